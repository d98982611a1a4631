"""The measurements behind docs/how-integrators-were-measured.md: its tables and figures.

Short horizon, long horizon, optimal control, noise, stiffness and real arms, for varpin's integrators and, where they
are installed (``pip install "varpin[peers]"``), for MuJoCo, Drake and a DOP853 in C++; SciPy's DOP853 on Pinocchio's
forward dynamics always takes part. A time of varpin's is that of a plain ``simulate`` call, its look at the motion
included. Times are the best of several rounds in which the methods take turns, after a round that does not count.

    python docs/which_integrator.py                   # rewrites the page and its figures
    python docs/which_integrator.py --quick FOLDER    # shorter, into a folder: the page, its figures, and which.csv
    python docs/which_integrator.py --only real       # one section
"""

from __future__ import annotations

import argparse
import csv
import logging
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

import varpin as vp
from varpin import plots
from varpin.mechanics.wiener import coarsen

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent / "benchmarks"))
import peers  # noqa: E402
from pages import fill  # noqa: E402
from paper import cases  # noqa: E402

PAGE = "how-integrators-were-measured.md"
Run = Callable[[], np.ndarray]

# Blocks of a long run whose means tell the trend.
BLOCKS = 20
# Errors [rad] from which on a motion is another one.
LOST = 1.0

STYLES = {
    "Midpoint": ("#0072b2", "o", "-"),
    "Gauss(1)": ("#0072b2", ".", ":"),
    "Gauss(2)": ("#56b4e9", "D", "-"),
    "Gauss(3)": ("#004d80", "h", "-"),
    "Gauss(4)": ("#000000", "P", "-"),
    "Gauss(5)": ("#666666", "*", "-"),
    "Radau(2)": ("#d4a6c8", "X", "-"),
    "Radau(3)": ("#8c2d6b", "X", "-"),
    "ExplicitEuler": ("#f0c040", "<", "-"),
    "SemiImplicitEuler": ("#b8860b", ">", "-"),
    "RungeKutta4": ("#e69f00", "x", "-"),
    "MuJoCo Euler": ("#d55e00", "^", "--"),
    "MuJoCo implicitfast": ("#8b2500", "1", ":"),
    "MuJoCo RK4": ("#cc79a7", "v", "--"),
    "Drake RK3": ("#7b3294", "p", "--"),
    "DOP853 in C++": ("#00573d", "8", "--"),
    "SciPy DOP853": ("#009e73", "s", "--"),
    "SciPy Radau": ("#9bd3bf", "s", ":"),
    "trep midpoint": ("#999933", "d", "--"),
    "Midpoint, split kick": ("#009e73", "s", "--"),
    "Midpoint, held": ("#cc79a7", "v", "-"),
    "Euler-Maruyama": ("#d55e00", "^", "-"),
    "Gauss(2), split kick": ("#000000", "P", "--"),
}


@dataclass(frozen=True)
class Entry:
    """A method at one setting, and what a run of it gives: the last q (n,)."""

    method: str
    setting: str
    run: Run


@dataclass(frozen=True)
class Point:
    """A measured entry: error in q at the end [rad], time of one run [us]; NaN where it failed."""

    method: str
    setting: str
    error: float
    microseconds: float

    @property
    def ours(self) -> bool:
        """Whether the method is varpin's."""
        return not self.method.startswith(("MuJoCo", "Drake", "DOP853", "SciPy", "trep"))


@dataclass(frozen=True)
class Scale:
    """How much is measured.

    Attributes:
        rounds: Of a race.
        enough: Time [s] after which a setting has been run often enough.
        long: The long horizon [s].
        paths: Brownian paths.
        finest: The reference of a path takes 2**finest steps a second.
        control_steps: Time steps of plans [s].
        thin: One in so many settings of the short races is taken.
    """

    rounds: int
    enough: float
    long: float
    paths: int
    finest: int
    control_steps: tuple[float, ...]
    thin: int


FULL = Scale(7, 0.3, 1000.0, 2000, 12, (1e-3, 2e-3, 3e-3, 4e-3, 6e-3, 1e-2, 1.5e-2, 2e-2), 1)
QUICK = Scale(3, 0.3, 100.0, 60, 10, (4e-3, 1e-2, 2e-2), 2)


def race(entries: Sequence[Entry], exact: np.ndarray, scale: Scale) -> list[Point]:
    """Errors and best times; the methods take turns, and a first round does not count."""
    best, spent = np.full(len(entries), np.inf), np.zeros(len(entries))
    errors = np.full(len(entries), np.nan)
    for number, entry in enumerate(entries):
        try:
            q = entry.run()
        except (vp.VarpinError, peers.PeerBlewUp):
            spent[number] = np.inf
            continue
        errors[number] = np.abs(q - exact).max() if np.isfinite(q).all() else np.nan
    for _ in range(scale.rounds):
        for number, entry in enumerate(entries):
            if spent[number] < scale.enough:
                begin = time.perf_counter()
                entry.run()
                seconds = time.perf_counter() - begin
                best[number], spent[number] = min(best[number], seconds), spent[number] + seconds
    return [
        Point(entry.method, entry.setting, float(error), 1e6 * float(seconds))
        for entry, error, seconds in zip(entries, errors, best, strict=True)
    ]


def name_of(integrator: vp.Integrator) -> str:
    """An integrator's name in tables and figures."""
    return str(integrator).replace("(alpha=0.5)", "").replace("stages=", "")


def varpin_run(case: peers.Case, integrator: vp.Integrator, steps: int) -> Run:
    """A run of varpin's that gives the last q."""
    scene, q0, v0, u, dt = case.scene, case.q0, case.v0, case.u, case.duration / steps

    def run() -> np.ndarray:
        return vp.simulate(scene, q0, v0, dt=dt, steps=steps, controls=u, integrator=integrator).q[-1]

    return run


# Short horizon ------------------------------------------------------------------------------------------------------

LEVELS = (1e-3, 1e-6, 1e-10)
STEPS: dict[vp.Integrator, tuple[float, ...]] = {
    vp.ExplicitEuler(): (1e-2, 3e-3, 1e-3, 3e-4, 1e-4),
    vp.SemiImplicitEuler(): (1e-2, 3e-3, 1e-3, 3e-4, 1e-4),
    vp.RungeKutta4(): (4e-2, 2e-2, 1e-2, 5e-3, 2e-3, 1e-3, 5e-4),
    vp.Midpoint(): (4e-2, 2e-2, 1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4),
    vp.Gauss(1): (2e-2, 1e-2, 2e-3, 5e-4),
    **{vp.Gauss(s): tuple(1.0 / k for k in (12, 20, 25, 33, 40, 50, 66, 100, 200, 400)) for s in (2, 3, 4, 5)},
}


def short_cases() -> list[peers.Case]:
    """The falling chains, and two arms: under torques and friction, and falling with friction."""
    own = []
    for links in (3, 7):
        rest = np.zeros(links)
        own.append(peers.Case(f"chain of {links}", vp.Scene(vp.planar_chain(links)), rest, rest, rest))
    q0 = np.array([0.3, -1.2, 1.4, -0.5, 0.8, 0.1])
    arm = vp.Scene(vp.load_robot("ur5"), damping=[4.0, 4.0, 2.0, 0.3, 0.2, 0.05])
    torque = np.array([10.0, -30.0, -8.0, 0.5, 0.3, 0.1])
    own.append(peers.Case("ur5, torques and friction", arm, q0, np.zeros(6), torque))
    light = vp.Scene(vp.load_robot("ur10"), damping=[4.0, 4.0, 2.0, 0.5, 0.5, 0.2])
    start = np.array([0.2, 1.0, -1.2, 0.4, 0.3, 0.1])
    return [*own, peers.Case("ur10, friction", light, start, np.zeros(6), np.zeros(6))]


def short_entries(case: peers.Case, scale: Scale) -> list[Entry]:
    """All methods at all settings."""
    entries = []
    for integrator, dts in STEPS.items():
        for dt in dts[:: scale.thin]:
            steps = round(case.duration / dt)
            entries.append(
                Entry(name_of(integrator), f"{case.duration / steps:.3g} s", varpin_run(case, integrator, steps))
            )
    for scheme in ("Euler", "implicitfast", "RK4"):
        for dt in (2e-2, 1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5)[:: scale.thin]:
            run = peers.mujoco_run(case, dt, scheme)
            entries += [] if run is None else [Entry(f"MuJoCo {scheme}", f"{dt:g} s", run)]
    for accuracy in (10.0 ** -np.arange(2.0, 9.0))[:: scale.thin]:
        run = peers.drake_run(case, accuracy)
        entries += [] if run is None else [Entry("Drake RK3", f"accuracy {accuracy:.0e}", run)]
    if case.name.startswith("chain"):
        for dt in (2e-2, 1e-2, 5e-3, 2e-3)[:: scale.thin]:
            run = peers.trep_run(case, dt)
            entries += [] if run is None else [Entry("trep midpoint", f"{dt:g} s", run)]
    for rtol in (10.0 ** -np.arange(3.0, 13.0))[:: scale.thin]:
        compiled = peers.compiled_run(case, rtol)
        entries += [] if compiled is None else [Entry("DOP853 in C++", f"rtol {rtol:.0e}", compiled)]
        entries.append(Entry("SciPy DOP853", f"rtol {rtol:.0e}", peers.scipy_run(case, rtol)))
    return entries


def best_of(points: Sequence[Point], motion: str, levels: Iterable[float], names: Sequence[str]) -> list[str]:
    """Rows of a table: for each error varpin's best setting and time, and the best times of peers; the least bold."""
    lines = []
    for level in levels:
        good = [p for p in points if p.error <= level]
        sides = [[p for p in good if p.ours]] + [[p for p in good if p.method.startswith(name)] for name in names]
        best = [min(side, key=lambda p: p.microseconds, default=None) for side in sides]
        fastest = min((p.microseconds for p in best if p is not None), default=0.0)
        cells = ["-" if best[0] is None else f"{best[0].method}, {best[0].setting}"]
        for p in best:
            text = "-" if p is None else f"{p.microseconds:.0f}"
            cells.append(f"**{text}**" if p is not None and p.microseconds == fastest else text)
        lines.append(f"| {motion} | {level:.0e} | {' | '.join(cells)} |")
    return lines


def draw_race(axes: Axes, points: Sequence[Point], handles: dict[str, object]) -> None:
    """Error over time of every method."""
    for method, (colour, marker, stroke) in STYLES.items():
        own = [p for p in points if p.method == method and p.error < LOST]
        if own:
            (handles[method],) = axes.loglog(
                [p.microseconds for p in own],
                [p.error for p in own],
                color=colour, marker=marker, linestyle=stroke, markersize=5, linewidth=1.1,
            )  # fmt: skip
    plots.apply_style(axes)


def short(scale: Scale) -> tuple[str, Figure, list[tuple[str, Point]]]:
    """The race over one second."""
    figure = Figure(figsize=(15, 4.9), layout="constrained")
    panels = figure.subplots(1, 4, sharey=True)
    lines = [
        "| motion | error [rad] | varpin | varpin [us] | MuJoCo [us] | DOP853 in C++ [us] | Drake [us] | SciPy [us] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    rows = []
    handles: dict[str, object] = {}
    for case, axes in zip(short_cases(), panels, strict=True):
        exact = vp.simulate(
            case.scene,
            case.q0,
            case.v0,
            dt=case.duration,
            steps=1,
            controls=case.u,
            integrator=vp.Reference(rtol=1e-13),
        ).q[-1]
        points = race(short_entries(case, scale), exact, scale)
        rows += [(case.name, point) for point in points]
        lines += best_of(points, case.name, LEVELS, ("MuJoCo", "DOP853", "Drake", "SciPy"))
        draw_race(axes, points, handles)
        axes.set(title=case.name, xlabel="time for one second [us]", ylim=(1e-13, LOST))
    panels[0].set_ylabel("error in q after 1 s [rad]")
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=7, fontsize=8, frameon=False)
    return "\n".join(lines + against_trep(rows)), figure, rows


def against_trep(rows: list[tuple[str, Point]]) -> list[str]:
    """A table of trep's midpoint integrator against the fastest of varpin that is as exact; nothing without trep."""
    heading = "| motion | error [rad] | trep midpoint [us] | varpin [us] | varpin / trep |"
    lines = ["", heading, "|---|---|---|---|---|"]
    theirs = [(motion, point) for motion, point in rows if point.method == "trep midpoint"]
    for motion, point in theirs:
        good = [p for name, p in rows if name == motion and p.ours and p.error <= point.error]
        if good:
            own = min(good, key=lambda p: p.microseconds)
            cells = (
                motion,
                f"{point.error:.1e}",
                f"{point.microseconds:.0f} ({point.setting})",
                f"{own.microseconds:.0f} ({own.method}, {own.setting})",
                f"{own.microseconds / point.microseconds:.3f}",
            )
            lines.append(f"| {' | '.join(cells)} |")
    return lines if theirs else []


# Long horizon -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Energy:
    """Energy errors of a long run, in m g n^2 / 2.

    Attributes:
        method: With its step.
        t: (K,) [s].
        error: (K,).
        seconds: Wall time [s].
        split: Part of the steps that a guard took in parts.
    """

    method: str
    t: np.ndarray
    error: np.ndarray
    seconds: float
    split: float = 0.0

    @property
    def rms(self) -> float:
        """Its root mean square."""
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def trend(self) -> tuple[float, float]:
        """Least squares slope over means of blocks, and its standard error, for the whole duration."""
        length = (len(self.error) - 1) // BLOCKS
        means = self.error[1 : 1 + BLOCKS * length].reshape(BLOCKS, length).mean(axis=1)
        x = (np.arange(BLOCKS) + 0.5) / BLOCKS - 0.5
        slope = float(x @ means / (x @ x))
        rest = means - means.mean() - slope * x
        return slope, float(np.sqrt(rest @ rest / (BLOCKS - 2) / (x @ x)))


def long_runs(scale: Scale) -> list[Energy]:
    """The chain of three from horizontal rest; times are the better of two, in turns."""
    rest, unit = np.zeros(3), 9.81 * 9 / 2
    case = peers.Case("chain of 3", vp.Scene(vp.planar_chain(3)), rest, rest, rest, scale.long)
    peers.require_same(case)
    own = (
        (vp.Midpoint(), 1e-2), (vp.Gauss(2), 2e-2), (vp.Gauss(2), 1e-2), (vp.Gauss(4), 4e-2), (vp.RungeKutta4(), 1e-2),
        (vp.RungeKutta4(), 5e-3), (vp.SemiImplicitEuler(), 1e-2),
    )  # fmt: skip
    # Each gives energies, the part of steps split, and its time, or None where all of it counts.
    jobs: dict[str, Callable[[], tuple[np.ndarray | None, float, float | None]]] = {}
    for integrator, dt in own:
        jobs[f"{name_of(integrator)}, {dt:g} s"] = lambda i=integrator, dt=dt: _own_energy(case, i, dt)
    for scheme, dt in (("Euler", 1e-2), ("implicitfast", 1e-2), ("RK4", 1e-2), ("RK4", 5e-3)):
        jobs[f"MuJoCo {scheme}, {dt:g} s"] = lambda s=scheme, dt=dt: _mujoco_energy(case, s, dt)
    for accuracy in (1e-3, 1e-5):
        jobs[f"Drake RK3, accuracy {accuracy:.0e}"] = lambda a=accuracy: (
            peers.drake_energies(case, a, 0.1),
            0.0,
            None,
        )
    done: dict[str, Energy] = {}
    for _ in range(2):
        for name, job in jobs.items():
            before = done[name].seconds if name in done else np.inf
            if np.isfinite(before) and before > 10.0:
                continue
            begin = time.perf_counter()
            energy, split, own_time = job()
            seconds = min(before, time.perf_counter() - begin if own_time is None else own_time)
            if energy is not None:
                t = np.linspace(0.0, case.duration, len(energy))
                done[name] = Energy(name, t, (energy - energy[0]) / unit, seconds, split)
    return list(done.values())


def _own_energy(case: peers.Case, integrator: vp.Integrator, dt: float) -> tuple[np.ndarray, float, None]:
    motion = vp.simulate(case.scene, case.q0, case.v0, dt=dt, steps=round(case.duration / dt), integrator=integrator)
    return motion.energy, motion.statistics.split_steps / motion.steps, None


def _mujoco_energy(case: peers.Case, scheme: str, dt: float) -> tuple[np.ndarray | None, float, float]:
    """Energies by one run, and the time of another that does not ask for them."""
    run = peers.mujoco_run(case, dt, scheme)
    begin = time.perf_counter()
    if run is not None:
        run()
    seconds = time.perf_counter() - begin
    return peers.mujoco_energies(case, dt, scheme), 0.0, seconds


def long(scale: Scale) -> tuple[str, Figure]:
    """Energy over the long run."""
    runs = long_runs(scale)
    lines = [
        f"| {scale.long:g} s of a chain of 3 | time [s] | rms | trend over the run | split steps |",
        "|---|---|---|---|---|",
    ]
    for run in runs:
        slope, uncertainty = run.trend
        trend = f"{slope:+.1e} ± {uncertainty:.0e}"
        lines.append(f"| {run.method} | {run.seconds:.2f} | {run.rms:.1e} | {trend} | {100 * run.split:.2g} % |")
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    axes = figure.subplots()
    for run in runs:
        method = run.method.split(",")[0]
        colour, _, stroke = STYLES[method]
        window = max(1, (len(run.error) - 1) // 100)
        blocks = run.error[1 : 1 + (len(run.error) - 1) // window * window].reshape(-1, window)
        at = (np.arange(len(blocks)) + 0.5) * window * (run.t[1] - run.t[0])
        first = not any(line.get_color() == colour for line in axes.get_lines())
        axes.semilogy(
            at, np.sqrt((blocks**2).mean(axis=1)), color=colour, linestyle=stroke, label=run.method,
            linewidth=1.4, alpha=1.0 if first else 0.55,
        )  # fmt: skip
    axes.set(xlabel="t [s]", ylabel=f"energy error, rms over {scale.long / 100:g} s [m g n²/2]")
    plots.apply_style(axes)
    figure.legend(loc="outside right center", fontsize=8, frameon=False)
    return "\n".join(lines), figure


# Optimal control ----------------------------------------------------------------------------------------------------


PLAN_STARTS = ("on the reference", "off it")
# The two true costs.
PLAN_MARKS: dict[str, dict[str, Any]] = {
    "open loop": {"marker": "o", "markersize": 4, "linestyle": "none"},
    "with feedback": {"marker": "s", "markersize": 9, "linestyle": "none", "markerfacecolor": "none"},
}


def control(scale: Scale) -> tuple[None, Figure]:
    """True cost of the finger's plans against solve time."""
    # Off the reference most solve times are those of searches that do not converge: once is enough.
    settings = ((cases.MAIN, 3, 0.0), (cases.VARIATIONS[0], 1, 2e-3))
    members: tuple[tuple[str, Sequence[vp.Integrator]], ...] = (
        ("variational", (vp.ExplicitEuler(), vp.Midpoint())),
        # Running costs at the Gauss points: of fourth order, for who is.
        (cases.FOURTH_ORDER, (vp.RungeKutta4(), vp.Gauss(2))),
    )
    runs: dict[str, list[vp.OptimalControlRun]] = {}
    for start, (setting, repeats, least_step) in zip(PLAN_STARTS, settings, strict=True):
        runs[start] = []
        for method, integrators in members:
            problem = cases.problem(setting, None, method, scale.control_steps[0])
            dts = [dt for dt in scale.control_steps if _divides(dt, cases.DURATION) and dt >= least_step]
            runs[start] += vp.optimal_control_tradeoff(problem, integrators, dts, repeats=repeats).runs
    return None, plans_figure(runs)


def plans_figure(runs: dict[str, list[vp.OptimalControlRun]]) -> Figure:
    """A panel for each method and start."""
    names = list(dict.fromkeys(name_of_text(run.integrator) for own in runs.values() for run in own))
    figure = Figure(figsize=(11, 6), layout="constrained")
    panels = figure.subplots(len(runs), len(names), sharex="row", sharey="row", squeeze=False)
    for (start, own), line_of_panels in zip(runs.items(), panels, strict=True):
        for name, axes in zip(names, line_of_panels, strict=True):
            # No lines: a finer step is not always a slower solve.
            shown = [run for run in own if name_of_text(run.integrator) == name]
            for label, style in PLAN_MARKS.items():
                costs = [run.open_loop_cost if label == "open loop" else run.closed_loop_cost for run in shown]
                points = [(1e3 * run.seconds, y) for run, y in zip(shown, costs, strict=True) if np.isfinite(y)]
                axes.loglog(
                    [x for x, _ in points], [y for _, y in points], color=STYLES[name][0], label=label, **style
                )  # fmt: skip
            axes.set(title=f"{name}, {start}")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0), numticks=8))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
            plots.apply_style(axes)
        line_of_panels[0].set_ylabel("true cost")
    for axes in panels[-1]:
        axes.set_xlabel("solve time [ms]")
    handles = [Line2D([], [], color="black", **style) for style in PLAN_MARKS.values()]
    figure.legend(handles, list(PLAN_MARKS), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return figure


def _divides(dt: float, duration: float) -> bool:
    return abs(duration / dt - round(duration / dt)) < 1e-9 * duration / dt


def name_of_text(text: str) -> str:
    """As :func:`name_of`, of an integrator as text."""
    return text.replace("(alpha=0.5)", "").replace("stages=", "")


# Noise --------------------------------------------------------------------------------------------------------------

NOISY: dict[str, vp.Integrator] = {
    "Euler-Maruyama": vp.ExplicitEuler(),
    "Midpoint": vp.Midpoint(),
    "Midpoint, split kick": vp.Midpoint(kick="split"),
    "Midpoint, held": vp.Midpoint(kick="held"),
    "Gauss(2), split kick": vp.Gauss(2, kick="split"),
}


def noise(scale: Scale) -> tuple[None, Figure]:
    """Strong and weak errors on the same Brownian paths."""
    scene = vp.Scene(vp.planar_chain(2), damping=0.3, noise=vp.AdditiveNoise(0.5))
    rest = np.zeros(2)
    fine = 2**scale.finest
    exponents = range(4, scale.finest - 2)
    ends = {(name, k): np.empty((scale.paths, 2)) for name in NOISY for k in exponents}
    exact = np.empty((scale.paths, 2))

    def end(integrator: vp.Integrator, increments: np.ndarray) -> np.ndarray:
        steps = len(increments)
        try:
            return vp.simulate(
                scene, rest, rest, dt=1.0 / steps, steps=steps, integrator=integrator, increments=increments
            ).q[-1]
        except vp.VarpinError:
            return np.full(2, np.nan)

    for path in range(scale.paths):
        dw = np.random.default_rng([7, path]).normal(scale=fine**-0.5, size=(fine, scene.processes))
        exact[path] = end(NOISY["Gauss(2), split kick"], dw)
        for (name, k), array in ends.items():
            array[path] = end(NOISY[name], coarsen(dw, fine // 2**k))
    figure = Figure(figsize=(10, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name in NOISY:
        colour, marker, stroke = STYLES[name]
        dts, strong, weak, bars = [], [], [], []
        for k in exponents:
            off = np.abs(ends[name, k] - exact).max(axis=1)
            gap = ends[name, k][:, 0] ** 2 - exact[:, 0] ** 2
            dts.append(2.0**-k)
            strong.append(np.sqrt((off**2).mean()))
            weak.append(abs(gap.mean()))
            bars.append(gap.std(ddof=1) / np.sqrt(scale.paths))
        left.loglog(dts, strong, color=colour, marker=marker, linestyle=stroke, label=name)
        right.errorbar(dts, weak, yerr=2.0 * np.array(bars), color=colour, marker=marker, linestyle=stroke, capsize=2)
    right.set(yscale="log", xlabel="dt [s]", ylabel="weak error of q1² after 1 s [rad²]", title="weak")
    left.set(xlabel="dt [s]", ylabel="strong error of q after 1 s, rms [rad]", title="strong")
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        plots.apply_style(axes)
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return None, figure


# Stiffness ----------------------------------------------------------------------------------------------------------

PRODUCTS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
STIFF_STEP = 1e-2


def stiff_case(kind: str, product: float) -> peers.Case:
    """A chain of three whose last joint is held by a spring, or a damper, with dt omega (or rate) = ``product``."""
    robot, rest = vp.planar_chain(3), np.zeros(3)
    # What the last joint's forces accelerate, the others free: 1 over the last entry of M^-1.
    effective = 1.0 / np.linalg.inv(vp.lagrangian_jet(vp.Scene(robot), rest, rest).Lvv)[2, 2]
    fast = product / STIFF_STEP
    last = np.array([0.0, 0.0, 1.0])
    if kind == "spring":
        scene = vp.Scene(robot, stiffness=effective * fast**2 * last, damping=0.02 * effective * fast * last)
    else:
        scene = vp.Scene(robot, damping=effective * fast * last)
    return peers.Case(f"stiff {kind}, {product:g}", scene, rest, rest, rest)


def stiff(scale: Scale) -> tuple[None, Figure]:
    """Errors of the first two joints at one step, over the stiffness of the third."""
    own: tuple[vp.Integrator, ...] = (
        vp.ExplicitEuler(), vp.SemiImplicitEuler(), vp.RungeKutta4(), vp.Midpoint(), vp.Gauss(2), vp.Gauss(3),
    )  # fmt: skip
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    handles: dict[str, object] = {}
    for kind, axes in zip(("spring", "damper"), panels, strict=True):
        curves: dict[str, list[Point]] = {}
        for product in PRODUCTS:
            case = stiff_case(kind, product)
            peers.require_same(case)
            exact = vp.simulate(
                case.scene, case.q0, case.v0, dt=case.duration, steps=1, integrator=vp.Reference(rtol=1e-12)
            ).q[-1]
            steps = round(case.duration / STIFF_STEP)
            entries = [Entry(name_of(i), f"{STIFF_STEP:g} s", varpin_run(case, i, steps)) for i in own]
            for scheme in ("Euler", "implicitfast", "RK4"):
                run = peers.mujoco_run(case, STIFF_STEP, scheme)
                entries += [] if run is None else [Entry(f"MuJoCo {scheme}", f"{STIFF_STEP:g} s", run)]
            run = peers.drake_run(case, 1e-4)
            entries += [] if run is None else [Entry("Drake RK3", "accuracy 1e-04", run)]
            entries.append(Entry("SciPy DOP853", "rtol 1e-04", peers.scipy_run(case, 1e-4)))
            # The slow part alone counts.
            slow = [Entry(e.method, e.setting, lambda run=e.run: run()[:2]) for e in entries]
            for point in race(slow, exact[:2], scale):
                curves.setdefault(f"{point.method}, {point.setting}", []).append(point)
        heading = "dt omega" if kind == "spring" else "dt times rate"
        for label, points in curves.items():
            colour, marker, stroke = STYLES[points[0].method]
            good = [(x, p.error) for x, p in zip(PRODUCTS, points, strict=True) if p.error < LOST]
            if good:
                (handles[label],) = axes.loglog(
                    *zip(*good, strict=True), color=colour, marker=marker, linestyle=stroke, markersize=5
                )
        axes.set(xlabel=heading, title=f"stiff {kind} at the last of three joints")
        plots.apply_style(axes)
    panels[0].set_ylabel("error of the first two joints after 1 s [rad]")
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return None, figure


# Real arms ----------------------------------------------------------------------------------------------------------

REAL: tuple[vp.Integrator, ...] = (
    vp.RungeKutta4(), vp.Midpoint(), *(vp.Gauss(s) for s in (2, 3, 4)), *(vp.Radau(s) for s in (2, 3)),
)  # fmt: skip
REAL_STEPS = (100, 200, 400, 1000, 2000, 4000)


@dataclass(frozen=True)
class RealArm:
    """A race of an arm as it is: what peers are given, and how varpin has it.

    Attributes:
        case: With servos as springs and dampers about goals that swing by torques.
        scene: With servos or friction as they are.
        controls: Of a number of steps.
        servos: Stiffness, damping and rest, for MuJoCo's actuators; None without.
    """

    case: peers.Case
    scene: vp.Scene
    controls: Callable[[int], vp.OpenLoop | np.ndarray]
    servos: peers.Servos | None = None


def real_arms() -> list[RealArm]:
    """An arm with its file's damping under torques that jump, one on servos, one with friction under smooth torques."""
    damped = vp.load_robot("xarm7")
    scene = vp.Scene(damped, damping="robot")
    q0, rest = np.array([0.3, -0.4, 0.2, 1.0, -0.1, 1.2, 0.4]), np.zeros(7)
    hold = vp.lagrangian_jet(scene, q0, rest)
    rows = -hold.Lq + 0.1 * damped.effort_limit * np.random.default_rng(0).uniform(-1.0, 1.0, (100, 7))
    jumping = peers.Case("xarm7, torques that jump", scene, q0, rest, rows)

    servoed = vp.load_robot("ur5")
    start, swing, omega = np.array([0.0, -1.2, 1.4, -1.8, -1.57, 0.0]), np.full(6, 0.3), 2.0 * np.pi
    inertia = np.diag(vp.lagrangian_jet(vp.Scene(servoed), start, np.zeros(6)).Lvv)
    # 10 Hz, damped to 0.7 of critical.
    stiffness, damping = inertia * (20.0 * np.pi) ** 2, 1.4 * inertia * 20.0 * np.pi
    springs = vp.Scene(servoed, stiffness=stiffness, damping=damping, rest=start)
    tracking = peers.Case("ur5, servos", springs, start, np.zeros(6), np.zeros(6), swing=stiffness * swing, omega=omega)
    servos = vp.Scene(servoed, forces=[vp.PositionServo(stiffness, damping)])

    dry = vp.load_robot("panda", lock={"panda_finger_joint1": 0.0})
    level, width = np.array([0.6, 0.9, 0.6, 0.9, 0.4, 0.4, 0.3]), 0.1
    q0, swing = np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.8, 0.7]), np.array([2.5, 4.0, 2.0, 2.5, 0.8, 0.8, 0.5])
    held = -vp.lagrangian_jet(vp.Scene(dry), q0, rest).Lq
    rubbing = peers.Case(
        "panda, friction", vp.Scene(dry), q0, rest, held, swing=swing, omega=omega, friction=level, width=width
    )
    rough = vp.Scene(dry, forces=[vp.CoulombFriction(level, width)])
    return [
        RealArm(jumping, scene, lambda steps: np.repeat(rows, steps // len(rows), axis=0)),
        RealArm(
            tracking,
            servos,
            lambda _: vp.OpenLoop(lambda t: start + np.sin(omega * t)[:, None] * 0.3, vectorized=True),
            (stiffness, damping, start),
        ),
        RealArm(
            rubbing, rough, lambda _: vp.OpenLoop(lambda t: held + np.sin(omega * t)[:, None] * swing, vectorized=True)
        ),
    ]


def real_entries(arm: RealArm, scale: Scale) -> list[Entry]:
    """All methods at all settings."""
    case, entries = arm.case, []

    def own(integrator: vp.Integrator, steps: int) -> Run:
        dt, controls = case.duration / steps, arm.controls(steps)
        return lambda: vp.simulate(
            arm.scene, case.q0, case.v0, dt=dt, steps=steps, controls=controls, integrator=integrator
        ).q[-1]

    for integrator in REAL:
        for steps in REAL_STEPS[:: scale.thin]:
            entries.append(Entry(name_of(integrator), f"{case.duration / steps:.3g} s", own(integrator, steps)))
    for scheme in ("Euler", "implicitfast", "RK4"):
        for steps in (*REAL_STEPS, 10_000)[:: scale.thin]:
            dt = case.duration / steps
            run = peers.mujoco_driven_run(case, dt, scheme, arm.servos)
            entries += [] if run is None else [Entry(f"MuJoCo {scheme}", f"{dt:g} s", run)]
    for rtol in (10.0 ** -np.arange(3.0, 13.0))[:: scale.thin]:
        compiled = peers.compiled_run(case, rtol)
        entries += [] if compiled is None else [Entry("DOP853 in C++", f"rtol {rtol:.0e}", compiled)]
        entries.append(Entry("SciPy Radau", f"rtol {rtol:.0e}", peers.scipy_run(case, rtol, "Radau")))
    return entries


def real(scale: Scale) -> tuple[str, Figure, list[tuple[str, Point]]]:
    """The race of arms as they are."""
    figure = Figure(figsize=(13, 4.9), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    names = "MuJoCo", "DOP853", "SciPy"
    lines = [
        "![Error over time for three real arms](images/which_real.png)",
        "",
        "| motion | error [rad] | varpin | varpin [us] | MuJoCo [us] | DOP853 in C++ [us] | SciPy Radau [us] |",
        "|---|---|---|---|---|---|---|",
    ]
    rows = []
    handles: dict[str, object] = {}
    for arm, axes in zip(real_arms(), panels, strict=True):
        exact = peers.scipy_run(arm.case, 1e-13)()
        points = race(real_entries(arm, scale), exact, scale)
        rows += [(arm.case.name, point) for point in points]
        lines += best_of(points, arm.case.name, LEVELS, names)
        draw_race(axes, points, handles)
        axes.set(title=arm.case.name, xlabel="time for one second [us]", ylim=(1e-12, LOST))
    panels[0].set_ylabel("error in q after 1 s [rad]")
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=7, fontsize=8, frameon=False)
    return "\n".join(lines), figure, rows


# The page -----------------------------------------------------------------------------------------------------------


def machine(scale: Scale) -> str:
    """Who took part, and on what."""
    here, missing = [f"varpin {vp.__version__}"], []
    for name, module in (("MuJoCo", "mujoco"), ("Drake", "pydrake"), ("trep", "trep")):
        own = peers.available(module)
        version = getattr(own, "__version__", "") or peers.version_of(module)
        (missing if own is None else here).append(f"{name} {version}".strip())
    text = f"{', '.join(here)}, NumPy {np.__version__}; {platform.machine()}, Python {platform.python_version()}."
    if missing:
        text += f" Not installed, so their rows are left out: {', '.join(missing)}."
    return text + (" A quick run: shorter, with fewer settings." if scale is QUICK else "")


def main(arguments: Iterable[str] | None = None) -> None:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folder", nargs="?", type=Path, default=DOCS, help="where page and images go; docs if left out")
    parser.add_argument("--quick", action="store_true", help="shorter runs, fewer settings")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these sections alone: short, long, control, ...")
    options = parser.parse_args(None if arguments is None else list(arguments))
    scale = QUICK if options.quick else FULL
    images = options.folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    page = options.folder / PAGE
    if page.resolve() != (DOCS / PAGE).resolve():
        shutil.copy(DOCS / PAGE, page)
    logging.getLogger("varpin").setLevel(logging.ERROR)
    for case in short_cases():
        peers.require_same(case)
    sections: dict[str, Callable[[Scale], tuple[Any, ...]]] = {
        "short": short, "long": long, "control": control, "noise": noise, "stiff": stiff, "real": real,
    }  # fmt: skip
    if options.only is not None and set(options.only) - set(sections):
        parser.error(f"--only takes names of {', '.join(sections)}, got {' '.join(options.only)}")
    parts, figures = {"machine": machine(scale)}, {}
    rows: list[tuple[str, Point]] = []
    begin = time.perf_counter()
    for name, section in sections.items():
        if options.only is not None and name not in options.only:
            continue
        text, figures[name], *raced = section(scale)
        parts |= {} if text is None else {name: text}
        rows += raced[0] if raced else []
        _tell(name, begin)
    for name, figure in figures.items():
        _print(figure, images / f"which_{name}.png")
    fill(page, parts)
    if options.folder != DOCS:
        with (options.folder / "which.csv").open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["motion", "method", "setting", "error in q [rad]", "time [us]"])
            writer.writerows([motion, p.method, p.setting, p.error, p.microseconds] for motion, p in rows)


def _print(figure: Figure, path: Path) -> None:
    figure.set_dpi(110)
    FigureCanvasAgg(figure).print_png(path)


def _tell(section: str, begin: float) -> None:
    sys.stderr.write(f"{time.perf_counter() - begin:6.0f} s: {section}\n")


if __name__ == "__main__":
    main()
