"""The Lagrangian against Pinocchio, and steps of large trees, solved from the leaves to the roots."""

import os
import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import random_tree
from oracles import assert_jet, assert_same_jet, slope
from refusals import refused

import varpin as vp
from varpin import textbook


def busy_scene(robot: vp.Robot, rng: np.random.Generator) -> vp.Scene:
    n = robot.dof
    return vp.Scene(
        robot, gravity=rng.normal(0.0, 6.0, 3), stiffness=rng.uniform(0.0, 3.0, n), rest=rng.uniform(-1.0, 1.0, n)
    )


def test_compiled_is_what_pinocchio_computes(robot):
    q, v = np.random.default_rng(0).normal(0.0, 2.0, (2, robot.dof))
    scene = busy_scene(robot, np.random.default_rng(1))
    compiled = vp.lagrangian_jet(scene, q, v)
    reference = vp.lagrangian_jet(scene, q, v, backend="pinocchio")
    assert_same_jet(compiled, reference)
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
    assert_same_jet(there, here)


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


def state_of(tree, seed=2):
    rng = np.random.default_rng(seed)
    return 0.3 * rng.uniform(-2.0, 2.0, tree.dof), 0.2 * rng.normal(size=tree.dof)


def jet_of(scene, q, v):
    return vp.lagrangian_jet(scene, q, v, backend="pinocchio")


def test_steps_solve_their_equation(tree):
    """(S1) of docs/mathematics.md, by Pinocchio's matrices."""
    friction = vp.CoulombFriction(FRICTION, width=0.5)
    scene = vp.Scene(tree, stiffness=0.3, rest=0.1, damping=DAMPING, friction=0.0, forces=friction)
    (q, v), u = state_of(tree), 0.1 * np.cos(np.arange(tree.dof))
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


@pytest.mark.parametrize("alpha", [0.5, 0.4])
def test_the_branch_margin_is_the_least_ratio_of_pivots(tree, alpha):
    """(G1): of M - (h/2) F_v + h skew (A + A') - h^2 reach L_qq / (1 - margin) and M, with a margin of 1/2."""
    scene, h = vp.Scene(tree, stiffness=0.3, damping=DAMPING, friction=0.0), 2e-3
    q, v = state_of(tree)
    # The pivots are those of the last factors, at a guess that is close once there are steps to extrapolate.
    motion = vp.simulate(scene, q, v, dt=h, steps=8, integrator=vp.Midpoint(alpha), check=False)
    assert (motion.statistics.substeps == 1).all()
    v = (motion.q[-1] - motion.q[-2]) / h
    jet = jet_of(scene, motion.q[-2] + alpha * h * v, v)
    C = jet.Lvv + 0.5 * h * DAMPING * np.eye(tree.dof) - 2.0 * h * h * alpha * (1.0 - alpha) * jet.Lqq
    C += h * (alpha - 0.5) * (jet.Lvq + jet.Lvq.T)
    # From the last coordinate to the first.
    pivots = [np.diag(np.linalg.cholesky(matrix[::-1, ::-1])) ** 2 for matrix in (C, jet.Lvv)]
    assert motion.statistics.branch_margin[-1] - 1.0 == pytest.approx(
        (pivots[0] / pivots[1]).min() - 1.0, rel=1e-3, abs=1e-6
    )


@pytest.mark.parametrize("integrator", [vp.ExplicitEuler(), vp.SemiImplicitEuler()], ids=str)
def test_accelerations_are_pinocchios(tree, integrator):
    """And momenta and energies, which count the rotors, too."""
    scene = vp.Scene(tree, damping=0.0, friction=0.0, forces=vp.Armature(0.3))
    (q, v), u = state_of(tree), np.cos(np.arange(tree.dof))
    motion = vp.simulate(scene, q, v, dt=H, steps=1, controls=u, integrator=integrator, check=False)
    for p, energy, *state in zip(motion.p, motion.energy, motion.q, motion.v, strict=True):
        jet = jet_of(scene, *state)
        np.testing.assert_allclose(p, jet.Lv, rtol=0, atol=1e-12 * (np.abs(jet.Lvv) @ np.abs(state[1])).max())
        assert energy == pytest.approx(state[1] @ jet.Lv - jet.L, rel=1e-11)
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


# --- the textbook, which shares no code with the library -------------------------------------------------------------


rng = np.random.default_rng(20)


def pair(robot, *, noise=None, fields=textbook.no_noise, gravity=(0.0, 0.0, -9.81), **surroundings):
    model = robot.model.copy()
    model.gravity = pin.Motion(np.array(gravity), np.zeros(3))
    scene = vp.Scene(robot, gravity=gravity, noise=noise, **surroundings)
    return scene, textbook.System(model, fields=fields, **surroundings)


@pytest.fixture(scope="module", params=["finger", "ur5", "chain"])
def arm(request):
    robot = vp.planar_chain(3) if request.param == "chain" else vp.load_robot(request.param)
    n = robot.dof
    return pair(robot, damping=np.linspace(0.0, 0.02, n), stiffness=np.linspace(0.3, 0.0, n), rest=0.2)


@pytest.mark.parametrize("alpha", [0.5, 0.2])
def test_motions_and_linearizations_are_those_of_the_textbook(arm, alpha):
    scene, system = arm
    # The finger's inertias are a millionth of the others': 0.1 ms are to it what 2 ms are to them.
    n, N, h = scene.robot.dof, 20, 1e-4 if scene.robot.name == "finger" else 2e-3
    q0, v0 = 0.3 * rng.normal(size=(2, n))
    scale = np.abs(vp.lagrangian_jet(scene, q0, v0).Lq).max()
    u = 0.1 * scale * rng.normal(size=(N, n))
    ours = vp.simulate(scene, q0, v0, dt=h, steps=N, controls=u, integrator=vp.Midpoint(alpha), check=False)
    assert ours.statistics.split_steps == 0
    theirs = textbook.rollout(system, q0, v0, u, h, a=alpha)
    assert np.abs(ours.q - theirs.q).max() <= 1e-11 * np.abs(theirs.q).max()
    assert np.abs(ours.p - theirs.p).max() <= 1e-10 * np.abs(theirs.p).max()
    lin = vp.linearize(scene, ours, integrator=vp.Midpoint(alpha))
    for k in (0, N - 1):
        own = textbook.linearize_step(system, theirs.q[k], theirs.q[k + 1], u[k], h, alpha)
        for name in ("A", "B", "K"):
            expected = getattr(own, name)
            # Blocks of x = (q, p) have units of their own.
            for part in (slice(0, n), slice(n, 2 * n)):
                gap = np.abs(getattr(lin, name)[k][part] - expected[part]).max()
                assert gap <= 1e-8 * np.abs(expected[part]).max(), (name, k)


NOISES = {
    "white": (vp.AdditiveNoise(1e-2), textbook.white_noise(1e-2)),
    "control": (vp.ControlNoise(3e-2), textbook.control_noise(3e-2)),
    "state": (vp.StateNoise(5e-2), textbook.state_noise(5e-2, np.array([0.4, 0.1, -0.2]))),
}


@pytest.mark.parametrize("name", NOISES)
def test_noise_acts_as_in_the_textbook(name):
    noise, fields = NOISES[name]
    scene, system = pair(vp.planar_chain(3), noise=noise, fields=fields)
    q0, h, N = np.array([0.4, 0.1, -0.2]), 5e-3, 20
    u, dw = rng.normal(size=(N, 3)), np.sqrt(h) * rng.normal(size=(N, 3))
    given = {"dt": h, "steps": N, "controls": u, "increments": dw, "integrator": vp.Midpoint()}
    ours = vp.simulate(scene, q0, np.zeros(3), check=False, **given)
    theirs = textbook.rollout(system, q0, np.zeros(3), u, h, dw=dw)
    assert np.abs(ours.q - theirs.q).max() <= 1e-11
    # What noise adds to a step, (1.7), against differences of the step itself.
    own = textbook.linearize_step(system, *textbook.rollout(system, q0, np.zeros(3), u[:1], h).q, u[0], h)
    for i in range(3):
        e = 1e-2 * np.eye(3)[i]
        ends = [np.concatenate(textbook.step(system, q0, np.zeros(3), u[0], h, dw=s * e)) for s in (1.0, -1.0)]
        assert np.abs((ends[0] - ends[1]) / 2e-2 - own.K @ own.F[:, i]).max() <= 1e-7 * np.abs(own.K).max()


@pytest.mark.parametrize("name", ["white", "control"])
def test_a_plan_is_that_of_the_textbook(name):
    noise, fields = NOISES[name]
    scene, system = pair(vp.planar_chain(2), noise=noise, fields=fields, gravity=(0.0, 0.0, 0.0))

    def reference(t):
        return np.array([1.0 + 0.25 * np.sin(4 * np.pi * t), 0.1 * np.sin(2 * np.pi * t)])

    h, N, q0 = 0.02, 40, np.array([0.8, 0.1])
    plan = textbook.solve(system, textbook.TrackingCost(reference), q0, np.zeros(2), np.zeros((N, 2)), h)
    cost = vp.TrackingCost(reference, 10.0) + vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost(reference))
    problem = vp.OptimalControlProblem(
        scene, cost, q0, np.zeros(2), dt=h, steps=N, integrator=vp.Midpoint(), sampling="start"
    )
    ours = vp.solve(problem, np.zeros(2), tolerance=1e-9)
    assert ours.status.converged
    assert ours.cost == pytest.approx(plan.cost, rel=1e-6)
    assert ours.noise_cost == pytest.approx(plan.noise_cost, rel=1e-4)
    assert np.abs(ours.controls - plan.motion.u).max() <= 1e-3 * np.abs(plan.motion.u).max()
    assert np.abs(ours.gains - plan.policy.feedback).max() <= 1e-3 * np.abs(plan.policy.feedback).max()


def test_models_of_joints_with_two_variables_are_refused():
    model = pin.Model()
    model.addJoint(0, pin.JointModelRUBZ(), pin.SE3.Identity(), "continuous")
    with refused(vp.InputError, "variable"):
        textbook.System(model)


# --- sines, exponentials and tangents of the core: right to rounding, with and without FMA ---------------------------


LINK = vp.Scene(vp.planar_chain(1))


def gravity(q):
    """The generalized force of gravity on a link that is horizontal at q = 0."""
    return vp.lagrangian_jet(LINK, [q], [0.0]).Lq[0]


def test_cosines_of_any_angle():
    rng = np.random.default_rng(0)
    sizes = 10.0 ** rng.uniform(-9.0, 6.0, 400)
    angles = np.concatenate([sizes * rng.choice([-1.0, 1.0], 400), np.pi / 2 * np.arange(-20, 21), [0.0, 1.6e6, 1e9]])
    largest = gravity(0.0)
    expected = largest * np.cos(angles.astype(np.longdouble))
    found = np.array([gravity(q) for q in angles])
    np.testing.assert_allclose(found, expected.astype(float), rtol=4e-16, atol=1e-16 * abs(largest))


RUN = """
import hashlib
import numpy as np
import varpin as vp
robot = vp.planar_chain(3)
forces = [vp.CoulombFriction(0.4, width=0.1), vp.FrameSpring("tip", [1.0, 0.0, -1.0], 5.0, rotational_stiffness=2.0)]
digest = hashlib.sha256()
for integrator in (vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4()):
    motion = vp.simulate(
        vp.Scene(robot, forces=forces), [0.3, -0.2, 2.9], [1.0, 2.0, -3.0], dt=0.01, steps=60, integrator=integrator
    )
    digest.update(motion.q.tobytes() + motion.p.tobytes())
print(digest.hexdigest())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the switch is glibc's")
def test_the_same_bytes_without_fused_multiplications():
    """The C library takes other functions where the processor is said to have no FMA."""
    bytes_of = [
        subprocess.run(
            [sys.executable, "-c", RUN], env=os.environ | tunables, capture_output=True, text=True, check=True
        ).stdout
        for tunables in ({}, {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-AVX2_Usable,-FMA_Usable"})
    ]
    assert bytes_of[0] == bytes_of[1]
