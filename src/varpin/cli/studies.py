"""``varpin tradeoff``, ``advise`` and ``extremes``: measurements of integrators."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from rich.console import Console
from rich.text import Text

from varpin.cli.arguments import add_motion, add_robot, motion_of, robot_options, simulate_words
from varpin.cli.console import progress_bar, say
from varpin.cli.exits import FAULTY, INTERRUPTED, STEP_FAILED
from varpin.cli.outputs import folder_at
from varpin.model import load_robot
from varpin.study.tradeoff import advise, work_precision
from varpin.support.tables import WIDTH, add_row, table_of


def add_tradeoff(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin tradeoff``."""
    parser.description = (
        "Run a robot's motion with every integrator and many time steps. Print and write errors against an accurate "
        "reference, and wall times. Runs recorded in the folder are not repeated, so that an interrupted "
        "measurement continues where it stopped."
    )
    parser.set_defaults(run=_tradeoff, log_level=logging.WARNING)
    add_robot(parser)
    parser.add_argument(
        "--duration", type=float, default=1.0, metavar="S", help="of the motion [s]; default: %(default)g"
    )
    parser.add_argument("--dt", type=float, nargs="+", metavar="S", help="time steps [s]; default: 0.04 and its halves")
    parser.add_argument(
        "--repeats", type=int, default=3, metavar="N", help="repetitions of each run; default: %(default)d"
    )
    add_motion(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="write a table (CSV), a figure (PNG), a page (HTML), the record (NPZ)",
    )
    outputs.add_argument("--quiet", action="store_true", help="print warnings and errors only")


def _tradeoff(request: argparse.Namespace, errors: Console) -> int:
    from varpin.show.tradeoff_report import COLUMNS, cells, write_report  # noqa: PLC0415 - matplotlib is slow to import

    folder = None if request.out is None else folder_at(request.out)
    scene, q0, v0, torque = motion_of(request)
    with request.interrupts.keeping(), progress_bar(errors, 1, quiet=request.quiet, unit="runs") as progress:
        record = work_precision(
            scene,
            q0,
            v0,
            controls=torque,
            duration=request.duration,
            dts=request.dt,
            repeats=request.repeats,
            progress=progress,
            save=None if folder is None else folder / "tradeoff.npz",
        )
    title = f"{record.robot}: speed against accuracy over {record.duration:g} s"
    files = [] if folder is None else [folder / "tradeoff.npz", *write_report(folder, record, title)]
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    if not request.quiet:
        table, front = table_of(title, COLUMNS), record.pareto()
        for run in record.runs:
            add_row(table, *cells(record, run, run in front), style="bold" if run in front else "")
        console.print(table)
        say(console, f"errors are against {record.reference}, accurate to {record.reference_error:.1e}", prefix="")
        for path in files:
            say(console, str(path), prefix="written")
    return INTERRUPTED if record.missing else 0


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
    parser.add_argument(
        "--duration", type=float, default=1.0, metavar="S", help="of the motion [s]; default: %(default)g"
    )
    add_motion(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("--out", type=Path, metavar="FOLDER", help="write advice.png and advice.html there")


def _advise(request: argparse.Namespace, _errors: Console) -> int:
    from varpin.show.tradeoff_report import write_advice  # noqa: PLC0415 - as above
    from varpin.study.tradeoff.advice import COLUMNS  # noqa: PLC0415

    folder = None if request.out is None else folder_at(request.out)
    scene, q0, v0, torque = motion_of(request)
    advice = advise(
        scene,
        q0,
        v0,
        controls=torque,
        duration=request.duration,
        tolerance=request.tolerance,
        budget=request.budget,
    )
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    for line in advice.reason.splitlines():
        say(console, line, prefix="")
    say(console, simulate_words(request, advice.integrator, advice.dt, advice.steps), prefix="run it")
    table = table_of("The best of each method", COLUMNS)
    for choice in (advice.best, *advice.alternatives):
        add_row(table, *choice.cells())
    console.print(table)
    say(console, f"(found in {advice.calibration:.2g} s)", prefix="")
    if folder is not None:
        goal = f"{advice.tolerance:g} in q" if advice.tolerance is not None else f"{advice.budget:g} s"
        title = f"{scene.robot.name}: an integrator for {request.duration:g} s and {goal}"
        for path in write_advice(folder, advice, title):
            say(console, str(path), prefix="written")
    return 0 if advice.reached else STEP_FAILED


def add_extremes(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin extremes``."""
    parser.description = (
        "Run difficult motions of a robot with every integrator, and judge each by independent checks: accurate; "
        "degraded with a warning; refused; stopped; or silent wrong, which is a bug of varpin. Exit status 1 if "
        "anything is silent wrong."
    )
    parser.set_defaults(run=_extremes, log_level=logging.CRITICAL)
    add_robot(parser)
    parser.add_argument("--deep", action="store_true", help="give each motion 15 minutes of work instead of 20 s")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write the record (JSON) and a heat map (HTML)")
    parser.add_argument("--quiet", action="store_true", help="print nothing but what is silent wrong")


def _extremes(request: argparse.Namespace, errors: Console) -> int:
    from varpin.show import extremes_report as report  # noqa: PLC0415 - most commands do not need it
    from varpin.study.extremes import Kind, check_robot  # noqa: PLC0415

    robot = load_robot(request.robot, **robot_options(request))
    folder = None if request.out is None else folder_at(request.out)
    with request.interrupts.keeping(), progress_bar(errors, 1, quiet=request.quiet, unit="cells") as progress:
        record = check_robot(
            robot,
            patience=900.0 if request.deep else 20.0,
            progress=lambda done, cells, _: progress(done, cells),
        )
    if folder is not None:
        record.save(folder / "extremes.json")
    files = [] if folder is None else [folder / "extremes.json", report.write_page(folder / "extremes.html", record)]
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    if not request.quiet:
        columns, rows = report.grid(record)
        table = table_of(f"{record.robot} at the extremes", ("motion", *columns))
        for name, cells in rows.items():
            entries = (cells.get(column) for column in columns)
            table.add_row(
                Text(name), *(Text(report.entry(c), style=report.STYLES[c.kind]) if c else Text("") for c in entries)
            )
        console.print(table)
        for kind, count in record.counts().items():
            say(console, f"{count} {kind.value}", prefix=report.LETTERS[kind])
        for path in files:
            say(console, str(path), prefix="written")
    for cell in record.wrong():
        say(console, f"{cell.trial}, {cell.integrator}: {'; '.join(cell.found)}", prefix=Kind.WRONG.value, style="red")
    if record.missing:
        return INTERRUPTED
    return FAULTY if record.wrong() else 0
