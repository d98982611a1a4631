"""What any search for plans has to do: a table of problems against oracles, and how searches end."""

import re
import time
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from oracles import kkt, least_cost, plan_rows, rollout, same, violation
from plan_problems import ARMS, CAPSULES, CASES, LIMITS, LINE, REST, SMALL, TWO, linear, reach, speeds, swing, tip
from refusals import refused

import varpin as vp

# A plan may cost as much more than the least cost known.
ABOVE = 1e-3
# Violation of constraints at nodes, in their own units.
MET = 1e-6


# --- the table -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_plan(name):
    case = CASES[name]
    problem, plan = case.problem, case.plan
    assert plan.status.converged, plan.reason
    assert plan.expected_cost <= (1.0 + ABOVE) * case.cost
    assert plan.cost == pytest.approx(problem.cost_of(plan.trajectory), rel=1e-12)
    assert ((problem.control_limits[0] <= plan.controls) & (plan.controls <= problem.control_limits[1])).all()
    assert violation(problem, plan.trajectory, plan.controls) <= MET
    assert plan.violation <= MET
    assert all((np.diff(report.t) >= 0.0).all() for report in plan.constraints)
    # The motion is that of its policy, and for arms that do not fall over without feedback, of its controls.
    assert_allclose(problem.simulate(plan.policy).q, plan.trajectory.q, rtol=0, atol=1e-9)
    if name in SMALL and not problem.scene.constraints:
        assert_allclose(rollout(problem, plan.controls).q, plan.trajectory.q, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", [name for name, case in SMALL.items() if case.kkt])
def test_karush_kuhn_tucker(name):
    assert kkt(SMALL[name].plan) <= SMALL[name].kkt


@pytest.mark.parametrize("name", [name for name, case in SMALL.items() if case.scipy])
def test_scipy_finds_no_less(name):
    case = SMALL[name]
    u = case.plan.controls
    disturbed = u * (1.0 + 5e-3 * np.random.default_rng(0).normal(size=u.shape))
    assert case.plan.cost == pytest.approx(least_cost(case.problem, disturbed), rel=1e-5)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.within])
def test_within_steps(name):
    """In sixteenths of the steps; arms fall over without feedback: each from its node."""
    case, worst = CASES[name], 0.0
    problem, plan, motion = case.problem, case.plan, case.plan.trajectory
    grid = {"dt": problem.dt / 16, "steps": 16, "integrator": problem.integrator, "check": False}
    for k in range(problem.steps):
        given = plan.controls[k // problem.hold]
        if problem.controls == "linear":
            given = vp.FirstOrderHold(np.linspace(*plan.controls[k : k + 2], 17))
        part = vp.simulate(problem.scene, motion.q[k], motion.v[k], controls=given, **grid)
        below, _ = plan_rows(problem, part, np.zeros((2, problem.scene.controls)))
        worst = max(worst, float(below.max()))
    assert worst <= case.within


@pytest.mark.parametrize(
    "name", ["held, speeds", "held, out of a sphere", "linear, rates and goal", "held over 3 steps"]
)
def test_multipliers_are_slopes_of_the_least_cost(name):
    change = 1e-3
    relaxed = {
        "held, speeds": lambda d: reach(speeds(1.8 + d)),
        "held, out of a sphere": lambda d: reach(vp.KeepOutOfSphere(TWO, "tip", [1.3, 0.0, -1.3], 0.3 - d)),
        "linear, rates and goal": lambda d: reach(tip(-0.9 + d), vp.WithinControlRate(120.0), controls="linear"),
        "held over 3 steps": lambda d: reach(speeds(2.2 + d), dt=0.03, steps=24, hold=3, **LIMITS),
    }[name]
    more, less = (vp.solve(relaxed(d), check=False, tolerance=1e-10).cost for d in (change, -change))
    report = SMALL[name].plan.constraints[0]
    pull = report.multipliers[-1, 2] if report.equality else report.multipliers.sum()
    assert (less - more) / (2.0 * change) == pytest.approx(pull, rel=1e-3)


def test_what_no_motion_meets_changes_nothing():
    wide = vp.KeepInBox(TWO, "tip", [-5.0] * 3, [5.0] * 3)
    within = vp.solve(reach(speeds(50.0), wide, control_limits=(-200.0, 200.0)), check=False)
    assert within.cost == pytest.approx(SMALL["held"].plan.cost, rel=1e-6)
    assert not any(report.active.any() for report in within.constraints)


def test_the_optimum_of_a_double_integrator_is_the_continuous_one():
    """Least effort from rest to rest is linear in time: two intervals hold it exactly."""
    robot = vp.planar_chain(1)
    scene = vp.Scene(robot, gravity=False)
    inertia = float(vp.lagrangian_jet(scene, np.zeros(1), np.zeros(1)).Lvv[0, 0])
    r, w, T = 0.3, 50.0, 1.2
    cost = vp.ControlCost(r) + vp.Terminal(vp.TrackingCost([1.0], w) + vp.VelocityCost(w))
    problem = vp.OptimalControlProblem(scene, cost, [0.0], [0.0], dt=T / 2, steps=2, controls="linear")
    plan = vp.solve(problem, check=False)
    # u = a + b t under (q, v)(T) = G (a, b), by hand.
    G = np.array([[T**2 / 2, T**3 / 6], [T, T**2 / 2]]) / inertia
    E = r * np.array([[T, T**2 / 2], [T**2 / 2, T**3 / 3]])
    a, b = np.linalg.solve(E + w * G.T @ G, w * G.T @ [1.0, 0.0])
    end = G @ [a, b]
    least = np.array([a, b]) @ E @ [a, b] + w * ((end[0] - 1.0) ** 2 + end[1] ** 2)
    assert plan.status.converged
    assert_allclose(plan.controls[:, 0], a + b * np.array([0.0, T / 2, T]), rtol=1e-9)
    assert plan.cost == pytest.approx(least, rel=1e-12)
    held = vp.solve(problem.at(controls="held"), check=False)
    assert held.cost > 1.01 * least


# --- feedback --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in SMALL | ARMS if not name.startswith(("closed loop", "an input"))])
def test_feedback_holds_a_disturbed_start(name):
    problem, plan = CASES[name].problem, CASES[name].plan
    away = 0.02 * np.random.default_rng(0).choice([-1, 1], problem.scene.robot.dof)
    grid = {"dt": problem.dt, "steps": problem.steps, "integrator": problem.integrator, "check": False}
    still = {"increments": 0} if problem.scene.processes else {}
    motion = vp.simulate(problem.scene, problem.q0 + away, problem.v0, controls=plan.policy, **grid, **still)
    off = np.abs(motion.q - plan.trajectory.q)
    assert off.max() <= 5 * 0.02
    assert off[-1].max() <= 1.05 * 0.02
    low, high = problem.control_limits
    rows = motion.u_nodes if problem.controls == "linear" else motion.u
    assert ((low <= rows) & (rows <= high)).all()
    assert np.isfinite(plan.gains).all()


# Linear systems under squares.
FED_BACK = {
    "Gauss": linear,
    "midpoint rule over 3 steps": lambda: linear(integrator=vp.Midpoint(), sampling="midpoint", hold=3),
    "start rule": lambda: linear(integrator=vp.ExplicitEuler(), sampling="start"),
    "Runge-Kutta": lambda: linear(integrator=vp.RungeKutta4(), sampling="start", hold=2),
    "noise": lambda: linear(noise=vp.AdditiveNoise(0.2) + vp.ControlNoise(0.5), integrator=vp.Midpoint(kick="split")),
    "lines": lambda: linear(vp.ControlRateCost(1e-2), controls="linear"),
}


@pytest.mark.parametrize("name", FED_BACK)
def test_feedback_is_the_optimum_from_another_start(name):
    problem, away = FED_BACK[name](), np.array([0.3, -0.2])
    plan = vp.solve(problem, tolerance=1e-14, check=False)
    assert plan.status.converged
    assert plan.iterations == 1
    moved = problem.at(q0=problem.q0 + away)
    best = vp.solve(moved, tolerance=1e-14, check=False)
    # On lines the first control is the plan's alone to change.
    policy = plan.shifted(0, plan.controls[0] + plan.gains[0, :, :2] @ away) if problem.linear else plan.policy
    motion = moved.simulate(policy)
    rows = motion.u_nodes if problem.linear else motion.u[:: problem.hold]
    assert_allclose(rows, best.controls, rtol=0, atol=1e-8 * np.abs(best.controls).max())
    assert np.abs(best.controls - plan.controls).max() > 1e-2


@pytest.mark.parametrize("name", [name for name in SMALL if name.startswith("noise")])
def test_noise_costs_what_motions_under_noise_cost(name):
    plan = SMALL[name].plan
    found = plan.monte_carlo(2000, rng=0)
    assert plan.noise_cost > 0.1 * plan.cost
    # The model is of second order in the noise, and controls at limits have no feedback.
    assert abs(found.cost - plan.expected_cost) <= 4.0 * found.standard_error + 0.05 * plan.noise_cost


# --- what cannot be --------------------------------------------------------------------------------------------------


def joints(low, high):
    return vp.WithinJointLimits(TWO, (low, high))


NEAR = vp.Obstacle.sphere([1.5, 0.0, 0.0], 0.3)
STRONG = {"control_limits": (-30.0, 30.0)}
# Constraints, options, the most iterations.
IMPOSSIBLE = {
    "a goal out of reach": ([vp.ReachFrame(TWO, "tip", position=[2.5, 0.0, 0.0])], {}, 30),
    "a goal off the plane": ([vp.ReachFrame(TWO, "tip", position=[1.0, 0.5, -0.5])], {}, 30),
    "two goals": ([vp.ReachFrame(TWO, "tip", position=[1.5, 0.0, z]) for z in (-0.5, 0.9)], {}, 30),
    "a goal too far for the speed": ([speeds(0.3), tip(-1.2)], {}, 30),
    "a start in an obstacle": ([vp.KeepClear(TWO, [NEAR], 0.02, capsules=CAPSULES)], STRONG, 8),
    "half-spaces that exclude each other": (
        [vp.KeepInHalfSpace(TWO, "tip", [0, 0, up], 0.5) for up in (1.0, -1.0)], {}, 30
    ),
    "a start too fast to brake": ([speeds(0.5)], {"v0": [3.0, 0.0], "control_limits": (-20.0, 20.0)}, 6),
    "torques that do not carry the arm": ([joints(-0.2, 0.2)], {"control_limits": (-5.0, 5.0)}, 30),
    "a start outside of limits": ([joints([0.5, -1], [2.0, 1])], STRONG, 6),
    "linear, a start outside": ([joints([0.5, -1], [2.0, 1])], {"controls": "linear", **STRONG}, 6),
    "a sphere around the goal": ([tip(), vp.KeepOutOfSphere(TWO, "tip", [1.2, 0.0, -0.9], 0.1)], {}, 30),
    "of two alike": ([joints(-3.0, 3.0), joints(-0.1, 0.1)], {"q0": [1.0, 0.0], "control_limits": (-1.0, 1.0)}, 30),
}  # fmt: skip


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_what_cannot_be_is_infeasible_and_named(name):
    """The constraint, row, node and amount of the reason are so of the plan's motion."""
    constraints, options, most = IMPOSSIBLE[name]
    given = {"q0": REST, "v0": REST, "dt": 0.05, "steps": 20, "constraints": constraints, **options}
    problem = vp.OptimalControlProblem(reach().scene, reach().cost, **given)
    plan = vp.solve(problem, check=False)
    assert plan.status is vp.Status.INFEASIBLE
    assert plan.iterations <= most
    assert np.isfinite(plan.trajectory.q).all()
    assert violation(problem, plan.trajectory, plan.controls) > 1e-3
    (report,) = [item for item in plan.constraints if plan.reason.startswith(item.label)]
    (row,) = [j for j, words in enumerate(report.rows) if f"{words} at" in plan.reason]
    when = float(re.search(r"t = ([0-9.e-]+) s", plan.reason)[1])
    amount = float(re.search(r"violated by ([0-9.e+-]+)", plan.reason)[1])
    place = int(np.abs(report.t - when).argmin())
    assert report.t[place] == pytest.approx(when, abs=1e-3)
    assert report.excess[place, row] > 1e-4
    assert report.excess[place].max() >= 0.99 * amount


def test_what_is_infeasible_from_given_controls_may_not_be_so_from_others():
    goals = [vp.ReachFrame(TWO, "tip", position=[1.5, 0.0, z]) for z in (-0.5, 0.9)]
    assert "without controls=" in vp.solve(reach(*goals), np.zeros(2), check=False).reason
    assert "controls=" not in vp.solve(reach(*goals), check=False).reason


@pytest.mark.parametrize("name", ["held", "held, goal", "held, speeds"])
def test_heavy_regularization_is_no_optimum_and_makes_nothing_infeasible(name):
    given = {"check": False, "regularization": 1e6}
    assert vp.solve(SMALL[name].problem, max_iterations=0, **given).status is vp.Status.MAX_ITERATIONS
    plan = vp.solve(SMALL[name].problem, **given)
    assert plan.status.converged
    assert plan.cost <= (1.0 + ABOVE) * SMALL[name].cost


def test_a_start_outside_that_one_step_mends_is_no_reason_to_end():
    mends = vp.WithinJointLimits(TWO, ([0.05, -1], [2.0, 1]))
    for options in ({}, {"control_limits": (-2000.0, 2000.0)}, {"controls": "linear", "between_nodes": True}):
        plan = vp.solve(reach(mends, **options), check=False)
        assert plan.status.converged
        assert violation(plan.problem, plan.trajectory, plan.controls) <= MET


# --- how searches begin, end and go on -------------------------------------------------------------------------------

RESUMED = ["held, torques", "held, speeds and torques", "held, goal", "held, between nodes", "linear, speeds"]
RESUMED += ["noise of the controls", "noise of the controls, linear"]


@pytest.mark.parametrize("name", RESUMED)
def test_a_plan_that_is_cut_saved_and_resumed_is_the_same_to_the_bit(name, tmp_path):
    case = SMALL[name]
    for most in (1, 3):
        part = vp.solve(case.problem, max_iterations=most, check=False)
        assert part.iterations <= most
        path = part.save(tmp_path / "part.npz")
        rest = vp.solve(case.problem, resume=vp.Solution.load(path, case.problem), check=False)
        assert rest.status.converged
        assert_array_equal(rest.controls, case.plan.controls)
        assert_array_equal(rest.gains, case.plan.gains)
        assert rest.cost == case.plan.cost


def test_a_file_holds_the_whole_plan(tmp_path):
    """With its multipliers, or its warnings and the steps that were tried; and of its motion the scene."""
    plan, path = SMALL["linear, speeds"].plan, tmp_path / "plan.npz"
    hasty = vp.solve(reach(dt=0.12, steps=6), true_cost=1e-12, time_limit=0.3)
    assert hasty.refinement
    assert hasty.warnings
    for own in (hasty, plan):
        assert same(vp.Solution.load(own.save(path), own.problem), own)
    with refused(vp.InputError, "damping"):
        vp.linearize(vp.Scene(TWO), vp.Trajectory.load(path))
    with pytest.raises(vp.FileError):
        vp.Solution.load(path, reach(tip()))
    entries = dict(np.load(path))
    np.savez(path, **entries | {"multipliers.values": entries["multipliers.values"][:-1]})
    with refused(vp.FileError, "multipliers.backoff"):
        vp.Solution.load(path, plan.problem)


@pytest.mark.parametrize("name", RESUMED)
def test_interrupted(name):
    case, seen = SMALL[name], []

    def stop(iteration):
        seen.append(iteration)
        if len(seen) == 2:
            raise KeyboardInterrupt

    part = vp.solve(case.problem, check=False, callback=stop)
    assert part.status is vp.Status.INTERRUPTED
    assert len(part.history) <= 3
    first = vp.solve(case.problem, check=False, max_iterations=0)
    if not case.problem.constraints:
        assert part.expected_cost <= first.expected_cost
    assert vp.solve(case.problem, resume=part, check=False).cost == pytest.approx(case.plan.cost, rel=1e-6)


@pytest.mark.parametrize("name", RESUMED)
def test_the_time_limit_ends_a_search(name):
    case = SMALL[name]
    none = vp.solve(case.problem, check=False, time_limit=1e-9)
    assert none.status is vp.Status.OUT_OF_TIME
    assert none.iterations == 0
    some = vp.solve(case.problem, check=False, time_limit=0.15, callback=lambda _: time.sleep(0.1))
    assert some.status is vp.Status.OUT_OF_TIME
    assert 1 <= some.iterations < case.plan.iterations
    assert vp.solve(case.problem, resume=some, check=False).cost == pytest.approx(case.plan.cost, rel=1e-6)


def test_reports_of_each_iteration():
    case = SMALL["held, speeds"]
    rows, motions, counts = [], [], []
    plan = vp.solve(case.problem, check=False, callback=rows.append, progress=lambda *count: counts.append(count))
    vp.solve(case.problem, check=False, callback=lambda _, motion: motions.append(motion))
    assert [row.index for row in rows] == list(range(len(rows)))
    assert [replace(row, seconds=0.0) for row in rows] == [replace(row, seconds=0.0) for row in plan.history]
    assert len(motions) == len(rows)
    assert all(isinstance(motion, vp.Trajectory) for motion in motions)
    done, most = zip(*counts, strict=True)
    assert list(done) == sorted(done)
    assert set(most) == {500}
    assert all(str(row) in plan.table() for row in plan.history)
    assert plan.reason in plan.table()


@pytest.mark.parametrize(
    ("name", "alone"),
    [
        ("held, joints", True),
        ("held, speeds", True),
        ("linear, speeds", True),
        ("held, torques", False),
        ("held, goal", False),
    ],
)
def test_any_start_leads_to_a_plan(name, alone):
    case = SMALL[name]
    starts = {
        "zero": {"controls": np.zeros(2)},
        "rows": {"controls": np.tile([20.0, 5.0], (case.problem.decisions, 1))},
        "a plan": {"controls": case.plan},
        "a policy": {"controls": case.plan.policy},
        "states": {"states": LINE},
        "states and velocities": {"states": (LINE, np.gradient(LINE, 0.06, axis=0))},
    }
    for start, options in starts.items():
        plan = vp.solve(case.problem, check=False, **options)
        assert plan.status.converged, start
        assert violation(case.problem, plan.trajectory, plan.controls) <= MET
        if alone or start in ("a plan", "a policy"):
            assert plan.cost <= (1.0 + ABOVE) * case.cost, start


# --- controllers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_a_controller_within_limits_and_constraints(controls):
    problem = swing(speeds(1.0), controls=controls, control_limits=([-20.0, -6.0], [20.0, 6.0]))
    run = vp.Mpc(problem).run(duration=0.9)
    assert not run.failed.any()
    assert not run.infeasible.any()
    u = run.motion.u
    assert (np.abs(u) <= [20.0, 6.0]).all()
    assert (np.abs(u) > [19.9, 5.9]).any()
    substeps = run.motion.steps // len(run.plans)
    assert np.abs(run.motion.v[::substeps]).max() <= 1.0 + 5e-3
    assert np.abs(run.motion.v).max() > 0.98
    assert (run.iterations[1:] <= 2).all()


def test_torques_of_a_loop_with_a_limit_of_the_rate_do_not_jump():
    scene = vp.Scene(TWO, damping=0.1)
    hold = scene.holding_torque([0.1, 0.2])
    cost = vp.TrackingCost([0.4, 0.0], 1e2) + vp.VelocityCost(1.0) + vp.ControlCost(1e-3)
    within = [vp.WithinControlRate(40.0, before=hold)]
    problem = vp.OptimalControlProblem(
        scene, cost, [0.1, 0.2], [0, 0], dt=0.04, steps=12, controls="linear", constraints=within
    )
    plant = vp.Plant(vp.Scene(TWO, damping=0.2, noise=vp.AdditiveNoise(0.02)), vp.Midpoint(), substeps=4)
    run = vp.Mpc(problem, iterations=3).run(plant, duration=0.6, rng=0)
    steps = np.abs(np.diff(run.motion.u, axis=0)) / run.motion.dt
    assert steps.max() > 39.0
    # Plans of three iterations violate the limit a little; what is applied does not.
    assert steps.max() <= 40.0 * (1.0 + 1e-9)
    assert run.constraints[0].violation <= 1e-9
    ends = np.array([plan.controls[:2] for plan in run.plans])
    assert_allclose(ends[0, 0], hold, atol=1e-12)
    assert_allclose(ends[1:, 0], ends[:-1, 1], atol=1e-4)
    # No plan comes in time: the feedback of the first one keeps to the limit, too.
    late = vp.Mpc(problem, budget=1e-9).run(plant, duration=0.4, rng=0).motion
    assert np.abs(np.diff(late.u, axis=0)).max() <= 40.0 * (1.0 + 1e-9) * late.dt


def test_failed_ticks():
    tick = 0

    def field(q, v, u):
        if tick in (3, 4):
            raise ValueError("no such noise")
        return 1e-3 * np.eye(2)

    def count(done, _):
        nonlocal tick
        tick = done

    uncertain = vp.Scene(TWO, damping=0.3, noise=vp.CustomNoise(field, 2))
    plant = vp.Plant(swing().scene)
    run = vp.Mpc(swing(scene=uncertain)).run(plant, duration=0.3, progress=count)
    assert run.failed.tolist() == [k in (3, 4) for k in range(10)]
    assert run.plans[2] is run.plans[3] is run.plans[4] is not run.plans[5]
    assert any("2 of 9 ticks" in told for told in map(str, run.warnings))
    whole = vp.Mpc(swing()).run(plant, duration=0.3)
    assert 0.0 < np.abs(run.motion.q - whole.motion.q).max() < 2e-2
