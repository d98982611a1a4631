"""Noise held over a step: exact covariances of linear systems, linearization, divided steps, constraints."""

import numpy as np
import pytest
from findings import about
from mechanisms import crank_and_slider, slider
from refusals import naming
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_lyapunov

import varpin as vp
from varpin.simulation.choice import integrator_for

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


@pytest.mark.parametrize("servo", [False, True])
@pytest.mark.parametrize("kind", [vp.Midpoint, vp.Gauss, vp.Radau])
@pytest.mark.parametrize("guard", [None, vp.Guard(branch_margin=0.9, energy_balance=1e-6)], ids=["whole", "divided"])
def test_the_force_acts_like_a_control_of_the_step(kind, guard, servo):
    """The motion of a control F dw / dt, energies included, also in steps that the guard divides."""
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
        motion.statistics.energy_defect, same.statistics.energy_defect, rtol=0, atol=1e-10 * np.abs(same.energy).max()
    )


OF_VELOCITIES = [
    *(vp.Midpoint(alpha, kick=kick) for alpha in (0.5, 0.3) for kick in ("left", "split", "held")),
    *(kind(kick=kick) for kind in (vp.Gauss, vp.Radau) for kick in ("left", "split", "held")),
    *(vp.RungeKutta4(), vp.SemiImplicitEuler(), vp.ExplicitEuler()),
]


@pytest.mark.parametrize("integrator", OF_VELOCITIES, ids=str)
@pytest.mark.parametrize("rate", [0.01, 0.17, 0.26, 0.9, 1.9, 20.0])
def test_a_damped_velocity_has_its_stationary_deviation_or_a_warning(integrator, rate):
    """An Ornstein-Uhlenbeck joint, s / sqrt(2 d I) in equilibrium: told from a tenth on, of motions and of moments."""
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
    """A damper without noise, noise without a damper, and a joint that is moved by hand are right."""
    inputs = vp.KinematicInput(held) if held else ()
    scene = vp.Scene(
        crank_and_slider(), gravity=False, damping=damping, constraints=inputs, noise=vp.AdditiveNoise(noise)
    )
    run = {"dt": 0.01, "steps": 30, "integrator": vp.Gauss(2, kick="held"), "rng": 0}
    motion = vp.simulate(scene, np.zeros(3), np.zeros(3), **run)
    assert len(about(motion.warnings, "noise of velocities")) == told


SERVO = (40.0, 3.0)


def servoed(limit, **more):
    """A chain of two links, the first of which a servo with a limit drives."""
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
    assert integrator_for(scene, np.zeros(1), 0.1).kick == "held"


@pytest.mark.parametrize("integrator", HELD, ids=str)
@pytest.mark.parametrize("command", [0.2, 0.45, 0.9], ids=["free", "bent", "saturated"])
@pytest.mark.parametrize("constraints", [(), [vp.JointTie("joint2", "joint1")]], ids=["single", "tied"])
def test_derivatives_beside_a_limited_drive(integrator, command, constraints):
    """Those in the noise and in the control, by differences of steps, below, around and beyond the servo's limit."""
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
    step, none = 1e-4, np.zeros(n)
    by_noise = [(end(none, step * e) - end(none, -step * e)) / (2.0 * step) for e in np.eye(n)]
    by_control = [(end(step * e, none) - end(-step * e, none)) / (2.0 * step) for e in np.eye(n)]
    for own, differences in ((lin.G[0], by_noise), (lin.B[0], by_control)):
        expected = np.stack(differences, axis=1)
        np.testing.assert_allclose(own, expected, rtol=0, atol=2e-7 * np.abs(expected).max())
    assert np.abs(lin.G[0, n:, 0]).max() > 0.05
    # The demand at the start is 0, 0.97 and 2.77 times the limit.
    assert (np.abs(lin.B[0, :, 0]).max() < 1e-12) == (command == 0.9)


def test_noise_of_a_saturated_drive_has_the_variance_of_fine_impulses():
    """Held over steps of 20 ms against impulses before steps of 1 ms, of the same noise, at the servo's limit."""
    scene, paths, coarse, parts = servoed(2.0), 150, 25, 20
    rng = np.random.default_rng(1)
    fine = np.sqrt(1e-3) * rng.normal(size=(paths, coarse * parts, 2))
    start = {"q0": [0.0, 0.0], "v0": [0.0, 0.0], "check": False}
    ends = {}
    for name, dt, dw, integrator in (
        ("held", 0.02, fine.reshape(paths, coarse, parts, 2).sum(axis=2), vp.Midpoint(kick="held")),
        ("left", 1e-3, fine, vp.Midpoint()),
    ):
        u = np.tile([3.0, 0.0], (dw.shape[1], 1))
        given = {"dt": dt, "steps": dw.shape[1], "controls": u, "integrator": integrator}
        motions = [vp.simulate(scene, **start, **given, increments=own) for own in dw]
        ends[name] = np.array([np.concatenate([motion.q[-1], motion.v[-1]]) for motion in motions])
    # The drive is at its limit all along.
    assert (SERVO[0] * (3.0 - ends["left"][:, 0]) > 1.5 * 2.0).all()
    deviations = {name: own.std(axis=0) for name, own in ends.items()}
    np.testing.assert_allclose(deviations["held"], deviations["left"], rtol=0.03)
    apart = np.abs(ends["held"].mean(axis=0) - ends["left"].mean(axis=0))
    assert (apart < 0.05 * deviations["left"]).all()


@pytest.mark.parametrize("kick", ["left", "held"])
@pytest.mark.parametrize("ties", ["four-bar", "tie"])
def test_moments_under_constraints_are_those_of_paths(ties, kick):
    """Variances along the one direction that the constraints leave, and none across; of a short time."""
    robot = vp.planar_chain(3 if ties == "four-bar" else 2)
    tie = vp.PointOnPoint("tip", (1.2, 0.0, -0.4), "xz") if ties == "four-bar" else vp.JointTie("joint2", "joint1")
    scene = vp.Scene(robot, damping=0.3, noise=vp.AdditiveNoise(0.1), constraints=tie)
    q = vp.assemble(scene, [-1.0, 1.5, 0.8] if ties == "four-bar" else [0.4, 0.4])
    given = {"dt": 0.01, "steps": 15, "integrator": vp.Gauss(2, kick=kick)}
    lin = vp.linearize(scene, vp.simulate(scene, q, np.zeros(robot.dof), increments=0, **given))
    P = vp.propagate_moments(lin).covariance[-1]
    paths = vp.simulate_ensemble(scene, q, np.zeros(robot.dof), paths=3000, rng=1, store=True, **given)
    inertia = vp.lagrangian_jet(scene, paths.q[:, -1].mean(axis=0), np.zeros(robot.dof)).Lvv
    drawn = np.cov(np.hstack([paths.q[:, -1], paths.v[:, -1] @ inertia]).T)
    n = robot.dof
    for block in (slice(0, n), slice(n, 2 * n)):
        found, expected = drawn[block, block], P[block, block]
        # The standard error of a variance is sqrt(2 / paths) of it; the constraint bends by a little more.
        np.testing.assert_allclose(found, expected, rtol=0, atol=4.0 * np.sqrt(2.0 / 3000) * np.trace(expected))
        least, *_, most = np.linalg.eigvalsh(expected)
        assert abs(least) < 1e-9 * most
