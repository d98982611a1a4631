"""The Lagrangian against Pinocchio, and steps of large trees, solved from the leaves to the roots."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import random_tree
from oracles import assert_jet, slope

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


def test_compiled_is_what_pinocchio_computes(robot):
    q, v = np.random.default_rng(0).normal(0.0, 2.0, (2, robot.dof))
    scene = busy_scene(robot, np.random.default_rng(1))
    compiled = vp.lagrangian_jet(scene, q, v)
    reference = vp.lagrangian_jet(scene, q, v, backend="pinocchio")
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
    assert_jet(busy_scene(robot, rng), q, v, backend)


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


def tied(count=5, seed=1):
    """Ties between any joints, which no elimination takes: leaders with several followers, spans that overlap."""
    rng = np.random.default_rng(seed)
    model = random_tree(seed, bodies=9 + 2 * count)
    single = [joint for joint in range(1, model.njoints) if model.joints[joint].nq == 1]
    followers, leaders = set(), set()
    while len(followers) < count:
        leader, follower = (int(joint) for joint in sorted(rng.choice(single, 2, replace=False)))
        if {leader, follower} & followers or follower in leaders:
            continue
        followers.add(follower)
        leaders.add(leader)
        model = pin.transformJointIntoMimic(model, leader, follower, rng.uniform(-2.0, 2.0), rng.normal())
    return vp.load_robot(model)


ROBOTS = {
    "chain": lambda: vp.planar_chain(40),
    "many branches": lambda: vp.load_robot(random_tree(5, bodies=36)),
    "heavy tip": lambda: vp.load_robot(random_tree(11, bodies=30, ratio=1e4)),
    "ties": tied,
    "small": lambda: vp.planar_chain(3),
}
H = 1e-3
DAMPING, FRICTION = 0.05, 0.2


@pytest.fixture(params=ROBOTS, scope="module")
def tree(request):
    return ROBOTS[request.param]()


def scene_of(tree):
    friction = vp.CoulombFriction(FRICTION, width=0.5)
    return vp.Scene(tree, stiffness=0.3, rest=0.1, damping=DAMPING, friction=0.0, forces=friction)


def state_of(tree, seed=2):
    rng = np.random.default_rng(seed)
    return 0.3 * rng.uniform(-2.0, 2.0, tree.dof), 0.2 * rng.normal(size=tree.dof)


def jet_of(scene, q, v):
    return vp.lagrangian_jet(scene, q, v, backend="pinocchio")


def test_steps_solve_their_equation(tree):
    """(S1) of docs/mathematics.md, by Pinocchio's matrices."""
    scene, (q, v), u = scene_of(tree), state_of(tree), 0.1 * np.cos(np.arange(tree.dof))
    motion = vp.simulate(scene, q, v, dt=H, steps=1, controls=u, integrator=vp.Midpoint(), check=False)
    assert motion.statistics.substeps.tolist() == [1]
    assert motion.statistics.residual.max() <= 100.0
    V = (motion.q[1] - q) / H
    jet, p = jet_of(scene, q + 0.5 * H * V, V), jet_of(scene, q, v).Lv
    force = jet.Lq + u - DAMPING * V - FRICTION * np.tanh(V / 0.5)
    size = (np.abs(jet.Lvv) @ np.abs(V)).max()
    np.testing.assert_allclose(p + 0.5 * H * force, jet.Lv, rtol=0, atol=1e-11 * size)
    np.testing.assert_allclose(motion.p[1], p + H * force, rtol=0, atol=1e-11 * np.abs(p).max())
    M = jet_of(scene, motion.q[1], motion.v[1]).Lvv
    assert np.abs(M @ motion.v[1] - motion.p[1]).max() <= 1e-12 * (np.abs(M) @ np.abs(motion.v[1])).max()


def test_the_branch_margin_is_the_least_ratio_of_pivots(tree):
    """(G1) at the midpoint: of M - (h/2) F_v - h^2 reach L_qq / (1 - margin), with reach 1/4 and margin 1/2, and M."""
    scene, h = vp.Scene(tree, stiffness=0.3, damping=DAMPING, friction=0.0), 2e-3
    q, v = state_of(tree)
    # The pivots are those of the last factors, at a guess that is close once there are steps to extrapolate.
    motion = vp.simulate(scene, q, v, dt=h, steps=8, integrator=vp.Midpoint(), check=False)
    assert (motion.statistics.substeps == 1).all()
    jet = jet_of(scene, 0.5 * (motion.q[-2] + motion.q[-1]), (motion.q[-1] - motion.q[-2]) / h)
    C = jet.Lvv + 0.5 * h * DAMPING * np.eye(tree.dof) - 0.5 * h * h * jet.Lqq
    # From the last coordinate to the first.
    pivots = [np.diag(np.linalg.cholesky(matrix[::-1, ::-1])) ** 2 for matrix in (C, jet.Lvv)]
    assert motion.statistics.branch_margin[-1] - 1.0 == pytest.approx(
        (pivots[0] / pivots[1]).min() - 1.0, rel=1e-3, abs=1e-6
    )


@pytest.mark.parametrize("integrator", [vp.ExplicitEuler(), vp.SemiImplicitEuler()], ids=str)
def test_accelerations_are_pinocchios(tree, integrator):
    scene, u = vp.Scene(tree, damping=0.0, friction=0.0), np.cos(np.arange(tree.dof))
    q, v = state_of(tree)
    motion = vp.simulate(scene, q, v, dt=H, steps=1, controls=u, integrator=integrator, check=False)
    data, at, rates = tree.model.createData(), tree.configuration(q), tree.velocity(v)
    M = jet_of(scene, q, v).Lvv
    force = u - tree.velocity(np.eye(tree.dof)) @ pin.nonLinearEffects(tree.model, data, at, rates)
    assert np.array_equal(motion.q[1], q + H * (v if integrator == vp.ExplicitEuler() else motion.v[1]))
    left = M @ ((motion.v[1] - v) / H) - force
    assert np.abs(left).max() <= 1e-9 * (np.abs(M) @ np.abs(np.linalg.solve(M, force))).max()


def test_derivatives_of_long_chains_are_those_of_differences():
    scene, n = vp.Scene(vp.planar_chain(60), damping=0.1, stiffness=1.0), 60
    rng = np.random.default_rng(7)
    q, v = rng.uniform(-0.2, 0.2, n), 0.1 * rng.normal(size=n)
    options = {"dt": 1e-2, "steps": 1, "check": False, "integrator": vp.Midpoint(tolerance=0.1)}
    lin = vp.linearize(scene, vp.simulate(scene, q, v, **options))
    # Directions dp = M dv, as long ones would take the chain apart.
    M, (dq, dv, du) = vp.lagrangian_jet(scene, q, v).Lvv, 0.1 * rng.normal(size=(3, n))

    def end(s):
        at = q + s[0] * dq
        rates = np.linalg.solve(vp.lagrangian_jet(scene, at, v).Lvv, M @ (v + s[0] * dv))
        moved = vp.simulate(scene, at, rates, controls=s[0] * du, **options)
        return np.append(moved.q[1], moved.p[1])

    expected = slope(end, np.zeros(1), np.ones(1), 1e-3)
    found = lin.A[0] @ np.append(dq, M @ dv) + lin.B[0] @ du
    for half in (slice(0, n), slice(n, None)):
        np.testing.assert_allclose(found[half], expected[half], rtol=0, atol=1e-5 * np.abs(expected[half]).max())


@pytest.mark.parametrize("links", [200, pytest.param(1000, marks=pytest.mark.slow)])
def test_long_chains_move_and_keep_their_energy(links):
    scene = vp.Scene(vp.planar_chain(links))
    motion = vp.simulate(scene, np.full(links, 0.01), np.zeros(links), dt=1e-3, steps=10)
    assert (motion.statistics.substeps == 1).all()
    turned = np.abs(motion.energy - motion.energy[0]).max()
    kinetic = 0.5 * motion.v[-1] @ motion.p[-1]
    assert turned <= 1e-4 * kinetic
    assert (motion.statistics.residual <= 100.0).all()
