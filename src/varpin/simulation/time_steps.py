"""The time step of a motion and the number of its steps, as given."""

from __future__ import annotations

import math

from varpin.errors import InputError
from varpin.support.checks import count, positive
from varpin.trajectory import Trajectory

# Distance of a duration from a multiple of the step, as a share: rounding.
_ROUNDING = 1e-9


def time_steps(
    dt: float | None, steps: int | None, duration: float | None, *, choosable: bool = False
) -> tuple[float, int]:
    """The time step [s] and the number of steps, from two of the three arguments.

    Args:
        dt: Time step [s].
        steps: Number of steps.
        duration: Their product [s].
        choosable: Whether a tolerance may be given instead, for the message.

    Raises:
        InputError: Not two are given, one is invalid, or the duration is no multiple of the step.
    """
    given = {name: value for name, value in (("dt", dt), ("steps", steps), ("duration", duration)) if value is not None}
    if len(given) != 2:
        got = " and ".join(given) or "none of them"
        other = ", or duration and tolerance [rad or m], which chooses dt" if choosable else ""
        raise InputError(
            f"give two of dt [s], steps and duration [s]{other}; got {got if len(given) < 3 else 'all three'}"
        )
    if duration is None:
        return positive("dt", dt, "s"), count("steps", steps)
    duration = positive("duration", duration, "s")
    if dt is None:
        steps = count("steps", steps, least=1)
        return duration / steps, steps
    dt = positive("dt", dt, "s")
    steps = max(1, round(min(duration / dt, 1e15)))
    if abs(steps * dt - duration) > _ROUNDING * duration:
        raise InputError(
            f"duration = {duration:g} s is no multiple of dt = {dt:g} s, but of dt = {duration / steps!r} s"
        )
    return dt, steps


def finer(trajectory: Trajectory, parts: int) -> tuple[int, str]:
    """At least so many parts of a motion's steps, and the argument that asks for them, for example ``dt = 0.0025 s``.

    The numbers of digits and parts are small: what is written divides the step of the motion. Where no short number
    does, the argument is the number of steps.
    """
    for more in range(parts, 2 * parts + 1):
        dt = trajectory.dt / more
        if math.isclose(float(f"{dt:.4g}"), dt, rel_tol=_ROUNDING):
            return more, f"dt = {dt:.4g} s"
    return parts, f"steps = {trajectory.steps * parts}"


def duration_for_tolerance(dt: float | None, steps: int | None, duration: float | None) -> float:
    """The duration of a motion with a tolerance [s]; refuses a given dt or number of steps."""
    for name, value in (("dt", dt), ("steps", steps)):
        if value is not None:
            raise InputError(
                f"{name} and tolerance do not go together: a tolerance chooses the steps; give duration and tolerance, "
                f"or {name} without it"
            )
    if duration is None:
        raise InputError("tolerance needs the duration of the motion [s]")
    return positive("duration", duration, "s")
