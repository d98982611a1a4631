"""Other libraries: crocoddyl's and Pontryagin's optima, and simulators that benchmarks race against.

crocoddyl needs an environment of its own; benchmarks/crocoddyl_reference.py has stored its solutions.
"""

import dataclasses
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


def solve(name, N, **options):
    stored = STORED[name]
    weights, reference = stored["weights"], REFERENCES[name.split("_")[0]]
    cost = vp.TrackingCost(reference, weights["wq"]) + vp.VelocityCost(weights["wv"])
    cost = cost + vp.ControlCost(weights["wu"]) + vp.Terminal(vp.TrackingCost(reference, weights["Wq"]))
    cost = cost + vp.Terminal(vp.VelocityCost(weights["Wv"]))
    scene = vp.Scene(vp.load_robot(stored["robot"], lock=stored["lock"] or None), gravity=stored["gravity"])
    rest, grid = np.zeros(scene.robot.dof), {"dt": stored["tf"] / N, "steps": N}
    given = {"integrator": vp.Midpoint(), "sampling": "midpoint", **grid}
    return vp.solve(vp.OptimalControlProblem(scene, cost, stored["q0"], rest, **given), **options)


# Steps at which the second-order error is in its asymptotic range: the finger's motion has a boundary layer of 0.2 ms
# where it does not start on the reference.
@pytest.mark.parametrize(
    ("name", "N", "bound"),
    [
        ("finger", 1500, 1e-6),
        ("panda", 500, 1e-6),
        pytest.param("finger_off_reference", 7500, 1e-3, marks=pytest.mark.slow),
    ],
)
def test_the_same_optimum_as_dt_goes_to_zero(name, N, bound):
    plans = [solve(name, steps, tolerance=1e-10) for steps in (N, 2 * N)]
    limit = (4.0 * plans[1].cost - plans[0].cost) / 3.0
    stored = STORED[name]["optimum"]
    assert abs(limit / stored["cost"] - 1.0) < bound
    for own in STORED[name]["richardson"].values():  # crocoddyl's own, from Euler and from RK4
        assert abs(limit - own["cost"]) < 1e-3 * stored["cost"] + 2.0 * own["uncertainty"]
    if name == "finger_off_reference":
        return
    # Away from the boundary layers of the finger.
    t, q, u = (np.array(stored["samples"][key]) for key in "tqu")
    inner, motion = (t > 0.05) & (t < t[-1] - 0.05), plans[1].trajectory

    def found(at, values):
        return np.array([np.interp(t, at, column) for column in values.T]).T[inner]

    np.testing.assert_allclose(found(motion.t, motion.q), q[inner], atol=2e-5)
    middle = found(motion.t[:-1] + 0.5 * motion.dt, motion.u)
    np.testing.assert_allclose(middle, u[inner], atol=1e-3 * np.abs(u[inner]).max())


def test_crocoddyls_euler_plans_fail_on_the_continuous_robot_where_midpoint_plans_hold():
    (run,) = (run for run in STORED["finger"]["runs"] if (run["integrator"], run["N"]) == ("Euler", 500))
    optimum = STORED["finger"]["optimum"]["cost"]
    assert solve("finger", 500).verify(tolerance=1e-8).open_loop_cost < 1.1 * optimum
    assert run["true_cost"] > 10.0 * optimum


@pytest.fixture(scope="module")
def peers(script):
    return script("peers")


@pytest.fixture
def case(peers):
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.7, stiffness=3.0, rest=0.2)
    return peers.Case("ur5", scene, np.linspace(0.2, 0.6, 6), np.zeros(6), np.linspace(5.0, 1.0, 6), 0.2)


def test_peers_are_the_same_mechanism_and_go_the_same_way(peers, case):
    assert peers.require_same(case, tolerance=1e-11)[0] == "pin.aba"
    options = {"dt": case.duration, "steps": 1, "controls": case.u, "integrator": vp.Reference()}
    exact = vp.simulate(case.scene, case.q0, case.v0, **options).q[-1]
    np.testing.assert_allclose(peers.scipy_run(case, 1e-11)(), exact, atol=1e-9)
    for run in (peers.mujoco_run(case, 1e-3, "RK4"), peers.drake_run(case, 1e-8)):
        if run is not None:
            np.testing.assert_allclose(run(), exact, atol=1e-8)
            # A run leaves nothing behind for the next, but for what its own step control remembers.
            np.testing.assert_allclose(run(), run(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["swing", "rows", "friction"])
def test_peers_are_driven_alike(peers, case, kind):
    """Torques that swing, that jump, and friction, against varpin's own forces and controls."""
    rng = np.random.default_rng(0)
    swing, jumps = rng.uniform(-1.0, 1.0, 6), case.u + rng.uniform(-1.0, 1.0, (20, 6))
    forces = [vp.CoulombFriction(0.5, 0.2)] if kind == "friction" else []
    scene = vp.Scene(case.scene.robot, damping=0.7, forces=forces)
    case = dataclasses.replace(case, scene=vp.Scene(case.scene.robot, damping=0.7))
    if kind == "rows":
        controls, case = jumps, dataclasses.replace(case, u=jumps)
    else:
        controls = vp.OpenLoop(lambda t: case.u + np.sin(20.0 * t) * swing)
        case = dataclasses.replace(case, swing=swing, omega=20.0)
    if kind == "friction":
        case = dataclasses.replace(case, friction=np.full(6, 0.5), width=0.2)
    options = {"dt": 0.01, "steps": 20, "controls": controls, "integrator": vp.Gauss(5)}
    exact = vp.simulate(scene, case.q0, case.v0, **options).q[-1]
    np.testing.assert_allclose(peers.scipy_run(case, 1e-11)(), exact, rtol=0, atol=1e-8)
    run = peers.mujoco_driven_run(case, 1e-4, "RK4")
    if run is not None:
        # Torques that change in time are held over a step there.
        np.testing.assert_allclose(run(), exact, rtol=0, atol=1e-6)
