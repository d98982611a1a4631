"""Plans within hard constraints whose controls are linear between nodes."""

import numpy as np
from scipy.optimize import minimize

import varpin as vp

N = 8
ROBOT = vp.planar_chain(2)
BEFORE = [12.0, 3.0]
CASES = {
    "speeds": [vp.WithinVelocityLimits(ROBOT, (-0.9, 0.9))],
    "goal": [vp.ReachFrame(ROBOT, "tip", position=[1.2, 0.0, -0.9])],
    "slopes": [vp.WithinControlRate([15.0, 5.0])],
    "given begin": [
        vp.WithinControlRate([150.0, np.inf], before=BEFORE),
        vp.WithinJointLimits(ROBOT, ([-1.0, -0.35], [1.0, 1.0])),
    ],
}


def links(name: str, **options: object) -> vp.OptimalControlProblem:
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(0.1) + vp.ControlRateCost(1e-4)
    cost += vp.Terminal(vp.TrackingCost([0.6, -0.4], 1e2) + vp.VelocityCost(1e1))
    given = {"dt": 0.1, "steps": N, "controls": "linear", "constraints": CASES[name]} | options
    return vp.OptimalControlProblem(vp.Scene(ROBOT, damping=0.1), cost, [0.1, 0.2], [0.0, 0.0], **given)


def moved(problem: vp.OptimalControlProblem, u: np.ndarray) -> vp.Trajectory:
    """The motion under controls (N + 1, m) at the nodes, without feedback."""
    return problem.simulate(vp.LinearPolicy(u[1:], np.zeros((N, 2, 4)), np.zeros((N, 4)), before=u[0], linear=True))


def test_slopes_are_those_of_the_lines():
    problem = links("slopes")
    plan = vp.solve(problem, check=False)
    (report,) = plan.constraints
    slopes = np.diff(plan.controls, axis=0) / problem.dt
    np.testing.assert_allclose(report.values, np.hstack([slopes - [15.0, 5.0], -slopes - [15.0, 5.0]]), atol=1e-9)
    assert report.active.any()
    np.testing.assert_allclose(report.t, problem.dt * np.arange(1, N + 1), atol=1e-12)
    told = plan.verify()
    assert told.constraints[0].open_loop <= 1e-6


def test_torques_of_a_loop_with_a_limit_of_the_rate_do_not_jump():
    """From tick to tick the lines join, and the plant's torque changes no faster than allowed, noise or not."""
    scene = vp.Scene(ROBOT, damping=0.1)
    hold = scene.holding_torque([0.1, 0.2])
    cost = vp.TrackingCost([0.4, 0.0], 1e2) + vp.VelocityCost(1.0) + vp.ControlCost(1e-3)
    within = [vp.WithinControlRate(40.0, before=hold)]
    problem = vp.OptimalControlProblem(
        scene, cost, [0.1, 0.2], [0, 0], dt=0.04, steps=12, controls="linear", constraints=within
    )
    plant = vp.Plant(vp.Scene(ROBOT, damping=0.2, noise=vp.AdditiveNoise(0.02)), vp.Midpoint(), substeps=4)
    run = vp.Mpc(problem, iterations=3).run(plant, duration=0.6, rng=0)
    steps = np.abs(np.diff(run.motion.u, axis=0)) / run.motion.dt
    assert steps.max() > 39.0
    # Plans of three iterations violate the limit a little; what is applied does not.
    assert steps.max() <= 40.0 * (1.0 + 1e-9)
    assert run.constraints[0].violation <= 1e-9
    ends = np.array([plan.controls[:2] for plan in run.plans])
    np.testing.assert_allclose(ends[0, 0], hold, atol=1e-12)
    np.testing.assert_allclose(ends[1:, 0], ends[:-1, 1], atol=1e-4)


def reach(robot, limit, scene=None, begin=None, goal=None, **options):
    n = robot.dof
    begin, goal = np.zeros(n) if begin is None else begin, np.linspace(0.6, -0.6, n) if goal is None else goal
    cost = vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost(goal, 1e2) + vp.VelocityCost(1.0))
    given = {"dt": 0.05, "steps": 20, "controls": "linear"} | options
    within = [vp.WithinVelocityLimits(robot, (-limit, limit))]
    return vp.OptimalControlProblem(
        scene or vp.Scene(robot, damping=0.1), cost, begin, np.zeros(n), constraints=within, **given
    )


def fastest(problem, u, parts):
    """The largest speed along the motion under lines through u (N + 1, m), in steps of classical Runge-Kutta."""
    lines = vp.FirstOrderHold(u).refined(parts)
    h, steps = problem.dt / parts, problem.steps * parts
    given = {"dt": h, "steps": steps, "controls": lines, "integrator": vp.RungeKutta4(), "check": False}
    return np.abs(vp.simulate(problem.scene, problem.q0, problem.v0, **given).v)


def test_scipy_finds_no_less_within_speeds_between_nodes():
    """SLSQP with the limits at 16 instants of each step."""
    problem = reach(vp.planar_chain(2), 0.6, dt=0.125, steps=N)
    plan = vp.solve(problem, check=False)
    assert plan.status.converged, plan.reason
    assert len(plan.constraints[0].t) > N
    rules = [{"type": "ineq", "fun": lambda x: 0.6 - fastest(problem, x.reshape(-1, 2), 16)[1:].ravel()}]
    best = minimize(
        lambda x: problem.cost_of(moved(problem, x.reshape(-1, 2))), plan.controls.ravel(), method="SLSQP",
        constraints=rules, options={"maxiter": 50, "ftol": 1e-10},
    )  # fmt: skip
    assert abs(best.fun - plan.cost) <= 1e-3 * plan.cost
