"""Hard constraints of a plan: what its motion has to keep to, whatever it costs.

They are no constraints of the mechanism, which :class:`varpin.Constraint` is for: those are kept by forces of their own
in every motion of the scene, these by the choice of the controls.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.errors import InputError
from varpin.model import Robot, require_robot
from varpin.model.kinematics import require_same
from varpin.support.checks import finite
from varpin.support.frozen import Frozen

# Scale of places, rotations and joints without a finite range: a tenth of an arm's reach [m], of a turn [rad] or of a
# speed [rad/s or m/s]; from 0.03 to 0.5.
LENGTH = 0.1


@dataclass(frozen=True, eq=False)
class Horizon(Frozen):
    """The time grid of a plan, to which constraints are bound.

    Attributes:
        t: Times of the nodes (N + 1,) [s], or of any states.
        robot: The problem's robot.
        controls: m.
        hold: Steps that share one control.
        control_joints: The joint whose force each control is; None where controls are something else.
        before: The control before the horizon (m,), or None where it is unknown.
        linear: Whether controls are linear between nodes, with decisions at both ends of every ``hold`` steps.
    """

    t: Floats
    robot: Robot
    controls: int
    hold: int
    control_joints: tuple[str, ...] | None
    before: Floats | None
    linear: bool = False

    @property
    def steps(self) -> int:
        """N."""
        return len(self.t) - 1


@dataclass(frozen=True, eq=False)
class BoundConstraint(Frozen, ABC):
    """A constraint on a grid: c <= 0 or c = 0 for ``rows`` at each of K places, nodes or decisions.

    Where it is one of states, c at a place depends on the state there and on the time alone. An inequality at all
    nodes but the first then has values between nodes, too: other ``places`` are rows of states at other times.

    Attributes:
        source: The constraint.
        places: Indices of nodes (K,), or of decisions where ``of_controls``, in ascending order.
        times: Times of the places (K,) [s].
        rows: Description of each row of c.
        unit: Unit of c.
        scale: About a tenth of the range of c, in its unit; violations count in it.
    """

    source: PlanConstraint
    places: Integers
    times: Floats
    rows: tuple[str, ...]
    unit: str
    scale: float
    of_controls: ClassVar[bool] = False

    @property
    def shape(self) -> tuple[int, int]:
        """(K, rows)."""
        return len(self.places), len(self.rows)

    @property
    def size(self) -> int:
        """The number of entries of c."""
        return len(self.places) * len(self.rows)

    @abstractmethod
    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The values c (..., K, rows) on motions, q and v (..., N + 1, n) at the nodes and u (..., N, m).

        Where controls are linear between nodes, u (..., N + 1, m) are those at the nodes.
        """

    def of_states(self, q: Floats, v: Floats, controls: int) -> Floats:
        """:meth:`value` of a constraint of states, in which the m = ``controls`` have no part."""
        return self.value(q, v, np.zeros((*q.shape[:-1], controls)))

    def jacobian(self, q: Floats, v: Floats) -> Floats:
        """dc/d(q, v) (K, rows, 2n) of one motion, q and v (N + 1, n).

        Raises:
            NotImplementedError: The constraint is on controls.
        """
        raise NotImplementedError


class PlanConstraint(Frozen, ABC):
    """A hard constraint of a plan. A subclass implements ``bind``, for any horizon.

    Constraints raise an InputError for arguments of a wrong shape or value, such as a frame that is fixed to the base,
    and an UnknownJoint or UnknownFrame for a name that the robot does not have.

    Attributes:
        margin: Distance kept from the bound, in standard deviations of c under the scene's noise; 0 for none. Where
            values are not normally distributed, it is as wide as motions under noise need (docs/plan-constraints.md).
    """

    margin: float = 0.0
    equality: ClassVar[bool] = False

    @abstractmethod
    def bind(self, horizon: Horizon) -> BoundConstraint:
        """Bind the constraint to a grid.

        Raises:
            InputError: The constraint is for another robot, or does not fit the controls.
        """

    @property
    def label(self) -> str:
        """Name in reports."""
        return type(self).__name__

    def __repr__(self) -> str:
        """All parameters."""
        values = {name: value for name, value in vars(self).items() if not isinstance(value, Robot) and name[0] != "_"}
        arguments = (f"{name}={_argument(value)}" for name, value in values.items() if name != "kinematics")
        return f"{type(self).__name__}({', '.join(arguments)})"


def _argument(value: object) -> str:
    return repr(value.tolist() if isinstance(value, np.ndarray) else value)


class OfStates(PlanConstraint):
    """A constraint on the states at all nodes after the first; an equality is one on the last state."""

    robot: Robot
    _rows: tuple[str, ...]
    _unit = "m"
    _scale = LENGTH

    def __init__(self, robot: Robot, margin: float = 0.0) -> None:
        """Take what all have."""
        name = type(self).__name__
        self.robot, self.margin = require_robot(robot, name), finite(f"{name} margin", margin)
        if self.margin < 0.0:
            raise InputError(f"{name} margin must be >= 0 [standard deviations], got {self.margin:g}")

    def bind(self, horizon: Horizon) -> BoundConstraint:
        require_same(self.label, self.robot, horizon.robot)
        places = np.arange(horizon.steps if self.equality else 1, horizon.steps + 1)
        times = horizon.t[places]
        return BoundStates(self, places, times, self._rows, self._unit, self._scale, self.at(times))

    def at(self, times: Floats) -> Self:  # noqa: ARG002
        """The constraint at times (K,) [s]: row i of states then belongs to the time i mod K.

        Raises:
            InputError: A user's function of time fails.
        """
        return self

    @abstractmethod
    def values(self, q: Floats, v: Floats) -> Floats:
        """The values c (P, rows) at states q and v (P, n)."""

    @abstractmethod
    def slopes(self, q: Floats, v: Floats) -> Floats:
        """dc/dq (P, rows, n) or dc/d(q, v) (P, rows, 2n)."""


@dataclass(frozen=True, eq=False)
class BoundStates(BoundConstraint):
    """A constraint on states on a grid.

    Attributes:
        of: The constraint at the times of its places.
    """

    of: OfStates

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:  # noqa: ARG002
        at = [np.ascontiguousarray(x[..., self.places, :]).reshape(-1, x.shape[-1]) for x in (q, v)]
        return self.of.values(*at).reshape(*q.shape[:-2], *self.shape)

    def jacobian(self, q: Floats, v: Floats) -> Floats:
        found = self.of.slopes(q[self.places], v[self.places])
        return np.pad(found, ((0, 0), (0, 0), (0, 2 * q.shape[1] - found.shape[2])))


def finite_sides(limits: Floats) -> tuple[Integers, Floats, Floats, list[str]]:
    """Columns, signs, bounds and names of the finite ones of limits (2, n), a row for each, upper ones first."""
    sides, columns = np.nonzero(np.isfinite(limits[::-1]))
    signs = np.where(sides == 0, 1.0, -1.0)
    return columns, signs, signs * limits[::-1][sides, columns], [("upper", "lower")[side] for side in sides]
