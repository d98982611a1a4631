"""The reference integrator: exact solutions, Pinocchio's forward dynamics, its tolerances and its derivatives."""

import numpy as np
import pytest
from findings import about
from refusals import refused
from test_linearization import ARMS, difference, make_scene, worst
from test_midpoint import reference

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


@pytest.mark.parametrize("name", ["finger", "ur5", "xarm7", "talos_arm"])
def test_against_pinocchios_forward_dynamics(name):
    robot = vp.load_robot(name)
    n = robot.dof
    scene = vp.Scene(robot)
    q0, v0 = np.linspace(0.2, 0.6, n), np.linspace(1.0, -1.0, n) * 0.5
    exact = reference(scene, q0, v0, 0.25)
    motion = vp.simulate(scene, q0, v0, dt=0.25, steps=1, integrator=vp.Reference())
    np.testing.assert_allclose(motion.q[-1], exact, rtol=0, atol=1e-10)
    fine = vp.simulate(scene, q0, v0, dt=5e-3, steps=50, integrator=vp.Reference())
    np.testing.assert_allclose(fine.q[-1], exact, rtol=0, atol=1e-10)
    assert np.abs(np.diff(fine.energy)).max() < 1e-10 * np.abs(fine.energy).max() + 1e-14


def test_friction_springs_controls_and_feedback():
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.5, stiffness=8.0, rest=0.1)
    q0, v0 = np.linspace(0.2, 0.6, 6), np.linspace(0.5, -0.5, 6)
    u = np.random.default_rng(0).normal(size=(8, 6))
    exact = vp.simulate(
        scene, q0, v0, dt=1e-4, steps=2000, controls=np.repeat(u, 250, axis=0), integrator=vp.RungeKutta4()
    )
    motion = vp.simulate(scene, q0, v0, dt=0.025, steps=8, controls=u, integrator=vp.Reference())
    np.testing.assert_allclose(motion.q, exact.q[::250], rtol=0, atol=1e-10)
    gains = np.random.default_rng(1).normal(size=(4, 6, 12))
    policy = vp.LinearPolicy(u[:4], gains, np.tile(np.append(q0, v0), (4, 1)), hold=2)
    held = [
        vp.simulate(scene, q0, v0, dt=dt, steps=8 * k, controls=own, integrator=integrator).q[-1]
        for dt, k, own, integrator in (
            (0.025, 1, policy, vp.Reference()),
            (
                0.00025,
                100,
                vp.LinearPolicy(policy.u, policy.gains, policy.reference, hold=200),
                vp.RungeKutta4(),
            ),
        )
    ]
    np.testing.assert_allclose(held[0], held[1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ARMS)
def test_first_derivatives(name):
    scene, strength = make_scene(name)
    n, dt = scene.robot.dof, 1e-3
    rng = np.random.default_rng(0)
    q, v, u = rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), strength * rng.uniform(-1, 1, n)
    integrator = vp.Reference()

    def step(x, u):
        end = vp.simulate(scene, x[:n], x[n:], dt=dt, steps=1, controls=u, integrator=integrator)
        return np.concatenate([end.q[1], end.v[1]])

    lin = vp.linearize(
        scene, vp.simulate(scene, q, v, dt=dt, steps=1, controls=u, integrator=integrator), integrator=integrator
    )
    x, one = np.concatenate([q, v]), np.ones(2 * n)
    assert worst(lin.A[0], difference(lambda x: step(x, u), x, 1e-2 * one), one, one) < 1e-8
    strengths = np.full(n, strength)
    assert worst(lin.B[0], difference(lambda u: step(x, u), u, strengths), one, strengths) < 1e-8


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


def test_every_integrator_knows_its_order():
    orders = {
        vp.Midpoint(): 2,
        vp.Midpoint(alpha=0.3): 1,
        vp.Gauss(stages=1): 2,
        vp.Gauss(stages=4): 8,
        vp.ExplicitEuler(): 1,
        vp.SemiImplicitEuler(): 1,
        vp.RungeKutta4(): 4,
        vp.Reference(): 8,
    }
    assert all(integrator.order == order for integrator, order in orders.items())


def test_dampers_are_resolved_whatever_dt_is():
    """A wrist whose damper is forty times faster than dt: the motion is that of small steps, and nothing rings."""
    scene = vp.Scene(vp.load_robot("ur10"), damping=2.0)
    start = [0.0, -1.2, 1.0, 0.0, 0.0, 0.3], np.zeros(6)
    motion = vp.simulate(scene, *start, dt=1e-2, steps=60, integrator=vp.Reference())
    fine = vp.simulate(scene, *start, dt=1e-4, steps=6000)
    np.testing.assert_allclose(motion.v, fine.v[::100], rtol=0, atol=1e-9)
    assert not about(motion.warnings, "ringing")
