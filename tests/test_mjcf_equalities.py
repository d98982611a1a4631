"""Equality constraints of MJCF files: MuJoCo's configurations and motions, taken and left out by a scene."""

from __future__ import annotations

import pickle

import mujoco
import numpy as np
import pytest
from findings import about
from refusals import naming, refused, unnamed

import varpin as vp

MASS = '<inertial pos="0.02 0.05 0.1" mass="1.3" diaginertia="0.02 0.03 0.025" quat="0.9 0.2 0.1 0"/>'
PLACE = 'pos="0.1 0.02 0.2" quat="0.9 0.1 0.2 0.3"'
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


HEAD = '<mujoco><compiler angle="radian"/><option><flag contact="disable" limit="disable"/></option>'


def document(equality, more="", world=ARM):
    return f"{HEAD}{more}<worldbody>{world}</worldbody><equality>{equality}</equality></mujoco>"


RELPOSE = 'relpose="0.3 0.1 0.2 0.8 0.2 0.1 0.4"'
TENDON = '<tendon><fixed name="t"><joint joint="cz" coef="1"/><joint joint="ax" coef="-0.25"/></fixed></tendon>'
KINDS = {
    "connect to the world": document('<connect body1="b" anchor="0.1 0.2 0.3"/>'),
    "connect of two sites": document('<connect site1="pad" site2="a"/>'),
    "connect to a site of the world": document('<connect site1="mark" site2="a"/>'),
    "joint on joint": document('<joint joint1="ax" joint2="cz" polycoef="0.1 0.7 -0.3 0.2 0.05"/>'),
    "slide on joint": document('<joint joint1="a" joint2="az" polycoef="0 0.1 0 0 0"/>'),
    "joint alone": document('<joint joint1="ay" polycoef="0.3 1 2 0 0"/>'),
    "joints on a tendon": document('<tendon tendon1="t"/>', TENDON),
    "joints on a tendon of a length": document('<tendon tendon1="t" polycoef="0.1 0.5 0 0 0"/>', TENDON),
    "weld to the world": document('<weld body1="b"/>'),
    "weld at an anchor": document('<weld body1="ay" body2="b" anchor="0.1 0.2 0.3"/>'),
    "weld by a pose": document(f'<weld body1="ay" body2="b" anchor="0.1 0.2 0.3" {RELPOSE}/>'),
    "weld of sites": document('<weld site1="tool" site2="a"/>'),
    "weld of points": document('<weld body1="ay" body2="b" anchor="0.1 0.2 0.3" torquescale="0"/>'),
}


def both(folder, text):
    """varpin's robot, and MuJoCo's model and data."""
    path = written(folder, text)
    model = mujoco.MjModel.from_xml_path(str(path))
    return vp.load_robot(path), model, mujoco.MjData(model)


def written(folder, text):
    path = folder / "arm.xml"
    path.write_text(text)
    return path


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
    return document('<connect site1="pin" site2="hole"/>', world=crank + rocker)


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
    (told,) = caplog.messages
    assert not unnamed(told, "planar loop", "<connect> 'pin'")
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
    return written(folder, document(equality, world=WORLD + more))


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
