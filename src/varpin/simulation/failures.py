"""Errors of a simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from varpin.errors import StepError, VarpinError
from varpin.integrators.base import Failure
from varpin.mechanics.constraints import CustomConstraint
from varpin.mechanics.scene import Scene
from varpin.trajectory import Trajectory


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a simulation.

    Attributes:
        trajectory: The motion before it.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        super().__init__(f"interrupted after {trajectory.steps} steps; they are in .trajectory")


class NoiseError(StepError):
    """A function of a custom noise raised, or returned something that is no field."""


class ForceError(StepError):
    """A function of a custom force raised, or returned something that is no force."""


class ConstraintError(StepError):
    """A function of a custom constraint raised, or returned something that is no value of it."""


class ToleranceError(VarpinError, RuntimeError):
    """No number of steps that was tried gives an error below 1 rad or m.

    Attributes:
        tolerance: The tolerance [rad or m].
        error: The smallest estimate of the error in q [rad or m]; infinite where there is none.
        steps: The number of steps of that estimate.
    """

    def __init__(self, tolerance: float, duration: float, steps: int, error: float) -> None:
        self.tolerance, self.error, self.steps = tolerance, error, steps
        known = f"is still {error:.1e} rad or m" if np.isfinite(error) else "is unknown"
        super().__init__(
            f"tolerance = {tolerance:g} cannot be met over {duration:g} s: with {steps} steps the error in q "
            f"{known}. Give a shorter duration, as no method follows a chaotic motion to its end, or dt and steps"
        )


class StepFailure(VarpinError, RuntimeError):
    """The step equation could not be solved on its principal branch.

    Attributes:
        step: Index of the step that failed.
        time: Its start [s].
        residual: The last residual, in units of the rounding error of its terms.
        reason: What stopped the last attempt.
        problem: The step and the reason, in words.
        advice: An unstable control loop if there is one, else the cause or what to try.
        q: Configuration at the start of the step (n,) [rad or m].
        v: Velocity there (n,).
        p: Momentum there (n,).
        trajectory: The motion before, with a warning if its control loop is unstable.
    """

    def __init__(
        self, step: int, time: float, failure: Failure, trajectory: Trajectory, advice: str = "Use a smaller dt"
    ) -> None:
        self.step = step
        self.time = float(time)
        self.residual = failure.residual
        self.reason = failure.reason
        self.q, self.v, self.p = trajectory.q[-1], trajectory.v[-1], trajectory.p[-1]
        self.trajectory = trajectory
        self.advice = next((found for found in trajectory.warnings if found.kind == "unstable loop"), advice)
        self.problem = f"step {step} (t = {time:.6g} s) failed: {failure.reason}"
        advice = str(self.advice)
        super().__init__(f"{self.problem}. {advice[:1].upper()}{advice[1:]}. The motion so far is in error.trajectory")

    def along(self, trajectory: Trajectory, advice: str) -> StepFailure:
        """The same failure with the motion's warnings, and with what its caller may try."""
        return StepFailure(self.step, self.time, Failure(self.reason, self.residual), trajectory, advice)


def named(scene: Scene, failure: Failure) -> Failure:
    """The failure with the scene's own functions of forces and constraints named as a possible reason."""
    own = [] if scene.custom is None else [f"CustomForce {scene.custom.names}"]
    own += ["a CustomConstraint"] * any(isinstance(each, CustomConstraint) for each in scene.constraints)
    if not own:
        return failure
    what = f"{' or '.join(own)} may be the reason, where it jumps or its derivatives are wrong"
    return replace(failure, reason=f"{failure.reason} ({what})")
