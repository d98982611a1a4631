"""The time step of a motion and the number of its steps, as given or chosen for a tolerance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.errors import InputError, VarpinError
from varpin.integrators import Integrator, Reference, integrator_of
from varpin.integrators.base import open_loop
from varpin.integrators.within import Times
from varpin.mechanics.inputs import held_in_parts
from varpin.mechanics.policy import FirstOrderHold, LinearPolicy, OpenLoop
from varpin.mechanics.scene import Scene
from varpin.simulation.choice import tolerance_candidates
from varpin.simulation.commands import Controls, commands_of, held_rows
from varpin.simulation.failures import ToleranceError
from varpin.simulation.functions import ControlLaw, require_law
from varpin.simulation.record import located
from varpin.simulation.refinement import SENSIBLE
from varpin.simulation.soundness import Finding
from varpin.simulation.tolerance import Motion, Raised, Steps, choose
from varpin.support.checks import count, positive
from varpin.trajectory import Accuracy

# Factor on the number of steps of a run whose user's function failed, when the failing step is looked for.
_REFINED = 16


def time_steps(
    dt: float | None, steps: int | None, duration: float | None, *, choosable: bool = False
) -> tuple[float, int]:
    """The time step [s] and the number of steps, from two of the three arguments.

    Args:
        dt: Time step [s].
        steps: Number of steps.
        duration: Their product [s].
        choosable: Whether a tolerance may be given instead, for the message.

    Raises:
        InputError: Not two are given, one is invalid, or the duration is no multiple of the step.
    """
    given = {name: value for name, value in (("dt", dt), ("steps", steps), ("duration", duration)) if value is not None}
    if len(given) != 2:
        got = " and ".join(given) or "none of them"
        other = ", or duration and tolerance [rad or m], which chooses dt" if choosable else ""
        raise InputError(
            f"give two of dt [s], steps and duration [s]{other}; got {got if len(given) < 3 else 'all three'}"
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
        raise InputError(
            f"duration = {duration:g} s is no multiple of dt = {dt:g} s, but of dt = {duration / steps!r} s"
        )
    return dt, steps


def duration_for_tolerance(dt: float | None, steps: int | None, duration: float | None) -> float:
    """The duration of a motion with a tolerance [s]; refuses a given dt or number of steps."""
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
    """The controls, if a tolerance can choose steps for them.

    Raises:
        InputError: The scene has noise, the controls are a law, or the integrator chooses its own steps.
    """
    if scene.processes:
        raise InputError(
            "tolerance is of single motions without noise: leave the noise out of the scene, or give dt and steps"
        )
    if isinstance(integrator, Reference):
        raise InputError("Reference chooses its own steps: its tolerance is rtol; give it dt and steps")
    if callable(controls):
        require_law(controls)
        raise InputError(
            "a control law is called once every period, in steps, and a tolerance chooses the steps: give dt and "
            "steps with a law, or a varpin.LinearPolicy with a period, or a varpin.OpenLoop(f)"
        )
    return controls


def _intervals(policy: LinearPolicy, duration: float) -> int:
    """The number of a policy's intervals over a motion whose steps a tolerance chooses."""
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


def _line_in_parts(
    scene: Scene, line: FirstOrderHold, q0: Floats, v0: Floats, duration: float, parts: int
) -> FirstOrderHold:
    """:meth:`FirstOrderHold.refined`, with kinematic inputs on the lines and cubics of the intervals."""
    found = line.refined(parts)
    u, own = found.u.copy(), scene.prescribed
    u[1:, own] = held_in_parts(scene, line.u[1:], q0, v0, duration / (len(line.u) - 1), parts)[:, own]
    return FirstOrderHold(u)


def _unmet(record: Accuracy, floor: float) -> Finding:
    """The warning that a tolerance is not met, with the cause."""
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


def _members(motion: Motion, controls: Controls, integrator: Integrator | None) -> tuple[Integrator, ...]:
    """The integrators to choose from; only the given one, if there is one."""
    if integrator is not None:
        return (integrator,)
    found = tolerance_candidates(motion.scene, motion.q0, motion.v0, motion.duration)
    if isinstance(controls, LinearPolicy):
        found = tuple(member for member in found if member.variational != (controls.on == "velocity"))
    return found


def steps_for_tolerance(
    scene: Scene,
    q0: Floats,
    v0: Floats,
    duration: float,
    tolerance: float | Accuracy,
    wanted: Controls | ControlLaw,
    integrator: Integrator | None,
) -> tuple[Integrator, int, Controls, Accuracy, tuple[Finding, ...], Steps]:
    """Integrator, number of steps and controls for a tolerance, with the estimated accuracy and warnings.

    The last value are the steps of this motion, if the search has kept them; else it is empty.

    Args:
        scene: The scene, without noise.
        q0: Initial configuration (n,) [rad or m].
        v0: Initial velocity (n,) [rad/s or m/s].
        duration: Of the motion [s].
        tolerance: The largest error in q [rad or m], or the accuracy of an earlier motion.
        wanted: The controls.
        integrator: The only one to consider; None for all.

    Raises:
        InputError: The scene, the controls or the integrator are none that a tolerance can choose steps for.
        ToleranceError: No number of steps gives an error below 1 rad or m.
        VarpinError: A user's function fails, or no integrator gets to the end.
    """
    earlier = tolerance if isinstance(tolerance, Accuracy) else None
    wish = positive("tolerance", tolerance.tolerance if isinstance(tolerance, Accuracy) else tolerance, "rad or m")
    controls = _require_choice(scene, wanted, integrator)
    parts = 1
    given: Callable[[Integrator, int], Commands]
    held = np.zeros((0, 0))
    if isinstance(controls, LinearPolicy):
        policy = controls
        parts = _intervals(policy, duration)

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
            fine = _line_in_parts(scene, by_nodes, q0, v0, duration, steps // parts)
            return commands_of(scene, member, fine, steps, duration / steps)
    else:
        held = held_rows(scene, controls)
        parts = len(held)

        def given(member: Integrator, steps: int) -> Commands:  # noqa: ARG001 - as for the others
            return open_loop(held_in_parts(scene, held, q0, v0, duration / parts, steps // parts))

    motion = Motion(scene, q0, v0, duration, parts, given, isinstance(controls, OpenLoop))
    first = None
    if earlier is not None:
        known = integrator_of(earlier.integrator)
        # A given integrator keeps its own guard and solver tolerance.
        if integrator is None or integrator.same_map(known):
            first = integrator or known, earlier.dt

    def failure_of(run: Raised) -> VarpinError:
        """The error with its failing step, found in smaller steps or, failing that, in those of the run."""
        for steps in (_REFINED * run.steps, run.steps):
            commands = given(run.integrator, steps)
            found = located(scene, run.integrator, (q0, v0), commands, duration / steps, None, run.error)
            if found is not run.error:
                return found
        return run.error

    try:
        choice = choose(motion, lambda: _members(motion, controls, integrator), wish, first)
    except Raised as run:
        raise failure_of(run) from run.error
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
            raise failure_of(choice.raised) from choice.raised.error
        raise ToleranceError(wish, duration, choice.steps, choice.error)
    found = () if record.met else (_unmet(record, choice.floor),)
    if isinstance(controls, FirstOrderHold):
        controls = _line_in_parts(scene, controls, q0, v0, duration, choice.steps // parts)
    elif not isinstance(controls, LinearPolicy | OpenLoop):
        controls = held_in_parts(scene, held, q0, v0, duration / parts, choice.steps // parts)
    return choice.integrator, choice.steps, controls, record, found, choice.motion
