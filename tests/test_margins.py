"""Margins by count: chance constraints where values in motions under noise are not normally distributed."""

import re

import numpy as np
import pytest
from findings import about
from scipy.special import ndtr

import varpin as vp
from varpin.control import augmented
from varpin.control.examination import PARTS, _within_steps
from varpin.control.margins import _chosen, _Counted, _Model, _played, _Row, widened
from varpin.control.spread import Feedback, deviations
from varpin.mechanics.wiener import children

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


def test_counts_are_those_of_other_motions():
    """Shares, their standard errors, and the distances that as many motions exceed as promised."""
    problem = under_a_lid(vp.AdditiveNoise(0.4))
    plan = vp.solve(problem, check=False, max_iterations=6)
    model = _Model.along(plan)
    (row,) = _chosen(plan, model, (3,))
    (counted,) = _played(plan, model, [row], children(5, 4096), 0, 4096)
    # Of the motions to first order as many are beyond two deviations as is known without them.
    share = ndtr(-2.0)
    np.testing.assert_allclose(counted.beyond.mean(axis=0), share, atol=4.0 * np.sqrt(share / 4096))
    c = values(problem, plan)[:, row.near]
    share, error = counted.shares(row)
    other = (c > 0.0).mean(axis=0)
    apart = (share - other) / np.hypot(error, np.sqrt(other * (1.0 - other) / PATHS))
    assert np.abs(apart).max() < 4.0
    assert apart.std() > 0.1
    beyond = (c - row.planned[row.near] > counted.needed(row)).mean(axis=0)
    assert (beyond < allowed()).all()
    assert (beyond > 0.6 * ndtr(-2.0)).all()


def test_tails_beyond_what_motions_show():
    """Distances that fewer motions exceed than were played: of normal values, and of an exponential tail, at least."""
    rng = np.random.default_rng(0)
    (bound,) = under_a_lid(vp.AdditiveNoise(0.1), margin=4.0).bound_constraints
    one = np.ones((1, 2))
    row = _Row(bound, one > 0.0, -4.0 * one, np.zeros((1, 2, 4)), one, one, 4.0 * one, 0.0 * one)
    given = np.column_stack(
        [rng.standard_normal(4096), np.sign(rng.standard_normal(4096)) * rng.exponential(size=4096)]
    )
    normal, exponential = _Counted(given - 4.0, given > 4.0, given > 4.0).needed(row)
    assert 4.0 < normal < 5.5
    # One side of a distribution that has two.
    assert exponential == pytest.approx(np.log(0.5 / ndtr(-4.0)), rel=0.25)


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


@pytest.mark.parametrize(
    "when",
    [
        pytest.param("before the count", marks=pytest.mark.slow),
        pytest.param("at the count", marks=pytest.mark.slow),
        pytest.param("after it", marks=pytest.mark.slow),
        pytest.param("while counting", marks=pytest.mark.slow),
    ],
)
def test_counted_margins_are_resumed_to_the_bit(when, tmp_path, monkeypatch):
    problem = under_a_lid(vp.AdditiveNoise(0.4))
    rounds = []

    def counting(*given):
        rounds.append(given[0].iterations)
        return widened(*given)

    monkeypatch.setattr(augmented, "widened", counting)
    whole = vp.solve(problem, check=False)
    counted = rounds[0]
    if when == "while counting":

        def interrupted(*given):
            raise KeyboardInterrupt

        monkeypatch.setattr(augmented, "widened", interrupted)
        part = vp.solve(problem, check=False)
        assert part.status is vp.Status.INTERRUPTED
        monkeypatch.setattr(augmented, "widened", widened)
    else:
        most = {"before the count": counted - 1, "at the count": counted, "after it": whole.iterations - 1}[when]
        part = vp.solve(problem, check=False, max_iterations=most)
        assert (part.multipliers.counts > 0) == (when == "after it")
    part.save(tmp_path / "part.npz")
    rest = vp.solve(problem, resume=vp.Solution.load(tmp_path / "part.npz", problem), check=False)
    assert rest.status is whole.status
    np.testing.assert_array_equal(rest.controls, whole.controls)
    np.testing.assert_array_equal(rest.multipliers.added, whole.multipliers.added)


@pytest.mark.slow
def test_a_start_near_a_bound_needs_no_later_margin():
    """What is added where motions have spread is not asked for at the first nodes, where they have not."""
    scene = vp.Scene(ROBOT, damping=0.5, noise=vp.AdditiveNoise(0.4))
    cost = vp.ControlCost(1.0) + vp.VelocityCost(0.3) + vp.TrackingCost(HANGING, 10.0)
    lid = vp.KeepInHalfSpace(ROBOT, "tip", [0.0, 0.0, -1.0], 1.905, margin=2.0)
    problem = vp.OptimalControlProblem(scene, cost, HANGING, np.zeros(2), constraints=[lid], **GRID)
    plan = vp.solve(problem)
    assert plan.multipliers.counts > 0
    assert plan.status is vp.Status.CONVERGED, plan.reason
    assert (values(problem, plan) > 0.0).mean(axis=0).max() <= allowed()


@pytest.mark.slow
def test_a_bound_that_the_linear_model_sees_no_motion_towards_is_counted():
    """At rest at the bottom, the tip moves sideways to first order, and up to second order alone."""
    bottom = np.array([np.pi / 2, 0.0])
    scene = vp.Scene(ROBOT, damping=0.5, noise=vp.AdditiveNoise(0.6))
    cost = vp.ControlCost(1.0) + vp.VelocityCost(0.3) + vp.TrackingCost(bottom, 0.1)
    lid = vp.KeepInHalfSpace(ROBOT, "tip", [0.0, 0.0, -1.0], 1.99, margin=2.0)
    problem = vp.OptimalControlProblem(scene, cost, bottom, np.zeros(2), constraints=[lid], **GRID)
    plan = vp.solve(problem, check=False, max_iterations=3)
    (bound,) = problem.bound_constraints
    own = deviations(problem, plan.trajectory, Feedback(plan.gains, plan.previous_gains), bound)
    assert own.max() < 1e-6
    outside = (values(problem, plan) > 0.0).mean(axis=0)
    assert outside.max() > 0.1
    (added,) = widened(plan)
    assert (added[outside > 0.1] > 0.01).all()


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
    own = deviations(problem, plan.trajectory, Feedback(plan.gains, plan.previous_gains), bound)[place, 0]
    # Farther away by as much as the margin is larger, as if motions about the plan stayed the same.
    assert (c - planned > margin * own).mean() < 0.03


def test_margins_within_steps():
    """Standard deviations of a Wiener process there, and none larger than at the end of the step."""
    t = 0.1 * np.arange(1, 6)
    found = _within_steps(np.sqrt(t)[:, None])[:, 0]
    np.testing.assert_allclose(found, np.sqrt(0.1 * np.arange(1, 5 * PARTS + 1) / PARTS), rtol=1e-14)
    falling = _within_steps(np.array([[3.0], [2.0]]))[:, 0]
    assert (falling[:PARTS] <= 3.0).all()
    np.testing.assert_array_equal(falling[PARTS:], 2.0)
