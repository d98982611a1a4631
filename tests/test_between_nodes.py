"""Plans within hard constraints that are to hold between nodes, too."""

import numpy as np
import pytest
from findings import about
from oracles import rollout
from plan_problems import CAPSULES
from refusals import refused
from scipy.optimize import minimize

import varpin as vp

ROBOT = vp.planar_chain(2)
N, DT, LIMIT = 6, 0.1, 0.6


def reach(limit=LIMIT, **options):
    cost = vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([0.6, -0.6], 1e2) + vp.VelocityCost(1.0))
    given = {"constraints": [vp.WithinVelocityLimits(ROBOT, (-limit, limit))], "between_nodes": True} | options
    scene, rest = vp.Scene(ROBOT, damping=0.1), np.zeros(2)
    return vp.OptimalControlProblem(scene, cost, rest, rest, dt=DT, steps=N, **given)


def speeds(problem, u, parts):
    lines = problem.controls == "linear"
    controls = vp.FirstOrderHold(u).refined(parts) if lines else np.repeat(u, parts, axis=0)
    given = {"dt": DT / parts, "steps": N * parts, "controls": controls, "check": False}
    return np.abs(vp.simulate(problem.scene, problem.q0, problem.v0, integrator=vp.RungeKutta4(), **given).v)


@pytest.mark.parametrize(("controls", "close"), [("held", 1e-4), ("linear", 1e-3)])
def test_speeds_hold_between_nodes_at_least_cost(controls, close):
    problem = reach(controls=controls)
    plan = vp.solve(problem)
    assert plan.status.converged, plan.reason
    assert plan.violation <= 1e-6
    assert not about(plan.warnings, "constraints between nodes")
    assert speeds(problem, plan.controls, 32).max() <= LIMIT + 2e-6
    rules = [{"type": "ineq", "fun": lambda x: LIMIT - speeds(problem, x.reshape(-1, 2), 16)[1:].ravel()}]
    best = minimize(
        lambda x: problem.cost_of(rollout(problem, x.reshape(-1, 2))), plan.controls.ravel(), method="SLSQP",
        constraints=rules, options={"maxiter": 50, "ftol": 1e-10},
    )  # fmt: skip
    assert abs(best.fun - plan.cost) <= close * plan.cost


def test_speeds_between_nodes_that_nobody_asks_for_are_told():
    alone = vp.solve(reach(between_nodes=False))
    assert speeds(alone.problem, alone.controls, 32).max() > LIMIT + 1e-2
    (told,) = about(alone.warnings, "constraints between nodes")
    assert "between_nodes=True" in told


def apart(z):
    start = ROBOT.frame_positions(np.zeros(2), "tip")
    return reach(constraints=vp.KeepOutOfSphere(ROBOT, "tip", start + np.array([0.0, 0.0, z]), 0.05))


def moving(speed):
    """In another process the same function has another address."""

    def way(t):
        return [speed * t, 0.0, 0.0]

    ball = vp.Obstacle.sphere([1.5, 0.0, 0.5], 0.1).moving(way)
    clear = vp.KeepClear(ROBOT, [ball], capsules=CAPSULES)
    return reach(constraints=[vp.KeepInSphere(ROBOT, "tip", way, 5.0), clear])


@pytest.mark.parametrize(
    ("build", "one", "other", "fact"),
    [
        (lambda between: reach(between_nodes=between), True, False, "between_nodes"),
        (apart, 0.2, -0.2, "constraints"),
        (moving, 1.0, 1.1, "constraints"),
    ],
    ids=["instants", "places away from the start", "ways"],
)
def test_plans_within_other_constraints_are_refused(build, one, other, fact, tmp_path):
    plan = vp.solve(build(one), max_iterations=1, check=False)
    path = plan.save(tmp_path / "plan.npz")
    assert vp.Solution.load(path, build(one)).cost == plan.cost
    with refused(vp.FileError, fact):
        vp.Solution.load(path, build(other))
    with refused(vp.InputError, fact):
        vp.solve(build(other), resume=plan, check=False)


def test_copies_and_files_know_the_option(tmp_path):
    problem, alone = reach(), reach(between_nodes=False)
    for copy in (problem.at(dt=DT / 2), problem.at(q0=[0.1, 0.0]), problem.at(controls="linear")):
        assert copy.between_nodes
    assert not alone.at(dt=DT / 2).between_nodes
    # Files without the entry are of problems that ask for nothing between nodes.
    plan = vp.solve(alone, check=False)
    with np.load(plan.save(tmp_path / "plan.npz")) as archive:
        np.savez(tmp_path / "older.npz", **{name: archive[name] for name in archive if name != "between_nodes"})
    assert vp.Solution.load(tmp_path / "older.npz", alone).controls.tobytes() == plan.controls.tobytes()
