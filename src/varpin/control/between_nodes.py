"""Constraints of a plan between its nodes: where the motion violates them, and rows that forbid it there.

Rows are added at the peaks of a motion within its steps, and stay (exchange, as of semi-infinite programs). Values are
those of the motion integrated in parts of its steps, on parabolas through their ends, and derivatives are differences
of these. A controller's ticks have rows on the cubics through the nodes instead, which take hardly any time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from varpin.arrays import Floats, Integers, Mask
from varpin.control.constraints import BoundConstraint
from varpin.control.problem import OptimalControlProblem
from varpin.control.sizes import FEASIBLE, SLIGHT
from varpin.errors import LinearizationError
from varpin.io.archive import Axes
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.scene import quiet
from varpin.signals.commands import cubics, open_loop
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

# Parts of a step in which motions are looked at; from 4 to 16.
PARTS = 8
# Differences of states and controls; from 1e-7 to 1e-5.
_SHIFT = 1e-6


@dataclass(frozen=True, eq=False)
class BoundBetween(BoundConstraint):
    """A constraint at instants within steps.

    The places are the nodes at the ends of the steps; several instants may be in one step.

    Attributes:
        problem: The problem.
        moments: The instants in a step of unit length (K,).
        of: The constraint at the instants, by :meth:`OptimalControlProblem.bound_at`.
        ends: The same at the ends of parts of the K steps; None where values are on cubics.
    """

    problem: OptimalControlProblem
    moments: Floats
    of: BoundConstraint
    ends: BoundConstraint | None

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundConstraint.value`; for one motion. Infinite where a step fails in parts."""
        if self.ends is None:
            return self.of.of_states(*self._states(q, v), u.shape[-1])
        found: Floats = self._in_parts(_given(self.problem, q, v, u, self.places - 1)[None])[0]
        return found

    def _in_parts(self, given: Floats) -> Floats:
        """Values (S, K, rows) for states before the steps and their controls (S, K, 2n + c); infinite if one fails."""
        assert self.ends is not None
        (_, first, index), S = np.unique(self.places, return_index=True, return_inverse=True), len(given)
        parts = _in_parts(self.problem, given[:, first].reshape(-1, given.shape[2]))
        if parts is None:
            return np.full((S, *self.shape), np.inf)
        steps = (x.reshape(S, len(first), *x.shape[1:])[:, index] for x in parts)
        q, v = (x.reshape(S, -1, x.shape[3]) for x in steps)
        found = self.ends.of_states(q, v, self.problem.scene.controls)
        return _on_parabolas(found.reshape(S, len(self.places), -1, len(self.rows)), self.moments)

    def slopes(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """Derivatives (K, rows, 2n + c) in the states where the steps begin and in their controls, by differences.

        Raises:
            LinearizationError: A step fails in parts.
        """
        given = _given(self.problem, q, v, u, self.places - 1)
        shifts = _SHIFT * np.eye(given.shape[1] + 1, given.shape[1], -1)
        values = self._in_parts(given + shifts[:, None])
        if not np.isfinite(values).all():
            raise LinearizationError(0, 0.0, "a step fails in parts")
        found: Floats = np.moveaxis(values[1:] - values[0], 0, 2) / _SHIFT
        return found

    @property
    def _coefficients(self) -> Floats:
        """Those of (q0, v0, q1, v1) for q and for v on the cubics (K, 2, 4)."""
        return cubics(self.moments, self.problem.dt).reshape(-1, 2, 4)

    def _states(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """The q and v (K, n) on the cubics of a motion."""
        nodes = np.array([x[self.places - back] for back in (1, 0) for x in (q, v)])
        on_q, on_v = np.einsum("kij,jkn->ikn", self._coefficients, nodes)
        return np.ascontiguousarray(on_q), np.ascontiguousarray(on_v)

    def jacobian(self, q: Floats, v: Floats) -> Floats:
        """dc/d(q, v) (K, rows, 2n), in the states on the cubics."""
        return self.of.jacobian(*self._states(q, v))

    def by_nodes(self, of_state: Floats) -> list[Floats]:
        """Derivatives (K, rows, 2n) in (q, v) at the nodes before and after, of those ``of_state`` on the cubics."""
        blocks = np.array(np.split(of_state, 2, axis=2))
        found = np.einsum("kij,ikrn->kjrn", self._coefficients, blocks)
        return [np.concatenate([found[:, j], found[:, j + 1]], axis=2) for j in (0, 2)]


@dataclass(frozen=True, eq=False)
class Instants(Frozen):
    """Instants between nodes at which constraints have rows.

    Attributes:
        rows: Constraint and step of the instants (I, 2), in ascending order.
        moments: Where they are in a step of unit length (I,).
        cubic: Whether values are on cubics, not of steps integrated in parts.
    """

    rows: Annotated[Integers, Axes("instants", 2)]
    moments: Annotated[Floats, Axes("instants", finite=True)]
    cubic: bool = False

    def __post_init__(self) -> None:
        for array in (self.rows, self.moments):
            array.setflags(write=False)

    @property
    def constraints(self) -> list[int]:
        """Indices of the constraints with such rows."""
        return [int(i) for i in np.unique(self.rows[:, 0])]

    def of(self, constraint: int) -> tuple[Integers, Floats]:
        """The steps and moments (K,) of the instants of one constraint."""
        own = self.rows[:, 0] == constraint
        return self.rows[own, 1], self.moments[own]


NOWHERE = Instants(np.zeros((0, 2), dtype=np.int64), np.zeros(0))


def enforced(problem: OptimalControlProblem, instants: Instants) -> OptimalControlProblem:
    """The problem with further bound constraints, one for each constraint with rows at ``instants``."""
    if not len(instants.rows):
        return problem
    found = list(problem.bound_constraints)
    for i in instants.constraints:
        item, steps, moments = problem.bound_constraints[i], *instants.of(i)
        times = problem.t0 + problem.dt * (steps + moments)
        ends = None if instants.cubic else problem.bound_at(i, _times(problem, steps))
        given = item.source, steps + 1, times, item.rows, item.unit, item.scale
        found.append(BoundBetween(*given, problem, moments, problem.bound_at(i, times), ends))
    return problem.changed(bound_constraints=tuple(found))


def _times(problem: OptimalControlProblem, steps: Integers) -> Floats:
    """Times [s] of all ends of parts of steps."""
    found: Floats = problem.t0 + problem.dt * (steps[:, None] + np.arange(PARTS + 1) / PARTS).ravel()
    return found


def watched(problem: OptimalControlProblem) -> list[int]:
    """Indices of the constraints that are to hold between nodes."""
    return problem.throughout if problem.linear or problem.between_nodes else []


def middles(problem: OptimalControlProblem) -> Instants:
    """The middles of all steps, for each constraint that has rows between nodes.

    Linear controls can alternate, so that a motion keeps to constraints at its nodes and nowhere else.
    """
    rows = [(i, step) for i in watched(problem) for step in range(problem.steps)]
    return Instants(np.array(rows), np.full(len(rows), 0.5), cubic=True) if rows else NOWHERE


def followed(problem: OptimalControlProblem, instants: Instants, motion: Trajectory, backoff: list[Floats]) -> Instants:
    """The instants, and those at peaks of a motion that violates constraints between its nodes; itself if none does.

    ``backoff`` are the margins (K, rows) of all constraints at the nodes.
    """
    found, violated = list[tuple[int, int, float]](), False
    for i, near in _seen(problem, motion).items():
        scale, (places, values, there) = problem.bound_constraints[i].scale, _peaks(near)
        beyond = np.where(there, values + backoff[i][:, None], -np.inf)
        violated |= bool((beyond > (FEASIBLE if problem.between_nodes else SLIGHT * scale)).any())
        # Known ones stay where they are: the search could go on for ever between some that moved.
        own = [(i, step, moment) for step, moment in zip(*(part.tolist() for part in instants.of(i)), strict=True)]
        for step, part, row in np.argwhere(beyond > -SLIGHT * scale):
            at = float(places[step, part, row])
            if not any(other == step and abs(at - moment) <= SLIGHT for _, other, moment in own):
                own.append((i, int(step), at))
        found += sorted(own)
    if not violated or len(found) == len(instants.rows):
        return instants
    return Instants(np.array([item[:2] for item in found]), np.array([item[2] for item in found]))


def _given(problem: OptimalControlProblem, q: Floats, v: Floats, u: Floats, steps: Integers) -> Floats:
    """The states before K steps and their controls (K, 2n + c), c = 2m at both ends where they are linear, else m."""
    ends = [u[steps], u[steps + 1]] if problem.linear else [u[steps]]
    return np.concatenate([q[steps], v[steps], *ends], axis=1)


def _in_parts(problem: OptimalControlProblem, given: Floats) -> tuple[Floats, Floats] | None:
    """The q and v (K, parts + 1, n) at the ends of the parts of K steps, without noise; None if one fails.

    ``given`` (K, 2n + c) are the states before the steps and their controls.
    """
    n, m = problem.scene.robot.dof, problem.scene.controls
    q, v, u = (part.copy() for part in np.split(given, [n, 2 * n], axis=1))
    commands = open_loop(u[:, -m:])._replace(hold=PARTS, own=1)
    if problem.linear:
        times = np.array(problem.integrator.stage_times or (0.5,))
        commands = commands._replace(before=u[:, :m].copy(), stage_times=times)
    try:
        found = problem.integrator.motions(quiet(problem.scene), q, v, commands, problem.dt / PARTS)
    except CustomForceError:
        return None
    if found is None:
        return None
    within_q, within_v = (np.concatenate([x[:, None], inner], axis=1) for x, inner in zip((q, v), found, strict=True))
    return within_q, within_v


def _seen(problem: OptimalControlProblem, motion: Trajectory) -> dict[int, Floats]:
    """The values (N, parts + 1, rows) of watched constraints at the ends of the parts of a motion's steps.

    Minus infinity in the first step where the start violates the constraint. Empty where a step fails in parts.
    """
    steps, found = np.arange(motion.steps), dict[int, Floats]()
    given = _given(problem, motion.q, motion.v, problem.control_rows(motion), steps)
    parts = _in_parts(problem, given) if watched(problem) else None
    if parts is None:
        return found
    q, v = (x.reshape(-1, x.shape[2]) for x in parts)
    for i in watched(problem):
        values = problem.bound_at(i, _times(problem, steps)).of_states(q, v, problem.scene.controls)
        found[i] = values.reshape(len(steps), PARTS + 1, -1)
        if (found[i][0, 0] > FEASIBLE).any():
            found[i][0] = -np.inf
    return found


def _on_parabolas(near: Floats, moments: Floats) -> Floats:
    """Values (S, K, rows) at moments (K,) of steps from those at the ends of their parts (S, K, parts + 1, rows)."""
    middle = np.clip(np.rint(PARTS * moments), 1, PARTS - 1).astype(np.int64)
    before, here, after = (near[:, np.arange(len(moments)), middle + k] for k in (-1, 0, 1))
    x = (PARTS * moments - middle)[:, None]
    found: Floats = here + 0.5 * x * (after - before) + 0.5 * x**2 * (after - 2.0 * here + before)
    return found


def _peaks(near: Floats) -> tuple[Floats, Floats, Mask]:
    """The peaks of values (N, parts + 1, rows) at the ends of parts: places (N, parts - 1, rows), values, and which.

    Each is of the parabola through the ends of two successive parts, and there if no closer to another's middle.
    """
    before, here, after = near[:, :-2], near[:, 1:-1], near[:, 2:]
    # The first and the last one go on to the end of the step.
    reach = np.full((2, PARTS - 1, 1), 0.5)
    reach[0, 0] = reach[1, -1] = 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        bends = 2.0 * here - before - after
        x = 0.5 * (after - before) / bends
        there = np.isfinite(here) & (bends > 0.0) & (-reach[0] <= x) & (x < reach[1])
        x = np.where(there, x, 0.0)
        values = np.where(there, here + 0.25 * x * (after - before), here)
    return (np.arange(1, PARTS)[:, None] + x) / PARTS, values, there
