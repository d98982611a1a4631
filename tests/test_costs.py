"""Costs: values by hand, expansions against differences, sums, references, and what is refused."""

import numpy as np
import pytest
from refusals import refused
from scipy.interpolate import CubicHermiteSpline
from test_sddp import SAMPLINGS, run, sliders, small

import varpin as vp
from varpin.control.costs import Points

N, DOF, M = 6, 3, 2
WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
FULL = np.array([[2.0, 0.3, -0.1], [0.3, 1.0, 0.2], [-0.1, 0.2, 0.5]])


def samples_of_a_step(sampling, h):
    """For each: its weight, its place in the step, and q and v there as sums over (q0, v0, q1, v1)."""
    if sampling == "start":
        return [(1.0, 0.0, [1, 0, 0, 0], [0, 1, 0, 0])]
    if sampling == "midpoint":
        return [(1.0, 0.5, [0.5, 0, 0.5, 0], [-1 / h, 0, 1 / h, 0])]
    units = np.eye(4)
    motion = CubicHermiteSpline([0.0, h], units[[0, 2]], units[[1, 3]])
    places, weights = np.polynomial.legendre.leggauss(2)
    places = 0.5 + 0.5 * places
    return [(0.5 * w, s, motion(s * h), motion(s * h, 1)) for w, s in zip(weights, places, strict=True)]


def points(times=None, steps=N):
    times = (np.arange(N) + 0.5) * 0.1 if times is None else np.asarray(times)
    return Points(times, 0.1 * steps, steps, DOF, M)


def random_points(seed=0, scale=1.0):
    rng = np.random.default_rng(seed)
    return [scale * rng.normal(size=(N, size)) for size in (DOF, DOF, M)]


def smooth(t, q, v, u):
    return np.sin(q[:, 0] + t) * v[:, 1] + np.exp(0.3 * q[:, 1]) * u[:, 0] ** 2 + np.cos(v[:, 2] * u[:, 1])


def smooth_derivatives(t, q, v, u):
    gradient, hessian = np.zeros((len(t), 8)), np.zeros((len(t), 8, 8))
    s, c = np.sin(q[:, 0] + t), np.cos(q[:, 0] + t)
    e = np.exp(0.3 * q[:, 1])
    a, b = v[:, 2] * u[:, 1], v[:, 2]
    gradient[:, 0], gradient[:, 4] = c * v[:, 1], s
    gradient[:, 1], gradient[:, 6] = 0.3 * e * u[:, 0] ** 2, 2 * e * u[:, 0]
    gradient[:, 5], gradient[:, 7] = -np.sin(a) * u[:, 1], -np.sin(a) * b
    hessian[:, 0, 0], hessian[:, 0, 4] = -s * v[:, 1], c
    hessian[:, 1, 1], hessian[:, 1, 6], hessian[:, 6, 6] = 0.09 * e * u[:, 0] ** 2, 0.6 * e * u[:, 0], 2 * e
    hessian[:, 5, 5], hessian[:, 7, 7] = -np.cos(a) * u[:, 1] ** 2, -np.cos(a) * b**2
    hessian[:, 5, 7] = -np.cos(a) * a - np.sin(a)
    lower = np.tril_indices(8, -1)
    hessian[:, lower[0], lower[1]] = hessian[:, lower[1], lower[0]]
    return gradient, hessian


ROWS = np.random.default_rng(9).normal(size=(N + 1, DOF))
HELD = np.random.default_rng(10).normal(size=(N, M))
COSTS = {
    "tracking, scalar, constant": vp.TrackingCost([0.1, 0.2, 0.3], 2.0),
    "tracking, vector, one number": vp.TrackingCost(0.4, [1.0, 0.0, 3.0]),
    "tracking, matrix, function": vp.TrackingCost(lambda t: [t, np.sin(t), 1.0], FULL),
    "tracking, matrix, rows": vp.TrackingCost(ROWS, FULL),
    "velocity, default": vp.VelocityCost(),
    "velocity, vector, rows": vp.VelocityCost([1.0, 2.0, 3.0], reference=ROWS),
    "control, default": vp.ControlCost(),
    "control, matrix, function": vp.ControlCost([[2.0, 1.0], [1.0, 0.5]], reference=lambda t: [t, -t]),
    "custom, with derivatives": vp.CustomCost(smooth, smooth_derivatives),
    "sum": vp.TrackingCost(0.1)
    + vp.VelocityCost(0.3)
    + vp.ControlCost(0.2)
    + vp.CustomCost(smooth, smooth_derivatives),
    "control, held rows": vp.ControlCost([2.0, 0.5], reference=HELD),
    "scaled": 3.0 * (vp.TrackingCost(0.1, FULL) + 0.5 * vp.CustomCost(smooth, smooth_derivatives)),
    "terminal": vp.Terminal(vp.TrackingCost(lambda t: [t, 0, 0], FULL) + vp.VelocityCost(0.3)),
}


def differences(bound, z):
    """Gradient and Hessian of the value by differences of eighth order."""

    def value(z):
        return bound.value(z[:, :DOF], z[:, DOF : 2 * DOF], z[:, 2 * DOF :])

    def gradient(z, size=2e-2):
        columns = []
        for a in range(z.shape[1]):
            e = size * np.eye(z.shape[1])[a]
            columns.append(sum(w * (value(z + k * e) - value(z - k * e)) for k, w in WEIGHTS.items()) / size)
        return np.array(columns).T

    rows = []
    for a in range(z.shape[1]):
        e = 2e-2 * np.eye(z.shape[1])[a]
        rows.append(sum(w * (gradient(z + k * e) - gradient(z - k * e)) for k, w in WEIGHTS.items()) / 2e-2)
    return gradient(z), np.array(rows).transpose(1, 0, 2)


@pytest.mark.parametrize("name", COSTS)
def test_expansions(name):
    bound = COSTS[name].bind(points())
    q, v, u = random_points()
    expansion = bound.expand(q, v, u)
    gradient, hessian = differences(bound, np.hstack([q, v, u]))
    np.testing.assert_allclose(expansion.gradient, gradient, rtol=0, atol=1e-10 * np.abs(gradient).max())
    given = np.broadcast_to(expansion.hessian, hessian.shape)
    np.testing.assert_allclose(given, hessian, rtol=0, atol=1e-9 * np.abs(hessian).max())


def test_references_in_rows_at_nodes_and_at_the_end():
    q, v, u = np.zeros((N, DOF)), np.zeros((N, DOF)), np.zeros((N, M))
    cost = vp.TrackingCost(ROWS)
    at_nodes = cost.bind(points(np.arange(N) * 0.1)).value(q, v, u)
    np.testing.assert_allclose(at_nodes, (ROWS[:-1] ** 2).sum(axis=1), rtol=1e-12)
    end = vp.Terminal(cost).bind(points([0.1 * N])).value(q[:1], v[:1], u[:1])
    np.testing.assert_allclose(end, (ROWS[-1] ** 2).sum(), rtol=1e-12)


@pytest.mark.parametrize(("steps", "dt"), [(7, 0.1), (300, 1e-3), (99, 1 / 3)])
def test_held_control_references(steps, dt):
    """A row is constant over its step, from the node where it begins on, rounding or not; N + 1 rows stay linear."""
    rows = np.arange(1.0, steps + 1.0)[:, None] * np.ones(M)
    zero = np.zeros((steps, DOF))
    for place in (0.0, 0.5 - np.sqrt(3.0) / 6.0, 0.5, 0.5 + np.sqrt(3.0) / 6.0):
        at = Points((np.arange(steps) + place) * dt, dt * steps, steps, DOF, M)
        value = vp.ControlCost(1.0, rows).bind(at).value(zero, zero, np.zeros((steps, M)))
        np.testing.assert_allclose(value, M * rows[:, 0] ** 2, rtol=1e-15)
    nodes = np.arange(steps + 1.0)[:, None] * np.ones(M)
    value = vp.ControlCost(1.0, nodes).bind(at).value(zero, zero, np.zeros((steps, M)))
    np.testing.assert_allclose(value, M * (np.arange(steps) + place) ** 2, rtol=1e-9)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_controls_of_a_solution_are_a_reference(sampling):
    """They cost nothing where they are followed."""
    controls = np.random.default_rng(0).normal(size=(20, 2))
    problem = small(vp.ControlCost(1.0, controls), sampling=sampling)
    assert problem.cost_of(run(problem, controls)) == 0.0


def test_sums():
    parts = [COSTS[name] for name in list(COSTS)[:9]]
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    assert total.terms == tuple(parts)
    assert (parts[0] + (parts[1] + parts[2])).terms == tuple(parts[:3])
    q, v, u = random_points(2)
    bound, own = total.bind(points()), [part.bind(points()) for part in parts]
    np.testing.assert_allclose(bound.value(q, v, u), sum(part.value(q, v, u) for part in own), rtol=1e-13)
    expansions = [part.expand(q, v, u) for part in own]
    np.testing.assert_allclose(bound.expand(q, v, u).gradient, sum(e.gradient for e in expansions), rtol=0, atol=1e-12)
    np.testing.assert_allclose(bound.expand(q, v, u).hessian, sum(e.hessian for e in expansions), rtol=0, atol=1e-12)
    assert repr(parts[0] + parts[6]) == "TrackingCost(weight=2.0) + ControlCost(weight=1.0)"
    for wrong in (lambda: parts[0] + 1.0, lambda: 1 + parts[0], lambda: "2" * parts[0], lambda: parts[0] * parts[1]):
        with pytest.raises(TypeError):
            wrong()
    assert sum(parts).terms == total.terms
    assert sum(parts[:1]) is parts[0]


def test_scaling():
    """Of every term, whose kind stays; numbers multiply."""
    end, track = vp.Terminal(vp.TrackingCost(0.0) + vp.VelocityCost()), vp.TrackingCost(0.0, 2.0)
    cost = np.float64(2.0) * (track + end)
    assert repr(2 * vp.ControlCost()) == "2 * ControlCost(weight=1.0)"
    assert repr(cost * 1) == repr(1 * cost)
    first, last = cost.terms
    assert isinstance(last, vp.Terminal)
    assert len(last.cost.terms) == 2
    q, v, u = random_points(4)
    for scaled, own in ((first, track), (last, end)):
        bound, plain = scaled.bind(points()), own.bind(points())
        np.testing.assert_allclose(bound.value(q, v, u), 2.0 * plain.value(q, v, u), rtol=1e-14)
    built_in = vp.solve(small(vp.TrackingCost([1.0, 0.0], 6.0) + vp.ControlCost(0.2) + vp.Terminal(track)))
    own = vp.solve(small(2.0 * (vp.TrackingCost([1.0, 0.0], 3.0) + vp.ControlCost(0.1) + vp.Terminal(0.5 * track))))
    np.testing.assert_allclose(own.controls, built_in.controls, rtol=0, atol=1e-12 * np.abs(built_in.controls).max())


@pytest.mark.parametrize("scale", [0.1, 1.0])
def test_custom_cost_from_its_value_alone(scale):
    """Gradient to 1e-8 and Hessian to 1e-5 of the function's size, for one that varies over lengths of about 1."""
    q, v, u = random_points(3, scale)
    exact = vp.CustomCost(smooth, smooth_derivatives).bind(points()).expand(q, v, u)
    bound = vp.CustomCost(smooth).bind(points())
    found, size = bound.expand(q, v, u), np.abs(bound.value(q, v, u)).max()
    assert np.abs(found.gradient - exact.gradient).max() < 1e-8 * size
    assert np.abs(found.hessian - exact.hessian).max() < 1e-5 * size
    np.testing.assert_array_equal(found.hessian, np.swapaxes(found.hessian, 1, 2))


@pytest.mark.parametrize("scale", [0.0, 1e-3, 0.1, 1.0])
@pytest.mark.parametrize("size", [1e-8, 1.0, 1e8])
def test_derivatives_that_are_right_pass_the_check(scale, size):
    cost = vp.CustomCost(
        lambda *z: size * smooth(*z), lambda *z: tuple(size * x for x in smooth_derivatives(*z)), check=True
    )
    cost.bind(points()).expand(*random_points(5, scale))
    target = np.arange(DOF) + 1.0
    square = vp.CustomCost(
        lambda t, q, v, u: size * ((q - target) ** 2).sum(axis=1),
        lambda t, q, v, u: (
            size * 2 * np.hstack([q - target, np.zeros((N, 5))]),
            size * 2 * np.diag([1.0] * 3 + [0.0] * 5)[None],
        ),
        check=True,
    )
    q = np.tile(target, (N, 1))
    # At its minimum, where value and gradient are zero.
    square.bind(points()).expand(q, 0 * q, np.zeros((N, M)))


@pytest.mark.parametrize(
    ("order", "where", "facts"),
    [
        (0, (3, 4), ("mine", "gradient[3, 4]", "0.35")),
        (1, (2, 1, 6), ("mine", "Hessian[2, 1, 6]")),
        (1, (0, 7, 7), ("mine", "Hessian[0, 7, 7]")),
    ],
)
def test_check_finds_a_wrong_derivative(order, where, facts):
    """At the first expansion and not after it: it costs as much as leaving the derivatives out."""
    wrong, calls = [1.0], []

    def derivatives(*z):
        out = smooth_derivatives(*z)
        out[order][where] += 1e-3 * wrong[0]
        if order == 1:
            out[1][where[0], where[2], where[1]] = out[1][where]
        return out

    def function(*z):
        calls.append(1)
        return smooth(*z)

    bound = vp.CustomCost(function, derivatives, name="mine", check=True).bind(points())
    with refused(vp.CostError, facts):
        bound.expand(*random_points())
    wrong[0] = 0.0
    bound.expand(*random_points())
    wrong[0], before = 1.0, len(calls)
    bound.expand(*random_points())
    assert len(calls) == before > 0
    vp.CustomCost(smooth, derivatives).bind(points()).expand(*random_points())


def test_check_is_not_passed_by_nan():
    cost = vp.CustomCost(lambda t, q, v, u: t * np.nan, smooth_derivatives, check=True)
    with refused(vp.CostError, "nan"):
        cost.bind(points()).expand(*random_points())


def test_hessians_must_be_symmetric():
    def derivatives(t, q, v, u):
        gradient, hessian = smooth_derivatives(t, q, v, u)
        hessian[4, 6, 1] *= 1.0 + error
        return gradient, hessian

    bound = vp.CustomCost(smooth, derivatives, name="mine").bind(points())
    error = 1e-10
    bound.expand(*random_points())
    error = 1e-3
    with refused(vp.CostError, "mine", "Hessian[4, 1, 6]", "symmetric"):
        bound.expand(*random_points())


def test_custom_cost_is_the_built_in_one():
    """The same plan from a tracking cost, and from its value alone."""
    built_in = vp.solve(small(vp.TrackingCost([1.0, 0.0], 2.0) + vp.ControlCost(0.1)))
    alone = vp.CustomCost(lambda t, q, v, u: 2.0 * ((q - [1.0, 0.0]) ** 2).sum(axis=1))
    own = vp.solve(small(alone + vp.ControlCost(0.1)))
    np.testing.assert_allclose(own.controls, built_in.controls, rtol=0, atol=1e-7 * np.abs(built_in.controls).max())
    assert own.cost == pytest.approx(built_in.cost, rel=1e-12)


def test_one_hessian_for_all_points():
    same = vp.CustomCost(lambda t, q, v, u: (q**2).sum(axis=1), lambda t, q, v, u: (np.zeros((N, 8)), np.eye(8)[None]))
    assert same.bind(points()).expand(*random_points()).hessian.shape == (1, 8, 8)


def test_problem_is_an_integral():
    """A sum over the samples of each step, and the terminal cost once."""
    scene = vp.Scene(sliders(2), gravity=False)
    each_step = vp.TrackingCost(lambda t: [t, 0.0], 2.0) + vp.VelocityCost(0.3) + vp.ControlCost(0.1)
    cost = each_step + vp.Terminal(vp.TrackingCost([1.0, 0.0], 3.0) + vp.VelocityCost(0.7))
    for sampling in SAMPLINGS:
        problem = vp.OptimalControlProblem(scene, cost, [0.3, 0.1], [0.2, 0.0], dt=0.1, steps=8, sampling=sampling)
        motion = run(problem, np.random.default_rng(0).normal(size=(8, 2)))
        total = 3 * ((motion.q[-1] - [1.0, 0.0]) ** 2).sum() + 0.7 * (motion.v[-1] ** 2).sum()
        for k in range(8):
            nodes = motion.q[k], motion.v[k], motion.q[k + 1], motion.v[k + 1]
            for weight, place, in_q, in_v in samples_of_a_step(sampling, 0.1):
                t, q, v = (k + place) * 0.1, np.dot(in_q, nodes), np.dot(in_v, nodes)
                running = 2 * ((q - [t, 0.0]) ** 2).sum() + 0.3 * (v**2).sum() + 0.1 * (motion.u[k] ** 2).sum()
                total += 0.1 * weight * running
        assert problem.cost_of(motion) == pytest.approx(total, rel=1e-13)


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: vp.TrackingCost(0.0, np.nan), ("TrackingCost", "weight", "nan")),
        (lambda: vp.TrackingCost(0.0, [1.0, np.inf]), ("weight[1]", "inf")),
        (lambda: vp.TrackingCost(0.0, [[1.0, 2.0], [2.0, 1.0]]), ("positive semidefinite", "-1")),
        (lambda: vp.ControlCost(-1.0), ("ControlCost", "weight", "-1")),
        (lambda: vp.VelocityCost([1.0, -2.0]), ("VelocityCost", "weight", "-2")),
        (lambda: vp.ControlCost(np.ones((2, 3))), ("weight", "(2, 3)")),
        (lambda: vp.ControlCost(np.ones((2, 2, 2))), ("weight", "(2, 2, 2)")),
        (lambda: vp.ControlCost("heavy"), ("ControlCost", "weight", "'heavy'")),
        (lambda: vp.TrackingCost("home"), ("TrackingCost", "reference", "'home'")),
        (lambda: vp.Terminal(vp.ControlCost()), ("ControlCost", "terminal")),
        (lambda: vp.Terminal(vp.TrackingCost(0.0) + vp.ControlCost()), ("ControlCost", "terminal")),
        (lambda: vp.Terminal(2.0 * vp.ControlCost()), ("ControlCost", "terminal")),
        (lambda: vp.Terminal(vp.Terminal(vp.TrackingCost(0.0))), "Terminal"),
        (lambda: -1.0 * vp.TrackingCost(0.0), "-1"),
        (lambda: np.nan * vp.TrackingCost(0.0), "nan"),
        (lambda: vp.CustomCost(3), ("CustomCost", "function", "3")),
        (lambda: vp.CustomCost(None), ("CustomCost", "function", "None")),
        (lambda: vp.CustomCost(smooth, 3.0, name="mine"), ("mine", "derivatives")),
        (lambda: small(vp.ControlCost(1.0, np.zeros((19, 2)))), ("(20, 2)", "(19, 2)")),
        (lambda: vp.Terminal(1.0), ("Terminal", "float")),
        (lambda: small(vp.ControlCost([1.0, 1.0, 1.0])), ("weight", "2", "(3,)")),
        (lambda: small(vp.TrackingCost(0.0, np.eye(3))), ("weight", "2", "(3, 3)")),
        (lambda: small(vp.TrackingCost(np.zeros((20, 2)))), ("(21, 2)", "(20, 2)")),
        (lambda: small(vp.TrackingCost([0.0, 0.0, 0.0])), ("(2,)", "(21, 2)", "(3,)")),
        (lambda: small(vp.TrackingCost([0.0, np.nan])), ("TrackingCost", "reference[1]", "nan")),
        (lambda: small(vp.Terminal(vp.TrackingCost([0.0, np.nan]))), ("TrackingCost", "reference[1]", "nan")),
    ],
)
def test_what_is_refused(make, facts):
    with refused(vp.InputError, facts):
        make()


def fails(*arguments):
    raise KeyError("gain")


@pytest.mark.parametrize(
    ("cost", "facts"),
    [
        (vp.TrackingCost(fails), ("TrackingCost", "reference", "KeyError('gain')", "0.025")),
        (vp.TrackingCost(lambda t: [0.0, np.nan]), ("TrackingCost", "reference", "0.025", "nan")),
        (vp.TrackingCost(lambda t: [0.0]), ("(2,)", "(1,)")),
        (vp.TrackingCost(lambda t: "home"), ("reference", "'home'")),
        (vp.Terminal(vp.VelocityCost(reference=fails)), ("VelocityCost", "reference", "KeyError('gain')", "1 s")),
        (vp.CustomCost(fails, name="mine"), ("mine", "KeyError('gain')")),
        (vp.CustomCost(lambda t, q, v, u: q, name="mine"), ("mine", "(20,)", "(20, 2)")),
        (vp.CustomCost(lambda t, q, v, u: None), ("CustomCost", "function")),
        (vp.CustomCost(lambda t, q, v, u: t, lambda t, q, v, u: (q, v)), ("gradient", "(20, 6)")),
        (vp.CustomCost(lambda t, q, v, u: t, fails), ("derivatives", "'gain'")),
        (vp.CustomCost(lambda t, q, v, u: t, lambda t, q, v, u: None), "derivatives"),
        (
            vp.CustomCost(lambda t, q, v, u: t, lambda t, q, v, u: (np.full((20, 6), np.nan), np.zeros((1, 6, 6)))),
            ("gradient[0, 0]", "nan"),
        ),
    ],
)
def test_functions_that_fail(cost, facts):
    with refused(vp.CostError, facts) as caught:
        vp.solve(small(cost + vp.ControlCost(1.0), sampling="midpoint"))
    assert isinstance(caught.value, vp.VarpinError)
    assert isinstance(caught.value.cost, str)


def test_weights_are_copied_and_frozen():
    weight = np.ones(2)
    cost = vp.ControlCost(weight)
    weight[:] = 5.0
    np.testing.assert_array_equal(cost.weight, 1.0)
    with pytest.raises(ValueError, match="read-only"):
        cost.weight[0] = 2.0


def test_semidefinite_weights_are_taken():
    """Rank one, with rounding below zero."""
    a = np.array([[0.1], [0.3], [-0.7]])
    vp.TrackingCost(0.0, a @ a.T)
    vp.TrackingCost(0.0, 0.0)


def test_cost_of_refuses_what_is_no_motion_of_the_problem():
    scene = vp.Scene(vp.planar_chain(2))
    problem = vp.OptimalControlProblem(scene, vp.ControlCost(), [0, 0], [0, 0], dt=0.1, steps=3)
    for wrong in (None, np.zeros((4, 2))):
        with refused(vp.InputError, "motion", "varpin.Trajectory"):
            problem.cost_of(wrong)
    other = vp.simulate(vp.Scene(vp.planar_chain(3)), np.zeros(3), np.zeros(3), dt=0.1, steps=3)
    with refused(vp.InputError, "joints"):
        problem.cost_of(other)
    driven = vp.Scene(vp.planar_chain(2), actuation=[[1.0], [0.0]])
    with refused(vp.InputError, "1", "2", "controls"):
        problem.cost_of(vp.simulate(driven, [0, 0], [0, 0], dt=0.1, steps=3))


def test_costs_print_in_a_line():
    def near_the_wall(t, q, v, u):
        return q[:, 0] ** 2

    assert repr(vp.CustomCost(near_the_wall)) == "CustomCost(near_the_wall)"
    assert repr(vp.CustomCost(near_the_wall, name="wall")) == "CustomCost('wall')"
    total = 2.0 * vp.CustomCost(near_the_wall) + vp.Terminal(vp.TrackingCost([0.0]))
    assert repr(total) == "2 * CustomCost(near_the_wall) + Terminal(cost=TrackingCost(weight=1.0))"


@pytest.mark.parametrize(
    "name", ["EnsembleStatistics", "PathFailure", "Integrator", "Points", "BoundCost", "Expansion", "Choice"]
)
def test_types_that_users_meet_have_public_names(name):
    assert isinstance(getattr(vp, name), type)


def test_help_of_the_problem_lists_every_cost():
    costs = [name for name in dir(vp) if name.endswith("Cost") and name not in ("Cost", "BoundCost")]
    for name in (*costs, "Terminal", "Gauss(stages=4)"):
        assert f"``{name}" in vp.OptimalControlProblem.__doc__, name
