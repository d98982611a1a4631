"""Last steps of plans within constraints: before the rounds have ended, without feedback, and with corrections."""

import inspect
import time

import numpy as np
import pytest

import varpin as vp
from varpin.control import augmented, polish
from varpin.control.line_search import LineSearch
from varpin.control.penalties import PenalizedProblem, split
from varpin.control.trials import Trials
from varpin.errors import LinearizationError


def reach(joints, *, steps, seconds=1.0, controls="linear", weight=1e-4, further=()):
    """A planar chain that is to move each joint by 1 rad within speeds that do not allow it."""
    robot, rest = vp.planar_chain(joints), np.zeros(joints)
    cost = vp.ControlCost(weight) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost((-1.0) ** np.arange(joints), 1e2) + vp.VelocityCost(1.0))
    within = [vp.WithinVelocityLimits(robot, (-0.8, 0.8)), *further]
    return vp.OptimalControlProblem(
        vp.Scene(robot, damping=0.1), cost, rest, rest, dt=seconds / steps, steps=steps, controls=controls,
        constraints=within,
    )  # fmt: skip


PROBLEMS = {
    "two links": lambda: reach(2, steps=20),
    "three links": lambda: reach(3, steps=12),
    "held": lambda: reach(3, steps=20, controls="held"),
    "held, also between nodes": lambda: reach(2, steps=8, controls="held").at(between_nodes=True),
    "a plane": lambda: reach(
        2, steps=20, further=[vp.KeepInHalfSpace(vp.planar_chain(2), "tip", normal=[0, 0, 1], offset=-1.2)]
    ),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_last_steps_before_the_end_lead_to_the_plan_of_the_rounds(name, monkeypatch):
    plan = vp.solve(PROBLEMS[name](), check=False)
    monkeypatch.setattr(augmented, "_REACHED", -1.0)
    whole = vp.solve(PROBLEMS[name](), check=False)
    assert plan.status.converged
    assert whole.status.converged
    assert plan.iterations < whole.iterations
    assert plan.violation <= 1e-9
    assert any(report.active.any() for report in plan.constraints)
    assert plan.cost == pytest.approx(whole.cost, rel=1e-7)
    np.testing.assert_allclose(plan.trajectory.q, whole.trajectory.q, atol=1e-4)
    assert "last steps after round" in plan.reason


@pytest.mark.parametrize("name", ["two links", "held", "held, also between nodes"])
def test_last_steps_that_run_out_of_time_are_tried_again(name, monkeypatch, tmp_path):
    """A plan whose time is over within them goes on to the same plan, to the last bit."""
    problem = PROBLEMS[name]()
    whole = vp.solve(problem, check=False)
    solve = polish._Step.solve

    def late(step, until):
        solve(step, until)
        if until < np.inf:
            wait = until - time.perf_counter()
            time.sleep(max(wait, 0.0) + 1e-3)

    monkeypatch.setattr(polish._Step, "solve", late)
    part = vp.solve(problem, time_limit=3.0, check=False)
    assert part.status is vp.Status.OUT_OF_TIME
    monkeypatch.setattr(polish._Step, "solve", solve)
    rest = vp.solve(problem, resume=vp.Solution.load(part.save(tmp_path / "plan.npz"), problem), check=False)
    assert rest.status.converged
    assert rest.controls.tobytes() == whole.controls.tobytes()
    assert rest.multipliers.values.tobytes() == whole.multipliers.values.tobytes()


def test_goals_alone_need_no_rows_between_nodes():
    """With linear controls, whose motion is not looked at between nodes where nothing could be violated there."""
    robot = vp.planar_chain(2)
    goal = vp.ReachFrame(robot, "tip", position=robot.frame_positions([0.6, -0.4], "tip"))
    cost = vp.ControlCost(1e-3) + vp.VelocityCost(0.1) + vp.Terminal(vp.VelocityCost(10.0))
    problem = vp.OptimalControlProblem(
        vp.Scene(robot, damping=0.1), cost, [0.1, 0.2], np.zeros(2), dt=0.05, steps=16, controls="linear",
        constraints=[goal],
    )  # fmt: skip
    plan = vp.solve(problem, check=False)
    assert plan.status.converged
    assert "last steps after round 1;" in plan.reason


def test_a_force_that_fails_in_a_last_step_ends_it_alone(monkeypatch):
    """The rounds go on."""
    attempt, asked = Trials.attempt, []

    def failing(trials, *given, **options):
        if any("polish.py" in frame.filename for frame in inspect.stack(0)[:4]):
            asked.append(given)
            raise LinearizationError(0, 0.0, "no derivative")
        return attempt(trials, *given, **options)

    monkeypatch.setattr(Trials, "attempt", failing)
    plan = vp.solve(PROBLEMS["held"](), check=False)
    assert asked
    assert plan.violation <= 1e-6


@pytest.mark.parametrize("name", ["two links", "held", "held, also between nodes"])
def test_last_steps_that_do_not_lead_to_an_optimum_leave_the_rounds_as_they_are(name, monkeypatch):
    problem = PROBLEMS[name]()
    tried, early = [], augmented._Rounds._early

    def failing(rounds, kept, begun):
        monkeypatch.setattr(augmented, "_EXACT", -1.0)
        tried.append(early(rounds, kept, begun))
        return tried[-1]

    monkeypatch.setattr(augmented._Rounds, "_early", failing)
    plan = vp.solve(problem, check=False)
    assert tried
    assert set(tried) == {None}
    monkeypatch.setattr(augmented, "_REACHED", -1.0)
    whole = vp.solve(problem, check=False)
    assert plan.controls.tobytes() == whole.controls.tobytes()
    assert plan.multipliers.values.tobytes() == whole.multipliers.values.tobytes()


def test_infeasible_plans_end_as_without_last_steps(monkeypatch):
    """They are not tried where the violation does not decrease."""
    problem = reach(2, steps=8, controls="held", further=[vp.ReachFrame(vp.planar_chain(2), "tip", [0.9, 0.0, -1.2])])
    tried, polished = [], augmented.polished
    monkeypatch.setattr(augmented, "polished", lambda *given: tried.append(given) or polished(*given))
    plan = vp.solve(problem, check=False)
    assert plan.status is vp.Status.INFEASIBLE
    assert not tried


@pytest.fixture
def rough(monkeypatch):
    """The plan of two links, and a step of the last ones from a motion that rounds have left off the constraints."""
    problem = reach(2, steps=20)
    plan = vp.solve(problem, check=False)
    with monkeypatch.context() as within:
        within.setattr(augmented, "_REACHED", -1.0)
        part = vp.solve(problem, max_iterations=17, check=False)
    known, whole = part.multipliers, augmented.enforced(problem, part.multipliers.between)
    values, backoff = (split(whole.bound_constraints, array) for array in (known.values, known.backoff))
    step = polish._Step(whole, part.trajectory, values, known.weights, backoff)
    assert step.found.violation > 1e-4
    return plan, step


def test_steps_without_feedback_lead_to_the_plan_too(rough):
    plan, step = rough
    trials, before = Trials(step.problem), step.cost
    for _ in range(20):
        step.solve(np.inf)
        found = polish._next(step, trials, 1.0, closed=False, until=np.inf)
        if found is None:
            break
        step = found[0]
    assert abs(before - plan.cost) > 1e-3 * plan.cost
    assert step.found.violation <= 1e-9
    assert step.found.decrease <= 1e-7 * step.found.stake
    assert step.cost == pytest.approx(plan.cost, rel=1e-3)


def test_feedback_that_loses_the_motion_is_left_out(monkeypatch, rough):
    """Gains ten thousand times as stiff, as heavy penalties make them: the step without feedback is taken."""
    plan, step = rough
    step.solve(np.inf)
    commands = polish._Step._commands

    def stiff(own, w, length):
        found = commands(own, w, length)
        return found._replace(gains=1e4 * found.gains)

    assert polish._next(step, Trials(step.problem), 1.0, closed=True, until=np.inf)[2]
    monkeypatch.setattr(polish._Step, "_commands", stiff)
    found, length, closed = polish._next(step, Trials(step.problem), 1.0, closed=True, until=np.inf)
    assert not closed
    assert length > 0.0
    assert found.found.violation < step.found.violation
    assert found.cost == pytest.approx(plan.cost, rel=1e-2)


def test_corrections_lead_back_onto_the_constraints(rough):
    """With the derivatives along the motion before: the violation falls with each, as the motion hardly bends."""
    _, step = rough
    step.solve(np.inf)
    trials, w = Trials(step.problem), step.ahead
    tried = step._tried(trials, w, 1.0, closed=False)
    before = tried.violation
    for _ in range(3):
        w = w + step._back(tried.c)
        tried = step._tried(trials, w, 1.0, closed=False)
    assert tried.violation < 0.05 * before


def test_shorter_steps_go_to_the_minimum_of_a_parabola(rough):
    """Through the merit here, with its slope, and that of a trial."""
    _, step = rough
    step.solve(np.inf)
    beyond = step._merit(step.cost, step.c) - step.cost
    slope, curvature = 2.0 * step.expected + beyond, 9.0 * (2.0 * step.expected + beyond)
    for length in (1.0, 0.5):
        step.rise = -slope * length + 0.5 * curvature * length**2
        assert step.shorter(length) == pytest.approx(slope / curvature)
    step.rise = np.inf
    assert step.shorter(1.0) == polish._SHARPEST


def test_trials_under_the_foreseen_controls(monkeypatch):
    """In later rounds, where the plan's stiff feedback loses the motion; never in the first one."""
    seen, run = [], LineSearch._try

    def noted(search, step, start, here, bounds):
        trial, count = run(search, step, start, here, bounds)
        if isinstance(search.problem, PenalizedProblem):
            alone = search._run(step, here.commands(step, start.plan), start, here, bounds, rise=np.inf)
            seen.append((search.problem.later, count, trial.expected, alone.expected))
        return trial, count

    monkeypatch.setattr(LineSearch, "_try", noted)
    assert vp.solve(reach(3, steps=12), check=False).status.converged
    assert {count for later, count, *_ in seen if not later} == {1}
    better = [ours < alone for _, count, ours, alone in seen if count == 2]
    assert len(better) > 3
    assert any(better)
