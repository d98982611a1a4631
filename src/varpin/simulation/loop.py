"""The stability of a digital control loop at its period, from a finished motion and copies of its control law.

At its equilibrium, found for some states of the motion, the law is differentiated, :mod:`varpin.signals.responses`,
unless its gains are known. With the step of the plant at rest there under a zero-order hold, x' = A x + B u, the loop
is unstable if the spectral radius of the step of (x_k, x_(k-1), ...) exceeds one (Franklin, Powell and Workman 1998,
section 4.3). Growth that the law would have in continuous time too, as in a falling pendulum, gives no warning unless
it doubles deviations in a period. The gains of plans made anew have no equilibrium: there the plant is held at the
state that the plan is about.

A law that does not respond to small displacements, as at its limits, shows by turning back every few periods.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from varpin.arrays import Floats, Integers
from varpin.errors import AssemblyError, ControlError, LinearizationError, SingularMassMatrix
from varpin.finding import Finding
from varpin.integrators.explicit import accelerations
from varpin.mechanics.assembly import nearest
from varpin.mechanics.scene import Scene, closest_controls, tangent_basis
from varpin.signals.functions import Copies, decision
from varpin.signals.responses import MEMORY, Response, responses
from varpin.simulation.spectrum import masses
from varpin.support.one_thread import one_thread
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

# Most states of a motion, and most turns, at which the law is differentiated.
_NODES = 5
# Iterations of Newton's method, and its last step [rad or m].
_ITERATIONS, _CONVERGED = 30, 1e-8
# Rank tolerance of the constraints in the metric of the kinetic energy, relative to the square of the largest.
_RANK = 1e-9
# Stiffness, as a share of the largest, below which a direction is free to stay anywhere.
_SINGULAR = 1e-6
# Least growth a period: rounding of differences may split double eigenvalues by 3e-6. 0 to 1e-5: the same.
_GROWTH = 1e-5
# The period causes growth if its exponent exceeds that in continuous time by this factor: 1.1 to 3 give the same. No
# more of the latter counts, for what more than doubles in a period is no motion that is meant: 0.2 to 0.6 the same.
_BY_PERIOD, _MEANT = 1.5, 0.5
# Ratio of the periods that are tried for a stable one.
_SHORTER = 0.9
# Least turns of a control within a window of so many periods, each by this share of its range at least: loops that are
# unstable and clip turn 9 to 20 times, stable ones with moving goals up to 6.
_TURNS, _WINDOW, _SWING = 9, 20, 0.1
# Least share of the turns that a linear function of the state tells for them to be feedback: of sensor noise 0.09.
_FOLLOWS = 0.15


class Gains(NamedTuple):
    """Linear feedback: gains (P, m, 2n) or, with columns for the previous control, (P, m, 2n + m), of each period."""

    rows: Floats
    of: Scene | None = None  # whose momenta p the gains are on (q, p) for; None: on (q, v)
    reference: Floats | None = None  # where each period leads (P, n) [rad or m]; None: to the feedback's equilibrium


@dataclass(frozen=True)
class Loop:
    """A plant with a law, linearized at rest; y are the f coordinates of the tangent space.

    Attributes:
        A: Rate of (y, y') by (y, y') (2f, 2f) [1/s].
        B: By u (2f, m).
        H: Of u by (y, y') of this period and those before (J, m, 2f).
        kept: What each period multiplies the responses by that follow the last of H (m, m).
    """

    A: Floats
    B: Floats
    H: Floats
    kept: Floats

    def mode(self, period: float) -> tuple[float, Floats]:
        """Spectral radius over a period [s] with zero-order hold, and sizes of the controls in that mode (m,).

        The radius is NaN where numbers overflow.
        """
        (size, m), J = self.B.shape, len(self.H)
        held = scipy.linalg.expm(period * np.block([[self.A, self.B], [np.zeros((m, size + m))]]))
        # The state is (x_k, ..., x_(k-J+1), y_k), with controls y of what was before.
        control = np.concatenate([*self.H, np.eye(m)], axis=1)
        step = np.eye(J * size + m, k=-size)
        step[:size] = held[:size, size:] @ control
        step[:size, :size] += held[:size, :size]
        step[J * size :] = 0.0
        step[J * size :, (J - 1) * size : J * size] = self.kept @ self.H[-1]
        step[J * size :, J * size :] = self.kept
        if not np.isfinite(step).all():
            return np.nan, np.zeros(m)
        factors, modes = np.linalg.eig(step)
        largest = int(np.argmax(np.abs(factors)))
        return float(np.abs(factors[largest])), np.abs(control @ modes[:, largest])

    def grows(self, period: float) -> bool:
        """Whether the loop is unstable because of its period [s]."""
        radius, _ = self.mode(period)
        if not radius > 1.0 + _GROWTH:
            return False
        change = np.concatenate([self.kept @ self.H[-1], self.kept - np.eye(len(self.kept))], axis=1) / period
        slow = np.block([[self.A + self.B @ self.H.sum(axis=0), self.B], [change]])
        rate = float(np.linalg.eigvals(slow).real.max())
        # What the plant does without a law is no fault of the period.
        most = max(_MEANT, period * float(np.linalg.eigvals(self.A).real.max()))
        return bool(np.log(radius) > _BY_PERIOD * min(max(rate, 0.0) * period, most))


def unstable_loop(
    scene: Scene, trajectory: Trajectory, hold: int = 1, law: Copies | Gains | None = None
) -> tuple[Finding, ...]:
    """The warning of a loop that is unstable at its period of ``hold`` steps; empty if stable, or nothing is known.

    ``law`` makes copies of the law as it was before the motion, or has its gains; None if there are neither. It is told
    of if the loop is unstable at most of some states spread over the motion, or over the turns of a control.
    """
    period, at = hold * trajectory.dt, np.arange(0, trajectory.steps, hold)
    if len(at) >= 3:
        u = trajectory.u[at]
        if not np.ptp(u, axis=0).any():
            return ()
    elif callable(law):
        # Of a motion that fails at once, the state at its start stands for its neighbours, too.
        at = np.zeros(3, dtype=np.int64)
        u = np.repeat(decision(law(), scene, 0, 0.0, trajectory.q[0], trajectory.v[0]), 3, axis=0)
    else:
        return ()
    x = np.concatenate([trajectory.q[at], trajectory.v[at]], axis=1)
    t: Floats = period * np.arange(len(at), dtype=np.float64)
    with np.errstate(all="ignore"), one_thread():
        worst, turning = _turning(u)
        groups = [_spread(nodes) for nodes in (_inside(u), turning)]
        loops = _loops(scene, law, t, x, u, sorted(set().union(*groups)))
        for nodes in groups:
            found = _by_theory(scene, [loops[k] for k in nodes if k in loops], period)
            if found:
                return found
    if trajectory.dw.any() or any(k in loops and loops[k].H[:, worst].any() for k in groups[-1]):
        return ()
    return _by_turns(scene, x, u, t, worst, turning)


def _spread(nodes: Integers) -> list[int]:
    """Some of the nodes, evenly spread."""
    chosen = np.unique(np.linspace(0, len(nodes) - 1, min(_NODES, len(nodes))).astype(np.int64))
    return [int(k) for k in nodes[chosen]]


def _inside(u: Floats) -> Integers:
    """The nodes but the first and the last at which the fewest controls of u (P, m) are at an end that they repeat."""
    at_end = u == np.array([u.min(axis=0), u.max(axis=0)])[:, None]
    clipped = (at_end & (at_end.sum(axis=1) > 1)[:, None]).any(axis=0).sum(axis=1)[1:-1]
    return 1 + np.flatnonzero(clipped == clipped.min())


def _turning(u: Floats) -> tuple[int, Integers]:
    """The control of u (P, m) that turns back most within a window, and the nodes at which it does, if it is often."""
    changes = np.diff(u, axis=0)
    far = np.abs(changes) >= _SWING * np.ptp(u, axis=0)
    turns = (changes[1:] * changes[:-1] < 0.0) & far[1:] & far[:-1]
    most = [np.convolve(each, np.ones(_WINDOW)).max() for each in turns.T]
    worst = int(np.argmax(most))
    return worst, 1 + np.flatnonzero(turns[:, worst] & (most[worst] >= _TURNS))


def _loops(
    scene: Scene, law: Copies | Gains | None, t: Floats, x: Floats, u: Floats, nodes: Sequence[int]
) -> dict[int, Loop]:
    """The loops with a law at some nodes of times t (P,), states x (P, 2n) and controls u (P, m), where it responds."""
    # Commands of kinematic inputs are positions.
    if law is None or scene.inputs:
        return {}
    found: dict[int, Loop] = {}
    start, places = x[0, : scene.robot.dof], law.reference if isinstance(law, Gains) else None
    respond = (
        functools.partial(_of_gains, scene, law, x, u) if isinstance(law, Gains) else responses(scene, law, t, x, u)
    )
    for k in nodes:
        try:
            # Oscillations by which controls alternate are at rest in the mean of three states.
            response = respond(k, 0.25 * (x[k - 1] + 2.0 * x[k] + x[k + 1]))
            if not response[1].any() or not np.isfinite(response[1]).all():
                continue
            if places is not None:
                q = nearest(scene, places[k]) if scene.constraints else places[k]
                _, H, kept = respond(k, np.append(q, np.zeros_like(q)))
                found[k], _ = _at_rest(scene, q, closest_controls(scene, q), H, kept)
            elif equilibrium := _at_equilibrium(scene, start, response, functools.partial(respond, k)):
                start, found[k] = equilibrium
        except (AssemblyError, SingularMassMatrix, ControlError, LinearizationError, np.linalg.LinAlgError) as error:
            logger.debug("a control law is not differentiated at state %d: %r", k, error)
    return found


def _finding(scene: Scene, control: int, text: str, value: float, time: float | None = None) -> tuple[Finding, ...]:
    """The warning with a text in which {} stands for the control."""
    joint = None if scene.control_joints is None else scene.control_joints[control]
    name = f"control {control}" if joint is None else f"the control of joint {joint!r}"
    return (Finding("unstable loop", text.format(name), joint=joint, time=time, value=value),)


def _by_theory(scene: Scene, loops: Sequence[Loop], period: float) -> tuple[Finding, ...]:
    """The warning if most loops are unstable because of the period [s], about the one in the middle."""
    unstable = sorted((loop for loop in loops if loop.grows(period)), key=lambda loop: loop.mode(period)[0])
    if 2 * len(unstable) <= len(loops):
        return ()
    loop = unstable[len(unstable) // 2]
    radius, sizes = loop.mode(period)
    stable = next((float(T) for T in period * _SHORTER ** np.arange(1, 60) if loop.mode(T)[0] <= 1.0 + _GROWTH), None)
    advice = "lower gains" if stable is None else f"a period below {stable:.3g} s, or lower gains"
    text = (
        f"control loop is unstable at its period of {period:.4g} s: each period multiplies deviations by {radius:.6g}. "
        f"Use {advice}"
    )
    return _finding(scene, int(np.argmax(sizes)), text, radius)


def _by_turns(scene: Scene, x: Floats, u: Floats, t: Floats, control: int, turns: Integers) -> tuple[Finding, ...]:
    """The warning if a control of u (P, m) turns back every few periods as the state x (P, 2n) does."""
    if not len(turns):
        return ()
    # What turns whatever the state is excitation, not feedback.
    side, fit = np.sign(u[turns, control] - u[turns - 1, control]), np.column_stack([x[turns], np.ones(len(turns))])
    left = side - fit @ np.linalg.lstsq(fit, side, rcond=None)[0]
    if not left @ left < (1.0 - _FOLLOWS) * (len(turns) - x.shape[1]) * side.var():
        return ()
    text = (
        f"{{}} turns back {len(turns)} times in {len(u)} periods of {t[1]:.4g} s: the law is too fast for "
        "its period. Use a shorter period, or lower gains"
    )
    return _finding(scene, control, text, float(len(turns)), float(t[turns[0]]))


def _of_gains(scene: Scene, gains: Gains, x: Floats, u: Floats, k: int, state: Floats) -> Response:
    """The response of linear feedback in a period at a state (2n,), from its controls u (P, m) at states x (P, 2n)."""
    n, m = scene.robot.dof, scene.controls
    M = np.tile(np.eye(n), (2, 1, 1)) if gains.of is None else masses(gains.of, np.array([state[:n], x[k, :n]]))
    K, G = np.split(gains.rows[k], [2 * n], axis=1)
    here, known = (np.concatenate([K[:, :n], K[:, n:] @ each], axis=1) for each in M)
    kept, J = (G, MEMORY) if G.size else (np.zeros((m, m)), 1)
    powers = np.array([np.linalg.matrix_power(kept, i) for i in range(J)])
    return u[k] - powers.sum(axis=0) @ known @ x[k], powers @ here, kept


def _at_equilibrium(
    scene: Scene, q: Floats, response: Response, respond: Callable[[Floats], Response]
) -> tuple[Floats, Loop] | None:
    """The equilibrium (n,) that Newton's method finds from q (n,), and the loop there; None if it finds none.

    The law is differentiated at each iterate at rest. Where a control does not respond there that does in the motion,
    as at its limit, the law has the response of the last state instead.
    """
    responding = response[1].any(axis=(0, 2))
    for _ in range(_ITERATIONS):
        q = nearest(scene, q) if scene.constraints else q
        here = respond(np.append(q, np.zeros_like(q)))
        if (here[1].any(axis=(0, 2)) >= responding).all():
            response = here
        u, H, kept = response
        loop, way = _at_rest(scene, q, u + H.sum(axis=0)[:, : len(q)] @ q, H, kept)
        if np.abs(way).max() < _CONVERGED:
            return q, loop
        q = q + way / max(1.0, np.abs(way).max())
    return None


def _at_rest(scene: Scene, q: Floats, u: Floats, H: Floats, kept: Floats) -> tuple[Loop, Floats]:
    """The loop where a constant force holds q (n,) at rest beside controls u (m,), for responses H (J, m, 2n).

    And the way (n,) of a step of Newton's method to where there is no such force. Changes of the state are dq = Z y and
    dv = Z y'; constraint forces are constant to first order, but for their curvature lam . g_qq.
    """
    M, Z = masses(scene, q[None])[0], tangent_basis(scene, q)
    still, force = np.zeros((1, len(q))), (scene.actuation @ u)[None]
    a, *_ = accelerations(scene, q[None], still, force)
    _, aq, av, af = (part[0] for part in accelerations(scene, q[None], still, force - a @ M))
    if scene.constraints:
        C = scene.core.constraints(q[None])[2][0]
        lam = np.linalg.lstsq(C @ af @ C.T, -C @ a[0], rcond=_RANK)[0]
        aq = aq + af @ scene.core.constraint_curvature(q, lam, q)[0]
    onto = np.linalg.solve(Z.T @ M @ Z, Z.T @ M)
    aq, av, pushed = onto @ aq @ Z, onto @ av @ Z, onto @ af @ scene.actuation
    H = H @ np.kron(np.eye(2), Z)
    way = Z @ np.linalg.lstsq(aq + pushed @ H.sum(axis=0)[:, : len(aq)], -onto @ a[0], rcond=_SINGULAR)[0]
    A = np.block([[np.zeros_like(aq), np.eye(len(aq))], [aq, av]])
    return Loop(A, np.concatenate([np.zeros_like(pushed), pushed]), H, kept), way
