"""Second derivatives of steps under constraints, against differences, and what is refused."""

import numpy as np
import pytest
import zoo
from refusals import refused

import varpin as vp
from varpin.mechanics.assembly import along_constraints, nearest

# Central differences of eighth order, of the first and of the second derivative.
FIRST = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
SECOND = {0: -205 / 72, 1: 8 / 5, 2: -1 / 5, 3: 8 / 315, 4: -1 / 560}
SIZE = 1e-3


def first(values):
    return sum(w * (values[k] - values[-k]) for k, w in FIRST.items()) / SIZE


def second(values):
    return (SECOND[0] * values[0] + sum(SECOND[k] * (values[k] + values[-k]) for k in range(1, 5))) / SIZE**2


def whole(curvature):
    return np.block([[curvature.xx[0], curvature.ux[0].T], [curvature.ux[0], curvature.uu[0]]])


CUBIC = [zoo.CRANK[0], vp.KinematicInput("joint1", "cubic")]
CASES = {
    "forces": zoo.ZOO["five-bar"],
    "linear": zoo.ZOO["cranked five-bar"],
    "cubic": zoo.Case("", zoo.chain(4, damping=0.3, constraints=CUBIC), **zoo.FIVE, path=zoo.cranked),
}


@pytest.mark.parametrize("integrator", [vp.Midpoint(guard=None), vp.Gauss(2, guard=None)])
@pytest.mark.parametrize("kind", CASES)
def test_against_differences_of_steps_along_the_constraints(kind, integrator):
    """Of z . x1 on curves through states that keep the constraints: f'' = x' H x' + z J x''."""
    scene, q, v = CASES[kind].scene, CASES[kind].q0, CASES[kind].v0
    rng, n = np.random.default_rng(3), 4
    u = scene.command_at(q) + 0.01 * rng.normal(size=scene.controls)
    given = {"dt": 1e-2, "steps": 1, "integrator": integrator, "check": False}
    motion = vp.simulate(scene, q, v, controls=u[None], **given)
    lin = vp.linearize(scene, motion)
    # States that keep what is not moved by hand.
    fixed = vp.Scene(scene.robot, constraints=scene.constraints[:1])
    z = rng.normal(size=2 * n)
    H = whole(vp.second_order(scene, motion, z))
    np.testing.assert_allclose(H, H.T, rtol=1e-12, atol=1e-12 * np.abs(H).max())
    for _ in range(3):
        dq, dv, du = rng.normal(size=n), rng.normal(size=n), rng.normal(size=scene.controls)
        curve, ends = {}, {}
        for k in range(-4, 5):
            at = nearest(fixed, q + k * SIZE * dq)
            rate = along_constraints(fixed, at, v + k * SIZE * dv)
            M = scene.core.jets(at[None], np.zeros((1, n)))[0][0]
            command = u + k * SIZE * du
            moved = vp.simulate(scene, at, rate, controls=command[None], **given)
            curve[k] = np.concatenate([at, M @ rate, command])
            ends[k] = z @ np.append(moved.q[1], moved.p[1])
        slope, bend = first(curve), second(curve)
        J = np.concatenate([lin.A[0], lin.B[0]], axis=1)
        assert abs(first(ends) - z @ J @ slope) < 1e-8 * np.abs(z @ J * slope).max()
        terms, bends = slope[:, None] * H * slope, z @ J * bend
        size = max(np.abs(terms).max(), np.abs(bends).max())
        assert abs(second(ends) - terms.sum() - bends.sum()) < 1e-7 * size


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
