"""Least squares, weight . r^2 with a residual r that the core evaluates.

Their Hessians are those of Gauss and Newton, 2 J' weight J with J the residual's derivative: positive semidefinite,
and exact where r is zero or linear.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import scipy
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.control.costs.base import Cost, CostError, Points
from varpin.errors import InputError
from varpin.support.checks import as_floats, require_finite, returned

ReferenceValues = ArrayLike | Callable[[float], ArrayLike]

# Of a weight's eigenvalues, relative to its largest entry.
_ROUNDING = 1e-12
# Share of a step, by which rounding must not put a time at a node into the step before it.
_OF_STEP = 1e-6


class LeastSquares(Cost):
    """weight . r^2.

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
    if least < -_ROUNDING * np.abs(array).max(initial=0.0):
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


def checked_reference(name: str, reference: ReferenceValues) -> ReferenceValues:
    """A function of time, or an array of numbers."""
    return reference if callable(reference) else as_floats(f"{name} reference", reference)


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
        times = points.t.tolist()
        # All at once, as there may be many thousands; one by one only to say which of them is wrong.
        with contextlib.suppress(Exception):
            rows = np.array([reference(t) for t in times])
            if rows.shape == (len(times), *shape) and rows.dtype.kind in "fiu" and np.isfinite(rows).all():
                return np.ascontiguousarray(rows, dtype=np.float64)
        try:
            found = [returned("the reference", partial(reference, t), shape, f" at t = {t:.6g} s") for t in times]
        except InputError as error:
            raise CostError(name, str(error)) from error
        return np.array(found)
    array = require_finite(f"{name} reference", as_floats(f"{name} reference", reference))
    steps, N = points.steps, points.steps + 1
    if array.shape in ((), shape):
        return np.array(np.broadcast_to(array, (1, *shape)))
    if held and array.shape == (steps, *shape):
        step = np.floor(points.elapsed * (steps / points.duration) + _OF_STEP).astype(np.int64)
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
        turns = scipy.spatial.transform.Slerp(nodes, scipy.spatial.transform.Rotation.from_matrix(array))
        return np.asarray(turns(np.clip(points.elapsed, 0.0, points.duration)).as_matrix())
    return np.column_stack([np.interp(points.elapsed, nodes, column) for column in array.T])
