"""S-DDP against crocoddyl: an iteration, and the time to a plan whose true cost is within 1% of the optimum.

    PYTHONPATH=src python benchmarks/sddp.py

In the environment of crocoddyl_reference.py, whose problems these are; both single-threaded, in turns, in one process.
Ratios are what counts: machines differ, and this one is noisy. True costs are open loop: of the controls alone, applied
to the continuous robot. varpin's look at a finished plan is left out, as crocoddyl takes none.
"""

from collections.abc import Callable

import crocoddyl
import numpy as np
import pinocchio as pin
from crocoddyl_reference import PROBLEMS, Problem, require_gravity, shooting
from timing import in_turns

import varpin as vp
from varpin.control.verification import played
from varpin.signals.commands import open_loop

ROUNDS = 15
PASSES = 3
SIZES = {"finger": (250, 1500), "panda": (200, 1000)}
LADDERS = {
    "finger": (250, 375, 500, 750, 1000, 1500, 2000, 3000),
    "panda": (20, 30, 40, 50, 75, 100, 150, 200, 300, 400, 500),
}


def ours(problem: Problem, N: int, integrator: vp.integrators.Integrator) -> vp.OptimalControlProblem:
    wq, wv, wu, Wq, Wv = problem.weights
    cost = vp.TrackingCost(problem.reference, wq) + vp.ControlCost(wu) + vp.Terminal(
        vp.TrackingCost(problem.reference, Wq)
    )  # fmt: skip
    if wv:
        cost = cost + vp.VelocityCost(wv) + vp.Terminal(vp.VelocityCost(Wv))
    scene = vp.Scene(vp.load_robot(problem.robot, lock=problem.lock or None))
    rest = np.zeros(scene.robot.dof)
    return vp.OptimalControlProblem(scene, cost, problem.q0, rest, dt=problem.tf / N, steps=N, integrator=integrator)


def theirs(
    problem: Problem, model: pin.Model, integrator: str, N: int, solver: type, threshold: float, most: int
) -> Callable[[], np.ndarray]:
    made = shooting(problem, model, integrator, N)
    rest = np.zeros(model.nv)
    hold = pin.rnea(model, model.createData(), np.array(problem.q0), rest, rest)

    def run() -> np.ndarray:
        own = solver(made)
        own.th_stop, own.reg_min = threshold, 1e-14
        own.solve([made.x0] * (N + 1), [hold] * N, most, False)
        return np.array(own.us)

    return run


def iterations() -> None:
    print("one iteration (rollout, derivatives, backward pass), us a node; ratio varpin / crocoddyl")
    for name, sizes in SIZES.items():
        problem = PROBLEMS[name]
        model = problem.model()
        require_gravity(model)
        for N in sizes:
            own = ours(problem, N, vp.Midpoint())
            runs = {
                "mine": lambda own=own: vp.solve(own, max_iterations=PASSES - 1, tolerance=1e-300, check=False),
                "other": theirs(problem, model, "Euler", N, crocoddyl.SolverDDP, 1e-300, PASSES),
            }
            mine, other = (own.min() for own in in_turns(runs, ROUNDS).values())
            a, b = (seconds / N / PASSES * 1e6 for seconds in (mine, other))
            print(f"  {name:8s} N = {N:5d}  varpin Midpoint {a:6.2f}  crocoddyl DDP, Euler {b:6.2f}  {a / b:5.2f}")


def time_to_one_percent() -> None:
    print("cold solve [ms] and true cost over the optimum; best within 1%")
    for name, ladder in LADDERS.items():
        problem = PROBLEMS[name]
        model = problem.model()
        reference = ours(problem, max(ladder), vp.RungeKutta4())
        optimum = (
            vp.solve(reference.at(dt=reference.dt / 4), tolerance=1e-12, check=False)
            .verify(tolerance=1e-9)
            .open_loop_cost
        )
        own = {f"varpin {i}": i for i in (vp.Midpoint(), vp.RungeKutta4(), *gauss())}
        best: dict[str, float] = {}
        for label in (*own, "crocoddyl FDDP Euler", "crocoddyl FDDP RK4"):
            for N in ladder:
                ocp = ours(problem, N, own.get(label, vp.Midpoint()))
                if label in own:
                    run = lambda ocp=ocp: vp.solve(ocp, tolerance=1e-4, check=False).controls  # noqa: E731
                else:
                    run = theirs(problem, model, label.split()[-1], N, crocoddyl.SolverFDDP, 1e-4 * optimum, 100)
                seconds = in_turns({"": run}, 5)[""].min()
                commands = open_loop(run())._replace(hold=64)
                cost = played(ocp, ocp.in_parts(64), commands, vp.RungeKutta4()).cost
                excess = cost / optimum - 1.0
                print(f"  {name:8s} {label:24s} N = {N:5d} {seconds * 1e3:9.2f} ms  {excess:+.2%}")
                if abs(excess) <= 0.01:
                    best[label] = min(best.get(label, np.inf), seconds)
                    break
        for label, seconds in best.items():
            print(f"  {name}: {label} within 1% in {seconds * 1e3:.2f} ms")


def gauss() -> tuple[vp.integrators.Integrator, ...]:
    return tuple(vp.Gauss(stages) for stages in (2, 3)) if hasattr(vp, "Gauss") else ()


if __name__ == "__main__":
    iterations()
    time_to_one_percent()
