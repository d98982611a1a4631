"""The structured linearization of a stochastic discrete map, and its means and covariances.

Equation (L3) of docs/mathematics.md; (1.7) and (1.10) of the paper.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.integrators import Integrator, integrator_of
from varpin.integrators.base import noise_fields
from varpin.integrators.registry import require_motion, require_scene_of
from varpin.mechanics.noise import Fields, ito_drift, over_steps
from varpin.mechanics.scene import Scene, require_scene
from varpin.signals.commands import open_line, open_loop
from varpin.simulation.choice import given_integrator
from varpin.simulation.velocity_noise import wrong_spread
from varpin.support.checks import as_floats, finite_array
from varpin.support.differences import slopes
from varpin.trajectory import Trajectory

# Difference of the end of a step from the recorded one, as shares of its change of velocity and of its speed: rounding.
_SAME, _OF_SPEED = 1e-5, 1e-8

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Linearization:
    """First-order model of N steps around a trajectory, exactly affine in the Wiener increments.

        dx[j+1] = (A + sum_i Gx_i dw_i) dx + (B + sum_i Gu_i dw_i) du + G dw

    Every derivative is taken at dw = 0, the paper's choice; the exact second derivative in x and dw differs by O(dt).
    The end of a step, at which a split kick has its second half, is therefore the one without noise. x is (q, p) for
    variational integrators and (q, v) for the others.

    Under constraints each step is a map on all of R^2n: it begins at any (q, p), removes the part of p normal to the
    constraints, and ends on them. A, B and K are derivatives of that map: A has rank 2 (n - r) for r independent rows
    and is symplectic on tangent directions of the constraints alone; K is zero for an impulse normal to them.

    Attributes:
        A: dx1/dx0 (N, 2n, 2n); symplectic without forces and damping.
        B: dx1/du (N, 2n, m), for a change du of the control over the whole step.
        K: Derivative of x1 in a kick (N, 2n, n): a jump of the momentum at the start of the step, with the drift
            unchanged. It is dx1/dp0 if no diffusion field depends on the velocity. Otherwise the drift from
            Stratonovich to Ito, (1/2) sum_i (dF_i/dv) M^-1 F_i, is that of the state before the kick; dx1/dp0 includes
            the derivative of the drift, and is A[:, :, n:], or A[:, :, n:] M^-1 for integrators on (q, v). With
            ``kick="held"`` it is the derivative in the impulse of a force that is constant over the step.
        J: The same for a jump of x's second half (N, 2n, n): of p, which is K, or of v.
        F: Diffusion fields (N, n, k).
        G: dx1/dw (N, 2n, k); K F if the whole kick precedes the step or is held over it. Of motions with controls that
            are linear between nodes it is (N, 2n, K), with the increments for their slopes, see
            :attr:`Trajectory.dw`; so are the next two.
        Gx: Derivative of G in x0 through the fields (N, 2n, k, 2n).
        Gu: Derivative of G in u (N, 2n, k, m).
        dt: Time step [s].
        variational: Whether x is (q, p) rather than (q, v).
        ramp: dx1/du for a change of the control that grows linearly from 0 at the start of the step to du at its end
            (N, 2n, m), from :func:`linearize` of a motion whose controls change within steps; else None. For controls
            linear between nodes, dx1 = A dx + (B - ramp) du_k + ramp du_(k+1).
        Gramp: Derivative of G in such a change (N, 2n, k, m); None where ``ramp`` is.
        warnings: Where moments of velocities are wrong, as damping is fast for the step; from :func:`linearize`.
    """

    A: Floats
    B: Floats
    K: Floats
    J: Floats
    F: Floats
    G: Floats
    Gx: Floats
    Gu: Floats
    dt: float
    variational: bool
    ramp: Floats | None = None
    Gramp: Floats | None = None
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        states, controls = self.B.shape[1:]
        x = "(q, p)" if self.variational else "(q, v)"
        return (
            f"Linearization({self.steps} steps of {self.dt:g} s, x = {x} of {states // 2} joints, {controls} controls, "
            f"{self.F.shape[2]} noise processes)"
        )

    @property
    def steps(self) -> int:
        """N."""
        return len(self.A)


def linearize(scene: Scene, trajectory: Trajectory, *, integrator: Integrator | None = None) -> Linearization:
    """Linearize every step of a trajectory: (1.7) and (1.10) of the paper.

    Main args:
        scene: The scene of the trajectory.
        trajectory: From :func:`varpin.simulate`.

    Other Args:
        integrator: Its integrator; read from ``trajectory.integrator`` if left out. It has to be given if it is not one
            of varpin's own; its guards may differ from those of the simulation.

    Raises:
        InputError: The trajectory is of another robot, another number of controls or processes, another integrator or
            a scene with other gravity, damping, springs, inertias or actuation; or its integrator is unknown.
        LinearizationError: A step has no solution at dw = 0.
    """
    integrator = matching_integrator(require_scene(scene), trajectory, integrator)
    within = trajectory.u_stages.shape[1] > 0 or trajectory.u_nodes.shape[1] > 0
    found = linearize_steps(scene, trajectory, integrator, trajectory.q[0], ramps=within)
    if not integrator.variational:
        # From a jump of the velocity to one of the momentum.
        M, _ = scene.core.jets(trajectory.q[:-1], trajectory.v[:-1])
        found = replace(found, K=found.J @ np.linalg.inv(M))
    return replace(found, warnings=wrong_spread(scene, integrator, trajectory))


def linearize_steps(
    scene: Scene, trajectory: Trajectory, integrator: Integrator, first: Floats, *, ramps: bool = False
) -> Linearization:
    """:func:`linearize` without checks, of a part of a motion that began at configuration ``first`` (n,).

    For integrators on (q, v), K is empty (N, 2n, 0): it needs the inverses of all mass matrices, and plans do not use
    it. ``ramps`` asks for the derivatives in controls that change within a step.
    """
    n, m, steps = scene.robot.dof, scene.controls, trajectory.steps
    Jx, Jf, Jk, Jr = integrator.linearize(scene, trajectory, ramps=ramps)
    ramp = Jr @ scene.transmission if ramps else None
    q, v, K = trajectory.q, trajectory.v, Jk if integrator.variational else np.zeros((steps, 2 * n, 0))
    if ramp is not None and scene.inputs:
        # Only the end of a step counts.
        ramp[:, :, scene.prescribed] = (Jf @ scene.transmission)[:, :, scene.prescribed]
    if scene.processes == 0:
        # One product instead of many small ones.
        B = Jf if scene.direct else (Jf.reshape(-1, Jf.shape[2]) @ scene.transmission).reshape(steps, 2 * n, m)
        F, G, Gx, Gu = (np.zeros((steps, *shape)) for shape in ((n, 0), (2 * n, 0), (2 * n, 0, 2 * n), (2 * n, 0, m)))
        Gramp = None if ramp is None else Gu
        return Linearization(Jx, B, K, Jk, F, G, Gx, Gu, trajectory.dt, integrator.variational, ramp, Gramp)
    start = noise_fields(scene, trajectory, q[:-1], v[:-1], first)
    A, B = Jx, Jf @ scene.transmission
    if start.Fv is not None:
        drift_x, drift_u, drift_r = _drift_derivatives(scene, trajectory, first, variational=integrator.variational)
        A, B = A + integrator.drift_share * Jf @ drift_x, B + integrator.drift_share * Jf @ drift_u
        if ramp is not None:
            ramp = ramp + integrator.drift_share * Jf @ drift_r
    left = integrator.left
    if integrator.variational:
        to_state = None
        jump, jump_x = start.F, _in_momentum(scene, q[:-1], v[:-1], start)
    else:
        M, _ = scene.core.jets(q[:-1], v[:-1])
        to_state = np.asarray(np.linalg.inv(M), dtype=np.float64)
        jump, jump_x = _in_velocity(scene, q[:-1], start, to_state)
    G = left * (Jk @ jump)
    Gx = left * _chain(Jk, jump_x)
    through = left * (Jk if to_state is None else Jk @ to_state)
    Gu = _chain(through, start.Fu)
    # Where the noise does not see the slope of the control, it is that of the step's mean control, as the drift.
    Gramp = None if ramp is None else 0.5 * Gu if start.Fr is None else _chain(through, start.Fr)
    if left < 1.0:
        # The part of a kick after the step is evaluated at the step's end.
        end_q, end_v = trajectory.q[1:], trajectory.v[1:]
        if trajectory.noisy:
            end_q, end_v = integrator.quiet_ends(scene, trajectory)
        end = noise_fields(scene, trajectory, end_q, end_v, first)
        end_x = _in_momentum(scene, end_q, end_v, end)
        G[:, n:] += (1.0 - left) * end.F
        Gx[:, n:] += (1.0 - left) * np.einsum("Naib,Nbc->Naic", end_x, A)
        Gu[:, n:] += (1.0 - left) * (end.Fu + np.einsum("Naib,Nbc->Naic", end_x, B))
        if ramp is not None and Gramp is not None:
            end_ramp = 0.5 * end.Fu if end.Fr is None else end.Fr
            Gramp[:, n:] += (1.0 - left) * (end_ramp + np.einsum("Naib,Nbc->Naic", end_x, ramp))
    if Gramp is not None and scene.inputs:
        # As of the step itself, only the end counts.
        Gramp[..., scene.prescribed] = Gu[..., scene.prescribed]
    F = np.broadcast_to(start.F[:, :, : scene.processes], (steps, n, scene.processes))
    return Linearization(A, B, K, Jk, F, G, Gx, Gu, trajectory.dt, integrator.variational, ramp, Gramp)


@dataclass(frozen=True, eq=False)
class Curvature:
    """Second derivatives of N deterministic steps, each contracted with a vector: sum_a z_a d2 x1_a.

    Attributes:
        xx: Second derivatives in the state (N, 2n, 2n).
        ux: Mixed derivatives in controls and state (N, m, 2n).
        uu: Second derivatives in the controls (N, m, m).
    """

    xx: Floats
    ux: Floats
    uu: Floats

    def __repr__(self) -> str:
        steps, m, states = self.ux.shape
        return f"Curvature({steps} steps, {states // 2} joints, {m} controls)"


def second_order(
    scene: Scene, trajectory: Trajectory, z: ArrayLike, *, integrator: Integrator | None = None
) -> Curvature:
    """Second-order linearization of every step of a trajectory at dw = 0, contracted with vectors.

    The result needs no tensor: third derivatives of the Lagrangian enter through a derivative of the jet along one
    direction. It is exact; under constraints it comes from differences of the first derivatives, good to about 1e-8.
    Full differential dynamic programming needs it with z the gradient of the value function.

    Main args:
        scene: The scene of the trajectory.
        trajectory: From :func:`varpin.simulate`.
        z: One vector for each step (N, 2n), or one for all of them (2n,).

    Other Args:
        integrator: As for :func:`linearize`. Only variational integrators have second derivatives.

    Raises:
        InputError: As for :func:`linearize`; or the integrator has no second derivatives, or noise fields depend on the
            velocity.
        LinearizationError: A step has no solution at dw = 0.
    """
    integrator = matching_integrator(require_scene(scene), trajectory, integrator)
    n, steps = scene.robot.dof, trajectory.steps
    rows = as_floats("z", z)
    if rows.shape == (2 * n,):
        rows = np.tile(rows, (steps, 1))
    return second_order_steps(scene, trajectory, finite_array("z", rows, (steps, 2 * n)), integrator)


def second_order_steps(scene: Scene, trajectory: Trajectory, z: Floats, integrator: Integrator) -> Curvature:
    """:func:`second_order` without checks of the trajectory."""
    if scene.noise.velocity_dependent:
        raise InputError("there are no second derivatives for noise fields that depend on the velocity")
    n = scene.robot.dof
    H = integrator.contract(scene, trajectory, z)
    B = scene.transmission
    x, f = slice(0, 2 * n), slice(2 * n, 2 * n + len(B))
    return Curvature(xx=H[:, x, x], ux=B.T @ H[:, f, x], uu=B.T @ H[:, f, f] @ B)


def velocity_at_nodes(scene: Scene, q: Floats, v: Floats) -> Floats:
    """Derivative of v in (q, p) at many nodes (N, n, 2n): at fixed q dv = M^-1 dp, at fixed p dv = -M^-1 L_vq dq."""
    return scene.core.velocity_slopes(q, v)


def velocity_curvature(scene: Scene, q: Floats, v: Floats, c: Floats) -> Floats:
    """Second derivatives of c . v in (q, p) at many nodes (N, 2n, 2n), for c (N, n).

    With y = M^-1 c they are those of -y . L_v(q, v) in (q, v), transformed to (q, p).
    """
    N, n = q.shape
    first = velocity_at_nodes(scene, q, v)
    y = np.einsum("Nij,Nj->Ni", first[:, :, n:], c)
    _, dA, dLqq = scene.core.jets_along(q, v, np.zeros_like(y), -y)
    D = np.concatenate([np.broadcast_to(np.eye(n, 2 * n), (N, n, 2 * n)), first], axis=1)
    inner = np.block([[dLqq, np.swapaxes(dA, 1, 2)], [dA, np.zeros_like(dA)]])
    second: Floats = np.swapaxes(D, 1, 2) @ inner @ D
    return second


def _chain(J: Floats, derivative: Floats) -> Floats:
    """J (N, a, b) times a derivative (N, b, k, c): (N, a, k, c)."""
    N, b, k, c = derivative.shape
    return (J @ derivative.reshape(N, b, k * c)).reshape(N, J.shape[1], k, c)


def _in_momentum(scene: Scene, q: Floats, v: Floats, fields: Fields) -> Floats:
    """dF/d(q, p) (N, n, k, 2n): at fixed q dv = M^-1 dp, at fixed p dv = -M^-1 L_vq dq."""
    N, n, k = fields.F.shape
    Fx = np.zeros((N, n, k, 2 * n))
    Fx[..., :n] = fields.Fq
    if fields.Fv is not None:
        M, A = scene.core.jets(q, v)
        Fx[..., n:] = np.swapaxes(np.linalg.solve(M[:, None], np.swapaxes(fields.Fv, 2, 3)), 2, 3)
        Fx[..., :n] -= np.einsum("Naip,Npb->Naib", Fx[..., n:], A)
    return Fx


def _in_velocity(scene: Scene, q: Floats, fields: Fields, inverse: Floats) -> tuple[Floats, Floats]:
    """Y = M^-1 F (N, n, k) and its derivative in (q, v) (N, n, k, 2n), for the ``inverse`` of M (N, n, n).

    d(M y)/dq at fixed y is L_vq(q, y), so dy = M^-1 (dF - L_vq(q, y) dq).
    """
    N, n, k = fields.F.shape
    y = inverse @ fields.F
    _, bend = scene.core.jets(np.repeat(q, k, axis=0), np.swapaxes(y, 1, 2).reshape(N * k, n))
    Fx = np.zeros((N, n, k, 2 * n))
    Fx[..., :n] = fields.Fq - np.swapaxes(bend.reshape(N, k, n, n), 1, 2)
    if fields.Fv is not None:
        Fx[..., n:] = fields.Fv
    return y, _chain(inverse, Fx)


def _drift_derivatives(
    scene: Scene, trajectory: Trajectory, start: Floats, *, variational: bool
) -> tuple[Floats, Floats, Floats]:
    """Derivatives of the drift in the state (N, n, 2n), in u (N, n, m) and in a ramp of u, by differences.

    The drift alone needs second derivatives of diffusion fields, which noise classes do not provide.
    """
    n, m, linear = scene.robot.dof, scene.controls, trajectory.u_nodes.shape[1] > 0
    found = np.zeros((trajectory.steps, n, 2 * (n + m)))
    for j in range(trajectory.steps):
        # In v even if the state is (q, p): a difference in p that suits the base moves a light wrist by rad/s, and at
        # rest the momentum gives no scale.
        u = trajectory.u[j]
        parts = trajectory.q[j], trajectory.v[j], *(trajectory.u_nodes[j : j + 2] if linear else (u, u))

        def drift(x: Floats) -> Floats:
            q, v, begin, end = np.split(x[None], [n, 2 * n, 2 * n + m], axis=1)
            ends = (begin, end) if linear else None
            found = ito_drift(scene.core, q, v, over_steps(scene.noise, q, v, 0.5 * (begin + end), ends, start))
            return found.ravel()

        sizes = [np.full(part.size, 2e-3 * max(1.0, np.abs(part).max(initial=0.0))) for part in parts]
        found[j] = slopes(drift, np.concatenate(parts), np.concatenate(sizes))
    in_state, by_begin, by_end = np.split(found, [2 * n, 2 * n + m], axis=2)
    if variational:
        in_velocity = in_state[:, :, n:].copy()
        in_state[:, :, n:] = 0.0
        in_state += in_velocity @ velocity_at_nodes(scene, trajectory.q[:-1], trajectory.v[:-1])
    return in_state, by_begin + by_end, by_end


def matching_integrator(scene: Scene, trajectory: Trajectory, given: Integrator | None) -> Integrator:
    """The integrator of the trajectory, after a check that the trajectory fits the scene."""
    require_motion(scene, trajectory)
    integrator = _integrator_of(scene, trajectory, given)
    require_scene_of(scene, trajectory)
    if scene.custom is not None or "constraints.custom" in scene.values or not trajectory.scene_values:
        _require_first_step(scene, trajectory, integrator)
    return integrator


def _require_first_step(scene: Scene, trajectory: Trajectory, integrator: Integrator) -> None:
    """Refuse a motion whose first step, if it is undivided, is another one in a scene with functions of one's own."""
    if not trajectory.steps or trajectory.statistics.substeps[0] > 1:
        return
    first = trajectory.part(0, 1)
    commands = open_loop(first.u)._replace(within=first.u_stages if first.u_stages.shape[1] else first.u_stages[:0])
    if first.u_nodes.shape[1]:
        commands = open_line(first.u_nodes, integrator.stage_times)
    state, _ = integrator.start(scene, first.q[:1].copy(), first.v[:1].copy())
    drawn = first.dw[None] if trajectory.noisy else first.dw[None, :0][:0]
    (again,) = integrator.rollout(scene, state, commands, drawn, first.dt)
    off, change = np.abs(again.v[0] - first.v[1]).max(), np.abs(np.diff(first.v, axis=0)).max()
    if again.failure is not None or not off <= _SAME * change + _OF_SPEED * np.abs(first.v).max():
        raise InputError("the trajectory was made in another scene than the one given: its first step differs")


def _integrator_of(scene: Scene, trajectory: Trajectory, given: Integrator | None) -> Integrator:
    """The integrator of the trajectory."""
    linear = trajectory.u_nodes.shape[1] > 0
    if trajectory.dw.shape[1] not in (scene.processes, scene.increments(linear=linear)):
        raise InputError(f"the trajectory has {trajectory.dw.shape[1]} processes, the scene {scene.processes}")
    chosen = given_integrator(given)
    if chosen is not None and str(chosen) == trajectory.integrator:
        return chosen
    try:
        made = integrator_of(trajectory.integrator)
    except InputError as problem:
        raise InputError(
            f"the trajectory was made with {trajectory.integrator}, which cannot be made again ({problem}): "
            "give integrator="
        ) from None
    if given is not None and not given.same_map(made):
        raise InputError(
            f"the trajectory was made with {trajectory.integrator}, not {given}: leave integrator out, or give that one"
        )
    return given or made


@dataclass(frozen=True, eq=False)
class Moments:
    """Mean and covariance of the deviation from a trajectory, at its nodes.

    Attributes:
        mean: Mean (N + 1, 2n).
        covariance: Covariance (N + 1, 2n, 2n).
        warnings: Where they are wrong, from the linearization.
    """

    mean: Floats
    covariance: Floats
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        nodes, states = self.mean.shape
        return f"Moments({nodes} nodes, {states // 2} joints)"


def propagate_moments(
    linearization: Linearization, mean: ArrayLike | None = None, covariance: ArrayLike | None = None
) -> Moments:
    """Mean and covariance of dx under the linearization (L3) with du = 0, in closed form.

        mean' = A mean,    P' = A P A' + dt sum_i [ Gx_i P Gx_i' + g_i g_i' ],    g_i = Gx_i mean + G_i

    Args:
        linearization: From :func:`linearize`.
        mean: Mean of dx at the first node (2n,); zero if left out.
        covariance: Covariance of dx at the first node (2n, 2n), symmetric and positive semidefinite; zero if left out.

    Raises:
        InputError: A shape is wrong, a value is not finite, or ``covariance`` is not symmetric and semidefinite.
    """
    if not isinstance(linearization, Linearization):
        raise InputError(f"linearization must be one of varpin.linearize, got {type(linearization).__name__}")
    size = linearization.A.shape[1]
    means, covariances = np.zeros((linearization.steps + 1, size)), np.zeros((linearization.steps + 1, size, size))
    if mean is not None:
        means[0] = finite_array("mean", mean, (size,))
    if covariance is not None:
        covariances[0] = require_covariance(finite_array("covariance", covariance, (size, size)))
    for j in range(linearization.steps):
        A, Gx, m, P = linearization.A[j], linearization.Gx[j], means[j], covariances[j]
        g = linearization.G[j] + np.einsum("aib,b->ai", Gx, m)
        means[j + 1] = A @ m
        covariances[j + 1] = A @ P @ A.T + linearization.dt * (np.einsum("aib,bc,dic->ad", Gx, P, Gx) + g @ g.T)
    for sentence in linearization.warnings:
        logger.warning(sentence)
    return Moments(means, covariances, linearization.warnings)


def require_covariance(P: Floats) -> Floats:
    """``P``, refused if it is asymmetric or indefinite beyond rounding in units of its deviations."""
    deviation = np.sqrt(np.maximum(np.diag(P), 0.0))
    scale = np.where(deviation > 0.0, deviation, 1.0)
    scaled = P / np.outer(scale, scale)
    least = float(np.linalg.eigvalsh(0.5 * (scaled + scaled.T))[0])
    if np.diag(P).min(initial=0.0) < 0.0 or least < -1e-9:
        raise InputError(f"covariance must be positive semidefinite; scaled, its least eigenvalue is {least:.3g}")
    if not np.abs(scaled - scaled.T).max() <= 1e-9:
        raise InputError("covariance must be symmetric")
    return P
