"""Plans to a wished true cost."""

import numpy as np
import pytest
from findings import about
from refusals import naming, unnamed

import varpin as vp
from varpin.control.refine import refine


def reach(steps, controls="held", **options):
    end = vp.TrackingCost([1.5, -1.0], 1e3) + vp.VelocityCost(1e2)
    cost = vp.ControlCost(1e-3) + vp.VelocityCost(0.1) + vp.Terminal(end)
    given = {"dt": 1.0 / steps, "steps": steps, "controls": controls, "integrator": vp.Gauss(2)} | options
    return vp.OptimalControlProblem(vp.Scene(vp.planar_chain(2), damping=0.1), cost, [0.0, 0.0], [0.0, 0.0], **given)


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_the_plan_is_within_the_wish_of_the_optimum(controls):
    """Coarse controls cost more, however well the robot follows."""
    optimum = vp.solve(reach(96, "linear"), check=False).cost
    for wish in (0.03, 3e-3):
        found = vp.solve(reach(3, controls), true_cost=wish, check=False).refinement
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
    plan = vp.solve(reach(8, hold=2), true_cost=1e-5, check=False)
    assert plan.refinement.met
    assert plan.problem.period == pytest.approx(0.25)
    assert len(plan.controls) == 4


def test_a_wish_out_of_reach_says_so():
    limited = vp.solve(reach(3), true_cost=1e-12, time_limit=0.3)
    assert not limited.refinement.met
    assert not unnamed(limited.refinement.reason, "true_cost = 1e-12")
    assert naming(limited.warnings, "true_cost")
    # A reference on the problem's own grid has no values in between.
    rows = np.ones((7, 2))
    fixed = reach(6, sampling="start").at(cost=vp.ControlCost(1.0) + vp.TrackingCost(rows, 100.0))
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

    plan = vp.solve(reach(4), true_cost=1e-9, callback=callback, check=False)
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


def test_saved_with_the_plan(tmp_path):
    plan = vp.solve(reach(4), true_cost=1e-4, check=False)
    again = vp.Solution.load(plan.save(tmp_path / "plan.npz"), plan.problem)
    assert again.refinement == plan.refinement


def test_no_plan_within_constraints():
    """A step that has none may be too coarse, so half of it is tried, too."""
    goal = vp.ReachFrame(vp.planar_chain(2), "tip", position=[1.0, 0.5, -0.5])
    far = vp.solve(reach(12, constraints=goal), true_cost=0.01, check=False)
    assert far.status is vp.Status.INFEASIBLE
    assert len(far.refinement.tried) == 2
    assert not far.refinement.met
    assert about(far.refinement.reason, "no plan within constraints")


def test_a_loss_within_the_wish_is_no_warning():
    plan = vp.solve(reach(4, "linear"), true_cost=1e-2)
    assert plan.refinement.met
    assert 2e-3 < plan.verify().closed_loop_loss < 1e-2
    assert not naming(plan.warnings, "in quarters of dt")
    assert naming(vp.solve(plan.problem, plan.controls).warnings, "in quarters of dt")


LIMITED = {"constraints": vp.WithinVelocityLimits(vp.planar_chain(2), (-2.0, 2.0))}


@pytest.mark.parametrize(
    ("problem", "wish"),
    [(reach(3), 1e-4), (reach(3, "linear"), 1e-4), (reach(12, **LIMITED), 1e-2)],
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
    beyond = max((told.closed_loop for told in truth.constraints), default=0.0)
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
    reason = vp.solve(reach(12, **LIMITED), true_cost=1e-2, check=False, callback=callback).refinement.reason
    assert not unnamed(reason, "interrupted", "violates WithinVelocityLimits on the continuous system", "rad/s", "t =")
    assert len(reason) <= 240


def test_a_search_that_fails_with_half_the_step_is_no_comparison():
    """The first plan is within the wish, but may be far above the optimum of finer controls."""

    def search(problem, _):
        if problem.steps > 12:
            raise vp.LinearizationError(0, 0.0, "of the test")
        return vp.solve(problem, check=False)

    found = refine(reach(12), search, 0.1, lambda: np.inf).refinement
    assert abs(found.tried[0].loss) <= 0.1
    assert not found.met
    assert not unnamed(found.reason, "half of dt", "of the test")
