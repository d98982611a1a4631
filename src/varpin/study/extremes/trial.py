"""A scene at an extreme, and what came of it with one integrator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import WRONG_ENERGY, WRONG_MOTION, WRONG_POSITION, WRONG_VELOCITY

Floats = NDArray[np.float64]


# From here on a result is wrong. Accuracy in units of the motion itself, structure in units of rounding with room for
# ill-conditioned mass matrices.
LEVELS = {
    "error": WRONG_MOTION,
    "joint": WRONG_POSITION,
    "velocity": WRONG_VELOCITY,
    "period": 1.0,
    "energy": WRONG_ENERGY,
    "momentum": 0.1,
    "kept momentum": 1e-6,
    "reversal": 1e-4,
    "symplecticity": 1e-7,
    "record": 1e-6,
}


class Kind(Enum):
    """What a cell is; the value says it in words."""

    ACCURATE = "accurate"
    DEGRADED = "degraded"
    REFUSED = "refused"
    STOPPED = "stopped"
    WRONG = "silent wrong"


@dataclass(frozen=True, eq=False)
class Setup:
    """All that a motion starts from.

    Attributes:
        scene: The scene.
        q0: (n,) [rad or m].
        v0: (n,) [rad/s or m/s].
        controls: None, one row (m,), or a row for each step (N, m).
        increments: Of the Wiener processes (N, k) [s^0.5], or None.
        exact: The motion in closed form, q (n,) at a time [s], or None.
        rate: Its velocity (n,) at a time [s], or None.
        twin: A scene with the same motion that is easier to compute, or None: at the origin, with angles reduced.
        shift: By how much q is ahead of the twin's (n,).
    """

    scene: Scene
    q0: Floats
    v0: Floats
    controls: Floats | None = None
    increments: Floats | None = None
    exact: Callable[[float], Floats] | None = None
    rate: Callable[[float], Floats] | None = None
    twin: Scene | None = None
    shift: Floats | float = 0.0


@dataclass(frozen=True)
class Trial:
    """A scene at an extreme.

    Attributes:
        name: One of a kind in a battery.
        family: Which extreme.
        build: Makes it; may raise what varpin refuses it with.
        dt: Time step [s].
        steps: N.
        window: How long it is held against the exact motion [s]: some periods of what moves.
        deep: Whether it takes long, and is left out of the usual battery.
    """

    name: str
    family: str
    build: Callable[[], Setup]
    dt: float
    steps: int
    window: float = 1.0
    deep: bool = False

    def takes(self, integrator: Integrator) -> bool:  # noqa: ARG002
        """Whether it is run with an integrator: with all of them."""
        return True


@dataclass(frozen=True)
class Cell:
    """What came of a trial with one integrator. Measures are NaN where they do not apply.

    Attributes:
        family: Of the trial.
        trial: Its name.
        integrator: As text.
        kind: One of the five.
        error: Largest distance in q from the exact motion over its window, in units of how far that goes; of a plan,
            the part of its cost that single controls would take off.
        joint: The same distance, each joint in units of its own way.
        velocity: The same of v, in units of each joint's largest velocity.
        period: Largest error over a period from any of many nodes of the whole motion, in units of what is wrong.
        energy: Largest error of the energy balance, in units of the energy there is to turn over.
        momentum: Largest change of the momentum that is to be conserved, in units of the largest one.
        reversal: Distance in q from where the reversed motion is to end, in units of the way.
        symplecticity: Largest entry of A' J A - J, in units of the sum of magnitudes that cancel in it.
        record: Largest distance of recorded momenta and energies from Pinocchio's, in their own units.
        said: What varpin said of it: warnings, or the error.
        found: What the checks found wrong.
        done: Steps done.
        steps: Steps asked for.
        seconds: Wall time, checks included [s].
        fingerprint: Of all it depends on.
    """

    family: str
    trial: str
    integrator: str
    kind: Kind
    error: float
    joint: float
    velocity: float
    period: float
    energy: float
    momentum: float
    reversal: float
    symplecticity: float
    record: float
    said: tuple[str, ...]
    found: tuple[str, ...]
    done: int
    steps: int
    seconds: float
    fingerprint: str

    @property
    def warned(self) -> bool:
        """Whether varpin says that something is not as it should be with a motion that it returns."""
        return self.kind is Kind.DEGRADED

    @property
    def needless(self) -> bool:
        """Whether it says so although no check finds anything."""
        return self.warned and not self.found
