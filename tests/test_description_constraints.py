"""``Scene(robot, constraints="robot")``: the equality constraints of a robot's description, taken and left out."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from findings import about
from refusals import naming, refused, unnamed

import varpin as vp

MASS = '<inertial pos="0.02 0.05 0.1" mass="1.3" diaginertia="0.02 0.03 0.025"/>'
CONNECT = '<connect name="pin" body1="c" anchor="0.2 0 0" body2="d"/>'
GEAR = '<joint name="gear" joint1="qa" joint2="qb" polycoef="0.1 2 0 0 0"/>'
CAM = '<joint name="cam" joint1="qa" joint2="qb" polycoef="0.1 2 1 0 0"/>'


def written(folder, equality, name="arm"):
    """Two chains of two links that turn about y: a and b, c and d."""
    joint = '<joint name="q{}" axis="0 1 0"/>'
    one, two, three, four = (
        f'<body name="{link}" pos="{place} 0 0">{joint.format(link)}{MASS}'
        for link, place in (("a", 0.0), ("b", 0.2), ("d", 0.4), ("c", 0.2))
    )
    path = folder / f"{name}.xml"
    path.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody>{one}{two}</body></body>{three}{four}</body></body></worldbody>'
        f"<equality>{equality}</equality></mujoco>"
    )
    return path


@pytest.fixture
def looped(tmp_path):
    return vp.load_robot(written(tmp_path, '<connect name="pin" body1="b" anchor="0.2 0 0" body2="c"/>' + GEAR))


def test_what_a_scene_leaves_out_is_told(looped, caplog):
    assert looped.loops == (("b", "c"),)
    assert not unnamed(repr(looped), "1 loops")
    assert len(naming(vp.inspect_robot(looped).warnings, "constraints='robot'")) == 1
    assert not caplog.records
    vp.Scene(looped)
    (record,) = caplog.records
    assert not unnamed(record.getMessage(), "constraints='robot'", "constraints=()")
    caplog.clear()
    vp.Scene(looped, constraints=vp.KinematicInput("qa"))
    assert len(caplog.records) == 1
    caplog.clear()
    tied = vp.Scene(looped, constraints=vp.JointTie("qa", "qb"))
    free, whole = vp.Scene(looped, constraints=()), vp.Scene(looped, constraints="robot")
    assert not caplog.records
    assert not free.constraints
    for scene, warned in ((tied, True), (free, True), (whole, False)):
        q0 = vp.assemble(scene, [0.1, 0.2, 0.3, 0.4])
        open_loops = about(vp.simulate(scene, q0, np.zeros(4), dt=1e-3, steps=2).warnings, "open loops")
        assert bool(naming(open_loops, "constraints='robot'", "'b'", "'c'")) == warned


def test_the_word_stands_among_others(looped, caplog):
    own = vp.Scene(looped, constraints="robot").constraints
    assert [type(each) for each in own] == [vp.PointOnPoint, vp.JointTie]
    more = vp.Scene(looped, constraints=[vp.KinematicInput("qd"), "robot"])
    assert [type(each) for each in more.constraints] == [vp.KinematicInput, vp.PointOnPoint, vp.JointTie]
    again = vp.Scene(pickle.loads(pickle.dumps(looped)), constraints="robot")
    q = [0.1, 0.2, 0.3, 0.4]
    for mine, its in zip(
        again.constraint_values(q), vp.Scene(looped, constraints=own).constraint_values(q), strict=True
    ):
        np.testing.assert_array_equal(mine, its)
    assert not caplog.records
    assert not vp.Scene(vp.load_robot("finger"), constraints="robot").constraints
    assert not unnamed(caplog.records[0].getMessage(), "constraints='robot'", "none")
    for given, facts in (("file", "constraints"), (["file"], "'file'"), (["robot", "robot"], "twice")):
        with refused(vp.InputError, facts):
            vp.Scene(looped, constraints=given)


def test_locked_joints_take_their_constraints_along(tmp_path):
    path = written(tmp_path, GEAR)

    def tied(**lock):
        robot = vp.load_robot(path, lock=lock)
        return robot, vp.Scene(robot, constraints="robot")

    robot, scene = tied(qb=0.3)
    assert vp.assemble(scene, np.zeros(3))[robot.coordinate("qa")] == pytest.approx(0.7, abs=1e-12)
    assert not tied(qa=0.7, qb=0.3)[1].constraints
    with refused(vp.InputError, "<joint> 'gear'", "0.1"):
        tied(qa=0.8, qb=0.3)
    path = written(tmp_path, CAM)
    assert vp.assemble(tied(qb=0.3)[1], np.zeros(3))[0] == pytest.approx(0.79, abs=1e-12)
    with refused(vp.InputError, "<joint> 'cam'", "'qa'", "'qb'"):
        tied(qa=0.7)
    with refused(vp.InputError, "<joint> 'cam'", "'qa'"):
        tied(qb=0.3, qc=0.0, qd=0.0)
    path = written(tmp_path, '<connect name="pin" body1="b" anchor="0.2 0 0" body2="c"/>')
    # All four joints of the loop are locked, a fifth moves.
    path.write_text(
        path.read_text().replace("</worldbody>", f'<body name="e"><joint name="qe"/>{MASS}</body></worldbody>')
    )
    for kind in ("connect", "weld"):
        path.write_text(path.read_text().replace("<connect", f"<{kind}"))
        robot, scene = tied(qa=0.0, qb=0.0, qc=0.0, qd=0.0)
        assert not scene.constraints
        assert not robot.loops
        assert tied(qa=0.0, qb=0.0, qd=0.0)[0].loops == (("b", "c"),)
        with refused(vp.InputError, f"<{kind}> 'pin'"):
            tied(qa=0.0, qb=0.0, qc=0.5, qd=0.0)


def test_combined_and_placed_robots_keep_them(tmp_path):
    arm = vp.load_robot(written(tmp_path, '<connect body1="b" anchor="0.2 0 0"/><weld body1="c"/>' + GEAR))
    turned = np.array([[0, -1, 0, 0.4], [1, 0, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1.0]])
    alone = vp.Scene(arm, constraints="robot").constraint_values(np.full(4, 0.2))[0]
    placed = vp.load_robot(arm.mjcf, base=turned)
    pair = vp.combine(arm, arm, placements=[None, turned], prefixes=["l_", "r_"])
    assert pair.loops == (("l_b", "l_world"), ("l_c", "l_world"), ("r_b", "r_world"), ("r_c", "r_world"))
    both = vp.Scene(pair, constraints="robot").constraint_values(np.full(8, 0.2))[0]
    np.testing.assert_allclose(both[:10], alone, rtol=0, atol=1e-14)
    for g in (vp.Scene(placed, constraints="robot").constraint_values(np.full(4, 0.2))[0], both[10:]):
        # Residuals of points are along the axes of the world, turns about those of the second frame.
        np.testing.assert_allclose(g[:3], turned[:3, :3] @ alone[:3], rtol=0, atol=1e-14)
        np.testing.assert_allclose(g[3:6], turned[:3, :3] @ alone[3:6], rtol=0, atol=1e-14)
        np.testing.assert_allclose(g[6:], alone[6:], rtol=0, atol=1e-14)


SCENE = """
[robot]
source = "arm.xml"
[horizon]
dt = 0.01
steps = 5
"""


def test_scene_files_take_them(tmp_path, looped, caplog):
    path = tmp_path / "arm.toml"
    path.write_text(SCENE)
    assert not vp.load_scene(path).scene.constraints
    assert len(naming(caplog.messages, "constraints='robot'")) == 1
    caplog.clear()
    path.write_text(SCENE + '[[constraint]]\ntype = "robot"\n[[constraint]]\ntype = "kinematic_input"\njoint = "qd"\n')
    file = vp.load_scene(path)
    kinds = [type(each) for each in file.scene.constraints]
    with refused(vp.SceneFileError, "arm.toml", "initial.q", "JointTie"):
        file.simulate()
    assert kinds == [vp.PointOnPoint, vp.JointTie, vp.KinematicInput]
    assert not caplog.records
    path.write_text(
        SCENE.replace("[horizon]", "lock = { qa = 0.5, qb = 0.5 }\n[horizon]") + '[[constraint]]\ntype = "robot"\n'
    )
    with refused(vp.SceneFileError, "constraint[0]", "<joint> 'gear'"):
        vp.load_scene(path).scene  # noqa: B018
