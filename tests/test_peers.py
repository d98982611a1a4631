"""The other simulators that benchmarks race against are the same mechanism, driven alike."""

import dataclasses

import numpy as np
import pytest

import varpin as vp


@pytest.fixture(scope="module")
def peers(script):
    return script("peers")


@pytest.fixture
def case(peers):
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.7, stiffness=3.0, rest=0.2)
    return peers.Case("ur5", scene, np.linspace(0.2, 0.6, 6), np.zeros(6), np.linspace(5.0, 1.0, 6), 0.2)


def test_peers_are_the_same_mechanism_and_go_the_same_way(peers, case):
    assert peers.require_same(case, tolerance=1e-11)[0] == "pin.aba"
    exact = vp.simulate(
        case.scene, case.q0, case.v0, dt=case.duration, steps=1, controls=case.u, integrator=vp.Reference()
    ).q[-1]
    np.testing.assert_allclose(peers.scipy_run(case, 1e-11)(), exact, atol=1e-9)
    for run in (peers.mujoco_run(case, 1e-3, "RK4"), peers.drake_run(case, 1e-8)):
        if run is not None:
            np.testing.assert_allclose(run(), exact, atol=1e-8)
            # A run leaves nothing behind for the next, but for what its own step control remembers.
            np.testing.assert_allclose(run(), run(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["swing", "rows", "friction"])
def test_peers_are_driven_alike(peers, case, kind):
    """Torques that swing, that jump, and friction, against varpin's own forces and controls."""
    rng, mild = np.random.default_rng(0), vp.Scene(case.scene.robot, damping=0.7)
    case = dataclasses.replace(case, scene=mild)
    scene, controls = case.scene, case.u
    if kind == "rows":
        controls = case.u + rng.uniform(-1.0, 1.0, (20, 6))
        case = dataclasses.replace(case, u=controls)
    else:
        swing = rng.uniform(-1.0, 1.0, 6)
        controls = vp.OpenLoop(lambda t: case.u + np.sin(20.0 * t) * swing)
        case = dataclasses.replace(case, swing=swing, omega=20.0)
    if kind == "friction":
        case = dataclasses.replace(case, friction=np.full(6, 0.5), width=0.2)
        scene = vp.Scene(scene.robot, damping=0.7, forces=[vp.CoulombFriction(0.5, 0.2)])
    options = {"dt": 0.01, "steps": 20, "controls": controls, "integrator": vp.Gauss(5)}
    exact = vp.simulate(scene, case.q0, case.v0, **options).q[-1]
    np.testing.assert_allclose(peers.scipy_run(case, 1e-11)(), exact, rtol=0, atol=1e-8)
    run = peers.mujoco_driven_run(case, 1e-4, "RK4")
    if run is not None:
        # Torques that change in time are held over a step there.
        np.testing.assert_allclose(run(), exact, rtol=0, atol=1e-6)
