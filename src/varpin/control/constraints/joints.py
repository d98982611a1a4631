"""Limits of joint positions, joint velocities and control rates, as hard constraints of a plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.control.constraints.base import LENGTH, BoundConstraint, Horizon, OfStates, PlanConstraint, finite_sides
from varpin.errors import InputError
from varpin.model import Robot, joint_unit
from varpin.support.checks import JointValues, as_floats, control_values, real, some_limits


class _WithinLimits(OfStates):
    limits: Floats
    in_velocity: bool

    def __init__(
        self, robot: Robot, limits: tuple[JointValues, JointValues] | None = None, *, margin: float = 0.0
    ) -> None:
        """Describe the constraint.

        Args:
            robot: The robot.
            limits: (lower, upper), each one number, (n,) or by joint name, infinite where there is none; by default the
                robot's [rad or m; of velocities rad/s or m/s].
            margin: In standard deviations of the joint under noise; see the page on plans within constraints.
        """
        super().__init__(robot, margin)
        name = type(self).__name__
        own = (-robot.velocity_limit, robot.velocity_limit) if self.in_velocity else robot.position_limits
        self.limits = some_limits(name, limits, own, robot.name, robot.joint_names)
        columns, self._signs, self._bounds, sides = finite_sides(self.limits)
        self._columns = columns + self.in_velocity * robot.dof
        joints = (robot.joint_names[c] for c in columns)
        self._rows = tuple(f"{side} limit of {joint}" for side, joint in zip(sides, joints, strict=True))
        self._unit = joint_unit(robot, sorted(set(columns.tolist())), speed=self.in_velocity)
        ranges = self.limits[1] - self.limits[0]
        whole = ranges[np.isfinite(ranges) & (ranges > 0.0)]
        self._scale = 0.1 * float(np.median(whole)) if whole.size else LENGTH

    def values(self, q: Floats, v: Floats) -> Floats:
        found: Floats = np.concatenate([q, v], axis=1)[:, self._columns] * self._signs - self._bounds
        return found

    def slopes(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        found = np.zeros((len(q), len(self._signs), 2 * self.robot.dof))
        found[:, np.arange(len(self._signs)), self._columns] = self._signs
        return found


class WithinJointLimits(_WithinLimits):
    """lower <= q <= upper at every node after the first: joints stay within their position limits.

    ``JointLimitBarrier`` is its soft counterpart, a cost.
    """

    in_velocity = False


class WithinVelocityLimits(_WithinLimits):
    """lower <= v <= upper at every node after the first: joints stay within their velocity limits.

    ``VelocityLimitBarrier`` is its soft counterpart, a cost.
    """

    in_velocity = True


@dataclass(frozen=True, eq=False)
class BoundRate(BoundConstraint):
    """Bound limits of the control rate; first the rows of the upper limits, then those of the lower ones.

    Attributes:
        period: The time that each control holds [s].
        hold: Steps that share one control.
        limit: (m,), infinite where there is none.
        before: The control before the horizon (m,), or None where the first one is free.
    """

    period: float
    hold: int
    limit: Floats
    before: Floats | None
    of_controls = True

    @property
    def limited(self) -> Integers:
        """Indices of the controls with a limit."""
        return np.flatnonzero(np.isfinite(self.limit))

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:  # noqa: ARG002
        u = u[..., :: self.hold, :]
        first = u[..., :1, :] if self.before is None else np.broadcast_to(self.before, (*u.shape[:-2], 1, u.shape[-1]))
        rate = np.diff(u, axis=-2, prepend=first)[..., self.places, :] / self.period
        rates, most = rate[..., self.limited], self.limit[self.limited]
        found: Floats = np.concatenate([rates - most, -rates - most], axis=-1)
        return found


class WithinControlRate(PlanConstraint):
    """abs(u_k - u_(k-1)) / T <= limit, T = hold dt: controls change no faster than the drives can.

    Controls are held and jump between decisions; the rate is the jump divided by the period. Where controls are linear
    between nodes it is the slope of each line, and the first control is ``before`` where that is given: the limited
    controls are then continuous from tick to tick of an :class:`Mpc`. ``ControlRateCost`` is the soft counterpart.
    """

    limit: JointValues
    before: JointValues | None

    def __init__(self, limit: JointValues, before: JointValues | None = None) -> None:
        """Describe the constraint.

        Args:
            limit: One number, (m,), or by joint name where each control is the force of a joint; infinite where there
                is none, and for joints that are not named [control/s].
            before: The control before the horizon, for the first change: one number, (m,) or by joint name. By default
                that of a ``ControlRateCost`` in the cost; without one, the first change is free.
        """
        name = "WithinControlRate limit"
        self.limit = dict(limit) if isinstance(limit, Mapping) else as_floats(name, limit)
        values = [real(name, x) for x in self.limit.values()] if isinstance(self.limit, dict) else self.limit
        if not (np.asarray(values) > 0.0).all():
            raise InputError(f"{name} must be > 0 [control/s], got {limit!r}")
        self.before = before

    def bind(self, horizon: Horizon) -> BoundConstraint:
        name, m, joints = "WithinControlRate", horizon.controls, horizon.control_joints
        limit = control_values(f"{name} limit", self.limit, joints, m, uniform=True, absent=np.inf)
        if not np.isfinite(limit).any():
            raise InputError(f"{name} limit must be finite for some control")
        before = horizon.before
        if self.before is not None:
            before = control_values(f"{name} before", self.before, joints, m, uniform=True)
            if horizon.before is not None and not np.array_equal(before, horizon.before):
                raise InputError(f"{name} and ControlRateCost must have the same control before")
        names = joints if joints is not None else tuple(f"control {i}" for i in range(m))
        limited = np.flatnonzero(np.isfinite(limit))
        period = float(horizon.t[horizon.hold] - horizon.t[0])
        if horizon.linear:
            # A given first control is no decision: lines have slopes, and no jumps.
            decisions = np.arange(1, horizon.steps // horizon.hold + 1)
        else:
            decisions = np.arange(0 if before is not None else 1, horizon.steps // horizon.hold)
        if decisions.size == 0:
            raise InputError(f"{name}: one decision without a control before has no change")
        return BoundRate(
            self,
            decisions,
            horizon.t[:: horizon.hold][decisions],
            tuple(f"{side} rate of {names[i]}" for side in ("upper", "lower") for i in limited),
            "control/s",
            0.1 * float(np.median(limit[limited])),
            period,
            horizon.hold,
            limit,
            before,
        )
