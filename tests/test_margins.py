"""Margins by count: chance constraints where values in motions under noise are not normally distributed."""

import re

import numpy as np
import pytest
from findings import about
from scipy.special import ndtr

import varpin as vp
from varpin.control.noise import deviations
from varpin.control.stages import Feedback, Steps

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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "begin", "travel"),
    [
        ("ur3", [0.0, -1.0, 1.0, 0.0, 0.5, 0.0], 0.6),
        ("z1", [0.0, 1.5, -1.5, 0.0, 0.0, 0.0, 0.0], 0.4),
        ("panda", [0.0, -0.5, 0.0, -1.8, 0.0, 1.5, 0.5], 0.4),
    ],
)
def test_chance_constraints_of_arms_hold(name, begin, travel):
    """By noise of their controls, with the linear model's margins, 3 to 5 % of motions were outside."""
    robot = vp.load_robot(name, lock={"panda_finger_joint1": 0.02} if name == "panda" else None)
    problem = beyond_a_joint_limit(robot, begin, travel, vp.ControlNoise(0.05), 0.5)
    plan = vp.solve(problem, check=False)
    assert plan.status is vp.Status.CONVERGED, plan.reason
    assert (values(problem, plan) > 0.0).mean(axis=0).max() <= allowed()


@pytest.mark.slow
def test_noise_that_leaves_no_room_is_told_of():
    """With the linear model's margins, four motions in ten were above the lid."""
    plan = vp.solve(under_a_lid(vp.AdditiveNoise(1.5)))
    assert plan.status is vp.Status.INFEASIBLE
    assert "included, which is as wide as motions under noise need" in plan.reason
    assert plan.multipliers.counts > 0


@pytest.mark.slow
def test_a_warning_of_a_small_margin_counts():
    """What it says of a bound is so by ten times as many other motions, and the margin that it names suffices there."""
    coarse = {"dt": 0.1, "steps": 8}
    problem = under_a_lid(vp.CustomNoise(lambda q, v, u: 1.5 * np.eye(2), 2), **coarse)
    plan = vp.solve(problem)
    (sentence,) = about(plan.warnings, "small margin")
    time, share, error, margin = map(
        float, re.search(r"t = (\S+) s .* by (\S+) \+- (\S+) % .*; margin=(\S+) is", sentence).groups()
    )
    (bound,) = problem.bound_constraints
    place = int(np.argmin(np.abs(bound.times - time)))
    # The same noise, compiled.
    c = values(under_a_lid(vp.AdditiveNoise(1.5), **coarse), plan)[:, place, 0]
    often = 100.0 * (c > 0.0).mean()
    assert abs(often - share) < 3.5 * error
    planned = bound.value(plan.trajectory.q, plan.trajectory.v, plan.controls)[place, 0]
    own = deviations(Steps(problem, plan.trajectory), Feedback(plan.gains, plan.previous_gains), [bound])[0][place, 0]
    # Farther away by as much as the margin is larger, as if motions about the plan stayed the same.
    assert (c - planned > margin * own).mean() < 0.03
