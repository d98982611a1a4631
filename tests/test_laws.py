"""Control laws are digital controllers; a loop that is unstable at its period is told of, and no other."""

import numpy as np
from findings import about

import varpin as vp


def run(scene, q, v, law, **options):
    """The motion and whether its loop was called unstable; (None, True) if it cannot go on."""
    try:
        motion = vp.simulate(scene, q, v, controls=law, **options)
    except (vp.StepFailure, vp.ControlError):
        return None, True
    return motion, bool(about(motion.warnings, "unstable loop"))


def speaks_of_the_loop(motion):
    return bool(about(motion.warnings, "unstable loop"))


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
