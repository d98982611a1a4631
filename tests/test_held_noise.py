"""Noise held over a step: exact covariances of linear systems, linearization, divided steps, constraints."""

import numpy as np
import pytest
from mechanisms import slider
from refusals import refused
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_lyapunov

import varpin as vp
from varpin.control.problem import integrator_for

HELD = [vp.Midpoint(kick="held"), vp.Gauss(2, kick="held"), vp.Radau(2, kick="held")]


def oscillator(damping):
    """Two coupled links on springs, with noise."""
    return vp.Scene(vp.planar_chain(2), gravity=False, damping=damping, stiffness=20.0, noise=vp.AdditiveNoise(0.3))


def continuous(scene):
    """The drift matrix (4, 4) of (q, p) at rest at zero, and the covariance rate (4, 4) of the noise."""
    M = vp.lagrangian_jet(scene, np.zeros(2), np.zeros(2)).Lvv
    slow = np.linalg.inv(M)
    A = np.block([[np.zeros((2, 2)), slow], [-np.diag(scene.stiffness), -np.diag(scene.damping) @ slow]])
    return A, np.diag([0.0, 0.0, 0.09, 0.09])


def at_rest(scene, integrator, dt, steps=1):
    """The linearization of steps at rest at zero."""
    still = {"q0": np.zeros(2), "v0": np.zeros(2), "increments": 0}
    return vp.linearize(scene, vp.simulate(scene, **still, dt=dt, steps=steps, integrator=integrator, check=False))


@pytest.mark.parametrize("damping", [0.5, 30.0])
@pytest.mark.parametrize("dt", [1e-2, 0.1, 1.0])
def test_the_stationary_covariance_of_the_midpoint_rule_is_exact(damping, dt):
    """At every step; that of impulses before the steps is not."""
    scene = oscillator(damping)
    A, rate = continuous(scene)
    exact = solve_continuous_lyapunov(A, -rate)
    found = {}
    for kick in ("held", "left"):
        lin = at_rest(scene, vp.Midpoint(kick=kick), dt)
        found[kick] = solve_discrete_lyapunov(lin.A[0], dt * lin.G[0] @ lin.G[0].T)
    np.testing.assert_allclose(found["held"], exact, rtol=0, atol=1e-10 * np.abs(exact).max())
    assert np.abs(found["left"] - exact).max() > 1e-3 * np.abs(exact).max()


@pytest.mark.parametrize("integrator", HELD, ids=str)
def test_covariances_at_a_time_converge_with_order_two(integrator):
    scene = oscillator(1.0)
    A, rate = continuous(scene)
    # Van Loan (1978).
    grown = expm(np.block([[-A, rate], [np.zeros_like(A), A.T]]))
    exact = grown[4:, 4:].T @ grown[:4, 4:]
    errors = []
    for steps in (20, 40):
        moments = vp.propagate_moments(at_rest(scene, integrator, 1.0 / steps, steps))
        errors.append(np.abs(moments.covariance[-1] - exact).max())
    assert 3.5 < errors[0] / errors[1] < 4.6


@pytest.mark.parametrize("kind", [vp.Midpoint, vp.Gauss, vp.Radau])
@pytest.mark.parametrize("guard", [None, vp.Guard(branch_margin=0.9, energy_balance=1e-6)], ids=["whole", "divided"])
def test_the_force_acts_like_a_control_of_the_step(kind, guard):
    """The motion of a control F dw / dt, energies included, also in steps that the guard divides."""
    robot = vp.planar_chain(2)
    integrator = kind(guard=guard, kick="held")
    start = {"q0": [1.0, 0.5], "v0": [2.0, -9.0], "dt": 0.1, "steps": 8, "integrator": integrator, "check": False}
    noisy = vp.Scene(robot, damping=0.1, noise=vp.AdditiveNoise([0.3, 0.1]))
    motion = vp.simulate(noisy, **start, controls=np.ones((8, 2)), rng=0)
    forces = 1.0 + motion.dw * [0.3, 0.1] / 0.1
    same = vp.simulate(vp.Scene(robot, damping=0.1), **start, controls=forces)
    assert (motion.statistics.split_steps > 0) == (guard is not None)
    for name in ("q", "p", "energy"):
        np.testing.assert_allclose(getattr(motion, name), getattr(same, name), rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        motion.statistics.energy_defect, same.statistics.energy_defect, rtol=0, atol=1e-10 * np.abs(same.energy).max()
    )


@pytest.mark.parametrize("integrator", HELD[:2], ids=str)
@pytest.mark.parametrize("drive", [None, "linear", "cubic"])
def test_linearization_under_constraints_and_beside_inputs(integrator, drive):
    """The noise's derivative by differences of steps; the drive of an input absorbs the noise of its joint."""
    robot = vp.planar_chain(3)
    given = vp.JointTie("joint2", "joint1") if drive is None else vp.KinematicInput("joint2", drive)
    scene = vp.Scene(robot, damping=0.1, noise=vp.AdditiveNoise([0.3, 0.2, 0.1]), constraints=[given])
    q, v = np.array([0.4, 0.4, -0.3]), np.array([0.5, 0.5, 1.0])
    u = np.zeros((1, scene.controls))
    if drive is not None:
        u[0, 1] = 0.41
    options = {"dt": 0.02, "steps": 1, "controls": u, "integrator": integrator, "check": False}

    def end(dw):
        motion = vp.simulate(scene, q, v, increments=dw[None], **options)
        return np.concatenate([motion.q[-1], motion.p[-1]])

    lin = vp.linearize(scene, vp.simulate(scene, q, v, increments=0, **options))
    step = 1e-4
    found = np.stack([(end(step * e) - end(-step * e)) / (2.0 * step) for e in np.eye(scene.processes)], axis=1)
    np.testing.assert_allclose(lin.G[0], found, rtol=0, atol=1e-8 * np.abs(found).max())
    assert lin.G[0][:, 1].any() == (drive is None)


@pytest.mark.parametrize(
    "integrator", [vp.Midpoint(), vp.Gauss(2, kick="held"), vp.Radau(4, kick="held"), vp.RungeKutta4()]
)
def test_moments_of_velocities_that_are_wrong_have_a_warning(integrator, caplog):
    """From where the stationary variance is wrong by a tenth, and the midpoint rule's, which is right, has none."""
    for damping in (1e-3, 0.3, 3.0, 10.0):
        scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=damping, noise=vp.AdditiveNoise(0.3))
        inertia = vp.lagrangian_jet(scene, [0.0], [0.0]).Lvv[0, 0]
        still = {"q0": [0.0], "v0": [0.0], "dt": 0.1, "steps": 1, "increments": 0, "check": False}
        lin = vp.linearize(scene, vp.simulate(scene, **still, integrator=integrator))
        by_speed = 1.0 if integrator.variational else inertia
        variance = 0.1 * (by_speed * lin.G[0, 1, 0]) ** 2 / (1.0 - lin.A[0, 1, 1] ** 2)
        ratio = variance / (0.3**2 * inertia / (2.0 * damping))
        moments = vp.propagate_moments(lin)
        assert bool(moments.warnings) == (abs(ratio - 1.0) > 0.1)
        usual = vp.simulate(scene, **still, integrator=vp.Midpoint(kick="held"))
        assert vp.propagate_moments(vp.linearize(scene, usual)).warnings == ()
    assert len(caplog.messages) >= 1


def test_drives_at_their_limits_do_not_cut_noise_off():
    """A mass under noise far above what its drive has: its velocity is that of the impulses; held noise is refused."""
    mass, strength = 2.0, 3.0
    servo = vp.PositionServo(1e-9, 1e-9, 0.1)
    scene = vp.Scene(slider(mass), gravity=False, forces=[servo], noise=vp.AdditiveNoise(strength))
    start = {"q0": [0.0], "v0": [0.0], "dt": 0.01, "steps": 50, "rng": 0}
    motion = vp.simulate(scene, **start)
    np.testing.assert_allclose(motion.v[-1], strength * motion.dw.sum(axis=0) / mass, rtol=1e-6)
    assert integrator_for(scene, np.zeros(1), 0.1).kick == "left"
    with refused(vp.InputError, "kick='held'", "effort limit"):
        vp.simulate(scene, **start, integrator=vp.Midpoint(kick="held"))
