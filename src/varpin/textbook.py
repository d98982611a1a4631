"""The method of the paper in plain NumPy, on Pinocchio's own calls. Start reading here.

From top to bottom: the Lagrangian and its derivatives from the mass matrix and the derivatives of RNEA; the discrete
Lagrangian and its slot derivatives; the forced discrete Euler-Lagrange equations and the step that solves them; the
structured stochastic linearization of that step; S-DDP on it. Nothing is compiled, guarded or fast. The rest of varpin
computes the same quantities, and its tests compare it with this module.

Numbers in parentheses are the paper's equations, with two interpretations. Each half-step carries *half* of the impulse
of the forces, h/2 F: equation (1.4) has the half, (1.5) to (1.10) drop it, and without it forces count twice. The
correction F_i' F_i of (1.3) is (dF_i/dv) M^-1 F_i, which vanishes here because the fields F_i depend on q and u alone.

    q (n,) configuration [rad or m]     v (n,) velocity     p (n,) momentum     u (m,) control [N m or N per unit]
    h time step [s]     a the paper's alpha     dw (k,) increments of k Wiener processes, N(0, h) [s^0.5]

Sources: Johnson and Murphey, "Scalable variational integrators for constrained mechanical systems in generalized
coordinates", 2009; Johnson, Schultz and Murphey, "Structured linearization of discrete mechanical systems", 2015;
Theodorou, Tassa and Todorov, "Stochastic differential dynamic programming", 2010.

Equations (D1), (D2), (D3), (D4) and (O2) of docs/mathematics.md; (1.1) of the paper.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from varpin.errors import InputError, VarpinError

Floats = NDArray[np.float64]
Fields = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]
ReferenceMotion = Callable[[float], Floats]


# --- the system ------------------------------------------------------------------------------------------------------


def no_noise(q: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
    """Fields without a Wiener process."""
    return np.zeros((q.size, 0)), np.zeros((q.size, 0, q.size)), np.zeros((q.size, 0, u.size))


def white_noise(C: float) -> Fields:
    """The paper's case 1: F_i = C e_i."""

    def fields(q: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
        n = q.size
        return C * np.eye(n), np.zeros((n, n, n)), np.zeros((n, n, u.size))

    return fields


def control_noise(C: float) -> Fields:
    """The paper's case 2, with one control for each joint: F_i = C e_i u_i."""

    def fields(q: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
        n, i = q.size, np.arange(q.size)
        Fu = np.zeros((n, n, n))
        Fu[i, i, i] = C
        return C * np.diag(u), np.zeros((n, n, n)), Fu

    return fields


def state_noise(C: float, center: Floats) -> Fields:
    """The paper's case 3: F_i = C e_i (q_i - center_i)^2."""

    def fields(q: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
        n, i = q.size, np.arange(q.size)
        Fq = np.zeros((n, n, n))
        Fq[i, i, i] = 2.0 * C * (q - center)
        return C * np.diag((q - center) ** 2), Fq, np.zeros((n, n, u.size))

    return fields


class System:
    """An arm and the forces on it, of which (1.1) is the equation of motion.

    Args:
        model: Pinocchio model, with its gravity. Every joint has one configuration and one velocity variable, in the
            same order; the rest of varpin treats mimic joints and continuous joints, which have two in Pinocchio.
        actuation: B (n, m), generalized force per unit of control; every joint is driven if left out.
        damping: Viscous damping, (n,) or one number [N m s/rad or N s/m]; the force is F_c = B u - damping v.
        stiffness: Stiffness of joint springs, (n,) or one number [N m/rad or N/m].
        rest: Rest configuration of the springs, (n,) or one number.
        fields: The diffusion fields: a function of (q, u) that returns F (n, k), one column for each Wiener process,
            dF/dq (n, k, n) and dF/du (n, k, m).

    Raises:
        InputError: A joint of the model has more than one variable.
    """

    def __init__(
        self,
        model: pin.Model,
        *,
        actuation: Floats | None = None,
        damping: Floats | float = 0.0,
        stiffness: Floats | float = 0.0,
        rest: Floats | float = 0.0,
        fields: Fields = no_noise,
    ) -> None:
        n = model.nv
        if model.nq != n or any(joint.nv != 1 for joint in list(model.joints)[1:]):
            raise InputError(
                "every joint must have one variable; varpin.load_robot takes continuous and mimic joints, too"
            )
        self.model, self.fields = model, fields
        self.actuation = np.eye(n) if actuation is None else actuation
        self.damping, self.stiffness, self.rest = (
            np.broadcast_to(np.asarray(value, dtype=np.float64), (n,)) for value in (damping, stiffness, rest)
        )


# --- the Lagrangian --------------------------------------------------------------------------------------------------


class LagrangianJet(NamedTuple):
    """L(q, v) = v'M(q)v / 2 - V(q) and its derivatives up to second order at one (q, v).

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


def lagrangian(system: System, q: Floats, v: Floats) -> LagrangianJet:
    """L and its derivatives at q (n,), v (n,): those of the bodies, and of the springs."""
    L, Lq, Lv, Lqq, Lvq, M = rigid_bodies(system.model, q, v)
    stretch = q - system.rest
    energy = float(0.5 * system.stiffness @ stretch**2)
    return LagrangianJet(L - energy, Lq - system.stiffness * stretch, Lv, Lqq - np.diag(system.stiffness), Lvq, M)


def rigid_bodies(model: pin.Model, q: Floats, v: Floats) -> LagrangianJet:
    """L of a model without springs and its derivatives, from Pinocchio's algorithms.

    L_vv = M from ``crba`` and L_v = M v. The inverse dynamics at rest with the acceleration v are M(q) v + g(q); their
    derivative in q, minus that of g, is L_vq. L_q = C'v - g, as dM/dt = C + C'. L_qq is in :func:`rigid_body_Lqq`.
    """
    data = model.createData()
    M = pin.crba(model, data, q)
    M = np.triu(M) + np.triu(M, 1).T
    pin.computeRNEADerivatives(model, data, q, np.zeros_like(v), v)
    Lvq = data.dtau_dq - pin.computeGeneralizedGravityDerivatives(model, model.createData(), q)
    C = pin.computeCoriolisMatrix(model, model.createData(), q, v)
    g = pin.computeGeneralizedGravity(model, model.createData(), q)
    L = float(0.5 * v @ M @ v - pin.computePotentialEnergy(model, data, q))
    return LagrangianJet(L, C.T @ v - g, M @ v, rigid_body_Lqq(model, q, v), Lvq, M)


def rigid_body_Lqq(model: pin.Model, q: Floats, v: Floats) -> Floats:
    """L_qq (n, n) without springs: W_i . (Y_j W_j + S_j x* H_j) - (Y_j S_j) . (S_i x g) for i above j or i = j.

    S_j is the axis of joint j and W_j = V_j x S_j its rate, the columns of Pinocchio's J and dJ/dt in world axes; Y_j
    and H_j are inertia and momentum of all bodies that joint j carries. docs/mathematics.md has the derivation.
    Pinocchio's Python bindings have no second derivatives of RNEA.
    """
    data = model.createData()
    pin.computeJointJacobiansTimeVariation(model, data, q, v)
    S, W = data.J.reshape(6, model.nv), data.dJ.reshape(6, model.nv)  # of one joint the bindings drop an axis
    bodies = range(1, model.njoints)
    Y = [np.zeros((6, 6))] + [data.oMi[j].act(model.inertias[j]).matrix() for j in bodies]
    H = [np.zeros(6)] + [Y[j] @ data.oMi[j].act(pin.getVelocity(model, data, j)).vector for j in bodies]
    for j in reversed(bodies):
        Y[model.parents[j]] = Y[model.parents[j]] + Y[j]
        H[model.parents[j]] = H[model.parents[j]] + H[j]
    gravity = pin.Motion(model.gravity)
    Lqq = np.zeros((model.nv, model.nv))
    for j in bodies:
        col = model.idx_vs[j]
        F = Y[j] @ S[:, col]
        B = Y[j] @ W[:, col] + pin.Motion(S[:, col]).cross(pin.Force(H[j])).vector
        i = j
        while i > 0:
            row = model.idx_vs[i]
            Lqq[row, col] = W[:, row] @ B - F @ pin.Motion(S[:, row]).cross(gravity).vector
            Lqq[col, row] = Lqq[row, col]
            i = model.parents[i]
    return Lqq


# --- the discrete Lagrangian, section 1.1 ----------------------------------------------------------------------------


class DiscreteLagrangian(NamedTuple):
    """The discrete Lagrangian L_d(q0, q1) of one step and its slot derivatives.

    Attributes:
        Ld: Discrete Lagrangian [J s].
        D1: Derivative in q0 (n,); -D1 is the momentum at the start of the step.
        D2: Derivative in q1 (n,), the momentum at its end [N m s or N s].
        D1D1: Second derivative in q0 (n, n), symmetric.
        D2D1: Derivative of D1 in q1 (n, n): ``D2D1[i, j]`` = d D1[i] / d q1[j].
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


def discrete_lagrangian(system: System, q0: Floats, q1: Floats, h: float, a: float = 0.5) -> DiscreteLagrangian:
    """L_d = h L((1 - a) q0 + a q1, (q1 - q0) / h), the generalized midpoint rule before (1.2)."""
    return slots(lagrangian(system, (1 - a) * q0 + a * q1, (q1 - q0) / h), h, a)


def slots(jet: LagrangianJet, h: float, a: float) -> DiscreteLagrangian:
    """L_d and its slot derivatives by the chain rule, from L and its derivatives: equations (D1) and (D2).

    q_m = (1 - a) q0 + a q1 has the derivatives 1 - a and a, v_m = (q1 - q0) / h has -1/h and 1/h.
    """
    L, Lq, Lv, Lqq, Lvq, M = jet
    b, Lqv = 1 - a, Lvq.T
    D2D1 = h * a * b * Lqq + b * Lqv - a * Lvq - M / h
    return DiscreteLagrangian(
        Ld=h * L,
        D1=h * b * Lq - Lv,
        D2=h * a * Lq + Lv,
        D1D1=h * b * b * Lqq - b * (Lqv + Lvq) + M / h,
        D2D1=D2D1,
        D1D2=D2D1.T.copy(),
        D2D2=h * a * a * Lqq + a * (Lqv + Lvq) + M / h,
    )


class Forces(NamedTuple):
    """F- = F+ of a step, each half of its impulse, and their derivatives in q0, q1 and u."""

    F: Floats
    D1: Floats
    D2: Floats
    D3: Floats


def discrete_forces(system: System, q0: Floats, q1: Floats, u: Floats, h: float) -> Forces:
    """F- = F+ = (h/2) F_c(q_m, v_m, u) of (1.2), with F_c = B u - damping v.

    The Ito correction of (1.3) is zero, because the fields F_i do not depend on v.
    """
    D = np.diag(system.damping)
    F = 0.5 * h * (system.actuation @ u - system.damping * (q1 - q0) / h)
    return Forces(F, 0.5 * D, -0.5 * D, 0.5 * h * system.actuation)


# --- a step, (1.6) and algorithm 1 -----------------------------------------------------------------------------------


def step(
    system: System,
    q0: Floats,
    p0: Floats,
    u: Floats,
    h: float,
    *,
    a: float = 0.5,
    dw: Floats | None = None,
    iterations: int = 50,
) -> tuple[Floats, Floats]:
    """One step (q0, p0) -> (q1, p1): (1.4), (1.5) and (1.6) in the position-momentum form (D3), with the forces (D4).

    Solves p0 + D1 L_d + F- + sum_i F_i(q0, u) dw_i = 0 for q1 (1.8) by Newton's iteration, whose matrix is
    D2D1 L_d + D2 F-, and computes p1 = D2 L_d + F+ (1.9). The iteration ends when corrections reach rounding, or no
    longer shrink near it; a fixed tolerance as in algorithm 1 suits one robot only.

    Raises:
        VarpinError: The iteration does not converge.
    """
    kick = 0.0 if dw is None else system.fields(q0, u)[0] @ dw
    q1 = q0 + h * np.linalg.solve(lagrangian(system, q0, np.zeros_like(q0)).Lvv, p0)
    last = np.inf
    for _ in range(iterations):
        Ld, forces = discrete_lagrangian(system, q0, q1, h, a), discrete_forces(system, q0, q1, u, h)
        correction = np.linalg.solve(Ld.D2D1 + forces.D2, p0 + Ld.D1 + forces.F + kick)
        size = np.abs(correction).max()
        rounding = 64 * np.finfo(float).eps * (1.0 + np.abs(q1).max())
        if size <= rounding or (size >= last and last <= 1e3 * rounding):
            return q1, Ld.D2 + forces.F
        q1, last = q1 - correction, size
    raise VarpinError(f"Newton's iteration has not converged in {iterations} iterations: a smaller h may help")


class Motion(NamedTuple):
    """Nodes q (N + 1, n) and p (N + 1, n), and the controls u (N, m) between them."""

    q: Floats
    p: Floats
    u: Floats


def rollout(
    system: System, q0: Floats, v0: Floats, u: Floats, h: float, *, a: float = 0.5, dw: Floats | None = None
) -> Motion:
    """N steps under controls u (N, m) from p0 = M(q0) v0; ``dw`` (N, k) are the Wiener increments."""
    q, p = [q0], [lagrangian(system, q0, v0).Lv]
    for k in range(len(u)):
        q1, p1 = step(system, q[-1], p[-1], u[k], h, a=a, dw=None if dw is None else dw[k])
        q.append(q1)
        p.append(p1)
    return Motion(np.array(q), np.array(p), u)


# --- the structured stochastic linearization, section 1.2 ------------------------------------------------------------


class StepLinearization(NamedTuple):
    """dx1 = (A + sum_i K Fq_i dw_i) dx + (B + sum_i K Fu_i dw_i) du + K F dw to first order, x = (q, p): (1.7).

    A (2n, 2n), B (2n, m), F (n, k), Fq (n, k, n), Fu (n, k, m). K (2n, n) are the columns of A for p0, since noise adds
    to p0 in (1.8). All of these are deterministic, so mean and covariance of dx1 have closed forms.
    """

    A: Floats
    B: Floats
    K: Floats
    F: Floats
    Fq: Floats
    Fu: Floats


def linearize_step(system: System, q0: Floats, q1: Floats, u: Floats, h: float, a: float = 0.5) -> StepLinearization:
    """Derivatives of a step at dw = 0 by implicit differentiation of (1.8), then of (1.9): (1.7) and (1.10)."""
    Ld, forces = discrete_lagrangian(system, q0, q1, h, a), discrete_forces(system, q0, q1, u, h)
    minus_inverse = -np.linalg.inv(Ld.D2D1 + forces.D2)  # -M_{k+1}^-1
    N = Ld.D2D2 + forces.D2
    dq1_dq0 = minus_inverse @ (Ld.D1D1 + forces.D1)  # (1.10)
    dq1_dp0 = minus_inverse
    dq1_du = minus_inverse @ forces.D3
    A = np.block([[dq1_dq0, dq1_dp0], [N @ dq1_dq0 + Ld.D1D2 + forces.D1, N @ dq1_dp0]])
    B = np.vstack([dq1_du, N @ dq1_du + forces.D3])
    return StepLinearization(A, B, A[:, q0.size :], *system.fields(q0, u))


# --- S-DDP, section 2 and algorithm 2 --------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrackingCost:
    """The paper's cost, summed over joints and controls.

    It is the integral of position (q - r(t))^2 + effort u^2, as a sum over the left ends of the steps, plus
    terminal (q - r(t_f))^2 at the end.
    """

    reference: ReferenceMotion
    position: float = 10.0
    effort: float = 0.1
    terminal: float = 1.0

    def total(self, motion: Motion, h: float) -> float:
        """The cost of a motion, without noise."""
        off = self._off(motion.q, h)
        running = self.position * (off[:-1] ** 2).sum() + self.effort * (motion.u**2).sum()
        return float(h * running + self.terminal * (off[-1] ** 2).sum())

    def expansion(self, motion: Motion, h: float) -> tuple[Floats, Floats]:
        """Gradients in q of the terms at all nodes (N + 1, n), and factors (N + 1,) of their Hessians, times 1."""
        weight = 2.0 * np.append(np.full(len(motion.u), h * self.position), self.terminal)
        return weight[:, None] * self._off(motion.q, h), weight

    def _off(self, q: Floats, h: float) -> Floats:
        off: Floats = q - np.array([self.reference(k * h) for k in range(len(q))])
        return off


class BackwardPass(NamedTuple):
    """Feed-forward k (N, m), feedback G (N, m, 2n), Q_u . k, k'Q_uu k, and the weights of noise Sg (N, n, n)."""

    feedforward: Floats
    feedback: Floats
    slope: float
    curvature: float
    noise_weight: Floats


def backward_pass(
    system: System, cost: TrackingCost, motion: Motion, h: float, a: float = 0.5, regularization: float = 0.0
) -> BackwardPass:
    """The quadratic model of the cost-to-go, from the end to the start, (O2).

    With the value v0 + Vx.dx + dx'Vxx dx / 2 after a step and Sg = h K'Vxx K, noise adds sum_i F_i'Sg F_i / 2 to the
    expected value before it; Sg is constant in its derivatives. If no F_i depends on q or u, the controls are DDP's.

    Raises:
        np.linalg.LinAlgError: Q_uu is not positive definite; ``regularization`` (relative to its diagonal) helps.
    """
    (N, m), n = motion.u.shape, motion.q.shape[1]
    lq, lqq = cost.expansion(motion, h)
    Vx, Vxx = np.append(lq[N], np.zeros(n)), np.diag(np.append(np.full(n, lqq[N]), np.zeros(n)))
    feedforward, feedback, weight = np.empty((N, m)), np.empty((N, m, 2 * n)), np.empty((N, n, n))
    slope = curvature = 0.0
    for k in range(N - 1, -1, -1):
        A, B, K, F, Fq, Fu = linearize_step(system, motion.q[k], motion.q[k + 1], motion.u[k], h, a)
        Sg = weight[k] = h * K.T @ Vxx @ K
        Fx = np.concatenate([Fq, np.zeros_like(Fq)], axis=2)
        lx, lxx = np.append(lq[k], np.zeros(n)), np.diag(np.append(np.full(n, lqq[k]), np.zeros(n)))
        Qx = lx + A.T @ Vx + np.einsum("iwx,ij,jw->x", Fx, Sg, F)
        Qu = 2.0 * h * cost.effort * motion.u[k] + B.T @ Vx + np.einsum("iwu,ij,jw->u", Fu, Sg, F)
        Qxx = lxx + A.T @ Vxx @ A + np.einsum("iwx,ij,jwy->xy", Fx, Sg, Fx)
        Qux = B.T @ Vxx @ A + np.einsum("iwu,ij,jwx->ux", Fu, Sg, Fx)
        Quu = 2.0 * h * cost.effort * np.eye(m) + B.T @ Vxx @ B + np.einsum("iwu,ij,jwv->uv", Fu, Sg, Fu)
        L = np.linalg.cholesky(Quu + regularization * np.diag(np.diag(Quu)))
        solved = -np.linalg.solve(L.T, np.linalg.solve(L, np.column_stack([Qu, Qux])))
        d, G = feedforward[k], feedback[k] = solved[:, 0], solved[:, 1:]
        slope += float(Qu @ d)
        curvature += float(d @ Quu @ d)
        Vx = Qx + G.T @ Quu @ d + G.T @ Qu + Qux.T @ d
        Vxx = Qxx + G.T @ Quu @ G + G.T @ Qux + Qux.T @ G
        Vxx = 0.5 * (Vxx + Vxx.T)
    return BackwardPass(feedforward, feedback, slope, curvature, weight)


def noise_cost(system: System, motion: Motion, plan: BackwardPass) -> float:
    """The expected cost of noise, sum_k sum_i F_i'Sg F_i / 2."""
    total = 0.0
    for k, Sg in enumerate(plan.noise_weight):
        F = system.fields(motion.q[k], motion.u[k])[0]
        total += 0.5 * float(np.einsum("iw,ij,jw->", F, Sg, F))
    return total


def forward_pass(system: System, motion: Motion, plan: BackwardPass, gamma: float, h: float, a: float = 0.5) -> Motion:
    """The motion under u + gamma k + G (x - x_old), with feedback from the states x of the new motion."""
    q, p, u = [motion.q[0]], [motion.p[0]], []
    for k in range(len(motion.u)):
        off = np.concatenate([q[-1] - motion.q[k], p[-1] - motion.p[k]])
        u.append(motion.u[k] + gamma * plan.feedforward[k] + plan.feedback[k] @ off)
        q1, p1 = step(system, q[-1], p[-1], u[-1], h, a=a)
        q.append(q1)
        p.append(p1)
    return Motion(np.array(q), np.array(p), np.array(u))


class Plan(NamedTuple):
    """A motion, the backward pass around it, its cost without noise, the cost of noise, and the iterations."""

    motion: Motion
    policy: BackwardPass
    cost: float
    noise_cost: float
    iterations: int


def solve(
    system: System,
    cost: TrackingCost,
    q0: Floats,
    v0: Floats,
    u: Floats,
    h: float,
    *,
    a: float = 0.5,
    armijo: float = 1e-5,
    backtracking: float = 0.25,
    tolerance: float = 1e-9,
    iterations: int = 100,
) -> Plan:
    """Algorithm 2: S-DDP with an Armijo line search, from controls u (N, m).

    If all step lengths of the line search fail, by Newton's iteration or by Armijo's rule, regularization is multiplied
    by ten. The search ends when the expected decrease is below ``tolerance`` times the cost of the motion.
    """
    motion = rollout(system, q0, v0, u, h, a=a)
    regularization, done = 0.0, 0
    while done < iterations:
        plan = backward_pass(system, cost, motion, h, a, regularization)
        now = cost.total(motion, h) + noise_cost(system, motion, plan)
        if -(plan.slope + 0.5 * plan.curvature) <= tolerance * cost.total(motion, h):
            break
        done += 1
        for gamma in backtracking ** np.arange(10):
            try:
                trial = forward_pass(system, motion, plan, gamma, h, a)
            except (VarpinError, np.linalg.LinAlgError):
                continue
            if cost.total(trial, h) + noise_cost(system, trial, plan) <= now + armijo * gamma * plan.slope:
                motion, regularization = trial, 0.1 * regularization if regularization > 1e-6 else 0.0
                break
        else:
            regularization = max(1e-6, 10.0 * regularization)
    plan = backward_pass(system, cost, motion, h, a)
    return Plan(motion, plan, cost.total(motion, h), noise_cost(system, motion, plan), done)
