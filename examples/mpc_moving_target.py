"""A UR5 holds its flange on a moving target, replanning a hundred times a second against a noisy, heavier robot."""

from dataclasses import replace
from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.load_robot("ur5")
heavier = vp.load_robot("ur5", payload=vp.Payload("tool0", mass=0.3))  # what the controller does not know
begin = np.array([0.37, -1.38, 1.37, -1.16, -1.45, 0.0])  # at the target [rad]

limits = (-robot.effort_limit, robot.effort_limit)  # [N m]


def target(t):
    """Where the flange is to be [m]."""
    return [0.45 + 0.1 * np.sin(2.0 * t), 0.15 + 0.15 * np.cos(1.3 * t), 0.4 + 0.1 * np.sin(1.7 * t)]


def controller(integrator):
    """Half a second ahead, in fifty steps."""
    scene = vp.Scene(robot, damping=0.05)
    hold = scene.holding_torque(begin)
    cost = vp.FramePositionCost(robot, "tool0", target, 1e3) + vp.VelocityCost(0.05) + vp.ControlCost(1e-4, hold)
    cost += vp.Terminal(vp.FramePositionCost(robot, "tool0", target, 1e2) + vp.VelocityCost(0.5))
    problem = vp.OptimalControlProblem(
        scene, cost, begin, np.zeros(robot.dof), dt=1e-2, steps=50, integrator=integrator, control_limits=limits
    )
    return vp.Mpc(problem, iterations=1)


plant = vp.Plant(vp.Scene(heavier, damping=0.05, noise=vp.AdditiveNoise(0.02)))
runs = {}
for name, integrator in (("variational", vp.Gauss(4)), ("explicit Euler", vp.ExplicitEuler())):
    runs[name] = run = controller(integrator).run(plant, duration=4.0, rng=1)
    tip = robot.frame_positions(run.motion.q, "tool0")
    error = np.linalg.norm(tip - [target(t) for t in run.motion.t], axis=1)
    settled = error[run.motion.t > 1.0]
    print(f"{name}: {run}")
    print(f"    off the target by {1e3 * np.sqrt((settled**2).mean()):.2f} mm (rms after 1 s)")

# The arm, where its plan means to be in half a second as a ghost, and the way there as beads.
goal = {"target": [target(t) for t in np.linspace(0.0, 4.0, 200)]}
marks = vp.Marks(trace="tool0", growing=True, targets=goal)
print(vp.replay(robot, runs["variational"], html=out / "mpc_moving_target.html", marks=marks))
both = [(robot, run) for run in runs.values()]
print(vp.replay(both, html=out / "mpc_integrators.html", marks=replace(marks, ahead=0.1)))
