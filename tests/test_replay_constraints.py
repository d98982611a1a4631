"""What a replay draws of a scene's constraints and of a plan's: ties, obstacles, regions, goals."""

import numpy as np
import pytest
from chromium import commands, picture, seek, visit
from refusals import refused
from test_replay_marks import assert_no_errors, names, placements, pose, vertices

import varpin as vp
from varpin import replay
from varpin.show.replay.annotations import regions

CAPSULES = {"joint1": ([0, 0, 0], [1, 0, 0], 0.05), "joint2": ([0, 0, 0], [1, 0, 0], 0.05)}


@pytest.fixture(scope="module")
def crank():
    """A crank whose rod's end slides, and its motion."""
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


def test_ties_are_where_pinocchio_puts_the_points(browser, crank, tmp_path):
    scene, motion = crank
    page = replay(scene.robot, motion, marks=vp.Marks(constraints=scene), html=tmp_path / "crank.html", fps=100.0)
    visit(browser, page)
    assert_no_errors(browser)
    assert "constraint: PointOnPoint, PointOnPlane" in key(browser)
    nodes = ["robot", "joint1", "moving", "joint2", "moving", "notes"]
    kinds = ["0 constraint PointOnPoint", "1 constraint PointOnPlane", "2 constraint PointOnPlane"]
    assert names(browser, nodes) == kinds
    base = ["robot", "base", "notes"]
    assert [names(browser, [*base, kind]) for kind in names(browser, base)] == [["b"], ["plane"], ["plane"]]
    for k in (0, 7, 20):
        seek(browser, 0.02 * k)
        tip = placements(scene.robot, motion.q[k], "tip")[0, :3, 3]
        for name in kinds:
            np.testing.assert_allclose(pose(browser, [*nodes, name, "a"])[:3, 3], tip, atol=1e-5)
        # The rod from the origin to there.
        ends = vertices(browser, ["notes", kinds[0], "rod"]).reshape(-1, 6, 3).mean(axis=1)
        np.testing.assert_allclose(ends[np.argsort(ends[:, 0])], [[0.0, 0.0, 0.0], tip], atol=1e-5)
    square = vertices(browser, [*base, kinds[1], "plane"])
    np.testing.assert_allclose(square[:, 2], 0.0, atol=1e-6)
    reach = placements(scene.robot, motion.q, "tip")[:, 0, 3]
    assert square[:, 0].min() < reach.min()
    assert reach.max() < square[:, 0].max()


def test_a_line_and_a_weld_are_drawn(browser, tmp_path):
    robot = vp.planar_chain(3)
    grip = np.eye(4)
    grip[:3, 3] = [0.0, 0.0, 0.4]
    kept = [vp.PointOnLine("tip", (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)), vp.FrameOnFrame("tip", "joint2", grip)]
    scene = vp.Scene(robot, constraints=kept[0])
    welded = vp.Scene(robot, constraints=kept[1])
    q = [[0.1, 0.2, 0.3]]
    line, weld = tmp_path / "line.html", tmp_path / "weld.html"
    replay(robot, q, dt=1.0, marks=vp.Marks(constraints=scene), html=line)
    replay(robot, q, dt=1.0, marks=vp.Marks(constraints=welded), html=weld)
    visit(browser, line)
    along = (
        vertices(browser, ["robot", "base", "notes", "0 constraint PointOnLine", "line"]).reshape(-1, 6, 3).mean(axis=1)
    )
    np.testing.assert_allclose(along[:, 1:], [[0.0, -1.0]] * len(along), atol=1e-6)
    visit(browser, weld)
    ends = vertices(browser, ["notes", "0 constraint FrameOnFrame", "rod"]).reshape(-1, 6, 3).mean(axis=1)
    expected = [placements(robot, q, name)[0, :3, 3] for name in ("tip", "joint2")]
    np.testing.assert_allclose(np.sort(ends, axis=0), np.sort(expected, axis=0), atol=1e-5)


def test_obstacles_and_regions_have_their_sizes(browser, plan, tmp_path):
    robot = plan.problem.scene.robot
    # A pose, as software draws large translucent shapes slowly.
    visit(
        browser,
        replay(
            robot, plan.trajectory.q[:1], dt=1.0, marks=vp.Marks(constraints=plan.problem), html=tmp_path / "plan.html"
        ),
    )
    assert_no_errors(browser)
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
    tip = placements(robot, plan.trajectory.q[:1], "tip")[:, :3, 3]
    assert low[0] < tip[:, 0].min()
    assert tip[:, 0].max() < high[0]
    np.testing.assert_allclose(found["6 in tip"][:, 2], -2.5, atol=1e-5)
    np.testing.assert_allclose(
        pose(browser, ["notes", goal])[:3, 3], placements(robot, [1.0, 0.5], "tip")[0, :3, 3], atol=1e-5
    )
    assert picture(browser).std() > 0.0


def test_constraints_can_be_left_out(plan, crank, tmp_path):
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
    with refused(vp.InputError, "'chain2'"):
        replay(
            vp.planar_chain(2), crank[1].q, dt=0.1, marks=vp.Marks(constraints=crank[0]), html=tmp_path / "other.html"
        )
    with refused(vp.InputError, "constraints", "'all'"):
        replay(robot, plan, marks=vp.Marks(constraints="all"), html=tmp_path / "word.html")


def test_what_moves_is_drawn_where_it_is():
    """Obstacles and spheres at the keyframes, from the time that the plan begins at."""
    robot = vp.planar_chain(2)

    def way(t):
        return np.array([0.1 * t, 0.0, 0.2 * t])

    arm = {"joint2": ([0, 0, 0], [1, 0, 0], 0.05)}
    ball = vp.Obstacle.sphere([1.0, 0.0, -2.0], 0.1).moving(way)
    constraints = [
        vp.KeepClear(robot, [ball], capsules=arm),
        vp.KeepOutOfSphere(robot, "tip", lambda t: way(t) - [0, 0, 3], 0.2),
    ]
    times = np.array([0.5, 0.7, 1.1])
    for region, begin in zip(regions(constraints, times), ([1.0, 0.0, -2.0], [0.0, 0.0, -3.0]), strict=True):
        np.testing.assert_allclose(region.begin, begin + way(0.5), atol=1e-15)
        np.testing.assert_allclose(region.begin + region.way, [begin + way(t) for t in times], atol=1e-15)
        reach = region.around(None).max(axis=0) - region.radius
        np.testing.assert_allclose(reach, begin + way(1.1), atol=1e-12)
