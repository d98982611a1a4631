"""The search for a plan: what its trials may take, when it ends; constants, scales and steady noise change nothing."""

import importlib
import logging
import re
from collections import Counter

import numpy as np
import pinocchio as pin
import pytest
from findings import about

import varpin as vp
from varpin.control import line_search, search
from varpin.control.backward import backward
from varpin.control.descent import at_stake
from varpin.control.following import Foresight
from varpin.control.line_search import LineSearch
from varpin.control.search import Search
from varpin.control.trials import Trials
from varpin.control.watchdog import Watchdog
from varpin.core import Watch, stake_of
from varpin.signals.commands import open_loop

GOAL = [0.8, -0.5]


def reach(*extra, factor=1.0, noise=None, **options):
    """Two links to a posture in a second."""
    scene = vp.Scene(vp.planar_chain(2), damping=0.1, noise=noise)
    end = vp.Terminal(vp.TrackingCost(GOAL, 1e3) + vp.VelocityCost(10.0))
    cost = factor * (vp.ControlCost(1e-2) + vp.VelocityCost(0.1) + end)
    for term in extra:
        cost = cost + term
    return vp.OptimalControlProblem(scene, cost, [0.0, 0.0], [0.0, 0.0], **{"dt": 0.02, "steps": 50, **options})


# These grids are coarse for the midpoint rule.
MIDPOINT = {"integrator": vp.Midpoint(), "sampling": "midpoint"}


def swing(steps):
    """A swing on a grid so coarse that steps are taken in parts: up to 7 with 20 steps."""
    end = vp.TrackingCost([-np.pi / 2, 0.0], 100.0) + vp.VelocityCost(5.0)
    cost = vp.ControlCost(0.1) + vp.VelocityCost(0.01) + vp.Terminal(end)
    scene = vp.Scene(vp.planar_chain(2))
    return vp.OptimalControlProblem(scene, cost, [np.pi / 2, 0.0], [0, 0], dt=2.0 / steps, steps=steps, **MIDPOINT)


def tool_reach(name="xarm7", steps=50):
    """A redundant arm brings its tool to a place, with little on the controls: early trials run wild."""
    robot = vp.load_robot(name)
    lower, upper = robot.position_limits
    rng = np.random.default_rng(0)
    begin = np.clip(0.5 * (lower + upper), -1.5, 1.5) + rng.uniform(-0.3, 0.3, robot.dof)
    model = robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, begin + rng.uniform(-0.5, 0.5, robot.dof))
    frame = model.frames[model.nframes - 1].name
    place = data.oMf[model.nframes - 1].translation.copy()
    end = vp.FramePositionCost(robot, frame, place, 1e4) + vp.VelocityCost(10.0)
    cost = vp.ControlCost(1e-3) + vp.Terminal(end)
    rest = np.zeros(robot.dof)
    return vp.OptimalControlProblem(vp.Scene(robot), cost, begin, rest, dt=1.0 / steps, steps=steps)


def constant(value):
    return vp.CustomCost(lambda t, q, v, u: np.full(len(t), value), name="constant")


def numbers(reason):
    """The expected decrease and the tolerance on it."""
    promise = re.search(r"expected decrease is (\S+?)[;, ]", reason)
    share = re.search(r"at stake is (\S+)$", reason)
    return float(promise[1]), float(share[1])


def assert_same_search(one, other, rtol=0.0):
    assert one.status is other.status
    assert [item.step for item in one.history] == [item.step for item in other.history]
    assert [item.rollouts for item in one.history] == [item.rollouts for item in other.history]
    np.testing.assert_allclose(other.controls, one.controls, rtol=rtol, atol=rtol * np.abs(one.controls).max())


GRIDS = {
    "midpoint": {},
    "gauss": {"integrator": vp.Gauss(stages=2), "sampling": "gauss"},
    "rk4": {"integrator": vp.RungeKutta4(), "sampling": "gauss"},
}


# Constants, scales and noise


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("extra", [constant(1e6), constant(-1e9), vp.Terminal(constant(1e6))], ids=repr)
def test_a_constant_changes_nothing(extra, grid):
    plain, other = vp.solve(reach(**GRIDS[grid])), vp.solve(reach(extra, **GRIDS[grid]))
    assert plain.status is vp.Status.CONVERGED
    assert_same_search(plain, other)
    assert numbers(plain.reason) == numbers(other.reason)


@pytest.mark.parametrize("value", [1e6, -1e6])
def test_a_constant_inside_a_cost_of_ones_own_changes_nothing(value):
    hessian = np.diag([2.0, 2.0, 0.0, 0.0, 0.2, 0.2])[None]

    def problem(offset):
        def function(t, q, v, u):
            return offset + ((q - GOAL) ** 2).sum(axis=1) + 0.1 * (u**2).sum(axis=1)

        def derivatives(t, q, v, u):
            return np.hstack([2.0 * (q - GOAL), 0.0 * v, 0.2 * u]), hessian

        scene = vp.Scene(vp.planar_chain(2), damping=0.1)
        return vp.OptimalControlProblem(scene, vp.CustomCost(function, derivatives), [0, 0], [0, 0], dt=0.02, steps=50)

    plain = vp.solve(problem(0.0))
    assert plain.status is vp.Status.CONVERGED
    assert_same_search(plain, vp.solve(problem(value)), rtol=1e-9)
    # The same as costs that varpin knows.
    known = vp.TrackingCost(GOAL) + vp.ControlCost(0.1)
    scene = vp.Scene(vp.planar_chain(2), damping=0.1)
    known = vp.solve(vp.OptimalControlProblem(scene, known, [0, 0], [0, 0], dt=0.02, steps=50))
    assert_same_search(known, plain, rtol=1e-9)


def test_a_long_chain_converges_with_the_defaults():
    # Five links, undamped, with an end ten thousand times dearer than their torques.
    rng = np.random.default_rng(501)
    begin = rng.uniform(-1.0, 1.0, 5)
    end = vp.TrackingCost(begin + rng.uniform(-1.2, 1.2, 5), 1e4) + vp.VelocityCost(1e3)
    cost = vp.ControlCost(1e-2) + vp.Terminal(end)
    scene = vp.Scene(vp.planar_chain(5))
    plan = vp.solve(vp.OptimalControlProblem(scene, cost, begin, np.zeros(5), dt=0.05, steps=20), check=False)
    assert plan.status is vp.Status.CONVERGED
    assert plan.iterations > 100


@pytest.mark.parametrize("factor", [1e-6, 1e6])
@pytest.mark.parametrize("most", [4, 100], ids=["cut short", "converged"])
def test_scaling_a_cost_changes_nothing(factor, most):
    plain = vp.solve(reach(), max_iterations=most)
    other = vp.solve(reach(factor=factor), max_iterations=most)
    assert_same_search(plain, other, rtol=1e-9)
    assert other.cost == pytest.approx(factor * plain.cost, rel=1e-9)


def test_constants_and_scales_change_nothing_where_a_search_stalls():
    plain = vp.solve(swing(50))
    assert plain.status is vp.Status.STALLED
    problem = swing(50)
    scale = 2.0**-20
    cost = scale * problem.cost + constant(1e6)
    other = vp.OptimalControlProblem(
        problem.scene, cost, problem.q0, problem.v0, dt=problem.dt, steps=problem.steps, **MIDPOINT
    )
    assert_same_search(plain, vp.solve(other))


@pytest.mark.parametrize("strength", [1.0, 1e3])
@pytest.mark.parametrize("grid", ["midpoint", "gauss"])
def test_additive_noise_changes_no_plan(strength, grid):
    """However much it adds to the cost: 1e7 times that of the motion."""
    quiet = vp.solve(reach(**GRIDS[grid]))
    noisy = vp.solve(reach(noise=vp.AdditiveNoise(strength), **GRIDS[grid]))
    assert noisy.noise_cost > strength**2 * quiet.cost
    assert_same_search(quiet, noisy, rtol=1e-9)


def test_additive_noise_hides_nothing_of_noise_that_controls_steer():
    one = vp.solve(reach(noise=vp.ControlNoise(0.1)))
    both = vp.solve(reach(noise=vp.ControlNoise(0.1) + vp.AdditiveNoise(300.0)))
    assert one.status is vp.Status.CONVERGED
    assert both.noise_cost > 1e5 * one.noise_cost
    assert_same_search(one, both, rtol=1e-8)


# What is at stake


def test_what_is_at_stake_of_squares_is_their_value():
    problem = reach(vp.ControlRateCost(0.1))
    motion = vp.solve(problem, max_iterations=2).trajectory
    model = backward(problem, motion, 0.0).model
    stake = at_stake(problem, motion, model)
    assert stake.free == pytest.approx(problem.cost_of(motion), rel=1e-12)
    assert 0.0 < stake.moved <= stake.free
    more = reach(vp.ControlRateCost(0.1), constant(7.0), vp.Terminal(constant(-3.0)))
    model = backward(more, motion, 0.0).model
    assert at_stake(more, motion, model).free == pytest.approx(stake.free, rel=1e-12)


def test_the_stake_of_any_models_is_that_of_the_definition():
    """Equation (O9), point by point; one model has a minimum that a step misses, one has none."""
    rng = np.random.default_rng(0)
    root, g, z = rng.normal(size=(6, 4, 4)), rng.normal(size=(6, 4)), rng.normal(size=(6, 4))
    H = root @ np.swapaxes(root, 1, 2)
    H[1], g[1] = np.diag([2.0, 3.0, 0.0, 1.0]), [1.0, -1.0, 0.0, 2.0]
    H[2] = -H[2]
    H[3], g[3] = 0.0, 0.0
    free, moved = [], []
    for one, slope, displacement in zip(H, g, z, strict=True):
        diagonal = np.diag(one)
        curved = diagonal > 0.0
        step = -np.divide(slope, diagonal, out=np.zeros(4), where=curved)
        bound = max(0.5 * displacement @ one @ displacement, 0.0)
        # The model along the step is least where its derivative is zero.
        fall = 0.0 if slope @ step == 0.0 else 0.5 * (slope @ step) ** 2 / (step @ one @ step)
        free.append(np.inf if (slope[~curved] != 0.0).any() else fall)
        moved.append(min(free[-1], bound))
    assert stake_of(g, H, z) == (np.inf, pytest.approx(sum(moved), rel=1e-12))
    bounded = [0, 1, 3, 4, 5]
    found = stake_of(g[bounded], H[bounded], z[bounded])
    assert found == pytest.approx((sum(free[k] for k in bounded), sum(moved[k] for k in bounded)), rel=1e-12)
    alone = [stake_of(g[k : k + 1], H[:1], z[k : k + 1]) for k in range(6)]
    assert stake_of(g, H[:1], z) == pytest.approx(tuple(np.sum(alone, axis=0)), rel=1e-12)


def test_a_target_out_of_reach_does_not_loosen_the_tolerance():
    """1000 m away: 1e6 of the cost is there to stay."""
    robot = vp.load_robot("ur5")
    cost = vp.ControlCost(1e-3) + vp.VelocityCost(0.1)
    cost += vp.Terminal(vp.FramePositionCost(robot, "tool0", [0.0, 1000.0, 0.5], 1.0) + vp.VelocityCost(10.0))
    begin = [0.0, -1.5, 0.8, -0.5, 0.0, 0.0]
    problem = vp.OptimalControlProblem(vp.Scene(robot, damping=1.0), cost, begin, np.zeros(6), dt=0.02, steps=50)
    sol = vp.solve(problem, max_iterations=3)
    assert sol.cost > 0.9e6
    assert numbers(sol.reason)[1] < 1e-2 * 1e-7 * sol.cost


def test_shares_add_up_to_the_cost():
    problem = reach(constant(2.0), vp.ControlRateCost(0.3), vp.Terminal(constant(-3.0)), hold=5, sampling="gauss")
    motion = vp.solve(problem, max_iterations=1).trajectory
    assert problem.cost_of(motion) == pytest.approx(problem.costs(motion.q, motion.v, motion.u), rel=1e-13)


# How it ends


def test_a_stalled_search_gives_numbers_that_agree():
    told = []
    for steps in (50, 79, 82):
        sol = vp.solve(swing(steps))
        assert sol.status is vp.Status.STALLED
        promise, share = numbers(sol.reason)
        assert promise > share
        # The promise is that of the motion that is returned, not of some regularization.
        assert promise == pytest.approx(backward(sol.problem, sol.trajectory, 0.0).expected_decrease, rel=0.06)
        gained = re.match(r"15 iterations have lowered the expected cost by (\S+);", sol.reason)
        if gained is None:
            continue
        told.append(steps)
        assert float(gained[1]) <= share
        # Without the iterations that were away from the best motion.
        costs = np.array([item.cost for item in sol.history])
        costs = costs[costs <= np.minimum.accumulate(costs)]
        # A search that would end looks once more with its bounds lifted, and that look may have a row. Returns from
        # departures are among the 15. Two digits are printed.
        falls = [pytest.approx(costs[-row] - costs[-1], rel=0.05) for row in range(4, 18)]
        assert float(gained[1]) in falls
    # How rounding falls decides which of them end so.
    assert told


def test_wrong_derivatives_stall_and_say_so():
    def derivatives(t, q, v, u):
        return np.hstack([-2.0 * (q - 1.0), 0.0 * v, 0.2 * u]), np.diag([2.0, 2.0, 0.0, 0.0, 0.2, 0.2])[None]

    wrong = vp.CustomCost(lambda t, q, v, u: ((q - 1.0) ** 2).sum(axis=1) + 0.1 * (u**2).sum(axis=1), derivatives)
    scene = vp.Scene(vp.planar_chain(2), damping=0.1)
    sol = vp.solve(vp.OptimalControlProblem(scene, wrong, [0, 0], [0, 0], dt=0.02, steps=50))
    assert sol.status is vp.Status.STALLED
    assert about(sol.reason, "no lower cost")
    promise, share = numbers(sol.reason)
    assert promise > share


@pytest.mark.parametrize("grid", GRIDS)
def test_a_search_ends_where_rounding_begins(grid):
    """No tolerance is too small."""
    problem = reach(**GRIDS[grid])
    best = vp.solve(problem, tolerance=1e-18)
    assert best.status is vp.Status.CONVERGED
    assert best.gradient == pytest.approx(0.0, abs=1e-6)
    assert vp.solve(problem, best).iterations == 0


@pytest.mark.parametrize("at", [[0.0, 0.0], [0.3, -1.2]])
def test_a_search_that_begins_at_the_optimum_ends_there(at):
    """At rest at the goal, where gravity does nothing."""
    scene = vp.Scene(vp.planar_chain(2), gravity=False)
    cost = vp.TrackingCost(at, 10.0) + vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost(at, 10.0))
    sol = vp.solve(vp.OptimalControlProblem(scene, cost, at, [0, 0], dt=0.02, steps=50))
    assert sol.status is vp.Status.CONVERGED
    assert sol.iterations == 0
    assert sol.cost == 0.0


# What trials may take


def work(monkeypatch, problem, **options):
    """A solution, and the parts that all of its motions took."""
    parts = []
    own = type(problem.integrator).watched

    def counted(self, scene, state, commands, dt, nodes, *others):
        found = own(self, scene, state, commands, dt, nodes, *others)
        parts.append(int(nodes.tally[0, : nodes.done[0], 3].sum()))
        return found

    with monkeypatch.context() as patch:
        patch.setattr(type(problem.integrator), "watched", counted)
        return vp.solve(problem, **options), sum(parts)


def test_an_iteration_linearizes_once_and_integrates_each_trial_once(monkeypatch):
    calls = Counter()

    def count(holder, name):
        own = getattr(holder, name)

        def counted(*args, **kwargs):
            calls[name] += 1
            return own(*args, **kwargs)

        monkeypatch.setattr(holder, name, counted)

    count(importlib.import_module("varpin.integrators.variational"), "variational_derivatives")
    count(importlib.import_module("varpin.control.along"), "velocity_at_nodes")
    count(vp.OptimalControlProblem, "expand_running")
    count(Trials, "attempt")
    plan = vp.solve(reach(), check=False)
    assert plan.status.converged
    iterations, trials = len(plan.history), sum(item.rollouts for item in plan.history)
    assert 3 < iterations <= trials + 1
    assert calls["variational_derivatives"] == calls["velocity_at_nodes"] == calls["expand_running"] == iterations
    assert calls["attempt"] == 1 + trials


@pytest.mark.slow
def test_trials_that_are_cut_to_pieces_are_given_up(monkeypatch):
    problem = tool_reach()
    sol, parts = work(monkeypatch, problem, max_iterations=12)
    with monkeypatch.context() as patch:
        patch.setattr("varpin.control.trials.HALVINGS", problem.integrator.guard.max_halvings)
        patch.setattr(line_search, "_PARTS", np.inf)
        unbounded, all_parts = work(monkeypatch, problem, max_iterations=12)
    assert parts < 0.4 * all_parts
    assert sol.cost <= 1.01 * unbounded.cost


@pytest.mark.parametrize("steps", [20, 30])
def test_what_was_given_up_is_tried_again_where_nothing_else_helps(steps, monkeypatch):
    """With no halvings to begin with, motions that need them are found all the same."""
    free = vp.solve(swing(steps))
    monkeypatch.setattr("varpin.control.trials.HALVINGS", 0)
    monkeypatch.setattr(line_search, "HALVINGS", 0)
    monkeypatch.setattr(line_search, "MORE_HALVINGS", 0)
    bounded = vp.solve(swing(steps))
    assert bounded.trajectory.statistics.substeps.max() > 1
    assert bounded.cost <= 1.05 * free.cost
    assert not bounded.search.bounded


ARRAYS = ("q", "v", "p", "u", "energy")


@pytest.mark.parametrize("hold", [1, 5])
@pytest.mark.parametrize("grid", GRIDS)
def test_a_trial_is_the_motion_of_a_simulation_and_its_cost(grid, hold):
    problem = reach(vp.ControlRateCost(0.1), hold=hold, **GRIDS[grid])
    policy = vp.solve(problem, max_iterations=2).policy
    moved = problem.at(q0=problem.q0 + 0.1)
    attempt = Trials(moved).attempt(policy.commands(problem.steps, 2, 2, problem.integrator.variational))
    whole, motion = moved.simulate(policy), attempt.trajectory()
    assert attempt.whole
    for name in ARRAYS:
        assert getattr(whole, name).tobytes() == getattr(motion, name).tobytes()
    for name, own in vars(whole.statistics).items():
        np.testing.assert_array_equal(own, getattr(motion.statistics, name))
    np.testing.assert_array_equal(attempt.shares(), moved.shares(whole))


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4(), vp.Reference()])
def test_a_trial_ends_where_it_costs_too_much(integrator):
    """Where the sum of its running cost passes a bound, and never in the first third."""
    problem = reach(integrator=integrator, sampling="gauss")
    trials, commands = Trials(problem), open_loop(np.ones((50, 2)))
    whole = trials.attempt(commands)
    motion = whole.trajectory()
    running = [
        problem.at(steps=steps).costs(motion.q[: steps + 1], motion.v[: steps + 1], motion.u[:steps])
        - problem.terminal.value(motion.q[steps : steps + 1], motion.v[steps : steps + 1], np.zeros((1, 2)))[0]
        for steps in range(1, 51)
    ]
    for steps in (5, 16, 30, 50):
        attempt = trials.attempt(commands, most=running[steps - 1] * (1.0 - 1e-9))
        assert attempt.verdict is Watch.Verdict.dear
        assert attempt.trajectory().steps == max(steps, 16)
        for name in ARRAYS:
            kept = getattr(attempt.trajectory(), name)
            assert kept.tobytes() == getattr(motion, name)[: len(kept)].tobytes()
        assert not attempt.whole
        assert steps < 16 or trials.attempt(commands, most=running[-1] * (1.0 + 1e-9)).whole


def test_a_trial_ends_where_its_first_third_takes_too_many_parts():
    problem = reach()
    attempt = Trials(problem).attempt(open_loop(np.zeros((50, 2))), parts=15)
    assert attempt.verdict is Watch.Verdict.cut
    assert attempt.trajectory().steps == 16
    assert Trials(problem).attempt(open_loop(np.zeros((50, 2))), parts=16).whole


def test_trials_that_cost_too_much_already_are_given_up(monkeypatch):
    """Those of a motion that runs off end early, and the plan is the same."""
    lengths = []
    own = Trials.attempt
    bounded = True

    def watched(self, commands, *, most=np.inf, **options):
        attempt = own(self, commands, most=most if bounded else np.inf, **options)
        lengths.append((attempt.trajectory().steps, attempt.verdict))
        return attempt

    robot = vp.planar_chain(2)
    cost = vp.TrackingCost(GOAL, 100.0) + vp.ControlCost(1e-6)
    problem = vp.OptimalControlProblem(
        vp.Scene(robot), cost, [2.5, 2.0], [0, 0], dt=0.02, steps=50, integrator=vp.RungeKutta4(), sampling="gauss"
    )
    monkeypatch.setattr(Trials, "attempt", watched)
    sol = vp.solve(problem, forward="open", max_iterations=30)
    dear = [steps for steps, verdict in lengths if verdict is Watch.Verdict.dear]
    assert dear
    assert min(dear) == 16
    bounded = False
    lengths.clear()
    assert_same_search(vp.solve(problem, forward="open", max_iterations=30), sol)
    assert all(verdict is Watch.Verdict.going for _, verdict in lengths)


def test_each_line_of_the_log_names_its_search(caplog):
    problem = vp.OptimalControlProblem(
        vp.Scene(vp.load_robot("finger")), vp.TrackingCost([0.3, 0.2, 0.1]) + vp.ControlCost(1e3), np.zeros(3),
        np.zeros(3), dt=0.01, steps=5,
    )  # fmt: skip
    with caplog.at_level(logging.INFO, "varpin.control.search"):
        plans = [vp.solve(own, check=False) for own in (problem, problem.at(t0=1.5, dt=0.005))]
    lines = [f"finger, 5 steps of 0.01 s from t = 0 s: {item}" for item in plans[0].history]
    lines += [f"finger, 10 steps of 0.005 s from t = 1.5 s: {item}" for item in plans[1].history]
    assert [record.getMessage() for record in caplog.records] == lines


@pytest.fixture
def in_controls_alone(monkeypatch):
    """Searches whose trials do not follow foreseen states."""
    monkeypatch.setattr(Foresight, "possible", False)


def swing_up(*, change=None, **options):
    """Two links swing up: without second derivatives of the dynamics the model is too steep."""
    swing = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    swing += vp.Terminal(vp.TrackingCost([-np.pi / 2, 0.0], 1e3) + vp.VelocityCost(1e2))
    if change is not None:
        swing += vp.ControlRateCost(change)
    options = {"dt": 0.05, "steps": 40, "integrator": vp.RungeKutta4(), "control_limits": (-20.0, 20.0)} | options
    return vp.OptimalControlProblem(vp.Scene(vp.planar_chain(2)), swing, [np.pi / 2, 0.0], np.zeros(2), **options)


def test_a_step_is_extended_while_the_cost_falls_on():
    plan = vp.solve(swing_up(dt=0.04, steps=50), tolerance=1e-4, check=False)
    assert plan.status.converged
    rows = plan.history
    extended = [k for k, row in enumerate(rows) if row.step > 1.0]
    assert {rows[k].step for k in extended} == {2.0, 4.0}
    for k in extended:
        # More than the full step, which brought 1.7 times what the model expects and more.
        assert rows[k].decrease > 1.7 * rows[k].expected_decrease
        # By two along the parabola through the last motions, which are those of full steps.
        assert rows[k].step == 4.0 or rows[k - 1].step == 1.0
    costs = [row.cost for row in rows]
    assert costs == sorted(costs, reverse=True)


@pytest.mark.parametrize(
    "options",
    [{}, {"hold": 2}, {"controls": "linear"}, {"change": 1e-4}, {"integrator": vp.Gauss(2)}],
    ids=["held", "over two steps", "linear", "change of controls", "momenta"],
)
def test_longer_steps_go_along_the_parabola_through_the_last_motions(monkeypatch, options):
    """With the states and controls of the parabola, by NumPy's fit of three motions."""
    given, bent = [], LineSearch._bent

    def noted(self, behind, ahead, start, here):
        given.append(([behind, start.trajectory, ahead], bent(self, behind, ahead, start, here)))
        return given[-1][1]

    monkeypatch.setattr(LineSearch, "_bent", noted)
    problem = swing_up(**options)
    plan = vp.solve(problem, tolerance=1e-4, check=False)
    assert plan.status.converged
    assert any(row.step == 2.0 for row in plan.history)
    assert given
    for motions, commands in given:
        second = "p" if problem.integrator.variational else "v"
        states = [np.hstack([motion.q, getattr(motion, second)])[: -1 : problem.hold] for motion in motions]
        reference = commands.reference[:, :4]
        for found, through in ((commands.u, map(problem.decided, motions)), (reference, states)):
            at = np.array([each.ravel() for each in through])
            wanted = np.array([4.0, 2.0, 1.0]) @ np.polyfit([-1.0, 0.0, 1.0], at, 2)
            np.testing.assert_allclose(found.ravel(), wanted, rtol=0, atol=1e-12 * np.abs(at).max())


@pytest.mark.parametrize("iterations", [17, 20, 23, 26])
def test_a_given_first_control_stays_exactly_as_it_is(iterations):
    before = np.random.default_rng(0).uniform(-5.0, 5.0, 2)
    problem = swing_up(controls="linear", constraints=[vp.WithinControlRate(400.0, before=before)])
    plan = vp.solve(problem, max_iterations=iterations, check=False)
    assert any(row.step == 2.0 for row in plan.history)
    np.testing.assert_array_equal(plan.search.trajectory.u_nodes[0], before)


def test_the_parabola_through_the_last_motions_saves_iterations(monkeypatch):
    def iterations():
        plans = [
            vp.solve(problem, tolerance=1e-4, check=False)
            for problem in (swing_up(steps=N, dt=2.0 / N) for N in (28, 30, 32, 36, 40))
        ]
        assert all(plan.cost < 1.005 for plan in plans)
        return sum(plan.iterations for plan in plans)

    found = iterations()
    monkeypatch.setattr(Search, "_behind", lambda _: None)
    assert found < 0.97 * iterations()


@pytest.mark.parametrize("into", [0, 1])
def test_a_resumed_search_knows_the_motion_behind(into, tmp_path):
    problem = swing_up()
    whole = vp.solve(problem, tolerance=1e-4, check=False)
    bent = next(k for k, row in enumerate(whole.history) if row.step == 2.0)
    part = vp.solve(problem, tolerance=1e-4, max_iterations=bent + into, check=False)
    assert (part.search.behind is None) == (into == 1)
    part.save(tmp_path / "part.npz")
    read = vp.Solution.load(tmp_path / "part.npz", problem)
    for known in (part, read):
        assert_same_search(whole, vp.solve(problem, resume=known, tolerance=1e-4, check=False))


def valley():
    """Four links reach with little on the controls and much on the end: long steps along the model miss it."""
    end = vp.Terminal(vp.TrackingCost([1.0, -1.5, 1.0, -0.5], 1e4) + vp.VelocityCost(1e3))
    options = {"dt": 1.0 / 30, "steps": 30, "integrator": vp.Gauss(2)}
    scene = vp.Scene(vp.planar_chain(4))
    return vp.OptimalControlProblem(scene, vp.ControlCost(1e-3) + end, np.zeros(4), np.zeros(4), **options)


@pytest.mark.usefixtures("in_controls_alone")
def test_a_watchdog_saves_iterations_and_leads_to_the_same_plan(monkeypatch):
    watched = vp.solve(valley(), check=False)
    monkeypatch.setattr(Watchdog, "departs", lambda *_: False)
    plain = vp.solve(valley(), check=False)
    assert watched.status.converged
    assert plain.status.converged
    assert watched.cost == pytest.approx(plain.cost, rel=1e-6)
    assert watched.iterations <= 0.8 * plain.iterations
    rises = [row for row in watched.history if row.decrease < 0.0]
    assert rises
    assert all(row.step >= 0.125 and row.cost - watched.cost < 0.01 * watched.search.first for row in rises)
    assert all(row.decrease >= 0.0 for row in plain.history)


@pytest.mark.usefixtures("in_controls_alone")
def test_a_watchdog_that_finds_nothing_returns_to_the_motion_that_it_left(monkeypatch):
    """Where the iterations away lead nowhere: here they may take no step."""
    own = LineSearch.run

    def stuck(self, start, shortest=0.0):
        return line_search.Step() if away() else own(self, start, shortest)

    searches = []
    begin = search.Search.begin
    monkeypatch.setattr(search.Search, "begin", lambda self, *args: (searches.append(self), begin(self, *args))[1])
    away = lambda: searches[-1].watchdog.away > 0  # noqa: E731
    monkeypatch.setattr(LineSearch, "run", stuck)
    plan = vp.solve(valley(), check=False, max_iterations=60)
    rows = plan.history
    departures = [k for k, row in enumerate(rows) if row.decrease < 0.0]
    assert len(departures) > 1
    for k in departures:
        # The step of length 0 that ends the departure, and then the iteration that would have been the next.
        assert rows[k + 1].step == 0.0
        assert rows[k + 2].cost < rows[k - 1].cost
    # Each departure in vain doubles the time until the next, and divides its rise by ten.
    assert np.all(np.diff(np.diff(departures)) > 0)
    allowed = 0.01 * plan.search.first * 0.1 ** np.arange(len(departures))
    assert all(-rows[k].decrease <= most for k, most in zip(departures, allowed, strict=True))
    # The best motion is returned, also where the search ends while it is away.
    assert plan.cost == min(row.cost for row in rows)


@pytest.mark.parametrize(
    ("backtracking", "found", "lengths"),
    [
        # The parabola through a decrease of half of what the slope gives has its minimum at the trial.
        (0.5, [-0.5, -0.25], [1.0, 0.5, 0.25]),
        # Through an increase as large as what the slope gives, at a quarter. Beyond that no more powers are left out.
        (0.5, [1.0, 25.0], [1.0, 0.25, 0.0625]),
        # So it is after a trial that has no cost.
        (0.5, [0.1, np.inf], [1.0, 0.5, 0.125]),
        (0.25, [1.0, 25.0], [1.0, 0.25, 0.0625]),
    ],
)
def test_lengths_of_a_line_search_follow_the_parabola_through_a_trial(backtracking, found, lengths):
    """``found``: changes of the cost where the slope is -1."""
    steps, tried = line_search._Lengths(backtracking, 0.0), []
    for length, change in zip(steps, [*found, np.inf], strict=False):
        tried.append(length)
        steps.learn(length, change, -1.0)
    assert tried[:3] == lengths


@pytest.mark.usefixtures("in_controls_alone")
@pytest.mark.parametrize("into", [0, 1, 2])
def test_searches_go_on_as_if_not_interrupted_while_they_are_away(into, tmp_path):
    whole = vp.solve(valley(), check=False)
    departure = next(k for k, row in enumerate(whole.history) if row.decrease < 0.0)
    part = vp.solve(valley(), max_iterations=departure + into, check=False)
    part.save(tmp_path / "part.npz")
    read = vp.Solution.load(tmp_path / "part.npz", part.problem)
    assert read.search.watchdog == part.search.watchdog
    for known in (part, read):
        assert_same_search(whole, vp.solve(part.problem, resume=known, check=False))
