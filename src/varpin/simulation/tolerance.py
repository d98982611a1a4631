"""The integrator, the step and the controls of a motion with a tolerance, and its error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.errors import InputError, StepError, VarpinError
from varpin.finding import Finding
from varpin.integrators import Integrator, Reference
from varpin.mechanics.constraints import CustomConstraintError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.scene import Scene
from varpin.signals.commands import open_loop
from varpin.signals.controls import Controls, commands_of, control_rows
from varpin.signals.functions import ControlLaw, Sampled, require_law
from varpin.signals.inputs import held_in_parts
from varpin.signals.policy import FirstOrderHold, LinearPolicy, OpenLoop
from varpin.simulation.check import closer, distance, repeated, short_forces
from varpin.simulation.failures import ToleranceError
from varpin.simulation.ladder import ROUNDING, SENSIBLE, Ladder, Trial, candidates, first_steps
from varpin.simulation.record import Motions
from varpin.support.checks import positive
from varpin.trajectory import Accuracy

# Number of evaluations, times the number of joints, after which no further trial begins.
_MOST_WORK = 50_000_000
# Trials in which a user's function fails after which the search ends, if none has passed.
_RAISES = 24


class Chosen(NamedTuple):
    """What :func:`steps_for_tolerance` has found; ``error`` (N + 1, n) is that of the motion [rad or m]."""

    integrator: Integrator
    steps: int
    controls: Controls
    accuracy: Accuracy
    found: tuple[Finding, ...]
    error: Floats


class _Search:
    """Trials of a motion."""

    def __init__(self, scene: Scene, q0: Floats, v0: Floats, duration: float, controls: Controls) -> None:
        self.scene, self.q0, self.v0, self.duration = scene, q0, v0, duration
        self.controls: Floats | LinearPolicy | OpenLoop | FirstOrderHold
        self.rows = 1
        if isinstance(controls, LinearPolicy | OpenLoop | FirstOrderHold):
            self.controls = controls
        else:
            self.controls = control_rows(scene, controls)
            self.rows = len(self.controls)
        if isinstance(controls, LinearPolicy):
            self.rows = _intervals(controls, duration)
        elif isinstance(controls, FirstOrderHold):
            self.rows = len(controls.u) - 1
        self.most = _MOST_WORK / len(q0)
        self.steps = self.evaluations = 0
        self.errors: dict[tuple[str, int], Floats] = {}
        self._sampled: dict[int, Sampled] = {}
        self._raised: list[VarpinError] = []
        self._passed = False

    def given(self, steps: int) -> Controls:
        """The controls of a motion in so many steps."""
        controls, parts = self.controls, steps // self.rows
        start, span = (self.q0, self.v0), self.duration / self.rows
        if isinstance(controls, OpenLoop):
            if steps not in self._sampled:
                self._sampled[steps] = Sampled(controls, self.scene, self.duration / steps)
            return self._sampled[steps]
        if isinstance(controls, FirstOrderHold):
            fine = controls.refined(parts).u.copy()
            own = self.scene.prescribed
            fine[1:, own] = held_in_parts(self.scene, controls.u[1:], *start, span, parts)[:, own]
            return FirstOrderHold(fine)
        if isinstance(controls, LinearPolicy):
            return controls
        return held_in_parts(self.scene, controls, *start, span, parts)

    def commands(self, integrator: Integrator, steps: int) -> Commands:
        """The same as commands of the core."""
        controls = self.given(steps)
        if isinstance(controls, np.ndarray):
            return open_loop(controls)
        return commands_of(self.scene, integrator, controls, steps, self.duration / steps)

    def attempt(self, integrator: Integrator, steps: int) -> Trial:
        """A motion with its error, and the evaluations that it takes.

        Raises:
            VarpinError: A user's function has failed in all of many trials.
        """
        if steps > self.most:
            # Too long to run. Its cost is counted, which ends a search whose trials all fail in their first steps.
            self.evaluations += steps
            return Trial(integrator, steps, math.inf, math.inf)
        dt, controls = self.duration / steps, self.given(steps)
        commands = self.commands(integrator, steps)
        try:
            motion, failure = Motions(self.scene, integrator, self.q0, self.v0, dt).under(commands)
            work = motion.statistics.jets.sum() + motion.statistics.sweeps.sum()
            self.steps, self.evaluations = self.steps + motion.steps, self.evaluations + int(work)
            if failure is not None:
                return Trial(integrator, steps, math.inf, float(work) * steps / max(motion.steps, 1))
            if short_forces(self.scene, integrator, motion):
                return Trial(integrator, steps, math.inf, float(work))
            again = repeated(self.scene, integrator, motion, controls)
            # Each step of a repetition takes about twice the evaluations.
            parts = closer(self.scene, integrator, motion)[1]
            self.steps, self.evaluations = self.steps + parts * steps, self.evaluations + 2 * parts * int(work)
        except (StepError, CustomForceError, CustomConstraintError) as error:
            # Coarse steps may go where the function is not defined.
            self._raised.append(error)
            self.evaluations += steps
            if len(self._raised) >= _RAISES and not self._passed:
                raise max(self._raised, key=lambda each: getattr(each, "step", -1)) from error
            return Trial(integrator, steps, math.inf, float(steps))
        self._passed = True
        off = distance(again, motion)[0]
        floor = ROUNDING * max(1.0, float(np.abs(motion.q).max()))
        self.errors[str(integrator), steps] = off
        largest = max(float(off.max()), floor)
        whole = motion.statistics.split_steps == 0
        return Trial(integrator, steps, largest if math.isfinite(largest) else math.inf, float(work), whole=whole)


def steps_for_tolerance(
    scene: Scene,
    q0: Floats,
    v0: Floats,
    duration: float,
    tolerance: float,
    wanted: Controls | ControlLaw,
    integrator: Integrator | None,
) -> Chosen:
    """Integrator, number of steps and controls for a tolerance, with the accuracy, the error and warnings.

    Args:
        scene: The scene, without noise.
        q0: Initial configuration (n,) [rad or m].
        v0: Initial velocity (n,) [rad/s or m/s].
        duration: Of the motion [s].
        tolerance: The largest error in q [rad or m].
        wanted: The controls.
        integrator: The only one to consider; None for all.

    Raises:
        InputError: The scene, the controls or the integrator are none that a tolerance can choose steps for.
        ToleranceError: No number of steps gives an error below 1 rad or m.
        VarpinError: A user's function fails, or no integrator gets to the end.
    """
    wish = positive("tolerance", tolerance, "rad or m")
    search = _Search(scene, q0, v0, duration, _require_choice(scene, wanted, integrator))
    floor = ROUNDING * max(1.0, float(np.abs(q0).max()))
    members = (integrator,) if integrator is not None else _members(search)
    # Raise for a state from which no motion can start.
    members[0].start(scene, q0[None], v0[None])
    coarse = first_steps(scene, q0, v0, duration, search.rows)
    ladder = Ladder(search.attempt, members, coarse, search.rows, lambda: search.evaluations > search.most)
    try:
        found = ladder.for_tolerance(max(wish, floor))[0][0]
    except (StepError, CustomForceError, CustomConstraintError):
        raise
    except VarpinError:
        raise ToleranceError(wish, duration, coarse, math.inf) from None
    if not found.error < SENSIBLE:
        raise ToleranceError(wish, duration, found.steps, found.error)
    record = Accuracy(
        wish, found.error, str(found.integrator), duration / found.steps, search.steps, search.evaluations
    )
    told = () if record.met else (_unmet(record, floor),)
    error = search.errors[str(found.integrator), found.steps]
    return Chosen(found.integrator, found.steps, search.given(found.steps), record, told, error)


def _members(search: _Search) -> Sequence[Integrator]:
    """The integrators to choose from."""
    found = candidates(search.scene)
    if isinstance(search.controls, LinearPolicy):
        found = tuple(member for member in found if member.variational != (search.controls.on == "velocity"))
    return found


def _unmet(record: Accuracy, floor: float) -> Finding:
    """The warning that a tolerance is not met, with the cause."""
    cause = f"rounding leaves {floor:.1e}" if record.tolerance < floor else "errors grow, or forces jump within steps"
    text = (
        f"tolerance = {record.tolerance:g} is not met: q is off by up to {record.error:.1e} with {record.integrator} "
        f"at dt = {record.dt:.3g} s ({cause})"
    )
    return Finding("tolerance not met", text, value=record.error, unit="rad or m")


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
