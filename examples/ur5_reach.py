"""A UR5 reaches a posture in one second, planned with large steps by a variational and by an explicit Euler method."""

from dataclasses import replace
from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.load_robot("ur5")
scene = vp.Scene(robot, damping=0.1)
begin = np.array([0.0, -1.5, 0.8, -0.5, 0.0, 0.0])  # [rad]
goal = np.array([1.0, -1.0, 1.5, -1.2, 0.8, 0.5])
rest = np.zeros(robot.dof)

hold = scene.holding_torque(goal)  # torques that carry the arm at the goal [N m]
cost = vp.ControlCost(1e-3, reference=hold) + vp.VelocityCost(1e-2)
cost += vp.Terminal(vp.TrackingCost(goal, 1e4) + vp.VelocityCost(1e2))

plans = {}
for name, integrator in (("variational", vp.Gauss(4)), ("explicit Euler", vp.ExplicitEuler())):
    problem = vp.OptimalControlProblem(scene, cost, begin, rest, dt=1e-2, steps=100, integrator=integrator)
    plans[name] = plan = vp.solve(problem)
    truth = plan.verify(tolerance=1e-8)
    print(f"{name}: {plan.iterations} iterations, {plan.status.value}")
    print(f"    planned cost {truth.planned_cost:.4g}")
    print(f"    true cost {truth.open_loop_cost:.4g} open loop, {truth.closed_loop_cost:.4g} with feedback")
    print(f"    ends {truth.open_loop_gap:.1e} rad from the plan open loop, {truth.closed_loop_gap:.1e} with feedback")

motion = plans["variational"].trajectory
hand = robot.frame_positions([goal])[0]  # where the tool is to be [m]
marks = vp.Marks(targets={"goal": hand}, trace=True, frames=True, torques=True)
print(vp.replay(robot, motion, html=out / "ur5_reach.html", speed=0.5, marks=replace(marks, ghost=[goal])))
side_by_side = [(robot, plan.trajectory) for plan in plans.values()]
print(vp.replay(side_by_side, html=out / "ur5_plans.html", speed=0.5, marks=marks))
