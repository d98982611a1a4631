"""What a scene does not require costs nothing: locked joints, idle fingers, terms that are off.

And what fingers cost side by side that share no inertia. Ratios within one run.

python benchmarks/required.py
"""

import functools
import logging
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin

import varpin as vp

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from test_required import hand, two_joint_panda
from timing import in_turns

ROUNDS, STEPS, DT = 25, 2_000, 1e-3
LOCK = {f"panda_joint{k}": 0.3 for k in (1, 3, 5, 6, 7)} | {"panda_finger_joint1": 0.02}


def simulation(
    scene: vp.Scene, q0: np.ndarray, controls: np.ndarray | None = None, speed: float = 0.0, rng: int | None = None
) -> Callable[[], object]:
    """A run of STEPS steps, by the same method with noise and without."""
    v0, options = np.full(len(q0), speed), {"controls": controls, "integrator": vp.Midpoint(), "rng": rng}
    return lambda: vp.simulate(scene, q0, v0, dt=DT, steps=STEPS, **options)


def fingers(copies: int) -> vp.Robot:
    """So many fingers of three joints side by side, each on its own."""
    model = pin.Model()
    link = pin.Inertia(0.02, np.array([0.0, 0.0, -0.02]), np.diag([3e-6, 3e-6, 1e-6]))
    for copy in range(copies):
        at, offset = 0, np.array([0.05 * copy, 0.0, 0.0])
        for k in range(3):
            at = model.addJoint(at, pin.JointModelRY(), pin.SE3(np.eye(3), offset), f"finger{copy}_{k}")
            model.appendBodyToJoint(at, link, pin.SE3.Identity())
            offset = np.array([0.0, 0.0, -0.04])
    return vp.load_robot(model)


def side_by_side() -> None:
    """Simulation and linearization of many fingers in one model, in multiples of as many times one."""
    runs: dict[tuple[str, int], Callable[[], object]] = {}
    for copies in (1, 2, 4, 8, 16):
        scene, q0 = vp.Scene(fingers(copies)), np.tile([0.5, 0.3, 0.2], copies)
        for integrator in (vp.Midpoint(), vp.Gauss(2)):
            options = {"dt": DT, "steps": STEPS // 4, "integrator": integrator}
            run = functools.partial(vp.simulate, scene, q0, np.zeros(len(q0)), check=False, **options)
            linearize = functools.partial(vp.linearize, scene, run(), integrator=integrator)
            runs |= {(f"{integrator} step", copies): run, (f"{integrator} linearization", copies): linearize}
    least = {key: times.min() for key, times in in_turns(runs, ROUNDS, time.process_time).items()}
    print("fingers of three joints in one model, against as many times one")
    for what, copies in runs:
        print(f"    {what}, {copies:2} fingers {least[what, copies] / (copies * least[what, 1]):6.3f}")


def compare(title: str, runs: dict[str, Callable[[], object]]) -> None:
    """Processor times of runs that take turns, the least and the median, and the ratio of the least to the first's."""
    times = in_turns(runs, ROUNDS, time.process_time)
    first = min(next(iter(times.values())))
    print(title)
    for name, own in times.items():
        print(
            f"    {name:40} {1e3 * min(own):9.2f} ms, median {1e3 * np.median(own):9.2f} ms   {min(own) / first:6.3f}"
        )


def main() -> None:
    """Measure and print."""
    logging.disable(logging.WARNING)
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
    arm, tiny = vp.load_robot("ur5"), 1e-12
    bent = np.linspace(-1.0, 1.0, 6)
    bare = {"gravity": False, "actuation": np.zeros((6, 0))}
    compare(
        "a UR5 in motion, with each term alone and too weak to change the motion",
        {
            name: simulation(vp.Scene(arm, **bare | term), bent, speed=0.5, rng=0 if "noise" in term else None)
            for name, term in {
                "none": {},
                "gravity": {"gravity": (0.0, 0.0, -tiny)},
                "damping": {"damping": tiny},
                "springs": {"stiffness": tiny},
                "additive noise": {"noise": vp.AdditiveNoise(tiny)},
                "controls": {"actuation": np.eye(6)},
            }.items()
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
    side_by_side()


if __name__ == "__main__":
    main()
