"""The command line: ``python -m fuzz --help``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from fuzz.runner import KINDS, Report, run, work


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description="Damaged input for everything that reads files")
    parser.add_argument("--inputs", type=int, default=2000, help="in all, as many of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=KINDS, action="append", help="only this kind")
    parser.add_argument("--findings", type=Path, help="folder for inputs that are findings")
    parser.add_argument("--worker", choices=KINDS, help=argparse.SUPPRESS)
    parser.add_argument("--numbers", type=int, nargs=2, help="only inputs from one number to another")
    options = parser.parse_args()
    if options.worker:
        work(options.worker, options.seed, *options.numbers)
        return 0
    kinds = options.kind or list(KINDS)
    reports = []
    for kind in kinds:
        begin, end = options.numbers or (0, options.inputs // len(kinds))
        reports.append(run(kind, options.seed, begin, end, options.findings))
        print(f"== {kind}: {reports[-1]}", flush=True)  # noqa: T201
    print(f"== all: {sum(reports, Report())}")  # noqa: T201
    return 1 if any(report.findings for report in reports) else 0


if __name__ == "__main__":
    sys.exit(main())
