"""Obstacles of plans: distances by least squares, slopes by differences, drawings, SRDF files."""

import pickle
from itertools import product

import numpy as np
import pytest
from chromium import animation, commands
from numpy.testing import assert_allclose
from plan_problems import CAPSULES, TWO, reach
from refusals import refused
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

import varpin as vp
from varpin import replay
from varpin.model.clearance import capsule_around, clearance
from varpin.model.kinematics import frame_kinematics

CUBE = np.array(list(product([-0.5, 0.5], repeat=3)))
TURN = Rotation.from_euler("xyz", [0.3, -0.5, 0.8]).as_matrix()
# The base of a wedge, whose edge lies above one of its sides.
WEDGE = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.3, 0], [0.4, 0.3, 0], [0, 0, 0.25], [0, 0.3, 0.25]], dtype=float)


UR5 = {"forearm_link": ([0, 0, 0], [0, 0, 0.4], 0.06), "wrist_3_link": ([0, 0, 0], [0, 0.1, 0], 0.05)}


def drum(corners=64):
    """A cylinder's corners: more than coal looks through one by one, and flat ends."""
    turn = 2.0 * np.pi * np.arange(corners) / corners
    return np.vstack([np.c_[0.3 * np.cos(turn), 0.3 * np.sin(turn), np.full(corners, z)] for z in (-0.4, 0.4)])


def apart(points, segment):
    """By least squares with non-negative shares that sum to 1 on each side."""
    heavy = 1e5
    ones, none = np.ones(len(points)), np.zeros(len(points))
    rows = np.vstack(
        [
            np.hstack([points.T, -segment.T]),
            heavy * np.r_[ones, 0.0, 0.0],
            heavy * np.r_[none, 1.0, 1.0],
        ]
    )
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
    assert made[0].hull.points.shape == (8, 3)
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
    ("points", "radius"), [(WEDGE, 0.0), (drum(), 0.0), (WEDGE[[1, 4]], 0.1)], ids=["wedge", "drum", "capsule"]
)
def test_distances_are_those_of_least_squares(points, radius):
    rng = np.random.default_rng(1)
    robot = vp.planar_chain(1)
    (R,), (p,) = frame_kinematics(robot, "joint1").placements(np.zeros((1, 1)))
    made = vp.Obstacle.capsule(*points, radius) if radius else vp.Obstacle.convex(points)
    clear = 0
    for _ in range(40):
        segment = 0.7 * rng.normal(size=(2, 3))
        here = (segment - p) @ R
        found = clearance(robot, [made], capsules={"joint1": (*here, 0.05)}).distances(np.zeros((1, 1)))[0, 0]
        known = apart(points, segment)
        if known > 1e-6:
            clear += 1
            assert found == pytest.approx(known - 0.05 - radius, abs=1e-9)
        else:
            assert found < -0.05 + 1e-6
    assert clear > 15


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
    slopes = measure.slopes(q)
    for c, e in enumerate(1e-6 * np.eye(6)):
        found = (measure.distances(q + e) - measure.distances(q - e)) / 2e-6
        assert_allclose(slopes[:, :, c], found, atol=1e-7)
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
