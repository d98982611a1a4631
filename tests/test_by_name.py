"""Joint values by name, holding torques and gravity: what a scene and those who take a state accept."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused

import varpin as vp

UR5 = vp.load_robot("ur5")
NAMES = UR5.joint_names
POSE = {"elbow_joint": 1.1, "shoulder_lift_joint": -0.7}
ROW = np.array([0.0, -0.7, 1.1, 0.0, 0.0, 0.0])


def same(a: vp.Trajectory, b: vp.Trajectory) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("q", "v", "p", "energy"))


def test_motions_start_where_names_say():
    scene = vp.Scene(UR5, damping=0.1)
    options = {"dt": 2e-3, "steps": 20, "integrator": vp.Midpoint()}
    rows = vp.simulate(scene, ROW, 0.1 * ROW, **options)
    spin = {name: 0.1 * value for name, value in POSE.items()}
    assert same(vp.simulate(scene, POSE, spin, **options), rows)
    ensemble = vp.simulate_ensemble(scene, POSE, spin, paths=2, rng=0, workers=1, **options)
    np.testing.assert_allclose(ensemble.q[1], rows.q, atol=1e-12)


def test_problems_jets_and_reports_take_names_too():
    scene = vp.Scene(UR5)
    problem = vp.OptimalControlProblem(scene, vp.ControlCost(1.0), POSE, {"wrist_3_joint": 2.0}, dt=0.01, steps=5)
    assert problem.q0.tolist() == ROW.tolist()
    assert problem.v0.tolist() == [0, 0, 0, 0, 0, 2]
    assert problem.at(q0={"elbow_joint": 0.5}).q0.tolist() == [0, 0, 0.5, 0, 0, 0]
    for backend in ("compiled", "pinocchio"):
        by_row = vp.lagrangian_jet(scene, ROW, np.zeros(6), backend=backend)
        assert np.array_equal(vp.lagrangian_jet(scene, POSE, {}, backend=backend).Lq, by_row.Lq)
    assert vp.inspect_robot(UR5, q=POSE, v={"elbow_joint": 1.0}).q.tolist() == ROW.tolist()
    step = vp.discrete_lagrangian(scene, POSE, POSE, 0.01)
    assert step.Ld == vp.discrete_lagrangian(scene, ROW, ROW, 0.01).Ld


@pytest.mark.parametrize(
    "call",
    [
        lambda value: vp.Scene(UR5, damping=value),
        lambda value: vp.Scene(UR5, noise=vp.AdditiveNoise(value)),
        lambda value: vp.JointLimitBarrier(UR5, value),
        lambda value: vp.simulate(vp.Scene(UR5), value, np.zeros(6), dt=1e-3, steps=1),
        lambda value: vp.simulate_ensemble(vp.Scene(UR5), np.zeros(6), value, dt=1e-3, steps=1, paths=1, rng=0),
        lambda value: vp.OptimalControlProblem(vp.Scene(UR5), vp.ControlCost(), value, ROW, dt=1e-3, steps=1),
        lambda value: vp.lagrangian_jet(vp.Scene(UR5), value, np.zeros(6)),
        lambda value: vp.Scene(UR5).holding_torque(value),
        lambda value: vp.inspect_robot(UR5, q=value),
        lambda value: vp.advise(vp.Scene(UR5), value, np.zeros(6), duration=1.0, tolerance=1e-3),
    ],
)
def test_names_and_numbers_that_are_none_are_named(call):
    with refused(vp.UnknownJoint, "'elbow'", "'elbow_joint'") as caught:
        call({"elbow": 1.0})
    assert caught.value.matches[0] == "elbow_joint"
    assert caught.value.known == NAMES
    for value, facts in ((np.nan, ("'elbow_joint'", "nan")), ("a", "'a'")):
        with refused(vp.InputError, facts):
            call({"elbow_joint": value})


@pytest.mark.parametrize("name", ["ur5", "panda", "finger"])
def test_holding_torque_is_pinocchios_gravity_and_the_springs(name):
    robot = vp.load_robot(name)
    rng = np.random.default_rng(3)
    q, stiffness, rest = rng.uniform(-1, 1, (3, robot.dof))
    scene = vp.Scene(robot, gravity=(1.0, -2.0, -7.0), stiffness=np.abs(stiffness), rest=rest)
    model = robot.free_model.copy()
    model.gravity = pin.Motion(np.array([1.0, -2.0, -7.0]), np.zeros(3))
    pull = pin.computeGeneralizedGravity(model, model.createData(), robot.free_positions(q))
    expected = robot.free_velocities(np.eye(robot.dof)) @ pull + np.abs(stiffness) * (q - rest)
    np.testing.assert_allclose(scene.holding_torque(q), expected, atol=1e-10)
    np.testing.assert_allclose(scene.holding_controls(q), expected, atol=1e-10)


def test_an_arm_stays_under_its_holding_torque_and_controls():
    gear = np.diag([100.0, 50.0, 60.0, 20.0, 20.0, 10.0])
    scene = vp.Scene(UR5, actuation=gear, stiffness={"elbow_joint": 3.0})
    controls = scene.holding_controls(POSE)
    np.testing.assert_allclose(gear @ controls, scene.holding_torque(POSE), atol=1e-12)
    held = vp.simulate(scene, POSE, {}, dt=1e-3, steps=50, controls=controls)
    np.testing.assert_allclose(held.q, np.tile(ROW, (51, 1)), atol=1e-9)


def test_controls_that_cannot_hold_are_refused():
    scene = vp.Scene(vp.planar_chain(2), actuation=["joint2"])
    with refused(vp.InputError, "'joint1'"):
        scene.holding_controls([1.0, 0.3])
    # Upright nothing pulls but rounding.
    np.testing.assert_allclose(scene.holding_controls([0.5 * np.pi, 0.0]), 0.0, atol=1e-12)


def test_gravity_as_a_number_is_answered_with_the_vector_meant():
    with refused(vp.InputError, "gravity", "(0, 0, -9.81)"):
        vp.Scene(UR5, gravity=-9.81)


def test_noise_costs_and_barriers_take_names():
    named = vp.Scene(UR5, noise=vp.AdditiveNoise({"elbow_joint": 0.2}) + vp.StateNoise({"wrist_1_joint": 0.3}, POSE))
    rows = vp.Scene(UR5, noise=vp.AdditiveNoise([0, 0, 0.2, 0, 0, 0]) + vp.StateNoise([0, 0, 0, 0.3, 0, 0], ROW))
    options = {"dt": 2e-3, "steps": 10, "rng": 5}
    moved = vp.simulate(named, ROW, np.zeros(6), **options)
    assert same(moved, vp.simulate(rows, ROW, np.zeros(6), **options))
    assert np.ptp(moved.q[:, 2]) > 0.0

    weight = {"elbow_joint": 3.0, "wrist_1_joint": 1.0}
    row = np.array([0, 0, 3.0, 1.0, 0, 0])

    def value(cost):
        problem = vp.OptimalControlProblem(vp.Scene(UR5), cost + vp.ControlCost(1.0), ROW, 0.5 * ROW, dt=0.01, steps=5)
        return problem.cost_of(problem.simulate(np.ones(6)))

    for by_name, by_row in (
        (vp.TrackingCost(POSE, weight), vp.TrackingCost(ROW, row)),
        (vp.VelocityCost(weight, {"wrist_3_joint": 0.1}), vp.VelocityCost(row, [0, 0, 0, 0, 0, 0.1])),
        (vp.JointLimitBarrier(UR5, weight, {"elbow_joint": 2.5}), vp.JointLimitBarrier(UR5, row, [0, 0, 2.5, 0, 0, 0])),
    ):
        assert value(by_name) == value(by_row)
    assert repr(vp.TrackingCost(0.0, weight)) == f"TrackingCost(weight={weight})"


def test_controls_that_are_torques_of_joints_take_names():
    """Whether all joints are driven or some, in another order."""
    push, row = {"elbow_joint": 3.0, "wrist_1_joint": -1.0}, np.array([0, 0, 3.0, -1.0, 0, 0])
    driven = ["wrist_1_joint", "elbow_joint", "wrist_3_joint"]
    for actuation, controls in ((None, row), (driven, np.array([-1.0, 3.0, 0.0]))):
        scene = vp.Scene(UR5, actuation=actuation, noise=vp.AdditiveNoise(0.1))
        assert scene.control_joints == (NAMES if actuation is None else tuple(driven))
        options = {"dt": 2e-3, "steps": 10}
        by_row = vp.simulate(scene, ROW, np.zeros(6), controls=controls, **options)
        assert same(vp.simulate(scene, ROW, np.zeros(6), controls=push, **options), by_row)
        assert np.array_equal(by_row.u[4], controls)
        (one,) = vp.simulate_ensemble(scene, ROW, np.zeros(6), controls=push, paths=1, rng=0, **options).u
        assert np.array_equal(one, by_row.u)
        weight, by_name = np.abs(controls), {joint: abs(value) for joint, value in push.items()}
        for named, plain in (
            (vp.ControlCost(by_name, push), vp.ControlCost(weight, controls)),
            (
                vp.ControlRateCost(by_name, push) + vp.ControlCost(),
                vp.ControlRateCost(weight, controls) + vp.ControlCost(),
            ),
        ):
            values = []
            for cost in (named, plain):
                problem = vp.OptimalControlProblem(scene, cost, ROW, 0.5 * ROW, **options)
                values.append(problem.cost_of(problem.simulate(np.linspace(0, 1, scene.controls))))
            assert values[0] == values[1] > 0.0
        limits = ({"elbow_joint": -2.0}, {"elbow_joint": 2.5, "wrist_1_joint": np.inf})
        problem = vp.OptimalControlProblem(scene, vp.ControlCost(), ROW, ROW, control_limits=limits, **options)
        at = scene.control_joints.index("elbow_joint")
        assert problem.control_limits[:, at].tolist() == [-2.0, 2.5]
        assert np.isinf(np.delete(problem.control_limits, at, axis=1)).all()
        start = vp.solve(problem, push, max_iterations=0, check=False)
        np.testing.assert_array_equal(start.controls[3], np.clip(controls, *problem.control_limits))


USES = [
    lambda scene, value: vp.simulate(scene, ROW, ROW, controls=value, dt=1e-3, steps=1),
    lambda scene, value: vp.OptimalControlProblem(scene, vp.ControlCost(value), ROW, ROW, dt=1e-3, steps=1),
    lambda scene, value: vp.OptimalControlProblem(
        scene, vp.ControlCost() + vp.ControlRateCost(value), ROW, ROW, dt=1e-3, steps=1
    ),
    lambda scene, value: vp.OptimalControlProblem(
        scene, vp.ControlCost(), ROW, ROW, control_limits=(-np.inf, value), dt=1e-3, steps=1
    ),
]


@pytest.mark.parametrize("use", USES)
def test_names_of_controls_that_have_none_are_refused(use):
    shared = np.eye(6)
    shared[1, 2] = 0.5
    for actuation in (shared, 2.0 * np.eye(6), np.ones((6, 1))):
        scene = vp.Scene(UR5, actuation=actuation)
        assert scene.control_joints is None
        with refused(vp.InputError, "joint name"):
            use(scene, {"elbow_joint": 1.0})
    with refused(vp.UnknownJoint, "'elbow_joint'"):
        use(vp.Scene(UR5, actuation=["wrist_1_joint"]), {"elbow_joint": 1.0})
    with refused(vp.InputError, "'elbow_joint'", "'a'"):
        use(vp.Scene(UR5), {"elbow_joint": "a"})


def test_a_posture_by_its_name_is_told_how_to_be_given():
    """The command line takes names of postures; from Python they are positions of the robot's."""
    scene = vp.Scene(vp.planar_chain(2))
    for call in (
        lambda: vp.simulate(scene, "home", [0, 0], dt=0.01, steps=2),
        lambda: vp.OptimalControlProblem(scene, vp.ControlCost(1.0), "home", [0, 0], dt=0.1, steps=2),
        lambda: scene.holding_torque("home"),
    ):
        with refused(vp.InputError, "(2,)", "robot.posture('home')"):
            call()
