"""How good varpin's advice is: robots x states x tolerances, against an exhaustive search over integrators and steps.

For each random case the advised integrator and step are run and held against a reference of tolerance 1e-13, and
against the cheapest of all integrators over steps a factor 2^(1/4) apart that meets the tolerance.

    python benchmarks/advise.py --cases 200 --seed 0
"""

import argparse
import logging
import math
from dataclasses import dataclass

import numpy as np

import varpin as vp
from varpin.tradeoff import INTEGRATORS
from varpin.tradeoff.setting import Setting

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    request = parser.parse_args()
    logging.getLogger("varpin").setLevel(logging.ERROR)
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
