"""What the guards cost on ordinary scenes: the midpoint rollout against the same rollout without them.

    python benchmarks/guard_cost.py

Without guards it takes every root that Newton's method finds and keeps no ledger. Both run in turns in one process,
from the same states, on motions that no guard objects to, so that they do the same steps.
"""

from functools import partial

import numpy as np
from timing import in_turns

import varpin as vp

ROUNDS = 75
STEPS = 1_000
DT = 1e-3
ROBOTS = {
    "finger": (None, [0.5, 0.3, 0.2]),
    "ur5": (None, [0.1] * 6),
    "panda": ({"panda_finger_joint1": 0.02}, [0.1] * 7),
    "talos_arm": (None, [0.1] * 7),
    "planar_chain(10)": (None, [0.1] * 10),
}


def row(name: str) -> str:
    """Both on one robot, as a row of a Markdown table."""
    lock, q0 = ROBOTS[name]
    robot = vp.planar_chain(len(q0)) if name.startswith("planar") else vp.load_robot(name, lock=lock)
    scene = vp.Scene(robot, gravity=(0.0, -9.81, 0.0) if name == "finger" else True)
    start, rest = np.array(q0), np.zeros(robot.dof)

    options = {"dt": DT, "steps": STEPS, "check": False}
    guards = {"guarded": vp.Guard(), "bare": None}
    runs = {
        name: partial(vp.simulate, scene, start, rest, integrator=vp.Midpoint(guard=guard), **options)
        for name, guard in guards.items()
    }
    guarded, bare = (own.min() / STEPS for own in in_turns(runs, ROUNDS).values())
    motion, other = (run() for run in runs.values())
    if not np.array_equal(motion.q, other.q):
        raise SystemExit(f"{name}: the guards objected to a step, so that the two motions differ")
    iterations = motion.statistics.newton_iterations.mean()
    cost = f"{1e6 * guarded:.2f} | {1e6 * bare:.2f} | {guarded / bare - 1.0:+.0%}"
    return f"| {name} | {robot.dof} | {iterations:.2f} | {cost} |"


def main() -> None:
    table = [
        "| robot | joints | Newton iterations | step [us] | without guards [us] | guards |",
        "|---|---|---|---|---|---|",
        *(row(name) for name in ROBOTS),
    ]
    print("\n".join(table))


if __name__ == "__main__":
    main()
