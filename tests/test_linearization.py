"""Linearizations of steps in parts and under noise against differences, and their moments against sampling."""

import numpy as np
import pytest
from oracles import Mechanism, slope
from refusals import refused

import varpin as vp
from varpin.linearization import linearize_steps


def friction_noise(n, strength):
    """Fields F_i = c (1 + v_i^2 / 2 + q_i v_i) e_i, which depend on the velocity, with their derivatives."""

    def diagonal(values):
        out = np.zeros((n, n, n))
        out[np.arange(n), np.arange(n), np.arange(n)] = values
        return strength * out

    return vp.CustomNoise(
        field=lambda q, v, u: strength * np.diag(1.0 + 0.5 * v**2 + q * v),
        processes=n,
        dq=lambda q, v, u: diagonal(v),
        dv=lambda q, v, u: diagonal(v + q),
        check=True,
    )


def test_velocity_dependent_fields():
    """Their derivatives at fixed momentum enter Gx; the next test has their drift."""
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.1, noise=friction_noise(6, 0.3))
    q, v, u, e, other = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    options = {"dt": 1e-3, "steps": 1, "controls": u, "integrator": vp.Midpoint(), "check": False}
    motion = vp.simulate(scene, q, v, increments=0, **options)
    lin, p = vp.linearize(scene, motion), motion.p[0]

    def field(x):
        speed = np.linalg.solve(Mechanism(scene).mass_matrix(x[:6]), x[6:])
        return lin.K[0] @ scene.noise.fields(x[None, :6], speed[None], u[None], q).F[0]

    along = np.append(e, np.abs(p).max() * other)
    found = slope(field, np.append(q, p), along, 1e-2)
    np.testing.assert_allclose(lin.Gx[0] @ along, found, rtol=0, atol=1e-8 * np.abs(found).max())


@pytest.mark.parametrize("speed", [0.0, 1.0, 5.0])
@pytest.mark.parametrize(
    "integrator",
    [vp.Midpoint(kick="split"), vp.Gauss(2), vp.Midpoint(kick="held"), vp.ExplicitEuler(), vp.RungeKutta4()],
    ids=str,
)
def test_drift_at_rest_and_moving(integrator, speed):
    """Its derivative does not take the size of a step from a momentum or velocity that may be zero."""
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.1, noise=friction_noise(6, 0.3))
    q, v, u = np.random.default_rng(0).uniform(-1, 1, (3, 6))
    # The check's step is in units of the largest momentum, which turns a light wrist by much more: at 5 rad/s too far.
    step = 2e-3 if speed == 5.0 else 5e-3
    found = vp.check_linearization(scene, q, speed * v, u, dt=1e-3, integrator=integrator, step=step)
    assert found.worst < 1e-8


@pytest.mark.parametrize("integrator", [vp.Midpoint(kick="split"), vp.Gauss(2, kick="held")], ids=str)
@pytest.mark.parametrize("custom", [False, True])
def test_noisy_motions_are_linearized_at_zero_noise(integrator, custom):
    """Each step of one as the step without noise from the same node: a split kick's second half at its end too."""
    noise = friction_noise(6, 0.3) if custom else vp.StateNoise(1.0) + vp.ControlNoise(0.2)
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.1, noise=noise)
    q, v, u = np.random.default_rng(0).uniform(-1, 1, (3, 6))
    noisy = vp.simulate(scene, q, v, dt=1e-3, steps=4, controls=u, integrator=integrator, rng=1)
    lin = vp.linearize(scene, noisy, integrator=integrator)
    for j in range(noisy.steps):
        quiet = vp.simulate(scene, noisy.q[j], noisy.v[j], dt=1e-3, steps=1, controls=u, integrator=integrator)
        alone = linearize_steps(scene, quiet, integrator, noisy.q[0])
        assert np.abs(noisy.v[j + 1] - quiet.v[1]).max() > 1e-4
        for name in ("A", "B", "K", "F", "G", "Gx", "Gu"):
            expected = getattr(alone, name)[0]
            np.testing.assert_allclose(
                getattr(lin, name)[j], expected, rtol=0, atol=1e-10 * np.abs(expected).max(), err_msg=name
            )


def test_moments_against_samples():
    """Closed-form mean and covariance within 4 standard errors of 5e4 sampled linearizations."""
    noise = vp.AdditiveNoise(3e-6) + vp.StateNoise(2e-4, center=0.0)
    scene = vp.Scene(vp.load_robot("finger"), damping=1e-6, stiffness=5e-6, noise=noise)
    motion = vp.simulate(scene, [0.4, 0.3, 0.2], [0.0, 0.0, 0.0], dt=5e-3, steps=12)
    lin = vp.linearize(scene, motion)
    mean, spread = np.full(6, 1e-2), 1e-2
    mean[3:] = 1e-8
    covariance = np.diag([spread**2] * 3 + [1e-16] * 3)
    moments = vp.propagate_moments(lin, mean, covariance)
    rng = np.random.default_rng(0)
    samples = 50_000
    x = mean + rng.normal(size=(samples, 6)) * np.sqrt(np.diag(covariance))
    for j in range(lin.steps):
        x = lin.step(j, x, np.zeros((samples, 3)), np.sqrt(lin.dt) * rng.normal(size=(samples, scene.processes)))
    deviation = x - x.mean(axis=0)
    products = deviation[:, :, None] * deviation[:, None, :]
    error = np.abs(x.mean(axis=0) - moments.mean[-1]) / (x.std(axis=0) / np.sqrt(samples))
    assert error.max() < 4.0
    error = np.abs(products.mean(axis=0) - moments.covariance[-1]) / (products.std(axis=0) / np.sqrt(samples))
    assert error.max() < 4.0


def test_what_is_no_covariance_is_refused():
    scene = vp.Scene(vp.planar_chain(1))
    lin = vp.linearize(scene, vp.simulate(scene, [0.1], [0.0], dt=0.01, steps=2))
    for wrong, facts in (
        (-np.eye(2), ("positive semidefinite", "-1")),
        ([[1.0, 2.0], [2.0, 1.0]], ("positive semidefinite", "-1")),
        ([[0.0, 1.0], [1.0, 0.0]], "positive semidefinite"),
        ([[1.0, 0.5], [0.4, 1.0]], "symmetric"),
    ):
        with refused(vp.InputError, facts):
            vp.propagate_moments(lin, covariance=wrong)
    # Units of momentum may be tiny beside those of angles, and a matrix of rank one is no less a covariance.
    direction = np.array([1.0, 1e-9])
    given = np.outer(direction, direction)
    np.testing.assert_array_equal(vp.propagate_moments(lin, covariance=given).covariance[0], given)


@pytest.mark.parametrize("motion", [None, np.zeros((3, 1))])
def test_what_is_no_trajectory_is_refused(motion):
    scene = vp.Scene(vp.planar_chain(1))
    for call in (lambda: vp.linearize(scene, motion), lambda: vp.second_order(scene, motion, np.zeros(2))):
        with refused(vp.InputError, "motion", "varpin.Trajectory"):
            call()
