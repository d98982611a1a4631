"""How good varpin's advice is: robots x states x tolerances, against an exhaustive search over integrators and steps.

For each random case the advised integrator and step are run and held against a reference of tolerance 1e-13, and
against the cheapest of all integrators over steps a factor 2^(1/4) apart that meets the tolerance.

    python benchmarks/advise.py --cases 200 --seed 0

With ``--simulate`` the same for ``simulate(duration=, tolerance=)``: on random cases, free and under controls, with
dampers, springs, servos, friction and rotors; errors at all nodes against SciPy's DOP853 on Pinocchio's aba, and costs
in evaluations, which are the same on every machine.

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
from scipy.interpolate import CubicHermiteSpline

import varpin as vp
from varpin.simulation.tolerance import INTEGRATORS
from varpin.study.motion import Setting

ROBOTS = ("finger", "ur5", "xarm7", "talos_arm", "z1", "chain2", "chain3", "chain5", "chain7")
RATIO = 2.0**0.25
REPEATS = 5
# Evaluations in Python after which a motion is beyond the reference.
PATIENCE = 60_000


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
            if not outcome.failure and np.abs(outcome.motion.q[-1] - exact).max() <= tolerance:
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
    tight, loose = (setting.run(vp.Reference(rtol=rtol), 1).motion.q[-1] for rtol in (1e-13, 1e-12))
    if not np.abs(tight - loose).max() <= 0.1 * tolerance:
        return None
    advice = vp.advise(scene, q0, v0, duration=duration, tolerance=tolerance)
    outcome = setting.run(advice.best.integrator, advice.best.steps, repeats=REPEATS)
    best, best_seconds = exhaustive(setting, tight, tolerance, outcome.seconds)
    error = float(np.abs(outcome.motion.q[-1] - tight).max())
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


@dataclass(frozen=True)
class Motion:
    """A motion of many kinds: what ``simulate`` is given, and its acceleration without varpin.

    Attributes:
        name: What it is, as text.
        scene: With damping, springs, servos, friction and rotors, as drawn.
        q0: (n,) [rad or m].
        v0: (n,) [rad/s or m/s].
        duration: [s].
        controls: As ``simulate`` takes them.
        command: The control at a time.
        pieces: Equal parts of the motion, between which the controls may jump.
        acceleration: Of (q, v, u), by Pinocchio's aba and the forces' formulas.
    """

    name: str
    scene: vp.Scene
    q0: np.ndarray
    v0: np.ndarray
    duration: float
    controls: np.ndarray | vp.OpenLoop | None
    command: Callable[[float], np.ndarray]
    pieces: int
    acceleration: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def random_motion(rng: np.random.Generator) -> tuple[Motion, float]:
    """A motion and a tolerance: half of them with servos, friction or rotors, under all kinds of controls."""
    name, plain, q0, v0, duration, tolerance = random_case(rng)
    robot, n = plain.robot, q0.size
    inertia = vp.lagrangian_jet(plain, q0, v0).Lvv.diagonal()
    effort = 0.3 * np.abs(plain.holding_torque(np.zeros(n))) + 10.0 * inertia
    servos, friction, rotors = rng.random(3) < (0.25, 0.25, 0.15)
    rate, ratio = 2.0 * np.pi * rng.uniform(1.0, 20.0), rng.uniform(0.2, 2.0)
    stiffness, damping = inertia * rate**2 * servos, 2.0 * ratio * inertia * rate * servos
    level, width = effort * rng.uniform(0.05, 0.5) * friction, float(10.0 ** rng.uniform(-2.0, -0.5))
    armature = inertia * rng.uniform(0.1, 1.0) * rotors
    forces: list[vp.Force] = []
    for present, force in (
        (servos, vp.PositionServo(stiffness, damping)),
        (friction, vp.CoulombFriction(level, width)),
        (rotors, vp.Armature(armature)),
    ):
        forces += [force] if present else []
    scene = vp.Scene(
        robot, gravity=plain.gravity, damping=plain.damping, stiffness=plain.stiffness, rest=plain.rest, forces=forces
    )
    controls, command, pieces, kind = random_controls(rng, q0 if servos else None, effort, duration)
    model = robot.model.copy()
    model.armature = model.armature + armature
    model.gravity.linear = np.asarray(plain.gravity)
    data = model.createData()

    def acceleration(q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        drive = stiffness * (u - q) - damping * v if servos else u
        passive = plain.damping * v + plain.stiffness * (q - plain.rest) + level * np.tanh(v / width)
        return pin.aba(model, data, robot.configuration(q), v, drive - passive)

    parts = (
        (f"servos of {rate / 2 / np.pi:.2g} Hz", servos),
        (f"friction of width {width:.2g}", friction),
        ("rotors", rotors),
        ("damped", bool(plain.damping.any())),
    )
    what = ", ".join([name, f"{duration:g} s", kind, *(part for part, present in parts if present)])
    return Motion(what, scene, q0, v0, duration, controls, command, pieces, acceleration), tolerance


def random_controls(
    rng: np.random.Generator, q0: np.ndarray | None, effort: np.ndarray, duration: float
) -> tuple[np.ndarray | vp.OpenLoop | None, Callable[[float], np.ndarray], int, str]:
    """Controls, the same as a function of time, how many equal parts they have, and what they are.

    Those of servos, whose ``q0`` is given, are positions within 0.4 rad of it; without any the servos hold q0.
    """
    n = effort.size
    about, size = (np.zeros(n), effort) if q0 is None else (q0, np.full(n, 0.2))
    kind = str(rng.choice(["free", "rows", "time"]))
    if kind == "rows":
        pieces = int(rng.integers(1, 6))
        rows = about + size * np.clip(rng.normal(size=(pieces, n)), -2.0, 2.0)
        return rows, lambda t: rows[min(int(t / duration * pieces), pieces - 1)], pieces, kind
    if kind == "time":
        rate, phase = rng.uniform(1.0, 8.0, n), rng.uniform(0.0, 6.3, n)

        def command(t: float) -> np.ndarray:
            return about + size * np.sin(rate * t + phase)

        return vp.OpenLoop(command), command, 1, kind
    return None if q0 is None else about, lambda _: about, 1, kind


def judge_simulation(rng: np.random.Generator) -> Simulated | None:
    """One case, or None where the reference itself does not know the motion well enough to judge."""
    given, tolerance = random_motion(rng)
    try:
        tight, loose = (true_motion(given, rtol) for rtol in (5e-14, 1e-12))
    except TimeoutError:
        return None
    looks = given.duration * (np.arange(200) + 0.5) / 200
    if not np.abs(tight(looks) - loose(looks)).max() <= 0.1 * tolerance:
        return None
    motion = vp.simulate(
        given.scene,
        given.q0,
        given.v0,
        duration=given.duration,
        tolerance=tolerance,
        controls=given.controls,
        check=False,
    )
    best, best_cost = cheapest(given, tight, tolerance, cost_of(motion))
    error = float(np.abs(motion.q - tight(motion.t)).max())
    return Simulated(given.name, tolerance, motion.accuracy, error, cost_of(motion), best, best_cost)


def true_motion(given: Motion, rtol: float) -> Callable[[np.ndarray], np.ndarray]:
    """Configurations (K, n) at times (K,) by DOP853 on Pinocchio's aba; controls may jump between equal pieces.

    Raises:
        TimeoutError: It takes too many evaluations.
    """
    n, asked = given.q0.size, 0
    ends = given.duration * np.arange(given.pieces + 1) / given.pieces
    parts, state = [], np.concatenate([given.q0, given.v0])
    for begin, end in pairwise(ends):
        middle = 0.5 * (begin + end)

        def slope(t: float, x: np.ndarray, middle: float = middle) -> np.ndarray:
            nonlocal asked
            asked += 1
            if asked > PATIENCE:
                raise TimeoutError
            u = given.command(t if given.pieces == 1 else middle)
            return np.concatenate([x[n:], given.acceleration(x[:n], x[n:], u)])

        options = {"rtol": rtol, "atol": rtol, "max_step": 0.02, "dense_output": True}
        solution = solve_ivp(slope, (begin, end), state, "DOP853", **options)
        parts.append(solution.sol)
        state = solution.y[:, -1]

    def at(times: np.ndarray) -> np.ndarray:
        piece = np.clip(np.searchsorted(ends, times) - 1, 0, given.pieces - 1)
        q = np.empty((len(times), n))
        for k in np.unique(piece):
            q[piece == k] = parts[k](times[piece == k])[:n].T
        return q

    return at


def cost_of(motion: vp.Trajectory) -> int:
    """Evaluations of forward dynamics or of the jet."""
    return int(motion.statistics.sweeps.sum() + motion.statistics.jets.sum())


def cheapest(
    given: Motion, exact: Callable[[np.ndarray], np.ndarray], tolerance: float, most: int
) -> tuple[str, float]:
    """The integrator and step that meet the tolerance at all nodes with the fewest evaluations, and how many."""
    best, cost = "", math.inf
    start, pieces = (given.scene, given.q0, given.v0), given.pieces
    for integrator in sorted((*INTEGRATORS, vp.Radau(3), vp.Radau(4)), key=lambda own: -own.order):
        parts = 1.0
        while True:
            steps = pieces * round(parts)
            held = given.controls
            if isinstance(held, np.ndarray) and held.ndim == 2:
                held = np.repeat(held, steps // pieces, axis=0)
            parts = max(parts * RATIO, round(parts) + 1)
            options = {"dt": given.duration / steps, "steps": steps, "controls": held, "integrator": integrator}
            try:
                motion = vp.simulate(*start, **options, check=False)
            except vp.StepFailure:
                continue
            if cost_of(motion) >= min(cost, 1.01 * most):
                break
            if np.abs(motion.q - exact(motion.t)).max() <= tolerance and follows(motion, exact):
                # More steps of the same method meet it too, and cost more.
                best, cost = f"{integrator} at {motion.dt:.3g} s", cost_of(motion)
                break
    return best, cost


def follows(motion: vp.Trajectory, exact: Callable[[np.ndarray], np.ndarray]) -> bool:
    """Whether the cubics through the nodes stay within a tenth of each joint's way.

    A single step to where servos come to rest tells nothing of how they get there.
    """
    looks = motion.t[-1] * (np.arange(400) + 0.5) / 400
    true = exact(looks)
    off = np.abs(CubicHermiteSpline(motion.t, motion.q, motion.v)(looks) - true).max(axis=0)
    return bool((off <= 0.1 * np.ptp(true, axis=0) + 1e-9).all())


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
