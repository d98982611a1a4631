"""Files that a command writes."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from varpin.cli.console import INTERRUPTED, MISTAKE, complain
from varpin.errors import InputError, VarpinError
from varpin.io.archive import atomic_file
from varpin.marks import Marks
from varpin.model import Robot
from varpin.show.replay.video import FORMATS, check_film
from varpin.support.checks import positive, writable
from varpin.trajectory import Trajectory


def add_outputs(parser: argparse.ArgumentParser, what: str) -> None:
    """Add options for the files that a command writes of a motion."""
    save = f"write the {what}, for {what.title()}.load"
    add_replay_options(add_files(parser, "NPZ", save, "draw an overview, as png, pdf or svg"))


def add_files(parser: argparse.ArgumentParser, ending: str, save: str, plot: str = "") -> argparse._ActionsContainer:
    """Add ``--save``, ``--plot`` if there is a figure, and ``--quiet``; returns their group."""
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("--save", type=Path, metavar=ending, help=save)
    if plot:
        outputs.add_argument("--plot", type=Path, metavar="PNG", help=plot)
    outputs.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    return outputs


def add_replay_options(outputs: argparse._ActionsContainer) -> None:
    """Add options for files that show a motion."""
    outputs.add_argument("--html", type=Path, metavar="HTML", help="write a replay that any browser opens")
    outputs.add_argument("--video", type=Path, metavar="MP4", help="write a video, mp4 or gif; needs varpin[video]")
    outputs.add_argument("--trace", nargs="+", default=[], metavar="FRAME", help="draw the paths of frames in it")
    text = "speed of the replay; 0.1 is ten times slower; default: the scene file's, or 1"
    outputs.add_argument("--speed", type=float, metavar="X", help=text)


# Functions that write a result, such as a robot, its motion and the solution that it is of, by the path of the file.
Writers = dict[Path, Callable[..., object]]
# Endings of figures.
PICTURES = (".png", ".pdf", ".svg")
MarksOf = Callable[[float], Marks]


def writers_of(request: argparse.Namespace, marks: MarksOf | None = None) -> Writers:
    """Writers of the requested files of a motion, the most important first."""
    speed = speed_of(request)

    def show(option: str, path: Path, robot: Robot, motion: Trajectory, _result: object) -> None:
        from varpin.show.replay.motion import replay  # noqa: PLC0415 - meshcat is slow to import

        task = Marks() if marks is None else marks(motion.duration)
        files: dict[str, Any] = {option: path}
        replay(robot, motion, **files, speed=speed, marks=replace(task, trace=request.trace or task.trace))

    return files_of(
        request,
        ("save", (".npz",), lambda path, _robot, _motion, result: result.save(path)),
        ("plot", PICTURES, lambda path, robot, motion, _: save_figure("plot_trajectory", path, motion, robot=robot)),
        ("html", (".html", ".htm"), partial(show, "html")),
        ("video", FORMATS, partial(show, "video")),
    )


def files_of(request: argparse.Namespace, *options: tuple[str, Sequence[str], Callable[..., object]]) -> Writers:
    """Writers of the requested files, by option, endings and function; what can fail before the run fails here."""
    found: Writers = {}
    for option, endings, write in options:
        path: Path | None = getattr(request, option, None)
        if path is None:
            continue
        target = writable(path)
        if path.suffix.lower() not in endings:
            raise InputError(f"--{option} must end in {', '.join(endings)}, got {path.name!r}")
        if option == "video":
            check_film(path)
        if target in found:
            raise InputError(f"two outputs cannot be one file: {path}")
        found[target] = partial(write, target)
    return found


def save_figure(plot: str, path: Path, result: object, **options: Any) -> None:
    """Write the figure that a function of :mod:`varpin.show.plots` draws of a result, in the format of the path."""
    from varpin.show import plots  # noqa: PLC0415 - matplotlib is slow to import

    figure = getattr(plots, plot)(result, **options)[0]
    with atomic_file(path) as stream:
        figure.savefig(stream, format=path.suffix[1:].lower(), dpi=150)


def speed_of(request: argparse.Namespace) -> float:
    """The speed of a replay."""
    return positive("--speed", 1.0 if request.speed is None else request.speed, "1")


def write_all(
    request: argparse.Namespace, errors: Console, files: Writers, *result: object
) -> tuple[list[tuple[str, Path]], int]:
    """Write files, and print an error for each that cannot be written; rows that name the others, and the exit status.

    Ctrl-C lets the current file be finished and leaves out the rest.
    """
    written, status, interrupts = [], 0, request.interrupts
    for path, write in files.items():
        if interrupts.wanted:
            complain(errors, f"{path} was not written: interrupted")
            continue
        try:
            with interrupts.written():
                write(*result)
        except (VarpinError, OSError) as error:
            complain(errors, f"{path} was not written: {error}")
            status = MISTAKE
        else:
            written.append(("written", path))
    return written, INTERRUPTED if interrupts.wanted else status
