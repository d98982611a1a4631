"""``varpin simulate``: integrate a robot in time."""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from varpin.cli.arguments import (
    ROBOT_OPTIONS,
    add_integrator,
    add_motion,
    add_robot,
    integrator_of_words,
    motion_of,
    names_scene,
    scene_file,
)
from varpin.cli.console import complain, progress_bar, say, show, written_rows
from varpin.cli.exits import INTERRUPTED, STEP_FAILED
from varpin.cli.outputs import Writers, add_outputs, write_all, writers_of
from varpin.errors import InputError
from varpin.mechanics.scene import Scene
from varpin.show.given import frame_names
from varpin.simulation.failures import Interrupted, StepFailure
from varpin.simulation.simulate import simulate
from varpin.simulation.start import time_steps
from varpin.support.checks import count, positive
from varpin.support.tables import Table
from varpin.trajectory import Trajectory

# Largest number of steps; more do not fit into memory.
MOST_STEPS = 10**9
# Default time step [s].
DT = 1e-3
# Options that exclude a scene file.
_OF_MOTIONS = (
    *(*ROBOT_OPTIONS, "dt", "tolerance", "duration", "steps", "integrator"),
    *("q0", "srdf", "v0", "gravity", "damping", "friction", "stiffness", "rest", "constraints", "torque"),
)


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
        "--duration", type=float, metavar="S", help="time to simulate [s], rounded to whole steps; default: 2"
    )
    length.add_argument("--steps", type=int, metavar="N", help="the number of steps instead")
    add_integrator(parser)
    add_motion(parser)
    add_outputs(parser, "trajectory")


def _simulate(request: argparse.Namespace, errors: Console) -> int:
    if names_scene(request.robot):
        file = scene_file(request, request.robot, "simulate", *_OF_MOTIONS)
        outputs = writers_of(request, file.marks)
        return _run(request, errors, file.scene, file.driven, file.steps, lambda p: file.simulate(progress=p), outputs)
    outputs = writers_of(request)
    steps = _steps(request)
    integrator = None if request.integrator is None else integrator_of_words(request.integrator)
    scene, q0, v0, torque = motion_of(request)

    def run(progress: Callable[[int, int], None]) -> Trajectory:
        if steps is None:
            wish = {"duration": _duration(request), "tolerance": request.tolerance}
        else:
            wish = {"dt": _dt(request), "steps": steps}
        return simulate(scene, q0, v0, **wish, controls=torque, integrator=integrator, progress=progress)

    return _run(request, errors, scene, bool(not scene.conservative or torque is not None), steps, run, outputs)


def _run(
    request: argparse.Namespace,
    errors: Console,
    scene: Scene,
    driven: bool,
    steps: int | None,
    run: Callable[[Callable[[int, int], None]], Trajectory],
    outputs: Writers,
) -> int:
    """Simulate; write and print the result, or the part before an interruption or failure."""
    robot = scene.robot
    frame_names("--trace", [robot], request.trace)
    status, complaint, begin = 0, "", time.perf_counter()
    with request.interrupts.keeping():
        try:
            with progress_bar(errors, steps or 1, quiet=request.quiet) as progress:
                trajectory = run(progress)
        except Interrupted as interruption:
            trajectory, status = interruption.trajectory, INTERRUPTED
            of = "" if steps is None else f" of {steps}"
            complaint = f"interrupted after {trajectory.steps}{of} steps, which are kept"
        except StepFailure as failure:
            trajectory, status = failure.trajectory, STEP_FAILED
            complaint = f"{failure.problem}. {failure.advice}. The motion so far is kept"
        wall_time = time.perf_counter() - begin
        writers = {path: partial(write, robot, trajectory) for path, write in outputs.items()}
        written, trouble = write_all(errors, writers, request.interrupts)
    status = status or trouble
    if not request.quiet:
        show(_summary(trajectory, steps, wall_time, driven, written))
    if status == INTERRUPTED:
        say(errors, complaint or "interrupted")
    elif complaint:
        complain(errors, complaint)
    return status


def _dt(request: argparse.Namespace) -> float:
    return positive("--dt", DT if request.dt is None else request.dt, "s")


def _duration(request: argparse.Namespace) -> float:
    return positive("--duration", 2.0 if request.duration is None else request.duration, "s")


def _steps(request: argparse.Namespace) -> int | None:
    """The number of steps; None with a tolerance."""
    if request.tolerance is not None:
        positive("--tolerance", request.tolerance, "rad or m")
        for option in ("dt", "steps"):
            if getattr(request, option) is not None:
                raise InputError(f"--{option} and --tolerance do not go together: a tolerance chooses the steps")
        return None
    dt = _dt(request)
    if request.steps is None:
        duration = _duration(request)
        # The default of the duration gives way to the step.
        given = request.duration is not None
        steps = time_steps(dt, None, duration)[1] if given else max(1, round(min(duration / dt, MOST_STEPS + 1)))
    else:
        steps = count("--steps", request.steps, 1)
    if steps > MOST_STEPS:
        raise InputError(f"{steps} steps are too many; a run has {MOST_STEPS} at most")
    return steps


def _summary(trajectory: Trajectory, asked: int | None, wall_time: float, driven: bool, files: Iterable[Path]) -> Table:
    """A table of a run: its settings, work, result and files."""
    statistics, steps = trajectory.statistics, trajectory.steps
    of = f" of {asked}" if asked is not None and steps < asked else ""
    rows = [
        ("steps", f"{steps}{of}, {trajectory.dt:g} s each, {trajectory.duration:g} s in all"),
        ("wall time", f"{wall_time:.3g} s"),
    ]
    error = "estimated error in q"
    if (accuracy := trajectory.accuracy) is not None:
        met = "" if accuracy.met else ", not"
        took = f"the search took {accuracy.search_steps} steps"
        rows.append((error, f"{accuracy.error:.2g} rad or m{met} within {accuracy.tolerance:g}; {took}"))
    elif trajectory.error_text:
        rows.append((error, f"{trajectory.error_text.removeprefix('error ')} rad or m"))
    if split := statistics.split_steps:
        most = statistics.substeps.max()
        rows.append(("split steps", f"{split} of {steps}, into up to {most} parts: a smaller dt keeps the structure"))
    drift = np.abs(trajectory.energy - trajectory.energy[0]).max()
    if driven:
        change = trajectory.energy[-1] - trajectory.energy[0]
        rows.append(("energy change", f"{change:+.3g} J from start to end, {drift:.3g} J at most in between"))
    else:
        kinetic = 0.5 * (trajectory.p * trajectory.v).sum(axis=1).max()
        of_kinetic = f", of a kinetic energy of up to {kinetic:.3g} J" if kinetic > 0.0 else ""
        rows.append(("energy error", f"{drift:.3g} J at most{of_kinetic}"))
    names = "q at the end [rad or m]", "v at the end [rad/s or m/s]"
    ends = (trajectory.q[-1], trajectory.v[-1])
    rows += [(name, "  ".join(f"{x:.6g}" for x in values)) for name, values in zip(names, ends, strict=True)]
    # The log has the first.
    rows += [("warning", finding) for finding in trajectory.warnings[1:]]
    return Table(f"{trajectory.robot}: {trajectory.integrator}", (), [*rows, *written_rows(files)])
