"""A scene at an extreme, and the judgement of what came of it with one integrator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from varpin.errors import VarpinError
from varpin.mechanics.scene import Scene
from varpin.study.extremes import Kind, line_of

Floats = NDArray[np.float64]

# A motion in closed form: q and v, each (n,), at a time [s].
ClosedForm = Callable[[float], tuple[Floats, Floats]]


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


@dataclass(frozen=True)
class Outcome:
    """The judgement of a motion: a part of a :class:`Cell`, and its measures by name as far as they apply."""

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
