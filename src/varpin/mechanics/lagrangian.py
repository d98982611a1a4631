"""The Lagrangian L(q, v) = 1/2 v' M(q) v - V(q) of a scene, its derivatives, and the discrete Lagrangian's.

Equations (J1), (J2), (D1) and (D2) of docs/mathematics.md.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import pinocchio as pin

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.mechanics.forces import ELEMENTS, keeps_energy, of_kind
from varpin.mechanics.scene import Scene, refuse_constraints, require_scene
from varpin.support.checks import JointValues, fraction, joint_array, positive, word
from varpin.textbook import DiscreteLagrangian, LagrangianJet, rigid_bodies, slots


def lagrangian_jet(
    scene: Scene, q: JointValues, v: JointValues, *, backend: Literal["compiled", "pinocchio"] = "compiled"
) -> LagrangianJet:
    """L, (J1), and all its derivatives up to second order, (J2); with gravity, springs and armature of the scene.

    Args:
        scene: The scene.
        q: Configuration, (n,) or by joint name [rad or m].
        v: Velocity, (n,) or by joint name [rad/s or m/s].
        backend: ``"compiled"`` takes one sweep over the tree (see ``docs/mathematics.md``); ``"pinocchio"`` puts
            the same together from Pinocchio's algorithms, slowly, as a reference, without stops and springs between
            frames.

    Raises:
        InputError: Wrong shapes, values that are not finite, or an unknown backend, or a force that the backend lacks.
    """
    joints = require_scene(scene).robot.joint_names
    q, v = joint_array("q", q, joints), joint_array("v", v, joints)
    word("backend", backend, ("compiled", "pinocchio"))
    return LagrangianJet(*scene.core.jet(q, v)) if backend == "compiled" else _of_pinocchio(scene, q, v)


def _of_pinocchio(scene: Scene, q: Floats, v: Floats) -> LagrangianJet:
    """The textbook's Lagrangian of the robot's bodies, in the coordinates, with the springs of the scene."""
    missing = {each.kind for each in scene.elements if ELEMENTS[each.kind].potential} - {"JointSpring"}
    missing |= {each.kind for each in scene.couplings if keeps_energy(each)}
    if missing:
        raise InputError(f"backend='pinocchio' has no {', '.join(sorted(missing))}; backend='compiled' has")
    robot = scene.robot
    model = robot.model.copy()
    model.gravity = pin.Motion(scene.gravity, np.zeros(3))
    free = rigid_bodies(model, robot.configuration(q), robot.velocity(v))
    # Jacobian of the free joints in the coordinates; mimic joints make it more than a permutation.
    G = robot.velocity(np.eye(robot.dof)).T
    rotors = scene.armature - robot.tree.armature
    springs = [(q[each.coordinate], *each.values) for each in of_kind(scene.elements, "JointSpring")]
    potential = sum(0.5 * stiffness * (at - rest) ** 2 for at, stiffness, rest in springs)
    Lvv = G.T @ free.Lvv @ G + np.diag(rotors)
    return LagrangianJet(
        L=free.L + float(0.5 * v @ (rotors * v) - potential),
        Lq=G.T @ free.Lq - scene.stiffness * (q - scene.rest),
        Lv=Lvv @ v,
        Lqq=G.T @ free.Lqq @ G - np.diag(scene.stiffness),
        Lvq=G.T @ free.Lvq @ G,
        Lvv=Lvv,
    )


def discrete_lagrangian(
    scene: Scene, q0: JointValues, q1: JointValues, dt: float, *, alpha: float = 0.5
) -> DiscreteLagrangian:
    """L_d(q0, q1) = dt L((1 - alpha) q0 + alpha q1, (q1 - q0) / dt), (D1), and its slot derivatives, (D2).

    The generalized midpoint rule (Marsden and West 2001, Johnson and Murphey 2009), without friction and controls.

    Args:
        scene: The scene.
        q0: Configuration at the start, (n,) or by joint name [rad or m].
        q1: Configuration at the end, (n,) or by joint name [rad or m].
        dt: Time step [s].
        alpha: Evaluation point of the Lagrangian between q0 and q1, in [0, 1]; 1/2 gives second order.

    Raises:
        InputError: Wrong shapes, values that are not finite, dt <= 0, alpha outside [0, 1].
    """
    joints = require_scene(scene).robot.joint_names
    refuse_constraints(scene, "discrete_lagrangian")
    q0, q1 = joint_array("q0", q0, joints), joint_array("q1", q1, joints)
    h, a = positive("dt", dt, "s"), fraction("alpha", alpha)
    return slots(lagrangian_jet(scene, (1.0 - a) * q0 + a * q1, (q1 - q0) / h), h, a)
