"""``varpin solve``: plan the motion of a scene file."""

from __future__ import annotations

import argparse
import logging
import shlex
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from varpin.cli.arguments import take_outputs
from varpin.cli.console import progress_bar, say, show, written_rows
from varpin.cli.exits import INTERRUPTED, STEP_FAILED
from varpin.cli.outputs import add_outputs, write_all, writers_of
from varpin.control import Solution, Status
from varpin.io.scenefile import SceneFile, load_scene
from varpin.support.checks import writable
from varpin.support.tables import Table


def add_solve(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin solve``."""
    parser.description = (
        "Find the motion of least cost of a scene file by S-DDP. Ctrl-C keeps the best motion so far; with --resume a "
        "saved solution continues as if it had not stopped."
    )
    parser.set_defaults(run=_solve, log_level=logging.WARNING)
    parser.add_argument("scene", metavar="SCENE", help="path of a scene file (TOML), or name of a scene of varpin")
    parser.add_argument("--resume", type=Path, metavar="NPZ", help="continue from a solution that --save wrote")
    parser.add_argument(
        "--max-iterations", type=int, metavar="N", help="largest number of iterations; default: the scene's, or 100"
    )
    parser.add_argument(
        "--true-cost",
        type=float,
        metavar="PART",
        help="halve the scene's step until the plan's cost and its cost on the continuous system differ by less than "
        "this share: 0.01 for a percent",
    )
    add_outputs(parser, "solution")


def _solve(request: argparse.Namespace, errors: Console) -> int:
    file = load_scene(request.scene)
    take_outputs(request, file)
    outputs = writers_of(request, file.marks)
    given = {"max_iterations": request.max_iterations, "true_cost": request.true_cost}
    options = {name: value for name, value in given.items() if value is not None}
    resume = None if request.resume is None else file.load_solution(request.resume)
    with request.interrupts.keeping():
        begin = time.perf_counter()
        with progress_bar(errors, 1, quiet=request.quiet, unit="iterations at most") as progress:
            solution = file.solve(resume=resume, progress=progress, **options)
        wall_time = time.perf_counter() - begin
        unmet = solution.refinement is not None and not solution.refinement.met
        status = 0 if solution.status.converged and not unmet else STEP_FAILED
        if solution.status is Status.INTERRUPTED:
            status = INTERRUPTED
        saved = None if request.save is None else writable(request.save)
        writers: dict[Path, Callable[[], object]] = {
            path: partial(solution.save, path) if path == saved else partial(write, file.robot, solution.trajectory)
            for path, write in outputs.items()
        }
        written, trouble = write_all(errors, writers, request.interrupts)
    status = status or trouble
    told = _status(solution, request.scene, request.save if saved in written else None)
    if not request.quiet:
        # The last two lines are the status, which the next table has, and its reason.
        show("\n".join(solution.table().splitlines()[:-2]))
        show(_plan_table(file, solution, told, wall_time, written))
    if not solution.status.converged:
        say(errors, told, style="yellow")
    if unmet and solution.refinement is not None:
        say(errors, solution.refinement.reason, style="yellow")
    return status


def _status(solution: Solution, scene: str, kept: Path | None) -> str:
    """How the search ended, with advice for the command line; ``kept`` is the file that has the solution."""
    if solution.status is Status.MAX_ITERATIONS:
        advice = "--save NPZ keeps the solution, and --resume NPZ continues from it"
        if kept is not None:
            scene, file = (shlex.quote(str(path)) for path in (scene, kept))
            advice = f"varpin solve {scene} --resume {file} continues from this solution"
        return f"not converged: more iterations may help; {advice}"
    if solution.status is Status.INFEASIBLE:
        return f"infeasible: {solution.reason}"
    known: str = solution.status.value
    return known


def _plan_table(file: SceneFile, solution: Solution, told: str, wall_time: float, files: Iterable[Path]) -> Table:
    problem, refinement = solution.problem, solution.refinement
    noise = f", and {solution.noise_cost:.6g} by noise" if solution.noise_cost else ""
    rows = [
        ("joints", f"{file.robot.dof} of {file.required.described} computed"),
        ("horizon", f"{problem.steps} steps of {problem.dt:g} s, {problem.integrator}"),
        ("status", told),
        ("cost", f"{solution.cost:.6g}{noise}, after {solution.iterations} iterations"),
    ]
    if refinement is not None and refinement.tried:
        steps = ", ".join(f"{row.dt:g} s" for row in refinement.tried)
        rows.append(("true cost", f"{refinement.tried[refinement.chosen].true_cost:.6g}, of the steps {steps}"))
    unit = "own units" if file.scene.inputs or file.scene.servo_joints else "N m or N"
    most = np.abs(solution.trajectory.u).max(axis=0, initial=0.0)
    return Table(
        file.title,
        (),
        [
            *rows,
            ("wall time", f"{wall_time:.3g} s"),
            (f"largest controls [{unit}]", "  ".join(f"{value:.4g}" for value in most)),
            ("q at the end [rad or m]", "  ".join(f"{value:.6g}" for value in solution.trajectory.q[-1])),
            *written_rows(files),
        ],
    )
