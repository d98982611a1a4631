"""From initial state and controls to a trajectory."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.errors import InputError
from varpin.finding import Finding, announce, ranked
from varpin.integrators import Integrator
from varpin.integrators.base import Failure, Run
from varpin.mechanics.scene import Scene, require_scene
from varpin.mechanics.wiener import wiener_increments
from varpin.signals.commands import open_loop
from varpin.signals.controls import Controls, commands_of
from varpin.signals.functions import ControlLaw, Sampled, copier, function_findings, require_law
from varpin.signals.policy import FirstOrderHold, LinearPolicy, OpenLoop
from varpin.simulation.check import Case
from varpin.simulation.check import check as checked
from varpin.simulation.choice import given_integrator, usual_integrator
from varpin.simulation.failures import Interrupted, StepFailure, named
from varpin.simulation.loop import Gains, unstable_loop
from varpin.simulation.record import MotionRecord, Progress, Reporter
from varpin.simulation.start import on_constraints, start_in_degrees, time_steps
from varpin.simulation.tolerance import steps_for_tolerance
from varpin.support.checks import JointValues, as_floats, count, flag, joint_array, positive, require_memory
from varpin.trajectory import STEP_NUMBERS, Accuracy, Trajectory

logger = logging.getLogger(__name__)

# Work between two progress calls and checks for Ctrl-C, in steps of one joint: some tens of milliseconds.
_CHUNK = 30_000

# The findings about the control loop of a motion.
LoopCheck = Callable[[Trajectory], tuple[Finding, ...]]


def simulate(
    scene: Scene,
    q0: JointValues,
    v0: JointValues,
    *,
    dt: float | None = None,
    steps: int | None = None,
    duration: float | None = None,
    tolerance: float | None = None,
    controls: Controls | ControlLaw = None,
    period: int = 1,
    integrator: Integrator | None = None,
    rng: np.random.Generator | int | None = None,
    increments: ArrayLike | None = None,
    check: bool = True,
    progress: Progress | None = None,
) -> Trajectory:
    """Integrate a scene in time.

    Give ``duration`` and ``tolerance`` to have the cheapest integrator and time step chosen that keep the error in q
    within the tolerance; or give two of ``dt``, ``steps`` and ``duration``.

    Main args:
        scene: The scene. A start that misses its constraints slightly is moved onto them, with a warning that gives
            the distance.
        q0: Initial configuration, (n,) or by joint name, 0 for those not named [rad or m].
        v0: Initial velocity, the same [rad/s or m/s].
        dt: Time step [s].
        steps: N, their number.
        duration: steps * dt [s].
        tolerance: The largest error in q allowed at any node [rad or m], in place of ``dt`` and ``steps``.
            ``Trajectory.accuracy`` gives the integrator and step taken, the estimated error and the steps of the
            search. If the tolerance cannot be met, a warning gives the error that is reached. Rows of controls, (R, m),
            are then held over duration / R each, in which joints with prescribed positions move to theirs; the
            intervals of a FirstOrderHold are as long; a LinearPolicy needs its period in seconds; noise and control
            laws are refused.
        controls: None for none, with servos holding ``q0``; an array (N, m), one row a step; one row (m,) for all
            steps, also by joint name where each control is the force of a joint, with 0 for joints that are not named;
            a :class:`varpin.LinearPolicy`; a control law, a function of (t [s], q (n,), v (n,)) that returns (m,) or
            numbers by joint name; :class:`varpin.OpenLoop`, a function of time alone; or
            :class:`varpin.FirstOrderHold`, linear in time between nodes. All but the last two are constant over each
            step. A law is a digital controller: it is called once at the start of each of its periods, with the time
            and state of that node, and its value is held over the period.
        period: Of a control law, in steps.
        integrator: If left out, that of the policy of a plan under noise, or chosen by the rates at the start and in
            all joint stops: ``Radau(stages=4)`` where dampers, dry friction or servos are more than twice as fast as
            the step and the scene has no constraints; ``Gauss(stages=4)`` where springs turn a mode by more than 0.4
            rad in a step; else ``Gauss(stages=2)``. A CustomForce has no part in the choice. ``Midpoint(kick="held")``
            where noise is drawn; with a tolerance, the cheapest of all. The check names a better one where the choice
            was not enough.

    Other Args:
        rng: Generator or seed of the Wiener increments. Without it, and without ``increments``, they are zero, with a
            warning if the scene has noise. An ``rng`` for a scene without noise gives a warning, too.
        increments: The increments themselves, (N, k) [s^0.5], or (N, K) as :attr:`Trajectory.dw` with those for slopes
            of linear controls, which are zero if left out, to replay or refine a path, see
            :mod:`varpin.mechanics.wiener`. 0 gives the motion without noise and without the warning.
        check: Find the error of the motion, ``Trajectory.error``, and what is doubtful, ``Trajectory.warnings``. Where
            the record alone shows the motion right the check takes half of the motion's time; else, and under a control
            law, of which it calls a copy, it repeats the motion by a method of two stages more, with forces and stiff
            methods in half steps, which takes two to five times as long as the motion, or twice that.
        progress: Called now and then with (steps done, steps in all). A function with three required arguments, such
            as :class:`varpin.LiveView`, also gets a :class:`varpin.Nodes` with the nodes since the last call, whose
            last node comes first again.

    Returns:
        The trajectory, frozen.

    Raises:
        InputError: Wrong shapes, values that are not finite, dt <= 0, steps < 0, a law of other arguments than
            (t, q, v), a period without a law; dt or steps, noise or a law beside a tolerance.
        ToleranceError: No step brings the error below 1 rad or m, as in a chaotic motion over a long time.
        UnknownJoint: ``q0`` or ``v0`` names a joint that is no coordinate of the robot, or ``controls`` one that no
            control drives.
        ControlError, NoiseError, ForceError, ConstraintError: A function of controls, a CustomNoise, a CustomForce or
            a CustomConstraint failed; holds the trajectory so far.
        StepFailure: A step has no trustworthy solution; holds the trajectory so far.
        SingularMassMatrix: M(q0) is not positive definite.
        AssemblyError: The scene's constraints cannot be kept near q0.
        Interrupted: Ctrl-C; holds the trajectory so far. It is a KeyboardInterrupt; during the search of a tolerance
            a plain one is raised.
    """
    joints = require_scene(scene).robot.joint_names
    q0, v0 = joint_array("q0", q0, joints), joint_array("v0", v0, joints)
    # A tolerance chooses among all integrators, also for a policy that has one.
    integrator = given_integrator(integrator, controls if tolerance is None else None)
    if controls is None and (scene.servo_joints or scene.inputs):
        controls = scene.command_at(q0)
    accuracy: Accuracy | None = None
    error: Floats | None = None
    unmet: tuple[Finding, ...] = ()
    given = q0, v0
    moved: tuple[Finding, ...] = ()
    if scene.constraints:
        q0, v0, moved = on_constraints(scene, q0, v0)
    if tolerance is not None:
        if dt is not None or steps is not None:
            raise InputError("a tolerance chooses dt and steps: give duration and tolerance without them")
        span = positive("duration", duration, "s")
        chosen = steps_for_tolerance(scene, q0, v0, span, tolerance, controls, integrator)
        integrator, steps, controls, accuracy, unmet, error = chosen
        dt = span / steps
    else:
        dt, steps = time_steps(dt, steps, duration, choosable=True)
    period, check = count("period", period, least=1), flag("check", check)
    columns = 3 * scene.robot.dof + 2 * scene.controls + len(STEP_NUMBERS) + 2
    require_memory(steps + 1, columns, f"steps = {steps}", "step")
    law = callable(controls)
    if callable(controls):
        require_law(controls)
    elif period != 1:
        raise InputError(
            f"period = {period} applies to a control law only; arrays have one row a step, "
            "a LinearPolicy has its own hold"
        )
    on_lines = isinstance(controls, FirstOrderHold) or (isinstance(controls, LinearPolicy) and controls.linear)
    width = scene.increments(linear=on_lines)
    if increments is not None and as_floats("increments", increments).shape == (steps, scene.processes):
        # Given without those for slopes of the controls, which are zero then.
        width = scene.processes
    dw = wiener_increments(width, dt, steps, rng, increments)
    if integrator is None:
        integrator = usual_integrator(scene, q0, v0, dt, noisy=len(dw) > 0)
    if isinstance(controls, OpenLoop) and not isinstance(controls, Sampled):
        controls = Sampled(controls, scene, dt)
    commands = open_loop(np.zeros((0, scene.controls)))._replace(hold=period)
    if not (callable(controls) or isinstance(controls, Sampled)):
        commands = commands_of(scene, integrator, controls, steps, dt)
    linear = len(commands.stage_times) > 0
    # The check of a loop is for held controls: commands have the period of a law, too.
    feeds_back = law or (isinstance(controls, LinearPolicy) and controls.gains.any() and not linear)
    hold = commands.hold if feeds_back else 0
    state, (start,) = integrator.start(scene, q0[None], v0[None])
    held = commands.hold > 1 and not law
    record = MotionRecord(scene, integrator, dt, dw, start, commands if linear else None, held=held)
    kept = copier(controls) if check and callable(controls) else None
    fed = kept if law else Gains(commands.gains, scene if integrator.variational else None)
    loop = functools.partial(unstable_loop, scene, hold=hold, law=fed) if check and hold else None
    interrupted = not _roll(record, state, steps, controls, commands, Reporter(progress, steps, dt), loop)
    motion = record.trajectory()
    known = None if interrupted else error
    try:
        found: list[Finding] = [*unmet, *noise_forgotten(scene, rng, increments)]
        if check:
            ended = interrupted and not isinstance(controls, Sampled)
            more = None if callable(controls) or ended else controls
            motion = checked(Case(scene, integrator, motion, more, hold=period if law else 0, law=kept), known)
            unstable = () if loop is None or steps <= 2 * hold else loop(motion)
            wrong = [finding for finding in motion.warnings if finding.kind == "error"]
            unsettled = function_findings(controls) if isinstance(controls, Sampled) else ()
            found = [*unstable, *wrong, *unsettled, *found, *motion.warnings]
        elif known is not None:
            motion = motion.with_error(known)
        # Degrees explain all else. Without controls servos hold the start.
        found = [*start_in_degrees(scene, *given, motion.u), *found, *moved]
        motion = motion.changed(warnings=ranked(found), accuracy=accuracy)
    except KeyboardInterrupt:
        raise Interrupted(motion.changed(accuracy=accuracy)) from None
    if interrupted:
        raise Interrupted(motion)
    announce(logger, scene.announced, dt, motion.warnings)
    return motion


def _roll(
    record: MotionRecord,
    state: Run,
    steps: int,
    controls: Controls | ControlLaw,
    commands: Commands,
    reporter: Reporter,
    loop: LoopCheck | None,
) -> bool:
    """Integrate the steps of a motion, with the check of its loop if there is one; False if Ctrl-C ended them."""
    scene = record.scene
    # The cost of a sweep is linear in the number of joints, that of an elimination cubic.
    n = scene.robot.dof
    chunk = max(1, _CHUNK // (n + n**3 // 100))
    # One step at a time where noise or forces call Python functions, to record the steps before one that fails.
    stepwise = scene.noise.diffusion is None or scene.custom is not None or bool(scene.bound_constraints.rows.customs)
    try:
        reporter.begin(record.last)
        while record.steps < steps:
            done = record.steps
            segment = record.advance(state, controls, commands, 1 if stepwise else chunk, steps)
            if segment.failure is not None:
                raise _step_failure(record, segment.failure, loop)
            reporter.add(segment, record.steps, due=done // chunk < record.steps // chunk)
    except KeyboardInterrupt:
        return False
    return True


def _step_failure(record: MotionRecord, failure: Failure, loop: LoopCheck | None) -> StepFailure:
    """The error of a step that failed, its motion with a warning where an unstable control loop is the cause."""
    motion = record.trajectory()
    motion = motion.changed(warnings=() if loop is None else loop(motion))
    # A function of the scene may fail where the motion runs away.
    rings = "" if record.scene.custom else Case(record.scene, record.integrator, motion).rings
    failure = named(record.scene, failure)
    return StepFailure(motion.steps, motion.t[-1], failure, motion, rings or "Use a smaller dt")


def noise_forgotten(
    scene: Scene, rng: np.random.Generator | int | None, increments: ArrayLike | None = None
) -> tuple[Finding, ...]:
    """Warnings: the scene has noise, but neither seed nor increments; or there is a seed, but no noise."""
    if scene.processes and rng is None and increments is None:
        text = (
            "no noise was applied, because rng= was not given. Pass rng=0 to draw it (seed = 0 in a scene file), "
            "increments=0 to silence this"
        )
        return (Finding("noise not drawn", text),)
    if rng is not None and not scene.processes:
        return (Finding("nothing random", "rng= has no effect: the scene has no noise, Scene(robot, noise=...)"),)
    return ()
