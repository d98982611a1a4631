"""Control laws are digital controllers; a loop that is unstable at its period is told of, and no other."""

import logging

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from refusals import refused, unnamed
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import fsolve

import varpin as vp
from varpin.simulation.loop import unstable_loop

INTEGRATORS = (vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4())


class Plant:
    """A robot by Pinocchio's algorithms alone."""

    def __init__(self, scene):
        self.robot, self.damping = scene.robot, scene.damping
        self.model = scene.robot.model.copy()
        self.model.gravity = pin.Motion(scene.gravity, np.zeros(3))
        self.data = self.model.createData()

    def acceleration(self, q, v, u):
        place = self.robot.configuration(q)
        return pin.aba(self.model, self.data, place, v, u - self.damping * v).copy()

    def digital(self, law, q, v, dt, periods):
        """(periods + 1, 2n): DOP853 under a law that is evaluated every dt and held."""
        n, nodes = len(q), [np.concatenate([q, v])]
        for k in range(periods):
            x = nodes[-1]
            u = law(k * dt, x[:n], x[n:])

            def rate(_, x, u=u):
                return np.concatenate([x[n:], self.acceleration(x[:n], x[n:], u)])

            nodes.append(solve_ivp(rate, (0.0, dt), x, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1])
        return np.array(nodes)

    def spectral_radius(self, law, K, dt, guess):
        """Of the loop about its equilibrium next to a guess, by differences and scipy's expm."""
        n, still, h = len(guess), np.zeros(len(guess)), 1e-5
        q = fsolve(lambda q: self.acceleration(q, still, law(0.0, q, still)), guess)
        u, unit = law(0.0, q, still), np.eye(n)

        def slope(f):
            return np.array([(f(h * e) - f(-h * e)) / (2.0 * h) for e in unit]).T

        zero = np.zeros((n, n))
        rates = np.block(
            [
                [zero, unit, zero],
                [
                    slope(lambda e: self.acceleration(q + e, still, u)),
                    slope(lambda e: self.acceleration(q, e, u)),
                    slope(lambda e: self.acceleration(q, still, u + e)),
                ],
                [np.zeros((n, 3 * n))],
            ]
        )
        step = expm(dt * rates)[: 2 * n]
        return np.abs(np.linalg.eigvals(step[:, : 2 * n] + step[:, 2 * n :] @ K)).max()


def spring_and_damper(kp, kd, goal=1.0):
    return lambda t, q, v: -kp * (q - goal) - kd * v


def run(scene, q, v, law, **options):
    """The motion and whether its loop was called unstable; (None, True) if it cannot go on."""
    try:
        motion = vp.simulate(scene, q, v, controls=law, **options)
    except (vp.StepFailure, vp.ControlError):
        return None, True
    return motion, bool(about(motion.warnings, "unstable loop"))


@pytest.mark.parametrize("gravity", [False, True])
@pytest.mark.parametrize(
    ("kp", "kd", "dt", "stable"),
    [
        (1e4, 100, 4e-3, True),
        (1e4, 200, 5e-3, False),
        (100, 110, 1e-2, False),
        (1e4, 300, 5e-3, False),
        (2500, 100, 1e-2, False),
    ],
)
@pytest.mark.parametrize("integrator", [*INTEGRATORS, vp.ExplicitEuler()], ids=str)
def test_stiff_laws(kp, kd, dt, stable, gravity, integrator):
    scene, law = vp.Scene(vp.planar_chain(1), gravity=gravity), spring_and_damper(kp, kd)
    plant, zero = Plant(scene), np.zeros(1)
    assert (plant.spectral_radius(law, np.array([[-kp, -kd]]), dt, np.ones(1)) < 1.0) == stable
    motion, told = run(scene, zero, zero, law, dt=dt, steps=200, integrator=integrator)
    assert told == (not stable)
    if stable:
        if integrator.order > 1:
            assert motion.warnings == ()
        exact = plant.digital(law, zero, zero, dt, 100)
        # A rod in the plane: gravity changes little over a step, and the torque does not change at all.
        limit = {1: 0.3, 2: 1e-5, 4: 1e-6}[integrator.order]
        assert np.abs(motion.q[:101, 0] - exact[:, 0]).max() < limit


def random_loops():
    """200 loops: links, gains, period, gravity."""
    rng = np.random.default_rng(14)
    for trial in range(200):
        n = int(rng.integers(1, 4))
        kp, kd, dt = 10 ** rng.uniform(1, 4), 10 ** rng.uniform(0, 2.5), 10 ** rng.uniform(-3, -1.7)
        yield trial, n, kp, kd, dt, bool(rng.integers(2))


def predictable(plant, law, n, dt, periods):
    """The exact loop from rest (K + 1, 2n), as far as a small disturbance does not grow a thousandfold."""
    zero = np.zeros(n)
    exact, moved = (plant.digital(law, zero + small, zero, dt, periods) for small in (0.0, 1e-7))
    grown = ~(np.abs(moved - exact)[:, :n].max(axis=1) < 1e-4)
    return exact[: max(2, int(grown.argmax())) if grown.any() else len(exact)]


@pytest.mark.parametrize("part", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 10))])
def test_random_loops(part):
    """What is stable follows the digital controller; what is unstable is told of or stops; some at a time."""
    held = 0
    for trial, n, kp, kd, dt, gravity in list(random_loops())[part::10]:
        scene, law = vp.Scene(vp.planar_chain(n), gravity=gravity), spring_and_damper(kp, kd)
        plant, zero = Plant(scene), np.zeros(n)
        K = np.hstack([-kp * np.eye(n), -kd * np.eye(n)])
        radius = plant.spectral_radius(law, K, dt, np.ones(n))
        integrator = INTEGRATORS[trial % 3]
        what = f"{n} links, kp = {kp:.6g}, kd = {kd:.6g}, dt = {dt:.6g} s, radius {radius:.6g}, {integrator}"
        motion, told = run(scene, zero, zero, law, dt=dt, steps=200, integrator=integrator)
        if radius >= 1.0:
            assert told, what
            continue
        exact = predictable(plant, law, n, dt, 24)
        if motion is None:
            # Stable next to its goal, but not from where it starts: so is the exact loop.
            assert np.abs(exact[:, n:]).max() > 1e2, what
            continue
        assert not told, what
        held += 1
        periods = len(exact) - 1
        fine, _ = run(scene, zero, zero, law, dt=dt / 32, steps=32 * periods, period=32, integrator=vp.Gauss(4))
        np.testing.assert_allclose(fine.q[::32], exact[:, :n], rtol=0, atol=1e-5, err_msg=what)
        # What is coarse at a step a period says so.
        own = np.abs(motion.q[: periods + 1] - exact[:, :n]).max() / np.abs(exact[:, :n]).max()
        assert own < 0.1 or motion.warnings, what
    assert held > 3


def saturated(kp, kd, limit):
    return lambda t, q, v: np.clip(-kp * (q - 1.0) - kd * v, -limit, limit)


@pytest.mark.parametrize(
    ("links", "period", "kd", "limit"), [(1, 1, 200.0, 5.0), (2, 3, 200.0, 20.0), (2, 1, 400.0, 100.0)]
)
def test_a_saturated_loop_that_flips_is_told_of(links, period, kd, limit):
    """It cannot grow beyond its limits, and goes from one to the other for ever."""
    scene, zero = vp.Scene(vp.planar_chain(links), gravity=False), np.zeros(links)
    options = {"dt": 5e-3, "steps": 600, "period": period}
    motion, _ = run(scene, zero, zero, saturated(100.0, kd, limit), **options)
    late = motion.u[::period][-50:]
    assert (late[1:] * late[:-1] < 0.0).mean() > 0.9
    assert about(motion.warnings, "unstable loop")
    calm, _ = run(scene, zero, zero, saturated(100.0, 10.0 / period, limit), **options)
    assert not about(calm.warnings, "unstable loop")


def test_a_law_is_read_off_where_it_does_not_saturate():
    scene = vp.Scene(vp.planar_chain(1), gravity=False)
    motion, told = run(scene, [0.0], [0.0], saturated(100.0, 134.0, 3.0), dt=5e-3, steps=600)
    assert (np.abs(motion.u) == 3.0).any()
    assert told
    assert about(motion.warnings[0], "unstable loop")


def clipped_loops():
    """Loops without end: scene, gains, limit, step, period, start, spectral radius of the loop without limits."""
    rng = np.random.default_rng(3)
    while True:
        n, period = int(rng.integers(1, 3)), int(rng.integers(1, 4))
        scene, goal = vp.Scene(vp.planar_chain(n), gravity=False, damping=0.01), np.full(n, 0.3)
        kp, kd, dt, limit = (10 ** rng.uniform(*ends) for ends in ((1, 4.5), (0, 2.5), (-3, -2), (0.5, 2)))
        start = goal + 10 ** rng.uniform(-4, 0) * rng.normal(size=n)
        K = np.hstack([-kp * np.eye(n), -kd * np.eye(n)])
        radius = Plant(scene).spectral_radius(spring_and_damper(kp, kd, goal), K, period * dt, goal)
        yield scene, kp, kd, limit, dt, period, start, radius


def speaks_of_the_loop(motion):
    return bool(about(motion.warnings, "unstable loop"))


def test_random_clipped_loops():
    """Limits keep what is unstable from growing: it cycles, over any number of periods."""
    counts = {True: 0, False: 0}
    told = {True: 0, False: 0}
    for scene, kp, kd, limit, dt, period, start, radius in clipped_loops():
        if min(counts.values()) >= 20:
            break
        unstable = radius > 1.05
        if 1.0 <= radius <= 1.05 or counts[unstable] >= 20:
            continue
        what = f"kp {kp:.6g}, kd {kd:.6g}, limit {limit:.4g}, dt {dt:.5g}, period {period}, start {start}, {radius:.5g}"
        counts[unstable] += 1

        def law(t, q, v, kp=kp, kd=kd, limit=limit):
            return np.clip(-kp * (q - 0.3) - kd * v, -limit, limit)

        try:
            motion = vp.simulate(scene, start, 0 * start, dt=dt, steps=600, period=period, controls=law)
        except vp.StepFailure:
            assert unstable, what
            continue
        off = np.abs(motion.q - 0.3).max(axis=1)
        if unstable and (off.max() > 10.0 * off[0] or (np.abs(motion.u[400:]) == limit).any()):
            assert speaks_of_the_loop(motion), what
            told[any("from limit to limit" in text for text in motion.warnings)] += 1
        if not unstable:
            assert not speaks_of_the_loop(motion), (what, motion.warnings)
    # Laws that can be told from the nodes inside their limits, and laws that cannot.
    assert told[False] > 5
    assert told[True] > 1


def test_a_clipped_loop_is_judged_by_its_few_nodes_inside_its_limits():
    """A cycle of 20 periods, 2900 times its start; 4 of 300 periods are inside the limits."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=0.01)
    kp, kd = 22161.0, 6.8
    law = saturated(kp, kd, 20.0)
    motion = vp.simulate(scene, [1.0003], [0.0], dt=5.33e-3, steps=600, period=2, controls=law)
    assert np.abs(motion.q - 1.0).max() > 1e3 * 3e-4
    plant = Plant(scene)
    radius = plant.spectral_radius(spring_and_damper(kp, kd), np.array([[-kp, -kd]]), 2 * 5.33e-3, np.ones(1))
    assert not unnamed(motion.warnings[0], f"{radius:.4g}")


def test_goals_that_move_from_limit_to_limit_are_no_alarm():
    """Nor is a law that pumps on purpose."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=0.01)
    for law in (
        lambda t, q, v: np.clip(-1e3 * (q - 3.0 * np.sin(6.0 * t)) - 50.0 * v, -10.0, 10.0),
        lambda t, q, v: np.clip(-3e3 * (q - np.sin(8.0 * t)) - 60.0 * (v - 8.0 * np.cos(8.0 * t)), -10.0, 10.0),
        lambda t, q, v: np.clip(-300.0 * (q - 0.5 * np.sign(np.sin(9.0 * t))) - 20.0 * v, -5.0, 5.0),
        lambda t, q, v: 10.0 * np.sign(np.sin(9.0 * t)) * np.ones(1),
    ):
        motion = vp.simulate(scene, [0.0], [0.0], dt=5e-3, steps=600, controls=law)
        late = motion.u[300:]
        assert (late == motion.u.max()).any()
        assert (late == motion.u.min()).any()
        assert not speaks_of_the_loop(motion), motion.warnings


def test_a_swing_up_from_limit_to_limit_is_no_alarm():
    """It pumps on purpose, catches the pendulum upright and holds it."""
    scene = vp.Scene(vp.planar_chain(1), damping=0.01)

    def law(t, q, v):
        if np.sin(q[0]) < -0.8:
            off = np.arctan2(np.cos(q), -np.sin(q))
            return np.clip(-60.0 * off - 10.0 * v, -6.0, 6.0)
        return -2.0 * np.sign(v * (v**2 / 6.0 - 0.5 * 9.81 * (np.sin(q) + 1.0)) + 1e-12)

    motion = vp.simulate(scene, [0.1 + np.pi / 2], [0.0], dt=5e-3, steps=1600, controls=law)
    assert (motion.u == 2.0).any()
    assert (motion.u == -2.0).any()
    assert abs(motion.v[-1, 0]) < 1e-6
    assert not speaks_of_the_loop(motion), motion.warnings
    pumped = vp.simulate(
        scene, [0.1 + np.pi / 2], [0.0], dt=5e-3, steps=1600, controls=lambda t, q, v: 0.3 * np.sign(v - 1e-12)
    )
    assert (np.diff(pumped.u[:, 0]) != 0.0).sum() > 6
    assert not speaks_of_the_loop(pumped), pumped.warnings


def test_torque_limits_of_an_arm_with_a_far_goal_are_no_alarm():
    scene = vp.Scene(vp.load_robot("ur5"), damping=1.0)
    goal, limit = np.array([1.0, -1.0, 1.2, -0.8, 0.5, 0.7]), 0.4 * np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0])
    M = np.diag(vp.lagrangian_jet(scene, goal, np.zeros(6)).Lvv)
    motion = vp.simulate(
        scene, np.zeros(6), np.zeros(6), dt=2e-3, steps=600,
        controls=lambda t, q, v: np.clip(-M * (400.0 * (q - goal) + 10.0 * v), -limit, limit),
    )  # fmt: skip
    assert (np.abs(motion.u) == limit).any()
    assert not speaks_of_the_loop(motion), motion.warnings


@pytest.mark.parametrize("kd", [1e3, 1e5, 1e6])
def test_a_loop_that_ends_within_a_few_periods_is_named(kd):
    with refused(vp.StepFailure, "unstable") as caught:
        vp.simulate(
            vp.Scene(vp.planar_chain(2)), [0, 0], [0, 0], dt=5e-3, steps=400, controls=spring_and_damper(1e5, kd)
        )
    assert caught.value.trajectory.steps < 5


@pytest.mark.parametrize("name", ["ur5", "panda"])
@pytest.mark.parametrize("share", [0.8, 2.6])
def test_stiff_laws_on_arms(name, share):
    """Gains in proportion to inertias, such that the fastest direction loses a share of its speed a period."""
    lock = {"panda_finger_joint1": 0.02} if name == "panda" else None
    scene = vp.Scene(vp.load_robot(name, lock=lock), damping=0.05)
    n, plant, dt = scene.robot.dof, Plant(scene), 2e-3
    goal = np.linspace(0.3, -0.4, n) - (1.5 if name == "panda" else 0.0) * (np.arange(n) == 3)
    M = vp.lagrangian_jet(scene, goal, np.zeros(n)).Lvv
    kd = np.diag(M) * share / dt / np.linalg.eigvals(np.linalg.solve(M, np.diag(np.diag(M)))).real.max()
    kp = 50.0 * kd
    law = spring_and_damper(kp, kd, goal)
    K = np.hstack([-np.diag(kp), -np.diag(kd)])
    radius = plant.spectral_radius(law, K, dt, goal)
    assert (radius < 1.0) == (share < 2.0)
    q0 = goal + 0.02
    motion, told = run(scene, q0, np.zeros(n), law, dt=dt, steps=150, integrator=vp.Gauss(2))
    assert told == (share > 2.0)
    if share < 2.0:
        exact = plant.digital(law, q0, np.zeros(n), dt, 15)
        np.testing.assert_allclose(motion.q[:16], exact[:, :n], rtol=0, atol=1e-6)


def test_a_law_is_not_called_for_a_look():
    """A law may have a memory: one call a period, in the order of time, whatever is looked at."""
    scene, times = vp.Scene(vp.planar_chain(2)), []

    def law(t, q, v):
        times.append(t)
        return -50.0 * (q - 1.0) - 10.0 * v

    for check in (True, False):
        times.clear()
        vp.simulate(scene, [0, 0], [0, 0], dt=2e-3, steps=60, controls=law, period=3, check=check)
        np.testing.assert_allclose(times, 6e-3 * np.arange(20), atol=1e-12)


def slow_law(radius):
    """A damper on a rod whose loop multiplies deviations of v by -radius a period of 4 ms."""
    rod = vp.Scene(vp.planar_chain(1), gravity=False)
    inertia = vp.lagrangian_jet(rod, [0.0], [0.0]).Lvv[0, 0]
    return rod, (1.0 + radius) * inertia / 4e-3


@pytest.mark.parametrize("radius", [0.995, 1.005])
def test_a_loop_that_is_slowly_unstable(radius):
    rod, kd = slow_law(radius)
    motion, told = run(rod, [0.3], [0.2], lambda t, q, v: -kd * v, dt=4e-3, steps=60)
    assert told == (radius > 1.0)
    if told:
        assert not unnamed(motion.warnings[0], f"{radius:.4g}")
    # Its goal moves, and no equilibrium is there to look at: the motion tells.
    _, told = run(rod, [0.3], [0.2], lambda t, q, v: -kd * (v - 3.0), dt=4e-3, steps=400)
    assert told == (radius > 1.0)


def test_slow_turns_of_a_complex_pair():
    """A sampled spring without a damper gains amplitude: |z|^2 = 1 + kp T^2 / (2 M)."""
    rod, _ = slow_law(1.0)
    inertia, dt = 1.0 / 3.0, 4e-3
    for kp in (30.0, 300.0):
        motion, told = run(rod, [0.3], [0.0], spring_and_damper(kp, 0.0, 0.0), dt=dt, steps=600)
        assert told
        assert not unnamed(motion.warnings[0], f"{np.sqrt(1.0 + 0.5 * kp * dt**2 / inertia):.4g}")


def cases_without_alarm():
    rod, free = vp.Scene(vp.planar_chain(1)), vp.Scene(vp.planar_chain(1), gravity=False)
    two, up = vp.Scene(vp.planar_chain(2)), np.pi / 2 - 1e-6
    noisy = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(0.1))
    passive = vp.Scene(vp.planar_chain(2), actuation=[[1.0], [0.0]])

    def pump(t, q, v):
        return -0.3 * v * (v**2 / 6.0 + 0.5 * 9.81 * (np.sin(q) - 1.0))

    return {
        "falls from upright, weak damping": (rod, [up], lambda t, q, v: -0.1 * v, {}),
        "falls from upright, weak springs": (rod, [up], lambda t, q, v: -(q - np.pi / 2) - 0.1 * v, {}),
        "falls without torque": (two, [0, 0], lambda t, q, v: 0.0 * v, {}),
        "constant torque": (free, [0], lambda t, q, v: np.ones(1), {}),
        "goal that swings": (two, [0, 0], lambda t, q, v: -300 * (q - np.sin(3 * t)) - 30 * v, {}),
        "goal that jumps late": (free, [0], lambda t, q, v: -100 * (q - (t > 1.0)) - 10 * v, {}),
        "goal that runs away": (free, [0], lambda t, q, v: -100 * (q - t**3) - 10 * (v - 3 * t**2), {}),
        "saturates": (rod, [0], lambda t, q, v: np.clip(-1e3 * (q - 1) - 50 * v, -20, 20), {}),
        "gravity compensated": (
            two, [0, 0],
            lambda t, q, v: -vp.lagrangian_jet(two, q, np.zeros(2)).Lq - 100 * (q - 1) - 5 * v, {},
        ),
        "starts at its goal and sags": (rod, [1], spring_and_damper(1e4, 100.0), {}),
        "rests at its goal": (free, [1], spring_and_damper(1e4, 300.0), {}),
        "velocity goal": (free, [0], lambda t, q, v: -30 * (v - 5), {}),
        "drag": (free, [0], lambda t, q, v: -100 * (q - 1) - 20 * v * np.abs(v), {}),
        "one joint of two": (passive, [0, 0], lambda t, q, v: -100 * (q[:1] - 1) - 20 * v[:1], {}),
        "pumped up": (rod, [0.01 - np.pi / 2], pump, {}),
        "noise": (noisy, [0, 0], spring_and_damper(300.0, 10.0), {"rng": 0}),
        "seldom": (rod, [0], spring_and_damper(100.0, 20.0), {"period": 4}),
    }  # fmt: skip


@pytest.mark.parametrize("case", cases_without_alarm())
def test_no_alarm(case):
    scene, q0, law, options = cases_without_alarm()[case]
    motion, told = run(scene, q0, np.zeros(len(q0)), law, dt=2e-3, steps=700, **options)
    assert motion is not None
    assert not told


def integral(kp, ki, kd, dt):
    """A law with a memory."""
    total = 0.0

    def law(t, q, v):
        nonlocal total
        total = total + dt * (q - 1.0)
        return -kp * (q - 1.0) - ki * total - kd * v

    return law


def cases_with_alarm():
    rod, free, two = (vp.Scene(vp.planar_chain(n), gravity=g) for n, g in ((1, True), (1, False), (2, True)))
    one = vp.Scene(vp.planar_chain(2), actuation=[[1.0], [0.0]])
    noisy = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(0.1))
    plant = Plant(two)

    def inverse_dynamics(t, q, v):
        return pin.rnea(plant.model, plant.data, q, v, -100.0 * (q - 1.0) - 203.0 * v)

    return {
        "integral": (rod, [0], integral(300.0, 500.0, 70.0, 1e-2), {}),
        "gravity compensated": (
            two, [1, 0.9],
            lambda t, q, v: -vp.lagrangian_jet(two, q, np.zeros(2)).Lq - 100 * (q - 1) - 40 * v, {},
        ),
        "inverse dynamics": (two, [1, 0.9], inverse_dynamics, {}),
        "one joint of two": (one, [0, 0], lambda t, q, v: -100 * (q[:1] - 1) - 200 * v[:1], {}),
        "noise": (noisy, [0, 0], spring_and_damper(300.0, 60.0), {"rng": 0}),
        "negative damper": (free, [0.1], lambda t, q, v: -10 * q + 5 * v, {}),
        "seldom": (rod, [0], spring_and_damper(100.0, 40.0), {"period": 2}),
        "near its goal": (free, [1 + 1e-6], spring_and_damper(1e3, 80.0), {}),
    }  # fmt: skip


@pytest.mark.parametrize("case", cases_with_alarm())
def test_alarm(case):
    scene, q0, law, options = cases_with_alarm()[case]
    _, told = run(scene, q0, np.zeros(len(q0)), law, dt=1e-2, steps=200, **options)
    assert told


def test_no_motion_ends_silently_above_a_thousand_times_its_start():
    """Whatever the law: torques that grow on and on."""
    free = vp.Scene(vp.planar_chain(1), gravity=False)
    for kp, kd in ((10.0, 69.0), (1e3, 0.0), (1e4, 10.0), (3e3, 20.0)):
        for shape in (lambda x: x, lambda x: x * (1.0 + 0.1 * np.sin(x)), lambda x: x + 0.1 * np.cos(x)):

            def law(t, q, v, kp=kp, kd=kd, shape=shape):
                return shape(-kp * (q - 1) - kd * v)

            motion, told = run(free, [0.0], [0.0], law, dt=1e-2, steps=400)
            if motion is not None and np.abs(motion.u[-20:]).max() > 1e3 * np.abs(motion.u[0]).max():
                assert told
                continue
            assert told or np.abs(motion.u).max() < 1e4 * np.abs(motion.u[0]).max()


def test_policies_are_looked_at():
    """Gains of a plan that act for its horizon are no alarm; constant gains beyond their period are."""
    scene, steps = vp.Scene(vp.planar_chain(2)), 100
    cost = vp.ControlCost(1e-3) + vp.Terminal(vp.TrackingCost([0.5, 0.3], 1e4) + vp.VelocityCost(1e2))
    problem = vp.OptimalControlProblem(
        scene, cost, [0, 0], [0, 0], dt=1e-2, steps=steps, integrator=vp.Gauss(2), sampling="gauss"
    )
    policy = vp.solve(problem).policy
    options = {"dt": 1e-2, "steps": steps, "integrator": vp.Gauss(2)}
    for q0 in ([0, 0], [0.05, -0.03]):
        assert not any("unstable" in w for w in vp.simulate(scene, q0, [0, 0], controls=policy, **options).warnings)
    free = vp.Scene(vp.planar_chain(1), gravity=False)
    for kd, unstable in ((50.0, False), (80.0, True)):
        own = vp.LinearPolicy(
            np.zeros((steps, 1)), np.tile([[-1e3, -kd]], (steps, 1, 1)), np.tile([1.0, 0.0], (steps, 1)), on="velocity"
        )
        motion, told = run(free, [0], [0], own, dt=1e-2, steps=steps, integrator=vp.RungeKutta4())
        assert told == unstable, (motion and motion.warnings, kd)


def test_the_sentence_says_what_to_do(caplog):
    scene = vp.Scene(vp.planar_chain(1), gravity=False)
    with caplog.at_level(logging.WARNING, "varpin"):
        motion, _ = run(scene, [0], [0], spring_and_damper(1e4, 200.0), dt=5e-3, steps=50)
        run(scene, [0], [0], spring_and_damper(1e4, 200.0), dt=5e-3, steps=50)
    (sentence,) = motion.warnings
    assert not unnamed(sentence, "unstable", "0.005 s", "2.136", "0.00295 s", "gains")
    assert [record.getMessage() for record in caplog.records] == [sentence]
    assert not run(scene, [0], [0], spring_and_damper(1e4, 200.0), dt=2.9e-3, steps=50)[1]
    assert run(scene, [0], [0], spring_and_damper(1e4, 200.0), dt=5e-3, steps=50, check=False)[0].warnings == ()


def test_a_step_that_fails_says_why():
    scene = vp.Scene(vp.planar_chain(1), gravity=False)
    with refused(vp.StepFailure, "period") as caught:
        vp.simulate(scene, [0], [0], dt=5e-3, steps=2000, controls=spring_and_damper(1e4, 300.0))
    assert about(caught.value.trajectory.warnings[0], "unstable loop")


def test_short_motions_and_still_ones():
    scene = vp.Scene(vp.planar_chain(1))
    for steps in range(6):
        motion = vp.simulate(scene, [0], [0], dt=1e-3, steps=steps, controls=spring_and_damper(10.0, 1.0))
        assert unstable_loop(scene, motion) == ()


def test_noise_that_python_evaluates_keeps_the_period():
    """Such noise is simulated step by step; the law still decides once a period."""
    times = []

    def law(t, q, v):
        times.append(t)
        return -10.0 * q - v

    motions = []
    for noise in (vp.CustomNoise(lambda q, v, u: np.eye(2) * 0.1, 2), vp.AdditiveNoise(0.1)):
        times.clear()
        scene = vp.Scene(vp.planar_chain(2), noise=noise)
        motions.append(vp.simulate(scene, [0.3, 0], [0, 0], dt=1e-2, steps=17, controls=law, period=5, rng=3))
        np.testing.assert_allclose(times, [0.0, 0.05, 0.1, 0.15])
    np.testing.assert_allclose(motions[0].u, motions[1].u, atol=1e-12)


def test_an_ensemble_whose_loop_is_unstable_says_so():
    """The gains that a motion is warned of, with noise: as many paths as one likes run away."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, noise=vp.AdditiveNoise(1e-3))
    N = 100
    gains = np.tile([[[-100.0, -110.0]]], (N, 1, 1))
    policy = vp.LinearPolicy(np.zeros((N, 1)), gains, np.tile([1.0, 0.0], (N, 1)), on="velocity")
    options = {"dt": 1e-2, "steps": N, "integrator": vp.RungeKutta4()}
    ensemble = vp.simulate_ensemble(scene, [0.0], [0.0], paths=20, rng=0, controls=policy, **options)
    assert np.abs(ensemble.q).max() > 1e3
    assert about(ensemble.warnings, "unstable loop"), ensemble.warnings
    calm = vp.LinearPolicy(np.zeros((N, 1)), 0.2 * gains, policy.reference, on="velocity")
    quiet = vp.simulate_ensemble(scene, [0.0], [0.0], paths=20, rng=0, controls=calm, **options)
    assert not about(quiet.warnings, "unstable loop"), quiet.warnings
