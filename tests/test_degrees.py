"""Angles in degrees and places in millimetres are pointed out wherever positions enter."""

from __future__ import annotations

import logging

import numpy as np
import pinocchio as pin
import pytest
from refusals import naming, refused, unnamed

import varpin as vp
from varpin.cli import main
from varpin.control.checks import foreseen
from varpin.model import degrees_hint

HOME = np.array([0.0, -90.0, 90.0, 0.0, 45.0, 0.0])
FACTS = ("'shoulder_lift_joint'", "-90 rad", "14 turns", "looks like degrees", "np.deg2rad")


@pytest.fixture(scope="module")
def scene():
    return vp.Scene(vp.load_robot("ur5"), gravity=False)


def test_a_start_in_degrees(scene, capsys):
    motion = vp.simulate(scene, HOME, np.zeros(6), dt=1e-3, steps=2)
    assert not unnamed(motion.warnings[0], FACTS)
    assert not any(
        "degrees" in told for told in vp.simulate(scene, np.deg2rad(HOME), np.zeros(6), dt=1e-3, steps=2).warnings
    )
    ensemble = vp.simulate_ensemble(scene, HOME, np.zeros(6), dt=1e-3, steps=2, paths=2, rng=0, workers=1)
    assert not unnamed(ensemble.warnings[0], FACTS)
    assert main(["simulate", "ur5", "--steps", "2", "--q0", *map(str, HOME)]) == 0
    assert not unnamed(" ".join(capsys.readouterr().err.split()), FACTS)


@pytest.mark.parametrize(
    ("speed", "told"), [(90.0, True), (-22.5, True), (22.51234, False), (3.1, False), (12.5, False)]
)
def test_a_speed_beyond_its_limit_in_degrees(scene, speed, told):
    v0 = np.array([0.0, speed, 0.0, 0.0, 0.0, 0.0])
    warnings = vp.simulate(scene, np.zeros(6), v0, dt=1e-4, steps=2).warnings
    found = [warning for warning in warnings if "looks like degrees" in warning]
    assert [not unnamed(text, "v0", "'shoulder_lift_joint'", f"{speed:g} rad/s") for text in found] == [True] * told
    free = scene.robot.model.copy()
    free.velocityLimit = np.full(6, np.inf)
    motion = vp.simulate(vp.Scene(vp.load_robot(free)), np.zeros(6), v0, dt=1e-4, steps=2)
    assert not any("looks like degrees" in warning for warning in motion.warnings)


def test_positions_for_servos_in_degrees(scene):
    servos = vp.Scene(scene.robot, gravity=False, damping=1.0, forces=[vp.PositionServo(100.0, 10.0)])
    task = {"q0": np.zeros(6), "v0": np.zeros(6), "dt": 1e-3, "steps": 2}
    by_law = vp.simulate(servos, **task, controls=lambda t, q, v: HOME)
    for motion in (vp.simulate(servos, **task, controls=HOME), by_law):
        assert not unnamed(motion.warnings[0], ("controls", *FACTS))
    forces = vp.simulate(scene, **task, controls=HOME)
    right = vp.simulate(servos, **task, controls=np.deg2rad(HOME))
    start = vp.simulate(servos, **{**task, "q0": HOME})
    assert not any("degrees" in told for told in (*forces.warnings, *right.warnings))
    assert sum("degrees" in told for told in start.warnings) == 1


def test_a_plan_names_units_before_everything_else(scene):
    cost = vp.ControlCost(1e-3) + vp.Terminal(vp.FramePositionCost(scene.robot, "tool0", [400.0, 100.0, 500.0]))
    problem = vp.OptimalControlProblem(scene, cost, np.zeros(6), np.zeros(6), dt=0.05, steps=4)
    assert not unnamed(vp.solve(problem, max_iterations=2).warnings[0], ("'tool0'", "millimetres"))
    reach = vp.ReachFrame(scene.robot, "tool0", position=[400.0, 100.0, 500.0])
    inside = vp.WithinVelocityLimits(scene.robot)
    problem = vp.OptimalControlProblem(
        scene, vp.ControlCost(1e-3), np.zeros(6), np.full(6, 4.0), dt=0.05, steps=4, constraints=[inside, reach]
    )
    plan = vp.solve(problem, max_iterations=1)
    assert [told.kind for told in foreseen(plan.problem)] == ["goal in millimetres"]
    for goal, told in ((HOME, True), (np.deg2rad(HOME), False)):
        cost = vp.ControlCost(1e-3) + vp.Terminal(vp.TrackingCost(goal, 1.0))
        problem = vp.OptimalControlProblem(scene, cost, np.zeros(6), np.zeros(6), dt=0.05, steps=4)
        plan = vp.solve(problem, max_iterations=2)
        assert any(not unnamed(warning, FACTS) for warning in plan.warnings) == told
        for reference in (goal, [goal] * 5, lambda t, goal=goal: goal):
            along = problem.at(cost=vp.ControlCost(1e-3) + vp.TrackingCost(reference))
            assert any(not unnamed(warning, FACTS) for warning in foreseen(along)) == told
    problem = vp.OptimalControlProblem(scene, vp.ControlCost(1e-3), HOME, np.zeros(6), dt=0.05, steps=4)
    assert not unnamed(vp.solve(problem).warnings[0], FACTS)


def test_joints_without_limits_may_have_turned_many_times():
    """A wheel that has turned is no mistake; a number of one decimal is typed."""
    model = pin.Model()
    place = model.addJoint(0, pin.JointModelRUBZ(), pin.SE3.Identity(), "wheel")
    model.appendBodyToJoint(place, pin.Inertia(1.0, np.zeros(3), 0.1 * np.eye(3)), pin.SE3.Identity())
    wheel = vp.load_robot(model)
    told = {q: bool(degrees_hint(wheel, "q0", np.array([q]))) for q in (90.0, -22.5, 12.5, 33.3333333, 1e3 / 7.0)}
    assert told == {90.0: True, -22.5: True, 12.5: False, 33.3333333: False, 1e3 / 7.0: False}
    slider = vp.load_robot(pin_slider())
    assert degrees_hint(slider, "q0", np.array([90.0])) == ""


def pin_slider():
    model = pin.Model()
    place = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "cart")
    model.appendBodyToJoint(place, pin.Inertia(1.0, np.zeros(3), 0.1 * np.eye(3)), pin.SE3.Identity())
    return model


def test_other_positions_in_degrees(scene, caplog):
    with caplog.at_level(logging.WARNING):
        vp.load_robot("ur5", lock={"elbow_joint": 90})
        vp.Scene(scene.robot, stiffness=1.0, rest=HOME)
    elbow, rest = (record.getMessage() for record in caplog.records)
    assert not unnamed(elbow, ("elbow_joint", "90", "looks like degrees", "np.deg2rad"))
    assert not unnamed(rest, ("rest", *FACTS))
    closed = vp.Scene(scene.robot, constraints=[vp.PointOnPoint("tool0", [0.8, 0.1, 0.2])])
    with refused(vp.InputError, "q0", *FACTS):
        vp.simulate(closed, HOME, np.zeros(6), dt=1e-3, steps=2)


@pytest.mark.parametrize(
    ("load", "facts"),
    [
        (
            lambda k: vp.load_robot("ur5", payload=vp.Payload("tool0", 2.0, [0.0, 0.0, k * 0.25])),
            ("payload", "'tool0'"),
        ),
        (lambda k: vp.load_robot("ur5", payload=vp.Payload("tool0", k * 2.0)), ("2000 kg", "grams")),
        (lambda k: vp.planar_chain(2, length=k * 0.5), ("'joint1' and 'joint2'", "500 m", "millimetres")),
    ],
)
def test_sizes_in_millimetres_and_grams(load, facts, caplog):
    load(1.0)
    assert not caplog.records
    load(1000.0)
    assert len(naming(caplog.messages, facts)) == 1


def test_stops_in_degrees(caplog):
    robot = vp.load_robot("so100")
    vp.Scene(robot, forces=[vp.JointStop(1e3, 5.0), vp.JointStop(1e3, lower=-1.5, upper={"shoulder_lift": 1.5})])
    assert not caplog.records
    vp.Scene(robot, forces=[vp.JointStop(1e3, 5.0, lower=-90.0, upper=90.0)])
    told = [record.getMessage() for record in caplog.records]
    assert [sentence.partition(" of the JointStop")[0] for sentence in told] == ["lower", "upper"]
    assert all("looks like degrees" in sentence for sentence in told)


@pytest.mark.parametrize("scale", [1000.0, 1.0])
@pytest.mark.parametrize(
    ("make", "named"),
    [
        (
            lambda r, k: vp.KeepClear(
                r, [vp.Obstacle.sphere(k * np.array([0.9, 0.5, 0.4]), 0.1, "ball")], links=["forearm_link"]
            ),
            "'ball'",
        ),
        (
            lambda r, k: vp.KeepClear(r, [vp.Obstacle.sphere([2.0, 0.5, 0.4], 0.1)], k * 0.1, links=["forearm_link"]),
            "KeepClear: distance",
        ),
        (
            lambda r, k: vp.KeepOutOfSphere(r, "tool0", k * np.array([0.9, 0.3, 0.4]), 0.1),
            ("KeepOutOfSphere('tool0')", "distance"),
        ),
        (lambda r, k: vp.KeepInHalfSpace(r, "tool0", [0.0, 0.0, 1.0], k * -0.3), "KeepInHalfSpace('tool0')"),
        (lambda r, k: vp.KeepInBox(r, "tool0", k * np.array([-0.9, -0.8, 0.1]), np.inf), "KeepInBox('tool0')"),
        (lambda r, k: vp.KeepInSphere(r, "tool0", [0.1, 0.2, 0.3], k * 0.6), "KeepInSphere('tool0')"),
    ],
)
def test_millimetres_in_obstacles_and_regions(scene, make, named, scale):
    constraints = [make(scene.robot, scale)]
    given = {"dt": 0.05, "steps": 2, "constraints": constraints}
    problem = vp.OptimalControlProblem(scene, vp.ControlCost(1e-3), np.deg2rad(HOME), np.zeros(6), **given)
    told = [found for found in foreseen(problem) if "millimetres" in found]
    assert bool(told) == (scale > 1.0)
    assert scale == 1.0 or not unnamed(told[0], named)
