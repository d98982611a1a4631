"""An installed varpin, with no source tree in sight: it simulates, linearizes, plans and writes a replay."""

from pathlib import Path

import numpy as np

import varpin as vp

home = Path(vp.__file__).resolve()
assert not (home.parents[2] / "pyproject.toml").exists(), f"varpin comes from the source, {home}"

robot = vp.load_robot("ur5")
scene = vp.Scene(robot)
for integrator in (vp.Midpoint(), vp.Gauss(4), vp.RungeKutta4()):

    def move(q0, integrator=integrator):
        return vp.simulate(scene, q0, np.zeros(6), dt=1e-3, steps=100, integrator=integrator, check=False)

    start, aside = np.full(6, 0.2), np.full(6, 0.2) + 1e-6
    motion, other = move(start), move(aside)
    assert np.ptp(motion.energy) < 1e-3, integrator
    lin = vp.linearize(scene, motion)
    change = np.linalg.multi_dot(lin.A[::-1])[:6, :6] @ (aside - start)
    np.testing.assert_allclose(other.q[-1] - motion.q[-1], change, atol=1e-9, err_msg=str(integrator))

goal = np.array([0.5, -1.0, 1.2, -0.6, 0.8, 0.0])
cost = vp.ControlCost(1e-4) + vp.Terminal(vp.TrackingCost(goal, 100.0) + vp.VelocityCost(10.0))
plan = vp.solve(vp.OptimalControlProblem(scene, cost, start, np.zeros(6), dt=0.02, steps=25))
assert plan.status.converged, plan.reason
assert np.abs(plan.trajectory.q[-1] - goal).max() < 0.05
vp.replay(robot, plan.trajectory, html="smoke.html")
assert Path("smoke.html").stat().st_size > 100_000
print("varpin", vp.__version__, "of", home.parent, "works")
