"""What a motion is given: its start, moved onto the constraints, its time step, and angles that look like degrees."""

from __future__ import annotations

import math

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.finding import Finding
from varpin.mechanics.assembly import along_constraints, dependent_input, missed, nearest
from varpin.mechanics.scene import CORRECTED, Scene
from varpin.model import in_degrees, joint_unit
from varpin.support.checks import count, positive
from varpin.trajectory import Trajectory

# Shift of a start onto its constraints up to which no warning is given [rad or m]: rounding.
_ROUNDING = 1e-9
# Distance of a duration from a multiple of the step, as a share: rounding.
_MULTIPLE = 1e-9


def start_in_degrees(scene: Scene, q0: Floats, v0: Floats, controls: Floats | None = None) -> tuple[Finding, ...]:
    """A warning of an initial state (n,), (n,) that looks like degrees, else of such positions in controls (N, m)."""
    found = in_degrees(scene.robot, "q0", q0) or in_degrees(scene.robot, "v0", v0, speed=True)
    return found if found or controls is None else in_degrees(scene.robot, "controls", controls @ scene.holding)


def on_constraints(scene: Scene, q0: Floats, v0: Floats) -> tuple[Floats, Floats, tuple[Finding, ...]]:
    """The nearest state that keeps the constraints, with a warning if it differs from (q0, v0).

    Raises:
        InputError: q0 misses the constraints by more than ``CORRECTED``.
        AssemblyError: The constraints cannot be kept near q0.
    """
    label, miss = missed(scene, q0)
    if miss > CORRECTED:
        sentence = (
            f"q0 misses {label} by {miss:.4g} m or rad: varpin.assemble(scene, q0) looks for the nearest configuration "
            "that keeps the constraints"
        )
        raise InputError("; ".join((sentence, *in_degrees(scene.robot, "q0", q0))))
    q = nearest(scene, q0)
    if (twice := dependent_input(scene, q)) is not None:
        raise InputError(f"{twice} moves a joint that the other constraints and inputs move already at q0")
    v = along_constraints(scene, q, v0)
    shift, turned = float(np.abs(q - q0).max()), float(np.abs(v - v0).max())
    changes = []
    if shift > _ROUNDING:
        changes.append(
            f"q0 was moved by up to {shift:.3g} {joint_unit(scene.robot)} onto the constraints (it missed {label} by "
            f"{miss:.3g})"
        )
    if turned > _ROUNDING * max(1.0, float(np.abs(v0).max())):
        unit = joint_unit(scene.robot, speed=True)
        changes.append(f"v0 was changed by up to {turned:.3g} {unit}, to what the constraints allow")
    return q, v, (Finding("start off the constraints", "; ".join(changes)),) if changes else ()


def time_steps(
    dt: float | None, steps: int | None, duration: float | None, *, choosable: bool = False
) -> tuple[float, int]:
    """The time step [s] and the number of steps, from two of the three; ``choosable`` if a tolerance may choose them.

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
    if abs(steps * dt - duration) > _MULTIPLE * duration:
        raise InputError(
            f"duration = {duration:g} s is no multiple of dt = {dt:g} s, but of dt = {duration / steps!r} s"
        )
    return dt, steps


def finer(trajectory: Trajectory, parts: int, substeps: int = 0) -> tuple[int, str]:
    """At least so many parts of a motion's steps, and the argument that asks for them: a short dt, or else steps.

    The argument is a plant's where the motion has so many ``substeps`` in each tick of a controller.
    """
    if substeps:
        return parts, f"Plant(substeps={substeps * parts})"
    for more in range(parts, 2 * parts + 1):
        dt = trajectory.dt / more
        if math.isclose(float(f"{dt:.4g}"), dt, rel_tol=_MULTIPLE):
            return more, f"dt = {dt:.4g} s"
    return parts, f"steps = {trajectory.steps * parts}"
