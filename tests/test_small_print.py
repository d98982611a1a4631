"""What is said where something is taken in another way than it was asked for, or looks right and is not."""

import logging

import numpy as np
import pytest
from findings import about
from mechanisms import joint, link, mimic, write_urdf
from refusals import naming, unnamed

import varpin as vp
from varpin.show.inspection import inspect_robot


@pytest.fixture
def gripper(tmp_path):
    """A joint with limits of 0.5 and 1.5 rad, and a slide that follows it."""
    turns = joint("turns", "base", "a").replace('lower="-1" upper="1"', 'lower="0.5" upper="1.5"')
    follows = joint("follows", "base", "b", "prismatic", inside=mimic("turns", 0.1))
    return write_urdf(tmp_path, link("a"), link("b"), turns.replace('velocity="8"', 'velocity="1"'), follows)


def test_a_leader_that_turns_is_an_angle_whatever_follows(gripper):
    robot = vp.load_robot(gripper)
    assert robot.tree.prismatic.any()
    assert robot.slides.tolist() == [False]
    motion = vp.simulate(vp.Scene(robot, gravity=False), [1.0], [3.0], dt=1e-2, steps=40)
    assert naming(motion.warnings, "1.5", "rad")


def test_inspection_says_where_zero_is_outside_the_limits(gripper):
    robot = vp.load_robot(gripper)
    told = about(inspect_robot(robot).warnings, "outside limits")
    assert len(told) == len(naming(told, "q = 0", "'turns'", "0.5", "1.5")) == 1
    assert not about(inspect_robot(robot, q=[1.0]).warnings, "outside limits")


def test_joints_locked_outside_their_limits_are_told_of(gripper, caplog):
    with caplog.at_level(logging.WARNING):
        vp.load_robot("panda", lock={"panda_joint4": -1.0})
        assert not about(caplog.messages, "outside limits")
        vp.load_robot("panda", lock={"panda_joint4": 1.0})
    assert naming(caplog.messages, "lock['panda_joint4'] = 1", "limits", "-3.0718")


def test_a_checked_linearization_has_a_verdict():
    chain, q, v = vp.planar_chain(2), [0.3, -0.2], [1.0, 0.5]
    good = vp.check_linearization(vp.Scene(chain, damping=0.1), q, v, dt=1e-2)
    assert good.holds
    assert about(str(good).splitlines()[-1], "right derivatives")
    coarse = vp.check_linearization(vp.Scene(chain, damping=0.1), q, v, dt=1e-2, step=1.0)
    assert not coarse.holds
    assert about(str(coarse), "another difference")
    wrong = type(good)(A=good.A, B=(0.5, 1.0), G=good.G)
    assert not unnamed(str(wrong).splitlines()[-1], "B", "5.0e-01")


@pytest.mark.parametrize(
    "constraint", [vp.PointOnPoint("joint3", (5.0, 0.0, 0.0)), vp.Distance("joint3", (0.0, 0.0, 4.0), 0.5)], ids=repr
)
def test_an_assembly_that_cannot_be_names_a_place_nearby(constraint):
    """A target out of reach: polishing to rounding must not lead away from where the search ended."""
    with pytest.raises(vp.AssemblyError) as info:
        vp.assemble(vp.Scene(vp.planar_chain(3), constraints=constraint), [0.3, 0.4, 0.2])
    assert np.abs(info.value.q).max() < 10.0
    assert info.value.miss < 3.8


def plan_problem(**horizon):
    cost = vp.ControlCost(1.0) + vp.Terminal(vp.TrackingCost([0.5, 0.2], 10.0))
    return vp.OptimalControlProblem(vp.Scene(vp.planar_chain(2)), cost, [0.0, 0.0], [0.0, 0.0], **horizon)


@pytest.mark.parametrize(
    ("horizon", "change", "dt", "steps"),
    [
        ({"dt": 0.02, "duration": 0.6}, {}, 0.02, 30),
        ({"steps": 30, "duration": 0.6}, {}, 0.02, 30),
        ({"dt": 0.02, "steps": 30}, {"dt": 0.01}, 0.01, 60),
        ({"dt": 0.02, "steps": 30}, {"duration": 1.2}, 0.02, 60),
        ({"dt": 0.02, "steps": 30}, {"duration": 1.2, "steps": 30}, 0.04, 30),
        ({"dt": 0.02, "steps": 30}, {"duration": 1.2, "dt": 0.04}, 0.04, 30),
        ({"dt": 0.02, "steps": 30}, {"dt": 0.1, "steps": 3}, 0.1, 3),
    ],
)
def test_a_problem_has_the_time_that_it_is_given(horizon, change, dt, steps):
    other = plan_problem(**horizon).at(**change)
    assert (other.dt, other.steps) == (dt, steps)
    assert other.duration == pytest.approx(dt * steps, rel=1e-15)
