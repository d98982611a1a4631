"""Contracts of motions: scenes of the zoo x integrators x signals, each against the continuous motion or differences.

Each scene, each integrator and each signal comes up several times in the usual run, every pair with ``--slow``.
"""

import contextlib
import dataclasses
import functools
import pickle
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import pytest
import zoo
from oracles import Mechanism, Motion, assert_jet, exact, jacobian, order_of, same, slope

import varpin as vp
from varpin import wiener

PIECES = 4  # intervals over which rows, laws and policies are constant
FLOOR = 2e-11  # of relative errors that show an order: oracles are good to about 1e-11
VARIATIONAL = [vp.Midpoint(), vp.Gauss(1), vp.Gauss(2), vp.Gauss(3), vp.Gauss(4), vp.Radau(2), vp.Radau(3)]
VARIATIONAL += [vp.Radau(4), vp.Gauss(6)]
OTHERS = [vp.ExplicitEuler(), vp.SemiImplicitEuler(), vp.RungeKutta4()]
EVERY = [*VARIATIONAL, *OTHERS, vp.Midpoint(alpha=0.3)]
FREE = [name for name, case in zoo.ZOO.items() if not case.scene.constraints]
BOUND = [name for name in zoo.ZOO if name not in FREE]
MOVED = [name for name, case in zoo.ZOO.items() if case.path is not None]
LOOPS = [name for name in BOUND if name not in MOVED]
SLOPED = [name for name in BOUND if name != "cranked five-bar"]
NOISY = [name for name, case in zoo.ZOO.items() if case.scene.processes]
SILENT = [name for name in FREE if name not in NOISY]
# Scenes where nothing but gravity and springs acts.
CONSERVATIVE = ["pendulum", "chain", "drifting chain", "cart", "mass on a spring", "tree", "finger", "ur5", "panda"]
CONSERVATIVE += ["hand", "springs", "frame springs", "bumpers", "trembling far out"]


def inertia(case: zoo.Case, q: np.ndarray) -> np.ndarray:
    return Mechanism(case.scene, case.path).mass_matrix(q)


def second(motion: vp.Trajectory, integrator: vp.Integrator) -> np.ndarray:
    return motion.p if integrator.variational else motion.v


# --- signals ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Signal:
    """Controls of a case: what :func:`varpin.simulate` is given, and what the oracle is."""

    name: str
    given: Callable[[zoo.Case, int, bool], dict]
    plain: Callable[[zoo.Case, bool], Callable | None]


def middles(case: zoo.Case) -> np.ndarray:
    return np.array([case.swing((k + 0.5) * case.span / PIECES) for k in range(PIECES)])


def nodes(case: zoo.Case) -> np.ndarray:
    return np.array([case.swing(k * case.span / PIECES) for k in range(PIECES + 1)])


def rows(case: zoo.Case, parts: int, momenta: bool) -> dict:
    return {"controls": np.repeat(middles(case), parts, axis=0)}


@functools.cache
def gains(case: zoo.Case, momenta: bool) -> tuple[np.ndarray, np.ndarray]:
    n, m = case.q0.size, case.scene.controls
    start = inertia(case, case.q0) @ case.v0 if momenta else case.v0
    sizes = np.concatenate([np.full(n, 0.5), np.full(n, np.abs(start).max() + 1e-9)])
    mixed = np.cos(np.arange(PIECES * m * 2 * n).reshape(PIECES, m, 2 * n))
    amp = np.broadcast_to(np.asarray(case.amp, float), (m,))
    return 0.2 / n * amp[:, None] * mixed / sizes, np.tile(np.append(case.q0, start), (PIECES, 1))


def fed_back(case: zoo.Case, momenta: bool, k: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    G, reference = gains(case, momenta)
    return G[k] @ (np.append(q, inertia(case, q) @ v if momenta else v) - reference[k])


def policy(case: zoo.Case, parts: int, momenta: bool) -> dict:
    on = "momentum" if momenta else "velocity"
    return {"controls": vp.LinearPolicy(middles(case), *gains(case, momenta), on=on, period=case.span / PIECES)}


def policy_of_lines(case: zoo.Case, parts: int, momenta: bool) -> dict:
    on, u = "momentum" if momenta else "velocity", nodes(case)
    given = {"on": on, "period": case.span / PIECES, "linear": True, "before": u[0]}
    return {"controls": vp.LinearPolicy(u[1:], *gains(case, momenta), **given)}


def law(case: zoo.Case, parts: int, momenta: bool) -> dict:
    def digital(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        k = round(t / case.span * PIECES)
        return middles(case)[k] + fed_back(case, False, k, q, v)

    return {"controls": digital, "period": parts}


def along(case: zoo.Case, before: np.ndarray, after: np.ndarray, k: int) -> Callable[[float], np.ndarray]:
    return lambda t: before + (t / case.span * PIECES - k) * (after - before)


def plain_policy_of_lines(case: zoo.Case, momenta: bool) -> Callable:
    u = nodes(case)
    last = [u[0]]

    def over(k: int, q: np.ndarray, v: np.ndarray) -> Callable:
        last.append(u[k + 1] + fed_back(case, momenta, k, q, v))
        return along(case, last[-2], last[-1], k)

    return over


def constant(values: Callable[[zoo.Case, bool, int, np.ndarray, np.ndarray], np.ndarray]) -> Callable:
    def plain(case: zoo.Case, momenta: bool) -> Callable:
        def over(k: int, q: np.ndarray, v: np.ndarray) -> Callable:
            u = values(case, momenta, k, q, v)
            return lambda t: u

        return over

    return plain


SIGNALS = [
    Signal("nothing", lambda case, parts, momenta: {}, lambda case, momenta: None),
    Signal("rows", rows, constant(lambda case, momenta, k, q, v: middles(case)[k])),
    Signal(
        "one row",
        lambda case, parts, momenta: {"controls": case.swing(0.0)},
        constant(lambda case, momenta, k, q, v: case.swing(0.0)),
    ),
    Signal(
        "open loop",
        lambda case, parts, momenta: {"controls": vp.OpenLoop(case.swing)},
        lambda case, momenta: lambda k, q, v: case.swing,
    ),
    Signal(
        "lines",
        lambda case, parts, momenta: {"controls": vp.FirstOrderHold(nodes(case)).refined(parts)},
        lambda case, momenta: lambda k, q, v: along(case, *nodes(case)[k : k + 2], k),
    ),
    Signal(
        "policy",
        policy,
        constant(lambda case, momenta, k, q, v: middles(case)[k] + fed_back(case, momenta, k, q, v)),
    ),
    Signal("policy of lines", policy_of_lines, plain_policy_of_lines),
    Signal("law", law, constant(lambda case, momenta, k, q, v: middles(case)[k] + fed_back(case, False, k, q, v))),
]
BY_NAME = {signal.name: signal for signal in SIGNALS}


def prescribed(case: zoo.Case, t: float, u: np.ndarray) -> np.ndarray:
    """Controls u (m,), with the position of the prescribed joint at a time, of cubic inputs its velocity too."""
    scene, u = case.scene, u.copy()
    (own,) = (own for own in scene.constraints if isinstance(own, vp.KinematicInput))
    at, rate, _ = case.path(t)
    u[list(scene.robot.joint_names).index(own.joint)] = at[0]
    u[scene.robot.dof :] = rate[0]
    return u


def path_rows(case: zoo.Case, parts: int, momenta: bool) -> dict:
    """Positions are those where each step ends."""
    t = np.linspace(0.0, case.span, PIECES * parts + 1)[1:]
    return {"controls": np.array(list(map(functools.partial(prescribed, case), t, np.repeat(middles(case), parts, 0))))}


def path_lines(case: zoo.Case, parts: int, momenta: bool) -> dict:
    t = np.linspace(0.0, case.span, PIECES * parts + 1)
    u = vp.FirstOrderHold(nodes(case)).refined(parts).u
    return {"controls": vp.FirstOrderHold(np.array(list(map(functools.partial(prescribed, case), t, u))))}


PATHS = [
    Signal("rows of a path", path_rows, BY_NAME["rows"].plain),
    Signal(
        "path",
        lambda case, parts, momenta: {"controls": vp.OpenLoop(lambda t: prescribed(case, t, case.swing(t)))},
        BY_NAME["open loop"].plain,
    ),
    Signal("lines of a path", path_lines, BY_NAME["lines"].plain),
]


def motion_of(case: zoo.Case, integrator: vp.Integrator, signal: Signal, parts: int, **options: object):
    steps = PIECES * parts
    given = {"dt": case.span / steps, "steps": steps, "integrator": integrator, "check": False, **options}
    if case.scene.processes and "rng" not in given:
        given.setdefault("increments", 0.0)
    return vp.simulate(case.scene, case.q0, case.v0, **signal.given(case, parts, integrator.variational), **given)


@functools.cache
def oracle(case: zoo.Case, signal: Signal, momenta: bool) -> Motion:
    times = np.linspace(0.0, case.span, PIECES + 1)
    return exact(
        case.scene, case.q0, case.v0, times, signal.plain(case, momenta), path=case.path, stiff=case.stiff
    )  # fmt: skip


# --- combinations ----------------------------------------------------------------------------------------------------


def combined(names: list[str], integrators: list, signals: list, each: int, first: int = 0) -> list:
    """Every scene with ``each`` integrators and signals in turn; and, slow, with all other integrators."""
    found = []
    for i, name in enumerate(names):
        for j, integrator in enumerate(integrators):
            if zoo.ZOO[name].stiff and not integrator.variational:
                continue
            usual = (j - first - each * i) % len(integrators) < each
            signal = signals[(i * 3 + j) % len(signals)]
            marks = () if usual else (pytest.mark.slow,)
            label = f"{name}-{integrator}-{signal.name}"
            found.append(pytest.param(zoo.ZOO[name], integrator, signal, marks=marks, id=label))
    return found


def keeping(integrators: list) -> list:
    return [own for own in integrators if isinstance(own, vp.Midpoint | vp.Gauss) and getattr(own, "alpha", 0.5) == 0.5]


UNDER = [SIGNALS[0], BY_NAME["rows"], BY_NAME["open loop"], BY_NAME["lines"], BY_NAME["policy"]]
MOTIONS = [
    *combined(FREE, EVERY, SIGNALS, 2),
    *combined(LOOPS, keeping(EVERY), UNDER, 2),
    *combined(MOVED, keeping(EVERY), PATHS, 4),
]
SOME = [
    *combined(FREE, EVERY, SIGNALS, 1, 2),
    *combined(LOOPS, keeping(EVERY), UNDER, 1, 1),
    *combined(MOVED, keeping(EVERY), PATHS, 1, 2),
]
AGAIN = [
    ("servos", vp.Gauss(2), "open loop"),
    ("servos", vp.RungeKutta4(), "open loop"),
    ("servos", vp.Radau(3), "law"),
    ("servo at its limit", vp.Gauss(3), "open loop"),
    ("ur5", vp.Gauss(4), "open loop"),
    ("ur5", vp.Radau(3), "lines"),
    ("panda", vp.RungeKutta4(), "open loop"),
]
MOTIONS += [pytest.param(zoo.ZOO[one], own, BY_NAME[two], id=f"{one}-{own}-{two} again") for one, own, two in AGAIN]
over_motions = pytest.mark.parametrize(("case", "integrator", "signal"), MOTIONS)
over_some = pytest.mark.parametrize(("case", "integrator", "signal"), SOME)


# --- order and energy ------------------------------------------------------------------------------------------------

MOST = {1: 256, 2: 128, 3: 64, 4: 32, 5: 16, 6: 16, 7: 8, 8: 4, 12: 4}  # parts of an interval where errors are small


@over_motions
def test_order(case, integrator, signal):
    own = oracle(case, signal, integrator.variational)
    sizes = np.ptp(own.q, axis=0).max(), np.abs(own.v).max(), np.abs(own.energy).max() + np.abs(own.work).max() + 1e-9
    counts, errors = [], []
    # Steps that call Python take long.
    finest = MOST[integrator.order] // (4 if case.name.startswith("custom") or signal in PATHS else 1)
    for parts in finest * 2 ** np.arange(6) // 8 if finest > 7 else 2 ** np.arange(5):
        motion = motion_of(case, integrator, signal, parts)
        if motion.statistics.split_steps:
            continue
        off = motion.q[::parts] - own.q, motion.v[::parts] - own.v, motion.energy[::parts] - own.energy
        found = [np.abs(each).max() / size for each, size in zip(off, sizes, strict=True)]
        counts.append(parts)
        errors.append([*found, np.abs(motion.statistics.energy_defect).max() / sizes[2]])
        if max(errors[-1]) < FLOOR:
            break
    assert counts
    # Stiff motions show an order late, and those above 8 are at the floor at once.
    order = min(integrator.order, 4 if case.stiff else 8)
    errors, least = np.array(errors), order - (0.35 if order <= 4 else 0.25 * order - 0.25)
    for name, error in zip(("q", "v", "energy", "defect"), errors.T, strict=True):
        last = min(len(error), 1 + np.argmax(np.append(error, 0.0) < FLOOR))
        # Where the leading term leads: over one or two refinements, to errors above the floor or just below it.
        found = [
            order_of(counts[k:end], error[k:end]) for end in (last - 1, last) for k in (end - 3, end - 2) if k >= 0
        ]
        at_once = last <= 2 and error[last - 1] < FLOOR
        assert at_once or max(found) > least, (name, counts, error)
        assert error[-1] < (1e-2 if integrator.order == 1 else 1e-4), (name, counts, error)


@pytest.mark.parametrize(
    ("case", "integrator", "signal"),
    combined([*SILENT[::5], "stops", "servos"], 6 * [vp.Reference(1e-11)], SIGNALS[:1] + SIGNALS[3:], 2),
)
def test_reference(case, integrator, signal):
    own, motion = oracle(case, signal, False), motion_of(case, integrator, signal, 1)
    np.testing.assert_allclose(motion.q, own.q, rtol=0, atol=2e-9)
    np.testing.assert_allclose(motion.v, own.v, rtol=0, atol=2e-8 * np.abs(own.v).max())


@pytest.mark.parametrize("driven", [False, True], ids=["nothing", "rows"])
@pytest.mark.parametrize("name", CONSERVATIVE)
def test_the_ledger_is_the_drift(name, driven):
    case = zoo.ZOO[name]
    for integrator in (vp.Midpoint(), vp.Gauss(2)):
        motion = motion_of(case, integrator, SIGNALS[1] if driven else SIGNALS[0], 3)
        work = np.cumsum(np.sum(motion.u @ case.scene.actuation.T * np.diff(motion.q, axis=0), axis=1))
        drift, size = np.abs(np.diff(motion.energy).cumsum() - work), np.abs(motion.energy).max()
        if len(set(case.scene.group)) == 1:
            np.testing.assert_allclose(motion.statistics.energy_defect, drift, rtol=1e-6, atol=1e-12 * size)
        assert (motion.statistics.energy_defect >= drift - 1e-12 * size).all()


@pytest.mark.parametrize("integrator", VARIATIONAL, ids=str)
@pytest.mark.parametrize(
    ("name", "c"), [("drifting chain", 0), ("cart", 0), ("ur5", 0), ("kinova", 0), ("frame dampers", 2)]
)
def test_momentum(name, c, integrator):
    case = zoo.ZOO[name]
    for signal in SIGNALS[:2]:
        motion = motion_of(case, integrator, signal, 8)
        impulse = np.vstack([np.zeros(motion.u.shape[1]), np.cumsum(motion.dt * motion.u, axis=0)])[:, c]
        off = np.abs(motion.p[:, c] - motion.p[0, c] - impulse).max()
        assert (off <= 2e-13 * np.abs(motion.p).max()) == (name != "frame dampers"), off


def symplectic(case: zoo.Case, motion: vp.Trajectory) -> None:
    """A'JA = J in units of the momenta."""
    n = case.q0.size
    units = np.concatenate([np.ones(n), np.full(n, np.abs(motion.p).max())])
    J = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(n))
    for A in vp.linearize(case.scene, motion).A / units[:, None] * units:
        assert np.abs(A.T @ J @ A - J).max() < 1e-12 * max(1.0, np.abs(A).max() ** 2)


@pytest.mark.parametrize("integrator", [own for own in VARIATIONAL if not isinstance(own, vp.Radau)], ids=str)
@pytest.mark.parametrize("name", CONSERVATIVE)
def test_reversal(name, integrator):
    case = zoo.ZOO[name]
    there = motion_of(case, integrator, SIGNALS[0], 5)
    back = vp.simulate(
        case.scene, there.q[-1], -there.v[-1], dt=there.dt, steps=there.steps, integrator=integrator, check=False,
        increments=0.0 if case.scene.processes else None,
    )  # fmt: skip
    assert there.statistics.split_steps == back.statistics.split_steps == 0
    np.testing.assert_allclose(back.q[-1], case.q0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(-back.v[-1], case.v0, rtol=0, atol=1e-10 * np.abs(there.v).max())
    symplectic(case, there)


# --- the Lagrangian --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*FREE, "four-bar"])
def test_jet(name):
    case = zoo.ZOO[name]
    assert_jet(case.scene, case.q0, case.v0, "compiled")
    with contextlib.suppress(vp.InputError):  # of what Pinocchio does not know
        assert_jet(case.scene, case.q0, case.v0, "pinocchio")


@pytest.mark.parametrize("name", [*CONSERVATIVE, "tilted chain"])
def test_holding_torque(name):
    """Pinocchio's gravity, less the pull of springs."""
    case = zoo.ZOO[name]
    own, none = Mechanism(case.scene), np.zeros(case.q0.size)
    weight = own.G.T @ pin.computeGeneralizedGravity(own.model, own.data, own.positions(case.q0))
    expected = weight - own.forces(case.q0, none, none)[1]
    np.testing.assert_allclose(case.scene.holding_torque(case.q0), expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("alpha", [0.5, 0.2])
@pytest.mark.parametrize("name", CONSERVATIVE)
def test_discrete_lagrangian(name, alpha):
    """Ld = h L at the mean, its slots against differences; a step solves p0 + D1 = 0, p1 = D2, and is symplectic."""
    case, h, n = zoo.ZOO[name], zoo.ZOO[name].dt, zoo.ZOO[name].q0.size
    integrator = vp.Midpoint(alpha=alpha, guard=None)
    motion = motion_of(case, integrator, SIGNALS[0], 5)
    ends, e = (motion.q[3], motion.q[4]), np.random.default_rng(2).uniform(-1.0, 1.0, (2, n))
    slots = vp.discrete_lagrangian(case.scene, *ends, h, alpha=alpha)
    jet = vp.lagrangian_jet(case.scene, (1 - alpha) * ends[0] + alpha * ends[1], (ends[1] - ends[0]) / h)
    assert slots.Ld == pytest.approx(h * jet.L, rel=1e-12)
    symplectic(case, motion)
    size = np.abs(motion.p).max() + h * np.abs(jet.Lq).max()
    np.testing.assert_allclose(motion.p[3], -slots.D1, rtol=0, atol=1e-11 * size)
    np.testing.assert_allclose(motion.p[4], slots.D2, rtol=0, atol=1e-11 * size)
    for i, name_ in enumerate(("D1", "D2")):
        for j in range(2):

            def slot(x: np.ndarray, j=j, name_=name_) -> np.ndarray:
                moved = (x, ends[1]) if j == 0 else (ends[0], x)
                return getattr(vp.discrete_lagrangian(case.scene, *moved, h, alpha=alpha), name_)

            own = getattr(slots, f"D{j + 1}D{i + 1}")
            np.testing.assert_allclose(
                own @ e[j], slope(slot, ends[j], e[j], h / 4), rtol=0, atol=1e-8 * size / h
            )  # fmt: skip


# --- derivatives -----------------------------------------------------------------------------------------------------


class Step:
    """The last step of a short motion, as a function of its state, controls and increments."""

    def __init__(self, case: zoo.Case, integrator: vp.Integrator, lines: bool) -> None:
        self.case, self.integrator, self.lines = case, integrator, lines
        scene, steps = case.scene, 3
        self.dt = 0.5 * case.dt
        self.none = {"increments": 0.0} if scene.processes else {}
        if case.path is not None:
            rows = PATHS[0].given(case, 40 // PIECES, True)["controls"][:steps]
            u, before = rows, rows
        else:
            u = np.array([case.swing(k * self.dt) for k in range(steps + 1)])
            before = u[:steps]
        self.motion = vp.simulate(
            scene, case.q0, case.v0, dt=self.dt, steps=steps, integrator=integrator, check=False,
            controls=vp.FirstOrderHold(u) if lines else before, **self.none,
        )  # fmt: skip
        assert self.motion.statistics.split_steps == 0
        self.n, self.x = case.q0.size, np.append(self.motion.q[2], second(self.motion, integrator)[2])
        self.u = u[2:].ravel() if lines else before[2]
        light = 1.0 / np.diag(np.linalg.inv(inertia(case, self.x[: self.n])))
        amp = np.broadcast_to(np.asarray(case.amp, float), (scene.controls,))
        self.rows = np.concatenate([np.ones(self.n), light if integrator.variational else np.ones(self.n)])
        self.units = np.concatenate([self.rows, np.tile(amp if case.path is None else 0.02 + 0 * amp, 1 + lines)])

    def of(self, z: np.ndarray, dw: np.ndarray | None = None, keep: bool = False):
        """The end (2n,) from (x, u), or the motion."""
        case, n, u = self.case, self.n, z[2 * self.n :]
        q = vp.assemble(case.scene, z[:n]) if case.scene.constraints and case.path is None else z[:n]
        v = np.linalg.solve(inertia(case, q), z[n : 2 * n]) if self.integrator.variational else z[n : 2 * n]
        controls = vp.FirstOrderHold(u.reshape(2, -1)) if self.lines else u
        noise = self.none if dw is None else {"increments": dw[None]}
        end = vp.simulate(
            case.scene, q, v, dt=self.dt, steps=1, controls=controls, integrator=self.integrator, check=False, **noise
        )
        return end if keep else np.append(end.q[1], second(end, self.integrator)[1])

    def direction(self, rng: np.random.Generator) -> np.ndarray:
        """A random direction in (x, u), q along the constraints."""
        e = rng.uniform(-1.0, 1.0, self.units.size) * self.units
        if self.case.scene.constraints and self.case.path is None:
            e[: self.n] = Mechanism(self.case.scene).tangent(self.x[: self.n], e[: self.n])
        return e

    @staticmethod
    def all_of(lin: vp.Linearization, lines: bool, k: int = -1) -> np.ndarray:
        """dx1/d(x, u), of lines dx1/d(x, u before, u after)."""
        return np.hstack([lin.A[k], *((lin.B[k] - lin.ramp[k], lin.ramp[k]) if lines else (lin.B[k],))])


def derivative_cases(integrators: list, each: int, first: int) -> list:
    found = []
    for own in (
        *combined(FREE, integrators, SIGNALS, each, first),
        *combined(SLOPED, keeping(integrators), SIGNALS, 1, first),
    ):
        case, integrator, signal = own.values
        lines = signal in SIGNALS[::2] and getattr(integrator, "stages", 2) > 1 and case.path is None
        lines = lines and isinstance(integrator, vp.Gauss | vp.Radau | vp.RungeKutta4 | vp.Reference)
        label = f"{case.name}-{integrator}-{'lines' if lines else 'rows'}"
        found.append(pytest.param(case, integrator, lines, marks=own.marks, id=label))
    return found


@pytest.mark.parametrize(("case", "integrator", "lines"), derivative_cases([*EVERY, vp.Reference()], 2, 1))
def test_linearization(case, integrator, lines):
    if isinstance(integrator, vp.Reference) and case.scene.processes:
        pytest.skip("the reference takes no noise")
    step, rng = Step(case, integrator, lines), np.random.default_rng(7)
    lin = vp.linearize(case.scene, step.motion)
    assert lin.variational == integrator.variational
    given, z = step.all_of(lin, lines), np.append(step.x, step.u)
    for _ in range(2):
        e = step.direction(rng)
        found = slope(step.of, z, e, 2e-3) / step.rows
        size = max(1.0, np.abs(found).max())
        bound = 1e-7 if isinstance(integrator, vp.Reference) else 2e-8
        np.testing.assert_allclose(given @ e / step.rows, found, rtol=0, atol=bound * size)
    if integrator.variational and not case.scene.constraints:
        np.testing.assert_array_equal(lin.K[-1], lin.A[-1][:, step.n :])


@pytest.mark.parametrize(("case", "integrator", "lines"), derivative_cases(VARIATIONAL, 1, 0))
def test_second_order(case, integrator, lines):
    if case.name == "custom force":
        with pytest.raises(vp.InputError, match="CustomForce"):
            vp.second_order(case.scene, Step(case, integrator, False).motion, np.ones(6))
        return
    step, rng = Step(case, integrator, False), np.random.default_rng(8)
    z = rng.normal(size=2 * step.n) / step.rows
    own = vp.second_order(case.scene, step.motion, z)
    given, at = np.block([[own.xx[-1], own.ux[-1].T], [own.ux[-1], own.uu[-1]]]), np.append(step.x, step.u)
    e, other = step.direction(rng), step.direction(rng)

    def gradient(y: np.ndarray) -> np.ndarray:
        return z @ step.all_of(vp.linearize(case.scene, step.of(y, keep=True)), False) @ other

    # Along constraints the second direction would have to turn with the first: controls and momenta alone.
    if case.scene.constraints and case.path is None:
        e[: step.n] = other[: step.n] = 0.0
    bound = 1e-5 if case.scene.constraints else 1e-6 if case.stiff else 1e-7
    found, size = slope(gradient, at, e, 2e-3), np.abs(other / step.units).max()
    assert other @ given @ e == pytest.approx(found, abs=bound * max(size, abs(found)))


# --- noise -----------------------------------------------------------------------------------------------------------


def fields(case: zoo.Case, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    n, B = q.size, case.scene.actuation
    return {
        "trembling": lambda: np.diag([0.3, 0.2]),
        "trembling torques": lambda: np.hstack([0.2 * B * u, 0.05 * np.eye(n)]),
        "trembling far out": lambda: np.diag(0.6 * (q - 0.1) ** 2),
        "custom noise": lambda: np.array([[0.2 + 0.1 * q[1]], [0.3 * np.cos(q[0]) + 0.1 * u[1]]]),
        "trembling loop": lambda: 0.2 * np.eye(n),
    }[case.name]()


KICKS = [vp.Midpoint(), vp.Midpoint(kick="split"), vp.Midpoint(kick="held"), vp.Gauss(2, kick="split")]
KICKS += [vp.Gauss(3, kick="held"), vp.Radau(2), vp.Radau(3, kick="held"), *OTHERS]
KICKED = [
    (name, own)
    for name in NOISY
    for own in KICKS
    if not zoo.ZOO[name].scene.constraints or (isinstance(own, vp.Midpoint | vp.Gauss) and own.kick != "split")
]
over_kicks = pytest.mark.parametrize(("name", "integrator"), KICKED, ids=str)


@over_kicks
def test_kicks(name, integrator):
    case = zoo.ZOO[name]
    step = Step(case, integrator, False)
    u, dt = step.u, step.dt
    dw = np.sqrt(dt) * np.random.default_rng(1).normal(size=case.scene.processes)
    q, v = step.motion.q[2], step.motion.v[2]
    noisy = vp.simulate(
        case.scene, q, v, dt=dt, steps=1, controls=u, integrator=integrator, increments=dw[None], check=False
    )
    held = getattr(integrator, "kick", "") == "held"
    before = 0.0 if held or isinstance(integrator, vp.ExplicitEuler) else getattr(integrator, "left", 1.0)
    impulse, own = fields(case, q, u) @ dw, Mechanism(case.scene)
    if held:
        u = u + np.linalg.solve(case.scene.actuation, impulse / dt)
    start = v + np.linalg.solve(own.mass_matrix(q), before * impulse)
    if case.scene.constraints:
        start = own.tangent(q, start)
    quiet = vp.simulate(
        case.scene, q, start, dt=dt, steps=1, controls=u, integrator=integrator, increments=0.0, check=False
    )
    after = (0.0 if held else 1.0 - before) * (fields(case, quiet.q[1], u) @ dw)
    if isinstance(integrator, vp.ExplicitEuler):
        after = own.mass_matrix(quiet.q[1]) @ np.linalg.solve(own.mass_matrix(q), impulse)
    end = quiet.v[1] + np.linalg.solve(own.mass_matrix(quiet.q[1]), after)
    if case.scene.constraints:
        end = own.tangent(quiet.q[1], end)
    np.testing.assert_allclose(noisy.q[1], quiet.q[1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(noisy.v[1], end, rtol=0, atol=1e-10 * np.abs(end).max())


@over_kicks
def test_derivatives_of_kicks(name, integrator):
    case = zoo.ZOO[name]
    step, rng = Step(case, integrator, False), np.random.default_rng(3)
    n, k = step.n, case.scene.processes
    lin = vp.linearize(case.scene, step.motion)
    z, zero = np.append(step.x, step.u), np.zeros(k)
    for i in range(k):
        found = slope(lambda dw: step.of(z, dw), zero, np.eye(k)[i], 5e-3) / step.rows
        np.testing.assert_allclose(
            lin.G[-1][:, i] / step.rows, found, rtol=0, atol=1e-8 * max(1.0, np.abs(found).max())
        )
    e = step.direction(rng)
    K, G = lin.K[-1], lin.G[-1]

    def jump(y: np.ndarray) -> np.ndarray:
        F = fields(case, y[:n], y[2 * n :])
        return F if integrator.variational else np.linalg.solve(inertia(case, y[:n]), F)

    def after(y: np.ndarray) -> np.ndarray:
        return fields(case, step.of(y)[:n], y[2 * n :])

    J, left = lin.J[-1], getattr(integrator, "left", 1.0)
    whole, moved = left * K @ fields(case, step.x[:n], step.u), left * J @ slope(jump, z, e, 5e-3)
    if left < 1.0:
        whole[n:] += (1.0 - left) * after(z)
        moved[n:] += (1.0 - left) * slope(after, z, e, 5e-3)
    np.testing.assert_allclose(G, whole, rtol=0, atol=1e-11 * np.abs(G).max())
    by_fields = lin.Gx[-1] @ e[: 2 * n] + lin.Gu[-1] @ e[2 * n :]
    np.testing.assert_allclose(by_fields, moved, rtol=0, atol=1e-8 * np.abs(J).max())


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.Radau(3, kick="held"), vp.RungeKutta4()], ids=str)
def test_kicks_along_lines(integrator):
    """Noise of controls on a line has the increments of their mean, and those of their slope over sqrt(12)."""
    case = zoo.ZOO["trembling torques"]
    step = Step(case, integrator, True)
    lin, m = vp.linearize(case.scene, step.motion), case.scene.controls
    q, before, after = step.x[: step.n], step.u[:m], step.u[m:]
    F = fields(case, q, 0.5 * (before + after))
    sloped = (fields(case, q, after) - fields(case, q, before))[:, :m] / np.sqrt(12.0)
    np.testing.assert_allclose(lin.G[-1], lin.K[-1] @ np.hstack([F, sloped]), rtol=0, atol=1e-12)
    found = jacobian(lambda dw: step.of(np.append(step.x, step.u), dw), np.zeros(F.shape[1] + m), 5e-3)
    np.testing.assert_allclose(lin.G[-1], found, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NOISY)
def test_paths(name):
    case, integrator = zoo.ZOO[name], vp.Midpoint()
    paths = [motion_of(case, integrator, BY_NAME["rows"], 5, rng=seed) for seed in (3, 3, 4)]
    assert paths[0].q.tobytes() == paths[1].q.tobytes() != paths[2].q.tobytes()
    again = motion_of(case, integrator, BY_NAME["rows"], 5, increments=paths[0].dw)
    assert again.q.tobytes() == paths[0].q.tobytes()
    still = motion_of(case, integrator, BY_NAME["rows"], 5)
    halves = wiener.refine(paths[0].dw, paths[0].dt, rng=1)
    np.testing.assert_allclose(halves[::2] + halves[1::2], paths[0].dw, rtol=0, atol=1e-14)
    fine = motion_of(case, integrator, BY_NAME["rows"], 10, increments=halves)
    assert np.abs(fine.q[::2] - paths[0].q).max() < 0.5 * np.abs(still.q - paths[0].q).max()


@pytest.mark.parametrize("name", ["pushed joint", "steered joint", "cranked five-bar"])
def test_inputs_between_calls_of_a_law(name):
    case, parts = zoo.ZOO[name], 3
    late = case.span / PIECES

    def law(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return prescribed(case, t + late, case.swing(t))

    motion = motion_of(case, vp.Gauss(2), Signal("", lambda *_: {"controls": law, "period": parts}, None), parts)
    (own,) = (own for own in case.scene.constraints if isinstance(own, vp.KinematicInput))
    way = [case.path(t)[0][0] for t in motion.t]
    np.testing.assert_allclose(motion.q[:, motion.joint_names.index(own.joint)], way, rtol=0, atol=1e-12)


# --- records ---------------------------------------------------------------------------------------------------------


@over_some
def test_records(case, integrator, signal, tmp_path):
    motion = motion_of(case, integrator, signal, 2, check=True)
    assert same(motion, motion_of(case, integrator, signal, 2, check=True))
    back = vp.Trajectory.load(motion.save(tmp_path / "motion.npz"))
    assert same(motion, back)
    assert same(motion, pickle.loads(pickle.dumps(motion)))
    assert same(vp.linearize(case.scene, back), vp.linearize(case.scene, motion))
    if case.name not in ("custom force", "custom noise"):
        scene = pickle.loads(pickle.dumps(case.scene))
        moved = dataclasses.replace(case, build=lambda: scene)
        assert same(motion, motion_of(moved, integrator, signal, 2, check=True))


@over_some
def test_halves(case, integrator, signal):
    # Guards that divide a step would begin afresh.
    integrator = dataclasses.replace(integrator, guard=None) if integrator.variational else integrator
    whole, k = motion_of(case, integrator, signal, 6), 3 * PIECES
    given = signal.given(case, 6, integrator.variational).get("controls")
    if isinstance(given, vp.OpenLoop):
        left = vp.OpenLoop(lambda t: given.f(t + 0.5 * case.span))
    elif isinstance(given, vp.FirstOrderHold):
        left = vp.FirstOrderHold(given.u[k:])
    else:
        left = vp.FirstOrderHold(whole.u_nodes[k:]) if whole.u_nodes.size else whole.u[k:]
    rest = vp.simulate(
        case.scene, whole.q[k], whole.v[k], dt=whole.dt, steps=k, controls=left, integrator=integrator, check=False,
        increments=0.0 if case.scene.processes else None,
    )  # fmt: skip
    for name in ("q", "v", "p", "energy"):
        found, own = getattr(rest, name), getattr(whole, name)[k:]
        np.testing.assert_allclose(found, own, rtol=0, atol=1e-9 * (1e-12 + np.abs(own).max()), err_msg=name)
    for node in (0, k, 2 * k):
        p = inertia(case, whole.q[node]) @ whole.v[node]
        np.testing.assert_allclose(whole.p[node], p, rtol=0, atol=1e-10 * (1e-12 + np.abs(p).max()))
    part = whole.part(k, 2 * k - 1)
    for name in ("q", "v", "p", "energy", "u", "dw", "constraint_forces"):
        assert same(getattr(part, name), getattr(whole, name)[k:-1]), name
    assert same(vp.linearize(case.scene, part).A, vp.linearize(case.scene, whole).A[k:-1])
    assert whole.constraint_labels == case.scene.constraint_labels


# Without inputs, which move along the lines or cubics of each step, whatever the path between its nodes.
FREELY = [one for one in MOTIONS if one.values[0].path is None and not one.marks]


@pytest.mark.parametrize(("case", "integrator", "signal"), FREELY)
def test_error(case, integrator, signal):
    """The error is the distance from the continuous motion; it is told from 1 % of the travel on, not below 0.7 %."""
    own = oracle(case, signal, integrator.variational)
    motion = motion_of(case, integrator, signal, 5, check=True)
    off, v_off = np.abs(motion.q[::5] - own.q), np.abs(motion.v[::5] - own.v).max(axis=0)
    rel = 0.5 if case.scene.servo_joints else 0.1
    assert motion.error[::5].max() == pytest.approx(off.max(), rel=rel, abs=1e-9)
    assert np.abs(motion.error[::5] - off).max() < 2.0 * rel * off.max() + 1e-9
    assert motion.error_bound is None or motion.error_bound > off.max() - 1e-9
    assert not motion.error.flags.writeable
    told = any(finding.kind == "error" for finding in motion.warnings)
    share = off.max() / np.ptp(motion.q, axis=0).max()
    fast = (v_off / np.abs(own.v).max(axis=0)).max() > 0.2
    assert told or not share > 0.0105
    assert not told or share > 0.007 or fast


@pytest.mark.parametrize("name", list(zoo.ZOO))
def test_right_motions_have_no_warnings_of_errors(name):
    case = zoo.ZOO[name]
    signal = PATHS[0] if case.path is not None else SIGNALS[0]
    motion = motion_of(case, vp.Gauss(2), signal, 10, check=True)
    own = oracle(case, signal, True)
    assert np.abs(motion.q[::10] - own.q).max() < 1e-4
    assert all("limits" in told.kind for told in motion.warnings), motion.warnings
