"""Wiener increments, and motions driven by them: strong and weak order, and the stationary law of an oscillator."""

import numpy as np
import pytest
from mechanisms import slider
from refusals import refused
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_lyapunov

import varpin as vp
from varpin.mechanics.wiener import coarsen, refine, wiener_increments

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
    lin = vp.linearize(
        scene, vp.simulate(scene, [0.1], [0], dt=dt, steps=1, integrator=integrator), integrator=integrator
    )
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
