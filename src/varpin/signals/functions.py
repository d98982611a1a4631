"""Controls that are functions: control laws, and functions of time, of which a step takes their own moments."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Commands
from varpin.errors import ControlError, InputError, UnknownJoint
from varpin.finding import Finding
from varpin.mechanics.scene import Scene
from varpin.signals.commands import Times, changing, open_loop
from varpin.signals.inputs import prescribing
from varpin.signals.moments import Moments, joined, moments_of, none_of
from varpin.signals.policy import OpenLoop
from varpin.support.checks import JointValues, control_values, finite_array, require_finite, takes

ControlLaw = Callable[[float, Floats, Floats], JointValues]


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
    """The control (1, m) of the period that begins with a step, at its time [s] and state (n,), (n,).

    Raises:
        ControlError: The law failed.
    """
    read = _reader("controls(t, q, v)", scene)
    return _called("controls(t, q, v)", lambda: law(time, q.copy(), v.copy()), read, step, time)[None]


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
        """The moments over steps first .. last, which begin at a step that is known or the next one.

        Raises:
            ControlError: The function failed.
        """
        if last > self.done:
            values = functools.partial(_values, self, self.scene)
            self.parts.append(moments_of(values, self.done, last - self.done, self.dt, self.breaks))
            before, vars(self)["done"] = self.done, last
            if first == before:
                return self.parts[-1]
        return self.whole.part(first, last)

    def commands(self, first: int, steps: int, times: Times) -> Commands:
        """The controls of ``steps`` steps from ``first`` on, for stages at ``times`` of a step.

        Kinematic inputs move to the values at the ends of the steps.

        Raises:
            ControlError: The function failed.
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
    """Controls (K, m) from a function of time at times (K,) [s] within ``steps`` (K,).

    Raises:
        ControlError: The function raised, or returned something else.
    """
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
        # The common case: all checks take longer than many functions.
        if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == shape:
            own: Floats = value.copy()
            return own if isfinite(own.dot(own)) else require_finite(name, own)
        return control_values(name, value, joints, *shape)

    return read


def _called(
    name: str,
    call: Callable[[], Any],
    read: Callable[[Any], Floats],
    step: int,
    time: float,
) -> Floats:
    """What a user's function returns, as ``read`` takes it.

    Raises:
        ControlError: The function raised, or returned something else.
    """
    try:
        value = call()
    except Exception as error:
        raise ControlError(step, time, f"{name} raised {error!r}") from error
    try:
        return read(value)
    except (InputError, UnknownJoint) as error:
        raise ControlError(step, time, str(error)) from None
