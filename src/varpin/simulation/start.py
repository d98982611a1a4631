"""The start of a motion, moved onto the constraints of the scene."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.mechanics.assembly import along_constraints, dependent_input, missed, nearest
from varpin.mechanics.scene import CORRECTED, Scene
from varpin.model import degrees_hint
from varpin.simulation.soundness import Finding

# Shift of a start onto its constraints up to which no warning is given [rad or m]: rounding.
_ROUNDING = 1e-9


def in_degrees(scene: Scene, q0: Floats) -> tuple[Finding, ...]:
    """A warning if an angle of the initial configuration (n,) looks like degrees."""
    sentence = degrees_hint(scene.robot, "q0", q0)
    return (Finding("start in degrees", sentence),) if sentence else ()


def on_constraints(scene: Scene, q0: Floats, v0: Floats) -> tuple[Floats, Floats, tuple[Finding, ...]]:
    """The nearest state that keeps the constraints, with a warning if it differs from (q0, v0).

    Raises:
        InputError: q0 misses the constraints by more than ``CORRECTED``.
        AssemblyError: The constraints cannot be kept near q0.
    """
    label, miss = missed(scene, q0)
    if miss > CORRECTED:
        units = degrees_hint(scene.robot, "q0", q0)
        raise InputError(
            f"q0 misses {label} by {miss:.4g} m or rad: varpin.assemble(scene, q0) looks for the nearest configuration "
            f"that keeps the constraints{'; ' if units else ''}{units}"
        )
    q = nearest(scene, q0)
    if (twice := dependent_input(scene, q)) is not None:
        raise InputError(f"{twice} moves a joint that the other constraints and inputs move already at q0")
    v = along_constraints(scene, q, v0)
    shift, turned = float(np.abs(q - q0).max()), float(np.abs(v - v0).max())
    changes = []
    if shift > _ROUNDING:
        changes.append(
            f"q0 was moved by up to {shift:.3g} rad or m onto the constraints (it missed {label} by {miss:.3g})"
        )
    if turned > _ROUNDING * max(1.0, float(np.abs(v0).max())):
        changes.append(f"v0 was changed by up to {turned:.3g} rad/s or m/s, to what the constraints allow")
    return q, v, (Finding("start off the constraints", "; ".join(changes)),) if changes else ()
