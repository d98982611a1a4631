"""The Lagrangian L(q, v) = 1/2 v' M(q) v - V(q) of a scene, its derivatives, and the discrete Lagrangian's.

Equations (J1), (J2), (D1) and (D2) of docs/mathematics.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pinocchio as pin

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.mechanics.forces import ELEMENTS, keeps_energy, of_kind
from varpin.mechanics.scene import Scene, refuse_constraints, require_scene
from varpin.support.checks import JointValues, fraction, joint_array, positive
from varpin.textbook import rigid_body_Lqq


@dataclass(frozen=True, eq=False)
class LagrangianJet:
    """A Lagrangian and its derivatives up to second order at one (q, v).

    Attributes:
        L: Lagrangian [J].
        Lq: dL/dq (n,) [N m or N].
        Lv: dL/dv = M v (n,), the momentum [N m s or N s].
        Lqq: d2L/dq2 (n, n), symmetric.
        Lvq: d2L/dv dq (n, n): ``Lvq[i, j]`` = d Lv[i] / d q[j]; its transpose is d Lq / dv.
        Lvv: d2L/dv2 = M (n, n), symmetric, armature included.
    """

    L: float
    Lq: Floats
    Lv: Floats
    Lqq: Floats
    Lvq: Floats
    Lvv: Floats

    def __repr__(self) -> str:
        return f"LagrangianJet({len(self.Lq)} joints, L = {self.L:.6g} J)"


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
    if backend == "compiled":
        return _compiled(scene, q, v)
    if backend == "pinocchio":
        return _from_pinocchio(scene, q, v)
    raise InputError(f"backend must be 'compiled' or 'pinocchio', got {backend!r}")


def _compiled(scene: Scene, q: Floats, v: Floats) -> LagrangianJet:
    return LagrangianJet(*scene.core.jet(q, v))


def _from_pinocchio(scene: Scene, q: Floats, v: Floats) -> LagrangianJet:
    missing = {each.kind for each in scene.elements if ELEMENTS[each.kind].potential} - {"JointSpring"}
    missing |= {each.kind for each in scene.couplings if keeps_energy(each)}
    if missing:
        raise InputError(f"backend='pinocchio' has no {', '.join(sorted(missing))}; backend='compiled' has")
    robot = scene.robot
    model = robot.free_model.copy()
    model.gravity = pin.Motion(scene.gravity, np.zeros(3))
    data = model.createData()
    full_q, full_v = robot.free_positions(q), robot.free_velocities(v)
    # Jacobian of the free joints in the coordinates; mimic joints make it more than a permutation.
    G = robot.free_velocities(np.eye(robot.dof)).T

    own_armature = model.armature.copy()
    model.armature = np.zeros(model.nv)
    M = pin.crba(model, data, full_q).copy()
    M = np.triu(M) + np.triu(M, 1).T
    pin.computeRNEADerivatives(model, data, full_q, np.zeros(model.nv), full_v)
    A = data.dtau_dq.copy()
    A -= pin.computeGeneralizedGravityDerivatives(model, data, full_q)
    C = pin.computeCoriolisMatrix(model, data, full_q, full_v).copy()
    gravity = pin.computeGeneralizedGravity(model, data, full_q).copy()
    M += np.diag(own_armature)
    added = np.diag(scene.armature - robot.tree.armature)

    deflection = q - scene.rest
    Lvv = G.T @ M @ G + added
    Lq = G.T @ (C.T @ full_v - gravity) - scene.stiffness * deflection
    Lqq = G.T @ rigid_body_Lqq(model, full_q, full_v) @ G - np.diag(scene.stiffness)
    potential = pin.computePotentialEnergy(model, data, full_q)
    springs = of_kind(scene.elements, "JointSpring")
    potential += sum(0.5 * spring.values[0] * (q[spring.coordinate] - spring.values[1]) ** 2 for spring in springs)
    return LagrangianJet(float(0.5 * v @ Lvv @ v - potential), Lq, Lvv @ v, Lqq, G.T @ A @ G, Lvv)


@dataclass(frozen=True, eq=False)
class DiscreteLagrangian:
    """The discrete Lagrangian of one step and its slot derivatives.

    Attributes:
        Ld: Discrete Lagrangian [J s].
        D1: Derivative in q0 (n,); -D1 is the momentum at the start of the step.
        D2: Derivative in q1 (n,), the momentum at its end [N m s or N s].
        D1D1: Second derivative in q0 (n, n), symmetric.
        D2D1: Derivative of D1 in q1 (n, n).
        D1D2: Derivative of D2 in q0 (n, n), the transpose of D2D1.
        D2D2: Second derivative in q1 (n, n), symmetric.
    """

    Ld: float
    D1: Floats
    D2: Floats
    D1D1: Floats
    D2D1: Floats
    D1D2: Floats
    D2D2: Floats

    def __repr__(self) -> str:
        return f"DiscreteLagrangian({len(self.D1)} joints, Ld = {self.Ld:.6g} J s)"


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
    jet = lagrangian_jet(scene, (1.0 - a) * q0 + a * q1, (q1 - q0) / h)
    b = 1.0 - a
    Lqv = jet.Lvq.T
    D2D1 = h * a * b * jet.Lqq + b * Lqv - a * jet.Lvq - jet.Lvv / h
    return DiscreteLagrangian(
        Ld=h * jet.L,
        D1=h * b * jet.Lq - jet.Lv,
        D2=h * a * jet.Lq + jet.Lv,
        D1D1=h * b * b * jet.Lqq - b * (Lqv + jet.Lvq) + jet.Lvv / h,
        D2D1=D2D1,
        D1D2=D2D1.T.copy(),
        D2D2=h * a * a * jet.Lqq + a * (Lqv + jet.Lvq) + jet.Lvv / h,
    )
