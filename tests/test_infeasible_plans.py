"""Plans that no motion within the constraints makes: each says so, with the constraint, within bounded iterations."""

import itertools
import re

import numpy as np
import pytest
from findings import about

import varpin as vp

ROBOT = vp.planar_chain(2)
LIMITS = {"control_limits": (-30.0, 30.0)}


def problem_of(constraints, **options):
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0) + vp.VelocityCost(10.0))
    options = {"q0": [0.0, 0.0], "v0": [0.0, 0.0], "dt": 0.05, "steps": 20, **options}
    return vp.OptimalControlProblem(vp.Scene(ROBOT, damping=0.1), cost, constraints=constraints, **options)


def test_a_search_that_jumps_does_not_call_a_plan_infeasible():
    """Gauss(2) divides steps of fast dampers, and a motion of other parts is another one; Radau has a plan."""
    goal = np.array([0.019, 0.721])
    cost = vp.ControlCost(1e-4) + vp.Terminal(vp.TrackingCost(goal, 1e3) + vp.VelocityCost(10.0))

    def plan(integrator):
        return vp.solve(
            vp.OptimalControlProblem(
                vp.Scene(ROBOT, damping=[100.0, 10.0]),
                cost,
                np.zeros(2),
                np.zeros(2),
                dt=0.1,
                steps=6,
                integrator=integrator,
                constraints=[vp.WithinVelocityLimits(ROBOT, (-1.2, 1.2))],
            ),
            check=False,
        )

    jumping = plan(vp.Gauss(2))
    assert jumping.status is vp.Status.STALLED
    assert jumping.violation > 1e-3
    for fact in ("WithinVelocityLimits is violated", "divide other steps", "Radau"):
        assert fact in jumping.reason
    assert plan(vp.Radau(2)).status.converged


def said(reason):
    return float(re.search(r"stays violated by ([0-9.e+-]+)", reason)[1])


# With joint limits, controls as given, and an integrator whose positions controls reach a step later.
FIRST_STEPS = {
    "limits of joints": ([vp.WithinJointLimits(ROBOT, ([0.5, -1], [2.0, 1]))], LIMITS),
    "limits of velocities": (
        [vp.WithinVelocityLimits(ROBOT, (-0.5, 0.5))],
        {"v0": [3.0, 1.0], "control_limits": (-20.0, 20.0)},
    ),
    "a box": ([vp.KeepInBox(ROBOT, "tip", [-3.0, -1.0, 0.3], [3.0, 1.0, 3.0])], LIMITS),
    "linear controls": ([vp.WithinJointLimits(ROBOT, ([0.5, -1], [2.0, 1]))], {"controls": "linear", **LIMITS}),
    "positions a step later": (
        [vp.WithinJointLimits(ROBOT, ([0.5, -1], [2.0, 1]))],
        {"integrator": vp.ExplicitEuler()},
    ),
    "one joint free": (
        [vp.WithinJointLimits(ROBOT, ([0.5, -1], [2.0, 1]))],
        {"control_limits": ([-30.0, -np.inf], [30.0, np.inf])},
    ),
}


@pytest.mark.parametrize("name", FIRST_STEPS)
def test_first_node_beside_grids_of_controls(name):
    """The violation that stays is that of one step under the best controls of grids, all corners included."""
    constraints, options = FIRST_STEPS[name]
    problem = problem_of(constraints, **options)
    plan = vp.solve(problem, check=False)
    if name == "one joint free":
        # The elbow's torque, without a limit, moves the shoulder, too.
        assert not about(plan.reason, "unmet first node")
        return
    assert about(plan.reason, "unmet first node")
    ends = 2 if problem.linear else 1
    low, high = problem.control_limits if "control_limits" in options else (np.full(2, -30.0), np.full(2, 30.0))
    low, high = np.tile(low, ends), np.tile(high, ends)
    best, least, wide = 0.5 * (low + high), np.inf, 0.5 * (high - low)
    for _ in range(4):
        # Around the best controls so far, on a grid that gets finer.
        around = np.clip(best + np.linspace(-wide, wide, 7), low, high)
        sides = [np.unique(side) for side in around.T]
        for u in itertools.product(*sides):
            now = after_one_step(problem, np.reshape(u, (ends, 2)), constraints[0])
            if now < least:
                least, best = now, np.array(u)
        wide = 0.3 * wide
    # The reason has three digits.
    assert abs(said(plan.reason) - least) <= 0.01 * least


def after_one_step(problem, controls, constraint):
    """The largest violation of a constraint after one step, in its own unit."""
    motion = vp.simulate(
        problem.scene, problem.q0, problem.v0, dt=problem.dt, steps=1,
        controls=vp.FirstOrderHold(controls) if problem.linear else controls,
        integrator=problem.integrator, check=False,
    )  # fmt: skip
    return excess(constraint, motion.q[1], motion.v[1])


def excess(constraint, q, v):
    """The largest violation of a constraint, in its own terms."""
    if isinstance(constraint, vp.KeepInBox):
        y, (low, high) = ROBOT.frame_positions(q, "tip"), constraint.limits
    else:
        y, (low, high) = (v if isinstance(constraint, vp.WithinVelocityLimits) else q), constraint.limits
    return max((y - high).max(), (low - y).max())


def test_two_constraints_that_the_first_node_cannot_meet_together():
    """Each can be met alone, and the reason has both."""
    joints, speeds = vp.WithinJointLimits(ROBOT, ([0.02, -1], [2.0, 1])), vp.WithinVelocityLimits(ROBOT, (-0.3, 0.3))
    strong = {"control_limits": (-300.0, 300.0)}
    for alone in (joints, speeds):
        assert not about(vp.solve(problem_of([alone], **strong), check=False).reason, "unmet first node")
    plan = vp.solve(problem_of([joints, speeds], **strong), check=False)
    assert plan.status is vp.Status.INFEASIBLE
    assert len(plan.history) <= 6
    assert about(plan.reason, "unmet first node")
    assert "WithinJointLimits and WithinVelocityLimits" in plan.reason
