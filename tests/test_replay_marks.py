"""What a replay shows beside the robot: paths, targets, frames, torques, constraints, plans, other robots."""

import itertools
import re

import numpy as np
import pinocchio as pin
import pytest
import zoo
from chromium import animation, commands, names, picture, pose, poses, seek, shape_poses, shapes_stand
from oracles import placements
from plan_problems import CAPSULES
from refusals import refused
from scipy.spatial.transform import Rotation

import varpin as vp
from varpin import replay

TIP, UR5 = "tool0", zoo.robot("ur5")
SWEEP = 0.8 * np.sin(np.linspace(0.0, 1.0, 21)[:, None] * [1.0, 2.0, 1.5, 3.0, 2.5, 0.7] + np.arange(6))


@pytest.fixture(scope="module")
def arm():
    """A UR5 without meshes, a skeleton, which software draws in a tenth of the time."""
    return vp.load_robot(UR5.model)


def places(robot, q, frame):
    return np.array([place.translation for place in placements(robot, np.atleast_2d(q), frame)])


def vertices(browser, path):
    """The corners (k, 3) of an object, in the world of meshcat's root."""
    node = "viewer.scene_tree.find(['meshcat', ...arguments[0]]).object"
    path = [*path, "<object>"]
    corners = browser.execute_script(f"return Array.from({node}.geometry.attributes.position.array)", path)
    place = pose(browser, path)
    return np.reshape(corners, (-1, 3)) @ place[:3, :3].T + place[:3, 3]


def tube(browser, path):
    """The points (P, 3) that a tube is around: the middles of its rings of six corners."""
    return vertices(browser, path).reshape(-1, 6, 3).mean(axis=1)


def farthest(points, path):
    """The largest distance of points (P, 3) from a densely sampled path (K, 3)."""
    return max(np.linalg.norm(path - point, axis=1).min() for point in points)


def test_traces_are_where_pinocchio_puts_the_frame(show, browser, arm):
    reference = np.array([[0.5, 0.0, 0.1], [0.5, 0.4, 0.1], [0.5, 0.4, 0.1], [0.5, 0.4, 0.6]])
    ghost = SWEEP[::-1] + 0.2
    # A frame that stays leaves no trace.
    marks = vp.Marks(trace=[TIP, "wrist_1_link", "base_link"], reference={"corner": reference}, ghost=ghost)
    show(arm, SWEEP, dt=0.05, marks=marks)
    assert len(names(browser, ["notes"])) == 5
    fine, rows = np.arange(0.0, 20.0 + 1e-9, 0.01), np.arange(21)
    for name, q in (("1 motion tool0", SWEEP), ("2 motion wrist_1_link", SWEEP), ("3 ghost tool0", ghost)):
        frame = name.split()[-1]
        expected = places(arm, np.column_stack([np.interp(fine, rows, column) for column in q.T]), frame)
        points = tube(browser, ["notes", name])
        assert len(points) >= 200
        np.testing.assert_allclose(points[[0, -1]], expected[[0, -1]], atol=1e-5)
        assert farthest(points, expected) < 2e-3  # between two of the dense samples
        assert farthest(expected, points) < 1e-2
        # The nodes themselves are on it, to single precision.
        assert farthest(places(arm, q, frame), points) < 1e-5
    np.testing.assert_allclose(tube(browser, ["notes", "0 reference corner"]), reference[[0, 1, 3]], atol=1e-6)


def test_a_trace_of_a_long_motion_stays_small_and_true(show, browser, arm):
    t = np.linspace(0.0, 20.0, 4_001)
    q = 0.5 * np.sin(t[:, None] * np.arange(1.0, 7.0) / 5.0)
    show(arm, q, dt=5e-3, marks=vp.Marks(trace=True))
    points = tube(browser, ["notes", f"0 motion {arm.end_effector}"])
    assert 500 < len(points) <= 1001
    assert farthest(points, places(arm, q, arm.end_effector)) < 1e-5


def test_a_growing_trace_is_drawn_as_far_as_the_motion_has_come(show, browser, arm):
    # It rests from 0.5 s to 0.75 s, and its ghost goes the other way.
    q = np.vstack([SWEEP[:11], np.repeat(SWEEP[10:11], 5, axis=0), SWEEP[11:]])
    ghost = q[::-1]
    show(arm, q, dt=0.05, marks=vp.Marks(ghost=ghost, trace=TIP, growing=True), fps=100.0)
    for name, rows in (("0 motion tool0", q), ("1 ghost tool0", ghost)):
        points = tube(browser, ["notes", name])
        lengths = []
        for seconds in (0.0, 0.21, 0.52, 0.7, 0.93, 1.25):
            seek(browser, seconds)
            drawn = browser.execute_script(
                "return viewer.scene_tree.find(['meshcat', 'notes', arguments[0], '<object>'])"
                ".object.geometry.drawRange.count",
                name,
            )
            whole, part = divmod(drawn / 36.0, 1.0)
            end = points[int(whole)]
            if part > 1e-9:
                end = (1.0 - part) * end + part * points[int(whole) + 1]
            now = [np.interp(seconds, 0.05 * np.arange(len(q)), column) for column in rows.T]
            np.testing.assert_allclose(end, places(arm, now, TIP)[0], atol=2e-3)
            lengths.append(drawn)
        assert lengths[0] == 0.0
        assert lengths[-1] == pytest.approx(36.0 * (len(points) - 1))


@pytest.fixture(scope="module")
def run():
    """A controller at work: six ticks of 0.02 s, looking 0.4 s ahead."""
    robot = vp.planar_chain(2)
    cost = vp.TrackingCost(lambda t: [np.sin(3.0 * t), np.cos(5.0 * t)], 1e3) + vp.ControlCost(1e-4)
    problem = vp.OptimalControlProblem(vp.Scene(robot), cost, [0.0, 1.0], [0.0, 0.0], dt=0.02, steps=20, t0=0.3)
    return vp.Mpc(problem).run(duration=0.12)


def test_a_controllers_run_shows_its_plans(show, browser, run):
    robot = run.plans[0].problem.scene.robot
    tip = robot.end_effector
    show(robot, run, marks=vp.Marks(trace=True, ahead=0.24), fps=1000.0)
    assert names(browser, ["notes"]) == [f"0 motion {tip}", f"1 plan {tip}"]
    root, beads = ["notes", f"1 plan {tip}"], 12
    assert len(names(browser, root)) == beads
    for tick in (0, 1, 5):
        seek(browser, tick * 0.02)
        plan = run.plans[tick].trajectory
        # 0.02 s from one bead to the next, as the plan's nodes are.
        for k in range(beads):
            place = pose(browser, [*root, str(k)])[:3, 3]
            np.testing.assert_allclose(place, places(robot, plan.q[k + 1], tip)[0], atol=1e-5)
        now, then = shape_poses(browser, "robot"), shape_poses(browser, "ghost")
        for figure, q in ((now, plan.q[0]), (then, plan.q[12])):
            # The last shape is at the last link's centre of mass.
            (link,) = placements(robot, q[None], robot.model.names[2])
            center = link.act(robot.model.inertias[2].lever)
            np.testing.assert_allclose(figure[max(figure)][:3, 3], center, atol=1e-5)


def test_frames_move_with_the_robot(show, browser, arm):
    show(arm, SWEEP, dt=0.05, marks=vp.Marks(frames=[TIP, "base_link"]))
    seek(browser, 0.725)
    found = poses(browser, [], "node.name.includes(' frame ')")
    assert sorted(name.split()[2] for name in found) == ["base_link", TIP]
    for name, now in found.items():
        (place,) = placements(arm, 0.5 * (SWEEP[14:15] + SWEEP[15:16]), name.split()[2])
        np.testing.assert_allclose(now, place.homogeneous, atol=2e-5)


def test_targets_stand_or_move(show, browser, arm):
    turn = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    half = Rotation.from_euler("z", 45.0, degrees=True).as_matrix()
    first, last = pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.3])), pin.SE3(turn, np.array([0.5, 0.2, 0.3]))
    targets = {
        "point": [0.3, 0.1, 0.5],
        "moves": [[0.0, 0.0, 0.5], [0.3, 0.0, 0.5], [0.3, 0.3, 0.5]],
        "pose": last,
        "turns": [first, last],
    }
    show(arm, SWEEP, dt=0.05, speed=0.5, marks=vp.Marks(targets=targets))
    nodes = {name: ["notes", f"{k} target {name}"] for k, name in enumerate(targets)}
    assert names(browser, ["notes"]) == [path[-1] for path in nodes.values()]
    for seconds, moving, turning in [
        (0.0, [0.0, 0.0, 0.5], first),
        (1.0, [0.3, 0.0, 0.5], pin.SE3(half, np.array([0.3, 0.2, 0.3]))),
        (1.5, [0.3, 0.15, 0.5], None),
        (2.0, [0.3, 0.3, 0.5], last),
    ]:
        seek(browser, seconds)
        now = {name: pose(browser, node) for name, node in nodes.items()}
        np.testing.assert_allclose(now["point"][:3, 3], [0.3, 0.1, 0.5], atol=1e-6)
        np.testing.assert_allclose(now["moves"][:3, 3], moving, atol=1e-6)
        np.testing.assert_allclose(now["pose"], last.homogeneous, atol=1e-6)
        if turning is not None:
            np.testing.assert_allclose(now["turns"], turning.homogeneous, atol=1e-4)
    kinds = browser.execute_script(
        """
        const kinds = {};
        for (const name in arguments[0]) {
            kinds[name] = [];
            viewer.scene_tree.find(["meshcat", ...arguments[0][name]]).object.traverse(node => {
                if (node.isSprite) kinds[name].push(atob(node.material.map.image.src.split(",")[1]));
                else if (node.isMesh) kinds[name].push(node.parent.name);
            });
        }
        return kinds;""",
        nodes,
    )
    plates = {name: kind.pop(next(k for k, part in enumerate(kind) if "<svg" in part)) for name, kind in kinds.items()}
    assert sorted(kinds["point"]) == ["ball"]
    assert sorted(kinds["turns"]) == ["axes", "ball"]
    assert "target: point, moves, pose, turns" in browser.find_element("id", "about").text
    for name, plate in plates.items():
        assert f">{name}</text>" in plate
        # Below the target: nothing is drawn over the tool.
        height = float(re.search(r'viewBox="0 0 \S+ (\S+)"', plate)[1])
        assert float(re.search(r'<rect x="\S+" y="(\S+)"', plate)[1]) > 0.5 * height


GREY, YELLOW, RED = [0.72, 0.76, 0.8], [0.98, 0.75, 0.1], [0.8, 0.05, 0.05]


def test_links_take_the_colour_of_their_torque(show, browser):
    model = vp.planar_chain(2).model
    model.effortLimit = np.array([8.0, np.inf])
    robot = vp.load_robot(model)
    controls = np.array([[4.0, 0.5], [9.0, -2.0]])
    motion = vp.simulate(vp.Scene(robot, damping=9.0), np.zeros(2), np.zeros(2), dt=0.01, steps=2, controls=controls)
    show(robot, motion, marks=vp.Marks(torques=True))
    for seconds, shares in [(0.0, [0.5, 0.25]), (0.02, [1.0, 1.0])]:
        seek(browser, seconds)
        colors = browser.execute_script(
            """
            const colors = {};
            viewer.scene_tree.find(["meshcat", "robot"]).object.traverse(node => {
                const shape = node.parent;
                if (node.isMesh && shape.parent.parent.name == "moving")
                    colors[shape.parent.parent.parent.name] = node.material.color.toArray();
            });
            return colors;"""
        )
        for color, share in zip(colors.values(), shares, strict=True):
            expected = [np.interp(share, [0.0, 0.5, 1.0], stops) for stops in np.transpose([GREY, YELLOW, RED])]
            np.testing.assert_allclose(color, expected, atol=1e-5)


def test_robots_side_by_side_keep_their_own_motions(show, browser):
    finger = vp.load_robot("finger")
    tip = finger.end_effector
    bend = np.linspace([0.0, 0.0, 0.0], [1.0, 1.2, 1.4], 21)
    # The last one's motion is over after 0.25 s, and held.
    motions = [bend, bend[::-1], bend[:6]]
    marks = vp.Marks(trace=True, targets={"goal": [0.1, 0.0, 0.1]})
    show([(finger, q) for q in motions], dt=0.05, marks=marks)
    seek(browser, 0.75)
    aside, spans = pose(browser, ["robot 2"])[:3, 3], []
    for k, q in enumerate([bend[15], bend[5], bend[5]]):
        number = f" {k + 1}" if k else ""
        shift = pose(browser, [f"robot{number}"])[:3, 3]
        points = [found[:3, 3] for found in shape_poses(browser, f"robot{number}").values()]
        assert shapes_stand(browser, finger, q, f"robot{number}", shift)
        goal = pose(browser, [f"notes{number}", names(browser, [f"notes{number}"])[-1]])[:3, 3]
        np.testing.assert_allclose(goal, np.array([0.1, 0.0, 0.1]) + shift, atol=1e-6)
        begin = tube(browser, [f"notes{number}", f"0 motion {tip}"])[0]
        np.testing.assert_allclose(begin, places(finger, motions[k][0], tip)[0] + shift, atol=1e-5)
        spans.append(np.array([*points, begin, goal]) @ aside)
    assert all(before.max() < after.min() for before, after in itertools.pairwise(spans))


def test_refuses_marks_it_cannot_show(run, crank, tmp_path):
    page = tmp_path / "page.html"

    def no(*facts, robot=UR5, motion=SWEEP, dt=0.05, **marks):
        with refused(vp.InputError, *facts):
            replay(robot, motion, dt=dt, html=page, marks=vp.Marks(**marks))

    with refused(vp.UnknownFrame, "trace", "'ur5'", "'fore_link'", "'forearm_link'"):
        replay(UR5, SWEEP, dt=0.05, html=page, marks=vp.Marks(trace="fore_link"))
    no("frames", "3", frames=[3])
    no("trace", "None", trace=None)
    no("reference", "(K, 3)", "(3,)", reference=[0.0, 0.0, 1.0])
    no("reference['a']", "target", reference={"a": np.ones((4, 3))})
    no("reference[1, 0]", "nan", reference=[[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    no("targets", targets=[0.0, 0.0, 1.0])
    no("targets['a']", "(3,)", "(4, 4)", targets={"a": np.zeros(4)})
    no("targets['a']", "(3,)", "shape ()", targets={"a": 3.0})
    no("targets['a'][2]", "inf", targets={"a": [0.0, 0.0, np.inf]})
    no("targets['a']", "pose", targets={"a": np.diag([1.0, 1.0, -1.0, 1.0])})
    no("targets['a']", "2", motion=SWEEP[:1], targets={"a": np.zeros((2, 3))})
    no("torques=True", torques=True)
    no("torques", "(N, 6)", "(20, 5)", torques=np.zeros((20, 5)))
    no("robots", "pairs", robot=[(UR5, SWEEP)])
    no("robots", "pairs", robot=[UR5, UR5], motion=None)
    with refused(vp.InputError, "marks", "Marks(trace=True)", "{'trace': True}"):
        replay(UR5, SWEEP, dt=0.05, html=page, marks={"trace": True})
    no("ahead", "Mpc", ahead=0.1)
    no("ahead", "-0.1", robot=run.plans[0].problem.scene.robot, motion=run, dt=None, ahead=-0.1)
    no("motion 2", "(N + 1, 6)", robot=[(UR5, SWEEP), (UR5, SWEEP[:, :3])], motion=None)
    no("motion", motion=None)
    no("'chain2'", robot=vp.planar_chain(2), motion=crank[1].q, constraints=crank[0])
    no("constraints", "'all'", constraints="all")
    scene = vp.Scene(vp.planar_chain(2), actuation=["joint1"])
    half = vp.simulate(scene, [0, 0], [0, 0], dt=1e-2, steps=2, controls=np.zeros((2, 1)))
    no("torques=True", "(N, 2)", robot=scene.robot, motion=half, dt=None, torques=True)
    ur10 = vp.simulate(vp.Scene(vp.load_robot("ur10")), np.zeros(6), np.zeros(6), dt=0.01, steps=2, check=False)
    no("'ur10'", "'ur5'", motion=ur10, dt=None)
    by_hand = vp.Scene(vp.planar_chain(2), constraints=vp.KinematicInput("joint1"))
    moved = vp.simulate(by_hand, [0.3, 0.3], [0, 0], dt=0.02, steps=3)
    no("torques=True", robot=by_hand.robot, motion=moved, dt=None, torques=True)
    assert not page.exists()


@pytest.fixture(scope="module")
def crank():
    robot = vp.planar_chain(2, length=0.3, mass=0.5)
    ties = [
        vp.PointOnPoint("tip", (0.0, 0.0, 0.0), axes="z"),
        vp.PointOnPlane("tip", (0.0, 0.0, 0.0), (0.0, 0.0, 2.0)),
        vp.PointOnPlane(("tip", (0.0, 0.0, 0.0)), (0.3, 0.1, 0.0), (0.0, 0.0, 1.0)),
    ]
    scene = vp.Scene(robot, constraints=ties, damping=0.01)
    begin = vp.assemble(scene, [-0.6, 1.2])
    return scene, vp.simulate(scene, begin, np.zeros(2), dt=0.02, steps=20, integrator=vp.Gauss(2))


@pytest.fixture(scope="module")
def plan():
    robot = vp.planar_chain(2)
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2) + vp.Terminal(vp.TrackingCost([1.0, 0.5], 1.0))
    posts = [
        vp.Obstacle.capsule([2.5, 0.0, -1.0], [2.5, 0.0, 1.0], 0.1, name="post"),
        vp.Obstacle.box([0.0, 3.0, 0.0], [0.2, 0.4, 0.6], name="crate"),
        vp.Obstacle.sphere([-2.5, 0.0, 0.0], 0.2, name="ball"),
    ]
    kept = [
        vp.KeepClear(robot, posts, 0.0, capsules=CAPSULES),
        vp.KeepInBox(robot, "tip", [-np.inf, -1.0, -3.0], [np.inf, 1.0, 3.0]),
        vp.KeepInSphere(robot, "tip", [0.0, 0.0, 0.0], 2.5),
        vp.KeepOutOfSphere(robot, "tip", [1.0, 2.0, 0.0], 0.3),
        vp.KeepInHalfSpace(robot, "tip", [0.0, 0.0, 1.0], -2.5),
        vp.ReachFrame(robot, "tip", position=robot.frame_positions([1.0, 0.5], "tip")),
    ]
    problem = vp.OptimalControlProblem(
        vp.Scene(robot, damping=0.1), cost, [0.3, 0.2], np.zeros(2), dt=0.05, steps=10, constraints=kept
    )
    return vp.solve(problem, max_iterations=3, check=False)


def key(browser):
    return [line.text for line in browser.find_elements("css selector", "#about li")]


def test_ties_are_where_pinocchio_puts_the_points(show, browser, crank):
    scene, motion = crank
    show(scene.robot, motion, marks=vp.Marks(constraints=scene), fps=100.0)
    assert "constraint: PointOnPoint, PointOnPlane" in key(browser)
    nodes = ["robot", "0 joint1", "moving", "1 joint2", "moving", "notes"]
    kinds = ["0 constraint PointOnPoint", "1 constraint PointOnPlane", "2 constraint PointOnPlane"]
    assert names(browser, nodes) == kinds
    base = ["robot", "notes"]
    assert [names(browser, [*base, kind]) for kind in names(browser, base)] == [["b"], ["plane"], ["plane"]]
    for k in (0, 7, 20):
        seek(browser, 0.02 * k)
        tip = places(scene.robot, motion.q[k], "tip")[0]
        for name in kinds:
            np.testing.assert_allclose(pose(browser, [*nodes, name, "a"])[:3, 3], tip, atol=1e-5)
        # The rod from the origin to there.
        ends = tube(browser, ["notes", kinds[0], "rod"])
        np.testing.assert_allclose(ends[np.argsort(ends[:, 0])], [[0.0, 0.0, 0.0], tip], atol=1e-5)
    square = vertices(browser, [*base, kinds[1], "plane"])
    np.testing.assert_allclose(square[:, 2], 0.0, atol=1e-6)
    reach = places(scene.robot, motion.q, "tip")[:, 0]
    assert square[:, 0].min() < reach.min()
    assert reach.max() < square[:, 0].max()


def test_a_line_and_a_weld_are_drawn(show, browser):
    robot, q, grip = vp.planar_chain(3), np.array([[0.1, 0.2, 0.3]]), np.eye(4)
    grip[:3, 3] = [0.0, 0.0, 0.4]
    line = vp.PointOnLine("tip", (0.0, 0.0, -1.0), (1.0, 0.0, 0.0))
    show(robot, q, dt=1.0, marks=vp.Marks(constraints=vp.Scene(robot, constraints=line)))
    along = tube(browser, ["robot", "notes", "0 constraint PointOnLine", "line"])
    np.testing.assert_allclose(along[:, 1:], [[0.0, -1.0]] * len(along), atol=1e-6)
    weld = vp.Scene(robot, constraints=vp.FrameOnFrame("tip", "joint2", grip))
    show(robot, q, dt=1.0, marks=vp.Marks(constraints=weld))
    ends = tube(browser, ["notes", "0 constraint FrameOnFrame", "rod"])
    expected = np.concatenate([places(robot, q, name) for name in ("tip", "joint2")])
    np.testing.assert_allclose(np.sort(ends, axis=0), np.sort(expected, axis=0), atol=1e-5)


def test_obstacles_and_regions_have_their_sizes(show, browser, plan):
    robot, q = plan.problem.scene.robot, plan.trajectory.q[:1]
    # A pose, as software draws large translucent shapes slowly.
    show(robot, q, dt=1.0, marks=vp.Marks(constraints=plan.problem))
    assert key(browser) == ["obstacle: post, crate, ball", "tip keeps out", "tip keeps in", "target: goal of tip"]
    *shown, goal = names(browser, ["notes"])
    found = {name: vertices(browser, ["notes", name]) for name in shown}
    boxes = {name: (points.min(axis=0), points.max(axis=0)) for name, points in found.items()}
    for name, low, high in [
        ("0 obstacle post", [2.4, -0.1, -1.1], [2.6, 0.1, 1.1]),
        ("1 obstacle crate", [-0.1, 2.8, -0.3], [0.1, 3.2, 0.3]),
        ("2 obstacle ball", [-2.7, -0.2, -0.2], [-2.3, 0.2, 0.2]),
        ("4 in tip", [-2.5, -2.5, -2.5], [2.5, 2.5, 2.5]),
        ("5 out tip", [0.7, 1.7, -0.3], [1.3, 2.3, 0.3]),
    ]:
        # Round shapes are of facets.
        np.testing.assert_allclose(boxes[name], [low, high], atol=0.01 * np.ptp([low, high]))
    low, high = boxes["3 in tip"]
    np.testing.assert_allclose([low[1:], high[1:]], [[-1.0, -3.0], [1.0, 3.0]], atol=1e-5)
    assert low[0] < places(robot, q, "tip")[0, 0] < high[0]
    np.testing.assert_allclose(found["6 in tip"][:, 2], -2.5, atol=1e-5)
    place = pose(browser, ["notes", goal])[:3, 3]
    np.testing.assert_allclose(place, places(robot, [1.0, 0.5], "tip")[0], atol=1e-5)
    assert picture(browser).std() > 0.0


def test_constraints_can_be_left_out(plan, tmp_path):
    robot = plan.problem.scene.robot
    whole = replay(robot, plan, html=tmp_path / "with.html").read_text()
    assert all(words in whole for words in ("tip keeps in", "tip keeps out", "obstacle: post", "target"))
    for name, motion, given in (("without", plan, False), ("motion", plan.trajectory, True)):
        page = replay(robot, motion, marks=vp.Marks(constraints=given), html=tmp_path / f"{name}.html").read_text()
        assert "<ul></ul>" in page
    both = [(robot, plan), (robot, plan, vp.Marks(constraints=False))]
    paths = [command.get("path", "") for command in commands(replay(both, html=tmp_path / "pair.html"))]
    drawn = [path for path in paths if "obstacle" in path]
    assert drawn
    assert not any("notes 2" in path for path in drawn)


def test_what_moves_is_drawn_where_it_is(tmp_path):
    robot, times = vp.planar_chain(2), np.array([0.5, 0.75, 1.0])

    def way(t):
        return np.array([0.1 * t, 0.0, 0.2 * t])

    kept = [
        vp.KeepClear(robot, [vp.Obstacle.sphere([1.0, 0.0, -2.0], 0.1).moving(way)], capsules=CAPSULES),
        vp.KeepOutOfSphere(robot, "tip", lambda t: way(t) - [0, 0, 3], 0.2),
    ]
    problem = vp.OptimalControlProblem(
        vp.Scene(robot), vp.ControlCost(1.0), [0, 0], [0, 0], dt=0.25, steps=2, constraints=kept, t0=0.5
    )
    page = replay(robot, np.zeros((3, 2)), dt=0.25, marks=vp.Marks(constraints=problem), html=tmp_path / "moving.html")
    tracks = [values for (path, _), (_, values) in animation(page)[0].items() if "notes" in path]
    for values, begin in zip(tracks, ([1.0, 0.0, -2.0], [0.0, 0.0, -3.0]), strict=True):
        np.testing.assert_allclose(values, [begin + way(t) for t in times], atol=1e-6)
