"""From initial state and controls to a trajectory."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.core.arrays import Commands
from varpin.errors import InputError, UnknownJoint, VarpinError
from varpin.integrators import Integrator, Reference, Segment, integrator_of
from varpin.integrators.base import Failure, join, lines, open_loop, rows, steps_of
from varpin.integrators.within import Times, changing
from varpin.mechanics.assembly import along_constraints, dependent_input, missed, nearest
from varpin.mechanics.constraints import CustomConstraintError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.inputs import held_in_parts
from varpin.mechanics.policy import FirstOrderHold, LinearPolicy, OpenLoop
from varpin.mechanics.scene import CORRECTED, Scene, refuse_inputs, require_scene
from varpin.mechanics.wiener import wiener_increments
from varpin.simulation import limits
from varpin.simulation.choice import changes_along, integrator_along, tolerance_candidates, usual_integrator
from varpin.simulation.loop_stability import examined_in_loop, outgrown, unstable_loop
from varpin.simulation.refinement import SENSIBLE
from varpin.simulation.soundness import Finding, announce, evident, with_warnings
from varpin.simulation.tolerance import Motion, Raised, choose
from varpin.support.checks import (
    JointValues,
    as_floats,
    control_array,
    control_values,
    count,
    finite_array,
    joint_array,
    positive,
    require_finite,
    takes,
    told_motion,
)
from varpin.trajectory import STEP_NUMBERS, Accuracy, Nodes, Trajectory

Floats = NDArray[np.float64]
ControlLaw = Callable[[float, Floats, Floats], JointValues]
# Controls that are known before the motion, or fed back by the core.
Controls = JointValues | LinearPolicy | OpenLoop | FirstOrderHold | None
Progress = Callable[[int, int], None] | Callable[[int, int, Nodes], None]

logger = logging.getLogger(__name__)

# Work between two looks at the progress callback and at Ctrl-C, in steps of one joint: some tens of milliseconds.
_CHUNK = 30_000
# Who is told the motion is called at least so often [s], where nothing but whole chunks of steps takes longer.
_LOOK = 1.0 / 60.0
# What a start may be moved by onto constraints without a word [rad or m].
_UNSAID = 1e-9
# Steps at which a function of time is held against steps of half the length, and the share by which it may be off.
_LOOKS, _ALIKE = 16, 0.05
# Steps in one of a run in which a function failed, for where it does.
_FINELY = 16
# Parts of a motion that are kept one by one.
_PARTS = 256
# What an error calls a function of time.
_OF_TIME = "OpenLoop: f(t)"


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a simulation.

    Attributes:
        trajectory: What was computed before it.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        super().__init__(f"interrupted after {trajectory.steps} steps; they are in .trajectory")


class _StepError(VarpinError, ValueError):
    """A function of the user's failed in a step.

    Attributes:
        step: Index of the step.
        time: When it was called [s].
        trajectory: What was computed before; None where the function is called before the motion begins.
    """

    def __init__(self, step: int, time: float, problem: str, trajectory: Trajectory | None) -> None:
        self.step = step
        self.time = time
        self.trajectory = trajectory
        before = "" if trajectory is None else "; what came before is in error.trajectory"
        super().__init__(f"step {step} (t = {time:.6g} s): {problem}{before}")

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (type(self), str(self), vars(self).copy())


def _again(kind: type[_StepError], message: str, values: dict[str, Any]) -> _StepError:
    """An error that comes from another process."""
    error = kind.__new__(kind, message)
    vars(error).update(values)
    return error


class ControlError(_StepError):
    """A control law or the function of an OpenLoop raised, or returned something that is no control.

    Attributes:
        step: Index of the step it was called for.
        time: The time it was called with [s].
        trajectory: What was computed before; None from an ensemble, whose controls are evaluated before it begins.
    """


class NoiseError(_StepError):
    """A function of a custom noise raised, or returned something that is no field.

    Attributes:
        step: Index of the step it was called in.
        time: The start of that step [s].
        trajectory: What was computed before.
    """


class ForceError(_StepError):
    """A function of a custom force raised, or returned something that is no force.

    Attributes:
        step: Index of the step it was called in.
        time: The start of that step [s].
        trajectory: What was computed before.
    """


class ConstraintError(_StepError):
    """A function of a custom constraint raised, or returned something that is no value of it.

    Attributes:
        step: Index of the step it was called in.
        time: The start of that step [s].
        trajectory: What was computed before.
    """


class ToleranceError(VarpinError, RuntimeError):
    """No number of steps that was tried gives an error below 1 rad or m.

    Attributes:
        tolerance: What was asked for [rad or m].
        error: The best estimate of an error [rad or m]; infinite where there is none.
        steps: With how many steps.
    """

    def __init__(self, tolerance: float, duration: float, steps: int, error: float) -> None:
        self.tolerance, self.error, self.steps = tolerance, error, steps
        known = f"is still {error:.1e} rad or m" if np.isfinite(error) else "is unknown"
        super().__init__(
            f"tolerance = {tolerance:g} cannot be met over {duration:g} s: with {steps} steps the error in q "
            f"{known}. A chaotic motion has no end that any method gets right, and one whose forces are too stiff or "
            "jump may need more; ask for a shorter duration, or give dt and steps"
        )


class StepFailure(VarpinError, RuntimeError):
    """The step equation could not be solved on its principal branch.

    Attributes:
        step: Index of the step that failed.
        time: Its start [s].
        residual: The last residual, in units of the rounding error of its terms.
        reason: What stopped the last attempt.
        q: Configuration at the start of the step (n,) [rad or m].
        v: Velocity there (n,).
        p: Momentum there (n,).
        trajectory: What was computed before, with a warning if its control loop is unstable.
    """

    def __init__(self, step: int, time: float, failure: Failure, trajectory: Trajectory) -> None:
        self.step = step
        self.time = float(time)
        self.residual = failure.residual
        self.reason = failure.reason
        self.q, self.v, self.p = trajectory.q[-1], trajectory.v[-1], trajectory.p[-1]
        self.trajectory = trajectory
        told = [sentence for sentence in trajectory.warnings if not sentence.startswith(limits.KINDS)]
        advice = told[0] if told else "a smaller dt may go further"
        super().__init__(
            f"step {step} (t = {time:.6g} s) cannot be trusted: {failure.reason}; last residual {failure.residual:.3g} "
            f"rounding units, at q = {_row(self.q)}, v = {_row(self.v)}. What came before is in error.trajectory; "
            f"{advice}"
        )


def named(scene: Scene, failure: Failure) -> Failure:
    """A failure that names the functions of the scene's forces, which may be its reason."""
    if scene.custom is None:
        return failure
    what = f"CustomForce {scene.custom.names} may be the reason, where it jumps or its derivatives are wrong"
    return replace(failure, reason=f"{failure.reason} ({what})")


def _row(values: Floats) -> str:
    """A vector on one line, whatever its length."""
    return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"


class _Record:
    """The steps done so far; a trajectory can be made of them at any time.

    Attributes:
        steps: How many.
        last: The part that was added last, or the first node.
    """

    def __init__(
        self, scene: Scene, integrator: Integrator, dt: float, dw: Floats, first: Segment, line: Commands | None
    ) -> None:
        self.scene, self.integrator, self.dt, self.dw = scene, integrator, dt, dw
        self._line = line  # the commands of controls that are linear between nodes
        self.steps, self.last = 0, first
        self._first = first
        self._joined: list[Segment] = []
        self._parts: list[Segment] = []
        self._within: list[Floats] = []

    def add(self, segment: Segment, within: Floats) -> None:
        if not len(segment.q):
            return
        self.steps += len(segment.q)
        self.last = segment
        self._parts.append(segment)
        if len(within):
            self._within.append(within[: len(segment.q)])
        # Single steps take many times the room of their numbers.
        if len(self._parts) == _PARTS:
            self._joined.append(join(self._parts))
            self._parts = []

    def trajectory(self) -> Trajectory:
        dw = self.dw[: self.steps] if len(self.dw) else None
        within = np.concatenate(self._within) if self._within else None
        parts = [*self._joined, *self._parts]
        return _trajectory(self.scene, self.integrator, self.dt, self._first, parts, dw, within, self._line)


class _Reporter:
    """Who is told how far a motion is, and perhaps what it was since the last time."""

    def __init__(self, progress: Progress | None, steps: int, dt: float) -> None:
        self._progress: Any = progress
        self._steps, self._dt = steps, dt
        self._moving = told_motion("progress", progress, "steps done, steps in all", "nodes")
        self._parts: list[Segment] = []
        self._last = time.perf_counter()

    def begin(self, node: Segment) -> None:
        """Take the first node, and tell of it who is told the motion."""
        if self._moving:
            self._parts = [node]
            self._tell(0)

    def add(self, segment: Segment, done: int, *, due: bool) -> None:
        """Take steps, after which so many are ``done``; and tell, if that is due."""
        if self._progress is None:
            return
        if self._moving:
            self._parts.append(segment)
            due = due or time.perf_counter() - self._last > _LOOK
        if due or done == self._steps:
            self._tell(done)

    def _tell(self, done: int) -> None:
        if not self._moving:
            self._progress(done, self._steps)
            return
        q, v = (np.concatenate([getattr(part, name) for part in self._parts]) for name in ("q", "v"))
        nodes = Nodes(np.arange(done - len(q) + 1, done + 1, dtype=np.float64) * self._dt, q, v)
        self._parts = [replace(self._parts[-1], q=q[-1:], v=v[-1:])]
        self._progress(done, self._steps, nodes)
        self._last = time.perf_counter()


def _trajectory(
    scene: Scene,
    integrator: Integrator,
    dt: float,
    first: Segment,
    parts: list[Segment],
    dw: Floats | None,
    within: Floats | None,
    on: Commands | None = None,
) -> Trajectory:
    """The motion from a first node on over parts that follow each other; no increments stand for zeros.

    ``on`` are the commands of all of it where its controls are linear between nodes.
    """
    steps = join(parts) if len(parts) > 1 else parts[0] if parts else first.part(0)
    N = len(steps.u)
    u, nodes = steps.u, np.zeros((N + 1, 0))
    if on is not None:
        u, within, nodes = lines(on, steps.u, integrator.stage_times)
    return Trajectory(
        t=np.arange(N + 1, dtype=np.float64) * dt,
        q=np.concatenate([first.q, steps.q]),
        v=np.concatenate([first.v, steps.v]),
        p=np.concatenate([first.p, steps.p]),
        energy=np.concatenate([first.energy, steps.energy]),
        u=u,
        dw=np.zeros((N, scene.processes)) if dw is None else dw,
        masses=scene.robot.tree.mass.copy(),
        dt=dt,
        integrator=str(integrator),
        robot=scene.robot.name,
        joint_names=scene.robot.joint_names,
        statistics=steps.statistics,
        scene_values=scene.values,
        constraint_forces=np.zeros((N, len(scene.constraint_order))) if steps.impulses is None else steps.impulses / dt,
        constraint_labels=scene.constraint_labels,
        u_stages=np.zeros((N, 0, scene.controls)) if within is None else within,
        u_nodes=nodes,
    )


def _raised(error: CustomForceError | CustomConstraintError, record: _Record, where: str = "") -> _StepError:
    """The error of a function that failed in the step after those of a record."""
    now = record.trajectory()
    kind = ForceError if isinstance(error, CustomForceError) else ConstraintError
    return kind(now.steps, float(now.t[-1]), f"{where}{error}", now)


def located(
    scene: Scene,
    integrator: Integrator,
    start: tuple[Floats, Floats],
    commands: Commands,
    dt: float,
    increments: Floats | None,
    error: CustomForceError | CustomConstraintError,
    where: str = "",
) -> VarpinError:
    """The error of a function that failed somewhere in a motion, with its step and the motion before.

    The motion is made again, step by step, from ``start`` (q0, v0).
    """
    state, (first,) = integrator.start(scene, start[0][None], start[1][None])
    dw = np.zeros((0, scene.processes)) if increments is None else increments
    record = _Record(scene, integrator, dt, dw, first, commands if len(commands.places) else None)
    for _ in range(steps_of(commands)):
        block = _next(commands, record)
        drawn = dw[None, record.steps : record.steps + 1] if len(dw) else dw[None, :0][:0]
        try:
            (segment,) = integrator.rollout(scene, state, block, drawn, dt)
        except (CustomForceError, CustomConstraintError) as found:
            return _raised(found, record, where)
        record.add(segment, block.within)
        if segment.failure is not None:
            break
    # What it depends on has changed in the meantime.
    return error


class Motions:
    """Motions from one state under commands of any kind; they share their work arrays."""

    def __init__(self, scene: Scene, integrator: Integrator, q0: Floats, v0: Floats, dt: float) -> None:
        self.scene, self.integrator, self.dt = scene, integrator, dt
        self._start = q0, v0
        self._state, (self._first,) = integrator.start(scene, q0[None], v0[None])

    def under(
        self,
        commands: Commands,
        *,
        increments: Floats | None = None,
    ) -> tuple[Trajectory, Failure | None]:
        """The motion, and why it stopped early, if it did; nothing is checked.

        Args:
            commands: For all of its steps.
            increments: Of its Wiener processes (N, k) [s^0.5]; left out, there is no noise.

        Raises:
            ForceError: A function of a CustomForce failed.
        """
        drawn = np.zeros((0, 0, self.scene.processes)) if increments is None else increments[None]
        state = self.integrator.fork(self._state)
        try:
            (segment,) = self.integrator.rollout(self.scene, state, commands, drawn, self.dt)
        except CustomForceError as error:
            given = self.scene, self.integrator, self._start, commands, self.dt, increments
            raise located(*given, error) from error
        done = len(segment.u)
        dw = None if increments is None else increments[:done]
        within = commands.within[:done] if len(commands.within) else None
        line = commands if len(commands.places) else None
        made = _trajectory(self.scene, self.integrator, self.dt, self._first, [segment], dw, within, line)
        return made, segment.failure


def rollout(
    scene: Scene, integrator: Integrator, q0: Floats, v0: Floats, commands: Commands, dt: float
) -> tuple[Trajectory, Failure | None]:
    """One of the :class:`Motions` from (q0, v0)."""
    return Motions(scene, integrator, q0, v0, dt).under(commands)


def simulate(
    scene: Scene,
    q0: JointValues,
    v0: JointValues,
    *,
    dt: float | None = None,
    steps: int | None = None,
    duration: float | None = None,
    tolerance: float | Accuracy | None = None,
    controls: Controls | ControlLaw = None,
    period: int = 1,
    integrator: Integrator | None = None,
    rng: np.random.Generator | int | None = None,
    increments: ArrayLike | None = None,
    check: bool = True,
    progress: Progress | None = None,
) -> Trajectory:
    """Integrate a scene in time.

    Give ``duration`` and ``tolerance``, and the cheapest integrator and step that keep the error in q within it are
    found out and taken; or give two of ``dt``, ``steps`` and ``duration``.

    Main args:
        scene: The scene. Where it has constraints, a start that is off them by little is moved onto them, and a
            warning says how far.
        q0: Initial configuration, (n,) or by joint name, 0 for those not named [rad or m].
        v0: Initial velocity, the same [rad/s or m/s].
        dt: Time step [s].
        steps: N, their number.
        duration: steps * dt [s].
        tolerance: The largest error in q allowed at any node [rad or m], in place of ``dt`` and ``steps``.
            ``Trajectory.accuracy`` says what was taken, what error that estimates and how many steps finding out took;
            it is itself a ``tolerance``, of the same scene's next motion, which tries first what it found. Where the
            tolerance is out of reach a warning says what is reached. Rows of controls, (R, m), are then held over
            duration / R each, in which joints that are moved by hand go to theirs; the intervals of a FirstOrderHold
            are as long, a LinearPolicy needs its period in seconds, and noise and control laws are refused.
        controls: None for none, servos staying where they are at ``q0``; an array (N, m), one row a step; one row
            (m,) for all steps, by joint name too where each control is the force of a joint, with 0 for joints that
            are not named; a :class:`varpin.LinearPolicy`; a control law, a function of (t [s], q (n,), v (n,)) that
            returns (m,), or numbers by joint name; :class:`varpin.OpenLoop`, a function of time alone; or
            :class:`varpin.FirstOrderHold`, linear in time between nodes. All but the last two are constant over each
            step. A law is a digital controller: it is called once where each of its periods begins, with the time and
            the state of that node, and what it returns is held over the period.
        period: Of a control law, in steps.
        integrator: If left out, ``Gauss(stages=2)``; where, at the start, springs turn a mode by more than 0.4 rad in a
            step, ``Gauss(stages=4)``; where dampers, dry friction or servos are more than twice as fast as the step
            there, ``Radau(stages=4)``, unless the scene has constraints. Where that shows only later in the motion,
            in a stop that a joint runs into, say, the motion is made anew, and ``Trajectory.integrator`` says by what;
            that of a law, which is called once a period, is not, but is ready for all stops. A CustomForce is not
            asked for either. ``Midpoint()`` where noise is drawn; with a tolerance, the cheapest that there is.

    Other Args:
        rng: Generator or seed of the Wiener increments. Without it, and without ``increments``, they are zero, and a
            noisy scene has a warning of it; so has an ``rng`` where nothing is random.
        increments: The increments themselves, (N, k) [s^0.5], to replay or refine a path, see
            :mod:`varpin.mechanics.wiener`. 0 asks for the motion without noise.
        check: Look at the finished motion, whether the balance of its energy closes, its steps resolve it and its
            control loop is stable, for ``Trajectory.warnings`` and the log. It takes about half as long as the
            motion, and 0.1 ms (0.4 ms from 40 steps on); some times as long as the motion where its steps are coarse,
            and twice as long where small disturbances may grow.
        progress: Called now and then with (steps done, steps in all). A function that needs three arguments gets the
            motion, too: a :class:`varpin.Nodes` with the nodes from the last call on, the one it ended with first; as
            :class:`varpin.LiveView` does.

    Returns:
        The trajectory, frozen.

    Raises:
        InputError: Wrong shapes, values that are not finite, dt <= 0, steps < 0, a law of other arguments than
            (t, q, v), a period without a law; dt or steps, noise or a law beside a tolerance.
        ToleranceError: No step brings the error below 1 rad or m; a chaotic motion over a long time, say.
        UnknownJoint: ``q0`` or ``v0`` names a joint that is no coordinate of the robot, or ``controls`` one that no
            control drives.
        ControlError: The control function returned something unusable; holds the trajectory so far.
        NoiseError: A function of a CustomNoise did; holds the trajectory so far.
        ForceError: A function of a CustomForce did; holds the trajectory so far.
        ConstraintError: A function of a CustomConstraint did; holds the trajectory so far.
        StepFailure: A step has no trustworthy solution; holds the trajectory so far.
        SingularMassMatrix: M(q0) is not positive definite.
        AssemblyError: The scene's constraints cannot be kept next to q0.
        Interrupted: Ctrl-C; holds the trajectory so far. It is a KeyboardInterrupt; while a tolerance looks for its
            integrator, a plain one.
    """
    joints = require_scene(scene).robot.joint_names
    q0, v0 = joint_array("q0", q0, joints), joint_array("v0", v0, joints)
    if integrator is not None and not isinstance(integrator, Integrator):
        raise InputError(f"integrator must be one of varpin's, for example varpin.Midpoint(), got {integrator!r}")
    if controls is None and (scene.servo_joints or scene.inputs):
        controls = scene.command_at(q0)
    accuracy: Accuracy | None = None
    wished: tuple[Finding, ...] = ()
    if scene.constraints:
        q0, v0, wished = on_constraints(scene, q0, v0)
    if tolerance is not None:
        span = _time_of_wish(dt, steps, duration)
        chosen = _chosen(scene, q0, v0, span, tolerance, controls, integrator)
        integrator, steps, controls, accuracy, unmet = chosen
        wished = (*wished, *unmet)
        dt = span / steps
    else:
        dt, steps = _times(dt, steps, duration)
    period = count("period", period, least=1)
    _require_memory(scene, steps)
    dw = wiener_increments(scene.processes, dt, steps, rng, increments)
    reporter = _Reporter(progress, steps, dt)
    law = controls if callable(controls) else None
    if callable(controls) or isinstance(controls, OpenLoop):
        refuse_inputs(scene, "simulate with a function of time or a law")
    if law is not None:
        _require_law(law)
    elif period != 1:
        raise InputError(
            f"period = {period} is of a control law, a function of (t, q, v); rows are given one a step, "
            "and a LinearPolicy has a hold of its own"
        )
    # A law may remember what it was called with: its motion is made once.
    again = integrator is None and law is None and not len(dw) and changes_along(scene)
    if integrator is None:
        integrator = usual_integrator(scene, q0, v0, dt, noisy=len(dw) > 0, ahead=law is not None)
    asked = _Asked(scene, q0, v0, controls, period, dt, steps, dw, check)
    record, hold, other, interrupted = _made(asked, integrator, reporter, again=again)
    while other is not None:
        integrator = other
        record, hold, other, interrupted = _made(asked, integrator, reporter, again=again)
    try:
        try:
            trajectory, found = _told(scene, integrator, record.trajectory(), hold, check=check)
        except (CustomForceError, CustomConstraintError) as error:
            # Steps that the check takes again may go where the function is not defined. The motion stands.
            sentence = f"the motion was not checked: {error}"
            trajectory, found = record.trajectory(), (Finding("check", sentence),)
        if check and isinstance(controls, OpenLoop):
            found = (*found, *_undersampled(controls, scene, integrator, trajectory))
        found = (*noise_forgotten(scene, rng, increments), *wished, *found)
        trajectory = with_warnings(trajectory, found)
        if accuracy is not None:
            trajectory = trajectory.changed(accuracy=accuracy)
    except KeyboardInterrupt:
        raise Interrupted(replace(record.trajectory(), accuracy=accuracy)) from None
    if interrupted:
        raise Interrupted(trajectory)
    announce(logger, scene, dt, found)
    return trajectory


class _Asked(NamedTuple):
    """A motion that is to be made, but for its integrator; ``period`` is that of a law in steps."""

    scene: Scene
    q0: Floats
    v0: Floats
    controls: Controls | ControlLaw
    period: int
    dt: float
    steps: int
    dw: Floats
    check: bool


def _made(
    asked: _Asked, integrator: Integrator, reporter: _Reporter, *, again: bool
) -> tuple[_Record, int | None, Integrator | None, bool]:
    """The steps of a motion, and the period of its feedback in steps, None for none.

    ``again`` asks whether another integrator should take them, which comes next; the steps so far are then to be left.
    Last comes whether Ctrl-C has ended them.
    """
    scene, controls, dt, steps = asked.scene, asked.controls, asked.dt, asked.steps
    if callable(controls) or isinstance(controls, OpenLoop):
        commands = open_loop(np.zeros((0, scene.controls)))._replace(hold=asked.period)
    else:
        commands = commands_of(scene, integrator, controls, steps, dt)
    hold = asked.period if callable(controls) else commands.hold if isinstance(controls, LinearPolicy) else None
    state, (start,) = integrator.start(scene, asked.q0[None], asked.v0[None])
    linear = bool(len(commands.places))
    if linear:
        # Gains of a held control are looked at by the loop's check; those of lines are not.
        hold = None
    record = _Record(scene, integrator, dt, asked.dw, start, commands if linear else None)
    # A sweep takes as long as the robot has joints, an elimination as their cube.
    n = scene.robot.dof
    chunk = max(1, _CHUNK // (n + n**3 // 100))
    # One step at a time where noise or forces call Python functions: what came before one that fails is recorded.
    stepwise = scene.noise.diffusion is None or scene.custom is not None or bool(scene.bound_constraints.rows.customs)
    try:
        reporter.begin(start)
        while record.steps < steps:
            done = record.steps
            block = _next_block(controls, commands, record, 1 if stepwise else chunk, steps - done)
            segment = _rolled_out(record, state, block)
            if again and (other := _better(record, segment, block)) is not None:
                return record, hold, other, False
            record.add(segment, block.within)
            if segment.failure is not None:
                # What a law has just decided is in no step yet.
                decided = (done, block.u) if callable(controls) else None
                raise _step_failure(record, segment.failure, hold if asked.check else None, decided)
            reporter.add(segment, record.steps, due=done // chunk < record.steps // chunk)
    except KeyboardInterrupt:
        return record, hold, None, True
    return record, hold, None, False


def _better(record: _Record, segment: Segment, block: Commands) -> Integrator | None:
    """What should have taken the steps of a segment that follows a record, if that is another integrator."""
    q, v = (np.concatenate([getattr(record.last, name)[-1:], getattr(segment, name)]) for name in ("q", "v"))
    u = segment.u if len(segment.u) else block.u[:1]
    other = integrator_along(record.scene, record.integrator, q, v, u, record.dt)
    return None if other.same_map(record.integrator) else other


def _next_block(controls: Controls | ControlLaw, commands: Commands, record: _Record, most: int, left: int) -> Commands:
    """Commands of the steps that come next: about ``most`` of the ``left`` ones, in whole intervals unless it is 1."""
    if callable(controls):
        decides = record.steps % commands.hold == 0
        u = _decision(controls, record) if decides else record.last.u[-1:]
        return open_loop(u)._replace(hold=min(1 if most == 1 else commands.hold, left))
    if isinstance(controls, OpenLoop):
        return _sampled(controls, record, min(most, left))
    if most == 1 and not len(commands.places):
        return _next(commands, record)
    first = record.steps // commands.hold
    before = record.last.u[None, -1] if record.steps else None
    return rows(commands, first, first + max(1, most // commands.hold), before)


def _rolled_out(record: _Record, state: object, block: Commands) -> Segment:
    """The steps of a block; an error of a user's force or noise has the motion so far."""
    dw, scene = record.dw, record.scene
    drawn = dw[None, record.steps : record.steps + steps_of(block)] if len(dw) else dw[None, :0][:0]
    try:
        (segment,) = record.integrator.rollout(scene, state, block, drawn, record.dt)
    except (CustomForceError, CustomConstraintError) as error:
        raise _raised(error, record) from error
    except InputError as error:
        now = record.trajectory()
        raise NoiseError(now.steps, float(now.t[-1]), str(error), now) from error.__cause__
    return segment


def _step_failure(
    record: _Record, failure: Failure, hold: int | None, decided: tuple[int, Floats] | None
) -> StepFailure:
    """The error of a step that failed, its motion with a warning where an unstable control loop is the cause.

    Args:
        record: The motion so far.
        failure: Of the step.
        hold: Steps between two decisions of the loop; None where no loop is to be looked at.
        decided: Of a law the step of its last decision, and that decision (1, m).
    """
    node = record.trajectory()
    if hold is not None and not record.scene.constraints:
        last, u = (node.steps, node.u[:0]) if decided is None else decided
        loop = unstable_loop(record.scene, node, hold)
        node = with_warnings(node, loop or outgrown(np.concatenate([node.u[:last:hold], u]), hold * record.dt))
    return StepFailure(node.steps, node.t[-1], named(record.scene, failure), node)


def _times(dt: float | None, steps: int | None, duration: float | None) -> tuple[float, int]:
    """Dt [s] and the number of steps, from two of the three."""
    given = {name: value for name, value in (("dt", dt), ("steps", steps), ("duration", duration)) if value is not None}
    if len(given) != 2:
        got = " and ".join(given) or "none of them"
        raise InputError(
            f"give two of dt [s], steps and duration [s], or duration and tolerance [rad or m], which chooses dt; "
            f"got {got if len(given) < 3 else 'all three'}"
        )
    if duration is None:
        return positive("dt", dt, "s"), count("steps", steps)
    duration = positive("duration", duration, "s")
    if dt is None:
        steps = count("steps", steps, least=1)
        return duration / steps, steps
    dt = positive("dt", dt, "s")
    steps = max(1, round(min(duration / dt, 1e15)))
    if abs(steps * dt - duration) > 1e-9 * duration:
        raise InputError(f"duration = {duration:g} s is no multiple of dt = {dt:g} s: dt = {duration / steps!r} s is")
    return dt, steps


def on_constraints(scene: Scene, q0: Floats, v0: Floats) -> tuple[Floats, Floats, tuple[Finding, ...]]:
    """The nearest state that keeps the constraints, and by how much it is another, if that is to be said.

    Raises:
        InputError: q0 misses them by more than is corrected unasked.
        AssemblyError: They cannot be kept next to q0.
    """
    label, miss = missed(scene, q0)
    if miss > CORRECTED:
        raise InputError(
            f"q0 misses {label} by {miss:.4g} m or rad: varpin.assemble(scene, q0) looks for the nearest configuration "
            "that keeps the constraints"
        )
    q = nearest(scene, q0)
    if (twice := dependent_input(scene, q)) is not None:
        raise InputError(f"{twice} moves a joint that the other constraints and inputs move already at q0")
    v = along_constraints(scene, q, v0)
    shift, turned = float(np.abs(q - q0).max()), float(np.abs(v - v0).max())
    words = []
    if shift > _UNSAID:
        words.append(
            f"q0 was moved by up to {shift:.3g} rad or m onto the constraints (it missed {label} by {miss:.3g})"
        )
    if turned > _UNSAID * max(1.0, float(np.abs(v0).max())):
        words.append(f"v0 was changed by up to {turned:.3g} rad/s or m/s, to what the constraints allow")
    return q, v, (Finding("start off the constraints", "; ".join(words)),) if words else ()


def _time_of_wish(dt: float | None, steps: int | None, duration: float | None) -> float:
    """The duration of a motion with a tolerance [s]."""
    for name, value in (("dt", dt), ("steps", steps)):
        if value is not None:
            raise InputError(
                f"{name} and tolerance do not go together: a tolerance chooses the steps; give duration and tolerance, "
                f"or {name} without it"
            )
    if duration is None:
        raise InputError("tolerance needs the duration of the motion [s]")
    return positive("duration", duration, "s")


def _require_choice(scene: Scene, controls: Controls | ControlLaw, integrator: Integrator | None) -> Controls:
    """The controls; refuses what no tolerance chooses steps for.

    Raises:
        InputError: Noise, a control law, or an integrator that chooses its own steps.
    """
    if scene.processes:
        raise InputError(
            "tolerance is of single motions without noise: leave the noise out of the scene, or give dt and steps"
        )
    if isinstance(integrator, Reference):
        raise InputError("Reference chooses its own steps: its tolerance is rtol; give it dt and steps")
    if callable(controls):
        _require_law(controls)
        raise InputError(
            "a control law is called once every period, in steps, and a tolerance chooses the steps: give dt and "
            "steps with a law, or a varpin.LinearPolicy with a period, or a varpin.OpenLoop(f)"
        )
    return controls


def _intervals(policy: LinearPolicy, duration: float) -> int:
    """How many intervals a policy has over a motion, whose steps a tolerance chooses."""
    if policy.linear:
        raise InputError("tolerance chooses dt, and a policy whose controls are linear between nodes takes it: dt=")
    if policy.period is None:
        raise InputError("tolerance chooses dt, so a LinearPolicy needs the period of its intervals, period= [s]")
    parts = len(policy.gains)
    if abs(parts * policy.period - duration) > 1e-9 * duration:
        raise InputError(
            f"the policy has {parts} intervals of {policy.period:g} s, {parts * policy.period:g} s in all, and "
            f"duration = {duration:g} s"
        )
    return parts


def _unmet(record: Accuracy, floor: float) -> Finding:
    """Says that a tolerance is not met, and why."""
    cause = (
        f"rounding leaves {floor:.1e}"
        if record.tolerance < floor
        else "errors grow along this motion, or its controls and forces jump inside steps"
    )
    return Finding(
        "tolerance not met",
        f"tolerance = {record.tolerance:g} is not met: the estimated error in q is {record.error:.1e} with "
        f"{record.integrator} at dt = {record.dt:.4g} s; {cause}",
    )


def _chosen(
    scene: Scene,
    q0: Floats,
    v0: Floats,
    duration: float,
    tolerance: float | Accuracy,
    asked: Controls | ControlLaw,
    integrator: Integrator | None,
) -> tuple[Integrator, int, Controls, Accuracy, tuple[Finding, ...]]:
    """Integrator, steps and controls for a tolerance, with the estimate and what is to be said of it."""
    earlier = tolerance if isinstance(tolerance, Accuracy) else None
    wish = positive("tolerance", tolerance.tolerance if isinstance(tolerance, Accuracy) else tolerance, "rad or m")
    controls = _require_choice(scene, asked, integrator)
    members = tolerance_candidates(scene, q0, v0, duration) if integrator is None else (integrator,)
    parts = 1
    given: Callable[[Integrator, int], Commands]
    held = np.zeros((0, 0))
    if isinstance(controls, LinearPolicy):
        policy = controls
        parts = _intervals(policy, duration)
        if integrator is None:
            members = tuple(member for member in members if member.variational != (controls.on == "velocity"))

        def given(member: Integrator, steps: int) -> Commands:
            return commands_of(scene, member, policy, steps, duration / steps)
    elif isinstance(controls, OpenLoop):
        of_time = controls
        sampled: dict[tuple[Times, int], Commands] = {}

        def given(member: Integrator, steps: int) -> Commands:
            key = member.stage_times, steps
            if key not in sampled:
                sampled[key] = commands_of(scene, member, of_time, steps, duration / steps)
            return sampled[key]
    elif isinstance(controls, FirstOrderHold):
        by_nodes = controls
        parts = len(controls.u) - 1

        def given(member: Integrator, steps: int) -> Commands:
            return commands_of(scene, member, by_nodes.refined(steps // parts), steps, duration / steps)
    else:
        held = held_rows(scene, controls)
        parts = len(held)

        def given(member: Integrator, steps: int) -> Commands:  # noqa: ARG001 - as for the others
            return open_loop(held_in_parts(scene, held, q0, v0, duration / parts, steps // parts))

    motion = Motion(scene, q0, v0, duration, parts, given, isinstance(controls, OpenLoop))
    first = None
    if earlier is not None:
        known = integrator_of(earlier.integrator)
        # The user's own guard and tolerance, where the integrator is given.
        same = known if integrator is None else next((member for member in members if member.same_map(known)), None)
        if same is not None:
            first = same, earlier.dt

    def finely(run: Raised) -> VarpinError:
        """Where the function fails in small steps, and where it did if it does not there."""
        for steps in (_FINELY * run.steps, run.steps):
            commands = given(run.integrator, steps)
            found = located(scene, run.integrator, (q0, v0), commands, duration / steps, None, run.error)
            if found is not run.error:
                return found
        return run.error

    try:
        choice = choose(motion, members, wish, first)
    except Raised as run:
        raise finely(run) from run.error
    record = Accuracy(
        wish,
        choice.error,
        str(choice.integrator),
        duration / choice.steps,
        choice.search_steps,
        choice.search_evaluations,
    )
    if not choice.error < SENSIBLE:
        if choice.raised is not None:
            raise finely(choice.raised) from choice.raised.error
        raise ToleranceError(wish, duration, choice.steps, choice.error)
    found = () if record.met else (_unmet(record, choice.floor),)
    if isinstance(controls, FirstOrderHold):
        controls = controls.refined(choice.steps // parts)
    elif not isinstance(controls, LinearPolicy | OpenLoop):
        controls = held_in_parts(scene, held, q0, v0, duration / parts, choice.steps // parts)
    return choice.integrator, choice.steps, controls, record, found


def held_rows(scene: Scene, controls: JointValues | None) -> Floats:
    """Controls that are each held over an equal part of a motion, (R, m).

    Raises:
        UnknownJoint: A name that is no driven joint's.
        InputError: The array is neither (R, m) nor (m,), or not finite.
    """
    m = scene.controls
    if controls is None:
        return np.zeros((1, m))
    if isinstance(controls, Mapping):
        return control_array("controls", controls, scene.control_joints)[None]
    if hasattr(controls, "policy"):
        raise InputError("controls is a plan: give its law, plan.policy, or its controls, plan.trajectory.u")
    held = np.atleast_2d(require_finite("controls", as_floats("controls", controls)))
    if held.ndim != 2 or held.shape[1] != m or not len(held):
        raise InputError(f"controls must have shape (R, {m}) or ({m},), got {np.shape(controls)}")
    return held


def _told(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, hold: int | None, *, check: bool
) -> tuple[Trajectory, tuple[Finding, ...]]:
    """A whole motion with what is to be said of it; ``hold`` is the period of its feedback in steps, None for none."""
    if check:
        return examined_in_loop(scene, integrator, trajectory, hold)
    found = evident(scene, integrator, trajectory)
    return with_warnings(trajectory, found), found


def noise_forgotten(
    scene: Scene, rng: np.random.Generator | int | None, increments: ArrayLike | None = None
) -> tuple[Finding, ...]:
    """Says if a noisy scene is given nothing to draw its noise from, or a seed is given to a scene without noise."""
    if scene.processes and rng is None and increments is None:
        sentence = (
            "the scene has noise, and none was drawn: this is the motion without it. rng=0, or any other seed, draws "
            "it (in a scene file, seed = 0 under [simulate]); increments=0 says that none is meant"
        )
        return (Finding("noise not drawn", sentence),)
    if rng is not None and not scene.processes:
        sentence = "rng was given, but the scene has no noise, so nothing is random: varpin.Scene(robot, noise=...) has"
        return (Finding("nothing random", sentence),)
    return ()


def _require_memory(scene: Scene, steps: int) -> None:
    """Refuse a number of steps whose record cannot be held, before anything runs."""
    columns = 3 * scene.robot.dof + 2 * scene.controls + len(STEP_NUMBERS) + 2
    try:
        np.empty((steps + 1, columns))
    except (MemoryError, ValueError, OverflowError):
        raise InputError(f"steps = {steps} needs more memory than there is: {columns * 8} bytes a step") from None


def commands_of(scene: Scene, integrator: Integrator, controls: Controls, steps: int, dt: float) -> Commands:
    """Controls of ``steps`` steps of ``dt`` [s] as the core takes them.

    They are None, (steps, m), (m,), by joint name, a function of time, linear between nodes or a policy.

    Raises:
        UnknownJoint: A name that is no driven joint's.
        InputError: The array is neither (steps, m) nor (m,), or not finite; the policy is for something else; a law.
        ControlError: The function of an OpenLoop failed; it holds no trajectory.
    """
    if isinstance(controls, OpenLoop | FirstOrderHold):
        refuse_inputs(scene, f"a {type(controls).__name__}")
    if isinstance(controls, LinearPolicy) and controls.hold != 1:
        refuse_inputs(scene, "a LinearPolicy that holds its controls over several steps")
    if isinstance(controls, LinearPolicy):
        if controls.joints is not None and controls.joints != scene.control_joints:
            raise InputError(
                f"the policy's controls are of joints {', '.join(controls.joints)}; "
                f"the scene's of {', '.join(scene.control_joints or ('no single joints',))}"
            )
        if controls.servos is not None and controls.servos != scene.servo_joints:
            raise InputError(
                f"the policy's controls are positions of {', '.join(controls.servos) or 'no joints'} and forces of all "
                f"others; the scene has servos on {', '.join(scene.servo_joints) or 'no joints'}"
            )
        if controls.linear and scene.processes:
            raise InputError(
                "a policy whose controls are linear between nodes acts in scenes without noise alone: leave the "
                "scene's noise out, or plan with held controls"
            )
        return controls.commands(
            steps, scene.controls, scene.robot.dof, integrator.variational, dt, integrator.stage_times
        )
    if isinstance(controls, OpenLoop):
        return _evaluated(controls, scene, integrator, dt, range(steps))
    if isinstance(controls, FirstOrderHold):
        if controls.u.shape != (steps + 1, scene.controls):
            raise InputError(
                f"FirstOrderHold: u must have shape {(steps + 1, scene.controls)}, a row for each node of the motion, "
                f"got {controls.u.shape}"
            )
        return _on_lines(controls.u, integrator.stage_times)
    if callable(controls):
        raise InputError(
            "controls must be rows, a varpin.LinearPolicy, a varpin.OpenLoop or a varpin.FirstOrderHold here; only "
            "simulate takes a control law"
        )
    return open_loop(control_rows(scene, controls, steps))


def control_rows(scene: Scene, controls: JointValues | None, steps: int) -> Floats:
    """Controls as one row a step, (steps, m).

    Raises:
        UnknownJoint: A name that is no driven joint's.
        InputError: The array is neither (steps, m) nor (m,), or not finite.
    """
    shape = (steps, scene.controls)
    if controls is None:
        return np.zeros(shape)
    if isinstance(controls, Mapping):
        controls = control_array("controls", controls, scene.control_joints)
    if hasattr(controls, "policy"):
        raise InputError("controls is a plan: give its law, plan.policy, or its controls, plan.trajectory.u")
    array = as_floats("controls", controls)
    if array.shape != shape and array.shape != shape[1:]:
        raise InputError(f"controls must have shape {shape}, one row a step, or {shape[1:]}, got {array.shape}")
    return np.broadcast_to(require_finite("controls", array), shape).copy()


def _next(commands: Commands, record: _Record) -> Commands:
    """The command of the next step alone: a decision, or the control of the last one while it is held."""
    decision, held = divmod(record.steps, commands.hold)
    if held:
        return open_loop(record.last.u[-1:])
    before = record.last.u[None, -1] if record.steps else None
    return rows(commands, decision, decision + 1, before)._replace(hold=1)


def _require_law(law: ControlLaw) -> None:
    """Refuse a function that cannot be called with (t, q, v)."""
    if takes(law, 3):
        return
    if takes(law, 1):
        raise InputError(
            "controls is a function of one argument; a control law takes (t, q, v), and controls that are a function "
            "of time alone are given as varpin.OpenLoop(f)"
        )
    raise InputError("controls must be a function of (t, q, v): it cannot be called with three arguments")


def _decision(law: ControlLaw, record: _Record) -> Floats:
    """The control (1, m) of the period that begins at the last node."""
    k = record.steps
    time = k * record.dt
    state = record.last.q[-1].copy(), record.last.v[-1].copy()
    return _called("controls(t, q, v)", lambda: law(time, *state), record.scene, k, time, record)[None]


def _on_lines(u: Floats, times: Times) -> Commands:
    """Controls (N + 1, m) at nodes, linear between them, for a method with stages at ``times``."""
    before, after = u[:-1, None], u[1:, None]
    if not times:
        return open_loop(0.5 * (before + after)[:, 0])
    share = np.array(times)[:, None]
    return changing((1.0 - share) * before + share * after, times)


def _sampled(controls: OpenLoop, record: _Record, steps: int) -> Commands:
    """Controls of the next steps, or of those before the first for which the function fails."""
    inputs = controls, record.scene, record.integrator, record.dt
    try:
        return _evaluated(*inputs, range(record.steps, record.steps + steps), record)
    except ControlError as error:
        if error.step == record.steps:
            raise
        return _evaluated(*inputs, range(record.steps, error.step), record)


def _evaluated(
    controls: OpenLoop,
    scene: Scene,
    integrator: Integrator,
    dt: float,
    steps: Iterable[int],
    record: _Record | None = None,
) -> Commands:
    """Controls of time at the stages of some steps, or from their middles for a method with one stage."""
    times, numbers = integrator.stage_times, np.array(steps, dtype=np.int64)
    at = (numbers[:, None] + np.array(times or (0.5,))) * dt
    asked = np.ones(at.shape, dtype=np.bool_)
    if times and times[0] == 0.0 and times[-1] == 1.0:
        # Where a step begins the one before has ended.
        asked[1:, 0] = np.diff(numbers) != 1
    found = np.empty((*at.shape, scene.controls))
    look = _at_all_times if controls.vectorized else _at_times
    found[asked] = look(controls.f, scene, at[asked], np.repeat(numbers, asked.sum(axis=1)), record)
    shared = np.flatnonzero(~asked[:, 0])
    found[shared, 0] = found[shared - 1, -1]
    return changing(found, times) if times else open_loop(found[:, 0])


def _at_times(
    f: Callable[..., Any], scene: Scene, times: Floats, steps: NDArray[np.int64], record: _Record | None
) -> Floats:
    """Controls of time (K, m) at some times (K,) [s], which are within ``steps`` (K,).

    Raises:
        ControlError: The function raised, or returned something else.
    """
    found = np.empty((len(times), scene.controls))
    shape, isfinite = found.shape[1:], math.isfinite
    for k, at in enumerate(times.tolist()):
        try:
            value = f(at)
        except Exception as error:
            raise _raised_for(_OF_TIME, error, int(steps[k]), at, record) from error
        # What is a control at a glance: to look at all that others may be takes longer than many a function.
        if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == shape:
            found[k] = value
            if isfinite(value.dot(value)):
                continue
        found[k] = _control(_OF_TIME, value, scene, int(steps[k]), at, record)
    return found


def _at_all_times(
    f: Callable[..., Any], scene: Scene, times: Floats, steps: NDArray[np.int64], record: _Record | None
) -> Floats:
    """:func:`_at_times` of a function that takes all times at once.

    The first is asked for alone, which tells its rows from its columns however many they are; and each alone where all
    of them fail, which tells the first that does.
    """
    m = scene.controls
    parts = [part for part in (times[:1], times[1:]) if len(part)]
    try:
        values = [finite_array(_OF_TIME, f(part.copy()), (len(part), m)) for part in parts]
    except Exception as failure:
        for step, at in zip(steps.tolist(), times.tolist(), strict=True):
            try:
                value = f(np.array([at]))
            except Exception as error:
                raise _raised_for(_OF_TIME, error, step, at, record) from error
            try:
                finite_array(_OF_TIME, value, (1, m))
            except InputError as error:
                raise _control_error(step, at, str(error), record) from None
        raise _control_error(
            int(steps[0]),
            float(times[0]),
            f"{_OF_TIME}, vectorized, fails for {len(times)} times at once, and for none of them alone: {failure}",
            record,
        ) from failure
    return np.concatenate(values) if values else np.zeros((0, m))


def _undersampled(
    controls: OpenLoop, scene: Scene, integrator: Integrator, trajectory: Trajectory
) -> tuple[Finding, ...]:
    """Says if steps of half the length see another function: a record has its values at the stages alone."""
    dt, times = trajectory.dt, integrator.stage_times
    if not trajectory.steps:
        return ()
    looks = np.unique(np.linspace(0, trajectory.steps - 1, _LOOKS).astype(np.int64))
    try:
        halves = _evaluated(controls, scene, integrator, 0.5 * dt, [2 * k + i for k in looks.tolist() for i in (0, 1)])
    except ControlError:
        return ()
    mean = 0.5 * (halves.u[::2] + halves.u[1::2])
    total, off = (float(np.abs(part).sum()) for part in (mean, mean - trajectory.u[looks]))
    if not off > _ALIKE * total:
        return ()
    stages = f"{len(times)} stages of a step" if times else "middle of a step"
    return (
        Finding(
            "fast controls",
            f"the controls of OpenLoop change too fast for dt = {dt:g} s: their means over a step, from the {stages}, "
            f"are off by {100.0 * off / total:.3g}% of those in half the step"
            if total > 0.0
            else f"the controls of OpenLoop change too fast for dt = {dt:g} s: half the step sees none of them",
        ),
    )


def _called(
    name: str, call: Callable[[], JointValues], scene: Scene, step: int, time: float, record: _Record | None
) -> Floats:
    """What a function of the user's returns as a control (m,).

    Raises:
        ControlError: It raised, or returned something else.
    """
    try:
        value = call()
    except Exception as error:
        raise _raised_for(name, error, step, time, record) from error
    return _control(name, value, scene, step, time, record)


def _control(name: str, value: JointValues, scene: Scene, step: int, time: float, record: _Record | None) -> Floats:
    """What a function of the user's has returned, as a control (m,).

    Raises:
        ControlError: It is something else.
    """
    try:
        return control_values(name, value, scene.control_joints, scene.controls)
    except (InputError, UnknownJoint) as error:
        raise _control_error(step, time, str(error), record) from None


def _raised_for(name: str, error: Exception, step: int, time: float, record: _Record | None) -> ControlError:
    """The error of a function of the user's that raised."""
    return _control_error(step, time, f"{name} raised {error!r}", record)


def _control_error(step: int, time: float, problem: str, record: _Record | None) -> ControlError:
    """The error of a function of the user's, with the motion before it."""
    return ControlError(step, time, problem, None if record is None else record.trajectory())
