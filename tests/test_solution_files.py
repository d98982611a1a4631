"""Solutions on disk: read back as they were, resumed as if nothing had happened, refused where they do not belong."""

import dataclasses

import numpy as np
import pytest
from refusals import refused

import varpin as vp


def problem_of(*, noise=None, damping=0.2, dt=0.02, weight=0.1, integrator=None, q0=(0.4, -0.3), robot=None, forces=()):
    robot = vp.planar_chain(2) if robot is None else robot
    scene = vp.Scene(robot, damping=damping, noise=noise, forces=forces)
    cost = vp.TrackingCost([0.8, 0.1], 10.0) + vp.ControlCost(weight) + vp.Terminal(vp.VelocityCost(1.0))
    return vp.OptimalControlProblem(scene, cost, q0, [0.0, 0.0], dt=dt, steps=round(0.6 / dt), integrator=integrator)


def same(a, b):
    """Whether two solutions are the same bit for bit, times apart."""
    for name in ("gains", "feedforward", "gradient"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    for name in ("t", "q", "v", "p", "u", "dw", "energy", "masses"):
        np.testing.assert_array_equal(getattr(a.trajectory, name), getattr(b.trajectory, name))
    for item in dataclasses.fields(a.trajectory.statistics):
        np.testing.assert_array_equal(
            getattr(a.trajectory.statistics, item.name), getattr(b.trajectory.statistics, item.name)
        )
    assert (a.cost, a.noise_cost, a.status) == (b.cost, b.noise_cost, b.status)
    without = [[dataclasses.replace(item, seconds=0.0) for item in s.history] for s in (a, b)]
    assert without[0] == without[1]


@pytest.mark.parametrize(
    ("other", "facts"),
    [
        ({"dt": 0.03}, ("dt", "0.02", "0.03")),
        ({"q0": (0.4, -0.2)}, "q0"),
        ({"weight": 0.2}, "cost"),
        ({"damping": 0.3}, "damping"),
        ({"noise": vp.AdditiveNoise(0.1)}, "noise"),
        ({"integrator": vp.Midpoint(alpha=0.4)}, "integrator"),
        ({"robot": vp.planar_chain(2, mass=2.0)}, "links"),
    ],
)
def test_solution_of_another_problem_is_refused(other, facts, tmp_path):
    path = vp.solve(problem_of(), max_iterations=1).save(tmp_path / "plan.npz")
    with refused(vp.FileError, facts):
        vp.Solution.load(path, problem_of(**other))


@pytest.mark.parametrize(
    "force",
    [
        vp.CoulombFriction(0.1),
        vp.JointStop(9.0, lower=-1.0, upper=1.0),
        vp.Armature(0.1),
        vp.FrameWrench("tip", (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)),
    ],
)
def test_forces_belong_to_the_problem(force, tmp_path):
    problem = problem_of(forces=force)
    plan = vp.solve(problem, max_iterations=2, second_order=True)
    path = plan.save(tmp_path / "with.npz")
    same(vp.Solution.load(path, problem), plan)
    other = vp.solve(problem_of(), max_iterations=1).save(tmp_path / "without.npz")
    for file, wrong in ((path, problem_of()), (other, problem)):
        with refused(vp.FileError, "scene"):
            vp.Solution.load(file, wrong)
    with refused(vp.InputError, "armature" if isinstance(force, vp.Armature) else "scene"):
        vp.solve(problem_of(), resume=plan)


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
    problem = problem_of()
    plan = vp.solve(problem, max_iterations=1)
    with refused(vp.InputError, "dt", "0.02"):
        vp.solve(problem_of(dt=0.03), resume=plan)
    with refused(vp.InputError, "cost"):
        vp.solve(problem_of(weight=0.2), resume=plan)
    with refused(vp.InputError, "resume"):
        vp.solve(problem, plan, resume=plan)
    with refused(vp.InputError, "Solution"):
        vp.solve(problem, resume=plan.trajectory)
