"""What a finished motion says of itself."""

from __future__ import annotations

import logging
import math

import numpy as np
import pinocchio as pin
import pytest

import varpin as vp
from varpin.robot.chain import rod_chain
from varpin.soundness import COARSE, energy_defects, step_error

ROD = rod_chain([1.0], [1.0])
EXPLICIT = (vp.ExplicitEuler(), vp.SemiImplicitEuler(), vp.RungeKutta4())


def oscillator(h_omega, integrator, steps=100, dt=1e-2, **scene):
    """A rod on a spring, released: h_omega [rad] a step."""
    surroundings = vp.Scene(ROD, gravity=False, stiffness=(h_omega / dt) ** 2 / 3.0, **scene)
    return surroundings, vp.simulate(surroundings, [0.5], [0.0], dt=dt, steps=steps, integrator=integrator)


@pytest.mark.parametrize(
    ("integrator", "formula"),
    [
        # What halving does to a step of q'' = -w^2 q, by its Taylor series, over the way h w and turn (h w) it makes.
        (vp.ExplicitEuler(), lambda z: z / 4),
        (vp.Midpoint(), lambda z: z**2 / 16),
    ],
    ids=["Euler", "Midpoint"],
)
def test_the_error_of_a_step_is_what_theory_says(integrator, formula):
    for z in (0.02, 0.05, 0.1):
        scene, motion = oscillator(z, integrator, steps=round(math.tau / z))
        error = step_error(scene, integrator, motion).error
        assert 0.5 * formula(z) < error < 3.0 * formula(z)


@pytest.mark.parametrize(
    "integrator", [*EXPLICIT, vp.Midpoint(), vp.Midpoint(alpha=0.0), vp.Gauss(stages=2), vp.Gauss(stages=4)], ids=str
)
def test_steps_that_do_not_resolve_the_motion_are_spoken_of(integrator, caplog):
    with caplog.at_level(logging.WARNING, "varpin"):
        _, motion = oscillator(1e-3, integrator)
        assert motion.warnings == ()
        assert not caplog.records
        _, motion = oscillator(1.9 if integrator.order < 6 else 6.0, integrator)
    assert any("coarse" in sentence for sentence in motion.warnings)
    assert [record.getMessage() for record in caplog.records] == list(motion.warnings)


def test_a_quiet_motion_is_right_to_some_percent():
    # At the largest h omega that nothing is said of, the error after a period is still small.
    for integrator in (vp.ExplicitEuler(), vp.Midpoint(), vp.Gauss(stages=2), vp.RungeKutta4()):
        for z in np.geomspace(2.0, 1e-3, 40):
            steps = max(1, round(math.tau / z))
            scene, motion = oscillator(z, integrator, steps=steps)
            if step_error(scene, integrator, motion).error <= COARSE:
                off = np.abs(motion.q[:, 0] - 0.5 * np.cos(z * np.arange(steps + 1))).max()
                assert off < 0.1 * 0.5
                break
        else:
            pytest.fail("something is said of every step")


@pytest.mark.parametrize("integrator", EXPLICIT, ids=str)
def test_energy_balance_of_explicit_methods(integrator):
    # Driven, damped and noisy: what is left is the method's own error, and goes with its order.
    scene = vp.Scene(rod_chain([1.0] * 2, [1.0] * 2), damping=0.3, noise=vp.AdditiveNoise(0.2))
    off = []
    for steps in (400, 1600):
        rng = np.random.default_rng(0).normal(size=(1600, 2)) * math.sqrt(1.0 / 1600)
        motion = vp.simulate(
            scene,
            np.zeros(2),
            np.zeros(2),
            dt=1.0 / steps,
            steps=steps,
            controls=np.array([2.0, -1.0]),
            increments=rng.reshape(steps, -1, 2).sum(axis=1),
            integrator=integrator,
        )
        np.testing.assert_array_equal(motion.statistics.energy_defect, energy_defects(scene, motion))
        off.append(np.abs(motion.statistics.energy_defect).max())
    # Forces, dampers and kicks account for most of what the energy does, and for all of it as dt shrinks.
    assert off[1] < 0.1 * np.abs(motion.energy - motion.energy[0]).max()
    assert off[1] < 0.4 * off[0]


def test_a_slider_that_is_far_and_fast_does_not_hide_a_hinge():
    """Metres per second and radians per second do not compare: what turns is judged by what turns."""
    model = pin.Model()
    for k, kind in enumerate((pin.JointModelRY(), pin.JointModelPX())):
        joint = model.addJoint(0, kind, pin.SE3.Identity(), f"joint{k}")
        model.appendBodyToJoint(joint, pin.Inertia(1.0, np.array([0.5, 0.0, 0.0]), 0.1 * np.eye(3)), pin.SE3.Identity())
    scene = vp.Scene(vp.load_robot(model))
    for integrator, coarse in ((vp.ExplicitEuler(), True), (vp.Gauss(3), False)):
        calm, fast = (
            vp.simulate(scene, np.zeros(2), [0.0, speed], dt=0.05, steps=20, integrator=integrator)
            for speed in (0.0, 1e6)
        )
        said = [any("is coarse" in text for text in motion.warnings) for motion in (calm, fast)]
        assert said == [coarse, coarse]


def test_energy_that_drifts_is_spoken_of():
    motion = vp.simulate(vp.Scene(ROD), [1.0], [0.0], dt=1e-3, steps=20_000, integrator=vp.ExplicitEuler())
    (sentence,) = motion.warnings
    drift = np.abs(motion.energy - motion.energy[0]).max()
    assert f"the energy is off by {drift:.3g} J" in sentence
    assert np.abs(motion.statistics.energy_defect).max() == pytest.approx(drift)
    assert vp.simulate(vp.Scene(ROD), [1.0], [0.0], dt=1e-3, steps=20_000).warnings == ()


def test_nothing_is_said_of_a_robot_at_rest():
    for integrator in (vp.Midpoint(), *EXPLICIT):
        for q in (0.5 * math.pi, -0.5 * math.pi):
            assert vp.simulate(vp.Scene(ROD), [q], [0.0], dt=0.01, steps=100, integrator=integrator).warnings == ()
    assert vp.simulate(vp.Scene(ROD), [0.0], [0.0], dt=0.01, steps=0).warnings == ()


def test_warnings_survive_the_disk(tmp_path):
    _, motion = oscillator(1.5, vp.Midpoint())
    assert motion.warnings
    assert vp.Trajectory.load(motion.save(tmp_path / "motion.npz")).warnings == motion.warnings


def test_an_interrupted_motion_tells_too():
    def interrupt(done, steps):
        raise KeyboardInterrupt

    with pytest.raises(vp.Interrupted) as caught:
        vp.simulate(vp.Scene(ROD), [0.0], [0.0], dt=0.3, steps=100_000, progress=interrupt, integrator=EXPLICIT[1])
    assert caught.value.trajectory.warnings


def test_a_loop_logs_each_kind_of_warning_once_for_a_scene_and_a_step(caplog):
    def logged(scene, dt, times):
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="varpin"):
            said = [vp.simulate(scene, [1.0], [0.0], dt=dt, steps=20).warnings for _ in range(times)]
        # The trajectories keep theirs, however often it was logged.
        assert all(any("damping is faster" in sentence for sentence in each) for each in said)
        return sum("damping is faster" in record.message for record in caplog.records)

    scene = vp.Scene(vp.planar_chain(1), damping=1e3)
    assert logged(scene, 1e-2, 5) == 1
    assert logged(scene, 1e-2, 1) == 0
    assert logged(scene, 2e-2, 1) == 1
    assert logged(vp.Scene(vp.planar_chain(1), damping=1e3), 1e-2, 1) == 1
