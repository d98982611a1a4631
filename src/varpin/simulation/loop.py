"""Stability of a digital control loop at its period, from a finished motion: the law is not called.

By theory, where the record determines the law u = Kq q + Kv v + S L_q(q, 0) + c: the loop is linearized at the
equilibrium next to the motion, under constraints on the tangent space. With the plant's exact step under a zero-order
hold, x' = A x + B u, it is unstable if the spectral radius of A + B K exceeds one (Franklin, Powell and Workman 1998,
section 4.3). Growth that the law would have in continuous time too, as in a falling pendulum, gives no warning.

By the record, for other laws: a control turns back every few periods, or grows while it does work.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from varpin.arrays import Floats
from varpin.errors import AssemblyError, LinearizationError, SingularMassMatrix
from varpin.finding import Finding
from varpin.integrators.explicit import accelerations
from varpin.mechanics.assembly import nearest
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.simulation.law import NOTHING, Law, decisions, law_of
from varpin.trajectory import Trajectory

# Rank tolerance of the constraints in the metric of the kinetic energy, relative to the largest singular value.
_RANK = 1e-9
# Least growth a period: rounding of fitted gains may split double eigenvalues by 3e-6. 0 to 1e-5: the same.
_GROWTH = 1e-5
# The period causes growth if its exponent exceeds that in continuous time by this factor: 1.1 to 3 give the same.
_BY_PERIOD = 1.5
# Ratio of the periods that are tried for a stable one.
_SHORTER = 0.9
# Least turns of a control within a window of so many periods, each by this share of its range at least: loops that are
# unstable and clip turn 9 to 20 times, stable ones with moving goals up to 6.
_TURNS, _WINDOW, _SWING = 9, 20, 0.1
# Least share of the turns that a linear function of the state tells for them to be feedback: of sensor noise 0.09.
_FOLLOWS = 0.15
# Least growth of controls from the first quarter of a motion to the last: 10 to 100 give the same.
_GREW = 30.0


@dataclass(frozen=True)
class Loop:
    """A plant with a law, linearized at rest; y are the f coordinates of the tangent space.

    Attributes:
        A: Rate of (y, y') by (y, y') (2f, 2f) [1/s].
        B: By u (2f, m).
        K: The law (m, 2f).
        known: Orthonormal directions of (y, y') in which the law is known (2f, r).
    """

    A: Floats
    B: Floats
    K: Floats
    known: Floats

    def mode(self, period: float) -> tuple[float, Floats]:
        """Spectral radius over a period [s] with zero-order hold, and sizes of the controls in that mode (m,)."""
        size, m = self.B.shape
        held = scipy.linalg.expm(period * np.block([[self.A, self.B], [np.zeros((m, size + m))]]))
        step = held[:size, :size] + held[:size, size:] @ self.K
        factors, modes = np.linalg.eig(self.known.T @ step @ self.known)
        largest = int(np.argmax(np.abs(factors)))
        return float(np.abs(factors[largest])), np.abs(self.K @ self.known @ modes[:, largest])


def unstable_loop(scene: Scene, trajectory: Trajectory, hold: int = 1) -> tuple[Finding, ...]:
    """The warning of a loop that is unstable at its period of ``hold`` steps; empty if stable, or nothing is known."""
    period, (at, x, u) = hold * trajectory.dt, decisions(trajectory, hold)
    if len(at) < 3 or not np.ptp(u, axis=0).any():
        return ()
    law = law_of(scene, trajectory, hold)
    found: tuple[Finding, ...] = ()
    with np.errstate(all="ignore"):
        try:
            found = () if law is None else _by_theory(scene, law, period)
        except (np.linalg.LinAlgError, LinearizationError):
            law = None
        if law is None and not trajectory.dw.any():
            found = _by_turns(scene, x, u, trajectory.t[at], period)
        return found or _by_growth(scene, trajectory, u, period)


def _finding(scene: Scene, control: int, text: str, value: float, time: float | None = None) -> tuple[Finding, ...]:
    joint = None if scene.control_joints is None else scene.control_joints[control]
    return (Finding("unstable loop", text, joint=joint, time=time, value=value),)


def _by_theory(scene: Scene, law: Law, period: float) -> tuple[Finding, ...]:
    """The warning if the spectral radius of the loop exceeds one because of the period [s]."""
    loop = loop_at_rest(scene, law)
    if not loop.known.size:
        return ()
    radius, sizes = loop.mode(period)
    rate = float(np.linalg.eigvals(loop.known.T @ (loop.A + loop.B @ loop.K) @ loop.known).real.max())
    if not radius > 1.0 + _GROWTH or np.log(radius) <= _BY_PERIOD * max(rate, 0.0) * period:
        return ()
    stable = next((float(T) for T in period * _SHORTER ** np.arange(1, 60) if loop.mode(T)[0] < 1.0), None)
    advice = "lower gains" if stable is None else f"a period below {stable:.3g} s, or lower gains"
    text = (
        f"control loop is unstable at its period of {period:.4g} s: each period multiplies deviations by {radius:.4g}. "
        f"Use {advice}"
    )
    return _finding(scene, int(np.argmax(sizes)), text, radius)


def _by_turns(scene: Scene, x: Floats, u: Floats, t: Floats, period: float) -> tuple[Finding, ...]:
    """The warning if a control of u (P, m) turns back every few periods, by much, as the state x (P, 2n) does."""
    changes = np.diff(u, axis=0)
    far = np.abs(changes) >= _SWING * np.ptp(u, axis=0)
    turns = (changes[1:] * changes[:-1] < 0.0) & far[1:] & far[:-1]
    worst = int(np.argmax([np.convolve(each, np.ones(_WINDOW)).max() for each in turns.T]))
    at = np.flatnonzero(turns[:, worst])
    if not np.convolve(turns[:, worst], np.ones(_WINDOW)).max() >= _TURNS:
        return ()
    # What turns whatever the state is excitation, not feedback.
    side, fit = np.sign(changes[at, worst]), np.column_stack([x[at + 1], np.ones(len(at))])
    left = side - fit @ np.linalg.lstsq(fit, side, rcond=None)[0]
    if not left @ left < (1.0 - _FOLLOWS) * (len(at) - x.shape[1]) * side.var():
        return ()
    text = (
        f"control {worst} turns back {len(at)} times in {len(u)} periods of {period:.4g} s: the law is too fast for "
        "its period. Use a shorter period, or lower gains"
    )
    return _finding(scene, worst, text, float(len(at)), float(t[at[0] + 1]))


def _by_growth(scene: Scene, trajectory: Trajectory, u: Floats, period: float) -> tuple[Finding, ...]:
    """The warning if a control of u (P, m) grows exponentially and by much, and the controls do work in the end."""
    quarters = np.array([part.max(axis=0, initial=0.0) for part in np.array_split(np.abs(u), 4)])
    ratios = quarters[1:] / quarters[:-1]
    grew = np.where((ratios >= 2.0).all(axis=0) & (ratios[2] >= 0.5 * ratios[0]), quarters[3] / quarters[0], 0.0)
    late = trajectory.part(3 * trajectory.steps // 4, trajectory.steps)
    work = (late.u / np.abs(late.u).max()) * (np.diff(late.q, axis=0) @ scene.actuation)
    worst = int(np.argmax(grew))
    if not grew[worst] >= _GREW or not work.sum() > 0.0:
        return ()
    text = (
        f"control loop is unstable at its period of {period:.4g} s: control {worst} grows by a factor of "
        f"{grew[worst]:.3g}. Use a shorter period, or lower gains, or check the signs of the law"
    )
    return _finding(scene, worst, text, float(grew[worst]))


def loop_at_rest(scene: Scene, law: Law) -> Loop:
    """The loop at the equilibrium that Newton's method finds from ``law.near``; if there is none, at ``law.near``."""
    q = law.near
    for _ in range(30):
        try:
            loop, off, way = _linearized(scene, law, nearest(scene, q) if scene.constraints else q)
        except (AssemblyError, SingularMassMatrix):
            break
        if off <= NOTHING:
            return loop
        q = q + way / max(1.0, np.abs(way).max())
    return _linearized(scene, law, law.near)[0]


def _linearized(scene: Scene, law: Law, q: Floats) -> tuple[Loop, float, Floats]:
    """The loop at rest at q (n,), its acceleration as a share of its terms, and Newton's step to zero (n,)."""
    n = len(q)
    jet, (Kq, Kv, S) = lagrangian_jet(scene, q, np.zeros(n)), np.split(law.K, 3, axis=1)
    force = scene.actuation @ (Kq @ q + S @ jet.Lq + law.c)
    a, aq, av, af, Z, onto = _at_rest(scene, q, force)
    pushed = af @ scene.actuation
    A = np.block([[np.zeros_like(aq), np.eye(len(aq))], [aq, av]])
    B = np.concatenate([np.zeros_like(pushed), pushed])
    gains = np.concatenate([(Kq + S @ jet.Lqq) @ Z, Kv @ Z], axis=1)
    way = Z @ np.linalg.lstsq(aq + pushed @ gains[:, : len(a)], -a, rcond=None)[0]
    terms = np.abs(pushed) @ (np.abs(Kq) @ np.abs(q) + np.abs(law.c)) + np.abs(af) @ np.abs(jet.Lq)
    off = float(np.abs(a).max(initial=0.0) / max(terms.max(initial=0.0), 1e-300))
    known, sizes, _ = np.linalg.svd(np.concatenate([onto @ part for part in np.split(law.directions, 2)]), False)
    return Loop(A, B, gains, known[:, sizes > NOTHING * sizes.max(initial=0.0)]), off, way


def _at_rest(scene: Scene, q: Floats, force: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """The motion linearized at rest at q (n,) under a constant force (n,), in f coordinates y of its tangent space.

    Accelerations of y (f,), their derivatives in y (f, f), in its rate (f, f) and in a force (f, n), and dq = Z dy,
    dy' = onto dv, with Z'MZ = 1 and C Z = 0. The constraint forces C' lam are constant to first order in y, but for
    their curvature lam . g_qq.
    """
    still = np.zeros((1, len(q)))
    a, aq, av, af = (part[0] for part in accelerations(scene, q[None], still, force[None]))
    if not scene.constraints:
        return a, aq, av, af, np.eye(len(q)), np.eye(len(q))
    C = scene.core.constraints(np.ascontiguousarray(q[None]))[2][0]
    root = np.linalg.cholesky(af)
    left, sizes, right = np.linalg.svd(C @ root)
    rank = int((sizes > _RANK * sizes.max(initial=0.0)).sum())
    left, sizes, Z = left[:, :rank], sizes[:rank], root @ right[rank:].T
    lam = -left @ ((left.T @ C @ a) / sizes**2)
    a, aq, av, af = (part[0] for part in accelerations(scene, q[None], still, (force + C.T @ lam)[None]))
    onto = Z.T @ np.linalg.inv(af)
    curved = scene.core.constraint_curvature(q, lam, q)[0]
    return onto @ a, onto @ (aq + af @ curved) @ Z, onto @ av @ Z, onto @ af, Z, onto
