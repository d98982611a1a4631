"""Joint values by name, holding torques and gravity: what a scene and those who take a state accept."""

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused

import varpin as vp

UR5 = vp.load_robot("ur5")
NAMES = UR5.joint_names
SCENE = vp.Scene(UR5, damping=0.1)
POSE = {"elbow_joint": 1.1, "shoulder_lift_joint": 0.7}
ROW = np.array([0.0, 0.7, 1.1, 0.0, 0.0, 0.0])
STEPS = {"dt": 2e-3, "steps": 10}
# Margins of limits in which the motion is.
WIDE, WIDE_ROW = {"elbow_joint": 3.1, "shoulder_lift_joint": 6.2}, np.array([0.0, 6.2, 3.1, 0.0, 0.0, 0.0])


def motion(q=ROW, v=ROW, scene=SCENE, **options):
    return vp.simulate(scene, q, v, **STEPS, **options)


def problem(q=ROW, v=ROW, cost=None, scene=SCENE, **options):
    cost = vp.ControlCost(1.0) if cost is None else cost + vp.ControlCost(1.0)
    return vp.OptimalControlProblem(scene, cost, q, v, **STEPS, **options)


def value(cost):
    task = problem(cost=cost)
    return task.cost_of(task.simulate(np.linspace(0.0, 1.0, task.scene.controls)))


# What is computed of joint values: the same whether they are given by name or as a row.
SAME = {
    "start": lambda x: motion(x, x).p,
    "paths": lambda x: vp.simulate_ensemble(SCENE, x, x, paths=2, rng=0, workers=1, **STEPS).q[1],
    "torques": lambda x: motion(controls=x).u,
    "torques of paths": lambda x: vp.simulate_ensemble(SCENE, ROW, ROW, controls=x, paths=1, rng=0, **STEPS).u[0],
    "problem": lambda x: [problem(x, x).q0, problem(x, x).v0, problem().at(q0=x).q0],
    "jet": lambda x: [vp.lagrangian_jet(SCENE, x, x, backend=name).Lq for name in ("compiled", "pinocchio")],
    "report": lambda x: [vp.inspect_robot(UR5, q=x, v=x).q, vp.inspect_robot(UR5, q=x, v=x).v],
    "discrete Lagrangian": lambda x: vp.discrete_lagrangian(SCENE, x, x, 0.01).D1,
    "noise": lambda x: motion(scene=vp.Scene(UR5, noise=vp.AdditiveNoise(x) + vp.StateNoise(x, 0.1)), rng=5).q,
    "noise's middle": lambda x: motion(scene=vp.Scene(UR5, noise=vp.StateNoise(1.0, x)), rng=5).q,
    "tracking": lambda x: value(vp.TrackingCost(x, x)),
    "speeds": lambda x: value(vp.VelocityCost(x, x)),
    "barrier": lambda x: value(vp.JointLimitBarrier(UR5, x, WIDE if x is POSE else WIDE_ROW)),
    "control cost": lambda x: value(vp.ControlCost(x, x)),
    "rate cost": lambda x: value(vp.ControlRateCost(x, x)),
}


@pytest.mark.parametrize("use", SAME)
def test_values_by_name_are_those_of_a_row(use):
    found = np.array(SAME[use](POSE))
    np.testing.assert_array_equal(found, SAME[use](ROW))
    assert np.abs(found - SAME[use](0.5 * ROW)).max() > 1e-6
    assert repr(vp.TrackingCost(0.0, POSE)) == f"TrackingCost(weight={POSE})"


@pytest.mark.parametrize(
    "call",
    [
        lambda value: vp.Scene(UR5, damping=value),
        lambda value: vp.Scene(UR5, noise=vp.AdditiveNoise(value)),
        lambda value: vp.JointLimitBarrier(UR5, value),
        motion,
        lambda value: vp.simulate_ensemble(SCENE, ROW, value, paths=1, rng=0, **STEPS),
        problem,
        lambda value: vp.lagrangian_jet(SCENE, value, ROW),
        SCENE.holding_torque,
        lambda value: vp.inspect_robot(UR5, q=value),
        lambda value: vp.advise(SCENE, value, ROW, duration=1.0, tolerance=1e-3),
    ],
)
def test_names_and_numbers_that_are_none_are_named(call):
    with refused(vp.UnknownJoint, "'elbow'", "'elbow_joint'") as caught:
        call({"elbow": 1.0})
    assert (caught.value.matches[0], caught.value.known) == ("elbow_joint", NAMES)
    for value, facts in ((np.nan, ("'elbow_joint'", "nan")), ("a", "'a'")):
        with refused(vp.InputError, facts):
            call({"elbow_joint": value})


@pytest.mark.parametrize("name", ["ur5", "panda", "finger"])
def test_holding_torque_is_pinocchios_gravity_and_the_springs(name):
    robot = vp.load_robot(name)
    rng = np.random.default_rng(3)
    q, stiffness, rest = rng.uniform(-1, 1, (3, robot.dof))
    scene = vp.Scene(robot, gravity=(1.0, -2.0, -7.0), stiffness=np.abs(stiffness), rest=rest)
    model = robot.model.copy()
    model.gravity = pin.Motion(np.array([1.0, -2.0, -7.0]), np.zeros(3))
    pull = pin.computeGeneralizedGravity(model, model.createData(), robot.configuration(q))
    expected = robot.velocity(np.eye(robot.dof)) @ pull + np.abs(stiffness) * (q - rest)
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


def test_torques_of_some_joints_in_another_order_take_names():
    driven = ("wrist_1_joint", "elbow_joint", "wrist_3_joint")
    scene = vp.Scene(UR5, actuation=list(driven))
    assert (scene.control_joints, vp.Scene(UR5).control_joints) == (driven, NAMES)
    named = motion(scene=scene, controls={"elbow_joint": 3.0, "wrist_1_joint": -1.0})
    assert named.u[4].tolist() == [-1.0, 3.0, 0.0]
    limits = ({"elbow_joint": -2.0}, {"elbow_joint": 2.5, "wrist_1_joint": np.inf})
    task = problem(scene=scene, control_limits=limits)
    assert task.control_limits.tolist() == [[-np.inf, -2.0, -np.inf], [np.inf, 2.5, np.inf]]
    start = vp.solve(task, {"elbow_joint": 3.0}, max_iterations=0, check=False)
    assert start.controls[3].tolist() == [0.0, 2.5, 0.0]


USES = [
    lambda scene, value: motion(scene=scene, controls=value),
    lambda scene, value: problem(cost=vp.ControlCost(value), scene=scene),
    lambda scene, value: problem(cost=vp.ControlRateCost(value), scene=scene),
    lambda scene, value: problem(scene=scene, control_limits=(-np.inf, value)),
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
