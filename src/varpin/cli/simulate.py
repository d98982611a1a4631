"""``varpin simulate``: integrate a robot in time."""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable, Iterable

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
        "Integrate a robot, or a scene file, in time with a variational integrator. An option with numbers of joints "
        "takes one number for all joints, one for each, or JOINT=VALUE for some. Ctrl-C and a failed step keep the "
        "motion up to there."
    )
    parser.set_defaults(run=_simulate, log_level=logging.WARNING)
    add_robot(parser, scenes=True)
    parser.add_argument("--dt", type=float, metavar="S", help=f"time step [s]; default: {DT:g}")
    parser.add_argument(
        "--tolerance",
        type=float,
        metavar="E",
        help="largest allowed error in q [rad or m], instead of --dt: selects the cheapest step that meets it, and the "
        "integrator if none is given",
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--duration",
        type=float,
        metavar="S",
        help=f"time to simulate [s]; default: {DURATION:g} or near it",
    )
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
    integrator = None if request.integrator is None else integrator_of_words(request.integrator)
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
    steps, statistics, accuracy = trajectory.steps, trajectory.statistics, trajectory.accuracy
    rows: list[tuple[str, object]] = [
        ("steps", f"{steps}, {trajectory.dt:g} s each, {trajectory.duration:g} s in all"),
        ("wall time", f"{wall_time:.3g} s"),
    ]
    if accuracy is not None:
        rows.append(("tolerance", str(accuracy)))
    elif trajectory.error_text:
        rows.append(("estimated error in q", f"{trajectory.error_text.removeprefix('error ')} rad or m"))
    if split := statistics.split_steps:
        most = statistics.substeps.max()
        rows.append(("split steps", f"{split} of {steps}, into up to {most} parts: a smaller dt keeps the structure"))
    change = trajectory.energy - trajectory.energy[0]
    kinetic = 0.5 * (trajectory.p * trajectory.v).sum(axis=1).max()
    rows += [
        ("energy change", f"{change[-1]:+.3g} J from start to end, {np.abs(change).max():.3g} J at most in between"),
        ("kinetic energy", f"up to {kinetic:.3g} J"),
        ("q at the end [rad or m]", "  ".join(f"{x:.6g}" for x in trajectory.q[-1])),
        ("v at the end [rad/s or m/s]", "  ".join(f"{x:.6g}" for x in trajectory.v[-1])),
        # The log has the first.
        *(("warning", finding) for finding in trajectory.warnings[1:]),
        *written,
    ]
    return Table(f"{trajectory.robot}: {trajectory.integrator}", (), rows)
