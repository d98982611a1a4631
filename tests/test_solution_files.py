"""Solutions on disk: refused where they do not belong, or hold what no solution has."""

import numpy as np
import pytest
from plan_problems import CAPSULES, TWO, reach, speeds
from refusals import refused

import varpin as vp


def other(**scene):
    return reach(scene=vp.Scene(**{"robot": TWO, "damping": 0.1, **scene}))


def apart(z):
    start = TWO.frame_positions(np.zeros(2), "tip")
    return reach(vp.KeepOutOfSphere(TWO, "tip", start + np.array([0.0, 0.0, z]), 0.05))


def moving(speed):
    """In another process the same function has another address."""

    def way(t):
        return [speed * t, 0.0, 0.0]

    ball = vp.Obstacle.sphere([1.5, 0.0, 0.5], 0.1).moving(way)
    return reach(vp.KeepInSphere(TWO, "tip", way, 5.0), vp.KeepClear(TWO, [ball], capsules=CAPSULES))


# Two problems, and what the errors of files and of the search name.
PAIRS = {
    "dt": (reach, lambda: reach(dt=0.03, steps=24), "0.03", "0.03"),
    "start": (reach, lambda: reach().at(q0=[0.0, 0.1]), "q0", "q0"),
    "cost": (reach, lambda: reach(more=vp.ControlCost(0.1)), "cost", "cost"),
    "damping": (reach, lambda: other(damping=0.3), "damping", "damping"),
    "noise": (reach, lambda: other(noise=vp.AdditiveNoise(0.1)), "noise", "noise"),
    "integrator": (reach, lambda: reach(integrator=vp.Midpoint(alpha=0.4)), "integrator", "integrator"),
    "robot": (reach, lambda: other(robot=vp.planar_chain(2, mass=2.0)), "links", "scene"),
    "friction": (reach, lambda: other(forces=vp.CoulombFriction(1e-3, 1.0)), "scene", "scene"),
    "stops": (reach, lambda: other(forces=vp.JointStop(9.0, lower=-1.0, upper=1.0)), "scene", "scene"),
    "armature": (reach, lambda: other(forces=vp.Armature(0.1)), "scene", "armature"),
    "load": (reach, lambda: other(forces=vp.FrameWrench("tip", (0.0, 0.0, 0.1, 0.0, 0.0, 0.0))), "scene", "scene"),
    "instants": (
        lambda: reach(speeds(1.8)), lambda: reach(speeds(1.8), between_nodes=True), "between_nodes", "between_nodes"
    ),
    "places away from the start": (lambda: apart(0.2), lambda: apart(-0.2), "constraints", "constraints"),
    "ways": (lambda: moving(1.0), lambda: moving(1.1), "constraints", "constraints"),
}  # fmt: skip


@pytest.mark.parametrize("name", PAIRS)
def test_a_solution_of_another_problem_is_refused(name, tmp_path):
    """From a file and to go on from, in both directions."""
    *pair, of_file, of_search = PAIRS[name]
    for mine, theirs in (pair, pair[::-1]):
        plan = vp.solve(mine(), max_iterations=1, check=False)
        path = plan.save(tmp_path / "plan.npz")
        assert vp.Solution.load(path, mine()).cost == plan.cost
        with refused(vp.FileError, of_file):
            vp.Solution.load(path, theirs())
        with refused(vp.InputError, of_search):
            vp.solve(theirs(), resume=plan)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("history.index", lambda rows: rows + 0.5),
        ("search.iterations", lambda count: -1 - count),
        ("status", lambda _: "DONE"),
        ("cost", lambda cost: 1.1 * cost),
    ],
)
def test_numbers_that_no_solution_has(name, change, tmp_path):
    path = vp.solve(reach(), max_iterations=1).save(tmp_path / "plan.npz")
    members = dict(np.load(path))
    np.savez(path, **members | {name: change(members[name])})
    with refused(vp.FileError, name.split(".")[-1]):
        vp.Solution.load(path, reach())


def test_resume_of_something_else():
    plan = vp.solve(reach(), max_iterations=1)
    with refused(vp.InputError, "resume"):
        vp.solve(reach(), plan, resume=plan)
    with refused(vp.InputError, "Solution"):
        vp.solve(reach(), resume=plan.trajectory)
