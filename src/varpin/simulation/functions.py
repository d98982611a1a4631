"""Controls that are functions: control laws, and functions of time."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.errors import InputError, UnknownJoint
from varpin.integrators import Integrator
from varpin.integrators.base import open_loop
from varpin.integrators.within import changing
from varpin.mechanics.inputs import as_moved, prescribing
from varpin.mechanics.policy import FirstOrderHold, OpenLoop
from varpin.mechanics.scene import Scene
from varpin.simulation.failures import ControlError
from varpin.simulation.growth import WARNED, better, growth_bound, whole_error
from varpin.simulation.record import MotionRecord
from varpin.simulation.soundness import Finding, share_in_words
from varpin.support.checks import JointValues, control_values, finite_array, takes
from varpin.trajectory import Trajectory

ControlLaw = Callable[[float, Floats, Floats], JointValues]
# Number of steps in which the mean of a function of time is compared with that of two half steps, and the largest
# difference without a warning, as a share of the mean.
_COMPARED, _ALIKE = 16, 0.05
# The difference, as a share of what the function changes by and grown as the motion's fastest mode grows, from which on
# the motion is repeated with its values at the stages of a better method; and the part of it that may be rounding.
_SEEN, _ROUNDING = 2e-4, 1e-8
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


def sampled(controls: OpenLoop, record: MotionRecord, steps: int) -> Commands:
    """Controls of the next steps up to the first for which the function fails.

    Raises:
        ControlError: It fails for the first of them.
    """
    inputs = controls, record.scene, record.integrator, record.dt
    try:
        return evaluated(*inputs, range(record.steps, record.steps + steps), record)
    except ControlError as error:
        if error.step == record.steps:
            raise
        return evaluated(*inputs, range(record.steps, error.step), record)


def evaluated(
    controls: OpenLoop,
    scene: Scene,
    integrator: Integrator,
    dt: float,
    steps: Iterable[int],
    record: MotionRecord | None = None,
) -> Commands:
    """Controls that are a function of time at the stages of some steps, or in their middles for one-stage methods."""
    times, numbers = integrator.stage_times, np.array(steps, dtype=np.int64)
    # Kinematic inputs move to the values at the ends of steps.
    fractions = (*(times or (0.5,)), *((1.0,) if scene.inputs else ()))
    at = (numbers[:, None] + np.array(fractions)) * dt
    values = _at_all_times if controls.vectorized else _at_times
    if times and times[0] == 0.0 and times[-1] == 1.0:
        # The first stage of a step is the last stage of the step before.
        called = np.ones(at.shape, dtype=np.bool_)
        called[1:, 0] = np.diff(numbers) != 1
        found = np.empty((*at.shape, scene.controls))
        found[called] = values(controls.f, scene, at[called], np.repeat(numbers, called.sum(axis=1)), record)
        shared = np.flatnonzero(~called[:, 0])
        found[shared, 0] = found[shared - 1, -1]
    else:
        found = values(controls.f, scene, at.ravel(), np.repeat(numbers, at.shape[1]), record)
        found = found.reshape(*at.shape, scene.controls)
    ends, found = found[:, -1], found[:, : len(times) or 1]
    return prescribing(scene, changing(found, times) if times else open_loop(found[:, 0]), ends)


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


@functools.lru_cache(maxsize=64)
def _compared(steps: int) -> tuple[int, ...]:
    """The steps of a motion in which means are compared."""
    return tuple(np.unique(np.linspace(0, steps - 1, _COMPARED).astype(np.int64)).tolist())


def undersampled(
    controls: OpenLoop, scene: Scene, integrator: Integrator, trajectory: Trajectory, *, right: bool
) -> tuple[Finding, ...]:
    """A warning if the mean of a function of time over a step differs from that of two half steps.

    A motion has the function's values at its stages alone. If it is ``right`` with these, it is repeated with those at
    the stages of a better method wherever the means differ at all.
    """
    dt, times = trajectory.dt, integrator.stage_times
    if not trajectory.steps:
        return ()
    at = _compared(trajectory.steps)
    try:
        halves = evaluated(controls, scene, integrator, 0.5 * dt, [2 * k + i for k in at for i in (0, 1)])
    except ControlError:
        return ()
    mean, taken = 0.5 * (halves.u[::2] + halves.u[1::2]), trajectory.u[list(at)]
    if len(scene.prescribed):
        forces = np.setdiff1d(np.arange(scene.controls), scene.prescribed)
        mean, taken = mean[:, forces], taken[:, forces]
    total, off = (float(np.abs(part).sum()) for part in (mean, mean - taken))
    if not off > _ALIKE * total:
        least = _SEEN * float(np.abs(mean - mean.mean(axis=0)).sum())
        may_matter = right and off > _ROUNDING * least and off * growth_bound(scene, trajectory) > least
        return _moved_within(controls, scene, integrator, trajectory) if may_matter else ()
    stages = f"{len(times)} stages of a step" if times else "middle of a step"
    return (
        Finding(
            "fast controls",
            f"the controls of OpenLoop change too fast for dt = {dt:g} s: their means over a step, from the {stages}, "
            f"are off by {100.0 * off / total:.3g}% of those in half the step"
            if total > 0.0
            else f"the controls of OpenLoop change too fast for dt = {dt:g} s: half the step sees none of them",
        ),
    )


def _moved_within(
    controls: OpenLoop, scene: Scene, integrator: Integrator, trajectory: Trajectory
) -> tuple[Finding, ...]:
    """A warning if values of a function of time at the stages of a better method move the joints elsewhere."""
    other, dt = better(integrator, trajectory), trajectory.dt
    times = other.method.stage_times
    if scene.inputs or not times:
        return ()
    try:
        values = evaluated(controls, scene, other.method, dt, range(trajectory.steps)).within
    except ControlError:
        return ()
    found = whole_error(scene, trajectory.changed(u_stages=values), other, times)
    if found is None or found[2] < WARNED:
        return ()
    joint, off, share = found
    name = trajectory.joint_names[joint]
    return (
        Finding(
            "fast controls",
            f"the controls of OpenLoop change too fast for dt = {dt:g} s: with their values at {len(times)} instants "
            f"of each step a method of more stages moves joint {name!r} by up to "
            f"{share_in_words(scene, joint, off, share)}",
            joint,
        ),
    )


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
        sentence = (
            f"control {k}, of a KinematicInput, is {first[k]:.6g} at t = 0, and the motion begins with {there[k]:.6g}: "
            "the joint makes up for the difference within the first step"
        )
        found.append(Finding("jump at the start", sentence))
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
