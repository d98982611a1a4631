"""Laws are digital controllers: called once a period, in the order of time."""

import numpy as np
import pytest

import varpin as vp

DAMPING = np.array([0.8, 0.5, 0.3])
Q0, V0 = np.array([0.3, -0.4, 0.5]), np.array([1.0, -0.5, 0.8])
GAIN = np.array([2.0, 1.0, 0.5])


@pytest.fixture(scope="module")
def scene():
    return vp.Scene(vp.planar_chain(3), damping=DAMPING, stiffness=1.5)


def law(t, q, v):
    """A motor that tries to swing, a drag that grows with the square of the speed, and a spring of its own."""
    return np.array([3.0, 2.0, 1.0]) * np.sin(7.0 * t) - GAIN * v * np.abs(v) - 2.0 * q


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(3), vp.RungeKutta4(), vp.ExplicitEuler()], ids=str)
def test_a_law_is_called_once_where_each_period_begins(scene, integrator):
    """With the time and the state of that node; its value is held over the period."""
    called = []

    def recorded(t, q, v):
        called.append((t, q, v))
        return law(t, q, v)

    motion = vp.simulate(
        scene, Q0, V0, dt=0.01, steps=50, controls=recorded, period=5, integrator=integrator, check=True
    )
    assert len(called) == 10
    for k, (t, q, v) in enumerate(called):
        assert t == pytest.approx(0.05 * k, abs=1e-12)
        np.testing.assert_array_equal(q, motion.q[5 * k])
        np.testing.assert_array_equal(v, motion.v[5 * k])
    np.testing.assert_array_equal(np.diff(motion.u.reshape(10, 5, 3), axis=1), 0.0)


def test_a_period_that_the_steps_do_not_fill_is_cut(scene):
    called = []
    motion = vp.simulate(
        scene, Q0, V0, dt=0.01, steps=17, controls=lambda t, q, v: called.append(t) or law(t, q, v), period=5
    )
    np.testing.assert_allclose(called, [0.0, 0.05, 0.1, 0.15])
    assert motion.steps == 17
    assert [len(np.unique(motion.u[k : k + 5, 0])) for k in (0, 5, 10, 15)] == [1, 1, 1, 1]


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
