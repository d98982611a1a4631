"""Costs of one's own: a function, its derivatives given or by differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.control.costs.base import BoundCost, Cost, CostError, Expansion, Points
from varpin.errors import InputError
from varpin.support.checks import as_floats, finite_array

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
        function = getattr(self.function, "__name__", type(self.function).__name__)
        return f"CustomCost({function})" if self.name == "CustomCost" else f"CustomCost({self.name!r})"

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
        for name, derivative, expected, tolerance in (
            ("gradient", given.gradient, found.gradient, 1e-6 * first.max(axis=0) + 1e-11 * size / h),
            ("Hessian", given.hessian, found.hessian, 1e-4 * second.max(axis=0) + 1e-12 * size / (h[:, None] * h)),
        ):
            claimed = np.broadcast_to(derivative, expected.shape)
            # Not "greater": differences that are NaN must not pass.
            off = ~(np.abs(claimed - expected) <= tolerance)
            if off.any():
                where = tuple(int(i) for i in np.argwhere(off)[0])
                raise CostError(
                    self.cost.name,
                    f"{name}{list(where)} from derivatives(t, q, v, u) is {claimed[where]:.6g}, but differences of the "
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
