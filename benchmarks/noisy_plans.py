"""Plans under noise: what the whole gradient of the noise cost gains, and whether paths cost what the model expects.

    PYTHONPATH=src python benchmarks/noisy_plans.py

Reaches from rest, under multiplicative noise from weak to where a plan makes no sense. Each is solved with the value
function's Hessian held, as in the paper, and with the whole gradient. Times are CPU times as ratios within this run.
Paths of the second plan are integrated with its feedback. Then noise costs in long steps, against those of the same
controls and gains in sixteenths of the steps.
"""

import logging
import time
from collections.abc import Iterator

import numpy as np

import varpin as vp
from varpin.control.moments import noise_cost
from varpin.control.spread import Feedback

PATHS = 2000
ARMS = {
    "two links": ([0.2, 0.2], [0.5, -0.5]),
    "UR5": ([0.0, -1.5, 0.8, -0.5, 0.0, 0.0], [0.5, -1.0, 1.2, -0.9, 0.5, 0.3]),
    "Kinova": ([0.0, 2.9, 1.3, -2.1, 1.4, 0.0], [0.4, 2.6, 1.0, -1.9, 1.2, 0.3]),
    "Panda": ([0.4, -0.3, 0.2, -1.2, 0.1, 1.0, 0.3], [0.9, 0.2, -0.3, -0.8, 0.6, 1.4, -0.1]),
    "SO-100": ([0.0, 1.5, -1.2, 0.5, 0.0, 0.2], [0.4, 1.2, -0.9, 0.1, 0.4, 0.4]),
}


def robots() -> dict[str, vp.Robot]:
    return {
        "two links": vp.planar_chain(2),
        "UR5": vp.load_robot("ur5"),
        "Kinova": vp.load_robot("kinova"),
        "Panda": vp.load_robot("panda", lock={"panda_finger_joint1": 0.02}),
        "SO-100": vp.load_robot("so100"),
    }


def reach(name: str, robot: vp.Robot, noise: object, *, dt: float = 0.02, damping: float = 0.1, speed: float = 1e-2):
    """Of 0.6 s."""
    begin, goal = ARMS[name]
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(speed)
    cost += vp.Terminal(vp.TrackingCost(goal, 100.0) + vp.VelocityCost(1.0))
    scene = vp.Scene(robot, damping=damping, noise=noise)
    return vp.OptimalControlProblem(scene, cost, begin, np.zeros(robot.dof), dt=dt, steps=round(0.6 / dt))


def noises(robot: vp.Robot) -> Iterator[tuple[str, object]]:
    for strength in (0.03, 0.1, 0.2, 0.5):
        yield f"`ControlNoise({strength:g})`", vp.ControlNoise(strength)
    yield "`StateNoise(0.1)`", vp.StateNoise(0.1, center=np.zeros(robot.dof))


def solved(problem: vp.OptimalControlProblem, noise: str) -> tuple[vp.Solution, float]:
    started = time.process_time()
    plan = vp.solve(problem, noise=noise, check=False)
    return plan, time.process_time() - started


def by_paths(plan: vp.Solution) -> str:
    found = plan.monte_carlo(PATHS, rng=0)
    return f"{found.cost:.4g} ± {found.standard_error:.1g}"


def gains() -> None:
    print("| task | noise / cost | held | iterations | whole | iterations | lower by | time | paths |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, robot in robots().items():
        for label, noise in noises(robot):
            (held, before), (whole, after) = (solved(reach(name, robot, noise), mode) for mode in ("held", "whole"))
            ends = [
                f"{plan.expected_cost:.7g}{'' if plan.status.converged else f' ({plan.status.name.lower()})'}"
                for plan in (held, whole)
            ]
            share, lower = whole.noise_cost / whole.cost, 1.0 - whole.expected_cost / held.expected_cost
            print(
                f"| {name}, {label} | {share:.2g} | {ends[0]} | {held.iterations} | {ends[1]} | {whole.iterations} | "
                f"{lower:.1g} | {after / before:.1f} | {by_paths(whole)} |",
                flush=True,
            )


def long_steps() -> None:
    print("| arm | 20 ms | 20 ms, damped | 50 ms | 50 ms, damped |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for name, robot in robots().items():
        found = []
        for dt in (0.02, 0.05):
            for damping in (0.01, 1.0):
                plan = vp.solve(reach(name, robot, None, dt=dt, damping=damping, speed=1.0), check=False)
                noisy = reach(name, robot, vp.ControlNoise(0.03), dt=dt, damping=damping, speed=1.0)
                feedback = Feedback(plan.gains, plan.previous_gains)
                fine = noisy.at(dt=dt / 16, hold=16)
                there = noise_cost(fine, fine.simulate(np.repeat(plan.controls, 16, axis=0)), feedback)
                found.append(f"{noise_cost(noisy, noisy.simulate(plan.controls), feedback) / there - 1.0:+.1%}")
        print(f"| {name} | {' | '.join(found)} |", flush=True)


def main() -> None:
    logging.getLogger("varpin").setLevel(logging.ERROR)
    gains()
    print()
    long_steps()


if __name__ == "__main__":
    main()
