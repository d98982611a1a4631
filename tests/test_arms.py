"""Arms as people have them, under their files' damping and on servos: defaults against SciPy on Pinocchio's aba."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import varpin as vp
from varpin.mechanics.forces import drive_forces

# Robots of example-robot-data whose files declare damping, and how many seconds the check of one takes.
FAST = ("xarm7",)
SLOW = (
    "z1",
    "talos_arm",
    "panda",
    "baxter",
    "double_pendulum",
    "alex_sake_hands",
    "allegro_left_hand",
    "tiago_no_hand",
)


def exact(scene, q0, rows, dt):
    """q and v (N + 1, n) at the nodes under torques held over dt: SciPy's Radau on Pinocchio's forward dynamics."""
    robot, n = scene.robot, scene.robot.dof
    model, data = robot.model, robot.model.createData()

    def slope(t, x, u):
        q, v = x[:n], x[n:]
        force = drive_forces(scene.elements, q[None], v[None], (scene.actuation @ u)[None])[0] - scene.damping * v
        if not robot.ties:
            return np.concatenate([v, pin.aba(model, data, robot.configuration(q), v, force)])
        free, rate = robot.free_model, robot.free_velocities(np.eye(n))
        tied = free.createData()
        at, speed = robot.free_positions(q), robot.free_velocities(v)
        mass = rate @ pin.crba(free, tied, at) @ rate.T
        return np.concatenate([v, np.linalg.solve(mass, force - rate @ pin.rnea(free, tied, at, speed, 0.0 * speed))])

    states = [np.concatenate([q0, np.zeros(n)])]
    for row in rows:
        found = solve_ivp(slope, (0.0, dt), states[-1], "Radau", rtol=1e-8, atol=1e-11, args=(row,))
        states.append(found.y[:, -1])
    return np.split(np.array(states), [n], axis=1)


def middle(robot):
    lower, upper = (np.nan_to_num(limit, posinf=1.0, neginf=-1.0) for limit in robot.position_limits)
    return 0.5 * (lower + upper)


@pytest.mark.parametrize("name", [*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_torques_that_jump_on_arms_with_their_own_damping(load, name):
    """Of the largest way, and of the largest velocity, of each joint, with nothing said of the integrator."""
    robot = load(name)
    scene, q0, rng = vp.Scene(robot, damping="robot"), middle(robot), np.random.default_rng(1)
    rows = scene.holding_torque(q0) + 0.05 * rng.normal(size=(20, robot.dof)) * np.minimum(robot.effort_limit, 50.0)
    q, v = exact(scene, q0, rows, 1e-2)
    motion = vp.simulate(scene, q0, np.zeros(robot.dof), dt=1e-2, steps=20, controls=rows)
    assert (np.abs(motion.q - q).max(axis=0) <= 0.01 * np.abs(q - q0).max(axis=0)).all()
    assert (np.abs(motion.v - v).max(axis=0) <= 0.10 * np.abs(v).max(axis=0)).all()


def test_who_integrates_where_nobody_is_named(load):
    """Dampers faster than the step change it; noise and constraints do not go with the other."""

    def taken(dt=1e-2, steps=1, **options):
        scene = vp.Scene(load("xarm7"), damping="robot", **options)
        return vp.simulate(scene, np.zeros(7), np.zeros(7), dt=dt, steps=steps, rng=0 if options else None).integrator

    assert taken() == "Radau(stages=3)"
    assert taken(5e-5) == "Midpoint(alpha=0.5)"
    assert taken(noise=vp.AdditiveNoise(0.1)) == "Midpoint(alpha=0.5)"
    assert vp.simulate(vp.Scene(load("ur5")), np.zeros(6), np.zeros(6), dt=1e-2, steps=1).integrator == (
        "Midpoint(alpha=0.5)"
    )
    rubbing = vp.Scene(load("ur5"), forces=[vp.CoulombFriction(1.0)])
    assert vp.simulate(rubbing, np.zeros(6), np.ones(6), dt=1e-2, steps=1).integrator == "Radau(stages=3)"
