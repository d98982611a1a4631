"""Costs: every term against NumPy and Pinocchio, sums, references, and functions of one's own."""

import mechanisms
import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from oracles import Mechanism, jacobian, placements
from plan_problems import linear, small
from refusals import refused
from scipy.interpolate import CubicHermiteSpline

import varpin as vp
from varpin.control.costs import Points
from varpin.model.kinematics import frame_kinematics

N, CONTROLS = 7, 3


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture(params=["sliders and hinges", "finger"])
def robot(request, load):
    # The finger's last joint mimics the one before.
    return load("finger") if request.param == "finger" else vp.load_robot(mechanisms.random_tree(3, 5, branching=False))


@pytest.fixture
def frame(robot):
    return robot.end_effector if robot.name == "finger" else "joint4"


def spd(rng, size):
    root = rng.normal(size=(size, size))
    return root @ root.T


def points(robot):
    return Points(np.linspace(0.0, 0.6, N), 0.6, N - 1, robot.dof, CONTROLS)


def samples(rng, robot):
    return rng.normal(size=(N, robot.dof)), rng.normal(size=(N, robot.dof)), rng.normal(size=(N, CONTROLS))


def plain(residual, J, weight, columns, size):
    gradient, hessian = np.zeros((N, size)), np.zeros((N, size, size))
    gradient[:, columns] = 2.0 * np.einsum("Nrc,rs,Ns->Nc", J, weight, residual)
    hessian[:, columns, columns] = 2.0 * np.einsum("Nrc,rs,Nsd->Ncd", J, weight, J)
    return np.einsum("Nr,rs,Ns->N", residual, weight, residual), gradient, hessian


def masses(robot, q):
    """Centres of mass (N, 3) and their derivatives (N, 3, n), by Pinocchio."""
    model, gear = robot.model, robot.velocity(np.eye(robot.dof)).T
    data = model.createData()
    slopes = np.array([pin.jacobianCenterOfMass(model, data, robot.configuration(row)) @ gear for row in q])
    return np.array([pin.centerOfMass(model, data, robot.configuration(row)).copy() for row in q]), slopes


def terms(rng, robot, frame, q, v, u):
    n, size = robot.dof, 2 * robot.dof + CONTROLS
    kinematics = frame_kinematics(robot, frame)
    R, p, J = kinematics.jacobians(q)
    found = []

    def add(cost, weight, residual, derivative, columns):
        found.append((cost, plain(residual, derivative, weight, columns, size)))

    for block, y, width, begin in (("q", q, n, 0), ("v", v, n, n), ("u", u, CONTROLS, 2 * n)):
        W, reference = spd(rng, width), rng.normal(size=(N, width))
        cost = {"q": vp.TrackingCost, "v": vp.VelocityCost, "u": vp.ControlCost}[block]
        cost = cost(reference, W) if block == "q" else cost(W, reference)
        add(cost, W, y - reference, np.tile(np.eye(width), (N, 1, 1)), slice(begin, begin + width))
    W, place = spd(rng, 3), rng.normal(size=3)
    add(vp.FramePositionCost(robot, frame, place, W), W, p - place, J[:, :3], slice(0, n))
    W, turns = spd(rng, 3), np.linalg.qr(rng.normal(size=(N, 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    error = np.array([pin.log3(target.T @ own) for target, own in zip(turns, R, strict=True)])
    turn = np.array([pin.Jlog3(target.T @ own) for target, own in zip(turns, R, strict=True)])
    of_turn = turn @ np.swapaxes(R, 1, 2) @ J[:, 3:]
    add(vp.FrameOrientationCost(robot, frame, turns, W), W, error, of_turn, slice(0, n))
    W, twist = spd(rng, 6), rng.normal(size=(N, 6))
    in_q = jacobian(lambda q: (kinematics.jacobians(q)[2] @ v[:, :, None])[..., 0], q, 1e-2)
    slopes = np.concatenate([in_q, J], axis=2)
    add(vp.FrameVelocityCost(robot, frame, twist, W), W, (J @ v[:, :, None])[..., 0] - twist, slopes, slice(0, 2 * n))
    W, place = spd(rng, 3), rng.normal(size=(N, 3))
    centers, slopes = masses(robot, q)
    add(vp.CenterOfMassCost(robot, place, W), W, centers - place, slopes, slice(0, n))
    # The finger turns in a plane.
    rows = [0, 1] if robot.name == "finger" else [0, 1, 2]

    def chosen(q):
        return kinematics.jacobians(q)[2][:, rows]

    J = chosen(q)
    measured = np.sqrt(np.linalg.det(J @ np.swapaxes(J, 1, 2)))
    least = 1.01 * float(np.median(measured))
    slopes = measured[:, None] * np.einsum("Nar,Nrab->Nb", np.linalg.pinv(J), jacobian(chosen, q, 1e-2))
    slopes = np.where(measured < least, -1.0, 0.0)[:, None, None] * slopes[:, None]
    cost = vp.ManipulabilityCost(robot, frame, least, 1.7, ["xyz"[row] for row in rows])
    add(cost, np.array([[1.7]]), np.maximum(0.0, least - measured)[:, None], slopes, slice(0, n))
    for kind, y, begin in ((vp.JointLimitBarrier, q, 0), (vp.VelocityLimitBarrier, v, n)):
        W, lower, upper = spd(rng, n), np.full(n, -0.5), np.linspace(0.3, 0.6, n)
        beyond = y - np.clip(y, lower + 0.1, upper - 0.1)
        slopes = np.eye(n) * (beyond != 0.0)[:, None]
        add(kind(robot, W, 0.1, (lower, upper)), W, beyond, slopes, slice(begin, begin + n))
    return found


def test_every_term_is_what_it_is_in_numpy(rng, robot, frame):
    at = samples(rng, robot)
    for cost, (value, gradient, hessian) in terms(rng, robot, frame, *at):
        bound = cost.bind(points(robot))
        own = bound.expand(*at)
        assert_allclose(bound.value(*at), value, rtol=1e-12, err_msg=repr(cost))
        assert_allclose(own.gradient, gradient, rtol=1e-11, atol=1e-11 * np.abs(gradient).max())
        full = np.broadcast_to(own.hessian, hessian.shape)
        assert_allclose(full, hessian, rtol=1e-11, atol=1e-11 * np.abs(hessian).max())


def test_sums_scale_and_add_up(rng, robot, frame):
    at = samples(rng, robot)
    found = terms(rng, robot, frame, *at)
    factors = rng.uniform(0.5, 2.0, len(found))
    last = 2 * robot.dof
    unit = np.eye(last + CONTROLS)[last]
    custom = vp.CustomCost(
        lambda t, q, v, u: u[:, 0] ** 2,
        lambda t, q, v, u: (2.0 * u[:, :1] * unit, np.tile(2.0 * np.diag(unit), (N, 1, 1))),
    )
    cost = sum((factor * own for factor, (own, _) in zip(factors, found, strict=True)), start=custom)
    bound = cost.bind(points(robot))
    expansion = bound.expand(*at)
    expected = [sum(f * parts[i] for f, (_, parts) in zip(factors, found, strict=True)) for i in range(3)]
    expected[0] = expected[0] + at[2][:, 0] ** 2
    expected[1] += 2.0 * at[2][:, :1] * unit
    expected[2] += 2.0 * np.diag(unit)
    assert_allclose(bound.value(*at), expected[0], rtol=1e-12)
    assert_allclose(expansion.gradient, expected[1], rtol=1e-10, atol=1e-10)
    assert_allclose(expansion.hessian, expected[2], rtol=1e-10, atol=1e-10)
    many = [np.stack([x, x[::-1]]) for x in at]
    assert_allclose(bound.value(*many)[0], expected[0], rtol=1e-12)


def test_manipulability_where_there_is_none(load):
    robot = load("ur5")
    frame = frame_kinematics(robot, "tool0")
    straight = np.array([0.3, -1.0, 0.0, 0.4, 0.9, 0.2])  # elbow
    wrist = np.array([0.3, -1.0, 0.7, 0.4, 0.0, 0.2])
    q = np.array([straight, wrist, straight * [1, 1, 1, 1, 0, 1]])
    bound = vp.ManipulabilityCost(robot, "tool0", 0.05).bind(Points(np.zeros(3), 1.0, 2, 6, 6))
    given = bound.expand(q, q, q)
    slopes = jacobian(lambda q: np.linalg.det(frame.jacobians(q)[2]), q, 1e-2)
    assert (np.abs(slopes[:2]).max(axis=1) > 1e-3).all()
    assert_allclose(np.abs(given.gradient[:, :6]), 0.1 * np.abs(slopes), atol=1e-10)
    assert_allclose(given.gradient[2], 0.0, atol=1e-10)
    outer = slopes[:, :, None] * slopes[:, None, :]
    assert_allclose(given.hessian[:, :6, :6], 2.0 * outer, atol=1e-9)


def tree(seed):
    model = mechanisms.random_tree(seed)
    rng = np.random.default_rng(seed)
    depths = [len(path) for path in model.supports]
    placement = pin.SE3(mechanisms.random_rotation(rng), rng.normal(0, 0.3, 3))
    model.addFrame(pin.Frame("hand", int(np.argmax(depths)), 0, placement, pin.FrameType.OP_FRAME))
    return vp.load_robot(model)


@pytest.mark.parametrize("name", ["tree0", "tree1", "tree2", "ur5", "panda", "kinova"])
def test_frames(load, rng, name):
    """Panda's fingers are tied to each other."""
    robot = tree(int(name[4:])) if name.startswith("tree") else load(name)
    frame = "hand" if name.startswith("tree") else robot.end_effector
    q, v, _ = samples(rng, robot)
    kinematics, own = frame_kinematics(robot, frame), Mechanism(vp.Scene(robot, damping=0.0))
    R, p, J = kinematics.jacobians(q)
    for k in range(N):
        own.place(q[k], v[k])
        for found, expected in zip((p[k], R[k], J[k]), own.point(frame), strict=False):
            assert_allclose(found, expected, atol=1e-13)
    for placed, once_more in zip(kinematics.placements(q), (R, p), strict=True):
        assert_array_equal(placed, once_more)


def turn(axis, angle):
    return pin.exp3(angle * np.asarray(axis) / np.linalg.norm(axis))


@pytest.mark.parametrize("axis", [(2, -1, 2), (-9, 2, 6), (2, 9, -6), (0, 0, 1)])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 9.9e-4, 1.01e-3, 0.5, 3.0, np.pi - 1e-5])
def test_orientation_at_every_distance(load, angle, axis):
    robot = load("ur5")
    q, v = np.random.default_rng(2).uniform(-1.5, 1.5, (2, 1, 6))
    R = placements(robot, q, "tool0")[0].rotation
    axis = np.array(axis) / np.linalg.norm(axis)
    W = np.diag([1.0, 2.0, 3.0])
    bound = vp.FrameOrientationCost(robot, "tool0", R @ turn(axis, angle).T, W).bind(Points(np.zeros(1), 1.0, 1, 6, 6))
    u = np.zeros((1, 6))
    assert bound.value(q, v, u)[0] == pytest.approx(angle**2 * (axis**2 @ [1, 2, 3]), rel=1e-6, abs=1e-28)
    given = bound.expand(q, v, u)
    J = pin.Jlog3(turn(axis, angle)) @ R.T @ frame_kinematics(robot, "tool0").jacobians(q)[2][0, 3:]
    assert_allclose(given.gradient[0, :6], 2 * angle * J.T @ W @ axis, atol=1e-9 * max(angle, 1e-6))
    hessian = 2 * J.T @ W @ J
    assert_allclose(given.hessian[0, :6, :6], hessian, atol=1e-8 * np.abs(hessian).max())


def test_targets_in_time(load, rng):
    robot, steps = load("ur5"), 4
    t, nodes = (np.arange(steps) + 0.5) * 0.25, np.linspace(0.0, 1.0, steps + 1)
    q, v = rng.uniform(-1.5, 1.5, (2, steps, 6))
    at = placements(robot, q, "tool0")

    def path(t):
        return np.array([t, 1.0 - t, 0.3])

    def turning(t):
        return turn([1, 1, 0], 2.0 * t)

    away = [((place.translation - path(time)) ** 2).sum() for time, place in zip(t, at, strict=True)]
    turned = [(pin.log3(turning(time).T @ place.rotation) ** 2).sum() for time, place in zip(t, at, strict=True)]
    for kind, target, expected in ((vp.FramePositionCost, path, away), (vp.FrameOrientationCost, turning, turned)):
        for given in (target, np.array([target(time) for time in nodes])):
            bound = kind(robot, "tool0", given).bind(Points(t, 1.0, steps, 6, 6))
            assert_allclose(bound.value(q, v, np.zeros((steps, 6))), expected, rtol=1e-10)


@pytest.mark.parametrize(("steps", "dt"), [(7, 0.1), (300, 1e-3), (99, 1 / 3)])
def test_references_in_rows(steps, dt):
    rows, nodes = np.arange(1.0, steps + 1.0)[:, None] * np.ones(2), np.arange(steps + 1.0)[:, None] * np.ones(2)
    zero = np.zeros((steps, 3))
    for place in (0.0, 0.5 - np.sqrt(3.0) / 6.0, 0.5, 0.5 + np.sqrt(3.0) / 6.0):
        at = Points((np.arange(steps) + place) * dt, dt * steps, steps, 3, 2)
        value = vp.ControlCost(1.0, rows).bind(at).value(zero, zero, zero[:, :2])
        assert_allclose(value, 2 * rows[:, 0] ** 2, rtol=1e-15)
    value = vp.ControlCost(1.0, nodes).bind(at).value(zero, zero, zero[:, :2])
    assert_allclose(value, 2 * (np.arange(steps) + place) ** 2, rtol=1e-9)
    last = Points(np.array([dt * steps]), dt * steps, steps, 3, 2)
    end = vp.TrackingCost(np.outer(np.arange(steps + 1.0), np.ones(3))).bind(last)
    assert_allclose(end.value(zero[:1], zero[:1], zero[:1, :2]), 3 * steps**2, rtol=1e-12)


def test_sums_and_scales():
    track, end = vp.TrackingCost(0.0, 2.0), vp.Terminal(vp.TrackingCost(0.0) + vp.VelocityCost())
    cost = np.float64(2.0) * (track + end) * 1
    assert [(type(term), term.factor, term.at_end) for term in cost.terms] == [
        (vp.TrackingCost, 2.0, False), (vp.TrackingCost, 2.0, True), (vp.VelocityCost, 2.0, True),
    ]  # fmt: skip
    assert (track + (track + track)).terms == (track, track, track) == sum([track, track, track]).terms
    assert sum([track]) is track
    for wrong in (lambda: track + 1.0, lambda: 1 + track, lambda: "2" * track, lambda: track * track):
        with pytest.raises(TypeError):
            wrong()


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


@pytest.mark.parametrize("sampling", ["midpoint", "gauss", "start"])
def test_problem_is_an_integral(sampling):
    each_step = vp.TrackingCost(lambda t: [t, 0.0], 2.0) + vp.VelocityCost(0.3) + vp.ControlCost(0.1)
    cost = each_step + vp.Terminal(vp.TrackingCost([1.0, 0.0], 3.0) + vp.VelocityCost(0.7))
    problem = linear().at(cost=cost, dt=0.1, steps=8, sampling=sampling).at(t0=0.7)
    motion = problem.simulate(np.random.default_rng(0).normal(size=(8, 2)))
    total = 3 * ((motion.q[-1] - [1.0, 0.0]) ** 2).sum() + 0.7 * (motion.v[-1] ** 2).sum()
    for k in range(8):
        nodes = motion.q[k], motion.v[k], motion.q[k + 1], motion.v[k + 1]
        for weight, place, in_q, in_v in samples_of_a_step(sampling, 0.1):
            t, q, v = 0.7 + (k + place) * 0.1, np.dot(in_q, nodes), np.dot(in_v, nodes)
            running = 2 * ((q - [t, 0.0]) ** 2).sum() + 0.3 * (v**2).sum() + 0.1 * (motion.u[k] ** 2).sum()
            total += 0.1 * weight * running
    assert problem.cost_of(motion) == pytest.approx(total, rel=1e-13)


def smooth(t, q, v, u):
    return np.sin(q[:, 0] + t) * v[:, 1] + np.exp(0.3 * q[:, 1]) * u[:, 0] ** 2


def smooth_derivatives(t, q, v, u):
    gradient, hessian = np.zeros((len(t), 8)), np.zeros((len(t), 8, 8))
    s, c, e, w = np.sin(q[:, 0] + t), np.cos(q[:, 0] + t), np.exp(0.3 * q[:, 1]), u[:, 0]
    gradient[:, 0], gradient[:, 4] = c * v[:, 1], s
    gradient[:, 1], gradient[:, 6] = 0.3 * e * w**2, 2 * e * w
    hessian[:, 0, 0], hessian[:, 0, 4], hessian[:, 4, 0] = -s * v[:, 1], c, c
    hessian[:, 1, 1], hessian[:, 6, 6] = 0.09 * e * w**2, 2 * e
    hessian[:, 1, 6] = hessian[:, 6, 1] = 0.6 * e * w
    return gradient, hessian


GRID = Points((np.arange(N) + 0.5) * 0.1, 0.1 * N, N, 3, 2)


def somewhere(seed=0, scale=1.0):
    rng = np.random.default_rng(seed)
    return [scale * rng.normal(size=(N, size)) for size in (3, 3, 2)]


@pytest.mark.parametrize("scale", [0.1, 1.0])
def test_custom_cost_from_its_value_alone(scale):
    at = somewhere(3, scale)
    gradient, hessian = smooth_derivatives(GRID.t, *at)
    bound = vp.CustomCost(smooth).bind(GRID)
    found, size = bound.expand(*at), np.abs(bound.value(*at)).max()
    assert np.abs(found.gradient - gradient).max() < 1e-8 * size
    assert np.abs(found.hessian - hessian).max() < 1e-5 * size
    assert_array_equal(found.hessian, np.swapaxes(found.hessian, 1, 2))


@pytest.mark.parametrize("scale", [0.0, 1e-3, 0.1, 1.0])
@pytest.mark.parametrize("size", [1e-8, 1.0, 1e8])
def test_derivatives_that_are_right_pass_the_check(scale, size):
    cost = vp.CustomCost(
        lambda *z: size * smooth(*z), lambda *z: tuple(size * x for x in smooth_derivatives(*z)), check=True
    )
    cost.bind(GRID).expand(*somewhere(5, scale))
    # At its minimum, where value and gradient are zero; one Hessian for all points stays one.
    square = vp.CustomCost(
        lambda t, q, v, u: size * (u**2).sum(axis=1),
        lambda t, q, v, u: (size * 2 * np.hstack([q, v, u]), size * 2 * np.diag([0.0] * 6 + [1.0] * 2)[None]),
        check=True,
    )
    zero = np.zeros((N, 3))
    assert square.bind(GRID).expand(zero, zero, zero[:, :2]).hessian.shape == (1, 8, 8)


@pytest.mark.parametrize(
    ("order", "where", "facts"),
    [
        (0, (3, 4), ("mine", "gradient[3, 4]", "0.35")),
        (1, (2, 1, 6), ("mine", "Hessian[2, 1, 6]")),
        (1, (0, 7, 7), ("mine", "Hessian[0, 7, 7]")),
    ],
)
def test_check_finds_a_wrong_derivative(order, where, facts):
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

    bound = vp.CustomCost(function, derivatives, name="mine", check=True).bind(GRID)
    with refused(vp.CostError, facts):
        bound.expand(*somewhere())
    wrong[0] = 0.0
    bound.expand(*somewhere())
    wrong[0], before = 1.0, len(calls)
    bound.expand(*somewhere())
    assert len(calls) == before > 0


def test_derivatives_that_cannot_be():
    with refused(vp.CostError, "nan"):
        vp.CustomCost(lambda t, q, v, u: t * np.nan, smooth_derivatives, check=True).bind(GRID).expand(*somewhere())

    def derivatives(t, q, v, u):
        gradient, hessian = smooth_derivatives(t, q, v, u)
        hessian[4, 6, 1] *= 1.0 + error
        return gradient, hessian

    bound = vp.CustomCost(smooth, derivatives, name="mine").bind(GRID)
    error = 1e-10
    bound.expand(*somewhere())
    error = 1e-3
    with refused(vp.CostError, "mine", "Hessian[4, 1, 6]", "symmetric"):
        bound.expand(*somewhere())


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda r: vp.FrameVelocityCost(r, "base_link"), ("'base_link'", "'ur5'")),
        (lambda r: vp.JointLimitBarrier("ur5"), "str"),
        (lambda r: vp.FramePositionCost(r, "tool0", [0, 0, 0], [1, 2]), ("FramePositionCost weight", "3")),
        (lambda r: vp.ManipulabilityCost(r, "tool0", 0.1, directions=["x", "x"]), "ManipulabilityCost directions"),
        (lambda r: vp.ManipulabilityCost(r, "tool0", 0.1, directions="up"), "ManipulabilityCost directions"),
        (lambda r: vp.ManipulabilityCost(r, "tool0", 0.0), "ManipulabilityCost least"),
        (lambda r: vp.ManipulabilityCost(r, "tool0", 0.1, [1.0]), "weight"),
        (lambda r: vp.ManipulabilityCost(vp.planar_chain(2), "tip", 0.1, directions="linear"), ("2", "3")),
        (lambda r: vp.JointLimitBarrier(vp.planar_chain(2)), ("JointLimitBarrier", "'chain2'")),
        (lambda r: vp.JointLimitBarrier(r, margin=-0.1), ("margin", "0", "-0.1")),
        (lambda r: vp.VelocityLimitBarrier(r, limits=(1.0, -1.0)), ("VelocityLimitBarrier", "1", "-1")),
        (lambda r: vp.FramePositionCost(r, "tool0", [0.0, 1.0]), ("FramePositionCost reference", "(3,)")),
        (lambda r: vp.FrameOrientationCost(r, "tool0", np.eye(4)), ("(3, 3)", "(3, 3, 3)")),
        (lambda r: vp.CenterOfMassCost(vp.planar_chain(2), [0, 0, 0]), ("'chain2'", "2", "'ur5'", "6", "scene.robot")),
    ],
)
def test_what_is_refused_in_the_task(load, make, facts):
    robot = load("ur5")
    with refused(vp.InputError, facts):
        make(robot).bind(Points(np.zeros(2), 1.0, 2, 6, 6, robot=robot))


def test_a_margin_is_at_most_half_of_the_range():
    """In the middle of a range nothing is beyond its limits, however wide the margin; elsewhere the distance to it."""
    scene = vp.Scene(vp.planar_chain(2), gravity=False)
    barrier = vp.JointLimitBarrier(scene.robot, margin=5.0, limits=([-1.0, 0.0], [1.0, 3.0]))
    for q, cost in (([0.0, 1.5], 0.0), ([0.2, 1.0], 0.2**2 + 0.5**2)):
        problem = vp.OptimalControlProblem(scene, vp.Terminal(barrier), q, [0.0, 0.0], dt=0.1, steps=1)
        assert vp.solve(problem, max_iterations=0).cost == pytest.approx(cost, abs=1e-12)


def test_robots_that_are_others(load, tmp_path):
    robot = load("ur5")
    inertia = '<inertial><mass value="0"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    light = vp.load_robot(str(mechanisms.arm(tmp_path, inertia)))
    with refused(vp.InputError, "mass"):
        vp.CenterOfMassCost(light, [0, 0, 0])
    heavier = vp.load_robot("ur5", payload=vp.Payload("tool0", 1.0))
    own = vp.ControlCost(1e-3) + vp.FramePositionCost(robot, "tool0", [0.45, 0.1, 0.4])
    vp.OptimalControlProblem(vp.Scene(heavier), own, np.zeros(6), np.zeros(6), dt=0.01, steps=5)


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


def test_weights_are_copied_and_frozen():
    weight, a = np.ones(2), np.array([[0.1], [0.3], [-0.7]])
    cost = vp.ControlCost(weight)
    weight[:] = 5.0
    assert_array_equal(cost.weight, 1.0)
    with pytest.raises(ValueError, match="read-only"):
        cost.weight[0] = 2.0
    # Of rank one, with rounding below zero.
    vp.TrackingCost(0.0, a @ a.T)


def test_costs_print_in_a_line():
    def near_the_wall(t, q, v, u):
        return q[:, 0] ** 2

    assert repr(vp.CustomCost(near_the_wall, name="wall")) == "CustomCost('wall')"
    total = 2.0 * vp.CustomCost(near_the_wall) + vp.Terminal(vp.TrackingCost([0.0]))
    assert repr(total) == "2 * CustomCost(near_the_wall) + Terminal(TrackingCost(weight=1.0))"
