"""The explicit integrators against plain versions of their steps."""

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused

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


@pytest.mark.parametrize(
    ("integrator", "damping", "dt"), [(vp.ExplicitEuler(), 0.0, 0.5), (vp.RungeKutta4(), 500.0, 0.05)], ids=str
)
def test_blow_up_is_a_step_failure(integrator, damping, dt):
    scene = vp.Scene(vp.planar_chain(3), damping=damping)
    with refused(vp.StepFailure, "runs away") as caught:
        vp.simulate(scene, np.full(3, 0.4), np.zeros(3), dt=dt, steps=10_000, integrator=integrator)
    assert "mass matrix" not in str(caught.value)
    assert np.isfinite(caught.value.trajectory.energy).all()
