"""Costs: integrals over time and terms at the end, which add up.

A running cost l(t, q, v, u) is integrated over the motion, so that its value does not depend on the time step;
``Terminal`` evaluates it at the final time instead. Costs are evaluated and expanded at many points at once: varpin's
own in the core, custom costs with NumPy, without compiled code.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.control.costs.terms import Terms
from varpin.errors import InputError, VarpinError
from varpin.model import Robot
from varpin.support.checks import as_floats, finite_array, require_finite
from varpin.support.frozen import Frozen
from varpin.support.markup import facts
from varpin.trajectory import Trajectory

ReferenceValues = ArrayLike | Callable[[float], ArrayLike]


class CostError(VarpinError, ValueError):
    """A cost raised an exception or returned an invalid value.

    Attributes:
        cost: The cost, as text.
        problem: Description of the failure.
        trajectory: In :meth:`varpin.Mpc.run`, the plant's motion so far; else None.
    """

    def __init__(self, cost: str, problem: str, trajectory: Trajectory | None = None) -> None:
        self.cost = cost
        self.problem = problem
        self.trajectory = trajectory
        so_far = "" if trajectory is None else "; the plant's motion so far is in error.trajectory"
        super().__init__(f"{cost}: {problem}{so_far}")


@dataclass(frozen=True, eq=False)
class Points(Frozen):
    """N points in time on a horizon, at which costs are evaluated.

    Attributes:
        t: Times (N,) [s].
        duration: Duration of the horizon [s].
        steps: Number of steps of the problem's grid.
        dof: n.
        controls: m.
        t0: Time at the beginning of the horizon [s].
        joints: Names of the coordinates, for weights and references by name.
        control_joints: The joint whose force each control is; None where controls are something else.
        robot: The problem's robot, for costs that check it.
    """

    t: Floats
    duration: float
    steps: int
    dof: int
    controls: int
    t0: float = 0.0
    joints: tuple[str, ...] = ()
    control_joints: tuple[str, ...] | None = None
    robot: Robot | None = None

    @property
    def elapsed(self) -> Floats:
        """Times since the beginning of the horizon (N,) [s]."""
        return self.t - self.t0

    @property
    def size(self) -> int:
        """2n + m, the length of z = (q, v, u)."""
        return 2 * self.dof + self.controls


@dataclass(frozen=True, eq=False)
class Expansion:
    """Gradient and Hessian of a cost at N points, in z = (q, v, u).

    Attributes:
        gradient: (N, 2n + m).
        hessian: (N, 2n + m, 2n + m), or (1, 2n + m, 2n + m) where it is the same everywhere.
    """

    gradient: Floats
    hessian: Floats


class BoundCost(Frozen, ABC):
    """A cost at given points."""

    @abstractmethod
    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """Its values (..., N) at q (..., N, n), v (..., N, n) and u (..., N, m)."""

    @abstractmethod
    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        """Its expansion at q (N, n), v (N, n) and u (N, m)."""

    def add_to(self, terms: Terms, factor: float) -> bool:  # noqa: ARG002
        """Add ``factor`` times the cost to the terms that the core evaluates; False if the core does not know it."""
        return False


class CompiledCost(BoundCost):
    """A cost that the core evaluates; a subclass implements ``add_to``."""

    points: Points

    @cached_property
    def _alone(self) -> Terms:
        terms = Terms(self.points.dof, self.points.controls)
        self.add_to(terms, 1.0)
        return terms

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundCost.value`."""
        total: Floats = self._alone.values(q, v, u).sum(axis=-1)
        return total

    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        """See :meth:`BoundCost.expand`."""
        return Expansion(*self._alone.expand(q, v, u))


class Cost(Frozen, ABC):
    """A cost. A subclass implements ``bind``; ``CustomCost`` takes a function instead."""

    @abstractmethod
    def bind(self, points: Points) -> BoundCost:
        """Bind the cost to given points.

        Raises:
            InputError: Its parameters do not fit the robot or the problem's grid.
            CostError: A reference function fails.
        """

    @property
    def terms(self) -> tuple[Cost, ...]:
        """The terms of the sum."""
        return (self,)

    @property
    def of_controls(self) -> bool:
        """Whether it depends on the controls alone, which do not exist at the final time."""
        return False

    @property
    def nonnegative(self) -> bool:
        """Whether it is known to be nonnegative: a motion of cost zero is then an optimum."""
        return False

    @property
    def timed(self) -> bool:
        """Whether the result of :meth:`bind` depends on the points' times, not only on their number."""
        return True

    def __add__(self, other: Cost) -> CostSum:
        if not isinstance(other, Cost):
            return NotImplemented
        return CostSum((*self.terms, *other.terms))

    def __radd__(self, other: int) -> Cost:
        # The zero that sum() begins with.
        return self if isinstance(other, int) and other == 0 else NotImplemented

    def __rmul__(self, factor: float) -> Cost:
        if not isinstance(factor, Real):
            return NotImplemented
        factor = float(factor)
        if not 0.0 <= factor < np.inf:
            raise InputError(f"a cost can be scaled by a finite number that is not negative, got {factor:g}")
        # Term by term, so that a terminal cost stays one.
        scaled = [Terminal(factor * t.cost) if isinstance(t, Terminal) else Scaled(factor, t) for t in self.terms]
        return scaled[0] if len(scaled) == 1 else CostSum(tuple(scaled))

    __mul__ = __rmul__

    def _repr_html_(self) -> str:
        rows = [("at the end", t.cost) if isinstance(t, Terminal) else ("along the motion", t) for t in self.terms]
        return facts("Cost", rows)


@dataclass(frozen=True)
class CostSum(Cost):
    """A sum of costs, running and terminal ones."""

    parts: tuple[Cost, ...]

    @property
    def terms(self) -> tuple[Cost, ...]:
        """See :attr:`Cost.terms`."""
        return self.parts

    @cached_property
    def nonnegative(self) -> bool:
        """See :attr:`Cost.nonnegative`."""
        return all(part.nonnegative for part in self.parts)

    @property
    def timed(self) -> bool:
        """See :attr:`Cost.timed`."""
        return any(part.timed for part in self.parts)

    def bind(self, points: Points) -> BoundCost:
        """See :meth:`Cost.bind`."""
        return BoundSum(tuple(part.bind(points) for part in self.parts), points)

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.parts))


@dataclass(frozen=True, eq=False)
class BoundSum(BoundCost):
    """A sum of bound costs; of none, zero."""

    parts: tuple[BoundCost, ...]
    points: Points

    @cached_property
    def _sorted(self) -> tuple[Terms, tuple[BoundCost, ...]]:
        """The parts that the core evaluates, and the others."""
        terms = Terms(self.points.dof, self.points.controls)
        return terms, tuple(part for part in self._flat() if not part.add_to(terms, 1.0))

    @property
    def compiled(self) -> Terms:
        """The terms that the core evaluates."""
        return self._sorted[0]

    @property
    def others(self) -> tuple[BoundCost, ...]:
        """The parts that it does not."""
        return self._sorted[1]

    def _flat(self) -> Iterator[BoundCost]:
        for part in self.parts:
            if isinstance(part, BoundSum):
                yield from part._flat()
            else:
                yield part

    def shares(self, q: Floats, v: Floats, u: Floats) -> list[Floats]:
        """The values of all terms, which add up: arrays (..., N, terms) and (..., N)."""
        terms, others = self._sorted
        return [terms.values(q, v, u), *(part.value(q, v, u) for part in others)]

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundCost.value`."""
        compiled, *others = self.shares(q, v, u)
        total: Floats = compiled.sum(axis=-1)
        for values in others:
            total += values
        return total

    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        """See :meth:`BoundCost.expand`."""
        terms, others = self._sorted
        gradient, hessian = terms.expand(q, v, u)
        for part in others:
            expansion = part.expand(q, v, u)
            # A cost of one's own may be anything, and NumPy would broadcast it.
            (N, size), found = gradient.shape, (np.shape(expansion.gradient), np.shape(expansion.hessian))
            if found not in [((N, size), (rows, size, size)) for rows in (1, N)]:
                raise CostError(
                    type(part).__name__,
                    f"its expansion has shapes {found}, where {(N, size)} and {(N, size, size)} belong",
                )
            gradient += expansion.gradient
            hessian = hessian + expansion.hessian
        return Expansion(gradient, hessian)


@dataclass(frozen=True)
class Scaled(Cost):
    """A number times a running cost: ``2.0 * cost``."""

    factor: float
    cost: Cost

    @property
    def of_controls(self) -> bool:
        """See :attr:`Cost.of_controls`."""
        return self.cost.of_controls

    @property
    def nonnegative(self) -> bool:
        """See :attr:`Cost.nonnegative`."""
        return self.cost.nonnegative

    @property
    def timed(self) -> bool:
        """See :attr:`Cost.timed`."""
        return self.cost.timed

    def bind(self, points: Points) -> BoundCost:
        """See :meth:`Cost.bind`."""
        return _BoundScaled(self.factor, self.cost.bind(points))

    def __repr__(self) -> str:
        return f"{self.factor:g} * {self.cost!r}"


@dataclass(frozen=True, eq=False)
class _BoundScaled(BoundCost):
    factor: float
    cost: BoundCost

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        return self.factor * self.cost.value(q, v, u)

    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        expansion = self.cost.expand(q, v, u)
        return Expansion(self.factor * expansion.gradient, self.factor * expansion.hessian)

    def add_to(self, terms: Terms, factor: float) -> bool:
        return self.cost.add_to(terms, self.factor * factor)


@dataclass(frozen=True)
class Terminal(Cost):
    """A cost at the final time instead of its integral: ``Terminal(TrackingCost(...))``.

    Attributes:
        cost: The argument: any cost, a sum too, but no ``ControlCost`` or ``ControlRateCost``, since there is no
            control at the final time.

    Raises:
        InputError: It is no cost, is terminal already, or holds a ``ControlCost`` or a ``ControlRateCost``.
    """

    cost: Cost

    def __post_init__(self) -> None:
        if not isinstance(self.cost, Cost):
            raise InputError(f"Terminal takes a cost, got {type(self.cost).__name__}")
        for term in self.cost.terms:
            if isinstance(term, Terminal):
                raise InputError(f"{term!r} is a terminal cost already: leave the outer Terminal out")
            if term.of_controls:
                raise InputError(f"{term!r} cannot be a terminal cost: there is no control at the final time")

    @property
    def nonnegative(self) -> bool:
        """See :attr:`Cost.nonnegative`."""
        return self.cost.nonnegative

    @property
    def timed(self) -> bool:
        """See :attr:`Cost.timed`."""
        return self.cost.timed

    def bind(self, points: Points) -> BoundCost:
        """See :meth:`Cost.bind`; the points must be the one at the end."""
        return self.cost.bind(points)


def checked_weight(name: str, weight: object) -> Floats:
    """A weight as given: one number, a vector or a symmetric matrix.

    Raises:
        InputError: Not finite, indefinite, or neither number, vector nor square matrix.
    """
    array = require_finite(f"{name} weight", as_floats(f"{name} weight", weight))
    if array.ndim > 2 or (array.ndim == 2 and array.shape[0] != array.shape[1]):
        raise InputError(f"{name} weight must be a number, a vector or a square matrix, got {array.shape}")
    least = np.linalg.eigvalsh(0.5 * (array + array.T)).min() if array.ndim == 2 else array.min(initial=0.0)
    if least < -1e-12 * np.abs(array).max(initial=0.0):
        raise InputError(f"{name} weight must be positive semidefinite; its least value is {least:g}")
    array = 0.5 * (array + array.T) if array.ndim == 2 else array
    array.setflags(write=False)
    return array


def weight_matrix(name: str, weight: Floats, size: int) -> Floats:
    """A weight as a matrix (size, size).

    Raises:
        InputError: It is for another size.
    """
    if weight.ndim > 0 and weight.shape[0] != size:
        raise InputError(f"{name} weight must be one number or have {size} rows, got shape {weight.shape}")
    return weight * np.eye(size) if weight.ndim < 2 else weight


def sample(name: str, reference: ReferenceValues, points: Points, size: int, *, held: bool = False) -> Floats:
    """A reference at the points, (N, size), or (1, size) where it is constant.

    With ``held``, an array may also have one row for each step, constant over the step.

    Raises:
        InputError: Its shape does not fit.
        CostError: A function that raises, or returns another shape or values that are not finite.
    """
    if callable(reference):
        values = []
        for time in points.t.tolist():
            try:
                values.append(reference(time))
            except Exception as error:
                raise CostError(name, f"the reference raised {error!r} at t = {time:.6g} s") from error
        # All at once, as there may be many thousands; one by one only to say which of them is wrong.
        with contextlib.suppress(ValueError, TypeError, OverflowError):
            rows = np.array(values)
            if rows.shape == (len(values), size) and rows.dtype.kind in "fiu" and np.isfinite(rows).all():
                return np.ascontiguousarray(rows, dtype=np.float64)
        for time, value in zip(points.t, values, strict=True):
            try:
                finite_array(f"the reference at t = {time:.6g} s", value, (size,))
            except InputError as error:
                raise CostError(name, str(error)) from None
        return np.array(values, dtype=np.float64)
    array = require_finite(f"{name} reference", as_floats(f"{name} reference", reference))
    if array.ndim < 2 and array.shape in ((), (size,)):
        return np.array(np.broadcast_to(array, (1, size)))
    if held and array.shape == (points.steps, size):
        # Rounding must not put a time at a node into the step before it; the end belongs to the last step.
        step = np.floor(points.elapsed * (points.steps / points.duration) + 1e-6).astype(np.int64)
        held_rows: Floats = array[np.minimum(step, points.steps - 1)]
        return held_rows
    if array.shape != (points.steps + 1, size):
        steps = f", or ({points.steps}, {size}): one for each of its steps" if held else ""
        raise InputError(
            f"{name} reference must be a function of time, have shape ({size},), or ({points.steps + 1}, {size}): one "
            f"row for each of the problem's nodes{steps}; got {array.shape}"
        )
    nodes = np.linspace(0.0, points.duration, points.steps + 1)
    return np.column_stack([np.interp(points.elapsed, nodes, column) for column in array.T])
