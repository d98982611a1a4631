"""Joints beyond their limits: said of a motion, with names, amounts and times, and never where there is no limit."""

from __future__ import annotations

import logging
import re

import numpy as np
import pytest
from refusals import unnamed

import varpin as vp
from varpin.simulation import limits
from varpin.simulation.soundness import findings_from_record

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
    assert not unnamed(sentence, "'panda_joint4'", "start", "0.0698 rad", "-0.0698")


@pytest.mark.parametrize("bounds", [None, (0, 0), (1.0, -1.0)])
def test_no_limits_no_alarm(arm, bounds):
    robot = arm(("turn", "continuous" if bounds is None else "revolute", bounds))
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
    (finding,) = findings_from_record(scene, vp.Midpoint(), motion)
    assert finding.kind == limits.POSITION
    assert finding.sentence in motion.warnings
    assert finding.sentence.count(" rad above ") == 6
    # The furthest beyond its limit comes first.
    assert finding.sentence.index("elbow_joint") < finding.sentence.index("shoulder_pan_joint")


def test_velocities_beyond_their_limits_are_told_of(arm, caplog):
    robot = arm(("slide", "prismatic", (-9, 9)), ("turn", "revolute", (-9, 9)), ("tip", "revolute", (-9, 9)))
    assert robot.velocity_limit.tolist() == [9.0, 9.0, 9.0]
    with caplog.at_level(logging.WARNING):
        motion = vp.simulate(vp.Scene(robot, gravity=False), np.zeros(3), [9.5, -12.0, 0.5], dt=1e-3, steps=100)
    (sentence,) = (sentence for sentence in motion.warnings if sentence.startswith(limits.VELOCITY))
    excess = np.abs(motion.v) - 9.0
    for c, (name, unit) in enumerate(zip(robot.joint_names, ("m/s", "rad/s", "rad/s"), strict=True)):
        if excess[:, c].max() <= 0.0:
            assert name not in sentence
            continue
        since, most, side, at = re.search(
            rf"'{name}' from (the start|t = \S+ s), at most (\S+) {unit} (above|below) -?9 at t = (\S+) s", sentence
        ).groups()
        first, peak = np.argmax(excess[:, c] > 0.0), np.argmax(excess[:, c])
        assert since == ("the start" if first == 0 else f"t = {motion.t[first]:.4g} s")
        assert float(most) == pytest.approx(excess[:, c].max(), rel=5e-3)
        assert float(at.rstrip(";")) == pytest.approx(motion.t[peak], rel=1e-3)
        assert side == ("above" if motion.v[peak, c] > 0.0 else "below")
    assert [record.getMessage() for record in caplog.records].count(sentence) == 1


@pytest.mark.parametrize("check", [True, False])
def test_forces_beyond_effort_limits_are_told_of_by_what_reaches_the_joint(arm, check):
    robot = arm(("slide", "prismatic", (-9, 9)), ("turn", "revolute", (-9, 9)))
    # One control pulls at both joints: a gear of 3 and one of -1/2.
    scene = vp.Scene(robot, gravity=False, actuation=[[3.0], [-0.5]])
    pull = np.linspace(0.0, 4.0, 50)[:, None]
    motion = vp.simulate(scene, np.zeros(2), np.zeros(2), dt=1e-3, steps=50, controls=pull, check=check)
    (sentence,) = motion.warnings
    since = motion.t[np.argmax(3.0 * pull[:, 0] > 9.0)]
    assert sentence == (
        f"{limits.EFFORT}, which nothing cuts off: 'slide' from t = {since:.4g} s, at most 3 N above 9 at t = 0.049 s"
    )


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
    motion = vp.simulate(vp.Scene(robot), [0.0], [50.0], dt=1e-4, steps=20, controls=[500.0])
    assert motion.warnings == ()


def test_a_motor_at_its_limit_is_not_beyond_it(arm):
    robot = arm(("turn", "revolute", (-9, 9)))
    motion = vp.simulate(vp.Scene(robot, gravity=False), [0.0], [0.0], dt=1e-3, steps=20, controls=robot.effort_limit)
    assert motion.warnings == ()


def test_plans_ensembles_and_controllers_tell_of_all_limits(arm):
    robot = arm(("turn", "revolute", (-9, 9)))
    scene = vp.Scene(robot, gravity=False)
    cost = vp.ControlCost(1e-6) + vp.Terminal(vp.TrackingCost([2.0], 1e3) + vp.VelocityCost(1.0))
    problem = vp.OptimalControlProblem(scene, cost, [0.0], [0.0], dt=1e-2, steps=20)
    plan = vp.solve(problem)
    run = vp.Mpc(problem).run(duration=0.05)
    ensemble = vp.simulate_ensemble(scene, [0.0], [20.0], dt=1e-3, steps=9, paths=2, rng=0, controls=[50.0])
    for told in (plan.warnings, run.warnings, ensemble.warnings):
        for kind in (limits.VELOCITY, limits.EFFORT):
            assert any(kind in sentence for sentence in told), (kind, told)


def test_what_is_printed_counts_the_warnings(arm):
    """One of them is one, and none are not mentioned."""
    robot = arm(("turn", "revolute", (-0.5, 0.5)))
    scene = vp.Scene(robot, gravity=False)
    for speed, pull, text in ((0.1, 0.0, ")"), (1.0, 0.0, ", 1 warning)"), (1.0, 10.0, ", 3 warnings)")):
        motion = vp.simulate(scene, [0.0], [speed], dt=1e-2, steps=90, controls=[pull], check=False)
        assert repr(motion).endswith(text)
        assert ("warning" in repr(motion)) == bool(motion.warnings)
    cost = vp.ControlCost(1e-6) + vp.Terminal(vp.TrackingCost([0.6], 1e3) + vp.VelocityCost(1.0))
    problem = vp.OptimalControlProblem(scene, cost, [0.0], [0.0], dt=0.1, steps=10)
    plan = vp.solve(problem)
    assert len(plan.warnings) == 1
    assert repr(plan).endswith(f"{plan.status.value}, 1 warning)")
    run = vp.Mpc(problem).run(duration=1.0)
    assert run.warnings
    assert repr(run).endswith(f", {len(run.warnings)} warning{'s' * (len(run.warnings) > 1)})")
