"""Several robots as one tree: each moves as by itself, and a step treats each by itself."""

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import joint, link, mimic, random_rotation, random_tree, write_urdf

import varpin as vp
from varpin.model import geometry, readable_geometry

PLACE = pin.SE3(pin.utils.rotate("z", np.pi) @ pin.utils.rotate("x", 0.2), np.array([1.2, 0.1, 0.2]))
INTEGRATORS = [vp.Midpoint(), vp.Midpoint(0.3), vp.Gauss(2), vp.SemiImplicitEuler(), vp.RungeKutta4()]
over_integrators = pytest.mark.parametrize("integrator", INTEGRATORS, ids=str)
STEPS = {"dt": 5e-3, "steps": 40}
CHAINS = [vp.load_robot(random_tree(seed, size, branching=False)) for seed, size in ((3, 3), (1, 1), (4, 4))]
PLACES = [None, PLACE, PLACE.inverse()]
ARMS = vp.load_robot("panda"), vp.load_robot("ur5", armature=0.02)


def forest():
    return vp.combine(*CHAINS, placements=PLACES, prefixes=["a_", "b_", "c_"])


def between(robot):
    """Which entries of a matrix (n, n) are of two groups."""
    return robot.tree.group[:, None] != robot.tree.group


@over_integrators
def test_together_as_each_alone(integrator):
    together = forest()
    assert together.tree.ends.tolist() == [3, 4, 8]
    assert together.tree.group.tolist() == [0, 0, 0, 1, 2, 2, 2, 2]
    own_terms = {"damping": 0.05 + 0.01 * np.arange(8), "stiffness": 0.5 * np.arange(8), "rest": 0.1 * np.arange(8)}
    noise, gravity = vp.AdditiveNoise(0.02), np.array([0.0, 1.0, -9.0])
    scene = vp.Scene(together, gravity=gravity, noise=noise, **own_terms)
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-1.0, 1.0, (2, 8))
    dw = 0.03 * rng.normal(size=(40, 8))
    # Feedback of every chain on every other: controls are constant over a step and couple no matrix of it.
    law = vp.LinearPolicy(np.full((40, 8), 0.1), rng.normal(0.0, 0.1, (40, 8, 16)), np.zeros((40, 16)))
    motion = vp.simulate(scene, q, v, controls=law, increments=dw, integrator=integrator, **STEPS)
    assert np.abs(motion.u - 0.1).min() > 0.0
    lin = vp.linearize(scene, motion)
    curved = isinstance(integrator, vp.Midpoint | vp.Gauss)
    z = rng.normal(size=16)
    xx = vp.second_order(scene, motion, z).xx if curved else np.zeros((1, 16, 16))
    for chain, place, own in zip(CHAINS, PLACES, np.split(np.arange(8), [3, 4]), strict=True):
        turned = gravity if place is None else place.rotation.T @ gravity
        alone = vp.Scene(chain, gravity=turned, noise=noise, **{name: value[own] for name, value in own_terms.items()})
        given = {"controls": motion.u[:, own], "increments": dw[:, own], "integrator": integrator, **STEPS}
        moved = vp.simulate(alone, q[own], v[own], **given)
        np.testing.assert_allclose(motion.q[:, own], moved.q, rtol=0, atol=1e-12)
        np.testing.assert_allclose(motion.p[:, own], moved.p, rtol=0, atol=1e-12)
        both = np.concatenate([own, own + 8])
        single = vp.linearize(alone, moved)
        np.testing.assert_allclose(lin.A[:, both[:, None], both], single.A, rtol=0, atol=1e-9)
        np.testing.assert_allclose(lin.B[:, both[:, None], own], single.B, rtol=0, atol=1e-11)
        if curved:
            there = vp.second_order(alone, moved, z[both]).xx
            np.testing.assert_allclose(xx[:, both[:, None], both], there, rtol=0, atol=1e-9)
    # Between chains there is nothing, to the last bit.
    for matrix in (lin.A, lin.B, xx):
        assert not matrix[:, np.tile(between(together), (2, matrix.shape[2] // 8))].any()


@over_integrators
def test_a_branch_between_two_that_a_mimic_joint_ties(tmp_path, integrator):
    """Its coordinates stand between those of another group, so that both share a block."""
    branches = {"a": "", "b": "", "c": mimic("a1", -0.5, 0.1)}
    scenes = []
    for names in ("abc", "ac"):
        parts = [link(f"{name}_1") + joint(f"{name}1", "base", f"{name}_1", inside=branches[name]) for name in names]
        parts += [link(f"{name}_2") + joint(f"{name}2", f"{name}_1", f"{name}_2") for name in names]
        scenes.append(vp.Scene(vp.load_robot(write_urdf(tmp_path, *parts, name=names)), damping=0.1))
    whole, without = scenes
    assert whole.robot.joint_names == ("a1", "a2", "b1", "b2", "c2")
    assert (whole.robot.tree.groups, list(whole.robot.tree.ends)) == (2, [5])
    own = [0, 1, 4]
    q, v = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 5))
    motion = vp.simulate(whole, q, v, integrator=integrator, **STEPS)
    apart = vp.simulate(without, q[own], v[own], integrator=integrator, **STEPS)
    np.testing.assert_allclose(motion.q[:, own], apart.q, rtol=0, atol=1e-12)
    A = vp.linearize(whole, motion).A
    both = np.array([*own, *(5 + i for i in own)])
    np.testing.assert_allclose(A[:, both[:, None], both], vp.linearize(without, apart).A, rtol=0, atol=1e-9)
    assert not A[:, np.tile(between(whole.robot), (2, 2))].any()


def test_in_halves():
    """Steps that the guards split, with their derivatives chained."""
    scene, (q, v) = vp.Scene(forest()), np.random.default_rng(0).uniform(-1.0, 1.0, (2, 8))
    motion = vp.simulate(scene, q, 4.0 * v, dt=0.1, steps=10, integrator=vp.Midpoint())
    assert motion.statistics.split_steps > 3
    lin = vp.linearize(scene, motion)
    assert not lin.A[:, np.tile(between(scene.robot), (2, 2))].any()
    J = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(8))
    for A in lin.A:
        np.testing.assert_allclose(A.T @ J @ A, J, rtol=0, atol=1e-9 * np.abs(A).max() ** 2)


def test_what_robots_know_goes_along():
    both = vp.combine(*ARMS, placements=[PLACE, None])
    assert both.joint_names == ARMS[0].joint_names + ARMS[1].joint_names
    for what in ("effort_limit", "velocity_limit", "damping", "friction", "position_limits"):
        np.testing.assert_array_equal(getattr(both, what), np.hstack([getattr(robot, what) for robot in ARMS]))
    np.testing.assert_array_equal(both.posture("default")[:8], ARMS[0].posture("default"))
    twice = vp.combine(ARMS[0], ARMS[0], prefixes=["a_", "b_"])
    np.testing.assert_array_equal(twice.posture("default"), np.tile(ARMS[0].posture("default"), 2))
    np.testing.assert_array_equal(vp.Scene(both, damping=0).armature, [0.0] * 8 + [0.02] * 6)
    assert len(both.ties) == 1


def assert_placed(robot, q, expected):
    """The robot's shapes at q (n,) are where they should be, by name."""
    found = placed(robot.model, geometry(robot), robot.configuration(q))
    assert found.keys() == expected.keys()
    for name, place in expected.items():
        np.testing.assert_allclose(found[name].homogeneous, place.homogeneous, atol=1e-12)


def placed(model, shapes, q):
    data = shapes.createData()
    pin.updateGeometryPlacements(model, model.createData(), shapes, data, q)
    return {shape.name: place.copy() for shape, place in zip(shapes.geometryObjects, data.oMg, strict=True)}


@pytest.mark.slow
def test_shapes_stand_where_the_parts_put_them():
    both, q = vp.combine(*ARMS, placements=[None, PLACE]), np.random.default_rng(1).normal(size=14)
    first, second = (
        placed(robot.model, geometry(robot), robot.configuration(own))
        for robot, own in zip(ARMS, (q[:8], q[8:]), strict=True)
    )
    assert_placed(both, q, first | {name: PLACE * place for name, place in second.items()})
    shapes, missing = readable_geometry(both)
    assert not missing
    for shape in shapes.geometryObjects:
        assert both.model.frames[shape.parentFrame].parentJoint == shape.parentJoint


@pytest.mark.parametrize("lock", [{}, {"joint1": 0.4}, {"joint0": -0.3, "joint5": 1.2}])
def test_shapes_of_a_wrapper_stand_as_in_the_unlocked_model(lock):
    model, rng = random_tree(11, branching=False), np.random.default_rng(0)
    shapes = pin.GeometryModel()
    for k in range(1, model.njoints):
        place = pin.SE3(random_rotation(rng), rng.normal(size=3))
        shapes.addGeometryObject(pin.GeometryObject(f"shape{k}", k, place, pin.hppfcl.Sphere(0.1)))
    whole, robot = (vp.load_robot(pin.RobotWrapper(model, visual_model=shapes), lock=at) for at in ({}, lock))
    assert all(shape.parentFrame < robot.model.nframes for shape in geometry(robot).geometryObjects)
    q = rng.uniform(-2.0, 2.0, whole.dof)
    for name, position in lock.items():
        q[whole.coordinate(name)] = position
    own = [whole.coordinate(name) for name in robot.joint_names]
    assert_placed(robot, q[own], placed(model, shapes, whole.configuration(q)))


def test_names_that_clash_get_a_prefix():
    arm = ARMS[1]
    twins = vp.combine(arm, arm, placements=[None, PLACE], prefixes=["left_", "right_"])
    assert twins.joint_names == tuple(f"{side}_{name}" for side in ("left", "right") for name in arm.joint_names)
    assert vp.combine(arm, arm).joint_names[0] == "a_shoulder_pan_joint"
    assert vp.combine(arm, vp.load_robot("ur3")).joint_names[0] == "ur5_shoulder_pan_joint"
    four = vp.combine(twins, ARMS[0], twins)
    assert four.dof == 32
    assert four.joint_names[0] == "a_left_shoulder_pan_joint"
    assert len(geometry(four).geometryObjects) == 4 * 7 + 11
    locked = vp.load_robot("ur5", lock={"wrist_3_joint": 0.3})
    assert vp.combine(locked, locked).locked == {"a_wrist_3_joint": 0.3, "b_wrist_3_joint": 0.3}
