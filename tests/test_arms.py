"""Arms as people have them, under their files' damping and on servos: defaults against SciPy on Pinocchio's aba."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from scipy.integrate import solve_ivp

import varpin as vp
from varpin.mechanics.forces import drive_forces, of_kind

# Robots of example-robot-data whose files declare damping; some of those with dry friction, too.
RUBBING = ("xarm7", "z1", "talos_arm", "allegro_left_hand")
DAMPED = (
    *RUBBING,
    "allegro_right_hand",
    "tiago_no_hand",
    "tiago_pro",
    "panda",
    "panda_collision",
    "baxter",
    "double_pendulum",
    "double_pendulum_continuous",
    "double_pendulum_simple",
    "alex_sake_hands",
    "alex_nub_hands",
    "alex_psyonic_hands",
)


def exact(scene, q0, rows, dt):
    """q and v (N + 1, n) at the nodes under torques held over dt: SciPy's Radau on Pinocchio's forward dynamics."""
    robot, n = scene.robot, scene.robot.dof
    model, data = robot.model, robot.model.createData()
    friction = of_kind(scene.elements, "CoulombFriction")
    level, width = np.zeros(n), np.ones(n)
    for own in friction:
        level[own.coordinate], width[own.coordinate] = own.values[:2]

    def slope(t, x, u):
        q, v = x[:n], x[n:]
        force = scene.actuation @ u - scene.damping * v - level * np.tanh(v / width)
        if not robot.ties:
            return np.concatenate([v, pin.aba(model, data, robot.configuration(q), v, force)])
        free, rate = robot.model, robot.velocity(np.eye(n))
        tied = free.createData()
        at, speed = robot.configuration(q), robot.velocity(v)
        mass = rate @ pin.crba(free, tied, at) @ rate.T
        return np.concatenate([v, np.linalg.solve(mass, force - rate @ pin.rnea(free, tied, at, speed, 0.0 * speed))])

    states = [np.concatenate([q0, np.zeros(n)])]
    for row in rows:
        found = solve_ivp(slope, (0.0, dt), states[-1], "Radau", rtol=1e-9, atol=1e-12, args=(row,))
        states.append(found.y[:, -1])
    return np.split(np.array(states), [n], axis=1)


def middle(robot):
    lower, upper = (np.nan_to_num(limit, posinf=1.0, neginf=-1.0) for limit in robot.position_limits)
    return 0.5 * (lower + upper)


def judge(robot, share, *, friction, steps=20):
    """Torques that jump each 10 ms, with nothing said of the integrator.

    Within 1 % of the way and 10 % of the largest velocity of each joint.
    """
    forces = [vp.CoulombFriction(robot.friction)] if friction else []
    scene, q0, rng = vp.Scene(robot, damping="robot", forces=forces), middle(robot), np.random.default_rng(1)
    rows = scene.holding_torque(q0) + share * rng.normal(size=(steps, robot.dof)) * np.minimum(robot.effort_limit, 50.0)
    q, v = exact(scene, q0, rows, 1e-2)
    motion = vp.simulate(scene, q0, np.zeros(robot.dof), dt=1e-2, steps=steps, controls=rows)
    assert (np.abs(motion.q - q).max(axis=0) <= 0.01 * np.abs(q - q0).max(axis=0)).all()
    assert (np.abs(motion.v - v).max(axis=0) <= 0.10 * np.abs(v).max(axis=0)).all()


@pytest.mark.parametrize(("name", "share", "friction"), [("xarm7", 0.2, True), ("z1", 0.05, False)])
def test_torques_that_jump_on_arms_as_they_are(load, name, share, friction):
    judge(load(name), share, friction=friction, steps=4)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.05, 0.2])
@pytest.mark.parametrize(
    ("name", "friction"), [*((name, False) for name in DAMPED), *((name, True) for name in RUBBING)]
)
def test_torques_that_jump_on_robots_as_they_are(load, name, friction, share):
    judge(load(name), share, friction=friction)


def test_who_integrates_where_nobody_is_named(load):
    """Dampers and springs faster than the step change it; Radau goes neither with noise nor with constraints."""

    def taken(dt=1e-2, steps=1, **options):
        scene = vp.Scene(load("xarm7"), damping="robot", **options)
        return vp.simulate(scene, np.zeros(7), np.zeros(7), dt=dt, steps=steps, rng=0 if options else None).integrator

    assert taken() == "Radau(stages=4)"
    assert taken(5e-5) == "Gauss(stages=2)"
    assert taken(noise=vp.AdditiveNoise(0.1)) == 'Midpoint(alpha=0.5, kick="held")'
    assert (
        vp.simulate(vp.Scene(load("ur5")), np.zeros(6), np.zeros(6), dt=1e-2, steps=1).integrator == "Gauss(stages=2)"
    )
    held = vp.Scene(load("ur5"), damping=1e3, constraints=[vp.JointTie("wrist_1_joint", "elbow_joint")])
    assert vp.simulate(held, np.zeros(6), np.zeros(6), dt=1e-2, steps=1).integrator == "Gauss(stages=2)"
    rubbing = vp.Scene(load("ur5"), forces=[vp.CoulombFriction(1.0)])
    assert vp.simulate(rubbing, np.zeros(6), np.ones(6), dt=1e-2, steps=1).integrator == "Radau(stages=4)"
    stiff = vp.Scene(load("ur5"), stiffness=1e4)
    assert vp.simulate(stiff, np.zeros(6), np.ones(6), dt=1e-2, steps=1).integrator == "Gauss(stages=4)"
    assert vp.simulate(stiff, np.zeros(6), np.ones(6), dt=1e-4, steps=1).integrator == "Gauss(stages=2)"


START = np.array([0.0, -1.2, 1.4, -1.0, -1.57, 0.0])


def served(robot, frequency, effort=np.inf):
    """A UR5 on servos of a natural frequency [Hz] at a posture, damped by 0.7."""
    rate, mass = 2.0 * np.pi * frequency, np.diag(vp.lagrangian_jet(vp.Scene(robot), START, np.zeros(6)).Lvv)
    return vp.Scene(robot, forces=[vp.PositionServo(mass * rate**2, 1.4 * mass * rate, effort)])


@pytest.mark.parametrize("frequency", [20, 100, 500, 2000, 5000])
def test_steps_of_servos_of_any_stiffness(load, frequency):
    """Commands that jump, at a step of 5 ms: the end by Radau in finer steps, and where each servo sags to."""
    robot = load("ur5")
    scene = served(robot, frequency)
    goal = START + np.array([0.05, -0.04, 0.03, 0.05, -0.05, 0.1])
    rows = np.repeat([goal, START + 0.02, goal], 20, axis=0)
    finer = {"dt": 5e-3 / 16, "steps": 960, "controls": np.repeat(rows, 16, axis=0), "integrator": vp.Radau(3)}
    end = vp.simulate(scene, START, np.zeros(6), **finer, check=False).q[-1]
    if frequency >= 100:
        stiffness = scene.actuation.diagonal()
        np.testing.assert_allclose(end, goal - scene.holding_torque(end) / stiffness, atol=1e-6)
    for integrator in (None, vp.Midpoint(), vp.Gauss(2), vp.Gauss(3), vp.Gauss(4), vp.Radau(2)):
        options = {"dt": 5e-3, "steps": 60, "controls": rows, "integrator": integrator}
        motion = vp.simulate(scene, START, np.zeros(6), **options)
        # The midpoint rule is A-stable only: what a jump excites far above its step's rate rings on, and it says so.
        rings = isinstance(integrator, vp.Midpoint) and frequency > 100
        assert np.abs(motion.q[-1] - end).max() <= (1e-2 if rings else 1e-3)
        assert not rings or about(motion.warnings, "error")
    for integrator in (vp.RungeKutta4(), vp.SemiImplicitEuler()):
        if frequency >= 100:
            with pytest.raises(vp.StepFailure):
                vp.simulate(scene, START, np.zeros(6), dt=5e-3, steps=60, controls=rows, integrator=integrator)


@pytest.mark.parametrize("frequency", [20, 500, 5000])
def test_servos_at_their_limits(load, frequency):
    """Commands beyond the motors for a while: within 1e-3 rad in the end, or so far off as the check says."""
    robot = load("ur5")
    scene = served(robot, frequency, 0.3 * robot.effort_limit)
    goal = START + np.array([0.3, 0.1, -0.1, 0.0, 0.0, 0.0])
    rows = np.tile(goal, (100, 1))
    finer = {"dt": 5e-3 / 64, "steps": 6400, "controls": goal, "integrator": vp.Radau(3)}
    fine = vp.simulate(scene, START, np.zeros(6), **finer, check=False)
    assert np.abs(drive_forces(scene.elements, fine.q[:-1], fine.v[:-1], fine.u @ scene.actuation)).max() > 0.29 * 150.0
    for integrator in (None, vp.Midpoint(), vp.Gauss(2), vp.Gauss(4)):
        motion = vp.simulate(scene, START, np.zeros(6), dt=5e-3, steps=100, controls=rows, integrator=integrator)
        assert np.abs(motion.q[-1] - fine.q[-1]).max() <= max(1e-3, 2.5 * motion.error.max())


@pytest.mark.parametrize("integrator", [None, vp.Midpoint(), vp.Gauss(2), vp.Gauss(4)], ids=str)
def test_smooth_commands_of_a_servo_of_100_hertz_take_whole_steps(load, integrator):
    scene = served(load("ur5"), 100.0)
    swing = np.array([0.3, 0.15, -0.15, 0.1, 0.06, 0.3])
    commands = vp.OpenLoop(lambda t: START + swing * (1.0 - np.cos(2.0 * t)))
    options = {"dt": 5e-3, "steps": 200, "controls": commands, "integrator": integrator}
    motion = vp.simulate(scene, START, np.zeros(6), **options)
    assert motion.statistics.split_steps == 0
    assert (motion.statistics.substeps == 1).all()
