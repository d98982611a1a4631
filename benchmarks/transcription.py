"""Plans by ipopt, as a sparse nonlinear program, against varpin's: iterations, time, cost.

    python -m venv ipopt && ipopt/bin/pip install varpin ipyopt
    ipopt/bin/python benchmarks/transcription.py [words that a task's name has]

Tasks of plans.py as vp.solve has them: the same steps, the same cost, the same limits. ipopt's variables
are the states at all nodes and the controls, its constraints that each step ends at the next node; it has the
exact derivatives of varpin's linearization and the Gauss-Newton Hessian of the cost. Both begin cold, with the robot
held where it is, and are single-threaded. Whether ipopt's controls do what its program says is seen from the cost of
the motion that they make. Times are of the processor, of the fastest of three solves: of the whole solve, of an
iteration, of ipopt without evaluations, which are calls of varpin's core with NumPy around them, and until the cost is
within 1 % of the least one found, for good, with gaps below 1e-4.
"""

from __future__ import annotations

import logging
import sys
import time
from dataclasses import replace

import ipyopt
import numpy as np
import plans

import varpin as vp
from varpin.linearization import linearize_steps, velocity_at_nodes
from varpin.signals.commands import open_loop

TASKS = (
    "ur5 posture, free",
    "ur5 posture, end alone, free",
    "xarm7 posture, limited",
    "panda posture, limited",
    "z1 tool, end alone, limited",
    "ur5 with 3 kg, limited",
    "xarm7 follows a wave, limited",
    "swing-up by both joints, free",
    "swing-up by the elbow, limited",
)
TOLERANCE, MOST, ROUNDS, SECONDS = 1e-6, 200, 3, 8.0
NEAR, GAP = 0.01, 1e-4


class Transcription:
    """A problem as ipopt takes it: variables (q_1, v_1, ..., q_N, v_N, u_0, ..., u_(N-1))."""

    def __init__(self, problem: vp.OptimalControlProblem) -> None:
        self.problem, scene = problem, problem.scene
        self.first = problem.simulate(problem.holding_controls()[None].repeat(problem.steps, axis=0))
        self.N, self.n, self.m = problem.steps, scene.robot.dof, scene.controls
        self.evaluating, self.iterations = 0.0, 0
        N, n, m, x = self.N, self.n, self.m, 2 * self.n
        # Where (q, v) at both ends of each step and its control are among the variables; -1 for what is given.
        begins = np.arange(-x, (N - 1) * x, x)[:, None] + np.arange(x)
        begins[0] = -1
        ends, controls = np.arange(0, N * x, x)[:, None] + np.arange(x), N * x + np.arange(N * m).reshape(N, m)
        self.places = np.concatenate([begins, ends, controls], axis=1)
        size = self.places.shape[1]
        rows = np.broadcast_to((np.arange(N * x).reshape(N, x))[:, :, None], (N, x, size))
        columns = np.broadcast_to(self.places[:, None], (N, x, size))
        self.of_jacobian = columns >= 0
        self.lower = np.tril(np.ones((size, size), dtype=bool))
        one, other = (np.broadcast_to(p, (N, size, size)) for p in (self.places[:, :, None], self.places[:, None]))
        self.of_hessian = self.lower & (one >= 0) & (other >= 0)
        limits = np.tile(problem.control_limits, (1, N))
        free = np.full((2, N * x), np.inf) * [[-1.0], [1.0]]
        bounds = np.hstack([free, np.where(np.isfinite(limits), limits, np.sign(limits) * 2e19)])
        bounds = np.clip(bounds, -2e19, 2e19)
        self.solver = ipyopt.Problem(
            (N * (x + m)),
            bounds[0],
            bounds[1],
            N * x,
            np.zeros(N * x),
            np.zeros(N * x),
            (rows[self.of_jacobian], columns[self.of_jacobian]),
            (np.maximum(one, other)[self.of_hessian], np.minimum(one, other)[self.of_hessian]),
            self.timed(self.cost),
            self.timed(self.gradient),
            self.timed(self.gaps),
            self.timed(self.jacobian),
            self.timed(self.hessian),
            self.count,
            ipopt_options={"print_level": 0, "sb": "yes", "tol": TOLERANCE, "max_iter": MOST, "max_cpu_time": SECONDS},
        )
        # (q, v) of the samples in those at both ends of a step, and the control.
        eye, rule = np.eye(n), problem.rule
        self.samples = np.zeros((len(rule), x + m, size))
        for k, row in enumerate(rule):
            for place in range(4):
                self.samples[k, :n, place * n : (place + 1) * n] = row[1 + place] * eye
                self.samples[k, n:x, place * n : (place + 1) * n] = row[5 + place] * eye
            self.samples[k, x:, 2 * x :] = np.eye(m)

    def timed(self, function):
        """The same, and its time counts as that of evaluations."""

        def run(*given):
            began = time.process_time()
            found = function(*given)
            self.evaluating += time.process_time() - began
            return found

        return run

    def count(self, _mode, iteration, cost, gap, *_):
        self.iterations = iteration
        self.trace.append((time.process_time() - self.began, cost if gap <= GAP else np.inf))
        return True

    def motion(self, z):
        """q, v (N + 1, n) and u (N, m)."""
        problem, x = self.problem, 2 * self.n
        nodes = np.vstack([np.concatenate([problem.q0, problem.v0]), z[: self.N * x].reshape(self.N, x)])
        q, v = np.ascontiguousarray(nodes[:, : self.n]), np.ascontiguousarray(nodes[:, self.n :])
        return q, v, z[self.N * x :].reshape(self.N, self.m).copy()

    def cost(self, z):
        return float(self.problem.costs(*self.motion(z)))

    def expansion(self, z):
        """The gradient (N, size) and the Hessian (N, size, size) of each step's share of the cost, ends in the last."""
        problem, x, (q, v, u) = self.problem, 2 * self.n, self.motion(z)
        at = problem.running.expand(*problem.samples(q, v, u))
        S, weight = self.samples, problem.dt * problem.rule[0, 0]
        own, shape = at.gradient.reshape(self.N, len(S), -1), at.hessian.shape[1:]
        second = np.broadcast_to(at.hessian, (self.N * len(S), *shape)).reshape(self.N, len(S), *shape)
        g = weight * np.einsum("ksi,Nks->Ni", S, own)
        H = weight * sum(S[k].T @ second[:, k] @ S[k] for k in range(len(S)))
        end = problem.terminal.expand(q[-1:], v[-1:], np.zeros((1, self.m)))
        g[-1, x : 2 * x] += end.gradient[0, :x]
        H[-1, x : 2 * x, x : 2 * x] += end.hessian[0, :x, :x]
        return g, H

    def gradient(self, z, out):
        out[:] = 0.0
        g, known = self.expansion(z)[0], self.places >= 0
        np.add.at(out, self.places[known], g[known])

    def hessian(self, z, _multipliers, factor, out):
        out[:] = factor * self.expansion(z)[1][self.of_hessian]

    def nodes(self, z):
        """The motion that the variables are, as one of the problem's: its steps need not end at its nodes."""
        q, v, u = self.motion(z)
        M, _ = self.problem.scene.core.jets(q, v)
        p = np.einsum("Nij,Nj->Ni", M, v)
        return replace(self.first, q=q, v=v, p=p, u=u), M

    def gaps(self, z, out):
        """What each step ends beyond the next node, in (q, v)."""
        problem, scene, (q, v, u) = self.problem, self.problem.scene, self.motion(z)
        still = open_loop(np.zeros((1, self.m)))
        force = (u @ scene.actuation.T)[:, None]
        ends = problem.integrator.motions(scene, q[:-1].copy(), v[:-1].copy(), still, force, problem.dt)
        if ends is None:
            out[:] = np.nan
            return
        self.ends = ends[0][:, 0], ends[1][:, 0]
        out[:] = np.hstack([self.ends[0] - q[1:], self.ends[1] - v[1:]]).ravel()

    def jacobian(self, z, out):
        """Its derivatives."""
        scene, n, x = self.problem.scene, self.n, 2 * self.n
        self.gaps(z, np.zeros(self.N * x))
        motion, M = self.nodes(z)
        try:
            lin = linearize_steps(scene, motion, self.problem.integrator, motion.q[0])
        except vp.LinearizationError:
            out[:] = np.nan
            return
        # From (q, v) to (q, p) where a step begins, and back where it ends.
        begin, end = np.zeros((self.N, x, x)), np.zeros((self.N, x, x))
        begin[:, :n, :n] = end[:, :n, :n] = np.eye(n)
        begin[:, n:, :n], begin[:, n:, n:] = scene.core.jets(motion.q[:-1], motion.v[:-1])[1], M[:-1]
        end[:, n:] = velocity_at_nodes(scene, *self.ends)
        J = np.zeros((self.N, x, self.places.shape[1]))
        J[:, :, :x], J[:, :, x : 2 * x], J[:, :, 2 * x :] = end @ lin.A @ begin, -np.eye(x), end @ lin.B
        out[:] = J[self.of_jacobian]

    def solve(self):
        """The controls (N, m), and whether ipopt says that it has converged."""
        problem = self.problem
        self.evaluating, self.trace, self.began = 0.0, [], time.process_time()
        hold = problem.holding_controls()
        z = np.concatenate([np.tile(np.concatenate([problem.q0, 0.0 * problem.v0]), self.N), np.tile(hold, self.N)])
        z, _, status = self.solver.solve(z)
        return self.motion(z)[2], status == 0


def timed(run):
    """The shortest time that a call takes [s], and what it returned."""
    best, found = np.inf, None
    for _ in range(ROUNDS):
        began = time.process_time()
        got = run()
        took = time.process_time() - began
        if took < best:
            best, found = took, got
        if took > SECONDS / ROUNDS:
            break
    return best, found


def near(trace, least):
    """When the cost comes within reach of the least one for good, of (time, cost) [ms]."""
    reached = np.inf
    for at, cost in reversed(trace):
        if not cost <= (1.0 + NEAR) * least:
            break
        reached = at
    return f"{1e3 * reached:8.1f}" if np.isfinite(reached) else f"{'-':>8}"


def main() -> None:
    logging.getLogger("varpin").setLevel(logging.ERROR)
    words = sys.argv[1:]
    print(f"{'task':32} {'solver':7} {'iterations':>10} ", end="")
    print(f"{'ms':>8} {'ms each':>8} {'in ipopt':>8} {'to 1 %':>8} {'cost':>11}")
    for name, problem in (*plans.of_arms(), *plans.others()):
        if name not in TASKS or not all(word in name for word in words):
            continue
        made = Transcription(problem)

        def by_ipopt(made=made):
            u, well = made.solve()
            return u, well, made.trace, made.evaluating, made.iterations

        seconds, (u, well, trace, evaluating, iterations) = timed(by_ipopt)
        try:
            cost = vp.solve(problem, u, max_iterations=0, check=False).cost
        except vp.VarpinError:
            cost = np.inf

        def by_varpin(problem=problem):
            began, passed = time.process_time(), []
            note = lambda item: passed.append((time.process_time() - began, item.cost))  # noqa: E731
            options = {"tolerance": TOLERANCE, "max_iterations": MOST, "check": False}
            return vp.solve(problem, callback=note, **options), passed

        ours, (plan, own) = timed(by_varpin)
        least = min(plan.cost, cost)
        inside, ended = f"{1e3 * (seconds - evaluating):8.1f}", "" if well else "not converged"
        row(name, "ipopt", iterations, seconds, inside, near(trace, least), cost, ended)
        ended = "" if plan.status.converged else plan.status.name
        row(name, "varpin", plan.iterations, ours, "", near(own, least), plan.cost, ended)


def row(name, solver, iterations, seconds, inside, reached, cost, ended):
    """A line of the table."""
    each = 1e3 * seconds / max(iterations, 1)
    numbers = f"{iterations:10d} {1e3 * seconds:8.1f} {each:8.2f} {inside:>8} {reached} {cost:11.5g}"
    print(f"{name:32} {solver:7} {numbers} {ended}", flush=True)


if __name__ == "__main__":
    main()
