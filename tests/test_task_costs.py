"""Costs in the task: kinematics against Pinocchio's, expansions against differences of its residuals, refusals."""

import mechanisms
import numpy as np
import pinocchio as pin
import pytest
from refusals import refused

import varpin as vp
from varpin.control.costs import Points
from varpin.model.kinematics import frame_kinematics, links

N = 5
STEP = 1e-2
WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def tree(seed):
    """A random tree with a frame set apart on its deepest joint."""
    model = mechanisms.random_tree(seed)
    rng = np.random.default_rng(seed)
    depths = [len(path) for path in model.supports]
    placement = pin.SE3(mechanisms.random_rotation(rng), rng.normal(0, 0.3, 3))
    model.addFrame(pin.Frame("hand", int(np.argmax(depths)), 0, placement, pin.FrameType.OP_FRAME))
    return vp.load_robot(model)


@pytest.fixture(params=["tree0", "tree1", "tree2", "ur5", "panda", "kinova"])
def arm(request, load):
    """A robot and the name of a frame; panda's fingers are tied to each other."""
    if request.param.startswith("tree"):
        return tree(int(request.param[4:])), "hand"
    robot = load(request.param)
    return robot, robot.end_effector


def state(robot, seed=0, count=N):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.5, 1.5, (count, robot.dof)), rng.normal(size=(count, robot.dof))


def pinocchio_frame(robot, frame, q, v):
    """Rotation, position and twist (6,) in world axes, joint by joint in Pinocchio."""
    model, data = robot.free_model, robot.free_model.createData()
    pin.forwardKinematics(model, data, robot.free_positions(q), robot.free_velocities(v))
    pin.updateFramePlacements(model, data)
    index = model.getFrameId(frame)
    placed = data.oMf[index]
    return placed.rotation.copy(), placed.translation.copy(), pin.getFrameVelocity(model, data, index, WORLD).vector


def differences(function, z):
    """Derivative (N, ..., d) of a function of z (N, d), of eighth order."""
    columns = []
    for a in range(z.shape[1]):
        e = STEP * np.eye(z.shape[1])[a]
        columns.append(sum(w * (function(z + k * e) - function(z - k * e)) for k, w in WEIGHTS.items()) / STEP)
    return np.stack(columns, axis=-1)


def test_a_frame_has_a_name():
    with refused(vp.InputError, "FramePositionCost frame", "[0, 0, 0]"):
        vp.FramePositionCost(vp.planar_chain(2), [0, 0, 0], "tip")


def test_frames(arm):
    robot, frame = arm
    q, v = state(robot)
    kinematics = frame_kinematics(robot, frame)
    R, p, J = kinematics.jacobians(q)
    for k in range(N):
        rotation, position, twist = pinocchio_frame(robot, frame, q[k], v[k])
        np.testing.assert_allclose(R[k], rotation, atol=1e-13)
        np.testing.assert_allclose(p[k], position, atol=1e-13)
        np.testing.assert_allclose(J[k] @ v[k], twist, atol=1e-12)
        whole = pin.computeFrameJacobian(
            robot.free_model,
            robot.free_model.createData(),
            robot.free_positions(q[k]),
            robot.free_model.getFrameId(frame),
            WORLD,
        )
        np.testing.assert_allclose(J[k], whole @ robot.free_velocities(np.eye(robot.dof)).T, atol=1e-13)
    for placed, once_more in zip(kinematics.placements(q), (R, p), strict=True):
        np.testing.assert_array_equal(placed, once_more)


def test_only_what_carries_a_frame_is_placed(load):
    robot = load("panda")
    assert len(links(robot.tree, 3).parent) == 4
    assert len(links(robot.tree).parent) == robot.tree.parent.size == 9


def turn(axis, angle):
    return pin.exp3(angle * np.asarray(axis) / np.linalg.norm(axis))


@pytest.mark.parametrize("axis", [(2, -1, 2), (-9, 2, 6), (2, 9, -6), (0, 0, 1)])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 9.9e-4, 1.01e-3, 0.5, 3.0, np.pi - 1e-5])
def test_orientation_at_every_distance(load, angle, axis):
    """The rotation vector from the target is exact, and its derivative, near no turn and near half a turn, too."""
    robot = load("ur5")
    q, v = state(robot, 2, 1)
    R = pinocchio_frame(robot, "tool0", q[0], v[0])[0]
    axis = np.array(axis) / np.linalg.norm(axis)
    target = R @ turn(axis, angle).T
    bound = vp.FrameOrientationCost(robot, "tool0", target, np.diag([1.0, 2.0, 3.0])).bind(
        Points(np.zeros(1), 1.0, 1, 6, 6)
    )
    u = np.zeros((1, 6))
    assert bound.value(q, v, u)[0] == pytest.approx(angle**2 * (axis**2 @ [1, 2, 3]), rel=1e-6, abs=1e-28)
    given = bound.expand(q, v, u)
    J = pin.Jlog3(turn(axis, angle)) @ R.T @ frame_kinematics(robot, "tool0").jacobians(q)[2][0, 3:]
    W = np.diag([1.0, 2.0, 3.0])
    np.testing.assert_allclose(given.gradient[0, :6], 2 * angle * J.T @ W @ axis, atol=1e-9 * max(angle, 1e-6))
    hessian = 2 * J.T @ W @ J
    np.testing.assert_allclose(given.hessian[0, :6, :6], hessian, atol=1e-8 * np.abs(hessian).max())


def test_targets_in_time(load):
    """Functions are sampled at the points, rows are linear between nodes, rotations turn evenly."""
    robot = load("ur5")
    steps = 4
    t = (np.arange(steps) + 0.5) * 0.25
    points = Points(t, 1.0, steps, 6, 6)
    q, v = state(robot, 3, steps)
    u = np.zeros((steps, 6))
    nodes = np.linspace(0.0, 1.0, steps + 1)

    def path(t):
        return np.array([t, 1.0 - t, 0.3])

    by_function = vp.FramePositionCost(robot, "tool0", path).bind(points)
    by_rows = vp.FramePositionCost(robot, "tool0", np.array([path(time) for time in nodes])).bind(points)
    at = np.array([pinocchio_frame(robot, "tool0", *row)[1] for row in zip(q, v, strict=True)])
    expected = ((at - np.array([path(time) for time in t])) ** 2).sum(axis=1)
    np.testing.assert_allclose(by_function.value(q, v, u), expected, rtol=1e-12)
    np.testing.assert_allclose(by_rows.value(q, v, u), expected, rtol=1e-12)

    def turning(t):
        return turn([1, 1, 0], 2.0 * t)

    by_function = vp.FrameOrientationCost(robot, "tool0", turning).bind(points)
    by_rows = vp.FrameOrientationCost(robot, "tool0", np.array([turning(time) for time in nodes])).bind(points)
    turns = [pinocchio_frame(robot, "tool0", *row)[0] for row in zip(q, v, strict=True)]
    expected = [(pin.log3(turning(time).T @ R) ** 2).sum() for time, R in zip(t, turns, strict=True)]
    np.testing.assert_allclose(by_function.value(q, v, u), expected, rtol=1e-10)
    np.testing.assert_allclose(by_rows.value(q, v, u), expected, rtol=1e-10)


@pytest.mark.parametrize("directions", ["all", "linear", ("x", "z", "ry")])
def test_manipulability(load, directions):
    """Yoshikawa's measure by Pinocchio's Jacobian; its slope by differences; nothing where there is enough of it."""
    robot = load("panda")
    rows = {"all": range(6), "linear": range(3)}.get(directions, [0, 2, 4])
    frame, n = robot.end_effector, robot.dof
    q, v = state(robot, 5)
    data = robot.free_model.createData()
    gear = robot.free_velocities(np.eye(n)).T

    def w(q):
        index = robot.free_model.getFrameId(frame)
        free = robot.free_positions(q)
        Js = [(pin.computeFrameJacobian(robot.free_model, data, row, index, WORLD) @ gear)[list(rows)] for row in free]
        return np.sqrt([np.linalg.det(J @ J.T) for J in Js])

    measured = w(q)
    least = float(np.median(measured))
    points = Points(np.linspace(0, 1, N), 1.0, N - 1, n, 1)
    bound = vp.ManipulabilityCost(robot, frame, least, 3.0, directions).bind(points)
    u = np.zeros((N, 1))
    lack = np.maximum(0.0, least - measured)
    np.testing.assert_allclose(bound.value(q, v, u), 3.0 * lack**2, rtol=1e-9, atol=1e-14)
    given = bound.expand(q, v, u)
    slope = differences(w, q)
    np.testing.assert_allclose(given.gradient[:, :n], -6.0 * lack[:, None] * slope, atol=1e-8 * np.abs(slope).max())
    hessian = 6.0 * (lack > 0.0)[:, None, None] * slope[:, :, None] * slope[:, None, :]
    below = measured < least * (1 - 1e-9)
    assert below.sum() == 2
    np.testing.assert_allclose(given.hessian[below][:, :n, :n], hessian[below], atol=1e-7 * np.abs(hessian).max())
    assert not given.hessian[measured > least * (1 + 1e-9)].any()


def test_barriers(load):
    """By hand: nothing inside, the square of what is beyond limit less margin outside."""
    robot = load("ur5")
    points = Points(np.zeros(3), 1.0, 3, 6, 6)
    q = np.zeros((3, 6))
    q[0, 1], q[1, 2], q[2, 5] = 7.0, -3.1, 6.2
    u = np.zeros((3, 6))
    bound = vp.JointLimitBarrier(robot, [1, 2, 3, 4, 5, 6], margin=0.1).bind(points)
    upper = 2 * np.pi - 0.1
    np.testing.assert_allclose(
        bound.value(q, u, u), [2 * (7.0 - upper) ** 2, 3 * (-3.1 + np.pi - 0.1) ** 2, 6 * (6.2 - upper) ** 2], rtol=1e-6
    )
    given = bound.expand(q, u, u)
    np.testing.assert_allclose(
        given.gradient[[0, 1, 2], [1, 2, 5]], [4 * (7.0 - upper), -6 * 0.05840735, 12 * 0.01681469], rtol=1e-6
    )
    assert np.count_nonzero(given.gradient) == 3
    np.testing.assert_allclose(given.hessian[[0, 1, 2], [1, 2, 5], [1, 2, 5]], [4, 6, 12])
    assert np.count_nonzero(given.hessian) == 3
    bound = vp.VelocityLimitBarrier(robot, 2.0).bind(points)
    v = np.zeros((3, 6))
    v[0, 0], v[1, 3], v[2, 1] = -4.0, 3.3, 3.0
    np.testing.assert_allclose(bound.value(q, v, u), [2 * 0.85**2, 2 * 0.1**2, 0.0], rtol=1e-6)
    given = bound.expand(q, v, u)
    np.testing.assert_allclose(given.gradient[[0, 1], [6, 9]], [-4 * 0.85, 4 * 0.1], rtol=1e-6)
    assert np.count_nonzero(given.gradient) == np.count_nonzero(given.hessian) == 2


def test_what_is_refused(load):
    robot = load("ur5")
    with refused(vp.UnknownFrame, "'ur5'", "'tool'", "'tool0'") as e:
        vp.FramePositionCost(robot, "tool", [0, 0, 0])
    assert "tool0" in e.value.matches
    assert "wrist_3_link" in e.value.frames
    with pytest.raises(vp.UnknownFrame):
        robot.frame_positions(np.zeros((1, 6)), "nowhere")
    with refused(vp.InputError, "'base_link'", "'ur5'"):
        vp.FrameVelocityCost(robot, "base_link")
    with refused(vp.InputError, "str"):
        vp.FramePositionCost("ur5", "tool0", [0, 0, 0])
    with refused(vp.InputError, "str"):
        vp.JointLimitBarrier("ur5")
    with refused(vp.InputError, "FramePositionCost weight", "3"):
        vp.FramePositionCost(robot, "tool0", [0, 0, 0], [1, 2])
    with refused(vp.InputError, "FrameVelocityCost weight", "positive semidefinite"):
        vp.FrameVelocityCost(robot, "tool0", 0.0, -1.0)
    with refused(vp.InputError, "ManipulabilityCost directions"):
        vp.ManipulabilityCost(robot, "tool0", 0.1, directions=["x", "x"])
    with refused(vp.InputError, "ManipulabilityCost directions"):
        vp.ManipulabilityCost(robot, "tool0", 0.1, directions="up")
    with refused(vp.InputError, "ManipulabilityCost least"):
        vp.ManipulabilityCost(robot, "tool0", 0.0)
    with refused(vp.InputError, "weight"):
        vp.ManipulabilityCost(robot, "tool0", 0.1, [1.0])
    chain = vp.planar_chain(2)
    with refused(vp.InputError, "2", "3"):
        vp.ManipulabilityCost(chain, "tip", 0.1, directions="linear")
    with refused(vp.InputError, "JointLimitBarrier", "'chain2'"):
        vp.JointLimitBarrier(chain)
    with refused(vp.InputError, "margin", "0", "-0.1"):
        vp.JointLimitBarrier(robot, margin=-0.1)
    with refused(vp.InputError, "VelocityLimitBarrier", "1", "-1"):
        vp.VelocityLimitBarrier(robot, limits=(1.0, -1.0))


def test_targets_that_are_refused(load):
    robot = load("ur5")
    points = Points(np.zeros(2), 1.0, 2, 6, 6)

    def bound(cost):
        return cost.bind(points)

    with refused(vp.InputError, "FramePositionCost reference", "(3,)"):
        bound(vp.FramePositionCost(robot, "tool0", [0.0, 1.0]))
    with refused(vp.CostError, "FramePositionCost", "reference", "0 s"):
        bound(vp.FramePositionCost(robot, "tool0", lambda t: [t]))
    for wrong, facts in (
        (2.0 * np.eye(3), "rotation"),
        (np.diag([1.0, 1.0, -1.0]), "rotation"),
        (np.full((3, 3), np.nan), "finite"),
        (np.eye(4), ("(3, 3)", "(3, 3, 3)")),
        (np.array([np.eye(3), 2 * np.eye(3), np.eye(3)]), ("1", "rotation")),
    ):
        with refused(vp.InputError, facts):
            bound(vp.FrameOrientationCost(robot, "tool0", wrong))
    for wrong in (lambda t: np.eye(2), lambda t: 2 * np.eye(3), lambda t: 1 / 0, lambda t: "up"):
        with refused(vp.CostError, "FrameOrientationCost", "0 s"):
            bound(vp.FrameOrientationCost(robot, "tool0", wrong))
    with refused(vp.InputError, "'ur5'", "6", "2"):
        vp.CenterOfMassCost(robot, [0, 0, 0]).bind(Points(np.zeros(2), 1.0, 2, 2, 2))


def test_a_robot_without_mass(tmp_path):
    """Its links' inertia alone is enough to move it, but it has no centre of mass."""
    inertia = '<inertial><mass value="0"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    robot = vp.load_robot(str(mechanisms.arm(tmp_path, inertia)))
    with refused(vp.InputError, "mass"):
        vp.CenterOfMassCost(robot, [0, 0, 0])


def test_a_cost_of_another_robot_is_refused(load):
    cost = vp.ControlCost(1e-3) + vp.Terminal(vp.FramePositionCost(load("ur10"), "tool0", [0.45, 0.1, 0.4]))
    with refused(vp.InputError, "FramePositionCost", "'ur10'", "scene.robot"):
        vp.OptimalControlProblem(vp.Scene(load("ur5")), cost, np.zeros(6), np.zeros(6), dt=0.01, steps=5)
    heavier = vp.load_robot("ur5", payload=vp.Payload("tool0", 1.0))
    own = vp.ControlCost(1e-3) + vp.FramePositionCost(load("ur5"), "tool0", [0.45, 0.1, 0.4])
    vp.OptimalControlProblem(vp.Scene(heavier), own, np.zeros(6), np.zeros(6), dt=0.01, steps=5)
