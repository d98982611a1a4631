"""Constraints of a plan between its nodes: where the motion violates them, and rows that forbid it there.

Rows are added at the peaks of a motion within its steps, and stay (exchange, as of semi-infinite programs): the value
there, and its derivatives in the state before the step and the controls over it, are those of the motion integrated in
a few equal parts, on the parabola through the ends of parts next to the instant. A controller's ticks have rows on the
cubics through the steps instead, which take hardly any time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from varpin.arrays import Floats, Integers, Mask
from varpin.control.constraints import BoundConstraint, Horizon, PlanConstraint
from varpin.control.problem import OptimalControlProblem
from varpin.core.arrays import Commands
from varpin.errors import LinearizationError
from varpin.integrators import Integrator
from varpin.integrators.base import Segment
from varpin.io.archive import Axes
from varpin.linearization import linearize_steps, velocity_at_nodes
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.scene import Scene, quiet
from varpin.signals.commands import Lines, cubics, on_lines, open_loop
from varpin.simulation.record import trajectory_of
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory, joined

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
# Differences of states and controls, where the derivatives of a step's parts do not follow from each other.
_SHIFT = 1e-5


@dataclass(frozen=True, eq=False)
class Parts(Frozen):
    """Steps of a scene without noise, each integrated in equal parts from the node at its begin.

    Controls are (m,) of a step, or where they are linear those at its begin and its end (2m,).
    """

    scene: Scene
    integrator: Integrator
    dt: float  # of a part [s]
    linear: bool

    @classmethod
    def of(cls, problem: OptimalControlProblem) -> Parts:
        """Those of a problem's steps."""
        return cls(quiet(problem.scene), problem.integrator, problem.dt / _PARTS, problem.linear)

    def controls(self, u: Floats, steps: Integers) -> Floats:
        """Controls (K, m), or (K, 2m), of steps, from those of all steps (N, m), or of all nodes (N + 1, m)."""
        return np.concatenate([u[steps], u[steps + 1]], axis=1) if self.linear else u[steps]

    def states(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats] | None:
        """The q and v (K, parts + 1, n) at the ends of the parts of K steps from q and v (K, n); None if one fails."""
        try:
            found = self.integrator.motions(self.scene, q.copy(), v.copy(), self._commands(u), self.dt)
        except CustomForceError:
            return None
        if found is None:
            return None
        return np.concatenate([q[:, None], found[0]], axis=1), np.concatenate([v[:, None], found[1]], axis=1)

    def _commands(self, u: Floats) -> Commands:
        """The controls of steps as one decision of each of K motions."""
        m = self.scene.controls
        found = open_loop(u[:, -m:])._replace(hold=_PARTS, own=1)
        if not self.linear:
            return found
        times = np.array(self.integrator.stage_times or (0.5,))
        return found._replace(before=np.ascontiguousarray(u[:, :m]), stage_times=times)

    def slopes(self, q: Floats, v: Floats, u: Floats) -> tuple[tuple[Floats, Floats], Floats]:
        """The states as :meth:`states`, and their derivatives (K, parts + 1, 2n, 2n + c) in (q, v, controls).

        Raises:
            LinearizationError: A part fails, or has no derivative.
        """
        if self.scene.inputs:
            return self._states(q, v, u), self._by_differences(q, v, u)
        motion, states = self._one_after_another(q, v, u)
        return states, self._chained(motion, states, u)

    def _states(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats]:
        found = self.states(q, v, u)
        if found is None:
            raise LinearizationError(0, 0.0, "a step fails in parts")
        return found

    def _chained(self, motion: Trajectory, states: tuple[Floats, Floats], u: Floats) -> Floats:
        """The derivatives in each step of :meth:`_one_after_another`, those of its parts one after another."""
        scene, n, K = self.scene, self.scene.robot.dof, len(u)
        lin = linearize_steps(scene, motion, self.integrator, motion.q[0], ramps=self.linear)
        A, B = (array.reshape(K, _PARTS, *array.shape[1:]) for array in (lin.A, lin.B))
        ramp = None if lin.ramp is None else lin.ramp.reshape(B.shape)
        slopes = np.tile(np.eye(2 * n), (K, _PARTS + 1, 1, 1))
        if self.integrator.variational:
            at = velocity_at_nodes(scene, *(x.reshape(-1, n) for x in states))
            slopes[:, :, n:] = at.reshape(K, _PARTS + 1, n, 2 * n)
        found = np.empty((K, _PARTS + 1, 2 * n, 2 * n + u.shape[1]))
        # In (x, controls).
        after = np.tile(np.eye(2 * n, found.shape[3]), (K, 1, 1))
        found[:, 0] = after
        after[:, :, : 2 * n] = np.linalg.inv(slopes[:, 0])
        for j in range(_PARTS):
            after = A[:, j] @ after
            if ramp is None:
                after[:, :, 2 * n :] += B[:, j]
            else:
                share, m = j / _PARTS, scene.controls
                rise = ramp[:, j] / _PARTS
                after[:, :, 2 * n : 2 * n + m] += (1.0 - share) * B[:, j] - rise
                after[:, :, 2 * n + m :] += share * B[:, j] + rise
            found[:, j + 1] = slopes[:, j + 1] @ after
        return found

    def _by_differences(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The derivatives by central differences: joints of kinematic inputs are on their way over a step."""
        z, n = np.concatenate([q, v, u], axis=1), self.scene.robot.dof
        K, Z = z.shape
        shifts = _SHIFT * np.concatenate([np.eye(Z), -np.eye(Z)])
        near = (z[:, None] + shifts).reshape(-1, Z)
        states = np.concatenate(self._states(near[:, :n], near[:, n : 2 * n], near[:, 2 * n :]), axis=2)
        after, before = states.reshape(K, 2, Z, _PARTS + 1, 2 * n).swapaxes(0, 1)
        found: Floats = np.moveaxis((after - before) / (2.0 * _SHIFT), 1, -1)
        return found

    def _one_after_another(self, q: Floats, v: Floats, u: Floats) -> tuple[Trajectory, tuple[Floats, Floats]]:
        """The parts of K steps as one motion, for its linearization, and their states (K, parts + 1, n).

        In the place of each step's end is the begin of the next one: the linearization takes every step again from the
        node at its begin; that at its end is a first guess only.
        """
        scene, integrator, dt, no_noise = self.scene, self.integrator, self.dt, self.scene.silence
        state, first = integrator.start(scene, q.copy(), v.copy())
        try:
            segments = integrator.rollout_compiled(scene, state, self._commands(u), no_noise, scene.no_drift, dt)
        except CustomForceError as error:
            raise LinearizationError(0, 0.0, str(error)) from error
        for segment in segments:
            if segment.failure is not None:
                raise LinearizationError(len(segment.q), dt * len(segment.q), "a step fails in parts")
        ends: dict[str, Floats] = {}
        states: dict[str, Floats] = {}
        for name in ("q", "p", "v", "energy"):
            begins = np.array([getattr(segment, name) for segment in first])
            within = np.array([getattr(segment, name) for segment in segments])
            states[name] = np.concatenate([begins, within], axis=1)
            within[:-1, -1] = begins[1:, 0]
            ends[name] = within.reshape(-1, *within.shape[2:])
        impulses = [segment.impulses for segment in segments if segment.impulses is not None]
        steps = Segment(
            q=ends["q"],
            p=ends["p"],
            v=ends["v"],
            energy=ends["energy"],
            u=np.concatenate([segment.u for segment in segments]),
            statistics=joined([segment.statistics for segment in segments]),
            impulses=np.concatenate(impulses) if impulses else None,
        )
        motion = trajectory_of(scene, integrator, dt, first[0], [steps], None, None)
        if self.linear:
            mean, stages, nodes = self._lines(u)
            motion = replace(motion, u=mean, u_stages=stages, u_nodes=nodes)
        return motion, (states["q"], states["v"])

    def _lines(self, u: Floats) -> Lines:
        """The controls within the parts of K steps, one after another."""
        begins, ends = np.split(np.repeat(u, _PARTS, axis=0), 2, axis=1)
        before, mean = on_lines(begins, ends, _PARTS, (0.0, 0.5)).swapaxes(0, 1)
        stages = on_lines(begins, ends, _PARTS, self.integrator.stage_times)
        return Lines(mean.copy(), stages, np.concatenate([before, ends[-1:]]))


@dataclass(frozen=True, eq=False)
class BoundBetween(BoundConstraint):
    """A constraint at instants within steps, each integrated in parts from the node at its begin.

    The value at an instant is that of the parabola through the ends of parts next to it. The places are the nodes at
    the ends of the steps; several instants may be in one step. The times are means of those of the rows.

    Attributes:
        of_nodes: The constraint at the nodes, all after the first.
        parts: The steps in parts.
        inner: The constraint, bound to a grid whose nodes after the first are the ends of parts of the K steps.
        weights: The weights of these ends in each row (K, rows, parts + 1); all zero in rows that are not enforced.
    """

    of_nodes: BoundConstraint
    parts: Parts
    inner: BoundConstraint
    weights: Floats

    @property
    def in_force(self) -> Mask:
        """Which rows are enforced (K, rows); others have minus the scale for a value."""
        return np.asarray(self.weights.any(axis=2))

    @property
    def begins(self) -> Integers:
        """Indices of the nodes at the begin of the steps (K,)."""
        return self.places - 1

    def _within(self, q: Floats, v: Floats, u: Floats) -> tuple[tuple[Floats, Floats, Floats], Integers]:
        """q, v and controls of the steps, each once, and which of them each instant is in (K,)."""
        steps, index = np.unique(self.begins, return_inverse=True)
        return (q[steps], v[steps], self.parts.controls(u, steps)), index

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundConstraint.value`; for one motion. Infinite where a step fails in parts."""
        given, index = self._within(q, v, u)
        within = self.parts.states(*given)
        if within is None:
            return np.full(self.shape, np.inf)
        q, v = (_after_first(x[index]) for x in within)
        c = self.inner.value(q, v, u)
        found = np.einsum("krs,ksr->kr", self.weights, c.reshape(len(self.places), -1, len(self.rows)))
        return np.where(self.in_force, found, -self.scale)

    def jacobian(self, q: Floats, v: Floats) -> Floats:
        """dc/d(q, v) (K, rows, 2n) as at the ends of the steps."""
        return self.of_nodes.jacobian(q, v)[self.begins]

    def slopes(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """Derivatives (K, rows, 2n + c) in the states where the steps begin and in their controls (K, c).

        Raises:
            LinearizationError: A part of a step has no derivative.
        """
        given, index = self._within(q, v, u)
        states, D = self.parts.slopes(*given)
        K, rows = self.shape
        J = self.inner.jacobian(*(_after_first(x[index]) for x in states)).reshape(K, -1, rows, D.shape[2])
        weighted = self.weights[..., None] * np.swapaxes(J, 1, 2)
        found: Floats = weighted.reshape(K, rows, -1) @ D.reshape(len(D), -1, D.shape[3])[index]
        return found


@dataclass(frozen=True, eq=False)
class BoundOnCubics(BoundConstraint):
    """A constraint within steps, at the same share of each, on the cubics through their nodes (q, v).

    The places are the nodes at the ends of the steps.

    Attributes:
        inner: The constraint, bound to a grid whose nodes after the first are the instants.
        coefficients: Those of (q0, v0, q1, v1) of a step, for q, then for v (8,).
    """

    inner: BoundConstraint
    coefficients: Floats

    def _states(self, q: Floats, v: Floats) -> Floats:
        """The q and v (2, ..., K, n) on the cubics of motions (..., N + 1, n)."""
        nodes = np.array([x[..., self.places - back, :] for back in (1, 0) for x in (q, v)])
        return np.tensordot(self.coefficients.reshape(2, 4), nodes, 1)

    def by_nodes(self, of_state: Floats) -> list[Floats]:
        """Derivatives (K, rows, 2n) in (q, v) at the nodes before and after, of those ``of_state`` on the cubics."""
        by_q, by_v = np.split(of_state, 2, axis=2)
        c = self.coefficients
        return [
            np.concatenate([c[i] * by_q + c[i + 4] * by_v, c[i + 1] * by_q + c[i + 5] * by_v], axis=2) for i in (0, 2)
        ]

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundConstraint.value`."""
        q, v = self._states(q, v)
        return self.inner.value(_after_first(q[..., None, :]), _after_first(v[..., None, :]), u)

    def jacobian(self, q: Floats, v: Floats) -> Floats:
        """dc/d(q, v) (K, rows, 2n), in the states on the cubics."""
        q, v = self._states(q, v)
        return self.inner.jacobian(_after_first(q[:, None]), _after_first(v[:, None]))


def _after_first(x: Floats) -> Floats:
    """Nodes (..., 1 + K s, n) whose last are the states (..., K, s, n)."""
    nodes = x.reshape(*x.shape[:-3], -1, x.shape[-1])
    return np.concatenate([nodes[..., :1, :], nodes], axis=-2)


@dataclass(frozen=True, eq=False)
class Instants(Frozen):
    """Instants between nodes at which constraints have rows.

    Attributes:
        rows: Constraint, step and number of the instant in the step (I, 3), each from 0, in ascending order.
        moments: Where all rows of each of them are in a step of unit length (O,), one instant after another; negative
            for rows that are not enforced.
        cubic: Whether rows are on the cubics through the steps, at their middles, not of steps integrated in parts.
    """

    rows: Annotated[Integers, Axes("instants", 3)]
    moments: Annotated[Floats, Axes("moments", finite=True)]
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
    used = moments >= 0.0
    mean = np.where(used, moments, 0.0).sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    share = _PARTS * moments
    middle = np.clip(np.rint(share), 1, _PARTS - 1)
    inner = at_times(problem, of_nodes.source, _times(problem, steps))
    times = problem.t0 + problem.dt * (steps + mean)
    given = of_nodes.source, steps + 1, times, of_nodes.rows, of_nodes.unit, of_nodes.scale
    return BoundBetween(*given, of_nodes, Parts.of(problem), inner, _on_parabolas(middle, share - middle, used))


def _on_parabolas(middle: Floats, x: Floats, used: Mask) -> Floats:
    """Weights (K, rows, parts + 1) of the ends of parts in values on parabolas.

    The parabolas go through the ends next to ``middle`` ones, from which ``x`` is counted in parts, each (K, rows).
    """
    found = np.zeros((*x.shape, _PARTS + 1))
    for k, weight in enumerate((0.5 * x * (x - 1.0), 1.0 - x * x, 0.5 * x * (x + 1.0))):
        place = (middle + k - 1).astype(np.int64)
        np.put_along_axis(found, place[:, :, None], np.where(used, weight, 0.0)[:, :, None], axis=2)
    return found


def _times(problem: OptimalControlProblem, steps: Integers) -> Floats:
    """Times [s] of all ends of parts of steps."""
    found: Floats = problem.t0 + problem.dt * (steps[:, None] + np.arange(_PARTS + 1) / _PARTS).ravel()
    return found


def _on_cubics(problem: OptimalControlProblem, constraint: int, steps: Integers) -> BoundOnCubics:
    """A constraint at the middles of ``steps`` (K,) of the cubics through them."""
    of_nodes = problem.bound_constraints[constraint]
    times = problem.t0 + problem.dt * (steps.astype(np.float64) + _MIDDLE)
    inner = at_times(problem, of_nodes.source, times)
    given = of_nodes.source, steps + 1, times, of_nodes.rows, of_nodes.unit, of_nodes.scale
    return BoundOnCubics(*given, inner, cubics(np.array([_MIDDLE]), problem.dt)[0])


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
    N = motion.steps
    parts = Parts.of(problem)
    controls = parts.controls(problem.control_rows(motion), np.arange(N))
    parted = parts.states(motion.q[:-1], motion.v[:-1], controls)
    if parted is None:
        return {}
    q, v = map(_after_first, parted)
    times = _times(problem, np.arange(N))
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
