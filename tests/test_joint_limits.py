"""Joints beyond their limits: said of a motion, with names, amounts and times, and never where there is no limit."""

from __future__ import annotations

import logging
import re

import numpy as np
import pytest

import varpin as vp
from varpin.soundness import JOINT_LIMITS, evident

LIMIT = '<limit lower="{}" upper="{}" velocity="9" effort="9"/>'
ROD = '<mass value="1"/><origin xyz="0.5 0 0"/><inertia ixx="0.001" ixy="0" ixz="0" iyy="0.083" iyz="0" izz="0.083"/>'


@pytest.fixture
def arm(tmp_path):
    """A slide along x, then a rod on a joint about y, with the limits asked for."""

    def make(*joints):
        text, parent = '<link name="base"/>', "base"
        for name, kind, limits in joints:
            axis = "1 0 0" if kind == "prismatic" else "0 1 0"
            limit = "" if limits is None else LIMIT.format(*limits)
            text += f'<link name="{name}_link"><inertial>{ROD}</inertial></link><joint name="{name}" type="{kind}">'
            text += f'<parent link="{parent}"/><child link="{name}_link"/><axis xyz="{axis}"/>{limit}</joint>'
            parent = f"{name}_link"
        path = tmp_path / "arm.urdf"
        path.write_text(f'<robot name="arm">{text}</robot>')
        return vp.load_robot(path)

    return make


def about_limits(motion):
    return [sentence for sentence in motion.warnings if "leave their limits" in sentence]


def test_joints_are_named_with_how_far_and_when(arm, caplog):
    robot = arm(("slide", "prismatic", (-0.1, 0.25)), ("turn", "revolute", (-2.0, 2.0)), ("tip", "revolute", (-3, 3)))
    scene = vp.Scene(robot, gravity=False)
    with caplog.at_level(logging.WARNING):
        motion = vp.simulate(scene, [0.0, 0.0, 0.0], [1.0, -8.0, 0.5], dt=1e-3, steps=500)
    (sentence,) = about_limits(motion)
    lower, upper = robot.position_limits
    excess = np.maximum(lower - motion.q, motion.q - upper)
    outside = [name for name, most in zip(robot.joint_names, excess.max(axis=0), strict=True) if most > 0.0]
    assert {"slide", "turn"} <= set(outside)
    for c, name in enumerate(robot.joint_names):
        if name not in outside:
            assert name not in sentence
            continue
        since, most, unit, side, limit, at = re.search(
            rf"'{name}' from t = (\S+) s, at most (\S+) (m|rad) (above|below) (\S+) at t = (\S+) s", sentence
        ).groups()
        assert float(since) == pytest.approx(motion.t[np.argmax(excess[:, c] > 0)], rel=1e-3)
        assert float(most) == pytest.approx(excess[:, c].max(), rel=5e-3)
        assert float(at.rstrip(";")) == pytest.approx(motion.t[np.argmax(excess[:, c])], rel=1e-3)
        assert unit == ("m" if name == "slide" else "rad")
        assert float(limit) == (upper if side == "above" else lower)[c]
    assert [record.getMessage() for record in caplog.records].count(sentence) == 1


def test_a_start_outside_is_said_to_be_one():
    panda = vp.load_robot("panda", lock={"panda_finger_joint1": 0.02})
    motion = vp.simulate(vp.Scene(panda, gravity=False), np.zeros(7), np.zeros(7), dt=1e-3, steps=5)
    (sentence,) = about_limits(motion)
    assert "'panda_joint4' from the start, at most 0.0698 rad above -0.0698" in sentence


@pytest.mark.parametrize("limits", [None, (0, 0), (1.0, -1.0)])
def test_no_limits_no_alarm(arm, limits):
    robot = arm(("turn", "continuous" if limits is None else "revolute", limits))
    motion = vp.simulate(vp.Scene(robot), [0.0], [0.0], dt=1e-3, steps=2000)
    assert np.ptp(motion.q) > 2.0
    assert about_limits(motion) == []


def test_rounding_at_a_limit_is_no_alarm(arm):
    robot = arm(("turn", "revolute", (-0.5, 1.0)))
    at_rest = vp.simulate(vp.Scene(robot, gravity=False), [1.0 + 1e-9], [0.0], dt=1e-3, steps=5)
    assert at_rest.warnings == ()


def test_the_finding_has_a_kind_of_its_own_and_many_joints_are_counted():
    robot = vp.load_robot("ur5")
    scene = vp.Scene(robot, gravity=False)
    q = np.full(6, 7.0)
    motion = vp.simulate(scene, q, np.zeros(6), dt=1e-3, steps=3, check=False)
    (finding,) = evident(scene, vp.Midpoint(), motion)
    assert finding.kind == JOINT_LIMITS
    assert finding.sentence in motion.warnings
    assert finding.sentence.count(" rad above ") == 6
    # The furthest beyond its limit comes first.
    assert finding.sentence.index("elbow_joint") < finding.sentence.index("shoulder_pan_joint")
