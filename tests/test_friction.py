"""Dry friction: arms that come to rest, and steps that friction is too fast for."""

from __future__ import annotations

import numpy as np
import pytest
from findings import about
from oracles import exact

import varpin as vp
from varpin.simulation.spectrum import rate_at_rest


def block(width, level=1.0):
    """One link without gravity, which dry friction brings to rest."""
    return vp.Scene(vp.planar_chain(1), gravity=False, forces=vp.CoulombFriction(level, width))


def own(motion):
    return about(motion.warnings, "error")


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.Gauss(4), vp.Radau(2), vp.Radau(3)], ids=str)
@pytest.mark.parametrize("width", [1e-1, 1e-3, 1e-5])
def test_friction_never_adds_energy(integrator, width):
    """Whatever the width is in steps."""
    for v0 in (2.0, 2.005, 2.013):
        motion = vp.simulate(block(width), [0.0], [v0], dt=1e-2, steps=120, integrator=integrator)
        assert np.diff(motion.energy).max() <= 1e-14


def test_friction_so_fast_that_steps_take_very_short_parts():
    """Joints of an arm ring that should rest; the method that stops them takes parts of a step of 1e-4 and less."""
    scene = vp.Scene(vp.load_robot("ur5"), forces=vp.CoulombFriction([8.0, 8.0, 5.0, 2.0, 2.0, 1.0], 1e-5))
    begin, speed = np.array([0.0, -1.2, 1.5, -0.5, 0.3, 0.2]), np.array([1.0, 1.0, -1.0, 1.0, 2.0, 2.0])
    stopped = vp.simulate(scene, begin, speed, dt=1e-2, steps=60, integrator=vp.Radau(3))
    assert stopped.statistics.halvings.max() > 12
    assert stopped.statistics.substeps.max() < 100
    assert np.abs(stopped.v[10:, 5]).max() < 1e-3
    motion = vp.simulate(scene, begin, speed, dt=2e-2, steps=30, integrator=vp.RungeKutta4())
    # Friction holds the last joint after 0.08 s.
    assert np.abs(motion.v[5:, 5]).max() > 0.3
    assert own(motion)


def test_joints_that_do_not_stop_are_quiet():
    sliding = vp.simulate(block(1e-5, 0.1), [0.0], [2.0], dt=1e-2, steps=100)
    resting = vp.simulate(block(1e-5), [0.0], [0.0], dt=1e-2, steps=100)
    assert own(sliding) == own(resting) == []


def problem(width, dt=0.02):
    scene = vp.Scene(vp.planar_chain(2), gravity=False, forces=vp.CoulombFriction(0.5, width))
    cost = vp.ControlCost(1e-2) + vp.Terminal(vp.TrackingCost([0.6, -0.4], 1e3) + vp.VelocityCost(10.0))
    return vp.OptimalControlProblem(scene, cost, [0.0, 0.0], [0.0, 0.0], dt=dt, steps=round(0.6 / dt))


def test_problems_take_an_integrator_that_friction_is_not_too_fast_for():
    assert problem(0.1).integrator == vp.Gauss(3)
    rough = problem(1e-4)
    assert rough.dt * rate_at_rest(rough.scene, rough.q0) > 10.0
    assert rough.integrator == vp.Radau(4)
    assert rough.at(dt=0.01).integrator == vp.Radau(4)
    # Another step chooses anew.
    assert 1e-4 * rate_at_rest(rough.scene, rough.q0) < 10.0
    assert rough.at(dt=1e-4).integrator == vp.Gauss(4)
    given = vp.OptimalControlProblem(
        rough.scene, rough.cost, rough.q0, rough.v0, dt=0.02, steps=30, integrator=vp.Gauss(2)
    )
    assert given.integrator == vp.Gauss(2)


def test_verification_under_friction_that_is_too_fast_for_explicit_steps():
    """The cost of the controls alone, against SciPy's Radau over each control."""
    rough = problem(2e-4)
    plan = vp.solve(rough, max_iterations=15)
    found = plan.verify(tolerance=1e-5, max_substeps=256)
    assert found.integrator == str(vp.Radau(3))
    assert found.told
    assert "Radau" in str(found)
    times, u = rough.dt * np.arange(31), plan.controls
    held = lambda k, q, v: lambda t: u[k]  # noqa: E731
    motion = exact(rough.scene, rough.q0, rough.v0, times, held, stiff=True, rtol=1e-8)
    q, v = motion.q[-1], motion.v[-1]
    true = rough.dt * 1e-2 * (u**2).sum() + 1e3 * ((q - [0.6, -0.4]) ** 2).sum() + 10.0 * (v**2).sum()
    assert found.open_loop_cost == pytest.approx(true, rel=1e-4)


def test_noise_beyond_the_width_of_friction_costs_more_than_the_model_says():
    """Linearized friction damps noise that the friction hardly feels; paths tell."""
    robot = vp.planar_chain(2)

    def paths(noise):
        forces = [vp.CoulombFriction(0.3, 0.02)]
        scene = vp.Scene(robot, gravity=False, forces=forces, noise=vp.AdditiveNoise(noise))
        cost = vp.ControlCost(1.0) + vp.TrackingCost([0.0, 0.0], 1.0)
        problem = vp.OptimalControlProblem(scene, cost, [0.0, 0.0], [0.0, 0.0], dt=0.01, steps=30)
        return vp.solve(problem).monte_carlo(paths=100, rng=0)

    loud, calm = paths(0.3), paths(1e-4)
    assert loud.cost > 3.0 * loud.predicted
    assert calm.cost == pytest.approx(calm.predicted, abs=4.0 * calm.standard_error)


def test_an_arm_comes_to_rest():
    robot = vp.load_robot("ur5")
    scene = vp.Scene(robot, gravity=False, forces=vp.CoulombFriction([8.0, 8.0, 5.0, 2.0, 2.0, 1.0], 1e-2))
    begin, speed = np.array([0.0, -1.2, 1.5, -0.5, 0.3, 0.2]), np.array([1.0, 1.0, -1.0, 1.0, 2.0, 2.0])

    true = exact(scene, begin, speed, np.linspace(0.0, 0.6, 13), stiff=True, rtol=1e-8).q
    for integrator, error in ((vp.Radau(3), 2e-6), (vp.Gauss(3), 2e-6), (vp.Midpoint(), 2e-5)):
        motion = vp.simulate(scene, begin, speed, dt=1e-3, steps=600, integrator=integrator)
        np.testing.assert_allclose(motion.q[::50], true, atol=error)
        assert np.abs(motion.v[-1]).max() < 1e-6
        assert np.diff(motion.energy).max() <= 1e-12 * motion.energy[0]
