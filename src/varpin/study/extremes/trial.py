"""A scene at an extreme, and the judgement of what came of it with one integrator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from varpin.errors import VarpinError
from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import WRONG_ENERGY, WRONG_MOTION, WRONG_POSITION, WRONG_VELOCITY

Floats = NDArray[np.float64]

# A motion in closed form: q and v, each (n,), at a time [s].
ClosedForm = Callable[[float], tuple[Floats, Floats]]

# The measures of a motion in the order of a cell's fields, and the value from which on each of them is wrong: accuracy
# in units of the motion itself, structure in units of rounding, with a margin for ill-conditioned mass matrices.
LEVELS = {
    "error": WRONG_MOTION,
    "joint": WRONG_POSITION,
    "velocity": WRONG_VELOCITY,
    "period": 1.0,
    "energy": WRONG_ENERGY,
    "momentum": 0.1,
    "reversal": 1e-4,
    "symplecticity": 1e-7,
    "record": 1e-6,
}
# The level of the momentum where the method conserves it by construction.
CONSERVED_MOMENTUM = 1e-6


class Kind(Enum):
    """The judgement of a cell; the value is its name in texts."""

    ACCURATE = "accurate"
    DEGRADED = "degraded"
    REFUSED = "refused"
    STOPPED = "stopped"
    WRONG = "silent wrong"


@dataclass(frozen=True, eq=False)
class Setup:
    """Initial state and inputs of a motion.

    Attributes:
        scene: The scene.
        q0: (n,) [rad or m].
        v0: (n,) [rad/s or m/s].
        controls: None, one row (m,), or a row for each step (N, m).
        increments: Of the Wiener processes (N, k) [s^0.5], or None.
        exact: The motion in closed form, or None.
        twin: A scene with the same motion that is easier to compute, or None: at the origin, with angles reduced.
        shift: Distance of q from the twin's (n,) [rad or m].
    """

    scene: Scene
    q0: Floats
    v0: Floats
    controls: Floats | None = None
    increments: Floats | None = None
    exact: ClosedForm | None = None
    twin: Scene | None = None
    shift: Floats | float = 0.0


@dataclass(frozen=True)
class Trial:
    """A scene at an extreme.

    Attributes:
        name: Unique in a battery.
        family: The extreme.
        build: Makes the setup; may raise varpin's refusal of it.
        dt: Time step [s].
        steps: N.
        window: Duration of the comparison with the exact motion [s]: some periods of what moves.
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
    """A trial with one integrator. Measures are NaN where they do not apply.

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
        """Whether varpin returns the motion with a warning."""
        return self.kind is Kind.DEGRADED

    @property
    def needless(self) -> bool:
        """Whether it warns although no check finds anything."""
        return self.warned and not self.found


@dataclass(frozen=True)
class Outcome:
    """The judgement of a motion or a plan: a part of a :class:`Cell`, and its measures by name as far as they apply."""

    kind: Kind
    measures: dict[str, float] = field(default_factory=dict)
    said: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    done: int = 0

    @classmethod
    def of_error(cls, error: Exception, kind: Kind, done: int = 0) -> Outcome:
        """A refusal or a stop where the error is varpin's own; any other error is a fault of varpin's."""
        if isinstance(error, VarpinError):
            return cls(kind, said=(line_of(error),), done=done)
        return cls(Kind.WRONG, found=(f"unnamed error: {type(error).__name__}: {error}",))


def line_of(error: Exception) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
