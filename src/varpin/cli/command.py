"""The parser and the entry point of the commands."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

from rich.console import Console

from varpin._version import __version__
from varpin.cli.console import INTERRUPTED, MISTAKE, Parser, complain, logged, say
from varpin.cli.fits import add_identify
from varpin.cli.interrupts import Interrupts
from varpin.cli.runs import add_simulate, add_solve
from varpin.cli.studies import add_advise, add_extremes, add_tradeoff
from varpin.cli.views import add_inspect, add_replay, add_robots
from varpin.errors import VarpinError

_EXAMPLES = """\
examples:
  varpin simulate finger --q0 0.5 0.3 0.2 --v0 0 0 1 --no-gravity --html finger.html
  varpin simulate panda --lock panda_finger_joint1=0.02 --q0 -0.5 --duration 5 --save fall.npz --plot fall.png
  varpin robots
  varpin inspect ur5
  varpin solve finger_tracking --html finger.html --save plan.npz
  varpin replay plan.npz --robot finger_tracking
  varpin advise ur5 --tolerance 1e-6 --duration 1
  varpin extremes finger --save extremes.csv
  varpin identify ur5 log.csv --parameters damping payload --q-noise 2e-4 --save ur5-found.urdf
"""


def _parser() -> Parser:
    parser = Parser(
        prog="varpin",
        description="Variational integrators on Pinocchio.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"varpin {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, add, text in (
        ("simulate", add_simulate, "integrate a robot in time"),
        ("robots", add_robots, "list the robots with names"),
        ("solve", add_solve, "plan the motion of a scene file"),
        ("replay", add_replay, "show a saved motion"),
        ("inspect", add_inspect, "report on a robot description"),
        ("tradeoff", add_tradeoff, "measure speed against accuracy"),
        ("advise", add_advise, "find the cheapest integrator and step"),
        ("extremes", add_extremes, "run every integrator where it is hard"),
        ("identify", add_identify, "find parameters of a robot from logs"),
    ):
        add(commands.add_parser(name, help=text, allow_abbrev=False))
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if left out, and return the exit status."""
    request = _parser().parse_args(arguments)
    errors = Console(stderr=True)
    run: Callable[[argparse.Namespace, Console], int] = request.run
    try:
        with logged(errors, request.log_level), Interrupts(errors) as request.interrupts:
            return run(request, errors)
    except VarpinError as error:
        complain(errors, error)
        return MISTAKE
    except MemoryError as error:
        complain(errors, f"out of memory: {error}; take fewer steps" if str(error) else "out of memory")
        return MISTAKE
    except KeyboardInterrupt:
        say(errors, "interrupted")
        return INTERRUPTED
