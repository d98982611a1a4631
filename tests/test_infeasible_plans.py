"""Plans that no motion within the constraints makes: each says so, with the constraint, within bounded iterations."""

import itertools
import re

import numpy as np
import pytest
from findings import about

import varpin as vp

ROBOT = vp.planar_chain(2)
ARM = {name: ([0, 0, 0], [1, 0, 0], 0.05) for name in ("joint1", "joint2")}
LIMITS = {"control_limits": (-30.0, 30.0)}


def reach(position):
    return vp.ReachFrame(ROBOT, "tip", position=position)


def clear(place, radius):
    return vp.KeepClear(ROBOT, [vp.Obstacle.sphere(place, radius)], 0.02, capsules=ARM)


def side(up, offset):
    return vp.KeepInHalfSpace(ROBOT, "tip", [0, 0, up], offset)


# The constraints, other options, and of which constraints one cannot be met.
TASKS = {
    "a goal out of reach": ([reach([2.5, 0.0, 0.0])], {}, ["ReachFrame"]),
    "a goal off the plane that the arm moves in": ([reach([1.0, 0.5, -0.5])], {}, ["ReachFrame"]),
    "two goals": ([reach([1.5, 0.0, -0.5]), reach([1.0, 0.0, 0.9])], {}, ["ReachFrame"]),
    "a start in an obstacle": ([clear([1.5, 0.0, 0.0], 0.3)], LIMITS, ["KeepClear"]),
    "an obstacle at the base": ([clear([0.0, 0.0, 0.0], 0.2)], {}, ["KeepClear"]),
    "a goal too far for the speed": (
        [vp.WithinVelocityLimits(ROBOT, (-0.3, 0.3)), reach([1.0, 0.0, -1.2])],
        {},
        ["ReachFrame", "WithinVelocityLimits"],
    ),
    "half-spaces that exclude each other": ([side(1, 0.5), side(-1, 0.5)], {}, ["KeepInHalfSpace"]),
    "a start too fast to brake": (
        [vp.WithinVelocityLimits(ROBOT, (-0.5, 0.5))],
        {"v0": [3.0, 0.0], "control_limits": (-20.0, 20.0)},
        ["WithinVelocityLimits"],
    ),
    "torques that do not carry the arm": (
        [vp.WithinJointLimits(ROBOT, (-0.2, 0.2))],
        {"control_limits": (-5.0, 5.0)},
        ["WithinJointLimits"],
    ),
    "a box inside a sphere": (
        [
            vp.KeepInBox(ROBOT, "tip", [1.0, -1.0, -0.2], [2.2, 1.0, 0.2]),
            vp.KeepOutOfSphere(ROBOT, "tip", [1.6, 0.0, 0.0], 1.0),
        ],
        {},
        ["KeepInBox", "KeepOutOfSphere"],
    ),
    "torques that rise too slowly": (
        [vp.WithinControlRate(5.0, before=[0.0, 0.0]), vp.WithinVelocityLimits(ROBOT, (-0.3, 0.3))],
        {},
        ["WithinControlRate", "WithinVelocityLimits"],
    ),
    "a start outside of limits": ([vp.WithinJointLimits(ROBOT, ([0.5, -1], [2.0, 1]))], LIMITS, ["WithinJointLimits"]),
    "a sphere that the tip starts far from": (
        [vp.KeepInSphere(ROBOT, "tip", [0.0, 0.0, 0.0], 1.0)],
        LIMITS,
        ["KeepInSphere"],
    ),
}
# Those of them that the first node after the start cannot meet.
AT_ONCE = (
    "a start in an obstacle",
    "an obstacle at the base",
    "a start too fast to brake",
    "torques that rise too slowly",
    "a start outside of limits",
    "a sphere that the tip starts far from",
)


def problem_of(constraints, **options):
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0) + vp.VelocityCost(10.0))
    options = {"q0": [0.0, 0.0], "v0": [0.0, 0.0], "dt": 0.05, "steps": 20, **options}
    return vp.OptimalControlProblem(vp.Scene(ROBOT, damping=0.1), cost, constraints=constraints, **options)


@pytest.mark.parametrize("name", TASKS)
def test_no_plan(name):
    constraints, options, labels = TASKS[name]
    plan = vp.solve(problem_of(constraints, **options), check=False)
    assert plan.status is vp.Status.INFEASIBLE
    assert len(plan.history) <= 250
    assert plan.reason.split("(")[0].split()[0] in labels
    assert about(plan.reason, "unmet constraint")
    worst = max(plan.constraints, key=lambda item: item.violation)
    # It is the one that is violated most, if not the one that the first node cannot meet.
    assert plan.reason.startswith(worst.label) or about(plan.reason, "unmet first node")
    assert worst.violation > 1e-3
    assert np.isfinite(plan.trajectory.q).all()


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


@pytest.mark.parametrize("name", AT_ONCE)
def test_no_plan_at_once(name):
    """Where no control meets a constraint at the first node, its reason says so, and there is no long search."""
    constraints, options, _ = TASKS[name]
    plan = vp.solve(problem_of(constraints, **options), check=False)
    assert len(plan.history) <= 6
    assert about(plan.reason, "unmet first node")
    # The constraint does stay violated there, by no less than said, unless rates of controls are.
    told = {item.label: item for item in plan.constraints}
    if "WithinControlRate" not in told:
        worst = next(item for label, item in told.items() if plan.reason.startswith(label))
        assert 0.0 < said(plan.reason) <= worst.excess[0].max() * (1.0 + 5e-3)
    for option in (None, 0, 1):
        few = {} if option is None else {"max_iterations": option}
        assert vp.solve(plan.problem, check=False, **few).status is vp.Status.INFEASIBLE
    again = vp.solve(plan.problem, resume=plan, check=False)
    assert again.status is vp.Status.INFEASIBLE
    assert again.reason == plan.reason


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


def test_a_start_outside_that_one_step_can_mend():
    """A start outside is no reason to end early where controls lead inside by the first node."""
    for options in ({}, {"control_limits": (-2000.0, 2000.0)}):
        plan = vp.solve(problem_of([vp.WithinJointLimits(ROBOT, ([0.05, -1], [2.0, 1]))], **options), check=False)
        assert plan.status.converged
        assert plan.violation <= 1e-9


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


def test_of_two_constraints_of_one_kind_the_reason_says_which():
    robot = vp.planar_chain(2)
    wide, narrow = (vp.WithinJointLimits(robot, (-limit, limit)) for limit in (3.0, 0.1))
    cost = vp.ControlCost(1e-2) + vp.Terminal(vp.TrackingCost([0.5, 0.0], 10.0))
    problem = vp.OptimalControlProblem(
        vp.Scene(robot, damping=0.1), cost, [1.0, 0.0], [0.0, 0.0], dt=0.05, steps=8, constraints=[wide, narrow],
        control_limits=(-1.0, 1.0),
    )  # fmt: skip
    plan = vp.solve(problem, check=False)
    assert plan.status is vp.Status.INFEASIBLE
    assert "WithinJointLimits (constraints[1])" in plan.reason
    assert [report.label for report in plan.constraints] == [f"WithinJointLimits (constraints[{i}])" for i in (0, 1)]
