"""Hard constraints of plans: against SciPy on the same grid, KKT conditions by differences, what is refused."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from refusals import naming, refused, unnamed
from scipy.integrate import solve_ivp
from threadpoolctl import threadpool_info, threadpool_limits

import varpin as vp
from varpin.control import ViolationOnRobot
from varpin.control.checks import foreseen
from varpin.model.clearance import capsule_around, clearance
from varpin.model.kinematics import frame_kinematics, reach


def two_links(constraints=(), *, steps=24, cost=None, **options):
    """Two links that are to swing up a little, faster than most constraints here allow."""
    robot = vp.planar_chain(2)
    scene = options.pop("scene", None) or vp.Scene(robot, damping=0.1)
    if cost is None:
        cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
        cost += vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0) + vp.VelocityCost(10.0))
    options = {"dt": 1.2 / steps, "steps": steps, **options}
    return vp.OptimalControlProblem(scene, cost, [0, 0], [0, 0], constraints=constraints, **options)


ROBOT = vp.planar_chain(2)
FAMILIES = {
    "positions": [vp.WithinJointLimits(ROBOT, (-0.05, [0.9, 2.0]))],
    "velocities": [vp.WithinVelocityLimits(ROBOT, (-1.2, 1.2))],
    "rates": [vp.WithinControlRate(150.0, before=[14.0, 4.0])],
    "goal": [vp.ReachFrame(ROBOT, "tip", position=[1.2, 0.0, -0.9])],
    "plane": [vp.KeepInHalfSpace(ROBOT, "tip", [0, 0, 1], -1.5)],
    "box": [vp.KeepInBox(ROBOT, "tip", [0.0, -np.inf, -1.6], [2.5, np.inf, np.inf])],
    "in a sphere": [vp.KeepInSphere(ROBOT, "tip", [1.5, 0.0, -0.5], 1.4)],
    "out of a sphere": [vp.KeepOutOfSphere(ROBOT, "tip", [1.3, 0.0, -1.3], 0.3)],
    "two": [vp.WithinVelocityLimits(ROBOT, (-1.5, 1.5)), vp.WithinControlRate(150.0)],
}


@pytest.mark.parametrize("torque", [1e-15, 1e-6, 1e-3])
def test_a_first_motion_that_costs_next_to_nothing_does_not_call_a_goal_infeasible(torque):
    """The plan is that of the same cost without the small reference, whose first motion costs nothing."""

    def plan(reference):
        cost = vp.ControlCost(0.1, reference=[reference, 0.0]) + vp.VelocityCost(0.02)
        problem = vp.OptimalControlProblem(
            vp.Scene(ROBOT, gravity=False, damping=0.1),
            cost + vp.Terminal(vp.VelocityCost(10.0)),
            [0.0, 0.1],
            [0.0, 0.0],
            dt=0.05,
            steps=24,
            constraints=[vp.ReachFrame(ROBOT, "tip", position=ROBOT.frame_positions([1.0, 0.5], "tip"))],
        )
        return vp.solve(problem, check=False)

    found, exact = plan(torque), plan(0.0)
    assert found.status is vp.Status.CONVERGED, found.reason
    assert found.violation <= 1e-6
    assert found.cost == pytest.approx(exact.cost, rel=1e-3)


def test_centres_that_move_are_compared_by_where_they_are():
    """In another process the same function has another address."""

    def problem(speed):
        ball = vp.Obstacle.sphere([1.5, 0.0, 0.5], 0.1).moving(lambda t: [speed * t, 0.0, 0.0])
        return two_links(
            [
                vp.KeepInSphere(ROBOT, "tip", lambda t: [speed * t, 0.0, 0.0], 5.0),
                vp.KeepClear(ROBOT, [ball], capsules={"tip": ([-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.05)}),
            ]
        )

    assert not problem(1.0).differs(problem(1.0).setting)
    assert "constraints" in problem(1.0).differs(problem(1.1).setting)


def test_the_jacobian_of_a_rotation():
    """Against differences; those of other families are in the gradients of Lagrangians of the table of plans."""
    robot = vp.load_robot("ur5")
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    goal = vp.ReachFrame(robot, "tool0", rotation=turn * np.linalg.det(turn))
    given = {"q0": np.zeros(6), "v0": np.zeros(6), "dt": 0.01, "steps": 3, "constraints": [goal]}
    (bound,) = vp.OptimalControlProblem(vp.Scene(robot), vp.ControlCost(1.0), **given).bound_constraints
    q, v, u = np.random.default_rng(1).normal(size=(4, 6)), np.zeros((4, 6)), np.zeros((3, 6))
    ends = [bound.value(q + sign * e, v, u) for e in 1e-6 * np.eye(6) for sign in (1.0, -1.0)]
    slopes = np.stack([(more - less) / 2e-6 for more, less in zip(ends[::2], ends[1::2], strict=True)], axis=2)
    np.testing.assert_allclose(bound.jacobian(q, v), np.pad(slopes, ((0, 0), (0, 0), (0, 6))), atol=1e-8)


def test_what_is_refused():
    other = vp.planar_chain(3)
    with refused(vp.InputError, "varpin.Scene"):
        two_links([vp.JointTie("joint1", "joint2")])
    with refused(vp.InputError, "robot"):
        two_links([vp.WithinJointLimits(other, (-1, 1))])
    with refused(vp.InputError, "limits"):
        vp.WithinVelocityLimits(ROBOT)
    with refused(vp.InputError, "position", "rotation"):
        vp.ReachFrame(ROBOT, "tip")
    with refused(vp.InputError, "rotation matrix"):
        vp.ReachFrame(ROBOT, "tip", rotation=2.0 * np.eye(3))
    with pytest.raises(vp.UnknownFrame):
        vp.KeepInBox(ROBOT, "hand", 0, 1)
    with refused(vp.InputError, "limit", "0"):
        vp.WithinControlRate(0.0)
    with refused(vp.InputError, "margin", "0"):
        vp.WithinJointLimits(ROBOT, (-1, 1), margin=-1.0)
    with refused(vp.InputError, "before", "nan"):
        two_links([vp.WithinControlRate(1.0, before=np.nan)])
    ball = vp.Obstacle.sphere([1.0, 0.0, 0.0], 0.1)
    arm = {"joint1": ([0, 0, 0], [1, 0, 0], 0.05)}
    for given, told in [
        ({"obstacles": None}, "obstacles"),
        ({"itself": "no"}, "itself"),
        ({"links": ["joint1", "joint1"]}, "twice"),
        ({"capsules": {"joint1": 0.05}}, "begin"),
        ({"capsules": [0.05]}, "capsules"),
    ]:
        with refused(vp.InputError, told):
            vp.KeepClear(ROBOT, **{"obstacles": [ball], "capsules": arm, **given})


def test_clearance_derivatives():
    """Of capsules against balls, boxes and each other, against differences; capsules hold all of their links."""
    robot = vp.load_robot("ur5")
    made = [
        vp.Obstacle.sphere([0.4, 0.2, 0.5], 0.15),
        vp.Obstacle.box([-0.3, 0.2, 0.3], [0.2, 0.3, 0.2]),
        vp.Obstacle.capsule([0.5, -0.5, 0.0], [0.5, -0.5, 1.0], 0.05),
    ]
    measure = clearance(robot, made, itself=True)
    q = np.random.default_rng(0).normal(size=(20, 6))
    slopes = measure.slopes(q)
    for c in range(6):
        e = np.zeros(6)
        e[c] = 1e-6
        found = (measure.distances(q + e) - measure.distances(q - e)) / 2e-6
        np.testing.assert_allclose(slopes[:, :, c], found, atol=1e-7)
    points = np.random.default_rng(1).normal(size=(500, 3)) * [1.0, 0.2, 0.1]
    begin, end, radius = capsule_around(points)
    along = np.clip((points - begin) @ (end - begin) / ((end - begin) @ (end - begin)), 0.0, 1.0)
    away = np.linalg.norm(points - begin - along[:, None] * (end - begin), axis=1)
    assert away.max() == pytest.approx(radius, rel=1e-9)


def test_capsule_distances_are_coals():
    """The distances of random capsules, by formula and by coal; ends, insides and balls among them."""
    rng = np.random.default_rng(3)
    coal = pin.coal
    robot = vp.planar_chain(1)
    for _ in range(100):
        a, b, c, d = rng.normal(size=(4, 3))
        one, other = rng.uniform(0.05, 0.2, 2)
        capsules = {"joint1": (a, b, one)}
        own = clearance(robot, [vp.Obstacle.capsule(c, d, other)], capsules=capsules).distances(np.zeros((1, 1)))
        R, p = frame_kinematics(robot, "joint1").placements(np.zeros((1, 1)))
        shapes = []
        for (x, y), r in ((((R[0] @ a + p[0]), (R[0] @ b + p[0])), one), ((c, d), other)):
            turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), y - x).toRotationMatrix()
            shapes += [coal.Capsule(r, float(np.linalg.norm(y - x))), coal.Transform3s(turn, 0.5 * (x + y))]
        known = coal.distance(*shapes, coal.DistanceRequest(), coal.DistanceResult())
        assert own[0, 0] == pytest.approx(known, abs=1e-6)


def test_monte_carlo_counts_what_margins_allow():
    """As an ensemble of the same seed does, of the bound and the node where most paths are outside."""
    limits = vp.WithinJointLimits(ROBOT, (-0.2, [0.9, 0.6]), margin=2.0)
    free = vp.WithinVelocityLimits(ROBOT, (-50.0, 50.0), margin=2.0)
    scene = vp.Scene(ROBOT, damping=0.3, noise=vp.AdditiveNoise(0.3))
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1.0) + vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0))
    constraints = [vp.WithinVelocityLimits(ROBOT, (-60.0, 60.0)), limits, free]
    problem = vp.OptimalControlProblem(scene, cost, [0, 0], [0, 0], dt=0.03, steps=40, constraints=constraints)
    plan, paths = vp.solve(problem, check=False), 1000
    seen = plan.monte_carlo(paths, rng=1)
    options = {"controls": plan.policy, "integrator": problem.integrator}
    found = vp.simulate_ensemble(scene, [0, 0], [0, 0], dt=0.03, steps=40, paths=paths, rng=1, **options)
    outside = (np.concatenate([found.q - [0.9, 0.6], -0.2 - found.q], axis=2)[:, 1:] > 0.0).sum(axis=0)
    # Constraints without a margin promise nothing, and are not counted.
    one, other = seen.broken
    assert (one.count, one.paths, other.count) == (outside.max(), paths, 0)
    node, row = np.argwhere(outside == outside.max())[0]
    names = [f"{side} limit of {joint}" for side in ("upper", "lower") for joint in ROBOT.joint_names]
    assert (one.label, one.row, one.time) == (limits.label, names[row], pytest.approx(0.03 * (node + 1)))
    share = outside.max() / paths
    assert one.standard_error == pytest.approx(np.sqrt(share * (1.0 - share) / paths))
    assert one.promised == pytest.approx(0.02275, rel=1e-3)
    assert abs(share - 0.02275) < 5.0 * one.standard_error
    assert not unnamed(str(seen), one.row, f"{one.count} of {paths}", "2.3 %")
    assert "WithinJointLimits" in seen._repr_html_()


def test_a_motion_that_leaves_the_nodes_tells_nothing_of_what_is_between_them():
    """An unstable motion runs away from the plan under its controls alone; from each node on it keeps the limits."""
    n, dt, steps, limit = 4, 0.1, 20, 3.15
    robot = vp.planar_chain(n)

    def reference(t):
        return np.append(-np.pi / 2, np.zeros(n - 1)) + np.linspace(0.5, -0.5, n) * (1.0 - np.cos(9.0 * t)) / 2.0

    tracking = vp.TrackingCost(reference, 10.0)
    problem = vp.OptimalControlProblem(
        vp.Scene(robot),
        vp.ControlCost(1e-6) + tracking + vp.Terminal(tracking),
        reference(0.0),
        np.zeros(n),
        dt=dt,
        steps=steps,
        constraints=[vp.WithinVelocityLimits(robot, (-limit, limit))],
    )
    plan = vp.solve(problem)

    def fastest(q, v, controls):
        rows = np.repeat(controls, 4, axis=0)
        motion = vp.simulate(
            problem.scene, q, v, dt=dt / 4, steps=len(rows), controls=rows, integrator=problem.integrator, check=False
        )
        return np.abs(motion.v).max()

    motion = plan.trajectory
    assert fastest(motion.q[0], motion.v[0], plan.controls) > 1.5 * limit
    assert max(fastest(motion.q[k], motion.v[k], plan.controls[k : k + 1]) for k in range(steps)) < limit
    assert not about(plan.warnings, "constraints between nodes")


def test_a_start_outside_is_told(caplog):
    """By its row and how far, before the search, and not as a violation between nodes of the first step."""
    problem = two_links([vp.WithinJointLimits(ROBOT, ([0.1, -1.0], 2.0))])
    vp.solve(problem, max_iterations=0)
    assert caplog.messages[0].startswith("the start is outside")
    plan = vp.solve(problem)
    (told,) = (sentence for sentence in plan.warnings if "WithinJointLimits" in sentence)
    assert not unnamed(told, "start", "WithinJointLimits", "lower limit of joint1", "0.1 rad")
    plan = vp.solve(two_links([vp.WithinJointLimits(ROBOT, (-1.0, 2.0))]))
    assert not any("start" in sentence for sentence in plan.warnings)


SCENE = """
[robot]
source = "ur5"
[initial]
q = [0.0, -1.2, 1.4, -1.8, -1.57, 0.0]
[horizon]
dt = 0.05
steps = 10
[[cost]]
type = "control"
[[plan_constraint]]
type = "velocity_limits"
lower = -1.0
upper = { elbow_joint = 0.5 }
margin = 1.5
[[plan_constraint]]
type = "control_rate"
limit = 500.0
before = 0.0
[[plan_constraint]]
type = "reach_frame"
frame = "tool0"
position = [0.5, 0.1, 0.4]
rotation = [3.1, 0.0, 0.0]
[[plan_constraint]]
type = "clearance"
distance = 0.02
links = ["forearm_link", "wrist_3_link"]
obstacles = [
    { type = "sphere", center = [0.4, 0.2, 0.5], radius = 0.1 },
    { type = "capsule", begin = [0.5, -0.5, 0.0], end = [0.5, -0.5, 1.0], radius = 0.05 },
    { type = "box", center = [-0.3, 0.2, 0.3], sides = [0.2, 0.3, 0.2] },
]
[[plan_constraint]]
type = "box"
frame = "tool0"
lower = [-1.0, -1.0, 0.0]
upper = [1.0, 1.0, 1.0]
[[plan_constraint]]
type = "half_space"
frame = "tool0"
normal = [0.0, 0.0, 1.0]
offset = 0.05
[[plan_constraint]]
type = "outside_sphere"
frame = "tool0"
center = [0.4, 0.2, 0.5]
radius = 0.1
[[plan_constraint]]
type = "joint_limits"
"""


def test_scene_files(tmp_path):
    """Each type becomes the constraint that it names; mistakes are told with their place."""
    path = tmp_path / "arm.toml"
    path.write_text(SCENE, encoding="utf-8")
    loaded = vp.load_scene(path)
    assert loaded.required.terms["the plan keeps"] == (
        "velocity limits, control rate, reach frame, clearance, box, half space, outside sphere, joint limits"
    )
    assert loaded.required.terms["not modelled"].endswith("shapes are read only for replays and clearance")
    made = loaded.problem.constraints
    speeds, rate, goal, clear, box, plane, sphere, joints = made
    assert speeds.margin == 1.5
    assert speeds.limits[1].tolist() == [np.inf, np.inf, 0.5, np.inf, np.inf, np.inf]
    assert (speeds.limits[0] == -1.0).all()
    assert rate.before == 0.0
    assert goal.position.tolist() == [0.5, 0.1, 0.4]
    assert goal.rotation[2, 2] == pytest.approx(np.cos(3.1))
    assert clear.pairs == tuple(
        f"{link} and {what}" for what in ("sphere", "capsule", "box") for link in ("forearm_link", "wrist_3_link")
    )
    assert box.limits[0].tolist() == [-1.0, -1.0, 0.0]
    assert (plane.offset, sphere.radius) == (0.05, 0.1)
    assert isinstance(joints, vp.WithinJointLimits)
    path.write_text(SCENE.replace('"forearm_link"', '"forearm"'), encoding="utf-8")
    with refused(vp.SceneFileError, "plan_constraint[3]", "'forearm'"):
        vp.load_scene(path)
    path.write_text(SCENE.replace("limit = 500.0", "limt = 500.0"), encoding="utf-8")
    with refused(vp.SceneFileError, "plan_constraint[1].limt"):
        vp.load_scene(path)


@pytest.mark.parametrize("family", ["velocities", "positions"])
@pytest.mark.parametrize(("damping", "fast"), [(200.0, True), (0.2, False)])
def test_a_margin_of_velocities_under_fast_damping_is_told_of(family, damping, fast):
    """The variances of velocities are too small there; those of positions are not."""
    scene = vp.Scene(ROBOT, damping=damping, noise=vp.AdditiveNoise(0.1))
    bound = {
        "velocities": vp.WithinVelocityLimits(ROBOT, (-20.0, 20.0), margin=2.0),
        "positions": vp.WithinJointLimits(ROBOT, (-20.0, 20.0), margin=2.0),
    }[family]
    plan = vp.solve(two_links([bound], steps=8, scene=scene, integrator=vp.Radau(2, kick="held")))
    assert bool(naming(plan.warnings, "WithinVelocityLimits", "margin", "standard deviation")) == (
        fast and family == "velocities"
    )


def test_a_margin_without_noise_is_told_of():
    plan = vp.solve(two_links([vp.WithinVelocityLimits(ROBOT, (-1.2, 1.2), margin=2.0)], steps=8))
    assert naming(plan.warnings, "margin", "noise")


def test_what_is_told_before_a_search():
    """What no motion meets, or looks like other units, is named, and these alone; what can be met is not."""
    given = {
        ("2.1 m", "2 m"): [vp.ReachFrame(ROBOT, "tip", position=[2.1, 0.0, 0.0])],
        ("millimetres",): [vp.ReachFrame(ROBOT, "tip", position=[1200.0, 0.0, -900.0])],
        ("90 rad",): [vp.WithinJointLimits(ROBOT, (10.0, 90.0)), vp.ReachFrame(ROBOT, "tip", position=[3.0, 0.0, 0.0])],
        ("joint1", "0.2 rad", "WithinJointLimits"): [vp.WithinJointLimits(ROBOT, (-1.0, 0.8))],
        ("joint1", "table", "0.01"): [
            vp.KeepClear(
                ROBOT,
                [vp.Obstacle.sphere([0.0, 0.0, -0.1], 0.06, name="table")],
                capsules={"joint1": ([0, 0, 0], [1, 0, 0], 0.05)},
            )
        ],
    }
    for facts, constraints in given.items():
        (told,) = foreseen(two_links(constraints))
        assert not unnamed(told, facts)
    for constraints in FAMILIES.values():
        assert all(not unnamed(told, "WithinJointLimits") for told in foreseen(two_links(constraints)))
    degrees = vp.ControlCost(1e-2) + vp.Terminal(2.0 * vp.TrackingCost([60.0, 30.0], 1.0))
    (told,) = foreseen(two_links(FAMILIES["velocities"], cost=degrees, control_limits=(-1.0, 1.0)))
    assert "60 rad" in told


def one_joint(joint, lower, upper):
    """A cart on rails, or a wheel, with limits of its own."""
    model = pin.Model()
    limits = (np.array([x]) for x in (100.0, 10.0, lower, upper))
    place = model.addJoint(0, joint, pin.SE3.Identity(), "moved", *limits)
    model.appendBodyToJoint(place, pin.Inertia(1.0, np.zeros(3), 0.1 * np.eye(3)), pin.SE3.Identity())
    model.addBodyFrame("cart", place, pin.SE3.Identity(), 0)
    return vp.load_robot(model)


def test_wide_limits_of_the_description_are_in_radians():
    robot = one_joint(pin.JointModelRZ(), -1e5, 1e5)
    for given, told in ((None, 0), ((-180.0, 180.0), 1)):
        constraints = [vp.WithinJointLimits(robot, given)]
        problem = vp.OptimalControlProblem(
            vp.Scene(robot, gravity=False), vp.ControlCost(1.0), [0], [0], dt=0.02, steps=10, constraints=constraints
        )
        assert [found.kind for found in foreseen(problem)] == ["limits in degrees"] * told


ARMS = ("ur3", "ur5", "ur10", "panda", "z1", "xarm7", "kinova", "so100", "talos_arm", "finger")


@pytest.mark.parametrize("name", [*ARMS, "tiago_no_hand"])
def test_reach_bounds_where_a_frame_gets(name):
    """Of many postures, rails included; targets there are not called out of reach, and farther ones are."""
    robot = vp.load_robot(name)
    frame = "wrist_ft_tool_link" if name == "tiago_no_hand" else robot.model.frames[robot.model.nframes - 1].name
    kinematics = frame_kinematics(robot, frame)
    lower, upper = robot.position_limits
    rng = np.random.default_rng(0)
    q = rng.uniform(np.maximum(lower, -7.0), np.minimum(upper, 7.0), (4000, robot.dof))
    places = kinematics.placements(q)[1]
    root = kinematics.links.tree.translation[0]
    away = np.linalg.norm(places - root, axis=1)
    most = reach(robot, kinematics)
    assert away.max() <= most < 1.4 * away.max()
    farthest = places[away.argmax()]
    scene = vp.Scene(robot)
    for target, reached in ((farthest, True), (places[0], True), (root + 1.01 * most * np.eye(3)[2], False)):
        cost = vp.ControlCost(1e-3) + vp.Terminal(2.0 * vp.FramePositionCost(robot, frame, target, 10.0))
        problem = vp.OptimalControlProblem(scene, cost, q[0], np.zeros(robot.dof), dt=0.1, steps=2)
        told = [finding for finding in foreseen(problem) if finding.kind == "goal out of reach"]
        assert len(told) == (not reached)
        assert reached or not unnamed(told[0], (frame, f"{1.01 * most:.4g} m", f"{most:.4g} m"))


def test_targets_out_of_reach():
    """Rows count, too, but only directions with a weight; a base on free rails gets anywhere."""

    def told(robot, target, **options):
        cost = vp.ControlCost(1e-3) + vp.FramePositionCost(robot, "tip", target, **options)
        rest = np.zeros(robot.dof)
        plan = vp.solve(vp.OptimalControlProblem(vp.Scene(robot), cost, rest, rest, dt=0.1, steps=2), max_iterations=1)
        return about(plan.warnings, "goal out of reach")

    robot, mobile = vp.planar_chain(2), vp.load_robot(vp.planar_chain(2).model, base="planar")
    assert told(robot, [2.1, 0.0, 0.0])
    assert told(robot, [2.1, 5.0, 0.0], weight=[1.0, 0.0, 1.0])
    assert not told(robot, [1.9, 5.0, 0.0], weight=[1.0, 0.0, 1.0])
    assert told(robot, np.linspace([1.0, 0.0, 0.0], [2.1, 0.0, 0.0], 3))
    assert not told(robot, np.linspace([1.0, 0.0, 0.0], [1.9, 0.0, 0.0], 3))
    assert not told(mobile, [30.0, 5.0, 0.0])


def test_references_of_rows_go_with_constraints():
    """Looking at a plan between its nodes takes no reference there."""
    reference = np.linspace(0.0, 1.0, 9)[:, None] * np.array([1.0, 0.5])
    cost = vp.ControlCost(1e-2) + vp.TrackingCost(reference, 10.0)
    plan = vp.solve(two_links([vp.WithinVelocityLimits(ROBOT, (-0.8, 0.8))], steps=8, cost=cost))
    assert plan.status is vp.Status.CONVERGED, plan.reason
    assert plan.violation <= 1e-6


def test_verification_tells_what_the_continuous_robot_violates():
    """Between nodes, and where coarse steps mislead; against an integration by SciPy."""
    problem = two_links(
        [*FAMILIES["velocities"], *FAMILIES["goal"]], steps=14, dt=0.1, integrator=vp.Midpoint(), sampling="midpoint"
    )
    plan = vp.solve(problem, check=False)
    seen = plan.verify(tolerance=1e-8)
    speed, goal = seen.constraints
    assert max(speed.planned, goal.planned) <= 1e-9
    x, fastest = np.zeros(4), 0.0

    def rate(_, x, torque):
        return np.append(x[2:], pin.aba(model, data, x[:2], x[2:], torque - 0.1 * x[2:]))

    model, data = ROBOT.model, ROBOT.model.createData()
    for torque in plan.controls:
        times = np.linspace(0.0, 0.1, seen.substeps + 1)
        found = solve_ivp(rate, (0.0, 0.1), x, "DOP853", rtol=1e-11, atol=1e-12, args=(torque,), t_eval=times).y
        x, fastest = found[:, -1], max(fastest, np.abs(found[2:]).max())
    assert speed.open_loop == pytest.approx(fastest - 1.2, rel=1e-3)
    tip = ROBOT.frame_positions(x[:2], "tip")
    assert goal.open_loop == pytest.approx(np.abs(tip - [1.2, 0.0, -0.9]).max(), rel=1e-4)
    assert speed.open_loop > 1e-3 < speed.closed_loop
    assert goal.closed_loop < goal.open_loop
    assert seen.violation == max(speed.closed_loop, goal.closed_loop)
    assert not unnamed(str(seen), "WithinVelocityLimits", "[rad/s]")
    assert "limit of joint" in speed.where


def test_a_motion_with_feedback_that_runs_away_is_no_small_violation():
    kept = ViolationOnRobot("one", "m", 0.0, 0.1, 0.2, "")
    lost = ViolationOnRobot("other", "m", 0.0, 0.1, np.nan, "")
    seen = vp.solve(two_links(FAMILIES["velocities"], steps=8), check=False).verify()
    for constraints in ((kept, lost), (lost, kept)):
        assert np.isnan(replace(seen, constraints=constraints).violation)
    assert replace(seen, constraints=(kept,)).violation == 0.2
    assert replace(seen, constraints=()).violation == 0.0


def test_linear_algebra_has_one_thread_within_constraints():
    """Of several plans at a time on one machine, each would take many times as long; afterwards it is as before."""
    problem, seen = two_links(FAMILIES["velocities"], steps=10), []

    def threads():
        return {item["num_threads"] for item in threadpool_info() if item["user_api"] == "blas"}

    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        vp.solve(problem, check=False, callback=lambda *_: seen.append(threads()))
        assert threads() == before
    assert len(seen) > 0
    assert all(each == {1} for each in seen)
