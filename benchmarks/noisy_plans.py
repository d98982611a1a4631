"""Plans under noise: whether paths cost what the model expects.

    PYTHONPATH=src python benchmarks/noisy_plans.py

Reaches from rest, under multiplicative noise from weak to where a plan makes no sense, and paths with the plan's
feedback. Then noise costs in long steps, against those of the same controls and gains in sixteenths of the steps.
"""

import logging
from collections.abc import Iterator

import numpy as np

import varpin as vp
from varpin.control.noise import noise_cost
from varpin.control.stages import Feedback, Steps

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


def by_paths(plan: vp.Solution) -> str:
    found = plan.monte_carlo(PATHS, rng=0)
    return f"{found.cost:.4g} ± {found.standard_error:.1g}"


def expected() -> None:
    print("| task | noise / cost | expected | status | iterations | paths |")
    print("| --- | ---: | ---: | --- | ---: | ---: |")
    for name, robot in robots().items():
        for label, noise in noises(robot):
            plan = vp.solve(reach(name, robot, noise), check=False)
            print(
                f"| {name}, {label} | {plan.noise_cost / plan.cost:.2g} | {plan.expected_cost:.7g} | "
                f"{plan.status.name.lower()} | {plan.iterations} | {by_paths(plan)} |",
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
                there = noise_cost(Steps(fine, fine.simulate(np.repeat(plan.controls, 16, axis=0))), feedback)
                found.append(f"{noise_cost(Steps(noisy, noisy.simulate(plan.controls)), feedback) / there - 1.0:+.1%}")
        print(f"| {name} | {' | '.join(found)} |", flush=True)


def main() -> None:
    logging.getLogger("varpin").setLevel(logging.ERROR)
    expected()
    print()
    long_steps()


if __name__ == "__main__":
    main()
