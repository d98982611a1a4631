"""Noise that is not drawn, and seeds of nothing, are told of; where either is meant, nothing is."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from findings import about
from plan_problems import swing
from refusals import refused

import varpin as vp

CHAIN = vp.planar_chain(2)
QUIET = vp.Scene(CHAIN)
NOISES = {
    "additive": vp.AdditiveNoise(1e-3),
    "control": vp.ControlNoise(1e-3),
    "custom": vp.CustomNoise(lambda q, v, u: 1e-3 * np.eye(2), processes=2),
}
SHORT = {"dt": 1e-3, "steps": 20}


def noisy(noise="additive"):
    return vp.Scene(CHAIN, noise=NOISES[noise])


@pytest.mark.parametrize("check", [True, False])
@pytest.mark.parametrize("noise", NOISES)
def test_noise_that_is_not_drawn_is_told_of_once(noise, check, caplog):
    scene = noisy(noise)
    with caplog.at_level(logging.WARNING):
        motions = [vp.simulate(scene, [0, 0], [0, 0], **SHORT, check=check) for _ in range(3)]
    for motion in motions:
        assert len(motion.warnings) == len(about(motion.warnings, "noise not drawn")) == 1
        assert not motion.dw.any()
    assert len(about(caplog.messages, "noise not drawn")) == 1


@pytest.mark.parametrize("meant", [{"rng": 0}, {"increments": 0}, {"increments": np.zeros((20, 2))}], ids=str)
def test_what_is_meant_is_not_told_of(meant):
    assert vp.simulate(noisy(), [0, 0], [0, 0], **SHORT, **meant).warnings == ()


def test_no_increments_are_the_motion_without_noise():
    quiet = vp.simulate(QUIET, [0.1, 0.2], [0, 0], **SHORT)
    told = vp.simulate(noisy(), [0.1, 0.2], [0, 0], **SHORT, increments=0)
    np.testing.assert_allclose(told.q, quiet.q, rtol=0.0, atol=1e-14)
    with refused(vp.InputError, "increments", "(20, 2)"):
        vp.simulate(noisy(), [0.1, 0.2], [0, 0], **SHORT, increments=1.0)


def test_paths_that_are_all_one_and_seeds_of_nothing_are_told_of():
    alone = vp.simulate(QUIET, [0, 0], [0, 0], **SHORT, rng=0).warnings
    assert len(alone) == len(about(alone, "nothing random")) == 1
    starts = [[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]]
    for scene, q0, paths in ((QUIET, [0, 0], 3), (QUIET, starts, 3), (noisy(), [0, 0], 3), (QUIET, [0, 0], 1)):
        told = vp.simulate_ensemble(scene, q0, [0, 0], **SHORT, paths=paths, rng=0).warnings
        same = scene is QUIET and paths > 1 and q0 is not starts
        assert len(told) == len(about(told, "paths alike")) == same


def problem(scene):
    return swing(scene=scene, steps=5)


def test_a_controller_tells_of_its_plant():
    mpc = vp.Mpc(problem(noisy()))
    for plant, rng, said in (
        (None, None, "noise not drawn"),
        (None, 0, None),
        (vp.Plant(noisy()), None, "noise not drawn"),
        (vp.Plant(QUIET), 0, "nothing random"),
        (vp.Plant(QUIET), None, None),
    ):
        run = mpc.run(plant, duration=0.06, rng=rng)
        told = about(run.warnings, "noise not drawn", "nothing random")
        assert len(told) == (said is not None)
        assert not told or about(told, said)
        assert not about(run.motion.warnings[1:], "noise not drawn", "nothing random")


def test_plans_and_their_checks_draw_nothing_and_say_nothing(caplog):
    with caplog.at_level(logging.WARNING):
        plan = vp.solve(problem(noisy()), max_iterations=2)
        plan.problem.simulate(plan.policy)
        plan.verify(tolerance=1e-3)
        vp.check_linearization(noisy(), [0.1, 0.2], [0.0, 0.0], dt=1e-2)
    assert not about(caplog.messages, "noise not drawn")
