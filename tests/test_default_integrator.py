"""What integrates a motion where nobody says what: by the rates at the start and in its stops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import varpin as vp

CHAIN = vp.planar_chain(2)
DT, STEPS = 0.01, 100
ENDS = {"lower": {"joint1": -9.0, "joint2": -9.0}, "upper": {"joint1": 9.0, "joint2": 0.5}}


def stopped():
    """A joint that is pressed into a damped stop; Gauss(2) loses 2 % of a velocity."""
    stop = vp.JointStop(1e3, 300.0, **ENDS, width=0.05)
    scene = vp.Scene(CHAIN, gravity=False, damping=0.3, forces=[stop])
    controls = np.random.default_rng(0).uniform(-6.0, 6.0, (STEPS, 2)) + np.array([0.0, 5.0])
    return scene, [0.0, 0.0], [0.5, 0.0], controls


def test_stops_ahead():
    scene, q0, v0, controls = stopped()
    options = {"dt": DT, "steps": STEPS, "controls": controls}
    usual = vp.simulate(scene, q0, v0, **options)
    named = vp.simulate(scene, q0, v0, **options, integrator=vp.Gauss(2), check=False)
    assert (usual.integrator, named.integrator) == ("Radau(stages=4)", "Gauss(stages=2)")
    assert usual.warnings == ()
    fine = {"dt": DT / 32, "steps": 32 * STEPS, "controls": np.repeat(controls, 32, axis=0)}
    true = vp.simulate(scene, q0, v0, **fine, integrator=vp.Radau(3), check=False)
    q, v = true.q[::32], true.v[::32]
    assert np.abs(usual.q - q).max() < 1e-3 * np.ptp(q, axis=0).max()
    assert np.abs(usual.v - v).max() < 3e-3 * np.abs(v).max() < 0.15 * np.abs(named.v - v).max()


def test_a_stop_between_two_nodes():
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
