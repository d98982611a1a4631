"""Solves by elimination from the leaves to the roots, against NumPy's on matrices that are formed."""

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import random_inertia, random_rotation, random_tree
from scipy.linalg import eigh

import varpin as vp
from varpin.core import Elimination, ForwardDynamics, Solver, VariationalRollout, variational_derivatives
from varpin.core.arrays import new_nodes
from varpin.model import example_robot_data
from varpin.signals.commands import open_loop


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


def tied(model, ties):
    """Joints that follow others, by (leader, follower, ratio, offset)."""
    for leader, follower, ratio, offset in ties:
        model = pin.transformJointIntoMimic(model, leader, follower, ratio, offset)
    return vp.load_robot(model)


def tied_chain(links, ties=((3, 5), (4, 12))):
    return tied(vp.planar_chain(links).model, [(leader, follower, -0.7, 0.1) for leader, follower in ties])


def tied_tree(count, seed=1):
    """Ties between any joints: leaders with several followers, spans that overlap."""
    rng = np.random.default_rng(seed)
    model = random_tree(seed, bodies=9 + 2 * count)
    single = [joint for joint in range(1, model.njoints) if model.joints[joint].nq == 1]
    ties, followers = [], set()
    for _ in range(count):
        while True:
            leader, follower = sorted(rng.choice(single, 2, replace=False))
            if not {leader, follower} & followers and follower not in {tie[0] for tie in ties}:
                break
        followers.add(follower)
        ties.append((int(leader), int(follower), rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0), rng.normal()))
    return tied(model, ties)


def example(path):
    return vp.load_robot(example_robot_data.locate(path))


def grippers():
    """Two fingers on the ground and two on an arm that slides, of which the follower has no mass."""
    model = pin.Model()
    model.name = "grippers"
    rng = np.random.default_rng(8)

    def add(parent, kind, name):
        joint = model.addJoint(parent, kind, pin.SE3(random_rotation(rng), rng.normal(0.0, 0.2, 3)), name)
        model.appendBodyToJoint(joint, random_inertia(rng), pin.SE3.Identity())
        return joint

    first, second = add(0, pin.JointModelRX(), "first"), add(0, pin.JointModelPY(), "second")
    slide = add(0, pin.JointModelPZ(), "slide")
    turn = add(slide, pin.JointModelRY(), "turn")
    third = add(turn, pin.JointModelRX(), "third")
    fourth = model.addJoint(slide, pin.JointModelRX(), pin.SE3.Identity(), "fourth")
    add(second, pin.JointModelRZ(), "tip")
    return tied(model, [(first, second, 0.5, 0.2), (third, fourth, -1.0, 0.0)])


ROBOTS = {
    **{f"chain{n}": lambda n=n: vp.planar_chain(n) for n in (1, 2, 15, 30)},
    **{f"tree{seed}": lambda seed=seed: vp.load_robot(random_tree(seed, bodies=4 + 4 * seed)) for seed in range(6)},
    "heavy tip": lambda: vp.load_robot(random_tree(11, bodies=8, ratio=1e4)),
    "star": lambda: star(7, 3),
    "floating": floating,
    "ur5": lambda: vp.load_robot("ur5"),
    "allegro": lambda: vp.load_robot("allegro_left_hand"),
    **{f"{k} ties": lambda k=k: tied_tree(k) for k in range(1, 6)},
    "tied chain": lambda: tied_chain(30),
    "leader and followers": lambda: tied_chain(12, ((2, 3), (2, 8), (4, 6), (5, 12))),
    "grippers": grippers,
    "panda": lambda: vp.load_robot("panda"),
    "talos": lambda: example("talos_data/robots/talos_full_v2.urdf"),
    "pr2": lambda: example("pr2_description/urdf/pr2.urdf"),
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


def eliminated_order(robot):
    """Coordinates in the order of elimination: with the last body that all their bodies hang on, from the last on."""
    parent, coordinate = robot.tree.parent, robot.tree.coordinate

    def hung_on(body):
        return [] if body < 0 else [*hung_on(parent[body]), body]

    # A body's own coordinate comes before others that end with it.
    keys = []
    for c in range(robot.dof):
        own = np.flatnonzero(coordinate == c)
        shared = set.intersection(*(set(hung_on(body)) for body in own))
        keys.append((-max(shared, default=-1), len(own) > 1, c))
    return [key[-1] for key in sorted(keys)]


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
    order = eliminated_order(robot)
    lower = np.linalg.cholesky(M[np.ix_(order, order)])
    shares = 0.5 * np.linalg.solve(lower, p[order]) ** 2
    assert np.abs(share[order] - shares).max() <= 1e-10 * shares.sum()


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
                order = eliminated_order(robot)
                ordered = (matrix[np.ix_(order, order)] for matrix in (C, jet.Lvv))
                pivots = [np.diag(np.linalg.cholesky(matrix)) ** 2 for matrix in ordered]
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


def test_round_off_grows_as_disturbances_do():
    """A panda over 3 s in steps of 10 ms: correct solvers agree in a step, and part as an ulp in the start does."""
    scene, integrator, steps = vp.Scene(vp.load_robot("panda")), vp.Gauss(2), 300
    n = scene.robot.dof
    q0, v0 = 0.5 * sum(scene.robot.position_limits), np.zeros(n)
    given = 1e-2, steps
    dense, eliminated = (
        rolled(scene, q0, v0, *given, solver, integrator) for solver in (Solver.dense, Solver.elimination)
    )
    moved = rolled(scene, np.nextafter(q0, np.inf), v0, *given, Solver.dense, integrator)
    assert dense.done == eliminated.done == moved.done == steps
    motion = vp.simulate(scene, q0, v0, dt=1e-2, steps=steps, controls=dense.u[0], integrator=integrator, check=False)
    amplified = np.eye(2 * n)
    for A in vp.linearize(scene, motion).A:
        amplified = A @ amplified
    growth = np.finfo(float).eps * np.abs(amplified[:n, :n]).max()
    assert np.abs(eliminated.q[0, 0] - dense.q[0, 0]).max() <= 1e-15
    for other in (eliminated, moved):
        apart = np.abs(other.q[0, -1] - dense.q[0, -1]).max()
        assert 1e-9 < apart < 1e-5
        assert growth / 100.0 < apart < growth * 100.0


def wide_star(bodies):
    """Branches of three bodies each on one trunk."""
    return star((bodies - 1) // 3, 3)


@pytest.mark.slow
@pytest.mark.parametrize(("bodies", "backend"), [(300, "pinocchio"), (1000, "compiled")])
@pytest.mark.parametrize(
    "build",
    [vp.planar_chain, wide_star, lambda bodies: vp.load_robot(random_tree(5, bodies=bodies))],
    ids=["chain", "star", "tree"],
)
def test_large_trees_are_solved_for_as_with_the_matrix(build, bodies, backend):
    """A step, M, and the guard on both sides of the step at which the least eigenvalue is zero.

    Pinocchio's tables (n, n, n) do not fit into memory for 1000 bodies; there the matrices are those of the sweeps.
    """
    robot = build(bodies)
    n = robot.dof
    scene, (q, v) = vp.Scene(robot), state_of(robot)
    q, v = 0.1 * q, 0.1 * v
    jet = vp.lagrangian_jet(scene, q, v, backend=backend)
    # M - c L_qq has a zero eigenvalue where c is one over the largest of L_qq in the metric of M.
    edge = 1.0 / eigh(jet.Lqq, jet.Lvv, eigvals_only=True)[-1]
    assert edge > 0.0
    elimination = Elimination(scene.core, q, v)
    assert elimination.least_pivot_ratio(0.0, 0.99 * edge, robot.tree.armature) > 0.0
    assert elimination.least_pivot_ratio(0.0, 1.01 * edge, robot.tree.armature) <= 0.0
    # The symmetric part of N is M - h^2 L_qq.
    h = 0.5 * np.sqrt(edge)
    N = jet.Lvv + h * (jet.Lvq - jet.Lvq.T) - h**2 * jet.Lqq
    b = np.random.default_rng(9).normal(size=n)
    x, *_, positive = elimination.step(h, h, robot.tree.armature, b)
    assert positive
    assert solved_like(x, N, b)
    x, _, positive = elimination.mass(b)
    assert positive
    assert solved_like(x, jet.Lvv, b)


@pytest.mark.parametrize("ramp", [False, True], ids=["shift", "ramp"])
@pytest.mark.parametrize(("integrator", "stages"), [(vp.Midpoint(), 1), (vp.Gauss(2), 2)], ids=["midpoint", "gauss2"])
def test_derivatives_are_those_with_matrices(robot, integrator, stages, ramp):
    scene, (q, v) = scene_of(robot), state_of(robot)
    p = vp.lagrangian_jet(scene, q, v).Lv
    fixed = scene.core, integrator._tableau(), float(integrator.tolerance), integrator._guards(), 1e-3
    guess = np.broadcast_to(v, (1, stages, robot.dof)).copy()
    # Another force at each stage, as under controls that change within the step; and in its ramp.
    force = np.linspace(-1e-3, 1e-3, stages * robot.dof).reshape(1, stages, robot.dof)
    at = q[None], p[None], force, np.ones(1, dtype=np.int64), np.zeros(0, dtype=np.uint8)
    (Ax, Af, Ar, *done), (Bx, Bf, Br, *also) = (
        variational_derivatives(*fixed, *at, guess=guess, ramp=ramp, solver=solver)
        for solver in (Solver.dense, Solver.elimination)
    )
    assert done == also == [0, 1]
    assert len(Ar) == len(Br) == ramp
    for A, B in ((Ax, Bx), (Af, Bf), (Ar, Br)):
        assert np.abs(A - B).max(initial=0.0) <= 1e-8 * np.abs(A).max(initial=0.0)


def test_accelerations_are_pinocchios(robot):
    scene, (q, v) = vp.Scene(robot), state_of(robot)
    force = np.random.default_rng(6).normal(size=robot.dof)
    dynamics = ForwardDynamics(scene.core, Solver.elimination)
    rate, regular = dynamics.rate(np.r_[q, v], force)
    assert regular
    data, at, rates = robot.free_model.createData(), robot.free_positions(q), robot.free_velocities(v)
    M = vp.lagrangian_jet(scene, q, v, backend="pinocchio").Lvv
    bias = robot.free_velocities(np.eye(robot.dof)) @ pin.nonLinearEffects(robot.free_model, data, at, rates)
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


@pytest.mark.parametrize("links", [200, pytest.param(1000, marks=pytest.mark.slow)])
def test_long_chains_move_and_keep_their_energy(links):
    scene = vp.Scene(vp.planar_chain(links))
    motion = vp.simulate(scene, np.full(links, 0.01), np.zeros(links), dt=1e-3, steps=10)
    assert (motion.statistics.substeps == 1).all()
    turned = np.abs(motion.energy - motion.energy[0]).max()
    kinetic = 0.5 * motion.v[-1] @ motion.p[-1]
    assert turned <= 1e-4 * kinetic
    assert (motion.statistics.residual <= 100.0).all()


@pytest.mark.parametrize("links", [60, pytest.param(200, marks=pytest.mark.slow)])
def test_long_chains_with_ties_are_solved_for_as_with_the_matrix(links):
    robot = tied_chain(links, ((2, links // 2), (links // 3, links)))
    scene, (q, v) = vp.Scene(robot), state_of(robot)
    q, v = 0.1 * q, 0.1 * v
    jet = vp.lagrangian_jet(scene, q, v)
    N = jet.Lvv + 1e-3 * (jet.Lvq - jet.Lvq.T) - 1e-6 * jet.Lqq
    b = np.random.default_rng(9).normal(size=robot.dof)
    elimination = Elimination(scene.core, q, v)
    x, *_, positive = elimination.step(1e-3, 1e-3, robot.tree.armature, b)
    assert positive
    assert solved_like(x, N, b)
    x, _, positive = elimination.mass(b)
    assert positive
    assert solved_like(x, jet.Lvv, b)


@pytest.mark.parametrize(
    ("build", "chosen"),
    [(lambda: tied_chain(60), Solver.elimination), (lambda: vp.load_robot("panda"), Solver.dense)],
    ids=["chain", "panda"],
)
@pytest.mark.parametrize("integrator", [vp.Midpoint(guard=LENIENT), vp.Gauss(2, guard=LENIENT)], ids=["one", "two"])
def test_large_trees_with_ties_do_without_matrices_and_small_ones_do_not(build, chosen, integrator):
    scene = vp.Scene(build())
    q, v = state_of(scene.robot)
    automatic, *ways = (
        rolled(scene, 0.1 * q, 0.1 * v, 1e-3, 5, solver, integrator)
        for solver in (Solver.automatic, Solver.dense, Solver.elimination)
    )
    alike = [
        all(np.array_equal(getattr(automatic, name), getattr(way, name)) for name in ("q", "v", "quality"))
        for way in ways
    ]
    assert alike == [chosen is Solver.dense, chosen is Solver.elimination]
