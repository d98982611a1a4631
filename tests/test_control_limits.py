"""Limits of controls: the box minimum against SciPy's, optimality signs, saturation everywhere, arms within them."""

import numpy as np
import pytest
from refusals import refused
from scipy.optimize import lsq_linear
from test_sddp import sliders

import varpin as vp
from varpin.control import backward as whole
from varpin.control import box, passes
from varpin.control.along import Along, Limits
from varpin.control.backward import backward
from varpin.control.penalties import penalized
from varpin.core import box_minimum
from varpin.model.kinematics import frame_kinematics


def quadratic(rng, m, condition):
    """A random convex quadratic function and a box that its minimum is often outside of."""
    V = np.linalg.qr(rng.normal(size=(m, m)))[0]
    H = (V * np.logspace(0, np.log10(condition), m)) @ V.T
    limits = np.sort(rng.normal(size=(2, m)), axis=0)
    infinite = rng.random((2, m)) < 0.15
    limits[infinite] = np.broadcast_to([[-np.inf], [np.inf]], (2, m))[infinite]
    return 0.5 * (H + H.T), H @ rng.normal(size=m), limits


@pytest.mark.parametrize("condition", [1.0, 1e3, 1e8])
@pytest.mark.parametrize("m", [1, 2, 3, 6, 12])
def test_box_minimum(m, condition):
    """As SciPy's active-set least squares finds it, from any first guess, with the factors of the free part.

    Where SciPy stops before the minimum, as it does far from well conditioned, signs and value tell.
    """
    rng = np.random.default_rng(m)
    held_at_all = 0
    for _ in range(40):
        H, g, limits = quadratic(rng, m, condition)
        L = np.linalg.cholesky(H)
        wide = np.where(np.isfinite(limits), limits, np.sign(limits) * 1e12)
        reference = lsq_linear(L.T, -np.linalg.solve(L, g), wide, method="bvls", tol=1e-14, max_iter=200).x
        x, F, held = box_minimum(H, g, limits, 5.0 * rng.normal(size=m))
        held_at_all += held.sum()
        assert ((x >= limits[0]) & (x <= limits[1])).all()
        assert ((x == limits[0]) | (x == limits[1]))[held].all()
        if condition < 1e6:
            np.testing.assert_allclose(x, reference, atol=1e-11 * (np.abs(reference).max() + 1.0))
        change = x - reference
        assert (g + 0.5 * H @ (x + reference)) @ change <= 1e-14 * condition
        slope = g + H @ x
        room = 1e-12 * (np.abs(H) @ np.abs(x) + np.abs(g))
        assert (np.abs(slope)[~held] <= room[~held]).all()
        assert (slope[held & (x == limits[0])] >= -room[held & (x == limits[0])]).all()
        assert (slope[held & (x == limits[1])] <= room[held & (x == limits[1])]).all()
        free = np.where(np.outer(~held, ~held), H, 0.0) + np.diag(held * 1.0)
        unit = np.tril(F, -1) + np.eye(m)
        np.testing.assert_allclose(unit * np.diag(F) @ unit.T, free, atol=1e-14 * condition * m)
    assert held_at_all > 10


def test_box_refuses_what_has_no_minimum():
    limits = np.array([[-1.0, -1.0], [1.0, 1.0]])
    for H in (np.diag([1.0, -1.0]), np.full((2, 2), np.nan)):
        assert box_minimum(H, np.zeros(2), limits, np.zeros(2)) is None


def pushed(limits=None, **options):
    """Two sliders that are to be farther away than their motors bring them in time."""
    scene = options.pop("scene", None) or vp.Scene(sliders(2), gravity=False)
    cost = vp.TrackingCost([1.0, -0.2]) + vp.ControlCost([[1e-2, 2e-3], [2e-3, 2e-2]]) + vp.VelocityCost(1e-3)
    cost += vp.Terminal(vp.TrackingCost([1.0, -0.2], 10.0))
    options = {"dt": 0.05, "steps": 30, **options}
    return vp.OptimalControlProblem(scene, cost, [0, 0], [0, 0], control_limits=limits, **options)


def transcribed(problem):
    """A problem linear in its controls as least squares: cost(u) = |A u - b|^2, columns by superposition."""
    R, m = problem.decisions, problem.scene.controls

    def cost(u):
        held = np.repeat(u.reshape(R, m), problem.hold, axis=0)
        motion = vp.simulate(
            problem.scene,
            problem.q0,
            problem.v0,
            dt=problem.dt,
            steps=problem.steps,
            controls=held,
            integrator=problem.integrator,
        )
        return problem.cost_of(motion)

    # Exact for a quadratic function: its Hessian by differences over unit steps.
    at_zero, unit = cost(np.zeros(R * m)), np.eye(R * m)
    ahead, behind = np.array([cost(e) for e in unit]), np.array([cost(-e) for e in unit])
    g = 0.5 * (ahead - behind)
    H = np.diag(ahead + behind - 2 * at_zero)
    for a in range(R * m):
        for b in range(a):
            H[a, b] = H[b, a] = cost(unit[a] + unit[b]) - ahead[a] - ahead[b] + at_zero
    return g, H


@pytest.mark.parametrize(("effort", "speed"), [(1.0, 1.0), (0.1, 0.0)], ids=["on the way", "at the end alone"])
def test_limits_that_the_optimum_does_not_touch(effort, speed):
    """From a cold start, with a stiff end."""
    robot = vp.load_robot("z1", lock={"jointGripper": 0.0})
    begin = np.array([0.2, 1.2, -1.4, 0.1, -0.3, 0.2])
    goal = begin + np.array([0.7, -0.5, 0.6, -0.4, 0.5, -0.6])
    cost = vp.ControlCost(effort / robot.effort_limit**2) + speed * vp.VelocityCost(1.0)
    cost += vp.Terminal(vp.TrackingCost(goal, 1e4) + vp.VelocityCost(1e3))
    scene = vp.Scene(robot, damping="robot")
    free, limited = (
        vp.solve(
            vp.OptimalControlProblem(scene, cost, begin, np.zeros(6), dt=0.02, steps=50, control_limits=limits),
            check=False,
        )
        for limits in ((-np.inf, np.inf), (-robot.effort_limit, robot.effort_limit))
    )
    assert (np.abs(free.controls) < robot.effort_limit).all()
    assert limited.status.converged
    assert limited.iterations <= free.iterations + 1
    np.testing.assert_allclose(limited.cost, free.cost, rtol=1e-6)
    np.testing.assert_allclose(limited.controls, free.controls, atol=1e-3)


def around_the_nominal_states(problem, motion, second_order):
    along = Along(problem, motion)
    curvature = None
    if second_order:
        plan, costate = passes.single_pass(along, 1e-3, costates=True)
        curvature = whole._curvature(along, plan, costate)
    limits = Limits(along.slack, np.zeros((0, 18)))
    return passes.single_pass(along, 0.0, curvature=curvature, limits=limits)[0]


@pytest.mark.parametrize(("steps", "controls"), [(40, "held"), (25, "linear")])
def test_limits_that_only_the_first_full_step_meets(steps, controls):
    """A Panda's reach: a light wrist meets its limit at the first plan, and not on the way. It took 17 iterations."""
    robot = vp.load_robot("panda", lock={"panda_finger_joint1": 0.02})
    begin = [0.71, 0.58, -0.4, -1.15, -0.14, 1.96, 0.72]
    goal = [0.59, 1.23, 0.32, -1.42, -0.62, 1.67, 0.18]
    speed = vp.VelocityCost(1.0)
    cost = vp.ControlCost(1.0 / robot.effort_limit**2) + speed
    cost += vp.Terminal(vp.TrackingCost(goal, 1e4) + 1e3 * speed)
    given = {"dt": 1.0 / steps, "steps": steps, "controls": controls, "integrator": vp.RungeKutta4()}
    scene = vp.Scene(robot, damping=0.1)
    free = vp.OptimalControlProblem(scene, cost, begin, np.zeros(7), **given)
    limited = vp.OptimalControlProblem(
        scene, cost, begin, np.zeros(7), **given, control_limits=(-robot.effort_limit, robot.effort_limit)
    )
    unlimited, plan = (vp.solve(problem, tolerance=1e-4, check=False) for problem in (free, limited))
    assert plan.status.converged
    assert plan.iterations <= unlimited.iterations + 3
    assert plan.cost == pytest.approx(unlimited.cost, rel=1e-2)
    begun = vp.solve(limited, tolerance=1e-4, max_iterations=2, check=False)
    resumed = vp.solve(limited, resume=begun, tolerance=1e-4, check=False)
    np.testing.assert_array_equal(resumed.controls, plan.controls)


@pytest.mark.parametrize("second_order", [False, True])
def test_each_decision_is_the_minimum_in_its_box(load, second_order):
    """Along any motion: the last decision against SciPy, on the model that the same pass without limits leaves."""
    robot = load("ur5")
    scene = vp.Scene(robot, damping=0.1)
    W = np.diag([1e-3, 2e-3, 1e-3, 1e-2, 2e-2, 1e-2]) + 1e-4
    target = np.array([0.5, -1.0, 1.0, 0.3, 0.2, 0.1])
    cost = vp.ControlCost(W) + vp.Terminal(vp.TrackingCost(target, 1e3) + vp.VelocityCost(10.0))
    limits = np.array([40.0, 60.0, 60.0, 3.0, 3.0, 1.0])
    begin = [0.2, -1.2, 0.9, 0.1, 0.3, 0.0]
    problem = vp.OptimalControlProblem(
        scene, cost, begin, np.zeros(6), dt=1e-2, steps=2, control_limits=(-limits, limits), integrator=vp.Midpoint()
    )
    motion = vp.solve(problem, max_iterations=0).trajectory
    free = vp.OptimalControlProblem(scene, cost, begin, np.zeros(6), dt=1e-2, steps=2, integrator=vp.Midpoint())
    without = backward(free, motion, 0.0, second_order)
    within = around_the_nominal_states(problem, motion, second_order)
    # The last decision's Q: its gradient is the cost's own, and its Hessian that of the cost in the last control.
    Qu = without.gradient[-1]
    tail = problem.at(q0=motion.q[1], v0=motion.v[1], steps=1)

    def slope(u):
        moved = vp.solve(tail, controls=u[None], max_iterations=0)
        return moved.gradient[0]

    u = motion.u[-1]
    k = within.feedforward[-1]
    assert ((u + k >= -limits * (1 + 1e-15)) & (u + k <= limits * (1 + 1e-15))).all()
    held = (np.abs(u + k) >= limits * (1 - 1e-12)) & (k != without.feedforward[-1])
    assert 1 <= held.sum() < 6
    if second_order:
        eps = 1e-4
        H = np.array([(slope(u + eps * e) - slope(u - eps * e)) / (2 * eps) for e in np.eye(6)])
    else:
        lin = vp.linearize(scene, motion)
        from_end = backward(free, motion, 0.0).gradient[-1]
        np.testing.assert_allclose(from_end, Qu)
        S = terminal_hessian(scene, motion)
        H = 2.0 * 1e-2 * W + lin.B[-1].T @ S @ lin.B[-1]
    L = np.linalg.cholesky(0.5 * (H + H.T))
    reference = lsq_linear(L.T, -np.linalg.solve(L, Qu), (-limits - u, limits - u), method="bvls", tol=1e-15).x
    np.testing.assert_allclose(k, reference, rtol=1e-5, atol=1e-5 * np.abs(reference).max())
    np.testing.assert_array_equal(within.feedback[-1][held], 0.0)
    assert np.abs(within.feedback[-1][~held]).max(axis=1).min() > 0.0


def terminal_hessian(scene, motion):
    """Of 1e3 |q - goal|^2 + 10 |v|^2 in (q, p), by the jet."""
    jet = vp.lagrangian_jet(scene, motion.q[-1], motion.v[-1])
    inverse = np.linalg.inv(jet.Lvv)
    D = np.hstack([-inverse @ jet.Lvq, inverse])
    return np.diag([2e3] * 6 + [0.0] * 6) + 20.0 * D.T @ D


@pytest.mark.parametrize("hold", [1, 5])
def test_model_within_limits_by_interior_points(hold, monkeypatch):
    """Where active sets do not settle, an interior-point method finds the limits that hold: SciPy's solution."""
    lower, upper = np.array([-3.0, -0.8]), np.array([2.0, 5.0])
    problem = pushed((lower, upper), integrator=vp.Midpoint(), hold=hold, dt=0.2 / hold, steps=10 * hold)
    real, calls = box.Box._active_sets, []

    def second_time(within, plan, held):
        calls.append(held)
        return real(within, plan, held) if len(calls) % 2 == 0 else None

    monkeypatch.setattr(box.Box, "_active_sets", second_time)
    sol = vp.solve(problem, max_iterations=1)
    assert calls
    g, H = transcribed(problem)
    L, R = np.linalg.cholesky(H), problem.decisions
    bounds = np.tile(lower, R), np.tile(upper, R)
    reference = lsq_linear(L.T, -np.linalg.solve(L, g), bounds, method="bvls", tol=1e-15, max_iter=1000).x
    np.testing.assert_allclose(sol.controls.ravel(), reference, atol=2e-5)


@pytest.mark.parametrize("rate", [None, 2e-3])
@pytest.mark.parametrize(("upper", "lower"), [((2.0, 5.0), (-3.0, -0.8)), ((2.0, 0.3), (-np.inf, 0.3))])
def test_interior_points_where_no_active_set_ends(rate, upper, lower, monkeypatch):
    """The last interior point is the plan then, in a dozen steps: by its gap at most above SciPy's solution."""
    problem, steps = pushed((lower, upper), integrator=vp.Midpoint(), dt=0.2, steps=10), []
    if rate is not None:
        problem = vp.OptimalControlProblem(
            problem.scene, problem.cost + vp.ControlRateCost(rate), problem.q0, problem.v0, dt=problem.dt,
            steps=problem.steps, integrator=vp.Midpoint(), control_limits=(lower, upper),
        )  # fmt: skip
    real = box.Box._pushed
    monkeypatch.setattr(box.Box, "_active_sets", lambda *_: None)
    monkeypatch.setattr(box.Box, "_pushed", lambda *given: steps.append(None) or real(*given))
    sol = vp.solve(problem, max_iterations=1)
    assert 1 < len(steps) <= 14
    g, H = transcribed(problem)
    L, least, most = np.linalg.cholesky(H), np.tile(lower, 10), np.tile(upper, 10)
    free = least < most
    reference = least.copy()
    shift = np.linalg.solve(L, g + H @ np.where(free, 0.0, least))
    bounds = least[free], most[free]
    reference[free] = lsq_linear(L.T[:, free], -shift, bounds, method="bvls", tol=1e-15, max_iter=1000).x
    assert (sol.controls >= lower).all()
    assert (sol.controls <= upper).all()
    best = problem.cost_of(problem.simulate(reference.reshape(-1, 2)))
    decrease = problem.cost_of(problem.simulate(np.clip(np.zeros((10, 2)), lower, upper))) - best
    # The complementarity of the last point bounds what it costs above the minimum.
    assert -1e-9 * decrease <= sol.cost - best <= 1e-5 * decrease


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_interior_points_are_corrected_as_by_whole_passes(controls, monkeypatch):
    """A correction by the gradient alone is that of another pass."""
    scene, apart = vp.Scene(vp.planar_chain(2), damping=0.05), []
    cost = vp.ControlCost(1e-2) + vp.ControlRateCost(1e-3) + vp.Terminal(vp.TrackingCost([1.0, -0.5], 10.0))
    problem = vp.OptimalControlProblem(
        scene, cost, [0, 0], [0, 0], dt=0.05, steps=10, control_limits=([-8, -0.5], [np.inf, -0.5]), controls=controls
    )
    real = box.Box._pushed

    def both(within, plan, limits, *others):
        whole = real(within, plan, limits._replace(factors=None), *others)
        quick = real(within, plan, limits, *others)
        apart.append(np.abs(quick - whole).max() / np.abs(whole).max())
        return quick

    monkeypatch.setattr(box.Box, "_active_sets", lambda *_: None)
    monkeypatch.setattr(box.Box, "_pushed", both)
    vp.solve(problem, max_iterations=1, check=False)
    assert 1 < len(apart) < 20
    assert max(apart) < 1e-9


@pytest.mark.parametrize("way", ["active sets", "interior points"])
@pytest.mark.parametrize("hold", [1, 5])
def test_penalties_and_limits_are_minimized_together(hold, way, monkeypatch):
    """Each penalty is the least square with a slack: SciPy's solution, with active rows and limits, after one step."""
    lower, upper, robot = np.array([-3.0, -0.8]), np.array([2.0, 5.0]), sliders(2)
    problem = pushed(
        (lower, upper), scene=vp.Scene(robot, gravity=False), integrator=vp.Midpoint(), hold=hold, dt=0.2 / hold,
        steps=10 * hold, constraints=[vp.WithinVelocityLimits(robot, (-0.6, 0.6)), vp.WithinControlRate(8.0)],
    )  # fmt: skip
    bound, weights = problem.bound_constraints, np.array([30.0, 0.02])
    zeros = [np.zeros(item.shape) for item in bound]
    real, calls = box.Box._active_sets, []

    def second_time(within, plan, held):
        calls.append(held)
        return real(within, plan, held) if len(calls) % 2 == 0 else None

    if way == "interior points":
        monkeypatch.setattr(box.Box, "_active_sets", second_time)
    sol = vp.solve(penalized(problem, zeros, weights, zeros), max_iterations=1)
    g, H = transcribed(problem)
    L, R = np.linalg.cholesky(H), problem.decisions

    def rows(u):
        motion = problem.simulate(np.repeat(u.reshape(R, 2), hold, axis=0))
        values = [item.value(motion.q, motion.v, motion.u) for item in bound]
        return np.concatenate([np.sqrt(w) * c.ravel() for w, c in zip(weights, values, strict=True)])

    begin = rows(np.zeros(2 * R))
    G = np.stack([rows(e) - begin for e in np.eye(2 * R)], axis=1)
    whole = np.block([[L.T, np.zeros((2 * R, len(begin)))], [G, np.eye(len(begin))]])
    low = np.concatenate([np.tile(lower, R), np.zeros(len(begin))])
    high = np.concatenate([np.tile(upper, R), np.full(len(begin), np.inf)])
    goal = -np.concatenate([np.linalg.solve(L, g), begin])
    found = lsq_linear(whole, goal, (low, high), method="bvls", tol=1e-15, max_iter=2000).x
    assert ((G @ found[: 2 * R] + begin) > 1e-6).sum() >= 2
    np.testing.assert_allclose(sol.controls.ravel(), found[: 2 * R], atol=2e-5)
    assert ((sol.controls == lower) | (sol.controls == upper)).sum() >= 2
    assert bool(calls) == (way == "interior points")


def test_control_that_is_fixed():
    """Equal limits leave a control no choice."""
    sol = vp.solve(pushed(([-np.inf, 0.3], [np.inf, 0.3])))
    assert sol.status.converged
    np.testing.assert_array_equal(sol.controls[:, 1], 0.3)
    assert not sol.gains[:, 1].any()


def test_first_controls_are_brought_within_limits():
    problem = pushed((-1.0, 0.5))
    for begin in (
        np.full((30, 2), 3.0),
        vp.LinearPolicy(np.full((30, 2), 3.0), np.zeros((30, 2, 4)), np.zeros((30, 4))),
    ):
        np.testing.assert_array_equal(vp.solve(problem, begin, max_iterations=0).controls, 0.5)
    other = vp.solve(pushed())
    assert np.abs(other.controls).max() > 1.0
    again = vp.solve(problem, other)
    assert again.status.converged
    assert (again.controls <= 0.5).all()
    assert (again.controls >= -1.0).all()
    hanging = vp.OptimalControlProblem(
        vp.Scene(vp.planar_chain(2)),
        vp.ControlCost(),
        [0, 0],
        [0, 0],
        dt=0.01,
        steps=5,
        control_limits=(-3.0, [4.0, 3.0]),
    )
    np.testing.assert_array_equal(hanging.holding_controls(), [-3.0, -3.0])


@pytest.mark.parametrize(
    "integrator",
    [vp.Midpoint(), vp.Gauss(stages=2), vp.RungeKutta4(), vp.SemiImplicitEuler(), vp.Reference()],
    ids=str,
)
def test_feedback_saturates(integrator):
    """A policy's controls are clipped, whatever integrates: each as the policy by hand gives it at the node."""
    rng = np.random.default_rng(0)
    limits = np.array([-0.4, -0.2]), np.array([0.3, 0.1])
    policy = vp.LinearPolicy(
        rng.normal(size=(6, 2)), rng.normal(size=(6, 2, 4)), rng.normal(size=(6, 4)), hold=2, limits=limits
    )
    motion = vp.simulate(
        vp.Scene(sliders(2)), [0.1, 0.2], [0, 0], dt=0.05, steps=12, controls=policy, integrator=integrator
    )
    second = motion.p if integrator.variational else motion.v
    x = np.hstack([motion.q, second])[:-1:2]
    wanted = policy.u + np.einsum("Rmx,Rx->Rm", policy.gains, x - policy.reference)
    np.testing.assert_allclose(motion.u[::2], np.clip(wanted, *limits), rtol=1e-12)
    np.testing.assert_array_equal(motion.u[1::2], motion.u[::2])
    assert np.count_nonzero(motion.u[::2] == limits[0]) + np.count_nonzero(motion.u[::2] == limits[1]) > 0


def shaken(scene_noise, limits):
    scene = vp.Scene(sliders(2), gravity=False, noise=scene_noise)
    return pushed(limits, scene=scene)


@pytest.mark.parametrize("noise", [vp.AdditiveNoise(0.3), vp.ControlNoise(0.05)], ids=["additive", "control"])
def test_noise_never_drives_a_control_out_of_its_limits(noise):
    """Not in Monte Carlo either; there saturation costs what the model of linear feedback does not see."""
    lower, upper = np.array([-1.0, -0.8]), np.array([1.5, 0.5])
    sol = vp.solve(shaken(noise, (lower, upper)))
    assert sol.status.converged
    ensemble = vp.simulate_ensemble(
        sol.problem.scene,
        sol.problem.q0,
        sol.problem.v0,
        dt=sol.problem.dt,
        steps=sol.problem.steps,
        paths=50,
        rng=0,
        controls=sol.policy,
    )
    assert (ensemble.u >= lower).all()
    assert (ensemble.u <= upper).all()
    saturated = (ensemble.u == lower) | (ensemble.u == upper)
    planned = (sol.controls == lower) | (sol.controls == upper)
    assert 0 < planned.sum() < planned.size
    assert (saturated != planned).any()
    # Limits so far away that noise does not reach them: the model's expectation is right.
    far = vp.solve(shaken(noise, (lower * 20, upper * 20))).monte_carlo(400, rng=1)
    assert abs(far.cost - far.predicted) < 4.0 * far.standard_error


def test_the_policy_keeps_its_limits():
    sol = vp.solve(pushed((-1.0, 0.5)))
    for policy in (sol.policy, sol.policy_on("velocity", 4), sol.shifted(3), pushed((-1.0, 0.5)).holding_policy()):
        np.testing.assert_array_equal(policy.limits, [[-1.0, -1.0], [0.5, 0.5]])
    moved = sol.problem.at(q0=[0.1, 0.0], dt=0.025)
    np.testing.assert_array_equal(moved.control_limits, sol.problem.control_limits)
    checked = sol.verify()
    # The system is linear and the plan a midpoint one: what is left is the order of the rule.
    assert checked.closed_loop_cost == pytest.approx(sol.cost, rel=2e-2)
    assert np.isinf(vp.solve(pushed(), max_iterations=1).policy.limits).all()


def test_violations():
    """Of a robot's joints whether the cost knows them or not; of what a barrier narrows."""
    robot = vp.load_robot("ur5")
    scene = vp.Scene(robot, gravity=False)
    narrow = np.append(-0.1, np.full(5, -0.5)), np.append(np.inf, np.full(5, 0.5))
    cost = vp.ControlCost(1e-4) + vp.Terminal(2.0 * vp.TrackingCost([7, 0.6, 0.3, 0, 0, 0], 1e4))
    cost += 2.0 * vp.JointLimitBarrier(robot, 1e-9, limits=narrow)
    rest = np.zeros(6)
    problem = vp.OptimalControlProblem(scene, cost, rest, rest, dt=0.02, steps=50, control_limits=(-200, 200))
    sol = vp.solve(problem, max_iterations=20, check=False)
    found = sol.violations
    assert found.any
    q, v = sol.trajectory.q, sol.trajectory.v
    expected = [q[:, 0].max() - 2 * np.pi, *np.maximum(0.0, np.abs(q[:, 1:]).max(axis=0) - 0.5)]
    np.testing.assert_allclose(found.position, expected, atol=1e-6)
    assert found.position[0] > 0.1
    assert found.position[1] > 0.05
    np.testing.assert_allclose(found.velocity, np.maximum(0.0, np.abs(v).max(axis=0) - robot.velocity_limit))
    assert found.velocity[0] > 1.0
    np.testing.assert_array_equal(found.control, 0.0)


@pytest.mark.parametrize(
    ("limits", "facts"),
    [
        ((1.0, -1.0), ("control_limits", "1", "-1", "0")),
        ((-1.0, np.nan), ("control_limits", "upper[0]", "NaN")),
        (([-1.0, -1.0, -1.0], 1.0), ("lower", "control_limits", "(2,)", "(3,)")),
        (3.0, ("control_limits", "pair")),
        ((1.0, 2.0, 3.0), ("control_limits", "pair")),
        (("a", 1.0), ("control_limits", "lower")),
        ("robot", "robot.effort_limit"),
        ((np.inf, np.inf), ("control_limits", "inf")),
    ],
)
def test_limits_that_are_refused(limits, facts):
    with refused(vp.InputError, facts):
        pushed(limits)


# By the share of the motors' torques that may be used.
REACHED = {1.0: [1.0, -1.0, 1.5, -1.2, 0.8, 0.5], 0.6: [0.61, -0.884, 0.831, -0.928, -0.892, -0.233]}


def reach(robot, goal, limits, **options):
    """From a bent posture to a place and orientation of the tool in one second, and rest there."""
    (R,), (p,) = frame_kinematics(robot, "tool0").placements(np.array([goal]))
    cost = vp.ControlCost(1.0 / robot.effort_limit**2) + vp.VelocityCost(1.0)
    at_end = vp.FramePositionCost(robot, "tool0", p, 1e5) + vp.FrameOrientationCost(robot, "tool0", R, 1e4)
    cost += vp.Terminal(at_end + vp.VelocityCost(10.0))
    begin = [0.0, -1.5, 0.8, -0.5, 0.0, 0.0]
    scene = vp.Scene(robot, damping=0.1)
    problem = vp.OptimalControlProblem(
        scene, cost, begin, np.zeros(6), dt=1e-2, steps=100, control_limits=(-limits, limits),
        integrator=vp.Midpoint(), sampling="midpoint",
    )  # fmt: skip
    return vp.solve(problem, backtracking=0.5, max_iterations=20, **options), R, p


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_ur5_reaches_within_its_torques(load, share):
    """To 1 mm and 10 mrad from a cold start in 20 iterations or fewer, by forward kinematics of Pinocchio."""
    import pinocchio as pin  # noqa: PLC0415

    robot = load("ur5")
    limits = share * robot.effort_limit
    sol, R, p = reach(robot, REACHED[share], limits)
    assert sol.iterations <= 20
    assert sol.status.converged
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, sol.trajectory.q[-1])
    tool = data.oMf[robot.model.getFrameId("tool0")]
    assert np.linalg.norm(tool.translation - p) < 1e-3
    assert np.linalg.norm(pin.log3(R.T @ tool.rotation)) < 1e-2
    assert (np.abs(sol.trajectory.u) <= limits).all()
    held = np.abs(sol.controls) == limits
    if share < 1.0:
        assert held.any()
    assert (sol.gradient[held] * np.sign(sol.controls[held]) < 0.0).all()
    assert not sol.violations.control.any()


@pytest.mark.slow
def test_a_double_pendulum_swings_up_by_its_elbow():
    """With 8 N m, where holding it level takes 20; first there and back to gather speed."""
    scene = vp.Scene(vp.planar_chain(2), actuation=["joint2"], damping=0.02)
    up = np.array([-np.pi / 2, 0.0])
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost(up, 1e3) + vp.VelocityCost(1e2))
    problem = vp.OptimalControlProblem(
        scene, cost, [np.pi / 2, 0.0], [0.0, 0.0], dt=0.02, steps=200, control_limits=(-8.0, 8.0)
    )
    sol = vp.solve(problem, backtracking=0.5, max_iterations=300)
    assert sol.status.converged
    assert np.abs(sol.controls).max() == 8.0
    np.testing.assert_allclose(sol.trajectory.q[-1], up, atol=5e-3)
    np.testing.assert_allclose(sol.trajectory.v[-1], 0.0, atol=2e-2)


@pytest.mark.slow
def test_a_control_with_equal_limits_within_constraints():
    """The cost does not fall along a control that cannot move; limits just apart give the same plan."""
    scene = vp.Scene(vp.planar_chain(2), damping=0.1)
    end = vp.TrackingCost([0.8, -0.5], 100.0) + vp.VelocityCost(10.0)
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(0.1) + vp.Terminal(end)

    def plan(apart):
        return vp.solve(
            vp.OptimalControlProblem(
                scene, cost, [0.0, 0.0], [0.0, 0.0], dt=0.02, steps=50,
                control_limits=([-60.0, -3.0 - apart], [60.0, -3.0 + apart]),
                constraints=[vp.WithinVelocityLimits(scene.robot, (-1.5, 1.5))],
            ), check=False,
        )  # fmt: skip

    equal, close = plan(0.0), plan(1e-6)
    assert equal.status is vp.Status.CONVERGED
    assert (equal.controls[:, 1] == -3.0).all()
    assert equal.violation <= 1e-8
    assert equal.cost == pytest.approx(close.cost, rel=1e-5)
