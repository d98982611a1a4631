"""The tasks of plans.py raced against crocoddyl: the time to a plan that loses less than 1 % on the continuous robot.

    PYTHONPATH=src python benchmarks/plans_race.py race.json [words that a task's name has]
    PYTHONPATH=src python benchmarks/plans_race_page.py race.json

In the environment of crocoddyl_reference.py with ``cmeel-eigen==3.4.1``; it takes some 20 minutes. Tasks
that the file has are left out, and those that failed are tried again. Times are processor times, each side in one
thread. crocoddyl (FDDP, within limits BoxFDDP) solves the same problems by its own compiled models (native.py) in
Euler's and in two- and four-stage Runge-Kutta steps; varpin in steps of several integrators, its controls held or
linear between nodes. Both begin cold, with the torques that hold the robot at q0, and end where the expected decrease
is below 1e-4 of the optimum (varpin: of the cost at stake) or after 100 iterations. Problems are built before, and
finished plans are not looked at.

True costs are those on the continuous robot, by the controls alone, and with the plan's feedback at its own rate. A
plan whose step is halved, each search from the plan before, tells the optimum; several tasks have other local minima
too, and the optimum is the cost on which most agree. Each combination halves its step until its plan is good both ways,
or its true costs no longer change, or it takes longer than the best of its side. The best combinations are bisected,
and their best plans timed again, in turns. Each task has a process of its own, with a limit on its time.
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import crocoddyl
import numpy as np
import pinocchio as pin
from native import SCHEMES, Dynamics, joints
from plans import of_arms, others
from scipy.integrate import solve_ivp

import varpin as vp
from varpin.control.problem import bind_cost
from varpin.control.verification import played
from varpin.simulation.spectrum import rate_at_rest

WITHIN = 0.01
TOLERANCE, ITERATIONS = 1e-4, 100
# Steps a second: least, and how often they double.
LEAST, OCTAVES = 10, 10
# Without and with dampers that are faster than FAST [1/s].
INTEGRATORS = (
    (vp.Gauss(4), vp.RungeKutta4(), vp.Gauss(2)),
    (vp.Radau(4), vp.Gauss(4)),
)
FAST = 100.0
# Largest product of a damper's rate and the step at which explicit steps are tried.
STABLE = 2.8
# A combination ends where both costs change by less than that, or after a solve of LONGEST [s].
SETTLED, LONGEST = 2e-3, 2.0
# The optimum: steps a second of the first plan, tolerance, change of the cost, and time [s] that end it.
FIRST, FINE, SAME, PATIENCE = 20, 1e-5, 2e-4, 10.0
# Combinations within CLOSE times the best are bisected so often.
CLOSE, BISECTIONS = 2.0, 2
# The best of each side are repeated in turns, each for about half a second at most.
CANDIDATES, ROUNDS, ENOUGH = 2, 3, 0.5
# Coarsest step of the plain way [s].
COARSEST = 0.1
# Nodes up to which SciPy looks at plans, too.
CHECKED = 200
# True costs: the least number of substeps a second, how often they double, and their relative change then. Motions that
# run away are tried again RUNAWAYS times.
COARSE, DOUBLINGS, ACCURACY, RUNAWAYS = 100.0, 6, 1e-5, 2
# Time [s] for one task.
LIMIT = 900.0
WAYS = ("alone", "feedback")


@dataclass
class Run:
    """A plan: how it was made, its processor time [s], and what it costs on the continuous robot."""

    side: str
    scheme: str
    controls: str
    N: int
    seconds: float
    iterations: int
    alone: float
    feedback: float


def by_varpin(problem: vp.OptimalControlProblem) -> Callable[[], vp.Solution]:
    return lambda: vp.solve(problem, tolerance=TOLERANCE, max_iterations=ITERATIONS, check=False)


def by_crocoddyl(problem: vp.OptimalControlProblem, made: crocoddyl.ShootingProblem, stop: float) -> Callable[[], Any]:
    kind = crocoddyl.SolverBoxFDDP if problem.limited else crocoddyl.SolverFDDP
    hold = np.clip(problem.holding_controls(), *problem.control_limits)

    def run() -> Any:
        solver = kind(made)
        solver.th_stop = stop
        solver.solve([made.x0] * (made.T + 1), [hold] * made.T, ITERATIONS, False)
        return solver

    return run


def policy_of(problem: vp.OptimalControlProblem, plan: Any) -> vp.LinearPolicy | None:
    """What a plan does, as feedback on (q, v); None where it is not finite."""
    if isinstance(plan, vp.Solution):
        return plan.policy_on("velocity")
    u, x = np.array(plan.us.tolist()), np.array(plan.xs.tolist())
    gains = -np.array(plan.K.tolist()).reshape(len(u), problem.scene.controls, -1)
    if not all(np.isfinite(values).all() for values in (u, gains, x)):
        return None
    limits = tuple(problem.control_limits)
    return vp.LinearPolicy(u, gains, x, on="velocity", limits=limits, period=problem.duration / len(u))


def true_cost(problem: vp.OptimalControlProblem, policy: vp.LinearPolicy | None, rate: float, planned: float) -> float:
    """What a policy costs on the continuous robot, roughly where that is far from planned; infinite where it runs away.

    ``rate`` is that of the fastest damper [1/s].
    """
    if policy is None:
        return np.inf
    N, before = len(policy.u), np.nan
    shape = "linear" if policy.linear else "held"
    at = problem.at(dt=problem.duration / N, integrator=vp.RungeKutta4(), controls=shape)
    n, m, places = at.scene.robot.dof, at.scene.controls, at.integrator.stage_times
    substeps, lost = 2 * int(np.ceil(0.5 * at.dt * max(rate, COARSE))), 0
    for _ in range(DOUBLINGS):
        commands = policy.commands(N * substeps, m, n, False, dt=at.dt / substeps, stage_times=places)
        found = played(at, at.in_parts(substeps), commands, at.integrator).cost
        if abs(found - before) <= (ACCURACY if found < 2.0 * planned else 0.5) * abs(found):
            return found
        lost += not np.isfinite(found)
        if lost > RUNAWAYS:
            break
        before, substeps = found, 2 * substeps
    return np.inf


def by_scipy(problem: vp.OptimalControlProblem, policy: vp.LinearPolicy) -> float:
    """The true cost of a policy's controls alone, by SciPy on Pinocchio's forward dynamics."""
    scene, model, n, N = problem.scene, problem.scene.robot.model, problem.scene.robot.dof, len(policy.u)
    data, dt = model.createData(), problem.duration / N
    begins = np.vstack([policy.before, policy.u[:-1]]) if policy.linear else policy.u
    places, weights = np.polynomial.legendre.leggauss(8)
    places = 0.5 + 0.5 * places

    def rate(t: float, y: np.ndarray, k: int) -> np.ndarray:
        u = begins[k] + (t / dt - k) * (policy.u[k] - begins[k])
        force = scene.actuation @ u - scene.damping * y[n:]
        return np.concatenate([y[n:], pin.aba(model, data, y[:n], y[n:], force)])

    y, states, controls = np.concatenate([problem.q0, problem.v0]), [], []
    for k in range(N):
        span = np.array([k, k + 1]) * dt
        steps = solve_ivp(rate, span, y, "DOP853", args=(k,), rtol=1e-8, atol=1e-10, dense_output=True)
        states.append(steps.sol((k + places) * dt).T)
        controls.append(begins[k] + places[:, None] * (policy.u[k] - begins[k]))
        y = steps.y[:, -1]
    x, u = np.vstack(states), np.vstack(controls)
    times = ((np.arange(N)[:, None] + places) * dt).ravel()
    running, terminal = bind_cost(problem.cost, times, problem.running.points)
    integral = 0.5 * dt * np.tile(weights, N) @ running.value(x[:, :n].copy(), x[:, n:].copy(), u)
    return float(integral + terminal.value(y[None, :n].copy(), y[None, n:].copy(), u[:1])[0])


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    began = time.process_time()
    found = run()
    return found, time.process_time() - began


Prepared = Callable[[int], Callable[[], Any]]


class Race:
    """One task: its runs so far, and how each can be repeated."""

    def __init__(self, problem: vp.OptimalControlProblem) -> None:
        self.problem, self.dynamics = problem, Dynamics(problem)
        self.dynamics.require_same()
        self.rate = rate_at_rest(problem.scene, problem.q0)
        self.runs: list[Run] = []
        self.ways: dict[tuple[str, str, str], Prepared] = {}
        self.policies: list[vp.LinearPolicy | None] = []
        # True costs where combinations ended, and of the fine plan.
        self.settled: dict[tuple[str, ...], float] = {("fine",): self.fine()}

    @property
    def optimum(self) -> float:
        """The cost on which most agree to 1 %: the least of those, and lower ones are other local minima."""
        found = np.sort(list(self.settled.values()))
        near = np.searchsorted(found, found * (1.0 + WITHIN), side="right") - np.arange(found.size)
        return float(found[near.argmax()])

    def fine(self) -> float:
        """The true cost of a plan with linear controls, whose step is halved until it no longer changes."""
        problem, integrator = self.problem, INTEGRATORS[self.rate > FAST][0]
        N, u, before, began = round(FIRST * problem.duration), None, np.nan, time.process_time()
        while True:
            at = problem.at(dt=problem.duration / N, integrator=integrator, controls="linear")
            plan = vp.solve(at, u, tolerance=FINE, max_iterations=3 * ITERATIONS, check=False)
            if abs(plan.cost / before - 1.0) <= SAME or time.process_time() - began > PATIENCE:
                true = self.cost(policy_of(problem, plan), plan.cost)
                if abs(true / plan.cost - 1.0) <= SAME or time.process_time() - began > PATIENCE:
                    return true
            nodes = plan.trajectory.u_nodes
            u = np.repeat(nodes, 2, axis=0)[:-1]
            u[1::2] = 0.5 * (nodes[:-1] + nodes[1:])
            N, before = 2 * N, plan.cost

    def cost(self, policy: vp.LinearPolicy | None, planned: float) -> float:
        return true_cost(self.problem, policy, self.rate, planned)

    def good(self, run: Run, way: str) -> bool:
        return bool(getattr(run, way) <= (1.0 + WITHIN) * self.optimum)

    def best(self, side: str, way: str) -> float:
        """The least time [s] of a side's plans that are good; infinite without one."""
        return min((run.seconds for run in self.runs if run.side == side and self.good(run, way)), default=np.inf)

    def off(self, k: int) -> float | None:
        """The difference of SciPy's true cost of good controls, relatively; None for bad ones, or of many nodes."""
        run = self.runs[k]
        if run.N > CHECKED or not self.good(run, "alone"):
            return None
        return by_scipy(self.problem, self.policies[k]) / run.alone - 1.0

    def stable(self, side: str, scheme: str, N: int) -> bool:
        explicit = side == "crocoddyl" or scheme.startswith("RungeKutta")
        return not explicit or self.rate * self.problem.duration / N <= STABLE

    def of(self, combination: tuple[str, str, str]) -> list[Run]:
        return [run for run in self.runs if (run.side, run.scheme, run.controls) == combination]

    def one(self, combination: tuple[str, str, str], N: int) -> Run | None:
        """A plan, made now or before; None where there is no first motion, or no plan."""
        known = next((run for run in self.of(combination) if run.N == N), None)
        if known is not None:
            return known
        run = self.ways[combination](N)
        try:
            plan, seconds = timed(run)
        except vp.VarpinError:
            return None
        policy = policy_of(self.problem, plan)
        costs = [self.cost(own, plan.cost) for own in (policy and policy.without_feedback(), policy)]
        iterations = plan.iterations if combination[0] == "varpin" else min(plan.iter + 1, ITERATIONS)
        self.runs.append(Run(*combination, N, seconds, iterations, *costs))
        self.policies.append(policy)
        return self.runs[-1]

    def climb(self, side: str, scheme: str, shape: str) -> None:
        """Half the step until the plan is good, or its costs no longer change, or the side has faster plans."""
        before, has = None, dict.fromkeys(WAYS, False)
        for octave in range(OCTAVES):
            N = round(LEAST * 2**octave * self.problem.duration)
            run = self.one((side, scheme, shape), N) if self.stable(side, scheme, N) else None
            if run is None:
                continue
            costs = [run.alone, run.feedback]
            has = {way: has[way] or self.good(run, way) for way in WAYS}
            if all(has.values()) or (before is not None and np.allclose(costs, before, rtol=SETTLED, atol=0.0)):
                if np.isfinite(min(costs)):
                    self.settled[side, scheme, shape] = min(costs)
                break
            if run.seconds > LONGEST or all(has[way] or run.seconds > self.best(side, way) for way in WAYS):
                break
            before = costs

    def between(self, side: str) -> None:
        """The steps between the last two of each combination, and one finer, for a side without good plans."""
        for combination in [key for key in self.ways if key[0] == side]:
            for run in self.of(combination)[-2:]:
                self.one(combination, round(np.sqrt(2.0) * run.N))

    def bisect(self, side: str, way: str) -> None:
        """Between the first good step of the fastest combinations and twice that."""
        limit = CLOSE * self.best(side, way)
        for combination in [key for key in self.ways if key[0] == side]:
            own = self.of(combination)
            good = [run.N for run in own if self.good(run, way) and run.seconds <= limit]
            if not good:
                continue
            high = min(good)
            low = max([0.5 * high, *(run.N for run in own if high > run.N and not self.good(run, way))])
            for _ in range(BISECTIONS):
                N = round(np.sqrt(low * high))
                coarse = LEAST * self.problem.duration > N
                if coarse or N in (low, high) or not self.stable(side, combination[1], N):
                    break
                run = self.one(combination, N)
                low, high = (low, N) if run is not None and self.good(run, way) else (N, high)

    def all(self) -> None:
        for integrator in INTEGRATORS[self.rate > FAST]:
            for shape in ("linear", "held"):
                problem = self.problem.at(integrator=integrator, controls=shape)
                prepared = lambda N, own=problem: by_varpin(own.at(dt=own.duration / N))  # noqa: E731
                self.ways["varpin", str(integrator), shape] = prepared
        stop = TOLERANCE * self.optimum
        for scheme in reversed(SCHEMES):
            prepared = lambda N, own=scheme: by_crocoddyl(self.problem, self.dynamics.shooting(N, own), stop)  # noqa: E731
            self.ways["crocoddyl", scheme, "held"] = prepared
        # Again, where a later combination has changed the optimum.
        for combination in (*self.ways, *self.ways):
            self.climb(*combination)
        for side in ("varpin", "crocoddyl"):
            if any(np.isinf(self.best(side, way)) for way in WAYS):
                self.between(side)
            for way in WAYS:
                self.bisect(side, way)

    def by_itself(self, shape: str) -> Callable[[], vp.Solution]:
        """The plain way: a coarse step, the default integrator, and a true cost."""
        at, steps = self.problem, round(self.problem.duration / COARSEST)
        limits = tuple(at.control_limits)
        coarse = vp.OptimalControlProblem(
            at.scene, at.cost, at.q0, at.v0, dt=COARSEST, steps=steps, control_limits=limits, controls=shape
        )
        return lambda: vp.solve(coarse, true_cost=WITHIN, check=False)

    def told(self, plan: vp.Solution) -> dict[str, Any]:
        """What a plan made the plain way took, and what it loses to the optimum."""
        lost = self.cost(policy_of(self.problem, plan), plan.cost) / self.optimum - 1.0
        return {"met": plan.refinement.met, "N": plan.problem.steps, "tried": len(plan.refinement.tried), "loss": lost}

    def result(self) -> dict[str, Any]:
        """The optimum, all runs, the best of each side by either cost, and plain ``vp.solve(..., true_cost=...)``."""
        chosen = {}
        for side in ("varpin", "crocoddyl"):
            for way in WAYS:
                own = [k for k, run in enumerate(self.runs) if run.side == side and self.good(run, way)]
                chosen[side, way] = sorted(own, key=lambda k: self.runs[k].seconds)[:CANDIDATES]
        repeated: dict[int | str, Callable[[], Any]] = {}
        for k in {k for own in chosen.values() for k in own}:
            run = self.runs[k]
            repeated[k] = self.ways[run.side, run.scheme, run.controls](run.N)
        plain = {shape: self.by_itself(shape) for shape in ("held", "linear")}
        told: dict[str, dict[str, Any]] = {}
        times: dict[int | str, float] = dict.fromkeys((*repeated, *plain), np.inf)
        for turn in range(ROUNDS):
            for k, run in (repeated | plain).items():
                if turn == 0 or turn * times[k] < ENOUGH:
                    plan, seconds = timed(run)
                    times[k] = min(times[k], seconds)
                    if k in plain and k not in told:
                        told[k] = self.told(plan)
        for k in repeated:
            self.runs[k].seconds = min(self.runs[k].seconds, times[k])
        best: dict[str, dict[str, Any]] = {"varpin": {}, "crocoddyl": {}}
        for (side, way), own in chosen.items():
            if own:
                k = min(own, key=lambda k: self.runs[k].seconds)
                best[side][way] = asdict(self.runs[k]) | {"scipy": self.off(k)}
        return {
            "optimum": self.optimum,
            "best": best,
            "plain": {shape: told[shape] | {"seconds": times[shape]} for shape in plain},
            "runs": [asdict(run) for run in self.runs],
        }


def raced(task: vp.OptimalControlProblem) -> dict[str, Any]:
    """The result of a task, by a process of its own; where that fails, why."""
    forks = multiprocessing.get_context("fork")
    ours, theirs = forks.Pipe(duplex=False)

    def work() -> None:
        try:
            race = Race(task)
            race.all()
            theirs.send(race.result())
        except (Exception, SystemExit):
            theirs.send({"error": traceback.format_exc()})

    process = forks.Process(target=work)
    process.start()
    theirs.close()
    try:
        return ours.recv() if ours.poll(LIMIT) else {"error": f"it took longer than {LIMIT:g} s"}
    except EOFError:
        process.join()
        return {"error": f"its process ended with code {process.exitcode}"}
    finally:
        process.kill()
        process.join()


def show(result: dict[str, Any]) -> None:
    if "error" in result:
        print(f"  failed: {result['error']}", flush=True)
        return
    for side, ways in result["best"].items():
        for way, best in ways.items():
            how = f"{best['scheme']}, {best['controls']}, {best['N']} nodes"
            print(f"  {side:9} {way:8} {1e3 * best['seconds']:9.2f} ms, {best['iterations']:3d} iterations: {how}")
    for shape, plain in result["plain"].items():
        print(f"  {'plain':9} {shape:8} {1e3 * plain['seconds']:9.2f} ms, {plain['N']} nodes, {plain['loss']:+.2%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="of results (JSON); tasks that it has are not raced again")
    parser.add_argument("words", nargs="*", help="of the tasks' names")
    asked = parser.parse_args()
    logging.getLogger("varpin").setLevel(logging.ERROR)
    results = json.loads(asked.file.read_text(encoding="utf-8")) if asked.file.exists() else {}
    tasks = {name: task for name, task in (*of_arms(), *others()) if all(word in name for word in asked.words)}
    joints()  # compiled once, for all processes
    began = time.monotonic()
    for place, (name, task) in enumerate(tasks.items(), start=1):
        if name not in results or "error" in results[name]:
            results[name] = raced(task)
            asked.file.write_text(json.dumps(results, indent=1), encoding="utf-8")
            print(f"{name} ({place} of {len(tasks)}, {time.monotonic() - began:.0f} s)", flush=True)
            show(results[name])


if __name__ == "__main__":
    main()
