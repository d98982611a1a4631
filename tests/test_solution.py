"""What is done with a solution: verification, Monte Carlo, policies, and plans to a wished true cost."""

import dataclasses

import numpy as np
import pytest
from findings import about
from oracles import Mechanism, exact, jacobian
from plan_problems import SMALL, UR5, arm, linear, reach
from refusals import naming, refused, unnamed

import varpin as vp
from varpin.control.refine import refine


def on_robot(plan, law=None):
    """Cost and end of a plan of ``reach`` on the continuous robot.

    Its dampers of 0.1 N m s tell the integral of v^2: of what the drives give they take what is not work in all.
    """
    problem, u = plan.problem, []

    def signal(k, q, v):
        u.append(plan.controls[k] if law is None else law(k, q, v, plan.controls[k]))
        return lambda t: u[k]

    times = problem.dt * problem.hold * np.arange(len(plan.controls) + 1)
    own = exact(problem.scene, problem.q0, problem.v0, times, signal)
    lost = np.sum(u * np.diff(own.q, axis=0)) - own.work[-1]
    q, v = own.q[-1], own.v[-1]
    running = 1e-2 * (times[1] * np.sum(np.square(u)) + lost / 0.1)
    return running + 100.0 * ((q - [1.0, 0.5]) ** 2).sum() + 10.0 * v @ v, q


@pytest.mark.parametrize(
    "options",
    [
        {"integrator": vp.Midpoint(), "hold": 4},
        {"integrator": vp.Midpoint(alpha=0.3)},
        {"integrator": vp.ExplicitEuler(), "hold": 4},
        {"integrator": vp.RungeKutta4()},
    ],
    ids=str,
)
def test_true_cost(options):
    plan = vp.solve(reach(dt=0.02, steps=36, **options))
    found, last = plan.verify(tolerance=1e-12), plan.trajectory.q[-1]
    assert found.accuracy <= 1e-12
    assert found.planned_cost == plan.cost
    cost, end = on_robot(plan)
    assert found.open_loop_cost == pytest.approx(cost, rel=1e-8)
    assert found.open_loop_gap == pytest.approx(np.abs(end - last).max(), rel=1e-6, abs=1e-9)
    policy = plan.policy_on("velocity")

    def law(k, q, v, u):
        return u + policy.gains[k] @ (np.concatenate([q, v]) - policy.reference[k])

    cost, end = on_robot(plan, law)
    assert found.closed_loop_cost == pytest.approx(cost, rel=1e-8)
    assert found.closed_loop_gap == pytest.approx(np.abs(end - last).max(), rel=1e-6, abs=1e-9)


def test_accuracy_is_honest():
    sol = vp.solve(reach(integrator=vp.Midpoint(), dt=0.01, steps=72))
    true, _ = on_robot(sol)
    alone = sol.verify(max_substeps=2)
    assert alone.accuracy == np.inf
    assert np.isfinite([alone.open_loop_cost, alone.closed_loop_cost]).all()
    assert not alone.told
    assert not unnamed(str(alone), "max_substeps of 4")
    assert not about(str(alone), "runaway")
    for most in (2, 3, 5, 11):
        assert sol.verify(tolerance=1e-15, max_substeps=most).substeps == 2 ** int(np.log2(most))
    for most in (4, 8, 16):
        found = sol.verify(tolerance=1e-15, max_substeps=most)
        assert found.substeps == most
        assert abs(found.open_loop_cost / true - 1.0) <= found.accuracy
    assert found.accuracy < 1e-8


@pytest.mark.parametrize("name", ["linear, change of controls", "held, change of controls"])
def test_changes_of_controls_cost_the_same_in_finer_steps(name):
    found = SMALL[name].plan.verify(tolerance=1e-6)
    assert abs(found.open_loop_loss) < 1e-3
    assert abs(found.closed_loop_loss) < 1e-3


def test_motion_that_runs_away():
    """A stiff spring that two substeps cannot follow gives NaN; enough of them give the cost."""
    scene = vp.Scene(vp.planar_chain(1), stiffness=3e4, gravity=False)
    cost = vp.TrackingCost([0.1]) + vp.ControlCost(1e-6)
    sol = vp.solve(vp.OptimalControlProblem(scene, cost, [0.1], [0.0], dt=0.05, steps=200), [2500.0])
    coarse = sol.verify(max_substeps=2)
    assert np.isnan(coarse.open_loop_cost)
    assert np.isnan(coarse.open_loop_gap)
    assert coarse.accuracy == np.inf
    fine = sol.verify(tolerance=1e-6)
    assert np.isfinite(fine.open_loop_cost)
    assert fine.accuracy <= 1e-6


def test_policy_on_velocities_and_back():
    plan = vp.solve(arm(*UR5, lambda *_: [], hold=5, integrator=vp.Midpoint()), check=False)
    own, n = Mechanism(plan.problem.scene), 6
    policy = plan.policy_on("velocity")
    assert policy.hold_at(plan.problem.dt / 5) == 25
    for r in (0, 2, 5):
        q, v = plan.trajectory.q[5 * r], plan.trajectory.v[5 * r]
        np.testing.assert_array_equal(policy.reference[r], np.concatenate([q, v]))
        columns = jacobian(lambda x, v=v: own.mass_matrix(x) @ v, q, 0.02)
        turned = plan.gains[r] @ np.block([[np.eye(n), np.zeros((n, n))], [columns, own.mass_matrix(q)]])
        np.testing.assert_allclose(policy.gains[r], turned, rtol=0, atol=1e-8 * np.abs(turned).max())
    other = plan.problem.at(integrator=vp.RungeKutta4())
    turned = dataclasses.replace(plan, problem=other, gains=plan.policy_on("velocity").gains.copy())
    np.testing.assert_array_equal(turned.policy_on("velocity").gains, turned.gains)
    back = turned.policy_on("momentum").gains
    np.testing.assert_allclose(back, plan.gains, rtol=1e-9, atol=1e-12 * np.abs(plan.gains).max())
    with refused(vp.InputError, "(q, p)", "(q, v)"):
        other.simulate(plan.policy)
    # Warm-started from the plan, the search has next to nothing to do.
    again = vp.solve(other, plan)
    assert again.status.converged
    assert again.history[0].expected_decrease < 1e-2 * again.cost


def test_monte_carlo_repeats():
    plan = vp.solve(linear(noise=vp.AdditiveNoise(0.2)))
    first = plan.monte_carlo(600, 7, workers=1)
    assert plan.monte_carlo(600, 7, workers=2) == first
    assert plan.monte_carlo(600, np.random.default_rng(7)) == first
    assert plan.monte_carlo(600, 8) != first
    quiet = vp.solve(linear()).monte_carlo(3, 0)
    assert quiet.cost == pytest.approx(quiet.predicted, rel=1e-13)
    assert quiet.standard_error == 0.0
    own = vp.CustomNoise(lambda q, v, u: 0.2 * np.eye(2), 2)
    alone = dataclasses.replace(plan, problem=linear(noise=own)).monte_carlo(6, 3)
    assert alone.cost == pytest.approx(plan.monte_carlo(6, 3).cost, rel=1e-12)


def test_monte_carlo_is_the_mean_of_its_paths():
    plan = vp.solve(linear(noise=vp.AdditiveNoise(0.2) + vp.ControlNoise(0.3), integrator=vp.Midpoint()))
    for feedback, given in ((True, plan.policy), (False, plan.controls)):
        found, children = plan.monte_carlo(8, 5, feedback=feedback), np.random.default_rng(5).spawn(8)
        costs = [plan.problem.cost_of(plan.problem.simulate(given, rng=child)) for child in children]
        assert (found.cost, found.predicted) == (pytest.approx(np.mean(costs), rel=1e-12), plan.expected_cost)
        assert found.standard_error == pytest.approx(np.std(costs, ddof=1) / np.sqrt(8), rel=1e-9)


def test_monte_carlo_interrupted_holds_the_paths_done():
    sol, seen = vp.solve(linear(noise=vp.AdditiveNoise(0.3))), []

    def stop(done, paths):
        seen.append((done, paths))
        if done >= 64:
            raise KeyboardInterrupt

    with refused(vp.PathsInterrupted, "paths") as caught:
        sol.monte_carlo(6000, 5, workers=1, progress=stop)
    assert len(seen) == 1
    # Those that the worker had begun are kept, too.
    kept = caught.value.result.paths
    assert seen[0][0] <= kept < 6000
    assert sol.monte_carlo(kept, 5, workers=2) == caught.value.result


@pytest.mark.slow
def test_paths_that_fail_are_counted():
    """Plain DDP's gains on the light finger, in noise they were not made for."""
    robot, start = vp.load_robot("finger"), np.array([0.2, 0.3, 0.2])
    goal = vp.TrackingCost([0.8, 0.5, 0.4], 10.0)
    cost = goal + vp.ControlCost(1e7) + vp.Terminal(goal + vp.VelocityCost(0.1))
    scenes = (vp.Scene(robot, damping=1e-6, noise=noise) for noise in (None, vp.ControlNoise(0.3)))
    given = {"dt": 5e-3, "steps": 100}
    quiet, noisy = (vp.OptimalControlProblem(scene, cost, start, np.zeros(3), **given) for scene in scenes)
    found = dataclasses.replace(vp.solve(quiet), problem=noisy).monte_carlo(16, 1)
    assert found.failures > 0
    assert found.paths + found.failures == 16
    assert not unnamed(found.warnings[0], f"{found.failures} of 16 paths", "not counted")
    assert np.isfinite(found.cost)


def test_verification_prints_the_loss_in_percent():
    text = str(vp.Verification(2.0, 2.5, 2.02, 0.125, 0.25, 8, 3e-11))
    assert not unnamed(text, "2.000000e+00", "2.500000e+00", "+25 %", "1.25e-01")
    assert not unnamed(text, "2.020000e+00", "+1 %", "2.50e-01", "3e-11")
    assert about(text.splitlines()[-1], "legend")
    lost = str(vp.Verification(2.0, np.nan, np.nan, np.nan, np.nan, 8, np.inf))
    assert len(about(lost.splitlines(), "runaway")) == 3
    assert "nan" not in lost
    assert "inf" not in lost
    # Nothing is a part of a cost of nothing.
    assert "+0 %" in str(vp.Verification(0.0, 0.0, 1e-9, 0.0, 0.0, 4, 0.0))
    assert vp.Verification(0.0, -1.0, 1.0, 0.0, 0.0, 4, 0.0).open_loop_loss == -np.inf


def test_monte_carlo_prints_how_far_it_is_from_the_prediction():
    text = str(vp.MonteCarlo(cost=1.1, standard_error=0.05, predicted=1.0, paths=197, failures=3))
    assert not unnamed(text, "1.100000e+00", "5.0e-02", "197", "3", "+10 %", "+2.0")
    assert about(text.splitlines()[-1], "legend")
    assert "standard errors)" not in str(vp.MonteCarlo(1.0, 0.0, 1.0, 2, 0))


def test_a_noise_field_that_fails_away_from_the_start_costs_a_trial_and_not_the_motion():
    limit = 0.05

    def field(q, v, u):
        return np.full((len(q), 1), np.nan if abs(q[0]) > limit else 1e-3)

    scene = vp.Scene(vp.planar_chain(2), gravity=False, noise=vp.CustomNoise(field, processes=1))
    cost = vp.TrackingCost([0.5, 0.0], 10.0) + vp.ControlCost(1e-3)
    problem = vp.OptimalControlProblem(scene, cost, [0.0, 0.0], [0.0, 0.0], dt=0.02, steps=25)
    sol = vp.solve(problem, max_iterations=10)
    assert np.abs(sol.trajectory.q[:-1, 0]).max() <= limit  # the last node kicks nothing
    assert sol.cost == problem.cost_of(sol.trajectory)
    assert sol.cost <= sol.history[0].cost


# --- plans to a wished true cost -------------------------------------------------------------------------------------


def reach_to_cost(steps, controls="held", **options):
    end = vp.TrackingCost([1.5, -1.0], 1e3) + vp.VelocityCost(1e2)
    cost = vp.ControlCost(1e-3) + vp.VelocityCost(0.1) + vp.Terminal(end)
    given = {"dt": 1.0 / steps, "steps": steps, "controls": controls, "integrator": vp.Gauss(2)} | options
    return vp.OptimalControlProblem(vp.Scene(vp.planar_chain(2), damping=0.1), cost, [0.0, 0.0], [0.0, 0.0], **given)


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_the_plan_is_within_the_wish_of_the_optimum(controls):
    """Coarse controls cost more, however well the robot follows."""
    optimum = vp.solve(reach_to_cost(96, "linear"), check=False).cost
    for wish in (0.03, 3e-3):
        found = vp.solve(reach_to_cost(3, controls), true_cost=wish, check=False).refinement
        assert found.met
        rows = [row for row in found.tried if np.isfinite(row.excess)]
        above = [row.true_cost / optimum - 1.0 for row in rows]
        assert above[-1] <= wish
        np.testing.assert_allclose([row.excess for row in rows], above, rtol=0.3, atol=0.1 * wish)


def test_halvings_go_on_until_they_resolve_the_dampers():
    """Losses of held controls rise at first: 10, 25, 43, 34, 6 and 0.1 %."""
    begin, rest = np.array([-1.0, 0.5]), np.zeros(2)
    inertia = vp.lagrangian_jet(vp.Scene(vp.planar_chain(2)), begin, rest).Lvv
    rate = np.abs(np.linalg.eigvals(np.linalg.inv(inertia))).max()
    cost = vp.ControlCost(1e-4) + vp.VelocityCost(1.0)
    cost += vp.Terminal(vp.TrackingCost([0.0, 0.3], 1e4) + vp.VelocityCost(1e3))
    scene = vp.Scene(vp.planar_chain(2), damping=1300.0 / rate)
    found = vp.solve(vp.OptimalControlProblem(scene, cost, begin, rest, dt=0.1, steps=5), true_cost=0.03).refinement
    losses = [row.loss for row in found.tried]
    assert found.met
    assert min(losses[1:4]) > losses[0]


def test_held_periods_stay():
    plan = vp.solve(reach_to_cost(8, hold=2), true_cost=1e-5, check=False)
    assert plan.refinement.met
    assert plan.problem.period == pytest.approx(0.25)
    assert len(plan.controls) == 4


def test_a_wish_out_of_reach_says_so():
    limited = vp.solve(reach_to_cost(3), true_cost=1e-12, time_limit=0.3)
    assert not limited.refinement.met
    assert not unnamed(limited.refinement.reason, "true_cost = 1e-12")
    assert naming(limited.warnings, "true_cost")
    # A reference on the problem's own grid has no values in between.
    rows = np.ones((7, 2))
    fixed = reach_to_cost(6, sampling="start").at(cost=vp.ControlCost(1.0) + vp.TrackingCost(rows, 100.0))
    stuck = vp.solve(fixed, true_cost=1e-9, check=False)
    assert not unnamed(stuck.refinement.reason, "half of dt", "reference")


@pytest.mark.parametrize("after", [1, 12])
def test_an_interrupt_keeps_the_best(after):
    calls = 0

    def callback(_):
        nonlocal calls
        calls += 1
        if calls == after:
            raise KeyboardInterrupt

    plan = vp.solve(reach_to_cost(4), true_cost=1e-9, callback=callback, check=False)
    assert plan.status is vp.Status.INTERRUPTED
    assert not plan.refinement.met
    assert about(plan.refinement.reason, "interruption")
    # The first step takes five iterations.
    assert (len(plan.refinement.tried) > 1) == (after == 12)
    if plan.refinement.tried:
        best = min(plan.refinement.tried, key=lambda row: abs(row.loss))
        assert plan.problem.dt == pytest.approx(best.dt)
    else:
        assert plan.problem.dt == pytest.approx(0.25)


def test_no_plan_within_constraints():
    """A step that has none may be too coarse, so half of it is tried, too."""
    goal = vp.ReachFrame(vp.planar_chain(2), "tip", position=[1.0, 0.5, -0.5])
    far = vp.solve(reach_to_cost(12, constraints=goal), true_cost=0.01, check=False)
    assert far.status is vp.Status.INFEASIBLE
    assert len(far.refinement.tried) == 2
    assert not far.refinement.met
    assert about(far.refinement.reason, "no plan within constraints")


def test_a_loss_within_the_wish_is_no_warning():
    plan = vp.solve(reach_to_cost(4, "linear"), true_cost=1e-2)
    assert plan.refinement.met
    assert 2e-3 < plan.verify().closed_loop_loss < 1e-2
    assert not naming(plan.warnings, "in quarters of dt")
    assert naming(vp.solve(plan.problem, plan.controls).warnings, "in quarters of dt")


LIMITED = {"constraints": vp.WithinVelocityLimits(vp.planar_chain(2), (-2.0, 2.0))}


@pytest.mark.parametrize(
    ("problem", "wish"),
    [(reach_to_cost(3), 1e-4), (reach_to_cost(3, "linear"), 1e-4), (reach_to_cost(12, **LIMITED), 1e-2)],
    ids=["held", "linear", "within speeds"],
)
def test_the_first_step_within_the_wish_is_taken(problem, wish):
    """Within speeds the first step costs little, but violates them."""
    plan = vp.solve(problem, true_cost=wish)
    found, truth = plan.refinement, plan.verify()
    assert found.met
    assert found.chosen == len(found.tried) - 1 >= 1
    assert plan.status.converged
    assert abs(truth.closed_loop_loss) <= wish
    beyond = max((told.violation for told in truth.constraints), default=0.0)
    assert found.tried[-1].violation == pytest.approx(beyond / 4.0, rel=1e-2)
    assert beyond / 4.0 <= 1e-3
    assert all(abs(row.loss) > wish or row.excess > wish or row.violation > 1e-3 for row in found.tried[:-1])
    assert found.tried[-1].excess <= wish
    np.testing.assert_allclose([row.dt for row in found.tried], problem.dt / 2.0 ** np.arange(len(found.tried)))
    assert plan.problem.steps == found.tried[-1].steps == plan.trajectory.steps
    assert str(found) in plan.table()
    # Each row is the plan of its step, from whatever controls it began.
    cold = vp.solve(problem.at(dt=found.tried[-1].dt), check=False)
    assert plan.cost == pytest.approx(cold.cost, rel=1e-5)
    # Its controls cost no more than the wish above those of a far finer step.
    best = vp.solve(problem.at(dt=plan.problem.dt / 4), check=False).cost
    assert truth.closed_loop_cost <= (1.0 + 2.0 * wish) * best


def test_a_refinement_that_ends_early_names_what_its_plan_violates():
    def callback(item):
        nonlocal plans
        plans += item.index == 0
        if plans == 2:
            raise KeyboardInterrupt

    plans = 0
    reason = vp.solve(reach_to_cost(12, **LIMITED), true_cost=1e-2, check=False, callback=callback).refinement.reason
    assert not unnamed(reason, "interrupted", "violates WithinVelocityLimits on the continuous system", "rad/s", "t =")
    assert len(reason) <= 240


def test_a_search_that_fails_with_half_the_step_is_no_comparison():
    """The first plan is within the wish, but may be far above the optimum of finer controls."""

    def search(problem, _):
        if problem.steps > 12:
            raise vp.LinearizationError(0, 0.0, "of the test")
        return vp.solve(problem, check=False)

    found = refine(reach_to_cost(12), search, 0.1, lambda: np.inf).refinement
    assert abs(found.tried[0].loss) <= 0.1
    assert not found.met
    assert not unnamed(found.reason, "half of dt", "of the test")
