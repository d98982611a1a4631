"""What a replay shows beside the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from varpin.control import OptimalControlProblem
    from varpin.mechanics.scene import Scene
    from varpin.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Marks:
    """What :func:`varpin.replay` and :class:`varpin.LiveView` show beside the robot; they check it.

    Attributes:
        trace: Frames whose paths are drawn, for the motion and the ghost; ``True`` for the end effector.
        growing: Whether these paths grow with the motion.
        frames: Frames to draw as triads, x red, y green, z blue; ``True`` for the end effector.
        reference: A path (K, 3) in the world [m] to draw, or several by name.
        targets: Targets by name, which is shown: a point (3,) [m], a pose (4, 4) or ``pin.SE3``; or rows of them,
            (K, 3) or (K, 4, 4), spread evenly over the motion's time. They are in the world of each robot.
        ghost: A second motion of the same robot, drawn translucent in the same place. Either a trajectory of any time
            step, which starts with the motion and is cut or held at its end; or configurations (K, n) [rad or m],
            spread evenly over the motion's time, of which a single row shows a pose. If left out, a run of
            :class:`varpin.Mpc` shows its planned configurations.
        ahead: Time ahead at which the plans of such a run are shown [s]: their configurations as the ghost, and the
            planned path of each traced frame as beads. The end of the horizon if left out; 0 to show no plans.
        torques: Colour each link by the torque of the joint that moves it, grey for none, red at its limit: ``True``
            for the controls of the trajectory, one for each joint; or the torques (N, n) themselves [N m or N], of N
            steps spread evenly over the motion's time. The limits are the robot's effort limits; a joint without one is
            red at its own largest torque.
        constraints: Draw the constraints of the mechanism, and the obstacles, regions and goals of a plan. ``True``
            takes them from a plan or a controller's run, ``False`` draws none. A trajectory or an array does not
            contain them: give its scene or its problem.
    """

    trace: bool | str | Sequence[str] = False
    growing: bool = False
    frames: bool | str | Sequence[str] = False
    reference: ArrayLike | Mapping[str, ArrayLike] | None = None
    targets: Mapping[str, object] | None = None
    ghost: Trajectory | ArrayLike | None = None
    ahead: float | None = None
    torques: bool | ArrayLike = False
    constraints: bool | Scene | OptimalControlProblem = True
