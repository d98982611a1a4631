"""MJCF files load as MuJoCo reads them: mass matrix, gravity torques, damping, limits, places of bodies."""

from __future__ import annotations

import pickle

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused, unnamed

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


def default(inside):
    return f"<default>{inside}</default>"


HINGE = '<joint name="ja" {}/>'
MESH = '<asset><mesh name="tet" file="tet.obj"/></asset>'
STANDS = body("s", BOX, 'pos="1 0 0" quat="0.8 0.3 0 0"', "")
LEANING = 'pos="0 0 0.3" euler="0.4 -0.2 0.3"'
EQUAL = "<equality>{}</equality>"
TENDON = '<tendon><fixed name="f"><joint joint="ja" coef="1"/></fixed></tendon>'
INACTIVE = default('<equality active="false"/>')
FRAME = '<frame pos="0 0 1" euler="0.1 0.2 0.3">{}</frame>'
FILES = {
    "plain": one(),
    "on a body that stands still": document(body("base", body("a", MASS + TIP), LEANING, "")),
    "two on the world": document(body("a", MASS + TIP) + body("b", MASS, 'pos="1 0 0"')),
    "beside a body that stands still": document(STANDS + body("a", MASS + TIP)),
    "a body that stands still between": one(MASS + body("s", BOX + TIP, 'pos="1 0 0"', "")),
    "degrees": one(place='euler="10 20 30"', joint=HINGE.format('range="-10 20"'), compiler=""),
    "turns about turned axes": one(place=LEANING, compiler='angle="radian" eulerseq="zyx"'),
    "turns about fixed axes": one(place=LEANING, compiler='angle="radian" eulerseq="XZY"'),
    "axis and angle": one(place='axisangle="1 2 3 0.4"'),
    "two axes": one(place='xyaxes="1 0.1 0 0 1 0.3"'),
    "joint off the origin": one(joint=HINGE.format('axis="0 1 2" pos="0.1 0.2 0.3" ref="0.3"')),
    "position of reference": one(joint=HINGE.format('range="-10 20" ref="5"'), compiler=""),
    "slide in a file of degrees": one(joint=HINGE.format('type="slide" range="-1 2" ref="0.5"'), compiler=""),
    "slide with one": one(joint=HINGE.format('type="slide" range="-1 2" ref="0.5"')),
    "slide": one(joint=HINGE.format('type="slide" axis="0 3 4" pos="0.1 0 0" armature="1"')),
    "three joints on a body": one(
        joint='<joint name="x" axis="1 0 0" pos="0.1 0 0" range="-1 2"/><joint name="y" damping="3" pos="0 0.2 0.3"/>'
        '<joint name="z" type="slide" armature="0.2" axis="0 1 1"/>'
    ),
    "classes": one(
        MASS + TIP,
        default('<joint damping="1"/><default class="k"><joint axis="1 0 0"/><default class="l">'
                '<joint armature="0.4" frictionloss="0.3"/></default></default>'),
        joint=HINGE.format('class="l" damping="2"'),
    ),
    "class of the children": one(
        MASS + TIP,
        default('<default class="k"><joint axis="1 0 0" range="-1 2"/></default>'),
        place='childclass="k"',
        joint=HINGE.format(""),
    ),
    "class of shapes": one(
        f'<geom class="k" size="0.1"/>{BOX}{TIP}',
        default('<default class="k"><geom type="sphere" mass="0.4"/></default>')
    ),
    "range that does not hold": one(joint=HINGE.format('range="-1 2" limited="false"')),
    "defaults at the end": one().replace("</mujoco>", default('<joint type="slide"/>') + "</mujoco>"),
    "two compilers": one(place='euler="10 20 30"').replace("<worldbody>", '<compiler angle="degree"/><worldbody>'),
    "full inertia": one('<inertial pos="0 0 1" mass="1" fullinertia="0.02 0.03 0.025 0.001 0.002 0.003"/>' + TIP),
    "shapes": one(f'{BOX}<geom type="capsule" size="0.05" fromto="0 0 0 0.1 0.2 0.3"/>{BALL} density="9"/>{TIP}'),
    "shapes that nothing touches": one(f'{BALL} contype="0" conaffinity="0"/>{BOX}{TIP}'),
    "shapes that nothing touches by default": one(
        f'{BALL}/>{BOX}<geom type="cylinder" size="0.1" fromto="0 0 0 0.1 0.2 0.3"/>{TIP}',
        default('<geom contype="0" conaffinity="0" density="300"/>'),
    ),
    "long shapes": one(
        '<geom type="ellipsoid" size="0.1 0.2 0.05" quat="0.9 0.1 0.3 0"/><geom type="cylinder" size="0.1 0.2"/>'
        '<geom type="box" size="0.05" fromto="0 0 0 0.1 0.2 0.3" mass="2"/><geom type="capsule" size="0.1 0.2"/>' + TIP
    ),
    "shapes without mass": one(f'{BALL} mass="0"/><geom type="mesh" mesh="tet" density="0"/>{BOX}{TIP}', MESH),
    "shapes beside an inertia": one(MASS + BOX + '<geom type="mesh" mesh="tet"/>' + TIP, MESH),
    "shapes instead of an inertia": one(MASS + BOX + TIP, compiler='angle="radian" inertiafromgeom="true"'),
    "shapes of no group": one(
        MASS + BOX + TIP, compiler='angle="radian" inertiafromgeom="true" inertiagrouprange="1 2"'
    ),
    "shapes of a group": one(f'{BALL} group="2"/>{BOX}{TIP}', compiler='angle="radian" inertiagrouprange="0 1"'),
    "frames": document(FRAME.format(FRAME.format(body("a", MASS + FRAME.format(TIP))))),
    "an included file": one(MASS + '<include file="tip.xml"/>'),
}  # fmt: skip


def written(folder, text):
    (folder / "tip.xml").write_text(f"<mujocoinclude>{TIP}</mujocoinclude>")
    (folder / "tet.obj").write_text("v 0 0 0\nv 0.3 0 0\nv 0 0.2 0\nv 0 0 0.4\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    path = folder / "arm.xml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("kind", FILES)
def test_robot_is_mujoco_s(tmp_path, kind, caplog):
    mujoco = pytest.importorskip("mujoco")
    path = written(tmp_path, FILES[kind])
    robot, model = vp.load_robot(path), mujoco.MjModel.from_xml_path(str(path))
    assert not caplog.records
    assert list(robot.joint_names) == [model.joint(k).name for k in range(model.njnt)]
    data, M = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    for q in np.random.default_rng(0).uniform(-0.9, 0.9, (2, robot.dof)):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        jet = vp.lagrangian_jet(vp.Scene(robot), q, np.zeros(robot.dof))
        np.testing.assert_allclose(jet.Lvv, M, rtol=0, atol=1e-12 * np.abs(M).max())
        # Two roundings: MuJoCo turns inertias to their principal axes and back.
        np.testing.assert_allclose(-jet.Lq, data.qfrc_bias, rtol=0, atol=1e-12 * max(1.0, np.abs(data.qfrc_bias).max()))
        np.testing.assert_allclose(robot.frame_positions(q, "tip"), data.body("tip").xpos, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(robot.damping, model.dof_damping)
    np.testing.assert_array_equal(robot.friction, model.dof_frictionloss)
    limited, limits = model.jnt_limited.astype(bool), robot.position_limits
    np.testing.assert_allclose(limits[0], np.where(limited, model.jnt_range[:, 0], -np.inf))
    np.testing.assert_allclose(limits[1], np.where(limited, model.jnt_range[:, 1], np.inf))


def test_keyframes_are_postures(tmp_path):
    keys = '<keyframe><key name="home" qpos="0.1 -0.2"/><key time="1"/></keyframe>'
    robot = vp.load_robot(written(tmp_path, one(MASS + TIP, keys)))
    assert robot.posture("home").tolist() == [0.1, -0.2]


def test_shapes_and_locked_joints(tmp_path):
    path = written(tmp_path, one(f'{BALL} name="b"/><geom type="mesh" mesh="tet" density="0"/>{TIP}', MESH))
    robot = pickle.loads(pickle.dumps(vp.load_robot(path)))
    assert (robot.name, robot.urdf, robot.mjcf) == ("arm", None, path)
    assert [shape.parentJoint for shape in geometry(robot).geometryObjects] == [1, 1]
    locked = vp.load_robot(path, lock={"ja": 0.5})
    assert [shape.parentJoint for shape in geometry(locked).geometryObjects] == [0, 0]
    assert len(vp.inspect_robot(path).joints) == 2
    (tmp_path / "tet.obj").unlink()
    with refused(vp.RobotError, "arm.xml", "'a'", "tet.obj"):
        geometry(robot)
    shapes, missing = readable_geometry(robot)
    assert (shapes.ngeoms, missing["a"][0]) == (0, 1)
    # Its dynamics do without.
    assert vp.load_robot(path).dof == 2


def test_joints_with_the_name_of_a_body_are_locked(tmp_path):
    joint = '<joint name="{}" axis="0 1 0"/>'
    tip = body("tip", MASS + '<site name="a" pos="0 0 0.1"/>', joint=joint.format("tip"))
    path = written(tmp_path, one(MASS + tip, joint=joint.format("a")))
    q = np.array([0.3, -0.2])
    robot = vp.load_robot(path)
    other = vp.load_robot(written(tmp_path, one(MASS + tip, joint=joint.format("b"))), lock={"b": 0.3})
    written(tmp_path, one(MASS + tip, joint=joint.format("a")))
    locked = vp.load_robot(path, lock={"a": 0.3})
    np.testing.assert_allclose(locked.frame_positions(q[1:]), robot.frame_positions(q), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(vp.Scene(locked).holding_torque(q[1:]), vp.Scene(other).holding_torque(q[1:]))
    kinds = [(frame.name, frame.type) for frame in locked.free_model.frames]
    assert [kinds.count(("a", kind)) for kind in (pin.FrameType.BODY, pin.FrameType.OP_FRAME)] == [1, 1]
    assert vp.load_robot(path, lock={"tip": 0.3}).joint_names == ("a",)


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        (one(joint=HINGE.format('stiffness="2"')), "joint springs"),
        (one(joint=HINGE.format('damping="2 0.5"')), "nonlinear"),
        (one(joint=HINGE.format('springdamper="0.1 1"')), "time constant"),
        (one(MASS + TIP, '<option density="1.2" viscosity="0.01"/>'), "fluid"),
        (one(compiler='boundmass="0.1"'), "least masses"),
        (one(place='gravcomp="1"'), "gravity compensation"),
        (one(MASS + TIP, EQUAL.format('<joint joint1="ja" active="false"/>')), "inactive equality constraints"),
        (one(MASS + TIP, INACTIVE, EQUAL.format('<connect body1="a"/>')), "inactive equality constraints"),
        (one(MASS + TIP, EQUAL.format('<tendon tendon1="t"/>')), "equality constraints of kind tendon"),
        (one(MASS + TIP, TENDON, EQUAL.format('<tendon tendon1="f"/>')), "equality constraints of kind tendon"),
        (one(MASS + TIP, TENDON), "tendons"),
    ],
)
def test_what_is_left_out_is_told(tmp_path, caplog, text, facts):
    vp.load_robot(written(tmp_path, text))
    (record,) = caplog.records
    assert not unnamed(record.getMessage(), "leaves out", facts)


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        (one(f'<geom type="mesh" mesh="tet"/>{TIP}', MESH), ("'a'", "<inertial>", "mesh")),
        (one(MASS + f'<replicate count="2">{TIP}</replicate>'), "<replicate>"),
        (one(FRAME.format(BOX) + TIP), ("<geom>", "<frame>")),
        (one(f'{BALL} shellinertia="true"/>{TIP}'), "'a'"),
        (one(compiler='coordinate="global"'), "world"),
        (one(compiler='settotalmass="10"'), "settotalmass"),
        (one(compiler='eulerseq="xy"', place=LEANING), ("eulerseq", "'xy'")),
        (one(joint='<joint name="b" type="screw"/>'), "joint"),
        (one(joint=HINGE.format('class="k"')), ("<joint> 'ja'", "'k'")),
        (one(joint=HINGE.format('damping="much"')), ("<joint> 'ja'", "damping", "'much'")),
        (one(MASS + body("b", place='pos="1 0 x"')), ("<body> 'b'", "pos", "'1 0 x'", "3")),
        (one(place='pos="1 0 x"'), ("<body> 'a'", "pos", "'1 0 x'", "3")),
        (one(place='axisangle="0 0 0 1"'), ("<body> 'a'", "axisangle")),
        (one(MASS.replace("1.3", "nan") + TIP), ("mass", "'nan'")),
        (one('<inertial pos="0 0 0" mass="1"/>' + TIP), ("'a'", "<inertial>", "mass")),
        (one(MASS + body("b", joint=HINGE.format(""))), "'ja'"),
        (one(MASS + '<include file="arm.xml"/>'), ("arm.xml", "itself")),
        (one()[:-10] + "</mujoco>", "XML"),
        (one(MASS + TIP, EQUAL.format('<connect body1="c" anchor="0 0 0"/>')), ("<connect> 'c'", "body 'c'")),
        (one(MASS + TIP, EQUAL.format('<connect name="e" body1="a"/>')), ("<connect> 'e'", "anchor")),
        (one(MASS + TIP, EQUAL.format('<weld name="e" site1="s" site2="t"/>')), ("<weld> 'e'", "site 's'")),
        (one(MASS + TIP, EQUAL.format('<weld body1="a" relpose="1 0 0"/>')), ("relpose", "'1 0 0'", "7")),
        (one(MASS + TIP, EQUAL.format('<joint name="e" joint1="ja" joint2="a"/>')), ("<joint> 'e'", "joint 'a'")),
        ("<mujoco/>", "joint"),
    ],
)
def test_bad_files_give_one_error(tmp_path, text, facts):
    with refused(vp.RobotError, facts):
        vp.load_robot(written(tmp_path, text))


@pytest.mark.parametrize(
    ("joint", "facts"),
    [
        ('<freejoint name="f"/>', ("'f'", "JointModelFreeFlyer")),
        ('<joint name="b" type="ball"/>', ("'b'", "JointModelSpherical")),
    ],
)
def test_joints_of_several_coordinates(tmp_path, joint, facts):
    with refused(vp.UnsupportedJoint, facts):
        vp.load_robot(written(tmp_path, one(joint=joint)))


def test_file_that_is_not_there(tmp_path):
    with refused(vp.FileError, "lost.xml"):
        vp.load_robot(written(tmp_path, one(MASS + '<include file="lost.xml"/>')))


def test_urdf_of_another_suffix_and_sdf(tmp_path, load):
    path = tmp_path / "ur5.xml"
    path.write_text(load("ur5").urdf.read_text())
    expected = pin.buildModelFromUrdf(str(path))
    assert [inertia.mass for inertia in vp.load_robot(path).model.inertias] == [i.mass for i in expected.inertias]
    for name in ("arm.sdf", "arm.xml"):
        (tmp_path / name).write_text('<sdf version="1.6"><model name="a"/></sdf>')
        with refused(vp.RobotError, "SDF"):
            vp.load_robot(tmp_path / name)


def test_planes_are_plates_and_those_without_an_edge_are_left_out(tmp_path):
    floor = '<geom name="floor" type="plane" size="0 0 0.1"/>'
    floor += '<geom name="mat" type="plane" size="0.4 0.3 0.1" pos="0 0 -1"/>'
    strip = default('<geom type="plane"/>'), '<geom name="strip" size="0.4 0 0.1"/>'
    robot = vp.load_robot(written(tmp_path, document(floor + strip[1] + body("a", MASS + BOX), strip[0])))
    shapes = {shape.name: shape for shape in geometry(robot).geometryObjects}
    assert not {"floor", "strip"} & {name.removesuffix("_0") for name in shapes}
    (plate,) = (shape for name, shape in shapes.items() if "mat" in name)
    np.testing.assert_allclose(2.0 * plate.geometry.halfSide, [0.8, 0.6, 1e-3])
    np.testing.assert_allclose(plate.placement.translation, [0.0, 0.0, -1.0])
    assert vp.replay(robot, [[0.3]], dt=1.0, html=tmp_path / "page.html").exists()
