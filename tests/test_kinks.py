"""Drives at their limits, joints at stops, dry friction that turns: what is told of steps over them is their error."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import slider
from scipy.integrate import solve_ivp

import varpin as vp
from varpin.simulation.kinks import kinks

CHAIN = vp.planar_chain(2)
OFTEN = "% of the largest joint travel"


def said_of(motion, what):
    """The percent that the warning of kinks gives, None where there is none."""
    told = [sentence for sentence in motion.warnings if what in sentence and OFTEN in sentence]
    return float(told[0].split(OFTEN)[0].split()[-1]) if told else None


def stopping(dt):
    stop = vp.JointStop(1e3, 10.0, lower=[-0.3, -0.4], upper=[0.4, 0.3], width=0.01)
    return vp.Scene(CHAIN, damping=0.3, forces=[stop]), np.tile([6.0, 4.0], (round(1.0 / dt), 1)) + 3.0


def rubbing(dt):
    t = np.arange(round(1.0 / dt)) * dt
    swing = np.stack([12.0 * np.sin(9.0 * t), 8.0 * np.sin(13.0 * t)], axis=1)
    scene = vp.Scene(CHAIN, gravity=False, forces=[vp.CoulombFriction([3.0, 2.0], width=0.05)])
    return scene, swing


def driving(dt):
    servo = vp.PositionServo([900.0, 200.0], [10.0, 2.0], effort=[15.0, 5.0])
    t = np.arange(round(1.0 / dt)) * dt
    goals = np.stack([0.8 * np.sin(29.0 * t), 0.5 * np.sign(np.sin(17.0 * t))], axis=1)
    return vp.Scene(CHAIN, gravity=False, forces=[servo]), goals


@pytest.mark.parametrize(
    ("case", "coarse", "words"),
    [
        (stopping, 0.05, "joints come to their stops"),
        (rubbing, 0.02, "dry friction changes sides"),
        (driving, 0.02, "servos come to"),
    ],
    ids=["stops", "friction", "servos"],
)
def test_what_is_told_is_the_error(case, coarse, words):
    """At coarse steps within a factor of three, at fine ones nothing is told, and little is wrong."""
    for dt in (coarse, 0.0005):
        scene, controls = case(dt)
        options = {"dt": dt, "steps": len(controls), "controls": controls}
        motion = vp.simulate(scene, [0.0, 0.0], [0.0, 0.0], **options)
        times = 64 if dt == coarse else 4
        fine = {"dt": dt / times, "steps": times * len(controls), "controls": np.repeat(controls, times, axis=0)}
        true = vp.simulate(scene, [0.0, 0.0], [0.0, 0.0], **fine, integrator=vp.Radau(3), check=False).q
        true = true[::times]
        wrong = 100.0 * np.abs(motion.q - true).max() / np.ptp(true, axis=0).max()
        said = said_of(motion, words)
        if dt == coarse:
            assert said is not None
            assert wrong / 3.0 < said < 3.0 * wrong
        else:
            assert said is None
            assert wrong < 0.3


def test_a_ball_on_a_stop_against_scipy():
    """A slider that falls on a hard stop, between nodes: every formula in the test."""
    mass, stiffness, width = 1.0, 4e3, 0.01
    scene = vp.Scene(
        slider(mass), gravity=False, forces=[vp.JointStop(stiffness, 0.0, lower=0.0, upper=9.0, width=width)]
    )

    def slope(_, x):
        depth = max(-x[0], 0.0)
        y = min(depth / width, 1.0)
        first = width * (y**3 - 0.5 * y**4) if depth < width else depth - 0.5 * width
        return [x[1], (stiffness * first - 9.81) / mass]

    found = solve_ivp(slope, (0.0, 1.0), [0.3, 0.0], rtol=1e-10, atol=1e-12, t_eval=np.linspace(0.0, 1.0, 51))
    motion = vp.simulate(scene, [0.3], [0.0], dt=0.02, steps=50, controls=[-9.81], integrator=vp.Gauss(2))
    wrong = 100.0 * np.abs(motion.q[:, 0] - found.y[0]).max() / np.ptp(found.y[0])
    assert wrong < 0.1
    assert said_of(motion, "joints come to their stops") is None
    steps = kinks(scene, motion).steps
    below = motion.q[:, 0] < 0.0
    assert set(np.flatnonzero(below[:-1] != below[1:])) <= set(steps)
    assert len(steps) < 20


def test_nothing_is_looked_for_where_forces_are_smooth():
    scene = vp.Scene(CHAIN, damping=0.3, stiffness=1.0)
    motion = vp.simulate(scene, [0.3, 0.0], [0.0, 0.0], dt=0.01, steps=100)
    found = kinks(scene, motion)
    assert found.causes == ()
    assert len(found.steps) == 0


def test_a_step_over_a_drives_limit_is_the_root_of_its_equation():
    """Undivided: halving where Newton's plain iteration turns back and forth would make the map of the step jump."""
    chain, h, rng = vp.planar_chain(2), 0.02, np.random.default_rng(0)
    model, data = chain.model, chain.model.createData()
    stiffness, damping, effort = np.array([4e4, 1e4]), np.array([600.0, 200.0]), np.array([30.0, 10.0])
    scene = vp.Scene(chain, gravity=False, forces=[vp.PositionServo(stiffness, damping, effort)])
    over = []
    for _ in range(200):
        q, v = rng.normal(size=2), 3.0 * rng.normal(size=2)
        goal = q + 0.1 * rng.normal(size=2)
        options = {"dt": h, "steps": 1, "integrator": vp.Midpoint(), "check": False}
        step = vp.simulate(scene, q, v, controls=goal[None], **options)
        if step.statistics.substeps[0] > 1:
            continue
        V = (step.q[1] - q) / h
        Q = q + 0.5 * h * V
        demand = stiffness * (goal - Q) - damping * V
        past = np.clip(np.abs(demand) / effort - 0.9, 0.0, 0.2)
        drive = np.sign(demand) * np.where(past > 0.0, effort * (0.9 + past - 2.5 * past**2), np.abs(demand))
        M = pin.crba(model, data, Q).copy()
        slope = pin.computeCoriolisMatrix(model, data, Q, V).T @ V + drive
        start = pin.crba(model, data, q) @ v
        scale = np.abs(start) + np.abs(M) @ np.abs(V) + 0.5 * h * (np.abs(slope) + np.abs(stiffness * (goal - Q)))
        np.testing.assert_array_less(np.abs(start + 0.5 * h * slope - M @ V), 1e-13 * scale.max())
        begun = stiffness * (goal - q) - damping * v
        over.append(np.any((np.abs(demand) < effort) & (np.abs(begun) > 10.0 * effort)))
    assert len(over) >= 195
    assert sum(over) >= 20
