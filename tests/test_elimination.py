"""Solves by elimination from the leaves to the roots, against NumPy's on matrices that are formed."""

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import random_inertia, random_rotation, random_tree

import varpin as vp
from varpin.core import Elimination, ForwardDynamics, Solver, VariationalRollout, variational_derivatives
from varpin.core.arrays import new_nodes
from varpin.integrators.base import open_loop


def star(branches, links, seed=0):
    """Chains of oblique joints that all hang on one body."""
    rng = np.random.default_rng(seed)
    model = pin.Model()
    model.name = f"star{branches}"

    def add(parent, name):
        axis = rng.normal(size=3)
        kind = pin.JointModelRevoluteUnaligned(axis / np.linalg.norm(axis))
        placement = pin.SE3(random_rotation(rng), rng.normal(0.0, 0.2, 3))
        joint = model.addJoint(parent, kind, placement, name)
        model.appendBodyToJoint(joint, random_inertia(rng), pin.SE3.Identity())
        return joint

    trunk = add(0, "trunk")
    for branch in range(branches):
        parent = trunk
        for link in range(links):
            parent = add(parent, f"branch{branch}_{link}")
    return vp.load_robot(model)


def floating(seed=0):
    """Two legs and two arms on a body that slides and turns freely, far from where it began."""
    rng = np.random.default_rng(seed)
    model = pin.Model()
    model.name = "floating"
    parent = 0
    slides, turns = [pin.JointModelPX, pin.JointModelPY, pin.JointModelPZ], [pin.JointModelRX, pin.JointModelRY]
    for k, kind in enumerate([*slides, *turns, pin.JointModelRZ]):
        parent = model.addJoint(parent, kind(), pin.SE3.Identity(), f"base{k}")
    model.appendBodyToJoint(parent, random_inertia(rng), pin.SE3.Identity())
    base = parent
    for limb in range(4):
        parent = base
        for k in range(5):
            kind = [pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ][k % 3]()
            parent = model.addJoint(parent, kind, pin.SE3(random_rotation(rng), rng.normal(0.0, 0.2, 3)), f"l{limb}{k}")
            model.appendBodyToJoint(parent, random_inertia(rng), pin.SE3.Identity())
    return vp.load_robot(model)


ROBOTS = {
    **{f"chain{n}": lambda n=n: vp.planar_chain(n) for n in (1, 2, 15, 30)},
    **{f"tree{seed}": lambda seed=seed: vp.load_robot(random_tree(seed, bodies=4 + 4 * seed)) for seed in range(6)},
    "heavy tip": lambda: vp.load_robot(random_tree(11, bodies=8, ratio=1e4)),
    "star": lambda: star(7, 3),
    "floating": floating,
    "ur5": lambda: vp.load_robot("ur5"),
    "allegro": lambda: vp.load_robot("allegro_left_hand"),
}


@pytest.fixture(params=ROBOTS, scope="module")
def robot(request):
    return ROBOTS[request.param]()


def scene_of(robot, seed=1):
    rng = np.random.default_rng(seed)
    weight = np.diag(vp.lagrangian_jet(vp.Scene(robot), np.zeros(robot.dof), np.zeros(robot.dof)).Lvv)
    return vp.Scene(robot, damping=0.3 * weight, stiffness=weight, rest=rng.normal(size=robot.dof))


def state_of(robot, seed=2):
    rng = np.random.default_rng(seed)
    return rng.uniform(-2.0, 2.0, robot.dof), rng.normal(size=robot.dof)


def solved_like(x, matrix, b, eps=1e-12):
    """Whether x solves as well as a backward stable method does."""
    return np.abs(matrix @ x - b).max() <= eps * (np.abs(matrix) @ np.abs(x) + np.abs(b)).max()


@pytest.mark.parametrize(("ahead", "behind"), [(0.05, 0.05), (0.02, 0.06), (0.1, 0.0)])
def test_a_step_is_solved_for_as_with_the_matrix(robot, ahead, behind):
    scene, (q, v) = scene_of(robot), state_of(robot)
    jet = vp.lagrangian_jet(scene, q, v, backend="pinocchio")
    rng = np.random.default_rng(3)
    b, extra = rng.normal(size=robot.dof), rng.uniform(0.0, 0.1, robot.dof) * np.diag(jet.Lvv)
    N = jet.Lvv + ahead * jet.Lvq - behind * jet.Lvq.T - ahead * behind * jet.Lqq + np.diag(extra)
    diagonal = robot.tree.armature + extra + ahead * behind * scene.stiffness
    x, slope, size, positive = Elimination(scene.core, q, v).step(ahead, behind, diagonal, b)
    # Without exchanges elimination may meet a pivot that is not positive only where the symmetric part is indefinite.
    if np.linalg.eigvalsh(N + N.T).min() <= 0.0:
        pytest.skip("the step is beyond the branch guard")
    assert positive
    assert solved_like(x, N, b)
    # `slope` lacks the springs, which callers add.
    expected = jet.Lvq.T @ x + ahead * (jet.Lqq + np.diag(scene.stiffness)) @ x
    scale = np.abs(jet.Lvq.T) @ np.abs(x) + ahead * np.abs(jet.Lqq) @ np.abs(x)
    assert np.abs(slope - expected).max() <= 1e-12 * scale.max()
    assert size == pytest.approx(x @ jet.Lvv @ x, rel=1e-10)


def test_velocities_and_shares_of_the_energy_are_those_of_the_mass_matrix(robot):
    scene, (q, v) = scene_of(robot), state_of(robot)
    M = vp.lagrangian_jet(scene, q, v, backend="pinocchio").Lvv
    p = M @ v
    x, share, positive = Elimination(scene.core, q, v).mass(p)
    assert positive
    assert solved_like(x, M, p)
    # M = U D U' with ones on the diagonal of U: the last coordinate is eliminated first.
    lower = np.linalg.cholesky(M[::-1, ::-1])[::-1, ::-1]
    shares = 0.5 * np.linalg.solve(lower, p) ** 2
    assert np.abs(share - shares).max() <= 1e-10 * shares.sum()


@pytest.mark.parametrize("skew", [0.0, 0.2])
def test_the_guard_has_the_sign_of_the_least_eigenvalue(robot, skew):
    scene = scene_of(robot)
    signs = set()
    for seed in range(6):
        q, v = state_of(robot, seed)
        jet = vp.lagrangian_jet(scene, q, (1 + 4 * seed) * v, backend="pinocchio")
        elimination = Elimination(scene.core, q, (1 + 4 * seed) * v)
        for h in (1e-4, 1e-2, 0.1, 1.0):
            coupling, curvature = skew * h, h * h
            C = jet.Lvv + coupling * (jet.Lvq + jet.Lvq.T) - curvature * jet.Lqq
            diagonal = robot.tree.armature + curvature * scene.stiffness
            ratio = elimination.least_pivot_ratio(coupling, curvature, diagonal)
            half = np.linalg.inv(np.linalg.cholesky(jet.Lvv))
            least = np.linalg.eigvalsh(half @ C @ half.T).min()
            if abs(least) < 1e-6:
                continue
            signs.add(least > 0.0)
            assert (ratio > 0.0) == (least > 0.0)
            assert ratio >= min(least, 0.0) * (1.0 + 1e-9)
            if least > 0.0:
                pivots = [np.diag(np.linalg.cholesky(matrix[::-1, ::-1])) ** 2 for matrix in (C, jet.Lvv)]
                assert ratio == pytest.approx((pivots[0] / pivots[1]).min(), rel=1e-7)
    assert signs == {True, False} or robot.dof < 3


def rolled(scene, q, v, dt, steps, solver, integrator):
    run = VariationalRollout(
        scene.core, integrator._tableau(), float(integrator.tolerance), integrator._guards(), 1.0, 1, solver
    )
    assert run.begin(q[None], v[None])
    nodes = new_nodes(1, steps, scene.robot.dof, scene.controls)
    rng = np.random.default_rng(4)
    u = 0.1 * rng.normal(size=(steps, scene.controls))
    run.roll(dt, open_loop(u), scene.silence, np.empty((0, 0, 0)), nodes)
    return nodes


# What the energy guard allows depends on whose the kinetic energy is said to be, which differs; so it allows all.
LENIENT = vp.Guard(energy_balance=1.0, energy_budget=1.0)
INTEGRATORS = [
    vp.Midpoint(guard=LENIENT),
    vp.Midpoint(alpha=0.4, guard=LENIENT),
    vp.Gauss(2, guard=LENIENT),
    vp.Gauss(3, guard=LENIENT),
    vp.Radau(2, guard=LENIENT),
]


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=["midpoint", "alpha", "gauss2", "gauss3", "radau2"])
def test_motions_are_those_with_matrices(robot, integrator):
    scene, (q, v) = scene_of(robot), state_of(robot)
    dense, eliminated = (
        rolled(scene, q, 0.2 * v, 1e-3, 20, solver, integrator) for solver in (Solver.dense, Solver.elimination)
    )
    assert dense.done == eliminated.done == 20
    assert np.array_equal(dense.tally[0, :, 3], eliminated.tally[0, :, 3])
    for name, eps in (("q", 1e-10), ("v", 1e-7), ("p", 1e-10), ("energy", 1e-10)):
        expected = getattr(dense, name)
        assert np.abs(getattr(eliminated, name) - expected).max() <= eps * max(np.abs(expected).max(), 1e-3)
    assert eliminated.quality[..., 1] == pytest.approx(dense.quality[..., 1], rel=1e-5)
    assert eliminated.quality[..., 0].max() <= 100.0


@pytest.mark.parametrize(("integrator", "stages"), [(vp.Midpoint(), 1), (vp.Gauss(2), 2)], ids=["midpoint", "gauss2"])
def test_derivatives_are_those_with_matrices(robot, integrator, stages):
    scene, (q, v) = scene_of(robot), state_of(robot)
    p = vp.lagrangian_jet(scene, q, v).Lv
    fixed = scene.core, integrator._tableau(), float(integrator.tolerance), integrator._guards(), 1e-3
    guess = np.broadcast_to(v, (1, stages, robot.dof)).copy()
    at = q[None], p[None], np.zeros((1, robot.dof)), np.ones(1, dtype=np.int64), np.zeros(0, dtype=np.uint8)
    (Ax, Af, *done), (Bx, Bf, *also) = (
        variational_derivatives(*fixed, *at, guess=guess, solver=solver)
        for solver in (Solver.dense, Solver.elimination)
    )
    assert done == also == [0, 1]
    for A, B in ((Ax, Bx), (Af, Bf)):
        assert np.abs(A - B).max() <= 1e-8 * np.abs(A).max()


def test_accelerations_are_pinocchios(robot):
    scene, (q, v) = vp.Scene(robot), state_of(robot)
    force = np.random.default_rng(6).normal(size=robot.dof)
    dynamics = ForwardDynamics(scene.core, Solver.elimination)
    rate, regular = dynamics.rate(np.r_[q, v], force)
    assert regular
    data, at, rates = robot.free_model.createData(), robot.free_positions(q), robot.free_velocities(v)
    M = vp.lagrangian_jet(scene, q, v, backend="pinocchio").Lvv
    bias = pin.nonLinearEffects(robot.free_model, data, at, rates)
    assert np.array_equal(rate[: robot.dof], v)
    assert solved_like(rate[robot.dof :], M, force - bias, eps=1e-11)
    momentum, energy, _ = dynamics.node(np.r_[q, v])
    assert np.abs(momentum - M @ v).max() <= 1e-12 * (np.abs(M) @ np.abs(v)).max()
    assert energy == pytest.approx(ForwardDynamics(scene.core, Solver.dense).node(np.r_[q, v])[1], rel=1e-12)


@pytest.mark.parametrize("distance", [0.0, 1e3, 1e6])
def test_a_floating_body_keeps_its_digits_far_away(distance):
    scene = vp.Scene(floating(), gravity=False)
    q, v = state_of(scene.robot)
    q[:3] = distance * np.array([1.0, -1.0, 1.0])
    jet = vp.lagrangian_jet(scene, q * np.r_[np.zeros(3), np.ones(23)], v, backend="pinocchio")
    N = jet.Lvv + 0.01 * (jet.Lvq - jet.Lvq.T) - 1e-4 * jet.Lqq
    b = np.random.default_rng(5).normal(size=26)
    x, *_, positive = Elimination(scene.core, q, v).step(0.01, 0.01, np.zeros(26), b)
    assert positive
    assert solved_like(x, N, b)


def test_derivatives_of_long_chains_are_those_of_differences():
    links = 60
    scene, integrator = vp.Scene(vp.planar_chain(links), damping=0.1, stiffness=1.0), vp.Midpoint(tolerance=0.1)
    rng = np.random.default_rng(7)
    q, v = rng.uniform(-0.2, 0.2, links), 0.1 * rng.normal(size=links)
    motion = vp.simulate(scene, q, v, dt=1e-2, steps=1, integrator=integrator)
    lin = vp.linearize(scene, motion)
    M = vp.lagrangian_jet(scene, q, v).Lvv
    # Directions dp = M dv, as long ones would take the chain apart.
    dq, dv, du = 0.1 * rng.normal(size=(3, links))
    expected = lin.A[0] @ np.r_[dq, M @ dv] + lin.B[0] @ du
    eps, ends = 1e-5, []
    for sign in (1.0, -1.0):
        at = q + sign * eps * dq
        p = M @ v + sign * eps * (M @ dv)
        rates = np.linalg.solve(vp.lagrangian_jet(scene, at, v).Lvv, p)
        moved = vp.simulate(scene, at, rates, dt=1e-2, steps=1, controls=sign * eps * du, integrator=integrator)
        ends.append(np.r_[moved.q[-1], moved.p[-1]])
    difference = (ends[0] - ends[1]) / (2.0 * eps)
    for half in (slice(0, links), slice(links, None)):
        assert np.abs(difference[half] - expected[half]).max() <= 1e-5 * np.abs(expected[half]).max()


@pytest.mark.parametrize("links", [200, 1000])
def test_long_chains_move_and_keep_their_energy(links):
    scene = vp.Scene(vp.planar_chain(links))
    motion = vp.simulate(scene, np.full(links, 0.01), np.zeros(links), dt=1e-3, steps=10)
    assert (motion.statistics.substeps == 1).all()
    turned = np.abs(motion.energy - motion.energy[0]).max()
    kinetic = 0.5 * motion.v[-1] @ motion.p[-1]
    assert turned <= 1e-4 * kinetic
    assert (motion.statistics.residual <= 100.0).all()


def test_mimic_joints_keep_the_matrix():
    scene = vp.Scene(vp.load_robot("panda"))
    with pytest.raises(ValueError, match="more than one joint"):
        Elimination(scene.core, np.zeros(scene.robot.dof), np.zeros(scene.robot.dof))
