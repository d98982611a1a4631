"""MJCF files load as MuJoCo reads them: accelerations, limits, places, shapes, and equality constraints."""

import pickle
import sys

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from findings import about
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


SITE = '<site name="{}" pos="0.1 -0.05 0.02" euler="0.3 0.2 -0.4"/>'


def joints(name, ref=0.0):
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    return "".join(f'<joint name="{name}{k}" axis="{axes[k]}" pos="0.03 0 0.05" ref="{ref}"/>' for k in axes)


# Two branches of six and four joints; a joint, a body and a site have one name.
ARM = (
    f'<body name="a" {PLACE}>{joints("a", 0.2)}{MASS}{SITE.format("pad")}'
    f'<body name="b" {PLACE}><joint name="a" type="slide" axis="0 1 1"/>{joints("b")}{MASS}{SITE.format("a")}</body>'
    f'</body><body name="ay" pos="0.3 0.2 0.4">{joints("c", -0.1)}{MASS}{SITE.format("tool")}</body>'
    f"{SITE.format('mark')}"
)
FLAGS = '<option><flag contact="disable" limit="disable"/></option>'


def equal(equality, *sections, world=ARM):
    return document(world, FLAGS, EQUAL.format(equality), *sections)


RELPOSE = 'relpose="0.3 0.1 0.2 0.8 0.2 0.1 0.4"'
PAIR = '<tendon><fixed name="t"><joint joint="cz" coef="1"/><joint joint="ax" coef="-0.25"/></fixed></tendon>'
KINDS = {
    "connect to the world": equal('<connect body1="b" anchor="0.1 0.2 0.3"/>'),
    "connect of two sites": equal('<connect site1="pad" site2="a"/>'),
    "connect to a site of the world": equal('<connect site1="mark" site2="a"/>'),
    "joint on joint": equal('<joint joint1="ax" joint2="cz" polycoef="0.1 0.7 -0.3 0.2 0.05"/>'),
    "slide on joint": equal('<joint joint1="a" joint2="az" polycoef="0 0.1 0 0 0"/>'),
    "joint alone": equal('<joint joint1="ay" polycoef="0.3 1 2 0 0"/>'),
    "joints on a tendon": equal('<tendon tendon1="t"/>', PAIR),
    "joints on a tendon of a length": equal('<tendon tendon1="t" polycoef="0.1 0.5 0 0 0"/>', PAIR),
    "weld to the world": equal('<weld body1="b"/>'),
    "weld at an anchor": equal('<weld body1="ay" body2="b" anchor="0.1 0.2 0.3"/>'),
    "weld by a pose": equal(f'<weld body1="ay" body2="b" anchor="0.1 0.2 0.3" {RELPOSE}/>'),
    "weld of sites": equal('<weld site1="tool" site2="a"/>'),
    "weld of points": equal('<weld body1="ay" body2="b" anchor="0.1 0.2 0.3" torquescale="0"/>'),
}


def both(folder, text):
    """varpin's robot, and MuJoCo's model and data."""
    path = written(folder, text)
    return vp.load_robot(path), *compiled(path)


def rows(model, data, q):
    """MuJoCo's residuals (c,) and Jacobian (c, n) of its equality constraints."""
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    equal = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    return data.efc_pos[equal].copy(), data.efc_J.reshape(-1, model.nv)[equal].copy()


@pytest.mark.parametrize("kind", KINDS)
def test_constraints_are_mujoco_s(tmp_path, kind, caplog):
    """Residuals and Jacobians; of welds, whose turns are told otherwise, the configurations and velocities."""
    robot, model, data = both(tmp_path, KINDS[kind])
    scene = vp.Scene(robot, constraints="robot")
    assert not caplog.records
    for q in model.qpos0 + np.random.default_rng(0).uniform(-0.3, 0.3, (3, robot.dof)):
        if not kind.startswith("weld"):
            for mine, its in zip(scene.constraint_values(q), rows(model, data, q), strict=True):
                np.testing.assert_allclose(mine, its, rtol=0, atol=1e-13)
            continue
        kept = vp.assemble(scene, q)
        g, C = rows(model, data, kept)
        np.testing.assert_allclose(g, 0.0, rtol=0, atol=1e-11)
        mine = scene.constraint_values(kept)[1]
        assert np.linalg.matrix_rank(C, 1e-9) == np.linalg.matrix_rank(mine, 1e-9) == len(mine)
        np.testing.assert_allclose(C @ (np.eye(robot.dof) - np.linalg.pinv(mine) @ mine), 0.0, rtol=0, atol=1e-11)


def upright(roll: str, offset: float = 0.0) -> str:
    """A four-bar in the x z plane whose joints turn about z of bodies that are rolled by a quarter turn."""

    def bar(name, place, length, inside="", turn=""):
        return (
            f'<body name="{name}" pos="{place}" {turn}><joint name="{name}" axis="0 0 1"/><geom type="capsule" '
            f'fromto="0 0 0 {length} 0 0" size="0.01" mass="{length}"/>{inside}</body>'
        )

    pin, hole = '<site name="pin" pos="0.4 0 0"/>', f'<site name="hole" pos="0.35 0 {offset}"/>'
    crank = bar("crank", "0 0 0", 0.2, bar("coupler", "0.2 0 0", 0.4, pin), 'quat="1 1 0 0"')
    rocker = bar("rocker", "0.5 0 0", 0.35, hole, f'euler="{roll} 0 0"')
    return equal('<connect site1="pin" site2="hole"/>', world=crank + rocker)


def swing(robot):
    """The start of a four-bar, its motion and the class of its constraint."""
    scene = vp.Scene(robot, constraints="robot")
    (constraint,) = scene.constraints
    q0 = vp.assemble(scene, [1.2, -1.0, 1.2])
    motion = vp.simulate(scene, q0, np.zeros(3), dt=0.01, steps=100, integrator=vp.Gauss(3))
    return q0, motion.q, type(constraint)


@pytest.mark.parametrize(("roll", "offset"), [("1.5705", 0.0), ("1.5708", 1e-4)])
def test_a_planar_loop_with_rounded_axes_is_closed_in_its_plane(tmp_path, caplog, roll, offset):
    start, whole, kind = swing(both(tmp_path, upright(repr(0.5 * np.pi)))[0])
    assert (kind, caplog.messages) == (vp.PointOnPoint, [])
    rounded, *_ = both(tmp_path, upright(roll, offset))
    own_start, motion, kind = swing(rounded)
    assert kind is vp.PointOnLine
    np.testing.assert_allclose(own_start, start, atol=1e-6)
    np.testing.assert_allclose(motion, whole, atol=2e-5)


def test_a_loop_in_space_is_not_taken_for_a_planar_one(tmp_path, caplog):
    robot, *_ = both(tmp_path, upright("1.56"))
    assert not caplog.records
    with pytest.raises(vp.AssemblyError):
        vp.assemble(vp.Scene(robot, constraints="robot"), [1.2, -1.0, 1.2])


PIN = '<connect name="pin" body1="b" anchor="0.2 0 0" body2="c"/>'
GEAR = '<joint name="gear" joint1="qa" joint2="qb" polycoef="0.1 2 0 0 0"/>'
CAM = '<joint name="cam" joint1="qa" joint2="qb" polycoef="0.1 2 1 0 0"/>'
LINK = '<body name="{0}" pos="{1} 0 0"><joint name="q{0}" axis="0 1 0"/>' + MASS
WORLD = "".join(LINK.format(*each) for each in (("a", 0), ("b", 0.2))) + "</body></body>"
WORLD += "".join(LINK.format(*each) for each in (("d", 0.4), ("c", 0.2))) + "</body></body>"


def chains(folder, equality, more=""):
    """The file of two chains of two links that turn about y: a and b, d and c."""
    return written(folder, equal(equality, world=WORLD + more))


@pytest.fixture
def looped(tmp_path):
    return vp.load_robot(chains(tmp_path, PIN + GEAR))


def test_what_a_scene_leaves_out_is_told(looped, caplog):
    assert looped.loops == (("b", "c"),)
    assert not unnamed(repr(looped), "1 loops")
    assert len(naming(vp.inspect_robot(looped).warnings, "constraints='robot'")) == 1
    assert not caplog.records
    vp.Scene(looped)
    vp.Scene(looped, constraints=vp.KinematicInput("qa"))
    assert len(naming(caplog.messages, "constraints='robot'", "constraints=()")) == len(caplog.messages) == 2
    caplog.clear()
    for constraints, warned in ((vp.JointTie("qa", "qb"), True), ((), True), ("robot", False)):
        scene = vp.Scene(looped, constraints=constraints)
        assert bool(scene.constraints) == (constraints != ())
        q0 = vp.assemble(scene, [0.1, 0.2, 0.3, 0.4])
        open_loops = about(vp.simulate(scene, q0, np.zeros(4), dt=1e-3, steps=2).warnings, "open loops")
        assert bool(naming(open_loops, "constraints='robot'", "'b'", "'c'")) == warned
    assert not naming(caplog.messages, "constraints=()")


def test_the_word_stands_among_others(looped, caplog):
    own = vp.Scene(looped, constraints="robot").constraints
    assert [type(each) for each in own] == [vp.PointOnPoint, vp.JointTie]
    more = vp.Scene(looped, constraints=[vp.KinematicInput("qd"), "robot"])
    assert [type(each) for each in more.constraints] == [vp.KinematicInput, vp.PointOnPoint, vp.JointTie]
    again = vp.Scene(pickle.loads(pickle.dumps(looped)), constraints="robot")
    scenes = (again, vp.Scene(looped, constraints=own))
    for mine, its in zip(*(scene.constraint_values([0.1, 0.2, 0.3, 0.4]) for scene in scenes), strict=True):
        np.testing.assert_array_equal(mine, its)
    assert not caplog.records
    assert not vp.Scene(vp.load_robot("finger"), constraints="robot").constraints
    assert naming(caplog.messages, "constraints='robot'", "none")
    for given, facts in (("file", "constraints"), (["file"], "'file'"), (["robot", "robot"], "twice")):
        with refused(vp.InputError, facts):
            vp.Scene(looped, constraints=given)


def tied(path, **lock):
    return vp.Scene(vp.load_robot(path, lock=lock), constraints="robot")


def test_locked_joints_take_their_ties_along(tmp_path):
    path = chains(tmp_path, GEAR)
    assert vp.assemble(tied(path, qb=0.3), np.zeros(3))[0] == pytest.approx(0.7, abs=1e-12)
    assert not tied(path, qa=0.7, qb=0.3).constraints
    with refused(vp.InputError, "<joint> 'gear'", "0.1"):
        tied(path, qa=0.8, qb=0.3)
    path = chains(tmp_path, CAM)
    assert vp.assemble(tied(path, qb=0.3), np.zeros(3))[0] == pytest.approx(0.79, abs=1e-12)
    with refused(vp.InputError, "<joint> 'cam'", "'qa'", "'qb'"):
        tied(path, qa=0.7)
    with refused(vp.InputError, "<joint> 'cam'", "'qa'"):
        tied(path, qb=0.3, qc=0.0, qd=0.0)


@pytest.mark.parametrize("kind", ["connect", "weld"])
def test_a_loop_whose_joints_are_locked_is_closed_or_refused(tmp_path, kind):
    fifth = f'<body name="e"><joint name="qe"/>{MASS}</body>'
    path = chains(tmp_path, PIN.replace("connect", kind), fifth)
    scene = tied(path, qa=0.0, qb=0.0, qc=0.0, qd=0.0)
    assert not scene.constraints
    assert not scene.robot.loops
    assert tied(path, qa=0.0, qb=0.0, qd=0.0).robot.loops == (("b", "c"),)
    with refused(vp.InputError, f"<{kind}> 'pin'"):
        tied(path, qa=0.0, qb=0.0, qc=0.5, qd=0.0)


def test_combined_and_placed_robots_keep_them(tmp_path):
    arm = vp.load_robot(chains(tmp_path, '<connect body1="b" anchor="0.2 0 0"/><weld body1="c"/>' + GEAR))
    turned = np.array([[0, -1, 0, 0.4], [1, 0, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1.0]])
    pair = vp.combine(arm, arm, placements=[None, turned], prefixes=["l_", "r_"])
    assert pair.loops == (("l_b", "l_world"), ("l_c", "l_world"), ("r_b", "r_world"), ("r_c", "r_world"))
    alone, placed, both = (
        vp.Scene(robot, constraints="robot").constraint_values(np.full(robot.dof, 0.2))[0]
        for robot in (arm, vp.load_robot(arm.mjcf, base=turned), pair)
    )
    np.testing.assert_allclose(both[:10], alone, rtol=0, atol=1e-14)
    for g in (placed, both[10:]):
        # Residuals of points are along the axes of the world, turns about those of the second frame.
        np.testing.assert_allclose(g[:3], turned[:3, :3] @ alone[:3], rtol=0, atol=1e-14)
        np.testing.assert_allclose(g[3:6], turned[:3, :3] @ alone[3:6], rtol=0, atol=1e-14)
        np.testing.assert_allclose(g[6:], alone[6:], rtol=0, atol=1e-14)


SCENE = '{}[robot]\nsource = "arm.xml"\n{}[horizon]\ndt = 0.01\nsteps = 5\n'
ROBOT = '[[constraint]]\ntype = "robot"\n'
INPUT = '[[constraint]]\ntype = "kinematic_input"\njoint = "qd"\n'


def test_scene_files_take_them(tmp_path, looped, caplog):
    path = tmp_path / "arm.toml"
    path.write_text(SCENE.format("", ""))
    assert not vp.load_scene(path).scene.constraints
    assert len(naming(caplog.messages, "constraints='robot'")) == 1
    caplog.clear()
    path.write_text(SCENE.format(ROBOT + INPUT, ""))
    file = vp.load_scene(path)
    assert [type(each) for each in file.scene.constraints] == [vp.PointOnPoint, vp.JointTie, vp.KinematicInput]
    with refused(vp.SceneFileError, "arm.toml", "initial.q", "JointTie"):
        file.simulate()
    assert not caplog.records
    path.write_text(SCENE.format(ROBOT, "lock = { qa = 0.5, qb = 0.5 }\n"))
    with refused(vp.SceneFileError, "constraint[0]", "<joint> 'gear'"):
        vp.load_scene(path).scene  # noqa: B018
