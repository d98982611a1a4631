"""Radau IIA collocation: its tableau, and motions under damping faster than the step."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import varpin as vp
from varpin.integrators.tableau import radau_coefficients


def test_tableau_of_two_stages():
    """Hairer and Wanner II, table IV.5.5."""
    a, b, c = radau_coefficients(2)
    np.testing.assert_allclose(a, [[5 / 12, -1 / 12], [3 / 4, 1 / 4]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(b, [3 / 4, 1 / 4], rtol=0, atol=1e-15)
    np.testing.assert_allclose(c, [1 / 3, 1], rtol=0, atol=1e-15)


@pytest.mark.parametrize("stages", [2, 3, 4, 6])
def test_tableau(stages):
    """Quadrature of order 2s - 1, collocation of order s, and stiffly accurate."""
    a, b, c = radau_coefficients(stages)
    for k in range(1, 2 * stages):
        assert b @ c ** (k - 1) == pytest.approx(1 / k, rel=1e-14)
    for k in range(1, stages + 1):
        np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=0, atol=1e-14)
    assert c[-1] == 1.0
    np.testing.assert_array_equal(b, a[-1])


def test_an_oscillator_damped_far_faster_than_the_step_is_at_rest_after_it():
    """The rational stability function: at h rate = 1000 what is left is below 1e-2, of Gauss nearly everything."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=1e5)
    left = {
        kind: abs(vp.simulate(scene, [0.0], [1.0], dt=1e-2, steps=1, integrator=kind, check=False).v[-1, 0])
        for kind in (vp.Radau(2), vp.Radau(3), vp.Gauss(2))
    }
    assert left[vp.Radau(2)] < 1e-2
    assert left[vp.Radau(3)] < 1e-2
    assert left[vp.Gauss(2)] > 0.9


def test_one_stage_is_the_implicit_euler_method():
    """Of first order; a damper stops a joint by 1 / (1 + h rate); p1 = p0 + h (L_q + F) at the end of the step."""
    euler = vp.Radau(1, guard=None)
    assert euler.order == 1
    scene = vp.Scene(vp.planar_chain(3), damping=0.1)
    start = {"q0": np.zeros(3), "v0": np.ones(3)}
    exact = vp.simulate(scene, **start, dt=0.5, steps=1, integrator=vp.Reference()).q[-1]
    motions = [vp.simulate(scene, **start, dt=0.5 / n, steps=n, integrator=euler) for n in (240, 480)]
    errors = [np.abs(motion.q[-1] - exact).max() for motion in motions]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1.0, abs=0.1)

    motion = motions[0]
    v = np.diff(motion.q, axis=0)[0] / motion.dt
    slope = vp.lagrangian_jet(scene, motion.q[1], v).Lq - 0.1 * v
    np.testing.assert_allclose(motion.p[1] - motion.p[0], motion.dt * slope, rtol=0, atol=1e-12)

    stiff = vp.Scene(vp.planar_chain(1), gravity=False, damping=1e5)
    inertia = vp.lagrangian_jet(stiff, np.zeros(1), np.zeros(1)).Lvv[0, 0]
    left = vp.simulate(stiff, [0.0], [1.0], dt=1e-2, steps=1, integrator=euler, check=False).v[-1, 0]
    assert left == pytest.approx(1.0 / (1.0 + 1e-2 * 1e5 / inertia), rel=1e-9)


@pytest.mark.parametrize(
    "damping", [pytest.param([10, 10, 5, 5, 5, 2, 2], marks=pytest.mark.slow, id="the file's"), 0.1]
)
def test_torques_that_jump_on_a_damped_arm(damping):
    """Against SciPy's Radau on Pinocchio's forward dynamics: q within 1 % of the way, node velocities within 10 %."""
    robot = vp.load_robot("xarm7")
    scene = vp.Scene(robot, damping=damping)
    n, steps, dt = robot.dof, 20, 1e-2
    q0 = np.full(n, 0.3)
    hold = scene.holding_torque(q0)
    u = hold + np.random.default_rng(0).normal(size=(steps, n)) * np.maximum(1.0, 0.2 * np.abs(hold)) / 2
    model, data = robot.model, robot.model.createData()
    x, nodes = np.concatenate([q0, np.zeros(n)]), []
    for torque in u:

        def rate(_, x, torque=torque):
            return np.append(
                x[n:], pin.aba(model, data, robot.configuration(x[:n]), x[n:], torque - scene.damping * x[n:])
            )

        x = solve_ivp(rate, (0.0, dt), x, method="Radau", rtol=1e-8, atol=1e-10).y[:, -1]
        nodes.append(x)
    exact = np.array(nodes)
    motion = vp.simulate(scene, q0, np.zeros(n), dt=dt, steps=steps, controls=u, integrator=vp.Radau(3))
    assert motion.statistics.split_steps == 0
    way = np.ptp(exact[:, :n], axis=0)
    assert (np.abs(motion.q[1:] - exact[:, :n]).max(axis=0) <= 0.01 * way.max()).all()
    speed = np.abs(exact[:, n:]).max(axis=0)
    assert (np.abs(motion.v[1:] - exact[:, n:]).max(axis=0) <= 0.1 * speed).all()


def test_energy_of_an_undamped_motion_decays_with_its_order():
    scene = vp.Scene(vp.planar_chain(2))
    lost = []
    for n in (100, 200):
        motion = vp.simulate(scene, [0.5, 0.5], [0.0, 0.0], dt=1.0 / n, steps=n, integrator=vp.Radau(2))
        lost.append(abs(motion.energy[-1] - motion.energy[0]))
    assert 2.5 < np.log2(lost[0] / lost[1]) < 3.6


@pytest.mark.parametrize("damping", [0.0, 1.0, 100.0])
def test_one_stage_moves_from_rest_under_the_default_guard(damping):
    """It loses a part of what a first step from rest gains, which is its first order and no fault of the step."""
    scene = vp.Scene(vp.planar_chain(3), damping=damping)
    motion = vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-3, steps=100, integrator=vp.Radau(1), check=False)
    assert motion.statistics.substeps.max() == 1
    free = vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-3, steps=100, integrator=vp.Radau(1, guard=None))
    np.testing.assert_allclose(motion.q, free.q, rtol=0, atol=1e-12)


def test_a_spring_beside_a_damper_keeps_its_energy():
    """The default takes Radau for the one; the other swings by itself, undamped, at a radian a step."""
    model, inertia = pin.Model(), 0.33
    for name in ("spring", "damper"):
        joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), name)
        model.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), inertia * np.eye(3)), pin.SE3.Identity())
    stiffness = inertia * 50.0**2
    scene = vp.Scene(vp.load_robot(model), gravity=False, stiffness=[stiffness, 0.0], damping=[0.0, 100.0])
    motion = vp.simulate(scene, [0.5, 0.0], [0.0, 1.0], dt=0.02, steps=500)
    assert motion.integrator == str(vp.Radau(4))
    energy = 0.5 * (stiffness * motion.q[:, 0] ** 2 + inertia * motion.v[:, 0] ** 2)
    np.testing.assert_allclose(energy / energy[0], 1.0, rtol=0, atol=0.01)
    exact = 0.5 * np.cos(50.0 * motion.t)
    assert np.abs(motion.q[:, 0] - exact).max() < 0.005


@pytest.mark.parametrize(("stages", "dt"), [(2, 0.02), (2, 0.05), (3, 0.1)])
def test_free_motions_keep_their_energy(stages, dt):
    """The guard's budget is a hundredth of the one of one stage: a thousandth of the kinetic energy is kept so."""
    scene = vp.Scene(vp.planar_chain(3), damping=0.0)
    options = {"dt": dt, "steps": round(3.0 / dt), "integrator": vp.Radau(stages), "check": False}
    motion = vp.simulate(scene, [0.3, 1.2, -0.8], [2.0, -3.0, 4.0], **options)
    kinetic = [0.5 * v @ vp.lagrangian_jet(scene, q, v).Lvv @ v for q, v in zip(motion.q, motion.v, strict=True)]
    assert motion.statistics.split_steps > 0
    assert np.abs(motion.energy - motion.energy[0]).max() < 1e-3 * max(kinetic)
