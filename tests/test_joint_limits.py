"""Joints beyond their limits: told with names, amounts and times, and never where there is no limit."""

from __future__ import annotations

import numpy as np
import pytest
from findings import about
from refusals import unnamed

import varpin as vp

LIMIT = '<limit lower="{}" upper="{}" velocity="9" effort="9"/>'
ROD = '<mass value="1"/><origin xyz="0.5 0 0"/><inertia ixx="0.001" ixy="0" ixz="0" iyy="0.083" iyz="0" izz="0.083"/>'


@pytest.fixture
def arm(tmp_path):
    """A slide along x, then a rod on a joint about y, with the limits asked for."""

    def make(*joints):
        text, parent = '<link name="base"/>', "base"
        for name, kind, bounds in joints:
            axis = "1 0 0" if kind == "prismatic" else "0 1 0"
            limit = "" if bounds is None else LIMIT.format(*bounds)
            text += f'<link name="{name}_link"><inertial>{ROD}</inertial></link><joint name="{name}" type="{kind}">'
            text += f'<parent link="{parent}"/><child link="{name}_link"/><axis xyz="{axis}"/>{limit}</joint>'
            parent = f"{name}_link"
        path = tmp_path / "arm.urdf"
        path.write_text(f'<robot name="arm">{text}</robot>')
        return vp.load_robot(path)

    return make


def about_limits(motion):
    return about(motion.warnings, "position limits")


def test_a_start_outside():
    panda = vp.load_robot("panda", lock={"panda_finger_joint1": 0.02})
    motion = vp.simulate(vp.Scene(panda, gravity=False), np.zeros(7), np.zeros(7), dt=1e-3, steps=5)
    (told,) = about_limits(motion)
    assert told.time == 0.0
    assert not unnamed(told, "'panda_joint4'", "-0.0698 rad", "by 0.0698", "t = 0 s")


@pytest.mark.parametrize("stop", [True, False])
def test_what_stops_a_joint(arm, stop):
    """Nothing; or a stop, which gives way."""
    robot = arm(("turn", "revolute", (-0.5, 1.0)))
    scene = vp.Scene(robot, gravity=False, forces=[vp.JointStop(1e3, 5.0)] if stop else [])
    (told,) = about_limits(vp.simulate(scene, [0.9], [2.0], dt=1e-3, steps=200))
    assert ("gives way" in told) == stop
    assert ("nothing stops it" in told) != stop


FREE, TURNS = ("turn", "continuous", None), ("turn", "revolute", (-0.5, 1.0))


@pytest.mark.parametrize(
    ("joint", "q", "v", "pull"),
    [
        (FREE, 0.0, 50.0, 500.0),
        (("turn", "revolute", (0, 0)), 0.0, 5.0, 0.0),
        (("turn", "revolute", (1.0, -1.0)), 0.0, 5.0, 0.0),
        (TURNS, 1.0 + 1e-9, 0.0, 0.0),
        (TURNS, 0.0, 0.0, 9.0),
    ],
    ids=["none", "zeros", "the wrong way round", "rounding", "a motor at its limit"],
)
def test_no_limit_is_passed(arm, joint, q, v, pull):
    motion = vp.simulate(vp.Scene(arm(joint), gravity=False), [q], [v], dt=1e-3, steps=20, controls=[pull])
    assert motion.warnings == ()


def test_forces_beyond_effort_limits_are_told_of_by_what_reaches_the_joint(arm):
    robot = arm(("slide", "prismatic", (-9, 9)), ("turn", "revolute", (-9, 9)))
    # One control pulls at both joints: a gear of 3 and one of -1/2.
    scene = vp.Scene(robot, gravity=False, actuation=[[3.0], [-0.5]])
    pull = np.linspace(0.0, 4.0, 50)[:, None]
    motion = vp.simulate(scene, np.zeros(2), np.zeros(2), dt=1e-3, steps=50, controls=pull)
    (told,) = motion.warnings
    assert (told.kind, told.joint, told.unit) == ("effort limits", "slide", "N")
    assert told.value == pytest.approx(3.0)
    assert told.time == motion.t[np.argmax(3.0 * pull[:, 0])]
    assert not unnamed(told, "'slide'", "9 N", "by 3", "t = 0.049 s")


@pytest.mark.parametrize("limit", ["", '<limit effort="0" velocity="0"/>'])
def test_missing_limits_and_limits_of_zero_are_none(tmp_path, limit):
    path = tmp_path / "arm.urdf"
    path.write_text(
        f'<robot name="arm"><link name="base"/><link name="l"><inertial>{ROD}</inertial></link>'
        f'<joint name="turn" type="continuous"><parent link="base"/><child link="l"/><axis xyz="0 1 0"/>{limit}</joint>'
        "</robot>"
    )
    robot = vp.load_robot(path)
    assert robot.effort_limit.tolist() == robot.velocity_limit.tolist() == [np.inf]


def test_plans_ensembles_and_controllers_tell_of_all_limits(arm):
    robot = arm(("turn", "revolute", (-9, 9)))
    scene = vp.Scene(robot, gravity=False)
    cost = vp.ControlCost(1e-6) + vp.Terminal(vp.TrackingCost([2.0], 1e3) + vp.VelocityCost(1.0))
    problem = vp.OptimalControlProblem(scene, cost, [0.0], [0.0], dt=1e-2, steps=20)
    plan = vp.solve(problem)
    run = vp.Mpc(problem).run(duration=0.05)
    ensemble = vp.simulate_ensemble(scene, [0.0], [20.0], dt=1e-3, steps=9, paths=2, rng=0, controls=[50.0])
    for told in (plan.warnings, run.warnings, ensemble.warnings):
        for kind in ("velocity limits", "effort limits"):
            assert about(told, kind), told


def test_what_is_printed_counts_the_warnings(arm):
    """One of them is one, and none are not mentioned."""
    robot = arm(("turn", "revolute", (-0.5, 0.5)))
    scene = vp.Scene(robot, gravity=False)
    for speed, pull, text in ((0.1, 0.0, ")"), (1.0, 0.0, ", 1 warning)"), (1.0, 10.0, ", 3 warnings)")):
        motion = vp.simulate(scene, [0.0], [speed], dt=1e-2, steps=90, controls=[pull])
        assert repr(motion).endswith(text)
        assert ("warning" in repr(motion)) == bool(motion.warnings)
