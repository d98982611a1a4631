"""A finger follows a reference although its muscles are noisy: S-DDP, and what plain DDP would have cost."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import varpin as vp
from varpin import plots

out = Path("out")
out.mkdir(exist_ok=True)


def reference(t: float) -> list[float]:
    """Joint angles to follow [rad]."""
    return [1.0 + 0.25 * np.sin(4 * np.pi * t), 0.3 + 0.1 * np.sin(2 * np.pi * t), 0.2]


finger = vp.load_robot("finger")
hanging = [9.81, 0.0, 0.0]  # gravity pulls along the stretched finger
quiet = vp.Scene(finger, gravity=hanging)
noisy = vp.Scene(finger, gravity=hanging, noise=vp.ControlNoise(2e-3))  # the more torque, the more noise
cost = vp.TrackingCost(reference, 10.0) + vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost(reference, 1.0))
start = {"q0": [1.0, 0.3, 0.2], "v0": [0.0, 0.0, 0.0], "dt": 2e-3, "steps": 750}

problem = vp.OptimalControlProblem(noisy, cost, **start)
plan = vp.solve(problem)
print(plan.table())

truth = plan.verify(tolerance=1e-6)
print(f"cost without noise: planned {truth.planned_cost:.3g}, on the continuous system {truth.closed_loop_cost:.3g}")
sampled = plan.monte_carlo(1000, rng=0)
print(f"cost under noise: predicted {sampled.predicted:.3g}, found {sampled.cost:.3g} +- {sampled.standard_error:.1g}")

unaware = vp.solve(vp.OptimalControlProblem(quiet, cost, **start))
paths = vp.simulate_ensemble(noisy, **start, controls=unaware.policy, paths=1000, rng=0, integrator=problem.integrator)
print(f"the plan that knows of no noise, under the same noise: {problem.costs(paths.q, paths.v, paths.u).mean():.3g}")

motion = plan.trajectory
followed = np.array([reference(t) for t in motion.t])
figure = Figure(figsize=(9, 7), layout="constrained")
joints, controls = figure.subplots(2, 1)
plots.plot_joints(motion, joints, robot=finger)
for column, line in zip(followed.T, list(joints.lines), strict=True):
    joints.plot(motion.t, column, color=line.get_color(), linestyle=":")
joints.set_title("the plan and its reference (dotted)")
plots.plot_controls(motion, controls, robot=finger)
controls.set_yscale("symlog", linthresh=2e-3)
figure.savefig(out / "finger_tracking.png", dpi=120)
print(vp.replay(finger, motion, marks=vp.Marks(ghost=followed), html=out / "finger_tracking.html", speed=0.1))
