"""Constraints of a plan between its nodes: where the motion violates them, and rows that forbid it there.

A row follows a peak of its constraint within a step, from one motion to the next: the value there, and its derivatives
in the state before the step and the controls over it, are those of the motion integrated in a few equal parts, on the
parabola through the ends of parts next to the peak. A controller's ticks have rows on the cubics through the steps
instead, which take hardly any time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats, Integers, Mask
from varpin.control.constraints import BoundBetween, BoundConstraint, BoundOnCubics, Horizon, PlanConstraint
from varpin.control.parts import Parts
from varpin.control.problem import OptimalControlProblem
from varpin.mechanics.scene import quiet
from varpin.signals.commands import cubics
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

# Parts of a step.
_PARTS = 8
# Greatest number of instants of a constraint in a step.
MOST_INSTANTS = _PARTS - 1
# Where the rows of a controller's ticks are.
_MIDDLE = 0.5
# Violation of the start from which on a row cannot hold in the first step.
_OUTSIDE = 1e-6
# How far a row follows its peak from one motion to the next, in steps; farther away there is another row.
_REACH = 1.5 / _PARTS
# How far the parabola of a peak goes on as it slides, in parts of a step; beyond, values are linear.
_SLIDE = 2.0
# Distance of a peak from its bound up to which it gets a row, too, relative to the constraint's scale.
_NEAR = 1e-3
# Marks a row that is not enforced, in the place of its moment.
UNUSED = -1.0


@dataclass(frozen=True, eq=False)
class Instants(Frozen):
    """Instants between nodes at which constraints have rows.

    Attributes:
        rows: Constraint, step and number of the instant in the step (I, 3), each from 0, in ascending order.
        moments: Where all rows of each of them are in a step of unit length (O,), one instant after another; negative
            for rows that are not enforced.
        bends: How sharp their peaks are (O,): minus the second derivative in time, in parts of a step; zero for rows
            that do not follow a peak.
        cubic: Whether rows are on the cubics through the steps, at their middles, not of steps integrated in parts.
    """

    rows: Integers
    moments: Floats
    bends: Floats
    cubic: bool = False

    def __post_init__(self) -> None:
        for array in (self.rows, self.moments, self.bends):
            array.setflags(write=False)

    @property
    def constraints(self) -> list[int]:
        """Indices of the constraints with such rows."""
        return [int(i) for i in np.unique(self.rows[:, 0])]

    def of(self, constraint: int) -> Integers:
        """Step and number (K, 2) of the instants of one constraint."""
        return self.rows[self.rows[:, 0] == constraint, 1:]


NOWHERE = Instants(np.zeros((0, 3), dtype=np.int64), np.zeros(0), np.zeros(0))


def enforced(problem: OptimalControlProblem, instants: Instants) -> OptimalControlProblem:
    """The problem with further bound constraints, one for each constraint with rows at ``instants``."""
    if not len(instants.rows):
        return problem
    made = object.__new__(type(problem))
    found: list[BoundConstraint] = list(problem.bound_constraints)
    for i, (moments, bends) in _of_constraints(problem, instants).items():
        steps = instants.of(i)[:, 0]
        found.append(_on_cubics(problem, i, steps) if instants.cubic else _bound(problem, i, steps, moments, bends))
    # The dataclass is frozen: attributes are set in its dictionary.
    vars(made).update(vars(problem) | {"bound_constraints": tuple(found)})
    return made


def in_force(problem: OptimalControlProblem, instants: Instants) -> list[Mask]:
    """Which rows at ``instants`` are enforced (K, rows), for each constraint with such rows."""
    return [moments >= 0.0 for moments, _ in _of_constraints(problem, instants).values()]


def _of_constraints(problem: OptimalControlProblem, instants: Instants) -> dict[int, tuple[Floats, Floats]]:
    """The moments and bends, each (K, rows), of each constraint with rows at ``instants``."""
    found, begin = {}, 0
    for i in instants.constraints:
        shape = len(instants.of(i)), len(problem.bound_constraints[i].rows)
        own = slice(begin, begin + shape[0] * shape[1])
        found[i], begin = (instants.moments[own].reshape(shape), instants.bends[own].reshape(shape)), own.stop
    return found


def _bound(
    problem: OptimalControlProblem, constraint: int, steps: Integers, moments: Floats, bends: Floats
) -> BoundBetween:
    """A constraint at the ``moments`` (K, rows) of ``steps`` (K,), several of which may be the same."""
    of_nodes = problem.bound_constraints[constraint]
    own, index = np.unique(steps, return_inverse=True)
    used = moments >= 0.0
    mean = np.where(used, moments, 0.0).sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    times = problem.t0 + problem.dt * (steps + mean)
    share = _PARTS * moments
    middle = np.clip(np.rint(share), 1, _PARTS - 1)
    weights, rates = _on_parabolas(middle, share - middle, used)
    # The states at which any row of a step needs the constraint.
    needed = np.zeros((len(own), _PARTS + 1), dtype=bool)
    np.logical_or.at(needed, index, weights.any(axis=1))
    samples = np.argwhere(needed)
    number = np.zeros(needed.shape, dtype=np.int64)
    number[needed] = np.arange(len(samples))
    inner = at_times(problem, of_nodes.source, _times(problem, own[samples[:, 0]], samples[:, 1]))
    given = of_nodes.source, steps + 1, times, of_nodes.rows, of_nodes.unit, of_nodes.scale
    parts = _parts(problem)
    return BoundBetween(*given, of_nodes, parts, own, samples, inner, number[index], weights, rates, bends, _SLIDE)


def _on_parabolas(middle: Floats, x: Floats, used: Mask) -> tuple[Floats, Floats]:
    """Weights (K, rows, parts + 1) of the ends of parts in values on parabolas, and in their derivatives in x.

    The parabolas go through the ends next to ``middle`` ones, from which ``x`` is counted in parts, each (K, rows).
    """
    found = np.zeros((2, *x.shape, _PARTS + 1))
    values = 0.5 * x * (x - 1.0), 1.0 - x * x, 0.5 * x * (x + 1.0)
    for into, weights in zip(found, (values, (x - 0.5, -2.0 * x, x + 0.5)), strict=True):
        for k, weight in enumerate(weights):
            place = (middle + k - 1).astype(np.int64)
            np.put_along_axis(into, place[:, :, None], np.where(used, weight, 0.0)[:, :, None], axis=2)
    return found[0], found[1]


def _times(problem: OptimalControlProblem, steps: Integers, samples: Integers) -> Floats:
    """Times [s] of ends of parts of steps."""
    found: Floats = problem.t0 + problem.dt * (steps + samples / _PARTS)
    return found


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
    rows = np.array([(i, step, 0) for i in of for step in range(problem.steps)])
    entries = problem.steps * sum(len(problem.bound_constraints[i].rows) for i in of)
    return Instants(rows, np.full(entries, _MIDDLE), np.zeros(entries), cubic=True)


def seen(problem: OptimalControlProblem, motion: Trajectory) -> list[Floats | None] | None:
    """The values of each constraint at the ends of the parts of a motion's steps (N, parts + 1, rows).

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
    q, v = (np.concatenate([x[0, :1], x.reshape(-1, n)]) for x in parted)
    steps, samples = np.divmod(np.arange(N * (_PARTS + 1)), _PARTS + 1)
    times = _times(problem, steps, samples)
    u = np.zeros((len(q), problem.scene.controls))
    found: list[Floats | None] = [None] * len(looks)
    for i, item in enumerate(problem.bound_constraints):
        if looks[i]:
            c = at_times(problem, item.source, times).value(q, v, u).reshape(N, _PARTS + 1, -1)
            c[0][:, c[0, 0] > _OUTSIDE] = -np.inf
            found[i] = c
    return found


def updated(
    problem: OptimalControlProblem,
    instants: Instants,
    values: list[Floats | None],
    backoff: list[Floats],
    *,
    anew: bool = True,
) -> Instants:
    """The instants at the peaks of a motion, and further ones where a constraint is violated or close to its bound.

    Args:
        problem: The problem, without rows between nodes.
        instants: Those so far.
        values: Values of the motion of :func:`seen`.
        backoff: Margins of all constraints at the nodes (K, rows).
        anew: Whether there may be further ones.
    """
    rows, moments, bends = [], [], []
    former = _of_constraints(problem, instants)
    for i, (near, margin) in enumerate(zip(values, backoff, strict=True)):
        if near is None:
            continue
        peaks = _peaks(near)
        close = -_NEAR * problem.bound_constraints[i].scale
        wanted = peaks.there & (peaks.values + margin[:, None] > close) & anew
        known = instants.of(i)
        old = former[i][0] if i in former else np.zeros((0, near.shape[2]))
        for step in np.union1d(np.flatnonzero(wanted.any(axis=(1, 2))), known[:, 0]):
            of_step = _Peaks(*(array[step] for array in peaks))
            new = _followed(old[known[:, 0] == step], of_step, wanted[step])
            rows += [(i, int(step), number) for number in range(len(new[0]))]
            moments.append(new[0].ravel())
            bends.append(new[1].ravel())
    if not rows:
        return NOWHERE
    return Instants(np.array(rows), np.concatenate(moments), np.concatenate(bends))


def _followed(moments: Floats, peaks: _Peaks, wanted: Mask) -> tuple[Floats, Floats]:
    """The moments and bends (S, rows) of one step's instants, of which the first were at ``moments`` (s, rows).

    Each row of an instant follows the nearest peak within reach. Peaks that are ``wanted`` (parts - 1, rows) and not
    followed get the first instants whose row is not enforced.
    """
    found = [*np.stack([moments, np.zeros(moments.shape)], axis=2)]
    for row in np.flatnonzero(wanted.any(axis=0) | (moments >= 0.0).any(axis=0)):
        places, sharp, left = peaks.places[:, row], peaks.bends[:, row], [*np.flatnonzero(peaks.there[:, row])]
        used = [own[row] for own in found if own[row, 0] >= 0.0]
        pairs = sorted((abs(places[k] - own[0]), s, k) for s, own in enumerate(used) for k in left)
        moved: set[int] = set()
        for distance, s, k in pairs:
            if distance <= _REACH and s not in moved and k in left:
                used[s][:] = places[k], sharp[k]
                moved.add(s)
                left.remove(k)
        for k in sorted((k for k in left if wanted[k, row]), key=lambda k: -float(peaks.values[k, row])):
            free = next((own for own in found if own[row, 0] < 0.0), None)
            if free is None and len(found) < MOST_INSTANTS:
                free = np.tile([UNUSED, 0.0], (wanted.shape[1], 1))
                found.append(free)
            if free is not None:
                free[row] = places[k], sharp[k]
    made = np.array(found)
    return made[:, :, 0], made[:, :, 1]


def beyond(values: list[Floats | None], backoff: list[Floats]) -> Floats:
    """By how much a motion violates each constraint between its nodes, zero where it holds.

    Args:
        values: Values of the motion of :func:`seen`.
        backoff: Margins of all constraints at the nodes (K, rows).
    """
    found = np.zeros(len(values))
    for i, (near, margin) in enumerate(zip(values, backoff, strict=True)):
        if near is not None:
            peaks = _peaks(near)
            found[i] = np.where(peaks.there, peaks.values + margin[:, None], 0.0).max(initial=0.0)
    return found


class _Peaks(NamedTuple):
    """Peaks within steps, each of the parabola through the ends of two successive parts."""

    places: Floats  # (N, parts - 1, rows) in a step of unit length
    values: Floats
    bends: Floats  # minus the second derivative, in parts of a step
    there: Mask  # which of the parabolas have one within the step, no closer to another's middle


def _peaks(near: Floats) -> _Peaks:
    """The peaks of values (N, parts + 1, rows) at the ends of parts."""
    before, here, after = near[:, :-2], near[:, 1:-1], near[:, 2:]
    # The first and the last one go on to the end of the step.
    reach = np.full((2, _PARTS - 1, 1), 0.5)
    reach[0, 0] = reach[1, -1] = 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        bends = 2.0 * here - before - after
        x = 0.5 * (after - before) / bends
        there = np.isfinite(here) & (bends > 0.0) & (-reach[0] <= x) & (x < reach[1])
        x, bends = np.where(there, x, 0.0), np.where(there, bends, 0.0)
        values = np.where(there, here + 0.25 * x * (after - before), here)
    places = (np.arange(1, _PARTS)[:, None] + x) / _PARTS
    return _Peaks(places, values, bends, there)


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


def _numbers(rows: Integers) -> Integers:
    """Ascending numbers (K,) of the step and number of instants (K, 2)."""
    found: Integers = rows[:, 0] * MOST_INSTANTS + rows[:, 1]
    return found
