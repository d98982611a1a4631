"""Bases that stand elsewhere or move, rotors, and inertias of meshes: what load_robot adds to a description."""

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import joint, link, write_urdf
from refusals import refused

import varpin as vp
from varpin.model.robot import geometry

PLACE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.5, 1.1), np.array([0.4, -2.0, 0.7]))
RNG = np.random.default_rng(5)


def mass_and_gravity(robot, q):
    """M and the gravity torques by Pinocchio, of the robot's own model."""
    model = robot.model
    data = model.createData()
    M = pin.crba(model, data, q)
    return np.triu(M) + np.triu(M, 1).T, pin.computeGeneralizedGravity(model, data, q)


class TestPlaced:
    @pytest.mark.parametrize(
        "base", [PLACE, PLACE.homogeneous, PLACE.homogeneous.tolist()], ids=["SE3", "array", "list"]
    )
    def test_frames_and_gravity_turn_with_it(self, base):
        there, here = vp.load_robot("ur5", base=base), vp.load_robot("ur5")
        q = RNG.normal(size=6)
        np.testing.assert_allclose(there.frame_positions(q), PLACE.act(here.frame_positions(q)), rtol=0, atol=1e-12)
        # What the arm feels is gravity turned the other way.
        turned = vp.Scene(here, gravity=PLACE.rotation.T @ [0.0, 0.0, -9.81])
        own, other = (vp.lagrangian_jet(s, q, np.ones(6)) for s in (vp.Scene(there), turned))
        for name in ("Lq", "Lvv", "Lqq"):
            np.testing.assert_allclose(getattr(own, name), getattr(other, name), rtol=0, atol=1e-10)

    def test_shapes_come_along(self):
        there, here = geometry(vp.load_robot("ur5", base=PLACE)), geometry(vp.load_robot("ur5"))
        for a, b in zip(there.geometryObjects, here.geometryObjects, strict=True):
            expected = PLACE * b.placement if b.parentJoint == 0 else b.placement
            np.testing.assert_allclose(a.placement.homogeneous, expected.homogeneous, atol=1e-12)

    @pytest.mark.parametrize(
        ("base", "facts"),
        [
            ("round", ("base", "'planar'", "'round'")),
            (np.eye(3), ("base", "(3, 3)")),
            (2.0 * np.eye(4), ("base", "rotation")),
            (np.diag([1.0, 1.0, -1.0, 1.0]), ("base", "rotation")),
        ],
        ids=str,
    )
    def test_what_is_refused(self, base, facts):
        with refused(vp.InputError, facts):
            vp.load_robot("ur5", base=base)


class TestPlanar:
    def test_it_is_the_arm_on_two_sliders_and_a_turn(self):
        robot = vp.load_robot("ur5", base="planar")
        assert robot.joint_names[:3] == ("base_x", "base_y", "base_turn")
        assert robot.dof == 9
        q = RNG.normal(size=9)
        moved = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, q[2]), np.array([q[0], q[1], 0.0]))
        arm = vp.load_robot("ur5", base=moved)
        np.testing.assert_allclose(robot.frame_positions(q), arm.frame_positions(q[3:]), rtol=0, atol=1e-12)
        M, gravity = mass_and_gravity(robot, q)
        jet = vp.lagrangian_jet(vp.Scene(robot), q, np.zeros(9))
        np.testing.assert_allclose(jet.Lvv, M, rtol=0, atol=1e-10)
        np.testing.assert_allclose(-jet.Lq, gravity, rtol=0, atol=1e-10)
        own, _ = mass_and_gravity(arm, q[3:])
        np.testing.assert_allclose(M[3:, 3:], own, rtol=0, atol=1e-10)

    def test_with_mimic_joints_payload_and_lock(self):
        load = vp.Payload("panda_hand", 1.5)
        options = {"lock": {"panda_joint7": 0.8}, "payload": load}
        robot, arm = vp.load_robot("panda", base="planar", **options), vp.load_robot("panda", **options)
        assert robot.joint_names == ("base_x", "base_y", "base_turn", *arm.joint_names)
        assert len(robot.ties) == len(arm.ties)
        q = np.concatenate([np.zeros(3), RNG.normal(size=arm.dof) * 0.01])
        own, other = (vp.lagrangian_jet(vp.Scene(r), x, np.zeros(r.dof)) for r, x in ((robot, q), (arm, q[3:])))
        np.testing.assert_allclose(own.Lvv[3:, 3:], other.Lvv, rtol=0, atol=1e-10)
        held = vp.load_robot("panda", base="planar", lock={"base_x": 0.5, "base_y": 0.0, "base_turn": 0.2})
        assert held.dof == vp.load_robot("panda").dof


class TestArmature:
    def test_it_adds_to_the_diagonal(self):
        plain = vp.load_robot("ur5")
        q = RNG.normal(size=6)
        M = vp.lagrangian_jet(vp.Scene(plain), q, np.zeros(6)).Lvv
        for armature, added in (
            (0.2, np.full(6, 0.2)),
            ({"elbow_joint": 0.3}, 0.3 * np.eye(6)[2]),
            (np.arange(6.0), np.arange(6.0)),
        ):
            robot = vp.load_robot("ur5", armature=armature)
            own = vp.lagrangian_jet(vp.Scene(robot), q, np.zeros(6)).Lvv
            np.testing.assert_allclose(own, M + np.diag(added), rtol=0, atol=1e-12)
            np.testing.assert_allclose(mass_and_gravity(robot, q)[0], own, rtol=0, atol=1e-10)


SHAPES = """
<visual><origin xyz="0.5 0 0" rpy="0 0 0.3"/><geometry><box size="1 0.1 0.2"/></geometry></visual>
<visual><origin xyz="1 0 0"/><geometry><sphere radius="0.2"/></geometry></visual>"""


class TestInertiasOfShapes:
    def test_links_without_an_inertia_have_that_of_their_shapes(self, tmp_path):
        parts = [link("a", extra=SHAPES), link("b", "", SHAPES), joint("j1", "base", "a"), joint("j2", "a", "b")]
        robot = vp.load_robot(write_urdf(tmp_path, *parts), inertia="meshes", density=500.0)
        box = pin.Inertia(10.0, np.zeros(3), 10.0 / 12.0 * np.diag([0.05, 1.04, 1.01]))
        ball = 500.0 * 4.0 / 3.0 * np.pi * 0.2**3
        expected = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, 0.3), np.array([0.5, 0.0, 0.0])).act(box)
        expected += pin.Inertia(ball, np.array([1.0, 0.0, 0.0]), 0.4 * ball * 0.04 * np.eye(3))
        np.testing.assert_allclose(robot.model.inertias[2].matrix(), expected.matrix(), rtol=0, atol=2e-6)
        assert robot.model.inertias[1].mass == 1.3

    def test_what_is_refused(self):
        with refused(vp.InputError, "inertia", "'file'", "'meshes'"):
            vp.load_robot("ur5", inertia="mesh")
        with refused(vp.InputError, "inertia"):
            vp.load_robot(vp.load_robot("ur5").model, inertia="meshes")
        with refused(vp.InputError, "density"):
            vp.load_robot("ur5", inertia="meshes", density=0.0)


class TestElsewhere:
    def test_scene_files(self, tmp_path):
        text = """
            [robot]
            source = "ur5"
            base = BASE
            armature = { elbow_joint = 0.4 }
            [horizon]
            dt = 0.001
            steps = 10
        """
        path = tmp_path / "scene.toml"
        path.write_text(text.replace("BASE", '"planar"'))
        assert vp.load_scene(path).robot.joint_names[:3] == ("base_x", "base_y", "base_turn")
        path.write_text(text.replace("BASE", "{ xyz = [0.0, 0.0, 2.0], rpy = [0.0, 0.5, 0.3] }"))
        robot = vp.load_scene(path).robot
        place = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.5, 0.3), np.array([0.0, 0.0, 2.0]))
        other = vp.load_robot("ur5", base=place)
        q = np.zeros(robot.dof)
        np.testing.assert_allclose(robot.frame_positions(q), other.frame_positions(np.zeros(6)), atol=1e-12)
        assert robot.tree.armature[robot.joint_names.index("elbow_joint")] == 0.4
        path.write_text(text.replace("BASE", '"round"'))
        with refused(vp.SceneFileError, "robot.base"):
            vp.load_scene(path)
