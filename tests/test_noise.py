"""Diffusion fields, Wiener increments, order and laws of motions under noise; noise that is held, or forgotten."""

import logging

import numpy as np
import pytest
from findings import about
from mechanisms import crank_and_slider, slider
from oracles import jacobian
from plan_problems import swing
from refusals import naming, refused
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_lyapunov
from zoo import rough

import varpin as vp
from varpin.mechanics.wiener import coarsen, refine, wiener_increments
from varpin.simulation.failures import NoiseError

# Three coordinates, two controls: one joint is not actuated, and a control moves two joints.
ACTUATION = np.array([[1.0, 0.0], [0.0, 0.0], [0.5, 2.0]])


def chain(noise, links=2, **options):
    return vp.Scene(vp.planar_chain(links), noise=noise, **options)


def rough_field(q, v, u):
    return 0.3 * (np.outer(q, q) + np.diag(1.0 + 0.5 * v**2 + q * v) + u[0])


OWN = rough(3, 2, 0.3)
TABLE = np.random.default_rng(3).normal(size=(3, 4, 2))
MATRIX = np.random.default_rng(4).normal(size=(3, 2))
CENTER = np.array([0.3, -0.2, 1.0])

# Model, and F at one point as its definition has it.
MODELS = {
    "additive": (vp.AdditiveNoise(0.7), lambda q, v, u, start: np.diag([0.7] * 3)),
    "additive row": (vp.AdditiveNoise([0.7, 0.0, 2.0]), lambda q, v, u, start: np.diag([0.7, 0.0, 2.0])),
    "additive matrix": (vp.AdditiveNoise(MATRIX), lambda q, v, u, start: MATRIX),
    "control": (vp.ControlNoise(0.4), lambda q, v, u, start: 0.4 * ACTUATION * u),
    "control row": (vp.ControlNoise([0.4, -0.1]), lambda q, v, u, start: ACTUATION * [0.4, -0.1] * u),
    "control table": (vp.ControlNoise(TABLE), lambda q, v, u, start: TABLE @ u),
    "state": (vp.StateNoise(0.6), lambda q, v, u, start: np.diag(0.6 * (q - start) ** 2)),
    "state center": (
        vp.StateNoise([0.6, 1.0, 2.0], center=CENTER),
        lambda q, v, u, start: np.diag([0.6, 1.0, 2.0] * (q - CENTER) ** 2),
    ),
    "custom": (OWN, lambda q, v, u, start: rough_field(q, v, u)),
    "list": (
        [vp.AdditiveNoise(MATRIX), OWN, vp.ControlNoise(0.4)],
        lambda q, v, u, start: np.hstack([MATRIX, rough_field(q, v, u), 0.4 * ACTUATION * u]),
    ),
    "sum": (
        vp.StateNoise(0.6) + (vp.AdditiveNoise(0.7) + vp.ControlNoise(TABLE)),
        lambda q, v, u, start: np.hstack([np.diag(0.6 * (q - start) ** 2), np.diag([0.7] * 3), TABLE @ u]),
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_fields_are_as_defined_and_have_their_derivatives(name):
    model, expected = MODELS[name]
    bound = vp.Scene(vp.planar_chain(3), actuation=ACTUATION, noise=model).noise
    rng = np.random.default_rng(0)
    q, v, u, start = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=(5, 2)), rng.normal(size=3)
    fields = bound.fields(q, v, u, start)
    exact = np.array([expected(*point, start) for point in zip(q, v, u, strict=True)])
    assert fields.F.shape == exact.shape == (5, 3, bound.processes)
    np.testing.assert_allclose(fields.F, exact, rtol=0, atol=1e-14)
    Fq = jacobian(lambda q: bound.fields(q, v, u, start).F, q, 1e-2)
    Fv = jacobian(lambda v: bound.fields(q, v, u, start).F, v, 1e-2)
    Fu = jacobian(lambda u: bound.fields(q, v, u, start).F, u, 1e-2)
    np.testing.assert_allclose(fields.Fq, Fq, rtol=0, atol=1e-12)
    np.testing.assert_allclose(fields.Fu, Fu, rtol=0, atol=1e-12)
    assert bound.velocity_dependent == (fields.Fv is not None) == bool(np.abs(Fv).max() > 0.1)
    if fields.Fv is not None:
        np.testing.assert_allclose(fields.Fv, Fv, rtol=0, atol=1e-12)


def test_state_noise_is_centred_on_the_start_of_the_motion():
    start, end = np.array([0.4, -0.9]), {"dt": 0.01, "steps": 60, "rng": 3}
    given = vp.simulate(chain(vp.StateNoise(0.8, center=start)), start, [1.0, 0.0], **end)
    left_out = vp.simulate(chain(vp.StateNoise(0.8)), start, [1.0, 0.0], **end)
    assert left_out.p.tobytes() == given.p.tobytes()
    starts = np.array([start, start + 1.0])
    paths = vp.simulate_ensemble(chain(vp.StateNoise(0.8)), starts, [1.0, 0.0], paths=2, **end)
    for k in range(2):
        scene = chain(vp.StateNoise(0.8, center=starts[k]))
        alone = vp.simulate_ensemble(scene, starts, [1.0, 0.0], paths=2, **end)
        assert alone.p[k].tobytes() == paths.p[k].tobytes()


@pytest.mark.parametrize("left_out", [False, True])
@pytest.mark.parametrize("wrong", ["dq", "dv", "du"])
def test_a_wrong_or_missing_derivative_is_named(wrong, left_out):
    slots = {name: getattr(OWN, name) for name in ("dq", "dv", "du")}
    exact = slots.pop(wrong)

    def off(q, v, u):
        values = np.array(exact(q, v, u))
        values[2, 1, 1] += 1e-3
        return values

    if not left_out:
        slots[wrong] = off
    with refused(vp.InputError, f"CustomNoise {wrong}(q, v, u)", "[:, :, 0]" if left_out else ("[:, :, 1]", "0.001")):
        vp.Scene(vp.planar_chain(3), actuation=ACTUATION, noise=vp.CustomNoise(OWN.field, 3, **slots, check=True))


@pytest.mark.parametrize(
    ("slots", "facts"),
    [
        ({"field": lambda q, v, u: np.eye(3)}, ("CustomNoise field(q, v, u)", "(2, 2)", "(3, 3)")),
        ({"field": lambda q, v, u: [[1, 0], [0, np.nan]]}, ("CustomNoise field(q, v, u)[1, 1]", "nan")),
        ({"dq": lambda q, v, u: np.zeros((2, 2))}, ("CustomNoise dq(q, v, u)", "(2, 2, 2)", "(2, 2)")),
        ({"dv": lambda q, v, u: np.full((2, 2, 2), np.inf)}, ("CustomNoise dv(q, v, u)[0, 0, 0]", "inf")),
        ({"du": lambda q, v, u: np.zeros((2, 2, 5))}, ("CustomNoise du(q, v, u)", "(2, 2, 2)", "(2, 2, 5)")),
    ],
)
def test_what_a_field_returns_is_checked(slots, facts):
    slots = {"field": lambda q, v, u: np.eye(2), "processes": 2} | slots
    with refused(vp.NoiseFieldError, facts):
        chain(vp.CustomNoise(**slots, check=True))
    scene = chain(vp.CustomNoise(**slots))
    with refused(NoiseError, "step 0", "t = 0 s", facts):
        vp.simulate(scene, [0, 0], [0, 0], dt=0.01, steps=3, rng=0)


@pytest.mark.parametrize("integrator", [vp.Midpoint(kick="held"), vp.Midpoint(kick="split"), vp.RungeKutta4()], ids=str)
def test_a_field_that_fails_on_the_way_leaves_the_motion_so_far(integrator):
    calls, cause = [], ZeroDivisionError("no field")

    def field(q, v, u):
        calls.append(q)
        # Split kicks take the field twice a step: at its start, and at its end.
        if failing and len(calls) > (7 if integrator.left == 1.0 else 14):
            raise cause
        return 0.1 * np.eye(2)

    policy = vp.LinearPolicy(np.full((5, 2), 0.2), np.full((5, 2, 4), -0.1), np.zeros((5, 4)), hold=4)
    noise = vp.CustomNoise(field, 2, dv=lambda q, v, u: np.zeros((2, 2, 2)))
    scene, options = chain(vp.AdditiveNoise(0.1) + noise), {"dt": 0.01, "steps": 20, "rng": 0, "controls": policy}
    failing = False
    whole = vp.simulate(scene, [0.3, 0.2], [0, 1], integrator=integrator, **options)
    failing = True
    calls.clear()
    with refused(NoiseError, "step 7", "t = 0.07 s", "CustomNoise field(q, v, u)", "ZeroDivisionError") as info:
        vp.simulate(scene, [0.3, 0.2], [0, 1], integrator=integrator, **options)
    error = info.value
    assert (error.step, error.time, error.trajectory.steps) == (7, pytest.approx(0.07), 7)
    assert error.__cause__ is cause
    for name in ("q", "v", "p", "energy", "u", "dw"):
        own = getattr(error.trajectory, name)
        assert own.tobytes() == getattr(whole, name)[: len(own)].tobytes()


def test_a_field_cannot_reach_into_the_motion():
    def vandal(q, v, u):
        value = np.diag(q)
        q[:], v[:], u[:] = 1e3, 1e3, 1e3
        return value

    options = {"dt": 0.01, "steps": 20, "rng": 0, "controls": [0.2, 0.1]}
    motions = [
        vp.simulate(chain(vp.CustomNoise(field, 2)), [0.3, 0.2], [0, 1], **options)
        for field in (vandal, lambda q, v, u: np.diag(q))
    ]
    assert motions[0].p.tobytes() == motions[1].p.tobytes()
    assert motions[0].u.tobytes() == motions[1].u.tobytes()


@pytest.mark.parametrize(
    "integrator", [vp.Midpoint(), vp.Midpoint(kick="split"), vp.Midpoint(kick="held"), vp.Radau(2)]
)
@pytest.mark.parametrize("dv", [True, False], ids=["Stratonovich", "Ito"])
def test_the_mean_of_noise_in_proportion_to_the_velocity(integrator, dv):
    """Over two steps of the noise with the moments of a normal one: dv = s v o dw has the mean v exp(s^2 t / 2)."""
    M, s, dt = vp.lagrangian_jet(vp.Scene(vp.planar_chain(1)), [0.0], [0.0]).Lvv[0, 0], 0.3, 0.01
    slopes = (lambda q, v, u: [[[s * M]]]) if dv else None
    noise = vp.CustomNoise(lambda q, v, u: [[s * M * v[0]]], 1, dv=slopes)
    scene = vp.Scene(vp.planar_chain(1), noise=noise, gravity=False)
    ends = [
        vp.simulate(scene, [0.5], [1.0], dt=dt, steps=1, integrator=integrator, increments=[[dw]], check=False).v[1, 0]
        for dw in (np.sqrt(dt), -np.sqrt(dt))
    ]
    drift = 0.5 * s**2 * dt
    # Half of a split kick has the field behind the step, which is half of the correction.
    known = drift if dv else 0.5 * drift * (getattr(integrator, "kick", "") == "split")
    assert np.mean(ends) - 1.0 == pytest.approx(known, rel=2e-3, abs=2e-3 * drift)


def test_noise_of_controls_within_a_step_is_that_of_their_mean():
    scene, start = chain(vp.ControlNoise(0.3), damping=0.1), ([0.3, 0.2], [0.0, 1.0])
    push = vp.OpenLoop(lambda t: [np.sin(9.0 * t), 1.0])
    motion = vp.simulate(scene, *start, dt=0.02, steps=4, controls=push, integrator=vp.Gauss(2), increments=0.0)
    lin = vp.linearize(scene, motion)
    np.testing.assert_array_equal(lin.Gramp, 0.5 * lin.Gu)
    assert np.abs(lin.Gu).max() > 1e-3


SPLIT = vp.Midpoint(kick="split")
BOTH = pytest.mark.parametrize("kick", ["left", "split"])


def test_increments_are_normal_with_variance_dt():
    dt, samples = 0.02, 400_000
    dw = wiener_increments(2, dt, samples // 2, rng=0)
    assert dw.shape == (samples // 2, 2)
    z = dw / np.sqrt(dt)
    # The moments of N(0, 1) and the variances of their estimates.
    for power, moment, variance in ((1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)):
        assert abs((z**power).mean() - moment) < 4.0 * np.sqrt(variance / samples)
    assert abs((z[:, 0] * z[:, 1]).mean()) < 4.0 / np.sqrt(samples / 2)
    assert abs((z[1:] * z[:-1]).mean()) < 4.0 / np.sqrt(samples)


def test_refined_increments_are_wiener_increments_of_half_the_step():
    dt, N = 0.1, 100_000
    dw = wiener_increments(1, dt, N, rng=1)
    fine = refine(dw, dt, rng=2)[:, 0] / np.sqrt(dt / 2)
    assert abs((fine**2).mean() - 1.0) < 4.0 * np.sqrt(2.0 / (2 * N))
    # Halves of one increment are as independent as neighbours from different increments.
    assert abs((fine[0::2] * fine[1::2]).mean()) < 4.0 / np.sqrt(N)
    assert abs((fine[1:-1:2] * fine[2::2]).mean()) < 4.0 / np.sqrt(N)
    # Given the increment, the middle is half of it on average, with variance dt / 4.
    middle = (fine[0::2] * np.sqrt(dt / 2)) - 0.5 * dw[:, 0]
    assert abs((middle * dw[:, 0]).mean()) < 4.0 * np.sqrt(0.25 * dt * dt / N)
    assert abs((middle**2).mean() - 0.25 * dt) < 4.0 * 0.25 * dt * np.sqrt(2.0 / N)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_coarse_increments_are_sums(factor):
    dw = np.arange(12.0).reshape(6, 2) ** 2
    sums = [[sum(dw[k * factor + i, c] for i in range(factor)) for c in range(2)] for k in range(6 // factor)]
    np.testing.assert_array_equal(coarsen(dw, factor), sums)


NOISES = {
    "additive": vp.AdditiveNoise(0.5),
    "state": vp.StateNoise(0.4, center=[2.0, -0.5]),
    "control": vp.ControlNoise(0.6),
}


@BOTH
@pytest.mark.parametrize("name", NOISES)
def test_strong_order_one(name, kick):
    """Mean over 200 paths of the largest error at common nodes, against 1/64 of the step on the same Brownian path."""
    scene, integrator = chain(NOISES[name], damping=0.3, stiffness=4.0), vp.Midpoint(kick=kick)
    duration, coarse, finest = 0.5, 32, 64
    # The same control function of time at every step size.
    u = np.array([[np.cos(3.0 * k / coarse), np.sin(5.0 * k / coarse)] for k in range(coarse)])

    def motion(dw):
        steps = len(dw)
        end = vp.simulate(
            scene, [1.0, 0.5], [0.0, 0.0], dt=duration / steps, steps=steps, increments=dw, integrator=integrator,
            controls=np.repeat(u, steps // coarse, axis=0), check=False,
        )  # fmt: skip
        nodes = slice(None, None, steps // coarse)
        return np.hstack([end.q[nodes], end.p[nodes]])

    errors, effect = np.zeros(4), 0.0
    still = motion(np.zeros((coarse, scene.processes)))
    for path in range(200):
        steps = coarse * finest
        dw = wiener_increments(scene.processes, duration / steps, steps, rng=np.random.default_rng([7, path]))
        reference = motion(dw)
        errors += [np.abs(motion(coarsen(dw, finest // m)) - reference).max() / 200 for m in (1, 2, 4, 8)]
        effect += np.abs(still - reference).max() / 200
    slope = -np.polyfit(np.log([1, 2, 4, 8]), np.log(errors), 1)[0]
    # The reference has an error of its own, which at 8 : 64 lifts the slope by no more than 0.06.
    assert 0.95 <= slope < 1.2, (slope, errors)
    # Noise matters to these motions: without it they go elsewhere by more than the errors.
    assert effect > 4.0 * errors[0]


MASS, STIFFNESS, DAMPING, HEAT = 1.3, 40.0, 0.8, 0.5


def oscillator():
    """A mass on a spring with friction, in a bath of temperature ``HEAT`` [J]."""
    noise = vp.AdditiveNoise(np.sqrt(2.0 * DAMPING * HEAT))
    return vp.Scene(slider(MASS), gravity=False, damping=DAMPING, stiffness=STIFFNESS, noise=noise)


def map_of(scene, dt, integrator):
    lin = vp.linearize(scene, vp.simulate(scene, [0.1], [0], dt=dt, steps=1, integrator=integrator))
    return lin.A[0], lin.G[0]


@pytest.mark.parametrize("dt", [0.02, 0.1, 0.25])
def test_stationary_law_of_the_linear_oscillator(dt):
    """Split kicks are exact in law for every step; the left kick gives k <q^2> = kT (1 + h^2 k / 4m)."""
    scene = oscillator()
    A, G = map_of(scene, dt, SPLIT)
    exact = np.diag([HEAT / STIFFNESS, MASS * HEAT])
    np.testing.assert_allclose(solve_discrete_lyapunov(A, dt * G @ G.T), exact, rtol=0, atol=1e-13)
    A, G = map_of(scene, dt, vp.Midpoint())
    left = solve_discrete_lyapunov(A, dt * G @ G.T)
    growth = dt**2 * STIFFNESS / (4 * MASS)
    assert left[0, 0] * STIFFNESS == pytest.approx(HEAT * (1.0 + growth), rel=1e-12)
    # Its nodes come after friction and before the next kick: there the momentum is cold by dt * damping / mass.
    cold = (1.0 - 0.5 * dt * DAMPING / MASS) ** 2
    assert left[1, 1] == pytest.approx(MASS * HEAT * (cold + growth), rel=1e-12)


@pytest.mark.parametrize(("kick", "order", "coarse"), [("left", 1.0, 1024), ("split", 2.0, 64)])
def test_weak_order_of_the_mean_energy(kick, order, coarse):
    """From rest towards equilibrium: the mean energy at t = 1 s from the map's moments, against the exact law."""
    scene, integrator = oscillator(), vp.Midpoint(kick=kick)
    flow = np.array([[0.0, 1.0 / MASS], [-STIFFNESS, -DAMPING / MASS]])
    noise = np.diag([0.0, 2.0 * DAMPING * HEAT])
    stationary = solve_continuous_lyapunov(flow, -noise)
    x0 = np.array([0.3, 0.0])
    mean = expm(flow) @ x0
    exact = stationary - expm(flow) @ stationary @ expm(flow).T + np.outer(mean, mean)
    errors = []
    for steps in (coarse, 2 * coarse, 4 * coarse):
        A, G = map_of(scene, 1.0 / steps, integrator)
        P = np.outer(x0, x0)
        for _ in range(steps):
            P = A @ P @ A.T + G @ G.T / steps
        energy = [0.5 * (STIFFNESS * second[0, 0] + second[1, 1] / MASS) for second in (P, exact)]
        errors.append(abs(energy[0] - energy[1]))
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (np.abs(slopes - order) < 0.1).all(), (slopes, errors)


# --- held over a step: a control of the step, deviations of velocities, drives at their limits -----------------------


HELD = [vp.Midpoint(kick="held"), vp.Gauss(2, kick="held"), vp.Radau(2, kick="held")]


@pytest.mark.parametrize("servo", [False, True])
@pytest.mark.parametrize("kind", [vp.Midpoint, vp.Gauss, vp.Radau])
@pytest.mark.parametrize("guard", [None, vp.Guard(branch_margin=0.9, energy_balance=1e-6)], ids=["whole", "divided"])
def test_the_force_acts_like_a_control_of_the_step(kind, guard, servo):
    robot = vp.planar_chain(2)
    integrator = kind(guard=guard, kick="held")
    start = {"q0": [1.0, 0.5], "v0": [2.0, -9.0], "dt": 0.1, "steps": 8, "integrator": integrator, "check": False}
    noisy = servoed(0.5) if servo else vp.Scene(robot, damping=0.1, noise=vp.AdditiveNoise([0.3, 0.2]))
    motion = vp.simulate(noisy, **start, controls=np.tile([90.0 if servo else 0.5, 0.4], (8, 1)), rng=0)
    # The servo's drive is at its limit.
    forces = np.array([0.5, 0.4]) + motion.dw * [0.3, 0.2] / 0.1
    same = vp.simulate(vp.Scene(robot, damping=0.1), **start, controls=forces)
    assert (motion.statistics.split_steps > 0) == (guard is not None)
    for name in ("q", "p", "energy"):
        np.testing.assert_allclose(getattr(motion, name), getattr(same, name), rtol=0, atol=1e-10 if servo else 1e-12)
    defects, size = (each.statistics.energy_defect for each in (motion, same)), np.abs(same.energy).max()
    np.testing.assert_allclose(*defects, rtol=0, atol=1e-10 * size)


OF_VELOCITIES = [
    *(vp.Midpoint(alpha, kick=kick) for alpha in (0.5, 0.3) for kick in ("left", "split", "held")),
    *(kind(kick=kick) for kind in (vp.Gauss, vp.Radau) for kick in ("left", "split", "held")),
    *(vp.RungeKutta4(), vp.SemiImplicitEuler(), vp.ExplicitEuler()),
]


@pytest.mark.parametrize("integrator", OF_VELOCITIES, ids=str)
@pytest.mark.parametrize("rate", [0.01, 0.17, 0.26, 0.9, 1.9, 20.0])
def test_a_damped_velocity_has_its_stationary_deviation_or_a_warning(integrator, rate):
    """An Ornstein-Uhlenbeck joint, s / sqrt(2 d I) in equilibrium: told from a tenth on."""
    inertia, s, dt = 1.0 / 3.0, 0.3, 0.01
    damping = rate * inertia / dt
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=damping, noise=vp.AdditiveNoise(s))
    run = {"dt": dt, "steps": 300, "integrator": integrator}
    if rate > 2.0 and not integrator.variational:
        pytest.skip("unstable")
    quiet = vp.simulate(scene, [0.0], [0.0], increments=0, check=False, **run)
    moments = vp.propagate_moments(vp.linearize(scene, quiet))
    deviation = np.sqrt(moments.covariance[-1, 1, 1]) / (inertia if integrator.variational else 1.0)
    true = s / np.sqrt(2.0 * damping * inertia) * np.sqrt(-np.expm1(-2.0 * rate * 300))
    paths = vp.simulate_ensemble(scene, [0.0], [0.0], paths=2, rng=0, **run)
    for told in (moments.warnings, paths.warnings, vp.simulate(scene, [0.0], [0.0], rng=0, **run).warnings):
        found = about(told, "noise of velocities")
        assert bool(found) == (abs(deviation / true - 1.0) > 0.1)
        assert all(abs(each.value - deviation / true) < 1e-3 * each.value for each in found)
        assert all(naming([each], "joint1", f"{deviation / true:.2g}") for each in found)
    assert not vp.simulate(scene, [0.0], [0.0], increments=0, **run).warnings


@pytest.mark.parametrize(
    ("damping", "noise", "held", "told"),
    [([1e3, 1e3, 0], [0, 0, 1], None, False), ([0, 0, 1e3], [1, 1, 0], None, False),
     ([0, 0, 0], [1, 1, 1], None, False), ([0, 0, 1e3], [0, 0, 1], None, True), ([0, 0, 1e3], [1] * 3, "block", False)],
)  # fmt: skip
def test_only_damped_joints_that_noise_moves_have_wrong_deviations(damping, noise, held, told):
    inputs = vp.KinematicInput(held) if held else ()
    scene = vp.Scene(
        crank_and_slider(), gravity=False, damping=damping, constraints=inputs, noise=vp.AdditiveNoise(noise)
    )
    run = {"dt": 0.01, "steps": 30, "integrator": vp.Gauss(2, kick="held"), "rng": 0}
    motion = vp.simulate(scene, np.zeros(3), np.zeros(3), **run)
    assert len(about(motion.warnings, "noise of velocities")) == told


SERVO = (40.0, 3.0)


def servoed(limit, **more):
    servo = vp.PositionServo(*({"joint1": value} for value in (*SERVO, limit)))
    return vp.Scene(vp.planar_chain(2), damping=0.1, forces=[servo], noise=vp.AdditiveNoise([0.3, 0.2]), **more)


@pytest.mark.parametrize("kick", ["held", None])
def test_drives_at_their_limits_do_not_cut_noise_off(kick):
    """A mass under noise far above what its drive has: its velocity is that of the impulses."""
    mass, strength = 2.0, 3.0
    servo = vp.PositionServo(1e-9, 1e-9, 0.1)
    scene = vp.Scene(slider(mass), gravity=False, forces=[servo], noise=vp.AdditiveNoise(strength))
    given = {} if kick is None else {"integrator": vp.Midpoint(kick=kick)}
    motion = vp.simulate(scene, [0.0], [0.0], dt=0.01, steps=50, rng=0, **given)
    np.testing.assert_allclose(motion.v[-1], strength * motion.dw.sum(axis=0) / mass, rtol=1e-6)
    problem = vp.OptimalControlProblem(scene, vp.ControlCost(1.0), [0.0], [0.0], dt=0.1, steps=2)
    assert problem.integrator.kick == "held"


@pytest.mark.parametrize("integrator", HELD, ids=str)
@pytest.mark.parametrize("command", [0.2, 0.45, 0.9], ids=["free", "bent", "saturated"])
@pytest.mark.parametrize("constraints", [(), [vp.JointTie("joint2", "joint1")]], ids=["single", "tied"])
def test_derivatives_beside_a_limited_drive(integrator, command, constraints):
    if constraints and isinstance(integrator, vp.Radau):
        pytest.skip("Radau's methods keep no constraints")
    scene, n = servoed(10.0, constraints=constraints), 2
    q, v = np.array([0.2, 0.2]), np.array([0.1, 0.1])
    u = np.array([command, 0.5])
    options = {"dt": 0.02, "steps": 1, "integrator": integrator, "check": False}

    def end(du, dw):
        motion = vp.simulate(scene, q, v, controls=(u + du)[None], increments=dw[None], **options)
        return np.concatenate([motion.q[-1], motion.p[-1]])

    lin = vp.linearize(scene, vp.simulate(scene, q, v, controls=u[None], increments=0, **options))
    none = np.zeros(n)
    for own, moved in ((lin.G[0], lambda z: end(none, z)), (lin.B[0], lambda z: end(z, none))):
        expected = jacobian(moved, none, 1e-4)
        np.testing.assert_allclose(own, expected, rtol=0, atol=2e-7 * np.abs(expected).max())
    assert np.abs(lin.G[0, n:, 0]).max() > 0.05
    # The demand at the start is 0, 0.97 and 2.77 times the limit.
    assert (np.abs(lin.B[0, :, 0]).max() < 1e-12) == (command == 0.9)


# --- not drawn, and seeds of nothing: told of, unless either is meant ------------------------------------------------


CHAIN = vp.planar_chain(2)
QUIET = vp.Scene(CHAIN)
FORGOTTEN = {
    "additive": vp.AdditiveNoise(1e-3),
    "control": vp.ControlNoise(1e-3),
    "custom": vp.CustomNoise(lambda q, v, u: 1e-3 * np.eye(2), processes=2),
}
SHORT = {"dt": 1e-3, "steps": 20}


def noisy(noise="additive"):
    return vp.Scene(CHAIN, noise=FORGOTTEN[noise])


@pytest.mark.parametrize("check", [True, False])
@pytest.mark.parametrize("noise", FORGOTTEN)
def test_noise_that_is_not_drawn_is_told_of_once(noise, check, caplog):
    scene = noisy(noise)
    with caplog.at_level(logging.WARNING):
        motions = [vp.simulate(scene, [0, 0], [0, 0], **SHORT, check=check) for _ in range(3)]
    for motion in motions:
        assert len(motion.warnings) == len(about(motion.warnings, "noise not drawn")) == 1
        assert not motion.dw.any()
    assert len(about(caplog.messages, "noise not drawn")) == 1


@pytest.mark.parametrize("meant", [{"rng": 0}, {"increments": 0}, {"increments": np.zeros((20, 2))}], ids=str)
def test_what_is_meant_is_not_told_of(meant):
    assert vp.simulate(noisy(), [0, 0], [0, 0], **SHORT, **meant).warnings == ()


def test_paths_that_are_all_one_and_seeds_of_nothing_are_told_of():
    alone = vp.simulate(QUIET, [0, 0], [0, 0], **SHORT, rng=0).warnings
    assert len(alone) == len(about(alone, "nothing random")) == 1
    starts = [[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]]
    for scene, q0, paths in ((QUIET, [0, 0], 3), (QUIET, starts, 3), (noisy(), [0, 0], 3), (QUIET, [0, 0], 1)):
        told = vp.simulate_ensemble(scene, q0, [0, 0], **SHORT, paths=paths, rng=0).warnings
        same = scene is QUIET and paths > 1 and q0 is not starts
        assert len(told) == len(about(told, "nothing random")) == same
    # Whatever the seed is: noise is drawn from a fresh one, too.
    for scene in (QUIET, noisy()):
        told = vp.simulate_ensemble(scene, [0, 0], [0, 0], **SHORT, paths=3, rng=None).warnings
        assert [warning for warning in told if "noise" in warning] == about(told, "nothing random")
        assert bool(told) == (scene is QUIET)


def problem(scene):
    return swing(scene=scene, steps=5)


def test_a_controller_tells_of_its_plant():
    mpc = vp.Mpc(problem(noisy()))
    for plant, rng, said in (
        (None, None, "noise not drawn"),
        (None, 0, None),
        (vp.Plant(noisy()), None, "noise not drawn"),
        (vp.Plant(QUIET), 0, "nothing random"),
        (vp.Plant(QUIET), None, None),
    ):
        run = mpc.run(plant, duration=0.06, rng=rng)
        told = about(run.warnings, "noise not drawn", "nothing random")
        assert len(told) == (said is not None)
        assert not told or about(told, said)
        assert not about(run.motion.warnings[1:], "noise not drawn", "nothing random")


def test_plans_and_their_checks_draw_nothing_and_say_nothing(caplog):
    with caplog.at_level(logging.WARNING):
        plan = vp.solve(problem(noisy()), max_iterations=2)
        plan.problem.simulate(plan.policy)
        plan.verify(tolerance=1e-3)
        vp.check_linearization(noisy(), [0.1, 0.2], [0.0, 0.0], dt=1e-2)
    assert not about(caplog.messages, "noise not drawn")
