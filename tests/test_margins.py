"""Margins by count: chance constraints where values in motions under noise are not normally distributed."""

import numpy as np
import pytest
from findings import about
from scipy.special import ndtr

import varpin as vp

ROBOT = vp.planar_chain(2)
HANGING = np.array([np.pi / 2 - 0.3, 0.0])
GRID = {"dt": 0.05, "steps": 20}
PATHS = 10_000


def under_a_lid(noise, margin=2.0, **grid):
    """The tip of two hanging links is higher whichever way noise pushes it."""
    scene = vp.Scene(ROBOT, damping=0.5, noise=noise)
    cost = vp.ControlCost(1.0) + vp.VelocityCost(0.3) + vp.TrackingCost(HANGING, 10.0)
    lid = vp.KeepInHalfSpace(ROBOT, "tip", [0.0, 0.0, -1.0], 1.86, margin=margin)
    return vp.OptimalControlProblem(scene, cost, HANGING, np.zeros(2), constraints=[lid], **GRID | grid)


def values(problem, plan, seed=1):
    """Values (P, K, rows) of the problem's constraint in other motions."""
    options = {"controls": plan.policy, "integrator": problem.integrator, "dt": problem.dt, "steps": problem.steps}
    found = vp.simulate_ensemble(problem.scene, problem.q0, problem.v0, paths=PATHS, rng=seed, **options)
    (own,) = problem.constraints
    if isinstance(own, vp.WithinJointLimits):
        return np.concatenate([found.q - own.limits[1], own.limits[0] - found.q], axis=2)[:, 1:]
    places = problem.scene.robot.frame_positions(found.q.reshape(-1, 2), own.frame).reshape(*found.q.shape[:2], 3)
    return (own.offset - places @ own.normal)[:, 1:, None]


def allowed(margin=2.0):
    share = ndtr(-margin)
    return share + 3.0 * np.sqrt(share * (1.0 - share) / PATHS)


def beyond_a_joint_limit(robot, begin, travel, noise, damping):
    """A reach whose goal is a little beyond limits with a margin."""
    begin = np.asarray(begin, dtype=float)
    goal = begin + travel
    scene = vp.Scene(robot, damping=damping, noise=noise)
    cost = vp.ControlCost(1e-3, scene.holding_torque(begin)) + vp.TrackingCost(goal, 10.0)
    cost += vp.Terminal(vp.TrackingCost(goal, 100.0) + vp.VelocityCost(1.0))
    within = vp.WithinJointLimits(robot, (begin - 0.3, goal - 0.1), margin=2.0)
    rest = np.zeros(len(begin))
    return vp.OptimalControlProblem(scene, cost, begin, rest, constraints=[within], **GRID)


@pytest.mark.parametrize(
    ("name", "begin", "travel", "noise"),
    [
        ("ur3", [0.0, -1.0, 1.0, 0.0, 0.5, 0.0], 0.6, vp.ControlNoise(0.05)),
        ("panda", [0.0, -0.5, 0.0, -1.8, 0.0, 1.5, 0.5], 0.4, vp.ControlNoise(0.02)),
        ("ur3", [0.0, -1.0, 1.0, 0.0, 0.5, 0.0], 0.6, vp.AdditiveNoise(0.1)),
        ("z1", [0.0, 1.5, -1.5, 0.0, 0.0, 0.0, 0.0], 0.4, vp.AdditiveNoise(0.1)),
    ],
    ids=["ur3, controls", "panda, controls", "ur3", "z1"],
)
def test_chance_constraints_of_arms_hold(name, begin, travel, noise):
    """By noise of their controls, with the linear model's margins, 3 to 5 % of motions were outside."""
    robot = vp.load_robot(name, lock={"panda_finger_joint1": 0.02} if name == "panda" else None)
    problem = beyond_a_joint_limit(robot, begin, travel, noise, 0.5)
    plan = vp.solve(problem, check=False)
    assert plan.status is vp.Status.CONVERGED, plan.reason
    assert plan.search.counts > 0
    assert (values(problem, plan) > 0.0).mean(axis=0).max() <= allowed()


def test_a_plan_with_margins_that_is_cut_is_resumed_as_if_it_had_not_been():
    problem = under_a_lid(vp.AdditiveNoise(0.4))
    whole = vp.solve(problem, check=False)
    part = vp.solve(problem, check=False, max_iterations=8)
    rest = vp.solve(problem, check=False, resume=part)
    assert whole.status is rest.status is vp.Status.CONVERGED
    np.testing.assert_array_equal(rest.controls, whole.controls)


def test_noise_that_leaves_no_room_is_told_of():
    """It is above the lid in almost every second motion, whatever the margin."""
    plan = vp.solve(under_a_lid(vp.AdditiveNoise(1.5)))
    assert plan.status is vp.Status.INFEASIBLE
    assert "its margin of" in plan.reason


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_margins_that_grow_with_the_motion_do_not_run_away(controls):
    """Noise of the controls: a motion that meets wide margins at once is violent, and has wider ones."""
    scene = vp.Scene(ROBOT, damping=0.5, noise=vp.ControlNoise(0.1))
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([0.9, 0.5], 100.0) + vp.VelocityCost(10.0))
    within = vp.WithinJointLimits(ROBOT, (-0.15, 1.0), margin=2.0)
    rest = np.zeros(2)
    grid = {"dt": 0.05, "steps": 16}
    free = vp.solve(vp.OptimalControlProblem(scene, cost, rest, rest, controls=controls, **grid), check=False)
    problem = vp.OptimalControlProblem(scene, cost, rest, rest, controls=controls, constraints=[within], **grid)
    plan = vp.solve(problem, check=False)
    assert plan.cost + plan.noise_cost < 3.0 * (free.cost + free.noise_cost)
    assert plan.status in (vp.Status.CONVERGED, vp.Status.INFEASIBLE)
    if plan.status.converged:
        assert (values(problem, plan) > 0.0).mean(axis=0).max() <= allowed()


def test_a_warning_of_a_small_margin_counts():
    """Noise that Python evaluates leaves margins as they are; what is said of a bound is so by other motions."""
    coarse = {"dt": 0.1, "steps": 8}
    problem = under_a_lid(vp.CustomNoise(lambda q, v, u: 0.7 * np.eye(2), 2), **coarse)
    plan = vp.solve(problem)
    (told,) = about(plan.warnings, "small margin")
    (bound,) = problem.bound_constraints
    place = int(np.argmin(np.abs(bound.times - told.time)))
    # The same noise, compiled.
    often = (values(under_a_lid(vp.AdditiveNoise(0.7), **coarse), plan)[:, place, 0] > 0.0).mean()
    # Of 512 motions, at the worst of a few places.
    assert abs(often - told.value) < 4.0 * np.sqrt(told.value / 512)
    assert f"{100.0 * told.value:.3g} % of motions" in told
