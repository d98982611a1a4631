"""The minimum of a model whose penalties become active: against plain Newton steps, and in how many passes."""

from dataclasses import replace

import numpy as np
import pytest

import varpin as vp
from varpin.control import box, piecewise
from varpin.control.active_rows import Rows
from varpin.control.along import Along
from varpin.control.backward import backward
from varpin.control.box import Box
from varpin.control.penalties import penalized

PANDA = vp.load_robot("panda")
START = np.array([0.1, -0.4, 0.2, -1.9, 0.1, 1.6, 0.4, 0.02])
GOAL = START + np.array([0.5, 0.4, -0.4, 0.5, -0.3, 0.4, 0.4, 0.01])


def reach(controls="held", steps=16, **options):
    """A reach within speeds that all joints meet for most of the way."""
    scene = vp.Scene(PANDA, damping=0.1)
    cost = vp.ControlCost(1e-3) + vp.VelocityCost(1e-3)
    cost += vp.Terminal(vp.TrackingCost(GOAL, 100.0) + vp.VelocityCost(1.0))
    most = 1.3 * np.abs(GOAL - START) / (0.05 * steps) + 0.02
    speeds = [vp.WithinVelocityLimits(PANDA, (-most, most))]
    return vp.OptimalControlProblem(
        scene, cost, START, np.zeros(8), dt=0.05, steps=steps, constraints=speeds, controls=controls, **options
    )


def augmented(problem, weight=2e3, **options):
    bound = problem.bound_constraints
    zeros = [np.zeros(item.shape) for item in bound]
    return penalized(problem, zeros, np.full(len(bound), weight), zeros, **options)


@pytest.fixture
def passes(monkeypatch):
    """The passes of a search, one entry for each."""
    made, passed = [], piecewise._Steps._passed

    def counted(steps, held):
        made.append(None)
        return passed(steps, held)

    monkeypatch.setattr(piecewise._Steps, "_passed", counted)
    return made


@pytest.mark.parametrize("regularization", [0.0, 1e-6, 1e-2])
@pytest.mark.parametrize("controls", ["held", "linear"])
def test_the_minimum_is_that_of_plain_newton_steps(controls, regularization, passes, monkeypatch):
    """One row after another becomes active in these, so that they take very many passes."""
    problem = reach(controls)
    motion = problem.simulate(problem.holding_policy())
    found = backward(augmented(problem), motion, regularization)
    assert found.rows.sum() > 30
    assert len(passes) < 20
    near = len(passes)
    monkeypatch.setattr(piecewise, "_SEARCHED", 1000)
    plain = backward(augmented(problem, passes=1000), motion, regularization)
    assert len(passes) - near > 60
    assert plain.expected_decrease == pytest.approx(found.expected_decrease, rel=1e-9)
    np.testing.assert_array_equal(found.rows, plain.rows)
    np.testing.assert_allclose(found.feedforward, plain.feedforward, rtol=1e-6, atol=1e-6)


def test_rows_to_begin_with_lead_there_at_once(passes):
    problem = augmented(reach())
    motion = problem.simulate(problem.holding_policy())
    cold = backward(problem, motion, 0.0)
    passes.clear()
    again = backward(problem, motion, 0.0, rows=cold.rows)
    assert len(passes) == 1
    np.testing.assert_array_equal(again.feedforward, cold.feedforward)
    # Wrong ones lead there, too, and those of another problem are left out.
    rng = np.random.default_rng(0)
    for rows in (rng.random(cold.rows.size) < 0.5, ~cold.rows, np.ones(3, dtype=bool)):
        other = backward(problem, motion, 0.0, rows=rows)
        assert other.expected_decrease == pytest.approx(cold.expected_decrease, rel=1e-9)
        np.testing.assert_allclose(other.feedforward, cold.feedforward, rtol=1e-6, atol=1e-6)


def test_regularization_makes_steps_shorter_and_is_no_cost():
    """What a step near the minimum loses grows with its square; a cost of its own would grow in proportion."""
    problem = augmented(reach("linear"))
    motion = problem.simulate(problem.holding_policy())
    best, *decreases = (
        backward(problem, motion, regularization).expected_decrease for regularization in (0.0, 1e-6, 1e-5, 1.0, 100.0)
    )
    assert best > decreases[0] > decreases[1] > decreases[2] > decreases[3] > 0.0
    assert best - decreases[1] > 30.0 * (best - decreases[0])


def test_a_plan_takes_few_passes(monkeypatch):
    """Those of the interior-point method among them; 65 where the rounds went on to their end."""
    made, one_pass = [], box.single_pass

    def counted(*args, **options):
        made.append(None)
        return one_pass(*args, **options)

    monkeypatch.setattr(box, "single_pass", counted)
    plan = vp.solve(reach(), check=False)
    assert plan.status is vp.Status.CONVERGED
    assert len(made) < 65


@pytest.mark.parametrize("regularization", [1e-2, 1.0])
def test_a_plan_within_limits_says_what_its_model_does(regularization):
    """Rows and controls at limits are found together; regularization is no part of what is expected."""
    problem = reach()
    motion = problem.simulate(problem.holding_policy())
    free = backward(augmented(problem), motion, regularization)
    most = 0.8 * np.abs(motion.u + free.feedforward).max(axis=0)
    goal = augmented(reach(control_limits=(-most, most)))
    plan = backward(goal, motion, regularization)
    rows = Rows(Along(goal, motion), goal)
    ahead = rows.ahead(rows.whole, plan)
    # The model with the rows that are active at its minimum, without regularization.
    model = Box(rows.along(rows.held(ahead)), None)
    at = model._at(plan, rows.ahead_of[1])
    whole, held, begun = (np.concatenate([x.ravel() for x in part]) for part in (ahead, rows.held(ahead), rows.begun))
    signed = np.concatenate([x.ravel() for x in rows.signed])
    change = at.value + 0.5 * float((rows.weights * signed**2) @ (held.astype(float) - begun))
    assert whole[held].min() > 0.0
    assert plan.expected_decrease == pytest.approx(-change, rel=1e-8)


def test_ill_conditioned_passes_keep_their_square_roots():
    """Under heavy penalties the plain recursion loses digits, regularized or not."""
    problem = reach("linear")
    motion = problem.simulate(problem.holding_policy())
    for regularization in (0.0, 1e-3):
        assert backward(augmented(problem, 1e10), motion, regularization).loss < 1e-8


@pytest.mark.slow
def test_rows_of_a_round_are_read_where_the_next_one_has_others(tmp_path):
    """Rows between nodes change from round to round."""
    problem = reach("linear", steps=8)
    sizes = set()
    for cut in (10, 20, 24, 28, 32):
        part = vp.solve(problem, max_iterations=cut, check=False)
        read = vp.Solution.load(part.save(tmp_path / "plan.npz"), problem)
        np.testing.assert_array_equal(read.search.rows, part.search.rows)
        sizes.add(part.search.rows.size)
    assert len(sizes) > 1


@pytest.mark.parametrize("cut", [3, 7, 11])
def test_rows_are_resumed_to_the_bit(cut, tmp_path):
    problem = reach()
    whole = vp.solve(problem, check=False)
    part = vp.solve(problem, max_iterations=cut, check=False)
    assert part.search.rows.any()
    read = vp.Solution.load(part.save(tmp_path / "plan.npz"), problem)
    np.testing.assert_array_equal(read.search.rows, part.search.rows)
    for begun in (part, read):
        rest = vp.solve(problem, resume=begun, check=False)
        np.testing.assert_array_equal(rest.controls, whole.controls)
        assert len(rest.history) == len(whole.history)
    # Without them the plan is the same.
    without = replace(part, search=replace(part.search, rows=None))
    rest = vp.solve(problem, resume=without, check=False)
    assert rest.cost == pytest.approx(whole.cost, rel=1e-9)
