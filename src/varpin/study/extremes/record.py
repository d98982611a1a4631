"""What came of a robot's motions at the extremes: a judgement of each scene with each integrator."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from varpin._version import __version__
from varpin.io.archive import load_json, save_json
from varpin.study.extremes.units import WRONG_ENERGY, WRONG_MOTION, WRONG_POSITION, WRONG_VELOCITY

FORMAT = "varpin.extremes/3"

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
        joint: The same distance, each joint in units of its own travel.
        velocity: The same of v, in units of each joint's largest velocity.
        period: Largest error over a period from any of many nodes of the whole motion, in units of what is wrong.
        energy: Largest error of the energy balance, in units of the energy there is to turn over.
        momentum: Largest change of the momentum that is to be conserved, in units of the largest one.
        reversal: Distance in q from where the reversed motion is to end, as a share of the joint travel.
        symplecticity: Largest entry of A' J A - J, in units of the sum of magnitudes that cancel in it.
        record: Largest distance of recorded momenta and energies from Pinocchio's, in their own units.
        said: varpin's warnings, or its error.
        found: The failed checks.
        done: Number of steps taken.
        steps: Number of steps of a complete motion.
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


@dataclass(frozen=True, eq=False)
class Record:
    """What came of a battery.

    Attributes:
        cells: In the order of the trials, and of the integrators within.
        robot: The robot's name, or that of the battery of scenes.
        deep: Whether the long trials were among them.
        missing: Cells that an interruption left out.
        version: The varpin that made it.
    """

    cells: tuple[Cell, ...]
    robot: str
    deep: bool
    missing: int = 0
    version: str = __version__

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {kind.value}" for kind, count in self.counts().items() if count)
        return f"Record({self.robot}: {counts or 'no cells'}{f', {self.missing} missing' if self.missing else ''})"

    def counts(self) -> dict[Kind, int]:
        """How many cells there are of each kind."""
        return {kind: sum(cell.kind is kind for cell in self.cells) for kind in Kind}

    def wrong(self) -> tuple[Cell, ...]:
        """The cells that are wrong without a warning."""
        return tuple(cell for cell in self.cells if cell.kind is Kind.WRONG)

    def needless(self) -> tuple[Cell, ...]:
        """The cells with a warning although every check passes: false alarms."""
        return tuple(cell for cell in self.cells if cell.needless)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the record as JSON; returns its path. What is not a finite number stands there as null.

        Raises:
            FileError: The path cannot be written.
        """
        return save_json(path, FORMAT, self)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Record:
        """Read a record that :meth:`save` wrote.

        Raises:
            FileError: The file is missing, damaged or something else.
        """
        return load_json(path, FORMAT, cls)


def line_of(error: Exception) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
