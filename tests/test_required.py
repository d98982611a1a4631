"""What is left out of a scene changes nothing in what is left."""

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import mass_matrix

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


def columns(file, names):
    return [file.robot.joint_names.index(name) for name in names]


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
    own = columns(whole, INDEX)
    np.testing.assert_allclose(plan.trajectory.q, everything.trajectory.q[:, own], atol=1e-10)
    np.testing.assert_allclose(plan.controls, everything.controls[:, own], atol=1e-9)
    assert plan.cost == pytest.approx(everything.cost, rel=1e-9)
    others = [c for c in range(16) if c not in own]
    assert np.ptp(everything.trajectory.q[:, others], axis=0).max() < 1e-12


def test_motion_is_the_same_without_idle_fingers(tmp_path):
    more = '[simulate]\ncontrols = { "joint_1.0" = 0.05 }\n'
    path = hand(tmp_path, [], more=more)
    file, whole = vp.load_scene(path), vp.load_scene(path, required_only=False)
    assert file.robot.joint_names == INDEX
    own = columns(whole, INDEX)
    np.testing.assert_allclose(file.simulate().q, whole.simulate().q[:, own], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "joints"),
    [
        ({"gravity": "[0.0, 0.0, -9.81]"}, 16),  # pulls at all of them
        ({"more": '[[noise]]\ntype = "additive"\nintensity = { "joint_6.0" = 1e-3 }'}, 8),
        ({"more": '[[noise]]\ntype = "control"\nintensity = 1e-3'}, 4),  # nothing without controls
        ({"more": '[springs]\nstiffness = { "joint_6.0" = 1.0 }'}, 4),  # slack
        ({"more": '[springs]\nstiffness = { "joint_5.0" = 1.0 }'}, 8),  # not slack at 0.4
        ({"more": '[[cost]]\ntype = "frame_position"\nframe = "link_7.0"\ntarget = [0, 0, 0]'}, 8),
        ({"more": '[[cost]]\ntype = "center_of_mass"\ntarget = [0, 0, 0]'}, 16),
        ({"more": '[[cost]]\ntype = "joint_limits"'}, 4),  # within them
        ({"more": '[[cost]]\ntype = "joint_limits"', "q": '"joint_12.0" = 0.2'}, 8),  # the thumb is below its least
        ({"more": '[[cost]]\ntype = "tracking"\nreference = { "joint_5.0" = 0.4, "joint_12.0" = 0.3 }'}, 4),
    ],
)
def test_what_touches_a_finger(change, joints, tmp_path):
    file = vp.load_scene(hand(tmp_path, ["joint_1.0"], **change))
    assert file.robot.dof == joints


def test_fingers_are_planned_apart_to_the_same_plan(tmp_path):
    path = hand(tmp_path, ["joint_1.0", "joint_13.0"])
    file = vp.load_scene(path)
    assert file.required.parts == (INDEX, THUMB)
    assert file.required.saved == pytest.approx(1.0 - 2 * 4**3 / 16**3)
    apart, together = file.solve(apart=True), vp.solve(file.problem)
    assert apart.status.converged
    # What was found apart is where the whole ends, at once.
    assert apart.iterations == 0
    assert apart.cost == pytest.approx(together.cost, rel=1e-8)
    np.testing.assert_allclose(apart.trajectory.q, together.trajectory.q, atol=1e-6)
    np.testing.assert_allclose(apart.gains, together.gains, rtol=1e-5, atol=1e-7)


def test_cost_on_the_whole_robot_keeps_fingers_together(tmp_path):
    file = vp.load_scene(hand(tmp_path, ["joint_1.0"], more='[[cost]]\ntype = "center_of_mass"\ntarget = [0, 0, 0]'))
    assert len(file.required.parts) == 1
    assert "center_of_mass" in file.required.coupled


def test_saving_is_measured(tmp_path):
    """A quarter of the joints takes far less than two thirds of the time."""
    assert vp.load_scene(hand(tmp_path, ["joint_1.0"])).saving() > 1.5


@pytest.mark.parametrize(
    ("text", "integrator"),
    [
        ('type = "gauss"\nstages = 3\nkick = "split"', vp.Gauss(stages=3, kick="split")),
        ('type = "explicit_euler"', vp.ExplicitEuler()),
        ('type = "semi_implicit_euler"', vp.SemiImplicitEuler()),
        ('type = "runge_kutta_4"', vp.RungeKutta4()),
        ('type = "midpoint"\nalpha = 0.3\nkick = "split"', vp.Midpoint(alpha=0.3, kick="split")),
    ],
)
def test_integrators(text, integrator, tmp_path):
    file = vp.load_scene(hand(tmp_path, ["joint_1.0"], more=f"[integrator]\n{text}"))
    assert file.problem.integrator == integrator


def test_robot_at_rest_is_all_of_the_scene(tmp_path):
    assert vp.load_scene(hand(tmp_path, [])).robot.dof == 16


def test_locked_joints_are_no_bodies():
    """A Panda that moves two joints is a two-body arm, whose inertias add up from the links that are carried."""
    lock = {f"panda_joint{k}": 0.3 for k in (1, 3, 5, 6, 7)} | {"panda_finger_joint1": 0.02}
    robot, twin = vp.load_robot("panda", lock=lock), vp.load_robot(two_joint_panda(lock))
    assert robot.dof == robot.tree.parent.size == 2
    motions = [vp.simulate(vp.Scene(arm), [0.2, -1.0], [0.5, 0.0], dt=5e-3, steps=100) for arm in (robot, twin)]
    np.testing.assert_allclose(motions[0].q, motions[1].q, rtol=0, atol=1e-11)


def two_joint_panda(lock):
    """panda_joint2 and panda_joint4 with everything they carry, added up link by link."""
    model = vp.load_robot("panda").free_model
    data, q = model.createData(), pin.neutral(model)
    for name, value in (lock | {"panda_finger_joint2": 0.02}).items():
        q[model.joints[model.getJointId(name)].idx_q] = value
    pin.forwardKinematics(model, data, q)
    arm, shoulder, elbow = pin.Model(), model.getJointId("panda_joint2"), model.getJointId("panda_joint4")
    own = {shoulder: arm.addJoint(0, pin.JointModelRZ(), data.oMi[shoulder], "shoulder")}
    own[elbow] = arm.addJoint(own[shoulder], pin.JointModelRZ(), data.oMi[shoulder].actInv(data.oMi[elbow]), "elbow")
    for joint in range(shoulder, model.njoints):
        carrier = elbow if joint >= elbow else shoulder
        arm.appendBodyToJoint(own[carrier], model.inertias[joint], data.oMi[carrier].actInv(data.oMi[joint]))
    return arm


def test_payload_is_what_pinocchio_makes_of_it(load):
    """Mass matrix with a payload: that of the robot without, and of the payload's body by its Jacobian."""
    inertia = np.array([[2e-3, 1e-4, 0.0], [1e-4, 3e-3, 2e-4], [0.0, 2e-4, 4e-3]])
    load_ = vp.Payload("tool0", 1.5, center=[0.01, -0.02, 0.1], inertia=inertia)
    bare, loaded = load("ur5"), vp.load_robot("ur5", payload=load_)
    q = np.linspace(-1.0, 1.0, 6)
    model, data = bare.model, bare.model.createData()
    J = pin.computeFrameJacobian(model, data, bare.configuration(q), model.getFrameId("tool0"), pin.LOCAL)
    body = pin.Inertia(1.5, np.array([0.01, -0.02, 0.1]), inertia).matrix()
    expected = mass_matrix(bare, q, data) + J.T @ body @ J
    np.testing.assert_allclose(mass_matrix(loaded, q, loaded.model.createData()), expected, rtol=1e-12, atol=1e-13)
    # Locking a joint does not lose it.
    held = vp.load_robot("ur5", payload=load_, lock={"wrist_3_joint": q[5]})
    np.testing.assert_allclose(
        mass_matrix(held, q[:5], held.model.createData()), expected[:5, :5], rtol=1e-12, atol=1e-13
    )


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"frame": "tool"}, "did you mean 'tool0'"),
        ({"frame": "world"}, "belongs to the base"),
        ({"mass": 0.0}, "mass must be positive"),
        ({"center": [0.0, 1.0]}, "center must have shape"),
        ({"inertia": [1.0, 1.0, 3.0]}, "no rigid body"),
        ({"inertia": 2.0}, "must be 0, three"),
        ({"inertia": [[1.0, 0.5, 0], [0, 1.0, 0], [0, 0, 1.0]]}, "symmetric"),
    ],
)
def test_payload_that_cannot_be(given, words):
    with pytest.raises(vp.VarpinError, match=words):
        vp.load_robot("ur5", payload=vp.Payload(**{"frame": "tool0", "mass": 1.0} | given))
