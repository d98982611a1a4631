"""Searches that start on states: where they end, in how many iterations, and what they refuse."""

import contextlib

import numpy as np
import pinocchio as pin
import pytest
from refusals import naming, refused

import varpin as vp

STEPS = 50


def sliders():
    """Two sliders one on the other: a linear robot."""
    model, at = pin.Model(), 0
    for name, mass in (("a", 2.0), ("b", 1.0)):
        at = model.addJoint(at, pin.JointModelPX(), pin.SE3.Identity(), name)
        model.appendBodyToJoint(at, pin.Inertia(mass, np.zeros(3), 0.01 * np.eye(3)), pin.SE3.Identity())
    return vp.load_robot(model)


def linear(**options):
    """A linear problem with one control for two joints."""
    scene = vp.Scene(sliders(), gravity=False, stiffness={"b": 3.0}, damping=0.1, actuation=["a"])
    cost = vp.ControlCost(0.1) + vp.VelocityCost(0.1)
    cost += vp.Terminal(vp.TrackingCost([1.0, 0.0], 100.0) + vp.VelocityCost(10.0))
    return vp.OptimalControlProblem(scene, cost, [0, 0], [0, 0], dt=0.04, steps=STEPS, **options)


def reach(*extra, scene=None, **options):
    """Two links to a posture."""
    scene = vp.Scene(vp.planar_chain(2), damping=0.1) if scene is None else scene
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0) + vp.VelocityCost(10.0))
    for term in extra:
        cost = cost + term
    return vp.OptimalControlProblem(scene, cost, [0, 0], [0, 0], dt=1.2 / STEPS, steps=STEPS, **options)


def line(end, steps=STEPS):
    s = np.linspace(0.0, 1.0, steps + 1)[:, None]
    return s * s * (3.0 - 2.0 * s) * np.asarray(end, dtype=float)


@pytest.mark.parametrize(
    "options",
    [{}, {"integrator": vp.RungeKutta4()}, {"hold": 5}, {"sampling": "midpoint"}, {"integrator": vp.Radau(2)}],
)
def test_a_linear_problem_takes_one_step(options):
    problem = linear(**options)
    own, found = vp.solve(problem), vp.solve(problem, states=line([1.0, 0.3]))
    assert found.status.converged
    assert [row.step for row in found.history] == [1.0, 0.0]
    assert found.cost == pytest.approx(own.cost, rel=1e-12)
    np.testing.assert_allclose(found.trajectory.q, own.trajectory.q, atol=1e-10)


def test_underactuated_under_noise():
    """Single shooting is far above after as many iterations, as the arm does not get near the goal."""
    scene = vp.Scene(vp.planar_chain(2), damping=0.1, actuation=["joint1"], noise=vp.ControlNoise(0.1))
    problem = reach(scene=scene)
    own = vp.solve(problem, max_iterations=25, check=False)
    found = vp.solve(problem, states=line([1.0, 0.5]), check=False)
    assert found.status.converged
    assert found.iterations <= 25
    assert found.cost < 0.1 * own.cost
    assert found.noise_cost > 0.0
    again = problem.simulate(found.policy)
    assert problem.cost_of(again) == pytest.approx(found.cost, rel=1e-9)


def test_the_first_motion_follows_the_path():
    """All joints are driven, and nothing is missing."""
    problem, path = reach(), line([1.0, 0.5])
    found = vp.solve(problem, states=path, max_iterations=0, check=False)
    np.testing.assert_allclose(found.trajectory.q, path, atol=2e-3)
    for states in (found.trajectory, (found.trajectory.q, found.trajectory.v)):
        again = vp.solve(problem, states=states, max_iterations=0, check=False)
        np.testing.assert_allclose(again.trajectory.q, path, atol=4e-3)
    given = vp.solve(problem, found.controls, states=path, max_iterations=0, check=False)
    np.testing.assert_allclose(given.trajectory.q, path, atol=2e-3)


def test_around_an_obstacle():
    """A path above the ball leads to a plan above it; the way below costs more than five times as much."""
    arm = {name: ([0, 0, 0], [1, 0, 0], 0.05) for name in ("joint1", "joint2")}
    ball = vp.Obstacle.sphere([1.4, 0.0, -1.35], 0.15)
    problem = reach(constraints=[vp.KeepClear(vp.planar_chain(2), [ball], 0.02, capsules=arm)])
    found = vp.solve(problem, states=line([1.0, 0.5]), check=False)
    assert found.status.converged
    assert found.violation <= 1e-6
    assert found.cost < 2.0


def test_states_in_degrees_are_told_of(caplog):
    # The motion along them may fail.
    with contextlib.suppress(vp.VarpinError):
        vp.solve(reach(), states=line([90.0, 45.0]), max_iterations=0)
    assert naming(caplog.messages, "states", "'joint1'", "90", "degrees")


def test_linear_controls_within_rate_limits_and_a_first_control():
    within = [vp.WithinControlRate(60.0, before=0.0), vp.WithinJointLimits(vp.planar_chain(2), ([-1, -1], [1.05, 0.6]))]
    problem = reach(vp.ControlRateCost(1e-5), controls="linear", constraints=within)
    found = vp.solve(problem, states=line([1.0, 0.5]))
    assert found.status.converged
    np.testing.assert_array_equal(found.controls[0], 0.0)
    assert np.abs(np.diff(found.controls, axis=0)).max() <= 60.0 * problem.dt * (1.0 + 1e-6)


OTHER = vp.simulate(vp.Scene(vp.planar_chain(1)), [0.0], [0.0], dt=0.01, steps=3)
SLOWER = vp.simulate(reach().scene, [0.0, 0.0], [0.0, 0.0], dt=2.4 / STEPS, steps=STEPS)


@pytest.mark.parametrize(
    ("states", "options", "facts"),
    [
        (line([1.0, 0.5], 20), {}, ("(51, 2)", "(21, 2)")),
        (np.zeros((51, 3)), {}, ("states", "(51, 2)")),
        (np.full((51, 2), np.nan), {}, "states"),
        (line([1.0, 0.5]) + np.array([0.0, 0.1]), {}, ("q0", "'joint2'", "0.1")),
        (line([90.0, 45.0]) + 30.0, {}, ("q0", "degrees")),
        ((np.zeros((51, 2)),), {}, ("(q, v)", "1")),
        ((np.zeros((51, 2)), np.zeros((50, 2))), {}, ("states", "v", "51")),
        ("path", {}, "states"),
        (OTHER, {}, "joints"),
        (SLOWER, {}, "dt"),
        (line([1.0, 0.5]), {"controls": reach().holding_policy()}, "states"),
        (line([1.0, 0.5]), {"resume": reach()}, ("states", "resume")),
    ],
)
def test_refused_states(states, options, facts):
    with refused(vp.InputError, facts):
        vp.solve(reach(), states=states, **options)
