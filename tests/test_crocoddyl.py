"""Optima against those of crocoddyl and of Pontryagin's boundary-value problem.

Stored by benchmarks/crocoddyl_reference.py.
crocoddyl needs an environment of its own; its solutions are in data/crocoddyl.json with the script that made them.
"""

import json
from pathlib import Path

import numpy as np
import pytest

import varpin as vp

STORED = json.loads((Path(__file__).parent / "data" / "crocoddyl.json").read_text(encoding="utf-8"))["problems"]

REFERENCES = {
    "finger": lambda t: [1 + 0.25 * np.sin(4 * np.pi * t), 0.1 * np.sin(2 * np.pi * t), 0.0],
    "panda": lambda t: (
        np.array(STORED["panda"]["q0"]) + 0.3 * np.sin(2 * np.pi * t) * np.array([2, 1, -2, 1, 2, -1, 2]) / 2
    ),
}


def problem(name, N, **options):
    stored = STORED[name]
    weights, reference = stored["weights"], REFERENCES[name.split("_")[0]]
    cost = vp.TrackingCost(reference, weights["wq"]) + vp.VelocityCost(weights["wv"])
    cost = cost + vp.ControlCost(weights["wu"]) + vp.Terminal(vp.TrackingCost(reference, weights["Wq"]))
    cost = cost + vp.Terminal(vp.VelocityCost(weights["Wv"]))
    scene = vp.Scene(vp.load_robot(stored["robot"], lock=stored["lock"] or None), gravity=stored["gravity"])
    rest = np.zeros(scene.robot.dof)
    options = {"integrator": vp.Midpoint(), "sampling": "midpoint", **options}
    return vp.OptimalControlProblem(scene, cost, stored["q0"], rest, dt=stored["tf"] / N, steps=N, **options)


# Steps at which the second-order error is in its asymptotic range: the finger's motion has a boundary layer of 0.2 ms
# where it does not start on the reference.
@pytest.mark.parametrize(
    ("name", "N", "bound"),
    [
        ("finger", 1500, 1e-6),
        ("panda", 200, 1e-6),
        pytest.param("finger_off_reference", 7500, 1e-3, marks=pytest.mark.slow),
    ],
)
def test_the_same_optimum_as_dt_goes_to_zero(name, N, bound):
    costs = [vp.solve(problem(name, steps), tolerance=1e-10).cost for steps in (N, 2 * N)]
    limit = (4.0 * costs[1] - costs[0]) / 3.0
    optimum = STORED[name]["optimum"]["cost"]
    assert abs(limit / optimum - 1.0) < bound
    for own in STORED[name]["richardson"].values():  # crocoddyl's own, from Euler and from RK4
        assert abs(limit - own["cost"]) < 1e-3 * optimum + 2.0 * own["uncertainty"]


@pytest.mark.parametrize("name", ["finger", "panda"])
def test_the_same_motion_and_torques(name):
    samples = STORED[name]["optimum"]["samples"]
    plan = vp.solve(problem(name, 3000 if name == "finger" else 1000), tolerance=1e-10)
    t = np.array(samples["t"])
    inner = (t > 0.05) & (t < t[-1] - 0.05)  # away from the boundary layers of the finger
    q = np.array([np.interp(t, plan.trajectory.t, column) for column in plan.trajectory.q.T]).T
    np.testing.assert_allclose(q[inner], np.array(samples["q"])[inner], atol=2e-5)
    middle = plan.trajectory.t[:-1] + 0.5 * plan.problem.dt
    u = np.array([np.interp(t, middle, column) for column in plan.controls.T]).T
    expected = np.array(samples["u"])
    np.testing.assert_allclose(u[inner], expected[inner], atol=1e-3 * np.abs(expected[inner]).max())


def test_crocoddyls_euler_plans_fail_on_the_continuous_robot_where_midpoint_plans_hold():
    runs = {run["N"]: run for run in STORED["finger"]["runs"] if run["integrator"] == "Euler"}
    optimum = STORED["finger"]["optimum"]["cost"]
    plan = vp.solve(problem("finger", 500)).verify(tolerance=1e-8)
    assert plan.open_loop_cost < 1.1 * optimum
    assert runs[500]["true_cost"] > 10.0 * optimum
