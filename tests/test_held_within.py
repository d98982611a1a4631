"""Plans within hard constraints whose controls are held: their motion between nodes."""

import numpy as np
import pytest
from findings import about
from scipy.optimize import minimize

import varpin as vp

ROBOT = vp.planar_chain(2)
N, DT, LIMIT = 6, 0.1, 0.6


def reach(limit=LIMIT):
    cost = vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([0.6, -0.6], 1e2) + vp.VelocityCost(1.0))
    within = [vp.WithinVelocityLimits(ROBOT, (-limit, limit))]
    scene, rest = vp.Scene(ROBOT, damping=0.1), np.zeros(2)
    return vp.OptimalControlProblem(scene, cost, rest, rest, dt=DT, steps=N, constraints=within)


def speeds(problem, u, parts):
    """Speeds along the motion under u (N, 2), in classical Runge-Kutta steps."""
    given = {"dt": DT / parts, "steps": N * parts, "controls": np.repeat(u, parts, axis=0), "check": False}
    return np.abs(vp.simulate(problem.scene, problem.q0, problem.v0, integrator=vp.RungeKutta4(), **given).v)


def at_nodes(problem):
    """The plan whose constraints hold at the nodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("varpin.control.augmented.seen", lambda *_: None)
        return vp.solve(problem)


def test_speeds_hold_between_nodes_at_least_cost():
    """Beside SLSQP with the limits at 16 instants of each step."""
    problem = reach()
    plan = vp.solve(problem)
    assert plan.status is vp.Status.CONVERGED, plan.reason
    assert plan.violation <= 1e-5
    assert f"hold to {plan.violation:.1e}" in plan.reason
    assert not about(plan.warnings, "between nodes")
    assert speeds(problem, at_nodes(problem).controls, 32).max() > LIMIT + 1e-2
    assert speeds(problem, plan.controls, 32).max() <= LIMIT * (1.0 + 1e-4)
    rules = [{"type": "ineq", "fun": lambda x: LIMIT - speeds(problem, x.reshape(N, 2), 16)[1:].ravel()}]
    best = minimize(
        lambda x: problem.cost_of(problem.simulate(x.reshape(N, 2))), plan.controls.ravel(), method="SLSQP",
        constraints=rules, options={"maxiter": 30, "ftol": 1e-10},
    )  # fmt: skip
    assert abs(best.fun - plan.cost) <= 1e-4 * plan.cost


def test_plans_within_constraints_between_nodes_are_those_at_nodes():
    problem = reach(50.0)
    plan, alone = vp.solve(problem), at_nodes(problem)
    assert plan.controls.tobytes() == alone.controls.tobytes()
    assert plan.reason == alone.reason
    assert len(plan.history) == len(alone.history)


@pytest.mark.parametrize("further", [0, 2])
def test_without_a_plan_between_nodes_that_at_nodes_is_kept(further, monkeypatch):
    """With too few iterations for it; as for a stiff servo."""
    monkeypatch.setattr("varpin.control.augmented._FURTHER", further)
    problem = reach()
    plan, alone = vp.solve(problem), at_nodes(problem)
    assert plan.status is vp.Status.CONVERGED
    assert plan.controls.tobytes() == alone.controls.tobytes()
    assert plan.gains.tobytes() == alone.gains.tobytes()
    assert plan.cost == alone.cost
    assert plan.violation == alone.violation
    assert about(plan.warnings, "between nodes")
    assert "between nodes" in plan.reason


def test_rounds_with_rows_between_nodes_go_on_where_they_stopped(tmp_path):
    problem = reach()
    whole = vp.solve(problem, check=False)
    cut = len(at_nodes(problem).history) + 3
    assert cut < len(whole.history)

    def stop(item, _motion):
        if item.index == cut:
            raise KeyboardInterrupt

    part = vp.solve(problem, callback=stop, check=False)
    assert part.status is vp.Status.INTERRUPTED
    rest = vp.solve(problem, resume=vp.Solution.load(part.save(tmp_path / "plan.npz"), problem), check=False)
    assert rest.controls.tobytes() == whole.controls.tobytes()
    again = vp.solve(problem, resume=vp.Solution.load(whole.save(tmp_path / "whole.npz"), problem), check=False)
    assert again.status is vp.Status.CONVERGED
    assert again.cost == pytest.approx(whole.cost, rel=1e-4)
