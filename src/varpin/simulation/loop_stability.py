"""Is a digital control loop stable at its period? The answer comes from a finished motion, without calls of the law.

There are two methods. By theory: where the motion determines the law, u = K (q, v) + c, with a share of gravity's
torque if needed, the loop is linearized at the equilibrium next to the motion. With the plant's exact step under a held
control, x' = A x + B u (Franklin, Powell and Workman 1998, section 4.3), it is stable if the spectral radius of A + B K
is below one. Under constraints it is linearized on the tangent space. By the record, for any other law: the controls
do work and grow steadily, by orders of magnitude, or by less if they oscillate within some periods. Growth that the law
would have in continuous time too, as in a pendulum that falls, gives no warning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.errors import AssemblyError, LinearizationError, SingularMassMatrix
from varpin.integrators import Integrator
from varpin.integrators.explicit import accelerations
from varpin.mechanics.assembly import nearest
from varpin.mechanics.forces import drive_forces
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.simulation import growth
from varpin.simulation.chatter import RUN, alternation
from varpin.simulation.modes import first_order, linearized
from varpin.simulation.soundness import GROWING, Finding, examined, with_warnings
from varpin.trajectory import Trajectory

_ADVICE = "take a shorter period or lower gains; where neither helps, look at the signs of the law"
KIND = "unstable loop"
_FLIPS = "flipping controls"
# Least growth of the controls for a warning: from the first quarter of a motion to its end, and over each of the last
# two quarters. Steady growth by 1e3 is growth by 1e3 ** (3/4) from the end of the first quarter.
_GREW, _GROWS = 1e2, 2.0
# Number of nodes for the fit of a law: this many with the largest changes, and as many spread over the motion.
_NODES = 32
# Largest error of a fit. In units of rounding: 32 times the condition of the state, at most 1e5. In units of the error
# with which squares of the state are fitted, too: on a smooth curve any function of the state can be fitted.
_EXACT, _TELLING = (32.0, 1e5), 1e-6
# Least motion of the state in a direction, as a share of the largest, for the law to be known in it: over the whole
# record, and in its last changes.
_EXCITED, _CHANGED = 1e-9, 1e-3
# Least growth of the controls' changes over the second half of a motion for a warning, if they oscillate.
_CHANGES_GREW = 1.5
# Least phase over a period [rad] of an oscillation: moving goals and plants take many periods for a turn.
_TURNS = np.pi / 6.0
# Least size of an alternation at its end, as a share of that at its start, for it to count as lasting.
_LASTS = 0.5
# Least growth of the controls up to a step that fails for a warning.
_OUTGROWN = 10.0
# Number of nodes at one extreme value from which on a control counts as saturated there.
_SATURATED = 2
# Least number of changes from one limit to the other in a cycle, and in the second half of the motion. The number of
# last intervals between them that are compared, and the ratio of the means of their halves below which the motion
# calms down.
_CYCLES, _LATE, _INTERVALS, _KEEPS = 6, 2, 8, 0.9
# Net work of a control, as a share of its work in absolute values, above which the law pumps energy in on purpose.
_PUMPS = 0.7
# Number of nodes for the fit of a clipped law.
_CLIPPED_NODES = 400
# Largest value that is squared.
_HUGE = 1e120
# Least part of a direction along the constraints, as a share of the largest, for the law to be known in it.
_ALONG = 1e-6
# Newton's iterations from one start, and halvings of one of its steps.
_ITERATIONS, _HALVINGS = 30, 6
# Least growth over the whole motion for a warning, and least excess of a spectral radius over one, beyond rounding.
_GREW_IN_ALL, _ABOVE_ONE = 1.01, 1e-6
# Least growth over a period for a warning where no equilibrium is found.
_FAST = 1.05


@dataclass(frozen=True)
class Span:
    """Directions in which a state moved.

    Attributes:
        directions: Orthonormal after division by ``unit`` (2n, r).
        unit: Of each entry of (q, v) (2n,).
    """

    directions: Floats
    unit: Floats

    def values(self, matrix: Floats) -> NDArray[np.complex128]:
        """Eigenvalues of a matrix (2n, 2n) within these directions."""
        inside = self.directions.T @ (matrix * self.unit / self.unit[:, None]) @ self.directions
        return np.asarray(np.linalg.eigvals(inside), dtype=np.complex128)


@dataclass(frozen=True)
class Law:
    """A control law from a record: u = Kq q + Kv v + S L_q(q, 0) + c.

    Attributes:
        Kq: (m, n).
        Kv: (m, n).
        S: Share of gravity's and the springs' forces (m, n).
        c: (m,).
        span: Directions of (q, v) in which the law is known.
        near: The configuration where the motion changes most slowly (n,).
    """

    Kq: Floats
    Kv: Floats
    S: Floats
    c: Floats
    span: Span
    near: Floats


@dataclass(frozen=True)
class Loop:
    """A linearized plant with a law.

    Attributes:
        A: Rate of (y, y') by (y, y') (2f, 2f) [1/s], with y the f coordinates of the tangent space, q without
            constraints.
        B: By u (2f, m).
        K: The law (m, 2f).
        span: Directions of (y, y') in which the law is known.
        q: The configuration of the linearization (n,).
        Z: Derivative of q in y (n, f).
    """

    A: Floats
    B: Floats
    K: Floats
    span: Span
    q: Floats
    Z: Floats

    def multiplier(self, period: float) -> complex:
        """The factor of a period [s] on deviations: the largest eigenvalue of the loop with a zero-order hold."""
        size, m = self.B.shape
        held = scipy.linalg.expm(period * np.block([[self.A, self.B], [np.zeros((m, size + m))]]))
        values = self.span.values(held[:size, :size] + held[:size, size:] @ self.K)
        return complex(values[np.argmax(np.abs(values))])

    def grows_by_period(self, period: float) -> bool:
        """Whether the growth is caused by the period: the loop in continuous time grows much less or not at all.

        Within a period the state may leave the directions of the nodes. Where not all directions are known, growth that
        oscillates within some periods therefore counts as caused by the period.
        """
        multiplier = self.multiplier(period)
        if self.span.directions.shape[1] < len(self.span.unit) and np.abs(np.angle(multiplier)) >= _TURNS:
            return True
        return bool(np.log(np.abs(multiplier)) > 1.5 * max(self.rate(), 0.0) * period)

    def rate(self) -> float:
        """The fastest rate of growth if the law acted at every instant [1/s]; negative if the loop is stable then."""
        return float(self.span.values(self.A + self.B @ self.K).real.max())


@np.errstate(over="ignore", invalid="ignore")
def examined_in_loop(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    hold: int | None,
    error: float | None = None,
    *,
    corrected: bool = False,
    commands: Commands | None = None,
) -> tuple[Trajectory, tuple[Finding, ...]]:
    """:func:`varpin.simulation.soundness.examined`, and the check of the control loop.

    ``hold`` is the period of the loop in steps, None without feedback; ``error`` the largest of q [rad or m], if known.
    ``corrected``: the controller brings the motion back, so that errors of steps do not add up. ``commands`` are those
    of all steps, where they have linear feedback: whether it does so is then tried out.
    """
    trajectory, found = examined(scene, integrator, trajectory, error, corrected=corrected)
    if (
        commands is not None
        and any(finding.kind == GROWING for finding in found)
        and growth.corrected(scene, integrator, trajectory, commands)
    ):
        # The repetition that found them had the recorded controls, without feedback.
        found = tuple(finding for finding in found if finding.kind != GROWING)
        trajectory = trajectory.changed(warnings=())
    if hold is not None:
        loop = unstable_loop(scene, trajectory, hold) or _flipping(scene, trajectory, hold)
        found = (*(loop or _cycling(scene, trajectory, hold)), *found)
    return with_warnings(trajectory, found), found


def _flipping(scene: Scene, trajectory: Trajectory, hold: int) -> tuple[Finding, ...]:
    """A warning if a law, saturated or not, flips from period to period and does not calm down.

    Alternating controls do not excuse alternating velocities here: the law computes them from the velocities.
    """
    if trajectory.dw.any():
        return ()
    period, v, u = hold * trajectory.dt, trajectory.v[::hold], trajectory.u[::hold]
    advice = f"the law is too fast for its period of {period:g} s; take a shorter period or lower gains"
    if not len(u):
        return ()
    found = alternation(v)
    if found is not None:
        size = np.abs(np.diff(v[found.first : found.first + found.changes + 3, found.joint], n=2))
        if size[-1] >= _LASTS * size[0]:
            seen = found.sentence(scene.robot.joint_names, trajectory.t[::hold], "period")
            return (Finding(_FLIPS, f"under the control law {seen}: {advice}", found.joint),)
    late = u[len(u) // 2 :]
    high, low = late == u.max(axis=0, initial=-np.inf), late == u.min(axis=0, initial=np.inf)
    flips = ((high[1:] & low[:-1]) | (low[1:] & high[:-1])).sum(axis=0)
    flips[np.ptp(u, axis=0) == 0.0] = 0
    if len(late) <= RUN or not 2 * flips.max(initial=0) > len(late):
        return ()
    worst = int(np.argmax(flips))
    sentence = (
        f"control {worst} goes from one of its limits to the other at {flips[worst]} of the last {len(late)} periods: "
        f"{advice}"
    )
    return (Finding(_FLIPS, sentence),)


def _cycling(scene: Scene, trajectory: Trajectory, hold: int) -> tuple[Finding, ...]:
    """A warning if a law with a fixed goal sends a control from limit to limit without calming down.

    Only for laws that cannot be fitted, with too few nodes inside their limits, and whose controls are forces.
    """
    if trajectory.dw.any() or scene.inputs:
        return ()
    at = np.arange(0, trajectory.steps, hold)
    x, u = np.concatenate([trajectory.q[at], trajectory.v[at]], axis=1), trajectory.u[at]
    if len(u) <= _CYCLES or np.abs(x).max() >= _HUGE:
        return ()
    side = _at_limit(u, u.max(axis=0)).astype(np.int64) - _at_limit(u, u.min(axis=0))
    half, v = len(u) // 2, trajectory.v[at] @ scene.actuation
    changes = {}
    for k in range(u.shape[1]):
        arrivals = _arrivals(side[:, k])
        late = int((arrivals >= half).sum())
        if len(arrivals) < _CYCLES or late < _LATE:
            continue
        before, after = np.array_split(np.diff(arrivals)[-_INTERVALS:], 2)
        work = side[half:, k] * v[half:, k]
        calms = after.mean() < _KEEPS * before.mean()
        if not calms and work.sum() <= _PUMPS * np.abs(work).sum() and _clips(scene, x, u, side, k, len(arrivals)):
            changes[k] = late
    if not changes:
        return ()
    with np.errstate(all="ignore"):
        try:
            known = _law_inside_limits(scene, x, u) is not None
        except (np.linalg.LinAlgError, LinearizationError):
            known = False
    if known:
        return ()
    worst = max(changes, key=lambda k: changes[k])
    low, high = u[:, worst].min(), u[:, worst].max()
    return (
        Finding(
            KIND,
            f"the control loop seems unstable at its period of {hold * trajectory.dt:g} s: control {worst} goes from "
            f"one of its limits, {low:.4g} and {high:.4g}, to the other {changes[worst]} times in the last "
            f"{len(u) - half} periods and does not calm down; {_ADVICE}",
        ),
    )


def _arrivals(side: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nodes at which a control reaches a limit from the other one; ``side`` (P,) is 1, -1 at the limits, 0 inside."""
    visits = np.flatnonzero(side)
    arrivals: NDArray[np.int64] = visits[1:][side[visits[1:]] != side[visits[:-1]]]
    return arrivals


def _clips(scene: Scene, x: Floats, u: Floats, side: NDArray[np.int64], k: int, changes: int) -> bool:
    """Whether control k of u (P, m) is a clipped law of its own joints' state or, failing that, of the whole one.

    Fewer ``changes`` of the limit than twice the unknowns of a law do not decide it: some law gives them by chance
    (Cover 1965).
    """
    driven = np.tile(scene.actuation[:, k] != 0.0, 2)
    return any(
        changes >= 2 * (columns.sum() + 1) and _clipped_law(x[:, columns], u[:, k], side[:, k])
        for columns in (driven, np.ones_like(driven))
    )


def _clipped_law(x: Floats, u: Floats, side: NDArray[np.int64]) -> bool:
    """Whether some k x + c, clipped to its limits, gives u (P,) at x (P, 2n); ``side`` (P,) is 1, -1 at the limits.

    With a moving goal there is none: the control reaches its limits at other states each time.
    """
    turns = np.flatnonzero(side[1:] != side[:-1])
    tight = np.unique(np.concatenate([turns, turns + 1]))
    spread = np.linspace(0, len(x) - 1, _CLIPPED_NODES).astype(np.int64)
    rows = np.unique(np.concatenate([tight[:: 1 + len(tight) // _CLIPPED_NODES], spread]))
    x, u, side = x[rows], u[rows], side[rows]
    weight = np.ones(len(x))
    unit = _spread(x, weight)
    moving = unit > 0.0
    columns = np.concatenate([_centered(x[:, moving], weight) / unit[moving], np.ones((len(x), 1))], axis=1)
    target = 2.0 * (u - u.min()) / np.ptp(u) - 1.0
    above, below, free = side > 0, side < 0, side == 0
    result = scipy.optimize.linprog(
        np.zeros(columns.shape[1]),
        A_ub=np.concatenate([-columns[above], columns[below]]),
        b_ub=np.concatenate([-target[above], target[below]]),
        A_eq=columns[free],
        b_eq=target[free],
        bounds=(None, None),
        method="highs",
    )
    return bool(result.status == 0)


def outgrown(u: Floats, period: float) -> tuple[Finding, ...]:
    """A warning if the controls (P, m) of a motion that ended at a failing step have grown by much.

    A fast unstable loop ends a motion before there are enough nodes to fit its law. ``period`` is that of the law [s].
    """
    size = np.abs(u).max(axis=1, initial=0.0)
    first = int(np.argmax(size > 0.0)) if size.any() else 0
    if len(u) < 2 or not size[-1] >= _OUTGROWN * size[first] > 0.0:
        return ()
    count = len(u) - 1 - first
    periods = "one period" if count == 1 else f"{count} periods"
    return (
        Finding(
            KIND,
            f"the control loop may be unstable at its period of {period:g} s: controls grow from {size[first]:.3g} to "
            f"{size[-1]:.3g} within {periods}; {_ADVICE}",
        ),
    )


def unstable_loop(scene: Scene, trajectory: Trajectory, hold: int = 1) -> tuple[Finding, ...]:
    """The warning of an unstable control loop with feedback every ``hold`` steps, if it is unstable."""
    period = hold * trajectory.dt
    at = np.arange(0, trajectory.steps, hold)
    x = np.concatenate([trajectory.q[at], trajectory.v[at]], axis=1)
    u = trajectory.u[at]
    if len(at) < 3 or not u.size or not np.ptp(u, axis=0).any():
        return ()
    with np.errstate(all="ignore"):
        try:
            found = _by_theory(scene, x, u, period)
        except (np.linalg.LinAlgError, LinearizationError):
            found = ()
        if found or not _does_work(scene, trajectory.part(int(at[round(0.75 * (len(at) - 1))]), trajectory.steps)):
            return found
        try:
            return _by_the_record(u, period) or _by_last_changes(x, u, period)
        except (np.linalg.LinAlgError, LinearizationError):
            return ()


def _does_work(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether the controls do positive work in a motion."""
    ways, before = np.diff(trajectory.q, axis=0), trajectory.u @ scene.actuation.T
    middle = 0.5 * (trajectory.q[1:] + trajectory.q[:-1])
    force = drive_forces(scene.elements, middle, ways / trajectory.dt, before)
    for row, c in scene.inputs.items():
        force[:, c] = trajectory.constraint_forces[:, int(np.argmax(scene.constraint_order == row))]
    return bool(((force / np.abs(force).max()) * (ways / np.abs(ways).max())).sum() > 0.0)


def _by_the_record(u: Floats, period: float) -> tuple[Finding, ...]:
    """A warning if controls have grown by orders of magnitude, and still grow."""
    largest = np.maximum.accumulate(np.abs(u), axis=0)
    last = len(u) - 1
    quarter, half, three = (largest[round(share * last)] for share in (0.25, 0.5, 0.75))
    steadily = (largest[last] >= _GROWS * three) & (three >= _GROWS * half)
    grew = np.where(steadily & (quarter > 0.0), largest[last] / quarter, 0.0)
    worst = int(np.argmax(grew))
    if not grew[worst] >= _GREW:
        return ()
    return (
        Finding(
            KIND,
            f"the control loop is unstable at its period of {period:g} s: control {worst} grows from "
            f"{quarter[worst]:.3g} in the first quarter of the motion to {largest[last, worst]:.3g} in the end; "
            f"{_ADVICE}",
        ),
    )


def _by_last_changes(x: Floats, u: Floats, period: float) -> tuple[Finding, ...]:
    """A warning if changes of the controls grow in a motion that oscillates within some periods."""
    n, last = x.shape[1] // 2, len(u) - 1
    window = 3 * n + 8
    if last < 2 * window:
        return ()
    changes = np.abs(np.diff(u, axis=0))
    peaks = np.array([part.max(axis=0) for part in np.array_split(changes[last // 2 :], 4)])
    growing = (np.diff(peaks, axis=0) > 0.0).all(axis=0) & (peaks[-1] >= _CHANGES_GREW * peaks[0])
    if not growing.any():
        return ()
    # The last changes of the state as a linear map of those before (dynamic mode decomposition, Schmid 2010).
    dx = np.diff(x[-window:], axis=0)
    dx -= dx.mean(axis=0)
    size = np.sqrt(np.mean(dx**2, axis=0))
    left, sizes, _ = np.linalg.svd(dx[:, size > 0.0] / size[size > 0.0], full_matrices=False)
    modes = (left * sizes)[:, sizes > _CHANGED * sizes[0]]
    step = np.linalg.lstsq(modes[:-1], modes[1:], rcond=None)[0]
    values = np.linalg.eigvals(step)
    growth = float(np.abs(values[np.abs(np.angle(values)) >= _TURNS]).max(initial=0.0))
    if not 0.5 * last * np.log(growth) > np.log(_CHANGES_GREW):
        return ()
    worst = int(np.argmax(np.where(growing, peaks[-1], 0.0)))
    return (
        Finding(
            KIND,
            f"the control loop is unstable at its period of {period:g} s: changes of control {worst} grow from "
            f"{peaks[0, worst]:.3g} to {peaks[-1, worst]:.3g} over the second half of the motion, and each period "
            f"multiplies deviations by {growth:.4g} in the end; {_ADVICE}",
        ),
    )


def _by_theory(scene: Scene, x: Floats, u: Floats, period: float) -> tuple[Finding, ...]:
    """A warning if the spectral radius of the loop exceeds one, where the record determines the law.

    Laws that give positions of kinematic inputs are left to the record.
    """
    if scene.inputs:
        return ()
    law = _law_inside_limits(scene, x, u)
    if law is None:
        return ()
    loop = loop_at_rest(scene, law)
    rests = loop is not None
    if loop is None:
        loop = _linearized(scene, law, law.near)[0]
    if not loop.span.directions.shape[1]:
        return ()
    multiplier = loop.multiplier(period)
    growth = float(np.abs(multiplier))
    grows = growth > 1.0 + _ABOVE_ONE and len(u) * np.log(growth) > np.log(_GREW_IN_ALL)
    if not (grows and loop.grows_by_period(period)):
        return ()
    # Away from an equilibrium only fast, oscillating growth: slow growth may be part of the motion.
    if not rests and (np.abs(np.angle(multiplier)) < _TURNS or growth < _FAST):
        return ()
    where = "its equilibrium q" if rests else "q"
    stable = next((period / 2**k for k in range(1, 8) if np.abs(loop.multiplier(period / 2**k)) < 1.0), None)
    advice = "take lower gains" if stable is None else f"with a period of {stable:g} s or lower gains it is stable"
    return (
        Finding(
            KIND,
            f"the control loop is unstable at its period of {period:g} s: each multiplies deviations by {growth:.4g} "
            f"(linearized at {where} = [{', '.join(f'{value:.4g}' for value in loop.q)}]); {advice}",
        ),
    )


def _law_inside_limits(scene: Scene, x: Floats, u: Floats) -> Law | None:
    """The law from all nodes or, where it saturates, from those at which a control is inside its limits."""
    law = fitted_law(scene, x, u)
    if law is not None:
        return law
    free = _unsaturated(u)
    if free.all():
        return None
    law = fitted_law(scene, x[free.all(axis=1)], u[free.all(axis=1)], spare=2)
    if law is not None or u.shape[1] == 1:
        return law
    # Each control by itself: its nodes inside the limits may be others.
    laws = [fitted_law(scene, x[rows], u[rows, k : k + 1], spare=2) for k, rows in enumerate(free.T)]
    known = [law for law in laws if law is not None]
    # The loop needs all laws in all directions.
    if len(known) < len(laws) or any(law.span.directions.shape[1] < x.shape[1] for law in known):
        return None
    Kq, Kv, S, c = (np.concatenate([getattr(law, name) for law in known]) for name in ("Kq", "Kv", "S", "c"))
    return Law(Kq=Kq, Kv=Kv, S=S, c=c, span=known[0].span, near=known[0].near)


def _unsaturated(u: Floats) -> NDArray[np.bool_]:
    """Where controls u (P, m) are not saturated at their largest or smallest value (P, m)."""
    return ~(_at_limit(u, u.max(axis=0)) | _at_limit(u, u.min(axis=0)))


def _at_limit(u: Floats, limit: Floats) -> NDArray[np.bool_]:
    """Where controls u (P, m) saturate at a value (m,), if they change at all (P, m)."""
    at = u == limit
    return np.asarray(at & (at.sum(axis=0) >= _SATURATED) & (np.ptp(u, axis=0) > 0.0), dtype=np.bool_)


def fitted_law(scene: Scene, x: Floats, u: Floats, spare: int = 4) -> Law | None:
    """The law, linear except for gravity, that gives u (P, m) at (q, v) = x (P, 2n) to rounding, if there is one.

    It takes at least ``spare`` more nodes than directions in which the state moves.
    """
    n = scene.robot.dof
    sound = (np.abs(x).max(axis=1) < _HUGE) & (np.abs(u).max(axis=1) < _HUGE)
    x, u = x[sound], u[sound]
    if len(x) < 4:
        return None
    # Weights by the size of the state, for motions that run away.
    weight = 1.0 / np.maximum(1.0, np.abs(x).max(axis=1))
    unit = _spread(x, weight)
    change = (np.abs(np.diff(x, axis=0)) / np.where(unit > 0.0, unit, np.inf)).max(axis=1)
    near = x[int(np.argmin(change)), :n]
    nodes = max(_NODES, 2 * n)
    if len(x) > 2 * nodes:
        largest = np.argpartition(change, -nodes)[-nodes:]
        chosen = np.unique(np.concatenate([largest, np.linspace(0, len(x) - 1, nodes).astype(np.int64)]))
        x, u, weight = x[chosen], u[chosen], weight[chosen]
    unit = _spread(x, weight)
    gains = _affine(x, u, weight, spare)
    if gains is None:
        gains = _affine(np.concatenate([x, _pull(scene, x[:, :n])], axis=1), u, weight, spare)
    if gains is None:
        return None
    K, c = gains
    S = K[:, 2 * n :] if K.shape[1] > 2 * n else np.zeros((len(K), n))
    moving = np.flatnonzero(unit > 0.0)
    _, sizes, rows = np.linalg.svd(_centered(x[:, moving], weight) / unit[moving], full_matrices=False)
    directions = np.zeros((2 * n, int((sizes > _EXCITED * sizes[0]).sum())))
    directions[moving] = rows[: directions.shape[1]].T
    span = Span(directions, np.where(unit > 0.0, unit, 1.0))
    return Law(Kq=K[:, :n], Kv=K[:, n : 2 * n], S=S, c=c, span=span, near=near)


def _pull(scene: Scene, q: Floats) -> Floats:
    """L_q(q, 0) at many configurations (P, n): the force of gravity and springs."""
    nothing = np.zeros_like(q)
    a, _, _, af = accelerations(scene, q, nothing, nothing)
    return np.asarray(np.linalg.solve(af, a[..., None])[..., 0], dtype=np.float64)


def _centered(columns: Floats, weight: Floats) -> Floats:
    """Columns (P, k) times weights (P,), without their part along the weights, which is that of a constant."""
    rows: Floats = columns * weight[:, None]
    along: Floats = np.asarray(weight @ rows, dtype=np.float64) / (weight @ weight)
    return rows - weight[:, None] * along


def _spread(columns: Floats, weight: Floats) -> Floats:
    """Root mean square (k,) of centered columns; zero for a column that is constant to rounding."""
    size = np.sqrt(np.mean(_centered(columns, weight) ** 2, axis=0))
    return np.where(size > 1e-13 * np.abs(columns * weight[:, None]).max(axis=0), size, 0.0)


def _affine(x: Floats, u: Floats, weight: Floats, spare: int) -> tuple[Floats, Floats] | None:
    """K (m, k) and c (m,) of u = K x + c, if that holds to rounding; K is the least of equal fits."""
    unit = _spread(x, weight)
    moving = np.flatnonzero(unit > 0.0)
    if not len(moving):
        return None
    state = _centered(x[:, moving], weight) / unit[moving]
    left, sizes, right = np.linalg.svd(state, full_matrices=False)
    known = sizes > _EXCITED * sizes[0]
    left = left[:, known]
    if len(x) < known.sum() + spare:
        return None
    target = _centered(u, weight)
    scaled = (right[known].T / sizes[known]) @ (left.T @ target)
    # Gains of rounding would split the double eigenvalue of a free joint: they are zero.
    scaled[np.abs(scaled) < 1e-10 * np.abs(scaled).max(axis=0)] = 0.0
    K = np.zeros((u.shape[1], x.shape[1]))
    K[:, moving] = (scaled / unit[moving, None]).T
    rest = u - x @ K.T
    c = weight**2 @ rest / (weight @ weight)
    off = np.abs((rest - c) * weight[:, None]).max()
    terms = ((np.abs(x) @ np.abs(K.T) + np.abs(c)) * weight[:, None]).max()
    squares = _centered((state / weight[:, None]) ** 2, weight)
    missed = np.abs(squares - left @ (left.T @ squares)).max(axis=0) / np.abs(squares).max(axis=0)
    # Rounding grows with the condition of the state.
    rounding = np.finfo(np.float64).eps * min(_EXACT[0] * sizes[0] / sizes[known][-1], _EXACT[1]) * terms
    allowed = min(rounding, _TELLING * np.median(missed) * np.abs(target).max())
    return (K, c) if off <= allowed else None


def loop_at_rest(scene: Scene, law: Law) -> Loop | None:
    """The loop at an equilibrium, by Newton's method from ``law.near`` or, failing that, from the law's goal.

    The goal is where the law gives no control. None if no equilibrium is found.
    """
    goal = law.near - np.linalg.lstsq(law.Kq, law.Kq @ law.near + law.c, rcond=None)[0]
    for start in (law.near, goal):
        kept = _kept(scene, start)
        if kept is None:
            continue
        loop, a, terms = _linearized(scene, law, kept)
        f = loop.Z.shape[1]
        for _ in range(_ITERATIONS if f else 0):
            way = np.linalg.lstsq(loop.A[f:, :f] + loop.B[f:] @ loop.K[:, :f], -a, rcond=None)[0]
            step = loop.Z @ way
            if np.abs(step).max() <= 1e-9 * max(1.0, np.abs(loop.q).max()):
                # With a singular matrix a force may remain that no step removes.
                if np.abs(a).max() > 1e-6 * terms:
                    break
                return loop
            before, q = np.abs(a).max(), loop.q
            # Halve the step until the acceleration falls.
            for halved in range(_HALVINGS):
                kept = _kept(scene, q + 0.5**halved * step)
                if kept is None:
                    continue
                loop, a, terms = _linearized(scene, law, kept)
                if np.abs(a).max() < before:
                    break
            if kept is None:
                break
    return None


def _kept(scene: Scene, q: Floats) -> Floats | None:
    """The configuration next to q (n,) that keeps the constraints; None if there is none."""
    if not scene.constraints:
        return q
    try:
        return nearest(scene, q)
    except (AssemblyError, SingularMassMatrix):
        return None


def _linearized(scene: Scene, law: Law, q: Floats) -> tuple[Loop, Floats, float]:
    """The loop at rest at q (n,); the acceleration there (f,), and the size of the terms that cancel in it."""
    n = len(q)
    u, Kq = law.Kq @ q + law.c, law.Kq
    if law.S.any():
        jet = lagrangian_jet(scene, q, np.zeros(n))
        u, Kq = u + law.S @ jet.Lq, Kq + law.S @ jet.Lqq
    force = scene.actuation @ u
    a, aq, av, af, Z, onto = (part[0] for part in linearized(scene, q[None], np.zeros((1, n)), force[None]))
    pushed = af @ scene.actuation
    sizes = np.abs(law.Kq) @ (np.abs(q) + law.span.unit[:n]) + np.abs(law.c)
    terms = np.abs(pushed) @ sizes + np.abs(a - af @ force)
    B = np.concatenate([np.zeros_like(pushed), pushed])
    gains = np.concatenate([Kq @ Z, law.Kv @ Z], axis=1)
    span = _along(law.span, onto) if scene.constraints else law.span
    return Loop(first_order(aq[None], av[None])[0], B, gains, span, q, Z), a, float(terms.max(initial=0.0))


def _along(span: Span, onto: Floats) -> Span:
    """Directions of (q, v) (2n,) as those of (y, y') on the tangent space, with y' = onto v."""
    n = onto.shape[1]
    there = span.directions * span.unit[:, None]
    both = np.concatenate([onto @ there[:n], onto @ there[n:]])
    left, sizes, _ = np.linalg.svd(both, full_matrices=False)
    known = left[:, sizes > _ALONG * sizes.max(initial=0.0)]
    return Span(known, np.ones(len(both)))
