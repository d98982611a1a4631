"""Crocoddyl's solvers on varpin's steps find what varpin's own finds. Needs ``pip install "varpin[crocoddyl]"``."""

import numpy as np
import pytest
import zoo
from oracles import slope
from refusals import refused

import varpin as vp

crocoddyl = pytest.importorskip("crocoddyl", reason="in an environment of its own: pip install 'varpin[crocoddyl]'")

from varpin.crocoddyl import first_guess, policy_of, shooting_problem  # noqa: E402

WAVE = np.array([0.3, 0.2, -0.1, 0.2, 0.1, -0.3])


def reach(integrator, sampling="midpoint"):
    """References are functions of time and rows, over a horizon that does not begin at time 0."""
    begin = np.array([0.0, -1.5, 0.8, -0.5, 0.0, 0.0])
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.1)
    rows = begin + np.linspace(0.0, 1.0, 26)[:, None] * WAVE
    torques = np.linspace(0.9, 1.1, 25)[:, None] * scene.holding_torque(begin)
    cost = vp.ControlCost(1e-3, reference=torques) + vp.VelocityCost(1e-2) + vp.TrackingCost(rows, 0.5)
    cost += vp.TrackingCost(lambda t: begin + WAVE * np.sin(6.0 * (t - 0.7)), 1.0)
    cost += vp.Terminal(vp.TrackingCost(rows, 1e2) + vp.VelocityCost(1.0))
    given = {"dt": 0.02, "steps": 25, "t0": 0.7, "integrator": integrator, "sampling": sampling}
    return vp.OptimalControlProblem(scene, cost, begin, np.zeros(6), **given)


PROBLEMS = {
    "midpoint": lambda: reach(vp.Midpoint()),
    "gauss": lambda: reach(vp.Midpoint(), "gauss"),
    "start": lambda: reach(vp.Midpoint(), "start"),
    "euler": lambda: reach(vp.SemiImplicitEuler()),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_steps_and_their_derivatives(name):
    """The cost of a motion, and derivatives against central differences of a step."""
    problem = PROBLEMS[name]()
    shooting = shooting_problem(problem)
    xs, us = first_guess(problem)
    motion = vp.solve(problem, max_iterations=0).trajectory
    np.testing.assert_allclose(us, motion.u, rtol=1e-12)
    assert shooting.calc(xs, us) == pytest.approx(problem.cost_of(motion), rel=1e-10)
    model, rng = shooting.runningModels[3], np.random.default_rng(0)
    z, data = np.append(xs[3] + 0.1 * rng.normal(size=12), us[3] + rng.normal(size=6)), model.createData()
    model.calc(data, z[:12], z[12:])
    model.calcDiff(data, z[:12], z[12:])

    def step(z):
        other = model.createData()
        model.calc(other, z[:12], z[12:])
        return np.append(other.xnext, other.cost)

    numeric = np.array([slope(step, z, e, 1e-5) for e in np.eye(18)]).T
    exact = np.hstack([data.Fx, data.Fu])
    np.testing.assert_allclose(exact, numeric[:12], rtol=0, atol=2e-8 * np.abs(exact).max())
    gradient = np.append(data.Lx, data.Lu)
    np.testing.assert_allclose(gradient, numeric[12], rtol=0, atol=1e-7 * np.abs(gradient).max())


@pytest.mark.parametrize("name", PROBLEMS)
def test_fddp_finds_the_same_optimum(name):
    """Its solution goes on as one of varpin's."""
    problem = PROBLEMS[name]()
    own = vp.solve(problem, tolerance=1e-12)
    solver = crocoddyl.SolverFDDP(shooting_problem(problem))
    solver.th_stop = 1e-12
    # What it adds to the second derivatives of the cost to go is 1e-9 by default, and shows in the gains.
    solver.reg_min = 1e-14
    logger = crocoddyl.CallbackLogger()
    solver.setCallbacks([logger])
    assert solver.solve(*first_guess(problem), 100)
    assert solver.cost == pytest.approx(own.cost, rel=1e-8)
    np.testing.assert_allclose(np.array(solver.us.tolist()), own.trajectory.u, rtol=0, atol=1e-4)
    np.testing.assert_allclose(-np.array(solver.K.tolist()), own.gains, rtol=0, atol=1e-5 * np.abs(own.gains).max())
    assert len(logger.costs) == solver.iter + 1
    plan = vp.solve(problem, policy_of(problem, solver), max_iterations=0)
    assert plan.cost == pytest.approx(solver.cost, rel=1e-9)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        pytest.param([-10.0, -5.0], [10.0, 5.0], id="both sides"),
        pytest.param([-np.inf, -np.inf], [10.0, 5.0], id="upper", marks=pytest.mark.slow),
        pytest.param([-10.0, -np.inf], [np.inf, np.inf], id="one joint's lower", marks=pytest.mark.slow),
    ],
)
def test_box_fddp_keeps_control_limits(lower, upper):
    """And ends at the cost of varpin's plan; its policy keeps them far from the plan, too."""
    cost = vp.ControlCost(1e-4) + vp.Terminal(vp.TrackingCost([1.5, 0.5], 1e3) + vp.VelocityCost(10.0))
    scene = vp.Scene(vp.planar_chain(2), damping=0.1)
    given = {"dt": 0.02, "steps": 50, "control_limits": (lower, upper)}
    problem = vp.OptimalControlProblem(scene, cost, [-1.5, 0.0], [0.0, 0.0], **given)
    solver = crocoddyl.SolverBoxFDDP(shooting_problem(problem))
    solver.th_stop = 1e-9
    assert solver.solve(*first_guess(problem), 200)
    controls = np.array(solver.us.tolist())
    assert (controls >= lower).all()
    assert (controls <= upper).all()
    assert np.isclose(controls, lower).any() or np.isclose(controls, upper).any()
    assert solver.cost == pytest.approx(vp.solve(problem, check=False).cost, rel=1e-6)
    policy = policy_of(problem, solver)
    again = problem.simulate(policy)
    assert problem.cost_of(again) == pytest.approx(solver.cost, rel=1e-9)
    pushed = policy.control(0, np.append(problem.q0 + 10.0, problem.v0))
    assert (pushed >= lower).all()
    assert (pushed <= upper).all()


def test_what_crocoddyl_has_not_is_refused():
    problem = PROBLEMS["midpoint"]()
    assert not any(model.has_control_limits for model in shooting_problem(problem).runningModels)
    rated = problem.at(cost=problem.cost + vp.ControlRateCost())
    for other, facts in ((problem.at(hold=5), ("controls", "5")), (rated, ("ControlRateCost",))):
        with refused(vp.InputError, *facts):
            shooting_problem(other)


def test_a_step_that_fails_shortens_the_line_search():
    model = shooting_problem(PROBLEMS["midpoint"]()).runningModels[0]
    data = model.createData()
    model.calc(data, np.full(12, np.nan), np.zeros(6))
    assert np.isnan(data.xnext).all()
    assert data.cost == np.inf


def test_a_closed_loop():
    """A five-bar: FDDP finds varpin's plan, from a motion that keeps the constraints."""
    loop = zoo.ZOO["five-bar"]
    scene = vp.Scene(loop.scene.robot, constraints=loop.scene.constraints, actuation=["joint1", "joint4"], damping=0.1)
    goal = vp.assemble(scene, loop.q0 + np.array([0.3, 0.0, 0.0, 0.0]))
    cost = vp.ControlCost(1e-3) + vp.VelocityCost(0.1)
    cost += vp.Terminal(vp.TrackingCost(goal, 100.0) + vp.VelocityCost(1.0))
    problem = vp.OptimalControlProblem(scene, cost, loop.q0, np.zeros(4), dt=0.02, steps=20)
    solver = crocoddyl.SolverFDDP(shooting_problem(problem))
    solver.th_stop = 1e-12
    assert solver.solve(*first_guess(problem), 200, True)
    assert solver.cost == pytest.approx(vp.solve(problem).cost, rel=1e-5)
    again = problem.simulate(policy_of(problem, solver))
    assert problem.cost_of(again) == pytest.approx(solver.cost, rel=1e-9)
    assert np.abs(scene.core.constraints(np.ascontiguousarray(again.q))[0]).max() < 1e-12
