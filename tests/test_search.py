"""The search for a plan: what changes nothing, states to start from, drives at their limits, its end."""

import contextlib
import logging
import re
import tracemalloc

import numpy as np
import pytest
from findings import about
from mechanisms import slider
from numpy.testing import assert_allclose, assert_array_equal
from oracles import kkt
from plan_problems import CAPSULES, REST, SMALL, TWO, linear, noisy, reach, small, wave
from refusals import naming, refused

import varpin as vp
from varpin.errors import UnknownName
from varpin.simulation.spectrum import rate_at_rest


def constant(value):
    return vp.CustomCost(lambda t, q, v, u: np.full(len(t), value), name="constant")


def numbers(reason):
    promise = re.search(r"expected decrease is (\S+?)[;, ]", reason)
    share = re.search(r"at stake is (\S+)$", reason)
    return float(promise[1]), float(share[1])


# --- what changes nothing --------------------------------------------------------------------------------------------

DAMPED, STEERED, STEADY = vp.Scene(TWO, damping=0.5), vp.ControlNoise(0.1), vp.AdditiveNoise
MIDPOINT = {"integrator": vp.Midpoint(), "sampling": "midpoint"}
PLAIN, RUNGE = reach(), reach(integrator=vp.RungeKutta4())
# Two problems, what may be other in their controls, and the ratio of their costs.
ALIKE = {
    "a constant": (PLAIN, PLAIN.at(cost=PLAIN.cost + constant(1e6)), 0.0, None),
    "a negative constant": (RUNGE, RUNGE.at(cost=RUNGE.cost + constant(-1e9)), 0.0, None),
    "a constant at the end": (PLAIN, PLAIN.at(cost=PLAIN.cost + vp.Terminal(constant(1e6))), 0.0, None),
    "a small scale": (PLAIN, PLAIN.at(cost=1e-6 * PLAIN.cost), 1e-9, 1e-6),
    "a large scale": (PLAIN, PLAIN.at(cost=1e6 * PLAIN.cost), 1e-9, 1e6),
    "steady noise": (reach(scene=DAMPED), reach(scene=noisy(STEADY(1.0))), 1e-9, 1.0),
    "strong noise": (reach(scene=DAMPED, **MIDPOINT), reach(scene=noisy(STEADY(1e3)), **MIDPOINT), 1e-9, 1.0),
    "noise that hides noise": (reach(scene=noisy(STEERED)), reach(scene=noisy(STEERED + STEADY(300.0))), 1e-8, 1.0),
}


@pytest.mark.parametrize("most", [4, 100], ids=["cut short", "converged"])
@pytest.mark.parametrize("name", ALIKE)
def test_what_changes_no_search(name, most):
    *problems, rtol, ratio = ALIKE[name]
    one, other = (vp.solve(problem, max_iterations=most, check=False) for problem in problems)
    assert one.status is other.status is (vp.Status.CONVERGED if most > 4 else vp.Status.MAX_ITERATIONS)
    assert [(item.step, item.rollouts) for item in one.history] == [
        (item.step, item.rollouts) for item in other.history
    ]
    assert_allclose(other.controls, one.controls, rtol=rtol, atol=rtol * np.abs(one.controls).max())
    if ratio is None:
        assert numbers(one.reason) == numbers(other.reason)
    else:
        assert other.cost == pytest.approx(ratio * one.cost, rel=1e-8)


def test_a_target_out_of_reach_does_not_loosen_the_tolerance():
    away = vp.Terminal(vp.FramePositionCost(TWO, "tip", [0.0, 0.0, 1000.0], 1.0))
    plan = vp.solve(reach(more=away), max_iterations=3, check=False)
    assert plan.cost > 0.9e6
    assert numbers(plan.reason)[1] < 1e-2 * 1e-7 * plan.cost


# --- how it ends -----------------------------------------------------------------------------------------------------


def test_wrong_derivatives_stall_and_say_so():
    def derivatives(t, q, v, u):
        return np.hstack([-2.0 * (q - 1.0), 0.0 * v, 0.2 * u]), np.diag([2.0, 2.0, 0.0, 0.0, 0.2, 0.2])[None]

    wrong = vp.CustomCost(lambda t, q, v, u: ((q - 1.0) ** 2).sum(axis=1) + 0.1 * (u**2).sum(axis=1), derivatives)
    plan = vp.solve(reach().at(cost=wrong))
    assert plan.status is vp.Status.STALLED
    assert about(plan.reason, "no lower cost")
    promise, share = numbers(plan.reason)
    assert promise > share


@pytest.mark.parametrize("problem", [reach(), reach(**MIDPOINT), RUNGE], ids=["Gauss", "midpoint", "RK4"])
def test_a_search_ends_where_rounding_begins(problem):
    best = vp.solve(problem, tolerance=1e-18)
    assert best.status.converged
    assert best.gradient == pytest.approx(0.0, abs=1e-6)
    assert vp.solve(problem, best).iterations == 0


def test_each_line_of_the_log_names_its_search(caplog):
    with caplog.at_level(logging.INFO, "varpin.control.search"):
        plans = [vp.solve(own, check=False) for own in (reach(), reach().at(t0=1.5, dt=0.03))]
    lines = [f"chain2, 12 steps of 0.06 s from t = 0 s: {item}" for item in plans[0].history]
    lines += [f"chain2, 24 steps of 0.03 s from t = 1.5 s: {item}" for item in plans[1].history]
    assert [record.getMessage() for record in caplog.records] == lines


# --- limits of controls ----------------------------------------------------------------------------------------------


def test_first_controls_are_brought_within_limits():
    problem = reach(control_limits=(-1.0, [0.5, 8.0]))
    wide = vp.LinearPolicy(np.full((12, 2), 3.0), np.zeros((12, 2, 4)), np.zeros((12, 4)))
    for begin in (np.full((12, 2), 3.0), wide):
        first = vp.solve(problem, begin, max_iterations=0, check=False).controls
        assert_array_equal(first, np.tile([0.5, 3.0], (12, 1)))
    first = vp.solve(problem, SMALL["held"].plan, max_iterations=0, check=False).controls
    assert ((first >= -1.0) & (first <= [0.5, 8.0])).all()
    assert_array_equal(problem.holding_controls(), [-1.0, -1.0])


# --- states to start from --------------------------------------------------------------------------------------------


def line(end, steps=12):
    s = np.linspace(0.0, 1.0, steps + 1)[:, None]
    return s * s * (3.0 - 2.0 * s) * np.asarray(end, dtype=float)


@pytest.mark.parametrize(
    "options",
    [{}, {"integrator": vp.RungeKutta4()}, {"hold": 4}, {"sampling": "midpoint"}, {"integrator": vp.Radau(2)}],
)
def test_a_linear_problem_takes_one_step(options):
    problem = linear(**options)
    away = np.linspace(problem.q0, [1.0, 0.5], problem.steps + 1)
    own, found = vp.solve(problem, check=False), vp.solve(problem, states=away, check=False)
    assert found.status.converged
    assert [row.step for row in found.history] == [1.0, 0.0]
    assert found.cost == pytest.approx(own.cost, rel=1e-12)
    assert_allclose(found.trajectory.q, own.trajectory.q, atol=1e-10)


def test_underactuated_under_noise():
    """Single shooting is far above after as many iterations, as the arm does not get near the goal."""
    scene = vp.Scene(TWO, damping=0.1, actuation=["joint1"], noise=vp.ControlNoise(0.1))
    problem = reach(scene=scene, dt=0.024, steps=50)
    own = vp.solve(problem, max_iterations=25, check=False)
    found = vp.solve(problem, states=line([1.0, 0.5], 50), check=False)
    assert found.status.converged
    assert found.iterations <= 25
    assert found.cost < 0.1 * own.cost
    assert problem.cost_of(problem.simulate(found.policy)) == pytest.approx(found.cost, rel=1e-9)


def test_the_first_motion_follows_the_path():
    problem, path = reach(dt=0.024, steps=50), line([1.0, 0.5], 50)
    found = vp.solve(problem, states=path, max_iterations=0, check=False)
    motion = found.trajectory
    given = [(None, path), (None, motion), (None, (motion.q, motion.v)), (found.controls, path)]
    for controls, states in given:
        again = vp.solve(problem, controls, states=states, max_iterations=0, check=False)
        assert_allclose(again.trajectory.q, path, atol=4e-3)


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_the_first_motion_of_servos_follows_the_path(controls):
    problem, path = served(1e3, controls=controls), line(GOAL, 40)
    found = vp.solve(problem, states=path, max_iterations=0, check=False)
    assert_allclose(found.trajectory.q, path, atol=2e-2)


def test_around_an_obstacle():
    """A path above the ball leads to a plan above it; the way below costs more than five times as much."""
    ball = vp.Obstacle.sphere([1.4, 0.0, -1.35], 0.15)
    problem = reach(vp.KeepClear(TWO, [ball], 0.02, capsules=CAPSULES), dt=0.024, steps=50)
    found = vp.solve(problem, states=line([1.0, 0.5], 50), check=False)
    assert found.status.converged
    assert found.violation <= 1e-6
    assert found.cost < 2.0


def test_states_in_degrees_are_told_of(caplog):
    # The motion along them may fail.
    with contextlib.suppress(vp.VarpinError):
        vp.solve(reach(), states=line([40.0, 20.0]), max_iterations=0)
    assert naming(caplog.messages, "states", "'joint1'", "40", "degrees")


OTHER = vp.simulate(vp.Scene(vp.planar_chain(1)), [0.0], [0.0], dt=0.01, steps=3)
SLOWER = vp.simulate(DAMPED, REST, REST, dt=0.12, steps=12)


@pytest.mark.parametrize(
    ("states", "options", "facts"),
    [
        (line([1.0, 0.5], 20), {}, ("(13, 2)", "(21, 2)")),
        (np.full((13, 2), np.nan), {}, "states"),
        (line([1.0, 0.5]) + np.array([0.0, 0.1]), {}, ("q0", "'joint2'", "0.1")),
        (line([90.0, 45.0]) + 30.0, {}, ("q0", "degrees")),
        ((np.zeros((13, 2)),), {}, ("states", "(1, 13, 2)")),
        ((np.zeros((13, 2)), np.zeros((12, 2))), {}, ("states", "v", "13")),
        ("path", {}, "states"),
        (OTHER, {}, "joints"),
        (SLOWER, {}, "dt"),
        (line([1.0, 0.5]), {"controls": reach().holding_policy()}, "states"),
        (line([1.0, 0.5]), {"resume": reach()}, ("states", "resume")),
    ],
)
def test_refused_states(states, options, facts):
    with refused(vp.InputError, facts):
        vp.solve(reach(), states=states, **options)


def test_a_given_first_control_stays_exactly_as_it_is():
    before = np.random.default_rng(0).uniform(-5.0, 5.0, 2)
    rates = vp.WithinControlRate(400.0, before=before)
    problem = reach(rates, vp.WithinJointLimits(TWO, ([-1, -1], [1.05, 0.6])), controls="linear")
    for options in ({"max_iterations": 2}, {}, {"states": line([1.0, 0.5])}):
        plan = vp.solve(problem, check=False, **options)
        assert_array_equal(plan.trajectory.u_nodes[0], before)
    assert plan.status.converged
    assert np.abs(np.diff(plan.controls, axis=0)).max() <= 400.0 * problem.dt * (1.0 + 1e-6)


# --- drives at their limits ------------------------------------------------------------------------------------------

GOAL, STIFFNESS, DAMPING = np.array([1.0, -0.7]), np.array([400.0, 200.0]), np.array([40.0, 15.0])


def served(effort, damping=DAMPING, begin=REST, **options):
    servos = vp.PositionServo(STIFFNESS, damping, np.array([3.0, 1.0]) * effort)
    scene = vp.Scene(TWO, forces=[servos], gravity=False)
    cost = vp.ControlCost(1e-3, reference=GOAL) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost(GOAL, 1e3) + vp.VelocityCost(10.0))
    return vp.OptimalControlProblem(scene, cost, begin, REST, dt=0.02, steps=40, **options)


def test_drives_at_their_limits_take_second_derivatives(tmp_path):
    """By first derivatives alone it takes over 200 iterations."""
    plan = vp.solve(served(35.0), check=False)
    assert plan.status.converged
    assert plan.iterations <= 40
    problem, motion = plan.problem, plan.trajectory
    demand = (STIFFNESS * (motion.u - motion.q[:-1]) - DAMPING * motion.v[:-1]) / [105.0, 35.0]
    assert np.abs(demand).max() > 1.1
    assert kkt(plan) <= 1e-4
    orders = [row.second_order for row in plan.history]
    assert (orders[0], orders[-1]) == (False, True)
    assert [str(row).endswith("*") for row in plan.history] == orders
    begun = vp.solve(problem, check=False, max_iterations=plan.iterations - 3)
    read = vp.Solution.load(begun.save(tmp_path / "plan.npz"), problem)
    assert read.history == begun.history
    assert read.search.second_order
    assert vp.solve(problem, resume=read, check=False).cost == plan.cost
    found = vp.solve(served(35.0, controls="linear"), check=False, max_iterations=100)
    assert found.status.converged
    assert found.history[-1].second_order


def test_drives_below_their_limits_change_no_search():
    below, endless = (vp.solve(served(effort), check=False) for effort in (400.0, np.inf))
    assert below.cost == pytest.approx(endless.cost, rel=1e-12)
    assert [row.step for row in below.history] == [row.step for row in endless.history]
    assert not any(row.second_order for row in below.history)


def test_dampers_of_servos_count_where_the_arm_begins():
    """A drive that is told to go to 0 from there is at its limit, and damps nothing."""
    begin = np.array([0.8, -0.5])
    problem = served(10.0, [500.0, 300.0], begin)
    M = vp.lagrangian_jet(problem.scene, begin, np.zeros(2)).Lvv
    rate = np.linalg.eigvals(np.linalg.solve(M, np.diag([500.0, 300.0]))).real.max()
    assert rate_at_rest(problem.scene, begin) == pytest.approx(rate, rel=1e-12)
    for product, chosen in ((11.0, vp.Radau(4)), (9.0, vp.Gauss(4))):
        assert problem.at(dt=product / rate, steps=2).integrator == chosen


# --- how fast it converges, what it says, where it begins, problems without an optimum -------------------------------


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


@pytest.mark.parametrize(
    ("horizon", "change", "dt", "steps"),
    [
        ({"dt": 0.02, "steps": None, "duration": 0.6}, {}, 0.02, 30),
        ({"dt": None, "steps": 30, "duration": 0.6}, {}, 0.02, 30),
        ({}, {"dt": 0.025}, 0.025, 40),
        ({}, {"duration": 2.0}, 0.05, 40),
        ({}, {"duration": 2.0, "steps": 20}, 0.1, 20),
        ({}, {"duration": 2.0, "dt": 0.1}, 0.1, 20),
        ({}, {"dt": 0.1, "steps": 40}, 0.1, 40),
    ],
)
def test_a_problem_has_the_time_that_it_is_given(horizon, change, dt, steps):
    other = small(hold=2, **horizon).at(**change)
    assert (other.dt, other.steps, other.hold) == (dt, steps, 2)
    assert other.duration == pytest.approx(dt * steps, rel=1e-15)


def test_the_same_problem_otherwise():
    problem = small(hold=2)
    assert problem.at(integrator=vp.RungeKutta4(), sampling="start", hold=5).decisions == 4
    assert_array_equal(problem.at(q0=[1, 2]).q0, [1, 2])
    moved = problem.at(q0=[1, 2], t0=1.0)
    assert moved.integrator == problem.integrator
    assert moved.integrator_by_default
    assert not problem.at(integrator=vp.Gauss(2)).integrator_by_default
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
