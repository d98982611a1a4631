"""Units in messages: those of the joints that they are about, and both only where joints turn and slide."""

from __future__ import annotations

import numpy as np
import pytest
from mechanisms import joint, link, slider, write_urdf

import varpin as vp
from varpin.model import joint_unit


@pytest.fixture
def crane(tmp_path):
    """A robot with a revolute and a prismatic joint."""
    parts = link("l1"), joint("turns", "base", "l1"), link("l2"), joint("slides", "l1", "l2", kind="prismatic")
    return vp.load_robot(write_urdf(tmp_path, *parts))


def test_joint_unit(crane):
    assert (joint_unit(vp.planar_chain(2)), joint_unit(vp.planar_chain(2), speed=True)) == ("rad", "rad/s")
    assert (joint_unit(slider()), joint_unit(slider(), speed=True)) == ("m", "m/s")
    assert (joint_unit(crane), joint_unit(crane, speed=True)) == ("rad or m", "rad/s or m/s")
    assert [joint_unit(crane, c) for c in (0, 1, [1], [0, 1])] == ["rad", "m", "m", "rad or m"]


def bound(robot, constraint):
    n = robot.dof
    problem = vp.OptimalControlProblem(
        vp.Scene(robot), vp.ControlCost(1.0), np.zeros(n), np.zeros(n), dt=0.01, steps=2, constraints=[constraint]
    )
    return problem.bound_constraints[0]


def test_units_of_limits(crane):
    chain = vp.planar_chain(2)
    assert bound(chain, vp.WithinVelocityLimits(chain, (-1.0, 1.0))).unit == "rad/s"
    assert bound(crane, vp.WithinVelocityLimits(crane, (-1.0, 1.0))).unit == "rad/s or m/s"
    # Only joints with a limit count.
    assert bound(crane, vp.WithinJointLimits(crane, (-np.inf, [np.inf, 1.0]))).unit == "m"
