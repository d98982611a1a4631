"""Random motions that judge the check of ``vp.simulate``; benchmarks/judged_motions.py judges hundreds."""

import itertools
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from oracles import Mechanism
from scipy import integrate, optimize

import varpin as vp

Array = np.ndarray
# q and v at the nodes (2, N + 1, n), and the largest distance of a run at a hundred times the tolerance (2, n).
Truth = tuple[Array, Array]
ARMS = dict.fromkeys(("ur3", "ur5", "ur10", "xarm7", "kinova", "finger", "so100", "double_pendulum_continuous"))
ARMS |= {"z1": "jointGripper", "talos_arm": "gripper_left_joint", "panda": "panda_finger_joint1"}  # locked
KINDS = ("free", "torques", "smooth", "blows", "dampers", "springs", "frames", "servos", "stops", "friction", "laws",
         "upright", "mixed")  # fmt: skip
METHODS = (vp.Midpoint(), vp.Gauss(2), vp.Gauss(3), vp.Radau(3), vp.RungeKutta4(), vp.SemiImplicitEuler())
# Warnings that are not about errors: words of plain sentences, kinds of records.
WORDS = ("leave their limits", "velocity limits", "effort limits", "are open", "degrees", "a thousand times")
NO_ERRORS = ("position limits", "velocity limits", "effort limits", "open loops")
# Errors of q by travel and of v by speed: wrong above, wrong by a stricter measure above, right below.
WRONG, STRICT, RIGHT = np.array([0.05, 0.25]), np.array([0.01, 0.25]), np.array([0.003, 0.075])
PATIENCE = 600_000  # evaluations after which a true motion is given up
AT = np.array([0.05, 0.1, 0.15])  # where a spring pulls, in its frame's axes [m]


class Case(NamedTuple):
    seed: int
    kind: str
    scene: vp.Scene
    q0: Array
    v0: Array
    dt: float
    steps: int
    integrator: vp.Integrator | None
    controls: object
    jumps: Array  # instants at which controls of time alone jump [s]
    rate: float  # of the fastest damping [1/s]

    def simulate(self, check: bool = True) -> vp.Trajectory:
        options = {"dt": self.dt, "steps": self.steps, "controls": self.controls, "integrator": self.integrator}
        return vp.simulate(self.scene, self.q0, self.v0, check=check, **options)

    def __str__(self) -> str:
        task = f"{self.seed:5d} {self.kind:8s} {self.scene.robot.name} ({self.q0.size}), {self.steps} x "
        return f"{task}{1e3 * self.dt:.3g} ms, {str(self.integrator)[:14]}, h rate {self.dt * self.rate:.2g}"


def log_uniform(rng: np.random.Generator, low: float, high: float, size: int | None = None) -> Array:
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def urdf(rng: np.random.Generator) -> str:
    branching, text, lengths = rng.random() < 0.5, '<robot name="tree"><link name="b0"/>', [0.0]
    for k in range(1, int(rng.integers(3, 9))):
        up = int(rng.integers(max(0, k - 3), k)) if branching else k - 1
        (x, y), z, mass = rng.uniform(0.03, 0.12, 2), rng.uniform(0.1, 0.6), log_uniform(rng, 0.1, 8.0)
        Ixx, Iyy, Izz = (mass / 12.0 * a for a in (y * y + z * z, x * x + z * z, x * x + y * y))
        axis = np.eye(3)[rng.integers(3)] if rng.random() < 0.6 else rng.normal(size=3)
        turn = rng.uniform(-1.5, 1.5, 3) * (rng.random() < 0.6)
        kind = "prismatic" if rng.random() < 0.15 else "revolute"
        text += (
            f'<link name="b{k}"><inertial><origin xyz="0 0 {z / 2}"/><mass value="{mass}"/><inertia ixx="{Ixx}" '
            f'iyy="{Iyy}" izz="{Izz}" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{k}" type="{kind}">'
            f'<parent link="b{up}"/><child link="b{k}"/><origin xyz="0 0 {lengths[up]}" rpy="{turn[0]} {turn[1]} '
            f'{turn[2]}"/><axis xyz="{axis[0]} {axis[1]} {axis[2]}"/><limit effort="1e9" velocity="1e9"/></joint>'
        )
        lengths.append(z)
    return text + "</robot>"


def any_robot(rng: np.random.Generator) -> vp.Robot:
    which, links, name = rng.random(), int(rng.integers(1, 8)), str(rng.choice(list(ARMS)))
    robot = vp.planar_chain(links)
    if which >= 0.35:
        source = name if which < 0.7 else pin.buildModelFromXML(urdf(rng))
        robot = vp.load_robot(source, lock={ARMS[name]: 0.01} if which < 0.7 and ARMS[name] else None)
    if rng.random() < 0.2:
        mass = sum(body.mass for body in robot.model.inertias) * rng.uniform(0.05, 0.5)
        robot = vp.load_robot(robot.model, payload=vp.Payload(robot.end_effector, mass, rng.uniform(-0.05, 0.05, 3)))
    return robot


def draw(seed: int) -> Case:
    """The task of a seed, whose kind follows from the seed, too."""
    rng, kind = np.random.default_rng(seed), KINDS[seed % len(KINDS)]
    robot, gravity = any_robot(rng), np.array([0.0, 0.0, -9.81]) * (kind == "upright" or rng.random() < 0.7)
    free, n = vp.Scene(robot, gravity=gravity, damping=0.0), robot.dof
    unit = np.where(robot.slides, 0.3, 1.0)
    dt = float(log_uniform(rng, 1e-3, 0.05))
    steps = max(4, round(rng.uniform(0.2, 2.0) / dt))
    q0, v0 = unit * rng.uniform(-1.5, 1.5, n), unit * rng.normal(size=n) * log_uniform(rng, 0.05, 5.0)
    v0 *= kind == "free" or rng.random() >= 0.3
    if kind == "upright":  # With sliding joints there may be no equilibrium: they fall.
        q0 = optimize.least_squares(free.holding_torque, q0, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        q0, v0 = q0 + log_uniform(rng, 1e-8, 0.03) * rng.normal(size=n), np.zeros(n)
    plain = Mechanism(free)
    inverse, weight, parts = np.linalg.inv(plain.mass_matrix(q0)), free.holding_torque(q0), {kind}
    inertia = 1.0 / np.diag(inverse)
    push = inertia * unit * log_uniform(rng, 3.0, 200.0)
    if kind == "mixed":
        pair = rng.choice(["dampers", "springs", "frames", "stops", "friction"], 2, replace=False)
        parts = {rng.choice(["torques", "smooth", "laws"]), *pair}
    forces, damping, jumps, controls = [], np.zeros(n), np.zeros(0), None
    if "dampers" in parts or (kind not in ("free", "upright") and rng.random() < 0.25):
        rate = log_uniform(rng, 0.01, 100.0) / dt if "dampers" in parts else log_uniform(rng, 0.1, 5.0)
        damping = rate * inertia * log_uniform(rng, 0.3, 1.0, n)
        forces.append(vp.JointDamper(damping))
    if "springs" in parts:
        turn = (log_uniform(rng, 0.01, 3.0) / dt) ** 2 * inertia * log_uniform(rng, 0.3, 1.0, n)
        forces.append(vp.JointSpring(turn, q0 + 0.2 * rng.normal(size=n)))
    if "frames" in parts:
        plain.place(q0)
        x, _, J, _ = plain.point((robot.end_effector, AT))
        anchor, omega = x + 0.1 * rng.normal(size=3), min(300.0, log_uniform(rng, 0.01, 2.0) / dt)
        stiff = omega**2 / np.linalg.norm(J[:3] @ inverse @ J[:3].T, 2)
        forces.append(vp.FrameSpring((robot.end_effector, AT), anchor, stiff))
    if "friction" in parts:
        level, width = push * rng.uniform(0.05, 0.5), unit * log_uniform(rng, 0.01, 0.1)
        damping = damping + level / width
        forces.append(vp.CoulombFriction(level, width))
    if "stops" in parts:
        lower, upper = (q0 + side * unit * rng.uniform(0.02, 0.4, n) for side in (-1.0, 1.0))
        hard, wide = inertia * log_uniform(rng, 30.0, 1000.0) ** 2, unit * log_uniform(rng, 0.003, 0.05)
        soft = 2.0 * rng.uniform(0.0, 1.0) * np.sqrt(hard * inertia)
        damping, v0 = damping + soft, v0 + unit * rng.normal(size=n)
        forces.append(vp.JointStop(hard, soft, lower, upper, wide))
    pace, swing, phase = rng.uniform(1.0, 20.0, n), push * rng.normal(size=n), rng.uniform(0.0, 6.3, n)
    mean, every = weight * (rng.random() < 0.5), int(rng.choice([1, 1, 2, 5, 20, steps]))
    rows = rng.normal(size=(steps, n))[np.arange(steps) // every * every]
    if "servos" in parts:
        k = inertia * log_uniform(rng, 3.0, 300.0) ** 2 * log_uniform(rng, 0.3, 1.0, n)
        d, way = 2.0 * rng.uniform(0.1, 2.0) * np.sqrt(k * inertia), unit * log_uniform(rng, 0.03, 1.0)
        effort = (np.abs(weight) + push) * rng.uniform(0.3, 2.0) if rng.random() < 0.5 else np.full(n, np.inf)
        damping = damping + d
        forces.append(vp.PositionServo(k, d, effort))
        controls = vp.OpenLoop(lambda t: q0 + way * np.sin(pace * t)) if rng.random() < 0.3 else q0 + way * rows
    scene = vp.Scene(robot, gravity=gravity, forces=forces, damping=0.0, friction=0.0)
    if "torques" in parts:
        controls = mean + push * rows
    if "smooth" in parts:
        controls = vp.OpenLoop(lambda t: mean + swing * np.sin(pace * t + phase))
    if "blows" in parts:  # Short ones of up to 50 times the push, and steps that stay.
        begin = rng.uniform(0.0, steps * dt, rng.integers(1, 5))
        last = np.where(rng.random(begin.size) < 0.3, np.inf, log_uniform(rng, 1e-3, 0.1, begin.size))
        size = rng.normal(size=(begin.size, n)) * push * np.minimum(50.0, 0.1 / np.minimum(last, 0.1))[:, None]
        end, jumps = begin + last, np.append(begin, begin + last)
        controls = vp.OpenLoop(lambda t: mean + 0.3 * swing * np.sin(pace * t) + ((begin <= t) & (t < end)) @ size)
    if "laws" in parts:  # From soft to the edge of instability.
        aim, omega = q0 + 0.3 * unit * rng.normal(size=n), min(150.0, log_uniform(rng, 0.03, 1.3) / dt)
        kp, kd = inertia * omega**2, 2.0 * inertia * omega * rng.uniform(0.3, 1.2)
        controls = lambda t, q, v: kp * (aim - q) - kd * v + scene.holding_torque(q)  # noqa: E731
    rate = float(np.linalg.eigvalsh(np.sqrt(damping)[:, None] * inverse * np.sqrt(damping)).max())
    integrator = None if rng.random() < 2.0 / 3.0 else METHODS[rng.integers(len(METHODS))]
    return Case(seed, kind, scene, q0, v0, dt, steps, integrator, controls, jumps, rate)


def run(case: Case, given: object, rtol: float) -> Array:
    """q and v (2, N + 1, n) at nodes, by SciPy on Pinocchio's aba, begun anew wherever the ``given`` controls jump."""
    plain, n, times = Mechanism(case.scene), case.q0.size, case.dt * np.arange(case.steps + 1)
    law, rows, end, calls = callable(given), isinstance(given, np.ndarray), times[-1], itertools.count()
    borders = times if law else np.unique(np.clip([0.0, *case.jumps, end], 0.0, end))
    if rows:
        borders = times[[0, *(np.flatnonzero((given[1:] != given[:-1]).any(axis=1)) + 1), case.steps]]
    method = "LSODA" if case.rate * end > max(500.0, 30.0 * (len(borders) - 1)) else "DOP853"
    # q is counted from the start: a robot that hardly moves keeps its digits.
    states = [x := np.append(np.zeros(n), case.v0)]
    for begin, end in itertools.pairwise(borders):
        row = given(begin, case.q0 + x[:n], x[n:]) if law else given[round(begin / case.dt)] if rows else np.zeros(n)

        def slope(t: float, x: Array, row: Array = row, ends: float = begin + end) -> Array:
            if next(calls) > PATIENCE:
                raise ArithmeticError
            # Of controls that jump at an end, the side within.
            u = given.f(t + 1e-12 * (ends - 2.0 * t)) if isinstance(given, vp.OpenLoop) else row
            q, v = case.q0 + x[:n], x[n:]
            _, pull, others = plain.forces(q, v, case.scene.actuation @ u)
            return np.append(v, plain.acceleration(t, q, v, pull + others))

        inside = times[(times > begin + 1e-9 * case.dt) & (times < end - 1e-9 * case.dt)]
        found = integrate.solve_ivp(slope, (begin, end), x, method, np.append(inside, end), rtol=rtol, atol=1e-4 * rtol)
        if not (found.success and np.isfinite(found.y).all()):
            raise ArithmeticError
        x = found.y[:, -1]
        states += list(found.y.T if np.abs(times - end).min() < 1e-9 * case.dt else found.y.T[:-1])
    q, v = np.split(np.array(states), 2, axis=1)
    return np.array([case.q0 + q, v])


def truth(case: Case) -> Truth | None:
    """The true motion, a law called with its states. None: unknown."""
    try:
        states, coarse = run(case, case.controls, 1e-11), run(case, case.controls, 1e-9)
    except (ArithmeticError, ValueError):
        return None
    return states, np.abs(states - coarse).max(axis=1)


class Verdict(NamedTuple):
    # "off": wrong; "right": clearly right; "untold", "told": of these, without and with a warning about the error;
    # "loop": right and told, but of an unstable loop; "unknown": too chaotic.
    labels: frozenset[str]
    told: tuple[str, ...] = ()  # warnings about its error
    share: tuple[float, float] = (np.nan, np.nan)  # error of q by travel, of v by speed
    factor: float = np.nan  # estimated by true error
    seconds: tuple[float, float] = (0.0, 0.0)  # without and with the check

    def __str__(self) -> str:
        q, v = (f"{100.0 * share:.3g} %" for share in self.share)
        return f"q {q}, v {v}, factor {self.factor:.3g} {[text[:150] for text in self.told]}"


def judge(case: Case, motion: vp.Trajectory, real: Truth | None) -> Verdict:
    """Compare a motion with the truth."""
    said = [str(one) for one in motion.warnings if getattr(one, "kind", "") not in NO_ERRORS]
    told = tuple(text for text in said if not any(word in text for word in WORDS))
    if real is None:
        return Verdict(frozenset({"unknown"}), told)
    states, doubt = real
    size = np.array([np.ptp(states[0], axis=0), np.abs(states[1]).max(axis=0)])
    for alike in (case.scene.robot.slides, ~case.scene.robot.slides):
        size[:, alike] = size[:, alike].max(axis=1, initial=1e-6, keepdims=True)
    off = np.abs(np.array([motion.q, motion.v]) - states).max(axis=1)
    least, share, doubt = max(1e-8, 5.0 * doubt[0].max()), (off / size).max(axis=1), (doubt / size).max(axis=1)
    loop = all("control l" in text for text in told)
    right = (share < RIGHT).all() and (doubt < 0.2 * RIGHT).all()
    labels = {"right", *(["loop" if loop else "told"] if told else [])} if right else set()
    for limit, after in ((WRONG, ""), (STRICT, " 1%")):
        labels |= {f"off{after}", *([] if told else [f"untold{after}"])} if (share > limit).any() else set()
    estimate, factor = getattr(motion, "error", None), np.nan
    if estimate is not None and off[0].max() > least:
        factor = float(np.max(estimate) / off[0].max())
    return Verdict(frozenset(labels if (doubt < 0.2 * WRONG).all() else {"unknown"}), told, tuple(share), factor)
