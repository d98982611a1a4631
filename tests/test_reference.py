"""The reference integrator: exact solutions and its tolerances."""

import numpy as np
import pytest
from refusals import refused

import varpin as vp


def test_oscillator_to_its_tolerance():
    """q(t) = A cos(w t) on a spring, over ten periods, at any dt."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, stiffness=3.0)
    omega = 3.0
    duration = 20 * np.pi / omega
    for dt_count in (3, 400):
        t = np.arange(dt_count + 1) * duration / dt_count
        motion = vp.simulate(
            scene, [0.7], [0.3], dt=duration / dt_count, steps=dt_count, integrator=vp.Reference(rtol=1e-13)
        )
        np.testing.assert_allclose(
            motion.q[:, 0], 0.7 * np.cos(omega * t) + 0.1 * np.sin(omega * t), rtol=0, atol=2e-12
        )
    loose = vp.simulate(scene, [0.7], [0.3], dt=duration, steps=1, integrator=vp.Reference(rtol=1e-6))
    assert 1e-9 < abs(loose.q[-1, 0] - 0.7) < 1e-4
    assert loose.statistics.sweeps[0] < 2000


def test_noise_is_refused():
    noisy = vp.Scene(vp.load_robot("finger"), noise=vp.AdditiveNoise(1e-3))
    with refused(vp.InputError, "noise"):
        vp.simulate(noisy, np.zeros(3), np.zeros(3), dt=1e-3, steps=1, rng=0, integrator=vp.Reference())


@pytest.mark.parametrize(
    ("name", "value"), [("rtol", 1e-15), ("rtol", 0.5), ("rtol", -1.0), ("atol", 0.0), ("rtol", "a")]
)
def test_tolerances_are_checked(name, value):
    with refused(vp.InputError, name, repr(value)):
        vp.Reference(**{name: value})


def test_runaway_is_a_step_failure():
    """Negative damping is not to be had, but a feedback of the wrong sign is."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False)
    policy = vp.LinearPolicy(np.zeros((60, 1)), np.tile([[1e3, 1e3]], (60, 1, 1)), np.zeros((60, 2)))
    with refused(vp.StepFailure) as caught:
        vp.simulate(scene, [1.0], [1.0], dt=10.0, steps=60, controls=policy, integrator=vp.Reference())
    assert np.isfinite(caught.value.trajectory.q).all()
