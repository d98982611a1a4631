"""Commands of a plan's motions: feedback around a motion, and given controls."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.core.arrays import Commands
from varpin.errors import InputError
from varpin.signals.commands import open_line, open_loop
from varpin.signals.policy import LinearPolicy
from varpin.support.checks import JointValues, as_floats, control_array, finite_array


def around(problem: OptimalControlProblem, u: Floats, x: Floats, gains: Floats, previous: Floats | None) -> Commands:
    """Controls u (R, m) with ``gains`` (R, m, 2n) around the states x before each decision.

    ``previous`` are those (R, m, m) on the previous control around u. Of linear controls, whose first one is given,
    there are states (R - 1, 2n).
    """
    if previous is not None:
        gains = np.concatenate([gains, previous], axis=2)
        # The control before the first one is given.
        before = u[:-1] if problem.linear else np.vstack([u[:1], u[:-1]])
        x = np.hstack([x, before])
    if problem.linear:
        return held(u, problem)._replace(gains=np.ascontiguousarray(gains[1:]), reference=np.ascontiguousarray(x))
    return Commands(
        u=u,
        gains=np.ascontiguousarray(gains),
        reference=np.ascontiguousarray(x),
        hold=problem.hold,
        limits=problem.control_limits,
        before=np.zeros((0, problem.scene.controls)),
    )


def held(u: Floats, problem: OptimalControlProblem) -> Commands:
    """Controls u (R, m) without feedback, within their limits."""
    if problem.linear:
        within = problem.begun(np.clip(u, *problem.control_limits))
        return open_line(within, problem.integrator.stage_times)._replace(limits=problem.control_limits.copy())
    return open_loop(u)._replace(hold=problem.hold, limits=problem.control_limits.copy())


def first_commands(problem: OptimalControlProblem, controls: JointValues | LinearPolicy | Solution | None) -> Commands:
    """The commands of the first motion under given controls, within the problem's limits.

    Raises:
        InputError: Controls of a wrong shape, or of another hold or kind than the problem's.
    """
    m, variational = problem.scene.controls, problem.integrator.variational
    if isinstance(controls, Solution):
        controls = controls.policy_on("momentum" if variational else "velocity")
    if controls is None:
        controls = problem.holding_policy()
    if isinstance(controls, LinearPolicy):
        if (hold := controls.hold_at(problem.dt)) != problem.hold:
            raise InputError(f"the policy holds its controls over {hold} steps, the problem {problem.hold}")
        if controls.linear != problem.linear:
            policy, wanted = ("linear", "held") if controls.linear else ("held", "linear")
            raise InputError(f"the policy's controls are {policy}, the problem's {wanted}")
        commands = controls.commands(
            problem.steps, m, problem.scene.robot.dof, variational, problem.dt, problem.integrator.stage_times
        )
        narrowed = np.clip(commands.limits, *problem.control_limits)
        narrowed.setflags(write=False)
        if problem.linear:
            return commands._replace(limits=narrowed, before=problem.begun(np.clip(commands.before, *narrowed)))
        if problem.rate is not None and problem.rate.before is not None:
            commands = commands._replace(before=problem.rate.before[None].copy())
        return commands._replace(limits=narrowed)
    return held(_rows_of(problem, controls), problem)


def controls_along(problem: OptimalControlProblem, controls: object) -> Floats | None:
    """Controls (R, m) along given states, clipped to their limits."""
    if controls is None:
        return None
    if isinstance(controls, Solution | LinearPolicy):
        raise InputError("controls beside states must be (R, m), (m,) or by joint name, without feedback")
    u = _rows_of(problem, controls)
    return np.asarray(np.clip(u, *problem.control_limits), dtype=np.float64)


def _rows_of(problem: OptimalControlProblem, controls: Any) -> Floats:
    """Given controls as rows (R, m)."""
    R, m = problem.decisions, problem.scene.controls
    if isinstance(controls, Mapping):
        controls = control_array("controls", controls, problem.scene.control_joints)
    rows = as_floats("controls", controls)
    return np.broadcast_to(finite_array("controls", rows, (m,) if rows.ndim == 1 else (R, m)), (R, m))
