"""A controller within constraints whose controls are linear between nodes: stable loops, and rows within steps."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from refusals import naming, refused, unnamed

import varpin as vp
from varpin.control import box, mpc, piecewise
from varpin.control.active_rows import Rows
from varpin.control.along import Along
from varpin.control.backward import backward
from varpin.control.between_nodes import enforced, middles
from varpin.control.penalties import penalized

CHAIN = vp.planar_chain(2)
LINKS = ["forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link"]


def beside_a_ball(controls):
    """The tool of a UR3 follows a target, and a ball comes at 0.25 m/s."""
    robot, begin = vp.load_robot("ur3"), np.array([0.0, -1.2, 1.2, -0.5, -1.0, 0.0])
    scene = vp.Scene(robot, damping=0.1)
    tool = robot.frame_positions(begin, "tool0")
    limits = (-robot.effort_limit, robot.effort_limit)

    def target(t):
        return tool + np.array([0.0, 0.15 * np.sin(2.0 * t), 0.05 * np.sin(3.0 * t)])

    cost = vp.FramePositionCost(robot, "tool0", target, 1e3) + vp.VelocityCost(0.05)
    cost += vp.ControlCost(1e-4, scene.holding_torque(begin))
    ball = vp.Obstacle.sphere(tool + np.array([0.0, 0.25, 0.05]), 0.05, name="ball")
    ball = ball.moving(lambda t: [0.0, -0.25 * t, 0.0])
    return vp.OptimalControlProblem(
        scene, cost, begin, np.zeros(6), dt=0.04, steps=12, control_limits=limits, controls=controls,
        constraints=[vp.KeepClear(robot, [ball], 0.02, links=LINKS)],
    )  # fmt: skip


def within_speeds(controls):
    """The flange of a UR5 follows a target faster than its joints may move."""
    robot, begin = vp.load_robot("ur5"), np.array([0.37, -1.38, 1.37, -1.16, -1.45, 0.0])
    scene, limits = vp.Scene(robot, damping=0.05), (-robot.effort_limit, robot.effort_limit)
    cost = vp.FramePositionCost(robot, "tool0", lambda t: [0.45 + 0.1 * np.sin(2.0 * t), 0.3, 0.4], 1e3)
    cost += vp.VelocityCost(0.05) + vp.ControlCost(1e-4, scene.holding_torque(begin))
    return vp.OptimalControlProblem(
        scene, cost, begin, np.zeros(6), dt=0.04, steps=12, control_limits=limits, controls=controls,
        constraints=[vp.WithinVelocityLimits(robot, (-0.25, 0.25))],
    )  # fmt: skip


def chain(controls, constraints=None, **options):
    """Two links without limits of torques."""
    cost = vp.TrackingCost(lambda t: [0.8 * np.sin(1.5 * t), 0.4], 100.0) + vp.ControlCost(1e-4)
    cost += vp.VelocityCost(1e-2)
    constraints = [vp.WithinVelocityLimits(CHAIN, (-0.8, 0.8))] if constraints is None else constraints
    given = {"dt": 0.03, "steps": 16, "controls": controls, "constraints": constraints} | options
    return vp.OptimalControlProblem(vp.Scene(CHAIN, damping=0.3), cost, [0.0, 0.4], [0.0, 0.0], **given)


@pytest.mark.parametrize("iterations", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("build", "duration", "most"),
    [
        pytest.param(beside_a_ball, 1.6, 2e-3, marks=pytest.mark.slow),
        (within_speeds, 0.8, 1e-2),
        (chain, 1.5, 1e-2),
    ],
)
def test_loops_of_linear_controls_do_not_run_away(build, duration, most, iterations):
    """Speeds of plans and of the plant, and its violations."""
    fastest, costs = {}, {}
    for controls in ("held", "linear"):
        run = vp.Mpc(build(controls), iterations=iterations).run(duration=duration)
        plans = max(np.abs(plan.trajectory.v).max() for plan in run.plans)
        fastest[controls] = max(plans, np.abs(run.motion.v).max())
        costs[controls] = np.mean([plan.cost for plan in run.plans])
        assert run.constraints[0].worst <= most
        assert not naming(run.warnings, "loop is unstable")
        assert max(item.rollouts for plan in run.plans[1:] for item in plan.history) <= 8
    # Beside the ball, with one iteration a tick, 1.2 and 1.28.
    assert fastest["linear"] <= 1.4 * fastest["held"]
    assert costs["linear"] <= 1.4 * costs["held"]


def test_penalties_of_ticks_are_not_stiffer_than_one_iteration_can_follow():
    """With those that the first plan ended with, 10,000 times as heavy as at first, it moved at 26 rad/s."""
    robot, begin = vp.load_robot("ur3"), np.array([0.0, -1.2, 1.2, -0.5, -1.0, 0.0])
    scene = vp.Scene(robot, damping=0.1)
    cost = vp.TrackingCost(lambda t: begin + 0.35 * np.sin(2.0 * t) * np.cos(np.arange(6)), 100.0)
    cost += vp.VelocityCost(0.05) + vp.ControlCost(1e-4, scene.holding_torque(begin))
    given = {"dt": 0.05, "steps": 12, "constraints": [vp.WithinJointLimits(robot, (begin - 0.15, begin + 0.15))]}
    held, linear = (
        vp.Mpc(vp.OptimalControlProblem(scene, cost, begin, np.zeros(6), controls=controls, **given), iterations=1)
        .run(duration=1.5)
        for controls in ("held", "linear")
    )  # fmt: skip
    assert linear.constraints[0].worst <= 1e-3
    assert np.abs(linear.motion.v).max() <= 1.2 * np.abs(held.motion.v).max()
    costs = [np.mean([plan.cost for plan in run.plans]) for run in (held, linear)]
    assert costs[1] == pytest.approx(costs[0], rel=1e-2)


@pytest.mark.slow
def test_multipliers_do_not_wind_up_after_short_steps():
    """From this start they did, up to 3e4, and the arm moved at 17 rad/s."""
    problem = beside_a_ball("linear")
    start = problem.q0 + 1e-3 * np.random.default_rng(2).normal(size=6)
    run = vp.Mpc(problem.at(q0=start), iterations=1).run(duration=1.2)
    assert np.abs(run.motion.v).max() < 8.0
    short = 0
    for before, plan in pairwise(run.plans[1:]):
        if plan.history[-1].step < 0.5:
            short += 1
            known, old = plan.multipliers, before.multipliers
            np.testing.assert_array_equal(np.unique(known.values), np.unique(known.begun))
            np.testing.assert_array_equal(known.weights, np.maximum(old.weights, known.first_weights))
    assert short > 3


def test_rows_on_cubics_are_those_of_the_motion():
    """Beside rows of steps integrated in eighths, whose distance falls with the fourth power of the step."""
    ball = vp.KeepOutOfSphere(CHAIN, "tip", [1.9, 0.0, -1.35], 0.3)
    errors = []
    for dt in (0.04, 0.02):
        problem = chain("linear", [ball], dt=dt, steps=4)
        u = np.arange(5)[:, None] * dt * np.array([100.0, -60.0])
        policy = vp.LinearPolicy(u[1:], np.zeros((4, 2, 4)), np.zeros((4, 4)), before=u[0], linear=True)
        motion = problem.simulate(policy)
        found = [
            enforced(problem, replace(middles(problem), cubic=cubic)).bound_constraints[1].value(motion.q, motion.v, u)
            for cubic in (True, False)
        ]
        errors.append(np.abs(found[0] - found[1]).max())
    assert 0.0 < errors[1] < errors[0] / 12.0


def test_slopes_of_rows_on_cubics():
    """The predicted rows, and the slope of the augmented cost, beside differences along the step of a plan."""
    center = CHAIN.frame_positions([0.0, 0.4], "tip") + np.array([0.1, 0.0, 0.1])
    constraints = [vp.WithinVelocityLimits(CHAIN, (-0.1, 0.1)), vp.KeepOutOfSphere(CHAIN, "tip", center, 0.3)]
    problem = chain("linear", constraints, steps=6)
    whole = enforced(problem, middles(problem))
    zeros = [np.zeros(item.shape) for item in whole.bound_constraints]
    goal = penalized(whole, zeros, np.full(len(zeros), 100.0), zeros)
    u = problem.holding_policy().u[0] + np.random.default_rng(1).normal(size=(7, 2)) * [20.0, 5.0]
    gains, reference = np.zeros((6, 2, 4)), np.zeros((6, 4))

    def moved(u):
        return problem.simulate(vp.LinearPolicy(u[1:], gains, reference, before=u[0], linear=True))

    motion = moved(u)
    along = Along(goal, motion)
    plan = backward(goal, motion, 0.0, along=along)
    rows = Rows(along, goal)
    ahead = rows.ahead(along, plan)
    _, moves = rows.ahead_of
    assert rows.begun[2].any()
    assert rows.begun[3].any()
    size = 1e-5
    near = [moved(u + sign * size * moves) for sign in (1.0, -1.0)]
    for item, before, after in zip(rows.penalties, rows.signed, ahead, strict=True):
        plus, minus = (item.signed(item.bound.value(x.q, x.v, x.u_nodes)) for x in near)
        np.testing.assert_allclose((plus - minus) / (2.0 * size), after - before, rtol=1e-5, atol=1e-6)
    plus, minus = (goal.shares(x).sum() for x in near)
    slope = (plus - minus) / (2.0 * size)
    gradient = float((along_gradient(goal, motion) * moves).sum())
    assert slope == pytest.approx(gradient, rel=1e-5)


def along_gradient(goal, motion):
    """The gradient of the augmented cost in the controls (R, m), from the model's steps one after another."""
    line = Along(goal, motion).line
    x, found = line.A.shape[1], np.zeros((goal.decisions, goal.scene.controls))
    costate = np.zeros(x)
    for j in reversed(range(len(line.A))):
        found[j] = goal.dt * line.gradient[j, x:] + line.B[j].T @ costate
        costate = goal.dt * line.gradient[j, :x] + line.A[j].T @ costate
    return found


def test_the_interior_point_method_ends_with_the_time(monkeypatch):
    """Limits of torques so narrow that they are met, and active sets that lead nowhere."""
    problem = chain("linear", control_limits=(-12.0, 12.0), steps=6)
    whole = enforced(problem, middles(problem))
    zeros = [np.zeros(item.shape) for item in whole.bound_constraints]
    motion, one_pass, made = problem.simulate(problem.holding_policy()), box.single_pass, []

    def counted(*args, **options):
        made.append(None)
        return one_pass(*args, **options)

    monkeypatch.setattr(box, "single_pass", counted)
    monkeypatch.setattr(box.Box, "_active_sets", lambda *_: None)
    passes = []
    for until in (0.0, np.inf):
        made.clear()
        goal = penalized(whole, zeros, np.full(len(zeros), 100.0), zeros, passes=1, until=until)
        plan = backward(goal, motion, 0.0)
        assert plan.expected_decrease > 0.0
        passes.append(len(made))
    assert passes[0] <= 4
    assert passes[1] > 10


def test_plans_of_ticks_are_saved_with_their_rows(tmp_path):
    run = vp.Mpc(chain("linear")).run(duration=0.15)
    plan = run.plans[-1]
    saved = vp.Solution.load(plan.save(tmp_path / "plan.npz"), plan.problem)
    assert saved.violation == plan.violation
    assert len(saved.constraints[0].t) == 2 * 16
    np.testing.assert_array_equal(saved.multipliers.values, plan.multipliers.values)
    np.testing.assert_array_equal(saved.multipliers.active, plan.multipliers.active)
    kept = dict(np.load(tmp_path / "plan.npz", allow_pickle=False))
    kept["multipliers.active"] = kept["multipliers.active"][:-1]
    np.savez(tmp_path / "short.npz", **kept)
    with refused(vp.FileError, "multipliers.active", "shape"):
        vp.Solution.load(tmp_path / "short.npz", plan.problem)


def test_ticks_within_speeds_are_close_to_their_optimum():
    """Of a UR3 most of whose joints are at their limits all the time, with one iteration a tick and with three."""
    robot, begin = vp.load_robot("ur3"), np.array([0.0, -1.2, 1.2, -0.5, -1.0, 0.0])
    scene = vp.Scene(robot, damping=0.1)
    cost = vp.TrackingCost(lambda t: begin + 0.35 * np.sin(2.0 * t) * np.cos(np.arange(6)), 100.0)
    cost += vp.VelocityCost(0.05) + vp.ControlCost(1e-4, scene.holding_torque(begin))
    problem = vp.OptimalControlProblem(
        scene, cost, begin, np.zeros(6), dt=0.02, steps=25, constraints=[vp.WithinVelocityLimits(robot, (-0.3, 0.3))]
    )
    one, three = (vp.Mpc(problem, iterations=count).run(duration=0.6) for count in (1, 3))
    costs = [np.mean([plan.cost for plan in run.plans]) for run in (one, three)]
    assert costs[0] <= 1.05 * costs[1]
    assert one.constraints[0].worst <= 3e-3


def test_loops_that_blow_up_are_called_unstable():
    """Plans that foresee far more than the first one, or a motion that does."""
    run = vp.Mpc(chain("linear"), iterations=1).run(duration=0.15)
    assert not mpc._blown_up(run.plans, run.motion)
    wild = run.plans[3]
    motion = replace(wild.trajectory, v=wild.trajectory.v * [1.0, 1e3])
    (found,) = mpc._blown_up([*run.plans[:3], replace(wild, trajectory=motion)], run.motion)
    assert found.joint == "joint2"
    assert not unnamed(found, "unstable", "joint2", "rad/s", "t = 0.09 s", "more iterations")
    fast = replace(run.motion, v=run.motion.v * [1e3, 1.0])
    (found,) = mpc._blown_up(run.plans, fast)
    assert not unnamed(found, "joint1", f"{1e3 * np.abs(run.motion.v[:, 0]).max():.3g} rad/s")


@pytest.mark.parametrize("controls", ["held", "linear"])
@pytest.mark.parametrize("first", [0, 1])
def test_ticks_know_the_rows_of_the_tick_before(controls, first, monkeypatch):
    """Whatever the order of the constraints; passes have the rows of control rates last."""
    wrong, run_of = [], piecewise._Steps.run

    def watched(steps, likely):
        run_of(steps, likely)
        if likely is not None:
            expected = zip(steps.rows.from_order(likely), steps.met, strict=True)
            wrong.append(sum(int((one != other).sum()) for one, other in expected))

    both = [vp.WithinControlRate([150.0, np.inf]), vp.WithinVelocityLimits(CHAIN, (-0.8, 0.8))]
    mpc = vp.Mpc(chain(controls, both[::-1] if first else both), iterations=1)
    first_plan = mpc.run(duration=0.09).plans[0]
    assert first_plan.status.converged
    monkeypatch.setattr(piecewise._Steps, "run", watched)
    plan = first_plan
    for tick in range(1, 13):
        wrong.clear()
        at = plan.trajectory
        plan = mpc.plan(0.03 * tick, at.q[1], at.v[1], plan)
    assert plan.multipliers.active.sum() > 10
    assert sum(wrong) <= 4
