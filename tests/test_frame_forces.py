"""Forces on frames and between them: against kinematics written out body by body, and closed forms."""

import pickle

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from naive import gradient, joint_axis, rotation
from refusals import refused
from test_groups import forest

import varpin as vp

# Tip and a frame before it, or on another branch.
ROBOTS = {
    "chain": (lambda: vp.planar_chain(3), "joint3", "joint1"),
    "finger": (lambda: vp.load_robot("finger"), "dip", "mcp"),
    "ur5": (lambda: vp.load_robot("ur5"), "tool0", "forearm_link"),
    "panda": (lambda: vp.load_robot("panda"), "panda_leftfinger", "panda_rightfinger"),
    "forest": (lambda: forest(0, 2), "0.2", "2.3"),
}


# A rotation about no axis of any frame.
TURNED = pin.rpy.rpyToMatrix(0.4, -0.7, 1.1)


def robot_of(name):
    make, tip, other = ROBOTS[name]
    return make(), tip, other


def placed(robot, frame, q):
    """Rotation (..., 3, 3) and place (..., 3) of a frame at complex q (..., n), body by body."""
    model, names = robot.free_model, list(robot.joint_names)
    ties = {tie.follower: tie for tie in robot.ties}
    found = model.frames[model.getFrameId(frame)]
    R, x = np.eye(3), np.zeros(3)
    for joint in list(model.supports[found.parentJoint])[1:]:
        tie = ties.get(joint)
        c = names.index(model.names[tie.leader if tie else joint])
        s = q[..., c] * (tie.ratio if tie else 1.0) + (tie.offset if tie else 0.0)
        placement = model.jointPlacements[joint]
        prismatic, axis = joint_axis(model, joint)
        x, R = x + R @ placement.translation, R @ placement.rotation
        if prismatic:
            x = x + (R @ axis) * s[..., None]
        else:
            R = R @ rotation(axis, s)
    return R @ found.placement.rotation, x + R @ found.placement.translation


def spins(robot, frame, q):
    """Angular velocity (3, n) that each coordinate gives to a frame, of dR/dq R'."""
    R = placed(robot, frame, q)[0]
    dR = np.stack([gradient(lambda y, i=i: placed(robot, frame, y)[0].reshape(*y.shape[:-1], 9)[..., i], q)
                   for i in range(9)]).reshape(3, 3, -1)  # fmt: skip
    turn = np.einsum("ikc,jk->ijc", dR, R)
    return np.stack([turn[2, 1], turn[0, 2], turn[1, 0]])


def turns(robot, at, q):
    """Angular velocities (3, n) of an end."""
    if not isinstance(at, str | tuple):
        return np.zeros((3, q.size))
    return spins(robot, at if isinstance(at, str) else at[0], q)


def forces(tip, other, scale=1.0):
    """One of each kind, between bodies, to the world, off the frames' origins."""
    s = scale
    return [
        vp.FrameWrench(tip, s * np.array([3.0, -2.0, 5.0, 0.0, 0.0, 0.0])),
        vp.FrameWrench((other, [0.1, 0.0, -0.2]), s * np.array([1.0, 2.0, -1.0, 0.5, -0.3, 0.8])),
        vp.FrameWrench((tip, [0.0, 0.1, 0.0]), s * np.array([1.0, -2.0, 0.5, 0.2, 0.4, -0.3]), axes="frame"),
        vp.FrameSpring(tip, (other, [0.05, 0.1, 0.0]), 8.0 * s),
        vp.FrameSpring((tip, [0.0, 0.0, 0.1]), [0.4, 0.3, 0.2], s * np.array([5.0, 0.0, 9.0]), [0.1, 0.0, -0.2]),
        vp.FrameSpring([1.2, -0.9, 1.1], other, 6.0 * s, 0.7),
        vp.FrameDamper(tip, other, 0.6 * s),
        vp.FrameDamper((other, [0.1, 0.0, 0.0]), [0.0, 0.0, 0.0], s * np.array([0.3, 0.0, 0.5])),
        vp.FrameSpring(tip, other, 3.0 * s, rotational_stiffness=2.0 * s),
        vp.FrameSpring(
            [0.3, 0.2, 0.1], tip, 0.0, rotational_stiffness=s * np.array([1.0, 5.0, 0.5]), rest_rotation=TURNED
        ),
        vp.FrameSpring((tip, [0.0, 0.1, 0.0]), [0.0, 0.1, 0.2], s, rotational_stiffness=s * np.array([2.0, 2.5, 3.0])),
        vp.FrameDamper(tip, other, 0.2 * s, 0.4 * s),
        vp.FrameDamper([0.0, 0.0, 0.0], tip, 0.0, s * np.array([0.3, 0.1, 0.5])),
    ]


def state(robot):
    rng = np.random.default_rng(3)
    return rng.normal(size=robot.dof), rng.normal(size=robot.dof)


def test_a_wrench_is_what_pinocchio_makes_of_it():
    robot, tip, _ = robot_of("ur5")
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
    robot, tip, other = robot_of("forest")
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


def test_a_hanging_spring_finds_its_rest():
    """A slider on a spring with a length: where stiffness and weight are even."""
    robot = vp.planar_chain(1)
    load = vp.FrameWrench("joint1", [0, 0, 0, 0, -2.0, 0])
    scene = vp.Scene(robot, gravity=False, damping=3.0, forces=[vp.JointSpring(4.0), load])
    motion = vp.simulate(scene, [0.0], [0.0], dt=1e-2, steps=2000)
    axis = spins(robot, "joint1", np.zeros(1))[:, 0]
    np.testing.assert_allclose(motion.q[-1], load.wrench[3:] @ axis / 4.0, atol=1e-6)


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


def test_scenes_with_frame_forces_travel_and_are_told_apart(tmp_path):
    robot, tip, other = robot_of("ur5")
    scene = vp.Scene(robot, damping=0.1, forces=forces(tip, other))
    back = pickle.loads(pickle.dumps(scene))
    assert back.couplings == scene.couplings
    assert repr(back.forces) == repr(scene.forces)
    assert "FrameSpring(a='tool0', b=('forearm_link', [0.05, 0.1, 0.0]), stiffness=8.0, rest=0.0)" in repr(scene.forces)
    assert "FrameWrench, FrameSpring, FrameDamper" in repr(scene)
    assert "FrameSpring" in scene._repr_html_()
    motions = [vp.simulate(own, np.zeros(6), np.ones(6), dt=1e-3, steps=20) for own in (scene, back)]
    assert motions[0].q.tobytes() == motions[1].q.tobytes()
    motions[0].save(tmp_path / "motion.npz")
    loaded = vp.Trajectory.load(tmp_path / "motion.npz")
    np.testing.assert_array_equal(loaded.scene_values["FrameDamper"], scene.values["FrameDamper"])
    bare = vp.Scene(robot, damping=0.1)
    with refused(vp.InputError, "FrameLoad", "none in the scene"):
        vp.linearize(bare, loaded)
    with refused(vp.InputError, "FrameLoad", "none in the motion"):
        vp.linearize(scene, vp.simulate(bare, np.zeros(6), np.ones(6), dt=1e-3, steps=5))
    assert not [name for name in bare.values if name.startswith("Frame")]


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: vp.FrameWrench("base_link", np.ones(6)), "'base_link'"),
        (lambda: vp.FrameWrench("tool0", np.ones(3)), ("wrench", "(6,)")),
        (lambda: vp.FrameWrench("tool0", [np.nan] * 6), "wrench"),
        (lambda: vp.FrameWrench("tool0", np.ones(6), "local"), ("axes", "'world'", "'frame'", "'local'")),
        (lambda: vp.FrameSpring("tool0", [0, 0], 1.0), ("b", "(2,)")),
        (lambda: vp.FrameSpring([0, 0, 0], "base_link", 1.0), ("FrameSpring", "'ur5'")),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], -1.0), ("stiffness", "-1.0")),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, -0.1), ("rest", "-0.1")),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], [1, 1, 1], 0.1), "stiffness"),
        (
            lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, rotational_stiffness=-1.0),
            ("rotational_stiffness", "-1.0"),
        ),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, rest_rotation=np.eye(3)), "rest_rotation"),
        (
            lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, 0.0, 1.0, np.diag([1.0, 1.0, -1.0])),
            "rest_rotation",
        ),
        (
            lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, 0.0, 1.0, 2.0 * np.eye(3)),
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


def test_a_frame_that_the_robot_does_not_have_is_named():
    with refused(vp.UnknownFrame, "'ur5'", "'tool'", "'tool0'"):
        vp.Scene(vp.load_robot("ur5"), forces=vp.FrameWrench("tool", np.ones(6)))


def test_a_place_in_the_world_carries_no_wrench():
    robot = vp.load_robot("ur5")
    with refused(vp.InputError, "frame", "[0.5, 0.0, 0.4]"):
        vp.Scene(robot, forces=vp.FrameWrench([0.5, 0.0, 0.4], np.ones(6)))
    listed, paired = (
        vp.Scene(robot, forces=vp.FrameSpring(kind(("tool0", [0.0, 0.0, 0.1])), [0.5, 0.0, 0.4], 10.0)).couplings
        for kind in (list, tuple)
    )
    assert listed == paired


def test_a_wrench_of_the_frame_keeps_no_energy():
    robot = vp.load_robot("ur5")
    assert vp.Scene(robot, forces=vp.FrameSpring("tool0", [0.5, 0.0, 0.4], 10.0)).conservative
    assert not vp.Scene(robot, forces=vp.FrameWrench("tool0", [1.0, 0, 0, 0, 0, 0], "frame")).conservative


def test_turning_has_a_known_energy_and_moment():
    """One joint that turns frame a about the spring's axis: k (1 - cos angle), and no singularity at half a turn."""
    robot, k, at = vp.planar_chain(1), 3.0, 0.4
    rest = placed(robot, "joint1", np.array([at]))[0]
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
    robot, tip, other = robot_of("ur5")
    q, k = state(robot)[0], np.array([1.0, 5.0, 0.5])
    rest = placed(robot, other, q)[0].T @ placed(robot, tip, q)[0]
    scene = vp.Scene(robot, damping=0.0, forces=vp.FrameSpring(tip, other, 0.0, 0.0, k, rest))
    added = vp.lagrangian_jet(vp.Scene(robot, damping=0.0), q, 0 * q).Lqq - vp.lagrangian_jet(scene, q, 0 * q).Lqq
    W = placed(robot, tip, q)[0].T @ (turns(robot, tip, q) - turns(robot, other, q))
    np.testing.assert_allclose(added, W.T @ (k[:, None] * W), atol=1e-12 * k.max())


def test_a_tool_that_a_spring_holds_in_place_and_turned():
    """Six springs and six dampers at the tool: the arm comes to rest where frame a is as it is to be."""
    robot, tip, _ = robot_of("ur5")
    q = np.array([0.3, -1.2, 1.4, -0.4, 0.5, 0.2])
    R, x = placed(robot, tip, q)
    forces_ = [
        vp.FrameSpring(tip, x, 2000.0, rotational_stiffness=200.0, rest_rotation=R),
        vp.FrameDamper(tip, x, 400.0, 40.0),
    ]
    scene = vp.Scene(robot, gravity=False, damping=0.0, forces=forces_)
    start = q + 0.2 * np.array([1.0, -1.0, 1.0, 0.5, -1.0, 1.0])
    motion = vp.simulate(scene, start, np.zeros(6), dt=5e-3, steps=800, integrator=vp.Radau(2))
    end, place = placed(robot, tip, motion.q[-1])
    np.testing.assert_allclose(place, x, atol=1e-4)
    np.testing.assert_allclose(end, R, atol=1e-3)
    assert np.diff(motion.energy).max() <= 1e-9 * motion.energy[0]
