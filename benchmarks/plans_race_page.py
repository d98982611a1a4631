"""The summary and the figure of docs/crocoddyl.md from what plans_race.py measured.

python benchmarks/plans_race_page.py race.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pages import fill

DOCS = Path(__file__).resolve().parents[1] / "docs"
WITHIN = 0.01
WAYS = {"feedback": "with feedback", "alone": "by the controls alone"}
SCHEMES = {"Euler": ("#d55e00", "^"), "RK2": ("#cc79a7", "v"), "RK4": ("#e69f00", "s")}

SHAPES = {"held": ("#56b4e9", "x"), "linear": ("#009e73", "+")}

Results = dict[str, dict[str, Any]]


def ratio(task: dict[str, Any], way: str) -> float:
    """varpin's time over crocoddyl's; zero where only varpin has a plan, infinite where only crocoddyl has one."""
    own, other = (task["best"][side].get(way) for side in ("varpin", "crocoddyl"))
    if own is None:
        return np.nan if other is None else np.inf
    return 0.0 if other is None else own["seconds"] / other["seconds"]


def summary(results: Results) -> str:
    lines = [f"Of {len(results)} tasks:", ""]
    for way, words in WAYS.items():
        found = np.array([ratio(task, way) for task in results.values()])
        found = found[~np.isnan(found)]
        lines.append(
            f"- {words}: varpin takes less time in {np.sum(found < 1.0)} of {len(found)} tasks, a third or less in "
            f"{np.sum(found <= 1 / 3)}; the median ratio is {np.median(found):.2f}, and crocoddyl has no such plan in "
            f"{np.sum(found == 0.0)}."
        )
    plans = [side["alone"] for task in results.values() for side in task["best"].values() if "alone" in side]
    off = [abs(best["scipy"]) for best in plans if best["scipy"] is not None]
    lines.append(
        f"- SciPy's DOP853 on `pin.aba` agrees on the costs of the controls alone of {len(off)} of these plans, those "
        f"of up to 200 nodes: to {np.median(off):.0e} (median), {max(off):.0e} at most."
    )
    return "\n".join(lines)


def draw(results: Results) -> Figure:
    """Each side's least times to a plan that is good with feedback."""
    figure = Figure(figsize=(9, 0.26 * len(results) + 1.2), layout="constrained")
    axes = figure.subplots()
    names = list(results)
    for row, name in enumerate(names):
        task = results[name]
        good = (1.0 + WITHIN) * task["optimum"]
        for scheme, (colour, marker) in SCHEMES.items():
            own = [run["seconds"] for run in task["runs"] if run["scheme"] == scheme and run["feedback"] <= good]
            if own:
                axes.plot(1e3 * min(own), row, marker, color=colour, ms=5, label=f"crocoddyl, {scheme}")
        best = task["best"]["varpin"].get("feedback")
        if best is not None:
            axes.plot(1e3 * best["seconds"], row, "o", color="#0072b2", ms=6, label="varpin, its best step")
        for shape, (colour, marker) in SHAPES.items():
            plain = task["plain"][shape]
            if plain["met"] and plain["loss"] <= WITHIN:
                label = f"varpin, true_cost=0.01, {shape}"
                axes.plot(1e3 * plain["seconds"], row, marker, color=colour, label=label)
    axes.set(xscale="log", xlabel="processor time to a plan that loses less than 1 % with feedback [ms]")
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.invert_yaxis()
    axes.grid(alpha=0.3)
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+", help="the results, of different tasks where they are several")
    results: Results = {}
    for file in parser.parse_args().files:
        found = json.loads(file.read_text(encoding="utf-8"))
        results |= {name: task for name, task in found.items() if "error" not in task}
        failed = [name for name, task in found.items() if "error" in task]
        if failed:
            print(f"{file} has no results of {', '.join(failed)}")
    FigureCanvasAgg(draw(results)).print_png(DOCS / "images" / "plans_race.png")
    fill(DOCS / "crocoddyl.md", {"race": summary(results)})
    print(summary(results))


if __name__ == "__main__":
    main()
