"""The paper's sentences, and varpin's own, each with what was measured and whether it holds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from paper import cases
from paper.cases import CASES, COARSE, COARSEST, MAIN, METHODS, VARIATIONS, Setting
from paper.experiments import OPTIMUM, PLAIN, STOCHASTIC, Cell
from varpin.integrators import RungeKutta4
from varpin.mechanics.scene import Scene
from varpin.simulation.failures import StepFailure
from varpin.simulation.simulate import simulate
from varpin.trajectory import Trajectory

Cells = Mapping[str, Cell]


@dataclass(frozen=True)
class Claim:
    """A sentence and its measurement.

    Attributes:
        source: "paper", with the place in it, or "varpin".
        sentence: As it stands there.
        measured: The numbers.
        verdict: "holds", "holds in part", "does not hold"; or "not measured", where no cell was run that decides.
    """

    source: str
    sentence: str
    measured: str
    verdict: str


NOT_MEASURED = "not measured"
# A growth, or a change with the step, is "far" greater than another from this factor on.
FAR = 3.0
# Sentences of several claims.
_APART = "The optimized solution obtained by the Euler method is far more dependent on the step size."
_FAR_GROWTH = "The growth in the cost is far greater when the Euler method is used."
_EXCESS = (
    "Over the sampled-data optimum the true cost of {} stays below 2% up to 6 ms, and Euler's exceeds ten times "
    "that or fails."
)
_HINGE = "The claims do not hinge on what the paper leaves open: {}."
# Which of both true costs one number stands for.
_BETTER = "the better of open loop and feedback"


def verdict(*conditions: bool) -> str:
    """The verdict of some conditions; "not measured" of none."""
    if not conditions:
        return NOT_MEASURED
    if all(conditions):
        return "holds"
    return "holds in part" if any(conditions) else "does not hold"


class NotRunError(LookupError):
    """A cell that a claim needs was not run."""


def cell(cells: Cells, case: str, method: str, dt: float, setting: Setting = MAIN) -> Cell:
    """A cell.

    Raises:
        NotRunError: It was not run.
    """
    try:
        return cells[f"{setting.key}_{case}_{method}_{dt:g}"]
    except KeyError as error:
        raise NotRunError from error


def series(cells: Cells, setting: Setting, case: str, method: str) -> list[Cell]:
    """The cells over dt, the finest first."""
    found = [c for c in cells.values() if (c.setting, c.case, c.method) == (setting.key, case, method)]
    return sorted(found, key=lambda c: c.dt)


def series_of_noise(cells: Cells, method: str) -> list[Cell]:
    """The cells of the noisy setting, the weakest noise first."""
    found = [c for c in cells.values() if (c.setting, c.method) == (cases.NOISY.key, method)]
    return sorted(found, key=lambda c: cases.strength_of(c.case))


def main_steps(cells: Cells) -> list[float]:
    """The steps of the main setting, the finest first [s].

    Raises:
        NotRunError: There are none.
    """
    steps = sorted({c.dt for c in cells.values() if c.setting == MAIN.key})
    if not steps:
        raise NotRunError
    return steps


# The finger without controls, by method and step.
Motions = Mapping[tuple[str, float], Trajectory]
REFERENCE = "reference"
FREE_STEPS = (cases.FINE, 0.25 * COARSEST, 0.5 * COARSEST, COARSEST)


def free_motions() -> dict[tuple[str, float], Trajectory]:
    """Figure 1: the finger without controls from the paper's start, by both methods at several steps.

    In the report's own setting, the horizontal plane, and over the whole 1.5 s; with it Runge-Kutta's motion at the
    finest step, the reference. A motion that could not be finished ends where it stopped.
    """
    scene = Scene(cases.finger(), gravity=MAIN.gravity)
    motions: dict[tuple[str, float], Trajectory] = {}
    for method, integrator in (*METHODS.items(), (REFERENCE, RungeKutta4())):
        for dt in (cases.FINE,) if method == REFERENCE else FREE_STEPS:
            steps = round(cases.DURATION / dt)
            options: dict[str, Any] = {"dt": dt, "steps": steps, "integrator": integrator, "check": False}
            try:
                motions[method, dt] = simulate(scene, *cases.FREE_START, **options)
            except StepFailure as error:
                motions[method, dt] = error.trajectory
    return motions


# The numbers in words, and the verdict.
Judgement = tuple[str, str]
Judge = Callable[[Any], Judgement]

# Source, sentence and judge of each claim about motions and about cells, in the order of the report.
_OF_MOTIONS: list[tuple[str, str, Judge]] = []
_OF_CELLS: list[tuple[str, str, Judge]] = []


def _claim(source: str, sentence: str, among: list[tuple[str, str, Judge]] = _OF_CELLS) -> Callable[[Judge], Judge]:
    """Register a judge of a claim; it raises :class:`NotRunError` where its cells were not run."""

    def keep(judge: Judge) -> Judge:
        among.append((source, sentence, judge))
        return judge

    return keep


def assess(cells: Cells, motions: Motions) -> list[Claim]:
    """Every claim of the paper and of varpin."""
    variations = [setting for setting in VARIATIONS if series(cells, setting, "0", "Euler")]
    hinges: list[tuple[str, str, Judge]] = [
        ("varpin", _HINGE.format(setting.title), partial(_hinge, setting=setting)) for setting in variations
    ]
    claims = []
    given: tuple[tuple[Any, list[tuple[str, str, Judge]]], ...]
    given = (motions, _OF_MOTIONS), (cells, [*_OF_CELLS, *hinges])
    for results, members in given:
        for source, sentence, judge in members:
            try:
                claims.append(Claim(source, sentence, *judge(results)))
            except NotRunError:
                claims.append(Claim(source, sentence, "The cells that could tell were not run.", NOT_MEASURED))
    return claims


# --- without controls ----------------------------------------------------------------------------------------------


def _error(motions: Motions, method: str, dt: float) -> float:
    """The largest error of theta_1 [rad]; infinite of a motion that stopped early."""
    motion, exact = motions[method, dt], motions[REFERENCE, cases.FINE]
    if motion.t[-1] < exact.t[-1] - 0.5 * dt:
        return np.inf
    return float(np.abs(motion.q[:, 0] - np.interp(motion.t, exact.t, exact.q[:, 0])).max())


@_claim("paper, section 1.1", "alpha = 1/2 results in second order accuracy.", _OF_MOTIONS)
def _order(motions: Motions) -> Judgement:
    steps, orders = FREE_STEPS[1:], {}
    for method in METHODS:
        errors = [_error(motions, method, dt) for dt in steps]
        orders[method] = np.diff(np.log(errors)) / np.diff(np.log(steps))
    vi, euler = (", ".join(f"{x:.2f}" for x in orders[method]) for method in METHODS)
    return (
        f"Of theta_1 in figure 1's motion, from dt = {steps[0]:g} s to {steps[-1]:g} s: order {vi}; Euler's {euler}.",
        verdict(bool((np.abs(orders["variational"] - 2.0) < 0.1).all())),
    )


@_claim(
    "paper, section 1.1",
    "Variational integrators are able to ensure (or strongly enforce) the conservation of fundamental "
    "quantities such as momentum and energy.",
    _OF_MOTIONS,
)
def _conserved(motions: Motions) -> Judgement:
    drifts = {}
    for method in METHODS:
        motion = motions[method, COARSEST]
        # The momentum p_1 is that of the whole finger about its base.
        kept = motion.energy, motion.p[:, 0]
        drifts[method] = [float(np.abs(x - x[0]).max() / abs(x[0])) for x in kept]
    text = "; ".join(f"{method}: energy {a:.1e}, momentum {b:.1e}" for method, (a, b) in drifts.items())
    (energy, momentum), (euler, _) = drifts["variational"], drifts["Euler"]
    return (
        f"Largest relative change in figure 1's motion at dt = {COARSEST:g} s, momentum about the base: {text}.",
        verdict(momentum < 1e-12, energy < 1e-3 and energy < 0.1 * euler),
    )


@_claim(
    "paper, figure 1",
    "The accuracy of the Euler method is degraded when the discretization step size is increased while the "
    "variational integrator is negligibly affected.",
    _OF_MOTIONS,
)
def _free(motions: Motions) -> Judgement:
    travel, rows = float(np.ptp(motions[REFERENCE, cases.FINE].q[:, 0])), []
    for method in METHODS:
        fine, coarse = (_error(motions, method, dt) for dt in (cases.FINE, COARSEST))
        motion = motions[method, COARSEST]
        split = f"{motion.statistics.split_steps} of {motion.steps} steps taken in parts"
        rows.append(f"{method}: {coarse:.2g} rad (at dt = {cases.FINE:g} s {fine:.1g} rad), {split}")
    vi, finest, euler = (
        _error(motions, *key) for key in (("variational", COARSEST), ("Euler", cases.FINE), ("Euler", COARSEST))
    )
    return (
        f"Largest error of theta_1 at dt = {COARSEST:g} s over {cases.DURATION:g} s in the horizontal plane, way "
        f"{travel:.3g} rad: {'; '.join(rows)}.",
        verdict(euler > 10.0 * finest and euler > 10.0 * vi, vi < 1e-3 * travel),
    )


# --- plans at a fine and at a coarse step --------------------------------------------------------------------------


def _pair(cells: Cells, case: str, method: str, coarse: float = COARSE) -> tuple[Cell, Cell]:
    """The cells of the main setting at the finest step and at a coarse one."""
    return cell(cells, case, method, main_steps(cells)[0]), cell(cells, case, method, coarse)


def _steps_of(fine: Cell) -> str:
    return f"dt = {fine.dt:g} s to {COARSE:g} s"


@_claim(
    "paper, section 3, case 1",
    "If the additive noise is neither state nor control dependent the S-DDP algorithm is equivalent to the "
    "classic DDP solution.",
)
def _additive(cells: Cells) -> Judgement:
    differences = []
    for noisy in series(cells, MAIN, "1", "variational"):
        plain = cells.get(f"{MAIN.key}_0_variational_{noisy.dt:g}")
        if plain is not None:
            differences.append(float(np.abs(noisy.u - plain.u).max() / np.abs(plain.u).max()))
    if not differences:
        raise NotRunError
    worst = max(differences)
    text = f"Controls with and without noise differ by at most {worst:.1e} of the largest control."
    return text, verdict(worst <= 1e-9)


def _apart(fine: Cell, coarse: Cell, joints: slice = slice(None)) -> float:
    """The largest distance between two solutions at the nodes of the coarser [rad]."""
    between = np.array([np.interp(coarse.t, fine.t, row) for row in fine.q.T]).T
    return float(np.abs(coarse.q - between)[:, joints].max())


def _controls_apart(fine: Cell, coarse: Cell, until: float) -> float:
    """The largest distance up to a time [s] between a control and the mean of finer ones meanwhile.

    In parts of the largest mean.
    """
    impulses = np.vstack([np.zeros((1, fine.u.shape[1])), np.cumsum(fine.u * np.diff(fine.t)[:, None], axis=0)])
    at_nodes = np.array([np.interp(coarse.t, fine.t, row) for row in impulses.T]).T
    means = np.diff(at_nodes, axis=0) / np.diff(coarse.t)[:, None]
    shown = coarse.t[:-1] <= until
    return float(np.abs(coarse.u - means)[shown].max() / np.abs(means[shown]).max())


def _solution(cells: Cells, case: str) -> Judgement:
    pairs = {method: _pair(cells, case, method) for method in METHODS}
    vi, euler = (_apart(*pair) for pair in pairs.values())
    fine = pairs["variational"][0]
    return (
        f"Solutions at dt = {fine.dt:g} s and {COARSE:g} s are at most {vi:.2g} rad (variational) and {euler:.2g} rad "
        "(Euler) apart.",
        verdict(euler > FAR * vi),
    )


_claim("paper, figures 2a and 2b, case 1", _APART)(partial(_solution, case="1"))


def _growths(cells: Cells, case: str) -> tuple[tuple[float, float], tuple[float, float], str]:
    """Growth of both methods' optimized costs: expected, of the mean motion alone, and in words."""
    pairs = [_pair(cells, case, method) for method in METHODS]
    vi, euler = ((b.cost + b.noise_cost) / (a.cost + a.noise_cost) for a, b in pairs)
    vi_mean, euler_mean = (b.cost / a.cost for a, b in pairs)
    text = (
        f"Optimized expected cost from {_steps_of(pairs[0][0])}: times {vi:.3g} (variational) and {euler:.3g} "
        f"(Euler); of the mean motion alone times {vi_mean:.3g} and {euler_mean:.3g}"
    )
    return (vi, euler), (vi_mean, euler_mean), text


@_claim(
    "paper, table 1 and figure 5, case 1",
    "The optimized cost increases more rapidly as the discretization time step is increased when the Euler "
    "method is used.",
)
def _growth(cells: Cells) -> Judgement:
    (vi, euler), (vi_mean, euler_mean), text = _growths(cells, "1")
    return f"{text}.", verdict(euler > vi, euler_mean > vi_mean)


def _far_growth(cells: Cells, case: str) -> Judgement:
    *growths, text = _growths(cells, case)
    far = [euler - 1.0 > FAR * abs(vi - 1.0) for vi, euler in growths]
    note = " Only the mean motion's does so; noise makes the growth of both." if far == [False, True] else ""
    return f"{text}.{note}", verdict(far[0])


@_claim(
    "paper, table 1", "The number of algorithm iterations is more predictable when the variational integrator is used."
)
def _iterations(cells: Cells) -> Judgement:
    counts = {
        method: [c.iterations for case in CASES for c in series(cells, MAIN, case.key, method) if c.dt <= COARSE]
        for method in METHODS
    }
    if not all(counts.values()):
        raise NotRunError
    text = "; ".join(f"{method} {min(vi)} to {max(vi)}" for method, vi in counts.items())
    vi, euler = (max(numbers) - min(numbers) <= 2 for numbers in counts.values())
    note = " Both are predictable: here the problem is close to a linear-quadratic one." if vi and euler else ""
    return (
        f"Iterations over all cases and all steps up to 6e-3 s, from rest on the reference: {text}.{note}",
        verdict(vi, not euler),
    )


@_claim(
    "paper, figure 2c",
    "When the variational integrator is used the required computational time can be drastically reduced "
    "without significantly changing the optimized cost.",
)
def _time(cells: Cells) -> Judgement:
    a, b = _pair(cells, "1", "variational")
    expected = (b.cost + b.noise_cost) / (a.cost + a.noise_cost) - 1.0
    mean = b.cost / a.cost - 1.0
    return (
        f"From {_steps_of(a)}: time from {a.seconds * 1e3:.0f} ms to {b.seconds * 1e3:.1f} ms; optimized expected cost "
        f"{expected:+.0%}, of the mean motion {mean:+.1%}; true cost {b.open_loop / a.open_loop - 1.0:+.0%} open loop, "
        f"{b.closed_loop / a.closed_loop - 1.0:+.0%} with feedback.",
        verdict(a.seconds > 5.0 * b.seconds, abs(expected) < 0.02, abs(mean) < 0.02, b.true_cost < 1.02 * a.true_cost),
    )


@_claim(
    "paper, section 3 (left to future work there)",
    "The growth of the optimized cost when the variational integrator is used is caused, in part, by the "
    "reduction of the controller's bandwidth.",
)
def _bandwidth(cells: Cells) -> Judgement:
    optima = series(cells, MAIN, "0", OPTIMUM)
    if len(optima) < 2:
        raise NotRunError
    first, last = optima[0], optima[-1]
    costs = (f"{c.true_cost:.3g} at {c.dt:g} s" for c in optima if c in (first, last) or c.dt == COARSE)
    return (
        f"The true optimum over controls held for dt ({_BETTER}), whatever the integrator: {', '.join(costs)}.",
        verdict(last.true_cost > 1.02 * first.true_cost),
    )


_claim("paper, figures 3a and 3b, case 2", _APART)(partial(_solution, case="2"))


@_claim(
    "paper, figure 3c, case 2",
    "The optimal control input is dependent on the time step, since it is advantageous to reduce the amount "
    "of induced noise.",
)
def _controls(cells: Cells) -> Judgement:
    noisy, plain = (_pair(cells, case, "variational", COARSEST) for case in ("2", "0"))
    change, quiet = (_controls_apart(*pair, until=0.1) for pair in (noisy, plain))
    fine, coarse = (float(np.abs(a.u - b.u).max() / np.abs(b.u).max()) for a, b in zip(noisy, plain, strict=True))
    return (
        f"In parts of the largest control: from {noisy[0].dt:g} s to {COARSEST:g} s it changes by {change:.2g} in the "
        f"first 0.1 s, without noise by {quiet:.2g}; by the noise {fine:.1e} ({noisy[0].dt:g} s) and {coarse:.1e} "
        f"({COARSEST:g} s).",
        verdict(change > 0.02, coarse > 0.02 and abs(change - quiet) > 0.5 * change),
    )


_claim("paper, figure 5b, case 2", _FAR_GROWTH)(partial(_far_growth, case="2"))


@_claim("paper, case 3", "Both methods are strongly dependent on the discretization step size.")
def _state_dependent(cells: Cells) -> Judgement:
    (vi, euler), _, _ = _growths(cells, "3")
    pairs = [_pair(cells, "3", method) for method in METHODS]
    vi_way, euler_way = (_apart(*pair) for pair in pairs)
    return (
        f"Expected cost from {_steps_of(pairs[0][0])}: times {vi:.3g} (variational), times {euler:.3g} (Euler), as a "
        f"kick is countered only at the next decision. Solutions {vi_way:.2g} rad and {euler_way:.2g} rad apart.",
        verdict(min(vi, euler) > 1.5),
    )


@_claim(
    "paper, figure 4, case 3",
    "The optimized state trajectory is dependent on the step size: it is advantageous to keep the system near"
    " its start.",
)
def _trajectory(cells: Cells) -> Judgement:
    noisy, plain = (_pair(cells, case, "variational") for case in ("3", "0"))
    change, quiet = (_apart(*pair, slice(1)) for pair in (noisy, plain))
    by_noise = _apart(plain[1], noisy[1], slice(1))
    fine = noisy[0]
    error = float(np.abs(fine.q[:, 0] - [cases.reference(time)[0] for time in fine.t]).max())
    return (
        f"theta_1 changes from {_steps_of(fine)} by {change:.2g} rad, without noise by {quiet:.2g} rad; by the noise "
        f"{by_noise:.2g} rad. Largest tracking error {error:.2g} rad.",
        verdict(change > 0.1 * error, by_noise > 0.5 * change),
    )


_claim("paper, table 1, case 3", _FAR_GROWTH)(partial(_far_growth, case="3"))
_claim(
    "paper, abstract",
    "The proposed variational integrator can be used to enable real-time implementation of nonlinear optimal "
    "control algorithms.",
)(
    lambda _: (
        "No control loop was run here against the clock; times of single searches are under figure 2c.",
        NOT_MEASURED,
    )
)
_claim(
    "paper, conclusion",
    "These benefits are not limited to S-DDP: similar improvements can be expected of any process that "
    "utilizes propagated system trajectories or linearized system dynamics.",
)(lambda _: ("No other process was run here.", NOT_MEASURED))


# --- varpin's own --------------------------------------------------------------------------------------------------


def _excess(cells: Cells, method: str) -> Judgement:
    rows, small, large = [], [], []
    plans, eulers = ({c.dt: c for c in series(cells, MAIN, "0", name)} for name in (method, "Euler"))
    for best in series(cells, MAIN, "0", OPTIMUM):
        if best.dt not in plans or best.dt not in eulers:
            continue
        excess, worse = (c[best.dt].true_cost / best.true_cost - 1.0 for c in (plans, eulers))
        rows.append(f"{best.dt:g} s: {excess:.2%} / {worse:.2%}")
        if best.dt <= COARSE:
            small.append(excess < 0.02)
            large.append(worse > 10.0 * excess)
    if not small:
        raise NotRunError
    return f"Excess (own / Euler), each {_BETTER}: {'; '.join(rows)}.", verdict(all(small), all(large))


_claim("varpin", _EXCESS.format("the plan with the midpoint integrator"))(partial(_excess, method="variational"))
_claim("varpin", _EXCESS.format("the plan with Gauss collocation of fourth order"))(
    partial(_excess, method=cases.FOURTH_ORDER)
)


@_claim("varpin", "The variational plan's true cost is never above Euler's at the same step.")
def _true_cost(cells: Cells) -> Judgement:
    eulers = {c.dt: c.true_cost for c in series(cells, MAIN, "0", "Euler")}
    plans = series(cells, MAIN, "0", "variational")
    wins = [c.true_cost <= eulers[c.dt] for c in plans if c.dt in eulers]
    return f"At {sum(wins)} of {len(wins)} steps, of each {_BETTER}.", verdict(*wins)


@_claim("varpin", "The feedback gains, referred to the middle of the step, converge as dt^2.")
def _gains(cells: Cells) -> Judgement:
    rows, good = [], []
    for setting in (MAIN, *VARIATIONS):
        plans = series(cells, setting, "0", "variational")
        if len(plans) < 6 or ("heavier-1000" not in setting.key and setting is not MAIN):
            continue
        finest = plans[0]
        usable = [c for c in plans[1:] if c.dt >= 4.0 * finest.dt and c.status == "CONVERGED"]
        errors = [np.abs(c.gains - finest.gains).max() / np.abs(finest.gains).max() for c in usable]
        slopes = np.diff(np.log(errors)) / np.diff(np.log([c.dt for c in usable]))
        text = ", ".join(f"{x:.2f}" for x in slopes)
        rows.append(f"{setting.title}: {text} (error at the smallest of these steps {errors[0]:.1e})")
        # The coarsest steps resolve nothing of the finger's boundary layers: the finest three slopes count.
        good.append(bool((slopes[:3] >= 1.9).all()))
    if not good:
        return "Too few steps were run to say.", NOT_MEASURED
    return f"Slopes between neighbouring steps, the finest as reference: {'; '.join(rows)}.", verdict(*good)


@_claim(
    "varpin",
    "Where noise matters, S-DDP's policy has a lower expected cost than that of DDP, which knows of no noise,"
    " and its predicted cost is right to 5%.",
)
def _under_noise(cells: Cells) -> Judgement:
    rows, good, near = [], [], []
    for known, blind in zip(series_of_noise(cells, STOCHASTIC), series_of_noise(cells, PLAIN), strict=True):
        (mean, error), (plain, plain_error) = known.sampled, blind.sampled
        predicted = known.cost + known.noise_cost
        apart = (plain - mean) / np.hypot(error, plain_error) if np.isfinite(plain) else np.inf
        text = f"{plain:.4g} ({apart:.0f} standard errors more)" if np.isfinite(plain) else "some paths run away"
        rows.append(
            f"C = {cases.strength_of(known.case):g}: predicted {predicted:.4g}, "
            f"S-DDP {mean:.4g} +- {error:.1g}, DDP {text}"
        )
        good.append(apart > 4.0)
        near.append(abs(predicted / mean - 1.0) < 0.05)
    if not rows:
        raise NotRunError
    return (
        f"In the vertical plane at {cases.NOISY_STEP:g} s, by Monte Carlo: {'; '.join(rows)}.",
        verdict(*good, all(near)),
    )


def _hinge(cells: Cells, setting: Setting) -> Judgement:
    fine, parts, factors = main_steps(cells)[0], [], []
    for method in METHODS:
        a, b = (cell(cells, "0", method, dt, setting) for dt in (fine, COARSE))
        factors.append(b.cost / a.cost)
        parts.append(
            f"{method}: optimized cost times {b.cost / a.cost:.4g}, {b.iterations} iterations "
            f"({b.status.lower().replace('_', ' ')}), true cost at {COARSE:g} s {_both(b)}"
        )
    names = OPTIMUM, "variational", "Euler", cases.FOURTH_ORDER
    best, vi, euler, fourth = (cell(cells, "0", method, COARSE, setting) for method in names)
    parts += [f"fourth order: true cost {_both(fourth)}", f"sampled-data optimum {best.true_cost:.4g}, {_BETTER}"]
    # Being better than Euler is no merit where the plan is of no use.
    useful = vi.true_cost <= 1.1 * best.true_cost and vi.status == "CONVERGED"
    flatter = abs(factors[0] - 1.0) < abs(factors[1] - 1.0)
    return (
        f"From dt = {fine:g} s to {COARSE:g} s: {'; '.join(parts)}.",
        verdict(useful, useful and vi.true_cost <= euler.true_cost, useful and flatter),
    )


def _both(c: Cell) -> str:
    """Both true costs in words."""
    opened, fed = (f"{x:.4g}" if np.isfinite(x) else "(runs away)" for x in (c.open_loop, c.closed_loop))
    return f"{opened} open loop and {fed} with feedback"
