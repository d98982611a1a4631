"""An optimal control problem: a scene, a cost, a horizon and its discretization.

Equation (O1) of docs/mathematics.md.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np

from varpin.arrays import Floats
from varpin.control.constraints import BoundConstraint, BoundRate, Horizon, PlanConstraint, WithinControlRate
from varpin.control.costs import (
    BoundSum,
    ControlRate,
    ControlRateCost,
    Cost,
    CostSum,
    Points,
    control_rate,
    with_control_before,
)
from varpin.control.sizes import HARMLESS, ROUNDING
from varpin.errors import InputError, UnknownName
from varpin.finding import announce
from varpin.integrators import Integrator
from varpin.integrators.registry import require_motion
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene, closest_controls, require_scene, tangent_basis
from varpin.mechanics.values import same
from varpin.signals.commands import as_moved, cubics
from varpin.signals.policy import LinearPolicy, OpenLoop
from varpin.simulation.choice import given_integrator, integrator_for
from varpin.simulation.simulate import simulate
from varpin.simulation.spectrum import natural_rate
from varpin.simulation.start import on_constraints, time_steps
from varpin.support.checks import (
    JointValues,
    control_values,
    count,
    finite,
    flag,
    joint_array,
    named_limits,
    tuple_of,
    word,
)
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, listed
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

Sampling = Literal["midpoint", "gauss", "start"]
Shape = Literal["held", "linear"]

# Greatest natural frequency of the feedback of first motions, times the period of controls; from 0.1 to 0.5.
FASTEST = 0.25
# All that another problem may have in place of its own.
_KEPT = ("cost", "dt", "steps", "hold", "controls", "between_nodes", "sampling", "q0", "v0", "t0", "control_limits",
         "constraints", "integrator")  # fmt: skip


@dataclass(frozen=True, eq=False, init=False)
class OptimalControlProblem(Frozen):
    """Minimize the expected cost of a motion from (q0, v0), (O1), over the controls, each held over ``hold`` steps.

    With ``controls="linear"`` controls are linear in time between the nodes, with one decision at each node, the first
    one included. Smooth motions then need a fraction of the nodes. Controls stay within their limits, feedback
    included. Running costs are integrals in time, and references are functions of time, so the problem is the same at
    every ``dt``. Costs add up, and numbers scale them:

        cost = vp.TrackingCost(reference, 10.0) + vp.ControlCost(0.1) + vp.Terminal(2.0 * vp.TrackingCost(goal))

    A control that nothing charges or limits may be of any size: give each a small :class:`varpin.ControlCost`.

    Attributes:
        scene: The scene, its noise included.
        cost: Running and terminal costs.
        q0: Initial configuration (n,) [rad or m]; it may be given by joint name. Where the scene has constraints, a
            small miss is corrected, as :func:`varpin.simulate` does.
        v0: Initial velocity (n,) [rad/s or m/s]; also by joint name, and corrected in the same way.
        dt: Time step [s].
        steps: N. ``duration=``, steps * dt [s], may be given instead of one of the two.
        integrator: Any of varpin's. If left out, ``Gauss(stages=3)`` where no swing, damper or friction is fast in a
            step at ``q0`` and rest, so that :func:`varpin.simulate` takes two stages; ``Radau(stages=4)`` where dry
            friction or dampers are more than 10 times as fast as the step, and the scene has no constraints; else
            ``Gauss(stages=4)``. All with ``kick="held"`` where the scene has noise.
        sampling: Where in each step running costs are sampled. ``"gauss"``, the default: at its two Gauss points, with
            a cubic motion between the nodes, of fourth order; at four points where a :class:`varpin.KinematicInput` is
            cubic. ``"midpoint"``: at ((q + q')/2, (q' - q)/dt, u), of second order, and blind to velocities that
            alternate from node to node. ``"start"``: at the step's first node, as in the paper, of first order.
        hold: Steps that share one control: a digital controller's period over the integrator's step.
        t0: Time at the beginning of the horizon [s], for references that are functions of time.
        control_limits: Least and greatest control (2, m) [N m or N per unit of control], infinite where there is none;
            of a :class:`varpin.KinematicInput` its positions at nodes.
        controls: ``"held"``, each constant over ``hold`` steps, or ``"linear"`` in time between nodes.
        constraints: Hard constraints on the motion (:class:`PlanConstraint`): joint limits, a frame's goal, regions,
            clearance. Those of a :class:`Scene` belong to the mechanism.
        between_nodes: Whether the constraints are to hold between nodes, too, which takes more time. Linear controls
            keep them there anyway, to a thousandth of their range.
        integrator_by_default: Whether ``integrator`` was left out; :meth:`at` then chooses it anew.
        rate: Cost of changes of the controls: ``rate.weight`` (m, m) and ``rate.before``, the control before the
            horizon (m,) or None; None where changes cost nothing.
    """

    scene: Scene
    cost: Cost
    q0: Floats
    v0: Floats
    dt: float
    steps: int
    integrator: Integrator
    sampling: Sampling
    hold: int
    t0: float
    control_limits: Floats
    constraints: tuple[PlanConstraint, ...]
    running: BoundSum
    terminal: BoundSum
    places: Floats
    rule: Floats
    rate: ControlRate | None
    controls: Shape
    between_nodes: bool
    integrator_by_default: bool
    bound_constraints: tuple[BoundConstraint, ...]

    def __init__(
        self,
        scene: Scene,
        cost: Cost,
        q0: JointValues,
        v0: JointValues,
        *,
        dt: float | None = None,
        steps: int | None = None,
        duration: float | None = None,
        integrator: Integrator | None = None,
        sampling: Sampling = "gauss",
        hold: int = 1,
        t0: float = 0.0,
        control_limits: tuple[JointValues, JointValues] | None = None,
        controls: Shape = "held",
        constraints: Sequence[PlanConstraint] = (),
        between_nodes: bool = False,
    ) -> None:
        """Describe a problem; see the class for the arguments.

        ``control_limits`` are (lower, upper), each one number, (m,), or by joint name where each control is the force
        of a joint. They are infinite where a control has no limit, and for joints that are not named.

        Raises:
            UnknownJoint: An unknown joint name, or one of a joint that is not driven, for controls.
            InputError: Wrong shapes or values; not two of ``dt``, ``steps`` and ``duration``; ``hold`` with linear
                controls or a :class:`KinematicInput`; another ``sampling`` than "gauss" with linear controls or a cubic
                input; a reference that does not fit the grid; constraints that are of another robot.
            CostError: A reference function fails.
            AssemblyError: The scene's constraints cannot be satisfied near q0.
        """
        n, m = require_scene(scene).robot.dof, scene.controls
        if not isinstance(cost, Cost):
            raise InputError(f"cost must be a cost, for example varpin.TrackingCost(...), got {type(cost).__name__}")
        given_integrator(integrator)
        if m == 0:
            raise InputError("the scene has no controls, so there is nothing to optimize")
        dt, steps = time_steps(dt, steps, duration)
        steps, hold = count("steps", steps, least=1), count("hold", hold, least=1)
        if steps % hold:
            raise InputError(f"steps = {steps} is no multiple of hold = {hold}")
        word("sampling", sampling, ("midpoint", "gauss", "start"))
        word("controls", controls, ("held", "linear"))
        linear = controls == "linear"
        if hold != 1 and (linear or scene.inputs):
            what = "linear controls" if linear else "positions of a KinematicInput"
            raise InputError(f"{what} are decided at every node: leave hold = {hold} out")
        if sampling != "gauss" and (linear or _cubic(scene)):
            what = "linear controls act" if linear else "a cubic KinematicInput acts"
            raise InputError(f"sampling = {sampling!r} misses the nodes, where {what}: leave it out, for 'gauss'")
        t0, names, (q0, v0) = finite("t0", t0), scene.robot.joint_names, _start(scene, q0, v0, dt)
        note = "; those of the mechanism belong to varpin.Scene(constraints=)"
        vars(self).update(
            scene=scene,
            cost=cost,
            q0=q0,
            v0=v0,
            dt=dt,
            steps=steps,
            integrator=integrator_for(scene, q0, dt) if integrator is None else integrator,
            sampling=sampling,
            hold=hold,
            t0=t0,
            control_limits=named_limits("control_limits", control_limits, scene.control_joints, m),
            constraints=tuple_of("constraints", constraints, PlanConstraint, note),
            controls=controls,
            between_nodes=flag("between_nodes", between_nodes),
            integrator_by_default=integrator is None,
        )
        self._bind(Points(np.zeros(0), dt * steps, steps, n, m, t0, names, scene.control_joints, scene.robot))

    def _bind(self, points: Points) -> Self:
        """Bind costs and constraints to the grid."""
        places, rule = _rule(self.sampling, self.dt, cubic=_cubic(self.scene))
        times = self.t0 + ((np.arange(self.steps, dtype=np.float64)[:, None] + places) * self.dt).reshape(-1)
        running, terminal = bind_cost(self.cost, times, points)
        rate = control_rate(self.cost, self.scene.controls, self.scene.control_joints)
        vars(self).update(places=places, rule=rule, running=running, terminal=terminal, rate=rate)
        vars(self)["bound_constraints"] = self.constraints_on(self.dt, self.steps, self.hold)
        for array in (self.q0, self.v0, places, rule):
            array.setflags(write=False)
        return self

    def __repr__(self) -> str:
        held = f", each control held over {self.hold}" if self.hold > 1 else ", linear controls" if self.linear else ""
        return f"OptimalControlProblem({self.scene!r}, {self.steps} steps of {self.dt:g} s{held}, {self.integrator})"

    def _repr_html_(self) -> str:
        limited = int(np.isfinite(self.control_limits).any(axis=0).sum())
        rows = [
            ("scene", self.scene),
            ("horizon", f"{self.steps} steps of {self.dt:g} s, {self.duration:g} s from t = {self.t0:g} s"),
            ("decisions", f"{self.decisions} of {self.scene.controls} controls, {limited} of them with limits"),
            *([("controls", "linear between nodes")] if self.linear else []),
            ("integrator", f"{self.integrator}, the cost sampled by the rule {self.sampling!r}"),
            ("from q [rad or m]", listed(f"{x:.4g}" for x in self.q0)),
            ("at v [rad/s or m/s]", listed(f"{x:.4g}" for x in self.v0)),
        ]
        return facts("Optimal control problem", rows, self.cost._repr_html_())

    @property
    def duration(self) -> float:
        """The horizon [s]."""
        return self.dt * self.steps

    @property
    def remembers(self) -> bool:
        """Whether the control before the horizon matters: changes of controls have a cost or a limit."""
        return self.rate is not None or any(item.of_controls for item in self.bound_constraints)

    @property
    def before(self) -> Floats | None:
        """The control before the horizon (m,); None where it does not matter or is unknown."""
        known = None if self.rate is None else self.rate.before
        limits = (item.before for item in self.bound_constraints if isinstance(item, BoundRate))
        return next((before for before in (known, *limits) if before is not None), None)

    @property
    def begin(self) -> Floats:
        """The first control (m,) where it is given, NaN where it is free; all are where controls are held.

        It is given where a limit of the rate begins with a control before the horizon: lines do not jump. Of a
        kinematic input it is where the joint is.
        """
        found = np.full(self.scene.controls, np.nan)
        if self.linear:
            found = as_moved(self.scene, self.q0, self.v0, found)
        for item in self.bound_constraints if self.linear else ():
            if isinstance(item, BoundRate) and item.before is not None:
                found[item.limited] = np.clip(item.before, *self.control_limits)[item.limited]
        return found

    def begun(self, u: Floats) -> Floats:
        """Controls of decisions (R, m) whose first one is :attr:`begin` where that is given."""
        given = self.begin
        return np.vstack([np.where(np.isnan(given), u[0], given), u[1:]])

    @property
    def decisions(self) -> int:
        """R, the number of decisions: steps / hold, or steps + 1 where controls are linear between nodes."""
        return self.steps + 1 if self.linear else self.steps // self.hold

    @cached_property
    def linear(self) -> bool:
        """Whether controls are linear in time between nodes."""
        return self.controls == "linear"

    @property
    def period(self) -> float:
        """The time that each control holds [s]."""
        return self.dt * self.hold

    def at(self, *, before: JointValues | None = None, **changes: Any) -> OptimalControlProblem:
        """The same problem with other arguments: another discretization, initial state, cost, ...

        With ``dt`` alone the horizon stays, and with ``duration`` alone the step; the number of steps follows. An
        integrator that was left out is chosen anew, but stays where the state or the time changes alone.

        Args:
            before: The control applied before the horizon, one number, (m,) or by joint name, for
                :class:`ControlRateCost` and :class:`WithinControlRate`.
            changes: Any arguments of the problem but the scene; None leaves one as it is.

        Raises:
            InputError: There is no such argument; the horizon is no multiple of ``dt``; ``before`` is given where
                changes of controls have neither cost nor limit; or as for the problem itself.
        """
        for name in changes.keys() - {*_KEPT, "duration"}:
            raise UnknownName(name, (*_KEPT, "duration"), "at has no argument")
        if before is not None and not self.remembers:
            raise InputError("before is what a ControlRateCost or a WithinControlRate begins with: give one")
        given = {name: value for name, value in changes.items() if value is not None}
        if "dt" in given and not given.keys() & {"steps", "duration"}:
            given["duration"] = self.duration
        if "duration" in given:
            dt, steps = given.get("dt", None if "steps" in given else self.dt), given.get("steps")
            given["dt"], given["steps"] = time_steps(dt, steps, given.pop("duration"))
        moves = given.keys() <= {"q0", "v0", "t0"}
        if before is not None:
            control = control_values("before", before, self.scene.control_joints, self.scene.controls)
            given["cost"] = with_control_before(given.get("cost", self.cost), control)
            kept = tuple_of("constraints", given.get("constraints", self.constraints), PlanConstraint)
            given["constraints"] = tuple(
                item.changed(before=control) if isinstance(item, WithinControlRate) else item for item in kept
            )
        if moves:
            t0 = finite("t0", given.get("t0", self.t0))
            q0, v0 = _start(self.scene, given.get("q0", self.q0), given.get("v0", self.v0), self.dt)
            points = self.running.points
            # A step alone has references of the whole horizon.
            points = points.changed(t0=points.t0 - self.t0 + t0)
            return self.changed(**given | {"q0": q0, "v0": v0, "t0": t0})._bind(points)
        same = {name: getattr(self, name) for name in _KEPT}
        if self.integrator_by_default:
            same["integrator"] = None
        return OptimalControlProblem(self.scene, **same | given)

    def in_parts(self, parts: int) -> OptimalControlProblem:
        """The problem in ``parts`` of each step, for motions under commands that are decided as in its own steps.

        Costs are sampled by the rule "gauss". It is not to be solved: the controls of kinematic inputs, and linear
        ones, are those of the parts.
        """
        given = {"dt": self.dt / parts, "steps": self.steps * parts, "hold": self.hold * parts, "sampling": "gauss"}
        return self.changed(**given)._bind(self.running.points)

    def step(self, k: int) -> OptimalControlProblem:
        """Step ``k`` of the problem alone; references have their values there, also those given at all nodes."""
        return self.changed(steps=1, t0=self.t0 + k * self.dt)._bind(self.running.points)

    @cached_property
    def setting(self) -> dict[str, Any]:
        """What tells the problem from others, costs aside: numbers and texts by name; noise in Python by its size.

        Constraints are their values on a path from the start that turns all joints: functions of time have no names.
        """
        plain = (name for name in _KEPT if name not in ("cost", "constraints", "integrator"))
        found: dict[str, Any] = {name: getattr(self, name) for name in plain}
        found["joints"] = ", ".join(self.scene.robot.joint_names)
        values = {name: array for name, array in self.scene.values.items() if not name.startswith("noise.")}
        found |= {f"scene.{name}": array for name, array in values.items()}
        found |= {f"noise.{name}": array for name, array in self.scene.noise.arrays._asdict().items()}
        found["constraints"] = ", ".join(item.label for item in self.constraints)
        found["integrator"] = repr(self.integrator)
        path = 0.1 * np.sin(np.outer(np.arange(self.steps + 1), 1.0 + np.arange(len(self.q0))))
        q, v = self.q0 + path, self.v0 + path
        u = np.zeros((self.steps + self.linear, self.scene.controls))
        for i, bound in enumerate(self.bound_constraints):
            found[f"constraints.{i}"] = np.append(bound.value(q, v, u), bound.source.margin)
        return found

    def differs(self, setting: Mapping[str, Any]) -> str:
        """The first difference from a problem of another :attr:`setting` in words; empty if there is none."""
        for name in dict.fromkeys((*self.setting, *setting)):
            theirs, mine = (np.asarray(one.get(name, np.zeros(0))) for one in (setting, self.setting))
            numbers = {mine.dtype.kind, theirs.dtype.kind} <= set("bif")
            if not (same(theirs, mine) if numbers else np.array_equal(theirs, mine)):
                single = mine.ndim == theirs.ndim == 0
                return f"{name} = {theirs}, not {mine}" if single else f"different {name.replace('.', ' ')}"
        return ""

    def mismatch(self, setting: Mapping[str, Any], trajectory: Trajectory, cost: float) -> str:
        """Of which other problem a plan's :attr:`setting`, motion and cost are, in words; empty if of this one."""
        if difference := self.differs(setting):
            return f"of another problem: {difference}"
        found = self.cost_of(trajectory)
        close = math.isclose(found, cost, rel_tol=HARMLESS)
        return "" if close else f"of a problem with another cost: {cost:.9g}, and here {found:.9g}"

    def constraints_on(
        self, dt: float, steps: int, hold: int, *, linear: bool | None = None
    ) -> tuple[BoundConstraint, ...]:
        """The constraints on another grid, and for controls that are ``linear`` between nodes or held."""
        times = self.t0 + np.arange(steps + 1, dtype=np.float64) * dt
        horizon, bound = self._horizon(times, hold, self.linear if linear is None else linear), []
        for i, item in enumerate(self.constraints):
            try:
                bound.append(item.bind(horizon))
            except InputError as error:
                error.add_note(f"in constraints[{i}]")
                raise
        return tuple(bound)

    def _horizon(self, times: Floats, hold: int, linear: bool) -> Horizon:
        scene, before = self.scene, None if self.rate is None else self.rate.before
        return Horizon(times, scene.robot, scene.controls, hold, scene.control_joints, before, linear)

    @cached_property
    def throughout(self) -> list[int]:
        """Indices of the constraints that have values between nodes: inequalities of states at all but the first."""
        every = np.arange(1, self.steps + 1)
        bounds = [(i, own) for i, own in enumerate(self.bound_constraints) if not own.of_controls]
        return [i for i, own in bounds if not own.source.equality and np.array_equal(own.places, every)]

    def bound_at(self, index: int, times: Floats) -> BoundConstraint:
        """A constraint ``throughout`` at times (K,) [s]: its places are the rows of states (..., K, n)."""
        bound = self.constraints[index].bind(self._horizon(np.append(self.t0, times), 1, self.linear))
        return bound.changed(places=np.arange(len(times)))

    def at_start(self, index: int) -> Floats:
        """The rows of a constraint ``throughout`` at the fixed start."""
        bound = self.bound_at(index, np.array([self.t0]))
        start: Floats = bound.of_states(self.q0[None], self.v0[None], self.scene.controls)[0]
        return start

    def label_of(self, constraint: PlanConstraint) -> str:
        """The name of one of the constraints in reports, with its index where several have the same name."""
        alike = [i for i, other in enumerate(self.constraints) if other.label == constraint.label]
        index = [i for i in alike if self.constraints[i] is constraint]
        return f"{constraint.label} (constraints[{index[0]}])" if len(alike) > 1 and index else constraint.label

    @property
    def steered(self) -> bool:
        """Whether controls can change what noise costs; that of constant strength adds the same to all motions."""
        fields = self.scene.noise.diffusion
        if fields is None or not self.integrator.variational:
            return self.scene.processes > 0
        return bool(fields.control.any() or fields.quadratic.any())

    @cached_property
    def limited(self) -> bool:
        """Whether any control has a limit."""
        return bool(np.isfinite(self.control_limits).any())

    def holding_controls(self) -> Floats:
        """The constant control (m,), within its limits, that comes closest to holding the robot at rest at q0."""
        u = closest_controls(self.scene, self.q0)
        return np.asarray(np.clip(u, *self.control_limits), dtype=np.float64)

    def holding_policy(self) -> LinearPolicy:
        """Holding controls, with feedback that stabilizes q0 where every joint can be driven.

        The feedback is M(q0) (omega^2 (q0 - q) - 2 omega v), twice as fast as the fastest natural motion at q0. Without
        feedback rounding errors alone make an upright arm fall over.
        """
        scene, q, u = self.scene, self.q0, self.holding_controls()
        N = self.decisions - self.linear
        driven = tangent_basis(scene, q).T @ scene.actuation
        omega = 2.0 * natural_rate(scene, q, u) + 1.0 / self.duration
        gains = np.zeros((scene.controls, 2 * q.size))
        # None where controls are held too long.
        if np.linalg.matrix_rank(driven) == len(driven) and omega * self.period <= FASTEST:
            gains = self.feedback(omega)
        at_rest = np.append(q, np.zeros(q.size))
        return self.policy_of(np.tile(u, (self.decisions, 1)), np.tile(gains, (N, 1, 1)), np.tile(at_rest, (N, 1)))

    def policy_of(
        self,
        u: Floats,
        gains: Floats,
        reference: Floats,
        on: Literal["momentum", "velocity"] | None = None,
        *,
        before: JointValues | None = None,
        **options: Any,
    ) -> LinearPolicy:
        """A policy of the problem's decisions; ``options`` as for the policy.

        It is on the integrator's state by default. Linear controls u are those of the ends of lines where that
        ``before`` them is given.
        """
        on = on or ("momentum" if self.integrator.variational else "velocity")
        if self.linear and before is None:
            before, u = u[0], u[1:]
        scene, limits = self.scene, (self.control_limits[0], self.control_limits[1])
        options |= {"limits": limits, "period": self.period, "linear": self.linear, "hold": self.hold}
        options |= {"joints": scene.control_joints, "servos": scene.servo_joints}
        if scene.processes and self.integrator.variational == (on == "momentum"):
            # Feedback and margins are for the noise as this method takes it.
            options["integrator"] = self.integrator
        return LinearPolicy(u, gains, reference, on=on, before=before, **options)

    def feedback(self, omega: float) -> Floats:
        """Gains (m, 2n) on x of the forces -M(q0) (omega^2 dq + 2 omega dv), as far as controls give them."""
        scene, n = self.scene, self.q0.size
        mass, along = lagrangian_jet(scene, self.q0, np.zeros(n)).Lvv, tangent_basis(scene, self.q0)
        on_speeds = np.eye(n) if self.integrator.variational else mass
        wanted = along.T @ np.hstack([omega**2 * mass, 2.0 * omega * on_speeds])
        gains: Floats = -np.linalg.pinv(along.T @ scene.actuation) @ wanted
        gains[scene.prescribed] = 0.0
        return gains

    def decided(self, trajectory: Trajectory) -> Floats:
        """The controls (R, m) of a motion on the problem's grid, one row per decision."""
        return self.control_rows(trajectory)[:: self.hold]

    def control_rows(self, trajectory: Trajectory) -> Floats:
        """The controls of a motion as :meth:`samples` takes them."""
        return trajectory.u_nodes if self.linear else trajectory.u

    def samples(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
        """States and controls at the running costs' samples, the s samples of a step one after another.

        q and v (..., N s, n) and u (..., N s, m), from q and v at the nodes (..., N + 1, n) and u (..., N, m), or
        (..., N + 1, m) at the nodes where controls are linear between them.
        """
        shape = *q.shape[:-2], (q.shape[-2] - 1) * len(self.rule), q.shape[-1]
        # Beside the first node: what cancels at rest leaves no velocities by rounding.
        moves, weights = (v[..., :-1, :], np.diff(q, axis=-2), v[..., 1:, :]), self.rule[:, 1:].reshape(-1, 4)[:, 1:]
        # A node without weight may be NaN.
        used = np.flatnonzero(weights.any(axis=0))
        at = weights[:, used] @ np.stack([moves[i] for i in used], -2)
        at_q, at_v = (at[..., ::2, :] + q[..., :-1, None, :]).reshape(shape), at[..., 1::2, :].reshape(shape)
        if self.linear:
            share = self.places[:, None]
            between = (1.0 - share) * u[..., :-1, None, :] + share * u[..., 1:, None, :]
            return at_q, at_v, np.ascontiguousarray(between.reshape(*at_q.shape[:-1], u.shape[-1]))
        return at_q, at_v, u if len(self.rule) == 1 else np.repeat(u, len(self.rule), axis=-2)

    def costs(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The cost (...) of motions without noise terms: q and v (..., N + 1, n), u (..., N, m)."""
        total: Floats = self._shares(q, v, u).sum(axis=-1)
        return total

    def cost_of(self, trajectory: Trajectory) -> float:
        """The cost of one motion on the problem's grid.

        Raises:
            InputError: The motion is not of the problem's robot, or has another number of steps or controls, or
                another time step.
        """
        require_motion(self.scene, trajectory)
        if self.linear and not trajectory.u_nodes.shape[1]:
            raise InputError(
                "the problem's controls are linear, the motion's are not: take plan.policy.without_feedback()"
            )
        if trajectory.steps != self.steps or abs(trajectory.dt - self.dt) > ROUNDING * self.dt:
            grids = (f"{grid.steps} steps of {grid.dt:g} s" for grid in (trajectory, self))
            raise InputError(f"the motion has {next(grids)}; the problem {next(grids)}")
        return float(self.shares(trajectory).sum())

    def shares(self, trajectory: Trajectory) -> Floats:
        """The terms that sum to the cost of a motion: one entry for each cost term at each sample.

        The difference of two costs is summed from differences of shares, so a constant in the cost, however large,
        causes no rounding error.
        """
        return self._shares(trajectory.q, trajectory.v, self.control_rows(trajectory))

    def _shares(self, q: Floats, v: Floats, u: Floats) -> Floats:
        # All samples of a rule have the same weight; there is no control at the end.
        weight, none = self.dt * self.rule[0, 0], np.zeros((*q.shape[:-2], 1, self.scene.controls))
        found = [weight * part for part in self.running.shares(*self.samples(q, v, u))]
        found += self.terminal.shares(q[..., -1:, :], v[..., -1:, :], none)
        if self.rate is not None:
            found.append(self.rate.shares(u[..., :: self.hold, :], self.period))
        return np.concatenate([part.reshape(*q.shape[:-2], -1) for part in found], axis=-1)

    def not_finite(self, trajectory: Trajectory) -> tuple[Cost, ...]:
        """The cost terms that are not finite on a motion."""
        alone = ((term, self.changed(cost=term)._bind(self.running.points)) for term in self.cost.terms)
        return tuple(term for term, problem in alone if not np.isfinite(problem.shares(trajectory)).all())

    def simulate(
        self,
        controls: JointValues | LinearPolicy | OpenLoop,
        *,
        rng: np.random.Generator | int | None = None,
        increments: Floats | None = None,
    ) -> Trajectory:
        """The motion from (q0, v0) under controls (N, m), a policy or an OpenLoop.

        Noise acts where a generator ``rng`` is given, or its ``increments`` [sqrt(s)], as :func:`varpin.simulate`
        takes them.

        Raises:
            StepFailure: A step cannot be integrated.
            InputError: As :func:`varpin.simulate`.
        """
        return simulate(
            self.scene,
            self.q0,
            self.v0,
            dt=self.dt,
            steps=self.steps,
            controls=controls,
            integrator=self.integrator,
            rng=rng if self.scene.processes else None,
            increments=0.0 if rng is None and increments is None else increments,
            check=False,
        )


def require_problem(problem: object) -> OptimalControlProblem:
    """``problem`` itself; an InputError if it is no OptimalControlProblem."""
    if not isinstance(problem, OptimalControlProblem):
        raise InputError(f"problem must be an OptimalControlProblem, got {type(problem).__name__}")
    return problem


def _start(scene: Scene, q0: JointValues, v0: JointValues, dt: float) -> tuple[Floats, Floats]:
    """The initial state, corrected where the scene has constraints."""
    names = scene.robot.joint_names
    q, v = joint_array("q0", q0, names), joint_array("v0", v0, names)
    if scene.constraints:
        q, v, moved = on_constraints(scene, q, v)
        announce(logger, scene.announced, dt, moved)
    return q, v


def _rule(sampling: str, dt: float, *, cubic: bool) -> tuple[Floats, Floats]:
    """Sample points in a step of unit length (s,), and the coefficients of the samples (s, 9).

    A row has the weight, the same for all samples, then the coefficients of (q0, v0, q1, v1) for q, then those for v.
    With ``cubic`` inputs, whose velocities at the nodes are controls, "gauss" means four points, exact to degree five:
    velocities may change while they stay the same at Gauss's two points.
    """
    if sampling == "start":
        return np.zeros(1), np.array([[1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    if sampling == "midpoint":
        return np.array([0.5]), np.array([[1.0, 0.5, 0.0, 0.5, 0.0, -1.0 / dt, 0.0, 1.0 / dt, 0.0]])
    places = 0.5 + np.array([-1.0, 1.0]) * np.sqrt(3.0) / 6.0
    if cubic:
        # Chebyshev's rule of equal weights.
        inner, outer = np.sqrt((1.0 + np.array([-2.0, 2.0]) / np.sqrt(5.0)) / 3.0)
        places = 0.5 + 0.5 * np.array([-outer, -inner, inner, outer])
    return places, np.column_stack([np.full(len(places), 1.0 / len(places)), cubics(places, dt)])


def _cubic(scene: Scene) -> bool:
    """Whether a scene has cubic inputs, whose velocities at the nodes are controls."""
    return max(scene.rates, default=-1) >= 0


def bind_cost(cost: Cost, times: Floats, horizon: Points) -> tuple[BoundSum, BoundSum]:
    """The running costs at ``times`` (N,) of a horizon, and the terminal costs at its end."""
    end = np.array([horizon.t0 + horizon.duration])
    running, terminal = (
        CostSum(tuple(_placed(cost, at_end))).bind(horizon.changed(t=t)) for at_end, t in enumerate((times, end))
    )
    return running, terminal


def _placed(cost: Cost, at_end: int) -> list[Cost]:
    """The terms along the motion, or at its end, but those of the controls' rate."""
    return [term for term in cost.terms if term.at_end == at_end and not isinstance(term, ControlRateCost)]
