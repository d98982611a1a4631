"""What load_robot adds to a description: bases, rotors, inertias of shapes. What a scene takes of it: its damping."""

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from mechanisms import joint, link, mass_matrix, mimic, write_urdf
from refusals import refused, unnamed

import varpin as vp
from varpin.model.robot import geometry

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
    M, gravity = mass_matrix(robot, q, data), pin.computeGeneralizedGravity(robot.model, data, q)
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
    np.testing.assert_allclose(mass_matrix(robot, q, robot.model.createData()), own, rtol=0, atol=1e-10)


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


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({"base": "round"}, ("base", "'planar'", "'round'")),
        ({"base": np.eye(3)}, ("base", "(3, 3)")),
        ({"base": 2.0 * np.eye(4)}, ("base", "rotation")),
        ({"base": np.diag([1.0, 1.0, -1.0, 1.0])}, ("base", "rotation")),
        ({"inertia": "mesh"}, ("inertia", "'file'", "'meshes'")),
        ({"inertia": "meshes", "source": vp.planar_chain(2).model}, "inertia"),
        ({"inertia": "meshes", "density": 0.0}, "density"),
    ],
    ids=str,
)
def test_what_is_refused(options, facts):
    with refused(vp.InputError, facts):
        vp.load_robot(**{"source": "ur5"} | options)


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
