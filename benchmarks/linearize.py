"""Derivatives of one step against the step itself and against MuJoCo's finite differences.

python benchmarks/linearize.py
"""

from collections.abc import Callable

import numpy as np
from peers import mujoco_model
from timing import in_turns

import varpin as vp

STEPS = 2000
ROUNDS = 15


def best(run: Callable[[], object], rounds: int = ROUNDS) -> float:
    """The fastest of several runs [s]."""
    return float(in_turns({"": run}, rounds)[""].min())


def transition_fd(links: int) -> float | None:
    """Seconds of one mujoco.mjd_transitionFD on a chain, or None without MuJoCo."""
    model = mujoco_model(vp.Scene(vp.planar_chain(links)), 1e-3)
    if model is None:
        return None
    import mujoco  # noqa: PLC0415

    data = mujoco.MjData(model)
    A, B = np.zeros((2 * links, 2 * links)), np.zeros((2 * links, 0))

    def run() -> None:
        for _ in range(STEPS):
            mujoco.mjd_transitionFD(model, data, 1e-6, True, A, B, None, None)

    return best(run) / STEPS


def main() -> None:
    robots = (vp.load_robot("finger"), vp.load_robot("xarm7"), vp.planar_chain(3), vp.planar_chain(7))
    for robot in robots:
        scene = vp.Scene(robot)
        start = np.full(robot.dof, 0.1), np.zeros(robot.dof)
        midpoint = vp.Midpoint()
        options = {"dt": 1e-3, "steps": STEPS, "integrator": midpoint}
        motion = vp.simulate(scene, *start, **options)
        step = best(lambda s=scene, x=start, o=options: vp.simulate(s, *x, **o, check=False)) / STEPS
        core = best(lambda s=scene, m=motion, i=midpoint: i.linearize(s, m)) / STEPS
        whole = best(lambda s=scene, m=motion: vp.linearize(s, m)) / STEPS
        line = f"{robot.name:8} step {1e6 * step:6.2f} us, derivatives {1e6 * core:6.2f} us ({core / step:.2f} of it)"
        line += f", linearize {1e6 * whole:6.2f} us ({whole / step:.2f})"
        if robot.name.startswith("chain"):
            other = transition_fd(robot.dof)
            if other is not None:
                line += f", mjd_transitionFD {1e6 * other:.2f} us ({core / other:.2f} of it)"
        print(line)


if __name__ == "__main__":
    main()
