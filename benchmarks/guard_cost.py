"""What the guards cost on ordinary scenes: the midpoint rollout against the same kernel without them.

    python benchmarks/guard_cost.py

The kernel without guards is made here from the source of ``varpin.kernels.midpoint``: it takes every root that Newton's
method finds and keeps no ledger. Both run in turns in one process, from the same states, on motions that no guard
objects to, so that they do the same steps. Writes the table of ``docs/mathematics.md`` between its markers.
"""

# ruff: noqa: ARG001 - functions that do nothing take what those they stand for take

import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from unittest import mock

import numpy as np
from guards import DOCUMENT
from pages import fill

import varpin as vp
from varpin.integrators import midpoint
from varpin.kernels import midpoint as guarded
from varpin.kernels._compile import inlined

ROUNDS = 25
STEPS = 1_000
# Each is compiled that often, and the fastest counts: where code comes to lie in memory makes 5%.
COPIES = 3
DT = 1e-3
ROBOTS = {
    "finger": (None, [0.5, 0.3, 0.2]),
    "ur5": (None, [0.1] * 6),
    "panda": ({"panda_finger_joint1": 0.02}, [0.1] * 7),
    "talos_arm": (None, [0.1] * 7),
    "planar_chain(10)": (None, [0.1] * 10),
}


@inlined
def no_margin(mechanism, options, h, k):
    return np.inf


@inlined
def not_moved(mechanism, state, k):
    return


@inlined
def all_balanced(options, state, k, r):
    return True


@inlined
def only_energies(state, k, r):
    state.energy[r, 0], state.energy[r, 1] = k.balance[r, 0], k.sweep.V[r]


@inlined
def no_shares(fade, state, k):
    return


@inlined
def no_energies(mechanism, place, p, v, k):
    return


@inlined
def loads_balanced(mechanism, options, state, k, r, rounding):
    return True


@inlined
def no_loads(state, k):
    return


def compiled(**without: Callable[..., object]) -> ModuleType:
    """The kernels of the midpoint step, some of their functions replaced: names are looked up when first compiled."""
    module = ModuleType("kernels")
    exec(compile(Path(guarded.__file__).read_text(encoding="utf-8"), "kernels", "exec"), module.__dict__)
    module.__dict__.update(without)
    return module


def unguarded() -> ModuleType:
    """The kernels without guards."""
    return compiled(
        branch_margin=no_margin,
        moved=not_moved,
        balanced=all_balanced,
        enter=only_energies,
        enter_shares=no_shares,
        load_energies=no_energies,
        load_balanced=loads_balanced,
        enter_loads=no_loads,
    )


def row(name: str, whole: list[ModuleType], plain: list[ModuleType]) -> str:
    """Both on one robot, as a row of a Markdown table."""
    lock, q0 = ROBOTS[name]
    robot = vp.planar_chain(len(q0)) if name.startswith("planar") else vp.load_robot(name, lock=lock)
    scene = vp.Scene(robot, gravity=(0.0, -9.81, 0.0) if name == "finger" else True)
    start, rest = np.array(q0), np.zeros(robot.dof)

    def run(kernels: ModuleType) -> tuple[float, vp.Trajectory]:
        with mock.patch.object(midpoint, "kernels", kernels):
            begin = time.perf_counter()
            motion = vp.simulate(scene, start, rest, dt=DT, steps=STEPS, check=False)
            return (time.perf_counter() - begin) / STEPS, motion

    best = [np.inf, np.inf]
    for _ in range(ROUNDS):
        for copies in zip(whole, plain, strict=True):
            for i, kernels in enumerate(copies):
                seconds, motion = run(kernels)
                best[i] = min(best[i], seconds)
    ends = [run(kernels)[1].q[-1] for kernels in (whole[0], plain[0])]
    if not np.array_equal(*ends):
        raise SystemExit(f"{name}: the guards objected to a step, so that the two motions differ")
    iterations = motion.statistics.newton_iterations.mean()
    with_guards, without = (1e6 * seconds for seconds in best)
    share = with_guards / without - 1.0
    return f"| {name} | {robot.dof} | {iterations:.2f} | {with_guards:.2f} | {without:.2f} | {share:+.0%} |"


def main() -> None:
    whole, plain = [compiled() for _ in range(COPIES)], [unguarded() for _ in range(COPIES)]
    table = [
        "| robot | joints | Newton iterations | step [us] | without guards [us] | guards |",
        "|---|---|---|---|---|---|",
        *(row(name, whole, plain) for name in ROBOTS),
    ]
    print("\n".join(table))
    fill(DOCUMENT, {"cost": "\n".join(table)})


if __name__ == "__main__":
    main()
