"""Controls as functions of time, as linear interpolation between nodes, and as linear feedback in the core."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.errors import InputError
from varpin.support.checks import (
    JointValues,
    as_floats,
    control_values,
    count,
    finite_array,
    flag,
    named_limits,
    positive,
    require_finite,
    takes,
    word,
)
from varpin.support.frozen import Frozen

if TYPE_CHECKING:
    from varpin.integrators import Integrator


@dataclass(frozen=True)
class OpenLoop:
    """Controls as a function of time.

    The control within a step is the polynomial with the function's own moments over it: a method of s stages takes the
    right impulse and s - 1 moments more, so that ``Gauss(s)`` keeps order 2 s, ``Radau(s)`` order 2 s - 1 and
    Runge-Kutta's method order 4, and a blow within a step acts with its whole impulse. Moments come from a quadrature
    that is refined until it settles, of 22 values for each 10 ms of a step at least, and of 10 for a step of up to
    2.5 ms; a blow of less than 0.8 ms is found for certain only with ``breaks``. A method with one stage holds the
    mean. If a guard divides a step, its parts take the same polynomial.
    ``Trajectory.u`` holds the mean over each step, ``Trajectory.u_stages`` the values.

    The function must depend on time alone: it is called for many steps ahead of the motion, and not in order of time.
    Controls that depend on the state are a control law, a function of (t, q, v).

    Attributes:
        f: Function of the time [s] that returns the controls, (m,), or by joint name if each control is the force of a
            joint; 0 for joints that are not named.
        vectorized: Whether f takes an array of times (K,) [s] and returns the controls (K, m). A few calls in all then
            replace one call for each value.
        breaks: Times [s] at which f jumps or has kinks, in any order.

    Raises:
        InputError: ``f`` is not a function of one argument, ``vectorized`` is not a bool, or ``breaks`` are no times.
    """

    f: Callable[[float], JointValues] | Callable[[Floats], ArrayLike]
    vectorized: bool = False
    breaks: Sequence[float] = ()

    def __post_init__(self) -> None:
        breaks = require_finite("breaks", as_floats("breaks", self.breaks))
        if breaks.ndim != 1:
            raise InputError(f"breaks must be a list of times [s], got shape {breaks.shape}")
        object.__setattr__(self, "breaks", tuple(np.unique(breaks).tolist()))
        if not callable(self.f):
            raise InputError(f"OpenLoop takes a function of the time t, got {reprlib.repr(self.f)}")
        flag("vectorized", self.vectorized)
        if not takes(self.f, 1):
            hint = "; a law of (t, q, v) is given as it is, controls=law" if takes(self.f, 3) else ""
            raise InputError(f"OpenLoop takes a function of one argument, the time t{hint}")


@dataclass(frozen=True, eq=False)
class FirstOrderHold(Frozen):
    """Controls at the nodes, linear in time between them.

    Methods with several stages follow the line and keep their order; those with one hold its mean over the step.
    With a tolerance, each of the N intervals lasts duration / N.

    Attributes:
        u: Controls at N + 1 nodes (N + 1, m), N >= 1.

    Raises:
        InputError: ``u`` has a wrong shape or is not finite.
    """

    u: Floats

    def __post_init__(self) -> None:
        u = require_finite("u", as_floats("u", self.u)).copy()
        if u.ndim != 2 or len(u) < 2:
            raise InputError(f"u must have shape (N + 1, m), a row for each node, got {u.shape}")
        u.setflags(write=False)
        object.__setattr__(self, "u", u)

    def refined(self, parts: int) -> FirstOrderHold:
        """The same controls with every interval cut into equal parts."""
        share = np.arange(parts)[:, None] / parts
        between = (1.0 - share) * self.u[:-1, None] + share * self.u[1:, None]
        return FirstOrderHold(np.vstack([between.reshape(-1, self.u.shape[1]), self.u[-1:]]))


@dataclass(frozen=True, eq=False, init=False)
class LinearPolicy(Frozen):
    """Linear feedback u = u_k + gains_k (x - x_k) within limits, for N intervals.

    The control is evaluated at the start of each interval and held over it. With ``linear``, u is instead the control
    at the end of the interval, and the control changes linearly in time.

    x is (q, p) for variational integrators and (q, v) for the others. If changes of the control have a cost
    (:class:`varpin.ControlRateCost`), the control of the previous interval is fed back, too:
    u = u_k + gains_k (x - x_k) + previous_gains_k (u_before - previous_k).

    Attributes:
        u: Feed-forward controls (N, m).
        gains: Feedback gains (N, m, 2n).
        reference: x_k (N, 2n).
        hold: Number of steps in an interval.
        on: The state x: ``"momentum"`` for (q, p), ``"velocity"`` for (q, v), or None where it is unknown.
        limits: Lower and upper limit of each control (2, m), infinite where there is none.
        previous_gains: Gains on the control of the previous interval (N, m, m), or None for none.
        previous: Reference of those gains (N, m), or None.
        before: Control before the first interval (m,); None where it is unknown and taken as ``previous``.
        period: Length of an interval [s]. The policy then acts at any dt that divides it. None where it is unknown.
        joints: The joint whose force, or servo position, each control is; None where they are unknown.
        servos: The joints whose controls are positions; None where they are unknown.
        linear: Whether controls are linear in time over each interval, from ``before`` on, instead of constant.
        integrator: The integrator of motions under the policy where none is given: that of a plan under noise, as its
            margins are for it; else None.
    """

    u: Floats
    gains: Floats
    reference: Floats
    hold: int
    on: Literal["momentum", "velocity"] | None
    limits: Floats
    previous_gains: Floats | None
    previous: Floats | None
    before: Floats | None
    period: float | None
    joints: tuple[str, ...] | None
    servos: tuple[str, ...] | None
    linear: bool
    integrator: Integrator | None

    def __init__(
        self,
        u: ArrayLike,
        gains: ArrayLike,
        reference: ArrayLike,
        hold: int = 1,
        on: Literal["momentum", "velocity"] | None = None,
        limits: tuple[JointValues, JointValues] | None = None,
        *,
        previous_gains: ArrayLike | None = None,
        previous: ArrayLike | None = None,
        before: JointValues | None = None,
        period: float | None = None,
        joints: Sequence[str] | None = None,
        servos: Sequence[str] | None = None,
        linear: bool = False,
        integrator: Integrator | None = None,
    ) -> None:
        """Make a policy of the attributes.

        ``reference`` may have a last row that is not used, (N + 1, 2n). ``previous`` is u of the previous interval if
        left out, and ``before`` for the first. ``limits`` (lower, upper) and ``before`` take one number, (m,) or, with
        ``joints``, numbers by joint name. Scenes with other ``joints`` or ``servos``, and integrators on another state
        than ``on``, refuse the policy. A ``linear`` policy needs ``before``.

        Raises:
            InputError: Shapes that do not fit each other, values that are not finite, or names without ``joints``.
            UnknownJoint: A name is not in ``joints``.
        """
        rows, gains = as_floats("reference", reference), as_floats("gains", gains)
        shape = gains.shape
        if len(shape) != 3:
            raise InputError(f"gains must have shape (N, m, 2n), got {shape}")
        steps, m, size = shape
        if rows.shape == (steps + 1, size):
            rows = rows[:steps]
        names = None if joints is None else tuple(joints)
        if on is not None:
            word("on", on, ("momentum", "velocity"))
        if names is not None and len(names) != m:
            raise InputError(f"joints must name the joint of each of the {m} controls, got {names}")
        if linear and before is None:
            raise InputError("controls that are linear between nodes need before, the control at the first node")
        if previous is not None and previous_gains is None:
            raise InputError("previous is the reference of previous_gains: give them too")
        own = finite_array("u", u, (steps, m))
        start = None if before is None else control_values("before", before, names, m)
        changes: Floats | None = None
        expected: Floats | None = None
        if previous_gains is not None:
            changes = finite_array("previous_gains", previous_gains, (steps, m, m))
            expected = np.vstack([own[:1] if start is None else start[None], own[:-1]])[:steps]
            if previous is not None:
                expected = finite_array("previous", previous, (steps, m))
        # The frozen dataclass refuses assignments.
        vars(self).update(
            u=own,
            gains=finite_array("gains", gains, shape),
            reference=finite_array("reference", rows, (steps, size)),
            hold=count("hold", hold, least=1),
            on=on,
            limits=named_limits("limits", limits, names, m),
            previous_gains=changes,
            previous=expected,
            before=start,
            period=None if period is None else positive("period", period, "s"),
            joints=names,
            servos=None if servos is None else tuple(servos),
            linear=bool(linear),
            integrator=integrator,
        )
        for array in (self.u, self.gains, self.reference, changes, expected, start):
            if array is not None:
                array.setflags(write=False)

    def __repr__(self) -> str:
        steps, m, size = self.gains.shape
        on = "" if self.on is None else f" on (q, {'p' if self.on == 'momentum' else 'v'})"
        line = ", linear between nodes" if self.linear else ""
        return f"LinearPolicy({steps} intervals of {self.hold} steps, {m} controls, {size // 2} joints{on}{line})"

    @property
    def feedback(self) -> Floats:
        """Gains on the state and, where they exist, on the previous control: (N, m, 2n) or (N, m, 2n + m)."""
        return self.gains if self.previous_gains is None else np.concatenate([self.gains, self.previous_gains], axis=2)

    def without_feedback(self) -> LinearPolicy:
        """The same feed-forward controls with zero gains."""
        gains = np.zeros_like(self.gains)
        gains.setflags(write=False)
        before = self.before if self.linear else None
        return self.changed(gains=gains, previous_gains=None, previous=None, before=before)

    def hold_at(self, dt: float) -> int:
        """Number of steps of ``dt`` [s] in an interval.

        Raises:
            InputError: ``dt`` does not divide the period.
        """
        if self.period is None:
            return self.hold
        hold = max(1, round(min(self.period / dt, 1e15)))
        if abs(hold * dt - self.period) > 1e-9 * self.period:
            raise InputError(
                f"the policy has intervals of {self.period:g} s, which dt = {dt:g} s does not divide: "
                f"dt = {self.period / hold!r} s does"
            )
        return hold

    def control(self, interval: int, x: ArrayLike, before: ArrayLike | None = None) -> Floats:
        """The control (m,) of an interval at the state x (2n,), for a ``linear`` policy at the end of the interval.

        ``before`` (m,) is the control of the previous interval, the policy's ``previous`` if left out.

        Raises:
            InputError: There is no such interval, or an argument has a wrong shape or value.
        """
        N, m, size = self.gains.shape
        if not 0 <= count("interval", interval) < N:
            raise InputError(f"interval must be from 0 to {N - 1}, got {interval}")
        u = self.u[interval] + self.gains[interval] @ (finite_array("x", x, (size,)) - self.reference[interval])
        if self.previous_gains is not None and self.previous is not None and before is not None:
            u = u + self.previous_gains[interval] @ (finite_array("before", before, (m,)) - self.previous[interval])
        return np.asarray(np.clip(u, *self.limits), dtype=np.float64)

    def commands(
        self,
        steps: int,
        controls: int,
        dof: int,
        variational: bool,
        dt: float | None = None,
        stage_times: Sequence[float] = (),
    ) -> Commands:
        """The policy in the form of the core, for a ``variational`` integrator on (q, p) or another one on (q, v).

        Its intervals have :meth:`hold_at` steps, or ``hold`` without ``dt`` [s]. A ``linear`` policy needs the
        integrator's ``stage_times``, in units of a step.

        Raises:
            InputError: The policy has another number of steps, controls or coordinates, another dt, or the other x.
        """
        if self.on is not None and variational != (self.on == "momentum"):
            other = "RungeKutta4()" if variational else "Gauss(2)"
            raise InputError(
                f"the policy acts on (q, {'p' if self.on == 'momentum' else 'v'}), the integrator's state is "
                f"(q, {'p' if variational else 'v'}); take integrator=varpin.{other}, or plan.policy_on(...)"
            )
        hold, intervals = self.hold if dt is None else self.hold_at(dt), len(self.gains)
        if intervals * hold != steps:
            own = "; a policy with period= [s] acts at any dt that divides it" if self.period is None else ""
            raise InputError(
                f"the policy has {intervals} controls, each held over {hold} steps: for {intervals * hold} steps, not "
                f"{steps}{own}"
            )
        if self.gains.shape[1:] != (controls, 2 * dof):
            raise InputError(f"the policy's gains must have shape (N, {controls}, {2 * dof}), got {self.gains.shape}")
        reference = self.reference
        if self.previous is not None:
            reference = np.concatenate([reference, self.previous], axis=1)
        before = np.zeros((0, controls)) if self.before is None else self.before[None].copy()
        found = Commands(self.u, self.feedback, reference, hold, self.limits, before)
        return found if not self.linear else found._replace(stage_times=np.array(tuple(stage_times) or (0.5,)))
