"""Plans within hard constraints whose controls are linear between nodes."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from findings import about
from scipy.optimize import lsq_linear, minimize

import varpin as vp
from varpin.control import augmented
from varpin.control.active_rows import Pushes
from varpin.control.between_nodes import NOWHERE, Instants, beyond, enforced, seen, updated
from varpin.control.box import Box
from varpin.control.closed_loop import ClosedLoop
from varpin.control.multipliers import at_nodes
from varpin.control.penalties import split
from varpin.control.polish import _Step, judged
from varpin.control.spread import Feedback, covariances
from varpin.control.trials import Trials
from varpin.errors import LinearizationError

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


def values(problem: vp.OptimalControlProblem, motion: vp.Trajectory) -> list[np.ndarray]:
    return [bound.value(motion.q, motion.v, motion.u_nodes) for bound in problem.bound_constraints]


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
    assert run.constraints[0].worst <= 1e-9
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


def test_karush_kuhn_tucker_with_rows_between_nodes():
    """The Lagrangian's slopes by differences, of the rows at nodes and of those that follow peaks."""
    problem = reach(vp.planar_chain(2), 0.6, dt=0.125, steps=N)
    plan = vp.solve(problem, check=False)
    known = plan.multipliers
    bound = enforced(problem, known.between).bound_constraints
    multipliers = split(bound, known.values)
    assert all((lam >= 0.0).all() for lam in multipliers)
    assert (multipliers[1] > 0.1).sum() > 5

    def parts(u):
        motion = moved(problem, u)
        pulls = (
            lam * item.value(motion.q, motion.v, motion.u_nodes) for lam, item in zip(multipliers, bound, strict=True)
        )
        return np.concatenate([problem.shares(motion), *(pull.ravel() for pull in pulls)])

    u, slopes, sizes = plan.controls, np.zeros(plan.controls.shape), np.zeros(plan.controls.shape)
    for i in np.ndindex(*u.shape):
        w = np.zeros(u.shape)
        w[i] = 1e-4
        change = (parts(u + w) - parts(u - w)) / 2e-4
        slopes[i], sizes[i] = change.sum(), np.abs(change).sum()
    assert np.abs(slopes).max() <= 1e-5 * sizes.max()


@pytest.mark.parametrize(
    ("limit", "dt", "steps"),
    [(0.3, 0.05, 20), (0.4, 0.05, 20), pytest.param(0.4, 0.1, 10, marks=pytest.mark.slow)],
)
def test_tight_speeds_end_at_an_optimum_without_a_peak_beyond(limit, dt, steps):
    """The last step of these leads to peaks of its own, or away from the optimum at first."""
    problem = reach(vp.planar_chain(2), limit, dt=dt, steps=steps)
    plan = vp.solve(problem, check=False)
    assert plan.status.converged, plan.reason
    values = seen(problem, plan.trajectory)
    assert beyond(values, [np.zeros(problem.bound_constraints[0].shape)]).max() <= 1e-6
    assert fastest(problem, plan.controls, 64).max() <= limit * (1.0 + 3e-4)


def test_margins_wider_than_a_tenth_of_the_range_hold_between_nodes():
    """Rows without a peak at an instant have no margin, which nothing could keep."""
    robot = vp.planar_chain(2)
    scene = vp.Scene(robot, damping=0.1, noise=vp.AdditiveNoise(0.02 * np.eye(2)))
    problem = reach(robot, 0.8, scene, dt=0.1, steps=10)
    within = [vp.WithinVelocityLimits(robot, (-0.8, 0.8), margin=2.0)]
    given = {"dt": 0.1, "steps": 10, "controls": "linear", "constraints": within}
    plan = vp.solve(vp.OptimalControlProblem(scene, problem.cost, problem.q0, problem.v0, **given), check=False)
    assert plan.status.converged, plan.reason
    assert plan.violation <= 1e-6
    assert len(plan.constraints[0].t) > 10
    assert plan.multipliers.backoff.max() > 0.1 * 1.6


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
    assert abs(best.fun - plan.cost) <= 1e-4 * plan.cost


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.RungeKutta4()], ids=repr)
@pytest.mark.parametrize("controls", ["held", "linear"])
def test_derivatives_of_rows_between_nodes(controls, integrator):
    """Beside central differences of the rows, which are those of a motion of the step in eighths, or on parabolas."""
    robot, rng = vp.planar_chain(2), np.random.default_rng(0)
    problem = reach(robot, 0.6, dt=0.1, steps=4, controls=controls, integrator=integrator)
    rows = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 3, 0]])
    moments = np.repeat([0.02, 0.5, 0.875, 0.4], 4)
    moments[-4:-2] = 0.97, -1.0
    bends = np.where((moments < 0.1) | (moments > 0.9), 0.5, 0.0)
    bound = enforced(problem, Instants(rows, moments, bends)).bound_constraints[1]
    shape = (5, 2), (5, 2), (5 if problem.linear else 4, 2)
    at, way = ([rng.normal(size=size) for size in shape] for _ in range(2))
    q, v, u = at
    lines = vp.FirstOrderHold(u[1:3]).refined(8) if problem.linear else np.tile(u[1], (8, 1))
    given = {"dt": 0.1 / 8, "steps": 8, "controls": lines, "integrator": integrator, "check": False}
    motion = vp.simulate(problem.scene, q[1], v[1], **given)
    speeds = np.abs(motion.v[[4, 7]])
    found = bound.value(*at)
    np.testing.assert_allclose(found[1:3].reshape(2, 2, 2).max(axis=1), speeds - 0.6, atol=1e-12)
    assert found[3, 1] == -bound.scale
    # Of a row at 0.4 steps, between the ends of the second, third and fourth part.
    given |= {"controls": vp.FirstOrderHold(u[3:5]).refined(8) if problem.linear else np.tile(u[3], (8, 1))}
    inside = vp.simulate(problem.scene, q[3], v[3], **given).v[2:5, 0]
    on_parabola = np.polyval(np.polyfit([2.0, 3.0, 4.0], inside, 2), 3.2)
    assert found[3, 2] == pytest.approx(-on_parabola - 0.6, abs=1e-10)
    after, before = (bound.value(*(x + size * dx for x, dx in zip(at, way, strict=True))) for size in (1e-5, -1e-5))
    slopes = bound.slopes(*at)
    dq, dv, du = way
    ends = [du[slopes.nodes], du[slopes.nodes + 1]] if problem.linear else [du[slopes.nodes]]
    moved = np.concatenate([dq[slopes.nodes], dv[slopes.nodes], *ends], axis=1)
    found = np.einsum("krz,kz->kr", slopes.in_step(), moved)
    np.testing.assert_allclose(found, (after - before) / 2e-5, rtol=1e-6, atol=1e-7)


def test_rows_follow_sliding_peaks():
    """Their values are the largest speeds in 64 parts of a step, at their motion and, as peaks slide, at others."""
    problem = reach(vp.planar_chain(2), 0.6, dt=0.125, steps=N, integrator=vp.RungeKutta4())
    free, way = reach(vp.planar_chain(2), 50.0, dt=0.125, steps=N), np.random.default_rng(0).normal(size=(N + 1, 2))
    u = vp.solve(free, check=False).controls + 8.0 * (-1.0) ** np.arange(N + 1)[:, None]

    def largest(u):
        """In each step and joint, and whether that is well within the step."""
        motion, found = moved(problem, u), []
        for k in range(N):
            lines = {"dt": 0.125 / 64, "steps": 64, "controls": vp.FirstOrderHold(u[k : k + 2]).refined(64)}
            options = {"integrator": vp.RungeKutta4(), "check": False}
            found.append(np.abs(vp.simulate(problem.scene, motion.q[k], motion.v[k], **lines, **options).v))
        places = np.argmax(found, axis=1)
        return np.max(found, axis=1), (places > 8) & (places < 56)

    motion = moved(problem, u)
    bound = problem.bound_constraints[0]
    instants = updated(problem, NOWHERE, seen(problem, motion), [np.full(bound.shape, 0.6)])

    def of_rows(u, bends):
        rows = enforced(problem, Instants(instants.rows, instants.moments, bends)).bound_constraints[1]
        motion = moved(problem, u)
        found = np.full((N, 4), -np.inf)
        np.maximum.at(found, rows.begins, rows.value(motion.q, motion.v, motion.u_nodes))
        return 0.6 + found.reshape(N, 2, 2).max(axis=1)

    (speeds, inside), (after, still) = (largest(controls) for controls in (u, u + way))
    inside &= still
    assert inside.sum() > N // 2
    np.testing.assert_allclose(of_rows(u, instants.bends)[inside], speeds[inside], rtol=1e-3)
    sliding, fixed = (
        np.abs(of_rows(u + way, bends) - of_rows(u, bends) - after + speeds)[inside].max()
        for bends in (instants.bends, np.zeros(instants.bends.shape))
    )
    assert sliding < 0.1 * fixed, (sliding, fixed)


def test_files_with_other_rows_between_nodes_are_refused(tmp_path):
    problem = reach(vp.planar_chain(2), 0.6, dt=0.125, steps=N)
    path = vp.solve(problem, check=False).save(tmp_path / "plan.npz")
    with np.load(path) as file:
        members = dict(file)
    wrong = {
        "instants": members["multipliers.instants"] + [0, N, 0],
        "moments": members["multipliers.moments"][1:],
        "bends": members["multipliers.bends"] - 1.0,
        "begun_moments": members["multipliers.begun_moments"] + 1.0,
        "weights": members["multipliers.weights"][:1],
    }
    for name, array in wrong.items():
        np.savez(path, **members | {f"multipliers.{name}": array})
        with pytest.raises(vp.FileError, match="multipliers"):
            vp.Solution.load(path, problem)


# Joints, their goal and start [rad], weights of controls and velocities, and steps.
RATED = {
    "two links": ([0.0, 0.2], [-0.47, -0.35], 6e-2, 1.6e-3, 15),
    "three links": ([-0.53, -0.86, 0.43], [0.31, 0.05, 0.13], 3.2e-4, 4.6e-2, 25),
}


@pytest.mark.parametrize("name", RATED)
def test_multipliers_leave_the_least_slope(name):
    """Beside all multipliers of the right signs, the Lagrangian's slopes in the controls by differences are least."""
    end, start, of_controls, of_velocities, steps = RATED[name]
    robot = vp.planar_chain(len(end))
    goal = vp.ReachFrame(robot, "tip", position=robot.frame_positions(np.array(end), "tip"))
    cost = vp.ControlCost(of_controls) + vp.VelocityCost(of_velocities) + vp.ControlRateCost(1e-5)
    problem = vp.OptimalControlProblem(
        vp.Scene(robot, damping=0.1), cost, start, np.zeros(len(end)), dt=0.06, steps=steps,
        integrator=vp.RungeKutta4(), controls="linear", constraints=[goal, vp.WithinControlRate(20.0)],
    )  # fmt: skip
    plan = vp.solve(problem, check=False)
    assert plan.status.converged
    u, (N, n) = plan.controls, (steps, len(end))

    def parts(u):
        policy = vp.LinearPolicy(u[1:], np.zeros((N, n, 2 * n)), np.zeros((N, 2 * n)), before=u[0], linear=True)
        motion = problem.simulate(policy)
        return np.concatenate([[problem.cost_of(motion)], *(c.ravel() for c in values(problem, motion))])

    change = 3e-6 * np.abs(u).max()
    slopes = np.zeros((len(parts(u)), u.size))
    for i, way in enumerate(change * np.eye(u.size)):
        w = way.reshape(u.shape)
        slopes[:, i] = (parts(u + w) - parts(u - w)) / (2.0 * change)
    told = np.concatenate([report.multipliers.ravel() for report in plan.constraints])
    met = np.concatenate([(np.abs(report.values) <= 1e-9).ravel() for report in plan.constraints])
    equal = np.concatenate([np.full(report.values.size, report.equality) for report in plan.constraints])
    assert met[~equal].any()
    assert (told[~met] == 0.0).all()
    best = lsq_linear(slopes[1:][met].T, -slopes[0], bounds=(np.where(equal[met], -np.inf, 0.0), np.inf), tol=1e-14)
    least = np.linalg.norm(slopes[0] + best.x @ slopes[1:][met])
    assert np.linalg.norm(slopes[0] + told @ slopes[1:]) <= 2.0 * least + 1e-6 * np.linalg.norm(slopes[0])


def test_a_last_step_to_a_motion_without_derivative_is_not_taken(monkeypatch):
    """The plan stays where it is, with the multipliers of its least slope, instead of those of the last round."""
    given, refused = [], []

    class Loop(ClosedLoop):
        def __init__(self, problem, motion, *args):
            if motion is not given[-1]:
                refused.append(motion)
                raise LinearizationError(0, 0.0, "no derivative")
            super().__init__(problem, motion, *args)

    def noted(step):
        def noting(problem, motion, *args):
            given.append(motion)
            return step(problem, motion, *args)

        return noting

    problem = links("goal", integrator=vp.Midpoint())
    best = vp.solve(problem, check=False)
    monkeypatch.setattr("varpin.control.polish.ClosedLoop", Loop)
    for name in ("polished", "judged"):
        monkeypatch.setattr(augmented, name, noted(getattr(augmented, name)))
    plan = vp.solve(problem, check=False)
    assert refused
    assert "the cost would fall by" in plan.reason
    np.testing.assert_allclose(plan.constraints[0].multipliers, best.constraints[0].multipliers, rtol=1e-3, atol=1e-3)


def test_margins_of_plans_with_rows_between_nodes():
    """The check of margins under noise, and a controller's ticks, are of the rows at nodes alone."""
    robot = vp.planar_chain(1)
    scene = vp.Scene(robot, gravity=False, damping=0.1, noise=vp.AdditiveNoise(0.01))
    cost = vp.ControlCost(1e-4) + vp.VelocityCost(1e-3) + vp.Terminal(vp.TrackingCost([0.4], 1e2))
    within = vp.WithinVelocityLimits(robot, (-0.3, 0.3), margin=2.0)
    given = {"dt": 0.05, "steps": N, "controls": "linear", "constraints": [within]}
    problem = vp.OptimalControlProblem(scene, cost, [0.1], [0.0], **given)
    plan = vp.solve(problem)
    assert plan.status.converged, plan.reason
    assert len(plan.constraints[0].t) > N
    assert not about(plan.warnings, "small margin")
    margins = at_nodes(problem, plan.multipliers, plan.multipliers.backoff)
    feedback = Feedback(plan.gains, plan.previous_gains)
    # Of a joint of constant inertia I, with p = I v.
    inertia = robot.model.inertias[1]
    moment = inertia.inertia[1, 1] + inertia.mass * inertia.lever @ inertia.lever
    P = covariances(problem, plan.trajectory, feedback)[1:, 1, 1]
    np.testing.assert_allclose(margins[0], np.tile(2.0 * np.sqrt(P)[:, None] / moment, 2), rtol=1e-2)
    assert len(vp.Mpc(problem).run(duration=0.1, rng=0).plans) == 2


def test_interior_point_steps_end_where_rounding_errors_keep_the_gap(monkeypatch):
    """Penalties are so heavy that some gaps stay above the bound; all 60 steps were taken then."""
    steps: list[int] = []
    begin, move = Pushes.__init__, Pushes.move

    def begun(self, *given):
        steps.append(0)
        begin(self, *given)

    def moved_on(self, length):
        steps[-1] += 1
        move(self, length)

    monkeypatch.setattr(Pushes, "__init__", begun)
    monkeypatch.setattr(Pushes, "move", moved_on)
    problem = reach(ROBOT, 0.6, begin=[0.1, 0.1], goal=[0.7, -0.7])
    plan = vp.solve(problem, check=False)
    assert plan.status.converged
    assert plan.iterations <= 35
    assert len(steps) > 3
    assert max(steps) <= 25


def test_interior_point_steps_lead_to_a_plan_where_the_next_pass_fails(monkeypatch):
    """Because of rounding errors its model has no minimum: the point before is the result, if its gap is small."""
    passed, steps, failed, inner, most = Box._passed, [], [], [], [0]

    def failing(self, limits, stiff=None, pull=None):
        if stiff is not None and limits.factors is None:
            steps.append(None)
            if len(steps) > most[0]:
                failed.append(None)
                return None
        return passed(self, limits, stiff, pull)

    real = Box._interior_with_rows

    def noted(self, plan, rows):
        steps.clear()
        inner.append(real(self, plan, rows))
        return inner[-1]

    monkeypatch.setattr(Box, "_passed", failing)
    monkeypatch.setattr(Box, "_interior_with_rows", noted)
    problem = reach(ROBOT, 0.6, begin=[0.1, 0.1], goal=[0.7, -0.7])
    # Two passes a step: the first or the second of them fails.
    for most[0], finds in ((6, False), (18, True), (19, True)):
        for calls in (inner, failed):
            calls.clear()
        plan = vp.solve(problem, check=False, max_iterations=3)
        assert np.isfinite(plan.cost)
        assert len(inner) > 0
        assert len(failed) == len(inner)
        assert all((found is not None) == finds for found in inner)


def test_last_steps_are_rough_as_long_as_peaks_move(monkeypatch):
    """Only the last one goes on to rounding errors; one that does not move the motion is not made again."""
    enough, real = [], augmented.polished

    def noted(*given):
        enough.append(given[-1])
        return real(*given)

    monkeypatch.setattr(augmented, "polished", noted)
    plan = vp.solve(links("speeds"), check=False)
    assert plan.status.converged
    assert len(enough) >= 2
    assert enough[0] is not None
    assert enough[-1] is None
    assert plan.violation <= 1e-11

    asked = []

    def still(problem, motion, multipliers, weights, backoff, *_):
        asked.append(motion)
        return replace(judged(problem, motion, multipliers, weights, backoff), decrease=np.inf)

    monkeypatch.setattr(augmented, "polished", still)
    assert vp.solve(links("speeds"), check=False).status in vp.Status
    assert {1} <= set(Counter(map(id, asked)).values()) <= {1, 2}


def test_trials_of_the_last_step_that_leave_are_given_up():
    """Under stiff feedback and changes of the controls a million times too large, a trial took thousands of parts."""
    problem = links("speeds")
    plan = vp.solve(problem, check=False)
    known = plan.multipliers
    whole = enforced(problem, known.between)
    values, backoff = (split(whole.bound_constraints, part) for part in (known.values, known.backoff))
    step = _Step(whole, plan.trajectory, values, known.weights, backoff)
    step.solve(np.inf)
    seen_parts = []

    class Counted(Trials):
        def attempt(self, *given, **options):
            found = super().attempt(*given, **options)
            seen_parts.append(int(found.written.tally[0, :, 3].sum()))
            return found

    assert step.after(Counted(whole), 1.0) is not None
    step.ahead = np.full_like(step.ahead, 1e4)
    assert step.after(Counted(whole), 1.0) is None
    assert max(seen_parts) <= 4 * N
