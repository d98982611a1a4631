"""S-DDP: how fast it converges, what it says, where it begins, and problems without an optimum."""

import re
import tracemalloc

import numpy as np
import pytest
from mechanisms import slider
from numpy.testing import assert_array_equal
from plan_problems import linear, reach, small, wave
from refusals import refused

import varpin as vp
from varpin.errors import UnknownName


def test_line_search_is_on_the_expected_cost():
    best = vp.solve(linear())
    plan = vp.solve(linear(noise=vp.ControlNoise(0.5)), best)
    assert plan.history[0].step == 1.0
    assert plan.history[0].cost > best.cost * (1 + 1e-5)
    assert plan.expected_cost < best.cost + plan.history[0].noise_cost


@pytest.mark.parametrize("sampling", ["midpoint", "gauss", "start"])
def test_rest_costs_no_velocities(sampling):
    """Not even those of rounding: a search weighs constraints by what is at stake."""
    at = np.random.default_rng(0).normal(size=4)
    given = {"q0": at, "v0": np.zeros(4), "dt": 0.03, "steps": 20, "sampling": sampling}
    problem = vp.OptimalControlProblem(vp.Scene(vp.planar_chain(4)), vp.VelocityCost(1.0), **given)
    assert problem.costs(np.tile(at, (21, 1)), np.zeros((21, 4)), np.zeros((20, 4))) == 0.0


@pytest.mark.parametrize(("sampling", "hold"), [("midpoint", 1), ("gauss", 1), ("start", 1), ("midpoint", 5)])
def test_quadratic_convergence(sampling, hold):
    """Each promised decrease is the square of the one before, in units."""
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(0.01)
    cost += vp.Terminal(vp.TrackingCost([-np.pi / 2, 0.0], 50.0) + vp.VelocityCost(5.0))
    # From upright to hanging in a second.
    given = {"dt": 0.02, "steps": 50, "integrator": vp.Midpoint(), "sampling": sampling, "hold": hold}
    problem = vp.OptimalControlProblem(vp.Scene(vp.planar_chain(2)), cost, [np.pi / 2, 0.0], [0, 0], **given)
    newton = vp.solve(problem, second_order=True, tolerance=1e-15, max_iterations=200)
    gauss = vp.solve(problem, tolerance=1e-13, max_iterations=200)
    assert newton.status is gauss.status is vp.Status.CONVERGED
    assert newton.cost == pytest.approx(gauss.cost, rel=1e-12)
    promised = np.log([item.expected_decrease / newton.cost for item in newton.history])
    assert promised[-1] < np.log(1e-14)
    # Rounding may limit the last.
    assert max(promised[-1] / promised[-2], promised[-2] / promised[-3]) > 1.6
    linear = np.log([item.expected_decrease / gauss.cost for item in gauss.history])
    assert linear[-1] / linear[-2] < 1.1
    # Far from the optimum both go alike; it is near it that Newton's method takes fewer iterations.
    near = np.log(1e-5)
    assert (promised < near).sum() <= 0.6 * (linear < near).sum()


def test_iterations_do_not_depend_on_dt():
    found = [vp.solve(wave().at(dt=dt), check=False).iterations for dt in (0.04, 0.01, 0.002)]
    assert max(found) - min(found) <= 2


def test_reason_gives_the_numbers_behind_the_status():
    for most, status in ((500, vp.Status.CONVERGED), (1, vp.Status.MAX_ITERATIONS)):
        plan = vp.solve(reach(), tolerance=1e-6, max_iterations=most)
        assert plan.status is status
        promise, tolerance = (float(part) for part in re.findall(r"\d\.\de[+-]\d\d", plan.reason))
        assert promise == pytest.approx(plan.history[-1].expected_decrease, rel=0.06)
        assert tolerance == pytest.approx(1e-6 * plan.cost, rel=0.06)
        assert (promise <= tolerance) == plan.status.converged


def test_a_cost_of_nothing_is_an_optimum_also_where_the_controls_are_not_unique():
    """A goal alone: many controls reach it, so the model needs regularization."""
    goal = vp.Terminal(vp.TrackingCost([0.3, 0.1]))
    problem = vp.OptimalControlProblem(
        vp.Scene(vp.planar_chain(2), gravity=False), goal, np.zeros(2), np.zeros(2), dt=0.01, steps=50
    )
    sol = vp.solve(problem)
    assert sol.status.converged
    assert sol.cost < 1e-16 * 0.1
    assert sol.iterations < 10
    there = problem.at(q0=[0.3, 0.1])
    assert vp.solve(there, np.zeros(2)).status is vp.Status.CONVERGED
    assert vp.solve(there, np.zeros(2)).iterations == 0
    # A cost of one's own may go below nothing, and where it starts at 0 that is no optimum.
    below = vp.CustomCost(lambda t, q, v, u: u[:, 0] + (u**2).sum(axis=1))
    own = vp.solve(small(below), np.zeros(2))
    assert own.cost < -0.1 * own.problem.duration


def test_no_minimum():
    for actuation, cost in (([[0.0], [0.0]], vp.TrackingCost(0.0)), (None, vp.TrackingCost(0.0))):
        problem = small(cost, actuation=actuation, sampling="start")
        sol = vp.solve(problem)
        assert sol.status is vp.Status.INDEFINITE
        assert "ControlCost" in sol.status.value
        assert sol.iterations == 0
        assert sol.cost == problem.cost_of(sol.trajectory)
        assert_array_equal(sol.gains, 0.0)
    # Where a midpoint is looked at, the last control does something.
    assert vp.solve(small(vp.TrackingCost(0.0), sampling="midpoint")).status is vp.Status.CONVERGED


def test_idle_actuator():
    cost = vp.TrackingCost(0.0) + vp.ControlCost([0.1, 0.0])
    sol = vp.solve(small(cost, actuation=[[1.0, 0.0], [0.5, 0.0]]), controls=[0.0, 0.7])
    assert sol.status.converged
    assert_array_equal(sol.controls[:, 1], 0.7)


def test_first_motion_that_cannot_be_integrated():
    scene, cost = vp.Scene(slider(), gravity=False, stiffness=1e9), vp.TrackingCost(0.0) + vp.ControlCost(1.0)
    problem = vp.OptimalControlProblem(scene, cost, [0.3], [0], dt=0.05, steps=400, integrator=vp.ExplicitEuler())
    with refused(vp.StepFailure, "finite") as caught:
        vp.solve(problem, controls=[0.0])
    assert 0 < caught.value.trajectory.steps < 400
    assert caught.value.step == caught.value.trajectory.steps
    assert np.isfinite(caught.value.trajectory.q).all()


def test_cost_that_is_not_finite():
    never = vp.CustomCost(lambda t, q, v, u: np.where(t > 0.5, np.nan, 0.0), name="never")
    with refused(vp.CostError, "CustomCost('never')", "nan"):
        vp.solve(small(vp.ControlCost(1.0) + never))
    with refused(vp.CostError, "Terminal(CustomCost('end'))", "inf"):
        vp.solve(
            small(vp.ControlCost(1.0) + vp.Terminal(vp.CustomCost(lambda t, q, v, u: np.inf + 0.0 * t, name="end")))
        )
    far = vp.CustomCost(lambda t, q, v, u: np.where(q[:, 0] > 0.8, np.nan, (q[:, 0] - 1.0) ** 2), name="far")
    problem = small(vp.ControlCost(1e-3) + far)
    sol = vp.solve(problem)
    assert np.isfinite(sol.cost)
    assert sol.cost < vp.solve(problem, max_iterations=0).cost


def test_heavy_regularization_is_not_mistaken_for_an_optimum():
    assert vp.solve(small(), regularization=1e12).cost == pytest.approx(vp.solve(small()).cost, rel=1e-6)
    assert vp.solve(small(), regularization=1e12, max_iterations=0).status is vp.Status.MAX_ITERATIONS


def test_warm_starts():
    plan = vp.solve(wave(), tolerance=1e-10)
    problem, cold = plan.problem, plan.iterations
    # From another state the policy is a better start than its controls.
    moved = problem.at(q0=problem.q0 + 0.05)
    by_policy, by_controls = (vp.solve(moved, start, max_iterations=0).cost for start in (plan, plan.controls))
    assert by_policy < by_controls
    assert vp.solve(moved, plan, tolerance=1e-10).iterations < cold
    # The next horizon.
    later = problem.at(q0=plan.trajectory.q[1], v0=plan.trajectory.v[1])
    shifted = plan.shifted(1)
    assert_array_equal(shifted.u, plan.controls[[*range(1, 10), 9]])
    assert_array_equal(shifted.gains[:-1], plan.gains[1:])
    assert vp.solve(later, shifted, tolerance=1e-10).iterations <= cold
    assert len(plan.shifted(9).u) == problem.decisions


def test_the_same_problem_otherwise():
    problem = small(hold=2)
    finer = problem.at(dt=0.025)
    assert (finer.steps, finer.dt, finer.hold) == (40, 0.025, 2)
    assert finer.duration == problem.duration
    longer = problem.at(dt=0.1, steps=40)
    assert longer.duration == pytest.approx(4.0)
    assert problem.at(integrator=vp.RungeKutta4(), sampling="start", hold=5).decisions == 4
    assert_array_equal(problem.at(q0=[1, 2]).q0, [1, 2])
    for dt in (0.3, 3.0):
        with refused(vp.InputError, "dt"):
            problem.at(dt=dt)
    for dt in (-0.1, "fast"):
        with refused(vp.InputError, "dt"):
            problem.at(dt=dt)
    for value in (None, 30):
        with refused(UnknownName, "'stpes'", "'steps'"):
            problem.at(stpes=value)
    rows = vp.TrackingCost(np.zeros((21, 2)))
    with refused(vp.InputError, "(41, 2)"):
        small(rows).at(dt=0.025)


@pytest.mark.parametrize(("noise", "most"), [(None, 4e3), (vp.ControlNoise(0.05), 10e3)], ids=["quiet", "noisy"])
def test_memory(noise, most):
    """Bytes a node at three joints, of the search with all its expansions, and of the plan alone."""
    peaks, kept = [], []
    for steps in (5000, 20000):
        problem = wave(scene=vp.Scene(vp.planar_chain(3), noise=noise), dt=1e-4, steps=steps, integrator=vp.Midpoint())
        problem = problem.at(sampling="midpoint")
        tracemalloc.start()
        plan = vp.solve(problem, max_iterations=1, check=False)
        for sizes, size in zip((kept, peaks), tracemalloc.get_traced_memory(), strict=True):
            sizes.append(size)
        tracemalloc.stop()
        del plan
    assert (peaks[1] - peaks[0]) / 15000 < most
    assert (kept[1] - kept[0]) / 15000 < 500.0
