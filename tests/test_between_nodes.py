"""Plans within hard constraints that are to hold between nodes, too."""

import numpy as np
import pytest
from findings import about
from oracles import rollout
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
    """Speeds along the motion under decisions u (R, 2), in classical Runge-Kutta steps."""
    lines = problem.controls == "linear"
    controls = vp.FirstOrderHold(u).refined(parts) if lines else np.repeat(u, parts, axis=0)
    given = {"dt": DT / parts, "steps": N * parts, "controls": controls, "check": False}
    return np.abs(vp.simulate(problem.scene, problem.q0, problem.v0, integrator=vp.RungeKutta4(), **given).v)


@pytest.mark.parametrize(("controls", "close"), [("held", 1e-4), ("linear", 1e-3)])
def test_speeds_hold_between_nodes_at_least_cost(controls, close):
    """Beside SLSQP with the limits at 16 instants of each step."""
    problem = reach(controls=controls)
    plan = vp.solve(problem)
    assert plan.status is vp.Status.CONVERGED, plan.reason
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


def arm(name, load):
    """A reach of a robot whose motion at the nodes alone goes through what is in its way, or too fast."""
    if name == "decisions of two steps":
        robot = vp.planar_chain(3)
        cost = vp.ControlCost(1e-3) + vp.VelocityCost(1e-2)
        cost += vp.Terminal(vp.TrackingCost([1.0, 0.5, 0.3], 1e2) + vp.VelocityCost(10.0))
        options = {"dt": 0.04, "steps": 30, "hold": 2, "control_limits": (-60.0, 60.0)}
        within = vp.WithinVelocityLimits(robot, (-1.2, 1.2))
        begin = np.zeros(3)
    else:
        begin = {"ur5": [0.0, -1.2, 1.4, -1.8, -1.57, 0.0], "panda": [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8]}[name]
        robot = vp.load_robot(name, lock={"panda_finger_joint1": 0.02}) if name == "panda" else load(name)
        begin, frame = np.array(begin), {"ur5": "tool0", "panda": "panda_hand"}[name]
        end = begin + np.pad([1.0, 0.4, -0.3], (0, robot.dof - 3))
        middle = robot.frame_positions(0.5 * (begin + end), frame)
        cost = vp.ControlCost(1.0 / robot.effort_limit**2) + vp.VelocityCost(0.2)
        cost += vp.Terminal(vp.TrackingCost(end, 100.0) + vp.VelocityCost(100.0))
        within = vp.KeepOutOfSphere(robot, frame, center=middle, radius=0.12)
        if name == "ur5":
            post = vp.Obstacle.capsule([*middle[:2], 0.0], [*middle[:2], 0.3], 0.06, name="post")
            names = ["forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link"]
            within = vp.KeepClear(robot, [post], 0.02, links=names)
        options = {"dt": 0.05, "steps": 24}
    options |= {"constraints": [within], "between_nodes": True}
    return vp.OptimalControlProblem(vp.Scene(robot, damping=0.1), cost, begin, np.zeros(robot.dof), **options)


@pytest.mark.parametrize("name", ["decisions of two steps", "ur5", "panda"])
def test_arms_hold_between_nodes(name, load):
    """Held against the motion in 32 parts of each step; at least cost, it is more by little."""
    problem = arm(name, load)
    plan, alone = (vp.solve(problem.at(between_nodes=each), check=False) for each in (True, False))
    assert plan.status is vp.Status.CONVERGED
    assert plan.violation <= 1e-6
    assert most(alone) > 3e-6
    # Between eighths of a step a parabola through three of them counts.
    assert most(plan) <= 2e-6
    assert alone.cost <= plan.cost <= alone.cost * (1.0 + 1e-3)


def most(plan, parts=32):
    """The largest value of a plan's constraints along its motion in parts of the steps."""
    problem = plan.problem
    motion = vp.simulate(
        problem.scene, problem.q0, problem.v0, dt=problem.dt / parts, steps=problem.steps * parts,
        controls=np.repeat(plan.controls, parts * problem.hold, axis=0), integrator=problem.integrator, check=False,
    )  # fmt: skip
    fine = problem.constraints_on(problem.dt / parts, problem.steps * parts, problem.hold * parts)
    return max(bound.value(motion.q, motion.v, motion.u).max() for bound in fine)


def test_copies_and_files_know_the_option(tmp_path):
    problem, alone = reach(), reach(between_nodes=False)
    for copy in (problem.at(dt=DT / 2), problem.at(q0=[0.1, 0.0]), problem.at(controls="linear")):
        assert copy.between_nodes
    assert not alone.at(dt=DT / 2).between_nodes
    assert "between_nodes" in problem.differs(alone.setting)
    plan = vp.solve(alone, check=False)
    with pytest.raises(vp.InputError, match="between_nodes"):
        vp.solve(problem, resume=plan, check=False)
    with pytest.raises(vp.FileError, match="between_nodes"):
        vp.Solution.load(plan.save(tmp_path / "plan.npz"), problem)
    # Files without the entry are of problems that ask for nothing between nodes.
    with np.load(tmp_path / "plan.npz") as archive:
        np.savez(tmp_path / "older.npz", **{name: archive[name] for name in archive if name != "between_nodes"})
    assert vp.Solution.load(tmp_path / "older.npz", alone).controls.tobytes() == plan.controls.tobytes()
    with pytest.raises(vp.InputError, match="between_nodes"):
        reach(between_nodes="yes")
