"""Controls that are neither rows nor a law: of time alone, linear between nodes, or fed back by the core."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.core.arrays import Commands
from varpin.errors import InputError
from varpin.support.checks import (
    JointValues,
    as_floats,
    control_values,
    count,
    finite_array,
    is_one_of,
    named_limits,
    positive,
    require_finite,
    takes,
)
from varpin.support.frozen import Frozen

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class OpenLoop:
    """Controls that are a function of time alone.

    The function is evaluated at the stages of every step, once and before the motion goes on: ``Gauss(s)`` stays of
    order 2 s, ``Radau(s)`` of 2 s - 1, Runge-Kutta's method of 4. A method with one stage holds the value from the
    middle of the step, and stays of its own order. Parts of a step that a guard cuts take the polynomial through its
    stages, which keeps the order too. ``Trajectory.u`` has the mean over each step, ``Trajectory.u_stages`` the values.
    Where the function jumps within a step the order is lost there; jumps at nodes alone are for rows of controls.

    It is called in order of time, for many steps ahead of the motion, and for some times more after it, unless
    ``check=False``; a tolerance calls it for the times of every step that it tries. So it should depend on the time
    alone. What depends on the state is a control law, a function of (t, q, v).

    Attributes:
        f: Of the time [s]; returns the controls, (m,) or by joint name where each is the force of a joint, 0 for joints
            that are not named.
        vectorized: Whether f takes an array of times (K,) [s] and returns the controls at all of them, (K, m). Then it
            is called a few times in all and not once for each stage, which for light robots takes longer than the
            motion itself.

    Raises:
        InputError: It is no function, or not one of one argument; ``vectorized`` is not True or False.
    """

    f: Callable[[float], JointValues] | Callable[[Floats], ArrayLike]
    vectorized: bool = False

    def __post_init__(self) -> None:
        if not callable(self.f):
            raise InputError(f"OpenLoop takes a function of the time t, got {reprlib.repr(self.f)}")
        if not isinstance(self.vectorized, bool):
            raise InputError(f"vectorized must be True or False, got {reprlib.repr(self.vectorized)}")
        if not takes(self.f, 1):
            hint = "; a law of (t, q, v) is given as it is, controls=law" if takes(self.f, 3) else ""
            raise InputError(f"OpenLoop takes a function of one argument, the time t{hint}")


@dataclass(frozen=True, eq=False)
class FirstOrderHold(Frozen):
    """Controls at the nodes, linear in time between them.

    Methods with several stages follow the line, and stay of their order; those with one hold its mean over the step.
    With a tolerance the N parts are each of duration / N.

    Attributes:
        u: Controls at N + 1 nodes (N + 1, m).

    Raises:
        InputError: It is no array of two rows or more, or not finite.
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
    """u = u_k + gains_k (x - x_k) within limits, evaluated at the start of each of N intervals and held over it.

    With ``linear`` it is the control at the end of the interval, and the control is linear in time from the one before.

    x is (q, p) for variational integrators and (q, v) for the others. Where changes of the control cost something
    (:class:`varpin.ControlRateCost`), the control of the interval before is fed back, too:
    u = u_k + gains_k (x - x_k) + previous_gains_k (u_before - previous_k).

    Attributes:
        u: Feed-forward (N, m).
        gains: (N, m, 2n).
        reference: x_k (N, 2n).
        hold: Steps that an interval has.
        on: What x is made for: ``"momentum"``, (q, p), ``"velocity"``, (q, v), or None where nobody said.
        limits: Least and greatest control (2, m), infinite where there is none.
        previous_gains: On the control of the interval before (N, m, m), or None for none.
        previous: What those gains expect it to be (N, m), or None.
        before: The control before the first interval (m,); None where nobody said, and it counts as expected.
        period: Of an interval [s], or None where nobody said. Then the policy acts at any dt that goes into it, held
            over as many steps as that takes.
        joints: The joint whose force, or servo's position, each control is, or None where nobody said.
        servos: The joints whose controls are positions, or None where nobody said.
        linear: Whether controls are linear in time over each interval, from ``before`` on, and not held.
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
    ) -> None:
        """Make a policy.

        Args:
            u: Feed-forward controls (N, m).
            gains: (N, m, 2n).
            reference: (N, 2n), or (N + 1, 2n), of which the last row is not used.
            hold: Steps of a simulation that each control is held over: the rate of a digital controller.
            on: Say what x is, and an integrator on the other x refuses the policy.
            limits: (lower, upper), each one number, (m,) or by joint name, of the whole control: feedback saturates
                there.
            previous_gains: (N, m, m), on the control of the interval before.
            previous: (N, m), what they expect it to be; left out, u of the interval before, and ``before`` for the
                first.
            before: The control before the first interval, (m,) or by joint name.
            period: Of an interval [s]: with it ``hold`` follows from the dt of a simulation, and a dt that does not go
                into it is refused.
            joints: The joint whose force each control is, :attr:`varpin.Scene.control_joints`: they give names to
                ``limits`` and ``before``, and a scene with other controls refuses the policy.
            servos: The joints whose controls are positions, :attr:`varpin.Scene.servo_joints`: a scene with other
                servos refuses the policy.
            linear: Controls are linear in time over each interval: u and what is fed back are those at its end. It
                needs ``before``, the control at the first node.

        Raises:
            InputError: Shapes that do not fit each other, values that are not finite, or names without ``joints``.
            UnknownJoint: A name that is not in ``joints``.
        """
        rows, gains = as_floats("reference", reference), as_floats("gains", gains)
        shape = gains.shape
        if len(shape) != 3:
            raise InputError(f"gains must have shape (N, m, 2n), got {shape}")
        steps, m, size = shape
        if rows.shape == (steps + 1, size):
            rows = rows[:steps]
        values = {
            "u": finite_array("u", u, (steps, m)),
            "gains": finite_array("gains", gains, shape),
            "reference": finite_array("reference", rows, (steps, size)),
        }
        for name, value in values.items():
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "hold", count("hold", hold, least=1))
        if on is not None and not is_one_of(on, ("momentum", "velocity")):
            raise InputError(f"on must be 'momentum', 'velocity' or None, got {on!r}")
        object.__setattr__(self, "on", on)
        names = None if joints is None else tuple(joints)
        if names is not None and len(names) != m:
            raise InputError(f"joints must name the joint of each of the {m} controls, got {names}")
        object.__setattr__(self, "joints", names)
        object.__setattr__(self, "servos", None if servos is None else tuple(servos))
        object.__setattr__(self, "period", None if period is None else positive("period", period, "s"))
        by_name = isinstance(before, Mapping) or any(isinstance(side, Mapping) for side in limits or ())
        if by_name and names is None:
            raise InputError(
                "limits and before by joint name take the names of the controls, joints=scene.control_joints"
            )
        object.__setattr__(self, "limits", named_limits("limits", limits, names, m))
        start = None if before is None else control_values("before", before, names, m)
        object.__setattr__(self, "linear", bool(linear))
        if linear and start is None:
            raise InputError("controls that are linear between nodes begin at one: give before, that of the first node")
        changes: Floats | None = None
        expected: Floats | None = None
        if previous_gains is not None:
            changes = finite_array("previous_gains", previous_gains, (steps, m, m))
            expected = np.vstack([self.u[:1] if start is None else start[None], self.u[:-1]])[:steps]
            if previous is not None:
                expected = finite_array("previous", previous, (steps, m))
        elif previous is not None:
            raise InputError("previous is what previous_gains expect: give them too")
        for name, array in {"previous_gains": changes, "previous": expected, "before": start}.items():
            if array is not None:
                array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __repr__(self) -> str:
        steps, m, size = self.gains.shape
        on = "" if self.on is None else f" on (q, {'p' if self.on == 'momentum' else 'v'})"
        line = ", linear between nodes" if self.linear else ""
        return f"LinearPolicy({steps} intervals of {self.hold} steps, {m} controls, {size // 2} joints{on}{line})"

    def without_feedback(self) -> LinearPolicy:
        """The controls alone."""
        limits = (self.limits[0], self.limits[1])
        return LinearPolicy(
            self.u,
            np.zeros_like(self.gains),
            self.reference,
            self.hold,
            self.on,
            limits,
            before=self.before if self.linear else None,
            period=self.period,
            joints=self.joints,
            servos=self.servos,
            linear=self.linear,
        )

    def hold_at(self, dt: float) -> int:
        """Steps of ``dt`` [s] that an interval has.

        Raises:
            InputError: The intervals have a period, and ``dt`` does not go into it.
        """
        if self.period is None:
            return self.hold
        hold = max(1, round(self.period / dt))
        if abs(hold * dt - self.period) > 1e-9 * self.period:
            raise InputError(
                f"the policy decides every {self.period:g} s, and dt = {dt:g} s does not go into that: "
                f"dt = {self.period / hold:g} s does"
            )
        return hold

    def control(self, interval: int, x: ArrayLike, before: ArrayLike | None = None) -> Floats:
        """The control (m,) of an interval at the state x (2n,), after the control ``before`` (m,).

        Left out, that is what the policy expects. Of a ``linear`` policy it is the control at the interval's end.

        Raises:
            InputError: There is no such interval, or an argument of a wrong shape or value.
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
        """The policy as the core takes it, for an integrator on (q, p) if it is ``variational``, else on (q, v).

        Its intervals have :meth:`hold_at` steps, or ``hold`` where ``dt`` [s] is left out. Where it is ``linear``, the
        integrator's ``stage_times`` say where in a step it looks at the controls.

        Raises:
            InputError: It is for another number of steps, controls or coordinates, for another dt, or for the other x.
        """
        if self.on is not None and variational != (self.on == "momentum"):
            raise InputError(
                f"the policy acts on (q, {'p' if self.on == 'momentum' else 'v'}), the integrator's state is "
                f"(q, {'p' if variational else 'v'}); Solution.policy_on(...) gives the policy on either"
            )
        hold, intervals = self.hold if dt is None else self.hold_at(dt), len(self.gains)
        if intervals * hold != steps:
            finer = ""
            if self.period is None and intervals and steps % intervals == 0 and steps > intervals * hold:
                finer = (
                    f". Where dt is finer than the policy's own, hold={steps // intervals} holds each control as long, "
                    "or give LinearPolicy the period of its intervals, period= [s]"
                )
            raise InputError(
                f"the policy has {intervals} controls, each held over {hold} steps: "
                f"for {intervals * hold} steps, not {steps}{finer}"
            )
        if self.gains.shape[1:] != (controls, 2 * dof):
            raise InputError(f"the policy's gains must have shape (N, {controls}, {2 * dof}), got {self.gains.shape}")
        gains, reference = self.gains, self.reference
        if self.previous_gains is not None and self.previous is not None:
            gains = np.concatenate([gains, self.previous_gains], axis=2)
            reference = np.concatenate([reference, self.previous], axis=1)
        before = np.zeros((0, controls)) if self.before is None else self.before[None].copy()
        found = Commands(self.u, gains, reference, hold, self.limits, before)
        return found if not self.linear else found._replace(places=np.array(tuple(stage_times) or (0.5,)))
