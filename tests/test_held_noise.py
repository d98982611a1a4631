"""Noise held over a step: a control of the step, deviations of velocities, drives at their limits."""

import numpy as np
import pytest
from findings import about
from mechanisms import crank_and_slider, slider
from oracles import slope
from refusals import naming

import varpin as vp

HELD = [vp.Midpoint(kick="held"), vp.Gauss(2, kick="held"), vp.Radau(2, kick="held")]


@pytest.mark.parametrize("servo", [False, True])
@pytest.mark.parametrize("kind", [vp.Midpoint, vp.Gauss, vp.Radau])
@pytest.mark.parametrize("guard", [None, vp.Guard(branch_margin=0.9, energy_balance=1e-6)], ids=["whole", "divided"])
def test_the_force_acts_like_a_control_of_the_step(kind, guard, servo):
    robot = vp.planar_chain(2)
    integrator = kind(guard=guard, kick="held")
    start = {"q0": [1.0, 0.5], "v0": [2.0, -9.0], "dt": 0.1, "steps": 8, "integrator": integrator, "check": False}
    noisy = servoed(0.5) if servo else vp.Scene(robot, damping=0.1, noise=vp.AdditiveNoise([0.3, 0.2]))
    motion = vp.simulate(noisy, **start, controls=np.tile([90.0 if servo else 0.5, 0.4], (8, 1)), rng=0)
    # The servo's drive is at its limit.
    forces = np.array([0.5, 0.4]) + motion.dw * [0.3, 0.2] / 0.1
    same = vp.simulate(vp.Scene(robot, damping=0.1), **start, controls=forces)
    assert (motion.statistics.split_steps > 0) == (guard is not None)
    for name in ("q", "p", "energy"):
        np.testing.assert_allclose(getattr(motion, name), getattr(same, name), rtol=0, atol=1e-10 if servo else 1e-12)
    np.testing.assert_allclose(
        motion.statistics.energy_defect,
        same.statistics.energy_defect,
        rtol=0,
        atol=1e-10 * np.abs(same.energy).max(),
    )


OF_VELOCITIES = [
    *(vp.Midpoint(alpha, kick=kick) for alpha in (0.5, 0.3) for kick in ("left", "split", "held")),
    *(kind(kick=kick) for kind in (vp.Gauss, vp.Radau) for kick in ("left", "split", "held")),
    *(vp.RungeKutta4(), vp.SemiImplicitEuler(), vp.ExplicitEuler()),
]


@pytest.mark.parametrize("integrator", OF_VELOCITIES, ids=str)
@pytest.mark.parametrize("rate", [0.01, 0.17, 0.26, 0.9, 1.9, 20.0])
def test_a_damped_velocity_has_its_stationary_deviation_or_a_warning(integrator, rate):
    """An Ornstein-Uhlenbeck joint, s / sqrt(2 d I) in equilibrium: told from a tenth on."""
    inertia, s, dt = 1.0 / 3.0, 0.3, 0.01
    damping = rate * inertia / dt
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=damping, noise=vp.AdditiveNoise(s))
    run = {"dt": dt, "steps": 300, "integrator": integrator}
    if rate > 2.0 and not integrator.variational:
        pytest.skip("unstable")
    quiet = vp.simulate(scene, [0.0], [0.0], increments=0, check=False, **run)
    moments = vp.propagate_moments(vp.linearize(scene, quiet))
    deviation = np.sqrt(moments.covariance[-1, 1, 1]) / (inertia if integrator.variational else 1.0)
    true = s / np.sqrt(2.0 * damping * inertia) * np.sqrt(-np.expm1(-2.0 * rate * 300))
    paths = vp.simulate_ensemble(scene, [0.0], [0.0], paths=2, rng=0, **run)
    for told in (moments.warnings, paths.warnings, vp.simulate(scene, [0.0], [0.0], rng=0, **run).warnings):
        found = about(told, "noise of velocities")
        assert bool(found) == (abs(deviation / true - 1.0) > 0.1)
        assert all(abs(each.value - deviation / true) < 1e-3 * each.value for each in found)
        assert all(naming([each], "joint1", f"{deviation / true:.2g}") for each in found)
    assert not vp.simulate(scene, [0.0], [0.0], increments=0, **run).warnings


@pytest.mark.parametrize(
    ("damping", "noise", "held", "told"),
    [([1e3, 1e3, 0], [0, 0, 1], None, False), ([0, 0, 1e3], [1, 1, 0], None, False),
     ([0, 0, 0], [1, 1, 1], None, False), ([0, 0, 1e3], [0, 0, 1], None, True), ([0, 0, 1e3], [1] * 3, "block", False)],
)  # fmt: skip
def test_only_damped_joints_that_noise_moves_have_wrong_deviations(damping, noise, held, told):
    inputs = vp.KinematicInput(held) if held else ()
    scene = vp.Scene(
        crank_and_slider(), gravity=False, damping=damping, constraints=inputs, noise=vp.AdditiveNoise(noise)
    )
    run = {"dt": 0.01, "steps": 30, "integrator": vp.Gauss(2, kick="held"), "rng": 0}
    motion = vp.simulate(scene, np.zeros(3), np.zeros(3), **run)
    assert len(about(motion.warnings, "noise of velocities")) == told


SERVO = (40.0, 3.0)


def servoed(limit, **more):
    servo = vp.PositionServo(*({"joint1": value} for value in (*SERVO, limit)))
    return vp.Scene(vp.planar_chain(2), damping=0.1, forces=[servo], noise=vp.AdditiveNoise([0.3, 0.2]), **more)


@pytest.mark.parametrize("kick", ["held", None])
def test_drives_at_their_limits_do_not_cut_noise_off(kick):
    """A mass under noise far above what its drive has: its velocity is that of the impulses."""
    mass, strength = 2.0, 3.0
    servo = vp.PositionServo(1e-9, 1e-9, 0.1)
    scene = vp.Scene(slider(mass), gravity=False, forces=[servo], noise=vp.AdditiveNoise(strength))
    given = {} if kick is None else {"integrator": vp.Midpoint(kick=kick)}
    motion = vp.simulate(scene, [0.0], [0.0], dt=0.01, steps=50, rng=0, **given)
    np.testing.assert_allclose(motion.v[-1], strength * motion.dw.sum(axis=0) / mass, rtol=1e-6)
    problem = vp.OptimalControlProblem(scene, vp.ControlCost(1.0), [0.0], [0.0], dt=0.1, steps=2)
    assert problem.integrator.kick == "held"


@pytest.mark.parametrize("integrator", HELD, ids=str)
@pytest.mark.parametrize("command", [0.2, 0.45, 0.9], ids=["free", "bent", "saturated"])
@pytest.mark.parametrize("constraints", [(), [vp.JointTie("joint2", "joint1")]], ids=["single", "tied"])
def test_derivatives_beside_a_limited_drive(integrator, command, constraints):
    if constraints and isinstance(integrator, vp.Radau):
        pytest.skip("Radau's methods keep no constraints")
    scene, n = servoed(10.0, constraints=constraints), 2
    q, v = np.array([0.2, 0.2]), np.array([0.1, 0.1])
    u = np.array([command, 0.5])
    options = {"dt": 0.02, "steps": 1, "integrator": integrator, "check": False}

    def end(du, dw):
        motion = vp.simulate(scene, q, v, controls=(u + du)[None], increments=dw[None], **options)
        return np.concatenate([motion.q[-1], motion.p[-1]])

    lin = vp.linearize(scene, vp.simulate(scene, q, v, controls=u[None], increments=0, **options))
    none = np.zeros(n)
    for own, moved in ((lin.G[0], lambda z: end(none, z)), (lin.B[0], lambda z: end(z, none))):
        expected = np.transpose([slope(moved, none, e, 1e-4) for e in np.eye(n)])
        np.testing.assert_allclose(own, expected, rtol=0, atol=2e-7 * np.abs(expected).max())
    assert np.abs(lin.G[0, n:, 0]).max() > 0.05
    # The demand at the start is 0, 0.97 and 2.77 times the limit.
    assert (np.abs(lin.B[0, :, 0]).max() < 1e-12) == (command == 0.9)
