"""Hard constraints of plans: what is told, scene files, between nodes, with margins, and on the continuous robot."""

import pickle
import re
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
from chromium import animation, commands
from findings import about
from numpy.testing import assert_allclose
from oracles import exact, jacobian
from plan_problems import CAPSULES, REST, SMALL, TWO, reach, speeds, tip
from refusals import refused, unnamed
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation
from scipy.special import ndtr
from threadpoolctl import threadpool_info, threadpool_limits

import varpin as vp
from varpin import replay
from varpin.control.checks import foreseen
from varpin.control.constraints import BoundConstraint
from varpin.model.clearance import capsule_around, clearance
from varpin.model.kinematics import frame_kinematics


def test_slopes_of_rows_are_differences():
    robot, rng = vp.load_robot("ur5"), np.random.default_rng(1)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    rules = [
        vp.ReachFrame(robot, "tool0", [0.4, 0.1, 0.3], turn * np.linalg.det(turn)),
        vp.WithinJointLimits(robot, (-1.0, 1.0)),
        vp.WithinVelocityLimits(robot, (-1.0, 1.0)),
        vp.KeepInHalfSpace(robot, "tool0", [0.2, 0.3, 1.0], 0.1),
        vp.KeepInBox(robot, "tool0", -1.0, 1.0),
        vp.KeepInSphere(robot, "tool0", [0.1, 0.2, 0.3], 1.0),
        vp.KeepOutOfSphere(robot, "tool0", lambda t: [0.1 + t, 0.2, 0.3], 0.1),
    ]
    given = {"q0": np.zeros(6), "v0": np.zeros(6), "dt": 0.01, "steps": 3, "constraints": rules}
    problem, u = vp.OptimalControlProblem(vp.Scene(robot), vp.ControlCost(1.0), **given), np.zeros((3, 6))
    x = rng.normal(size=(4, 12))
    for bound in problem.bound_constraints:

        def value(x, bound=bound):
            return bound.value(x[:, :6], x[:, 6:], u)

        np.testing.assert_allclose(bound.jacobian(x[:, :6], x[:, 6:]), jacobian(value, x, 1e-3), atol=1e-8)


def test_monte_carlo_counts_what_margins_allow():
    free = vp.WithinVelocityLimits(TWO, (-50.0, 50.0), margin=2.0)
    problem = beside_a_limit(vp.AdditiveNoise(0.3))
    (limits,), scene = problem.constraints, problem.scene
    problem = problem.at(constraints=[vp.WithinVelocityLimits(TWO, (-60.0, 60.0)), limits, free])
    plan, paths = vp.solve(problem, check=False), 1000
    seen = plan.monte_carlo(paths, rng=1)
    options = {"controls": plan.policy, "integrator": problem.integrator}
    found = vp.simulate_ensemble(scene, [0, 0], [0, 0], dt=0.03, steps=40, paths=paths, rng=1, **options)
    outside = (np.concatenate([found.q - [0.9, 0.6], -0.2 - found.q], axis=2)[:, 1:] > 0.0).sum(axis=0)
    # Constraints without a margin promise nothing, and are not counted.
    one, other = seen.broken
    assert (one.count, one.paths, other.count) == (outside.max(), paths, 0)
    node, row = np.argwhere(outside == outside.max())[0]
    names = [f"{side} limit of {joint}" for side in ("upper", "lower") for joint in TWO.joint_names]
    assert (one.label, one.row, one.time) == (limits.label, names[row], pytest.approx(0.03 * (node + 1)))
    share = outside.max() / paths
    assert one.standard_error == pytest.approx(np.sqrt(share * (1.0 - share) / paths))
    assert one.promised == pytest.approx(0.02275, rel=1e-3)
    assert abs(share - 0.02275) < 5.0 * one.standard_error
    assert not unnamed(str(seen), one.row, f"{one.count} of {paths}", "2.3 %")
    assert "WithinJointLimits" in seen._repr_html_()


def test_a_motion_that_leaves_the_nodes_tells_nothing_of_what_is_between_them():
    """An unstable motion runs away under its controls alone; from each node on it keeps the limits."""
    n, dt, steps, limit = 4, 0.1, 20, 3.15
    robot = vp.planar_chain(n)

    def reference(t):
        return np.append(-np.pi / 2, np.zeros(n - 1)) + np.linspace(0.5, -0.5, n) * (1.0 - np.cos(9.0 * t)) / 2.0

    tracking = vp.TrackingCost(reference, 10.0)
    cost = vp.ControlCost(1e-6) + tracking + vp.Terminal(tracking)
    given = {"dt": dt, "steps": steps, "constraints": vp.WithinVelocityLimits(robot, (-limit, limit))}
    problem = vp.OptimalControlProblem(vp.Scene(robot), cost, reference(0.0), np.zeros(n), **given)
    plan = vp.solve(problem)

    def fastest(q, v, controls):
        fine = problem.at(dt=dt / 4, steps=4 * len(controls), q0=q, v0=v)
        return np.abs(fine.simulate(np.repeat(controls, 4, axis=0)).v).max()

    motion = plan.trajectory
    assert fastest(motion.q[0], motion.v[0], plan.controls) > 1.5 * limit
    assert max(fastest(motion.q[k], motion.v[k], plan.controls[k : k + 1]) for k in range(steps)) < limit
    assert not about(plan.warnings, "constraints between nodes")


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
    { type = "convex", points = [[1, 0, 1], [1.4, 0, 1], [1, 0.3, 1], [1, 0, 1.25], [1.1, 0.1, 1.1]] },
    { type = "mesh", path = "tetra.obj" },
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
    (tmp_path / "tetra.obj").write_text("v 1 0 0\nv 1.4 0 0\nv 1 0.3 0\nv 1 0 0.25\nf 1 2 3\nf 1 2 4\n")
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
        f"{link} and {what}"
        for what in ("sphere", "capsule", "box", "convex", "tetra")
        for link in ("forearm_link", "wrist_3_link")
    )
    hull = clear.obstacles[-1]
    np.testing.assert_allclose(hull.position + hull.points.max(axis=0), [1.4, 0.3, 0.25])
    assert box.limits[0].tolist() == [-1.0, -1.0, 0.0]
    assert (plane.offset, sphere.radius) == (0.05, 0.1)
    assert isinstance(joints, vp.WithinJointLimits)
    for old, new, facts in [
        ('"forearm_link"', '"forearm"', ("plan_constraint[3]", "'forearm'")),
        ("limit = 500.0", "limt = 500.0", ("plan_constraint[1].limt",)),
        ("tetra.obj", "lost.obj", ("plan_constraint[3].obstacles[4].path", "there is no file", "lost.obj")),
        ('"tetra.obj"', "7", ("plan_constraint[3].obstacles[4].path", "7")),
        ("links =", 'srdf = "lost.srdf"\nlinks =', ("plan_constraint[3].srdf", "lost.srdf")),
        ("links =", 'srdf = "tetra.obj"\nlinks =', ("plan_constraint[3]", "srdf", "itself")),
    ]:
        path.write_text(SCENE.replace(old, new), encoding="utf-8")
        with refused(vp.SceneFileError, *facts):
            vp.load_scene(path)


ARMS = ("ur3", "ur5", "ur10", "panda", "z1", "xarm7", "kinova", "so100", "talos_arm", "finger")


@pytest.mark.parametrize("name", [*ARMS, "tiago_no_hand"])
def test_reach_bounds_where_a_frame_gets(name):
    robot = vp.load_robot(name)
    frame = "wrist_ft_tool_link" if name == "tiago_no_hand" else robot.model.frames[robot.model.nframes - 1].name
    kinematics = frame_kinematics(robot, frame)
    lower, upper = robot.position_limits
    rng = np.random.default_rng(0)
    q = rng.uniform(np.maximum(lower, -7.0), np.minimum(upper, 7.0), (4000, robot.dof))
    places = kinematics.placements(q)[1]
    root = kinematics.links.tree.translation[0]
    away = np.linalg.norm(places - root, axis=1)

    def told(target):
        cost = vp.ControlCost(1e-3) + vp.Terminal(2.0 * vp.FramePositionCost(robot, frame, target, 10.0))
        problem = vp.OptimalControlProblem(vp.Scene(robot), cost, q[0], np.zeros(robot.dof), dt=0.1, steps=2)
        return [finding for finding in foreseen(problem) if finding.kind == "goal out of reach"]

    farthest, up = places[away.argmax()], np.eye(3)[2]
    (beyond,) = told(root + 1.5 * away.max() * up)
    most = float(re.search(r"gets (\S+) m", beyond)[1])
    assert away.max() <= 1.001 * most < 1.4 * away.max()
    assert not told(farthest) + told(places[0])
    (beyond,) = told(root + 1.01 * most * up)
    assert not unnamed(beyond, (frame, f"{1.01 * most:.4g} m", f"{most:.4g} m"))


def test_verification_tells_what_the_continuous_robot_violates():
    problem = reach(speeds(1.2), tip(), steps=14, dt=0.1, integrator=vp.Midpoint(), sampling="midpoint")
    plan = vp.solve(problem, check=False)
    seen = plan.verify(tolerance=1e-8)
    (speed, goal), (alone, opened) = seen.constraints, seen.open_loop_constraints
    assert plan.violation <= 1e-9
    parts = seen.substeps
    torques = lambda k, q, v: lambda t: plan.controls[k // parts]  # noqa: E731
    motion = exact(problem.scene, REST, REST, np.linspace(0.0, 1.4, 14 * parts + 1), torques)
    assert alone.violation == pytest.approx(np.abs(motion.v).max() - 1.2, rel=1e-3)
    end = TWO.frame_positions(motion.q[-1], "tip")
    assert opened.violation == pytest.approx(np.abs(end - [1.2, 0.0, -0.9]).max(), rel=1e-4)
    assert alone.violation > 1e-3 < speed.violation
    assert goal.violation < opened.violation
    assert seen.violation == max(speed.violation, goal.violation)
    assert not unnamed(str(seen), "WithinVelocityLimits", "[rad/s]")
    assert "limit of joint" in speed.where
    far = vp.solve(reach(vp.ReachFrame(TWO, "tip", position=[2.5, 0.0, 0.0])), max_iterations=0, check=False)
    assert far.verify().open_loop_constraints[0].violation == pytest.approx(0.5, rel=0.1)


def test_before_the_first_node_a_start_outside_is_no_violation():
    plan = vp.solve(reach(vp.WithinJointLimits(TWO, ([0.01, -np.inf], np.inf)), between_nodes=True))
    assert plan.violation <= 1e-9
    assert plan.verify().violation < 1e-4


def test_a_motion_with_feedback_that_runs_away_is_no_small_violation():
    seen = SMALL["held, speeds"].plan.verify()
    (own,) = seen.constraints
    kept, lost = (replace(own, values=np.full(own.values.shape, value)) for value in (0.2, np.nan))
    for constraints in ((kept, lost), (lost, kept)):
        assert np.isnan(replace(seen, constraints=constraints).violation)
    assert replace(seen, constraints=(kept,)).violation == 0.2
    assert replace(seen, constraints=()).violation == 0.0


def test_linear_algebra_has_one_thread_within_constraints():
    """Several plans at a time on one machine would each take many times as long."""
    problem, seen = SMALL["held, speeds"].problem, []

    def threads():
        return {item["num_threads"] for item in threadpool_info() if item["user_api"] == "blas"}

    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        vp.solve(problem, check=False, callback=lambda *_: seen.append(threads()))
        assert threads() == before
    assert len(seen) > 0
    assert all(each == {1} for each in seen)


# --- between nodes, too ----------------------------------------------------------------------------------------------


ROBOT = vp.planar_chain(2)
N, DT, LIMIT = 6, 0.1, 0.6


def in_speeds(limit=LIMIT, **options):
    cost = vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([0.6, -0.6], 1e2) + vp.VelocityCost(1.0))
    given = {"constraints": [vp.WithinVelocityLimits(ROBOT, (-limit, limit))], "between_nodes": True} | options
    scene, rest = vp.Scene(ROBOT, damping=0.1), np.zeros(2)
    return vp.OptimalControlProblem(scene, cost, rest, rest, dt=DT, steps=N, **given)


def speeds_of(problem, u, parts):
    lines = problem.controls == "linear"
    controls = vp.FirstOrderHold(u).refined(parts) if lines else np.repeat(u, parts, axis=0)
    given = {"dt": DT / parts, "steps": N * parts, "controls": controls, "check": False}
    return np.abs(vp.simulate(problem.scene, problem.q0, problem.v0, integrator=vp.RungeKutta4(), **given).v)


@dataclass(frozen=True, eq=False)
class BoundSpeeds(BoundConstraint):
    def value(self, q, v, u):
        speeds = v[..., self.places, :]
        return np.concatenate([speeds - LIMIT, -speeds - LIMIT], axis=-1)

    def jacobian(self, q, v):
        return np.tile(np.kron([[0.0, 1.0], [0.0, -1.0]], np.eye(2)), (len(self.places), 1, 1))


class Speeds(vp.PlanConstraint):
    """WithinVelocityLimits as a user would write them, at the last nodes."""

    def __init__(self, nodes):
        self.nodes = nodes

    def bind(self, horizon):
        places = np.arange(horizon.steps - min(self.nodes, horizon.steps), horizon.steps) + 1
        return BoundSpeeds(self, places, horizon.t[places], ("a", "b", "c", "d"), "rad/s", 0.12)


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_constraints_of_ones_own_hold_between_nodes_where_they_are_at_all(controls):
    everywhere = vp.solve(in_speeds(constraints=Speeds(10**6), controls=controls))
    known = vp.solve(in_speeds(controls=controls))
    assert everywhere.status.converged
    assert everywhere.cost == pytest.approx(known.cost, rel=1e-6)
    assert speeds_of(everywhere.problem, everywhere.controls, 32).max() <= LIMIT + 2e-6
    assert_allclose(everywhere.constraints[0].t, known.constraints[0].t, atol=1e-6)
    late = vp.solve(in_speeds(constraints=Speeds(2), controls=controls))
    assert_allclose(late.constraints[0].t, [DT * (N - 1), DT * N])
    assert late.cost < known.cost


def test_speeds_between_nodes_that_nobody_asks_for_are_told():
    alone = vp.solve(in_speeds(between_nodes=False))
    assert speeds_of(alone.problem, alone.controls, 32).max() > LIMIT + 1e-2
    (told,) = about(alone.warnings, "constraints between nodes")
    assert "between_nodes=True" in told


def apart(z):
    start = ROBOT.frame_positions(np.zeros(2), "tip")
    return in_speeds(constraints=vp.KeepOutOfSphere(ROBOT, "tip", start + np.array([0.0, 0.0, z]), 0.05))


def moving(speed):
    """In another process the same function has another address."""

    def way(t):
        return [speed * t, 0.0, 0.0]

    ball = vp.Obstacle.sphere([1.5, 0.0, 0.5], 0.1).moving(way)
    clear = vp.KeepClear(ROBOT, [ball], capsules=CAPSULES)
    return in_speeds(constraints=[vp.KeepInSphere(ROBOT, "tip", way, 5.0), clear])


def test_constraints_print_their_numbers():
    robot = vp.planar_chain(2)
    tip = robot.model.frames[-1].name
    ball = vp.KeepOutOfSphere(robot, tip, [1.0, 2.0, 3.0], 0.25, margin=2.0)
    assert not unnamed(repr(ball), "KeepOutOfSphere(", repr(tip), "[1.0, 2.0, 3.0]", "0.25", "margin=2.0")


@pytest.mark.parametrize(
    ("build", "one", "other", "fact"),
    [
        (lambda between: in_speeds(between_nodes=between), True, False, "between_nodes"),
        (apart, 0.2, -0.2, "constraints"),
        (moving, 1.0, 1.1, "constraints"),
    ],
    ids=["instants", "places away from the start", "ways"],
)
def test_plans_within_other_constraints_are_refused(build, one, other, fact, tmp_path):
    plan = vp.solve(build(one), max_iterations=1, check=False)
    path = plan.save(tmp_path / "plan.npz")
    assert vp.Solution.load(path, build(one)).cost == plan.cost
    with refused(vp.FileError, fact):
        vp.Solution.load(path, build(other))
    with refused(vp.InputError, fact):
        vp.solve(build(other), resume=plan, check=False)


def test_copies_and_files_know_the_option(tmp_path):
    problem, alone = in_speeds(), in_speeds(between_nodes=False)
    for copy in (problem.at(dt=DT / 2), problem.at(q0=[0.1, 0.0]), problem.at(controls="linear")):
        assert copy.between_nodes
    assert not alone.at(dt=DT / 2).between_nodes
    # Files without the entry are of problems that ask for nothing between nodes.
    plan = vp.solve(alone, check=False)
    with np.load(plan.save(tmp_path / "plan.npz")) as archive:
        np.savez(tmp_path / "older.npz", **{name: archive[name] for name in archive if name != "between_nodes"})
    assert vp.Solution.load(tmp_path / "older.npz", alone).controls.tobytes() == plan.controls.tobytes()


# --- margins by count, where values in motions under noise are not normally distributed ------------------------------


HANGING = np.array([np.pi / 2 - 0.3, 0.0])
GRID = {"dt": 0.05, "steps": 20}
PATHS = 4000


def under_a_lid(noise, margin=2.0, **grid):
    """The tip of two hanging links is higher whichever way noise pushes it."""
    scene = vp.Scene(TWO, damping=0.5, noise=noise)
    cost = vp.ControlCost(1.0) + vp.VelocityCost(0.3) + vp.TrackingCost(HANGING, 10.0)
    lid = vp.KeepInHalfSpace(TWO, "tip", [0.0, 0.0, -1.0], 1.86, margin=margin)
    return vp.OptimalControlProblem(scene, cost, HANGING, np.zeros(2), constraints=[lid], **GRID | grid)


def beside_a_limit(noise, **options):
    within = vp.WithinJointLimits(TWO, (-0.2, [0.9, 0.6]), margin=2.0)
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1.0) + vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0))
    scene = vp.Scene(TWO, damping=0.3, noise=noise)
    return vp.OptimalControlProblem(scene, cost, REST, REST, dt=0.03, steps=40, constraints=[within], **options)


def arm(name, begin, travel, noise):
    robot, begin = vp.load_robot(name, lock={"panda": {"panda_finger_joint1": 0.02}}.get(name)), np.array(begin)
    goal, scene = begin + travel, vp.Scene(robot, damping=0.5, noise=noise)
    cost = vp.ControlCost(1e-3, scene.holding_torque(begin)) + vp.TrackingCost(goal, 10.0)
    cost += vp.Terminal(vp.TrackingCost(goal, 100.0) + vp.VelocityCost(1.0))
    within = vp.WithinJointLimits(robot, (begin - 0.3, goal - 0.1), margin=2.0)
    return vp.OptimalControlProblem(scene, cost, begin, np.zeros(robot.dof), constraints=[within], **GRID)


UR3, PANDA = [0.0, -1.0, 1.0, 0.0, 0.5, 0.0], [0.0, -0.5, 0.0, -1.8, 0.0, 1.5, 0.5]
BOUNDED = {
    "held": lambda: beside_a_limit(vp.AdditiveNoise(0.05)),
    "linear": lambda: beside_a_limit(vp.AdditiveNoise(0.05), controls="linear"),
    "torques": lambda: beside_a_limit(vp.AdditiveNoise(0.05), control_limits=([-32.0, -12.0], [32.0, 12.0])),
    "noise of the controls": lambda: beside_a_limit(vp.ControlNoise(0.03)),
    # By the linear model's margins 3 to 5 % of motions were outside.
    "ur3, noise of the controls": lambda: arm("ur3", UR3, 0.6, vp.ControlNoise(0.05)),
    "panda, noise of the controls": lambda: arm("panda", PANDA, 0.4, vp.ControlNoise(0.02)),
    "z1": lambda: arm("z1", [0.0, 1.5, -1.5, 0.0, 0.0, 0.0, 0.0], 0.4, vp.AdditiveNoise(0.1)),
}


def outside(problem, plan):
    """The share (K, rows) of other motions that violate the problem's constraint at each node."""
    options = {"controls": plan.policy, "integrator": problem.integrator, "dt": problem.dt, "steps": problem.steps}
    found = vp.simulate_ensemble(problem.scene, problem.q0, problem.v0, paths=PATHS, rng=1, **options)
    (own,) = problem.constraints
    if isinstance(own, vp.WithinJointLimits):
        beyond = np.concatenate([found.q - own.limits[1], own.limits[0] - found.q], axis=2)
    else:
        places = TWO.frame_positions(found.q.reshape(-1, 2), own.frame).reshape(*found.q.shape[:2], 3)
        beyond = (own.offset - places @ own.normal)[:, :, None]
    return (beyond[:, 1:] > 0.0).mean(axis=0)


def most_allowed():
    share = ndtr(-2.0)
    return share + 3.0 * np.sqrt(share * (1.0 - share) / PATHS)


@pytest.mark.parametrize("name", BOUNDED)
def test_margins_in_standard_deviations(name):
    """At margin 2 by at most 2.3 % of motions for each bound and node, at an active one by many."""
    problem = BOUNDED[name]()
    plan = vp.solve(problem, check=False)
    assert plan.status.converged, plan.reason
    share = outside(problem, plan).max()
    assert share <= most_allowed()
    # The linear model's margins do for two links under noise of constant strength.
    assert (plan.search.counts > 0) == (name not in ("held", "linear", "torques"))
    if problem.scene.robot.dof > 2:
        return
    assert share >= 0.5 * ndtr(-2.0)
    # With their margins, values are at the bound.
    assert plan.constraints[0].values.max() == pytest.approx(0.0, abs=1e-6)
    # Without noise the plan keeps away from the bound.
    assert (problem.constraints[0].limits[1] - plan.trajectory.q).min() > 1e-3


@pytest.mark.parametrize(
    ("problem", "most"),
    [
        (beside_a_limit(vp.ControlNoise(0.3)), 40),
        (beside_a_limit(vp.ControlNoise(1.0)), 40),
        (beside_a_limit(vp.AdditiveNoise(3.0)), 40),
        # It is above the lid in almost every second motion, whatever the margin.
        (under_a_lid(vp.AdditiveNoise(1.5)), 200),
    ],
    ids=["controls", "strong", "additive", "lid"],
)
def test_noise_too_strong_for_a_margin_is_infeasible(problem, most):
    """Margins move with the motion, so that each program foresees a plan that the next one has not."""
    plan = vp.solve(problem, check=False)
    assert plan.status is vp.Status.INFEASIBLE
    assert plan.iterations <= most
    assert "its margin of" in plan.reason


def test_a_plan_with_margins_that_is_cut_is_resumed_as_if_it_had_not_been():
    problem = under_a_lid(vp.AdditiveNoise(0.4))
    whole = vp.solve(problem, check=False)
    part = vp.solve(problem, check=False, max_iterations=8)
    rest = vp.solve(problem, check=False, resume=part)
    assert whole.status is rest.status is vp.Status.CONVERGED
    np.testing.assert_array_equal(rest.controls, whole.controls)


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_margins_that_grow_with_the_motion_do_not_run_away(controls):
    """Noise of the controls: a motion that meets wide margins at once is violent, and has wider ones."""
    scene = vp.Scene(TWO, damping=0.5, noise=vp.ControlNoise(0.1))
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([0.9, 0.5], 100.0) + vp.VelocityCost(10.0))
    within = vp.WithinJointLimits(TWO, (-0.15, 1.0), margin=2.0)
    grid = {"dt": 0.05, "steps": 16, "controls": controls}
    free = vp.solve(vp.OptimalControlProblem(scene, cost, REST, REST, **grid), check=False)
    problem = vp.OptimalControlProblem(scene, cost, REST, REST, constraints=[within], **grid)
    plan = vp.solve(problem, check=False)
    assert plan.cost + plan.noise_cost < 3.0 * (free.cost + free.noise_cost)
    assert plan.status in (vp.Status.CONVERGED, vp.Status.INFEASIBLE)
    if plan.status.converged:
        assert outside(problem, plan).max() <= most_allowed()


def test_a_warning_of_a_small_margin_counts():
    """Noise that Python evaluates leaves margins as they are."""
    coarse = {"dt": 0.1, "steps": 8}
    problem = under_a_lid(vp.CustomNoise(lambda q, v, u: 0.7 * np.eye(2), 2), **coarse)
    plan = vp.solve(problem)
    (told,) = about(plan.warnings, "small margin")
    (bound,) = problem.bound_constraints
    place = int(np.argmin(np.abs(bound.times - told.time)))
    # The same noise, compiled.
    often = outside(under_a_lid(vp.AdditiveNoise(0.7), **coarse), plan)[place, 0]
    # Of 512 motions, at the worst of a few places.
    assert abs(often - told.value) < 4.0 * np.sqrt(told.value / 512)
    assert f"{100.0 * told.value:.3g} % of motions" in told


# --- obstacles: distances by least squares, slopes by differences, drawings, SRDF files ------------------------------


CUBE = np.array(list(product([-0.5, 0.5], repeat=3)))
TURN = Rotation.from_euler("xyz", [0.3, -0.5, 0.8]).as_matrix()
# The base of a wedge, whose edge lies above one of its sides.
WEDGE = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.3, 0], [0.4, 0.3, 0], [0, 0, 0.25], [0, 0.3, 0.25]], dtype=float)


UR5 = {"forearm_link": ([0, 0, 0], [0, 0, 0.4], 0.06), "wrist_3_link": ([0, 0, 0], [0, 0.1, 0], 0.05)}


def drum(corners=64):
    """A cylinder's corners: more than coal looks through one by one, and flat ends."""
    turn = 2.0 * np.pi * np.arange(corners) / corners
    return np.vstack([np.c_[0.3 * np.cos(turn), 0.3 * np.sin(turn), np.full(corners, z)] for z in (-0.4, 0.4)])


def least_distance(points, segment):
    """By least squares with non-negative shares that sum to 1 on each side."""
    heavy = 1e5
    ones, none = np.ones(len(points)), np.zeros(len(points))
    sums = heavy * np.vstack([np.r_[ones, 0.0, 0.0], np.r_[none, 1.0, 1.0]])
    rows = np.vstack([np.hstack([points.T, -segment.T]), sums])
    shares, _ = nnls(rows, np.r_[0.0, 0.0, 0.0, heavy, heavy])
    one, other = shares[: len(points)], shares[len(points) :]
    return np.linalg.norm(points.T @ one / one.sum() - segment.T @ other / other.sum())


def test_eight_points_are_a_box():
    robot = vp.load_robot("ur5")
    center, sides = np.array([0.4, 0.2, 0.4]), np.array([0.3, 0.2, 0.5])

    def measured(obstacle):
        return clearance(robot, [obstacle], links=list(UR5), capsules=UR5)

    def way(t):
        return [0.1 * t, 0.0, -0.2 * t]

    box = vp.Obstacle.box(center, sides, TURN).moving(way)
    made = [
        vp.Obstacle.convex([*(CUBE * sides), [0, 0, 0], *(CUBE * sides)], center, TURN).moving(way),
        vp.Obstacle.convex((CUBE * sides) @ TURN.T + center).moving(way),
    ]
    assert made[0].points.shape == (8, 3)
    q = np.random.default_rng(0).normal(size=(40, 6))
    times = np.arange(20.0) / 10.0
    known = measured(box).over(times)
    assert known.distances(q).min() < -0.05
    assert known.distances(q).max() > 0.5
    for hull in (*made, pickle.loads(pickle.dumps(vp.Obstacle.convex(CUBE * sides, center, TURN)))):
        expected = known if hull.shift else measured(vp.Obstacle.box(center, sides, TURN))
        measure = measured(hull).over(times)
        assert_allclose(measure.distances(q), expected.distances(q), atol=1e-9)
        assert_allclose(measure.slopes(q), expected.slopes(q), atol=1e-8)


@pytest.mark.parametrize(
    ("points", "made"),
    [
        (WEDGE, vp.Obstacle.convex(WEDGE)),
        (drum(), vp.Obstacle.convex(drum())),
        (WEDGE[[1, 4]], vp.Obstacle.capsule(*WEDGE[[1, 4]], 0.1)),
        ((CUBE * [0.3, 0.2, 0.5]) @ TURN.T + [0.1, 0.2, 0.3], vp.Obstacle.box([0.1, 0.2, 0.3], [0.3, 0.2, 0.5], TURN)),
    ],
    ids=["wedge", "drum", "capsule", "box"],
)
def test_distances_are_those_of_least_squares(points, made):
    rng = np.random.default_rng(1)
    robot = vp.planar_chain(1)
    (R,), (p,) = frame_kinematics(robot, "joint1").placements(np.zeros((1, 1)))
    clear = 0
    for _ in range(40):
        segment = 0.7 * rng.normal(size=(2, 3))
        here = (segment - p) @ R
        found = clearance(robot, [made], capsules={"joint1": (*here, 0.05)}).distances(np.zeros((1, 1)))[0, 0]
        known = least_distance(points, segment)
        if known > 1e-6:
            clear += 1
            assert found == pytest.approx(known - 0.05 - made.radius, abs=1e-9)
        else:
            assert found < -0.05 + 1e-6
    assert clear > 15


def test_a_plane_is_the_same_with_a_normal_of_any_length():
    planes = [vp.KeepInHalfSpace(TWO, "tip", [0.0, 0.0, -size], 1.5 * size) for size in (1.0, 2.0)]
    below = [vp.solve(reach(plane), max_iterations=0).violation for plane in planes]
    assert below[0] == pytest.approx(below[1], rel=1e-12)
    assert below[0] > 0.1


def test_links_that_overlap_at_rest_do_not_clear_each_other():
    """Of three links in a row the outer ones are no neighbours: thick ones overlap at all angles, and have no pair."""
    robot = vp.planar_chain(4)
    for radius, pairs in ((0.05, 3), (0.6, 1)):
        thick = {f"joint{k}": ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], radius) for k in range(1, 5)}
        assert len(clearance(robot, [], itself=True, capsules=thick).pairs) == pairs


def test_slopes_are_differences():
    robot = vp.load_robot("ur5")
    made = [
        vp.Obstacle.sphere([0.4, 0.2, 0.5], 0.15),
        vp.Obstacle.box([-0.3, 0.2, 0.3], [0.2, 0.3, 0.2]),
        vp.Obstacle.capsule([0.5, -0.5, 0.0], [0.5, -0.5, 1.0], 0.05),
        vp.Obstacle.convex(WEDGE, [-0.5, 0.2, 0.3], TURN),
        vp.Obstacle.convex(drum(), [0.6, -0.4, 0.4], TURN.T),
    ]
    measure = clearance(robot, made, itself=True)
    q = np.random.default_rng(0).normal(size=(20, 6))
    assert_allclose(measure.slopes(q), jacobian(measure.distances, q, 1e-6), atol=1e-7)
    points = np.random.default_rng(1).normal(size=(500, 3)) * [1.0, 0.2, 0.1]
    begin, end, radius = capsule_around(points)
    along = np.clip((points - begin) @ (end - begin) / ((end - begin) @ (end - begin)), 0.0, 1.0)
    away = np.linalg.norm(points - begin - along[:, None] * (end - begin), axis=1)
    assert away.max() == pytest.approx(radius, rel=1e-9)


@pytest.mark.parametrize(
    ("given", "facts"),
    [
        ({"points": WEDGE[:3]}, ("points", "(N, 3)", "4")),
        ({"points": np.zeros((5, 3))}, ("points", "plane")),
        ({"points": WEDGE[:4]}, ("points", "plane")),
        ({"points": WEDGE * [1.0, np.nan, 1.0]}, ("points", "finite")),
        ({"points": np.vstack([drum(300)[:300], [[0.0, 0.0, 1.0]]])}, ("300", "254", "fewer")),
        ({"points": WEDGE, "rotation": 2.0 * np.eye(3)}, ("rotation",)),
        ({"points": WEDGE, "position": [0.0]}, ("position",)),
    ],
)
def test_what_is_no_hull_is_refused(given, facts):
    with refused(vp.InputError, *facts):
        vp.Obstacle.convex(**given)


def test_drawn_where_it_is(tmp_path):
    hull = vp.Obstacle.convex(WEDGE, [0.5, 0.1, 0.2], TURN).moving(lambda t: [t, 0.0, 0.0])
    problem = reach(vp.KeepClear(TWO, [hull], capsules=CAPSULES))
    known = WEDGE @ TURN.T + [0.5, 0.1, 0.2]
    page = replay(
        problem.scene.robot, np.zeros((2, 2)), dt=1.0, marks=vp.Marks(constraints=problem), html=tmp_path / "wedge.html"
    )
    drawn, placed = (
        command for command in commands(page) if command.get("path", "").endswith("notes/0 obstacle convex")
    )
    data = drawn["object"]["geometries"][0]["data"]
    at = np.array(placed["matrix"]).reshape(4, 4).T[:3, 3]
    seen = np.frombuffer(data["attributes"]["position"]["array"].data, dtype=np.float32).reshape(-1, 3) + at
    assert_allclose(np.sort(seen, axis=0), np.sort(known, axis=0), atol=1e-6)
    faces = np.frombuffer(data["index"]["array"].data, dtype=np.uint32).reshape(-1, 3)
    a, b, c = (seen[faces[:, k]] for k in range(3))
    # The divergence theorem: the volume within the triangles.
    assert (a * np.cross(b, c)).sum() / 6.0 == pytest.approx(0.5 * 0.4 * 0.25 * 0.3, rel=1e-5)
    (track,) = [values for (path, _), (_, values) in animation(page)[0].items() if "notes" in path]
    assert_allclose(np.diff(track, axis=0), [[1.0, 0.0, 0.0]], atol=1e-6)


def srdf_of(path, *pairs):
    rows = "".join(f'<disable_collisions link1="{one}" link2="{other}" reason="Never"/>' for one, other in pairs)
    path.write_text(f'<robot name="r">{rows}</robot>', encoding="utf-8")
    return path


def test_an_srdf_of_another_robot_is_refused(tmp_path):
    robot = vp.planar_chain(4)
    capsules = {f"joint{k}": ([0, 0, 0], [1, 0, 0], 0.05) for k in range(1, 5)}

    def pairs(*disabled):
        path = srdf_of(tmp_path / "arm.srdf", *disabled)
        return vp.KeepClear(robot, itself=True, links=list(capsules), capsules=capsules, srdf=path).pairs

    pair = ("joint4", "joint1")
    assert pairs(pair) == ("joint1 and joint3", "joint2 and joint4")
    with refused(vp.InputError, "KeepClear srdf", "itself=True"):
        ball = vp.Obstacle.sphere([3, 0, 3], 0.1)
        vp.KeepClear(robot, [ball], links=list(capsules), capsules=capsules, srdf=tmp_path / "arm.srdf")
    for disabled in ((("panda_link1", "panda_link4"),), ()):
        with refused(vp.InputError, "arm.srdf", repr(robot.name)):
            pairs(*disabled)
