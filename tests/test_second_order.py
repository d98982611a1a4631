"""Second derivatives of steps: many at once, and what cannot be done."""

import numpy as np
from refusals import refused

import varpin as vp


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
