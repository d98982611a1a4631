"""Robots from names, files and models: locked, tied, on bases of their own, with more than their file has."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from mechanisms import arm, joint, link, mimic, random_inertia, random_tree, write_urdf
from oracles import Mechanism, assert_same_jet, placements
from refusals import naming, refused, unnamed

import varpin as vp
from varpin.model import geometry
from varpin.model.names import FIXED_BASE

MOVING = ("revolute", "continuous", "prismatic")


def jet_at(robot: vp.Robot, q, v) -> vp.LagrangianJet:
    return vp.lagrangian_jet(vp.Scene(robot, gravity=(0.7, -1.1, -9.5)), q, v)


def test_only_the_bravo7_is_not_installed():
    missing = set(FIXED_BASE) - set(vp.robot_names())
    assert all(name.startswith("bravo7_") for name in missing)


class TestSources:
    def test_relative_path_and_home(self, tmp_path, monkeypatch):
        arm(tmp_path)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("HOME", str(tmp_path))
        for source in ("made_up.urdf", "./made_up.urdf", Path("made_up.urdf"), "~/made_up.urdf"):
            assert vp.load_robot(source).urdf == tmp_path / "made_up.urdf"

    @pytest.mark.parametrize("name", ["baxter", "kinova"])
    def test_models_with_mimic_joints(self, load, name):
        named = load(name)
        model = pin.buildModelFromUrdf(str(named.urdf), mimic=True)
        q, v = np.random.default_rng(3).uniform(-4.0, 4.0, (2, named.dof))
        robot = vp.load_robot(pin.RobotWrapper(model))
        order = [robot.joint_names.index(joint_name) for joint_name in named.joint_names]
        back = np.argsort(order)
        assert_same_jet(jet_at(named, q, v), jet_at(robot, q[back], v[back]), keep=order)
        assert len(robot.ties) == len(named.ties)

    @pytest.mark.parametrize("frames", [True, False])
    def test_the_robot_keeps_no_hold_of_the_user_s_model(self, load, frames):
        model = pin.buildModelFromUrdf(str(load("xarm7").urdf)) if frames else random_tree(0, branching=False)
        shapes = pin.GeometryModel()
        robot = vp.load_robot(pin.RobotWrapper(model, pin.GeometryModel(), shapes))
        scene = vp.Scene(robot)
        q, v = np.ones(7), np.arange(7.0)
        before = vp.lagrangian_jet(scene, q, v, backend="pinocchio")
        model.armature = np.full(7, 9.0)
        model.inertias[3] = random_inertia(np.random.default_rng(1))
        model.jointPlacements[2] = pin.SE3.Identity()
        shapes.addGeometryObject(pin.GeometryObject("late", 1, pin.SE3.Identity(), pin.hppfcl.Sphere(0.1)))
        assert_same_jet(vp.lagrangian_jet(scene, q, v, backend="pinocchio"), before, rtol=0)
        assert geometry(robot).ngeoms == 0

    @pytest.mark.parametrize("gravity", [(0.0, 0.0, -1.62), (0.0, 0.0, 0.0), (3.0, -9.0, 0.5)])
    def test_gravity_of_a_model_is_the_scene_s_unless_given(self, load, caplog, gravity):
        model = random_tree(0, branching=False)
        model.gravity = pin.Motion(np.array(gravity), np.zeros(3))
        q = np.ones(7)
        wrapped = pin.RobotWrapper(model)
        for robot in (vp.load_robot(model), vp.load_robot(model, base=np.eye(4)), vp.load_robot(wrapped)):
            held = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), robot.configuration(q))
            assert vp.Scene(robot).gravity.tolist() == list(gravity)
            np.testing.assert_allclose(vp.Scene(robot).holding_torque(q), held, rtol=0, atol=1e-12)
        for backend in ("compiled", "pinocchio"):
            jet = vp.lagrangian_jet(vp.Scene(robot, gravity=False), q, np.zeros(7), backend=backend)
            assert np.abs(jet.Lq).max() == 0.0
        vp.combine(robot, load("xarm7"))
        assert naming(caplog.messages, "gravity", f"'{robot.name}'")
        for kept in (vp.load_robot(model, lock={model.names[1]: 0.1}), vp.combine(robot, robot)):
            assert vp.Scene(kept).gravity.tolist() == list(gravity)

    def test_joints_added_out_of_order_are_reordered(self, caplog):
        # Pinocchio computes another mass matrix, without a word, unless every subtree is contiguous.
        rng = np.random.default_rng(5)
        model = pin.Model()
        parents = {"left": 0, "right": 0, "left_tip": 1, "right_tip": 2}
        for name, parent in parents.items():
            k = model.addJoint(parent, pin.JointModelRY(), pin.SE3.Random(), name)
            model.appendBodyToJoint(k, random_inertia(rng), pin.SE3.Identity())
        shapes = pin.GeometryModel()
        for k, name in enumerate(parents):
            shapes.addGeometryObject(pin.GeometryObject(name, k + 1, pin.SE3.Identity(), pin.hppfcl.Sphere(0.1)))
        robot = vp.load_robot(pin.RobotWrapper(model, shapes, shapes))
        assert robot.joint_names == ("left", "left_tip", "right", "right_tip")
        assert naming(caplog.messages, "left, left_tip, right, right_tip")
        assert [robot.model.names[shape.parentJoint] for shape in geometry(robot).geometryObjects] == list(parents)
        q, v = rng.normal(size=(2, 4))
        scene = vp.Scene(robot)
        at, data = [0, 2, 1, 3], model.createData()
        expected = pin.computeKineticEnergy(model, data, q[at], v[at]) - pin.computePotentialEnergy(model, data, q[at])
        for backend in ("compiled", "pinocchio"):
            assert pytest.approx(expected, rel=1e-13) == vp.lagrangian_jet(scene, q, v, backend=backend).L


def test_keeping_locks_all_other_joints_where_they_may_be(load):
    whole = load("panda")
    robot = vp.load_robot("panda", keep=["panda_joint2", "panda_joint7"], lock={"panda_joint5": 0.3})
    assert robot.joint_names == ("panda_joint2", "panda_joint7")
    nearest = dict(zip(whole.joint_names, np.clip(0.0, *whole.position_limits), strict=True)) | {"panda_joint5": 0.3}
    for name, at in robot.locked.items():
        assert at == pytest.approx(nearest.get(name, 0.0))
    same = vp.load_robot("panda", lock={k: v for k, v in nearest.items() if k not in robot.joint_names})
    assert_same_jet(jet_at(robot, [0.1, 0.2], [1.0, 2.0]), jet_at(same, [0.1, 0.2], [1.0, 2.0]), rtol=0)


def test_followers_are_kept_and_locked_with_their_leader():
    robot = vp.load_robot("panda", keep=["panda_finger_joint1"])
    assert robot.joint_names == ("panda_finger_joint1",)
    assert len(robot.ties) == 1
    robot = vp.load_robot("panda", lock={"panda_finger_joint1": 0.03})
    assert dict(robot.locked) == {"panda_finger_joint1": 0.03, "panda_finger_joint2": 0.03}
    assert robot.ties == ()


class TestLocking:
    @pytest.mark.parametrize(
        ("name", "lock"),
        [
            ("ur5", {"wrist_3_joint": -2.0, "shoulder_pan_joint": 1.1}),
            ("kinova", {"j2s6s200_joint_4": 7.9, "j2s6s200_joint_2": 3.0}),
            ("panda", {"panda_finger_joint1": 0.03}),
            ("tiago_pro", {"torso_lift_joint": 0.2, "gripper_left_finger_joint": 0.3}),
        ],
    )
    def test_is_the_unlocked_robot_held_there(self, load, name, lock):
        whole = load(name)
        robot = vp.load_robot(name, lock=lock)
        keep = [c for c, joint_name in enumerate(whole.joint_names) if joint_name not in lock]
        assert robot.joint_names == tuple(whole.joint_names[c] for c in keep)
        assert lock.items() <= robot.locked.items()
        rng = np.random.default_rng(0)
        q, v = rng.uniform(-1.0, 1.0, (2, whole.dof))
        for joint_name, position in lock.items():
            q[whole.coordinate(joint_name)], v[whole.coordinate(joint_name)] = position, 0.0
        locked, unlocked = jet_at(robot, q[keep], v[keep]), jet_at(whole, q, v)
        assert_same_jet(locked, unlocked, keep)
        for frame in list(robot.model.frames)[1:]:
            (mine,), (its,) = placements(robot, q[None, keep], frame.name), placements(whole, q[None], frame.name)
            np.testing.assert_allclose(mine.homogeneous, its.homogeneous, rtol=0, atol=1e-13, err_msg=frame.name)
        elsewhere = q.copy()
        elsewhere[keep] = rng.uniform(-1.0, 1.0, len(keep))
        # What hangs on the world for good adds a constant to the potential energy.
        shift = jet_at(robot, elsewhere[keep], v[keep]).L - jet_at(whole, elsewhere, v).L
        assert pytest.approx(shift, abs=1e-11) == locked.L - unlocked.L

    @pytest.mark.parametrize("lock", [{}, {"wrist_roll": 0.2}, {"gripper": 0.3}])
    def test_a_link_keeps_the_name_that_a_joint_elsewhere_has_too(self, tmp_path, lock):
        robot = vp.load_robot("so100", lock=lock)
        model = vp.load_robot("so100").model
        q = np.array([lock.get(name, 0.3) for name in list(model.names)[1:]])
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        link = data.oMf[model.getFrameId("gripper", pin.FrameType.BODY)].translation
        assert np.abs(link - data.oMf[model.getFrameId("gripper", pin.FrameType.JOINT)].translation).max() > 0.02
        own = np.full(robot.dof, 0.3)
        np.testing.assert_allclose(robot.frame_positions(own, "gripper"), link, atol=1e-14)
        kinds = sorted(str(frame.type) for frame in robot.model.frames if frame.name == "gripper")
        assert kinds == sorted(["BODY", "FIXED_JOINT" if "gripper" in lock else "JOINT"])
        vp.replay(robot, own[None], dt=0.1, marks=vp.Marks(trace="gripper"), html=tmp_path / "gripper.html")


HALF = pin.Quaternion(np.array([0.1, 0.2, 0.3, 0.9])).normalized().coeffs()


@pytest.mark.parametrize(
    ("kind", "position"),
    [
        (pin.JointModelFreeFlyer(), [0.1, 0.2, 0.3, *HALF]),
        (pin.JointModelSpherical(), HALF),
        (pin.JointModelPlanar(), [0.4, 0.5, np.cos(0.6), np.sin(0.6)]),
        (pin.JointModelHX(0.2), 1.3),
        (pin.JointModelTranslation(), [1.0, 2.0, 3.0]),
    ],
    ids=lambda value: value.shortname() if hasattr(value, "shortname") else "",
)
def test_the_advice_against_an_unsupported_joint_works(kind, position):
    rng, model, joint = np.random.default_rng(3), pin.Model(), 0
    for name, each, x in (("root", kind, np.zeros(3)), ("elbow", pin.JointModelRY(), np.array([0.1, 0.2, 0.3]))):
        joint = model.addJoint(joint, each, pin.SE3(np.eye(3), x), name)
        model.appendBodyToJoint(joint, random_inertia(rng), pin.SE3.Identity())
    with refused(vp.UnsupportedJoint, "'root'", kind.shortname(), "lock={'root': "):
        vp.load_robot(model)
    robot = vp.load_robot(model, lock={"root": position})
    assert robot.joint_names == ("elbow",)
    q, data = np.append(position, 0.0), model.createData()
    for q[-1] in (0.3, -1.2):
        jet = vp.lagrangian_jet(vp.Scene(robot), q[-1:], [0.0])
        assert -jet.Lq[0] == pytest.approx(pin.computeGeneralizedGravity(model, data, q)[-1], rel=1e-12)
        assert jet.Lvv[0, 0] == pytest.approx(pin.crba(model, data, q)[-1, -1], rel=1e-12)
    if model.nq == 8:
        for wrong, facts in (([0, 0, 0, 0, 0, 0, 2], "1"), (np.zeros(7), "1"), (0.0, ("7", "(1,)"))):
            with refused(vp.InputError, "lock['root']", facts):
                vp.load_robot(model, lock={"root": wrong})


def tree(folder, *joints, axis="0 1 0"):
    """The file of joints in words (name, parent, child, kind), each with what it follows."""
    parts = [link(words.split()[2]) + joint(*words.split(), axis=axis, inside=inside) for words, inside in joints]
    return write_urdf(folder, *parts)


def check(robot, place):
    """The Lagrangian with each joint at its (position, rate), worked out by hand, and M as Pinocchio's model has it."""
    positions, rates = np.array([place[name] for name in list(robot.model.names)[1:]]).T
    q, v = np.array([place[name] for name in robot.joint_names]).T
    model, data, kinds = robot.model, robot.model.createData(), list(robot.model.joints)[1:]
    turned = [[x] if kind.nq == 1 else [np.cos(x), np.sin(x)] for kind, x in zip(kinds, positions, strict=True)]
    kinetic = pin.computeKineticEnergy(model, data, np.concatenate(turned), rates)
    potential = pin.computePotentialEnergy(model, data, np.concatenate(turned))
    for backend in ("compiled", "pinocchio"):
        jet = vp.lagrangian_jet(vp.Scene(robot), q, v, backend=backend)
        assert pytest.approx(kinetic - potential, rel=1e-12) == jet.L, backend
    M = Mechanism(vp.Scene(robot)).mass_matrix(q)
    np.testing.assert_allclose(jet.Lvv, M, rtol=0, atol=1e-12 * np.abs(M).max())


@pytest.mark.parametrize("q", [0.7, 3.9, -12.0])
@pytest.mark.parametrize("axis", ["0 0 1", "0.6 0 0.8"])
@pytest.mark.parametrize("follower", MOVING)
@pytest.mark.parametrize("leader", MOVING)
def test_ties_joints_of_every_kind_however_far_they_turn(tmp_path, leader, follower, axis, q):
    joints = (f"j1 base a {leader}", ""), (f"j2 a b {follower}", mimic("j1", 2.5, 0.3))
    robot = vp.load_robot(tree(tmp_path, *joints, axis=axis))
    assert robot.joint_names == ("j1",)
    check(robot, {"j1": (q, 0.6), "j2": (2.5 * q + 0.3, 1.5)})


@pytest.mark.parametrize(
    ("joints", "place"),
    [
        ((("j1 base a", ""), ("j2 a b", mimic("j1", 0, 0.3))), {"j1": (0.5, 2.0), "j2": (0.3, 0.0)}),
        # A chain of followers ends at the free joint.
        (
            (("j1 base a", ""), ("j2 a b", mimic("j1", 2, 0.5)), ("j3 b c", mimic("j2", -3, 0.25))),
            {"j1": (0.3, 1.0), "j2": (1.1, 2.0), "j3": (-3.05, -6.0)},
        ),
        # A follower carries its leader.
        ((("j1 base a", mimic("j2", 2)), ("j2 a b", "")), {"j1": (0.6, 1.0), "j2": (0.3, 0.5)}),
    ],
    ids=["ratio zero", "chain", "carried"],
)
def test_ties_in_any_order(tmp_path, joints, place):
    path = tree(tmp_path, *joints)
    check(vp.load_robot(path), place)
    free = vp.load_robot(path, mimic="free")
    assert free.dof == len(place)
    check(free, place)


def test_a_model_s_ratio_of_zero_is_refused(tmp_path):
    path = tree(tmp_path, ("j1 base a", ""), ("j2 a b", mimic("j1", 0, 0.3)))
    with refused(vp.RobotError, "'j2'", "'j1'", "multiplier", "0"):
        vp.load_robot(pin.buildModelFromUrdf(str(path), mimic=True))


def test_a_leader_in_a_later_branch(tmp_path):
    # Pinocchio orders siblings by name, so the leader comes last.
    joints = ("j_a base a", mimic("j_d", -2.0, 0.1)), ("j_b a b", ""), ("j_c base c", ""), ("j_d c d", "")
    path = tree(tmp_path, *joints)
    robot = vp.load_robot(path)
    assert robot.joint_names == ("j_b", "j_c", "j_d")
    check(robot, {"j_c": (0.2, 1.0), "j_d": (0.4, 2.0), "j_b": (0.6, 3.0), "j_a": (-0.7, -4.0)})
    assert robot.velocity_limit.tolist() == [8.0, 8.0, 4.0]
    assert np.ravel(robot.position_limits) == pytest.approx([-1.0, -1.0, -0.45, 1.0, 1.0, 0.55])
    locked = vp.load_robot(path, lock={"j_b": 0.6})
    assert_same_jet(jet_at(locked, [0.2, 0.4], [1.0, 2.0]), jet_at(robot, [0.6, 0.2, 0.4], [0.0, 1.0, 2.0]), [1, 2])
    assert locked.velocity_limit.tolist() == [8.0, 4.0]


@pytest.mark.parametrize(
    ("ratio", "offset", "limits", "speed", "effort"),
    [(1, 0, (-0.5, 0.4), 2.0, 3.0), (-2, 0, (-0.2, 0.25), 1.0, 6.0), (0.5, 0.1, (-1.0, 0.6), 4.0, 1.5)],
)
def test_limits_of_followers_are_limits_of_their_leader(tmp_path, ratio, offset, limits, speed, effort):
    tight = joint("j2", "a", "b", inside=mimic("j1", ratio, offset))
    for usual, own in (("9", "3"), ("8", "2"), ("-1", "-0.5"), ("1", "0.4")):
        tight = tight.replace(f'="{usual}"', f'="{own}"', 1)
    path = write_urdf(tmp_path, link("a"), link("b"), joint("j1", "base", "a"), tight)
    robot = vp.load_robot(path)
    assert (*robot.position_limits[0], *robot.position_limits[1]) == pytest.approx(limits)
    assert (*robot.velocity_limit, *robot.effort_limit) == pytest.approx((speed, effort))
    q = np.linspace(*limits, 5)[:, None]
    follower = robot.configuration(q)[:, robot.model.getJointId("j2") - 1]
    assert (follower >= -0.5 - 1e-12).all()
    assert (follower <= 0.4 + 1e-12).all()
    free = vp.load_robot(path, mimic="free")
    assert free.position_limits[0].tolist() == [-1.0, -0.5]
    assert vp.combine(robot, robot).position_limits[0] == pytest.approx([limits[0]] * 2)


def test_followers_without_room_are_told(tmp_path, caplog):
    path = tree(tmp_path, ("j1 base a", ""), ("j2 a b", mimic("j1", 1, 5)))
    assert vp.load_robot(path).position_limits[0].tolist() == [-1.0]
    assert naming(caplog.messages, "'j2'", "no room")
    assert naming(vp.inspect_robot(path).warnings, "'j2'", "no room")


def test_limits_of_zero_of_a_model_are_limits():
    model = vp.planar_chain(2).model.copy()
    model.lowerPositionLimit[:], model.upperPositionLimit[:] = [0.0, 0.3], [0.5, 0.3]
    np.testing.assert_array_equal(vp.load_robot(model).position_limits, [[0.0, 0.3], [0.5, 0.3]])


@pytest.mark.parametrize("x", [0.0, 0.1])
def test_a_composite_of_one_joint_is_that_joint_unless_displaced(x):
    model, shell = pin.Model(), pin.JointModelComposite(pin.JointModelRY(), pin.SE3(np.eye(3), np.array([x, 0, 0])))
    model.addJoint(0, shell, pin.SE3.Identity(), "shell")
    model.appendBodyToJoint(1, random_inertia(np.random.default_rng(0)), pin.SE3.Identity())
    if x:
        with refused(vp.UnsupportedJoint, "'shell'", "JointModelComposite"):
            vp.load_robot(model)
        return
    scene = vp.Scene(vp.load_robot(model))
    jets = [vp.lagrangian_jet(scene, [0.4], [1.3], backend=name) for name in ("compiled", "pinocchio")]
    assert pytest.approx(jets[1].L, rel=1e-13) == jets[0].L


def test_planar_chain_is_rods_in_the_vertical_plane():
    length, mass = 0.7, 1.4
    scene = vp.Scene(vp.planar_chain(2, length=length, mass=mass))
    q, v = np.array([0.3, 0.5]), np.array([1.2, -0.4])
    angles, rates = np.cumsum(q), np.cumsum(v)
    tips = np.cumsum(length * np.column_stack([np.cos(angles), -np.sin(angles)]), axis=0)
    centers = tips - 0.5 * length * np.column_stack([np.cos(angles), -np.sin(angles)])
    swing = length * rates[:, None] * np.column_stack([-np.sin(angles), -np.cos(angles)])
    speeds = np.cumsum(swing, axis=0) - 0.5 * swing
    kinetic = 0.5 * mass * (speeds**2).sum() + 0.5 * mass * length**2 / 12 * (rates**2).sum()
    potential = mass * 9.81 * centers[:, 1].sum()
    assert pytest.approx(kinetic - potential, rel=1e-14) == vp.lagrangian_jet(scene, q, v).L
    assert scene.robot.end_effector == "tip"
    np.testing.assert_allclose(scene.robot.frame_positions(q), [tips[-1, 0], 0.0, tips[-1, 1]], atol=1e-14)


def test_the_end_effector_is_no_camera_and_no_finger(tmp_path):
    frames = (("camera", "0.05 0 0.3"), ("flange", "0 0 0.1"), ("zoom", "0 0.03 0.2"))
    plates = [
        f'<joint name="{name}_joint" type="fixed"><origin xyz="{at}"/><parent link="b"/><child link="{name}"/></joint>'
        f'<link name="{name}"/>'
        for name, at in frames
    ]
    parts = [link("a"), link("b"), joint("shoulder", "base", "a"), joint("wrist", "a", "b", axis="0 0 1"), *plates]
    assert vp.load_robot(write_urdf(tmp_path, *parts)).end_effector == "flange"
    tools = {
        "kinova": "j2s6s200_end_effector",
        "ur5": "tool0",
        "xarm7": "link_eef",
        "finger_edu": "finger_tip_link",
        "asr_twodof": "Tip",
        "panda": "panda_hand_tcp",
        "tiago": "hand_tool_link",
        "z1": "gripperStator",
        "so100": "gripper",
        "so101": "gripper_frame_link",
        "talos_arm": "wrist_left_ft_tool_link",
        # Of two arms, and of a hand alone, no joint is the last.
        "baxter": "r_gripper_r_finger_tip",
        "allegro_left_hand": "link_11.0_tip",
    }
    assert {name: vp.load_robot(name).end_effector for name in tools} == tools
    assert vp.load_robot("panda", lock={"panda_finger_joint1": 0.0}).end_effector == "panda_hand_tcp"


def test_positions_of_frames(load):
    """Where they are, MuJoCo says elsewhere."""
    panda, q = load("panda"), np.random.default_rng(0).normal(size=(2, 8))
    one = panda.frame_positions(q[0], "panda_hand")
    np.testing.assert_array_equal(one, panda.frame_positions(q, "panda_hand")[0])
    with refused(vp.InputError, "q", "(..., 8)", "(2,)"):
        panda.frame_positions(np.zeros(2))
    assert panda.frame_positions(np.zeros((2, 0, 8)), "panda_hand").shape == (2, 0, 3)


# --- bundled robots: the finger by its lengths and density, the gripper by its parallelograms ------------------------


LENGTHS, RADII, DENSITY = (0.0431, 0.0344, 0.0270), (0.010, 0.008, 0.007), 1104.0
# Of right joints when the right crank turns, and of left ones: a finger turns back by what its link turns.
TURNS = {"crank": 1.0, "link": 1.0, "finger": -1.0}


def test_the_finger_is_uniform_cylinders_in_a_row():
    finger = vp.load_robot("finger")
    assert finger.joint_names == ("mcp", "pip", "dip")
    for L, R, body in zip(LENGTHS, RADII, list(finger.model.inertias)[1:], strict=True):
        mass = DENSITY * np.pi * R**2 * L
        across, along = mass * (3.0 * R**2 + L**2) / 12.0, mass * R**2 / 2.0
        np.testing.assert_allclose(body.mass, mass, rtol=1e-14)
        np.testing.assert_allclose(body.lever, [L / 2.0, 0.0, 0.0], rtol=1e-14)
        np.testing.assert_allclose(body.inertia, np.diag([along, across, across]), rtol=1e-13, atol=1e-30)
    for frame, x in (("mcp", 0.0), ("pip", LENGTHS[0]), ("dip", sum(LENGTHS[:2])), ("tip", sum(LENGTHS))):
        np.testing.assert_allclose(finger.frame_positions(np.zeros(3), frame), [x, 0.0, 0.0], rtol=1e-14)


def pads(robot, q):
    """Where the pads are, the right one first."""
    return np.array([robot.frame_positions(q, f"{side}_pad") for side in ("right", "left")])


def test_the_loops_of_the_gripper_are_closed_wherever_the_crank_is():
    task = vp.load_scene("gripper_closes")
    way = np.array([TURNS[name.split("_")[1]] for name in task.robot.joint_names])
    crank = task.robot.coordinate("right_crank")
    for angle in (0.0, 0.3, 0.8):
        g, C = task.scene.constraint_values(angle * way)
        assert np.abs(g).max() < 1e-15
        np.testing.assert_allclose(C @ way, 0.0, atol=1e-15)
        assert np.linalg.matrix_rank(C) == 5
        q = vp.assemble(task.scene, angle * way + 0.01)
        np.testing.assert_allclose(q, way * way[0] * q[crank], atol=1e-12)
    right, left = pads(task.robot, np.zeros(6))
    np.testing.assert_allclose(right * [-1.0, 1.0, 1.0], left, atol=1e-15)
    assert right[0] - left[0] == pytest.approx(0.0854, abs=1e-12)
    plan = task.solve()
    assert plan.status.converged
    right, left = pads(task.robot, plan.trajectory.q[-1])
    assert right[0] - left[0] == pytest.approx(0.04, abs=1e-6)
    assert abs(plan.verify().closed_loop_loss) < 1e-6


def test_a_gripper_whose_loops_are_open_says_so(caplog):
    robot = vp.load_robot("gripper")
    assert robot.loops == (("right_crank_pin", "right_finger_pin"), ("left_crank_pin", "left_finger_pin"))
    assert not unnamed(repr(robot), "2 loops")
    assert naming(vp.inspect_robot("gripper").warnings, "'left_crank_pin'", "'left_finger_pin'")
    assert not about(caplog.messages, "open loops")
    start = np.zeros(6), np.zeros(6)
    tied = vp.Scene(robot, damping=0.0, constraints=vp.JointTie("left_crank", "right_crank"))
    for _ in range(2):
        motion = vp.simulate(tied, *start, dt=1e-3, steps=3)
        assert naming(about(motion.warnings, "open loops"), "'right_crank_pin'", "'right_finger_pin'")
        assert len(about(caplog.messages, "open loops")) == 1
    one = vp.Scene(robot, damping=0.0, constraints=vp.PointOnPoint("right_crank_pin", "right_finger_pin", axes="xz"))
    assert not about(vp.simulate(one, *start, dt=1e-3, steps=3).warnings, "open loops")
    assert not vp.load_scene("gripper_closes").scene.open_loops


def test_loops_of_a_file_that_says_too_little_are_none(tmp_path):
    text = vp.load_robot("gripper").urdf.read_text()
    for whole, part in (('<link2 link="left_finger_pin"/>', ""), ('<link1 link="right_crank_pin"/>', "<link1/>")):
        text = text.replace(whole, part)
    path = tmp_path / "gripper.urdf"
    path.write_text(text)
    assert vp.load_robot(path).loops == ()


# --- what is added to a description: bases, rotors, inertias of shapes; what a scene takes of it ---------------------


PLACE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.5, 1.1), np.array([0.4, -2.0, 0.7]))
RNG = np.random.default_rng(5)


def jet(robot, q, **scene):
    return vp.lagrangian_jet(vp.Scene(robot, **scene), q, np.zeros(robot.dof))


@pytest.mark.parametrize("base", [PLACE, PLACE.homogeneous, PLACE.homogeneous.tolist()], ids=["SE3", "array", "list"])
def test_frames_gravity_and_shapes_turn_with_the_base(load, base):
    there, here = vp.load_robot("ur5", base=base), load("ur5")
    q = RNG.normal(size=6)
    np.testing.assert_allclose(there.frame_positions(q), PLACE.act(here.frame_positions(q)), rtol=0, atol=1e-12)
    # What the arm feels is gravity turned the other way.
    own, other = jet(there, q), jet(here, q, gravity=PLACE.rotation.T @ [0.0, 0.0, -9.81])
    for name in ("Lq", "Lvv", "Lqq"):
        np.testing.assert_allclose(getattr(own, name), getattr(other, name), rtol=0, atol=1e-10)
    for a, b in zip(geometry(there).geometryObjects, geometry(here).geometryObjects, strict=True):
        expected = PLACE * b.placement if b.parentJoint == 0 else b.placement
        np.testing.assert_allclose(a.placement.homogeneous, expected.homogeneous, atol=1e-12)


def test_a_planar_base_is_two_sliders_and_a_turn():
    robot = vp.load_robot("ur5", base="planar")
    assert robot.joint_names[:3] == ("base_x", "base_y", "base_turn")
    assert robot.dof == 9
    q = RNG.normal(size=9)
    moved = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, q[2]), np.array([q[0], q[1], 0.0]))
    arm = vp.load_robot("ur5", base=moved)
    np.testing.assert_allclose(robot.frame_positions(q), arm.frame_positions(q[3:]), rtol=0, atol=1e-12)
    found, data = jet(robot, q), robot.model.createData()
    M, gravity = Mechanism(vp.Scene(robot)).mass_matrix(q), pin.computeGeneralizedGravity(robot.model, data, q)
    np.testing.assert_allclose(found.Lvv, M, rtol=0, atol=1e-10)
    np.testing.assert_allclose(-found.Lq, gravity, rtol=0, atol=1e-10)
    np.testing.assert_allclose(M[3:, 3:], jet(arm, q[3:]).Lvv, rtol=0, atol=1e-10)


def test_a_planar_base_with_mimic_joints_payload_and_lock(load):
    options = {"lock": {"panda_joint7": 0.8}, "payload": vp.Payload("panda_hand", 1.5)}
    robot, arm = vp.load_robot("panda", base="planar", **options), vp.load_robot("panda", **options)
    assert robot.joint_names == ("base_x", "base_y", "base_turn", *arm.joint_names)
    assert len(robot.ties) == len(arm.ties)
    q = RNG.normal(size=arm.dof) * 0.01
    own = jet(robot, np.concatenate([np.zeros(3), q]))
    np.testing.assert_allclose(own.Lvv[3:, 3:], jet(arm, q).Lvv, rtol=0, atol=1e-10)
    held = vp.load_robot("panda", base="planar", lock={"base_x": 0.5, "base_y": 0.0, "base_turn": 0.2})
    assert held.dof == load("panda").dof


@pytest.mark.parametrize(
    ("armature", "added"),
    [(0.2, np.full(6, 0.2)), ({"elbow_joint": 0.3}, 0.3 * np.eye(6)[2]), (np.arange(6.0), np.arange(6.0))],
)
def test_armature_adds_to_the_diagonal(load, armature, added):
    robot, q = vp.load_robot("ur5", armature=armature), RNG.normal(size=6)
    own = jet(robot, q).Lvv
    np.testing.assert_allclose(own, jet(load("ur5"), q).Lvv + np.diag(added), rtol=0, atol=1e-12)
    np.testing.assert_allclose(Mechanism(vp.Scene(robot)).mass_matrix(q), own, rtol=0, atol=1e-10)
    with refused(vp.InputError, "armature", "'elbow_joint'", "-1"):
        vp.load_robot("ur5", armature=np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0]))


SHAPES = """
<visual><origin xyz="0.5 0 0" rpy="0 0 0.3"/><geometry><box size="1 0.1 0.2"/></geometry></visual>
<visual><origin xyz="1 0 0"/><geometry><sphere radius="0.2"/></geometry></visual>"""


def test_links_without_an_inertia_have_that_of_their_shapes(tmp_path):
    parts = [link("a", extra=SHAPES), link("b", "", SHAPES), joint("j1", "base", "a"), joint("j2", "a", "b")]
    robot = vp.load_robot(write_urdf(tmp_path, *parts), inertia="meshes", density=500.0)
    box = pin.Inertia(10.0, np.zeros(3), 10.0 / 12.0 * np.diag([0.05, 1.04, 1.01]))
    ball = 500.0 * 4.0 / 3.0 * np.pi * 0.2**3
    expected = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, 0.3), np.array([0.5, 0.0, 0.0])).act(box)
    expected += pin.Inertia(ball, np.array([1.0, 0.0, 0.0]), 0.4 * ball * 0.04 * np.eye(3))
    np.testing.assert_allclose(robot.model.inertias[2].matrix(), expected.matrix(), rtol=0, atol=2e-6)
    assert robot.model.inertias[1].mass == 1.3


@pytest.fixture
def rubbing(tmp_path):
    """Two joints and one that follows the second at twice its speed, with dampers and dry friction."""
    given = {"j1": (0.3, 0.0), "j2": (0.5, 0.1), "j3": (0.25, 0.2)}
    inside = {name: f'<dynamics damping="{d}" friction="{f}"/>' for name, (d, f) in given.items()}
    inside["j3"] += mimic("j2", ratio=-2)
    ends = {"j1": ("base", "l1"), "j2": ("l1", "l2"), "j3": ("l2", "l3")}
    parts = [link(child) + joint(name, parent, child, inside=inside[name]) for name, (parent, child) in ends.items()]
    return vp.load_robot(write_urdf(tmp_path, *parts))


def left_out(caplog):
    return about(caplog.messages, "left out of the description")


def test_a_scene_that_leaves_dampers_out_says_so_once(rubbing, caplog):
    scene = vp.Scene(rubbing)
    for _ in range(2):
        vp.simulate(scene, [0, 0], [0, 0], dt=1e-3, steps=3)
    for sentence, name in zip(left_out(caplog), ("damping", "friction"), strict=True):
        assert not unnamed(sentence, f"{name}='robot'", f"{name}=0")
    assert not scene.damping.any()
    caplog.clear()
    vp.Scene(vp.load_robot("ur5"))
    assert not left_out(caplog)
    with refused(vp.InputError, "damping", "'robot'"):
        vp.Scene(rubbing, damping="urdf")


def test_the_description_s_dampers_take_what_pinocchio_s_model_says(rubbing, caplog):
    """Power of the dampers of all joints of the free model, followers too, at a velocity of the coordinates."""
    scene = vp.Scene(rubbing, damping="robot")
    (sentence,) = left_out(caplog)
    assert "friction='robot'" in sentence
    v = np.array([0.7, -1.3])
    free, model = rubbing.velocity(v), rubbing.model
    assert scene.damping @ v**2 == pytest.approx(np.asarray(model.damping) @ free**2, rel=1e-14)
    assert rubbing.friction @ np.abs(v) == pytest.approx(np.asarray(model.friction) @ np.abs(free), rel=1e-14)
    # And it is what forces of that size do in the equations of motion.
    given = vp.Scene(rubbing, damping=[0.3, 0.5 + 4 * 0.25])
    ends = [vp.simulate(each, [0.1, 0.2], v, dt=1e-3, steps=20).q for each in (scene, given)]
    np.testing.assert_array_equal(*ends)


def loaded(folder, head, base):
    path = folder / "scene.toml"
    robot = f'[robot]\nsource = "xarm7"\nbase = {base}\narmature = {{ joint3 = 0.4 }}'
    path.write_text(f"{head}\n{robot}\n[horizon]\ndt = 1e-3\nsteps = 3\n")
    return vp.load_scene(path, required_only=False).scene


def test_scene_files_take_them(tmp_path, caplog):
    own = [10.0, 10.0, 5.0, 5.0, 5.0, 2.0, 2.0]
    # The robot's file gives dry friction, too, which is told of wherever the rest is taken.
    for head, damping, told in (("", [0.0] * 7, 2), ('damping = "robot"', own, 1), ("damping = 0.0", [0.0] * 7, 0)):
        caplog.clear()
        scene = loaded(tmp_path, head, '"planar"')
        assert (scene.damping[3:].tolist(), len(left_out(caplog))) == (damping, told)
    assert scene.robot.joint_names[:3] == ("base_x", "base_y", "base_turn")
    robot = loaded(tmp_path, "", "{ xyz = [0.0, 0.0, 2.0], rpy = [0.0, 0.5, 0.3] }").robot
    assert robot.tree.armature[robot.joint_names.index("joint3")] == 0.4
    place = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.5, 0.3), np.array([0.0, 0.0, 2.0]))
    other, q = vp.load_robot("xarm7", base=place), np.zeros(7)
    np.testing.assert_allclose(robot.frame_positions(q), other.frame_positions(q), atol=1e-12)
    with refused(vp.SceneFileError, "robot.base"):
        loaded(tmp_path, "", '"round"')
    with refused(vp.SceneFileError, "'urdf'", "robot"):
        loaded(tmp_path, 'damping = "urdf"', '"planar"')
