"""Second derivatives of steps: many at once, and what cannot be done."""

import numpy as np
from refusals import refused

import varpin as vp


def test_many_steps_and_one_vector_for_all():
    scene = vp.Scene(vp.load_robot("finger"))
    motion = vp.simulate(scene, [0.4, 0.3, 0.2], [1.0, -2.0, 3.0], dt=2e-3, steps=5, controls=[1e-5, 0.0, -1e-5])
    z = np.array([1.0, -1.0, 0.5, 2.0, 0.0, 1.0])
    once = vp.second_order(scene, motion, z)
    rows = vp.second_order(scene, motion, np.outer(np.arange(5.0), z))
    assert once.xx.shape == (5, 6, 6)
    assert once.ux.shape == (5, 3, 6)
    assert once.uu.shape == (5, 3, 3)
    for j in range(5):
        np.testing.assert_allclose(rows.xx[j], j * once.xx[j], rtol=1e-9, atol=1e-12 * np.abs(once.xx).max())
        np.testing.assert_allclose(rows.uu[j], j * once.uu[j], rtol=1e-9, atol=1e-12 * np.abs(once.uu).max())


def test_what_cannot_be_done_is_said():
    scene = vp.Scene(vp.load_robot("finger"))
    motion = vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-3, steps=2)
    with refused(vp.InputError, "z", "(2, 6)", "(3, 6)"):
        vp.second_order(scene, motion, np.zeros((3, 6)))
    with refused(vp.InputError, "z[1, 2]", "nan"):
        vp.second_order(scene, motion, np.array([[0.0] * 6, [0.0, 0.0, np.nan, 0.0, 0.0, 0.0]]))
    rk = vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-3, steps=2, integrator=vp.RungeKutta4())
    with refused(vp.InputError, "RungeKutta4"):
        vp.second_order(scene, rk, np.zeros(6), integrator=vp.RungeKutta4())
