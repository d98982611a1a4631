"""``varpin identify``: parameters of a robot from logs."""

from __future__ import annotations

import argparse
import logging
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

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
from varpin.model import load_robot

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

    urdf = "save", (".urdf",), lambda path, found: found.save_urdf(path)
    files = files_of(request, urdf, ("plot", PICTURES, partial(save_figure, "plot_identification")))
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
        show(found)
        for row in written:
            show("{}: {}".format(*row))
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
