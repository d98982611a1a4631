"""The claims and figures of docs/paper.md, from a folder of results.

python benchmarks/paper paper
python docs/paper.py paper
"""

import csv
import shutil
import sys
from pathlib import Path

DOCUMENT = Path(__file__).resolve().parent / "paper.md"
sys.path.insert(0, str(DOCUMENT.parents[1] / "benchmarks"))
from pages import fill  # noqa: E402

FIGURES = ("figure1", "figure2", "figure3", "figure4", "figure5", "truth", "noise")


def main() -> None:
    """Rewrite the table and copy the figures."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: paper.py FOLDER")
    folder = Path(sys.argv[1])
    for name in FIGURES:
        shutil.copy(folder / f"{name}.png", DOCUMENT.parent / "images" / f"paper_{name}.png")
    with (folder / "claims.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    table = ["| verdict | source | sentence |", "|---|---|---|"]
    table += [f"| {r['verdict']} | {r['source']} | {r['sentence']} |" for r in rows if r["source"].startswith("paper")]
    fill(DOCUMENT, {"claims": "\n".join(table)})


if __name__ == "__main__":
    main()
