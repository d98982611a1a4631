"""Arms as people have them, under their files' damping and on servos: defaults against SciPy on Pinocchio's aba."""

from __future__ import annotations

import numpy as np
import pytest
from findings import about
from oracles import exact

import varpin as vp
from varpin.mechanics.forces import drive_forces

# Robots of example-robot-data whose files declare damping; some of those with dry friction, too.
RUBBING = ["xarm7", "z1", "talos_arm", "allegro_left_hand"]
DAMPED = ["allegro_right_hand", "tiago_no_hand", "tiago_pro", "panda", "panda_collision", "baxter"]
DAMPED += ["double_pendulum", "double_pendulum_continuous", "double_pendulum_simple"]
DAMPED += ["alex_sake_hands", "alex_nub_hands", "alex_psyonic_hands"]
EVERY = [(name, share, False, 10) for name in RUBBING + DAMPED for share in (0.05, 0.2)]
EVERY += [(name, share, True, 10) for name in RUBBING for share in (0.05, 0.2)]


@pytest.mark.parametrize(
    ("name", "share", "friction", "steps"),
    [
        ("xarm7", 0.2, True, 4),
        ("z1", 0.05, False, 4),
        *(pytest.param(*values, marks=pytest.mark.slow) for values in EVERY),
    ],
)
def test_torques_that_jump_on_robots_as_they_are(load, name, share, friction, steps):
    """With nothing said of the integrator: within 1 % of the way and 10 % of the largest velocity of each joint."""
    robot, rng = load(name), np.random.default_rng(1)
    forces = [vp.CoulombFriction(robot.friction)] if friction else []
    scene, rest = vp.Scene(robot, damping="robot", forces=forces), np.zeros(robot.dof)
    lower, upper = (np.nan_to_num(limit, posinf=1.0, neginf=-1.0) for limit in robot.position_limits)
    q0 = 0.5 * (lower + upper)
    rows = scene.holding_torque(q0) + share * rng.normal(size=(steps, robot.dof)) * np.minimum(robot.effort_limit, 50.0)
    times = 1e-2 * np.arange(steps + 1)
    own = exact(scene, q0, rest, times, lambda k, q, v: lambda t: rows[k], stiff=True)
    motion = vp.simulate(scene, q0, rest, dt=1e-2, steps=steps, controls=rows)
    assert (np.abs(motion.q - own.q).max(axis=0) <= 0.01 * np.abs(own.q - q0).max(axis=0)).all()
    assert (np.abs(motion.v - own.v).max(axis=0) <= 0.10 * np.abs(own.v).max(axis=0)).all()


TIE = vp.JointTie("wrist_1_joint", "elbow_joint")


@pytest.mark.parametrize(
    ("name", "options", "dt", "integrator"),
    [
        ("xarm7", {"damping": "robot"}, 1e-2, "Radau(stages=4)"),
        ("xarm7", {"damping": "robot"}, 5e-5, "Gauss(stages=2)"),
        ("xarm7", {"damping": "robot", "noise": vp.AdditiveNoise(0.1)}, 1e-2, 'Midpoint(alpha=0.5, kick="held")'),
        ("ur5", {}, 1e-2, "Gauss(stages=2)"),
        ("ur5", {"damping": 1e3, "constraints": TIE}, 1e-2, "Gauss(stages=2)"),
        ("ur5", {"forces": vp.CoulombFriction(1.0)}, 1e-2, "Radau(stages=4)"),
        ("ur5", {"stiffness": 1e4}, 1e-2, "Gauss(stages=4)"),
        ("ur5", {"stiffness": 1e4}, 1e-4, "Gauss(stages=2)"),
    ],
)
def test_who_integrates_where_nobody_is_named(load, name, options, dt, integrator):
    """Dampers and springs faster than the step change it; Radau goes neither with noise nor with constraints."""
    scene = vp.Scene(load(name), **options)
    rest, seed = np.zeros(scene.robot.dof), 0 if "noise" in options else None
    assert vp.simulate(scene, rest, rest, dt=dt, steps=1, rng=seed).integrator == integrator


START = np.array([0.0, -1.2, 1.4, -1.0, -1.57, 0.0])


def served(robot, frequency, effort=np.inf):
    """A UR5 on servos of a natural frequency [Hz] at a posture, damped by 0.7."""
    rate, mass = 2.0 * np.pi * frequency, np.diag(vp.lagrangian_jet(vp.Scene(robot), START, np.zeros(6)).Lvv)
    return vp.Scene(robot, forces=[vp.PositionServo(mass * rate**2, 1.4 * mass * rate, effort)])


def finely(scene, rows, parts):
    """Commands of 5 ms by Radau in steps of a part of that."""
    finer = {"dt": 5e-3 / parts, "steps": parts * len(rows), "controls": np.repeat(rows, parts, axis=0)}
    return vp.simulate(scene, START, np.zeros(6), integrator=vp.Radau(3), check=False, **finer)


def moved(scene, rows, integrator):
    return vp.simulate(scene, START, np.zeros(6), dt=5e-3, steps=len(rows), controls=rows, integrator=integrator)


@pytest.mark.parametrize("frequency", [20, 100, 500, 2000, 5000])
def test_steps_of_servos_of_any_stiffness(load, frequency):
    """Commands that jump, at a step of 5 ms: the end by Radau in finer steps, and where each servo sags to."""
    scene = served(load("ur5"), frequency)
    goal = START + np.array([0.05, -0.04, 0.03, 0.05, -0.05, 0.1])
    rows = np.repeat([goal, START + 0.02, goal], 20, axis=0)
    end = finely(scene, rows, 16).q[-1]
    if frequency >= 100:
        stiffness = scene.actuation.diagonal()
        np.testing.assert_allclose(end, goal - scene.holding_torque(end) / stiffness, atol=1e-6)
        for integrator in (vp.RungeKutta4(), vp.SemiImplicitEuler()):
            with pytest.raises(vp.StepFailure):
                moved(scene, rows, integrator)
    for integrator in (None, vp.Midpoint(), vp.Gauss(2), vp.Gauss(3), vp.Gauss(4), vp.Radau(2)):
        motion = moved(scene, rows, integrator)
        # The midpoint rule is A-stable only: what a jump excites far above its step's rate rings on, and it says so.
        rings = isinstance(integrator, vp.Midpoint) and frequency > 100
        assert np.abs(motion.q[-1] - end).max() <= (1e-2 if rings else 1e-3)
        assert not rings or about(motion.warnings, "error")


@pytest.mark.parametrize("frequency", [20, 500, 5000])
def test_servos_at_their_limits(load, frequency):
    """Commands beyond the motors for a while: within 1e-3 rad in the end, or so far off as the check says."""
    scene = served(load("ur5"), frequency, 0.3 * load("ur5").effort_limit)
    rows = np.tile(START + np.array([0.3, 0.1, -0.1, 0.0, 0.0, 0.0]), (100, 1))
    fine = finely(scene, rows, 64)
    drives = drive_forces(scene.elements, fine.q[:-1], fine.v[:-1], fine.u @ scene.actuation)
    assert np.abs(drives).max() > 0.29 * 150.0
    for integrator in (None, vp.Midpoint(), vp.Gauss(2), vp.Gauss(4)):
        motion = moved(scene, rows, integrator)
        assert np.abs(motion.q[-1] - fine.q[-1]).max() <= max(1e-3, 2.5 * motion.error.max())


@pytest.mark.parametrize("integrator", [None, vp.Midpoint(), vp.Gauss(2), vp.Gauss(4)], ids=str)
def test_smooth_commands_of_a_servo_of_100_hertz_take_whole_steps(load, integrator):
    scene = served(load("ur5"), 100.0)
    swing = np.array([0.3, 0.15, -0.15, 0.1, 0.06, 0.3])
    commands = vp.OpenLoop(lambda t: START + swing * (1.0 - np.cos(2.0 * t)))
    options = {"dt": 5e-3, "steps": 200, "controls": commands, "integrator": integrator}
    work = vp.simulate(scene, START, np.zeros(6), **options).statistics
    assert (work.split_steps, work.substeps.max()) == (0, 1)
