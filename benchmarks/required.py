"""What a scene does not require costs nothing: locked joints, idle fingers, terms that are off. Ratios within one run.

python benchmarks/required.py
"""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import varpin as vp

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from test_required import hand, two_joint_panda

ROUNDS, STEPS, DT = 25, 5_000, 1e-3
LOCK = {f"panda_joint{k}": 0.3 for k in (1, 3, 5, 6, 7)} | {"panda_finger_joint1": 0.02}


def simulation(scene: vp.Scene, q0: np.ndarray, controls: np.ndarray | None = None) -> Callable[[], object]:
    """A run of STEPS steps from rest."""
    return lambda: vp.simulate(scene, q0, np.zeros(len(q0)), dt=DT, steps=STEPS, controls=controls)


def compare(title: str, runs: dict[str, Callable[[], object]]) -> None:
    """Median times of runs that take turns, and their ratios to the first."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(ROUNDS):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - begin)
    first = next(iter(times.values()))
    print(title)
    for name, own in times.items():
        ratio = np.median(np.array(own) / np.array(first))
        print(f"    {name:48} {1e3 * np.median(own):9.3f} ms   {ratio:6.3f}")


def main() -> None:
    """Measure and print."""
    q0 = np.array([0.2, -1.0])
    panda, whole = vp.load_robot("panda", lock=LOCK), vp.load_robot("panda")
    start = np.array([0.3, 0.2, 0.3, -1.0, 0.3, 0.3, 0.3, 0.02])
    compare(
        f"a Panda with 7 of its 9 joints locked, {STEPS} steps",
        {
            "a 2-joint arm, built by hand": simulation(vp.Scene(vp.load_robot(two_joint_panda(LOCK))), q0),
            "the Panda, 7 joints locked": simulation(vp.Scene(panda), q0),
            "the Panda, nothing locked": simulation(vp.Scene(whole), start),
        },
    )
    arm = vp.load_robot("ur5")
    bent = np.linspace(-1.0, 1.0, 6)
    hold = np.zeros(6)
    compare(
        "terms that are on, each alone (a UR5 without gravity)",
        {
            "none": simulation(vp.Scene(arm, gravity=False), bent),
            "gravity": simulation(vp.Scene(arm, actuation=np.zeros((6, 0))), bent),
            "damping": simulation(vp.Scene(arm, gravity=False, damping=0.1), bent),
            "controls of zero": simulation(vp.Scene(arm, gravity=False), bent, hold),
        },
    )
    with tempfile.TemporaryDirectory() as folder:
        one = hand(Path(folder), ["joint_1.0"])
        idle, everything = vp.load_scene(one), vp.load_scene(one, required_only=False)
        compare(
            "an Allegro hand that moves one finger: a simulation and a plan",
            {
                "simulate: what is required": simulation(idle.scene, idle.q0, np.full(4, 0.01)),
                "simulate: all 16 joints": simulation(everything.scene, everything.q0, np.repeat([0.01, 0.0], [4, 12])),
            },
        )
        compare(
            "the same, solved",
            {
                "solve: what is required": idle.solve,
                "solve: all 16 joints": lambda: vp.solve(everything.problem),
            },
        )
        four = vp.load_scene(hand(Path(folder), ["joint_1.0", "joint_5.0", "joint_9.0", "joint_13.0"]))
        compare(
            "an Allegro hand that moves four fingers",
            {"solve: each finger apart": four.solve, "solve: all together": lambda: vp.solve(four.problem)},
        )


if __name__ == "__main__":
    main()
