"""The paper's sentences, and ours, each with the numbers that came out and whether it holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.integrators import RungeKutta4
from varpin.mechanics.scene import Scene
from varpin.simulation.run import StepFailure, simulate
from varpin.study.paper import cases
from varpin.study.paper.cases import CASES, COARSE, COARSEST, MAIN, VARIATIONS, Setting
from varpin.study.paper.experiments import OPTIMUM, PLAIN, STOCHASTIC, Cell

Floats = NDArray[np.float64]

Cells = Mapping[str, Cell]


@dataclass(frozen=True)
class Claim:
    """A sentence and what was measured of it.

    Attributes:
        source: "paper", with its place, or "varpin".
        sentence: As it stands there.
        measured: Our numbers.
        verdict: "holds", "holds in part", "does not hold"; or "not measured", where nothing was run that could tell.
    """

    source: str
    sentence: str
    measured: str
    verdict: str


NOT_MEASURED = "not measured"
# A growth, or a change with the step, that is "far" greater than another is so by this factor.
FAR = 3.0


def verdict(*conditions: bool) -> str:
    """What some conditions make of a claim; of none, nothing is known."""
    if not conditions:
        return NOT_MEASURED
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


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """The finger without controls.

    Attributes:
        t: Times of the nodes (N + 1,) [s].
        theta: theta_1 there [rad].
        energy: [J].
        momentum: p_1 [N m s], that of the whole finger about its base.
        split_steps: How many steps were taken in parts.
        steps: N.
    """

    t: Floats
    theta: Floats
    energy: Floats
    momentum: Floats
    split_steps: int
    steps: int

    @property
    def drifts(self) -> tuple[float, float]:
        """The largest changes of the energy and of the momentum, in parts of what they began with."""
        return tuple(float(np.abs(x - x[0]).max() / abs(x[0])) for x in (self.energy, self.momentum))  # type: ignore


Motions = Mapping[tuple[str, float], FreeMotion]
REFERENCE = "reference"
FREE_STEPS = (cases.FINE, 0.25 * COARSEST, 0.5 * COARSEST, COARSEST)


def free_motions() -> dict[tuple[str, float], FreeMotion]:
    """Figure 1: the finger without controls from the paper's start, by both methods at several steps.

    In the report's own setting, the horizontal plane, and over the whole 1.5 s; with it Runge-Kutta's motion at the
    finest step, to hold theirs against. A motion that could not be finished ends where it stopped.
    """
    scene = Scene(cases.finger(), gravity=MAIN.gravity)
    motions = {}
    for method, integrator in (*cases.METHODS.items(), (REFERENCE, RungeKutta4())):
        for dt in (cases.FINE,) if method == REFERENCE else FREE_STEPS:
            steps = round(cases.DURATION / dt)
            try:
                motion = simulate(scene, *cases.FREE_START, dt=dt, steps=steps, integrator=integrator, check=False)
            except StepFailure as error:
                motion = error.trajectory
            motions[method, dt] = FreeMotion(
                motion.t, motion.q[:, 0], motion.energy, motion.p[:, 0], motion.statistics.split_steps, motion.steps
            )
    return motions


def assess(cells: Cells, motions: Motions) -> list[Claim]:
    """Every claim of the paper and of ours."""
    steps = sorted({c.dt for c in cells.values() if c.setting == MAIN.key})
    fine, coarse = steps[0] if steps else cases.FINE, COARSE
    return [
        _order(motions),
        _conserved(motions),
        _free(motions),
        _additive(cells),
        _solution(cells, "1", "figures 2a and 2b", fine, coarse),
        _growth(cells, "1", fine, coarse),
        _iterations(cells),
        _time(cells, fine, coarse),
        _bandwidth(cells),
        _solution(cells, "2", "figures 3a and 3b", fine, coarse),
        _controls(cells, fine),
        _far_growth(cells, "2", "figure 5b", fine, coarse),
        _state_dependent(cells, fine, coarse),
        _trajectory(cells, fine, coarse),
        _far_growth(cells, "3", "table 1", fine, coarse),
        *_unmeasured(),
        _excess(cells, steps, "variational", "the plan with the midpoint integrator"),
        _excess(cells, steps, cases.FOURTH_ORDER, "the plan with Gauss collocation of fourth order"),
        _true_cost(cells, steps),
        _gains(cells),
        _under_noise(cells),
        *(_hinge(cells, setting, fine, coarse) for setting in VARIATIONS if series(cells, setting, "0", "Euler")),
    ]


def _error(motions: Motions, method: str, dt: float) -> float:
    """The largest error of theta_1 [rad]; infinite of a motion that stopped early."""
    own, exact = motions[method, dt], motions[REFERENCE, cases.FINE]
    if own.t[-1] < exact.t[-1] - 0.5 * dt:
        return np.inf
    return float(np.abs(own.theta - np.interp(own.t, exact.t, exact.theta)).max())


def _order(motions: Motions) -> Claim:
    steps = FREE_STEPS[1:]
    errors = {method: [_error(motions, method, dt) for dt in steps] for method in cases.METHODS}
    orders = {method: np.diff(np.log(own)) / np.diff(np.log(steps)) for method, own in errors.items()}
    return Claim(
        "paper, section 1.1",
        "alpha = 1/2 results in second order accuracy.",
        f"Of theta_1 in figure 1's motion, from dt = {steps[0]:g} s to {steps[-1]:g} s: order "
        + ", ".join(f"{x:.2f}" for x in orders["variational"])
        + "; Euler's "
        + ", ".join(f"{x:.2f}" for x in orders["Euler"])
        + ".",
        verdict(bool((np.abs(orders["variational"] - 2.0) < 0.1).all())),
    )


def _conserved(motions: Motions) -> Claim:
    drifts = {method: motions[method, COARSEST].drifts for method in cases.METHODS}
    text = "; ".join(f"{method}: energy {a:.1e}, momentum {b:.1e}" for method, (a, b) in drifts.items())
    (energy, momentum), (other, _) = drifts["variational"], drifts["Euler"]
    return Claim(
        "paper, section 1.1",
        "Variational integrators are able to ensure (or strongly enforce) the conservation of fundamental quantities "
        "such as momentum and energy.",
        f"Largest change in figure 1's motion at dt = {COARSEST:g} s, in parts of what there is, of the energy and of "
        f"the momentum about the base: {text}. The momentum is kept to rounding, the energy nearly.",
        verdict(momentum < 1e-12, energy < 1e-3 and energy < 0.1 * other),
    )


def _free(motions: Motions) -> Claim:
    errors = {method: [_error(motions, method, dt) for dt in (cases.FINE, COARSEST)] for method in cases.METHODS}
    travel = float(np.ptp(motions[REFERENCE, cases.FINE].theta))
    text = "; ".join(
        f"{method}: {b:.2g} rad, {b / travel:.2g} of it (at dt = {cases.FINE:g} s {a:.1g} rad), "
        f"{motions[method, COARSEST].split_steps} of {motions[method, COARSEST].steps} steps taken in parts"
        for method, (a, b) in errors.items()
    )
    (_, own), (finest, other) = errors["variational"], errors["Euler"]
    return Claim(
        "paper, figure 1",
        "The accuracy of the Euler method is degraded when the discretization step size is increased while the "
        "variational integrator is negligibly affected.",
        f"Largest error of theta_1 at dt = {COARSEST:g} s over {cases.DURATION:g} s in the horizontal plane, in which "
        f"it moves by {travel:.3g} rad: {text}.",
        verdict(other > 10.0 * finest and other > 10.0 * own, own < 1e-3 * travel),
    )


def _additive(cells: Cells) -> Claim:
    differences = []
    for dt in sorted({c.dt for c in cells.values()}):
        noisy, plain = (cell(cells, MAIN, case, "variational", dt) for case in ("1", "0"))
        if noisy is not None and plain is not None:
            differences.append(np.abs(noisy.u - plain.u).max() / np.abs(plain.u).max())
    source, sentence = (
        "paper, section 3, case 1",
        "If the additive noise is neither state nor control dependent the S-DDP algorithm is equivalent to the classic "
        "DDP solution.",
    )
    if not differences:
        return _not_run(source, sentence)
    worst = max(differences)
    return Claim(
        source,
        sentence,
        f"Controls with and without noise differ by at most {worst:.1e} of the largest control.",
        verdict(worst <= 1e-9),
    )


def _pair(cells: Cells, case: str, method: str, fine: float, coarse: float) -> tuple[Cell, Cell] | None:
    """The cells of the main setting at two steps, if both were computed."""
    a, b = (cell(cells, MAIN, case, method, dt) for dt in (fine, coarse))
    return None if a is None or b is None else (a, b)


def _way_apart(fine: Cell, coarse: Cell, joints: slice = slice(None)) -> float:
    """The largest distance between two solutions at the nodes of the coarser [rad]."""
    between = np.array([np.interp(coarse.t, fine.t, row) for row in fine.q.T]).T
    return float(np.abs(coarse.q - between)[:, joints].max())


def _controls_apart(fine: Cell, coarse: Cell, until: float = np.inf) -> float:
    """The largest distance between a control and the mean of finer ones meanwhile, in parts of the largest mean."""
    impulses = np.vstack([np.zeros((1, fine.u.shape[1])), np.cumsum(fine.u * np.diff(fine.t)[:, None], axis=0)])
    at_nodes = np.array([np.interp(coarse.t, fine.t, row) for row in impulses.T]).T
    means = np.diff(at_nodes, axis=0) / np.diff(coarse.t)[:, None]
    shown = coarse.t[:-1] <= until
    return float(np.abs(coarse.u - means)[shown].max() / np.abs(means[shown]).max())


def _solution(cells: Cells, case: str, figures: str, fine: float, coarse: float) -> Claim:
    source = f"paper, {figures}, case {case}"
    sentence = "The optimized solution obtained by the Euler method is far more dependent on the step size."
    pairs = {method: _pair(cells, case, method, fine, coarse) for method in cases.METHODS}
    apart = {method: _way_apart(*pair) for method, pair in pairs.items() if pair is not None}
    if len(apart) < len(pairs):
        return _not_run(source, sentence)
    return Claim(
        source,
        sentence,
        f"Solutions at dt = {fine:g} s and {coarse:g} s are at most {apart['variational']:.2g} rad (variational) and "
        f"{apart['Euler']:.2g} rad (Euler) apart.",
        verdict(apart["Euler"] > FAR * apart["variational"]),
    )


def _growths(
    cells: Cells, case: str, fine: float, coarse: float
) -> tuple[dict[str, float], dict[str, float], str] | None:
    """By how much the optimized costs of both methods grow: expected, of the mean motion alone, and in words."""
    factor, mean = {}, {}
    for method in cases.METHODS:
        pair = _pair(cells, case, method, fine, coarse)
        if pair is None:
            return None
        a, b = pair
        factor[method] = (b.cost + b.noise_cost) / (a.cost + a.noise_cost)
        mean[method] = b.cost / a.cost
    text = (
        f"From dt = {fine:g} s to {coarse:g} s the optimized expected cost grows by a factor of "
        f"{factor['variational']:.3g} (variational) and {factor['Euler']:.3g} (Euler); that of the mean motion alone, "
        f"without what noise adds, by {mean['variational']:.3g} and {mean['Euler']:.3g}"
    )
    return factor, mean, text


def _growth(cells: Cells, case: str, fine: float, coarse: float) -> Claim:
    source = f"paper, table 1 and figure 5, case {case}"
    sentence = (
        "The optimized cost increases more rapidly as the discretization time step is increased when the Euler method "
        "is used."
    )
    found = _growths(cells, case, fine, coarse)
    if found is None:
        return _not_run(source, sentence)
    factor, mean, text = found
    return Claim(
        source,
        sentence,
        f"{text}.",
        verdict(factor["Euler"] > factor["variational"], mean["Euler"] > mean["variational"]),
    )


def _far_growth(cells: Cells, case: str, place: str, fine: float, coarse: float) -> Claim:
    source, sentence = (
        f"paper, {place}, case {case}",
        "The growth in the cost is far greater when the Euler method is used.",
    )
    found = _growths(cells, case, fine, coarse)
    if found is None:
        return _not_run(source, sentence)
    factor, mean, text = found
    far = [x["Euler"] - 1.0 > FAR * abs(x["variational"] - 1.0) for x in (factor, mean)]
    note = " Only the mean motion's does so; noise makes the growth of both" if far == [False, True] else ""
    return Claim(source, sentence, f"{text}.{note}{'.' if note else ''}", verdict(far[0]))


def _not_run(source: str, sentence: str) -> Claim:
    return Claim(source, sentence, "The cells that could tell were not run.", NOT_MEASURED)


def _iterations(cells: Cells) -> Claim:
    counts = {
        method: [c.iterations for case in CASES for c in series(cells, MAIN, case.key, method) if c.dt <= COARSE]
        for method in cases.METHODS
    }
    source, sentence = (
        "paper, table 1",
        "The number of algorithm iterations is more predictable when the variational integrator is used.",
    )
    if not all(counts.values()):
        return _not_run(source, sentence)
    text = "; ".join(f"{method} {min(own)} to {max(own)}" for method, own in counts.items())
    spread = {method: max(own) - min(own) for method, own in counts.items()}
    predictable = {method: own <= 2 for method, own in spread.items()}
    both = (
        " Both are predictable: here the problem is close to a linear-quadratic one."
        if all(predictable.values())
        else ""
    )
    return Claim(
        source,
        sentence,
        f"Iterations over all cases and all steps up to 6e-3 s, from rest on the reference: {text}.{both}",
        verdict(predictable["variational"], not predictable["Euler"]),
    )


def _time(cells: Cells, fine: float, coarse: float) -> Claim:
    source, sentence = (
        "paper, figure 2c",
        "When the variational integrator is used the required computational time can be drastically reduced without "
        "significantly changing the optimized cost.",
    )
    pair = _pair(cells, "1", "variational", fine, coarse)
    if pair is None:
        return _not_run(source, sentence)
    a, b = pair
    expected = (b.cost + b.noise_cost) / (a.cost + a.noise_cost) - 1.0
    return Claim(
        source,
        sentence,
        f"From dt = {fine:g} s to {coarse:g} s the time falls from {a.seconds * 1e3:.0f} ms to {b.seconds * 1e3:.1f} "
        f"ms, by a factor of {a.seconds / b.seconds:.0f}; the optimized expected cost changes by {expected:+.0%}, "
        f"that of the mean motion by {b.cost / a.cost - 1.0:+.1%}, its true cost on the continuous system by "
        f"{b.open_loop / a.open_loop - 1.0:+.0%} open loop and {b.closed_loop / a.closed_loop - 1.0:+.0%} with "
        "feedback.",
        verdict(
            a.seconds > 5.0 * b.seconds,
            abs(expected) < 0.02,
            abs(b.cost / a.cost - 1.0) < 0.02,
            b.true_cost < 1.02 * a.true_cost,
        ),
    )


def _bandwidth(cells: Cells) -> Claim:
    source, sentence = (
        "paper, section 3 (left to future work there)",
        "The growth of the optimized cost when the variational integrator is used is caused, in part, by the reduction "
        "of the controller's bandwidth.",
    )
    optima = series(cells, MAIN, "0", OPTIMUM)
    if len(optima) < 2:
        return _not_run(source, sentence)
    first, last = optima[0], optima[-1]
    middle = cell(cells, MAIN, "0", OPTIMUM, COARSE)
    shown = [first, last] if middle is None else [first, middle, last]
    return Claim(
        source,
        sentence,
        f"The true optimum over controls held for dt ({_BETTER}) is "
        + ", ".join(f"{c.true_cost:.3g} at {c.dt:g} s" for c in shown)
        + ": so much is the bandwidth's, whatever the integrator. What a method adds to it is below.",
        verdict(last.true_cost > 1.02 * first.true_cost),
    )


# What is said where one number stands for both true costs.
_BETTER = "the better of open loop and feedback"


def _controls(cells: Cells, fine: float) -> Claim:
    source, sentence = (
        "paper, figure 3c, case 2",
        "The optimal control input is dependent on the time step, since it is advantageous to reduce the amount of "
        "induced noise.",
    )
    pairs = [_pair(cells, case, "variational", fine, COARSEST) for case in ("2", "0")]
    if any(pair is None for pair in pairs):
        return _not_run(source, sentence)
    own, quiet = (_controls_apart(*pair, until=0.1) for pair in pairs if pair is not None)
    by_noise = [
        float(np.abs(a.u - b.u).max() / np.abs(b.u).max())
        for a, b in zip(*(pair for pair in pairs if pair is not None), strict=True)
    ]
    return Claim(
        source,
        sentence,
        f"Variational controls at dt = {COARSEST:g} s and the means of those at {fine:g} s differ by up to {own:.2g} "
        f"of the largest in the first 0.1 s; without any noise by {quiet:.2g}. At the same step the noise changes the "
        f"controls by {by_noise[0]:.1e} ({fine:g} s) and {by_noise[1]:.1e} ({COARSEST:g} s) of the largest.",
        verdict(own > 0.02, by_noise[1] > 0.02 and abs(own - quiet) > 0.5 * own),
    )


def _state_dependent(cells: Cells, fine: float, coarse: float) -> Claim:
    source, sentence = "paper, case 3", "Both methods are strongly dependent on the discretization step size."
    found = _growths(cells, "3", fine, coarse)
    pairs = {method: _pair(cells, "3", method, fine, coarse) for method in cases.METHODS}
    apart = {method: _way_apart(*pair) for method, pair in pairs.items() if pair is not None}
    if found is None or len(apart) < len(pairs):
        return _not_run(source, sentence)
    factor, _, _ = found
    return Claim(
        source,
        sentence,
        f"Expected cost from dt = {fine:g} s to {coarse:g} s: times {factor['variational']:.3g} (variational), times "
        f"{factor['Euler']:.3g} (Euler). It is the noise: a kick is countered only at the next decision. The solutions "
        f"are {apart['variational']:.2g} rad and {apart['Euler']:.2g} rad apart.",
        verdict(min(factor.values()) > 1.5),
    )


def _trajectory(cells: Cells, fine: float, coarse: float) -> Claim:
    source, sentence = (
        "paper, figure 4, case 3",
        "The optimized state trajectory is dependent on the step size: it is advantageous to keep the system near its "
        "start.",
    )
    pairs = [_pair(cells, case, "variational", fine, coarse) for case in ("3", "0")]
    if any(pair is None for pair in pairs):
        return _not_run(source, sentence)
    noisy, plain = (pair for pair in pairs if pair is not None)
    own, quiet = (_way_apart(*pair, slice(1)) for pair in (noisy, plain))
    by_noise = _way_apart(plain[1], noisy[1], slice(1))
    finest = noisy[0]
    error = float(np.abs(finest.q[:, 0] - [cases.reference(time)[0] for time in finest.t]).max())
    return Claim(
        source,
        sentence,
        f"theta_1 at dt = {fine:g} s and {coarse:g} s differ by up to {own:.2g} rad, where the largest tracking error "
        f"at {fine:g} s is {error:.2g} rad; without any noise by {quiet:.2g} rad. At {coarse:g} s the noise moves it "
        f"by up to {by_noise:.2g} rad.",
        verdict(own > 0.1 * error, by_noise > 0.5 * own),
    )


def _unmeasured() -> tuple[Claim, ...]:
    """Sentences of which these experiments say nothing."""
    return (
        Claim(
            "paper, abstract",
            "The proposed variational integrator can be used to enable real-time implementation of nonlinear optimal "
            "control algorithms.",
            "No control loop was run here against the clock; times of single searches are under figure 2c.",
            NOT_MEASURED,
        ),
        Claim(
            "paper, conclusion",
            "These benefits are not limited to S-DDP: similar improvements can be expected of any process that "
            "utilizes propagated system trajectories or linearized system dynamics.",
            "No other process was run here.",
            NOT_MEASURED,
        ),
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
    source, sentence = (
        "varpin",
        f"Over the sampled-data optimum the true cost of {name} stays below 2% up to 6 ms, and Euler's exceeds ten "
        "times that or fails.",
    )
    if not small:
        return _not_run(source, sentence)
    return Claim(
        source,
        sentence,
        f"Excess (own / Euler), each {_BETTER}: " + "; ".join(rows) + ".",
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
        f"At {sum(wins)} of {len(wins)} steps, of each {_BETTER}.",
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
    measured = f"Slopes between neighbouring steps, the finest as reference: {text}."
    # The coarsest steps resolve nothing of the finger's boundary layers: the finest three slopes count.
    good = [bool((own[:3] >= 1.9).all()) for own, _ in slopes.values()]
    return Claim(
        "varpin",
        "The feedback gains, referred to the middle of the step, converge as dt^2.",
        measured if good else "Too few steps were run to say.",
        verdict(*good),
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
    source, sentence = (
        "varpin",
        "Where noise matters, S-DDP's policy has a lower expected cost than that of DDP, which knows of no noise, and "
        "its predicted cost is right to 5%.",
    )
    if not rows:
        return _not_run(source, sentence)
    return Claim(
        source,
        sentence,
        f"In the vertical plane at {cases.NOISY_STEP:g} s, by Monte Carlo: " + "; ".join(rows) + ".",
        verdict(*good, all(near)),
    )


def series_of_noise(cells: Cells, method: str) -> list[Cell]:
    """The cells of the noisy setting, the weakest noise first."""
    found = [c for c in cells.values() if (c.setting, c.method) == (cases.NOISY.key, method)]
    return sorted(found, key=lambda c: cases.strength_of(c.case))


def _both(c: Cell) -> str:
    """Both true costs in words."""
    own = [f"{x:.4g}" if np.isfinite(x) else "(runs away)" for x in (c.open_loop, c.closed_loop)]
    return f"{own[0]} open loop and {own[1]} with feedback"


def _hinge(cells: Cells, setting: Setting, fine: float, coarse: float) -> Claim:
    text, good = [], []
    factor = {}
    for method in cases.METHODS:
        a, b = (cell(cells, setting, "0", method, dt) for dt in (fine, coarse))
        if a is not None and b is not None:
            factor[method] = b.cost / a.cost
            text.append(
                f"{method}: optimized cost times {factor[method]:.4g}, {b.iterations} iterations "
                f"({b.status.lower().replace('_', ' ')}), true cost at {coarse:g} s {_both(b)}"
            )
    best, own, other = (cell(cells, setting, "0", m, coarse) for m in (OPTIMUM, "variational", "Euler"))
    fourth = cell(cells, setting, "0", cases.FOURTH_ORDER, coarse)
    if best is not None and own is not None and other is not None:
        if fourth is not None:
            text.append(f"fourth order: true cost {_both(fourth)}")
        text.append(f"sampled-data optimum {best.true_cost:.4g}, {_BETTER}")
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
