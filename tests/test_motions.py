"""Motions from one state that share their work arrays are what they would be each by itself."""

import numpy as np
import pytest

import varpin as vp
from varpin.integrators.base import open_loop
from varpin.simulation.record import Motions

STEPS, DT = 60, 0.01


@pytest.mark.parametrize(
    "integrator", [vp.Midpoint(), vp.Midpoint(alpha=0.3), vp.Gauss(2), vp.RungeKutta4(), vp.Reference()], ids=str
)
def test_motions_do_not_see_each_other(integrator):
    robot = vp.planar_chain(3)
    q0, v0 = np.array([0.3, -0.2, 0.4]), np.array([1.0, 0.0, -2.0])
    scene = vp.Scene(robot, damping=0.1)
    motions = Motions(scene, integrator, q0, v0, DT)
    rng = np.random.default_rng(3)
    for scale in (1e-3, 1.0, 0.0):
        u = scale * rng.standard_normal((STEPS, 3))
        alone = vp.simulate(scene, q0, v0, dt=DT, steps=STEPS, controls=u, integrator=integrator, check=False)
        together, failure = motions.under(open_loop(u))
        assert failure is None
        for name in ("t", "q", "v", "p", "u", "dw", "energy"):
            np.testing.assert_array_equal(getattr(together, name), getattr(alone, name), err_msg=name)
        for name, of_alone in vars(alone.statistics).items():
            np.testing.assert_array_equal(getattr(together.statistics, name), of_alone, err_msg=name)
    assert np.abs(together.q[-1] - q0).max() > 0.01
