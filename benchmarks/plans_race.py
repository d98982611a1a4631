"""The tasks of plans.py raced against crocoddyl: the time to a plan that loses less than 1 % on the continuous robot.

    PYTHONPATH=src python benchmarks/plans_race.py race.json [words that a task's name has]
    PYTHONPATH=src python benchmarks/plans_race_page.py race.json

In the environment of crocoddyl_reference.py with ``cmeel-eigen==3.4.1``; it takes some 20 minutes. Tasks
that the file has are left out. Times are processor times, each side in one thread. crocoddyl (FDDP, within limits
BoxFDDP) solves the same problems by its own compiled models (native.py) in Euler's and in two- and four-stage
Runge-Kutta steps;
varpin in steps of several integrators, its controls held or linear between nodes. Both begin cold, with the torques
that hold the robot at q0, and end where the expected decrease is below 1e-4 of the optimum (varpin: of the cost at
stake) or after 100 iterations. Problems are built before, and finished plans are not looked at.

Each combination climbs a ladder of steps until its plans' true costs no longer change: those on the continuous robot,
by the controls alone, and with the plan's feedback at its own rate. The optimum is the cost on which most ladders
agree; some tasks have several local minima. The best plans of each side are timed again, in turns.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import crocoddyl
import numpy as np
import pinocchio as pin
from native import SCHEMES, Dynamics
from plans import of_arms, others
from scipy.integrate import solve_ivp

import varpin as vp
from varpin.control.problem import bind_cost
from varpin.control.verification import accurate_cost
from varpin.simulation.friction import rate_at_rest

WITHIN = 0.01
TOLERANCE, ITERATIONS = 1e-4, 100
# Steps a second.
LADDER = (10, 14, 20, 28, 40, 56, 80, 112, 160, 226, 320, 452, 640, 904, 1280, 2560, 5120, 10240)
COARSEST = 0.1
# Without and with dampers that are faster than FAST [1/s].
INTEGRATORS = (
    (vp.Gauss(4), vp.RungeKutta4(), vp.Gauss(2)),
    (vp.Radau(4), vp.Gauss(4)),
)
FAST = 100.0
# Largest product of a damper's rate and the step at which explicit steps are tried.
STABLE = 2.8
# A ladder ends where both costs change by less than that, or a solve takes PATIENCE times the least one of which this
# was true, or LONGEST [s].
SETTLED, PATIENCE, LONGEST = 2e-3, 1.5, 2.0
# The best of each side are repeated in turns, each for about half a second at most.
CANDIDATES, ROUNDS, ENOUGH = 2, 3, 0.5
# Nodes up to which SciPy looks at plans, too.
CHECKED = 200
# True costs: the least number of substeps a second, how often they double, and their relative change then.
COARSE, DOUBLINGS, ACCURACY = 100.0, 6, 1e-5


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
    substeps = 2 * int(np.ceil(0.5 * at.dt * max(rate, COARSE)))
    for _ in range(DOUBLINGS):
        commands = policy.commands(N * substeps, m, n, False, dt=at.dt / substeps, stage_times=places)
        found, _ = accurate_cost(at, commands, substeps)
        if abs(found - before) <= (ACCURACY if found < 2.0 * planned else 0.5) * abs(found):
            return found
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


class Race:
    """One task: its runs so far, and how each can be repeated."""

    def __init__(self, problem: vp.OptimalControlProblem) -> None:
        self.problem, self.dynamics = problem, Dynamics(problem)
        self.dynamics.require_same()
        self.rate = rate_at_rest(problem.scene, problem.q0)
        self.runs: list[Run] = []
        self.again: list[Callable[[], Any]] = []
        self.policies: list[vp.LinearPolicy | None] = []
        # True costs at the ends of ladders.
        self.settled: list[float] = []
        # Time [s] from which a side's ladders end.
        self.enough = {"varpin": LONGEST, "crocoddyl": LONGEST}

    @property
    def optimum(self) -> float:
        """The cost on which most ladders agree to 1 %: the least of those, and lower ones are other local minima."""
        found = np.sort(self.settled or [min(run.alone, run.feedback) for run in self.runs])
        near = np.searchsorted(found, found * (1.0 + WITHIN), side="right") - np.arange(found.size)
        return float(found[near.argmax()])

    def cost(self, policy: vp.LinearPolicy | None, planned: float) -> float:
        return true_cost(self.problem, policy, self.rate, planned)

    def off(self, k: int) -> float | None:
        """The difference of SciPy's true cost of good controls, relatively; None for bad ones, or of many nodes."""
        run = self.runs[k]
        if run.N > CHECKED or run.alone > (1.0 + WITHIN) * self.optimum:
            return None
        return by_scipy(self.problem, self.policies[k]) / run.alone - 1.0

    def climb(self, side: str, scheme: str, shape: str, prepared: Callable[[int], Callable[[], Any]]) -> None:
        """Up the ladder until the plans' costs no longer change."""
        explicit = side == "crocoddyl" or scheme.startswith("RungeKutta")
        before = None
        for rung in LADDER:
            N = round(rung * self.problem.duration)
            if explicit and self.rate * self.problem.duration / N > STABLE:
                continue
            run = prepared(N)
            try:
                plan, seconds = timed(run)
            except vp.VarpinError:
                continue
            policy = policy_of(self.problem, plan)
            costs = [self.cost(own, plan.cost) for own in (policy and policy.without_feedback(), policy)]
            iterations = plan.iterations if side == "varpin" else min(plan.iter + 1, ITERATIONS)
            self.runs.append(Run(side, scheme, shape, N, seconds, iterations, *costs))
            self.again.append(run)
            self.policies.append(policy)
            if before is not None and np.allclose(costs, before, rtol=SETTLED, atol=0.0):
                self.enough[side] = min(self.enough[side], PATIENCE * self.runs[-2].seconds)
                self.settled.append(min(costs))
                break
            if seconds > self.enough[side]:
                break
            before = costs

    def all(self) -> None:
        for integrator in INTEGRATORS[self.rate > FAST]:
            for shape in ("linear", "held"):
                problem = self.problem.at(integrator=integrator, controls=shape)
                prepared = lambda N, own=problem: by_varpin(own.at(dt=own.duration / N))  # noqa: E731
                self.climb("varpin", str(integrator), shape, prepared)
        stop = TOLERANCE * self.optimum
        for scheme in reversed(SCHEMES):
            prepared = lambda N, own=scheme: by_crocoddyl(self.problem, self.dynamics.shooting(N, own), stop)  # noqa: E731
            self.climb("crocoddyl", scheme, "held", prepared)

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
        optimum = self.optimum
        good = (1.0 + WITHIN) * optimum
        chosen = {}
        for side in ("varpin", "crocoddyl"):
            for way in ("alone", "feedback"):
                own = [k for k, run in enumerate(self.runs) if run.side == side and getattr(run, way) <= good]
                chosen[side, way] = sorted(own, key=lambda k: self.runs[k].seconds)[:CANDIDATES]
        repeated = {k: self.again[k] for own in chosen.values() for k in own}
        plain = {shape: self.by_itself(shape) for shape in ("held", "linear")}
        times: dict[int | str, float] = dict.fromkeys((*repeated, *plain), np.inf)
        for turn in range(ROUNDS):
            for k, run in (repeated | plain).items():
                if turn == 0 or turn * times[k] < ENOUGH:
                    times[k] = min(times[k], timed(run)[1])
        for k in repeated:
            self.runs[k].seconds = min(self.runs[k].seconds, times[k])
        best: dict[str, dict[str, Any]] = {"varpin": {}, "crocoddyl": {}}
        for (side, way), own in chosen.items():
            if own:
                k = min(own, key=lambda k: self.runs[k].seconds)
                best[side][way] = asdict(self.runs[k]) | {"scipy": self.off(k)}
        return {
            "optimum": optimum,
            "best": best,
            "plain": {shape: self.told(run()) | {"seconds": times[shape]} for shape, run in plain.items()},
            "runs": [asdict(run) for run in self.runs],
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="of results (JSON); tasks that it has are not raced again")
    parser.add_argument("words", nargs="*", help="of the tasks' names")
    asked = parser.parse_args()
    logging.getLogger("varpin").setLevel(logging.ERROR)
    results = json.loads(asked.file.read_text()) if asked.file.exists() else {}
    for name, task in (*of_arms(), *others()):
        if name in results or not all(word in name for word in asked.words):
            continue
        race = Race(task)
        race.all()
        results[name] = race.result()
        asked.file.write_text(json.dumps(results, indent=1))
        print(name, flush=True)
        for side, ways in results[name]["best"].items():
            for way, best in ways.items():
                how = f"{best['scheme']}, {best['controls']}, {best['N']} nodes"
                print(f"  {side:9} {way:8} {1e3 * best['seconds']:9.2f} ms, {best['iterations']:3d} iterations: {how}")
        for shape, plain in results[name]["plain"].items():
            print(f"  {'plain':9} {shape:8} {1e3 * plain['seconds']:9.2f} ms, {plain['N']} nodes, {plain['loss']:+.2%}")


if __name__ == "__main__":
    main()
