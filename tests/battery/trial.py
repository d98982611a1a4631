"""A scene at an extreme."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.mechanics.scene import Scene

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
