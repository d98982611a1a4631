"""Whether a motion is of a scene."""

from __future__ import annotations

from varpin.errors import InputError
from varpin.mechanics.scene import Scene, differences, same
from varpin.trajectory import Trajectory, require_trajectory


def require_motion(scene: Scene, trajectory: Trajectory) -> None:
    """Refuse anything but a trajectory of a scene's robot with the scene's number of controls.

    Raises:
        InputError: It is not one; the message tells the difference.
    """
    require_trajectory(trajectory)
    if trajectory.joint_names != scene.robot.joint_names:
        raise InputError(
            f"the trajectory is of joints {', '.join(trajectory.joint_names)}; "
            f"the scene's robot has {', '.join(scene.robot.joint_names)}"
        )
    if trajectory.u.shape[1] != scene.controls:
        raise InputError(f"the trajectory has {trajectory.u.shape[1]} controls, the scene {scene.controls}")


def require_scene_of(scene: Scene, trajectory: Trajectory) -> None:
    """Refuse a motion of a scene with other numbers, as far as the motion has them.

    Noise is compared only if the motion has increments: a motion without noise does not depend on it.

    Raises:
        InputError: The scenes differ; the message tells where.
    """
    found = differences(scene, trajectory.scene_values, noise=bool(trajectory.dw.any()))
    if not same(trajectory.masses, scene.robot.tree.mass):
        found.insert(0, "the robot's masses")
    if found:
        more = f" and {len(found) - 2} more" if len(found) > 2 else ""
        raise InputError(
            f"the trajectory was made in another scene than the one given, which differs in {', '.join(found[:2])}"
            f"{more}. Give the scene that made it, or simulate again in this one"
        )
