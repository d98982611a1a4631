"""A generalized force that a user writes in Python."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.core.arrays import Coupling, Element
from varpin.errors import InputError
from varpin.mechanics.forces import Force
from varpin.model import Robot
from varpin.support.checks import is_one_of, require_function, returned
from varpin.support.differences import EIGHTH
from varpin.support.frozen import Frozen

Field: TypeAlias = Callable[[Floats, Floats], ArrayLike]
Slopes: TypeAlias = Callable[[Floats, Floats], tuple[ArrayLike, ArrayLike]]

# Weights of central differences of sixth order at the points of those of eighth order.
_LOWER = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60, 4: 0.0}
# Largest difference of the two orders that needs no smaller step, relative to the derivative and the force.
_SMOOTH = 1e-8
# Steps of the differences, relative to max(1, |coordinate|), from the largest on.
_STEPS = (2e-3, 2e-4, 2e-5, 2e-6)
# Imaginary step of the complex-step derivative.
_TINY = 1e-200
# A derivative is right within this share of its size, plus this many error bounds of the differences.
_AGREES, _DOUBT = 1e-6, 10.0
# Differences with a larger relative error bound than this are not compared.
_KNOWN = 1e-4


class CustomForceError(InputError):
    """A function of a custom force raised, or returned a wrong type, shape or value."""


@dataclass(frozen=True, eq=False, repr=False)
class CustomForce(Force):
    """A generalized force that you write in Python: drag, a cable, a learned friction.

    Integrators evaluate it in every iteration of every stage, so they keep their order; each evaluation costs a Python
    call. The force may depend on and act on all joints. Its work enters the energy balance. Trajectories do not record
    it.

    Attributes:
        f: Function of (q (n,), v (n,)) that returns the force (n,) [N m or N] on the n coordinates of the robot.
        derivatives: Function of (q, v) that returns (dF/dq, dF/dv), each (n, n). ``"complex"``: complex steps, exact to
            rounding, for an ``f`` of analytic operations (no ``abs``, no comparisons). Both are compared with
            differences once, at the start of the first motion. Left out: central differences of eighth order with
            adaptive steps, accurate to about 1e-10 of the force where it is smooth.
    """

    f: Field
    derivatives: Slopes | Literal["complex"] | None = None

    def __post_init__(self) -> None:
        require_function("CustomForce f", self.f, "(q, v)")
        if not is_one_of(self.derivatives, ("complex",)):
            require_function("CustomForce derivatives", self.derivatives, "(q, v), or 'complex'", optional=True)

    def __repr__(self) -> str:
        how = "given" if callable(self.derivatives) else f"by {'complex steps' if self.derivatives else 'differences'}"
        return f"CustomForce({self.name}, derivatives {how})"

    @property
    def name(self) -> str:
        """Name of the function."""
        return str(getattr(self.f, "__name__", type(self.f).__name__))

    def bind(self, robot: Robot) -> tuple[Element | Coupling, ...]:  # noqa: ARG002
        """Nothing: the core calls the function itself."""
        return ()

    def at(self, q: Floats, v: Floats) -> Floats:
        """The force (n,).

        Raises:
            CustomForceError: The function raised, or its result is not a finite real array (n,).
        """
        return self._read(lambda: self.f(q.copy(), v.copy()), "f(q, v)", (q.size,), q, v)

    def slopes(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Derivatives dF/dq and dF/dv, each (n, n).

        Raises:
            CustomForceError: As :meth:`at`.
        """
        n, derivatives = q.size, self.derivatives
        if callable(derivatives):
            return tuple(self._read(lambda: derivatives(q.copy(), v.copy()), "derivatives(q, v)", (2, n, n), q, v))
        column = self._complex if derivatives == "complex" else self._difference
        by_q, by_v = (np.column_stack([column(q, v, moved, c)[0] for c in range(n)]) for moved in (0, 1))
        return by_q, by_v

    def _complex(self, q: Floats, v: Floats, moved: int, c: int) -> tuple[Floats, float]:
        """:meth:`_difference` by a complex step, without an error."""
        state = [q.astype(complex), v.astype(complex)]
        state[moved][c] += 1j * _TINY
        what = "f(q, v) of complex numbers"
        return self._read(lambda: np.imag(np.asarray(self.f(*state))) / _TINY, what, (q.size,), q, v), 0.0

    def _difference(self, q: Floats, v: Floats, moved: int, c: int) -> tuple[Floats, float]:
        """Column ``c`` (n,) of dF/dq (``moved`` 0) or dF/dv (``moved`` 1), and a bound of its error.

        The step shrinks until differences of two orders agree, since friction may change its sign within a short range.
        """
        best, least = np.zeros_like(q), np.inf

        def shifted(by: float) -> Floats:
            state = [q.copy(), v.copy()]
            state[moved][c] += by
            return self.at(*state)

        for share in _STEPS:
            size = share * max(1.0, abs(float((q, v)[moved][c])))
            ends = {k: (shifted(k * size), shifted(-k * size)) for k in EIGHTH}
            high, low = (
                np.asarray(sum(weight * (ends[k][0] - ends[k][1]) for k, weight in weights.items()) / size)
                for weights in (EIGHTH, _LOWER)
            )
            force = float(np.abs(list(ends.values())).max(initial=0.0))
            off = float(np.abs(high - low).max(initial=0.0)) + np.finfo(np.float64).eps * force / size
            if off < least:
                best, least = high, off
            if off <= _SMOOTH * max(1.0, force, float(np.abs(high).max(initial=0.0))):
                break
        return best, least

    def check(self, q: Floats, v: Floats) -> None:
        """Compare derivatives from the user or from complex steps with differences at a state.

        The check skips points where a function is not differentiable or raises; integration steps report those.

        Raises:
            CustomForceError: They differ.
        """
        if self.derivatives is None:
            return
        try:
            force = self.at(q, v)
            found = [[self._difference(q, v, moved, c) for c in range(q.size)] for moved in (0, 1)]
            slopes = self.slopes(q, v)
        except CustomForceError:
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
                why = "derivatives(q, v) is wrong"
                if self.derivatives == "complex":
                    why = "f drops imaginary parts (abs, comparisons, float): leave derivatives='complex' out"
                raise CustomForceError(
                    f"CustomForce {self.name}: {why}: {name}[{r}, {c}] is {given[r, c]:.8g}, and differences of f give "
                    f"{column[r]:.8g}, at {_state_text(q, v)}"
                )

    def _read(self, call: Callable[[], object], what: str, shape: tuple[int, ...], q: Floats, v: Floats) -> Floats:
        name = f"CustomForce {self.name}: {what}"
        return returned(name, call, shape, lambda: f" at {_state_text(q, v)}", CustomForceError)


def _state_text(q: Floats, v: Floats) -> str:
    return f"q = {np.array2string(q, precision=6)}, v = {np.array2string(v, precision=6)}"


@dataclass(frozen=True, eq=False)
class CustomForces(Frozen):
    """The sum of several custom forces, in the form that the core calls.

    Attributes:
        parts: The forces.
        checked: Not empty once the derivatives have been compared with differences.
    """

    parts: tuple[CustomForce, ...]
    checked: list[bool] = field(default_factory=list, repr=False)

    @property
    def names(self) -> str:
        """Names of the functions."""
        return ", ".join(part.name for part in self.parts)

    def check(self, q: Floats, v: Floats) -> None:
        """:meth:`CustomForce.check` of all forces at the first of the states q, v (P, n), in the first call only."""
        if self.checked or not len(q):
            return
        for part in self.parts:
            part.check(q[0], v[0])
        self.checked.append(True)

    def __call__(self, q: Floats, v: Floats, derivatives: bool) -> tuple[Floats, Floats, Floats]:
        """The force (n,) and its derivatives (n, n) in q and v, or (0, 0) without ``derivatives``.

        All are NaN where q or v is not finite.
        """
        size = q.size if derivatives else 0
        finite = np.isfinite(q).all() and np.isfinite(v).all()
        F, by_q, by_v = (np.full(shape, 0.0 if finite else np.nan) for shape in (q.size, (size, size), (size, size)))
        for part in self.parts if finite else ():
            F += part.at(q, v)
            if derivatives:
                own_q, own_v = part.slopes(q, v)
                by_q += own_q
                by_v += own_v
        return F, by_q, by_v
