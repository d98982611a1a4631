"""``varpin solve``: plan the motion of a scene file."""

from __future__ import annotations

import argparse
import logging
import shlex
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rich.console import Console

from varpin.cli.arguments import take_outputs
from varpin.cli.console import INTERRUPTED, STEP_FAILED, progress_bar, say, show
from varpin.cli.outputs import add_outputs, write_all, writers_of
from varpin.control import Solution, Status
from varpin.io.scenefile import SceneFile, load_scene
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
    add_outputs(parser, "solution")


def _solve(request: argparse.Namespace, errors: Console) -> int:
    file = load_scene(request.scene)
    take_outputs(request, file)
    outputs = writers_of(request, file.marks)
    options = {} if request.max_iterations is None else {"max_iterations": request.max_iterations}
    resume = None if request.resume is None else file.load_solution(request.resume)
    with request.interrupts.keeping():
        begin = time.perf_counter()
        with progress_bar(errors, 1, quiet=request.quiet, unit="iterations at most") as progress:
            solution = file.solve(resume=resume, progress=progress, **options)
        wall_time = time.perf_counter() - begin
        written, trouble = write_all(request, errors, outputs, file.robot, solution.trajectory, solution)
    converged, refinement = solution.status.converged, solution.refinement
    unmet = refinement is not None and not refinement.met
    told = _status(solution, request.scene, request.save)
    if not request.quiet:
        # The last two lines are the status, which the next table has, and its reason.
        show("\n".join(solution.table().splitlines()[:-2]))
        show(_plan_table(file, solution, told, wall_time, written))
    if not converged:
        say(errors, told, style="yellow")
    if unmet and refinement is not None:
        say(errors, refinement.reason, style="yellow")
    if solution.status is Status.INTERRUPTED:
        return INTERRUPTED
    return trouble or (0 if converged and not unmet else STEP_FAILED)


def _status(solution: Solution, scene: str, saved: Path | None) -> str:
    """How the search ended, with advice for the command line."""
    if solution.status is Status.MAX_ITERATIONS:
        advice = "with --save NPZ this solution can be continued from"
        if saved is not None:
            scene, file = (shlex.quote(str(path)) for path in (scene, saved))
            advice = f"varpin solve {scene} --resume {file} continues from this solution"
        return f"not converged: more iterations may help; {advice}"
    return f"infeasible: {solution.reason}" if solution.status is Status.INFEASIBLE else str(solution.status.value)


def _plan_table(
    file: SceneFile, solution: Solution, told: str, wall_time: float, written: Iterable[tuple[str, object]]
) -> Table:
    problem, refinement = solution.problem, solution.refinement
    noise = f", and {solution.noise_cost:.6g} by noise" if solution.noise_cost else ""
    rows: list[tuple[str, object]] = [
        ("joints", f"{file.robot.dof} of {file.required.described} computed"),
        ("horizon", f"{problem.steps} steps of {problem.dt:g} s, {problem.integrator}"),
        ("status", told),
        ("cost", f"{solution.cost:.6g}{noise}, after {solution.iterations} iterations"),
    ]
    if refinement is not None and refinement.tried:
        steps = ", ".join(f"{row.dt:g} s" for row in refinement.tried)
        rows.append(("true cost", f"{refinement.tried[refinement.chosen].true_cost:.6g}, of the steps {steps}"))
    values = solution.trajectory.scene_values
    unit = "own units" if file.scene.inputs or values["PositionServo"].size else "N m or N"
    most = np.abs(solution.trajectory.u).max(axis=0, initial=0.0)
    rows += [
        ("wall time", f"{wall_time:.3g} s"),
        (f"largest controls [{unit}]", "  ".join(f"{value:.4g}" for value in most)),
        ("q at the end [rad or m]", "  ".join(f"{value:.6g}" for value in solution.trajectory.q[-1])),
        *written,
    ]
    return Table(file.title, (), rows)
