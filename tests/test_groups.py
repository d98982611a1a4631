"""Branches that share no inertia: a step treats each by itself, and the answer is that of each alone."""

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import joint, link, mimic, random_inertia, random_rotation, random_tree, write_urdf

import varpin as vp

INTEGRATORS = [vp.Midpoint(), vp.Midpoint(0.3), vp.Gauss(2), vp.SemiImplicitEuler(), vp.RungeKutta4()]
SIZES = (3, 1, 4)


def forest(*chains):
    """These chains side by side, each always the same."""
    model = pin.Model()
    for chain in chains:
        parent = 0
        for k in range(SIZES[chain]):
            rng = np.random.default_rng([chain, k])
            kind = pin.JointModelPX() if rng.random() < 0.2 else pin.JointModelRY()
            placement = pin.SE3(random_rotation(rng), rng.normal(0.0, 0.3, 3))
            parent = model.addJoint(parent, kind, placement, f"{chain}.{k}")
            model.appendBodyToJoint(parent, random_inertia(rng), pin.SE3.Identity())
    return vp.load_robot(model)


def tied(folder, *, between):
    """Two branches of two joints, the first joint of the second one tied to that of the first; one between them."""
    chains = {"a": "", "b": "", "c": mimic("a1", -0.5, 0.1)}
    parts = []
    for name, inside in chains.items():
        if between or name != "b":
            parts += [link(f"{name}_1") + joint(f"{name}1", "base", f"{name}_1", inside=inside)]
            parts += [link(f"{name}_2") + joint(f"{name}2", f"{name}_1", f"{name}_2")]
    return vp.load_robot(write_urdf(folder, *parts, name=f"tied_{between}"))


def busy(robot, **more):
    """A scene on a forest with every term in it; a joint of one name has the same in each."""
    own = np.array([1.0 + 0.3 * int(name[0]) + 0.1 * int(name[2]) for name in robot.joint_names])
    return vp.Scene(robot, damping=0.05 * own, stiffness=0.5 * own, rest=0.2 * own, **more)


def state(robot):
    """A state in which each joint has the same wherever it stands."""
    draws = [np.random.default_rng([9, int(name[0]), int(name[2])]).uniform(-1.0, 1.0, 2) for name in robot.joint_names]
    return np.array(draws).T


class TestCuts:
    def test_on_random_trees_no_group_lies_across_one_and_none_is_missing(self):
        seen = set()
        for seed in range(60):
            tree = vp.load_robot(random_tree(seed, 6)).tree
            n = tree.group.size
            across = [c for c in range(1, n) if set(tree.group[:c]) & set(tree.group[c:])]
            assert list(tree.ends) == [c for c in range(1, n + 1) if c not in across]
            seen.add(len(tree.ends))
            # Joints come subtree by subtree: no group stands within another.
            assert tree.groups == len(tree.ends)
        assert {1, 2, 3} <= seen


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=str)
def test_together_as_each_alone(integrator):
    together = forest(0, 1, 2)
    assert together.tree.ends.tolist() == [3, 4, 8]
    noise = vp.AdditiveNoise(0.02)
    scene, (q, v) = busy(together, noise=noise), state(together)
    dw = 0.03 * np.random.default_rng(0).normal(size=(40, together.dof))
    n = together.dof
    # Feedback of every chain on every other: controls are constant over a step and couple no matrix of it.
    gains = np.random.default_rng(1).normal(0.0, 0.1, (40, n, 2 * n))
    law = vp.LinearPolicy(np.full((40, n), 0.1), gains, np.zeros((40, 2 * n)))
    motion = vp.simulate(scene, q, v, dt=5e-3, steps=40, controls=law, increments=dw, integrator=integrator)
    assert np.abs(motion.u - 0.1).min() > 0.0
    lin = vp.linearize(scene, motion, integrator=integrator)
    curved = isinstance(integrator, (vp.Midpoint, vp.Gauss))
    z = np.random.default_rng(2).normal(size=2 * n)
    xx = vp.second_order(scene, motion, z, integrator=integrator).xx if curved else np.zeros((1, 2 * n, 2 * n))
    outside = np.ones((n, n), dtype=bool)
    for chain in range(3):
        one = forest(chain)
        own = np.arange(*np.append(0, together.tree.ends)[chain : chain + 2])
        apart = busy(one, noise=noise)
        moved = vp.simulate(
            apart,
            q[own],
            v[own],
            dt=5e-3,
            steps=40,
            controls=motion.u[:, own],
            increments=dw[:, own],
            integrator=integrator,
        )
        np.testing.assert_allclose(motion.q[:, own], moved.q, rtol=0, atol=1e-12)
        np.testing.assert_allclose(motion.p[:, own], moved.p, rtol=0, atol=1e-12)
        both = np.concatenate([own, own + n])
        single = vp.linearize(apart, moved, integrator=integrator)
        np.testing.assert_allclose(lin.A[:, both[:, None], both], single.A, rtol=0, atol=1e-9)
        np.testing.assert_allclose(lin.B[:, both[:, None], own], single.B, rtol=0, atol=1e-11)
        if curved:
            there = vp.second_order(apart, moved, z[both], integrator=integrator).xx
            np.testing.assert_allclose(xx[:, both[:, None], both], there, rtol=0, atol=1e-9)
        outside[np.ix_(own, own)] = False
    # Between chains there is nothing, to the last bit.
    assert not lin.A[:, np.tile(outside, (2, 2))].any()
    assert not lin.B[:, np.tile(outside, (2, 1))].any()
    assert not xx[:, np.tile(outside, (2, 2))].any()


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=str)
def test_a_branch_between_two_that_a_mimic_joint_ties(tmp_path, integrator):
    """Its coordinates stand between those of another group, so that both share a block."""
    whole, without = tied(tmp_path, between=True), tied(tmp_path, between=False)
    assert whole.joint_names == ("a1", "a2", "b1", "b2", "c2")
    assert (whole.tree.groups, list(whole.tree.ends)) == (2, [5])
    own = [0, 1, 4]
    q, v = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 5))
    options = {"dt": 5e-3, "steps": 40, "integrator": integrator}
    motion = vp.simulate(vp.Scene(whole, damping=0.1), q, v, **options)
    apart = vp.simulate(vp.Scene(without, damping=0.1), q[own], v[own], **options)
    np.testing.assert_allclose(motion.q[:, own], apart.q, rtol=0, atol=1e-12)
    A = vp.linearize(vp.Scene(whole, damping=0.1), motion, integrator=integrator).A
    single = vp.linearize(vp.Scene(without, damping=0.1), apart, integrator=integrator).A
    both = np.array([*own, *(5 + i for i in own)])
    np.testing.assert_allclose(A[:, both[:, None], both], single, rtol=0, atol=1e-9)
    outside = np.tile(whole.tree.group[:, None] != whole.tree.group, (2, 2))
    assert not A[:, outside].any()


def test_in_halves():
    """Steps that the guards split, with their derivatives chained."""
    together = forest(0, 1, 2)
    scene, (q, v) = vp.Scene(together), state(together)
    motion = vp.simulate(scene, q, 4.0 * v, dt=0.1, steps=10, integrator=vp.Midpoint())
    assert motion.statistics.split_steps > 3
    lin = vp.linearize(scene, motion)
    outside = np.tile(together.tree.group[:, None] != together.tree.group, (2, 2))
    assert not lin.A[:, outside].any()
    J = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(together.dof))
    for A in lin.A:
        np.testing.assert_allclose(A.T @ J @ A, J, rtol=0, atol=1e-9 * np.abs(A).max() ** 2)
