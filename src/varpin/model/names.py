"""Robots by path and by name: bundled ones, those of example-robot-data, those of robot_descriptions.

The 6.x wheels of example-robot-data contain data and no Python module, so its files are found through the metadata of
the distribution. The package robot_descriptions downloads git repositories on first use.
"""

from __future__ import annotations

import importlib
import os
import re
from importlib import metadata
from pathlib import Path

from varpin.errors import FileError, InputError, RobotError, RobotNotFound
from varpin.model.packages import Files, optional
from varpin.model.xacro import plain_name
from varpin.support.checks import is_file, path_like

# Suffixes of robots' files.
_SUFFIXES = (".urdf", ".xacro", ".xml", ".mjcf")

_EXAMPLES = "example-robot-data"

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
_SRDF = {"talos_arm": "talos_data/srdf/talos.srdf"}

# End of the names of robot_descriptions, and a sentence about them.
_DESCRIPTION = "_description"
_MORE = (
    f'more robots, by names such as "iiwa14{_DESCRIPTION}", are those of robot_descriptions: '
    'pip install "varpin[descriptions]"'
)

# Tags of robots with a floating base, and tags that override them.
_FLOATING, _FIXED = {"biped", "drone", "humanoid", "quadruped"}, {"arm", "dual_arm", "end_effector"}


def models_dir() -> Path:
    """The folder of the bundled robots: in the wheel, or at the top of a source tree."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "models", package.parents[1] / "models"):
        if (folder / "SOURCES.md").is_file():
            return folder
    raise FileError(f"varpin's bundled models are missing beside {package}")


def bundled_robots() -> dict[str, Path]:
    """Files of the robots bundled with varpin, by name."""
    return {path.stem: path for path in sorted(models_dir().glob("*.urdf"))}


def robot_names() -> tuple[str, ...]:
    """The names that :func:`varpin.load_robot` takes: varpin's own robots, then those of example-robot-data.

    The latter are the fixed-base robots in the installed version of example-robot-data, if it is installed.
    """
    files = _files(robots_dir())
    return (*bundled_robots(), *sorted(name for name, stem in FIXED_BASE.items() if stem in files))


def find(source: str | os.PathLike[str]) -> Files:
    """The files of a robot's path or name."""
    text = os.fspath(source)
    if text.lstrip("\ufeff \t\r\n").startswith("<"):
        raise InputError(
            "source is the text of a file, not its path: write it to a file, or give pin.buildModelFromXML(text)"
        )
    path = path_like("source", source)
    is_path = isinstance(source, os.PathLike) or path.suffix or os.sep in text
    if is_path and is_file(path):
        return Files(plain_name(path), path.resolve())
    bundled = bundled_robots()
    if text in bundled:
        return Files(text, bundled[text])
    if found := _example(text):
        return found
    downloadable = _downloadable()
    if text in downloadable or (not downloadable and not is_path and text.endswith(_DESCRIPTION)):
        return _download(text)
    if is_path and os.path.isdir(path):  # noqa: PTH112 - False for a name that is too long
        files = ", ".join(sorted(file.name for file in path.glob("*.urdf"))) or "no URDF file"
        raise RobotError(f"{path} is a folder, not a URDF file; it contains {files}")
    if is_path:
        folder = path.absolute().parent
        if not folder.is_dir():
            raise RobotNotFound(text, (), f": there is no folder {folder}")
        there = [file.name for file in folder.iterdir() if file.suffix in _SUFFIXES]
        raise RobotNotFound(path.name, there, f" in the folder {folder}")
    # Without the package its names are unknown.
    more = "" if downloadable else _MORE
    raise RobotNotFound(text, [*robot_names(), *downloadable], more=more)


def robots_dir() -> Path | None:
    """The folder of the installed robots, as the installer recorded it; None if the package is not installed."""
    try:
        distribution = metadata.distribution(_EXAMPLES)
    except metadata.PackageNotFoundError:
        return None
    found = re.search(r"^.*share/example-robot-data/robots/", distribution.read_text("RECORD") or "", re.MULTILINE)
    return Path(str(distribution.locate_file(found[0]))).resolve() if found else None


def _files(folder: Path | None) -> dict[str, Path]:
    """The URDF files of the folder of robots, by their names without suffix."""
    return {path.stem: path for path in sorted(folder.glob("*/*/*.urdf"))} if folder else {}


def _example(name: str) -> Files | None:
    """The files of a robot of example-robot-data; None if there is none of this name."""
    folder = robots_dir()
    path = _files(folder).get(FIXED_BASE.get(name, name))
    if name not in FIXED_BASE and (path is None or name in FIXED_BASE.values()):
        return None
    if folder is None:
        raise RobotError(f"robot {name!r} is in {_EXAMPLES}, which is not installed: pip install {_EXAMPLES}")
    if path is None:
        version = metadata.version(_EXAMPLES)
        raise RobotError(f"the installed {_EXAMPLES} {version} does not contain {FIXED_BASE[name]}.urdf")
    if name not in FIXED_BASE:
        raise RobotError(
            f"{name!r} of {_EXAMPLES} is no arm on a fixed base, which varpin models; to pin its base to the world, "
            f"load its file by path: {path}"
        )
    # package://example-robot-data/... is looked up in the folder of the package.
    return Files(name, path, (str(folder.parents[1]),), srdf=folder / _SRDF[name] if name in _SRDF else None)


def _downloadable() -> tuple[str, ...]:
    """Names of the robots in the installed robot_descriptions; empty if it is not installed."""
    try:
        return tuple(importlib.import_module("robot_descriptions").DESCRIPTIONS)
    except ImportError:
        return ()


def _download(name: str) -> Files:
    """The files of a robot of robot_descriptions, from the package's cache or from the network."""
    package = optional("robot_descriptions", f"robot {name!r}", "descriptions")
    try:
        module = importlib.import_module(f"robot_descriptions.{name}")
    except Exception as error:  # Importing the module runs git, which may fail in any way.
        what = " ".join(str(error).split())
        raise RobotError(
            f"robot {name!r} cannot be downloaded by robot_descriptions, whose cache is "
            f"$ROBOT_DESCRIPTIONS_CACHE or ~/.cache/robot_descriptions: {type(error).__name__}: {what}"
        ) from None
    found = next((value for key in ("URDF_PATH", "XACRO_PATH", "MJCF_PATH") if (value := getattr(module, key, ""))), "")
    if not found:
        raise RobotError(f"robot {name!r} of robot_descriptions has no URDF, xacro or MJCF file")
    tags = set(package.DESCRIPTIONS[name].tags)
    if tags & _FLOATING and not tags & _FIXED:
        raise RobotError(
            f"{name!r} is a {' and '.join(sorted(tags & _FLOATING))}, whose base moves, and varpin models fixed bases; "
            f"to pin its base to the world, load its file by path: {found}"
        )
    roots = [Path(value) for key in ("PACKAGE_PATH", "REPOSITORY_PATH") if (value := getattr(module, key, ""))]
    folders = dict.fromkeys(str(folder) for root in roots for folder in (root, root.parent))
    srdf = getattr(module, "SRDF_PATH", "") or getattr(module, "SRDF_XACRO_PATH", "")
    return Files(
        name,
        Path(found),
        folders=tuple(folders),
        xacro_args=getattr(module, "XACRO_ARGS", {}),
        packages=getattr(module, "XACRO_PACKAGE_PATHS", {}),
        srdf=Path(srdf) if srdf else None,
        srdf_args=getattr(module, "SRDF_XACRO_ARGS", {}),
    )
