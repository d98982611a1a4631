"""What integrates a motion where nobody says what: right where damping or stops get fast only along the way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import varpin as vp
from varpin.integrators.base import Failure
from varpin.simulation.choice import usual_integrator

CHAIN = vp.planar_chain(2)
DT, STEPS = 0.01, 100
ENDS = {"lower": {"joint1": -9.0, "joint2": -9.0}, "upper": {"joint1": 9.0, "joint2": 0.5}}


def jumps(*size):
    return np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, 2)) * size


def off(scene, q0, v0, controls, motion):
    """By how much q and v are off at the nodes, of the longest way and of the largest velocity."""
    fine = {"dt": DT / 32, "steps": 32 * STEPS, "controls": np.repeat(controls, 32, axis=0)}
    true = vp.simulate(scene, q0, v0, **fine, integrator=vp.Radau(3), check=False)
    q, v = true.q[::32], true.v[::32]
    return np.abs(motion.q - q).max() / np.ptp(q, axis=0).max(), np.abs(motion.v - v).max() / np.abs(v).max()


def dragged():
    """A damper on the tip that has no lever at the start, and one that grows: Gauss(2) loses 8 % of a velocity."""
    forces = [vp.FrameDamper("tip", [0.0, 0.0, 0.0], [0.0, 0.0, 1e4])]
    return vp.Scene(CHAIN, gravity=False, forces=forces), [1.57, 0.0], [2.0, -3.0], jumps(20.0, 20.0)


def stopped():
    """A joint that is pressed into a damped stop; Gauss(2) loses 2 % of a velocity."""
    stop = vp.JointStop(1e3, 300.0, **ENDS, width=0.05)
    return (
        vp.Scene(CHAIN, gravity=False, damping=0.3, forces=[stop]),
        [0.0, 0.0],
        [0.5, 0.0],
        jumps(6.0, 6.0) + np.array([0.0, 5.0]),
    )


@pytest.mark.parametrize("case", [dragged, stopped])
def test_damping_that_gets_fast_along_the_way(case):
    scene, q0, v0, controls = case()
    options = {"dt": DT, "steps": STEPS, "controls": controls}
    begun = usual_integrator(scene, np.array(q0), np.array(v0), DT, noisy=False)
    assert begun.same_map(vp.Gauss(2))
    usual = vp.simulate(scene, q0, v0, **options)
    assert usual.integrator == "Radau(stages=4)"
    assert usual.warnings == ()
    in_q, in_v = off(scene, q0, v0, controls, usual)
    assert in_q < 1e-3
    assert in_v < 3e-3
    # Who is named is taken.
    named = vp.simulate(scene, q0, v0, **options, integrator=vp.Gauss(2), check=False)
    assert named.integrator == "Gauss(stages=2)"
    assert off(scene, q0, v0, controls, named)[1] > 0.02


def test_a_stop_between_two_nodes():
    """A joint that bounces off a stiff stop and back within a step."""
    stop = vp.JointStop(1e6, 500.0, **ENDS, width=1e-3)
    scene = vp.Scene(CHAIN, gravity=False, forces=[stop])
    # The nodes lie 0.005 rad before the stop and behind it.
    motion = vp.simulate(scene, [0.0, 0.445], [0.0, 5.0], dt=DT, steps=4)
    assert motion.q[:, 1].max() < 0.5
    assert motion.integrator == "Radau(stages=4)"


def test_a_stiff_stop():
    scene = vp.Scene(CHAIN, gravity=False, forces=[vp.JointStop(1e4, 0.0, **ENDS)])
    for v0, name in (([0.0, 2.0], "Gauss(stages=4)"), ([0.0, 0.2], "Gauss(stages=2)")):
        assert vp.simulate(scene, [0.0, 0.3], v0, dt=DT, steps=60, check=False).integrator == name


def test_a_law_is_called_once_a_period_and_is_ready_for_stops():
    scene, q0, v0, controls = stopped()
    calls = []

    def law(t, q, v):
        calls.append(t)
        return controls[len(calls) - 1]

    motion = vp.simulate(scene, q0, v0, dt=DT, steps=STEPS, controls=law)
    assert len(calls) == STEPS
    assert motion.integrator == "Radau(stages=4)"
    np.testing.assert_array_equal(motion.q, vp.simulate(scene, q0, v0, dt=DT, steps=STEPS, controls=controls).q)


def test_a_step_that_fails_is_taken_by_another(monkeypatch):
    """Where the steps end that the start's integrator takes, it is asked, too."""
    scene, q0, v0, controls = stopped()
    rollout = vp.Gauss.rollout

    def failing(self, *given):
        (segment,) = rollout(self, *given)
        return [replace(segment.part(60), failure=Failure("made up", 1.0))]

    monkeypatch.setattr(vp.Gauss, "rollout", failing)
    assert vp.simulate(scene, q0, v0, dt=DT, steps=STEPS, controls=controls).steps == STEPS
    with pytest.raises(vp.StepFailure, match="made up"):
        vp.simulate(scene, q0, v0, dt=DT, steps=STEPS, controls=controls, integrator=vp.Gauss(2))


def test_who_looks_on_sees_one_motion():
    """Nothing was shown of steps that were left, unless they were too many for one look."""
    scene, q0, v0, controls = stopped()
    seen = []
    motion = vp.simulate(scene, q0, v0, dt=DT, steps=STEPS, controls=controls, progress=lambda *part: seen.append(part))
    assert seen[-1] == (STEPS, STEPS)
    assert motion.steps == STEPS


def test_scene_files(tmp_path):
    """A file without an integrator makes the motion of ``simulate``."""
    path = tmp_path / "stop.toml"
    path.write_text(
        """
gravity = false
[robot]
source = "double_pendulum"
[[force]]
type = "stop"
stiffness = 1e3
damping = 300.0
width = 0.05
lower = -9.0
upper = 0.5
[initial]
v = [0.0, 2.0]
[horizon]
dt = 0.01
steps = 100
"""
    )
    file = vp.load_scene(path, required_only=False)
    assert file.integrator.same_map(vp.Gauss(2))
    assert file.simulate().integrator == "Radau(stages=4)"
