"""Constraints of a plan between its nodes: where the motion violates them, and rows that forbid it there.

Rows are added at the peaks of a motion within its steps, and stay (exchange, as of semi-infinite programs): the value
there, and its derivatives in the state before the step and the controls over it, are those of the motion integrated in
a few equal parts, on the parabola through the ends of parts next to the instant. A controller's ticks have rows on the
cubics through the steps instead, which take hardly any time.
"""

from __future__ import annotations

from dataclasses import dataclass

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
# Where the rows of a controller's ticks are.
_MIDDLE = 0.5
# Violation of the start from which on a row cannot hold in the first step.
_OUTSIDE = 1e-6
# Distance in steps within which an instant is that of a peak: what it misses of it is of second order.
_SAME = 1e-3
# Distance of a peak from its bound up to which it gets a row, too, relative to the constraint's scale.
_NEAR = 1e-3
# Violation between nodes from which rows are added: where the problem asks for them, and in tenths of a constraint's
# range with linear controls, which lead around nodes.
_BETWEEN, _SHARE = 1e-6, 1e-3
# Marks a row that is not enforced, in the place of its moment.
_UNUSED = -1.0


@dataclass(frozen=True, eq=False)
class Instants(Frozen):
    """Instants between nodes at which constraints have rows.

    Attributes:
        rows: Constraint, step and number of the instant in the step (I, 3), each from 0, in ascending order.
        moments: Where all rows of each of them are in a step of unit length (O,), one instant after another; negative
            for rows that are not enforced.
        cubic: Whether rows are on the cubics through the steps, at their middles, not of steps integrated in parts.
    """

    rows: Integers
    moments: Floats
    cubic: bool = False

    def __post_init__(self) -> None:
        for array in (self.rows, self.moments):
            array.setflags(write=False)

    @property
    def constraints(self) -> list[int]:
        """Indices of the constraints with such rows."""
        return [int(i) for i in np.unique(self.rows[:, 0])]

    def of(self, constraint: int) -> Integers:
        """Step and number (K, 2) of the instants of one constraint."""
        return self.rows[self.rows[:, 0] == constraint, 1:]


NOWHERE = Instants(np.zeros((0, 3), dtype=np.int64), np.zeros(0))


def enforced(problem: OptimalControlProblem, instants: Instants) -> OptimalControlProblem:
    """The problem with further bound constraints, one for each constraint with rows at ``instants``."""
    if not len(instants.rows):
        return problem
    made = object.__new__(type(problem))
    found: list[BoundConstraint] = list(problem.bound_constraints)
    for i, moments in _of_constraints(problem, instants).items():
        steps = instants.of(i)[:, 0]
        found.append(_on_cubics(problem, i, steps) if instants.cubic else _bound(problem, i, steps, moments))
    # The dataclass is frozen: attributes are set in its dictionary.
    vars(made).update(vars(problem) | {"bound_constraints": tuple(found)})
    return made


def _of_constraints(problem: OptimalControlProblem, instants: Instants) -> dict[int, Floats]:
    """The moments (K, rows) of each constraint with rows at ``instants``."""
    found, begin = {}, 0
    for i in instants.constraints:
        shape = len(instants.of(i)), len(problem.bound_constraints[i].rows)
        own = slice(begin, begin + shape[0] * shape[1])
        found[i], begin = instants.moments[own].reshape(shape), own.stop
    return found


def _bound(problem: OptimalControlProblem, constraint: int, steps: Integers, moments: Floats) -> BoundBetween:
    """A constraint at the ``moments`` (K, rows) of ``steps`` (K,), several of which may be the same."""
    of_nodes = problem.bound_constraints[constraint]
    own, index = np.unique(steps, return_inverse=True)
    used = moments >= 0.0
    mean = np.where(used, moments, 0.0).sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    times = problem.t0 + problem.dt * (steps + mean)
    share = _PARTS * moments
    middle = np.clip(np.rint(share), 1, _PARTS - 1)
    weights = _on_parabolas(middle, share - middle, used)
    # The states at which any row of a step needs the constraint.
    needed = np.zeros((len(own), _PARTS + 1), dtype=bool)
    np.logical_or.at(needed, index, weights.any(axis=1))
    samples = np.argwhere(needed)
    number = np.zeros(needed.shape, dtype=np.int64)
    number[needed] = np.arange(len(samples))
    inner = at_times(problem, of_nodes.source, _times(problem, own[samples[:, 0]], samples[:, 1]))
    given = of_nodes.source, steps + 1, times, of_nodes.rows, of_nodes.unit, of_nodes.scale
    return BoundBetween(*given, of_nodes, _parts(problem), own, samples, inner, number[index], weights)


def _on_parabolas(middle: Floats, x: Floats, used: Mask) -> Floats:
    """Weights (K, rows, parts + 1) of the ends of parts in values on parabolas.

    The parabolas go through the ends next to ``middle`` ones, from which ``x`` is counted in parts, each (K, rows).
    """
    found = np.zeros((*x.shape, _PARTS + 1))
    for k, weight in enumerate((0.5 * x * (x - 1.0), 1.0 - x * x, 0.5 * x * (x + 1.0))):
        place = (middle + k - 1).astype(np.int64)
        np.put_along_axis(found, place[:, :, None], np.where(used, weight, 0.0)[:, :, None], axis=2)
    return found


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
    """The middles of all steps, for each constraint that has rows between nodes.

    Linear controls can alternate, so that a motion keeps to constraints at its nodes and nowhere else.
    """
    of = [i for i, may in enumerate(watched(problem)) if may and (problem.linear or problem.between_nodes)]
    if not of:
        return NOWHERE
    rows = np.array([(i, step, 0) for i in of for step in range(problem.steps)])
    entries = problem.steps * sum(len(problem.bound_constraints[i].rows) for i in of)
    return Instants(rows, np.full(entries, _MIDDLE), cubic=True)


def followed(problem: OptimalControlProblem, instants: Instants, motion: Trajectory, backoff: list[Floats]) -> Instants:
    """The instants, and those at peaks of a motion that violates constraints between its nodes; itself if none does.

    ``backoff`` are the margins (K, rows) of all constraints at the nodes.
    """
    if not any(watched(problem)) or not (problem.linear or problem.between_nodes):
        return instants
    rows, moments, violated = [], [], False
    former = _of_constraints(problem, instants)
    for i, near in _seen(problem, motion).items():
        scale, (places, values, there) = problem.bound_constraints[i].scale, _peaks(near)
        beyond = np.where(there, values + backoff[i][:, None], -np.inf)
        violated |= bool((beyond > (_BETWEEN if problem.between_nodes else _SHARE * scale)).any())
        wanted = beyond > -_NEAR * scale
        known = instants.of(i)[:, 0]
        old = former.get(i, np.zeros((0, near.shape[2])))
        for step in np.union1d(np.flatnonzero(wanted.any(axis=(1, 2))), known):
            new = _with_places(old[known == step], np.where(wanted[step], places[step], _UNUSED))
            rows += [(i, int(step), number) for number in range(len(new))]
            moments.append(new.ravel())
    if not violated:
        return instants
    made = Instants(np.array(rows), np.concatenate(moments))
    same = np.array_equal(made.rows, instants.rows) and np.array_equal(made.moments, instants.moments)
    return instants if same else made


def _seen(problem: OptimalControlProblem, motion: Trajectory) -> dict[int, Floats]:
    """The values (N, parts + 1, rows) of watched constraints at the ends of the parts of a motion's steps.

    Rows that the start violates are -inf in the first step. Empty where a step cannot be integrated in parts.
    """
    N, n = motion.steps, problem.scene.robot.dof
    parts = _parts(problem)
    controls = parts.controls(problem.control_rows(motion), np.arange(N))
    parted = parts.states(motion.q[:-1], motion.v[:-1], controls)
    if parted is None:
        return {}
    q, v = (np.concatenate([x[0, :1], x.reshape(-1, n)]) for x in parted)
    times = _times(problem, *np.divmod(np.arange(N * (_PARTS + 1)), _PARTS + 1))
    u, found = np.zeros((len(q), problem.scene.controls)), {}
    for i, (item, looks) in enumerate(zip(problem.bound_constraints, watched(problem), strict=True)):
        if looks:
            found[i] = at_times(problem, item.source, times).value(q, v, u).reshape(N, _PARTS + 1, -1)
            found[i][0][:, found[i][0, 0] > _OUTSIDE] = -np.inf
    return found


def _with_places(moments: Floats, places: Floats) -> Floats:
    """The moments (s, rows) of one step's instants, and new ones at places (parts - 1, rows), negative for none.

    Known ones stay: the search could go on for ever between some that moved.
    """
    found = [*moments.copy()]
    for row, wanted in enumerate(places.T):
        for place in wanted[wanted >= 0.0]:
            if any(own[row] >= 0.0 and abs(own[row] - place) <= _SAME for own in found):
                continue
            own = next((own for own in found if own[row] < 0.0), None)
            if own is None and len(found) < _PARTS - 1:
                own = np.full(places.shape[1], _UNUSED)
                found.append(own)
            if own is not None:
                own[row] = place
    return np.array(found)


def _peaks(near: Floats) -> tuple[Floats, Floats, Mask]:
    """The peaks of values (N, parts + 1, rows) at the ends of parts: places (N, parts - 1, rows), values, and which.

    Each is of the parabola through the ends of two successive parts, and there if no closer to another's middle.
    """
    before, here, after = near[:, :-2], near[:, 1:-1], near[:, 2:]
    # The first and the last one go on to the end of the step.
    reach = np.full((2, _PARTS - 1, 1), 0.5)
    reach[0, 0] = reach[1, -1] = 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        bends = 2.0 * here - before - after
        x = 0.5 * (after - before) / bends
        there = np.isfinite(here) & (bends > 0.0) & (-reach[0] <= x) & (x < reach[1])
        x = np.where(there, x, 0.0)
        values = np.where(there, here + 0.25 * x * (after - before), here)
    places = (np.arange(1, _PARTS)[:, None] + x) / _PARTS
    return places, values, there
