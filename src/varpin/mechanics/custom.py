"""A generalized force that a user writes in Python."""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.core.arrays import Coupling, Element
from varpin.errors import InputError
from varpin.mechanics.forces import Force
from varpin.model import Robot
from varpin.support.frozen import Frozen

Floats = NDArray[np.float64]
Field: TypeAlias = Callable[[Floats, Floats], ArrayLike]
Slopes: TypeAlias = Callable[[Floats, Floats], tuple[ArrayLike, ArrayLike]]

# Of central differences of eighth order, and of those of sixth order at the same points; what the two differ by, in
# units of the derivative and the force, that needs no smaller step.
_WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
_LOWER = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60, 4: 0.0}
_SMOOTH = 1e-8
# Their steps in units of what is moved, 1 at least: the next where the function is not smooth over four of one.
_STEPS = (2e-3, 2e-4, 2e-5, 2e-6)
# An imaginary step, and how far derivatives may be from differences, beside the error of those.
_TINY, _AGREES = 1e-200, 1e-6
_DOUBT = 10.0
# Differences that are known less well than this are no derivatives.
_KNOWN = 1e-4
# States at which the complex step is held against differences, and how far from rest they are.
_PROBES, _AROUND = 2, 0.3


class CustomForceError(InputError):
    """A function of a custom force raised, or returned something that is no force."""


@dataclass(frozen=True, eq=False, repr=False)
class CustomForce(Force):
    """A generalized force of your own, in Python: drag, a cable, a learned friction.

    Every integrator asks for it wherever it looks at the scene's forces, at every iterate of every stage, and so the
    order of the motion is whole; each call takes its time in Python. It may act on all joints and depend on all of
    them. What it does is work in the balance of the energy. A motion keeps no record of it.

    Attributes:
        f: Function of (q (n,), v (n,)) that returns the force (n,) [N m or N], n coordinates of the robot.
        derivatives: Function of (q, v) that returns (dF/dq, dF/dv), each (n, n); ``"complex"`` takes them by complex
            steps, exact to rounding, for an ``f`` of analytic operations (no ``abs``, no comparisons); left out,
            by central differences of eighth order, good to about 1e-10 of the force where it is smooth, in steps that
            become as small as it takes. Those that are given are held against differences once, where a motion
            starts.
    """

    f: Field
    derivatives: Slopes | Literal["complex"] | None = None

    def __post_init__(self) -> None:
        if not callable(self.f):
            raise InputError(f"CustomForce takes a function of (q, v), got {reprlib.repr(self.f)}")
        if not (self.derivatives is None or self.derivatives == "complex" or callable(self.derivatives)):
            raise InputError(
                f"CustomForce derivatives must be a function of (q, v), 'complex' or None, got {self.derivatives!r}"
            )

    def __repr__(self) -> str:
        ways = {"complex": "derivatives by complex steps", None: "derivatives by differences"}
        how = "derivatives given" if callable(self.derivatives) else ways[self.derivatives]
        return f"CustomForce({self.name}, {how})"

    @property
    def name(self) -> str:
        """Of the function."""
        return str(getattr(self.f, "__name__", type(self.f).__name__))

    def bind(self, robot: Robot) -> tuple[Element | Coupling, ...]:
        """See :meth:`Force.bind`; the core asks the function itself.

        Raises:
            InputError: Complex steps do not give the derivatives of ``f``.
        """
        if self.derivatives == "complex":
            self._check_complex(robot.dof)
        return ()

    def at(self, q: Floats, v: Floats) -> Floats:
        """The force (n,).

        Raises:
            CustomForceError: The function raised, or returned something that is no force.
        """
        value = self._asked(lambda: self.f(q.copy(), v.copy()), "f(q, v)", q, v)
        return self._read(value, "f(q, v)", (q.size,), q, v)

    def slopes(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Its derivatives (n, n) in q and in v.

        Raises:
            CustomForceError: As :meth:`at`.
        """
        n = q.size
        if callable(self.derivatives):
            derivatives = self.derivatives
            value = self._asked(lambda: derivatives(q.copy(), v.copy()), "derivatives(q, v)", q, v)
            if not isinstance(value, tuple | list) or len(value) != 2:
                raise CustomForceError(
                    f"CustomForce {self.name}: derivatives(q, v) must return dF/dq and dF/dv, two matrices {(n, n)}, "
                    f"got {reprlib.repr(value)}"
                )
            parts = zip(value, ("dF/dq", "dF/dv"), strict=True)
            by_q, by_v = (self._read(part, f"{name} of derivatives(q, v)", (n, n), q, v) for part, name in parts)
            return by_q, by_v
        return self._complex(q, v) if self.derivatives == "complex" else self._differences(q, v)

    def _complex(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        def column(moved: int, c: int) -> Floats:
            state = [q.astype(complex), v.astype(complex)]
            state[moved][c] += 1j * _TINY
            value = self._asked(lambda: self.f(*state), "f(q, v) of complex numbers", q, v)
            return self._read(np.imag(np.asarray(value)) / _TINY, "f(q, v) of complex numbers", (q.size,), q, v)

        return self._columns(column, q.size)

    def _differences(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        by_q, by_v = self._columns(lambda moved, c: self._difference(q, v, moved, c)[0], q.size)
        return by_q, by_v

    def _difference(self, q: Floats, v: Floats, moved: int, c: int) -> tuple[Floats, float]:
        """A column of dF/dq or dF/dv, ``moved`` 0 or 1, and what it may be off by.

        The step is made smaller until differences of two orders agree: friction may turn round within a small part of
        it.
        """
        best, least = np.zeros_like(q), np.inf
        for share in _STEPS:
            size = share * max(1.0, abs(float((q, v)[moved][c])))
            high, low, force = np.zeros_like(q), np.zeros_like(q), 0.0
            for steps, weight in _WEIGHTS.items():
                for side in (1.0, -1.0):
                    state = [q.copy(), v.copy()]
                    state[moved][c] += side * steps * size
                    value = self.at(*state)
                    high += side * weight / size * value
                    low += side * _LOWER[steps] / size * value
                    force = max(force, float(np.abs(value).max(initial=0.0)))
            off = float(np.abs(high - low).max(initial=0.0)) + np.finfo(np.float64).eps * force / size
            if off < least:
                best, least = high, off
            if off <= _SMOOTH * max(1.0, force, float(np.abs(high).max(initial=0.0))):
                break
        return best, least

    @staticmethod
    def _columns(column: Callable[[int, int], Floats], n: int) -> tuple[Floats, Floats]:
        by_q, by_v = (np.column_stack([column(moved, c) for c in range(n)]) for moved in (0, 1))
        return by_q, by_v

    def _check_complex(self, n: int) -> None:
        rng = np.random.default_rng(0)
        for _ in range(_PROBES):
            self.check(*(_AROUND * rng.normal(size=(2, n))))

    def check(self, q: Floats, v: Floats) -> None:
        """Hold derivatives that are given, or taken by complex steps, against differences at a state.

        Where the function has none, at a kink or an edge, or is not defined, nothing is said: steps tell.

        Raises:
            CustomForceError: They are others.
        """
        if self.derivatives is None:
            return
        try:
            force = self.at(q, v)
            found = [[self._difference(q, v, moved, c) for c in range(q.size)] for moved in (0, 1)]
        except CustomForceError:
            return
        try:
            slopes = self.slopes(q, v)
        except CustomForceError:
            if self.derivatives == "complex":
                raise
            return
        scale = 1.0 + float(np.abs(force).max(initial=0.0))
        for name, given, columns in zip(("dF/dq", "dF/dv"), slopes, found, strict=True):
            for c, (column, off) in enumerate(columns):
                size = scale + np.abs(column)
                wrong = ~(np.abs(given[:, c] - column) <= _DOUBT * off + _AGREES * size)
                # Differences across a jump grow as their step shrinks.
                if off > _KNOWN * size.max() or not wrong.any():
                    continue
                r = int(np.argmax(np.abs(given[:, c] - column)))
                if self.derivatives == "complex":
                    why = (
                        "complex steps do not give the derivatives of f, which drops imaginary parts somewhere (abs, "
                        "comparisons, float(...)); leave derivatives out, or give a function"
                    )
                else:
                    why = "derivatives(q, v) does not return the derivatives of f"
                raise CustomForceError(
                    f"CustomForce {self.name}: {why}: {name}[{r}, {c}] is {given[r, c]:.8g}, and differences of f give "
                    f"{column[r]:.8g}, at {_place(q, v)}"
                )

    def _asked(self, call: Callable[[], object], what: str, q: Floats, v: Floats) -> object:
        try:
            return call()
        except Exception as error:
            raise CustomForceError(f"CustomForce {self.name}: {what} raised {error!r} at {_place(q, v)}") from error

    def _read(self, value: object, what: str, shape: tuple[int, ...], q: Floats, v: Floats) -> Floats:
        given = np.asarray(value)
        if given.dtype.kind not in "fiu" or given.shape != shape:
            raise CustomForceError(
                f"CustomForce {self.name}: {what} must return real numbers of shape {shape}, got "
                f"{reprlib.repr(value)} of shape {given.shape}"
            )
        if not np.isfinite(given).all():
            raise CustomForceError(f"CustomForce {self.name}: {what} is not finite at {_place(q, v)}: {given}")
        return np.ascontiguousarray(given, dtype=np.float64)


def _place(q: Floats, v: Floats) -> str:
    return f"q = {np.array2string(q, precision=6)}, v = {np.array2string(v, precision=6)}"


@dataclass(frozen=True, eq=False)
class CustomForces(Frozen):
    """Several of them together, as the core asks for them.

    Attributes:
        parts: The forces.
        checked: Whether their derivatives have been held against differences.
    """

    parts: tuple[CustomForce, ...]
    checked: list[bool] = field(default_factory=list, repr=False)

    @property
    def names(self) -> str:
        """Of the functions."""
        return ", ".join(part.name for part in self.parts)

    def check(self, q: Floats, v: Floats) -> None:
        """:meth:`CustomForce.check` of all, at the first state that a motion starts from.

        Raises:
            CustomForceError: Derivatives are wrong.
        """
        if self.checked:
            return
        for part in self.parts:
            part.check(q, v)
        self.checked.append(True)

    def __call__(self, q: Floats, v: Floats, derivatives: bool) -> tuple[Floats, Floats, Floats]:
        """The force (n,) and, if wanted, its derivatives (n, n) in q and v.

        An iterate that is not finite has none that is.
        """
        n = q.size
        size = n if derivatives else 0
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            return np.full(n, np.nan), np.full((size, size), np.nan), np.full((size, size), np.nan)
        F, by_q, by_v = np.zeros(n), np.zeros((size, size)), np.zeros((size, size))
        for part in self.parts:
            F += part.at(q, v)
            if derivatives:
                own_q, own_v = part.slopes(q, v)
                by_q += own_q
                by_v += own_v
        return F, by_q, by_v
