"""Robots of the package robot_descriptions, which downloads their git repositories on first use."""

import importlib
from pathlib import Path

from varpin.errors import MissingDependency, RobotError
from varpin.model.packages import Files

SUFFIX = "_description"
INSTALL = (
    f'more robots, by names such as "iiwa14{SUFFIX}", are those of robot_descriptions: '
    'pip install "varpin[descriptions]"'
)

# Tags of robots with a floating base, and tags that override them.
_FLOATING, _FIXED = {"biped", "drone", "humanoid", "quadruped"}, {"arm", "dual_arm", "end_effector"}


def names() -> tuple[str, ...]:
    """Names of the robots in the installed package; empty if it is not installed."""
    try:
        return tuple(importlib.import_module("robot_descriptions").DESCRIPTIONS)
    except ImportError:
        return ()


def download(name: str) -> Files:
    """The files of one of the robots, from the package's cache or from the network."""
    try:
        package = importlib.import_module("robot_descriptions")
    except ImportError as error:
        missing = error.name or "robot_descriptions"
        raise MissingDependency(f"robot {name!r}", [missing], 'pip install "varpin[descriptions]"') from None
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
