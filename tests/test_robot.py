from __future__ import annotations

import logging
import xml.etree.ElementTree as ET
from pathlib import Path

import naive
import numpy as np
import pinocchio as pin
import pytest
from mechanisms import arm, joint, link, mimic, random_inertia, random_tree, write_urdf
from refusals import naming, refused

import varpin as vp
from varpin.model import example_robot_data, geometry

MOVING = ("revolute", "continuous", "prismatic")


def configuration(model: pin.Model, positions: np.ndarray) -> np.ndarray:
    q = pin.neutral(model)
    for k in range(model.njoints - 1):
        entry = model.joints[k + 1]
        q[entry.idx_q : entry.idx_q + entry.nq] = (
            positions[k] if entry.nq == 1 else (np.cos(positions[k]), np.sin(positions[k]))
        )
    return q


def full_crba(model: pin.Model, q: np.ndarray) -> np.ndarray:
    M = np.triu(pin.crba(model, model.createData(), q))
    return M + np.triu(M, 1).T


def jet_at(robot: vp.Robot, q, v) -> vp.LagrangianJet:
    return vp.lagrangian_jet(vp.Scene(robot, gravity=(0.7, -1.1, -9.5)), q, v)


def assert_same_jet(a: vp.LagrangianJet, b: vp.LagrangianJet, keep=slice(None), rtol: float = 1e-12) -> None:
    """Jet ``a`` is jet ``b`` on the coordinates ``keep`` of ``b``."""
    for name in ("Lq", "Lv", "Lqq", "Lvq", "Lvv"):
        whole = getattr(b, name)
        part = whole[keep] if whole.ndim == 1 else whole[keep][:, keep]
        np.testing.assert_allclose(getattr(a, name), part, rtol=0, atol=rtol * np.abs(whole).max(), err_msg=name)


def test_only_the_bravo7_is_not_installed():
    missing = set(example_robot_data.FIXED_BASE) - set(vp.robot_names())
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
        for source in (model, pin.RobotWrapper(model)):
            robot = vp.load_robot(source)
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
        for robot in (
            vp.load_robot(model),
            vp.load_robot(model, base=np.eye(4)),
            vp.load_robot(pin.RobotWrapper(model)),
        ):
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
        with caplog.at_level(logging.WARNING):
            robot = vp.load_robot(pin.RobotWrapper(model, shapes, shapes))
        assert robot.joint_names == ("left", "left_tip", "right", "right_tip")
        assert naming(caplog.messages, "left, left_tip, right, right_tip")
        assert [robot.model.names[shape.parentJoint] for shape in geometry(robot).geometryObjects] == list(parents)
        q, v = rng.normal(size=(2, 4))
        scene = vp.Scene(robot)
        expected = naive.lagrangian(scene, q, v)
        for backend in ("compiled", "pinocchio"):
            assert pytest.approx(expected, rel=1e-13) == vp.lagrangian_jet(scene, q, v, backend=backend).L


class TestGeometry:
    def test_is_not_read_at_load(self, tmp_path):
        mesh = '<visual><geometry><mesh filename="package://nowhere/missing.dae"/></geometry></visual>'
        robot = vp.load_robot(write_urdf(tmp_path, link("l1", extra=mesh), joint("j1", "base", "l1")))
        assert robot.dof == 1
        with refused(vp.RobotError, "missing.dae"):
            geometry(robot)

    @pytest.mark.parametrize("lock", [{}, {"joint1": 0.4}, {"joint0": -0.3, "joint5": 1.2}])
    def test_of_a_wrapper_moves_as_in_the_unlocked_model(self, lock):
        model = random_tree(11, branching=False)
        rng = np.random.default_rng(0)
        shapes = pin.GeometryModel()
        for k in range(1, model.njoints):
            placement = pin.SE3(pin.Quaternion(rng.normal(size=4)).normalized().matrix(), rng.normal(size=3))
            shapes.addGeometryObject(pin.GeometryObject(f"shape{k}", k, placement, pin.hppfcl.Sphere(0.1)))
        robot = vp.load_robot(pin.RobotWrapper(model, pin.GeometryModel(), shapes), lock=lock)
        visuals = geometry(robot)
        assert all(shape.parentFrame < robot.model.nframes for shape in visuals.geometryObjects)
        q = rng.uniform(-2.0, 2.0, robot.dof)
        positions = dict(zip(robot.joint_names, q, strict=True)) | lock
        full_q = configuration(model, np.array([positions[name] for name in list(model.names)[1:]]))
        ours, theirs = visuals.createData(), shapes.createData()
        pin.updateGeometryPlacements(robot.model, robot.model.createData(), visuals, ours, robot.configuration(q))
        pin.updateGeometryPlacements(model, model.createData(), shapes, theirs, full_q)
        assert visuals.ngeoms == shapes.ngeoms
        for k, shape in enumerate(shapes.geometryObjects):
            mine = ours.oMg[visuals.getGeometryId(shape.name)]
            assert np.abs(mine.homogeneous - theirs.oMg[k].homogeneous).max() < 1e-12


class TestKeeping:
    def test_locks_all_other_joints_where_they_may_be(self, load):
        whole = load("panda")
        robot = vp.load_robot("panda", keep=["panda_joint2", "panda_joint7"], lock={"panda_joint5": 0.3})
        assert robot.joint_names == ("panda_joint2", "panda_joint7")
        lower, upper = whole.position_limits
        nearest = dict(zip(whole.joint_names, np.clip(0.0, lower, upper), strict=True)) | {"panda_joint5": 0.3}
        for name, at in robot.locked.items():
            assert at == pytest.approx(nearest.get(name, 0.0))
        same = vp.load_robot("panda", lock={k: v for k, v in nearest.items() if k not in robot.joint_names})
        assert_same_jet(jet_at(robot, [0.1, 0.2], [1.0, 2.0]), jet_at(same, [0.1, 0.2], [1.0, 2.0]), rtol=0)

    def test_keeps_followers_with_their_leader(self):
        robot = vp.load_robot("panda", keep=["panda_finger_joint1"])
        assert robot.joint_names == ("panda_finger_joint1",)
        assert len(robot.ties) == 1
        with refused(vp.InputError, "panda_finger_joint2", "panda_finger_joint1"):
            vp.load_robot("panda", keep=["panda_finger_joint2"])

    def test_refuses_names_and_forms(self):
        for keep in ("elbow_joint", {"elbow_joint": 0.0}):
            with refused(vp.InputError, "keep"):
                vp.load_robot("ur5", keep=keep)
        with refused(vp.UnknownJoint, "keep", "'elbow'", "'elbow_joint'"):
            vp.load_robot("ur5", keep=["elbow"])
        with refused(vp.InputError, "'elbow_joint'", "keep", "lock"):
            vp.load_robot("ur5", keep=["elbow_joint"], lock={"elbow_joint": 0.1})
        with refused(vp.RobotError, "no joint that moves"):
            vp.load_robot("ur5", keep=[])


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
        elsewhere = q.copy()
        elsewhere[keep] = rng.uniform(-1.0, 1.0, len(keep))
        # What hangs on the world for good adds a constant to the potential energy.
        shift = locked.L - unlocked.L
        assert (
            pytest.approx(shift, abs=1e-11) == jet_at(robot, elsewhere[keep], v[keep]).L - jet_at(whole, elsewhere, v).L
        )

    def test_is_pinocchio_s_reduced_model(self, load):
        name, held = "kinova", (0, 2)
        whole = load(name)
        at = {whole.joint_names[c]: 0.3 - 0.2 * c for c in held}
        robot, full = vp.load_robot(name, lock=at), whole.model
        q = whole.configuration([at.get(joint_name, 0.0) for joint_name in whole.joint_names])
        expected = pin.buildReducedModel(full, [full.getJointId(joint_name) for joint_name in at], q)
        assert list(robot.model.names) == list(expected.names)
        positions = robot.configuration(np.random.default_rng(1).uniform(-1.0, 1.0, robot.dof))
        ours, theirs = robot.model.createData(), expected.createData()
        for model, data in ((robot.model, ours), (expected, theirs)):
            pin.framesForwardKinematics(model, data, positions)
        for k, frame in enumerate(robot.model.frames):
            other = theirs.oMf[expected.getFrameId(frame.name, frame.type)]
            np.testing.assert_allclose(ours.oMf[k].homogeneous, other.homogeneous, rtol=0, atol=1e-14)
        M, other = full_crba(robot.model, positions), full_crba(expected, positions)
        np.testing.assert_allclose(M, other, rtol=0, atol=1e-13 * np.abs(other).max())

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

    def test_of_a_leader_locks_its_followers(self):
        robot = vp.load_robot("panda", lock={"panda_finger_joint1": 0.03})
        assert dict(robot.locked) == {"panda_finger_joint1": 0.03, "panda_finger_joint2": 0.03}
        assert robot.ties == ()

    @pytest.mark.parametrize(
        ("kind", "position"),
        [
            (
                pin.JointModelFreeFlyer(),
                [0.1, 0.2, 0.3, *pin.Quaternion(np.array([0.1, 0.2, 0.3, 0.9])).normalized().coeffs()],
            ),
            (pin.JointModelSpherical(), pin.Quaternion(np.array([0.5, 0.2, -0.3, 0.9])).normalized().coeffs()),
            (pin.JointModelPlanar(), [0.4, 0.5, np.cos(0.6), np.sin(0.6)]),
            (pin.JointModelHX(0.2), 1.3),
            (pin.JointModelTranslation(), [1.0, 2.0, 3.0]),
        ],
        ids=lambda value: value.shortname() if hasattr(value, "shortname") else "",
    )
    def test_the_advice_against_an_unsupported_joint_works(self, kind, position):
        rng = np.random.default_rng(3)
        model = pin.Model()
        base = model.addJoint(0, kind, pin.SE3.Identity(), "root")
        model.appendBodyToJoint(base, random_inertia(rng), pin.SE3.Identity())
        elbow = model.addJoint(base, pin.JointModelRY(), pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.3])), "elbow")
        model.appendBodyToJoint(elbow, random_inertia(rng), pin.SE3.Identity())
        with refused(vp.UnsupportedJoint, "'root'", kind.shortname(), "lock={'root': "):
            vp.load_robot(model)
        robot = vp.load_robot(model, lock={"root": position})
        assert robot.joint_names == ("elbow",)
        q = pin.neutral(model)
        q[: model.joints[base].nq] = position
        for angle in (0.3, -1.2):
            q[model.joints[elbow].idx_q] = angle
            jet = vp.lagrangian_jet(vp.Scene(robot), [angle], [0.0])
            weight = pin.computeGeneralizedGravity(model, model.createData(), q)[model.joints[elbow].idx_v]
            assert -jet.Lq[0] == pytest.approx(weight, rel=1e-12)
            assert jet.Lvv[0, 0] == pytest.approx(full_crba(model, q)[-1, -1], rel=1e-12)

    def test_takes_no_unnormalized_quaternion(self):
        model = pin.Model()
        base = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
        model.addJoint(base, pin.JointModelRY(), pin.SE3.Identity(), "elbow")
        for quaternion in ([0, 0, 0, 2], [0, 0, 0, 0]):
            with refused(vp.InputError, "lock['root']", "1"):
                vp.load_robot(model, lock={"root": [0, 0, 0, *quaternion]})
        with refused(vp.InputError, "lock['root']", "7", "(1,)"):
            vp.load_robot(model, lock={"root": 0.0})


class TestMimic:
    """Positions of all joints are worked out by hand and given to the naive Lagrangian."""

    @staticmethod
    def expected(robot: vp.Robot, place: dict[str, tuple[float, float]]) -> float:
        """L with each joint at its (position, rate)."""
        model = robot.model
        positions, rates = np.array([place[name] for name in list(model.names)[1:]]).T
        kinetic, potential = naive.energies(model, positions, rates, np.array([0.0, 0.0, -9.81]))
        return float(kinetic - potential)

    def check(self, robot: vp.Robot, q, v, place) -> None:
        expected = self.expected(robot, place)
        for backend in ("compiled", "pinocchio"):
            jet = vp.lagrangian_jet(vp.Scene(robot), q, v, backend=backend)
            assert pytest.approx(expected, rel=1e-12) == jet.L, backend
        G = robot.velocity(np.eye(robot.dof))
        M = G @ full_crba(robot.model, robot.configuration(q)) @ G.T
        np.testing.assert_allclose(jet.Lvv, M, rtol=0, atol=1e-12 * np.abs(M).max())

    @pytest.mark.parametrize("q", [0.7, 3.9, -12.0])
    @pytest.mark.parametrize("axis", ["0 0 1", "0.6 0 0.8"])
    @pytest.mark.parametrize("follower", MOVING)
    @pytest.mark.parametrize("leader", MOVING)
    def test_ties_joints_of_every_kind_however_far_they_turn(self, tmp_path, leader, follower, axis, q):
        path = write_urdf(
            tmp_path,
            link("a"),
            link("b"),
            joint("j1", "base", "a", leader, axis),
            joint("j2", "a", "b", follower, axis, mimic("j1", 2.5, 0.3)),
        )
        robot = vp.load_robot(path)
        assert robot.joint_names == ("j1",)
        self.check(robot, [q], [0.6], {"j1": (q, 0.6), "j2": (2.5 * q + 0.3, 1.5)})

    def test_ratio_zero_holds_the_follower(self, tmp_path):
        path = write_urdf(
            tmp_path, link("a"), link("b"), joint("j1", "base", "a"), joint("j2", "a", "b", inside=mimic("j1", 0, 0.3))
        )
        self.check(vp.load_robot(path), [0.5], [2.0], {"j1": (0.5, 2.0), "j2": (0.3, 0.0)})
        with refused(vp.RobotError, "'j2'", "'j1'", "multiplier", "0"):
            vp.load_robot(pin.buildModelFromUrdf(str(path), mimic=True))

    def test_leader_in_a_later_branch(self, tmp_path):
        # Pinocchio orders siblings by name, so the leader comes last.
        path = write_urdf(
            tmp_path,
            *(link(name) for name in ("a", "b", "c", "d")),
            joint("j_a", "base", "a", inside=mimic("j_d", -2.0, 0.1)),
            joint("j_b", "a", "b"),
            joint("j_c", "base", "c"),
            joint("j_d", "c", "d"),
        )
        robot = vp.load_robot(path)
        assert robot.joint_names == ("j_b", "j_c", "j_d")
        place = {"j_c": (0.2, 1.0), "j_d": (0.4, 2.0), "j_b": (0.6, 3.0), "j_a": (-0.7, -4.0)}
        self.check(robot, [0.6, 0.2, 0.4], [3.0, 1.0, 2.0], place)
        assert robot.velocity_limit.tolist() == [8.0, 8.0, 4.0]
        assert robot.position_limits[0] == pytest.approx([-1.0, -1.0, -0.45])
        assert robot.position_limits[1] == pytest.approx([1.0, 1.0, 0.55])
        locked = vp.load_robot(path, lock={"j_b": 0.6})
        assert_same_jet(jet_at(locked, [0.2, 0.4], [1.0, 2.0]), jet_at(robot, [0.6, 0.2, 0.4], [0.0, 1.0, 2.0]), [1, 2])
        assert locked.velocity_limit.tolist() == [8.0, 4.0]

    @pytest.mark.parametrize(
        ("ratio", "offset", "limits", "speed", "effort"),
        [(1, 0, (-0.5, 0.4), 2.0, 3.0), (-2, 0, (-0.2, 0.25), 1.0, 6.0), (0.5, 0.1, (-1.0, 0.6), 4.0, 1.5)],
    )
    def test_limits_of_followers_are_limits_of_their_leader(self, tmp_path, ratio, offset, limits, speed, effort):
        tight = joint("j2", "a", "b", inside=mimic("j1", ratio, offset))
        tight = tight.replace(
            'effort="9" velocity="8" lower="-1" upper="1"', 'effort="3" velocity="2" lower="-0.5" upper="0.4"'
        )
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

    def test_followers_without_room_are_told(self, tmp_path, caplog):
        path = write_urdf(
            tmp_path, link("a"), link("b"), joint("j1", "base", "a"), joint("j2", "a", "b", inside=mimic("j1", 1, 5))
        )
        assert vp.load_robot(path).position_limits[0].tolist() == [-1.0]
        assert naming(caplog.messages, "'j2'", "no room")
        assert naming(vp.inspect_robot(path).warnings, "'j2'", "no room")

    def test_chain_of_mimics_ends_at_the_free_joint(self, tmp_path):
        path = write_urdf(
            tmp_path,
            *(link(name) for name in ("a", "b", "c")),
            joint("j1", "base", "a"),
            joint("j2", "a", "b", inside=mimic("j1", 2, 0.5)),
            joint("j3", "b", "c", inside=mimic("j2", -3, 0.25)),
        )
        place = {"j1": (0.3, 1.0), "j2": (1.1, 2.0), "j3": (-3.05, -6.0)}
        self.check(vp.load_robot(path), [0.3], [1.0], place)

    def test_of_a_leader_that_is_not_there_stays_free(self, tmp_path, caplog):
        path = arm(tmp_path, inside=mimic("thumb"))
        assert vp.load_robot(path).joint_names == ("j1",)
        assert naming(caplog.messages, "'j1'", "'thumb'")

    def test_free_makes_followers_coordinates(self, load):
        robot = vp.load_robot("panda", mimic="free")
        assert robot.joint_names[-2:] == ("panda_finger_joint1", "panda_finger_joint2")
        tied = load("panda")
        q, v = np.random.default_rng(0).normal(size=(2, 8))
        G = np.vstack([np.eye(8), np.eye(8)[-1]])
        free = jet_at(robot, G @ q, G @ v)
        np.testing.assert_allclose(jet_at(tied, q, v).Lqq, G.T @ free.Lqq @ G, rtol=0, atol=1e-12)

    def test_a_follower_that_carries_its_leader(self, tmp_path):
        path = write_urdf(
            tmp_path, link("a"), link("b"), joint("j1", "base", "a", inside=mimic("j2", 2)), joint("j2", "a", "b")
        )
        self.check(vp.load_robot(path), [0.3], [0.5], {"j1": (0.6, 1.0), "j2": (0.3, 0.5)})


class TestJoints:
    def test_limits_that_a_urdf_leaves_at_0_are_none(self, load):
        robot = load("double_pendulum")
        for entry in ET.parse(robot.urdf).getroot().findall("joint"):
            if entry.get("name") in robot.joint_names:
                assert {entry.find("limit").get(key) for key in ("lower", "upper", "velocity")} == {"0"}
        lower, upper = robot.position_limits
        assert (lower == -np.inf).all()
        assert (upper == np.inf).all()
        assert (robot.velocity_limit == np.inf).all()
        held = robot.model.copy()
        held.lowerPositionLimit[:], held.upperPositionLimit[:] = [0.0, 0.3], [0.5, 0.3]
        lower, upper = vp.load_robot(held).position_limits
        np.testing.assert_array_equal([lower, upper], [[0.0, 0.3], [0.5, 0.3]])

    def test_a_composite_of_one_joint_is_that_joint_unless_displaced(self):
        def of(placement: pin.SE3) -> pin.Model:
            model = pin.Model()
            k = model.addJoint(0, pin.JointModelComposite(pin.JointModelRY(), placement), pin.SE3.Identity(), "shell")
            model.appendBodyToJoint(k, random_inertia(np.random.default_rng(0)), pin.SE3.Identity())
            return model

        robot = vp.load_robot(of(pin.SE3.Identity()))
        scene = vp.Scene(robot)
        jets = [vp.lagrangian_jet(scene, [0.4], [1.3], backend=b) for b in ("compiled", "pinocchio")]
        assert pytest.approx(jets[1].L, rel=1e-13) == jets[0].L
        with refused(vp.UnsupportedJoint, "'shell'", "JointModelComposite"):
            vp.load_robot(of(pin.SE3(np.eye(3), np.array([0.1, 0.0, 0.0]))))


def test_the_arm_of_talos_has_the_rotors_of_its_srdf(load):
    robot = load("talos_arm")
    model = pin.buildModelFromUrdf(str(robot.urdf))
    pin.loadRotorParameters(model, str(example_robot_data.robots_dir() / example_robot_data.SRDF["talos_arm"]), False)
    assert model.armature.any()
    np.testing.assert_allclose(robot.tree.armature, model.armature, rtol=1e-15)


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


def test_end_effector_is_where_pinocchio_says(load):
    rng = np.random.default_rng(0)
    chain = vp.planar_chain(3)
    assert chain.end_effector == "tip"
    q = rng.normal(size=(4, 3))
    angles = np.cumsum(q, axis=1)
    expected = np.stack([np.cos(angles).sum(axis=1), np.zeros(4), -np.sin(angles).sum(axis=1)], axis=1)
    np.testing.assert_allclose(chain.frame_positions(q), expected, atol=1e-14)
    panda = load("panda")
    q = rng.normal(size=(2, panda.dof))
    data = panda.model.createData()
    for row, position in zip(q, panda.frame_positions(q, "panda_hand"), strict=True):
        pin.framesForwardKinematics(panda.model, data, panda.configuration(row))
        np.testing.assert_allclose(position, data.oMf[panda.model.getFrameId("panda_hand")].translation, atol=1e-14)
    with refused(vp.UnknownFrame, "'panda'", "'hand'", "'panda_hand'"):
        panda.frame_positions(q, "hand")
    np.testing.assert_array_equal(panda.frame_positions(q[0], "panda_hand"), panda.frame_positions(q, "panda_hand")[0])
    np.testing.assert_array_equal(chain.frame_positions(rng.normal(size=(2, 0, 3))), np.zeros((2, 0, 3)))
    with refused(vp.InputError, "q", "(..., 3)", "(2,)"):
        chain.frame_positions(np.zeros(2))
