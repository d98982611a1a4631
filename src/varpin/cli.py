"""The ``varpin`` command: simulate a robot, plan its motion, look into its description, or choose an integrator for it.

Exit status: 0 done, 1 a silent wrong result among extreme scenes, 2 a mistake in the request, 3 a step that could not
be solved or an accuracy out of reach, 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import logging
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from varpin._version import __version__
from varpin.checks import count, positive, writable
from varpin.errors import FileError, InputError, VarpinError
from varpin.inspection import JointReport, RobotReport, inspect_robot
from varpin.integrators import Integrator, Midpoint
from varpin.lagrangian import lagrangian_jet
from varpin.replay import check_film, frame_names, replay
from varpin.robot import Robot, build_robot, load_robot, robot_names
from varpin.scene import Scene
from varpin.scenefile import SceneFile, load_scene, scenes
from varpin.sddp import Solution, Status
from varpin.simulation import Interrupted, StepFailure, simulate
from varpin.tradeoff import advise, work_precision
from varpin.tradeoff.setting import Setting
from varpin.trajectory import Trajectory, atomic_file

if TYPE_CHECKING:
    from varpin.extremes import Cell

FAULTY, MISTAKE, STEP_FAILED, INTERRUPTED = 1, 2, 3, 130

PLOT_FORMATS = (".png", ".pdf", ".svg")
# More steps than anyone can hold in memory, said before NumPy says it in its own words.
MOST_STEPS = 10**9
# The largest step is no limit beyond this [s].
_ANY_STEP = 100.0
# Options that a scene file leaves no room for.
_OF_MOTIONS = (
    *("lock", "package_dir", "dt", "duration", "steps", "alpha"),
    *("q0", "v0", "gravity", "damping", "stiffness", "rest", "torque"),
)
# Width of tables in a pipe or a file, which have none of their own.
_WIDTH = 140

_EXAMPLES = """\
examples:
  varpin simulate finger --q0 0.5 0.3 0.2 --v0 0 0 1 --no-gravity --html finger.html
  varpin simulate panda --lock panda_finger_joint1=0.02 --q0 -0.5 --duration 5 --save fall.npz --plot fall.png
  varpin simulate arm.urdf --dt 5e-4 --steps 4000 --damping 0.1 --torque 1 -2.5e-1
  varpin robots
  varpin inspect ur5 --q 0 -1.2 1 0 0 0
  varpin solve finger_tracking --html finger.html --save plan.npz
  varpin simulate scene.toml --plot motion.png
  varpin advise ur5 --tolerance 1e-6 --duration 1
  varpin tradeoff ur5 --duration 1 --out ur5-tradeoff
  varpin extremes finger --out finger-extremes
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if left out, and return the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    request, unknown = _parser().parse_known_args([_shielded(word) for word in words])
    if unknown:
        request.parser.error(_not_an_option(unknown, request.parser))
    errors = Console(stderr=True)
    run: Callable[[argparse.Namespace, Console], int] = request.run
    try:
        with _logged(errors, request.log_level):
            return run(request, errors)
    except VarpinError as error:
        _complain(errors, error)
        return MISTAKE
    except MemoryError as error:
        _complain(errors, f"out of memory: {error}; take fewer steps" if str(error) else "out of memory")
        return MISTAKE
    except KeyboardInterrupt:
        _say(errors, "interrupted")
        return INTERRUPTED


def _shielded(word: str) -> str:
    """``word`` such that argparse takes it for no option: it knows -1 for a number, but not -1e-3 or -inf."""
    try:
        float(word)
    except ValueError:
        return word
    return f" {word}" if word.startswith("-") else word


def _not_an_option(words: Sequence[str], parser: argparse.ArgumentParser) -> str:
    """What is wrong with words that no option takes, and the options they come closest to."""
    known = [name for action in parser._actions for name in action.option_strings]
    message = f"unrecognized arguments: {' '.join(word.strip() for word in words)}"
    for word in words:
        name = word.partition("=")[0]
        if name.startswith("--") and (matches := difflib.get_close_matches(name, known, n=1)):
            message += f"; did you mean {matches[0]} for {name}?"
    return message


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="varpin",
        description="Variational integrators on Pinocchio.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"varpin {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_simulate(commands.add_parser("simulate", help="integrate a robot in time", allow_abbrev=False))
    _add_robots(commands.add_parser("robots", help="list the robots that go by a name", allow_abbrev=False))
    _add_solve(commands.add_parser("solve", help="plan the motion that a scene file asks for", allow_abbrev=False))
    _add_inspect(commands.add_parser("inspect", help="look into a robot description", allow_abbrev=False))
    _add_tradeoff(commands.add_parser("tradeoff", help="measure speed against accuracy", allow_abbrev=False))
    _add_advise(commands.add_parser("advise", help="find the cheapest integrator and step", allow_abbrev=False))
    _add_paper(commands.add_parser("paper", help="reproduce the paper's experiments", allow_abbrev=False))
    _add_extremes(commands.add_parser("extremes", help="run every integrator where it is hard", allow_abbrev=False))
    for command in commands.choices.values():
        command.set_defaults(parser=command)
    return parser


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Integrate a robot in time with the midpoint variational integrator; or a scene file, which says all of it "
        "itself. Of numbers that belong to joints, one alone is taken for all of them. Ctrl-C and a failed step keep "
        "what was computed before."
    )
    parser.set_defaults(run=_simulate, log_level=logging.WARNING)
    _add_robot(parser, scenes=True)
    parser.add_argument("--dt", type=float, default=1e-3, metavar="S", help="time step [s]; default: %(default)g")
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--duration", type=float, metavar="S", help="time to simulate [s], rounded to whole steps; default: 2"
    )
    length.add_argument("--steps", type=int, metavar="N", help="the number of steps instead")
    parser.add_argument(
        "--alpha",
        type=float,
        default=0.5,
        help="of the midpoint rule, in [0, 1]; second order at 0.5, first elsewhere; default: %(default)g",
    )
    _add_motion(parser)
    _add_outputs(parser, "trajectory")


def _add_outputs(parser: argparse.ArgumentParser, what: str) -> None:
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("--save", type=Path, metavar="NPZ", help=f"write the {what}, for {what.title()}.load")
    outputs.add_argument("--plot", type=Path, metavar="PNG", help="draw an overview, as png, pdf or svg")
    outputs.add_argument("--html", type=Path, metavar="HTML", help="write a replay that any browser opens")
    outputs.add_argument(
        "--video", type=Path, metavar="MP4", help="film the replay, as mp4 or gif; needs varpin[video]"
    )
    outputs.add_argument("--trace", nargs="+", default=[], metavar="FRAME", help="draw the paths of frames in it")
    outputs.add_argument(
        "--speed",
        type=float,
        default=1.0,
        metavar="X",
        help="of the replay; 0.1 is ten times slower; default: true speed",
    )
    outputs.add_argument("--quiet", action="store_true", help="print warnings and errors only")


def _add_solve(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Find the motion of least cost that a scene file asks for, by S-DDP. Ctrl-C keeps the best motion so far; "
        "with --resume a saved solution goes on as if it had not stopped."
    )
    parser.set_defaults(run=_solve, log_level=logging.WARNING)
    parser.add_argument("scene", metavar="SCENE", help="path of a scene file (TOML), or name of a scene of varpin")
    parser.add_argument("--resume", type=Path, metavar="NPZ", help="go on from a solution that --save wrote")
    parser.add_argument("--max-iterations", type=int, metavar="N", help="at most; default: the scene's, or 100")
    _add_outputs(parser, "solution")


def _add_inspect(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Print a robot's joints, links and masses, how well its mass matrix is conditioned, the largest step the "
        "midpoint integrator's branch guard accepts, and whatever looks wrong. Takes robots that simulate refuses."
    )
    # What loading warns of is among the report's own warnings.
    parser.set_defaults(run=_inspect, log_level=logging.ERROR)
    _add_robot(parser, scenes=True)
    _add_vector(parser, "q", "configuration to look at [rad or m]; default: 0")
    _add_vector(parser, "v", "velocity there [rad/s or m/s]; default: 0")
    _add_gravity(parser)


def _add_robots(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "List the robots that every command takes by name: those that come with varpin, and the fixed-base ones of the "
        "installed example-robot-data."
    )
    parser.set_defaults(run=_robots, log_level=logging.ERROR)


def _add_tradeoff(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Run a robot's motion with every integrator over many steps, and print and write their errors against an "
        "accurate reference, and their wall times. What is in the folder already is not run again, so an interrupted "
        "measurement goes on where it stopped."
    )
    parser.set_defaults(run=_tradeoff, log_level=logging.WARNING)
    _add_robot(parser)
    parser.add_argument(
        "--duration", type=float, default=1.0, metavar="S", help="of the motion [s]; default: %(default)g"
    )
    parser.add_argument("--dt", type=float, nargs="+", metavar="S", help="time steps [s]; default: 0.04 and its halves")
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="of each run; default: %(default)d")
    _add_motion(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="write a table (CSV), a figure (PNG), a page (HTML), the record (NPZ)",
    )
    outputs.add_argument("--quiet", action="store_true", help="print warnings and errors only")


def _add_advise(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Find the cheapest integrator and step that keep the error in q at the end of a robot's motion below a "
        "tolerance, or the most accurate ones within a time, from short runs."
    )
    parser.set_defaults(run=_advise, log_level=logging.WARNING)
    _add_robot(parser)
    wish = parser.add_mutually_exclusive_group(required=True)
    wish.add_argument("--tolerance", type=float, metavar="E", help="the error to keep below [rad or m]")
    wish.add_argument("--budget", type=float, metavar="S", help="the wall time to keep to [s]")
    parser.add_argument(
        "--duration", type=float, default=1.0, metavar="S", help="of the motion [s]; default: %(default)g"
    )
    _add_motion(parser)
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("--out", type=Path, metavar="FOLDER", help="write advice.png and advice.html there")


def _add_paper(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Run the experiments of the paper on stochastic variational integrators and write tables (CSV), figures (PNG) "
        "and a report (HTML) that holds each of its claims against what came out. What is in the folder already is not "
        "computed again, so an interrupted run goes on where it stopped."
    )
    parser.set_defaults(run=_paper, log_level=logging.ERROR)
    parser.add_argument("--quick", action="store_true", help="fewer time steps and one setting: about a minute")
    parser.add_argument(
        "--out", type=Path, default=Path("paper"), metavar="FOLDER", help="where to write; default: %(default)s"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but the report's path")


def _add_extremes(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Run scenes at the extremes with every integrator, and judge each result by independent checks: accurate; "
        "degraded, and varpin says so; refused; stopped; or silent wrong, which is a fault of varpin's. What is in the "
        "folder already is not run again, so an interrupted battery goes on where it stopped. Exit status 1 if "
        "anything is silent wrong."
    )
    parser.set_defaults(run=_extremes, log_level=logging.CRITICAL)
    _add_robot(parser, optional=True)
    parser.add_argument("--deep", action="store_true", help="the long scenes too: hours")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write the record (JSON) and a heat map (HTML)")
    parser.add_argument("--quiet", action="store_true", help="print nothing but what is silent wrong")


def _add_robot(parser: argparse.ArgumentParser, *, optional: bool = False, scenes: bool = False) -> None:
    parser.add_argument(
        "robot",
        metavar="ROBOT",
        nargs="?" if optional else None,
        help="path of a URDF file, or name of a robot of varpin or of example-robot-data"
        + ("; scenes made up for it if left out" if optional else "")
        + ("; or a scene file (TOML), or name of a scene of varpin" if scenes else ""),
    )
    parser.add_argument(
        "--lock",
        type=_lock,
        nargs="+",
        action="extend",
        default=[],
        metavar="JOINT=VALUE",
        help="hold joints still [rad or m]",
    )
    parser.add_argument(
        "--package-dir",
        action="append",
        metavar="DIR",
        help="where package:// paths of meshes are looked up; repeatable",
    )


def _add_motion(parser: argparse.ArgumentParser) -> None:
    """Where a motion starts, and what acts on it."""
    start = parser.add_argument_group("start")
    _add_vector(start, "q0", "initial configuration [rad or m]; default: 0")
    _add_vector(start, "v0", "initial velocity [rad/s or m/s]; default: 0")
    surroundings = parser.add_argument_group("surroundings")
    _add_gravity(surroundings)
    _add_vector(surroundings, "damping", "viscous damping [N m s/rad or N s/m]; default: 0")
    _add_vector(surroundings, "stiffness", "joint springs [N m/rad or N/m]; default: 0")
    _add_vector(surroundings, "rest", "where the springs are slack [rad or m]; default: 0")
    _add_vector(surroundings, "torque", "constant generalized forces [N m or N]; default: 0")


def _add_vector(group: argparse._ActionsContainer, name: str, text: str) -> None:
    group.add_argument(f"--{name}", type=float, nargs="+", metavar="X", help=text)


def _add_gravity(group: argparse._ActionsContainer) -> None:
    gravity = group.add_mutually_exclusive_group()
    gravity.add_argument(
        "--gravity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        default=True,
        help="in world axes [m/s^2]; default: 0 0 -9.81",
    )
    gravity.add_argument("--no-gravity", dest="gravity", action="store_false", help="none")


def _lock(word: str) -> tuple[str, ArrayLike]:
    name, equals, value = word.strip().rpartition("=")
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    if not (equals and name and numbers):
        raise argparse.ArgumentTypeError(f"{word!r} is not of the form JOINT=VALUE, for example elbow=0.5")
    return name, numbers[0] if len(numbers) == 1 else numbers


def _vector(option: str, numbers: Sequence[float] | None, robot: Robot) -> ArrayLike:
    """The numbers of an option: none for 0, one for all joints, or (n,)."""
    if numbers is None:
        return 0.0
    if len(numbers) not in (1, robot.dof):
        raise InputError(
            f"--{option} takes one number for all joints or {robot.dof}, for {', '.join(robot.joint_names)}; "
            f"got {len(numbers)}"
        )
    return numbers[0] if len(numbers) == 1 else list(numbers)


@dataclass(frozen=True)
class _Output:
    """A file to make of the trajectory."""

    path: Path
    write: Callable[[Robot, Trajectory], None]


def _outputs(request: argparse.Namespace) -> list[_Output]:
    """The files asked for, in the order of their worth; what writes them is imported now and not after the run.

    Raises:
        FileError: One of them cannot be written.
        InputError: Two are the same file, or a format is unknown.
        MissingDependency: A film needs what is not installed.
    """
    outputs = []
    if request.save is not None:
        outputs.append(_record(writable(request.save)))
    if request.plot is not None:
        outputs.append(_figure(writable(request.plot)))
    for path, film in ((request.html, False), (request.video, True)):
        if path is not None:
            if film:
                check_film(path)
            outputs.append(_replay(writable(path), positive("--speed", request.speed, "1"), request.trace, film))
    paths = [output.path.resolve() for output in outputs]
    for path in paths:
        if paths.count(path) > 1:
            raise InputError(f"two outputs cannot be one file: {path}")
    return outputs


def _record(path: Path) -> _Output:
    def write(_robot: Robot, trajectory: Trajectory) -> None:
        trajectory.save(path)

    return _Output(path, write)


def _figure(path: Path) -> _Output:
    if path.suffix.lower() not in PLOT_FORMATS:
        raise InputError(f"--plot must end in {', '.join(PLOT_FORMATS)}, got {path.name!r}")
    from varpin.plots import plot_trajectory  # noqa: PLC0415 - matplotlib is slow to import

    def write(robot: Robot, trajectory: Trajectory) -> None:
        figure, _ = plot_trajectory(trajectory, robot=robot)
        with atomic_file(path) as stream:
            figure.savefig(stream, format=path.suffix[1:].lower(), dpi=150)  # type: ignore[union-attr]

    return _Output(path, write)


def _replay(path: Path, speed: float, frames: Sequence[str], film: bool) -> _Output:
    def write(robot: Robot, trajectory: Trajectory) -> None:
        html, video = (None, path) if film else (path, None)
        replay(robot, trajectory, html=html, video=video, speed=speed, trace=frames)

    return _Output(path, write)


def _motion(request: argparse.Namespace) -> tuple[Scene, ArrayLike, ArrayLike, NDArray[np.float64] | None]:
    """The scene, q0, v0, and the torque unless it is zero."""
    robot = load_robot(request.robot, package_dirs=request.package_dir, lock=dict(request.lock))
    scene = Scene(
        robot,
        gravity=request.gravity,
        damping=_vector("damping", request.damping, robot),
        stiffness=_vector("stiffness", request.stiffness, robot),
        rest=_vector("rest", request.rest, robot),
    )
    q0, v0, torque = (
        np.broadcast_to(_vector(name, getattr(request, name), robot), (robot.dof,)) for name in ("q0", "v0", "torque")
    )
    return scene, q0, v0, torque if torque.any() else None


def _names_scene(word: str) -> bool:
    return Path(word).suffix == ".toml" or word in scenes()


def _scene_file(request: argparse.Namespace, word: str, *given: str) -> SceneFile:
    """The scene file, whose outputs stand in for those not asked for; ``given`` are options it leaves no room for."""
    command, default = given[0], _parser().parse_args([given[0], "robot"]) if len(given) > 1 else None
    for name in given[1:]:
        if getattr(request, name) != getattr(default, name):
            option = name.replace("_", "-") if getattr(request, name) is not False else f"no-{name}"
            raise InputError(f"--{option} has no place beside a scene file: {command} {word} takes it from the file")
    scene = load_scene(word)
    outputs = scene.spec.outputs
    for name in ("save", "plot", "html"):
        if hasattr(request, name) and getattr(request, name) is None:
            setattr(request, name, getattr(outputs, name))
    if getattr(request, "speed", None) == 1.0:
        request.speed = outputs.speed
    return scene


def _simulate(request: argparse.Namespace, errors: Console) -> int:
    if _names_scene(request.robot):
        file = _scene_file(request, request.robot, "simulate", *_OF_MOTIONS)
        driven = bool(file.scene.damping.any() or file.controls() is not None or file.spec.seed is not None)
        _warm_up(file.scene, file.q0, file.v0, None, file.spec.integrator)
        return _run(request, errors, file.scene, driven, file.spec.steps, lambda p: file.simulate(progress=p))
    outputs = _outputs(request)
    steps = _steps(request)
    scene, q0, v0, torque = _motion(request)
    integrator = Midpoint(alpha=request.alpha)
    _warm_up(scene, q0, v0, torque, integrator)

    def run(progress: Callable[[int, int], None]) -> Trajectory:
        return simulate(
            scene, q0, v0, dt=request.dt, steps=steps, controls=torque, integrator=integrator, progress=progress
        )

    return _run(request, errors, scene, bool(scene.damping.any() or torque is not None), steps, run, outputs)


def _warm_up(scene: Scene, q0: ArrayLike, v0: ArrayLike, torque: ArrayLike | None, integrator: Integrator) -> None:
    """Compile what a run needs, which is no part of its wall time; damping is looked at through the jet."""
    Setting.of(scene, q0, v0, torque, 1.0).warm_up(integrator)
    lagrangian_jet(scene, q0, np.zeros(scene.robot.dof))


def _run(
    request: argparse.Namespace,
    errors: Console,
    scene: Scene,
    driven: bool,
    steps: int,
    run: Callable[[Callable[[int, int], None]], Trajectory],
    outputs: list[_Output] | None = None,
) -> int:
    """Simulate, and write and print what came out, a part of it if that is all."""
    outputs = _outputs(request) if outputs is None else outputs
    robot = scene.robot
    frame_names("--trace", [robot], request.trace)
    status, complaint, begin = 0, "", time.perf_counter()
    try:
        with _progress(errors, steps, quiet=request.quiet) as progress:
            trajectory = run(progress)
    except Interrupted as interruption:
        trajectory, status = interruption.trajectory, INTERRUPTED
        complaint = f"interrupted after {trajectory.steps} of {steps} steps, which are kept"
    except StepFailure as failure:
        trajectory, status = failure.trajectory, STEP_FAILED
        complaint = str(failure).replace("is in error.trajectory", "is kept")
    wall_time = time.perf_counter() - begin

    written = _write(errors, {output.path: partial(output.write, robot, trajectory) for output in outputs})
    if len(written) < len(outputs):
        status = status or MISTAKE
    if not request.quiet:
        tables = Console() if sys.stdout.isatty() else Console(width=_WIDTH)
        tables.print(_summary(robot, trajectory, steps, wall_time, driven, written))
    if status == INTERRUPTED:
        _say(errors, complaint)
    elif complaint:
        _complain(errors, complaint)
    return status


def _write(errors: Console, files: Mapping[Path, Callable[[], object]]) -> list[Path]:
    """Write files, complain of those that cannot be, and return the others."""
    written = []
    for path, write in files.items():
        try:
            write()
        except (VarpinError, OSError) as error:
            _complain(errors, f"{path} was not written: {error}")
        else:
            written.append(path)
    return written


def _solve(request: argparse.Namespace, errors: Console) -> int:
    file = _scene_file(request, request.scene, "solve")
    outputs = _outputs(request)
    options = {} if request.max_iterations is None else {"max_iterations": request.max_iterations}
    resume = None if request.resume is None else file.load_solution(request.resume)
    begin = time.perf_counter()
    solution = file.solve(resume=resume, **options)
    wall_time = time.perf_counter() - begin
    status = 0 if solution.status.converged else STEP_FAILED
    if solution.status is Status.INTERRUPTED:
        status = INTERRUPTED
    saved = None if request.save is None else writable(request.save)
    writers: dict[Path, Callable[[], object]] = {
        output.path: partial(solution.save, output.path)
        if output.path == saved
        else partial(output.write, file.robot, solution.trajectory)
        for output in outputs
    }
    written = _write(errors, writers)
    if len(written) < len(outputs):
        status = status or MISTAKE
    if not request.quiet:
        console = Console() if sys.stdout.isatty() else Console(width=_WIDTH)
        for line in solution.table().splitlines()[:-1]:
            _say(console, line, prefix="")
        console.print(_plan_table(file, solution, wall_time, written))
    if not solution.status.converged:
        _say(errors, solution.status.value, style="yellow")
    return status


def _plan_table(file: SceneFile, solution: Solution, wall_time: float, files: Iterable[Path]) -> Table:
    table, problem = _facts(file.spec.title), solution.problem
    apart = f", planned in {len(file.required.parts)} parts" if len(file.required.parts) > 1 else ""
    _row(table, "joints", f"{file.robot.dof} of {file.required.described} computed{apart}")
    _row(table, "horizon", f"{problem.steps} steps of {problem.dt:g} s, {problem.integrator}")
    _row(table, "status", solution.status.value, style="" if solution.status.converged else "bold yellow")
    noise = f", and {solution.noise_cost:.6g} by noise" if solution.noise_cost else ""
    _row(table, "cost", f"{solution.cost:.6g}{noise}, after {solution.iterations} iterations")
    _row(table, "wall time", f"{wall_time:.3g} s, loading of kernels included")
    most = np.abs(solution.trajectory.u).max(axis=0, initial=0.0)
    _row(table, "largest controls", "  ".join(f"{value:.4g}" for value in most))
    _row(table, "q at the end [rad or m]", "  ".join(f"{value:.6g}" for value in solution.trajectory.q[-1]))
    for path in files:
        _row(table, "written", f"{path} ({_size(path.stat().st_size)})")
    return table


def _steps(request: argparse.Namespace) -> int:
    dt = positive("--dt", request.dt, "s")
    if request.steps is None:
        ratio = positive("--duration", 2.0 if request.duration is None else request.duration, "s") / dt
        if ratio < 0.5:
            raise InputError(f"--duration {request.duration:g} s is less than one step of {dt:g} s")
        steps = round(ratio) if math.isfinite(ratio) else MOST_STEPS + 1
    else:
        steps = count("--steps", request.steps, 1)
    if steps > MOST_STEPS:
        raise InputError(f"{steps} steps or more are asked for; a run has {MOST_STEPS} at most")
    return steps


def _summary(
    robot: Robot, trajectory: Trajectory, asked: int, wall_time: float, driven: bool, files: Iterable[Path]
) -> Table:
    """What a run was, took and made."""
    table = _facts(f"{trajectory.robot}: {trajectory.integrator}")
    statistics, steps = trajectory.statistics, trajectory.steps
    of = f" of {asked}" if steps < asked else ""
    _row(table, "steps", f"{steps}{of}, {trajectory.dt:g} s each, {trajectory.duration:g} s in all")
    _row(table, "wall time", f"{wall_time:.3g} s, without compiling")
    if steps:
        newton, split = statistics.newton_iterations, statistics.split_steps
        _row(table, "Newton iterations", f"{newton.mean():.2f} a step, {newton.max()} at most")
        if split:
            _row(
                table,
                "split steps",
                f"{split} of {steps}, into up to {statistics.substeps.max()} parts: a smaller dt keeps the structure",
                style="bold yellow",
            )
        else:
            _row(table, "split steps", "none")
        _row(table, "worst residual", f"{statistics.residual.max():.3g} rounding units")
        _row(table, "smallest branch margin", f"{statistics.branch_margin.min():.3g} (1 for dt -> 0, refused at 0)")
    drift = np.abs(trajectory.energy - trajectory.energy[0]).max()
    kinetic = 0.5 * (trajectory.p * trajectory.v).sum(axis=1).max()
    if driven:
        change = trajectory.energy[-1] - trajectory.energy[0]
        _row(table, "energy change", f"{change:+.3g} J from start to end, {drift:.3g} J at most in between")
    else:
        part = drift / kinetic if kinetic > 0.0 else 0.0
        share = f"{part:.2g} of" if part < 1.0 else f"{part:.3g} times"
        of_kinetic = f", {share} the largest kinetic energy" if part > 0.0 else ""
        _row(table, "energy error", f"{drift:.3g} J at most{of_kinetic}")
    lower, upper = robot.position_limits
    outside = np.any((trajectory.q < lower) | (trajectory.q > upper), axis=0)
    if outside.any():
        joints = ", ".join(name for name, out in zip(robot.joint_names, outside, strict=True) if out)
        _row(table, "beyond their limits", f"{joints} (limits are not modelled)")
    names = "q at the end [rad or m]", "v at the end [rad/s or m/s]"
    for name, values in zip(names, (trajectory.q[-1], trajectory.v[-1]), strict=True):
        _row(table, name, "  ".join(f"{value:.6g}" for value in values))
    for path in files:
        _row(table, "written", f"{path} ({_size(path.stat().st_size)})")
    return table


def _table(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=Text(title), title_justify="left")
    for column in columns:
        table.add_column(Text(column), overflow="fold")
    return table


def _facts(title: str) -> Table:
    """A table of two columns, names and values."""
    table = Table(title=Text(title), title_justify="left", show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    return table


def _row(table: Table, *cells: str, style: str = "") -> None:
    # As Text: rich takes what stands in brackets for markup, and units stand in brackets.
    table.add_row(*(Text(cell) for cell in cells), style=style)


def _size(size: int) -> str:
    if size < 1000:
        return f"{size} B"
    return f"{size / 1e3:.1f} kB" if size < 1e6 else f"{size / 1e6:.1f} MB"


def _inspect_scene(request: argparse.Namespace) -> int:
    file = _scene_file(request, request.robot, "inspect", "lock", "package_dir", "gravity", "q", "v")
    spec, required = file.spec, file.required
    table = _facts(f"{spec.title} ({spec.path.name})")
    _row(table, "robot", f"{file.robot.name}, {len(required.joints)} of {required.described} joints computed")
    _row(table, "computed", ", ".join(required.joints))
    for title, joints in (("locked", required.locked), ("left out: nothing touches", required.idle)):
        if joints:
            _row(table, title, ", ".join(f"{joint} at {at}" for joint, at in joints.items()), style="dim")
    if len(required.parts) > 1:
        _row(table, "planned apart", "; ".join(", ".join(part) for part in required.parts))
    if required.coupled:
        _row(table, "planned together", required.coupled)
    for name, words in required.terms.items():
        _row(table, name, words, style="dim" if words == "none" or name == "not modelled" else "")
    _row(table, "horizon", f"{spec.steps} steps of {spec.dt:g} s, {spec.integrator}")
    _row(table, "saved", f"{100 * required.saved:.0f}% of the linear algebra of a plan, by counting")
    console = Console() if sys.stdout.isatty() else Console(width=_WIDTH)
    console.print(table)
    return 0


def _inspect(request: argparse.Namespace, _errors: Console) -> int:
    if _names_scene(request.robot):
        return _inspect_scene(request)
    arguments = {"package_dirs": request.package_dir, "lock": dict(request.lock), "gravity": request.gravity}
    report = inspect_robot(request.robot, q=_one_or_all(request.q), v=_one_or_all(request.v), **arguments)
    console = Console() if sys.stdout.isatty() else Console(width=_WIDTH)
    console.print(_joint_table(report))
    console.print(_link_table(report))
    console.print(_report_table(report))
    for warning in report.warnings:
        _say(console, warning, prefix="warning", style="yellow")
    if not report.warnings:
        _say(console, "nothing looks wrong", prefix="")
    return 0


def _tradeoff(request: argparse.Namespace, errors: Console) -> int:
    from varpin.tradeoff_report import COLUMNS, cells, write_report  # noqa: PLC0415 - matplotlib is slow to import

    folder = None if request.out is None else _folder(request.out)
    scene, q0, v0, torque = _motion(request)
    with _progress(errors, 1, quiet=request.quiet, unit="runs") as progress:
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
    console = Console() if sys.stdout.isatty() else Console(width=_WIDTH)
    if not request.quiet:
        table, front = _table(title, COLUMNS), record.pareto()
        for run in record.runs:
            _row(table, *cells(record, run, run in front), style="bold" if run in front else "")
        console.print(table)
        _say(console, f"errors are against {record.reference}, good to {record.reference_error:.1e}", prefix="")
        for path in files:
            _say(console, str(path), prefix="written")
    return INTERRUPTED if record.missing else 0


def _folder(path: Path) -> Path:
    """``path`` as a folder, made if need be."""
    folder = path.expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"cannot make the folder {folder}: {error.strerror or error}") from None
    return folder


def _advise(request: argparse.Namespace, _errors: Console) -> int:
    from varpin.tradeoff_report import ADVICE_COLUMNS, advice_cells, write_advice  # noqa: PLC0415 - as above

    folder = None if request.out is None else _folder(request.out)
    scene, q0, v0, torque = _motion(request)
    advice = advise(
        scene,
        q0,
        v0,
        controls=torque,
        duration=request.duration,
        tolerance=request.tolerance,
        budget=request.budget,
    )
    console = Console() if sys.stdout.isatty() else Console(width=_WIDTH)
    for line in advice.reason.splitlines():
        _say(console, line, prefix="")
    table = _table("The best of each method", ADVICE_COLUMNS)
    for choice in (advice.best, *advice.alternatives):
        _row(table, *advice_cells(choice))
    console.print(table)
    _say(console, f"(found in {advice.calibration:.2g} s)", prefix="")
    if folder is not None:
        wish = f"{advice.tolerance:g} in q" if advice.tolerance is not None else f"{advice.budget:g} s"
        title = f"{scene.robot.name}: an integrator for {request.duration:g} s and {wish}"
        for path in write_advice(folder, advice, title):
            _say(console, str(path), prefix="written")
    return 0 if advice.reached else STEP_FAILED


def _paper(request: argparse.Namespace, errors: Console) -> int:
    from varpin.paper import reproduce  # noqa: PLC0415  (its figures need matplotlib, which takes long to import)

    with _progress(errors, 1, quiet=request.quiet, unit="cells") as report:
        result = reproduce(request.out, quick=request.quick, progress=lambda done, cells, _: report(done, cells))
    console = Console() if sys.stdout.isatty() else Console(width=_WIDTH)
    if not request.quiet:
        table = _table("Claims", ("verdict", "sentence", "measured"))
        for claim in result.claims:
            _row(table, claim.verdict, claim.sentence, claim.measured)
        console.print(table)
    _say(console, str(result.page), prefix="")
    return 0


def _robots(_request: argparse.Namespace, _errors: Console) -> int:
    table = _table("Robots", ("name", "joints"))
    for name in robot_names():
        _row(table, name, str(build_robot(name).dof))
    console = Console() if sys.stdout.isatty() else Console(width=_WIDTH)
    console.print(table)
    _say(console, "joints without those that mimic others; --lock holds some still", prefix="")
    return 0


def _extremes(request: argparse.Namespace, errors: Console) -> int:
    from varpin import extremes_report as report  # noqa: PLC0415 - most commands have no use for it
    from varpin.extremes import Kind, run  # noqa: PLC0415

    robot = None
    if request.robot is not None:
        robot = load_robot(request.robot, package_dirs=request.package_dir, lock=dict(request.lock))
    folder = None if request.out is None else _folder(request.out)
    with _progress(errors, 1, quiet=request.quiet, unit="cells") as progress:
        record = run(
            robot,
            deep=request.deep,
            save=None if folder is None else folder / "extremes.json",
            progress=lambda done, cells, _: progress(done, cells),
        )
    files = [] if folder is None else [folder / "extremes.json", report.write_page(folder / "extremes.html", record)]
    console = Console() if sys.stdout.isatty() else Console(width=_WIDTH)
    columns, rows = report.grid(record)
    if not request.quiet:
        table = _table(f"{record.robot} at the extremes", ("scene", *columns))
        last = ""
        for family, trial, cells in rows:
            if family != last:
                _row(table, family, style="bold")
                last = family
            entries = (cells.get(name) for name in columns)
            table.add_row(Text(f"  {trial}"), *(_extreme(cell) for cell in entries))
        console.print(table)
        for kind, count in record.counts().items():
            _say(console, f"{count} {kind.value}", prefix=report.LETTERS[kind])
        for path in files:
            _say(console, str(path), prefix="written")
    for cell in record.wrong():
        _say(console, f"{cell.trial}, {cell.integrator}: {'; '.join(cell.found)}", prefix=Kind.WRONG.value, style="red")
    if record.missing:
        return INTERRUPTED
    return FAULTY if record.wrong() else 0


def _extreme(cell: Cell | None) -> Text:
    from varpin.extremes_report import STYLES, entry  # noqa: PLC0415

    return Text("") if cell is None else Text(entry(cell), style=STYLES[cell.kind])


def _one_or_all(numbers: Sequence[float] | None) -> ArrayLike | None:
    return numbers[0] if numbers is not None and len(numbers) == 1 else numbers


def _joint_table(report: RobotReport) -> Table:
    columns = "#", "joint", "kind", "axis", "position", "velocity", "effort"
    table = _table(f"{report.robot.name}: joints", columns)
    number = iter(range(len(report.joints)))
    for joint in report.joints:
        slides = joint.unit == "m"
        kind = joint.kind if joint.kind != "mimic" else f"mimic: {joint.follows}"
        _row(
            table,
            "" if joint.kind == "mimic" else str(next(number)),
            joint.name,
            kind,
            _axis(joint),
            "free" if joint.kind == "continuous" else f"{joint.lower:g} .. {joint.upper:g} {joint.unit}",
            _bound(joint.velocity, "m/s" if slides else "rad/s"),
            _bound(joint.effort, "N" if slides else "N m"),
        )
    for name, at in report.locked.items():
        _row(table, "", name, f"locked at {at}", "", "", "", "", style="dim")
    return table


def _axis(joint: JointReport) -> str:
    for letter, component in zip("xyz", joint.axis, strict=True):
        if abs(abs(component) - 1.0) < 1e-9:
            return f"{'+' if component > 0.0 else '-'}{letter}"
    return "(" + ", ".join(f"{component:.3g}" for component in joint.axis) + ")"


def _bound(value: float, unit: str) -> str:
    return "none" if math.isinf(value) else f"{value:g} {unit}"


def _link_table(report: RobotReport) -> Table:
    columns = "link", "moved by", "mass [kg]", "centre of mass [m]", "principal moments [kg m^2]"
    table = _table(f"{report.robot.name}: links", columns)
    for link in report.links:
        _row(
            table,
            link.name,
            link.joint or "the base",
            f"{link.mass:.4g}",
            "  ".join(f"{x:.3g}" for x in link.center),
            "  ".join(f"{x:.3g}" for x in link.moments),
            style="" if link.joint else "dim",
        )
    return table


def _report_table(report: RobotReport) -> Table:
    table = _facts(f"{report.robot.name}: as a whole")
    _row(table, "degrees of freedom", str(report.robot.dof))
    _row(table, "mass of what moves", f"{report.total_mass:.5g} kg")
    _row(table, "at q [rad or m]", "  ".join(f"{x:g}" for x in report.q))
    _row(table, "condition of M(q)", f"{report.condition:.3g}; {report.scaled_condition:.3g} with a unit diagonal")
    step = "undefined: the mass matrix is singular"
    if report.largest_step is not None:
        # A description's own rounding, a frame turned by 1.5708, makes directions unstable that are not.
        step = "any: nothing is unstable" if report.largest_step > _ANY_STEP else f"{report.largest_step:.3g} s"
        step += f" at this q, {'at rest' if not report.v.any() else 'and this v'}"
    _row(table, "largest step accepted", f"{step} (branch margin {report.branch_margin:g}; says nothing of accuracy)")
    return table


class _Bar:
    """A progress callback that draws a bar on a terminal and writes a line now and then elsewhere."""

    PATIENCE = 10.0  # [s] between lines

    def __init__(self, console: Console, steps: int, unit: str) -> None:
        self._console = console
        self._unit = unit
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._said = time.monotonic()
        if console.is_terminal:
            columns = (TextColumn("varpin"), BarColumn(), TextColumn(f"{{task.completed}}/{{task.total}} {unit}"))
            self._bar = Progress(*columns, TimeRemainingColumn(), console=console, transient=True)
            self._task = self._bar.add_task("", total=steps)

    def __enter__(self) -> _Bar:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, done: int, steps: int) -> None:
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, total=steps)
        elif time.monotonic() - self._said >= self.PATIENCE:
            self._said = time.monotonic()
            _say(self._console, f"{done} of {steps} {self._unit}")


@contextlib.contextmanager
def _progress(
    console: Console, steps: int, *, quiet: bool, unit: str = "steps"
) -> Iterator[Callable[[int, int], None]]:
    if quiet:
        yield lambda _done, _steps: None
        return
    with _Bar(console, steps, unit) as bar:
        yield bar


class _ConsoleHandler(logging.Handler):
    """Log records as one readable line each, above a progress bar if there is one."""

    def __init__(self, console: Console, level: int) -> None:
        super().__init__(level)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        _say(self._console, record.getMessage(), prefix=f"varpin: {record.levelname.lower()}", style="yellow")


@contextlib.contextmanager
def _logged(console: Console, level: int) -> Iterator[None]:
    """The library's log from ``level`` on, on ``console`` within this context."""
    logger, handler = logging.getLogger("varpin"), _ConsoleHandler(console, level)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _complain(console: Console, error: object) -> None:
    # NumPy breaks the lines of long arrays, and an error is one line.
    _say(console, " ".join(str(error).split()), prefix="varpin: error", style="red")


def _say(console: Console, message: str, *, prefix: str = "varpin", style: str | None = None) -> None:
    text = f"{prefix}: {message}" if prefix else message
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)
