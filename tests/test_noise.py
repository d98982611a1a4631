"""Diffusion fields against their definitions, Wiener increments, and the order and laws of motions under noise."""

import numpy as np
import pytest
from mechanisms import slider
from oracles import slope
from refusals import refused
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_lyapunov

import varpin as vp
from varpin.mechanics.wiener import coarsen, refine, wiener_increments
from varpin.simulation.failures import NoiseError

# Three coordinates, two controls: one joint is not actuated, and a control moves two joints.
ACTUATION = np.array([[1.0, 0.0], [0.0, 0.0], [0.5, 2.0]])


def chain(noise, links=2, **options):
    return vp.Scene(vp.planar_chain(links), noise=noise, **options)


def points(n=3, m=2, count=5):
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, n)), rng.normal(size=(count, n)), rng.normal(size=(count, m)), rng.normal(size=n)


def difference(function, x):
    return np.stack([slope(function, x, e, 1e-2) for e in np.eye(x.shape[1])], axis=-1)


def own_noise(strength=0.3):
    """F = strength (q q' + diag(v) + u_0), with all its derivatives."""
    eye = np.eye(3)

    def dq(q, v, u):
        return strength * (np.einsum("ic,k->ikc", eye, q) + np.einsum("kc,i->ikc", eye, q))

    def du(q, v, u):
        return strength * np.einsum("ik,m->ikm", np.ones((3, 3)), [1.0, 0.0])

    return vp.CustomNoise(
        field=lambda q, v, u: strength * (np.outer(q, q) + np.diag(v) + u[0]),
        processes=3,
        dq=dq,
        dv=lambda q, v, u: strength * np.einsum("ik,ic->ikc", eye, eye),
        du=du,
        check=True,
    )


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
    "custom": (own_noise(), lambda q, v, u, start: 0.3 * (np.outer(q, q) + np.diag(v) + u[0])),
    "list": (
        [vp.AdditiveNoise(MATRIX), own_noise(), vp.ControlNoise(0.4)],
        lambda q, v, u, start: np.hstack([MATRIX, 0.3 * (np.outer(q, q) + np.diag(v) + u[0]), 0.4 * ACTUATION * u]),
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
    q, v, u, start = points()
    fields = bound.fields(q, v, u, start)
    exact = np.array([expected(*point, start) for point in zip(q, v, u, strict=True)])
    assert fields.F.shape == exact.shape == (5, 3, bound.processes)
    np.testing.assert_allclose(fields.F, exact, rtol=0, atol=1e-14)
    Fv = difference(lambda v: bound.fields(q, v, u, start).F, v)
    np.testing.assert_allclose(fields.Fq, difference(lambda q: bound.fields(q, v, u, start).F, q), rtol=0, atol=1e-12)
    np.testing.assert_allclose(fields.Fu, difference(lambda u: bound.fields(q, v, u, start).F, u), rtol=0, atol=1e-12)
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


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: vp.AdditiveNoise([1.0, 2.0]), ("AdditiveNoise intensity", "(3,)", "(2,)")),
        (lambda: vp.AdditiveNoise(np.ones((2, 4))), ("AdditiveNoise intensity", "(3, 4)", "(2, 4)")),
        (lambda: vp.ControlNoise(np.ones((3, 4, 3))), ("ControlNoise intensity", "(3, 4, 2)")),
        (lambda: vp.ControlNoise(np.full((3, 1, 2), np.nan)), ("ControlNoise intensity[0, 0, 0]", "nan")),
        (lambda: 3.0, ("noise", "3.0")),
        (lambda: [vp.AdditiveNoise(1.0), 0.5], ("noise", "0.5")),
        (lambda: vp.CustomNoise(lambda q, v, u: np.eye(3), 3.0), ("CustomNoise processes", "3.0")),
        (lambda: vp.CustomNoise(None, 3), ("CustomNoise field", "None")),
        (lambda: vp.CustomNoise(lambda q, v, u: np.eye(3), 3, dv=0.0), "CustomNoise dv"),
    ],
)
def test_parameters_that_do_not_fit(make, facts):
    with refused(vp.InputError, facts):
        vp.Scene(vp.planar_chain(3), actuation=ACTUATION, noise=make())


@pytest.mark.parametrize("left_out", [False, True])
@pytest.mark.parametrize("wrong", ["dq", "dv", "du"])
def test_a_wrong_or_missing_derivative_is_named(wrong, left_out):
    right = own_noise()
    slots = {name: getattr(right, name) for name in ("dq", "dv", "du")}
    exact = slots.pop(wrong)

    def off(q, v, u):
        values = np.array(exact(q, v, u))
        values[2, 1, 1] += 1e-3
        return values

    if not left_out:
        slots[wrong] = off
    with refused(vp.InputError, f"CustomNoise {wrong}(q, v, u)", "[:, :, 0]" if left_out else ("[:, :, 1]", "0.001")):
        vp.Scene(vp.planar_chain(3), actuation=ACTUATION, noise=vp.CustomNoise(right.field, 3, **slots, check=True))


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


def noisy_chain(noise):
    return vp.Scene(vp.planar_chain(2), damping=0.3, stiffness=4.0, noise=noise)


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


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: coarsen(np.zeros((9, 1)), 2), ("number", "9", "2")),
        (lambda: coarsen(np.zeros(8)), ("increments", "(8,)")),
        (lambda: wiener_increments(2, 0.1, 3, increments=np.zeros((3, 1))), ("(3, 2)", "(3, 1)")),
        (lambda: wiener_increments(1, 0.1, 1, 0, np.zeros((1, 1))), ("rng", "increments")),
    ],
)
def test_errors(call, facts):
    with refused(vp.InputError, facts):
        call()


NOISES = {
    "additive": vp.AdditiveNoise(0.5),
    "state": vp.StateNoise(0.4, center=[2.0, -0.5]),
    "control": vp.ControlNoise(0.6),
}


@BOTH
@pytest.mark.parametrize("name", NOISES)
def test_strong_order_one(name, kick):
    """Mean over 200 paths of the largest error at common nodes, against 1/64 of the step on the same Brownian path."""
    scene, integrator = noisy_chain(NOISES[name]), vp.Midpoint(kick=kick)
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
