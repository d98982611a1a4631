"""The Lagrangian the slow and plain way: forward kinematics body by body, for complex q and v, in batches.

It reads joint axes off Pinocchio's joint types and shares no code with the library. The complex step gives its
gradient to rounding, and an eighth-order central difference of the gradient the second derivatives to about 1e-12.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import varpin as vp

AXES = {"X": np.eye(3)[0], "Y": np.eye(3)[1], "Z": np.eye(3)[2]}
# Coefficients of the eighth-order central difference, and its step in units of the coordinate.
DIFFERENCE = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
STEP = 0.02


def joint_axis(model: pin.Model, joint: int) -> tuple[bool, np.ndarray]:
    """(prismatic, axis) of a joint, from its type's name."""
    kind = model.joints[joint].shortname().removeprefix("JointModel")
    if kind == "RevoluteUnboundedUnaligned":
        # Its Python class does not tell the axis; a turn by 1 rad does.
        q = pin.neutral(model)
        q[model.joints[joint].idx_q : model.joints[joint].idx_q + 2] = np.cos(1.0), np.sin(1.0)
        data = model.createData()
        pin.forwardKinematics(model, data, q)
        return False, pin.log3((model.jointPlacements[joint].inverse() * data.liMi[joint]).rotation)
    if kind.endswith("Unaligned"):
        return kind.startswith("P"), np.array(model.joints[joint].extract().axis)
    return kind.startswith("P"), AXES[kind[-1]]


def rotation(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rodrigues' formula, (..., 3, 3)."""
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle)[..., None, None] * K + (1 - np.cos(angle))[..., None, None] * (K @ K)


def energies(model: pin.Model, positions, rates, gravity) -> tuple[np.ndarray, np.ndarray]:
    """Kinetic and potential energy at joint positions and rates (..., joints), every joint on its own."""
    shape = np.broadcast_shapes(positions.shape, rates.shape)[:-1]
    R = [np.broadcast_to(np.eye(3), (*shape, 3, 3))]
    origin, omega, speed = ([np.zeros((*shape, 3))] for _ in range(3))
    kinetic = potential = 0.0
    for joint in range(1, model.njoints):
        up, s, rate = model.parents[joint], positions[..., joint - 1], rates[..., joint - 1][..., None]
        placement, link = model.jointPlacements[joint], model.inertias[joint]
        prismatic, axis = joint_axis(model, joint)
        offset = R[up] @ placement.translation
        base = R[up] @ placement.rotation
        along = base @ axis
        if prismatic:
            offset = offset + along * s[..., None]
            R.append(base)
            omega.append(omega[up])
            speed.append(speed[up] + np.cross(omega[up], offset) + along * rate)
        else:
            R.append(base @ rotation(axis, s))
            omega.append(omega[up] + along * rate)
            speed.append(speed[up] + np.cross(omega[up], offset))
        origin.append(origin[up] + offset)
        lever = R[joint] @ link.lever
        at_center = speed[joint] + np.cross(omega[joint], lever)
        spin = np.einsum("...ji,...j->...i", R[joint], omega[joint])
        kinetic = kinetic + 0.5 * link.mass * (at_center**2).sum(-1) + 0.5 * (spin * (spin @ link.inertia)).sum(-1)
        potential = potential - link.mass * ((origin[joint] + lever) @ gravity)
    return kinetic, potential


def lagrangian(scene: vp.Scene, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """L of a scene at q, v (..., n)."""
    model, names = scene.robot.model, list(scene.robot.joint_names)
    ties = {tie.follower: tie for tie in scene.robot.ties}
    positions, rates = [], []
    for joint in range(1, model.njoints):
        tie = ties.get(joint)
        c = names.index(model.names[tie.leader if tie else joint])
        ratio, offset = (tie.ratio, tie.offset) if tie else (1.0, 0.0)
        positions.append(ratio * q[..., c] + offset)
        rates.append(ratio * v[..., c])
    kinetic, potential = energies(model, np.stack(positions, -1), np.stack(rates, -1), scene.gravity)
    own = np.array([model.armature[model.joints[model.getJointId(name)].idx_v] for name in names])
    kinetic = kinetic + 0.5 * (own * v**2).sum(-1)
    return kinetic - potential - 0.5 * (scene.stiffness * (q - scene.rest) ** 2).sum(-1)


def gradient(f, x: np.ndarray) -> np.ndarray:
    """Complex-step gradient (..., k) of f: (..., k) -> (...) at real x."""
    step = 1e-30
    return f(x[..., None, :] + 1j * step * np.eye(x.shape[-1])).imag / step


def directional(g, x: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """d g(x + s d) / ds at s = 0 for each row d of ``directions`` (r, k): (r, ...)."""
    total = 0.0
    for k, c in DIFFERENCE.items():
        total = total + c * (g(x + k * STEP * directions) - g(x - k * STEP * directions))
    return total / STEP


def continuous(scene: vp.Scene, q, v, controls, dt, running, law=None, method="DOP853", rtol=1e-11):
    """The continuous motion under controls held over dt, by a method of SciPy on Pinocchio's own dynamics.

    ``running(t, q, v, u)`` is integrated beside it. With ``law(k, q, v, u)`` the control of interval k is that, else
    its row of ``controls``. Returns q (N + 1, n), v (N + 1, n) and the integral.
    """
    model, n = scene.robot.model, scene.robot.dof
    data = model.createData()
    qs, vs, total = [np.array(q, float)], [np.array(v, float)], 0.0
    for k, row in enumerate(controls):
        u = row if law is None else law(k, qs[-1], vs[-1], row)

        def slope(t, y, u=u):
            at_q, at_v = y[:n], y[n : 2 * n]
            force = scene.actuation @ u - scene.damping * at_v - scene.stiffness * (at_q - scene.rest)
            return np.concatenate([at_v, pin.aba(model, data, at_q, at_v, force), [running(t, at_q, at_v, u)]])

        start = np.concatenate([qs[-1], vs[-1], [0.0]])
        end = solve_ivp(slope, (k * dt, (k + 1) * dt), start, method=method, rtol=rtol, atol=1e-2 * rtol).y[:, -1]
        qs.append(end[:n])
        vs.append(end[n : 2 * n])
        total += end[-1]
    return np.array(qs), np.array(vs), total
