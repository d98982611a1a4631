"""Derivatives of one step against the step itself and against MuJoCo's finite differences; ensembles on two workers.

python benchmarks/linearize.py
"""

import time
from collections.abc import Callable

import numpy as np
from peers import mujoco_model

import varpin as vp

STEPS = 2000
ROUNDS = 15


def best(run: Callable[[], object], repeats: int = ROUNDS) -> float:
    """The fastest of several runs [s]."""
    seconds = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        seconds = min(seconds, time.perf_counter() - start)
    return seconds


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
    ensembles()


def ensembles() -> None:
    """Two workers against one, and one against a single motion, in turns: median and range of the ratios."""
    scene = vp.Scene(vp.load_robot("finger"), gravity=False, damping=1e-4, noise=vp.AdditiveNoise(1e-5))
    start = {"q0": np.full(3, 0.3), "v0": np.zeros(3), "dt": 1e-3}

    def ensemble(workers: int) -> float:
        options = {"paths": 1000, "steps": 1000, "rng": 0, "store": False, "quantiles": ()}
        return best(lambda: vp.simulate_ensemble(scene, **start, **options, workers=workers), 1)

    def single() -> float:
        return 10.0 * best(lambda: vp.simulate(scene, **start, steps=100_000, rng=0, check=False), 1)

    ensemble(1)
    times = np.array([(ensemble(1), ensemble(2), single()) for _ in range(ROUNDS)])
    # Short motions from the same start are other work than one long motion.
    paths = [
        vp.simulate(scene, **start, steps=1000, rng=child, check=False) for child in np.random.default_rng(0).spawn(50)
    ]
    long = vp.simulate(scene, **start, steps=100_000, rng=0, check=False)
    jets = np.mean([path.statistics.jets for path in paths]) / long.statistics.jets.mean()
    one, two, alone = times.min(axis=0)
    print(f"ensemble of 1000 paths: two workers {in_words(times[:, 0] / times[:, 1])} times as fast as one")
    print(f"a path-step {one:.2f} us on one worker, {two:.2f} us on two, a step of one simulate {alone:.2f} us")
    print(f"  one worker to one simulate {in_words(times[:, 0] / times[:, 2])}, with {jets:.3f} of its jets a step")


def in_words(ratios: np.ndarray) -> str:
    """Median and range."""
    return f"{np.median(ratios):.3f} ({ratios.min():.2f} to {ratios.max():.2f})"


if __name__ == "__main__":
    main()
