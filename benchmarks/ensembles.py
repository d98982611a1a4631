"""A path-step of a noisy ensemble against MuJoCo's rollouts of many motions, with one worker each and with two.

Both move as many paths over as many steps of 1 ms on the same chains of links: ``simulate_ensemble`` with Midpoint,
additive noise, guards and moments of the state at every node, ``mujoco.rollout`` with its Euler method, without noise,
writing all states into an array that is there already. All are measured in one run, in turns, and reported as ratios.
MuJoCo takes part where it is installed (``pip install "varpin[peers]"``).

    python benchmarks/ensembles.py
"""

from collections.abc import Callable

import numpy as np
from peers import mujoco_model
from timing import in_turns, in_words

import varpin as vp

ROUNDS = 9
PATHS = 200
STEPS = 500
DT = 1e-3
START = 0.3  # of every joint [rad]


def ensemble(links: int, workers: int) -> Callable[[], object]:
    """One simulate_ensemble call."""
    scene = vp.Scene(vp.planar_chain(links), damping=1e-4, noise=vp.AdditiveNoise(1e-3))
    start = {"q0": np.full(links, START), "v0": np.zeros(links)}
    size = {"dt": DT, "steps": STEPS, "paths": PATHS, "workers": workers}
    return lambda: vp.simulate_ensemble(scene, **start, **size, rng=0, store=False, quantiles=())


def rollouts(links: int, threads: int) -> Callable[[], object] | None:
    """One call of mujoco.rollout on the same chain, or None without MuJoCo."""
    model = mujoco_model(vp.Scene(vp.planar_chain(links), damping=1e-4), DT)
    if model is None:
        return None
    import mujoco  # noqa: PLC0415
    from mujoco import rollout  # noqa: PLC0415

    data = [mujoco.MjData(model) for _ in range(threads)]
    data[0].qpos[:] = START
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    first = np.zeros(size)
    mujoco.mj_getState(model, data[0], first, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    starts, states = np.tile(first, (PATHS, 1)), np.zeros((PATHS, STEPS, size))
    return lambda: rollout.rollout(model, data, starts, nstep=STEPS, state=states, persistent_pool=True)


def main() -> None:
    for links in (3, 7):
        runs = {"one": ensemble(links, 1), "two": ensemble(links, 2)}
        for name, threads in (("mujoco one", 1), ("mujoco two", 2)):
            run = rollouts(links, threads)
            if run is None:
                print("MuJoCo is not installed")
                break
            runs[name] = run
        times = {name: 1e6 / (PATHS * STEPS) * own for name, own in in_turns(runs, ROUNDS).items()}
        print(f"chain of {links}: a path-step {', '.join(f'{name} {own.min():.2f} us' for name, own in times.items())}")
        print(f"  two workers {in_words(times['one'] / times['two'])} times as fast as one")
        if "mujoco two" in times:
            for name in ("one", "two"):
                print(f"  to mujoco.rollout, {name} each: {in_words(times[name] / times[f'mujoco {name}'])}")


if __name__ == "__main__":
    main()
