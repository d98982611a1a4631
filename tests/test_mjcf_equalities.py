"""Equality constraints of MJCF files are MuJoCo's: which configurations keep them, and motions."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

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
    f'<body name="stand" pos="0.5 0 0.3" euler="0.1 0.2 0.3">{SITE.format("post")}</body>{SITE.format("mark")}'
)


def document(equality, *sections, world=ARM, compiler='angle="radian"'):
    inside = "".join(sections)
    return (
        f"<mujoco><compiler {compiler}/><option><flag contact='disable' limit='disable'/></option>{inside}<worldbody>"
        f"{world}</worldbody><equality>{equality}</equality></mujoco>"
    )


RELPOSE = 'relpose="0.3 0.1 0.2 0.8 0.2 0.1 0.4"'
KINDS = {
    "connect to the world": '<connect body1="b" anchor="0.1 0.2 0.3"/>',
    "connect of two sites": '<connect site1="pad" site2="a"/>',
    "connect to a site of the world": '<connect site1="mark" site2="a"/>',
    "joint on joint by a polynomial": '<joint joint1="ax" joint2="cz" polycoef="0.1 0.7 -0.3 0.2 0.05"/>',
    "slide on joint": '<joint joint1="a" joint2="az" polycoef="0 0.1 0 0 0"/>',
    "joint alone": '<joint joint1="ay" polycoef="0.3 1 2 0 0"/>',
}
WELDS = {
    "weld to the world": '<weld body1="b"/>',
    "weld at an anchor": '<weld body1="ay" body2="b" anchor="0.1 0.2 0.3"/>',
    "weld by a pose at an anchor": f'<weld body1="ay" body2="b" anchor="0.1 0.2 0.3" {RELPOSE}/>',
    "weld of sites": '<weld site1="tool" site2="a"/>',
    "weld of points": '<weld body1="ay" body2="b" anchor="0.1 0.2 0.3" torquescale="0"/>',
}


def both(folder, text):
    """varpin's robot, and MuJoCo's model and data."""
    path = folder / "arm.xml"
    path.write_text(text)
    model = mujoco.MjModel.from_xml_path(str(path))
    return vp.load_robot(path), model, mujoco.MjData(model)


def rows(model, data, q):
    """MuJoCo's residuals (c,) and Jacobian (c, n) of its equality constraints."""
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    equal = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    return data.efc_pos[equal].copy(), data.efc_J.reshape(-1, model.nv)[equal].copy()


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_are_mujoco_s(tmp_path, kind, caplog):
    robot, model, data = both(tmp_path, document(KINDS[kind]))
    scene = vp.Scene(robot, constraints="robot")
    assert not caplog.records
    for q in np.random.default_rng(0).uniform(-0.9, 0.9, (3, robot.dof)):
        for mine, its in zip(scene.constraint_values(q), rows(model, data, q), strict=True):
            np.testing.assert_allclose(mine, its, rtol=0, atol=1e-13)


@pytest.mark.parametrize("kind", WELDS)
def test_configurations_are_mujoco_s(tmp_path, kind):
    robot, model, data = both(tmp_path, document(WELDS[kind]))
    scene = vp.Scene(robot, constraints="robot")
    rng = np.random.default_rng(1)
    for _ in range(2):
        q = vp.assemble(scene, model.qpos0 + rng.uniform(-0.3, 0.3, robot.dof))
        g, C = rows(model, data, q)
        np.testing.assert_allclose(g, 0.0, rtol=0, atol=1e-11)
        mine = scene.constraint_values(q)[1]
        # The same velocities keep them.
        assert np.linalg.matrix_rank(C, 1e-9) == np.linalg.matrix_rank(mine, 1e-9) == len(mine)
        np.testing.assert_allclose(C @ (np.eye(robot.dof) - np.linalg.pinv(mine) @ mine), 0.0, rtol=0, atol=1e-11)


@pytest.mark.parametrize("offset", ["", 'polycoef="0.1 0.5 0 0 0"'])
def test_a_tendon_of_two_joints_ties_them(tmp_path, offset):
    tendon = '<tendon><fixed name="t"><joint joint="ax" coef="-2"/><joint joint="cz" coef="0.5"/></fixed></tendon>'
    robot, model, data = both(tmp_path, document(f'<tendon tendon1="t" {offset}/>', tendon))
    scene = vp.Scene(robot, constraints="robot")
    for q in np.random.default_rng(0).uniform(-0.9, 0.9, (2, robot.dof)):
        for mine, its in zip(scene.constraint_values(q), rows(model, data, q), strict=True):
            np.testing.assert_allclose(-2.0 * mine, its, rtol=0, atol=1e-13)


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


@pytest.mark.parametrize(("roll", "offset"), [("1.5705", 0.0), ("1.5708", 1e-4)])
def test_a_planar_loop_with_rounded_axes_is_closed_in_its_plane(tmp_path, caplog, roll, offset):
    start = [1.2, -1.0, 1.2]
    exact, *_ = both(tmp_path, upright(repr(0.5 * np.pi)))
    assert not caplog.records
    scene = vp.Scene(exact, constraints="robot")
    (constraint,) = scene.constraints
    assert isinstance(constraint, vp.PointOnPoint)
    q0 = vp.assemble(scene, start)
    whole = vp.simulate(scene, q0, np.zeros(3), dt=0.01, steps=100, integrator=vp.Gauss(3))
    rounded, *_ = both(tmp_path, upright(roll, offset))
    (record,) = caplog.records
    assert "planar loop" in record.message
    assert "<connect> 'pin'" in record.message
    scene = vp.Scene(rounded, constraints="robot")
    (constraint,) = scene.constraints
    assert isinstance(constraint, vp.PointOnLine)
    start = vp.assemble(scene, start)
    np.testing.assert_allclose(start, q0, atol=1e-6)
    motion = vp.simulate(scene, start, np.zeros(3), dt=0.01, steps=100, integrator=vp.Gauss(3))
    np.testing.assert_allclose(motion.q, whole.q, atol=2e-5)


def test_a_loop_in_space_is_not_taken_for_a_planar_one(tmp_path, caplog):
    robot, *_ = both(tmp_path, upright("1.56"))
    assert not caplog.records
    scene = vp.Scene(robot, constraints="robot")
    with pytest.raises(vp.AssemblyError):
        vp.assemble(scene, [1.2, -1.0, 1.2])
