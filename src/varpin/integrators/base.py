"""The contract of every integrator."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.scene import Scene
from varpin.trajectory import StepStatistics

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Failure:
    """Why a rollout stopped before its end.

    Attributes:
        reason: In words.
        residual: The last residual, in units of its rounding error.
    """

    reason: str
    residual: float


@dataclass(frozen=True, eq=False)
class Segment:
    """Some steps of a rollout: the node after each, and what it took.

    Attributes:
        q: Configurations (k, n) [rad or m].
        p: Momenta (k, n).
        v: Velocities (k, n) [rad/s or m/s].
        energy: (k,) [J].
        statistics: Of the k steps.
        failure: Why the step after them failed, or None.
    """

    q: Floats
    p: Floats
    v: Floats
    energy: Floats
    statistics: StepStatistics
    failure: Failure | None = None


class Integrator(ABC):
    """A one-step method.

    Whoever adds one provides

    1. ``start``, which makes the state of a rollout at (q0, v0) and returns it with the first node;
    2. ``rollout``, which moves a state through one step for each row of controls;
    3. ``predict``, the state to expect half a step ahead, to second order, at which feedback is evaluated;
    4. ``variational``, which says whether it maps (q, p) or (q, v).
    """

    variational: bool

    @abstractmethod
    def start(self, scene: Scene, q0: Floats, v0: Floats) -> tuple[Any, Segment]:
        """The state of a rollout at (q0, v0), each (n,), and a segment of that one node.

        Raises:
            SingularMassMatrix: M(q0) is not positive definite.
        """

    @abstractmethod
    def rollout(self, scene: Scene, state: Any, controls: Floats, dt: float) -> Segment:
        """One step of length ``dt`` [s] from ``state`` for each row of ``controls`` (k, m); ``state`` moves along."""

    @abstractmethod
    def predict(self, state: Any, dt: float) -> tuple[Floats, Floats]:
        """Q (n,) and v (n,) expected in the middle of the next step."""
