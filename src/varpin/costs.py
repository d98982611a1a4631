"""Costs: integrals over time and terms at the end, which add up.

A running cost l(t, q, v, u) stands for its integral over the motion, whatever the time step; ``Terminal`` makes it a
term at the final time. All of them are evaluated and expanded over many points at once, with NumPy, so that a cost of
one's own needs no compiled code.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.checks import as_floats, finite_array, require_finite
from varpin.errors import InputError, VarpinError

Floats = NDArray[np.float64]
Reference = ArrayLike | Callable[[float], ArrayLike]


class CostError(VarpinError, ValueError):
    """A cost raised, or returned something that is no cost.

    Attributes:
        cost: Which one, as text.
    """

    def __init__(self, cost: str, problem: str) -> None:
        self.cost = cost
        super().__init__(f"{cost}: {problem}")


@dataclass(frozen=True, eq=False)
class Points:
    """Where costs are to be evaluated: N points in time on a horizon.

    Attributes:
        t: Times (N,) [s].
        duration: Of the horizon [s].
        steps: Of the problem's grid.
        dof: n.
        controls: m.
        t0: When the horizon begins [s].
    """

    t: Floats
    duration: float
    steps: int
    dof: int
    controls: int
    t0: float = 0.0

    @property
    def elapsed(self) -> Floats:
        """Times since the horizon began (N,) [s]."""
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


class BoundCost(ABC):
    """A cost at given points."""

    @abstractmethod
    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """Its values (..., N) at q (..., N, n), v (..., N, n) and u (..., N, m)."""

    @abstractmethod
    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        """Its expansion at q (N, n), v (N, n) and u (N, m)."""


class Cost(ABC):
    """A cost. Whoever adds one provides ``bind``; ``CustomCost`` is the shorter way."""

    @abstractmethod
    def bind(self, points: Points) -> BoundCost:
        """The cost at given points.

        Raises:
            InputError: Its parameters do not fit the robot or the problem's grid.
            CostError: A reference that is a function fails.
        """

    @property
    def terms(self) -> tuple[Cost, ...]:
        """What it is a sum of."""
        return (self,)

    @property
    def nonnegative(self) -> bool:
        """Whether it is known never to be below zero: a motion that costs nothing is then an optimum."""
        return False

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


@dataclass(frozen=True)
class CostSum(Cost):
    """A sum of costs, running and terminal ones."""

    parts: tuple[Cost, ...]

    @property
    def terms(self) -> tuple[Cost, ...]:
        """See :attr:`Cost.terms`."""
        return self.parts

    @property
    def nonnegative(self) -> bool:
        """See :attr:`Cost.nonnegative`."""
        return all(part.nonnegative for part in self.parts)

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

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundCost.value`."""
        total = np.zeros(q.shape[:-1])
        for part in self.parts:
            total += part.value(q, v, u)
        return total

    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        """See :meth:`BoundCost.expand`."""
        gradient = np.zeros((len(q), self.points.size))
        hessian = np.zeros((1, self.points.size, self.points.size))
        for part in self.parts:
            own = part.expand(q, v, u)
            # Kernels check no shapes, and a cost of one's own may be anything.
            (N, size), found = gradient.shape, (np.shape(own.gradient), np.shape(own.hessian))
            if found not in [((N, size), (rows, size, size)) for rows in (1, N)]:
                raise CostError(
                    type(part).__name__,
                    f"its expansion has shapes {found}, where {(N, size)} and {(N, size, size)} belong",
                )
            gradient += own.gradient
            hessian = hessian + own.hessian
        return Expansion(gradient, hessian)


@dataclass(frozen=True)
class Scaled(Cost):
    """A number times a running cost: ``2.0 * cost``."""

    factor: float
    cost: Cost

    @property
    def nonnegative(self) -> bool:
        """See :attr:`Cost.nonnegative`."""
        return self.cost.nonnegative

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
        own = self.cost.expand(q, v, u)
        return Expansion(self.factor * own.gradient, self.factor * own.hessian)


class _Quadratic(Cost):
    """weight . (y - y_r)^2 for one block y of z."""

    weight: Floats
    reference: Reference
    block: str

    def __init__(self, reference: Reference, weight: ArrayLike) -> None:
        self.weight = checked_weight(type(self).__name__, weight)
        self.reference = reference if callable(reference) else as_floats(f"{type(self).__name__} reference", reference)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(weight={self.weight.tolist()})"

    @property
    def nonnegative(self) -> bool:
        """See :attr:`Cost.nonnegative`."""
        return True

    def bind(self, points: Points) -> BoundCost:
        """See :meth:`Cost.bind`."""
        size = points.controls if self.block == "u" else points.dof
        begin = {"q": 0, "v": points.dof, "u": 2 * points.dof}[self.block]
        name = type(self).__name__
        W = weight_matrix(name, self.weight, size)
        hessian = np.zeros((1, points.size, points.size))
        hessian[0, begin : begin + size, begin : begin + size] = 2.0 * W
        reference = sample(name, self.reference, points, size, held=self.block == "u")
        return _BoundQuadratic(self.block, begin, reference, W, hessian)


def checked_weight(name: str, weight: ArrayLike) -> Floats:
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


@dataclass(frozen=True, eq=False)
class _BoundQuadratic(BoundCost):
    block: str
    begin: int
    reference: Floats  # (N, size) or (1, size)
    weight: Floats  # (size, size)
    hessian: Floats

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        error = {"q": q, "v": v, "u": u}[self.block] - self.reference
        total: Floats = np.einsum("...i,...i->...", error @ self.weight, error)
        return total

    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        error = {"q": q, "v": v, "u": u}[self.block] - self.reference
        gradient = np.zeros((len(q), self.hessian.shape[1]))
        gradient[:, self.begin : self.begin + len(self.weight)] = 2.0 * (error @ self.weight)
        return Expansion(gradient, self.hessian)


class TrackingCost(_Quadratic):
    """weight . (q - q_r(t))^2: follow a reference in joint space."""

    block = "q"

    def __init__(self, reference: Reference, weight: ArrayLike = 1.0) -> None:
        """Describe the cost.

        Args:
            reference: q_r: a function of the time [s] that returns (n,), a constant (n,), or an array (N + 1, n) of
                its values at the problem's nodes, between which it is linear [rad or m].
            weight: One number, (n,), or a matrix (n, n), positive semidefinite.

        Raises:
            InputError: A weight that is not finite, indefinite, or neither number, vector nor square matrix.
        """
        super().__init__(reference, weight)


class VelocityCost(_Quadratic):
    """weight . (v - v_r(t))^2."""

    block = "v"

    def __init__(self, weight: ArrayLike = 1.0, reference: Reference = 0.0) -> None:
        """Describe the cost; see :class:`TrackingCost`."""
        super().__init__(reference, weight)


class ControlCost(_Quadratic):
    """weight . (u - u_r(t))^2."""

    block = "u"

    def __init__(self, weight: ArrayLike = 1.0, reference: Reference = 0.0) -> None:
        """Describe the cost; see :class:`TrackingCost`, with m controls for n coordinates.

        Args:
            weight: One number, (m,), or a matrix (m, m), positive semidefinite.
            reference: u_r: a function of the time [s], a constant, or an array of rows of m: N + 1 of them as there,
                or N, one for each step and constant over it, as controls are; for example those of another solution.
        """
        super().__init__(reference, weight)


def sample(name: str, reference: Reference, points: Points, size: int, *, held: bool = False) -> Floats:
    """A reference at the points, (N, size), or (1, size) where it is constant.

    ``held`` says that an array of it may also have one row for each step, constant over the step.

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


@dataclass(frozen=True)
class Terminal(Cost):
    """A cost at the final time instead of its integral: ``Terminal(TrackingCost(...))``.

    Attributes:
        cost: The argument: any cost, a sum too, but no ``ControlCost``, since there is no control at the final time.

    Raises:
        InputError: It is no cost, is terminal already, or holds a ``ControlCost``.
    """

    cost: Cost

    def __post_init__(self) -> None:
        if not isinstance(self.cost, Cost):
            raise InputError(f"Terminal takes a cost, got {type(self.cost).__name__}")
        for term in self.cost.terms:
            if isinstance(term, Terminal):
                raise InputError(f"{term!r} is a terminal cost already: leave the outer Terminal out")
            if isinstance(term.cost if isinstance(term, Scaled) else term, ControlCost):
                raise InputError(f"{term!r} cannot be a terminal cost: there is no control at the final time")

    @property
    def nonnegative(self) -> bool:
        """See :attr:`Cost.nonnegative`."""
        return self.cost.nonnegative

    def bind(self, points: Points) -> BoundCost:
        """See :meth:`Cost.bind`; the points must be the one at the end."""
        return self.cost.bind(points)


Function = Callable[[Floats, Floats, Floats, Floats], ArrayLike]
Derivatives = Callable[[Floats, Floats, Floats, Floats], tuple[ArrayLike, ArrayLike]]


@dataclass(frozen=True)
class CustomCost(Cost):
    """A cost of one's own, evaluated at many points at once.

        near = vp.CustomCost(lambda t, q, v, u: np.exp(-((q[:, 0] - 0.3) ** 2) / 0.01), name="keep away")

    Attributes:
        function: Takes t (N,), q (N, n), v (N, n) and u (N, m); returns (N,).
        derivatives: Takes the same; returns gradient (N, 2n + m) and Hessian (N, 2n + m, 2n + m) in z = (q, v, u).
            If left out, both are differenced.
        step: Of the differences: None for 1e-3 rad or m in q, 1e-3 of the largest velocity (or of 1) in v and 1e-3 of
            the largest control in u; or one number for each of z (2n + m,). The differences are right to about 1e-8 of
            the function's size where it changes little over a step, so the second derivatives to 1e-5 of it by the
            step's square.
        name: For messages.
        check: Hold ``derivatives`` against differences when the cost is first expanded.

    Raises:
        InputError: ``function`` or ``derivatives`` cannot be called.
    """

    function: Function
    derivatives: Derivatives | None = None
    step: ArrayLike | None = None
    name: str = "CustomCost"
    check: bool = False

    def __repr__(self) -> str:
        own = getattr(self.function, "__name__", type(self.function).__name__)
        return f"CustomCost({own})" if self.name == "CustomCost" else f"CustomCost({self.name!r})"

    def __post_init__(self) -> None:
        for name in ("function", "derivatives"):
            value = getattr(self, name)
            if not callable(value) and (value is not None or name == "function"):
                raise InputError(f"{self.name} {name} must be a function of (t, q, v, u), got {value!r}")

    def bind(self, points: Points) -> BoundCost:
        """See :meth:`Cost.bind`."""
        return _BoundCustom(self, points, unchecked=self.check)


@dataclass(eq=False)
class _BoundCustom(BoundCost):
    cost: CustomCost
    points: Points
    unchecked: bool

    def _call(self, t: Floats, q: Floats, v: Floats, u: Floats) -> Floats:
        try:
            values = as_floats("what it returned", self.cost.function(t, q, v, u))
        except Exception as error:
            raise CostError(self.cost.name, f"function(t, q, v, u) failed: {error!r}") from error
        if values.shape != t.shape:
            raise CostError(self.cost.name, f"function(t, q, v, u) must return shape {t.shape}, got {values.shape}")
        return values

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        lead = q.shape[:-1]
        t = np.broadcast_to(self.points.t, lead).reshape(-1)
        rows = [np.ascontiguousarray(x).reshape(len(t), x.shape[-1]) for x in (q, v, u)]
        return self._call(t, *rows).reshape(lead)

    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:
        N, d = len(q), self.points.size
        if self.cost.derivatives is None:
            return self._differences(np.hstack([q, v, u]))
        try:
            first, second = self.cost.derivatives(self.points.t, q, v, u)
            gradient = finite_array("the gradient", first, (N, d))
            hessian = as_floats("the Hessian", second)
            hessian = finite_array("the Hessian", hessian, (1, d, d) if hessian.shape == (1, d, d) else (N, d, d))
        except Exception as error:
            raise CostError(self.cost.name, f"derivatives(t, q, v, u) failed: {error}") from error
        given = Expansion(gradient, hessian)
        self._require_symmetry(hessian)
        if self.unchecked:
            self._check(given, np.hstack([q, v, u]))
            self.unchecked = False
        return given

    def _require_symmetry(self, hessian: Floats) -> None:
        gap = np.abs(hessian - np.swapaxes(hessian, 1, 2))
        off = gap > 1e-8 * np.abs(hessian).max(axis=(1, 2), initial=0.0, keepdims=True)
        if off.any():
            j, a, b = np.argwhere(off)[0]
            raise CostError(
                self.cost.name,
                f"the Hessian must be symmetric: Hessian[{j}, {a}, {b}] is {hessian[j, a, b]:.6g} and "
                f"Hessian[{j}, {b}, {a}] is {hessian[j, b, a]:.6g}",
            )

    def _check(self, given: Expansion, z: Floats) -> None:
        """Hold the user's derivatives against differences; the first entry that is off is an error."""
        found, h = self._differences(z), self._steps(z)
        first, second = np.abs(found.gradient), np.abs(found.hessian)
        # What is wrong with the differences themselves goes with the function's size, or with what it varies by where
        # it is zero, over lengths of 1000 steps.
        size = np.abs(self._call(self.points.t, *self._blocks(z))).max(initial=0.0)
        size = max(size, 1e6 * float((second * h[:, None] * h).max(initial=0.0)))
        for name, derivative, expected, room in (
            ("gradient", given.gradient, found.gradient, 1e-6 * first.max(axis=0) + 1e-11 * size / h),
            ("Hessian", given.hessian, found.hessian, 1e-4 * second.max(axis=0) + 1e-12 * size / (h[:, None] * h)),
        ):
            own = np.broadcast_to(derivative, expected.shape)
            # Not "greater": differences that are NaN must not pass.
            off = ~(np.abs(own - expected) <= room)
            if off.any():
                where = tuple(int(i) for i in np.argwhere(off)[0])
                raise CostError(
                    self.cost.name,
                    f"{name}{list(where)} from derivatives(t, q, v, u) is {own[where]:.6g}, but differences of the "
                    f"function give {expected[where]:.6g}, at t = {self.points.t[where[0]]:.6g} s",
                )

    def _blocks(self, z: Floats) -> tuple[Floats, Floats, Floats]:
        n = self.points.dof
        return z[:, :n], z[:, n : 2 * n], z[:, 2 * n :]

    def _steps(self, z: Floats) -> Floats:
        n, d = self.points.dof, self.points.size
        if self.cost.step is not None:
            steps = finite_array(f"{self.cost.name} step", self.cost.step, (d,))
            if not (steps > 0.0).all():
                raise InputError(f"{self.cost.name} step must be positive, got {steps}")
            return steps
        speed = max(1.0, np.abs(z[:, n : 2 * n]).max(initial=0.0))
        control = np.abs(z[:, 2 * n :]).max(initial=0.0)
        return np.repeat([1e-3, 1e-3 * speed, 1e-3 * (control if control > 0.0 else 1.0)], [n, n, d - 2 * n])

    def _differences(self, z: Floats) -> Expansion:
        """Central differences: of fourth order for the gradient, of second for the Hessian."""
        N, d = z.shape

        def at(moved: Floats) -> Floats:
            return self._call(self.points.t, *self._blocks(moved))

        size = self._steps(z)
        gradient, hessian = np.empty((N, d)), np.empty((N, d, d))
        middle = at(z)
        ahead, behind = [], []
        for a in range(d):
            e = np.zeros(d)
            e[a] = size[a]
            outer = at(z + 2.0 * e) - at(z - 2.0 * e)
            gradient[:, a] = (8.0 * (at(z + e) - at(z - e)) - outer) / (12.0 * size[a])
            e[a] = size[a]
            ahead.append(at(z + e))
            behind.append(at(z - e))
            hessian[:, a, a] = (ahead[a] - 2.0 * middle + behind[a]) / size[a] ** 2
            for b in range(a):
                e[b] = size[b]
                both = at(z + e) + at(z - e)
                e[b] = 0.0
                mixed = both - ahead[a] - behind[a] - ahead[b] - behind[b] + 2.0 * middle
                hessian[:, a, b] = hessian[:, b, a] = mixed / (2.0 * size[a] * size[b])
        return Expansion(gradient, hessian)
