"""Each force alone, and all together, on five kinds of robots: a step's equations, its derivatives, and the energy.

The equations of a step are put together from Pinocchio's Lagrangian of the bare robot and the formulas of the forces,
written out in :mod:`test_forces` and :mod:`test_frame_forces`.
"""

import functools

import numpy as np
import pytest
from naive import gradient
from refusals import refused
from test_forces import WEIGHTS, one_step, total
from test_frame_forces import TURNED, energy, push

import varpin as vp

# A finger, two arms of which one has a gripper with a mimic joint, a hand, and a mobile manipulator with a lift.
ROBOTS = {
    "finger": (lambda: vp.load_robot("finger"), "dip", "mcp"),
    "ur5": (lambda: vp.load_robot("ur5"), "tool0", "forearm_link"),
    "panda": (lambda: vp.load_robot("panda"), "panda_leftfinger", "panda_rightfinger"),
    "allegro": (lambda: vp.load_robot("allegro_right_hand"), "link_3.0", "link_14.0"),
    "tiago": (lambda: vp.load_robot("tiago_no_hand", base="planar"), "arm_7_link", "torso_lift_link"),
}
KINDS = [
    "Armature",
    "JointSpring",
    "JointDamper",
    "CoulombFriction",
    "Stribeck",
    "JointStop",
    "damped JointStop",
    "PositionServo",
    "FrameLoad",
    "FrameWrench",
    "FrameSpring",
    "FrameLengthSpring",
    "FrameTurnSpring",
    "FrameDamper",
    "CustomForce",
    "all",
]
CONSERVATIVE = {
    "Armature", "JointSpring", "JointStop", "FrameLoad", "FrameSpring", "FrameLengthSpring", "FrameTurnSpring"
}  # fmt: skip
PAIRS = [(name, kind) for name in ROBOTS for kind in KINDS]


@functools.cache
def prepared(name):
    """The robot, its frames, a state, and the inertia that a push on one coordinate meets (n,)."""
    make, tip, other = ROBOTS[name]
    robot = make()
    rng = np.random.default_rng(8)
    q, v = 0.7 * rng.normal(size=robot.dof), rng.normal(size=robot.dof)
    light = 1.0 / np.diag(np.linalg.inv(vp.lagrangian_jet(vp.Scene(robot), q, v).Lvv))
    return robot, tip, other, q, v, light


def drag(unit):
    """Coupled, and no gradient."""

    def f(q, v):
        return unit * (0.4 * np.sin(np.roll(q, 1)) - 0.5 * v * np.sqrt(1.0 + v**2) + 0.2 * np.roll(v, -1) * q)

    return f


def forces_on(name):
    """One of each kind, in units of the robot's inertia, so that each accelerates it by some rad/s^2."""
    robot, tip, other, q, _, unit = prepared(name)
    n, s = robot.dof, float(unit.min())
    first, *_, last = robot.joint_names
    touched = np.arange(n) % 3
    upper = np.where(touched == 0, q - 0.2, q + 1.0)
    lower = np.where(touched == 1, q + 0.7, upper - 9.0)
    lower = np.where(lower < upper, lower, upper - 9.0)
    stop = {"lower": lower, "upper": upper, "width": 0.5}
    some = np.zeros(n)
    some[[1, -1]] = unit[[1, -1]]
    return {
        "Armature": vp.Armature(0.5 * unit),
        "JointSpring": vp.JointSpring(7.0 * unit, 0.2),
        "JointDamper": vp.JointDamper(0.8 * unit),
        "CoulombFriction": vp.CoulombFriction(2.0 * unit, width=0.8),
        "Stribeck": vp.CoulombFriction({first: unit[0]}, 1.0, {first: 2.5 * unit[0]}, 1.5),
        "JointStop": vp.JointStop(9.0 * unit, **stop),
        "damped JointStop": vp.JointStop({last: 4.0 * unit[-1]}, {last: 2.0 * unit[-1]}, **stop),
        "PositionServo": vp.PositionServo(20.0 * some, 2.0 * some, np.where(some > 0.0, 30.0 * some, np.inf)),
        "FrameLoad": vp.FrameWrench((tip, [0.0, 0.1, 0.0]), s * np.array([3.0, -2.0, 5.0, 0.0, 0.0, 0.0])),
        "FrameWrench": vp.FrameWrench(tip, s * np.array([1.0, -2.0, 0.5, 0.2, 0.4, -0.3]), axes="frame"),
        "FrameSpring": vp.FrameSpring(tip, (other, [0.05, 0.1, 0.0]), s * np.array([8.0, 0.0, 3.0]), [0.1, 0.0, -0.2]),
        "FrameLengthSpring": vp.FrameSpring((tip, [0.0, 0.0, 0.1]), [1.2, -0.9, 1.1], 6.0 * s, 0.7),
        "FrameTurnSpring": vp.FrameSpring(
            tip, other, 0.0, rotational_stiffness=s * np.array([1.0, 5.0, 0.5]), rest_rotation=TURNED
        ),
        "FrameDamper": vp.FrameDamper((tip, [0.1, 0.0, 0.0]), other, 0.6 * s, 0.4 * s),
        "CustomForce": vp.CustomForce(drag(unit), "complex"),
    }


def setting(name, kind):
    """A scene with forces of one kind, or all, and a state with a control for each joint."""
    robot, _, _, q, v, unit = prepared(name)
    every = forces_on(name)
    scene = vp.Scene(robot, damping=0.0, forces=list(every.values()) if kind == "all" else every[kind])
    u = 0.5 * unit * np.cos(np.arange(robot.dof))
    if kind in ("all", "PositionServo"):
        # The drive of the last joint is at its effort, in the middle of its bend.
        u[[1, -1]] = q[1] + 0.4, q[-1] + 1.5 + 0.1 * v[-1]
    return scene, q, v, u


def pushes(scene, q, v, u):
    """All forces (n,) beside the bare robot's Lagrangian, by their formulas: those of energies, and the others."""
    robot, driven = scene.robot, scene.actuation @ u
    others = driven + total(scene, q, v, driven)
    of_energy = np.zeros_like(q)
    for own in scene.forces:
        if isinstance(own, vp.CustomForce):
            others = others + own.f(q, v)
        elif isinstance(own, vp.FrameWrench | vp.FrameSpring | vp.FrameDamper):
            others = others + push(robot, own, q, v)
            of_energy = of_energy - gradient(lambda y, own=own: energy(robot, own, y), q)
    return of_energy, others


@pytest.mark.parametrize(("name", "kind"), PAIRS)
def test_the_equations_of_a_step(name, kind):
    """p0 + D1 Ld + F- = 0 and p1 = D2 Ld + F+, at the midpoint."""
    scene, q, v, u = setting(name, kind)
    n, h = q.size, 4e-3
    rotors = np.zeros(n)
    for own in scene.forces:
        rotors = rotors + (own.inertia if isinstance(own, vp.Armature) else 0.0)
    bare = vp.Scene(scene.robot, damping=0.0)
    motion = vp.simulate(scene, q, v, dt=h, steps=1, controls=u, integrator=vp.Midpoint(), check=False)
    middle, rate = 0.5 * (motion.q[0] + motion.q[1]), (motion.q[1] - motion.q[0]) / h
    jet = vp.lagrangian_jet(bare, middle, rate, backend="pinocchio")
    of_energy, others = pushes(scene, middle, rate, u)
    p, half = jet.Lv + rotors * rate, 0.5 * h * (jet.Lq + of_energy + others)
    first = vp.lagrangian_jet(bare, q, v, backend="pinocchio").Lv + rotors * v
    size = 1e-12 * (np.abs(p) + np.abs(half)).max()
    # What positions round to, the velocity between them multiplies by 1 / h.
    size += 4.0 * np.finfo(float).eps * np.abs(middle).max() / h * np.abs(jet.Lvv).sum(axis=1).max()
    np.testing.assert_allclose(motion.p[0], first, rtol=0, atol=size)
    np.testing.assert_allclose(p - half, first, rtol=0, atol=size)
    np.testing.assert_allclose(motion.p[1], p + half, rtol=0, atol=size)


def units_of(scene, q, v, u, integrator):
    """Sizes (3 n,) of a state and a control that accelerate joints alike."""
    light = 1.0 / np.diag(np.linalg.inv(vp.lagrangian_jet(scene, q, v).Lvv))
    servos = np.zeros(q.size, dtype=bool)
    for own in scene.forces:
        if isinstance(own, vp.PositionServo):
            servos = own.stiffness > 0.0
    return np.concatenate(
        [np.ones(q.size), light if integrator.variational else np.ones(q.size), np.where(servos, 1.0, light)]
    )


def integrators_of(kind, every, alone):
    """All of them where all forces act, and the first where one does."""
    return every if kind == "all" else every[:alone]


@pytest.mark.parametrize(("name", "kind"), PAIRS)
def test_linearization(name, kind):
    """Along random directions, against differences of eighth order."""
    scene, q, v, u = setting(name, kind)
    n, h, size = q.size, 2e-3, 4e-3
    rng = np.random.default_rng(5)
    for integrator in integrators_of(kind, (vp.Midpoint(), vp.RungeKutta4(), vp.Gauss(2), vp.Radau(2)), 2):
        motion = vp.simulate(scene, q, v, dt=h, steps=1, controls=u, integrator=integrator, check=False)
        assert motion.statistics.split_steps == 0
        lin, units = vp.linearize(scene, motion, integrator=integrator), units_of(scene, q, v, u, integrator)
        x = np.concatenate([q, motion.p[0] if integrator.variational else v, u])
        for _ in range(2):
            e = rng.uniform(-1.0, 1.0, 3 * n) * units

            def end(step, e=e, x=x, integrator=integrator):
                return one_step(scene, *np.split(x + step * size * e, [2 * n]), h, integrator)

            found = sum(w * (end(i) - end(-i)) for i, w in WEIGHTS.items()) / size / units[: 2 * n]
            given = np.hstack([lin.A[0], lin.B[0]]) @ e / units[: 2 * n]
            assert np.abs(given - found).max() <= 1e-8 * max(1.0, np.abs(found).max()), integrator


@pytest.mark.parametrize(("name", "kind"), [(name, kind) for name, kind in PAIRS if kind != "CustomForce"])
def test_second_order(name, kind):
    """Against differences of the first derivatives, of eighth order, along a random direction.

    Of a force in Python there are none, and that is said.
    """
    scene, q, v, u = setting(name, kind)
    if kind == "all":
        motion = vp.simulate(scene, q, v, dt=2e-3, steps=1, controls=u, integrator=vp.Midpoint(), check=False)
        with refused(vp.InputError, "CustomForce"):
            vp.second_order(scene, motion, np.ones(2 * q.size))
        kept = [own for own in scene.forces if not isinstance(own, vp.CustomForce)]
        scene = vp.Scene(scene.robot, damping=0.0, forces=kept)
    n, h, size = q.size, 2e-3, 2e-3
    rng = np.random.default_rng(6)
    for integrator in integrators_of(kind, (vp.Midpoint(), vp.Gauss(2), vp.Radau(2)), 1):
        motion = vp.simulate(scene, q, v, dt=h, steps=1, controls=u, integrator=integrator, check=False)
        units = units_of(scene, q, v, u, integrator)
        z = rng.normal(size=2 * n) / units[: 2 * n]
        own = vp.second_order(scene, motion, z, integrator=integrator)
        given = np.block([[own.xx[0], own.ux[0].T], [own.ux[0], own.uu[0]]])
        e, x = rng.uniform(-1.0, 1.0, 3 * n) * units, np.concatenate([q, motion.p[0], u])

        def slope(step, e=e, x=x, z=z, integrator=integrator):
            y = x + step * size * e
            rate = np.linalg.solve(vp.lagrangian_jet(scene, y[:n], np.zeros(n)).Lvv, y[n : 2 * n])
            end = vp.simulate(
                scene, y[:n], rate, dt=h, steps=1, controls=y[2 * n :], integrator=integrator, check=False
            )
            lin = vp.linearize(scene, end, integrator=integrator)
            return z @ np.hstack([lin.A[0], lin.B[0]])

        found = sum(w * (slope(i) - slope(-i)) for i, w in WEIGHTS.items()) / size * units
        assert np.abs(given @ e * units - found).max() <= 1e-8 * max(1.0, np.abs(found).max()), integrator


@pytest.mark.parametrize(("name", "kind"), [(name, kind) for name, kind in PAIRS if kind in CONSERVATIVE])
def test_potentials_keep_steps_symplectic(name, kind):
    scene, q, v, _ = setting(name, kind)
    n = q.size
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    for integrator in (vp.Midpoint(), vp.Gauss(2)):
        motion = vp.simulate(scene, q, v, dt=2e-3, steps=5, integrator=integrator, check=False)
        A = vp.linearize(scene, motion, integrator=integrator).A
        assert np.abs(A.transpose(0, 2, 1) @ J @ A - J).max() <= 1e-11 * np.abs(A).max() ** 2


@pytest.mark.parametrize(("name", "kind"), PAIRS)
def test_power_balance(name, kind):
    """The energy changes by the work of what is no potential, by the formulas; what steps lose of it is noted."""
    scene, q, v, u = setting(name, kind)
    motion = vp.simulate(scene, q, v, dt=5e-4, steps=40, controls=u, integrator=vp.Gauss(3), check=False)
    power = np.array([motion.v[k] @ work(scene, motion.q[k], motion.v[k], u) for k in range(41)])
    # Simpson's rule.
    done = (power[:-1:2] + 4.0 * power[1::2] + power[2::2]).cumsum() * motion.dt / 3.0
    size = np.abs(power).sum() * motion.dt
    assert size > 0.0
    np.testing.assert_allclose(motion.energy[2::2] - motion.energy[0], done, rtol=0, atol=1e-7 * size)
    assert np.abs(motion.statistics.energy_defect).max() <= 1e-6 * size


def work(scene, q, v, u):
    """The forces (n,) that are part of no energy, by their formulas."""
    driven = scene.actuation @ u
    potential = total(vp.Scene(scene.robot, damping=0.0, forces=conservative(scene)), q, v, np.zeros_like(q))
    others = driven + total(scene, q, v, driven) - potential
    for own in scene.forces:
        if isinstance(own, vp.CustomForce):
            others = others + own.f(q, v)
        elif isinstance(own, vp.FrameWrench | vp.FrameSpring | vp.FrameDamper):
            others = others + push(scene.robot, own, q, v)
    return others


def conservative(scene):
    """The springs of the joints, and their stops without dampers."""
    found = []
    for own in scene.forces:
        if isinstance(own, vp.JointSpring):
            found.append(own)
        elif isinstance(own, vp.JointStop):
            found.append(vp.JointStop(own.stiffness, 0.0, own.lower, own.upper, own.width))
    return found
