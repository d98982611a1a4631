"""What figures and replays are given: motions, plans, and runs of controllers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from varpin.trajectory import Trajectory

if TYPE_CHECKING:
    # Imported for types alone: showing a motion needs no optimizer.
    from varpin.control import OptimalControlProblem


def motion_of(given: object) -> Any:
    """The motion of a plan or of a controller's run; anything else is returned as it is."""
    own = (getattr(given, name, None) for name in ("trajectory", "motion"))
    return next((motion for motion in own if isinstance(motion, Trajectory)), given)


def problem_of(given: object) -> OptimalControlProblem | None:
    """The problem of a plan, or of the first plan of a controller's run; None of anything else."""
    plans = getattr(given, "plans", None)
    plan = plans[0] if isinstance(plans, tuple) and plans else given
    return cast("OptimalControlProblem | None", getattr(plan, "problem", None))
