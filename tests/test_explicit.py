"""The explicit integrators: their orders, their linearizations, and plain versions of their steps."""

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused
from test_linearization import ARMS, difference, make_scene, worst
from test_midpoint import reference, slopes

import varpin as vp

INTEGRATORS = [vp.ExplicitEuler(), vp.SemiImplicitEuler(), vp.RungeKutta4()]


def plain_step(scene, integrator, q, v, u, dw, dt):
    """(q, v) one step on by Pinocchio's forward dynamics and the textbook's formulas."""
    model = scene.robot.model.copy()
    model.gravity = pin.Motion(scene.gravity, np.zeros(3))
    data = model.createData()

    def rate(q, v):
        force = scene.actuation @ u - scene.damping * v - scene.stiffness * (q - scene.rest)
        return pin.aba(model, data, scene.robot.configuration(q), v, force)

    F = scene.noise.fields(q[None], v[None], u[None], q).F[0]
    jump = np.linalg.solve(vp.lagrangian_jet(scene, q, v).Lvv, F @ dw)
    if isinstance(integrator, vp.ExplicitEuler):
        return q + dt * v, v + dt * rate(q, v) + jump
    v = v + jump
    if isinstance(integrator, vp.SemiImplicitEuler):
        v = v + dt * rate(q, v)
        return q + dt * v, v
    k1 = v, rate(q, v)
    k2 = v + dt / 2 * k1[1], rate(q + dt / 2 * k1[0], v + dt / 2 * k1[1])
    k3 = v + dt / 2 * k2[1], rate(q + dt / 2 * k2[0], v + dt / 2 * k2[1])
    k4 = v + dt * k3[1], rate(q + dt * k3[0], v + dt * k3[1])
    return (
        q + dt / 6 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0]),
        v + dt / 6 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1]),
    )


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=str)
@pytest.mark.parametrize("name", ["ur5", "kinova", "talos_arm"])
def test_step_against_a_plain_version(name, integrator):
    robot = vp.load_robot(name)
    noise = vp.AdditiveNoise(0.3) + vp.ControlNoise(0.1) + vp.StateNoise(0.5, center=0.2)
    scene = vp.Scene(robot, damping=0.3, stiffness=2.0, rest=0.1, noise=noise)
    rng = np.random.default_rng(0)
    q, v, u = rng.normal(size=(3, robot.dof))
    dw = np.sqrt(1e-3) * rng.normal(size=scene.processes)
    motion = vp.simulate(
        scene, q, v, dt=1e-3, steps=1, controls=u, increments=dw[None], integrator=integrator, check=False
    )
    q1, v1 = plain_step(scene, integrator, q, v, u, dw, 1e-3)
    np.testing.assert_allclose(motion.q[1], q1, rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion.v[1], v1, rtol=0, atol=1e-10 * np.abs(v1).max())
    jet = vp.lagrangian_jet(scene, motion.q[1], motion.v[1], backend="pinocchio")
    np.testing.assert_allclose(motion.p[1], jet.Lv, rtol=1e-11, atol=1e-12)
    assert motion.energy[1] == pytest.approx(jet.Lv @ motion.v[1] - jet.L, rel=1e-12)


@pytest.mark.parametrize(("integrator", "order"), list(zip(INTEGRATORS, (1, 1, 4), strict=True)), ids=str)
def test_order(integrator, order):
    """Unforced but for friction and springs; a function of time as control would cap the order at two."""
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.5, stiffness=8.0, rest=0.1)
    q0, v0 = np.linspace(0.2, 0.6, 6), np.linspace(0.5, -0.5, 6)
    exact = reference(scene, q0, v0, 0.25)
    counts = (400, 800, 1600) if order == 1 else (50, 100, 200)
    errors = [
        np.abs(vp.simulate(scene, q0, v0, dt=0.25 / k, steps=k, integrator=integrator, check=False).q[-1] - exact).max()
        for k in counts
    ]
    assert (np.abs(slopes(errors) - order) < 0.15).all(), errors


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("integrator", INTEGRATORS, ids=str)
def test_first_derivatives(name, integrator):
    """A, B, K and G to 1e-8 of eighth-order differences of the step (q, v, u, dw) -> (q', v')."""
    scene, strength = make_scene(name)
    noise = vp.AdditiveNoise(1e-2 * strength) + vp.ControlNoise(0.1) + vp.StateNoise(strength, center=0.3)
    scene = vp.Scene(scene.robot, damping=scene.damping, stiffness=scene.stiffness, noise=noise)
    n, dt = scene.robot.dof, 1e-3
    rng = np.random.default_rng(0)
    q, v, u = rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), strength * rng.uniform(-1, 1, n)

    def step(x, u, dw):
        end = vp.simulate(
            scene, x[:n], x[n:], dt=dt, steps=1, controls=u, increments=dw[None], integrator=integrator, check=False
        )
        return np.concatenate([end.q[1], end.v[1]])

    lin = vp.linearize(
        scene, vp.simulate(scene, q, v, dt=dt, steps=1, controls=u, integrator=integrator), integrator=integrator
    )
    assert not lin.variational
    x, zero, one = np.concatenate([q, v]), np.zeros(scene.processes), np.ones(2 * n)
    in_x = difference(lambda x: step(x, u, zero), x, 1e-2 * one)
    in_u = difference(lambda u: step(x, u, zero), u, np.full(n, strength))
    in_w = difference(lambda w: step(x, u, w), zero, np.full(scene.processes, 1e-2))
    assert worst(lin.A[0], in_x, one, one) < 1e-8
    assert worst(lin.B[0], in_u, one, np.full(n, strength)) < 1e-8
    assert worst(lin.G[0], in_w, one, np.ones(scene.processes)) < 1e-8
    M = vp.lagrangian_jet(scene, q, v).Lvv
    kicked = lin.K[0] @ M
    expected = in_x[:, n:] if not isinstance(integrator, vp.ExplicitEuler) else np.eye(2 * n)[:, n:]
    assert worst(kicked, expected, one, np.ones(n)) < 1e-8


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=str)
def test_derivative_of_the_jump(integrator):
    """Gx against differences of Jk M^-1 F, Jk held: the paper's derivative at dw = 0."""
    scene = vp.Scene(vp.load_robot("ur5"), noise=vp.AdditiveNoise(0.1) + vp.StateNoise(0.7, center=0.3))
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-1, 1, (2, 6))
    lin = vp.linearize(scene, vp.simulate(scene, q, v, dt=1e-3, steps=1, integrator=integrator), integrator=integrator)
    Jk = lin.K[0] @ vp.lagrangian_jet(scene, q, v).Lvv

    def jump(q):
        F = scene.noise.fields(q[None], v[None], np.zeros((1, 6)), q).F[0]
        return (Jk @ np.linalg.solve(vp.lagrangian_jet(scene, q, v).Lvv, F)).ravel()

    numeric = difference(jump, q, np.full(6, 1e-2)).reshape(12, scene.processes, 6)
    np.testing.assert_allclose(lin.Gx[0][..., :6], numeric, rtol=0, atol=1e-8 * np.abs(numeric).max())
    assert not lin.Gx[0][..., 6:].any()


def test_blow_up_is_a_step_failure():
    scene = vp.Scene(vp.planar_chain(3))
    with refused(vp.StepFailure, "finite") as caught:
        vp.simulate(scene, np.zeros(3), np.zeros(3), dt=0.5, steps=10_000, integrator=vp.ExplicitEuler())
    assert np.isfinite(caught.value.trajectory.energy).all()


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=str)
def test_fields_in_python_do_the_same(integrator):
    robot = vp.load_robot("ur5")
    custom = vp.CustomNoise(lambda q, v, u: 0.2 * np.eye(6), processes=6)
    start = np.linspace(0, 0.5, 6), np.zeros(6)
    motions = [
        vp.simulate(vp.Scene(robot, noise=noise), *start, dt=1e-3, steps=20, rng=3, integrator=integrator)
        for noise in (vp.AdditiveNoise(0.2), custom)
    ]
    np.testing.assert_allclose(motions[0].q, motions[1].q, rtol=0, atol=1e-13)
    np.testing.assert_allclose(motions[0].v, motions[1].v, rtol=0, atol=1e-10)
