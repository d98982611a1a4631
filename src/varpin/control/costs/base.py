"""Costs: integrals over time and terms at the end, which add up.

A running cost l(t, q, v, u) is integrated over the motion, so that its value does not depend on the time step;
``Terminal`` evaluates it at the final time instead. Costs are evaluated and expanded at many points at once: varpin's
own in the core, custom costs with NumPy, without compiled code.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from numbers import Real
from typing import Self

import numpy as np
import scipy
from numpy.typing import ArrayLike

from varpin.arrays import Floats, Integers
from varpin.control.sizes import ROUNDING, TRACE
from varpin.core import CostTerms, Subject
from varpin.errors import InputError, VarpinError
from varpin.model import Robot
from varpin.model.kinematics import FrameKinematics, Links
from varpin.support.checks import as_floats, require_finite, returned, rotation_matrix
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


class Cost(Frozen, ABC):
    """A cost. A subclass implements ``bind``; ``CustomCost`` takes a function instead.

    Costs raise an InputError for arguments of a wrong shape or value, such as a weight that is indefinite, an
    UnknownJoint or UnknownFrame for a name that the robot does not have, and a CostError where a function fails.

    Attributes:
        factor: What it is scaled by in a sum.
        at_end: Whether it is a terminal cost instead of an integral over time.
        of_controls: Whether it depends on the controls alone, which do not exist at the final time.
    """

    factor: float = 1.0
    at_end: bool = False
    of_controls: bool = False

    @abstractmethod
    def bind(self, points: Points) -> BoundCost:
        """Bind the cost to given points, without its ``factor``.

        Raises:
            InputError: Its parameters do not fit the robot or the problem's grid.
            CostError: A reference function fails.
        """

    @property
    def terms(self) -> tuple[Cost, ...]:
        """The terms of the sum, each with its factor."""
        return (self,)

    def __add__(self, other: Cost) -> CostSum:
        if not isinstance(other, Cost):
            return NotImplemented
        return CostSum((*self.terms, *other.terms))

    def __radd__(self, other: int) -> Self:
        # The zero that sum() begins with.
        return self if isinstance(other, int) and other == 0 else NotImplemented

    def __rmul__(self, factor: float) -> Cost:
        if not isinstance(factor, Real):
            return NotImplemented
        factor = float(factor)
        if not 0.0 <= factor < np.inf:
            raise InputError(f"a cost can be scaled by a finite number that is not negative, got {factor:g}")
        return _sum([term.changed(factor=factor * term.factor) for term in self.terms])

    __mul__ = __rmul__

    def __repr__(self) -> str:
        text = f"Terminal({self._text()})" if self.at_end else self._text()
        return text if self.factor == 1.0 else f"{self.factor:g} * {text}"

    def _text(self) -> str:
        """The cost in a line, without its factor."""
        return type(self).__name__

    def _repr_html_(self) -> str:
        places = ("along the motion", "at the end")
        rows = [(places[term.at_end], term.changed(at_end=False)) for term in self.terms]
        return facts("Cost", rows)


@dataclass(frozen=True, repr=False)
class CostSum(Cost):
    """A sum of costs, running and terminal ones."""

    parts: tuple[Cost, ...]

    @property
    def terms(self) -> tuple[Cost, ...]:
        return self.parts

    def bind(self, points: Points) -> BoundSum:
        return BoundSum(tuple((term.factor, term.bind(points)) for term in self.parts), points)

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.parts))


def _sum(terms: list[Cost]) -> Cost:
    return terms[0] if len(terms) == 1 else CostSum(tuple(terms))


def Terminal(cost: Cost) -> Cost:
    """A cost at the final time instead of its integral: ``Terminal(TrackingCost(...))``.

    Args:
        cost: Any cost, a sum too, but no ``ControlCost`` or ``ControlRateCost``, since there is no control at the final
            time.

    Raises:
        InputError: It is no cost, is terminal already, or holds a ``ControlCost`` or a ``ControlRateCost``.
    """
    if not isinstance(cost, Cost):
        raise InputError(f"Terminal takes a cost, got {type(cost).__name__}")
    for term in cost.terms:
        if term.at_end:
            raise InputError(f"{term!r} is a terminal cost already: leave the outer Terminal out")
        if term.of_controls:
            raise InputError(f"{term!r} cannot be a terminal cost: there is no control at the final time")
    return _sum([term.changed(at_end=True) for term in cost.terms])


@dataclass(frozen=True, eq=False)
class BoundTerm(BoundCost):
    """weight . r^2 with r what a ``subject`` of the core is beside its target.

    Attributes:
        points: The points.
        subject: What r is of.
        of: Index of the first entry of z = (q, v, u), the frame, or the links whose centre of mass it is.
        weight: (r, r).
        target: (N, r), or (1, r) where it is constant; of an orientation (N, 9), of an excess (1, 2 r).
        directions: Rows of the Jacobian in a manipulability.
    """

    points: Points
    subject: Subject
    of: int | FrameKinematics | Links
    weight: Floats
    target: Floats
    directions: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @cached_property
    def _alone(self) -> BoundSum:
        return BoundSum(((1.0, self),), self.points)

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        return self._alone.value(q, v, u)

    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        """See :meth:`BoundCost.expand`; the Hessian is that of Gauss and Newton, 2 J' weight J with J of r."""
        return self._alone.expand(q, v, u)


@dataclass(frozen=True, eq=False)
class BoundSum(BoundCost):
    """A sum of bound costs, each with its factor; of none, zero."""

    parts: tuple[tuple[float, BoundCost], ...]
    points: Points

    @cached_property
    def core(self) -> CostTerms:
        """The terms weight . r^2, which the core evaluates all at once. The frame of several terms is placed once."""
        terms, places = CostTerms.make(self.points.dof, self.points.controls), dict[bytes, int]()
        for factor, part in self.parts:
            if not isinstance(part, BoundTerm):
                continue
            of = part.of
            if not isinstance(of, int):
                if of.key not in places:
                    added = (
                        terms.add_center(of.core)
                        if isinstance(of, Links)
                        else terms.add_frame(of.links.core, of.rotation, of.translation)
                    )
                    places[of.key] = added
                of = places[of.key]
            terms.add_term(part.subject, of, factor * part.weight, part.target, part.directions)
        return terms

    def compiled(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The value of each term of the core (..., N, terms) at q (..., N, n), v (..., N, n) and u (..., N, m)."""
        found = self.core.values(*(np.ascontiguousarray(x).reshape(-1, x.shape[-1]) for x in (q, v, u)))
        return found.reshape(*q.shape[:-1], found.shape[1])

    @cached_property
    def others(self) -> tuple[tuple[float, BoundCost], ...]:
        """The parts that it does not, with their factors."""
        return tuple(part for part in self.parts if not isinstance(part[1], BoundTerm))

    def shares(self, q: Floats, v: Floats, u: Floats) -> list[Floats]:
        """The values of all terms, which add up: arrays (..., N, terms) and (..., N)."""
        return [self.compiled(q, v, u), *(factor * part.value(q, v, u) for factor, part in self.others)]

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        compiled, *others = self.shares(q, v, u)
        total: Floats = compiled.sum(axis=-1)
        for values in others:
            total += values
        return total

    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        gradient, hessian = self.core.expand(q, v, u)
        for factor, part in self.others:
            expansion = part.expand(q, v, u)
            # A cost of one's own may be anything, and NumPy would broadcast it.
            (N, size), found = gradient.shape, (np.shape(expansion.gradient), np.shape(expansion.hessian))
            if found not in [((N, size), (rows, size, size)) for rows in (1, N)]:
                wanted = f"{(N, size)} and {(N, size, size)}"
                raise CostError(type(part).__name__, f"its expansion has shapes {found}, where {wanted} belong")
            gradient += factor * expansion.gradient
            hessian = hessian + factor * expansion.hessian
        return Expansion(gradient, hessian)


class LeastSquares(Cost):
    """weight . r^2 with a residual r that the core evaluates.

    Its Hessian is that of Gauss and Newton, 2 J' weight J with J the residual's derivative: positive semidefinite, and
    exact where r is zero or linear.

    Attributes:
        weight: One number, (r,) or (r, r), or numbers by joint name.
    """

    weight: Floats | Mapping[str, float]

    def _text(self) -> str:
        frame = getattr(self, "frame", "")
        return f"{type(self).__name__}({f'{frame!r}, ' if frame else ''}weight={plain(self.weight)})"


def plain(values: Floats | Mapping[str, float]) -> object:
    """Values as in Python's text."""
    return dict(values) if isinstance(values, Mapping) else values.tolist()


def checked_weight(name: str, weight: object) -> Floats:
    """A weight as given: one number, a vector or a symmetric matrix.

    Raises:
        InputError: Not finite, indefinite, or neither number, vector nor square matrix.
    """
    array = require_finite(f"{name} weight", as_floats(f"{name} weight", weight))
    if array.ndim > 2 or (array.ndim == 2 and array.shape[0] != array.shape[1]):
        raise InputError(f"{name} weight must be a number, a vector or a square matrix, got {array.shape}")
    array = 0.5 * (array + array.T) if array.ndim == 2 else array
    least = np.linalg.eigvalsh(array).min(initial=0.0) if array.ndim == 2 else array.min(initial=0.0)
    if least < -ROUNDING * np.abs(array).max(initial=0.0):
        raise InputError(f"{name} weight must be positive semidefinite; its least value is {least:g}")
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


def checked_reference(name: str, reference: ReferenceValues, *, turns: bool = False) -> ReferenceValues:
    """A reference as given, a function or an array; one of ``turns`` (..., 3, 3) holds rotation matrices.

    Raises:
        InputError: The array is not finite, or a matrix is no rotation.
    """
    if callable(reference):
        return reference
    array = require_finite(f"{name} reference", as_floats(f"{name} reference", reference))
    return _rotations(name, array) if turns and array.shape[-2:] == (3, 3) else array


def sample(
    name: str, reference: ReferenceValues, points: Points, shape: tuple[int, ...], *, held: bool = False
) -> Floats:
    """A reference at the points, (N, *shape), or (1, *shape) where it is constant.

    Between the nodes rows are linear, and rotation matrices turn evenly. With ``held``, an array may also have one row
    for each step, constant over the step.

    Raises:
        InputError: Its shape does not fit.
        CostError: A function that raises, or returns another shape or values that are not finite.
    """
    if callable(reference):
        try:
            given = [(partial(reference, t), shape, partial(" at t = {:.6g} s".format, t)) for t in points.t.tolist()]
            found = np.array([returned("the reference", *each) for each in given])
            return _rotations(name, found) if len(shape) == 2 else found
        except InputError as error:
            raise CostError(name, str(error)) from error
    array, steps, N = np.asarray(reference), points.steps, points.steps + 1
    if array.shape in ((), shape):
        return np.full((1, *shape), array)
    if held and array.shape == (steps, *shape):
        step = np.floor(points.elapsed * (steps / points.duration) + TRACE).astype(np.int64)
        held_rows: Floats = array[np.minimum(step, steps - 1)]
        return held_rows
    if array.shape != (N, *shape):
        also = f", or {(steps, *shape)}: one for each of its steps" if held else ""
        raise InputError(
            f"{name} reference must be a function of time, have shape {shape}, or {(N, *shape)}: one for each of the "
            f"problem's nodes{also}; got {array.shape}"
        )
    nodes = np.linspace(0.0, points.duration, N)
    if len(shape) == 2:
        rotations = scipy.spatial.transform.Rotation.from_matrix(array)
        turns = scipy.spatial.transform.Slerp(nodes, rotations)
        return np.asarray(turns(np.clip(points.elapsed, 0.0, points.duration)).as_matrix())
    return np.column_stack([np.interp(points.elapsed, nodes, column) for column in array.T])


def _rotations(name: str, values: Floats) -> Floats:
    """Values of a reference (..., 3, 3); an InputError where one is no rotation."""
    for k, R in enumerate(matrices := values.reshape(-1, 3, 3)):
        rotation_matrix(f"{name} reference{f' number {k}' if len(matrices) > 1 else ''}", R)
    return values
