"""``varpin identify``: parameters of a robot from logs."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from varpin.arrays import Floats
from varpin.cli.arguments import (
    add_gravity,
    add_integrator,
    add_losses,
    add_robot,
    integrator_of_words,
    names_scene,
    robot_options,
    scene_file,
    values_of,
)
from varpin.cli.console import INTERRUPTED, STEP_FAILED, progress_bar, say, show
from varpin.cli.outputs import PICTURES, add_files, files_of, save_figure, write_all
from varpin.mechanics.scene import Scene
from varpin.model import joint_unit, load_robot
from varpin.support.tables import Table

if TYPE_CHECKING:
    from varpin.estimation import Identification

# The default of varpin.identify; after so many of all searches the bar of the progress grows.
_EXPECTED = 100


def add_identify(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin identify``."""
    parser.description = (
        "Find parameters of a robot, such as dampers and a payload, from logs of its encoders and controls, with "
        "their standard deviations, and what the logs do not tell. Ctrl-C keeps the best values so far."
    )
    parser.set_defaults(run=_identify, log_level=logging.WARNING)
    add_robot(parser, scenes=True)
    text = "logs: CSV with columns t, q_<joint>, u_<joint> and, if there are any, v_<joint>, or npz"
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help=text)
    text = "what to find: damping, friction, armature, payload, inertia; or of one: damping:elbow, inertia:link"
    parser.add_argument("--parameters", nargs="+", required=True, metavar="NAME", help=text)
    parser.add_argument("--held-out", nargs="+", type=Path, default=[], metavar="LOG", help="logs to try the values on")
    noise = parser.add_argument_group("noise")
    text = "standard deviation of an encoder's error [rad or m]"
    noise.add_argument("--q-noise", nargs="+", required=True, metavar="X", help=text)
    text = "that of measured velocities [rad/s or m/s]; default: they are not used"
    noise.add_argument("--v-noise", nargs="+", metavar="X", help=text)
    for name, kind, letter, text in (
        ("delay", float, "S", "by how much the controls act later than the logs say [s]; default: it is found, too"),
        ("dt", float, "S", "time step [s]; default: the usual one of the logs"),
        ("horizon", float, "S", "length of the stretches that are simulated [s], inf for whole logs; default: 1"),
        ("evaluations", int, "N", f"most evaluations of each search; default: {_EXPECTED}"),
    ):
        parser.add_argument(f"--{name}", type=kind, metavar=letter, help=text)
    add_integrator(parser, default="Gauss(stages=2)")
    begin = parser.add_argument_group("begin")
    add_gravity(begin)
    add_losses(begin)
    add_files(parser, "URDF", "write the robot's URDF with the values", "draw measured positions, before and after")


def _identify(request: argparse.Namespace, errors: Console) -> int:
    from varpin.estimation import Log, identify  # noqa: PLC0415 - most commands do not need SciPy's optimizers

    files = files_of(
        request, ("save", (".urdf",), lambda path, found: found.save_urdf(path)), ("plot", PICTURES, _plot)
    )
    scene = _scene(request)
    logs, apart = ([Log.load(path) for path in paths] for paths in (request.logs, request.held_out))
    options: dict[str, Any] = {name: getattr(request, name) for name in ("delay", "dt", "horizon", "evaluations")}
    options |= {name: values_of(name.replace("_", "-"), getattr(request, name)) for name in ("q_noise", "v_noise")}
    options["integrator"] = integrator_of_words(request.integrator)
    options = {name: value for name, value in options.items() if value is not None}
    with request.interrupts.keeping():
        with progress_bar(errors, _EXPECTED, quiet=request.quiet, unit="evaluations") as progress:
            found = identify(
                scene,
                logs,
                request.parameters,
                **options,
                held_out=apart,
                callback=lambda done, _residual: progress(done, max(done, _EXPECTED)),
            )
        written, trouble = write_all(request, errors, files, found)
    if not request.quiet:
        show(_values(found))
        show(_residuals(found))
        show(_facts(found, written))
    if found.status == "converged":
        return trouble
    say(errors, f"the search has not converged: {found.status}", style="yellow")
    return INTERRUPTED if found.status == "interrupted" else STEP_FAILED


def _scene(request: argparse.Namespace) -> Scene:
    """The scene in which the search begins. The step of a scene file is that of its plan, so the logs' may differ."""
    if names_scene(request.robot):
        own = argparse.Namespace(**{**vars(request), "dt": None, "integrator": None})
        return scene_file(own, request.robot).scene
    robot = load_robot(request.robot, **robot_options(request))
    forces: dict[str, Any] = {name: values_of(name, getattr(request, name)) for name in ("damping", "friction")}
    return Scene(robot, gravity=request.gravity, **forces)


def _plot(path: Path, found: Identification) -> None:
    from varpin.show.plots import plot_identification  # noqa: PLC0415 - matplotlib is slow to import

    save_figure(path, plot_identification(found)[0])


def _values(found: Identification) -> Table:
    rows = [
        (name, f"{start:.5g}", f"{value:.5g}", f"{deviation:.2g}" if np.isfinite(deviation) else "not told", unit)
        for name, start, value, deviation, unit in zip(
            found.names, found.start, found.values, found.deviations, found.units, strict=True
        )
    ]
    return Table(found.scene.robot.name, ("parameter", "before", "value", "+-", "unit"), rows)


def _residuals(found: Identification) -> Table:
    """The root mean square of each joint's residuals."""
    robot = found.scene.robot
    before = [log.q - own for log, own in zip(found.logs, found.predicted_before, strict=True)]
    kinds = {"before": before, "after": found.residuals} | ({"held out": found.held_out} if found.held_out else {})
    units = [joint_unit(robot, c) for c in range(robot.dof)]
    rows = list(zip(robot.joint_names, *map(_rms, kinds.values()), units, strict=True))
    return Table("\nrms of the residuals", ("joint", *kinds, "unit"), rows)


def _rms(residuals: Sequence[Floats]) -> list[str]:
    """That of each joint where there are samples; a motion that failed has none."""
    if any(np.isnan(each).all() for each in residuals):
        return ["no motion"] * residuals[0].shape[1]
    return [f"{rms:.3g}" for rms in np.sqrt(np.nanmean(np.square(np.concatenate(residuals)), axis=0))]


def _facts(found: Identification, written: Sequence[tuple[str, Path]]) -> Table:
    spread = f" +- {1e3 * found.delay_deviation:.2g}" if found.delay_deviation else ", as given"
    rows: list[tuple[str, object]] = [
        ("status", found.status),
        ("delay of the controls", f"{1e3 * found.delay:.4g}{spread} ms"),
        *(("not told", sentence) for sentence in found.null_space),
        *(("warning", finding) for finding in found.warnings),
        *written,
    ]
    return Table("\nsearch", (), rows)
