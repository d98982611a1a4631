"""Controls of a motion as commands of the core."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.errors import InputError
from varpin.mechanics.scene import Scene
from varpin.signals.commands import Times, changing, on_lines, open_line, open_loop, prescribing
from varpin.signals.functions import Sampled
from varpin.signals.policy import FirstOrderHold, LinearPolicy, OpenLoop
from varpin.support.checks import JointValues, as_floats, control_values, require_finite

# All controls but a control law: known before the motion, or fed back by the core.
Controls = JointValues | LinearPolicy | OpenLoop | FirstOrderHold | None


class Method(Protocol):
    """What controls need to know of an integrator."""

    variational: bool

    @property
    def stage_times(self) -> Times:
        """Times of a unit step at which controls that change within it are evaluated; empty if their mean is held."""


def commands_of(scene: Scene, integrator: Method, controls: Controls, steps: int, dt: float) -> Commands:
    """Commands of the core for controls of ``steps`` steps of ``dt`` [s].

    The controls are None, (steps, m), (m,), by joint name, a function of time, linear between nodes or a policy.

    Raises:
        UnknownJoint: A name is not that of a driven joint.
        InputError: The array is neither (steps, m) nor (m,), or not finite; the policy is for another scene or step;
            the controls are a control law.
        ControlError: The function of an OpenLoop failed; the error holds no trajectory.
    """
    if isinstance(controls, LinearPolicy):
        for what, own, of_scene in (
            ("controls", controls.joints, scene.control_joints),
            ("servos", controls.servos, scene.servo_joints),
        ):
            if own is not None and own != of_scene:
                theirs, ours = (", ".join(joints or ()) or "no joint" for joints in (own, of_scene))
                raise InputError(f"the policy's {what} are of {theirs}, the scene's of {ours}")
        return controls.commands(
            steps, scene.controls, scene.robot.dof, integrator.variational, dt, integrator.stage_times
        )
    if isinstance(controls, OpenLoop):
        of = controls if isinstance(controls, Sampled) and controls.dt == dt else Sampled(controls, scene, dt)
        return of.commands(0, steps, integrator.stage_times)
    if isinstance(controls, FirstOrderHold):
        if controls.u.shape != (steps + 1, scene.controls):
            raise InputError(
                f"FirstOrderHold: u must have shape {(steps + 1, scene.controls)}, a row for each node of the motion, "
                f"got {controls.u.shape}"
            )
        if scene.noise.sloped.size:
            # Their noise sees the lines themselves.
            return open_line(controls.u, integrator.stage_times)
        return prescribing(scene, _on_lines(controls.u, integrator.stage_times), controls.u[1:])
    if callable(controls):
        raise InputError(
            "controls must be rows, a varpin.LinearPolicy, a varpin.OpenLoop or a varpin.FirstOrderHold here; only "
            "simulate takes a control law: call it with rng= for each path, or give a linear law as a LinearPolicy"
        )
    return open_loop(control_rows(scene, controls, steps))


def control_rows(scene: Scene, controls: JointValues | None, steps: int | None = None) -> Floats:
    """Controls as rows, one for each of so many steps; or as many as are given, each for an equal part of a motion.

    Raises:
        UnknownJoint: A name is not that of a driven joint.
        InputError: The array is neither (steps, m) nor (m,), or not finite.
    """
    m = scene.controls
    if controls is None:
        return np.zeros((1 if steps is None else steps, m))
    if isinstance(controls, Mapping):
        controls = control_values("controls", controls, scene.control_joints, m)
    if hasattr(controls, "policy"):
        raise InputError("controls is a plan: give its law, plan.policy, or its controls, plan.trajectory.u")
    array = as_floats("controls", controls)
    number = max(1, len(np.atleast_2d(array))) if steps is None else steps
    if array.shape not in ((number, m), (m,)):
        raise InputError(
            f"controls must have shape ({'R' if steps is None else steps}, {m}), one row a step, or ({m},), got "
            f"{array.shape}"
        )
    rows = np.empty((number, m))
    rows[:] = require_finite("controls", array)
    return rows


def _on_lines(u: Floats, times: Times) -> Commands:
    """Commands for controls (N + 1, m) at the nodes, linear between them, with stages at ``times``."""
    along = on_lines(u[:-1], u[1:], 1, times or (0.5,))
    return changing(along, times) if times else open_loop(along[:, 0])
