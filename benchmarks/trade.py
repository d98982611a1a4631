"""The trade of speed for accuracy, measured: the table and the figure of the page on measurements.

Three links of 1 m and 1 kg, and seven, fall from horizontal rest. Left: error in q after one second against the time
that one simulated second takes, for steps and tolerances of each method. Right: energy over 1000 s at one step, 1e-2 s.
The table: the least time at which any of varpin's integrators, and any of the others, is within an error.
SciPy's DOP853 runs on Pinocchio's forward dynamics; MuJoCo takes part where it is installed.

    python benchmarks/trade.py
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import peers
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pages import fill

import varpin as vp

ROOT = Path(__file__).resolve().parents[1]
CHAINS = (3, 7)
REPEATS = 25
WINDOWS = 200
LEVELS = 10.0 ** -np.arange(2, 12, 3)
STEPS = {
    vp.Midpoint(): (2e-2, 1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4),
    vp.RungeKutta4(): (2e-2, 1e-2, 5e-3, 2e-3, 1e-3, 5e-4),
    **{vp.Gauss(s): tuple(1.0 / n for n in (20, 25, 33, 40, 50, 66, 80, 100, 133, 200, 400)) for s in (2, 3, 4, 5)},
}


@dataclass(frozen=True)
class Point:
    """One run: a method at one setting, its error in q after 1 s [rad], and time a simulated second [us]."""

    method: str
    setting: str
    error: float
    microseconds: float


def timed(run: Callable[[], np.ndarray]) -> tuple[np.ndarray, float]:
    """Result and best time [us] of several runs, after one that does not count."""
    run()
    best = np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        result = run()
        best = min(best, time.perf_counter() - start)
    return result, 1e6 * best


def falling(links: int, duration: float = 1.0) -> peers.Case:
    """The chain, from horizontal rest."""
    rest = np.zeros(links)
    return peers.Case(f"chain of {links}", vp.Scene(vp.planar_chain(links)), rest, rest, rest, duration)


def work_precision(links: int) -> list[Point]:
    """All methods at all settings."""
    case = falling(links)
    peers.require_same(case)
    scene, rest = case.scene, case.q0
    exact = peers.scipy_run(case, 1e-13)()
    points = []

    def add(method: str, setting: str, run: Callable[[], np.ndarray]) -> None:
        q, cost = timed(run)
        points.append(Point(method, setting, np.abs(q - exact).max(), cost))

    for integrator, dts in STEPS.items():
        for dt in dts:
            steps = round(1.0 / dt)
            add(
                f"varpin {str(integrator).replace('(alpha=0.5)', '').replace('stages=', '')}",
                f"{1.0 / steps:.4g} s",
                # Nobody else looks at the finished motion either.
                lambda i=integrator, n=steps: vp.simulate(
                    scene, rest, rest, dt=1.0 / n, steps=n, integrator=i, check=False
                ).q[-1],
            )
    for rtol in 10.0 ** -np.arange(3, 13):
        add("SciPy DOP853 on pin.aba", f"rtol {rtol:.0e}", peers.scipy_run(case, rtol))
    for name in ("Euler", "RK4"):
        for dt in (2e-2, 1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4):
            run = peers.mujoco_run(case, dt, name)
            if run is not None:
                add(f"MuJoCo {name}", f"{dt:g} s", run)
    return points


def race(points: list[Point], level: float) -> tuple[Point | None, Point | None]:
    """The fastest of varpin and the fastest of the others within an error."""
    good = [p for p in points if p.error <= level]
    sides = ([p for p in good if p.method.startswith("varpin") == ours] for ours in (True, False))
    own, other = (min(side, key=lambda p: p.microseconds, default=None) for side in sides)
    return own, other


def long_run(links: int, dt: float = 1e-2, duration: float = 1000.0) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Energy errors over a long run at one step, in m g n^2 / 2, by method."""
    case, unit = falling(links, duration), 9.81 * links**2 / 2
    steps = round(duration / dt)
    motion = vp.simulate(case.scene, case.q0, case.v0, dt=dt, steps=steps, integrator=vp.Midpoint())
    curves = {"varpin Midpoint": (motion.t, (motion.energy - motion.energy[0]) / unit)}
    for name in ("Euler", "RK4"):
        energy = peers.mujoco_energies(case, dt, name)
        if energy is not None:
            curves[f"MuJoCo {name}"] = (motion.t, (energy - energy[0]) / unit)
    return curves


def draw(points: list[Point], curves: dict[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """The figure."""
    figure = Figure(figsize=(10, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    style = {
        "varpin Midpoint": ("#0072b2", "o"),
        "varpin Gauss(2)": ("#56b4e9", "D"),
        "varpin Gauss(4)": ("#000000", "P"),
        "varpin RungeKutta4": ("#e69f00", "x"),
        "SciPy DOP853 on pin.aba": ("#009e73", "s"),
        "MuJoCo Euler": ("#d55e00", "^"),
        "MuJoCo RK4": ("#cc79a7", "v"),
    }
    for method, (colour, marker) in style.items():
        own = [point for point in points if point.method == method]
        if own:
            left.loglog(
                [p.microseconds for p in own], [p.error for p in own], color=colour, marker=marker, label=method
            )
        if method in curves:
            t, error = curves[method]
            window = max(1, len(t) // WINDOWS)
            largest = np.abs(error[1 : 1 + len(error) // window * window]).reshape(-1, window).max(axis=1)
            right.semilogy(t[window::window][: len(largest)], largest, color=colour, label=method, linewidth=1.0)
    left.set(xlabel="time for one simulated second [us]", ylabel="error in q after 1 s [rad]", title="Short and exact")
    right.set(xlabel="t [s]", ylabel="largest |energy error| in 5 s [m g n²/2]", title="Long: energy at dt = 0.01 s")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def cell(point: Point | None) -> str:
    return "out of reach" if point is None else f"{point.microseconds:.0f} ({point.method}, {point.setting})"


def table(chains: dict[int, list[Point]], curves: dict[str, tuple[np.ndarray, np.ndarray]]) -> str:
    """The table."""
    lines = ["| links | error [rad] | varpin [us] | others [us] | ratio |", "|---|---|---|---|---|"]
    for links, points in chains.items():
        for level in LEVELS:
            own, other = race(points, level)
            ratio = "" if own is None or other is None else f"{own.microseconds / other.microseconds:.2f}"
            lines.append(f"| {links} | {level:.0e} | {cell(own)} | {cell(other)} | {ratio} |")
    lines += ["", "| 1000 s at 0.01 s | largest energy error [m g n^2 / 2] | at the end |", "|---|---|---|"]
    lines += [
        f"| {name} | {np.abs(error).max():.3g} | {error[-1]:+.3g} |"
        for name, (_, error) in sorted(curves.items(), reverse=True)
    ]
    return "\n".join(lines)


def main() -> None:
    logging.getLogger("varpin").setLevel(logging.ERROR)
    chains = {links: work_precision(links) for links in CHAINS}
    curves = long_run(CHAINS[0])
    text = table(chains, curves)
    print(text)
    FigureCanvasAgg(draw(chains[CHAINS[0]], curves)).print_png(ROOT / "docs" / "images" / "trade.png")
    fill(ROOT / "docs" / "how-integrators-were-measured.md", {"trade": text})


if __name__ == "__main__":
    main()
