"""How good varpin's advice is: robots x states x tolerances, against an exhaustive search over integrators and steps.

For each random case the advised integrator and step are run and held against a reference of tolerance 1e-13, and
against the cheapest of all integrators over steps a factor 2^(1/4) apart that meets the tolerance.

    python benchmarks/advise.py --cases 200 --seed 0

With ``--simulate`` the same for ``simulate(duration=, tolerance=)``: on random cases, some under controls, errors at
all nodes against SciPy's DOP853 on Pinocchio's aba, and costs in evaluations, which are the same on every machine.

    python benchmarks/advise.py --simulate --cases 200 --seed 0
"""

import argparse
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import varpin as vp
from varpin.study.tradeoff import INTEGRATORS
from varpin.study.tradeoff.setting import Setting

ROBOTS = ("finger", "ur5", "xarm7", "talos_arm", "z1", "chain2", "chain3", "chain5", "chain7")
RATIO = 2.0**0.25
REPEATS = 5


@dataclass(frozen=True)
class Verdict:
    """One case: what was asked, what was advised, and what came out."""

    case: str
    tolerance: float
    advice: vp.Advice
    error: float
    seconds: float
    best: str
    best_seconds: float

    @property
    def met(self) -> bool:
        return self.error <= self.tolerance

    @property
    def ratio(self) -> float:
        """Over the cheapest choice; infinite for a choice that misses the tolerance, however cheap."""
        return self.seconds / min(self.seconds, self.best_seconds) if self.met else math.inf


def random_case(rng: np.random.Generator) -> tuple[str, vp.Scene, np.ndarray, np.ndarray, float, float]:
    """A scene, a state, a duration [s] and a tolerance."""
    name = str(rng.choice(ROBOTS))
    robot = vp.planar_chain(int(name[5:])) if name.startswith("chain") else vp.load_robot(name)
    q0, v0 = rng.uniform(-1.5, 1.5, robot.dof), rng.uniform(-1.0, 1.0, robot.dof)
    scene = vp.Scene(robot, gravity=bool(name != "finger" or rng.random() < 0.5))
    if rng.random() < 0.4:
        inertia = vp.lagrangian_jet(scene, q0, v0).Lvv.diagonal()
        damping, stiffness = inertia * rng.uniform(0.0, 3.0), inertia * rng.uniform(0.0, 30.0)
        scene = vp.Scene(robot, gravity=scene.gravity, damping=damping, stiffness=stiffness)
    duration = float(rng.choice([0.1, 0.3, 1.0, 2.0]))
    return name, scene, q0, v0, duration, float(10.0 ** rng.uniform(-9.0, -2.0))


def exhaustive(setting: Setting, exact: np.ndarray, tolerance: float, most: float) -> tuple[str, float]:
    """The cheapest integrator and step that meet the tolerance, and its time [s]."""
    best, seconds = "", math.inf
    for integrator in sorted(INTEGRATORS, key=lambda own: -own.order):
        steps = 2.0
        while True:
            outcome = setting.run(integrator, round(steps), repeats=2)
            if outcome.seconds > 3.0 * min(seconds, most):
                break
            if not outcome.failure and np.abs(outcome.q[-1] - exact).max() <= tolerance:
                cost = setting.run(integrator, round(steps), repeats=REPEATS).seconds
                if cost < seconds:
                    best, seconds = f"{integrator} at {setting.duration / round(steps):.3g} s", cost
                # More steps of the same method meet it too, and take longer.
                break
            steps *= RATIO
    return best, seconds


def judge(rng: np.random.Generator) -> Verdict | None:
    """One case, or None where the reference itself does not know the end well enough to judge."""
    name, scene, q0, v0, duration, tolerance = random_case(rng)
    setting = Setting.of(scene, q0, v0, None, duration)
    tight, loose = (setting.run(vp.Reference(rtol=rtol), 1).q[-1] for rtol in (1e-13, 1e-12))
    if not np.abs(tight - loose).max() <= 0.1 * tolerance:
        return None
    advice = vp.advise(scene, q0, v0, duration=duration, tolerance=tolerance)
    outcome = setting.run(advice.integrator, advice.steps, repeats=REPEATS)
    best, best_seconds = exhaustive(setting, tight, tolerance, outcome.seconds)
    error = float(np.abs(outcome.q[-1] - tight).max())
    what = f"{name}, {duration:g} s{', damped' if scene.damping.any() else ''}"
    return Verdict(what, tolerance, advice, error, outcome.seconds, best, best_seconds)


@dataclass(frozen=True)
class Simulated:
    """One case of ``simulate`` with a tolerance: what came out, in evaluations."""

    case: str
    tolerance: float
    accuracy: vp.Accuracy
    error: float
    cost: int
    best: str
    best_cost: float

    @property
    def met(self) -> bool:
        return self.error <= self.tolerance

    @property
    def ratio(self) -> float:
        """Over the cheapest fixed choice; infinite where the tolerance is missed, however cheap."""
        return self.cost / min(self.cost, self.best_cost) if self.met else math.inf

    @property
    def search(self) -> float:
        """What finding out took, over the motion itself."""
        return self.accuracy.search_evaluations / self.cost


def judge_simulation(rng: np.random.Generator) -> Simulated | None:
    """One case, or None where the reference itself does not know the motion well enough to judge."""
    name, scene, q0, v0, duration, tolerance = random_case(rng)
    effort = 0.3 * np.abs(scene.holding_torque(np.zeros_like(q0))).max() + 0.1 * np.diag(
        vp.lagrangian_jet(scene, q0, v0).Lvv
    )
    kind = str(rng.choice(["free", "rows", "time"]))
    controls: np.ndarray | vp.OpenLoop | None = None
    pieces, torque = 1, lambda _: np.zeros_like(q0)
    if kind == "rows":
        pieces = int(rng.integers(1, 6))
        controls = rows = effort * rng.normal(size=(pieces, q0.size))
        torque = lambda t: rows[min(int(t / duration * pieces), pieces - 1)]  # noqa: E731
    elif kind == "time":
        # Such motions are right to second order only, so tight tolerances take long.
        tolerance = max(tolerance, 10.0 ** rng.uniform(-6.5, -2.0))
        rate, phase = rng.uniform(1.0, 8.0, q0.size), rng.uniform(0.0, 6.3, q0.size)
        torque = lambda t: effort * np.sin(rate * t + phase)  # noqa: E731
        controls = vp.OpenLoop(torque)
    tight, loose = (true_motion(scene, q0, v0, duration, torque, pieces, rtol) for rtol in (5e-14, 1e-12))
    looks = duration * (np.arange(200) + 0.5) / 200
    if not np.abs(tight(looks) - loose(looks)).max() <= 0.1 * tolerance:
        return None
    motion = vp.simulate(scene, q0, v0, duration=duration, tolerance=tolerance, controls=controls, check=False)
    best, best_cost = cheapest(scene, q0, v0, duration, controls, tight, tolerance, pieces, cost_of(motion))
    error = float(np.abs(motion.q - tight(motion.t)).max())
    what = f"{name}, {duration:g} s, {kind}{', damped' if scene.damping.any() else ''}"
    return Simulated(what, tolerance, motion.accuracy, error, cost_of(motion), best, best_cost)


def true_motion(
    scene: vp.Scene,
    q0: np.ndarray,
    v0: np.ndarray,
    duration: float,
    torque: Callable[[float], np.ndarray],
    pieces: int,
    rtol: float,
) -> Callable[[np.ndarray], np.ndarray]:
    """Configurations (K, n) at times (K,) by DOP853 on Pinocchio's aba; torques may jump between equal pieces."""
    model, n = scene.robot.model, q0.size
    data = model.createData()
    ends = duration * np.arange(pieces + 1) / pieces
    parts, state = [], np.concatenate([q0, v0])
    for begin, end in pairwise(ends):
        middle = 0.5 * (begin + end)

        def slope(t: float, x: np.ndarray, middle: float = middle) -> np.ndarray:
            q, v = x[:n], x[n:]
            given = torque(t if pieces == 1 else middle)
            force = given - scene.damping * v - scene.stiffness * (q - scene.rest)
            return np.concatenate([v, pin.aba(model, data, scene.robot.configuration(q), v, force)])

        options = {"rtol": rtol, "atol": rtol, "max_step": 0.02, "dense_output": True}
        solution = solve_ivp(slope, (begin, end), state, "DOP853", **options)
        parts.append(solution.sol)
        state = solution.y[:, -1]

    def at(times: np.ndarray) -> np.ndarray:
        piece = np.clip(np.searchsorted(ends, times) - 1, 0, pieces - 1)
        q = np.empty((len(times), n))
        for k in np.unique(piece):
            q[piece == k] = parts[k](times[piece == k])[:n].T
        return q

    return at


def cost_of(motion: vp.Trajectory) -> int:
    """Evaluations of forward dynamics or of the jet."""
    return int(motion.statistics.sweeps.sum() + motion.statistics.jets.sum())


def cheapest(
    scene: vp.Scene,
    q0: np.ndarray,
    v0: np.ndarray,
    duration: float,
    controls: np.ndarray | vp.OpenLoop | None,
    exact: Callable[[np.ndarray], np.ndarray],
    tolerance: float,
    pieces: int,
    most: int,
) -> tuple[str, float]:
    """The integrator and step that meet the tolerance at all nodes with the fewest evaluations, and how many."""
    best, cost = "", math.inf
    for integrator in sorted(INTEGRATORS, key=lambda own: -own.order):
        parts = 1.0
        while True:
            steps = pieces * round(parts)
            held = np.repeat(controls, steps // pieces, axis=0) if isinstance(controls, np.ndarray) else controls
            parts = max(parts * RATIO, round(parts) + 1)
            try:
                motion = vp.simulate(
                    scene, q0, v0, dt=duration / steps, steps=steps, controls=held, integrator=integrator, check=False
                )
            except vp.StepFailure:
                continue
            if cost_of(motion) >= min(cost, 1.01 * most):
                break
            if np.abs(motion.q - exact(motion.t)).max() <= tolerance:
                # More steps of the same method meet it too, and cost more.
                best, cost = f"{integrator} at {motion.dt:.3g} s", cost_of(motion)
                break
    return best, cost


def report_simulations(cases: int, seed: int) -> None:
    """Judge ``simulate`` with a tolerance, and print what came out."""
    rng = np.random.default_rng(seed)
    verdicts = [verdict for verdict in (judge_simulation(rng) for _ in range(cases)) if verdict is not None]
    for own in verdicts:
        if own.ratio > 2.0:
            print(f"{own.case}: {own.accuracy}; true {own.error:.1e}, {own.ratio:.2f} times {own.best}")
    met, ratios = np.array([own.met for own in verdicts]), np.array([own.ratio for own in verdicts])
    print(f"{len(verdicts)} of {cases} cases; the others are beyond the reference")
    print(f"tolerance met: {100 * met.mean():.1f} %")
    print(f"within 2x of the cheapest: {100 * (ratios <= 2.0).mean():.1f} %; median {np.median(ratios):.2f} times")
    told = np.array([own.accuracy.error / own.error for own in verdicts])
    print(f"estimate over true error: median {np.median(told):.2f}, from {told.min():.2f} to {told.max():.2f}")
    share = np.array([own.search for own in verdicts])
    print(f"finding out took {np.median(share):.0f} times the evaluations of the motion in the median")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--simulate", action="store_true", help="judge simulate with a tolerance instead")
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    request = parser.parse_args()
    logging.getLogger("varpin").setLevel(logging.ERROR)
    if request.simulate:
        report_simulations(request.cases, request.seed)
        return
    rng = np.random.default_rng(request.seed)
    verdicts = []
    for _ in range(request.cases):
        verdict = judge(rng)
        if verdict is not None:
            verdicts.append(verdict)
            if verdict.ratio > 2.0 or not verdict.advice.reached:
                print(
                    f"{verdict.case}: asked {verdict.tolerance:.1e}, {verdict.advice.best}, got {verdict.error:.1e} in "
                    f"{verdict.seconds:.2e} s, {verdict.ratio:.2f} times {verdict.best} ({verdict.best_seconds:.2e} s)"
                )
    met = np.array([verdict.met for verdict in verdicts])
    ratios = np.array([verdict.ratio for verdict in verdicts])
    share = np.array([verdict.advice.calibration / verdict.seconds for verdict in verdicts])
    print(f"{len(verdicts)} of {request.cases} cases; the others are beyond the reference")
    print(f"tolerance met: {100 * met.mean():.1f} %")
    print(f"within 2x of the cheapest: {100 * (ratios <= 2.0).mean():.1f} %; median {np.median(ratios):.2f} times")
    print(f"calibration took {np.median(share):.0f} times the run in the median")


if __name__ == "__main__":
    main()
