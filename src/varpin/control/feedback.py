"""Commands with feedback around a motion, and without."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem
from varpin.core.arrays import Commands
from varpin.signals.commands import open_line, open_loop


def around(problem: OptimalControlProblem, u: Floats, x: Floats, gains: Floats, previous: Floats | None) -> Commands:
    """Controls u (R, m) with feedback around the states x before each decision.

    Args:
        problem: The problem.
        u: The controls without feedback.
        x: States (R, 2n); (R - 1, 2n) with linear controls, the first of which is given.
        gains: Gains (R, m, 2n) on the states.
        previous: Gains (R, m, m) on the previous control, around ``u``; None without.
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
