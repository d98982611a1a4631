"""A controller within constraints whose controls are linear between nodes: stable loops, and rows within steps."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import naming, refused, unnamed

import varpin as vp
from varpin.control import mpc

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


def test_plans_of_ticks_are_saved_with_their_rows(tmp_path):
    run = vp.Mpc(chain("linear")).run(duration=0.15)
    plan = run.plans[-1]
    saved = vp.Solution.load(plan.save(tmp_path / "plan.npz"), plan.problem)
    assert saved.violation == plan.violation
    assert len(saved.constraints[0].t) == 2 * 16
    np.testing.assert_array_equal(saved.multipliers.values, plan.multipliers.values)
    kept = dict(np.load(tmp_path / "plan.npz", allow_pickle=False))
    kept["multipliers.values"] = kept["multipliers.values"][:-1]
    np.savez(tmp_path / "short.npz", **kept)
    with refused(vp.FileError, "multipliers.backoff"):
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
