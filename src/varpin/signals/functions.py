"""Controls that are functions: control laws, and functions of time, of which a step takes their own moments.

The control within a step is the polynomial with the function's own moments: that of degree s - 1 for a method of s
stages, so that the impulse and s - 1 moments more are right. What is left is orthogonal to all polynomials of lower
degree, which keeps the order 2 s of Gauss's methods and 2 s - 1 of Radau's: a smooth motion integrates it to
zero up to terms of higher order. A quadrature that is refined where it has not settled finds the moments.
"""

from __future__ import annotations

import functools
import io
import logging
import math
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FunctionType
from typing import Any

import cloudpickle
import numpy as np
from numpy.polynomial.legendre import legvander

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Commands
from varpin.errors import ControlError, InputError
from varpin.finding import Finding
from varpin.mechanics.scene import Scene
from varpin.signals.commands import Times, changing, open_loop, prescribing
from varpin.signals.policy import OpenLoop
from varpin.support.checks import JointValues, control_values, finite_array, require_finite, takes
from varpin.support.frozen import Frozen

logger = logging.getLogger(__name__)

ControlLaw = Callable[[float, Floats, Floats], JointValues]
Copies = Callable[[], ControlLaw]
# Values (K, m) of a function at times (K,) [s] in steps (K,).
Values = Callable[[Floats, Integers], Floats]

# Number of moments: one for each stage of the method with the most.
MOMENTS = 8
# Length of a panel [s] and its points: none of them are more than 0.8 ms apart, so that no blow of a millisecond is
# missed; those of steps of at most 2.5 ms, which are as near to each other. Halves of a panel have as many points, so
# that they see what the panel has seen at its ends.
_PANEL, _POINTS, _SHORT, _FEW = 0.01, 20, 2.5e-3, 8
# A panel has settled where the last few coefficients of its Legendre series, times its share of the step, are below a
# share of the largest value: jumps are then found to 1e-9 of a step. From 1e-7 to 1e-11 motions agree to that.
_SETTLED = 1e-9
# Distance of a panel's outermost values from its ends, as a share of its half: jumps at the ends are beyond them.
_INSIDE = 1e-9
# Halvings of a panel, and evaluations of a step on average, after which it counts as unsettled.
_HALVINGS, _MOST = 40, 2000


def require_law(law: ControlLaw) -> None:
    """Refuse a function that cannot be called with (t, q, v)."""
    if takes(law, 3):
        return
    if takes(law, 1):
        raise InputError(
            "controls is a function of one argument; a control law takes (t, q, v), and controls that are a function "
            "of time alone are given as varpin.OpenLoop(f)"
        )
    raise InputError("controls must be a function of (t, q, v): it cannot be called with three arguments")


def decision(law: ControlLaw, scene: Scene, step: int, time: float, q: Floats, v: Floats) -> Floats:
    """The control (1, m) of the period that begins with a step, at its time [s]; a ControlError if the law failed."""
    read = _reader("controls(t, q, v)", scene)
    return _called("controls(t, q, v)", lambda: law(time, q.copy(), v.copy()), read, step, time)[None]


class _Copier(cloudpickle.Pickler):  # type: ignore[misc]
    """Writes a law and what it changes: functions of the law's module by value, too."""

    def __init__(self, file: io.BytesIO, law: Any) -> None:
        super().__init__(file)
        while isinstance(law, functools.partial):
            law = law.func
        self._module = getattr(law, "__module__", None)
        self.shared = list[object]()

    def persistent_id(self, value: object) -> int | None:
        if not (isinstance(value, Frozen) or type(value).__module__.startswith("pinocchio")):
            return None
        self.shared.append(value)
        return len(self.shared) - 1

    def reducer_override(self, value: object) -> Any:
        if isinstance(value, FunctionType) and value.__module__ == self._module:
            return self._dynamic_function_reduce(value)
        found = super().reducer_override(value)
        if not isinstance(value, type) or found is NotImplemented or len(found[1]) == 1:
            return found
        # Without its identifier, the last but one, a class is made anew: with it, copies of methods would replace those
        # of the user's own class.
        make, (*arguments, _, extra), *rest = found
        return make, (*arguments, None, extra), *rest


def copier(law: ControlLaw) -> Copies | None:
    """What makes copies of a control law as it is now, with all that it changes when it is called; None if it cannot.

    Copies are by value, as of functions that are sent to other processes: calls of a copy change nothing of the user's
    but what stands in modules that the law imports. Frozen objects, and those of Pinocchio, are shared.
    """
    file = io.BytesIO()
    writer = _Copier(file, law)

    def copy() -> ControlLaw:
        reader = pickle.Unpickler(io.BytesIO(file.getvalue()))
        reader.persistent_load = writer.shared.__getitem__  # type: ignore[method-assign]
        made: ControlLaw = reader.load()
        return made

    try:
        writer.dump(law)
        copy()
    except Exception as error:
        # What a law refers to may be anything: a socket, a running generator.
        logger.debug("a control law cannot be copied: %r", error)
        return None
    return copy


@dataclass(frozen=True)
class Moments:
    """A function of time over N steps.

    Attributes:
        series: Coefficients (N, K, m) of its Legendre series over each step.
        rest: Root mean square (N, s) of what is beyond the first s = 1 .. K terms, for the worst control.
        extremes: The least and the largest value of each control seen in each step (2, N, m).
        unsettled: Steps whose quadrature has not settled (U,).
    """

    series: Floats
    rest: Floats
    extremes: Floats
    unsettled: Integers

    @property
    def largest(self) -> float:
        """The largest absolute value seen."""
        return float(np.abs(self.extremes).max(initial=0.0))

    def at(self, times: Sequence[float]) -> Floats:
        """The polynomials with the function's moments, at ``times`` (s,) of each step: (N, s, m)."""
        values: Floats = legvander(2.0 * np.array(times) - 1.0, len(times) - 1) @ self.series[:, : len(times)]
        return values

    def part(self, first: int, last: int) -> Moments:
        """Steps first .. last of them."""
        taken = slice(first, last)
        here = self.unsettled[(self.unsettled >= first) & (self.unsettled < last)]
        return Moments(self.series[taken], self.rest[taken], self.extremes[:, taken], here)

    @property
    def mean(self) -> Floats:
        """The means over the steps (N, m)."""
        return self.series[:, 0]


def moments_of(values: Values, first: int, count: int, dt: float, breaks: Sequence[float] = ()) -> Moments:
    """The moments over ``count`` steps of ``dt`` [s] from ``first`` on of a function that jumps at ``breaks`` [s]."""
    step, begin, width = _panels(first, count, dt, np.array(breaks, dtype=np.float64))
    total, square, spent = np.zeros((0, 0, 0)), np.zeros((0, 0)), 0
    extremes = np.zeros((2, 0, 0))
    unsettled = np.zeros(0, dtype=np.int64)
    points = _POINTS if dt > _SHORT else _FEW
    x, weights, to_series, to_ends = _rule(points)
    for halving in range(_HALVINGS + 1):
        inside = begin[:, None] + width[:, None] * x
        found = values(((first + step)[:, None] + inside).ravel() * dt, np.repeat(first + step, len(x)))
        found = found.reshape(len(step), len(x), -1)
        spent += len(step) * len(x)
        if not total.size:
            total = np.zeros((count, MOMENTS, found.shape[2]))
            square = np.zeros((count, found.shape[2]))
            extremes = np.repeat([[[np.inf]], [[-np.inf]]], count, axis=1) + square
        np.minimum.at(extremes[0], step, found.min(axis=1))
        np.maximum.at(extremes[1], step, found.max(axis=1))
        # The gaps between the outermost points and the ends have values of their own.
        inside, ends, found = inside[:, 1:-1], found[:, [0, -1]], found[:, 1:-1]
        tail = np.abs(np.einsum("kp,jpm->jkm", to_series[-(points // 3) :], found)).max(axis=(1, 2), initial=0.0)
        beside = np.abs(np.einsum("ep,jpm->jem", to_ends, found) - ends).max(axis=(1, 2), initial=0.0)
        tail = np.maximum(tail, x[1] * beside)
        last = halving == _HALVINGS or spent > _MOST * count + _MOST * 50
        open_ = tail * width > _SETTLED * np.abs(extremes).max(initial=0.0)
        done = np.ones_like(open_) if last else ~open_
        # Moments about the whole step, from the values at the points of its panels.
        basis = legvander(2.0 * inside[done] - 1.0, MOMENTS - 1) * (width[done, None, None] * weights[:, None])
        np.add.at(total, step[done], np.einsum("jpk,jpm->jkm", basis, found[done]))
        np.add.at(square, step[done], np.einsum("j,p,jpm->jm", width[done], weights, found[done] ** 2))
        if last:
            unsettled = np.unique(first + step[open_])
        if last or not open_.any():
            break
        step, half = np.repeat(step[open_], 2), np.repeat(0.5 * width[open_], 2)
        begin = np.repeat(begin[open_], 2) + np.tile([0.0, 1.0], int(open_.sum())) * half
        width = half
    degrees = 2.0 * np.arange(MOMENTS) + 1.0
    power = np.cumsum(degrees[:, None] * total**2, axis=1)
    rest = np.sqrt(np.maximum(square[:, None] - power, 0.0)).max(axis=2, initial=0.0)
    return Moments(degrees[:, None] * total, rest, extremes, unsettled)


def none_of(controls: int) -> Moments:
    """The moments over no steps."""
    shape = 0, MOMENTS
    return Moments(np.zeros((*shape, controls)), np.zeros(shape), np.zeros((2, 0, controls)), np.zeros(0, np.int64))


def joined(parts: Sequence[Moments]) -> Moments:
    """Consecutive steps as one."""
    if len(parts) == 1:
        return parts[0]
    series, rest, unsettled = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("series", "rest", "unsettled")
    )
    return Moments(series, rest, np.concatenate([part.extremes for part in parts], axis=1), unsettled)


def _panels(first: int, count: int, dt: float, breaks: Floats) -> tuple[Integers, Floats, Floats]:
    """Panels of steps: the step of each from 0 on, its begin and its width in units of a step."""
    number = max(1, int(np.ceil(dt / _PANEL)))
    edges = (np.arange(count)[:, None] + np.arange(number) / number).ravel()
    at = breaks / dt - first
    edges = np.unique(np.concatenate([edges, at[(at > 0.0) & (at < count)]]))
    step = edges.astype(np.int64)
    return step, edges - step, np.diff(np.append(edges, float(count)))


@functools.cache
def _rule(points: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Points of a panel with its ends (p + 2,), weights (p,), and matrices to the series (p, p) and its ends (2, p)."""
    x, w = np.polynomial.legendre.leggauss(points)
    degrees = np.arange(points)
    to_series = (0.5 * (2.0 * degrees + 1.0))[:, None] * (legvander(x, points - 1) * w[:, None]).T
    ends = np.array([_INSIDE - 1.0, 1.0 - _INSIDE])
    at = 0.5 * (1.0 + np.concatenate([ends[:1], x, ends[1:]]))
    return at, 0.5 * w, to_series, legvander(ends, points - 1) @ to_series


class Sampled(OpenLoop):
    """A function of time with its moments over the steps so far, for the motion and its repetition alike."""

    scene: Scene
    dt: float
    parts: list[Moments]
    done: int

    def __init__(self, given: OpenLoop, scene: Scene, dt: float) -> None:
        super().__init__(given.f, given.vectorized, given.breaks)
        # The frozen dataclass refuses assignments.
        vars(self).update(scene=scene, dt=dt, parts=[none_of(scene.controls)], done=0)

    @property
    def whole(self) -> Moments:
        """The moments over all steps so far."""
        self.parts[:] = [joined(self.parts)]
        return self.parts[0]

    def moments(self, first: int, last: int) -> Moments:
        """The moments over steps first .. last, of which the first is known or the next; a ControlError if f failed."""
        if last > self.done:
            values = functools.partial(_values, self, self.scene)
            self.parts.append(moments_of(values, self.done, last - self.done, self.dt, self.breaks))
            before, vars(self)["done"] = self.done, last
            if first == before:
                return self.parts[-1]
        return self.whole.part(first, last)

    def commands(self, first: int, steps: int, times: Times) -> Commands:
        """The controls of ``steps`` steps from ``first`` on, for stages at ``times`` of a step.

        Kinematic inputs move to the values at the ends of the steps. Raises a ControlError if the function failed.
        """
        found = self.moments(first, first + steps)
        commands = changing(found.at(times), times) if times else open_loop(found.mean)
        if not len(self.scene.prescribed):
            return commands
        at = np.arange(first, first + steps)
        ends = _values(self, self.scene, np.float64(self.dt) * (at + 1.0), at)
        return prescribing(self.scene, commands, ends)


def function_findings(controls: Sampled) -> tuple[Finding, ...]:
    """A warning if the quadrature of a function of time has not settled in some steps."""
    steps = controls.whole.unsettled.tolist()
    if not steps:
        return ()
    text = (
        f"the controls of OpenLoop change too fast in {len(steps)} steps for their impulse to be known "
        f"(from t = {steps[0] * controls.dt:.3g} s). Name the instants of jumps, OpenLoop(f, breaks=[...])"
    )
    return (Finding("fast controls", text, time=steps[0] * controls.dt, value=float(len(steps)), unit="steps"),)


def left_by_stages(controls: Sampled, stages: int) -> float:
    """What polynomials through so many stages leave of the function in the worst step, as a share of its largest value.

    A root mean square; infinite where the quadrature of a step has not settled.
    """
    found = controls.whole
    rest = float(found.rest[:, max(1, stages) - 1].max(initial=0.0))
    if len(found.unsettled):
        return math.inf
    return rest / found.largest if rest > 0.0 else 0.0


def _values(controls: OpenLoop, scene: Scene, times: Floats, steps: Integers) -> Floats:
    """Controls (K, m) from a function of time at times (K,) [s] within ``steps`` (K,); a ControlError if it failed."""
    f: Callable[..., Any] = controls.f
    at, m = list(zip(steps.tolist(), times.tolist(), strict=True)), scene.controls
    if not controls.vectorized:
        name = "OpenLoop: f(t)"
        read = _reader(name, scene)
        found = [_called(name, functools.partial(f, time), read, step, time) for step, time in at]
        return np.array(found).reshape(len(at), m)
    name = "OpenLoop, vectorized=True: f(t) of times t (K,)"
    # The first time alone, so that rows and columns cannot be confused.
    parts = [part for part in (times[:1], times[1:]) if len(part)]
    try:
        return np.concatenate(
            [np.zeros((0, m)), *(finite_array(name, f(part.copy()), (len(part), m)) for part in parts)]
        )
    except Exception as failure:
        # Each alone, to find the first that fails.
        for step, time in at:
            alone = functools.partial(f, np.array([time]))
            _called(name, alone, lambda value: finite_array(name, value, (1, m)), step, time)
        problem = f"{name} fails for {len(times)} times at once, and for none of them alone: {failure}"
        raise ControlError(*at[0], problem) from failure


def _reader(name: str, scene: Scene) -> Callable[[JointValues], Floats]:
    """The function from what a user's function returns to the control (m,)."""
    shape, joints, isfinite = (scene.controls,), scene.control_joints, math.isfinite

    def read(value: JointValues) -> Floats:
        # The common case: all checks take longer than many functions. Squares of large values would overflow.
        if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == shape:
            own: Floats = value.copy()
            return own if all(map(isfinite, own.tolist())) else require_finite(name, own)
        with np.errstate(over="ignore", invalid="ignore"):
            return control_values(name, value, joints, *shape)

    return read


def _called(
    name: str,
    call: Callable[[], Any],
    read: Callable[[Any], Floats],
    step: int,
    time: float,
) -> Floats:
    """What a user's function returns, as ``read`` takes it; a ControlError if it raised, or returned something else."""
    try:
        value = call()
    except Exception as error:
        raise ControlError(step, time, f"{name} raised {error!r}") from error
    try:
        return read(value)
    except InputError as error:
        raise ControlError(step, time, str(error)) from None
