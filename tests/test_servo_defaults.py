"""What stands for no controls where servos act, and who takes their commands for torques."""

import numpy as np
import pytest
from refusals import refused

import varpin as vp

Q0 = [0.0, -1.0, 1.0, -0.5, 0.8, 0.0]


@pytest.fixture(scope="module")
def served():
    scene = vp.Scene(vp.load_robot("ur5"), forces=[vp.PositionServo(2000.0, 200.0)])
    return scene, vp.simulate(scene, Q0, np.zeros(6), dt=1e-3, steps=200, integrator=vp.Radau(3))


def test_servos_that_are_told_nothing_stay(served):
    scene, motion = served
    np.testing.assert_array_equal(motion.u, np.tile(Q0, (200, 1)))
    # They give way to gravity alone, by what a spring would.
    sag = scene.holding_torque(Q0) / 2000.0
    assert np.abs(motion.q - Q0).max() < 2.0 * np.abs(sag).max()


def test_ensembles_and_advice_take_the_same(served):
    scene, motion = served
    paths = vp.simulate_ensemble(scene, Q0, np.zeros(6), dt=1e-3, steps=200, paths=1, rng=0, integrator=vp.Radau(3))
    np.testing.assert_allclose(paths.statistics.mean[-1, :6], motion.q[-1], rtol=0, atol=1e-12)
    with refused(vp.InputError, "controls", "servos"):
        vp.simulate_ensemble(scene, [Q0, np.zeros(6)], np.zeros(6), dt=1e-3, steps=2, paths=2, rng=0)


def test_commands_are_not_coloured_as_torques(served, tmp_path):
    scene, motion = served
    with refused(vp.InputError, "controls", "servos"):
        vp.replay(scene.robot, motion, html=tmp_path / "served.html", marks=vp.Marks(torques=True))
