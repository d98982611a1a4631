"""A control loop that is unstable at its period is told of, and no other."""

import logging
import threading
from itertools import product

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from mechanisms import rod_chain
from oracles import exact
from refusals import naming, refused
from scipy.linalg import expm
from scipy.optimize import fsolve

import varpin as vp

KIND = "unstable loop"

ROD, PENDULUM = vp.Scene(vp.planar_chain(1), gravity=False), vp.Scene(vp.planar_chain(1))
INERTIA = 1.0 / 3.0  # of the rod about its joint


def told(motion):
    return about(motion.warnings, KIND)


def run(scene, q, v, law, **options):
    try:
        return vp.simulate(scene, q, v, controls=law, **options)
    except vp.StepFailure as failure:
        return failure.trajectory


def pd(kp, kd, goal=1.0, limit=np.inf):
    return lambda t, q, v: np.clip(-kp * (q - goal) - kd * v, -limit, limit)


def radius(scene, K, period, guess):
    """Spectral radius at the equilibrium next to a guess under u = K (q - guess, v): Pinocchio, differences, expm."""
    model, n, h = scene.robot.model.copy(), scene.robot.dof, 1e-5
    model.gravity.linear = scene.gravity
    data, still = model.createData(), np.zeros(n)

    def acceleration(q, v, u):
        return pin.aba(model, data, scene.robot.configuration(q), v, u - scene.damping * v).copy()

    rest = fsolve(lambda q: acceleration(q, still, K[:, :n] @ (q - guess)), guess)
    u = K[:, :n] @ (rest - guess)
    changes = h * np.eye(3 * n)
    moved = [acceleration(rest + d[:n], d[n : 2 * n], u + d[2 * n :]) for d in np.concatenate([changes, -changes])]
    rates = np.zeros((3 * n, 3 * n))
    rates[:n, n : 2 * n] = np.eye(n)
    rates[n : 2 * n] = (np.array(moved[: 3 * n]) - np.array(moved[3 * n :])).T / (2.0 * h)
    step = expm(period * rates)[: 2 * n]
    return np.abs(np.linalg.eigvals(step[:, : 2 * n] + step[:, 2 * n :] @ K)).max()


def jury(a, b):
    """Largest root of z^2 - (2 - b - a / 2) z + 1 - b + a / 2, a = kp h^2 / I and b = kd h / I."""
    return np.abs(np.roots([1.0, -(2.0 - b - 0.5 * a), 1.0 - b + 0.5 * a])).max()


@pytest.mark.parametrize("period", [1, 3])
@pytest.mark.parametrize(
    ("kp", "kd"), [(0, 66), (0, 67), (10, 30), (300, 1), (300, 1.4), (300, 1.6), (300, 66), (300, 67), (9e3, 60)]
)
def test_jury_conditions(kp, kd, period):
    """Stable for a / 2 < b < 2."""
    h = 1e-2
    a, b = kp * h**2 / INERTIA, kd * h / INERTIA
    size = jury(a, b)
    stable = 0.5 * a < b < 2.0
    options = {"dt": h / period, "steps": 150 * period, "period": period}
    motion = run(ROD, [0.3], [0.2 * (kp == 0)], pd(kp, kd), **options)
    assert bool(told(motion)) != stable, (size, motion.warnings)
    for finding in told(motion):
        assert (finding.kind, finding.joint) == (KIND, "joint1")
        np.testing.assert_allclose(finding.value, size, rtol=1e-6)
        assert naming([finding], f"{size:.6g}", "0.01 s")
        # The period that is stable, at most a tenth short.
        limit = min(2.0 * INERTIA / kd, 2.0 * kd / max(kp, 1e-9))
        shorter = float(finding.split("below ")[1].split(" s")[0])
        assert 0.89 * limit < shorter < 1.001 * limit


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4()], ids=str)
def test_random_loops_of_chains(integrator):
    rng, seen = np.random.default_rng(14), {True: 0, False: 0}
    for _ in range(20):
        n, kp, kd, dt = int(rng.integers(1, 4)), *10 ** rng.uniform([1, 0, -3], [4, 2.5, -1.7])
        scene = vp.Scene(vp.planar_chain(n), gravity=bool(rng.integers(2)))
        size = radius(scene, np.hstack([-kp * np.eye(n), -kd * np.eye(n)]), dt, np.ones(n))
        motion = run(scene, np.zeros(n), np.zeros(n), pd(kp, kd), dt=dt, steps=200, integrator=integrator)
        if motion.steps == 200:
            assert bool(told(motion)) == (size > 1.0), (n, kp, kd, dt, size, motion.warnings)
            seen[size > 1.0] += 1
    assert min(seen.values()) > 0


@pytest.mark.parametrize("share", [0.8, 2.6])
@pytest.mark.parametrize("compensated", [False, True])
@pytest.mark.parametrize("limit", [np.inf, 25.0])
def test_six_joints(share, compensated, limit):
    scene, n, h = vp.Scene(vp.load_robot("ur5"), damping=0.05), 6, 2e-3
    goal = np.array([0.3, -1.0, 1.2, -0.8, 0.5, 0.7])
    jet = vp.lagrangian_jet(scene, goal, np.zeros(n))
    diagonal = np.diag(jet.Lvv)
    kd = diagonal * share / h / np.linalg.eigvals(np.linalg.solve(jet.Lvv, np.diag(diagonal))).real.max()

    def law(t, q, v):
        pull = vp.lagrangian_jet(scene, q, np.zeros(n)).Lq if compensated else jet.Lq
        return np.clip(-pull - 50.0 * kd * (q - goal) - kd * v, -limit - 60.0, limit + 60.0)

    motion = run(scene, goal + 0.05, np.zeros(n), law, dt=h, steps=300)
    assert bool(told(motion)) == (share > 2.0), motion.warnings


@pytest.mark.parametrize(("robot", "h"), [("ur5", 1 / 30), ("ur3", 1e-2)])
@pytest.mark.parametrize(("rate", "ratio"), [(0.9, 0.7), (1.33, 0.7), (1.5, 0.7), (0.9, 1.0), (1.3, 1.0), (1.9, 0.5)])
def test_computed_torque_is_judged_at_rest(robot, h, rate, ratio):
    """Its joints are uncoupled there, whatever inertias act and change along the motion."""
    scene, rng = vp.Scene(vp.load_robot(robot), gravity=False, damping=0.0), np.random.default_rng(3)
    model, n = scene.robot.model.copy(), scene.robot.dof
    model.gravity.linear = np.zeros(3)
    data, goal = model.createData(), np.resize([0.1, -0.9, 0.8, -1.2, 0.3, 0.9, 0.4], n)
    size, w = jury(rate**2, 2.0 * ratio * rate), rate / h

    def law(t, q, v):
        return pin.rnea(model, data, scene.robot.configuration(q), v, w**2 * (goal - q) - 2.0 * ratio * w * v)

    motion = run(scene, goal + 0.3 * rng.normal(size=n), np.zeros(n), law, dt=h / 4, steps=160, period=4)
    found = [finding.value for finding in told(motion)]
    np.testing.assert_allclose(found, [size] if size > 1.0 else [], rtol=1e-5)


def test_a_law_is_read_off_where_it_does_not_clip():
    """Four of 300 periods are inside the limits."""
    scene, kp, kd = vp.Scene(vp.planar_chain(1), gravity=False, damping=0.01), 22161.0, 6.8
    size = radius(scene, np.array([[-kp, -kd]]), 2 * 5.33e-3, np.ones(1))
    motion = run(scene, [1.0003], [0.0], pd(kp, kd, limit=20.0), dt=5.33e-3, steps=600, period=2)
    assert (np.abs(motion.u[::2]) < 20.0).sum() < 10
    assert naming(told(motion), f"{size:.6g}")


@pytest.mark.parametrize(
    ("n", "period", "kp", "kd", "limit", "gravity"),
    [(1, 5e-3, 100, 200, 5, False), (2, 0.015, 100, 200, 20, False), (2, 0.023, 480, 66, 3.2, True),
     (2, 0.029, 850, 19, 5.7, False), (2, 0.013, 1100, 91, 6.5, True)],
)  # fmt: skip
def test_an_unstable_loop_that_clips_is_told(n, period, kp, kd, limit, gravity):
    scene = vp.Scene(vp.planar_chain(n), gravity=gravity)
    motion = run(scene, np.zeros(n), np.zeros(n), pd(kp, kd, limit=limit), dt=period / 2, steps=298, period=2)
    assert radius(scene, np.hstack([-kp * np.eye(n), -kd * np.eye(n)]), period, np.ones(n)) > 1.0
    assert told(motion)
    assert not told(run(scene, np.zeros(n), np.zeros(n), pd(50.0, 0.1 / period, 1.0, limit), dt=period / 2, steps=298))


def test_the_count_of_turns():
    motion = run(ROD, [0.0], [0.5], lambda t, q, v: -5.0 * np.sign(v), dt=1e-2, steps=300)
    (finding,) = told(motion)
    assert finding.value > 290
    assert 0.0 < finding.time < 0.3
    assert naming([finding], "joint1", f"{finding.value:.0f} times", "300 periods", "0.01 s")


def swing_up(t, q, v):
    """It pumps from limit to limit, catches the pendulum upright and holds it."""
    if np.sin(q[0]) < -0.8:
        return np.clip(-60.0 * np.arctan2(np.cos(q), -np.sin(q)) - 10.0 * v, -6.0, 6.0)
    return -2.0 * np.sign(v * (v**2 / 6.0 - 0.5 * 9.81 * (np.sin(q) + 1.0)) + 1e-12)


TWO = vp.Scene(vp.planar_chain(2))
HEAVY = vp.Scene(vp.planar_chain(1), gravity=1e4 * PENDULUM.gravity)
ONE_OF_TWO = vp.Scene(vp.planar_chain(2), actuation=[[1.0], [0.0]])
NOISE = np.random.default_rng(0).normal(size=701)
STABLE = {
    "noise of sensors": (ROD, 1, lambda t, q, v: -100 * (q - 1) - 10 * v + NOISE[round(t / 2e-3)]),
    "clipped, goal that swings": (ROD, 0, lambda t, q, v: np.clip(-1e3 * (q - 3 * np.sin(6 * t)) - 50 * v, -10, 10)),
    "clipped, goal that jumps": (ROD, 0, lambda t, q, v: np.clip(-300 * (q - np.sign(np.sin(9 * t))) - 20 * v, -5, 5)),
    "bang-bang plan": (ROD, 0, lambda t, q, v: 10.0 * np.sign(np.sin(9.0 * t)) * np.ones(1)),
    "swing-up": (PENDULUM, 0.1 + np.pi / 2, swing_up),
    "clipped": (PENDULUM, 0, pd(1e3, 50.0, limit=20.0)),
    "falls, weak damping": (PENDULUM, np.pi / 2 - 1e-6, lambda t, q, v: -0.1 * v),
    "runs away over many periods": (ROD, 1 + 1e-6, lambda t, q, v: 900 * (q - 1)),
    "falls, weak springs": (PENDULUM, np.pi / 2 - 1e-6, pd(1.0, 0.1, np.pi / 2)),
    "spring too weak to hold it upright": (PENDULUM, 0.02 - np.pi / 2, pd(2.0, 0.5, goal=-np.pi / 2)),
    "goal that swings fast": (ROD, 0, lambda t, q, v: -100 * np.sin(q - np.sin(120 * t)) - 5 * v),
    "goal that swings": (TWO, 0, lambda t, q, v: -300 * (q - np.sin(3 * t)) - 30 * v),
    "goal that runs away": (ROD, 0, lambda t, q, v: -100 * (q - t**3) - 10 * (v - 3 * t**2)),
    "gravity alone compensated": (TWO, 0.3, lambda t, q, v: -vp.lagrangian_jet(TWO, q, np.zeros(2)).Lq - 2.0 * v),
    "velocity goal": (ROD, 0, lambda t, q, v: -30 * (v - 5)),
    "drag": (ROD, 0, lambda t, q, v: -100 * (q - 1) - 0.3 * v - 20 * v * np.abs(v)),
    "one joint of two": (ONE_OF_TWO, 0, lambda t, q, v: -100 * (q[:1] - 1) - 20 * v[:1]),
    "falls within a period": (HEAVY, 1e-6 - np.pi / 2, lambda t, q, v: -1e-6 * v),
}
UNSTABLE = {
    "runs away within a period": (ROD, 1 + 1e-6, lambda t, q, v: 9e4 * (q - 1)),
    "drag alone, none at rest": (ROD, 0, lambda t, q, v: -100 * (q - 1) - 20 * v * np.abs(v)),
    "velocity goal, too fast": (ROD, 0, lambda t, q, v: -335 * (v - 5)),
    "drag that alternates": (ROD, 0.1, lambda t, q, v: -100 * q - 340 * v - v * np.abs(v)),
    "one joint of two, too fast": (ONE_OF_TWO, 0, lambda t, q, v: -100 * (q[:1] - 1) - 1000 * v[:1]),
    "moving goal": (TWO, 0, lambda t, q, v: -300 * (q - np.sin(3 * t)) - 300 * v),
    "near its goal": (ROD, 1 + 1e-6, pd(1e3, 340.0)),
    "limits that move": (ROD, 0, lambda t, q, v: (2 + np.sin(t)) * np.clip(-100 * (q - 1) - 400 * v, -5, 5)),
    "at the end alone": (ROD, 0, lambda t, q, v: np.clip(-100 * (q - 1) - (500 if t > 1.3 else 10) * v, -5, 5)),
    "for a time": (ROD, 0, lambda t, q, v: np.clip(-500 * (q - t) - (9e3 if 0.5 < t < 0.53 else 25) * (v - 1), -5, 5)),
    "nonlinear": (ROD, 0, lambda t, q, v: 400.0 * np.sin(-0.1 * (q - 1) - 1.0 * v)),
}  # fmt: skip


@pytest.mark.parametrize("name", [*STABLE, *UNSTABLE])
def test_laws(name):
    scene, q, law = (STABLE | UNSTABLE)[name]
    motion = run(scene, np.full(scene.robot.dof, q), np.zeros(scene.robot.dof), law, dt=2e-3, steps=700)
    assert bool(told(motion)) == (name in UNSTABLE), motion.warnings


@pytest.mark.parametrize(("kd", "unstable"), [(40.0, False), (70.0, True)])
def test_a_law_with_a_memory(kd, unstable):
    total = 0.0

    def law(t, q, v):
        nonlocal total
        total = total + 1e-2 * (q - 1.0)
        return -300.0 * (q - 1.0) - 100.0 * total - kd * v

    assert bool(told(run(PENDULUM, [0.0], [0.0], law, dt=1e-2, steps=300))) == unstable


class Remembering:
    """Springs and dampers of a rod on states that are late, filtered, or summed up, with the matrix of a period.

    Its state is (q, v) and what the law remembers, about the goal 1 rad.
    """

    def __init__(self, kind, kp, kd, h):
        self.kind, self.kp, self.kd, self.h = kind, kp, kd, h
        self.late, self.slow, self.total = [], None, 0.0

    def __call__(self, t, q, v):
        if self.kind == "delay":
            self.late = [*self.late, (q, v)][-3:]
            q, v = self.late[0]
        if self.kind == "filter":
            self.slow = v if self.slow is None else self.slow + 0.3 * (v - self.slow)
            v = self.slow
        if self.kind == "integral":
            self.total = self.total + self.h * (q - 1.0)
        return -self.kp * (q - 1.0) - self.kd * v - 2.0 * self.kp * self.total

    def radius(self):
        h, zero = self.h, np.zeros((2, 2))
        A, B = np.array([[1.0, h], [0.0, 1.0]]), np.array([[0.5 * h**2], [h]]) / INERTIA
        K = -np.array([[self.kp, self.kd]])
        if self.kind == "delay":
            step = np.block([[A, zero, B @ K], [np.eye(2), zero, zero], [zero, np.eye(2), zero]])
        elif self.kind == "filter":
            new = np.array([[0.0, 0.3, 0.7]])
            u = np.array([[-self.kp, 0.0, 0.0]]) - self.kd * new
            step = np.vstack([np.hstack([A, np.zeros((2, 1))]) + B @ u, new])
        else:
            new = np.array([[h, 0.0, 1.0]])
            u = np.append(K, [[0.0]], axis=1) - 2.0 * self.kp * new
            step = np.vstack([np.hstack([A, np.zeros((2, 1))]) + B @ u, new])
        return np.abs(np.linalg.eigvals(step)).max()


@pytest.mark.parametrize("kind", ["delay", "filter", "integral"])
@pytest.mark.parametrize("kd", [5.0, 15.0, 30.0, 60.0, 90.0, 200.0])
def test_laws_that_remember(kind, kd):
    law = Remembering(kind, 40.0, kd, 1e-2)
    found = told(run(ROD, [0.9], [0.0], law, dt=1e-2, steps=100))
    assert bool(found) == (law.radius() > 1.0), (law.radius(), found)
    for finding in found:
        np.testing.assert_allclose(finding.value, law.radius(), rtol=1e-6)


@pytest.mark.parametrize("robot", ["ur5", "panda"])
@pytest.mark.parametrize("encoder", ["noise", "quanta", "friction"])
@pytest.mark.parametrize(("share", "unstable"), [(1.0, False), (2.5, True)])
def test_encoders_are_no_feedback(robot, encoder, share, unstable):
    """Dampers of a share of what the period allows, from encoders with noise or quanta, or with a small relay."""
    scene, h, rng = vp.Scene(vp.load_robot(robot), damping=0.0), 2e-3, np.random.default_rng(1)
    goal = np.resize([0.1, -0.9, 0.8, -1.2, 0.3, 0.9, 0.4], scene.robot.dof)
    jet = vp.lagrangian_jet(scene, goal, 0.0 * goal)
    M = np.diag(jet.Lvv)
    kd = share * M / h / np.linalg.eigvals(np.linalg.solve(jet.Lvv, np.diag(M))).real.max()

    def law(t, q, v):
        relay = 0.02 * np.sign(v) if encoder == "friction" else 0.0
        if encoder == "noise":
            q, v = q + 1e-3 * rng.standard_normal(len(q)), v + 3e-2 * rng.standard_normal(len(q))
        if encoder == "quanta":
            q = 1e-3 * np.round(q / 1e-3)
        return -jet.Lq - kd * (15.0 * (q - goal) + v + relay)

    assert bool(told(run(scene, goal + 0.05 * unstable, 0.0 * goal, law, dt=h, steps=300))) == unstable


@pytest.mark.parametrize(("kd", "unstable"), [(10.0, False), (60.0, True)])
def test_noise_hides_nothing(kd, unstable):
    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(0.1))
    assert bool(told(run(scene, [0, 0], [0, 0], pd(300.0, kd), dt=1e-2, steps=200, rng=0))) == unstable


LOOPS = {"four-bar": ((1.3, 0.0, 0.2), [-1.5, 1.5, 1.5], ["joint1"]),
         "five-bar": ((1.6, 0.0, 0.3), [-1.0, 1.0, 1.0, 1.0], ["joint1", "joint4"])}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "kp", "kd", "steps", "unstable"),
    [
        ("four-bar", 300.0, 1.0, 800, True),
        ("four-bar", 300.0, 40.0, 800, False),
        ("five-bar", 30.0, 1.0, 800, False),
        ("five-bar", 30.0, 160.0, 80, True),
    ],
)
def test_closed_loops(name, kp, kd, steps, unstable):
    place, seed, driven = LOOPS[name]
    joint = vp.PointOnPoint("tip", place, axes="xz")
    scene = vp.Scene(vp.planar_chain(len(seed)), damping=0.05, constraints=joint, actuation=driven)
    goal = vp.assemble(scene, seed)
    start = vp.assemble(scene, goal + 0.02 * np.arange(1, len(seed) + 1))

    def law(t, q, v):
        return scene.actuation.T @ (kp * (goal - q) - kd * v)

    motion = run(scene, start, np.zeros(len(seed)), law, dt=1e-2, steps=steps, period=2)
    assert bool(told(motion)) == unstable, motion.warnings
    first, *_, last = np.array_split(np.abs(motion.v), 4)
    assert (last.max() > first.max()) == unstable


def test_policies():
    on_v, on_p = ("velocity", 1.0, vp.RungeKutta4()), ("momentum", INERTIA, vp.Gauss(2))
    for (kd, unstable), (on, unit, integrator) in product(((50.0, False), (80.0, True)), (on_v, on_p)):
        gains, goals = np.tile([[-1e3, -kd / unit]], (100, 1, 1)), np.tile([1.0, 0.0], (100, 1))
        policy = vp.LinearPolicy(np.zeros((100, 1)), gains, goals, on=on)
        assert bool(told(run(ROD, [0], [0], policy, dt=1e-2, steps=100, integrator=integrator))) == unstable
    cost = vp.ControlCost(1e-3) + vp.Terminal(vp.TrackingCost([0.5, 0.3], 1e4) + vp.VelocityCost(1e2))
    plan = vp.solve(vp.OptimalControlProblem(TWO, cost, [0, 0], [0, 0], dt=1e-2, steps=100, integrator=vp.Gauss(2)))
    motion = run(TWO, [0.05, -0.03], [0, 0], plan.policy, dt=1e-2, steps=100, integrator=vp.Gauss(2))
    assert not told(motion), motion.warnings


@pytest.mark.parametrize(("goal", "other", "rate"), [([0.5, 2.9], 0.0, 12.0), ([0.0, 0.0], 2.9, 15.0)])
def test_a_policy_is_the_same_about_any_reference(goal, other, rate):
    """One that holds the goal, and as the same function of the state about a place where another inertia acts."""
    scene, N = vp.Scene(vp.planar_chain(2), gravity=False, damping=0.1), 100
    M = vp.lagrangian_jet(scene, np.zeros(2), np.zeros(2)).Lvv
    K = -np.hstack([rate**2 * M, 1.4 * rate * M])
    size = radius(scene, K, 0.02, np.array(goal))
    for x in (np.array(goal), np.array([0.0, other])):
        u, reference = np.tile(K[:, :2] @ (x - goal), (N, 1)), np.tile([*x, 0.0, 0.0], (N, 1))
        policy = vp.LinearPolicy(u, np.tile(K, (N, 1, 1)), reference, on="velocity")
        motion = run(scene, np.add(goal, 0.01), [0, 0], policy, dt=0.02, steps=N, integrator=vp.RungeKutta4())
        found = [finding.value for finding in told(motion)]
        np.testing.assert_allclose(found, [size] if size > 1.0 else [], rtol=1e-5)


@pytest.mark.parametrize(("kd", "kept"), [(60.0, 0.0), (60.0, 0.4), (60.0, 0.9), (60.0, -0.3), (100.0, 0.4)])
def test_a_policy_on_the_control_before(kd, kept):
    """The step of (q, v, u) has its spectral radius."""
    h, K, N = 1e-2, np.array([[-300.0, -kd]]), 60
    A, B = np.array([[1.0, h], [0.0, 1.0]]), np.array([[0.5 * h**2], [h]]) / INERTIA
    size = np.abs(np.linalg.eigvals(np.block([[A + B @ K, kept * B], [K, np.full((1, 1), kept)]]))).max()
    rows, goals = np.tile(K, (N, 1, 1)), np.tile([1.0, 0.0], (N, 1))
    policy = vp.LinearPolicy(
        np.zeros((N, 1)), rows, goals, on="velocity", previous_gains=np.full((N, 1, 1), kept), before=[0.0]
    )
    found = told(run(ROD, [0.9], [0.0], policy, dt=h, steps=N, integrator=vp.RungeKutta4()))
    assert bool(found) == (size > 1.0), (size, found)
    for finding in found:
        np.testing.assert_allclose(finding.value, size, rtol=1e-6)


def test_the_sentence(caplog):
    with caplog.at_level(logging.WARNING, "varpin"):
        (sentence,) = run(ROD, [0], [0], pd(1e4, 200.0), dt=5e-3, steps=50).warnings
    assert naming([sentence], "unstable", "0.005 s", "2.13583", "lower gains")
    assert len(sentence) <= 240
    assert [record.getMessage() for record in caplog.records] == [sentence]
    assert not run(ROD, [0], [0], pd(1e4, 200.0), dt=5e-3, steps=50, check=False).warnings
    assert not any(told(run(PENDULUM, [0], [0], pd(10.0, 1.0), dt=1e-3, steps=steps)) for steps in range(6))


@pytest.mark.parametrize(("kp", "kd", "dt", "failed"), [(3e4, 300, 5e-3, 3), (1e5, 1e3, 5e-3, 2), (1e7, 0, 1 / 30, 0)])
def test_a_step_that_fails_under_a_law_has_the_judgement_of_its_loop(kp, kd, dt, failed):
    with refused(vp.StepFailure, "unstable at its period") as caught:
        vp.simulate(TWO, [0, 0], [0, 0], dt=dt, steps=400, controls=pd(kp, kd))
    assert caught.value.step == failed
    size = radius(TWO, np.hstack([-kp * np.eye(2), -kd * np.eye(2)]), dt, np.ones(2))
    assert caught.value.trajectory.warnings[0].value == pytest.approx(size, rel=1e-6)


def test_an_ensemble_whose_loop_is_unstable_says_so():
    """The gains that a motion is warned of, with noise: as many paths as one likes run away."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, noise=vp.AdditiveNoise(1e-3))
    N = 100
    gains = np.tile([[[-100.0, -110.0]]], (N, 1, 1))
    policy = vp.LinearPolicy(np.zeros((N, 1)), gains, np.tile([1.0, 0.0], (N, 1)), on="velocity")
    options = {"dt": 1e-2, "steps": N, "integrator": vp.RungeKutta4()}
    ensemble = vp.simulate_ensemble(scene, [0.0], [0.0], paths=20, rng=0, controls=policy, **options)
    assert np.abs(ensemble.q).max() > 1e3
    assert told(ensemble), ensemble.warnings
    calm = vp.LinearPolicy(np.zeros((N, 1)), 0.2 * gains, policy.reference, on="velocity")
    quiet = vp.simulate_ensemble(scene, [0.0], [0.0], paths=20, rng=0, controls=calm, **options)
    assert not told(quiet), quiet.warnings


@pytest.mark.parametrize("integrator", [None, vp.Gauss(2), vp.RungeKutta4()])
def test_the_error_under_a_law_has_its_feedback(integrator):
    """A computed torque with an integral of its own, which compensates dampers that are as fast as its period."""
    scene, h, goal, rest = vp.Scene(rod_chain([1.0, 0.3], [1.0, 0.2]), damping=0.2), 5e-3, [0.5, -0.4], np.zeros(2)
    model = scene.robot.model
    data = model.createData()

    def law(missed):
        def torque(t, q, v):
            missed.append(np.subtract(goal, q))
            wanted = 100.0 * missed[-1] - 20.0 * v + 50.0 * h * np.sum(missed, axis=0)
            return pin.rnea(model, data, q, v, wanted) + 0.2 * v

        return torque

    calls, again = [], law([])
    motion = vp.simulate(scene, rest, rest, dt=h, steps=100, controls=law(calls), integrator=integrator)

    def signal(k, q, v):
        torque = again(motion.t[k], q, v)
        return lambda t: torque

    off = np.abs(motion.q - exact(scene, rest, rest, motion.t, signal).q)
    assert abs(motion.error.max() - off.max()) <= 0.1 * off.max()
    assert len(calls) == motion.steps


def test_a_law_that_cannot_be_copied_keeps_its_record():
    lock = threading.Lock()

    def law(t, q, v):
        with lock:
            return -5.0 * np.sin(q) - v

    motion = vp.simulate(ROD, [0.5], [0.0], dt=1e-2, steps=100, controls=law)
    assert 0.0 < motion.error.max() < 1e-6


def of_module(t, q, v, times=[0.0]):  # noqa: B006
    """A function that pickle knows by its name alone, with an integral of its own."""
    times.append(times[-1] + q[0])
    return -q - 0.1 * v - 0.05 * times[-1]


def test_a_law_of_a_module_is_copied_with_its_memory():
    (times,) = of_module.__defaults__
    motion = vp.simulate(ROD, [0.5], [0.0], dt=1e-2, steps=100, controls=of_module)
    assert len(times) == 1 + motion.steps
    assert not about(motion.warnings, "error")
    assert 0.0 < motion.error.max() < 1e-6


def test_classes_of_laws_stay_as_they_are():
    class Integral:
        total = np.zeros(1)

        def __call__(self, t, q, v):
            Integral.total = Integral.total + q
            return -q - 0.1 * v - 0.05 * Integral.total

    before = Integral.__call__
    motion = vp.simulate(ROD, [0.5], [0.0], dt=1e-2, steps=100, controls=Integral())
    assert Integral.__call__ is before
    np.testing.assert_allclose(Integral.total, motion.q[:-1].sum(axis=0))
    assert 0.0 < motion.error.max() < 1e-6


class Unreadable:
    """Pickle writes it and fails to read it."""

    def __call__(self, t, q, v):
        return -5.0 * np.sin(q) - v

    def __reduce__(self):
        return Unreadable, (1,)


def test_a_law_whose_copy_fails_keeps_its_record():
    motion = vp.simulate(ROD, [0.5], [0.0], dt=1e-2, steps=100, controls=Unreadable())
    assert 0.0 < motion.error.max() < 1e-6
