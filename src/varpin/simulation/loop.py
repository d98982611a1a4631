"""The law of a digital control loop and its stability, from a finished motion: the law is not called.

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

from varpin.arrays import Floats, Integers
from varpin.errors import AssemblyError, LinearizationError, SingularMassMatrix
from varpin.finding import Finding
from varpin.integrators.explicit import accelerations
from varpin.mechanics.assembly import nearest
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.trajectory import Trajectory

# Least nodes of a fit, spread over the motion, but four a joint at least: 30 to 300 give the same.
_NODES = 100
# Largest error of a fit by that of squares of the state: short smooth curves fit any function. 1e-9 to 1e-6: the same.
_TELLING = 1e-6
# Share of the largest below which a direction of the motion or the force at an equilibrium is zero: 1e-11 to 1e-6.
NOTHING = 1e-8
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
class Law:
    """A control law from a record: u = K (q, v, L_q(q, 0)) + c, with the forces L_q(q, 0) of gravity and springs.

    Attributes:
        K: (m, 3n).
        c: (m,).
        directions: Of (q, v), in which the motion tells the law (2n, r).
        near: A configuration of the motion (n,) [rad or m].
    """

    K: Floats
    c: Floats
    directions: Floats
    near: Floats


def law_of(scene: Scene, trajectory: Trajectory, hold: int) -> Law | None:
    """The law of a motion under feedback every ``hold`` steps, if its record tells it."""
    at, x, u = decisions(trajectory, hold)
    # Commands of kinematic inputs are positions.
    if scene.inputs or len(at) < 3:
        return None
    with np.errstate(all="ignore"):
        try:
            return _law(scene, x, u)
        except (np.linalg.LinAlgError, LinearizationError):
            return None


def decisions(trajectory: Trajectory, hold: int) -> tuple[Integers, Floats, Floats]:
    """The nodes (P,) at which a period begins, the states (q, v) (P, 2n) there, and the controls (P, m)."""
    at = np.arange(0, trajectory.steps, hold)
    return at, np.concatenate([trajectory.q[at], trajectory.v[at]], axis=1), trajectory.u[at]


def _law(scene: Scene, x: Floats, u: Floats) -> Law | None:
    """The law from all nodes or, where it clips, of each control from the nodes at which it is inside its limits."""
    law = fitted_law(scene, x, u)
    at_end = u == np.array([u.min(axis=0), u.max(axis=0)])[:, None]
    clipped = (at_end & (at_end.sum(axis=1) > 1)[:, None]).any(axis=0)
    if law is not None or not clipped.any():
        return law
    laws = [fitted_law(scene, x[~rows], u[~rows, k : k + 1]) for k, rows in enumerate(clipped.T)]
    # Directions that one control does not know cannot be combined with those of another.
    known = [law for law in laws if law is not None and law.directions.shape[1] >= x.shape[1]]
    if len(known) < len(laws):
        return None
    K, c = np.concatenate([law.K for law in known]), np.concatenate([law.c for law in known])
    return Law(K, c, known[0].directions, known[0].near)


def fitted_law(scene: Scene, x: Floats, u: Floats) -> Law | None:
    """The law that gives u (P, m) at states (q, v) = x (P, 2n), if there is one that the record tells."""
    n = x.shape[1] // 2
    if len(x) < 3:
        return None
    # An odd interval: controls may alternate.
    every = 1 + 2 * (len(x) // max(2 * _NODES, 8 * n))
    x, u = x[::every], u[::every]
    pulled = (np.append(state, lagrangian_jet(scene, state[:n], np.zeros(n)).Lq) for state in x)
    fit = _affine(x, u) or _affine(np.array(list(pulled)), u)
    if fit is None:
        return None
    K, c, directions = fit
    K = np.pad(K, ((0, 0), (0, 3 * n - K.shape[1])))
    return Law(K, c, directions[: 2 * n], x[0, :n])


def _affine(x: Floats, u: Floats) -> tuple[Floats, Floats, Floats] | None:
    """K (m, k), c (m,) of u = K x + c, if the record tells that, and directions (k, r) of x; the least of equal K."""
    mean, mean_u = x.mean(axis=0), u.mean(axis=0)
    size = np.std(x, axis=0)
    moving = size > NOTHING * size.max()
    unit = np.where(moving, size, np.inf)
    state, target = (x - mean) / unit, u - mean_u
    left, sizes, right = np.linalg.svd(state, full_matrices=False)
    known = sizes > NOTHING * sizes[0]
    if not moving.any() or len(x) < known.sum() + 2:
        return None
    left, directions = left[:, known], right[known].T
    squares = state[:, moving] ** 2 - 1.0
    missed = np.abs(squares - left @ (left.T @ squares)).max(axis=0) / np.abs(squares).max(axis=0)
    off = np.abs(target - left @ (left.T @ target)).max()
    if off > _TELLING * np.median(missed) * np.abs(target).max():
        return None
    K = ((directions / sizes[known]) @ (left.T @ target)).T / unit
    return K, mean_u - K @ mean, directions * np.where(moving, size, 0.0)[:, None]


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
    """The warning with a text in which {} stands for the control."""
    joint = None if scene.control_joints is None else scene.control_joints[control]
    name = f"control {control}" if joint is None else f"the control of joint {joint!r}"
    return (Finding("unstable loop", text.format(name), joint=joint, time=time, value=value),)


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
        f"{{}} turns back {len(at)} times in {len(u)} periods of {period:.4g} s: the law is too fast for "
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
        f"control loop is unstable at its period of {period:.4g} s: {{}} grows by a factor of "
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
