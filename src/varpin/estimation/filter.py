"""Extended Kalman filter and Rauch-Tung-Striebel smoother of a log, on the exact derivatives of steps.

Equations (K1) and (K2) of docs/mathematics.md.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag
from scipy.special import chdtrc

from varpin.arrays import Floats
from varpin.core.arrays import FilterArrays, FilterLog
from varpin.errors import InputError
from varpin.estimation.grid import Grid
from varpin.estimation.log import Log, as_log
from varpin.finding import Finding, announce
from varpin.integrators import Integrator
from varpin.linearization import require_covariance, velocity_at_nodes
from varpin.mechanics.scene import Scene, refuse_constraints, require_scene
from varpin.simulation.choice import given_integrator, usual_integrator
from varpin.support.checks import JointValues, finite_array, joint_array, positive
from varpin.support.frozen import Frozen
from varpin.support.markup import warning_count, warning_lines
from varpin.trajectory import Trajectory

# Standard deviations of a start that is not given, in units of those of the first two samples: it then counts for 1e-4
# of a sample. Much wider ones lose digits, 1e-16 times their square.
_WIDE = 100.0
# Mean square of the innovations, in what it is if all is right, that is told, unless it is less rare than this among
# samples of a right scene.
_MISFIT, _RARE = 2.0, 1e-9

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Estimate(Frozen):
    """The states of an arm at the samples of a log, from :func:`kalman_filter` or :func:`smooth`.

    Attributes:
        t: Times of the samples (K,) [s].
        q: Positions (K, n) [rad or m].
        v: Velocities (K, n) [rad/s or m/s].
        covariance: Covariance of the errors of (q, v), (K, 2n, 2n).
        external: External forces on the joints (K, n) [N m or N]; None where they were not asked for.
        external_covariance: Covariance of their errors (K, n, n), or None.
        innovations: Samples minus their predictions from the samples before (K, n) [rad or m], with those of measured
            velocities (K, 2n) [rad/s or m/s]; NaN where a sample is missing.
        forward: Moments of the filter's state before and after each sample, and derivatives of predictions: of (q, p)
            or (q, v), then of the external forces.
        given: What the filter was given, in the form of the core.
        joint_names: The joints of the columns.
        integrator: Whose steps these are, as text.
        variational: Whether the filter's state is (q, p) rather than (q, v).
        smoothed: Whether all samples tell of a state, and not those up to it alone.
        warnings: What is doubtful: innovations that are larger than expected, and the log.
    """

    t: Floats
    q: Floats
    v: Floats
    covariance: Floats
    forward: FilterArrays
    given: FilterLog
    joint_names: tuple[str, ...]
    integrator: str
    variational: bool
    external: Floats | None = None
    external_covariance: Floats | None = None
    smoothed: bool = False
    warnings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        what, n = "smoothed" if self.smoothed else "filtered", self.q.shape[1]
        return f"Estimate({len(self.t)} samples, {n} joints, {what} by {self.integrator}{warning_count(self.warnings)})"

    def __str__(self) -> str:
        return "\n".join([repr(self), *warning_lines(self.warnings)])

    @property
    def innovations(self) -> Floats:
        """See the class."""
        return self.forward.innovations

    @cached_property
    def S(self) -> Floats:
        """Covariances of the innovations (K, z, z)."""
        H, P = self.forward.rows, self.forward.predicted_covariance[:, : 2 * self.q.shape[1], : 2 * self.q.shape[1]]
        found: Floats = H @ P @ np.swapaxes(H, 1, 2) + np.diag(self.given.variance)
        return found

    @cached_property
    def gains(self) -> Floats:
        """Gains of the filter (K, d, z): what a unit of an innovation moves the state; 0 for missing samples."""
        # P C' R^-1, with P after the sample, is (K2)'s gain.
        CP = self.forward.rows @ self.forward.covariance[:, : 2 * self.q.shape[1]]
        gains = np.swapaxes(CP, 1, 2) / self.given.variance
        return np.where(np.isfinite(self.innovations)[:, None], gains, 0.0)

    @cached_property
    def _root(self) -> Floats:
        """Cholesky factors of S (K, z, z), with rows of the unit matrix for missing samples."""
        there = np.isfinite(self.innovations)
        S = np.where(there[:, :, None] & there[:, None], self.S, np.eye(there.shape[1]))
        return np.asarray(np.linalg.cholesky(S))

    def independent(self, rows: Floats) -> Floats:
        """Rows (K, z, k) as S makes innovations independent numbers of variance 1; 0 for missing samples."""
        there = np.isfinite(self.innovations)[:, :, None]
        return np.asarray(np.linalg.solve(self._root, np.where(there, rows, 0.0)))

    @cached_property
    def log_likelihood(self) -> float:
        """Logarithm of the density of all samples, given the start and the scene."""
        samples = np.isfinite(self.innovations).sum()
        logs = np.log(np.diagonal(self._root, axis1=1, axis2=2)).sum()
        return float(-0.5 * (self.nis().sum() + samples * np.log(2.0 * np.pi)) - logs)

    def nis(self) -> Floats:
        """Normalized squares of the innovations (K,): of as many degrees of freedom as a sample has numbers.

        Means far above that number tell of noise that is larger than given, or of a scene that is wrong.
        """
        return np.asarray((self.independent(self.innovations[:, :, None]) ** 2).sum(axis=(1, 2)))

    def nees(self, q: ArrayLike, v: ArrayLike) -> Floats:
        """Normalized squares of the errors of (q, v) against a known motion (K,): of 2n degrees of freedom.

        Args:
            q: Its positions at the samples (K, n) [rad or m].
            v: Its velocities (K, n) [rad/s or m/s].

        Raises:
            InputError: A shape is wrong, or a value is not finite.
        """
        off = [finite_array(name, x, own.shape) - own for name, x, own in (("q", q, self.q), ("v", v, self.v))]
        e = np.concatenate(off, axis=1)[:, :, None]
        return np.asarray((e * np.linalg.solve(self.covariance, e)).sum(axis=(1, 2)))


def kalman_filter(
    scene: Scene,
    log: Log | Trajectory,
    *,
    q_noise: JointValues,
    v_noise: JointValues | None = None,
    external: tuple[JointValues, float] | None = None,
    dt: float | None = None,
    q0: JointValues | None = None,
    v0: JointValues | None = None,
    covariance: ArrayLike | None = None,
    integrator: Integrator | None = None,
) -> Estimate:
    """Estimate positions, velocities and external forces at each sample of a log from the samples up to it.

    It is an extended Kalman filter on the exact derivatives of the integrator's steps, (K2) of docs/mathematics.md.

    Main args:
        scene: The scene. Its noise is what moves the arm besides, as forces: white, of any model but those that depend
            on the velocity. Scenes with constraints are refused.
        log: The log, or a simulated motion. Missing samples are left out, joint by joint.
        q_noise: Standard deviation of an encoder's error: one number, (n,) or by joint name [rad or m].
        v_noise: The same of measured velocities [rad/s or m/s]; without it they are not used.
        external: Estimate external forces on all joints, too, such as those of a collision: their standard deviation,
            one number, (n,) or by joint name [N m or N], and the time [s] after which they are forgotten. It is a
            momentum observer for encoders alone.

    Other Args:
        dt: Longest step [s] of the equal ones in an interval; if left out, they have one each, and more in gaps.
        q0: Mean of the position at the first sample [rad or m]; if left out, that sample.
        v0: Mean of the velocity there [rad/s or m/s]; if left out, the difference of the first two samples.
        covariance: Covariance of (q0, v0) (2n, 2n); if left out, a hundred times the standard deviations of the first
            two samples, which is as good as unknown.
        integrator: If left out, as for a motion without noise: the usual choice of :func:`varpin.simulate`.

    Raises:
        InputError: The scene has no noise, noise that depends on the velocity, or constraints; the log does not fit it;
            or a value is out of its range.
        UnknownJoint: A name is no joint of the robot.
        LinearizationError: A step from an estimate has no solution.
    """
    log = as_log(log).matched(require_scene(scene))
    start = q0, v0, covariance
    found = filtered(scene, Grid.between(log, dt), q_noise, v_noise, external=external, start=start, method=integrator)
    there, total = np.isfinite(found.innovations), float(found.nis().sum())
    numbers, samples = int(there.sum()), int(there.any(axis=1).sum())
    told = tuple(
        doubt.about(f"the mean of nis() is {total / samples:.3g}, and {numbers / samples:.3g} if all is right: ")
        for doubt in misfit(total, numbers)
    )
    announce(logger, scene.announced, float(np.median(np.diff(log.t))), told)
    return found.changed(warnings=(*told, *log.warnings))


def misfit(total: float, numbers: int) -> Iterator[Finding]:
    """The warning of innovations whose squares, in units of their variances, have a ``total`` that is too large."""
    if not total <= _MISFIT * numbers and not chdtrc(numbers, total) > _RARE:
        over = float(np.sqrt(total / numbers))
        text = f"the innovations are {over:.3g} times what the scene's noise and q_noise explain: something else acts"
        yield Finding("misfit", text, value=over)


def filtered(
    scene: Scene,
    grid: Grid,
    q_noise: JointValues,
    v_noise: JointValues | None,
    *,
    external: tuple[JointValues, float] | None = None,
    start: tuple[JointValues | None, JointValues | None, ArrayLike | None] = (None, None, None),
    method: Integrator | None,
) -> Estimate:
    """:func:`kalman_filter` of a log in the scene's order with samples at nodes of a grid, without its doubts."""
    refuse_constraints(scene, "a Kalman filter")
    if scene.noise.velocity_dependent:
        raise InputError("a Kalman filter does not take noise whose fields depend on the velocity")
    if not scene.processes and external is None:
        raise InputError(
            "the scene has no noise, so that a filter would trust it more than any sample: varpin.Scene(robot, "
            "noise=varpin.AdditiveNoise(intensity)) says how strong the forces are that it does not know"
        )
    log, joints, n = grid.log, scene.robot.joint_names, scene.robot.dof
    measured, variance = measurements(log, joints, q_noise, v_noise)
    q, first, rate, P = _first_samples(log, variance[:n])
    q0, v0, covariance = start
    first = first if q0 is None else joint_array("q0", q0, joints)
    rate = rate if v0 is None else joint_array("v0", v0, joints)
    if covariance is not None:
        P = require_covariance(finite_array("covariance", covariance, (2 * n, 2 * n)))
    parts = np.diff(grid.at).astype(np.int64)
    h = np.diff(log.t) / parts
    method = given_integrator(method) or usual_integrator(scene, first, rate, float(h.max()), noisy=False)
    mean, P = _of_state(scene, first, rate, P, variational=method.variational)
    strength, kept = np.zeros(n), np.zeros(len(h))
    if external is not None:
        strength, kept = _external(external, joints, h)
        mean, P = np.concatenate([mean, np.zeros(n)]), block_diag(P, np.diag(strength))
    F = scene.noise.fields(q[:-1], np.zeros_like(q[:-1]), log.u[:-1], q[0]).F
    force, spread = log.u[:-1] @ scene.actuation.T, F @ np.swapaxes(F, 1, 2)
    added = (1.0 - kept[:, None] ** 2) * strength
    seen = FilterLog(mean, P, measured, variance, parts, h, force, spread, kept, added)
    found = method.filtered(scene, seen)
    states = _in_velocities(scene, found.state, found.covariance, variational=method.variational)
    own: dict[str, Any] = {"joint_names": joints, "integrator": str(method), "variational": method.variational}
    return Estimate(log.t, forward=found, given=seen, **own, **states)


def smooth(scene: Scene, log: Log | Trajectory, *, q_noise: JointValues, **options: Any) -> Estimate:
    """Estimate positions, velocities and external forces at each sample of a log from all of them.

    It is the smoother of Rauch, Tung and Striebel after :func:`kalman_filter`, whose arguments and errors it has: (K2)
    of docs/mathematics.md.
    """
    found = kalman_filter(scene, log, q_noise=q_noise, **options)
    states = _in_velocities(scene, *_backward(found.forward), variational=found.variational)
    return found.changed(**states, smoothed=True)


def measurements(
    log: Log, joints: tuple[str, ...], q_noise: JointValues, v_noise: JointValues | None
) -> tuple[Floats, Floats]:
    """Measured positions, with ``v_noise`` velocities beside them (K, z), and the variances of their errors (z,)."""
    variance = variances("q_noise", q_noise, joints)
    if v_noise is None:
        return log.q, variance
    if log.v is None:
        raise InputError("v_noise is given, and a log has no velocities v")
    return np.concatenate([log.q, log.v], axis=1), np.concatenate([variance, variances("v_noise", v_noise, joints)])


def variances(name: str, value: JointValues, joints: tuple[str, ...]) -> Floats:
    """Squares (n,) of standard deviations: one number, (n,) or by joint name, > 0."""
    deviation = joint_array(name, value, joints, uniform=True)
    with np.errstate(over="ignore", under="ignore"):
        variance: Floats = deviation**2
    if not ((deviation > 0.0) & (variance > 0.0) & (variance < np.inf)).all():
        raise InputError(f"{name} must be positive for every joint, as must its square, got {deviation.tolist()}")
    return variance


def _external(given: tuple[JointValues, float], joints: tuple[str, ...], h: Floats) -> tuple[Floats, Floats]:
    """Variances (n,) of external forces, and the share (K - 1,) that steps of length h keep of them."""
    if not isinstance(given, tuple | list) or len(given) != 2:
        raise InputError(f"external must be (standard deviation [N m or N], time [s]), got {given!r}")
    strength = variances("external: standard deviation", given[0], joints)
    return strength, np.exp(-h / positive("external: time", given[1], "s"))


def _first_samples(log: Log, variance: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Positions without gaps (K, n), and position, velocity and a wide covariance of (q, v) at the first sample."""
    q, n = np.empty_like(log.q), log.q.shape[1]
    first, rate, deviation = np.empty(n), np.empty(n), np.sqrt(np.tile(variance, 2))
    for c, column in enumerate(log.q.T):
        there = np.flatnonzero(np.isfinite(column))
        begin, end = there[:2]
        span, late = log.t[end] - log.t[begin], log.t[begin] - log.t[0]
        q[:, c] = np.interp(log.t, log.t[there], column[there])
        rate[c] = (column[end] - column[begin]) / span
        first[c] = column[begin] - late * rate[c]
        deviation[[c, n + c]] *= np.sqrt(2.0) * np.array([1.0 + late / span, 1.0 / span])
    return q, first, rate, np.diag((_WIDE * deviation) ** 2)


def _of_state(scene: Scene, q: Floats, v: Floats, P: Floats, *, variational: bool) -> tuple[Floats, Floats]:
    """Mean and covariance of the filter's state from those of (q, v): dp = L_vq dq + M dv."""
    if not variational:
        return np.concatenate([q, v]), P
    M, A = (jet[0] for jet in scene.core.jets(q[None], v[None]))
    to = np.block([[np.eye(q.size), np.zeros_like(M)], [A, M]])
    return np.concatenate([q, M @ v]), to @ P @ to.T


def _in_velocities(scene: Scene, x: Floats, P: Floats, *, variational: bool) -> dict[str, Any]:
    """The states of an estimate from moments (K, d), (K, d, d) of the filter's state."""
    n = scene.robot.dof
    q, v, more = (part.copy() for part in np.split(x, [n, 2 * n], axis=1))
    covariance, of_more = P[:, : 2 * n, : 2 * n].copy(), P[:, 2 * n :, 2 * n :]
    if variational:
        v = np.asarray(np.linalg.solve(scene.core.jets(q, v)[0], v[:, :, None])[:, :, 0])
        to = np.tile(np.eye(2 * n), (len(q), 1, 1))
        to[:, n:] = velocity_at_nodes(scene, q, v)
        covariance = to @ covariance @ np.swapaxes(to, 1, 2)
    known = {"q": q, "v": v, "covariance": covariance}
    return known | ({"external": more, "external_covariance": of_more} if more.size else {})


def _backward(found: FilterArrays) -> tuple[Floats, Floats]:
    """Smoothed moments (K, d), (K, d, d) of the filter's state."""
    x, P = found.state.copy(), found.covariance.copy()
    before = found.predicted_covariance[1:]
    back = np.swapaxes(np.linalg.solve(before, found.transition @ P[:-1]), 1, 2)
    for k in range(len(x) - 2, -1, -1):
        x[k] += back[k] @ (x[k + 1] - found.predicted[k + 1])
        P[k] += back[k] @ (P[k + 1] - before[k]) @ back[k].T
    return x, 0.5 * (P + np.swapaxes(P, 1, 2))
