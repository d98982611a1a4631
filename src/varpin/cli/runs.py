"""``varpin simulate`` and ``varpin solve``: the motion of a robot or a scene file, and the plan of one."""

from __future__ import annotations

import argparse
import logging
import shlex
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from rich.console import Console

from varpin.cli.arguments import (
    add_integrator,
    add_motion,
    add_robot,
    integrator_of_words,
    motion_of,
    names_scene,
    scene_file,
    take_outputs,
)
from varpin.cli.console import INTERRUPTED, STEP_FAILED, complain, progress_bar, say, show
from varpin.cli.outputs import Writers, add_outputs, write_all, writers_of
from varpin.control import Solution, Status
from varpin.io.scenefile import SceneFile, load_scene
from varpin.model import Robot
from varpin.show.given import frame_names
from varpin.simulation.failures import Interrupted, StepFailure
from varpin.simulation.simulate import simulate
from varpin.support.checks import positive
from varpin.support.tables import Table
from varpin.trajectory import Trajectory

# Defaults [s].
DT, DURATION = 1e-3, 2.0


def add_simulate(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin simulate``."""
    parser.description = (
        "Integrate a robot, or a scene file, in time. An option with numbers of joints takes one number for all, "
        "one for each, or JOINT=VALUE for some. Ctrl-C and a failed step keep the motion up to there."
    )
    parser.set_defaults(run=_simulate, log_level=logging.WARNING)
    add_robot(parser, scenes=True)
    parser.add_argument("--dt", type=float, metavar="S", help=f"time step [s]; default: {DT:g}")
    text = "largest allowed error in q [rad or m] instead of --dt: the cheapest integrator and step that meet it"
    parser.add_argument("--tolerance", type=float, metavar="E", help=text)
    length = parser.add_mutually_exclusive_group()
    text = f"time to simulate [s]; default: {DURATION:g} or near it"
    length.add_argument("--duration", type=float, metavar="S", help=text)
    length.add_argument("--steps", type=int, metavar="N", help="the number of steps instead")
    add_integrator(parser)
    add_motion(parser)
    add_outputs(parser, "trajectory")


def _simulate(request: argparse.Namespace, errors: Console) -> int:
    if names_scene(request.robot):
        file = scene_file(request, request.robot)
        take_outputs(request, file)
        outputs = writers_of(request, file.marks)
        return _run(request, errors, file.robot, lambda progress: file.simulate(progress=progress), outputs)
    outputs = writers_of(request)
    integrator = integrator_of_words(request.integrator)
    scene, q0, v0, torque = motion_of(request)
    wish = {name: getattr(request, name) for name in ("dt", "steps", "duration", "tolerance")}
    if request.dt is not None:
        positive("--dt", request.dt, "s")
    elif request.tolerance is None:
        wish["dt"] = DT
    if request.steps is None and request.duration is None:
        dt = wish["dt"]
        # The default of the duration gives way to the step.
        wish["duration"] = DURATION if dt is None else dt * max(1, round(DURATION / dt))

    def run(progress: Callable[[int, int], None]) -> Trajectory:
        return simulate(scene, q0, v0, **wish, controls=torque, integrator=integrator, progress=progress)

    return _run(request, errors, scene.robot, run, outputs)


def _run(
    request: argparse.Namespace,
    errors: Console,
    robot: Robot,
    run: Callable[[Callable[[int, int], None]], Trajectory],
    outputs: Writers,
) -> int:
    """Simulate; write and print the result, or the part before an interruption or failure."""
    frame_names("--trace", [robot], request.trace)
    tell: Callable[[Console, str], None] = say
    status, complaint, begin = 0, "interrupted", time.perf_counter()
    with request.interrupts.keeping():
        try:
            with progress_bar(errors, 1, quiet=request.quiet) as progress:
                trajectory = run(progress)
        except Interrupted as interruption:
            trajectory, status = interruption.trajectory, INTERRUPTED
            complaint = f"interrupted after {trajectory.steps} steps, which are kept"
        except StepFailure as failure:
            trajectory, status, tell = failure.trajectory, STEP_FAILED, complain
            complaint = f"{failure.problem}. {failure.advice}. The motion so far is kept"
        wall_time = time.perf_counter() - begin
        written, trouble = write_all(request, errors, outputs, robot, trajectory, trajectory)
    if not request.quiet:
        show(_summary(trajectory, wall_time, written))
    if status or trouble == INTERRUPTED:
        tell(errors, complaint)
    return status or trouble


def _summary(trajectory: Trajectory, wall_time: float, written: Iterable[tuple[str, object]]) -> Table:
    """A table of a run: its settings, work, result and files."""
    rows = [
        *trajectory.overview,
        ("wall time", f"{wall_time:.3g} s"),
        ("q at the end [rad or m]", "  ".join(f"{x:.6g}" for x in trajectory.q[-1])),
        ("v at the end [rad/s or m/s]", "  ".join(f"{x:.6g}" for x in trajectory.v[-1])),
        # The log has the first.
        *(("warning", finding) for finding in trajectory.warnings[1:]),
        *written,
    ]
    return Table(f"{trajectory.robot}: {trajectory.integrator}", (), rows)


def add_solve(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin solve``."""
    parser.description = (
        "Find the motion of least cost of a scene file by S-DDP. Ctrl-C keeps the best motion so far; with --resume a "
        "saved solution continues as if it had not stopped."
    )
    parser.set_defaults(run=_solve, log_level=logging.WARNING)
    parser.add_argument("scene", metavar="SCENE", help="path of a scene file (TOML), or name of a scene of varpin")
    parser.add_argument("--resume", type=Path, metavar="NPZ", help="continue from a solution that --save wrote")
    text = "largest number of iterations; default: the scene's, or 100"
    parser.add_argument("--max-iterations", type=int, metavar="N", help=text)
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
    # The solution is the first of the outputs.
    kept = request.save is not None and ("written", next(iter(outputs))) in written
    told = _status(solution, request.scene, request.save if kept else None)
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
    return (0 if converged and not unmet else STEP_FAILED) or trouble


def _status(solution: Solution, scene: str, saved: Path | None) -> str:
    """How the search ended, with advice for the command line; ``saved`` is the file that has the solution."""
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
    problem, most = solution.problem, np.abs(solution.trajectory.u).max(axis=0, initial=0.0)
    noise = f", and {solution.noise_cost:.6g} by noise" if solution.noise_cost else ""
    unit = "own units" if file.scene.inputs or file.scene.servo_joints else "N m or N"
    rows = [
        ("joints", f"{file.robot.dof} of {file.required.described} computed"),
        ("horizon", f"{problem.steps} steps of {problem.dt:g} s, {problem.integrator}"),
        ("status", told),
        ("cost", f"{solution.cost:.6g}{noise}, after {solution.iterations} iterations"),
        ("wall time", f"{wall_time:.3g} s"),
        (f"largest controls [{unit}]", "  ".join(f"{value:.4g}" for value in most)),
        ("q at the end [rad or m]", "  ".join(f"{value:.6g}" for value in solution.trajectory.q[-1])),
        *written,
    ]
    return Table(file.title, (), rows)
