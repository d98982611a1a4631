"""Forces on frames and between them, against Pinocchio's kinematics and closed forms; the battery has their motions."""

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from refusals import refused
from test_groups import forest

import varpin as vp


def frame_of(robot, frame, q):
    """Pose of a frame, and its angular velocity (3, n) per velocity of each joint."""
    model, data = robot.model, robot.model.createData()
    J = pin.computeFrameJacobian(model, data, q, model.getFrameId(frame), pin.LOCAL_WORLD_ALIGNED)
    pin.framesForwardKinematics(model, data, q)
    # Of one joint the bindings drop an axis.
    return data.oMf[model.getFrameId(frame)], J.reshape(6, -1)[3:]


def state(robot):
    rng = np.random.default_rng(3)
    return rng.normal(size=robot.dof), rng.normal(size=robot.dof)


def test_a_wrench_is_what_pinocchio_makes_of_it():
    robot, tip = vp.load_robot("ur5"), "tool0"
    q, v = state(robot)
    model, data = robot.model, robot.model.createData()
    wrench = np.array([3.0, -1.0, 2.0, 0.4, 0.5, -0.6])
    for axes, frame in (("world", pin.LOCAL_WORLD_ALIGNED), ("frame", pin.LOCAL)):
        J = pin.computeFrameJacobian(model, data, q, model.getFrameId(tip), frame)
        scene = vp.Scene(robot, gravity=False, damping=0.0, forces=vp.FrameWrench(tip, wrench, axes))
        still = np.zeros_like(v)
        np.testing.assert_allclose(scene.holding_torque(q), -J.T @ wrench, rtol=1e-12, atol=1e-13)
        motion = vp.simulate(scene, q, still, dt=1e-3, steps=5, controls=scene.holding_controls(q))
        np.testing.assert_allclose(motion.q, np.tile(q, (6, 1)), atol=1e-9)


def test_groups_that_couplings_join():
    robot, tip, other = forest(0, 2), "0.2", "2.3"
    spring = vp.FrameSpring(tip, other, 5.0)
    assert vp.Scene(robot).group.tolist() == [0, 0, 0, 1, 1, 1, 1]
    assert vp.Scene(robot, forces=vp.FrameSpring(tip, [0.0, 0.0, 0.0], 5.0)).group.max() == 1
    assert vp.Scene(robot, forces=spring).group.tolist() == [0] * 7
    q, v = state(robot)
    scene = vp.Scene(robot, forces=spring)
    A = vp.linearize(scene, vp.simulate(scene, q, v, dt=1e-3, steps=1)).A[0]
    assert np.abs(A[7:10, 3:7]).min() > 0.0
    # Errors of the energy that passes between arms are no errors.
    motion = vp.simulate(scene, q, np.zeros(7), dt=1e-3, steps=300, integrator=vp.RungeKutta4())
    assert not about(motion.warnings, "error")


def carrier():
    """A heavy wheel that carries a light pendulum of two links."""
    model = pin.Model()
    parent = 0
    for k, mass in enumerate((500.0, 0.01, 0.01)):
        parent = model.addJoint(parent, pin.JointModelRY(), pin.SE3(np.eye(3), np.array([0.3 * k, 0, 0])), f"j{k}")
        model.appendBodyToJoint(parent, pin.Inertia.FromSphere(mass, 0.2), pin.SE3(np.eye(3), np.array([0.2, 0, 0])))
        placement = pin.SE3(np.eye(3), np.array([0.3, 0, 0]))
        model.addFrame(pin.Frame(f"tip{k}", parent, 0, placement, pin.FrameType.OP_FRAME))
    return vp.load_robot(model)


@pytest.mark.parametrize("ends", [("tip2", "tip0"), ("tip2", [0.5, 0.0, -0.8]), ("tip2", "tip1")])
def test_light_parts_balance_with_springs(ends):
    """A spring on a light part belongs to its balance: steps that resolve the motion stay whole."""
    robot = carrier()
    assert robot.tree.loads.size
    scene = vp.Scene(robot, forces=[vp.FrameSpring(*ends, 2.0), vp.FrameDamper(*ends, 0.002)])
    q, v = np.array([0.1, 0.8, -0.5]), np.array([0.4, 0.0, 1.0])
    motion = vp.simulate(scene, q, v, dt=2e-3, steps=500, integrator=vp.Gauss(2), check=False)
    assert motion.statistics.split_steps == 0


def test_scenes_show_their_frame_forces():
    scene = vp.Scene(vp.load_robot("ur5"), forces=vp.FrameSpring("tool0", ("forearm_link", [0.05, 0.1, 0.0]), 8.0))
    assert "FrameSpring(a='tool0', b=('forearm_link', [0.05, 0.1, 0.0]), stiffness=8.0, rest=0.0)" in repr(scene.forces)
    assert "FrameSpring" in repr(scene)
    assert "FrameSpring" in scene._repr_html_()


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: vp.FrameWrench("base_link", np.ones(6)), "'base_link'"),
        (lambda: vp.FrameWrench("tool0", np.ones(3)), ("wrench", "(6,)")),
        (lambda: vp.FrameWrench([0.5, 0.0, 0.4], np.ones(6)), ("frame", "[0.5, 0.0, 0.4]")),
        (lambda: vp.FrameWrench("tool0", np.ones(6), "local"), ("axes", "'world'", "'frame'", "'local'")),
        (lambda: vp.FrameSpring("tool0", [0, 0], 1.0), ("b", "(2,)")),
        (lambda: vp.FrameSpring([0, 0, 0], "base_link", 1.0), ("FrameSpring", "'ur5'")),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], -1.0), ("stiffness", "-1.0")),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, -0.1), ("rest", "-0.1")),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], [1, 1, 1], 0.1), "stiffness"),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, rest_rotation=np.eye(3)), "rest_rotation"),
        (
            lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, 0.0, 1.0, np.diag([1.0, 1.0, -1.0])),
            "rest_rotation",
        ),
        (lambda: vp.FrameSpring("base_link", [0, 0, 0], 0.0, 0.0, 1.0), ("FrameSpring", "'ur5'")),
        (lambda: vp.FrameDamper("tool0", [0, 0, 0], 1.0, np.nan), ("rotational_damping", "nan")),
        (lambda: vp.FrameDamper(("tool0", [0, 0]), [0, 0, 0], 1.0), "(3,)"),
        (lambda: vp.FrameDamper("tool0", [0, 0, 0], [1, np.inf, 1]), ("damping", "[1.0, inf, 1.0]")),
    ],
)
def test_what_cannot_be_is_refused(make, facts):
    with refused(vp.InputError, facts):
        vp.Scene(vp.load_robot("ur5"), forces=make())


def test_turning_has_a_known_energy_and_moment():
    """One joint that turns frame a about the spring's axis: k (1 - cos angle), and no singularity at half a turn."""
    robot, k, at = vp.planar_chain(1), 3.0, 0.4
    rest = frame_of(robot, "joint1", np.array([at]))[0].rotation
    scene = vp.Scene(
        robot,
        gravity=False,
        damping=0.0,
        forces=vp.FrameSpring("joint1", [0, 0, 0], 0.0, rotational_stiffness=k, rest_rotation=rest),
    )
    bare = vp.Scene(robot, gravity=False, damping=0.0)
    for angle in (0.0, 1e-9, 0.5, 2.0, np.pi - 1e-6, np.pi, 4.0):
        one, two = (vp.lagrangian_jet(own, [at + angle], [0.0]) for own in (scene, bare))
        held = two.L - one.L
        assert held == pytest.approx(k * (1.0 - np.cos(angle)), rel=1e-12, abs=1e-15)
        assert one.Lq[0] == pytest.approx(-k * np.sin(angle), rel=1e-12, abs=1e-15)
        assert one.Lqq[0, 0] == pytest.approx(-k * np.cos(angle), rel=1e-12, abs=1e-14)


def test_stiffness_about_each_axis():
    """At rest the curvature is that of three springs of turning, about the axes of frame a."""
    robot, tip, other = vp.load_robot("ur5"), "tool0", "forearm_link"
    q, k = state(robot)[0], np.array([1.0, 5.0, 0.5])
    (a, on_a), (b, on_b) = (frame_of(robot, frame, q) for frame in (tip, other))
    rest = b.rotation.T @ a.rotation
    scene = vp.Scene(robot, damping=0.0, forces=vp.FrameSpring(tip, other, 0.0, 0.0, k, rest))
    added = vp.lagrangian_jet(vp.Scene(robot, damping=0.0), q, 0 * q).Lqq - vp.lagrangian_jet(scene, q, 0 * q).Lqq
    W = a.rotation.T @ (on_a - on_b)
    np.testing.assert_allclose(added, W.T @ (k[:, None] * W), atol=1e-12 * k.max())


def test_a_hanging_spring_finds_its_rest():
    """A slider on a spring with a length: where stiffness and weight are even."""
    robot = vp.planar_chain(1)
    load = vp.FrameWrench("joint1", [0, 0, 0, 0, -2.0, 0])
    scene = vp.Scene(robot, gravity=False, damping=3.0, forces=[vp.JointSpring(4.0), load])
    motion = vp.simulate(scene, [0.0], [0.0], dt=1e-2, steps=2000)
    axis = frame_of(robot, "joint1", np.zeros(1))[1][:, 0]
    np.testing.assert_allclose(motion.q[-1], load.wrench[3:] @ axis / 4.0, atol=1e-6)


def test_a_tool_that_a_spring_holds_in_place_and_turned():
    """Six springs and six dampers at the tool: the arm comes to rest where frame a is as it is to be."""
    robot, tip = vp.load_robot("ur5"), "tool0"
    q = np.array([0.3, -1.2, 1.4, -0.4, 0.5, 0.2])
    goal = frame_of(robot, tip, q)[0]
    R, x = goal.rotation, goal.translation
    forces_ = [
        vp.FrameSpring(tip, x, 2000.0, rotational_stiffness=200.0, rest_rotation=R),
        vp.FrameDamper(tip, x, 400.0, 40.0),
    ]
    scene = vp.Scene(robot, gravity=False, damping=0.0, forces=forces_)
    start = q + 0.2 * np.array([1.0, -1.0, 1.0, 0.5, -1.0, 1.0])
    motion = vp.simulate(scene, start, np.zeros(6), dt=5e-3, steps=800, integrator=vp.Radau(2))
    end, _ = frame_of(robot, tip, motion.q[-1])
    np.testing.assert_allclose(end.translation, x, atol=1e-4)
    np.testing.assert_allclose(end.rotation, R, atol=1e-3)
    assert np.diff(motion.energy).max() <= 1e-9 * motion.energy[0]
