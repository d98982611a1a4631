"""Payloads: rigid bodies added to the links that carry them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.model.inertia import fault, principal_moments
from varpin.model.tree import frame_index
from varpin.support.checks import as_floats, finite_array, positive, require_finite


@dataclass(frozen=True, eq=False)
class Payload:
    """A rigid body fastened to a frame of the robot.

    Attributes:
        frame: Name of the frame.
        mass: Mass [kg], > 0.
        center: Centre of mass (3,) in the frame [m].
        inertia: Inertia about the centre of mass, in the frame's axes [kg m^2]: 0 for a point mass, (3,) principal
            moments along the axes, or (3, 3).
    """

    frame: str
    mass: float
    center: ArrayLike = (0.0, 0.0, 0.0)
    inertia: ArrayLike = 0.0

    def __post_init__(self) -> None:
        positive("payload mass", self.mass, "kg")
        finite_array("payload center", self.center, (3,))
        self.moments()

    def moments(self) -> Floats:
        """The inertia as a matrix (3, 3).

        Raises:
            InputError: No rigid body has it: it is not symmetric, is negative, or violates the triangle inequality.
        """
        given = require_finite("payload inertia", as_floats("payload inertia", self.inertia))
        if given.shape not in ((), (3,), (3, 3)) or (given.ndim == 0 and given != 0.0):
            raise InputError(
                "payload inertia must be 0, three principal moments or a matrix (3, 3), got "
                + (f"{given:g}" if given.ndim == 0 else f"shape {given.shape}")
            )
        matrix = given * np.eye(3) if given.ndim < 2 else given
        size = float(np.abs(matrix).max())
        if np.abs(matrix - matrix.T).max() > 1e-9 * size:
            raise InputError("payload inertia must be symmetric")
        _, sentence = fault(self.frame, float(self.mass), principal_moments(matrix))
        if sentence:
            raise InputError(f"payload inertia: {sentence}")
        return np.asarray(matrix)


def carry(model: pin.Model, payload: Sequence[Payload], robot: str) -> None:
    """Add payloads to the links of ``model``."""
    for part in payload:
        if not isinstance(part, Payload):
            raise InputError(f"payload must be a varpin.Payload or a sequence of them, got {type(part).__name__}")
        frame = model.frames[frame_index(model, part.frame, robot)]
        if frame.parentJoint == 0:
            raise InputError(
                f"payload of robot {robot!r}: frame {part.frame!r} belongs to the base, which does not move"
            )
        body = pin.Inertia(float(part.mass), np.array(part.center, dtype=float), part.moments())
        model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
