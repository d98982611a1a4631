"""Controls that are functions: control laws, and functions of time, of which a step takes their own moments."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Commands
from varpin.errors import InputError, UnknownJoint
from varpin.finding import Finding
from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene
from varpin.signals.commands import changing, open_loop
from varpin.signals.inputs import as_moved, prescribing
from varpin.signals.moments import Moments, joined, moments_of
from varpin.signals.policy import FirstOrderHold, OpenLoop
from varpin.simulation.failures import ControlError
from varpin.simulation.record import MotionRecord
from varpin.support.checks import JointValues, control_values, finite_array, takes

ControlLaw = Callable[[float, Floats, Floats], JointValues]
# Root mean square of what a step's polynomial leaves of a function of time, as a share of its largest value, up to
# which the motion's own residual shows its error: a third order of it is lost.
_RESOLVED = 0.02
# Distance of a kinematic input from its control at the start [rad or m, rad/s or m/s] without a warning.
_ELSEWHERE = 1e-6
# Name of a function of time in errors.
_OF_TIME = "OpenLoop: f(t)"
_OF_TIMES = "OpenLoop, vectorized=True: f(t) of times t (K,)"


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


def decision(law: ControlLaw, record: MotionRecord) -> Floats:
    """The control (1, m) of the period that begins at the last node."""
    k = record.steps
    time = k * record.dt
    state = record.last.q[-1].copy(), record.last.v[-1].copy()
    return _called("controls(t, q, v)", lambda: law(time, *state), record.scene, k, time, record)[None]


class Sampled(OpenLoop):
    """A function of time with its moments over the steps so far, for the motion and its repetition alike."""

    scene: Scene
    dt: float
    parts: list[Moments]
    done: int

    def __init__(self, given: OpenLoop, scene: Scene, dt: float) -> None:
        super().__init__(given.f, given.vectorized, given.breaks)
        # The frozen dataclass refuses assignments.
        vars(self).update(scene=scene, dt=dt, parts=[], done=0)

    @property
    def extremes(self) -> Floats | None:
        """The least and the largest controls in each step so far (2, N, m)."""
        return joined(self.parts).extremes if self.parts else None

    def moments(self, first: int, last: int, record: MotionRecord | None) -> Moments:
        """The moments over steps first .. last, which begin at a step that is known or the next one.

        Raises:
            ControlError: The function failed.
        """
        if last > self.done:
            values = _at_all_times if self.vectorized else _at_times

            def at(times: Floats, steps: Integers) -> Floats:
                return values(self.f, self.scene, times, steps, record)

            fresh = moments_of(at, self.done, last - self.done, self.dt, self.breaks)
            self.parts.append(fresh)
            before, vars(self)["done"] = self.done, last
            if first == before:
                return fresh
        return joined(self.parts).part(first, last)


def sampled(controls: Sampled, record: MotionRecord, steps: int) -> Commands:
    """Controls of the next steps up to the first for which the function fails.

    Raises:
        ControlError: It fails for the first of them.
    """
    first = record.steps
    try:
        found = controls.moments(first, first + steps, record)
    except ControlError as error:
        if error.step == first:
            raise
        found = controls.moments(first, error.step, record)
    return of_time(controls, found, record.integrator, first, record)


def of_time(
    controls: Sampled, found: Moments, integrator: Integrator, first: int = 0, record: MotionRecord | None = None
) -> Commands:
    """The controls of steps from ``first`` on with given moments; kinematic inputs move to the values at their ends."""
    times, scene = integrator.stage_times, controls.scene
    commands = changing(found.at(times), times) if times else open_loop(found.mean)
    if not len(scene.prescribed):
        return commands
    steps = np.arange(first, first + len(found.series))
    values = _at_all_times if controls.vectorized else _at_times
    return prescribing(
        scene, commands, values(controls.f, scene, np.float64(controls.dt) * (steps + 1.0), steps, record)
    )


def function_findings(controls: Sampled, duration: float) -> tuple[Finding, ...]:
    """Warnings: the quadrature of a function of time has not settled in some steps, or no break is in the motion."""
    found: list[Finding] = []
    steps = joined(controls.parts).unsettled.tolist() if controls.parts else []
    if steps:
        text = (
            f"the controls of OpenLoop change too fast in {len(steps)} steps for their impulse to be known "
            f"(from t = {steps[0] * controls.dt:.3g} s). Name the instants of jumps, OpenLoop(f, breaks=[...])"
        )
        found.append(Finding("fast controls", text, time=steps[0] * controls.dt, value=float(len(steps)), unit="steps"))
    if controls.breaks and not any(0.0 <= at <= duration for at in controls.breaks):
        text = f"breaks of OpenLoop are from {controls.breaks[0]:.4g} s on, outside the motion: they are in [s]"
        found.append(Finding("breaks outside", text, time=controls.breaks[0]))
    return tuple(found)


def resolved(controls: Sampled, integrator: Integrator) -> bool:
    """Whether the polynomials that a method takes are nearly the function itself in all steps."""
    if not controls.parts:
        return True
    found = joined(controls.parts)
    rest = found.rest[:, max(1, len(integrator.stage_times)) - 1]
    return bool(rest.max(initial=0.0) <= _RESOLVED * found.largest) and not len(found.unsettled)


def _at_times(
    f: Callable[..., Any], scene: Scene, times: Floats, steps: NDArray[np.int64], record: MotionRecord | None
) -> Floats:
    """Controls (K, m) from a function of time at times (K,) [s] within ``steps`` (K,).

    Raises:
        ControlError: The function raised, or returned something else.
    """
    found = np.empty((len(times), scene.controls))
    shape, isfinite = found.shape[1:], math.isfinite
    for k, at in enumerate(times.tolist()):
        try:
            value = f(at)
        except Exception as error:
            raise _error_raised(_OF_TIME, error, int(steps[k]), at, record) from error
        # The common case, without the checks of _control: these take longer than many functions.
        if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == shape:
            found[k] = value
            if isfinite(value.dot(value)):
                continue
        found[k] = _control(_OF_TIME, value, scene, int(steps[k]), at, record)
    return found


def _at_all_times(
    f: Callable[..., Any], scene: Scene, times: Floats, steps: NDArray[np.int64], record: MotionRecord | None
) -> Floats:
    """:func:`_at_times` for a vectorized function.

    The first time is evaluated alone, so that rows and columns cannot be confused. If the call for all others fails,
    each is evaluated alone to find the first that fails.
    """
    m = scene.controls
    parts = [part for part in (times[:1], times[1:]) if len(part)]
    try:
        values = [finite_array(_OF_TIMES, f(part.copy()), (len(part), m)) for part in parts]
    except Exception as failure:
        for step, at in zip(steps.tolist(), times.tolist(), strict=True):
            try:
                value = f(np.array([at]))
            except Exception as error:
                raise _error_raised(_OF_TIMES, error, step, at, record) from error
            try:
                finite_array(_OF_TIMES, value, (1, m))
            except InputError as error:
                raise _control_error(step, at, str(error), record) from None
        raise _control_error(
            int(steps[0]),
            float(times[0]),
            f"{_OF_TIMES} fails for {len(times)} times at once, and for none of them alone: {failure}",
            record,
        ) from failure
    return np.concatenate(values) if values else np.zeros((0, m))


def begins_elsewhere(controls: OpenLoop | FirstOrderHold, scene: Scene, q0: Floats, v0: Floats) -> tuple[Finding, ...]:
    """A warning if a kinematic input's control at the first node differs from the motion's start (q0, v0)."""
    if not scene.inputs:
        return ()
    if isinstance(controls, OpenLoop):
        values = _at_all_times if controls.vectorized else _at_times
        first = values(controls.f, scene, np.zeros(1), np.zeros(1, dtype=np.int64), None)[0]
    else:
        first = controls.u[0]
    found = []
    there = as_moved(scene, q0, v0, first)
    for k in scene.prescribed[np.abs(there - first)[scene.prescribed] > _ELSEWHERE].tolist():
        text = (
            f"control {k}, of a KinematicInput, is {first[k]:.6g} at t = 0 and the motion begins with {there[k]:.6g}: "
            "the joint jumps in the first step. Start there, or give another control"
        )
        found.append(Finding("jump at the start", text, time=0.0, value=float(there[k] - first[k])))
    return tuple(found)


def _called(
    name: str, call: Callable[[], JointValues], scene: Scene, step: int, time: float, record: MotionRecord | None
) -> Floats:
    """The control (m,) that a user's function returns.

    Raises:
        ControlError: The function raised, or returned no control.
    """
    try:
        value = call()
    except Exception as error:
        raise _error_raised(name, error, step, time, record) from error
    return _control(name, value, scene, step, time, record)


def _control(
    name: str, value: JointValues, scene: Scene, step: int, time: float, record: MotionRecord | None
) -> Floats:
    """The value of a user's function as a control (m,).

    Raises:
        ControlError: The value is no control.
    """
    try:
        return control_values(name, value, scene.control_joints, scene.controls)
    except (InputError, UnknownJoint) as error:
        raise _control_error(step, time, str(error), record) from None


def _error_raised(name: str, error: Exception, step: int, time: float, record: MotionRecord | None) -> ControlError:
    """The error of a user's function that raised."""
    return _control_error(step, time, f"{name} raised {error!r}", record)


def _control_error(step: int, time: float, problem: str, record: MotionRecord | None) -> ControlError:
    """The error of a user's function, with the motion before it."""
    return ControlError(step, time, problem, None if record is None else record.trajectory())
