"""``varpin tradeoff``, ``advise`` and ``extremes``: measurements of integrators."""

from __future__ import annotations

import argparse
import logging
import shlex
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

from rich.console import Console

from varpin.cli.arguments import add_motion, add_robot, motion_of, robot_options
from varpin.cli.console import FAULTY, INTERRUPTED, STEP_FAILED, progress_bar, say, show
from varpin.cli.outputs import PICTURES, Writers, add_files, files_of, save_figure, write_all
from varpin.model import load_robot
from varpin.study.advice import advise
from varpin.study.precision import work_precision
from varpin.study.record import Progress, Study, StudyInterrupted
from varpin.support.tables import Table

if TYPE_CHECKING:
    from varpin.study.extremes import Record

Made = TypeVar("Made", bound=Study[Any])


def add_tradeoff(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin tradeoff``."""
    parser.description = (
        "Run a robot's motion with every integrator and many time steps. Print errors against an accurate reference, "
        "and wall times. Ctrl-C keeps the runs that are done."
    )
    parser.set_defaults(run=_tradeoff, log_level=logging.WARNING)
    add_robot(parser)
    _add_duration(parser)
    parser.add_argument("--dt", type=float, nargs="+", metavar="S", help="time steps [s]; default: 0.04 and its halves")
    text = "repetitions of each run; default: %(default)d"
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help=text)
    add_motion(parser)
    add_files(parser, "CSV", "write the runs", "draw errors over wall times, as png, pdf or svg")


def _tradeoff(request: argparse.Namespace, errors: Console) -> int:
    files = _files(request)
    scene, q0, v0, torque = motion_of(request)
    options = {"controls": torque, "duration": request.duration, "dts": request.dt, "repeats": request.repeats}
    record = _kept(request, errors, lambda progress: work_precision(scene, q0, v0, progress=progress, **options))
    table = record.table(f"{record.robot}: speed against accuracy over {record.duration:g} s")
    return _tell(request, errors, files, record, table, *record.notes, *record.failures)


def add_advise(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin advise``."""
    parser.description = (
        "Find, from short runs, the cheapest integrator and step that keep the error in q at the end of a robot's "
        "motion below a tolerance, or the most accurate ones within a wall time."
    )
    parser.set_defaults(run=_advise, log_level=logging.WARNING)
    add_robot(parser)
    goal = parser.add_mutually_exclusive_group(required=True)
    goal.add_argument("--tolerance", type=float, metavar="E", help="largest allowed error in q [rad or m]")
    goal.add_argument("--budget", type=float, metavar="S", help="largest allowed wall time [s]")
    _add_duration(parser)
    add_motion(parser)
    add_files(parser, "CSV", "write the best choice of each method")


def _advise(request: argparse.Namespace, errors: Console) -> int:
    files = _files(request)
    scene, q0, v0, torque = motion_of(request)
    say(errors, "trying integrators on this motion, for a minute at most")
    options = {"controls": torque, "tolerance": request.tolerance, "budget": request.budget}
    advice = advise(scene, q0, v0, duration=request.duration, **options)
    best = advice.best
    words = ["--integrator", str(best.integrator), "--dt", repr(best.dt), "--steps", str(best.steps)]
    command = f"varpin simulate {shlex.quote(request.robot)} {shlex.join(words)}"
    texts = [*advice.notes, f"run it: {command}, and the same start and forces"]
    found = f"(found in {advice.calibration:.2g} s)"
    trouble = _tell(request, errors, files, advice, *texts, advice.table("The best of each method"), found)
    return trouble if advice.reached else STEP_FAILED


def add_extremes(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin extremes``."""
    parser.description = (
        "Run difficult motions of a robot with every integrator, and judge each by independent checks: accurate; "
        "degraded with a warning; refused; stopped; or silent wrong, which is a bug of varpin. Exit status 1 if "
        "anything is silent wrong. It takes some minutes; Ctrl-C keeps the runs that are done."
    )
    parser.set_defaults(run=_extremes, log_level=logging.CRITICAL)
    add_robot(parser)
    parser.add_argument("--deep", action="store_true", help="give each motion 15 minutes of work instead of 20 s")
    add_files(parser, "CSV", "write the motions")


def _extremes(request: argparse.Namespace, errors: Console) -> int:
    from varpin.study.extremes import Kind, check_robot  # noqa: PLC0415 - most commands do not need it

    robot = load_robot(request.robot, **robot_options(request))
    files, patience = _files(request), 900.0 if request.deep else 20.0
    if not request.quiet:
        whole = "hours" if request.deep else "minutes"
        say(errors, f"each motion takes {patience:g} s at most; all together take {whole}")
    record = _kept(request, errors, lambda progress: check_robot(robot, patience=patience, progress=progress))
    kinds = [f"{count} {kind.value}: {kind.meaning}" for kind, count in record.counts().items()]
    trouble = _tell(request, errors, files, record, _kinds(record), *kinds)
    for cell in record.wrong():
        show(f"{Kind.WRONG.value}: {cell.trial}, {cell.integrator}: {'; '.join(cell.found)}")
    return FAULTY if record.wrong() and not record.missing else trouble


def _kinds(record: Record) -> Table:
    """How many motions of each kind an integrator has."""
    kinds, integrators = record.counts(), dict.fromkeys(cell.integrator for cell in record.runs)
    found = {name: [cell.kind for cell in record.runs if cell.integrator == name] for name in integrators}
    rows = [(name, *map(own.count, kinds)) for name, own in found.items()]
    return Table(f"{record.robot} at the extremes", ("integrator", *(kind.value for kind in kinds)), rows)


def _add_duration(parser: argparse.ArgumentParser) -> None:
    text = "of the motion [s]; default: %(default)g"
    parser.add_argument("--duration", type=float, default=1.0, metavar="S", help=text)


def _files(request: argparse.Namespace) -> Writers:
    """Writers of the requested files of a study."""
    table = "save", (".csv",), lambda path, study: study.to_csv(path)
    return files_of(request, table, ("plot", PICTURES, partial(save_figure, "plot_study")))


def _kept(request: argparse.Namespace, errors: Console, study: Callable[[Progress], Made]) -> Made:
    """A study with a progress bar; after Ctrl-C what there is of it."""
    with request.interrupts.keeping(), progress_bar(errors, 1, quiet=request.quiet, unit="runs") as progress:
        try:
            return study(progress)
        except StudyInterrupted as stop:
            say(errors, f"interrupted: {len(stop.record.runs)} runs are kept, {stop.record.missing} are missing")
            return cast("Made", stop.record)


def _tell(request: argparse.Namespace, errors: Console, files: Writers, study: Study[Any], *texts: object) -> int:
    """Print texts about a study and write its files; the exit status."""
    written, trouble = write_all(request, errors, files, study)
    if not request.quiet:
        show("\n".join(map(str, [*texts, *("{}: {}".format(*row) for row in written)])))
    return INTERRUPTED if study.missing else trouble
