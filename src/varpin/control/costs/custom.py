"""Costs of one's own: a function, its derivatives given or by differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.control.costs.base import BoundCost, Cost, CostError, Expansion, Points
from varpin.support.checks import as_floats, finite_array, require_function

Function = Callable[[Floats, Floats, Floats, Floats], ArrayLike]
Derivatives = Callable[[Floats, Floats, Floats, Floats], tuple[ArrayLike, ArrayLike]]

# Step of differences, by the size of what is moved: between 1e-4 and 1e-2 errors of rounding and of order balance.
_STEP = 1e-3
# Asymmetry of a Hessian, by its largest entry, that is no rounding.
_SYMMETRY = 1e-8
# Errors of differences, by the largest entry and by the function's size over the step, of gradients and of Hessians.
_ERRORS = (1e-6, 1e-11), (1e-4, 1e-12)


@dataclass(frozen=True, eq=False, repr=False)
class CustomCost(Cost):
    """A cost of one's own, evaluated at many points at once.

        near = vp.CustomCost(lambda t, q, v, u: np.exp(-((q[:, 0] - 0.3) ** 2) / 0.01), name="keep away")

    Attributes:
        function: Takes t (N,), q (N, n), v (N, n) and u (N, m); returns (N,).
        derivatives: Takes the same; returns gradient (N, 2n + m) and Hessian (N, 2n + m, 2n + m) in z = (q, v, u).
            If left out, both are differenced, in steps of 1e-3 rad or m in q, of 1e-3 of the largest velocity (or of 1)
            in v and of 1e-3 of the largest control in u. The gradient is then right to about 1e-8 of the function's
            size where it changes little over a step, the Hessian to 1e-5 of it.
        name: For messages.
        check: Hold ``derivatives`` against differences when the cost is first expanded.

    Raises:
        InputError: ``function`` or ``derivatives`` cannot be called.
    """

    function: Function
    derivatives: Derivatives | None = None
    name: str = "CustomCost"
    check: bool = False

    def __post_init__(self) -> None:
        for name in ("function", "derivatives"):
            value, optional = getattr(self, name), name == "derivatives"
            require_function(f"{self.name} {name}", value, "(t, q, v, u)", optional=optional)

    def _text(self) -> str:
        function = getattr(self.function, "__name__", type(self.function).__name__)
        return f"CustomCost({function})" if self.name == "CustomCost" else f"CustomCost({self.name!r})"

    def bind(self, points: Points) -> BoundCost:
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
        if self.cost.derivatives is None:
            return self._differences(np.hstack([q, v, u]))
        N, d = len(q), self.points.size
        try:
            first, second = self.cost.derivatives(self.points.t, q, v, u)
            gradient = finite_array("the gradient", first, (N, d))
            hessian = as_floats("the Hessian", second)
            hessian = finite_array("the Hessian", hessian, (1, d, d) if hessian.shape == (1, d, d) else (N, d, d))
        except Exception as error:
            raise CostError(self.cost.name, f"derivatives(t, q, v, u) failed: {error}") from error
        gap = np.abs(hessian - np.swapaxes(hessian, 1, 2))
        off = gap > _SYMMETRY * np.abs(hessian).max(axis=(1, 2), initial=0.0, keepdims=True)
        if off.any():
            j, a, b = np.argwhere(off)[0]
            both = f"Hessian[{j}, {a}, {b}] is {hessian[j, a, b]:.6g} and Hessian[{j}, {b}, {a}] {hessian[j, b, a]:.6g}"
            raise CostError(self.cost.name, f"the Hessian must be symmetric: {both}")
        if self.unchecked:
            self._check((gradient, hessian), np.hstack([q, v, u]))
            self.unchecked = False
        return Expansion(gradient, hessian)

    def _check(self, given: tuple[Floats, Floats], z: Floats) -> None:
        """Hold the user's derivatives against differences; the first entry that is off is an error."""
        found, h = self._differences(z), self._steps(z)
        steps = h, h[:, None] * h
        # What is wrong with the differences themselves goes with the function's size, or with what it varies by where
        # it is zero, over lengths of 1000 steps.
        size = np.abs(self._call(self.points.t, *self._blocks(z))).max(initial=0.0)
        size = max(size, float((np.abs(found.hessian) * steps[1]).max(initial=0.0)) / _STEP**2)
        differences = found.gradient, found.hessian
        for i, name in enumerate(("gradient", "Hessian")):
            claimed, expected = np.broadcast_to(given[i], differences[i].shape), differences[i]
            relative, absolute = _ERRORS[i]
            # Not "greater": differences that are NaN must not pass.
            off = ~(np.abs(claimed - expected) <= relative * np.abs(expected).max(axis=0) + absolute * size / steps[i])
            if off.any():
                where = tuple(int(i) for i in np.argwhere(off)[0])
                raise CostError(
                    self.cost.name,
                    f"{name}{list(where)} from derivatives(t, q, v, u) is {claimed[where]:.6g}, but differences of the "
                    f"function give {expected[where]:.6g}, at t = {self.points.t[where[0]]:.6g} s",
                )

    def _blocks(self, z: Floats) -> list[Floats]:
        return np.split(z, [self.points.dof, 2 * self.points.dof], axis=1)

    def _steps(self, z: Floats) -> Floats:
        _, speed, control = (np.abs(block).max(initial=0.0) for block in self._blocks(z))
        sizes = [1.0, max(1.0, speed), control or 1.0]
        return _STEP * np.repeat(sizes, [self.points.dof, self.points.dof, self.points.controls])

    def _differences(self, z: Floats) -> Expansion:
        """Central differences: of fourth order for the gradient, of second for the Hessian."""
        (N, d), size = z.shape, self._steps(z)
        steps = np.diag(size)

        def at(step: Floats) -> Floats:
            return self._call(self.points.t, *self._blocks(z + step))

        middle, ahead, behind = at(np.zeros(d)), [at(e) for e in steps], [at(-e) for e in steps]
        gradient, hessian = np.empty((N, d)), np.empty((N, d, d))
        for a, e in enumerate(steps):
            outer = at(2.0 * e) - at(-2.0 * e)
            gradient[:, a] = (8.0 * (ahead[a] - behind[a]) - outer) / (12.0 * size[a])
            hessian[:, a, a] = (ahead[a] - 2.0 * middle + behind[a]) / size[a] ** 2
            for b in range(a):
                both = at(e + steps[b]) + at(-e - steps[b])
                mixed = both - ahead[a] - behind[a] - ahead[b] - behind[b] + 2.0 * middle
                hessian[:, a, b] = hessian[:, b, a] = mixed / (2.0 * size[a] * size[b])
        return Expansion(gradient, hessian)
