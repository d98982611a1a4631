"""Constraints of a plan between its nodes: where the motion violates them, and rows that forbid it there.

A row is at one of a few instants of a step, the ends of equal parts of it. Its value, and its derivatives in the state
before the step and the controls over it, are those of the motion integrated in these parts. An offset is added where
the motion has a peak between two instants. A controller's ticks have rows on the cubics through the steps instead,
which take hardly any time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers
from varpin.control.constraints import BoundBetween, BoundConstraint, BoundOnCubics, Horizon, PlanConstraint
from varpin.control.parts import Parts
from varpin.control.problem import OptimalControlProblem, cubics
from varpin.mechanics.scene import quiet
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

# Parts of a step, whose ends within the step are the instants, and where these are in a step of unit length.
_PARTS = 8
SHARES: Floats = np.arange(1, _PARTS) / _PARTS
SHARES.setflags(write=False)
# Where the rows of a controller's ticks are.
_MIDDLE = 0.5
# Violation of the start from which on a row cannot hold in the first step.
_OUTSIDE = 1e-6
# Change of an offset between rounds up to which it is halved, relative to the constraint's scale.
_SAME = 1e-3
# By how much wide offsets grow, in units of what they lack, and how much too large they stay, in scales.
_AHEAD, _KEPT = 4.0, 1e-3


@dataclass(frozen=True, eq=False)
class Instants(Frozen):
    """Instants between nodes at which constraints have rows.

    Attributes:
        rows: Constraint, step and instant (I, 3), each from 0, in ascending order.
        offsets: Offsets of all rows of each of them (O,), one instant after another; zero on cubics.
        cubic: Whether rows are on the cubics through the steps, at their middles, not of steps integrated in parts.
    """

    rows: Integers
    offsets: Floats
    cubic: bool = False

    def __post_init__(self) -> None:
        for array in (self.rows, self.offsets):
            array.setflags(write=False)

    @property
    def constraints(self) -> list[int]:
        """Indices of the constraints with such rows."""
        return [int(i) for i in np.unique(self.rows[:, 0])]

    def of(self, constraint: int) -> Integers:
        """Step and instant (K, 2) of the rows of one constraint."""
        return self.rows[self.rows[:, 0] == constraint, 1:]


NOWHERE = Instants(np.zeros((0, 3), dtype=np.int64), np.zeros(0))


def enforced(problem: OptimalControlProblem, instants: Instants) -> OptimalControlProblem:
    """The problem with further bound constraints, one for each constraint with rows at ``instants``."""
    if not len(instants.rows):
        return problem
    made = object.__new__(type(problem))
    found: list[BoundConstraint] = list(problem.bound_constraints)
    for i, offset in _offsets(problem, instants).items():
        if instants.cubic:
            found.append(_on_cubics(problem, i, instants.of(i)[:, 0]))
            continue
        found.append(replace(_bound(problem, i, instants.of(i)), offset=offset))
    # The dataclass is frozen: attributes are set in its dictionary.
    vars(made).update(vars(problem) | {"bound_constraints": tuple(found)})
    return made


def _offsets(problem: OptimalControlProblem, instants: Instants) -> dict[int, Floats]:
    """The offsets (K, rows) of each constraint with rows at ``instants``."""
    found, begin = {}, 0
    for i in instants.constraints:
        shape = len(instants.of(i)), len(problem.bound_constraints[i].rows)
        end = begin + shape[0] * shape[1]
        found[i], begin = instants.offsets[begin:end].reshape(shape), end
    return found


def _bound(problem: OptimalControlProblem, constraint: int, rows: Integers) -> BoundBetween:
    """A constraint at the step and instant of ``rows`` (K, 2), without offsets."""
    of_nodes, (steps, samples) = problem.bound_constraints[constraint], rows.T
    times = problem.t0 + problem.dt * (steps + SHARES[samples])
    inner = at_times(problem, of_nodes.source, times)
    zeros = np.zeros((len(times), len(of_nodes.rows)))
    given = of_nodes.source, steps + 1, times, of_nodes.rows, of_nodes.unit, of_nodes.scale
    return BoundBetween(*given, inner, _parts(problem), samples, zeros)


def _on_cubics(problem: OptimalControlProblem, constraint: int, steps: Integers) -> BoundOnCubics:
    """A constraint at the middles of ``steps`` (K,) of the cubics through them."""
    of_nodes = problem.bound_constraints[constraint]
    times = problem.t0 + problem.dt * (steps.astype(np.float64) + _MIDDLE)
    inner = at_times(problem, of_nodes.source, times)
    given = of_nodes.source, steps + 1, times, of_nodes.rows, of_nodes.unit, of_nodes.scale
    return BoundOnCubics(*given, inner, _MIDDLE, cubics(np.array([_MIDDLE]), problem.dt)[0])


def _parts(problem: OptimalControlProblem) -> Parts:
    return Parts(quiet(problem.scene), problem.integrator, problem.dt, _PARTS, problem.linear)


def at_times(problem: OptimalControlProblem, constraint: PlanConstraint, times: Floats) -> BoundConstraint:
    """A constraint on a grid whose nodes after the first are at ``times`` (K,) [s]."""
    scene, grid = problem.scene, np.concatenate([times[:1], times])
    return constraint.bind(Horizon(grid, scene.robot, scene.controls, 1, scene.control_joints, None, problem.linear))


def watched(problem: OptimalControlProblem) -> list[bool]:
    """Which constraints may have rows between nodes: inequalities of states that hold at all nodes after the first."""
    after = np.arange(1, problem.steps + 1)
    return [
        np.array_equal(item.places, after) and not (item.of_controls or item.source.equality)
        for item in problem.bound_constraints
    ]


def middles(problem: OptimalControlProblem) -> Instants:
    """The middles of all steps, for each constraint that may have rows there; none where controls are held.

    Linear controls can alternate, so that a motion keeps to constraints at its nodes and nowhere else.
    """
    of = [i for i, may in enumerate(watched(problem)) if may and problem.linear]
    if not of:
        return NOWHERE
    rows = np.array([(i, step, _PARTS // 2 - 1) for i in of for step in range(problem.steps)])
    entries = problem.steps * sum(len(problem.bound_constraints[i].rows) for i in of)
    return Instants(rows, np.zeros(entries), cubic=True)


def seen(problem: OptimalControlProblem, motion: Trajectory) -> list[Floats | None] | None:
    """The values of each constraint within the steps of a motion (N, instants + 2, rows), with those at the nodes.

    None for constraints on controls, and for those that hold at some nodes only. Rows that the start violates are -inf
    in the first step. None, too, where there is no other constraint, or a step cannot be integrated in parts.
    """
    N, n = motion.steps, problem.scene.robot.dof
    looks = watched(problem)
    parts, u = _parts(problem), problem.control_rows(motion)
    controls = parts.controls(u, np.arange(N))
    parted = parts.states(motion.q[:-1], motion.v[:-1], controls) if any(looks) else None
    if parted is None:
        return None
    q, v = (
        np.concatenate([np.concatenate([x[:-1, None], y], axis=1).reshape(-1, n), x[-1:]])
        for x, y in zip((motion.q, motion.v), parted, strict=True)
    )
    q, v = np.concatenate([q[:1], q]), np.concatenate([v[:1], v])
    times: Floats = problem.t0 + problem.dt / _PARTS * np.arange(N * _PARTS + 1, dtype=np.float64)
    points = _PARTS * np.arange(N)[:, None] + np.arange(_PARTS + 1)
    u = np.zeros((len(times), problem.scene.controls))
    found: list[Floats | None] = [None] * len(looks)
    for i, item in enumerate(problem.bound_constraints):
        if looks[i]:
            c = at_times(problem, item.source, times).value(q, v, u)
            of_steps = c[points]
            of_steps[0][:, c[0] > _OUTSIDE] = -np.inf
            found[i] = of_steps
    return found


def updated(
    problem: OptimalControlProblem,
    instants: Instants,
    motion: Trajectory,
    values: list[Floats | None],
    backoff: list[Floats],
    least: float,
    *,
    wide: bool,
) -> Instants:
    """The instants, with the offsets of a motion, and further ones where it violates a constraint by > ``least``.

    These are where a row is greatest between its neighbours in the step.

    Args:
        problem: The problem, without rows between nodes.
        instants: Those so far.
        motion: The motion.
        values: Its values of :func:`seen`.
        backoff: Margins of all constraints at the nodes (K, rows).
        least: In the unit of each constraint.
        wide: Whether offsets are made larger than they are, so that peaks that slide are within them soon.
    """
    rows, offsets, u = [], [], problem.control_rows(motion)
    former = _offsets(problem, instants)
    for i, (near, margin) in enumerate(zip(values, backoff, strict=True)):
        if near is None:
            continue
        peak, c = _peaks(near)
        beyond: NDArray[np.bool_] = np.asarray((peak & (c + margin[:, None] > least)).any(axis=2))
        beyond[tuple(instants.of(i).T)] = True
        places = np.argwhere(beyond)
        if not len(places):
            continue
        bound = _bound(problem, i, places)
        row, true = bound.value(motion.q, motion.v, u), c[tuple(places.T)]
        # Rows without a value are made to hold.
        offset = np.where(np.isfinite(true), true, -bound.scale) - row
        before = former.get(i)
        if before is not None:
            own = np.isin(_numbers(places), _numbers(instants.of(i)))
            change = offset[own] - before
            offset[own] = before + _followed(change, bound.scale, wide=wide)
        rows.append(np.column_stack([np.full(len(places), i), places]))
        offsets.append(offset.ravel())
    if not rows:
        return NOWHERE
    return Instants(np.concatenate(rows), np.concatenate(offsets))


def beyond(values: list[Floats | None], backoff: list[Floats]) -> Floats:
    """By how much a motion violates each constraint between its nodes, zero where it holds.

    Args:
        values: Values of the motion of :func:`seen`.
        backoff: Margins of all constraints at the nodes (K, rows).
    """
    found = np.zeros(len(values))
    for i, (near, margin) in enumerate(zip(values, backoff, strict=True)):
        if near is not None:
            peak, c = _peaks(near)
            found[i] = np.where(peak, c + margin[:, None], 0.0).max(initial=0.0)
    return found


def _followed(change: Floats, scale: float, *, wide: bool) -> Floats:
    """What offsets take up of their changes between rounds.

    Small changes are halved: else rounds may go to and fro between two motions whose peaks are on either side of an
    instant. Where this takes long, as peaks slide away, ``wide`` offsets only grow, by a multiple of what they lack.
    """
    if wide:
        more: Floats = np.maximum(np.minimum(_AHEAD * change, _SAME * scale), change)
        return np.where(change > 0.0, more, np.minimum(change + _KEPT * scale, 0.0))
    return np.where(np.abs(change) <= _SAME * scale, 0.5, 1.0) * change


def _numbers(rows: Integers) -> Integers:
    """Ascending numbers (K,) of the step and instant of ``rows`` (K, 2)."""
    found: Integers = rows[:, 0] * len(SHARES) + rows[:, 1]
    return found


def _peaks(near: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """Which of the values (N, instants + 2, rows) at instants are greatest beside their neighbours, and their peaks.

    The value of an instant is that at the peak of the parabola through it and its neighbours, if this is between them:
    both instants beside a peak have its value, so that it goes on from one to the other without a jump.
    """
    before, here, after = near[:, :-2], near[:, 1:-1], near[:, 2:]
    peak = (here >= before) & (here >= after) & np.isfinite(here)
    with np.errstate(invalid="ignore", divide="ignore"):
        bent = 2.0 * here - before - after
        inside = (bent > 0.0) & (np.abs(after - before) <= 2.0 * bent)
        above = 0.125 * (after - before) ** 2 / bent
    return peak, np.where(inside, here + above, here)


def carried(
    problem: OptimalControlProblem, old: Instants, new: Instants, parts: list[Floats], least: float = 0.0
) -> list[Floats]:
    """Values (K, rows) of all constraints and their rows at instants ``old``, for those at ``new``.

    Rows that are not in ``old`` have ``least``.
    """
    count = len(problem.bound_constraints)
    found, before = list(parts[:count]), dict(zip(old.constraints, parts[count:], strict=True))
    for i in new.constraints:
        rows = new.of(i)
        values = np.full((len(rows), len(problem.bound_constraints[i].rows)), least)
        if i in before:
            number, numbers = _numbers(old.of(i)), _numbers(rows)
            known = np.isin(numbers, number)
            values[known] = before[i][np.searchsorted(number, numbers[known])]
        found.append(values)
    return found
