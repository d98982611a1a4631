"""Files of the robots in the package example-robot-data.

Its 6.x wheels contain data and no Python module, so files are found through the metadata of the distribution.
"""

import re
from importlib import metadata
from pathlib import Path

from varpin.errors import RobotError
from varpin.model.packages import Files

DISTRIBUTION = "example-robot-data"

# Robots with a fixed base by their names in example_robot_data.load, and the names of their URDF files.
FIXED_BASE = {
    "asr_twodof": "TwoDofs",
    "talos_arm": "talos_left_arm",
    "ur3": "ur3_robot",
    "ur3_limited": "ur3_joint_limited_robot",
    "ur5": "ur5_robot",
    "ur5_limited": "ur5_joint_limited_robot",
    "ur10": "ur10_robot",
    "ur10_limited": "ur10_joint_limited_robot",
}
FIXED_BASE |= {name: name for name in (
    "alex_nub_hands", "alex_psyonic_hands", "alex_sake_hands", "allegro_left_hand", "allegro_right_hand", "baxter",
    "bravo7_gripper", "bravo7_no_ee", "double_pendulum", "double_pendulum_continuous", "double_pendulum_simple",
    "finger_edu", "kinova", "panda", "panda_collision", "so100", "so101", "tiago", "tiago_dual", "tiago_no_hand",
    "tiago_pro", "ur3_gripper", "ur5_gripper", "xarm7", "z1",
)}  # fmt: skip

# SRDF files that are not beside their robots: that of talos has the rotors of its arm.
SRDF: dict[str, str] = {"talos_arm": "talos_data/srdf/talos.srdf"}


def robots_dir() -> Path | None:
    """The folder of the installed robots, as the installer recorded it; None if the package is not installed."""
    try:
        distribution = metadata.distribution(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return None
    found = re.search(r"^.*share/example-robot-data/robots/", distribution.read_text("RECORD") or "", re.MULTILINE)
    return Path(str(distribution.locate_file(found[0]))).resolve() if found else None


def _files(folder: Path | None) -> dict[str, Path]:
    """The URDF files of the folder of robots, by their names without suffix."""
    return {path.stem: path for path in sorted(folder.glob("*/*/*.urdf"))} if folder else {}


def find(name: str) -> Files | None:
    """The files of a robot; None if there is none of this name."""
    folder = robots_dir()
    files = _files(folder)
    if name not in FIXED_BASE and name in files:
        raise RobotError(
            f"{name!r} of {DISTRIBUTION} is no arm on a fixed base, which varpin models; to pin its base to the world, "
            f"load its file by path: {files[name]}"
        )
    if name not in FIXED_BASE:
        return None
    if folder is None:
        raise RobotError(f"robot {name!r} is in {DISTRIBUTION}, which is not installed: pip install {DISTRIBUTION}")
    if (path := files.get(FIXED_BASE[name])) is None:
        version = metadata.version(DISTRIBUTION)
        raise RobotError(f"the installed {DISTRIBUTION} {version} does not contain {FIXED_BASE[name]}.urdf")
    # package://example-robot-data/... is looked up in the folder of the package.
    return Files(name, path, (str(folder.parents[1]),), srdf=folder / SRDF[name] if name in SRDF else None)


def installed() -> tuple[str, ...]:
    """Names of the fixed-base robots in the installed example-robot-data; empty if it is not installed."""
    files = _files(robots_dir())
    return tuple(sorted(name for name, stem in FIXED_BASE.items() if stem in files))
