"""Solutions on disk: refused where they do not belong, or hold what no solution has."""

import numpy as np
import pytest
from refusals import refused

import varpin as vp


def problem_of(*, noise=None, damping=0.2, dt=0.02, weight=0.1, integrator=None, q0=(0.4, -0.3), robot=None, forces=()):
    robot = vp.planar_chain(2) if robot is None else robot
    scene = vp.Scene(robot, damping=damping, noise=noise, forces=forces)
    cost = vp.TrackingCost([0.8, 0.1], 10.0) + vp.ControlCost(weight) + vp.Terminal(vp.VelocityCost(1.0))
    return vp.OptimalControlProblem(scene, cost, q0, [0.0, 0.0], dt=dt, steps=round(0.6 / dt), integrator=integrator)


@pytest.mark.parametrize(
    ("other", "fact"),
    [
        ({"dt": 0.03}, "0.03"),
        ({"q0": (0.4, -0.2)}, "q0"),
        ({"weight": 0.2}, "cost"),
        ({"damping": 0.3}, "damping"),
        ({"noise": vp.AdditiveNoise(0.1)}, "noise"),
        ({"integrator": vp.Midpoint(alpha=0.4)}, "integrator"),
        ({"robot": vp.planar_chain(2, mass=2.0)}, "links"),
        ({"forces": vp.CoulombFriction(1e-3, 1.0)}, "scene"),
        ({"forces": vp.JointStop(9.0, lower=-1.0, upper=1.0)}, "scene"),
        ({"forces": vp.Armature(0.1)}, "armature"),
        ({"forces": vp.FrameWrench("tip", (0.0, 0.0, 0.1, 0.0, 0.0, 0.0))}, "scene"),
    ],
)
def test_a_solution_of_another_problem_is_refused(other, fact, tmp_path):
    """From a file and to go on from, in both directions."""
    pair = [problem_of(), problem_of(**other)]
    for mine, theirs in (pair, pair[::-1]):
        plan = vp.solve(mine, max_iterations=1, second_order=True, check=False)
        path = plan.save(tmp_path / "plan.npz")
        assert vp.Solution.load(path, mine).cost == plan.cost
        with refused(vp.FileError, fact if fact != "armature" else "scene"):
            vp.Solution.load(path, theirs)
        with refused(vp.InputError, fact if fact != "links" else "scene"):
            vp.solve(theirs, resume=plan)


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
    path = vp.solve(problem_of(), max_iterations=1).save(tmp_path / "plan.npz")
    members = dict(np.load(path))
    np.savez(path, **members | {name: change(members[name])})
    with refused(vp.FileError, name.split(".")[-1]):
        vp.Solution.load(path, problem_of())


def test_resume_of_something_else():
    plan = vp.solve(problem_of(), max_iterations=1)
    with refused(vp.InputError, "resume"):
        vp.solve(problem_of(), plan, resume=plan)
    with refused(vp.InputError, "Solution"):
        vp.solve(problem_of(), resume=plan.trajectory)
