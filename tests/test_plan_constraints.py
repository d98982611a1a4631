"""Hard constraints of plans: what is told, scene files, Monte Carlo, and the continuous robot."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from plan_problems import SMALL, TWO, reach, speeds, tip
from refusals import refused, unnamed
from scipy.integrate import solve_ivp
from threadpoolctl import threadpool_info, threadpool_limits

import varpin as vp
from varpin.control import ViolationOnRobot
from varpin.control.checks import foreseen
from varpin.model.kinematics import frame_kinematics


def test_unknown_frames():
    with refused(vp.UnknownFrame, "'hand'"):
        vp.KeepInBox(TWO, "hand", 0, 1)


def test_monte_carlo_counts_what_margins_allow():
    limits = vp.WithinJointLimits(TWO, (-0.2, [0.9, 0.6]), margin=2.0)
    free = vp.WithinVelocityLimits(TWO, (-50.0, 50.0), margin=2.0)
    scene = vp.Scene(TWO, damping=0.3, noise=vp.AdditiveNoise(0.3))
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1.0) + vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0))
    constraints = [vp.WithinVelocityLimits(TWO, (-60.0, 60.0)), limits, free]
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


def test_a_start_outside_is_told(caplog):
    problem = reach(vp.WithinJointLimits(TWO, ([0.1, -1.0], 2.0)))
    vp.solve(problem, max_iterations=0)
    assert caplog.messages[0].startswith("the start is outside")
    plan = vp.solve(problem)
    (told,) = (sentence for sentence in plan.warnings if "WithinJointLimits" in sentence)
    assert not unnamed(told, "start", "WithinJointLimits", "lower limit of joint1", "0.1 rad")
    plan = vp.solve(reach(vp.WithinJointLimits(TWO, (-1.0, 2.0))))
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
    np.testing.assert_allclose(hull.begin + hull.hull.points.max(axis=0), [1.4, 0.3, 0.25])
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


def test_references_of_rows_go_with_constraints():
    reference = np.linspace(0.0, 1.0, 13)[:, None] * np.array([1.0, 0.5])
    plan = vp.solve(reach(speeds(1.8), more=vp.TrackingCost(reference, 10.0)))
    assert plan.status.converged, plan.reason
    assert plan.violation <= 1e-6


def test_verification_tells_what_the_continuous_robot_violates():
    problem = reach(speeds(1.2), tip(), steps=14, dt=0.1, integrator=vp.Midpoint(), sampling="midpoint")
    plan = vp.solve(problem, check=False)
    seen = plan.verify(tolerance=1e-8)
    speed, goal = seen.constraints
    assert max(speed.planned, goal.planned) <= 1e-9
    x, fastest = np.zeros(4), 0.0

    def rate(_, x, torque):
        return np.append(x[2:], pin.aba(model, data, x[:2], x[2:], torque - 0.1 * x[2:]))

    model, data = TWO.model, TWO.model.createData()
    for torque in plan.controls:
        times = np.linspace(0.0, 0.1, seen.substeps + 1)
        found = solve_ivp(rate, (0.0, 0.1), x, "DOP853", rtol=1e-11, atol=1e-12, args=(torque,), t_eval=times).y
        x, fastest = found[:, -1], max(fastest, np.abs(found[2:]).max())
    assert speed.open_loop == pytest.approx(fastest - 1.2, rel=1e-3)
    end = TWO.frame_positions(x[:2], "tip")
    assert goal.open_loop == pytest.approx(np.abs(end - [1.2, 0.0, -0.9]).max(), rel=1e-4)
    assert speed.open_loop > 1e-3 < speed.closed_loop
    assert goal.closed_loop < goal.open_loop
    assert seen.violation == max(speed.closed_loop, goal.closed_loop)
    assert not unnamed(str(seen), "WithinVelocityLimits", "[rad/s]")
    assert "limit of joint" in speed.where
    far = vp.solve(reach(vp.ReachFrame(TWO, "tip", position=[2.5, 0.0, 0.0])), max_iterations=0, check=False)
    assert far.verify().constraints[0].open_loop == pytest.approx(0.5, rel=0.1)


def test_a_motion_with_feedback_that_runs_away_is_no_small_violation():
    kept = ViolationOnRobot("one", "m", 0.0, 0.1, 0.2, "")
    lost = ViolationOnRobot("other", "m", 0.0, 0.1, np.nan, "")
    seen = SMALL["held, speeds"].plan.verify()
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
