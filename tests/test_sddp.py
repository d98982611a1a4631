"""S-DDP against a plain Riccati recursion, scipy, differences of the rolled-out cost, and brute force."""

import re
import tracemalloc
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import random_inertia
from refusals import refused

import varpin as vp
from varpin.errors import UnknownName

WEIGHTS = {1: 2 / 3, 2: -1 / 12}
SAMPLINGS = ["midpoint", "gauss", "start"]


def sliders(count, seed=0):
    """A chain of oblique prismatic joints: its mass matrix is constant, and full."""
    rng = np.random.default_rng(seed)
    model = pin.Model()
    model.name = f"sliders{count}"
    for k in range(count):
        axis = rng.normal(size=3)
        kind = pin.JointModelPrismaticUnaligned(axis / np.linalg.norm(axis))
        new = model.addJoint(k, kind, pin.SE3.Identity(), f"joint{k}")
        model.appendBodyToJoint(new, random_inertia(rng), pin.SE3.Identity())
    return vp.load_robot(model)


class Plain:
    """The matrices of M q'' + D q' + K q = B u, discretized by hand."""

    def __init__(self, scene, dt, integrator):
        n = scene.robot.dof
        model = scene.robot.model
        M = pin.crba(model, model.createData(), pin.neutral(model))
        M = np.triu(M) + np.triu(M, 1).T
        D, K, one, zero = np.diag(scene.damping), np.diag(scene.stiffness), np.eye(n), np.zeros((n, n))
        self.n, self.M, self.rest = n, M, np.linalg.solve(M, K @ scene.rest)
        inverse = np.linalg.inv(M)
        if isinstance(integrator, vp.Midpoint):
            # p0 = M v + h/2 (K qm + D v - f) and p1 = M v - h/2 (K qm + D v - f), qm = q0 + h v / 2.
            S = np.linalg.inv(M + dt / 2 * D + dt**2 / 4 * K)
            v0, v1 = np.hstack([-dt / 2 * S @ K, S]), dt / 2 * S
            q = np.hstack([one, zero]) + dt * v0
            p = np.hstack([zero, -one]) + 2 * M @ v0
            self.A, self.Bf = np.vstack([q, p]), np.vstack([dt * v1, 2 * M @ v1])
            self.V = np.hstack([zero, inverse])
            self.kick = integrator.left * self.A[:, n:]
            self.kick[n:] += (1.0 - integrator.left) * one
            self.c = self.Bf @ K @ scene.rest
        else:
            Ac = np.block([[zero, one], [-inverse @ K, -inverse @ D]])
            Bc = np.vstack([zero, inverse])
            terms = 1 if isinstance(integrator, vp.ExplicitEuler) else 4
            power, self.A, series = np.eye(2 * n), np.eye(2 * n), np.zeros((2 * n, 2 * n))
            for k in range(1, terms + 1):
                series = series + power * dt / k
                power = power @ Ac * dt / k
                self.A = self.A + power
            self.Bf = series @ Bc
            self.V = np.hstack([zero, one])
            jump = np.vstack([zero, inverse])
            self.kick = jump if terms == 1 else self.A @ jump
            self.c = self.Bf @ K @ scene.rest
        self.B = self.Bf @ scene.actuation
        self.dt = dt


FULL = np.random.default_rng(0).normal(size=(3, 3))
WEIGHTS_OF = {"q": FULL @ FULL.T, "v": np.diag([0.1, 0.2, 0.3]), "u": 0.05 * np.eye(2)}
AIMS = {"v": [0.1, 0.0, -0.1], "u": [0.3, -0.1], "end": [1.0, 0.5, -0.5]}


def riccati(plain, problem, added, tremble):
    """Gains, and the expected cost, of ``lq_problem`` sampled at the starts of steps; forms are in (x, 1).

    Noise is ``added`` to each joint's force, and controls ``tremble`` in proportion to themselves.
    """
    n, m, h = plain.n, problem.scene.controls, plain.dt
    pick, zero = np.hstack([np.eye(n), np.zeros((n, n))]), np.zeros(n)

    def form(part, aim, weight):
        E = np.hstack([part, -np.asarray(aim, float)[:, None]])
        return 2.0 * E.T @ weight @ E

    P = form(pick, AIMS["end"], 3.0 * np.eye(n)) + form(plain.V, zero, 0.7 * np.eye(n))
    A = np.block([[plain.A, plain.c[:, None]], [np.zeros((1, 2 * n)), np.ones((1, 1))]])
    B, kicks, gains = np.vstack([plain.B, np.zeros((1, m))]), plain.kick @ problem.scene.actuation, []
    for j in range(problem.steps - 1, -1, -1):
        S, u_aim = P[:-1, :-1], np.array(AIMS["u"])
        trembling = h * tremble**2 * np.diag(np.einsum("ai,ab,bi->i", kicks, S, kicks))
        Quu = 2.0 * h * WEIGHTS_OF["u"] + B.T @ P @ B + trembling
        Qux = B.T @ P @ A
        Qux[:, -1] -= 2.0 * h * WEIGHTS_OF["u"] @ u_aim
        K = -np.linalg.solve(Quu, Qux)
        gains.append(K)
        aim = problem.cost.terms[0].reference(j * h)
        running = h * (form(pick, aim, WEIGHTS_OF["q"]) + form(plain.V, AIMS["v"], WEIGHTS_OF["v"]))
        running[-1, -1] += 2.0 * h * u_aim @ WEIGHTS_OF["u"] @ u_aim
        running[-1, -1] += h * added**2 * np.trace(plain.kick.T @ S @ plain.kick)
        P = running + A.T @ P @ A + Qux.T @ K
    second = plain.M @ problem.v0 if problem.integrator.variational else problem.v0
    start = np.concatenate([problem.q0, second, [1.0]])
    return np.array(gains[::-1]), 0.5 * start @ P @ start


def lq_problem(integrator, sampling, noise=None, steps=40):
    scene = vp.Scene(
        sliders(3),
        gravity=False,
        damping=[0.3, 0.1, 0.2],
        stiffness=[1.0, 0.0, 2.0],
        rest=[0.1, -0.2, 0.3],
        actuation=np.random.default_rng(4).normal(size=(3, 2)),
        noise=noise,
    )
    cost = (
        vp.TrackingCost(lambda t: [np.sin(3 * t), 0.2, t], WEIGHTS_OF["q"])
        + vp.VelocityCost([0.1, 0.2, 0.3], reference=AIMS["v"])
        + vp.ControlCost(0.05, reference=AIMS["u"])
        + vp.Terminal(vp.TrackingCost(AIMS["end"], 3.0) + vp.VelocityCost(0.7))
    )
    return vp.OptimalControlProblem(
        scene, cost, [0.3, -0.4, 0.2], [0.5, 0.1, -0.6], dt=0.03, steps=steps, integrator=integrator, sampling=sampling
    )


LINEAR = [vp.Midpoint(), vp.ExplicitEuler(), vp.RungeKutta4()]


def run(problem, controls):
    return vp.simulate(
        problem.scene,
        problem.q0,
        problem.v0,
        dt=problem.dt,
        steps=problem.steps,
        controls=np.repeat(controls, problem.hold, axis=0),
        integrator=problem.integrator,
        check=False,
    )


@pytest.mark.parametrize("integrator", [*LINEAR, vp.Midpoint(kick="split")], ids=str)
def test_riccati_with_multiplicative_noise(integrator):
    """One step solves it; gains and expected cost are those of the recursion by hand."""
    problem = lq_problem(integrator, "start", vp.AdditiveNoise(0.2) + vp.ControlNoise(0.5))
    sol = vp.solve(problem)
    motion, plain = sol.trajectory, Plain(problem.scene, problem.dt, integrator)
    # The discretization by hand is that of the library.
    x = np.hstack([motion.q, motion.p if integrator.variational else motion.v])
    np.testing.assert_allclose(x[1:], x[:-1] @ plain.A.T + motion.u @ plain.B.T + plain.c, rtol=0, atol=1e-12)
    policies, value = riccati(plain, problem, 0.2, 0.5)
    assert sol.status is vp.Status.CONVERGED
    assert sol.iterations == 1
    assert sol.expected_cost == pytest.approx(value, rel=1e-10)
    assert sol.noise_cost > 0.02 * value
    np.testing.assert_allclose(sol.gains, policies[:, :, :-1], rtol=0, atol=1e-10 * np.abs(policies).max())


def test_line_search_is_on_the_expected_cost():
    """From the best motion without noise a whole step is taken, although the cost without noise rises."""
    problem = lq_problem(vp.Midpoint(), "midpoint", vp.ControlNoise(0.5))
    plain = vp.solve(lq_problem(vp.Midpoint(), "midpoint"))
    sol = vp.solve(problem, plain)
    assert sol.history[0].step == 1.0
    assert sol.history[0].cost > plain.cost * (1 + 1e-5)
    assert sol.expected_cost < plain.cost + sol.history[0].noise_cost


def moved_cost(problem, controls):
    return problem.cost_of(run(problem, controls))


def differences(function, x, size):
    """Gradient at x of any shape, by differences of fourth order."""
    gradient = np.empty(x.size)
    for j in range(x.size):
        e = np.zeros(x.size)
        e[j] = size
        e = e.reshape(x.shape)
        gradient[j] = sum(w * (function(x + i * e) - function(x - i * e)) for i, w in WEIGHTS.items()) / size
    return gradient.reshape(x.shape)


GRADIENT_INTEGRATORS = [vp.Midpoint(), vp.Midpoint(alpha=0.3), vp.ExplicitEuler(), vp.RungeKutta4()]


def arm_problem(name, integrator, sampling="midpoint", hold=1, noise=None, steps=12, dt=None):
    robot = vp.load_robot(name)
    n = robot.dof
    light = name == "finger"
    scene = vp.Scene(robot, damping=1e-7 if light else 0.2, noise=noise)
    cost = (
        vp.TrackingCost(lambda t: 0.3 + 0.2 * np.sin(20 * t + np.arange(n)), np.linspace(1.0, 2.0, n))
        + vp.VelocityCost(0.01)
        + vp.ControlCost(1e8 if light else 1e-3)
        + vp.Terminal(vp.TrackingCost(np.full(n, 0.2), 0.5) + vp.VelocityCost(0.03, reference=0.1))
    )
    return vp.OptimalControlProblem(
        scene,
        cost,
        np.linspace(0.2, 0.7, n),
        np.linspace(-0.5, 0.4, n),
        dt=dt or (2e-3 if light else 1e-2),
        steps=steps,
        integrator=integrator,
        sampling=sampling,
        hold=hold,
    )


def arm_controls(problem, seed=3):
    """Around what holds the arm; nothing does the finger in zero gravity."""
    base = problem.holding_controls() + (2e-5 if problem.scene.robot.name == "finger" else 0.0)
    shape = (problem.decisions, problem.scene.controls)
    return base + 0.3 * np.abs(base).max() * np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_rest_costs_no_velocities(sampling):
    """Not even those of rounding: a search weighs constraints by what is at stake."""
    at = np.random.default_rng(0).normal(size=4)
    given = {"q0": at, "v0": np.zeros(4), "dt": 0.03, "steps": 20, "sampling": sampling}
    problem = vp.OptimalControlProblem(vp.Scene(vp.planar_chain(4)), vp.VelocityCost(1.0), **given)
    assert problem.costs(np.tile(at, (21, 1)), np.zeros((21, 4)), np.zeros((20, 4))) == 0.0


@pytest.mark.parametrize("hold", [1, 3])
@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize("integrator", GRADIENT_INTEGRATORS, ids=str)
@pytest.mark.parametrize("name", ["finger", "ur5"])
def test_gradient(name, integrator, sampling, hold):
    problem = arm_problem(name, integrator, sampling, hold)
    controls = arm_controls(problem)
    expected = differences(lambda u: moved_cost(problem, u), controls, 3e-3 * np.abs(controls).max())
    given = vp.solve(problem, controls, max_iterations=0, check=False).gradient
    np.testing.assert_allclose(given, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def swing(second_order, *, sampling="midpoint", hold=1, tolerance=1e-13):
    """From upright to hanging in a second, on a budget."""
    return vp.solve(swing_problem(sampling, hold), second_order=second_order, tolerance=tolerance, max_iterations=200)


def swing_problem(sampling="midpoint", hold=1, steps=50, duration=1.0):
    scene = vp.Scene(vp.planar_chain(2))
    end = vp.TrackingCost([-np.pi / 2, 0.0], 50.0) + vp.VelocityCost(5.0)
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(0.01) + vp.Terminal(end)
    return vp.OptimalControlProblem(
        scene,
        cost,
        [np.pi / 2, 0.0],
        [0, 0],
        dt=duration / steps,
        steps=steps,
        integrator=vp.Midpoint(),
        sampling=sampling,
        hold=hold,
    )


@pytest.mark.parametrize(("sampling", "hold"), [("midpoint", 1), ("gauss", 1), ("start", 1), ("midpoint", 5)])
def test_quadratic_convergence(sampling, hold):
    """The promised decrease goes with the square of the gradient: each is the square of the one before, in units."""
    newton = swing(True, sampling=sampling, hold=hold, tolerance=1e-15)
    gauss = swing(False, sampling=sampling, hold=hold)
    assert newton.status is gauss.status is vp.Status.CONVERGED
    assert newton.cost == pytest.approx(gauss.cost, rel=1e-12)
    promised = np.log([item.expected_decrease / newton.cost for item in newton.history])
    assert promised[-1] < np.log(1e-14)
    # Rounding may limit the last.
    assert max(promised[-1] / promised[-2], promised[-2] / promised[-3]) > 1.6
    linear = np.log([item.expected_decrease / gauss.cost for item in gauss.history])
    assert linear[-1] / linear[-2] < 1.1
    # Far from the optimum both go alike; it is near it that Newton's method takes fewer iterations.
    near = np.log(1e-5)
    assert (promised < near).sum() <= 0.6 * (linear < near).sum()
    np.testing.assert_allclose(newton.controls, gauss.controls, rtol=0, atol=1e-5 * np.abs(gauss.controls).max())


def reach_problem(dt, sampling="midpoint", integrator=vp.Midpoint(), hold=1):  # noqa: B008 - it is frozen
    """An arm that follows a function of time, the same at every dt."""
    start, reach = np.array([0.0, -1.5, 1.5, 0.0, 0.5, 0.0]), np.array([0.5, 0.3, -0.3, 0.3, 0.2, 0.2])
    duration = 0.48

    def reference(t):
        return start + reach * np.sin(3 * t) ** 2

    cost = (
        vp.TrackingCost(reference, 10.0)
        + vp.VelocityCost(0.05)
        + vp.ControlCost(1e-2)
        + vp.Terminal(vp.TrackingCost(reference(duration), 2.0) + vp.VelocityCost(0.1))
    )
    return vp.OptimalControlProblem(
        vp.Scene(vp.load_robot("ur5"), damping=1.0),
        cost,
        start,
        np.zeros(6),
        dt=dt,
        steps=round(duration / dt),
        integrator=integrator,
        sampling=sampling,
        hold=hold,
    )


def slopes(values, ratio):
    moved = [np.abs(np.asarray(a) - b).max() for a, b in pairwise(values)]
    return [np.log(a / b) / np.log(ratio) for a, b in pairwise(moved)]


@pytest.mark.parametrize(
    ("integrator", "sampling", "holds", "order"),
    [
        (vp.Midpoint(), "midpoint", (4, 8, 16), 1.9),
        (vp.RungeKutta4(), "midpoint", (4, 8, 16), 1.9),
        (vp.Midpoint(), "start", (8, 16, 32), 0.9),
        (vp.RungeKutta4(), "gauss", (2, 4, 8), 3.7),
    ],
    ids=str,
)
def test_sampled_data_plans_converge_with_the_order_of_sampling(integrator, sampling, holds, order):
    """Controls held over 40 ms in ever finer steps: everything that a user gets converges."""
    costs, controls, gains, late = [], [], [], []
    for hold in holds:
        sol = vp.solve(reach_problem(0.04 / hold, sampling, integrator, hold), tolerance=1e-14)
        found = sol.policy_on("velocity").gains
        costs.append(sol.cost)
        controls.append(sol.controls)
        gains.append(found[0])
        late.append(found[6])
    found = [slopes(values, 2)[0] for values in (costs, controls, gains, late)]
    assert min(found) > order
    # A left sum is of first order and no better.
    assert sampling != "start" or max(found[:2]) < 1.1


def test_iterations_do_not_depend_on_dt():
    found = [vp.solve(reach_problem(dt)).iterations for dt in (0.02, 0.01, 0.004, 0.002, 0.001)]
    assert max(found) - min(found) <= 2


def small(cost=None, *, noise=None, actuation=None, **options):
    """Two sliders to (1, 0) in a second."""
    scene = vp.Scene(sliders(2), gravity=False, noise=noise, actuation=actuation)
    goal = vp.TrackingCost([1.0, 0.0])
    cost = goal + vp.ControlCost(0.1) + vp.Terminal(goal) if cost is None else cost
    return vp.OptimalControlProblem(scene, cost, [0.3, 0.1], [0, 0], **{"dt": 0.05, "steps": 20, **options})


def test_reason_gives_the_numbers_behind_the_status():
    sol = vp.solve(reach_problem(0.02), tolerance=1e-6)
    assert sol.status is vp.Status.CONVERGED
    promise, tolerance = (float(part) for part in re.findall(r"\d\.\de[+-]\d\d", sol.reason))
    assert promise == pytest.approx(sol.history[-1].expected_decrease, rel=0.06)
    assert tolerance == pytest.approx(1e-6 * sol.cost, rel=0.06)
    assert promise <= tolerance
    short = vp.solve(reach_problem(0.02), max_iterations=1)
    promise, tolerance = (float(part) for part in re.findall(r"\d\.\de[+-]\d\d", short.reason))
    assert short.status is vp.Status.MAX_ITERATIONS
    assert promise > tolerance


def test_a_cost_of_nothing_is_an_optimum_also_where_the_controls_are_not_unique():
    """A goal alone: many controls reach it, so the model needs regularization, and none does better than nothing."""
    goal = vp.Terminal(vp.TrackingCost([0.3, 0.1]))
    problem = vp.OptimalControlProblem(
        vp.Scene(vp.planar_chain(2), gravity=False), goal, np.zeros(2), np.zeros(2), dt=0.01, steps=50
    )
    sol = vp.solve(problem)
    assert sol.status is vp.Status.CONVERGED
    assert sol.cost < 1e-16 * 0.1
    assert sol.iterations < 10
    there = problem.at(q0=[0.3, 0.1])
    assert vp.solve(there, np.zeros(2)).status is vp.Status.CONVERGED
    assert vp.solve(there, np.zeros(2)).iterations == 0
    # A cost of one's own may go below nothing, and where it starts at 0 that is no optimum.
    below = vp.CustomCost(lambda t, q, v, u: u[:, 0] + (u**2).sum(axis=1))
    own = vp.solve(small(below), np.zeros(2))

    assert own.cost < -0.1 * own.problem.duration


def test_no_minimum():
    """Controls that do nothing and cost nothing have no best value."""
    for actuation, cost in (([[0.0], [0.0]], vp.TrackingCost(0.0)), (None, vp.TrackingCost(0.0))):
        problem = small(cost, actuation=actuation, sampling="start")
        sol = vp.solve(problem)
        assert sol.status is vp.Status.INDEFINITE
        assert "ControlCost" in sol.status.value
        assert sol.iterations == 0
        assert sol.cost == problem.cost_of(sol.trajectory)
        np.testing.assert_array_equal(sol.gains, 0.0)
    # Where a midpoint is looked at, the last control does something.
    assert vp.solve(small(vp.TrackingCost(0.0), sampling="midpoint")).status is vp.Status.CONVERGED


def test_idle_actuator():
    """A control without effect or cost beside one that has both stays where it is."""
    cost = vp.TrackingCost(0.0) + vp.ControlCost([0.1, 0.0])
    sol = vp.solve(small(cost, actuation=[[1.0, 0.0], [0.5, 0.0]]), controls=[0.0, 0.7])
    assert sol.status is vp.Status.CONVERGED
    np.testing.assert_array_equal(sol.controls[:, 1], 0.7)


def test_heavy_regularization_is_not_mistaken_for_an_optimum():
    best = vp.solve(small())
    sol = vp.solve(small(), regularization=1e12)
    assert sol.status is vp.Status.CONVERGED
    assert sol.cost == pytest.approx(best.cost, rel=1e-6)
    assert vp.solve(small(), regularization=1e12, max_iterations=0).status is vp.Status.MAX_ITERATIONS


def test_first_motion_that_cannot_be_integrated():
    scene = vp.Scene(sliders(2), gravity=False, stiffness=1e9)
    cost = vp.TrackingCost(0.0) + vp.ControlCost(1.0)
    problem = vp.OptimalControlProblem(
        scene, cost, [0.3, 0.1], [0, 0], dt=0.05, steps=400, integrator=vp.ExplicitEuler()
    )
    with refused(vp.StepFailure, "finite") as caught:
        vp.solve(problem, controls=[0.0, 0.0])
    assert 0 < caught.value.trajectory.steps < 400
    assert caught.value.step == caught.value.trajectory.steps
    assert np.isfinite(caught.value.trajectory.q).all()


def test_cost_that_is_not_finite():
    never = vp.CustomCost(lambda t, q, v, u: np.where(t > 0.5, np.nan, 0.0), name="never")
    with refused(vp.CostError, "CustomCost('never')", "nan"):
        vp.solve(small(vp.ControlCost(1.0) + never))
    with refused(vp.CostError, "Terminal(CustomCost('end'))", "inf"):
        vp.solve(
            small(vp.ControlCost(1.0) + vp.Terminal(vp.CustomCost(lambda t, q, v, u: np.inf + 0.0 * t, name="end")))
        )
    far = vp.CustomCost(lambda t, q, v, u: np.where(q[:, 0] > 0.8, np.nan, (q[:, 0] - 1.0) ** 2), name="far")
    problem = small(vp.ControlCost(1e-3) + far)
    sol = vp.solve(problem)
    assert np.isfinite(sol.cost)
    assert sol.cost < vp.solve(problem, max_iterations=0).cost


def test_warm_starts():
    problem = reach_problem(0.02)
    sol = vp.solve(problem, tolerance=1e-10)
    cold = sol.iterations
    # From another state the policy is a better start than its controls.
    moved = problem.at(q0=problem.q0 + 0.05)
    by_policy, by_controls = (vp.solve(moved, start, max_iterations=0).cost for start in (sol, sol.controls))
    assert by_policy < by_controls
    assert vp.solve(moved, sol).iterations < cold
    # The next horizon.
    later = problem.at(q0=sol.trajectory.q[1], v0=sol.trajectory.v[1])
    shifted = sol.shifted(1)
    np.testing.assert_array_equal(shifted.u[:-1], sol.controls[1:])
    np.testing.assert_array_equal(shifted.u[-1], sol.controls[-1])
    np.testing.assert_array_equal(shifted.gains[:-1], sol.gains[1:])
    assert vp.solve(later, shifted).iterations <= cold
    assert len(sol.shifted(problem.decisions - 1).u) == problem.decisions
    for wrong in (-1, problem.decisions, 1.5):
        with refused(vp.InputError, "decisions"):
            sol.shifted(wrong)


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: vp.solve("finger"), ("OptimalControlProblem", "str")),
        (lambda: vp.solve(small(), tolerance=0.0), "tolerance"),
        (lambda: vp.solve(small(), tolerance=np.nan), "tolerance"),
        (lambda: vp.solve(small(), regularization=-1.0), "regularization"),
        (lambda: vp.solve(small(), max_iterations=1.5), "max_iterations"),
        (lambda: vp.solve(small(), max_iterations=-1), ("max_iterations", "0")),
        (lambda: vp.solve(small(integrator=vp.ExplicitEuler()), second_order=True), "ExplicitEuler"),
        (lambda: small(dt=0.0), "dt"),
        (lambda: small(steps=0), ("steps", "1")),
        (lambda: small(hold=3), ("steps = 20", "hold = 3")),
        (lambda: small(hold=0), ("hold", "1")),
        (lambda: small(sampling="end"), "sampling"),
        (lambda: small(integrator="rk4"), "integrator"),
        (lambda: small(actuation=[]), "controls"),
        (lambda: small("cheap"), "cost"),
        (lambda: small().at(q0=[0.0]), "q0"),
        (lambda: small().at(v0=[0.0, np.inf]), "v0"),
        (lambda: small().cost_of(vp.simulate(small().scene, [0, 0], [0, 0], dt=0.05, steps=3)), "3 steps"),
        (lambda: vp.solve(small(hold=2), np.zeros((20, 2))), ("controls", "(10, 2)", "(20, 2)")),
        (lambda: vp.solve(small(), [np.nan, 0.0]), "controls"),
        (lambda: vp.solve(small(hold=2), vp.solve(small())), ("controls", "1", "2")),
        (lambda: vp.solve(small(steps=40), vp.solve(small())), ("20", "40")),
    ],
)
def test_what_is_refused(make, facts):
    with refused(vp.InputError, facts):
        make()


def test_the_same_problem_otherwise():
    problem = small(hold=2)
    finer = problem.at(dt=0.025)
    assert (finer.steps, finer.dt, finer.hold) == (40, 0.025, 2)
    assert finer.duration == problem.duration
    longer = problem.at(dt=0.1, steps=40)
    assert longer.duration == pytest.approx(4.0)
    assert problem.at(integrator=vp.RungeKutta4(), sampling="start", hold=5).decisions == 4
    np.testing.assert_array_equal(problem.at(q0=[1, 2]).q0, [1, 2])
    for dt in (0.3, 3.0):
        with refused(vp.InputError, "dt"):
            problem.at(dt=dt)
    for dt in (-0.1, "fast"):
        with refused(vp.InputError, "dt"):
            problem.at(dt=dt)
    for value in (None, 30):
        with refused(UnknownName, "'stpes'", "'steps'"):
            problem.at(stpes=value)
    rows = vp.TrackingCost(np.zeros((21, 2)))
    with refused(vp.InputError, "(41, 2)"):
        small(rows).at(dt=0.025)


@pytest.mark.parametrize(("noise", "most"), [(None, 4e3), (vp.ControlNoise(0.05), 10e3)], ids=["quiet", "noisy"])
def test_memory(noise, most):
    """Bytes a node at three joints, of the search with all its expansions, and of the plan alone."""
    peaks, kept = [], []
    for steps in (5000, 20000):
        problem = arm_problem("finger", vp.Midpoint(), steps=steps, dt=1e-4, noise=noise)
        tracemalloc.start()
        plan = vp.solve(problem, max_iterations=1, check=False)
        for sizes, size in zip((kept, peaks), tracemalloc.get_traced_memory(), strict=True):
            sizes.append(size)
        tracemalloc.stop()
        del plan
    assert (peaks[1] - peaks[0]) / 15000 < most
    assert (kept[1] - kept[0]) / 15000 < 500.0
