"""Large trees, whose steps are solved by elimination from the leaves to the roots, against Pinocchio's matrices."""

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import random_inertia, random_rotation, random_tree

import varpin as vp


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
    "tree": lambda: vp.load_robot(random_tree(5, bodies=36)),
    "heavy tip": lambda: vp.load_robot(random_tree(11, bodies=30, ratio=1e4)),
    "star": lambda: star(9, 5),
    "floating": floating,
    "ties": tied,
}
H = 1e-3
DAMPING, FRICTION = 0.05, 0.2


@pytest.fixture(params=ROBOTS, scope="module")
def robot(request):
    return ROBOTS[request.param]()


def scene_of(robot):
    """Springs, dampers and friction on every joint."""
    friction = vp.CoulombFriction(FRICTION, width=0.5)
    return vp.Scene(robot, stiffness=0.3, rest=0.1, damping=DAMPING, friction=0.0, forces=friction)


def state_of(robot, seed=2):
    rng = np.random.default_rng(seed)
    return 0.3 * rng.uniform(-2.0, 2.0, robot.dof), 0.2 * rng.normal(size=robot.dof)


def jet_of(scene, q, v):
    return vp.lagrangian_jet(scene, q, v, backend="pinocchio")


def midpoint(scene, q, v, u):
    """(q, p) after a step by (S1) of docs/mathematics.md: V += M^-1 r until r vanishes."""
    p, V = jet_of(scene, q, v).Lv, v
    for _ in range(60):
        jet = jet_of(scene, q + 0.5 * H * V, V)
        force = jet.Lq + u - DAMPING * V - FRICTION * np.tanh(V / 0.5)
        step = np.linalg.solve(jet.Lvv, p + 0.5 * H * force - jet.Lv)
        V = V + step
        if np.abs(step).max() <= 1e-14 * np.abs(V).max():
            break
    return q + H * V, p + H * force


def test_steps_solve_their_equation(robot):
    scene, (q, v), u = scene_of(robot), state_of(robot), 0.1 * np.cos(np.arange(robot.dof))
    motion = vp.simulate(scene, q, v, dt=H, steps=1, controls=u, integrator=vp.Midpoint(), check=False)
    assert motion.statistics.substeps.tolist() == [1]
    assert motion.statistics.residual.max() <= 100.0
    q1, p1 = midpoint(scene, q, v, u)
    assert np.abs(motion.q[1] - q1).max() <= 1e-13 + 1e-9 * np.abs(q1 - q).max()
    assert np.abs(motion.p[1] - p1).max() <= 1e-11 * np.abs(p1).max()
    M = jet_of(scene, motion.q[1], motion.v[1]).Lvv
    assert np.abs(M @ motion.v[1] - motion.p[1]).max() <= 1e-12 * (np.abs(M) @ np.abs(motion.v[1])).max()


def test_the_branch_margin_is_the_least_ratio_of_pivots(robot):
    """(G1) at the midpoint: of M - (h/2) F_v - h^2 reach L_qq / (1 - margin), with reach 1/4 and margin 1/2, and M."""
    scene, (q, v), h = vp.Scene(robot, stiffness=0.3, damping=DAMPING, friction=0.0), state_of(robot), 2e-3
    # The pivots are those of the last factors, at a guess that is close once there are steps to extrapolate.
    motion = vp.simulate(scene, q, v, dt=h, steps=8, integrator=vp.Midpoint(), check=False)
    assert (motion.statistics.substeps == 1).all()
    jet = jet_of(scene, 0.5 * (motion.q[-2] + motion.q[-1]), (motion.q[-1] - motion.q[-2]) / h)
    C = jet.Lvv + 0.5 * h * DAMPING * np.eye(robot.dof) - 0.5 * h * h * jet.Lqq
    # From the last coordinate to the first.
    pivots = [np.diag(np.linalg.cholesky(matrix[::-1, ::-1])) ** 2 for matrix in (C, jet.Lvv)]
    assert motion.statistics.branch_margin[-1] - 1.0 == pytest.approx(
        (pivots[0] / pivots[1]).min() - 1.0, rel=1e-3, abs=1e-6
    )


def test_accelerations_are_pinocchios(robot):
    """The change of velocity over a step of Euler's method."""
    scene, (q, v), u = vp.Scene(robot, damping=0.0, friction=0.0), state_of(robot), np.cos(np.arange(robot.dof))
    motion = vp.simulate(scene, q, v, dt=H, steps=1, controls=u, integrator=vp.ExplicitEuler(), check=False)
    data, at, rates = robot.model.createData(), robot.configuration(q), robot.velocity(v)
    M = jet_of(scene, q, v).Lvv
    force = u - robot.velocity(np.eye(robot.dof)) @ pin.nonLinearEffects(robot.model, data, at, rates)
    assert np.array_equal(motion.q[1], q + H * v)
    left = M @ ((motion.v[1] - v) / H) - force
    assert np.abs(left).max() <= 1e-9 * (np.abs(M) @ np.abs(np.linalg.solve(M, force))).max()


def test_a_floating_body_keeps_its_digits_far_away():
    scene = vp.Scene(floating(), gravity=False)
    q, v = state_of(scene.robot)
    far = q + np.r_[1e6 * np.array([1.0, -1.0, 1.0]), np.zeros(23)]
    near, away = (vp.simulate(scene, at, v, dt=H, steps=5, check=False) for at in (q, far))
    np.testing.assert_allclose(away.v, near.v, rtol=0, atol=1e-9 * np.abs(near.v).max())
    np.testing.assert_allclose(away.p, near.p, rtol=0, atol=1e-10 * np.abs(near.p).max())


def test_derivatives_of_long_chains_are_those_of_differences():
    robot, integrator = vp.planar_chain(60), vp.Midpoint(tolerance=0.1)
    scene, n = vp.Scene(robot, damping=0.1, stiffness=1.0), robot.dof
    rng = np.random.default_rng(7)
    q, v = rng.uniform(-0.2, 0.2, n), 0.1 * rng.normal(size=n)
    motion = vp.simulate(scene, q, v, dt=1e-2, steps=1, integrator=integrator)
    lin = vp.linearize(scene, motion)
    M = vp.lagrangian_jet(scene, q, v).Lvv
    # Directions dp = M dv, as long ones would take the chain apart.
    dq, dv, du = 0.1 * rng.normal(size=(3, n))
    expected = lin.A[0] @ np.r_[dq, M @ dv] + lin.B[0] @ du
    eps, ends = 1e-5, []
    for sign in (1.0, -1.0):
        at = q + sign * eps * dq
        p = M @ v + sign * eps * (M @ dv)
        rates = np.linalg.solve(vp.lagrangian_jet(scene, at, v).Lvv, p)
        moved = vp.simulate(scene, at, rates, dt=1e-2, steps=1, controls=sign * eps * du, integrator=integrator)
        ends.append(np.r_[moved.q[-1], moved.p[-1]])
    difference = (ends[0] - ends[1]) / (2.0 * eps)
    for half in (slice(0, n), slice(n, None)):
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
