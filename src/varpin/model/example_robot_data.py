"""Files of the robots in the package example-robot-data.

Its 6.x wheels contain data and no Python module, so files are found through the metadata of the distribution.
"""

import re
from importlib import metadata
from pathlib import Path

from varpin.errors import RobotError
from varpin.model.packages import Files

DISTRIBUTION = "example-robot-data"

# Names as in example_robot_data.load; paths relative to share/example-robot-data/robots.
FIXED_BASE: dict[str, str] = {
    "alex_nub_hands": "alex_description/urdf/alex_nub_hands.urdf",
    "alex_psyonic_hands": "alex_description/urdf/alex_psyonic_hands.urdf",
    "alex_sake_hands": "alex_description/urdf/alex_sake_hands.urdf",
    "allegro_left_hand": "allegro_hand_description/urdf/allegro_left_hand.urdf",
    "allegro_right_hand": "allegro_hand_description/urdf/allegro_right_hand.urdf",
    "asr_twodof": "asr_twodof_description/urdf/TwoDofs.urdf",
    "baxter": "baxter_description/urdf/baxter.urdf",
    "bravo7_gripper": "bravo7_description/urdf/bravo7_gripper.urdf",
    "bravo7_no_ee": "bravo7_description/urdf/bravo7_no_ee.urdf",
    "double_pendulum": "double_pendulum_description/urdf/double_pendulum.urdf",
    "double_pendulum_continuous": "double_pendulum_description/urdf/double_pendulum_continuous.urdf",
    "double_pendulum_simple": "double_pendulum_description/urdf/double_pendulum_simple.urdf",
    "finger_edu": "finger_edu_description/robots/finger_edu.urdf",
    "kinova": "kinova_description/robots/kinova.urdf",
    "panda": "panda_description/urdf/panda.urdf",
    "panda_collision": "panda_description/urdf/panda_collision.urdf",
    "so100": "so_arm_description/urdf/so100.urdf",
    "so101": "so_arm_description/urdf/so101.urdf",
    "talos_arm": "talos_data/robots/talos_left_arm.urdf",
    "tiago": "tiago_description/robots/tiago.urdf",
    "tiago_dual": "tiago_description/robots/tiago_dual.urdf",
    "tiago_no_hand": "tiago_description/robots/tiago_no_hand.urdf",
    "tiago_pro": "tiago_pro_description/robots/tiago_pro.urdf",
    "ur3": "ur_description/urdf/ur3_robot.urdf",
    "ur3_gripper": "ur_description/urdf/ur3_gripper.urdf",
    "ur3_limited": "ur_description/urdf/ur3_joint_limited_robot.urdf",
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur5_gripper": "ur_description/urdf/ur5_gripper.urdf",
    "ur5_limited": "ur_description/urdf/ur5_joint_limited_robot.urdf",
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "ur10_limited": "ur_description/urdf/ur10_joint_limited_robot.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "z1": "z1_description/urdf/z1.urdf",
}

# SRDF files that are not beside their robots: that of talos has the rotors of its arm.
SRDF: dict[str, str] = {"talos_arm": "talos_data/srdf/talos.srdf"}

# Robots that walk, fly or swim: example-robot-data gives them a free-flyer.
FLOATING_BASE = frozenset([
    "a1", "alexander", "anymal", "anymal_c", "anymal_kinova", "b1", "b1_z1", "bluevolta_bravo7_gripper",
    "bluevolta_bravo7_no_ee", "bolt", "borinot", "cassie", "centauro", "falcon_bravo7_gripper",
    "falcon_bravo7_no_ee", "g1", "g1_with_hands", "go1", "go2", "hector", "hextilt", "human", "hyq", "icub",
    "icub_reduced", "iris", "laikago", "pr2", "quadruped", "romeo", "simple_humanoid", "simple_humanoid_classical",
    "solo12", "solo8", "talos", "talos_box", "talos_full", "talos_full_box", "talos_legs",
])  # fmt: skip


def robots_dir() -> Path | None:
    """The folder of the installed robots, as the installer recorded it; None if the package is not installed."""
    try:
        distribution = metadata.distribution(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return None
    found = re.search(r"^.*share/example-robot-data/robots/", distribution.read_text("RECORD") or "", re.MULTILINE)
    return Path(str(distribution.locate_file(found[0]))).resolve() if found else None


def find(name: str) -> Files | None:
    """The files of a robot; None if there is none of this name."""
    if name in FLOATING_BASE:
        raise RobotError(
            f"{name!r} has a free-flyer base in example-robot-data, and varpin models fixed bases; "
            "to pin its base to the world, load its URDF file by path"
        )
    if name not in FIXED_BASE:
        return None
    folder = robots_dir()
    if folder is None:
        raise RobotError(f"robot {name!r} is in {DISTRIBUTION}, which is not installed: pip install {DISTRIBUTION}")
    path = folder / FIXED_BASE[name]
    if not path.is_file():
        raise RobotError(f"the installed {DISTRIBUTION} {metadata.version(DISTRIBUTION)} does not contain {path}")
    # package://example-robot-data/... is looked up in the folder of the package.
    return Files(name, path, (str(folder.parents[1]),), srdf=folder / SRDF[name] if name in SRDF else None)


def installed() -> tuple[str, ...]:
    """Names of the fixed-base robots in the installed example-robot-data; empty if it is not installed."""
    folder = robots_dir()
    return tuple(name for name, path in FIXED_BASE.items() if folder is not None and (folder / path).is_file())
