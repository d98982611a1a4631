"""What integrates a motion where nobody says what: by the rates at the start and in its stops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from findings import about

import varpin as vp

CHAIN = vp.planar_chain(2)
DT, STEPS = 0.01, 100
ENDS = {"lower": {"joint1": -9.0, "joint2": -9.0}, "upper": {"joint1": 9.0, "joint2": 0.5}}


def jumps(*size):
    return np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, 2)) * size


def off(scene, q0, v0, controls, motion):
    """By how much q and v are off at the nodes, of the largest joint travel and of the largest velocity."""
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


def test_stops_ahead():
    """The choice at the start is ready for a stop that comes later."""
    scene, q0, v0, controls = stopped()
    options = {"dt": DT, "steps": STEPS, "controls": controls}
    usual = vp.simulate(scene, q0, v0, **options)
    assert usual.integrator == "Radau(stages=4)"
    assert usual.warnings == ()
    in_q, in_v = off(scene, q0, v0, controls, usual)
    assert in_q < 1e-3
    assert in_v < 3e-3
    # A given integrator is taken.
    named = vp.simulate(scene, q0, v0, **options, integrator=vp.Gauss(2), check=False)
    assert named.integrator == "Gauss(stages=2)"
    assert off(scene, q0, v0, controls, named)[1] > 0.02


def test_damping_that_gets_fast_along_the_way():
    """The start does not show it: the error names the method that is right."""
    scene, q0, v0, controls = dragged()
    options = {"dt": DT, "steps": STEPS, "controls": controls}
    usual = vp.simulate(scene, q0, v0, **options)
    assert usual.integrator == "Gauss(stages=2)"
    (told,) = about(usual.warnings, "error")
    assert "varpin.Radau(4)" in told
    better = vp.simulate(scene, q0, v0, **options, integrator=vp.Radau(4))
    assert better.warnings == ()
    assert off(scene, q0, v0, controls, better)[1] < 3e-3 < off(scene, q0, v0, controls, usual)[1]


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
    for speed in (2.0, 0.2):
        motion = vp.simulate(scene, [0.0, 0.3], [0.0, speed], dt=DT, steps=60, check=False)
        assert motion.integrator == "Gauss(stages=4)"


def test_paths_without_noise_are_those_of_simulate():
    """Of one start, and of many of which some ask for more."""
    scene, q0, v0, controls = stopped()
    options = {"dt": DT, "steps": STEPS, "controls": controls}
    alone = vp.simulate(scene, q0, v0, **options)
    paths = vp.simulate_ensemble(scene, q0, v0, **options, paths=2, rng=0)
    assert paths.integrator == alone.integrator == "Radau(stages=4)"
    assert paths.integrator in repr(paths)
    np.testing.assert_array_equal(paths.q[1], alone.q)
    # Those that start away from the stop, which later ones come to.
    q0 = np.linspace([0.0, -3.0], [0.0, 0.3], 32)
    assert vp.simulate_ensemble(scene, q0, [0.0, 3.0], dt=DT, steps=10, paths=32, rng=0).integrator == alone.integrator
    noisy = vp.Scene(CHAIN, gravity=False, damping=0.3, noise=vp.AdditiveNoise(0.1))
    assert vp.simulate_ensemble(noisy, q0[:2], [0.0, 0.5], dt=DT, steps=10, paths=2, rng=0).integrator.startswith("Mid")


@pytest.mark.parametrize(
    ("scene", "rng", "chosen"),
    [
        ({"damping": 0.3}, None, "Gauss(stages=2)"),
        ({"damping": [0.3, 200.0]}, None, "Radau(stages=4)"),
        ({"damping": 0.3, "forces": [vp.JointStop(1e3, 300.0, **ENDS)]}, None, "Radau(stages=4)"),
        (
            {"damping": 0.3, "forces": [vp.FrameDamper("tip", [0.0, 0.0, 0.0], [0.0, 0.0, 1e4])]},
            None,
            "Gauss(stages=2)",
        ),
        ({"damping": 0.3, "noise": vp.AdditiveNoise(0.1)}, None, 'Gauss(stages=2, kick="held")'),
        ({"damping": 0.3, "noise": vp.AdditiveNoise(0.1)}, 0, 'Midpoint(alpha=0.5, kick="held")'),
    ],
    ids=["light", "damped", "stops", "lever", "no noise", "noise"],
)
def test_a_plant_takes_that_of_simulate(scene, rng, chosen):
    """As its start, its stops and the first plan ask for it, at its own steps."""
    cost = vp.TrackingCost(lambda t: [1.57 - t, 0.0], 100.0) + vp.ControlCost(1e-3)
    start = [1.57, 0.0], [0.0, 0.0]
    problem = vp.OptimalControlProblem(vp.Scene(CHAIN, gravity=False), cost, *start, dt=0.05, steps=10)
    plant = vp.Plant(vp.Scene(CHAIN, gravity=False, **scene), substeps=5)
    assert vp.Mpc(problem).run(plant, duration=0.1, rng=rng).motion.integrator == chosen
    named = replace(plant, integrator=vp.RungeKutta4(), substeps=50)
    if chosen != "Radau(stages=4)":
        assert vp.Mpc(problem).run(named, duration=0.1, rng=rng).motion.integrator == "RungeKutta4"
