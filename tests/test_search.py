"""The search for a plan: what its trials may take, when it ends; constants, scales and steady noise change nothing."""

import logging
import re

import numpy as np
import pytest
from findings import about

import varpin as vp

GOAL = [0.8, -0.5]


def reach(*extra, factor=1.0, noise=None, **options):
    """Two links to a posture in a second."""
    scene = vp.Scene(vp.planar_chain(2), damping=0.1, noise=noise)
    end = vp.Terminal(vp.TrackingCost(GOAL, 1e3) + vp.VelocityCost(10.0))
    cost = factor * (vp.ControlCost(1e-2) + vp.VelocityCost(0.1) + end)
    for term in extra:
        cost = cost + term
    return vp.OptimalControlProblem(scene, cost, [0.0, 0.0], [0.0, 0.0], **{"dt": 0.02, "steps": 50, **options})


def constant(value):
    return vp.CustomCost(lambda t, q, v, u: np.full(len(t), value), name="constant")


def numbers(reason):
    """The expected decrease and the tolerance on it."""
    promise = re.search(r"expected decrease is (\S+?)[;, ]", reason)
    share = re.search(r"at stake is (\S+)$", reason)
    return float(promise[1]), float(share[1])


def assert_same_search(one, other, rtol=0.0):
    assert one.status is other.status
    assert [item.step for item in one.history] == [item.step for item in other.history]
    assert [item.rollouts for item in one.history] == [item.rollouts for item in other.history]
    np.testing.assert_allclose(other.controls, one.controls, rtol=rtol, atol=rtol * np.abs(one.controls).max())


GRIDS = {
    "midpoint": {},
    "gauss": {"integrator": vp.Gauss(stages=2), "sampling": "gauss"},
    "rk4": {"integrator": vp.RungeKutta4(), "sampling": "gauss"},
}


# Constants, scales and noise


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("extra", [constant(1e6), constant(-1e9), vp.Terminal(constant(1e6))], ids=repr)
def test_a_constant_changes_nothing(extra, grid):
    plain, other = vp.solve(reach(**GRIDS[grid])), vp.solve(reach(extra, **GRIDS[grid]))
    assert plain.status is vp.Status.CONVERGED
    assert_same_search(plain, other)
    assert numbers(plain.reason) == numbers(other.reason)


def test_a_long_chain_converges_with_the_defaults():
    # Five links, undamped, with an end ten thousand times dearer than their torques.
    rng = np.random.default_rng(501)
    begin = rng.uniform(-1.0, 1.0, 5)
    end = vp.TrackingCost(begin + rng.uniform(-1.2, 1.2, 5), 1e4) + vp.VelocityCost(1e3)
    cost = vp.ControlCost(1e-2) + vp.Terminal(end)
    scene = vp.Scene(vp.planar_chain(5))
    plan = vp.solve(vp.OptimalControlProblem(scene, cost, begin, np.zeros(5), dt=0.05, steps=20), check=False)
    assert plan.status is vp.Status.CONVERGED
    assert plan.iterations > 100


@pytest.mark.parametrize("factor", [1e-6, 1e6])
@pytest.mark.parametrize("most", [4, 100], ids=["cut short", "converged"])
def test_scaling_a_cost_changes_nothing(factor, most):
    plain = vp.solve(reach(), max_iterations=most)
    other = vp.solve(reach(factor=factor), max_iterations=most)
    assert_same_search(plain, other, rtol=1e-9)
    assert other.cost == pytest.approx(factor * plain.cost, rel=1e-9)


@pytest.mark.parametrize("strength", [1.0, 1e3])
@pytest.mark.parametrize("grid", ["midpoint", "gauss"])
def test_additive_noise_changes_no_plan(strength, grid):
    """However much it adds to the cost: 1e7 times that of the motion."""
    quiet = vp.solve(reach(**GRIDS[grid]))
    noisy = vp.solve(reach(noise=vp.AdditiveNoise(strength), **GRIDS[grid]))
    assert noisy.noise_cost > strength**2 * quiet.cost
    assert_same_search(quiet, noisy, rtol=1e-9)


def test_additive_noise_hides_nothing_of_noise_that_controls_steer():
    one = vp.solve(reach(noise=vp.ControlNoise(0.1)))
    both = vp.solve(reach(noise=vp.ControlNoise(0.1) + vp.AdditiveNoise(300.0)))
    assert one.status is vp.Status.CONVERGED
    assert both.noise_cost > 1e5 * one.noise_cost
    assert_same_search(one, both, rtol=1e-8)


# What is at stake


def test_a_target_out_of_reach_does_not_loosen_the_tolerance():
    """1000 m away: 1e6 of the cost is there to stay."""
    robot = vp.load_robot("ur5")
    cost = vp.ControlCost(1e-3) + vp.VelocityCost(0.1)
    cost += vp.Terminal(vp.FramePositionCost(robot, "tool0", [0.0, 1000.0, 0.5], 1.0) + vp.VelocityCost(10.0))
    begin = [0.0, -1.5, 0.8, -0.5, 0.0, 0.0]
    problem = vp.OptimalControlProblem(vp.Scene(robot, damping=1.0), cost, begin, np.zeros(6), dt=0.02, steps=50)
    sol = vp.solve(problem, max_iterations=3)
    assert sol.cost > 0.9e6
    assert numbers(sol.reason)[1] < 1e-2 * 1e-7 * sol.cost


# How it ends


def test_wrong_derivatives_stall_and_say_so():
    def derivatives(t, q, v, u):
        return np.hstack([-2.0 * (q - 1.0), 0.0 * v, 0.2 * u]), np.diag([2.0, 2.0, 0.0, 0.0, 0.2, 0.2])[None]

    wrong = vp.CustomCost(lambda t, q, v, u: ((q - 1.0) ** 2).sum(axis=1) + 0.1 * (u**2).sum(axis=1), derivatives)
    scene = vp.Scene(vp.planar_chain(2), damping=0.1)
    sol = vp.solve(vp.OptimalControlProblem(scene, wrong, [0, 0], [0, 0], dt=0.02, steps=50))
    assert sol.status is vp.Status.STALLED
    assert about(sol.reason, "no lower cost")
    promise, share = numbers(sol.reason)
    assert promise > share


@pytest.mark.parametrize("grid", GRIDS)
def test_a_search_ends_where_rounding_begins(grid):
    """No tolerance is too small."""
    problem = reach(**GRIDS[grid])
    best = vp.solve(problem, tolerance=1e-18)
    assert best.status is vp.Status.CONVERGED
    assert best.gradient == pytest.approx(0.0, abs=1e-6)
    assert vp.solve(problem, best).iterations == 0


@pytest.mark.parametrize("at", [[0.0, 0.0], [0.3, -1.2]])
def test_a_search_that_begins_at_the_optimum_ends_there(at):
    """At rest at the goal, where gravity does nothing."""
    scene = vp.Scene(vp.planar_chain(2), gravity=False)
    cost = vp.TrackingCost(at, 10.0) + vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost(at, 10.0))
    sol = vp.solve(vp.OptimalControlProblem(scene, cost, at, [0, 0], dt=0.02, steps=50))
    assert sol.status is vp.Status.CONVERGED
    assert sol.iterations == 0
    assert sol.cost == 0.0


# What trials may take


def test_each_line_of_the_log_names_its_search(caplog):
    problem = vp.OptimalControlProblem(
        vp.Scene(vp.load_robot("finger")), vp.TrackingCost([0.3, 0.2, 0.1]) + vp.ControlCost(1e3), np.zeros(3),
        np.zeros(3), dt=0.01, steps=5,
    )  # fmt: skip
    with caplog.at_level(logging.INFO, "varpin.control.search"):
        plans = [vp.solve(own, check=False) for own in (problem, problem.at(t0=1.5, dt=0.005))]
    lines = [f"finger, 5 steps of 0.01 s from t = 0 s: {item}" for item in plans[0].history]
    lines += [f"finger, 10 steps of 0.005 s from t = 1.5 s: {item}" for item in plans[1].history]
    assert [record.getMessage() for record in caplog.records] == lines


@pytest.mark.parametrize("iterations", [2, 5])
def test_a_given_first_control_stays_exactly_as_it_is(iterations):
    before = np.random.default_rng(0).uniform(-5.0, 5.0, 2)
    problem = reach(controls="linear", constraints=[vp.WithinControlRate(400.0, before=before)])
    plan = vp.solve(problem, max_iterations=iterations, check=False)
    np.testing.assert_array_equal(plan.trajectory.u_nodes[0], before)
