"""What is left out of a scene changes nothing in what is left."""

import numpy as np
import pinocchio as pin
import pytest
from oracles import Mechanism
from refusals import refused

import varpin as vp

HAND = """
gravity = {gravity}
[robot]
source = "allegro_right_hand"
[initial]
q = {{ {q} }}
[horizon]
dt = 5e-3
steps = 40
[[cost]]
type = "tracking"
weight = 10.0
[cost.reference]
offset = {{ {q} }}
sines = [{sines}]
[[cost]]
type = "velocity"
weight = 1e-3
[[cost]]
type = "control"
weight = 0.1
{more}
"""
SINE = '{{ of = "{}", amplitude = 0.3, frequency = 2.0 }}'
INDEX = ("joint_0.0", "joint_1.0", "joint_2.0", "joint_3.0")
THUMB = ("joint_12.0", "joint_13.0", "joint_14.0", "joint_15.0")


def hand(folder, moving, *, gravity="false", q='"joint_5.0" = 0.4, "joint_12.0" = 0.3', more=""):
    path = folder / "hand.toml"
    sines = ", ".join(SINE.format(name) for name in moving)
    path.write_text(HAND.format(gravity=gravity, q=q, sines=sines, more=more))
    return path


def columns(robot, names):
    return [robot.joint_names.index(name) for name in names]


def test_idle_fingers_are_left_out_and_the_answer_is_the_same(tmp_path):
    path = hand(tmp_path, ["joint_1.0", "joint_2.0"])
    file, whole = vp.load_scene(path), vp.load_scene(path, required_only=False)
    assert file.robot.joint_names == INDEX
    assert len(file.required.idle) == 12
    assert file.required.idle["joint_5.0"] == 0.4
    assert file.required.described == whole.robot.dof == 16
    assert file.robot.tree.parent.size == 4  # nothing of the other fingers is in the tree
    plan = file.solve()
    everything = vp.solve(whole.problem)
    own = columns(whole.robot, INDEX)
    np.testing.assert_allclose(plan.trajectory.q, everything.trajectory.q[:, own], atol=1e-10)
    np.testing.assert_allclose(plan.controls, everything.controls[:, own], atol=1e-9)
    assert plan.cost == pytest.approx(everything.cost, rel=1e-9)
    others = [c for c in range(16) if c not in own]
    assert np.ptp(everything.trajectory.q[:, others], axis=0).max() < 1e-12
    assert vp.load_scene(hand(tmp_path, ["joint_1.0", "joint_13.0"])).required.parts == (INDEX, THUMB)


@pytest.mark.parametrize(
    ("change", "joints"),
    [
        ({"gravity": "[0.0, 0.0, -9.81]"}, 16),  # pulls at all of them
        ({"more": '[[noise]]\ntype = "additive"\nintensity = { "joint_6.0" = 1e-3 }'}, 8),
        ({"more": '[[noise]]\ntype = "control"\nintensity = 1e-3'}, 4),  # nothing without controls
        ({"more": '[[noise]]\ntype = "state"\nintensity = { "joint_6.0" = 1e-3 }\ncenter = 0.1'}, 8),
        ({"more": '[springs]\nstiffness = { "joint_6.0" = 1.0 }'}, 4),  # slack
        ({"more": '[springs]\nstiffness = { "joint_5.0" = 1.0 }'}, 8),  # not slack at 0.4
        ({"more": '[[cost]]\ntype = "frame_position"\nframe = "link_7.0"\ntarget = [0, 0, 0]'}, 8),
        ({"more": '[[cost]]\ntype = "center_of_mass"\ntarget = [0, 0, 0]'}, 16),
        ({"more": '[[cost]]\ntype = "joint_limits"'}, 4),  # within them
        ({"more": f'[[cost]]\ntype = "joint_limits"\nmargin = {[0.01] * 16}'}, 4),
        ({"more": '[[cost]]\ntype = "joint_limits"', "q": '"joint_12.0" = 0.2'}, 8),  # the thumb is below its least
        ({"more": '[[cost]]\ntype = "tracking"\nreference = { "joint_5.0" = 0.4, "joint_12.0" = 0.3 }'}, 4),
    ],
)
def test_what_touches_a_finger(change, joints, tmp_path):
    file = vp.load_scene(hand(tmp_path, ["joint_1.0"], **change))
    assert file.robot.dof == joints


def test_payload_is_what_pinocchio_makes_of_it(load):
    inertia = np.array([[2e-3, 1e-4, 0.0], [1e-4, 3e-3, 2e-4], [0.0, 2e-4, 4e-3]])
    load_ = vp.Payload("tool0", 1.5, center=[0.01, -0.02, 0.1], inertia=inertia)
    bare, loaded = load("ur5"), vp.load_robot("ur5", payload=load_)
    q = np.linspace(-1.0, 1.0, 6)
    model, data = bare.model, bare.model.createData()
    J = pin.computeFrameJacobian(model, data, bare.configuration(q), model.getFrameId("tool0"), pin.LOCAL)
    body = pin.Inertia(1.5, np.array([0.01, -0.02, 0.1]), inertia).matrix()
    expected = Mechanism(vp.Scene(bare)).mass_matrix(q) + J.T @ body @ J
    found = Mechanism(vp.Scene(loaded)).mass_matrix(q)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)
    # Locking a joint does not lose it.
    held = vp.load_robot("ur5", payload=load_, lock={"wrist_3_joint": q[5]})
    found = Mechanism(vp.Scene(held)).mass_matrix(q[:5])
    np.testing.assert_allclose(found, expected[:5, :5], rtol=1e-12, atol=1e-13)


def every_force(robot):
    """Forces on all joints in every form of their values, and between two fingers."""
    n = robot.dof
    return [
        vp.JointSpring({"joint_1.0": 1.0, "joint_6.0": 0.0}, 0.3),
        vp.PositionServo(np.full(n, 2.0), 0.05, {"joint_0.0": 0.4, "joint_5.0": 0.3}),
        vp.CoulombFriction(dict.fromkeys(robot.joint_names, 0.001), 0.1),
        vp.JointStop(1.0, lower=np.full(n, -3.0), upper={"joint_1.0": 0.2, "joint_13.0": 2.0}),
        vp.Armature(np.linspace(1e-5, 2e-5, n)),
        vp.FrameDamper("link_3.0", ("link_7.0", [0.0, 0.0, 0.01]), 0.2),
        vp.FrameDamper("link_11.0", [0.0, 0.1, 0.1], 0.2),
    ]


def moved_alone(scene, required, controls, **start):
    """What is left of a scene without its idle joints, which moves as in the whole."""
    part, robot = scene.without(required.idle), scene.robot
    assert part.robot.joint_names == required.joints
    own = columns(robot, required.joints)
    q0 = np.zeros(16)
    q0[columns(robot, start)] = list(start.values())
    options = {"dt": 1e-3, "steps": 40, "rng": 0 if scene.processes else None, "check": False}
    whole = vp.simulate(scene, q0, np.zeros(16), controls=controls, **options)
    alone = vp.simulate(part, q0[own], np.zeros(len(own)), controls=controls[own], **options)
    np.testing.assert_allclose(alone.q, whole.q[:, own], rtol=1e-11, atol=1e-13)
    assert np.ptp(alone.q, axis=0).max() > 0.01
    return part


def test_scenes_in_python_are_the_same_without_idle_joints():
    robot, one = vp.load_robot("allegro_right_hand"), np.eye(16)
    noise = [vp.AdditiveNoise(1e-3 * one[:, [2]]), vp.ControlNoise(1e-2 * one[:, [1], None] * one[0])]
    q0 = {"joint_9.0": 0.2, "joint_12.0": 0.3}
    spring, _, *others = every_force(robot)
    scene = vp.Scene(robot, gravity=False, damping=1e-3, forces=[spring, *others], noise=noise)
    required = scene.required(q0)
    # The index finger has a spring, the middle finger a damper to it.
    assert required.joints == tuple(f"joint_{k}.0" for k in range(8))
    assert required.parts == (required.joints,)
    assert required.idle.keys() == {f"joint_{k}.0" for k in range(8, 16)}
    assert required.idle["joint_12.0"] == 0.3
    part = moved_alone(scene, required, 0.01 * one[0], **q0)
    assert dict(part.robot.locked) == dict(required.idle)
    assert part.processes == scene.processes == 2
    assert len(part.couplings) == 1


def test_servos_hold_idle_joints_and_move_the_others():
    robot = vp.load_robot("allegro_right_hand")
    scene = vp.Scene(robot, gravity=False, forces=every_force(robot))
    command = 0.1 * (np.array(robot.joint_names) == "joint_13.0")
    assert scene.required(0.0).joints == tuple(f"joint_{k}.0" for k in range(8))
    required = scene.required(0.0, controls=command)
    assert len(required.joints) == 12
    assert moved_alone(scene, required, command).servo_joints == required.joints


@pytest.mark.parametrize(
    ("given", "joints"),
    [
        ({}, 16),  # nothing moves at all
        ({"v0": {"joint_1.0": 0.1}}, 4),
        ({"controls": np.eye(16)[5]}, 4),
        ({"controls": [np.zeros(16), np.eye(16)[1]], "task": ["joint_13.0"]}, 8),
        ({"task": ["joint_1.0", "joint_2.0"]}, 4),
    ],
)
def test_what_touches_a_joint_in_python(given, joints):
    scene = vp.Scene(vp.load_robot("allegro_right_hand"), gravity=False)
    assert len(scene.required(0.0, **given).joints) == joints


def test_gravity_along_an_axis_touches_no_joint():
    model = pin.Model()
    for name in ("one", "two"):
        joint = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), name)
        model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    assert vp.Scene(vp.load_robot(model)).required(0.0, {"one": 1.0}).joints == ("one",)


def test_held_joints_are_those_of_a_robot_that_is_loaded_with_them():
    lock = {"panda_joint1": 0.3, "panda_joint5": -0.2}
    whole, robot = vp.load_robot("panda"), vp.load_robot("panda", lock=lock)
    part = vp.Scene(
        whole, damping="robot", stiffness={"panda_joint1": 3.0, "panda_joint2": 2.0}, actuation=np.eye(8)[:, 1:]
    )
    part = part.without(lock)
    scene = vp.Scene(robot, damping="robot", stiffness={"panda_joint2": 2.0}, actuation=np.eye(6))
    assert part.robot.joint_names == robot.joint_names
    np.testing.assert_array_equal(part.robot.damping, robot.damping)
    np.testing.assert_array_equal(part.actuation, scene.actuation)
    q, v = np.linspace(0.1, 0.2, 6), np.linspace(0.3, -0.3, 6)
    motions = [vp.simulate(s, q, v, dt=1e-3, steps=20, check=False).q for s in (part, scene)]
    np.testing.assert_allclose(*motions, rtol=1e-12, atol=1e-13)


def test_joints_of_combined_robots_are_held():
    pair = vp.combine(vp.load_robot("finger"), vp.load_robot("finger"), prefixes=["a_", "b_"])
    part = vp.Scene(pair, damping={"a_pip": 0.1, "b_dip": 0.2}).without({"a_dip": 0.4, "b_mcp": 0.1})
    assert part.robot.joint_names == ("a_mcp", "a_pip", "b_pip", "b_dip")
    np.testing.assert_array_equal(part.damping, [0.0, 0.1, 0.0, 0.2])
    own = [vp.load_robot("finger", lock=lock) for lock in ({"dip": 0.4}, {"mcp": 0.1})]
    expected = np.concatenate([vp.Scene(robot).holding_torque([0.2, 0.3]) for robot in own])
    np.testing.assert_allclose(part.holding_torque([0.2, 0.3, 0.2, 0.3]), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("scene", "joints", "kind", "facts"),
    [
        ({"constraints": vp.JointTie("dip", "pip")}, ["mcp"], vp.InputError, "constraints"),
        ({"forces": vp.CustomForce(lambda q, v: 0.0 * q)}, ["mcp"], vp.InputError, "CustomForce"),
        ({"noise": vp.CustomNoise(lambda q, v, u: np.ones((3, 1)), 1)}, ["mcp"], vp.InputError, "CustomNoise"),
        ({}, "mcp", vp.InputError, "'mcp'"),
        ({}, {"mcp": "a"}, vp.InputError, "'mcp'"),
        ({}, {"mcq": 0.0}, vp.UnknownJoint, ("'mcq'", "mcp")),
        ({}, ["mcp", "pip", "dip"], vp.RobotError, "joint"),
    ],
)
def test_scenes_that_keep_their_joints(scene, joints, kind, facts):
    made = vp.Scene(vp.load_robot("finger"), **scene)
    with refused(kind, facts):
        made.without(joints)


def test_nothing_is_left_out_of_scenes_with_constraints_or_functions():
    robot = vp.load_robot("allegro_right_hand")
    for more in (
        {"constraints": vp.JointTie("joint_1.0", "joint_2.0")},
        {"forces": vp.CustomForce(lambda q, v: 0.0 * q)},
    ):
        assert not vp.Scene(robot, gravity=False, **more).required(0.0, {"joint_1.0": 0.1}).idle
    with refused(vp.InputError, ("controls", "(16,)", "(1, 3)")):
        vp.Scene(robot).required(0.0, controls=np.zeros(3))
