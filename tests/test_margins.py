"""Margins by count: chance constraints where values in motions under noise are not normally distributed."""

import numpy as np
import pytest
from findings import about
from plan_problems import REST, TWO
from scipy.special import ndtr

import varpin as vp

HANGING = np.array([np.pi / 2 - 0.3, 0.0])
GRID = {"dt": 0.05, "steps": 20}
PATHS = 10_000


def under_a_lid(noise, margin=2.0, **grid):
    """The tip of two hanging links is higher whichever way noise pushes it."""
    scene = vp.Scene(TWO, damping=0.5, noise=noise)
    cost = vp.ControlCost(1.0) + vp.VelocityCost(0.3) + vp.TrackingCost(HANGING, 10.0)
    lid = vp.KeepInHalfSpace(TWO, "tip", [0.0, 0.0, -1.0], 1.86, margin=margin)
    return vp.OptimalControlProblem(scene, cost, HANGING, np.zeros(2), constraints=[lid], **GRID | grid)


def beside_a_limit(noise, **options):
    within = vp.WithinJointLimits(TWO, (-0.2, [0.9, 0.6]), margin=2.0)
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1.0) + vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0))
    scene = vp.Scene(TWO, damping=0.3, noise=noise)
    return vp.OptimalControlProblem(scene, cost, REST, REST, dt=0.03, steps=40, constraints=[within], **options)


def arm(name, begin, travel, noise):
    robot, begin = vp.load_robot(name, lock={"panda": {"panda_finger_joint1": 0.02}}.get(name)), np.array(begin)
    goal, scene = begin + travel, vp.Scene(robot, damping=0.5, noise=noise)
    cost = vp.ControlCost(1e-3, scene.holding_torque(begin)) + vp.TrackingCost(goal, 10.0)
    cost += vp.Terminal(vp.TrackingCost(goal, 100.0) + vp.VelocityCost(1.0))
    within = vp.WithinJointLimits(robot, (begin - 0.3, goal - 0.1), margin=2.0)
    return vp.OptimalControlProblem(scene, cost, begin, np.zeros(robot.dof), constraints=[within], **GRID)


UR3, PANDA = [0.0, -1.0, 1.0, 0.0, 0.5, 0.0], [0.0, -0.5, 0.0, -1.8, 0.0, 1.5, 0.5]
BOUNDED = {
    "held": lambda: beside_a_limit(vp.AdditiveNoise(0.05)),
    "linear": lambda: beside_a_limit(vp.AdditiveNoise(0.05), controls="linear"),
    "torques": lambda: beside_a_limit(vp.AdditiveNoise(0.05), control_limits=([-32.0, -12.0], [32.0, 12.0])),
    "noise of the controls": lambda: beside_a_limit(vp.ControlNoise(0.03)),
    # By the linear model's margins 3 to 5 % of motions were outside.
    "ur3, noise of the controls": lambda: arm("ur3", UR3, 0.6, vp.ControlNoise(0.05)),
    "panda, noise of the controls": lambda: arm("panda", PANDA, 0.4, vp.ControlNoise(0.02)),
    "z1": lambda: arm("z1", [0.0, 1.5, -1.5, 0.0, 0.0, 0.0, 0.0], 0.4, vp.AdditiveNoise(0.1)),
}


def outside(problem, plan):
    """The share (K, rows) of other motions that violate the problem's constraint at each node."""
    options = {"controls": plan.policy, "integrator": problem.integrator, "dt": problem.dt, "steps": problem.steps}
    found = vp.simulate_ensemble(problem.scene, problem.q0, problem.v0, paths=PATHS, rng=1, **options)
    (own,) = problem.constraints
    if isinstance(own, vp.WithinJointLimits):
        beyond = np.concatenate([found.q - own.limits[1], own.limits[0] - found.q], axis=2)
    else:
        places = TWO.frame_positions(found.q.reshape(-1, 2), own.frame).reshape(*found.q.shape[:2], 3)
        beyond = (own.offset - places @ own.normal)[:, :, None]
    return (beyond[:, 1:] > 0.0).mean(axis=0)


def most_allowed():
    share = ndtr(-2.0)
    return share + 3.0 * np.sqrt(share * (1.0 - share) / PATHS)


@pytest.mark.parametrize("name", BOUNDED)
def test_margins_in_standard_deviations(name):
    """At margin 2 by at most 2.3 % of motions for each bound and node, at an active one by many."""
    problem = BOUNDED[name]()
    plan = vp.solve(problem, check=False)
    assert plan.status.converged, plan.reason
    share = outside(problem, plan).max()
    assert share <= most_allowed()
    # The linear model's margins do for two links under noise of constant strength.
    assert (plan.search.counts > 0) == (name not in ("held", "linear", "torques"))
    if problem.scene.robot.dof > 2:
        return
    assert share >= 0.5 * ndtr(-2.0)
    # With their margins, values are at the bound.
    assert plan.constraints[0].values.max() == pytest.approx(0.0, abs=1e-6)
    # Without noise the plan keeps away from the bound.
    assert (problem.constraints[0].limits[1] - plan.trajectory.q).min() > 1e-3


@pytest.mark.parametrize(
    ("problem", "most"),
    [
        (beside_a_limit(vp.ControlNoise(0.3)), 40),
        (beside_a_limit(vp.ControlNoise(1.0)), 40),
        (beside_a_limit(vp.AdditiveNoise(3.0)), 40),
        # It is above the lid in almost every second motion, whatever the margin.
        (under_a_lid(vp.AdditiveNoise(1.5)), 200),
    ],
    ids=["controls", "strong", "additive", "lid"],
)
def test_noise_too_strong_for_a_margin_is_infeasible(problem, most):
    """Margins move with the motion, so that each program foresees a plan that the next one has not."""
    plan = vp.solve(problem, check=False)
    assert plan.status is vp.Status.INFEASIBLE
    assert plan.iterations <= most
    assert "its margin of" in plan.reason


def test_a_plan_with_margins_that_is_cut_is_resumed_as_if_it_had_not_been():
    problem = under_a_lid(vp.AdditiveNoise(0.4))
    whole = vp.solve(problem, check=False)
    part = vp.solve(problem, check=False, max_iterations=8)
    rest = vp.solve(problem, check=False, resume=part)
    assert whole.status is rest.status is vp.Status.CONVERGED
    np.testing.assert_array_equal(rest.controls, whole.controls)


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_margins_that_grow_with_the_motion_do_not_run_away(controls):
    """Noise of the controls: a motion that meets wide margins at once is violent, and has wider ones."""
    scene = vp.Scene(TWO, damping=0.5, noise=vp.ControlNoise(0.1))
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([0.9, 0.5], 100.0) + vp.VelocityCost(10.0))
    within = vp.WithinJointLimits(TWO, (-0.15, 1.0), margin=2.0)
    grid = {"dt": 0.05, "steps": 16, "controls": controls}
    free = vp.solve(vp.OptimalControlProblem(scene, cost, REST, REST, **grid), check=False)
    problem = vp.OptimalControlProblem(scene, cost, REST, REST, constraints=[within], **grid)
    plan = vp.solve(problem, check=False)
    assert plan.cost + plan.noise_cost < 3.0 * (free.cost + free.noise_cost)
    assert plan.status in (vp.Status.CONVERGED, vp.Status.INFEASIBLE)
    if plan.status.converged:
        assert outside(problem, plan).max() <= most_allowed()


def test_a_warning_of_a_small_margin_counts():
    """Noise that Python evaluates leaves margins as they are."""
    coarse = {"dt": 0.1, "steps": 8}
    problem = under_a_lid(vp.CustomNoise(lambda q, v, u: 0.7 * np.eye(2), 2), **coarse)
    plan = vp.solve(problem)
    (told,) = about(plan.warnings, "small margin")
    (bound,) = problem.bound_constraints
    place = int(np.argmin(np.abs(bound.times - told.time)))
    # The same noise, compiled.
    often = outside(under_a_lid(vp.AdditiveNoise(0.7), **coarse), plan)[place, 0]
    # Of 512 motions, at the worst of a few places.
    assert abs(often - told.value) < 4.0 * np.sqrt(told.value / 512)
    assert f"{100.0 * told.value:.3g} % of motions" in told
