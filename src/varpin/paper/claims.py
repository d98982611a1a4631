"""The paper's sentences, and ours, each with the numbers that came out and whether it holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.integrators import RungeKutta4
from varpin.paper import cases
from varpin.paper.cases import CASES, COARSE, COARSEST, MAIN, VARIATIONS, Setting
from varpin.paper.experiments import OPTIMUM, PLAIN, STOCHASTIC, Cell
from varpin.simulation import StepFailure, simulate

Floats = NDArray[np.float64]

Cells = Mapping[str, Cell]


@dataclass(frozen=True)
class Claim:
    """A sentence and what was measured of it.

    Attributes:
        source: "paper", with its place, or "varpin".
        sentence: As it stands there.
        measured: Our numbers.
        verdict: "holds", "holds in part" or "does not hold".
    """

    source: str
    sentence: str
    measured: str
    verdict: str


def verdict(*conditions: bool) -> str:
    """What some conditions make of a claim."""
    if all(conditions):
        return "holds"
    return "holds in part" if any(conditions) else "does not hold"


def cell(cells: Cells, setting: Setting, case: str, method: str, dt: float) -> Cell | None:
    """A cell, if it was computed."""
    return cells.get(f"{setting.key}_{case}_{method}_{dt:g}")


def series(cells: Cells, setting: Setting, case: str, method: str) -> list[Cell]:
    """The cells over dt, the finest first."""
    found = [c for c in cells.values() if (c.setting, c.case, c.method) == (setting.key, case, method)]
    return sorted(found, key=lambda c: c.dt)


def free_motions() -> dict[tuple[str, str, float], tuple[Floats, Floats]]:
    """Figure 1: t and theta_1 without controls, from two states, by both methods, at the finest and the coarsest step.

    A motion that could not be finished ends where it stopped.
    """
    # In the vertical plane: in the horizontal one nothing would move from rest.
    scene = cases.problem(VARIATIONS[1], None, "variational", COARSEST).scene
    starts = {"b": ([np.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.0]), "c": ([np.pi / 2, 0.0, 0.0], [0.0, 0.0, 1.0])}
    motions = {}
    for panel, (q0, v0) in starts.items():
        for method, integrator in (*cases.METHODS.items(), ("reference", RungeKutta4())):
            for dt in (cases.FINE,) if method == "reference" else (cases.FINE, COARSEST):
                steps = round(cases.DURATION / dt)
                try:
                    motion = simulate(scene, q0, v0, dt=dt, steps=steps, integrator=integrator)
                except StepFailure as error:
                    motion = error.trajectory
                motions[panel, method, dt] = motion.t, motion.q[:, 0]
    return motions


def assess(cells: Cells, motions: Mapping[tuple[str, str, float], tuple[Floats, Floats]]) -> list[Claim]:
    """Every claim that the cells suffice for."""
    steps = sorted({c.dt for c in cells.values() if c.setting == MAIN.key})
    fine, coarse = steps[0], COARSE
    return [
        _free(motions),
        _additive(cells),
        *(_growth(cells, case.key, fine, coarse) for case in CASES),
        _iterations(cells),
        _time(cells, fine, coarse),
        _bandwidth(cells),
        _state_dependent(cells, fine, coarse),
        _excess(cells, steps, "variational", "the plan with the midpoint integrator"),
        _excess(cells, steps, cases.FOURTH_ORDER, "the plan with Gauss collocation of fourth order"),
        _true_cost(cells, steps),
        _gains(cells),
        _under_noise(cells),
        *(_hinge(cells, setting, fine, coarse) for setting in VARIATIONS if series(cells, setting, "0", "Euler")),
    ]


def _free(motions: Mapping[tuple[str, str, float], tuple[Floats, Floats]]) -> Claim:
    parts, better = [], []
    for panel in "bc":
        errors = {}
        reference_t, reference_q = motions[panel, "reference", cases.FINE]
        for method in cases.METHODS:
            t, q = motions[panel, method, COARSEST]
            error = np.abs(q - np.interp(t, reference_t, reference_q))
            early = error[t <= 0.2 + 1e-9]
            errors[method] = float(early.max())
        parts.append(f"({panel}) {errors['variational']:.3g} rad variational, {errors['Euler']:.3g} rad Euler")
        better.append(errors["variational"] <= 0.1 * errors["Euler"])
    return Claim(
        "paper, figure 1",
        "The accuracy of the Euler method is degraded when the discretization step size is increased while the "
        "variational integrator is negligibly affected.",
        "Largest error of theta_1 at dt = 2e-2 s over the first 0.2 s (later the motion is chaotic and no method with "
        "that step follows it): " + "; ".join(parts) + ".",
        verdict(*better),
    )


def _additive(cells: Cells) -> Claim:
    differences = []
    for dt in sorted({c.dt for c in cells.values()}):
        noisy, plain = (cell(cells, MAIN, case, "variational", dt) for case in ("1", "0"))
        if noisy is not None and plain is not None:
            differences.append(np.abs(noisy.u - plain.u).max() / np.abs(plain.u).max())
    worst = max(differences)
    return Claim(
        "paper, section 3, case 1",
        "If the additive noise is neither state nor control dependent the S-DDP algorithm is equivalent to the classic "
        "DDP solution.",
        f"Controls with and without noise differ by at most {worst:.1e} of the largest control.",
        verdict(worst <= 1e-9),
    )


def _growth(cells: Cells, case: str, fine: float, coarse: float) -> Claim:
    factor, mean = {}, {}
    for method in cases.METHODS:
        a, b = (cell(cells, MAIN, case, method, dt) for dt in (fine, coarse))
        if a is not None and b is not None:
            factor[method] = (b.cost + b.noise_cost) / (a.cost + a.noise_cost)
            mean[method] = b.cost / a.cost
    return Claim(
        f"paper, table 1 and figure 5, case {case}",
        "The optimized cost increases more rapidly as the discretization time step is increased when the Euler method "
        "is used.",
        f"From dt = {fine:g} s to {coarse:g} s the optimized expected cost grows by a factor of "
        f"{factor['variational']:.3g} (variational) and {factor['Euler']:.3g} (Euler); that of the mean motion alone, "
        f"without what noise adds, by {mean['variational']:.3g} and {mean['Euler']:.3g}.",
        verdict(factor["Euler"] > factor["variational"], mean["Euler"] > mean["variational"]),
    )


def _iterations(cells: Cells) -> Claim:
    counts = {
        method: [c.iterations for case in CASES for c in series(cells, MAIN, case.key, method) if c.dt <= COARSE]
        for method in cases.METHODS
    }
    text = "; ".join(f"{method} {min(own)} to {max(own)}" for method, own in counts.items())
    spread = {method: max(own) - min(own) for method, own in counts.items()}
    return Claim(
        "paper, table 1",
        "The number of algorithm iterations is more predictable when the variational integrator is used.",
        f"Iterations over all cases and all steps up to 6e-3 s, from rest on the reference: {text}. Both are: here the "
        "problem is close to a linear-quadratic one.",
        verdict(spread["variational"] <= 2, spread["variational"] < spread["Euler"]),
    )


def _time(cells: Cells, fine: float, coarse: float) -> Claim:
    a, b = (cell(cells, MAIN, "1", "variational", dt) for dt in (fine, coarse))
    if a is None or b is None:
        return Claim("paper, figure 2c", "", "", "does not hold")
    return Claim(
        "paper, figure 2c",
        "When the variational integrator is used the required computational time can be drastically reduced without "
        "significantly changing the optimized cost.",
        f"From dt = {fine:g} s to {coarse:g} s the time falls from {a.seconds * 1e3:.0f} ms to {b.seconds * 1e3:.1f} "
        f"ms, by a factor of {a.seconds / b.seconds:.0f}; the cost of the mean motion changes by "
        f"{b.cost / a.cost - 1.0:+.1%}, its true cost (with feedback, on the continuous system) by "
        f"{b.closed_loop / a.closed_loop - 1.0:+.0%}.",
        verdict(a.seconds > 5.0 * b.seconds, abs(b.cost / a.cost - 1.0) < 0.02, b.closed_loop < 1.02 * a.closed_loop),
    )


def _bandwidth(cells: Cells) -> Claim:
    optima = series(cells, MAIN, "0", OPTIMUM)
    first, last = optima[0], optima[-1]
    middle = cell(cells, MAIN, "0", OPTIMUM, COARSE)
    text = f"{first.true_cost:.3g} at {first.dt:g} s, " + (
        f"{middle.true_cost:.3g} at {middle.dt:g} s, " if middle is not None else ""
    )
    return Claim(
        "paper, section 3 (left to future work there)",
        "The growth of the optimized cost when the variational integrator is used is caused, in part, by the reduction "
        "of the controller's bandwidth.",
        f"The true optimum over controls held for dt is {text}{last.true_cost:.3g} at {last.dt:g} s: so much is the "
        "bandwidth's, whatever the integrator. What a method adds to it is below.",
        verdict(last.true_cost > 1.02 * first.true_cost),
    )


def _state_dependent(cells: Cells, fine: float, coarse: float) -> Claim:
    share = {}
    for method in cases.METHODS:
        a, b = (cell(cells, MAIN, "3", method, dt) for dt in (fine, coarse))
        if a is not None and b is not None:
            share[method] = (b.cost + b.noise_cost) / (a.cost + a.noise_cost)
    return Claim(
        "paper, case 3",
        "Both methods are strongly dependent on the discretization step size.",
        f"Expected cost from dt = {fine:g} s to {coarse:g} s: times {share['variational']:.3g} (variational), times "
        f"{share['Euler']:.3g} (Euler). It is the noise: a kick is countered only at the next decision.",
        verdict(min(share.values()) > 1.5),
    )


def _excess(cells: Cells, steps: Sequence[float], method: str, name: str) -> Claim:
    rows, small, large = [], [], []
    for dt in steps:
        best, own, other = (cell(cells, MAIN, "0", m, dt) for m in (OPTIMUM, method, "Euler"))
        if best is None or own is None or other is None:
            continue
        excess = [c.true_cost / best.true_cost - 1.0 for c in (own, other)]
        rows.append(f"{dt:g} s: {excess[0]:.2%} / {excess[1]:.2%}")
        if dt <= COARSE:
            small.append(excess[0] < 0.02)
            large.append(excess[1] > 10.0 * excess[0])
    return Claim(
        "varpin",
        f"Over the sampled-data optimum the true cost of {name} stays below 2% up to 6 ms, and Euler's exceeds ten "
        "times that or fails.",
        "Excess (own / Euler): " + "; ".join(rows) + ".",
        verdict(all(small), all(large)),
    )


def _true_cost(cells: Cells, steps: Sequence[float]) -> Claim:
    wins = []
    for dt in steps:
        own, other = (cell(cells, MAIN, "0", method, dt) for method in cases.METHODS)
        if own is not None and other is not None:
            wins.append(own.true_cost <= other.true_cost)
    return Claim(
        "varpin",
        "The variational plan's true cost is never above Euler's at the same step.",
        f"At {sum(wins)} of {len(wins)} steps.",
        verdict(*wins),
    )


def _gains(cells: Cells) -> Claim:
    slopes = {}
    for setting in (MAIN, *VARIATIONS):
        own = series(cells, setting, "0", "variational")
        if len(own) < 6 or ("heavier-1000" not in setting.key and setting is not MAIN):
            continue
        finest = own[0]
        usable = [c for c in own[1:] if c.dt >= 4.0 * finest.dt and c.status == "CONVERGED"]
        errors = [np.abs(c.gains - finest.gains).max() / np.abs(finest.gains).max() for c in usable]
        slopes[setting.title] = np.diff(np.log(errors)) / np.diff(np.log([c.dt for c in usable])), errors[0]
    text = "; ".join(
        f"{title}: {', '.join(f'{x:.2f}' for x in own)} (error at the smallest of these steps {first:.1e})"
        for title, (own, first) in slopes.items()
    )
    if not slopes:
        text = "too few steps were run to say"
    # The coarsest steps resolve nothing of the finger's boundary layers: the finest three slopes count.
    good = [bool((own[:3] >= 1.9).all()) for own, _ in slopes.values()]
    return Claim(
        "varpin",
        "The feedback gains, referred to the middle of the step, converge as dt^2.",
        f"Slopes between neighbouring steps, the finest as reference: {text}.",
        verdict(*good) if good else "does not hold",
    )


def _under_noise(cells: Cells) -> Claim:
    rows, good, near = [], [], []
    for own in series_of_noise(cells, STOCHASTIC):
        other = cells[f"{cases.NOISY.key}_{own.case}_{PLAIN}_{own.dt:g}"]
        (mean, error), (plain, plain_error) = own.sampled, other.sampled
        predicted = own.cost + own.noise_cost
        ran_away = not np.isfinite(plain)
        apart = np.inf if ran_away else (plain - mean) / np.hypot(error, plain_error)
        text = "some paths run away" if ran_away else f"{plain:.4g} ({apart:.0f} standard errors more)"
        rows.append(
            f"C = {cases.strength_of(own.case):g}: predicted {predicted:.4g}, "
            f"S-DDP {mean:.4g} +- {error:.1g}, DDP {text}"
        )
        good.append(apart > 4.0)
        near.append(abs(predicted / mean - 1.0) < 0.05)
    return Claim(
        "varpin",
        "Where noise matters, S-DDP's policy has a lower expected cost than that of DDP, which knows of no noise, and "
        "its predicted cost is right to 5%.",
        f"In the vertical plane at {cases.NOISY_STEP:g} s, by Monte Carlo: " + "; ".join(rows) + ".",
        verdict(*good, all(near)),
    )


def series_of_noise(cells: Cells, method: str) -> list[Cell]:
    """The cells of the noisy setting, the weakest noise first."""
    found = [c for c in cells.values() if (c.setting, c.method) == (cases.NOISY.key, method)]
    return sorted(found, key=lambda c: cases.strength_of(c.case))


def _hinge(cells: Cells, setting: Setting, fine: float, coarse: float) -> Claim:
    text, good = [], []
    factor = {}
    for method in cases.METHODS:
        a, b = (cell(cells, setting, "0", method, dt) for dt in (fine, coarse))
        if a is not None and b is not None:
            factor[method] = b.cost / a.cost
            text.append(
                f"{method}: optimized cost times {factor[method]:.4g}, {b.iterations} iterations "
                f"({b.status.lower().replace('_', ' ')}), true cost {b.true_cost:.4g} at {coarse:g} s"
            )
    best, own, other = (cell(cells, setting, "0", m, coarse) for m in (OPTIMUM, "variational", "Euler"))
    fourth = cell(cells, setting, "0", cases.FOURTH_ORDER, coarse)
    if best is not None and own is not None and other is not None:
        if fourth is not None:
            text.append(f"fourth order: true cost {fourth.true_cost:.4g}")
        text.append(f"sampled-data optimum {best.true_cost:.4g}")
        # Being better than Euler is no merit where the plan is of no use.
        useful = own.true_cost <= 1.1 * best.true_cost and own.status == "CONVERGED"
        better = own.true_cost <= other.true_cost
        good = [useful, useful and better, useful and abs(factor["variational"] - 1.0) < abs(factor["Euler"] - 1.0)]
    return Claim(
        "varpin",
        f"The claims do not hinge on what the paper leaves open: {setting.title}.",
        f"From dt = {fine:g} s to {coarse:g} s: " + "; ".join(text) + ".",
        verdict(*good),
    )
