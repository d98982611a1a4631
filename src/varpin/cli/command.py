"""The parser and the entry point of the commands."""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Callable, Mapping, Sequence

from rich.console import Console

from varpin._version import __version__
from varpin.cli.console import Parser, complain, logged, say
from varpin.cli.exits import INTERRUPTED, MISTAKE
from varpin.cli.inspect import add_inspect, add_robots
from varpin.cli.interrupts import Interrupts
from varpin.cli.replay import add_replay
from varpin.cli.simulate import add_simulate
from varpin.cli.solve import add_solve
from varpin.cli.studies import add_advise, add_extremes, add_tradeoff
from varpin.errors import VarpinError

_EXAMPLES = """\
examples:
  varpin simulate finger --q0 0.5 0.3 0.2 --v0 0 0 1 --no-gravity --html finger.html
  varpin simulate panda --lock panda_finger_joint1=0.02 --q0 -0.5 --duration 5 --save fall.npz --plot fall.png
  varpin simulate arm.urdf --dt 5e-4 --steps 4000 --damping 0.1 --torque elbow=-2.5
  varpin robots
  varpin inspect ur5 --q 0 -1.2 1 0 0 0
  varpin solve finger_tracking --html finger.html --save plan.npz
  varpin replay plan.npz --robot finger_tracking
  varpin simulate scene.toml --plot motion.png
  varpin advise ur5 --tolerance 1e-6 --duration 1
  varpin tradeoff ur5 --duration 1 --out ur5-tradeoff
  varpin extremes finger --out finger-extremes
"""


def _parser() -> tuple[Parser, Mapping[str, Parser]]:
    """The parser, and the parsers of the commands by name."""
    parser = Parser(
        prog="varpin",
        description="Variational integrators on Pinocchio.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"varpin {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    add_simulate(commands.add_parser("simulate", help="integrate a robot in time", allow_abbrev=False))
    add_robots(commands.add_parser("robots", help="list the robots with names", allow_abbrev=False))
    add_solve(commands.add_parser("solve", help="plan the motion of a scene file", allow_abbrev=False))
    add_replay(commands.add_parser("replay", help="show a saved motion", allow_abbrev=False))
    add_inspect(commands.add_parser("inspect", help="report on a robot description", allow_abbrev=False))
    add_tradeoff(commands.add_parser("tradeoff", help="measure speed against accuracy", allow_abbrev=False))
    add_advise(commands.add_parser("advise", help="find the cheapest integrator and step", allow_abbrev=False))
    add_extremes(commands.add_parser("extremes", help="run every integrator where it is hard", allow_abbrev=False))
    for command in commands.choices.values():
        command.set_defaults(parser=command)
    return parser, commands.choices


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if left out, and return the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    request = _request(words)
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


def _request(words: Sequence[str]) -> argparse.Namespace:
    """Parse the command line; a mistake in it ends the process with status 2 and one line."""
    parser, commands = _parser()
    if not words:
        parser.error(f"a command is missing; commands: {', '.join(commands)}")
    command = words[0]
    if command in commands:
        # Checked before argparse, which would report missing arguments instead of misspelled ones.
        known = _options(commands[command])
        if wrong := [word for word in words[1:] if word.startswith("--") and word.partition("=")[0] not in known]:
            commands[command].error(_not_an_option(wrong, known))
    elif not command.startswith("-"):
        matches = difflib.get_close_matches(command, commands, n=1)
        hint = f"did you mean {matches[0]!r}? " if matches else ""
        parser.error(f"there is no command {command!r}; {hint}commands: {', '.join(commands)}")
    request, unknown = parser.parse_known_args([_shielded(word) for word in words])
    if unknown:
        request.parser.error(_not_an_option(unknown, _options(request.parser)))
    return request


def _options(parser: argparse.ArgumentParser) -> list[str]:
    return [name for action in parser._actions for name in action.option_strings]


def _shielded(word: str) -> str:
    """``word`` in a form that argparse takes for a number: it knows -1, but not -1e-3 or -inf."""
    try:
        float(word)
    except ValueError:
        return word
    return f" {word}" if word.startswith("-") else word


def _not_an_option(words: Sequence[str], known: Sequence[str]) -> str:
    """A message about unknown options, with similar ones."""
    message = f"unrecognized arguments: {' '.join(word.strip() for word in words)}"
    for word in words:
        name = word.partition("=")[0]
        if name.startswith("--") and (matches := difflib.get_close_matches(name, known, n=1)):
            message += f"; did you mean {matches[0]} for {name}?"
    return message
