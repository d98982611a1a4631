"""The paper's figures, drawn from what came out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from paper import cases
from paper.cases import CASES, COARSE, COARSEST, MAIN
from paper.claims import REFERENCE, Cells, Motions, cell, main_steps, series, series_of_noise
from paper.experiments import OPTIMUM, PLAIN, STOCHASTIC
from varpin.show.plots import COLORS

# Tracking errors are linear below this [rad] and logarithmic beyond: a start away from the optimum outweighs the rest a
# hundredfold.
_SMALL_ERROR = 1e-4

# How a method is called where the paper has no figure of its own.
_METHOD_NAME = {"variational": "midpoint", "Euler": "Euler", cases.FOURTH_ORDER: "Gauss(stages=2)"}
_METHOD_COLOR = {"variational": COLORS[0], "Euler": COLORS[1], cases.FOURTH_ORDER: COLORS[2]}


def draw(cells: Cells, motions: Motions) -> dict[str, tuple[Figure, str]]:
    """Each figure with its caption, by the name of its file."""
    fine = main_steps(cells)[0]
    return {
        "figure1": (
            _free(motions),
            "Figure 1 (b), (c): θ₁ without controls from θ = [π/2, 0, 0] at [0, 0, 1] rad/s, in the horizontal plane.",
        ),
        "figure2": (
            _tracking(cells, "1", fine, _cost_over_time),
            f"Figure 2, case 1: tracking errors at dt = {fine:g} s (dotted) and {COARSE:g} s; cost over time.",
        ),
        "figure3": (
            _tracking(cells, "2", fine, _first_controls),
            f"Figure 3, case 2: tracking errors at dt = {fine:g} s (dotted) and {COARSE:g} s; first controls, "
            f"variational, at {fine:g} s (dotted) and {COARSEST:g} s.",
        ),
        "figure4": (
            _tracking(cells, "3", fine, _first_joint),
            f"Figure 4, case 3: tracking errors at dt = {fine:g} s (dotted) and {COARSE:g} s; θ₁, variational.",
        ),
        "figure5": (_cost_over_step(cells), "Figure 5: optimized expected cost over dt; Euler dashed."),
        "truth": (
            _truth(cells),
            "True cost of the plans of case 1 on the continuous system, and the optimum over held controls.",
        ),
        "noise": (
            _under_noise(cells),
            "Expected cost under control-dependent noise in the vertical plane: S-DDP, and DDP that knows of no noise.",
        ),
    }


def _free(motions: Motions) -> Figure:
    figure = Figure(figsize=(10, 4.0), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for panel, axes, method in zip("bc", panels, ("Euler", "variational"), strict=True):
        for dt, dash in ((cases.FINE, ":"), (COARSEST, "-")):
            motion = motions[method, dt]
            axes.plot(motion.t, motion.q[:, 0], dash, color=_METHOD_COLOR[method], label=f"{method}, dt = {dt:g} s")
        exact = motions[REFERENCE, cases.FINE].q[:, 0]
        span = np.ptp(exact)
        axes.set_ylim(exact.min() - 0.4 * span, exact.max() + 0.4 * span)
        axes.set(xlabel="time [s]", ylabel=r"$\theta_1$ [rad]", title=f"({panel}) {method}")
        _legend(axes, "outside lower left" if panel == "b" else "outside lower right", 2)
    return figure


def _legend(
    axes: Axes, where: Literal["outside lower left", "outside lower center", "outside lower right"], columns: int
) -> None:
    """The legend of some axes below the figure, where it covers no curve."""
    handles, labels = axes.get_legend_handles_labels()
    axes.figure.legend(handles, labels, loc=where, ncols=columns, frameon=False, fontsize=8, handlelength=2.5)


def _tracking(cells: Cells, case: str, fine: float, third: Callable[[Axes, Cells, str, float], None]) -> Figure:
    figure = Figure(figsize=(13, 4.0), layout="constrained")
    axes = figure.subplots(1, 3)
    axes[1].sharey(axes[0])
    for panel, method in zip(axes[:2], ("Euler", "variational"), strict=True):
        for dt, dash in ((fine, ":"), (COARSE, "-")):
            plan = cell(cells, case, method, dt)
            error = plan.q - np.array([cases.reference(t) for t in plan.t])
            for joint in range(3):
                label = rf"$\theta_{joint + 1}$, {dt:g} s"
                panel.plot(plan.t, error[:, joint], dash, color=COLORS[joint], lw=1.0, label=label)
        panel.set_yscale("symlog", linthresh=_SMALL_ERROR)
        panel.set(xlabel="time [s]", ylabel="tracking error [rad]", title=method)
    third(axes[2], cells, case, fine)
    _legend(axes[1], "outside lower left", 6)
    _legend(axes[2], "outside lower right", 3)
    return figure


def _cost_over_time(axes: Axes, cells: Cells, case: str, fine: float) -> None:  # noqa: ARG001
    for method in cases.METHODS:
        plans = series(cells, MAIN, case, method)
        axes.loglog(
            [c.seconds for c in plans],
            [c.cost + c.noise_cost for c in plans],
            "o-",
            color=_METHOD_COLOR[method],
            label=method,
        )
    axes.set(xlabel="time of the search [s]", ylabel="optimized expected cost")
    # The times span little more than a decade, where minor ticks get labels for which there is no room.
    axes.xaxis.set_minor_formatter(NullFormatter())


def _first_controls(axes: Axes, cells: Cells, case: str, fine: float) -> None:
    for dt, dash in ((fine, ":"), (COARSEST, "-")):
        plan = cell(cells, case, "variational", dt)
        shown = plan.t[:-1] <= 0.1
        for joint in range(3):
            axes.step(
                plan.t[:-1][shown], 1e6 * plan.u[shown, joint], dash, where="post", color=COLORS[joint],
                label=f"$u_{joint + 1}$, {dt:g} s",
            )  # fmt: skip
    axes.set_yscale("symlog", linthresh=10.0)
    axes.set(xlabel="time [s]", ylabel=r"control [$\mu$N m], logarithmic beyond 10")


def _first_joint(axes: Axes, cells: Cells, case: str, fine: float) -> None:
    for dt, dash in ((fine, ":"), (COARSE, "-")):
        plan = cell(cells, case, "variational", dt)
        axes.plot(plan.t, plan.q[:, 0], dash, color=COLORS[0], label=f"dt = {dt:g} s")
    t = np.linspace(0.0, cases.DURATION, 301)
    axes.plot(t, [cases.reference(x)[0] for x in t], color="0.6", lw=1, label="reference", zorder=0)
    axes.set(xlabel="time [s]", ylabel=r"$\theta_1$ [rad]")


def _cost_over_step(cells: Cells) -> Figure:
    figure = Figure(figsize=(13, 3.6), layout="constrained")
    for axes, case in zip(figure.subplots(1, 3), CASES, strict=True):
        for method in cases.METHODS:
            plans = series(cells, MAIN, case.key, method)
            axes.loglog(
                [c.dt for c in plans],
                [c.cost + c.noise_cost for c in plans],
                "s--" if method == "Euler" else "o-",
                color=_METHOD_COLOR[method],
                label=method,
            )
        axes.set(xlabel="dt [s]", ylabel="optimized expected cost", title=f"case {case.key}: {case.title}")
        axes.legend(loc="upper left")
    return figure


def _truth(cells: Cells) -> Figure:
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    axes = figure.subplots()
    best = min(c.true_cost for c in series(cells, MAIN, "0", OPTIMUM))
    top = 1e5 * best
    for method in (*cases.METHODS, cases.FOURTH_ORDER, OPTIMUM):
        plans = series(cells, MAIN, "0", method)
        dts = [c.dt for c in plans]
        label = _METHOD_NAME.get(method, "optimum over held controls")
        if method == OPTIMUM:  # a broad band: the best plans lie on it
            axes.loglog(dts, [c.open_loop for c in plans], "-", color="0.8", lw=7, zorder=0, label=label)
        else:
            axes.loglog(
                dts, [c.open_loop for c in plans], "o-", color=_METHOD_COLOR[method], label=f"{label}, open loop"
            )
            costs = [c.closed_loop for c in plans]
            label += ", with feedback"
            if not any(cost < top for cost in costs):
                label += ":\nruns away at every dt"
            axes.loglog(dts, costs, "^:", color=_METHOD_COLOR[method], label=label)
    axes.set_ylim(0.5 * best, top)
    axes.set(xlabel="dt [s]", ylabel="true cost")
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    return figure


def _under_noise(cells: Cells) -> Figure:
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    axes = figure.subplots()
    known, plain = (series_of_noise(cells, method) for method in (STOCHASTIC, PLAIN))
    strengths = [cases.strength_of(c.case) for c in known]
    axes.loglog(strengths, [c.cost + c.noise_cost for c in known], "-", color=COLORS[0], label="S-DDP, predicted")
    for plans, color, label in ((known, COLORS[0], "S-DDP, Monte Carlo"), (plain, COLORS[1], "DDP, Monte Carlo")):
        finite = [c for c in plans if np.isfinite(c.sampled[0])]
        axes.errorbar(
            [cases.strength_of(c.case) for c in finite],
            [c.sampled[0] for c in finite],
            [2.0 * c.sampled[1] for c in finite],
            fmt="o",
            capsize=4,
            color=color,
            label=label,
        )
    for lost in plain:
        if not np.isfinite(lost.sampled[0]):
            axes.annotate(
                "DDP: paths run away", (cases.strength_of(lost.case), 0.6), xycoords=("data", "axes fraction"),
                color=COLORS[1], ha="right",
            )  # fmt: skip
    axes.set(xlabel="strength C of the noise [s$^{1/2}$]", ylabel="expected cost")
    axes.legend()
    return figure
