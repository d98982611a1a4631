"""A controller within hard constraints: its ticks against plans from scratch, obstacles that move, what is told."""

import numpy as np
import pytest
from refusals import naming, refused, unnamed

import varpin as vp

ROBOT = vp.planar_chain(2)
ARM = {"joint1": ([0, 0, 0], [1, 0, 0], 0.05), "joint2": ([0, 0, 0], [1, 0, 0], 0.05)}


def target(t):
    return [0.8 * np.sin(1.5 * t), 0.4]


def bob(t):
    """Where a ball is that swings into the tool's way [m]."""
    return [1.9 - 0.3 * np.sin(2.0 * t), 0.0, -1.35]


def tracking(constraints, **options):
    cost = vp.TrackingCost(target, 100.0) + vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    return vp.OptimalControlProblem(
        vp.Scene(ROBOT, damping=0.3),
        cost,
        [0.0, 0.4],
        [0.0, 0.0],
        dt=0.03,
        steps=16,
        constraints=constraints,
        **options,
    )


FAMILIES = {
    "speeds": [vp.WithinVelocityLimits(ROBOT, (-0.8, 0.8))],
    "a moving sphere": [vp.KeepOutOfSphere(ROBOT, "tip", bob, 0.3)],
    "a moving ball": [
        vp.KeepClear(ROBOT, [vp.Obstacle.sphere(bob(0), 0.2).moving(lambda t: bob(t) - np.array(bob(0)))], 0.02,
                     capsules=ARM),
    ],
    "rates": [vp.WithinControlRate(100.0)],
}  # fmt: skip


def test_obstacles_are_where_they_are_at_each_time():
    """Bounds of an obstacle and a sphere that move are those of ones that stand there, at every node."""
    problem = tracking([*FAMILIES["a moving sphere"], *FAMILIES["a moving ball"]], t0=0.4)
    rng = np.random.default_rng(0)
    q = rng.normal(size=(17, 2))
    sphere, ball = (bound.value(q, q, q[1:]) for bound in problem.bound_constraints)
    slopes = [bound.jacobian(q, q) for bound in problem.bound_constraints]
    for k, t in enumerate(0.4 + 0.03 * np.arange(1, 17)):
        still = [
            vp.KeepOutOfSphere(ROBOT, "tip", bob(t), 0.3),
            vp.KeepClear(ROBOT, [vp.Obstacle.sphere(bob(t), 0.2)], 0.02, capsules=ARM),
        ]
        for moving, there, slope in zip((sphere, ball), tracking(still).bound_constraints, slopes, strict=True):
            np.testing.assert_allclose(moving[k], there.value(q, q, q[1:])[k], rtol=0, atol=1e-12)
            np.testing.assert_allclose(slope[k], there.jacobian(q, q)[k], rtol=0, atol=1e-12)
    # Several motions at once, as a line search has them.
    both = problem.bound_constraints[1].value(np.array([q, -q]), np.array([q, q]), np.zeros((2, 16, 2)))
    np.testing.assert_array_equal(both[0], ball)


def test_ways_of_obstacles_are_checked():
    ball = vp.Obstacle.sphere([1.0, 0.0, 0.0], 0.1, name="ball")
    with refused(vp.InputError, "function"):
        ball.moving([0.0, 0.0, 1.0])
    moving = ball.moving(lambda t: [0.0, 0.0])
    with refused(vp.InputError, "moves already"):
        moving.moving(lambda t: [0.0, 0.0, 0.0])
    with refused(vp.InputError, "'ball'", "0.03"):
        tracking([vp.KeepClear(ROBOT, [moving], capsules=ARM)])
    with refused(vp.InputError, "center", "finite"):
        tracking([vp.KeepOutOfSphere(ROBOT, "tip", lambda t: [np.nan, 0.0, 0.0], 0.1)])


def test_ticks_that_find_no_plan_are_told_of():
    """A goal that no horizon reaches: multipliers stay bounded, and the goal is kept again once it can be."""
    far = vp.Mpc(tracking([vp.ReachFrame(ROBOT, "tip", position=[2.2, 0.0, 0.0])])).run(duration=0.3)
    assert far.infeasible.sum() > 3
    assert naming(far.warnings, "no plan", "ReachFrame('tip')")
    # One iteration leaves a little of a violation that has a plan.
    assert not vp.Mpc(tracking(FAMILIES["speeds"]), iterations=1).run(duration=0.6).infeasible.any()
    assert not unnamed(str(far), "ReachFrame('tip')")
    assert np.isfinite(far.plans[-1].multipliers.values).all()


def test_what_the_plant_violates_is_told_of():
    """A plant that is pushed harder than the model knows."""
    noisy = vp.Plant(vp.Scene(ROBOT, damping=0.3, noise=vp.AdditiveNoise(0.1)))
    run = vp.Mpc(tracking(FAMILIES["speeds"])).run(noisy, duration=0.6, rng=1)
    assert 0.05 < run.constraints[0].violation < 0.4
    assert naming(run.warnings, "motion violates", "WithinVelocityLimits", "margin=", "narrower")


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


def chain(controls):
    """Two links without limits of torques."""
    return tracking(FAMILIES["speeds"], controls=controls)


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
        assert run.constraints[0].violation <= most
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
    assert one.constraints[0].violation <= 3e-3


def test_between_nodes_ticks_keep_to_the_middles_of_long_steps():
    """Held controls, whose plans keep to the sphere at the nodes alone without it."""
    sphere, found = vp.KeepOutOfSphere(ROBOT, "tip", [1.6, 0.0, -1.2], 0.25), {}
    for between in (False, True):
        problem = tracking([sphere], between_nodes=between).at(dt=0.06, steps=8)
        found[between] = vp.Mpc(problem).run(duration=1.2).constraints[0].violation
    assert found[False] > 1e-3
    assert found[True] < 1e-4
