"""Finding and reading scene files."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

from varpin.errors import FileError, InputError
from varpin.io.scenefile.table import SceneFileError, suggestion
from varpin.model import models_dir
from varpin.support.checks import is_file

if TYPE_CHECKING:
    from varpin.io.scenefile.tables import SceneSpec


def scenes() -> dict[str, Path]:
    """Files of the scenes bundled with varpin, by name."""
    return {path.stem: path for path in sorted((models_dir() / "scenes").glob("*.toml"))}


def find_scene(source: str | Path) -> Path:
    """The scene file at a path, or the bundled one of that name.

    Raises:
        FileError: There is no such file; similar names are listed.
        InputError: ``source`` is not a path.
    """
    if not isinstance(source, str | Path) or "\0" in str(source):
        raise InputError(f"a scene must be the path of a TOML file or a name, got {type(source).__name__}")
    bundled = scenes()
    if str(source) in bundled:
        return bundled[str(source)]
    path = Path(source).expanduser()
    if is_file(path):
        return path
    if os.path.isdir(path):  # noqa: PTH112 - of a path that is too long for any, pathlib raises an OSError
        raise FileError(f"{path} is a folder, not a scene file")
    raise FileError(f"no scene file {str(source)!r}; {suggestion(path.stem, bundled, 'bundled scenes')}")


def read_scene(path: Path, name: str | None = None) -> SceneSpec:
    """Read a scene file.

    Raises:
        FileError: The file cannot be read.
        SceneFileError: There is a mistake in it.
    """
    # Imported here because pydantic loads slowly, and only scene files need it.
    from varpin.io.scenefile.tables import spec_of  # noqa: PLC0415

    try:
        data = tomllib.loads(path.read_bytes().decode("utf-8").replace("\r\n", "\n"))
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise SceneFileError(path.name, "", "it is not a text in UTF-8") from None
    except RecursionError:
        raise SceneFileError(path.name, "", "it is nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, or an error of Python's number parsing
        raise SceneFileError(path.name, "", f"it is not TOML: {error}") from None
    return spec_of(data, path, path.stem if name is None else name)
