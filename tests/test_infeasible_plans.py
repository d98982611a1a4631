"""Plans that no motion within the constraints makes: each says so, with the constraint, within bounded iterations."""

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


@pytest.mark.parametrize("name", TASKS)
def test_no_plan(name):
    constraints, options, labels = TASKS[name]
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0) + vp.VelocityCost(10.0))
    options = {"q0": [0.0, 0.0], "v0": [0.0, 0.0], "dt": 0.05, "steps": 20, **options}
    problem = vp.OptimalControlProblem(vp.Scene(ROBOT, damping=0.1), cost, constraints=constraints, **options)
    plan = vp.solve(problem, check=False)
    assert plan.status is vp.Status.INFEASIBLE
    assert len(plan.history) <= 250
    assert plan.reason.split("(")[0].split()[0] in labels
    assert about(plan.reason, "unmet constraint")
    # It is the one that is violated most.
    worst = max(plan.constraints, key=lambda item: item.violation)
    assert plan.reason.startswith(worst.label)
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
