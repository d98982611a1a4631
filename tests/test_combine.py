"""Several robots as one tree, against the robots by themselves and Pinocchio."""

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused

import varpin as vp
from varpin.model import geometry, readable_geometry

PLACE = pin.SE3(pin.utils.rotate("z", np.pi) @ pin.utils.rotate("x", 0.2), np.array([1.2, 0.1, 0.2]))


@pytest.fixture(scope="module")
def arms():
    return vp.load_robot("panda"), vp.load_robot("ur5", armature=0.02)


def test_each_part_moves_as_by_itself(arms):
    both = vp.combine(*arms, placements=[None, PLACE])
    assert both.joint_names == arms[0].joint_names + arms[1].joint_names
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=both.dof), rng.normal(size=both.dof)
    options = {"dt": 1e-2, "steps": 10, "integrator": vp.Gauss(2)}
    motion = vp.simulate(vp.Scene(both, damping="robot", gravity=(0.0, 1.0, -9.0)), q, v, **options)
    first = 0
    for robot, gravity in zip(arms, ([0.0, 1.0, -9.0], PLACE.rotation.T @ [0.0, 1.0, -9.0]), strict=True):
        own = slice(first, first + robot.dof)
        alone = vp.simulate(vp.Scene(robot, damping="robot", gravity=gravity), q[own], v[own], **options)
        np.testing.assert_allclose(motion.q[:, own], alone.q, atol=1e-10)
        first += robot.dof


def test_what_robots_know_goes_along(arms):
    both = vp.combine(*arms, placements=[PLACE, None])
    for what in ("effort_limit", "velocity_limit", "damping", "friction"):
        np.testing.assert_array_equal(getattr(both, what), np.hstack([getattr(robot, what) for robot in arms]))
    np.testing.assert_array_equal(both.position_limits, np.hstack([robot.position_limits for robot in arms]))
    np.testing.assert_array_equal(both.posture("default")[:8], arms[0].posture("default"))
    np.testing.assert_array_equal(vp.Scene(both, damping=0).armature, [0.0] * 8 + [0.02] * 6)
    assert len(both.ties) == 1


@pytest.mark.slow
def test_shapes_stand_where_the_parts_put_them(arms):
    both = vp.combine(*arms, placements=[None, PLACE])
    q = np.random.default_rng(1).normal(size=both.dof)
    found = placed(both, q)
    assert found.keys() == placed(arms[0], q[:8]).keys() | placed(arms[1], q[8:]).keys()
    for name, place in placed(arms[0], q[:8]).items():
        np.testing.assert_allclose(found[name], place, atol=1e-12)
    for name, place in placed(arms[1], q[8:]).items():
        np.testing.assert_allclose(found[name], PLACE.homogeneous @ place, atol=1e-12)
    shapes, missing = readable_geometry(both)
    assert not missing
    for shape in shapes.geometryObjects:
        assert both.model.frames[shape.parentFrame].parentJoint == shape.parentJoint


def placed(robot, q):
    """Where the shapes of a robot are, by name."""
    shapes, data = geometry(robot), robot.model.createData()
    of_shapes = shapes.createData()
    pin.updateGeometryPlacements(robot.model, data, shapes, of_shapes, robot.configuration(q))
    return {shape.name: place.homogeneous for shape, place in zip(shapes.geometryObjects, of_shapes.oMg, strict=True)}


def test_names_that_clash_get_a_prefix(arms):
    arm = arms[1]
    twins = vp.combine(arm, arm, placements=[None, PLACE], prefixes=["left_", "right_"])
    assert twins.joint_names == tuple(f"{side}_{name}" for side in ("left", "right") for name in arm.joint_names)
    assert vp.combine(arm, arm).joint_names[0] == "a_shoulder_pan_joint"
    assert vp.combine(arm, vp.load_robot("ur3")).joint_names[0] == "ur5_shoulder_pan_joint"
    four = vp.combine(twins, arms[0], twins)
    assert four.dof == 32
    assert four.joint_names[0] == "a_left_shoulder_pan_joint"
    assert len(geometry(four).geometryObjects) == 4 * 7 + 11
    locked = vp.load_robot("ur5", lock={"wrist_3_joint": 0.3})
    assert vp.combine(locked, locked).locked == {"a_wrist_3_joint": 0.3, "b_wrist_3_joint": 0.3}


WRONG = {
    "one": (vp.combine, "robots"),
    "no robot": (lambda arm: vp.combine(arm, "ur5"), "robots"),
    "placements": (lambda arm: vp.combine(arm, arm, placements=[None]), ("placements", "2")),
    "planar": (lambda arm: vp.combine(arm, arm, placements=[None, "planar"]), "base="),
    "a place": (lambda arm: vp.combine(arm, arm, placements=[None, [2.0, 0.0, 0.0]]), ("placements", "'chain2'")),
    "no rotation": (lambda arm: vp.combine(arm, arm, placements=[None, 2.0 * np.eye(4)]), "rotation"),
    "prefixes": (lambda arm: vp.combine(arm, arm, prefixes="ab"), "prefixes"),
    "alike": (lambda arm: vp.combine(arm, arm, prefixes=["", ""]), "'joint1'"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_combinations_are_refused(what):
    make, facts = WRONG[what]
    with refused(vp.InputError, facts):
        make(vp.planar_chain(2))
