"""The other simulators that benchmarks race against are the same mechanism, and would not start if they were not."""

import dataclasses

import numpy as np
import pytest
from refusals import refused

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


@pytest.mark.parametrize(
    ("change", "quantity"),
    [
        ({"damping": 0.8, "stiffness": 3.0, "rest": 0.2}, "acceleration"),
        ({"damping": 0.7, "stiffness": 3.1, "rest": 0.2}, "energy"),
        ({"damping": 0.7, "stiffness": 3.0, "rest": 0.2, "gravity": (0.0, 0.0, -9.8)}, "energy"),
    ],
)
def test_another_mechanism_does_not_start(peers, case, monkeypatch, change, quantity):
    pytest.importorskip("mujoco")
    other, build = vp.Scene(case.scene.robot, **change), peers.mujoco_model
    monkeypatch.setattr(peers, "mujoco_model", lambda scene, *args, **options: build(other, *args, **options))
    with refused(RuntimeError, "MuJoCo", "ur5", quantity):
        peers.require_same(case)


def test_energies_of_mujoco_are_those_of_nodes(peers):
    """What MuJoCo itself reports after a step of RK4 belongs to the step's last stage."""
    pytest.importorskip("mujoco")
    rest = np.zeros(2)
    case = peers.Case("chain", vp.Scene(vp.planar_chain(2)), rest, rest, rest, 1.0)
    energy = peers.mujoco_energies(case, 1e-3, "RK4")
    assert energy.shape == (1001,)
    assert np.abs(energy - energy[0]).max() < 1e-8


def test_robots_that_peers_are_not_built_for_are_refused(peers, case):
    pytest.importorskip("mujoco", reason="pip install 'varpin[peers]'")
    model = case.scene.robot.model.copy()
    model.armature = np.full(6, 0.1)
    with refused(ValueError, "armature"):
        peers.require_same(dataclasses.replace(case, scene=vp.Scene(vp.load_robot(model))))


def spring(peers, h_omega, dt=1e-2, steps=200):
    """A rod on a spring that turns so far a step [rad]."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, stiffness=(h_omega / dt) ** 2 / 3.0)
    return peers.Case("spring", scene, np.array([0.5]), np.zeros(1), np.zeros(1), dt * steps)


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_what_mujoco_sets_back_is_told(peers, integrator):
    pytest.importorskip("mujoco")
    calm = peers.mujoco_motion(spring(peers, 0.1), 1e-2, integrator)
    assert calm.said == ""
    assert calm.q.shape == calm.v.shape == (201, 1)
    assert np.abs(calm.q).max() > 0.4
    # In the first step of all there is no clock that goes back.
    for h_omega, first in ((10.0, None), (1e4, 0.01)):
        wild = peers.mujoco_motion(spring(peers, h_omega), 1e-2, integrator)
        assert wild.said.startswith("set back to q = 0 once, first after ")
        assert first is None or wild.said.endswith(f" {first:g} s")
        # At rest where the spring is slack it stays.
        assert not wild.q[-1].any()


def test_a_warning_that_sets_nothing_back_is_no_reset(peers, monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    case, step = spring(peers, 0.1), mujoco.mj_step

    def warned(model, data):
        step(model, data)
        data.warning[mujoco.mjtWarning.mjWARN_CONTACTFULL].number += 1

    monkeypatch.setattr(mujoco, "mj_step", warned)
    motion = peers.mujoco_motion(case, 1e-2, "RK4")
    assert motion.said == "warns of mjWARN_CONTACTFULL"
    assert np.abs(motion.q[100:]).max() > 0.4

    def lies(model, data):
        step(model, data)
        data.warning[mujoco.mjtWarning.mjWARN_BADQVEL].number += 1

    monkeypatch.setattr(mujoco, "mj_step", lies)
    with pytest.raises(RuntimeError, match="does not set it back"):
        peers.mujoco_motion(case, 1e-2, "RK4")


def test_whole_motions_of_peers_are_the_exact_one(peers):
    rest = np.zeros(2)
    case = peers.Case("chain", vp.Scene(vp.planar_chain(2)), rest, rest, rest, 0.5)
    exact = vp.simulate(case.scene, rest, rest, dt=1e-2, steps=50, integrator=vp.Reference())
    motions = {
        "MuJoCo": (peers.mujoco_motion(case, 1e-2, "RK4"), 1e-4),
        "Drake, discrete": (peers.drake_motion(case, 1e-2), 0.1),
        "Drake": (peers.drake_motion(case, 1e-2, "runge_kutta3"), 1e-3),
        "trep": (peers.trep_motion(case, 1e-2), 1e-2),
    }
    for name, (motion, level) in motions.items():
        if motion is not None:
            assert motion.said == ""
            assert np.abs(motion.q - exact.q).max() < level, name
            assert np.abs(motion.v - exact.v).max() < 10.0 * level, name


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


def test_servos_of_mujoco_are_the_springs_and_dampers_of_others(peers, case):
    stiffness, damping, swing = np.full(6, 300.0), np.full(6, 10.0), np.full(6, 0.1)
    springs = vp.Scene(case.scene.robot, stiffness=stiffness, damping=damping, rest=case.q0)
    tracking = dataclasses.replace(case, scene=springs, u=np.zeros(6), swing=stiffness * swing, omega=20.0)
    servos = vp.Scene(case.scene.robot, forces=[vp.PositionServo(stiffness, damping)])
    goals = vp.OpenLoop(lambda t: case.q0 + np.sin(20.0 * t) * swing)
    exact = vp.simulate(servos, case.q0, case.v0, dt=0.01, steps=20, controls=goals, integrator=vp.Gauss(5)).q[-1]
    np.testing.assert_allclose(peers.scipy_run(tracking, 1e-11)(), exact, rtol=0, atol=1e-8)
    run = peers.mujoco_driven_run(tracking, 1e-4, "RK4", (stiffness, damping, case.q0))
    if run is not None:
        np.testing.assert_allclose(run(), exact, rtol=0, atol=1e-6)
