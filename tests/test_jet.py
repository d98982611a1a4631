from __future__ import annotations

import naive
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import random_tree

import varpin as vp

NAMES = ("Lq", "Lv", "Lqq", "Lvq", "Lvv")


def busy_scene(robot: vp.Robot, rng: np.random.Generator) -> vp.Scene:
    n = robot.dof
    return vp.Scene(
        robot, gravity=rng.normal(0.0, 6.0, 3), stiffness=rng.uniform(0.0, 3.0, n), rest=rng.uniform(-1.0, 1.0, n)
    )


def assert_close(actual: np.ndarray, expected: np.ndarray, rtol: float, what: str, scale: float = 0.0) -> None:
    """Agreement to ``rtol`` of the largest entry, or of ``scale`` where everything might vanish."""
    scale = max(scale, np.abs(expected).max())
    np.testing.assert_allclose(actual, expected, rtol=0, atol=rtol * scale, err_msg=what)


def naive_first(scene: vp.Scene, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """L_q and L_v at q, v (..., n) by complex step."""
    n = scene.robot.dof
    x = np.concatenate(np.broadcast_arrays(q, v), axis=-1)
    g = naive.gradient(lambda y: naive.lagrangian(scene, y[..., :n], y[..., n:]), x)
    return g[..., :n], g[..., n:]


def check_against_naive(scene: vp.Scene, q: np.ndarray, v: np.ndarray, directions: np.ndarray, backend: str) -> None:
    jet = vp.lagrangian_jet(scene, q, v, backend=backend)
    kinetic = 0.5 * v @ jet.Lvv @ v
    L = naive.lagrangian(scene, q, v)
    assert abs(jet.L - L) <= 1e-13 * (abs(kinetic) + abs(kinetic - L)) * scene.robot.dof
    Lq, Lv = naive_first(scene, q, v)
    assert_close(jet.Lq, Lq, 1e-12, "Lq")
    assert_close(jet.Lv, Lv, 1e-12, "Lv")
    in_q = naive.directional(lambda x: np.stack(naive_first(scene, x, v), axis=1), q, directions)
    in_v = naive.directional(lambda x: naive_first(scene, q, x)[1], v, directions)
    # Two single joints side by side have no L_vq at all; differences then leave rounding of L_v.
    momentum = np.abs(Lv).max()
    assert_close(directions @ jet.Lqq, in_q[:, 0], 2e-11, "Lqq", momentum)
    assert_close(directions @ jet.Lvq.T, in_q[:, 1], 2e-11, "Lvq", momentum)
    assert_close(directions @ jet.Lvv, in_v, 2e-11, "Lvv")


def test_compiled_is_what_pinocchio_computes(robot):
    q, v = np.random.default_rng(0).normal(0.0, 2.0, (2, robot.dof))
    scene = busy_scene(robot, np.random.default_rng(1))
    compiled, reference = (vp.lagrangian_jet(scene, q, v, backend=backend) for backend in ("compiled", "pinocchio"))
    for name in NAMES:
        assert_close(getattr(compiled, name), getattr(reference, name), 1e-12, name)
    kinetic = 0.5 * v @ reference.Lvv @ v
    assert abs(compiled.L - reference.L) <= 1e-12 * (kinetic + abs(kinetic - reference.L))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), bodies=st.integers(1, 9), branching=st.booleans())
@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_random_trees(backend, seed, bodies, branching):
    robot = vp.load_robot(random_tree(seed, bodies, branching=branching))
    rng = np.random.default_rng(seed)
    q, v = rng.uniform(-3.0, 3.0, bodies), rng.normal(0.0, 2.0, bodies)
    check_against_naive(busy_scene(robot, rng), q, v, np.eye(bodies), backend)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6))
def test_symmetries_are_exact_and_mass_is_positive(seed):
    robot = vp.load_robot(random_tree(seed, 8))
    rng = np.random.default_rng(seed)
    jet = vp.lagrangian_jet(busy_scene(robot, rng), rng.normal(size=8), rng.normal(size=8))
    assert np.array_equal(jet.Lvv, jet.Lvv.T)
    assert np.array_equal(jet.Lqq, jet.Lqq.T)
    assert np.linalg.eigvalsh(jet.Lvv)[0] > 0.0


@pytest.mark.parametrize("name", ["ur5", "xarm7", "allegro_left_hand"])
def test_a_base_ten_kilometres_away_costs_no_digits(load, name):
    near = load(name)
    model = near.model.copy()
    for joint in range(1, model.njoints):
        if model.parents[joint] == 0:
            placement = model.jointPlacements[joint]
            moved = placement.translation + np.array([1e4, -1e4, 3e3])
            model.jointPlacements[joint] = pin.SE3(placement.rotation, moved)
    q, v = np.random.default_rng(0).normal(size=(2, near.dof))
    here, there = (vp.lagrangian_jet(vp.Scene(own), q, v) for own in (near, vp.load_robot(model)))
    for entry in NAMES:
        assert_close(getattr(there, entry), getattr(here, entry), 1e-12, entry)


def test_exact_zeros_between_branches():
    filled = dict.fromkeys(("Lqq", "Lvq", "Lvv"), 0)
    for seed in range(20):
        robot = vp.load_robot(random_tree(seed, 8))
        parent = robot.tree.parent

        def line(j, parent=parent):
            return {j} | (line(parent[j]) if parent[j] >= 0 else set())

        apart = np.array([[i not in line(j) and j not in line(i) for j in range(8)] for i in range(8)])
        rng = np.random.default_rng(seed)
        jet = vp.lagrangian_jet(busy_scene(robot, rng), rng.normal(size=8), rng.normal(size=8))
        for name in filled:
            assert not getattr(jet, name)[apart].any()
            filled[name] += np.count_nonzero(getattr(jet, name)[~apart])
    assert min(filled.values()) > 200
