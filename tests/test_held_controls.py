"""Controls that are constant over a step: rows, functions of time, and laws as digital controllers."""

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


def swing(t):
    return np.array([3.0, 2.0, 1.0]) * np.sin(7.0 * t)


def test_an_open_loop_is_its_means_for_a_method_of_one_stage(scene):
    options = {"dt": 0.01, "steps": 70, "integrator": vp.Midpoint()}
    turns = np.cos(0.07 * np.arange(71))
    rows = (turns[:-1] - turns[1:])[:, None] / 0.07 * [3.0, 2.0, 1.0]
    by_rows = vp.simulate(scene, Q0, V0, controls=rows, **options)
    by_time = vp.simulate(scene, Q0, V0, controls=vp.OpenLoop(swing), **options)
    np.testing.assert_allclose(by_time.q, by_rows.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(by_time.u, by_rows.u, rtol=0, atol=1e-12)
    noisy = vp.Scene(scene.robot, noise=vp.AdditiveNoise(0.1))
    one, other = (
        vp.simulate_ensemble(noisy, Q0, V0, controls=controls, paths=3, rng=0, **options)
        for controls in (rows, vp.OpenLoop(swing))
    )
    np.testing.assert_allclose(one.q, other.q, rtol=0, atol=1e-12)


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
