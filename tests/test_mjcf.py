"""MJCF files load as MuJoCo reads them: accelerations, limits, places of bodies, sites and shapes."""

from __future__ import annotations

import pickle
import sys

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from refusals import naming, refused, unnamed

import varpin as vp
from varpin.model import geometry, readable_geometry

MASS = '<inertial pos="0.02 0.05 0.1" mass="1.3" diaginertia="0.02 0.03 0.025" quat="0.9 0.2 0.1 0"/>'
BOX = '<geom type="box" size="0.1 0.05 0.02" pos="0.1 0.02 0"/>'
BALL = '<geom type="sphere" size="0.1"'
PLACE = 'pos="0.1 0.02 0.2" quat="0.9 0.1 0.2 0.3"'


def body(name, inside=MASS, place=PLACE, joint=None):
    joint = f'<joint name="j{name}" axis="0 1 0"/>' if joint is None else joint
    return f'<body name="{name}" {place}>{joint}{inside}</body>'


TIP = body("tip")


def document(world, *sections, compiler='angle="radian"'):
    return f"<mujoco><compiler {compiler}/>{''.join(sections)}<worldbody>{world}</worldbody></mujoco>"


def one(inside=MASS + TIP, *sections, joint=None, place=PLACE, compiler='angle="radian"'):
    return document(body("a", inside, place, joint), *sections, compiler=compiler)


HINGE = '<joint name="ja" {}/>'
MESH = '<asset><mesh name="tet" file="tet.obj"/></asset>'
LEANING = 'pos="0 0 0.3" euler="0.4 -0.2 0.3"'
EQUAL = "<equality>{}</equality>"
TENDON = '<tendon><fixed name="f"><joint joint="ja" coef="1"/></fixed></tendon>'
TENDONS = "equality constraints of kind tendon", "tendons (1)"
FILES = {
    "plain": one(),
    "on a body that stands still": document(body("base", body("a", MASS + TIP), LEANING, "")),
    "a body that stands still between": one(MASS + body("s", BOX + TIP, 'pos="1 0 0"', "")),
    "degrees": one(place='euler="10 20 30"', joint=HINGE.format('range="-10 20"'), compiler=""),
    "joint off the origin": one(joint=HINGE.format('axis="0 1 2" pos="0.1 0.2 0.3" ref="0.3"')),
    "position of reference": one(joint=HINGE.format('range="-10 20" ref="5"'), compiler=""),
    "slide": one(joint=HINGE.format('type="slide" axis="0 3 4" pos="0.1 0 0" armature="1"')),
    "three joints on a body": one(
        joint='<joint name="x" axis="1 0 0" pos="0.1 0 0" range="-1 2"/><joint name="y" damping="3" pos="0 0.2 0.3"/>'
        '<joint name="z" type="slide" armature="0.2" axis="0 1 1"/>'
    ),
    "full inertia": one('<inertial pos="0 0 1" mass="1" fullinertia="0.02 0.03 0.025 0.001 0.002 0.003"/>' + TIP),
    "shapes": one(f'{BOX}<geom type="capsule" size="0.05" fromto="0 0 0 0.1 0.2 0.3"/>{BALL} density="9"/>{TIP}'),
    "an included file": one(MASS + '<include file="tip.xml"/>'),
    "copies": document(
        f'<replicate count="2" offset="0 0.3 0" euler="0 0 0.5">{body("b", MASS)}</replicate>' + body("a", MASS + TIP)
    ),
    "a file within": document(
        '<frame pos="0 0 1" euler="0.3 0 0"><attach model="arm" body="tip" prefix="other:"/></frame>'
        + body("a", MASS + TIP),
        '<asset><model name="arm" file="other.xml"/></asset>',
    ),
    "rotors of actuators": one(
        MASS + TIP, '<actuator><motor joint="ja" gear="-3" armature="0.2" damping="0.1"/></actuator>'
    ),
    "no gravity": one(MASS + TIP, '<option><flag gravity="disable"/></option>'),
    "a camera, a light, a sensor": document(
        '<light pos="0 0 3"/><camera name="c" pos="1 0 0"/>' + body("a", MASS + TIP),
        '<sensor><jointpos joint="ja"/></sensor><contact><exclude body1="a" body2="tip"/></contact>',
    ),
}  # fmt: skip
TET = "v 0 0 0\nv 0.3 0 0\nv 0 0.2 0\nv 0 0 0.4\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def written(folder, text):
    (folder / "meshes").mkdir(exist_ok=True)
    for file in ("tet.obj", "meshes/tet.obj"):
        (folder / file).write_text(TET)
    (folder / "tip.xml").write_text(f"<mujocoinclude>{TIP}</mujocoinclude>")
    (folder / "other.xml").write_text(document(TIP))
    path = folder / "arm.xml"
    path.write_text(text)
    return path


def compiled(path):
    """MuJoCo's model and data of a file, without the forces of its actuators."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return model, mujoco.MjData(model)


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
@pytest.mark.parametrize("kind", FILES)
def test_robot_is_mujoco_s(tmp_path, kind, caplog):
    path = written(tmp_path, FILES[kind])
    robot, (model, data) = vp.load_robot(path), compiled(path)
    assert not caplog.records
    assert list(robot.joint_names) == [model.joint(k).name for k in range(model.njnt)]
    scene = vp.Scene(robot, damping=robot.damping)
    rng = np.random.default_rng(0)
    for _ in range(2):
        q, v = rng.uniform(-0.9, 0.9, (2, robot.dof))
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        jet = vp.lagrangian_jet(scene, q, v)
        a = np.linalg.solve(jet.Lvv, jet.Lq - jet.Lvq @ v - robot.damping * v)
        # MuJoCo turns inertias to their principal axes and back.
        np.testing.assert_allclose(a, data.qacc_smooth, rtol=0, atol=1e-11 * max(1.0, np.abs(a).max()))
        np.testing.assert_allclose(robot.frame_positions(q, "tip"), data.body("tip").xpos, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(robot.friction, model.dof_frictionloss)
    limited, limits = model.jnt_limited.astype(bool), robot.position_limits
    np.testing.assert_allclose(limits[0], np.where(limited, model.jnt_range[:, 0], -np.inf))
    np.testing.assert_allclose(limits[1], np.where(limited, model.jnt_range[:, 1], np.inf))


DRIVES = """<actuator>
<motor joint="a" gear="-3" ctrlrange="-1 1"/><position joint="a" kp="5" forcerange="-7 7"/>
<position joint="b" kp="5" ctrlrange="-1 1"/><general joint="c" gainprm="4" ctrlrange="-2 2"/>
<motor joint="d" ctrlrange="-9 9"/><motor joint="e" ctrlrange="-1 2"/></actuator>"""


def test_forces_of_actuators_are_effort_limits(tmp_path, caplog):
    joints = "".join(f'<joint name="{name}" axis="0 1 0" armature="1"/>' for name in "abcf")
    tip = '<joint name="d" actuatorfrcrange="-5 5"/><joint name="e" axis="1 0 0"/>'
    robot = vp.load_robot(written(tmp_path, one(MASS + body("tip", joint=tip), DRIVES, joint=joints)))
    assert robot.joint_names == ("a", "b", "c", "f", "d", "e")
    assert robot.effort_limit.tolist() == [10.0, np.inf, 8.0, np.inf, 5.0, 2.0]
    assert naming(caplog.messages, "force limits in one direction (1)") == caplog.messages


def test_things_without_a_name_have_one(tmp_path):
    joint = '<joint/><joint axis="0 1 0"/>'
    robot = vp.load_robot(written(tmp_path, document(body("a", f"{MASS}<body>{joint}{MASS}</body>", joint="<joint/>"))))
    assert robot.joint_names == ("a_joint", "body2_joint", "body2_joint1")


LOOSE = '<keyframe><key time="1"/><key name="up" qpos="0.1 0.2 0.3 0.8 0.6 0 0 0.5"/></keyframe>'
BALL_JOINT = '<joint name="f" type="ball" pos="0.1 0 0.2"/>'


@pytest.mark.parametrize(
    ("joint", "lock", "keys"),
    [
        ('<freejoint name="f"/>', [0.1, 0.2, 0.3, 0.6, 0.0, 0.0, 0.8], LOOSE),
        (BALL_JOINT, [0.6, 0.0, 0.0, 0.8], LOOSE.replace("0.1 0.2 0.3 ", "")),
    ],
)
def test_joints_of_several_coordinates_are_named_and_may_be_locked(tmp_path, joint, lock, keys):
    path = written(tmp_path, one(MASS + TIP, keys, joint=joint))
    with refused(vp.UnsupportedJoint, "'f'"):
        vp.load_robot(path)
    robot, (model, data) = vp.load_robot(path, lock={"f": lock}), compiled(path)
    assert robot.posture("up").tolist() == [0.5]
    data.qpos[:] = model.key_qpos[1]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(robot.frame_positions([0.5], "tip"), data.body("tip").xpos, rtol=0, atol=1e-14)
    torque = vp.Scene(robot).holding_torque([0.5])
    np.testing.assert_allclose(torque, data.qfrc_bias[-1:], rtol=0, atol=1e-12)


SEEN = (
    f'<site name="spot" pos="0.1 0.2 0.3"/>{BALL} name="ball" rgba="1 0 0 0.5"/>{BOX}<geom name="hidden" size="1" '
    'group="3"/><geom name="tet" type="mesh" mesh="tet" pos="0.1 0.2 0" euler="0.3 0 0.1" material="blue"/>'
    '<geom name="rod" type="capsule" size="0.02" fromto="0 0 0 0.1 0.2 0.3" contype="0" conaffinity="0" group="4" '
    'material="grass"/>'
)
BLUE = MESH.replace(
    "</asset>",
    '<texture name="grass" type="2d" builtin="flat" rgb1="0 1 0" width="4" height="4"/><material name="grass" '
    'texture="grass"/><material name="blue" rgba="0 0 1 1"/></asset>',
)


def test_shapes_and_sites_are_where_mujoco_has_them(tmp_path):
    path = written(tmp_path, one(SEEN + TIP, BLUE, compiler='angle="radian" discardvisual="true"'))
    robot, (model, data) = vp.load_robot(path), compiled(path)
    q = np.array([0.4, -0.3])
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(robot.frame_positions(q, "spot"), data.site("spot").xpos, rtol=0, atol=1e-14)
    shapes = {shape.name: shape for shape in geometry(robot).geometryObjects}
    assert set(shapes) == {"ball", "a_geom1", "tet", "rod"}
    its, body = robot.model.createData(), data.body("a")
    pin.forwardKinematics(robot.model, its, q)
    place = {name: its.oMi[shape.parentJoint] * shape.placement for name, shape in shapes.items()}
    np.testing.assert_allclose(place["ball"].translation, data.geom("ball").xpos, rtol=0, atol=1e-14)
    middle = body.xpos + body.xmat.reshape(3, 3) @ [0.05, 0.1, 0.15]
    np.testing.assert_allclose(place["rod"].translation, middle, rtol=0, atol=1e-14)
    # The file's own vertices; MuJoCo's are about the centre of mass, and its turns about x, then the turned y and z.
    own = pin.SE3(pin.utils.rotate("x", 0.3) @ pin.utils.rotate("z", 0.1), np.array([0.1, 0.2, 0.0]))
    where = pin.SE3(body.xmat.reshape(3, 3), body.xpos) * own
    corners = np.array([place["tet"].act(corner) for corner in shapes["tet"].geometry.vertices()])
    expected = [where.act(np.array(corner)) for corner in ([0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.4])]
    # MuJoCo keeps vertices in single precision.
    np.testing.assert_allclose(sorted(corners.tolist()), sorted(np.array(expected).tolist()), rtol=0, atol=1e-7)
    colors = {"ball": [1.0, 0.0, 0.0, 0.5], "tet": [0.0, 0.0, 1.0, 1.0], "rod": [0.0, 1.0, 0.0, 1.0]}
    assert {name: shapes[name].meshColor.tolist() for name in colors} == colors


def test_shapes_and_locked_joints(tmp_path):
    path = written(tmp_path, one(f'{BALL} name="b"/><geom type="mesh" mesh="tet" density="0"/>{TIP}', MESH))
    robot = pickle.loads(pickle.dumps(vp.load_robot(path)))
    assert (robot.name, robot.urdf, robot.mjcf) == ("arm", None, path)
    assert [shape.parentJoint for shape in geometry(robot).geometryObjects] == [1, 1]
    locked = vp.load_robot(path, lock={"ja": 0.5})
    assert [shape.parentJoint for shape in geometry(locked).geometryObjects] == [0, 0]
    assert len(vp.inspect_robot(path).joints) == 2
    (tmp_path / "tet.obj").unlink()
    with refused(vp.RobotError, "MuJoCo cannot read", "arm.xml", "tet.obj"):
        geometry(robot)
    shapes, missing = readable_geometry(robot)
    assert (shapes.ngeoms, missing["a"][0]) == (0, 1)


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        (one(joint=HINGE.format('stiffness="2"')), "joint springs (1)"),
        (one(joint=HINGE.format('damping="2 0.5"')), "nonlinear joint dampers"),
        (one(MASS + TIP, '<option density="1.2" viscosity="0.01"/>'), "fluid"),
        (one(place='gravcomp="1"'), "gravity compensation"),
        (one(MASS + TIP, '<actuator><position joint="ja" kp="5"/></actuator>'), "servos of actuators (1)"),
        (one(MASS + TIP, EQUAL.format('<joint joint1="ja" active="false"/>')), "inactive equality constraints"),
        (one(MASS + TIP, TENDON, EQUAL.format('<tendon tendon1="f"/>')), TENDONS),
    ],
)
def test_what_is_left_out_is_told(tmp_path, caplog, text, facts):
    vp.load_robot(written(tmp_path, text))
    (told,) = caplog.messages
    assert not unnamed(told, "leaves out", facts)


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        (one(joint=HINGE.format('damping="much"')), ("damping", "joint")),
        (one(body("b", ""), place=""), ("mass", "'a'")),
        (one(f'<geom type="mesh" mesh="tet"/>{TIP}', MESH.replace("tet.obj", "lost.obj")), "lost.obj"),
    ],
)
def test_files_that_mujoco_cannot_read_give_one_sentence(tmp_path, text, facts):
    with refused(vp.RobotError, "MuJoCo cannot read", "arm.xml", facts):
        vp.load_robot(written(tmp_path, text))


def test_without_mujoco_the_error_has_the_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with refused(vp.MissingDependency, "arm.xml", "mujoco", 'pip install "varpin[mjcf]"'):
        vp.load_robot(written(tmp_path, one()))


def test_urdf_of_another_suffix(tmp_path, load):
    path = tmp_path / "ur5.xml"
    path.write_text(load("ur5").urdf.read_text())
    expected = pin.buildModelFromUrdf(str(path))
    assert [inertia.mass for inertia in vp.load_robot(path).model.inertias] == [i.mass for i in expected.inertias]


@pytest.mark.parametrize(
    ("flag", "found"),
    [
        ("sensor", (0.5, 0.2, 1.0)),
        ("damper", (0.0, 0.2, 1.0)),
        ("frictionloss", (0.5, 0.0, 1.0)),
        ("limit", (0.5, 0.2, np.inf)),
    ],
)
def test_parts_of_the_physics_that_a_file_disables(tmp_path, flag, found):
    joint = HINGE.format('damping="0.5" frictionloss="0.2" range="-1 1"')
    option = f'<option><flag {flag}="disable"/></option>'
    robot = vp.load_robot(written(tmp_path, one(MASS, option, joint=joint)))
    assert (robot.damping[0], robot.friction[0], robot.position_limits[1][0]) == found
