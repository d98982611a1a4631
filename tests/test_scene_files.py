"""Scene files: what they may say, each mistake in its own words, and that they reach no further than what they name."""

import copy
import datetime
import functools
import inspect
import itertools
import logging
import os
import pickle
import re
import tomllib
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import INERTIAL, joint, link, write_urdf
from refusals import refused, unnamed

import varpin as vp
from varpin.cli import main
from varpin.io.scenefile import scenes
from varpin.io.scenefile.kinds import COSTS, FORCES, cost_keys
from varpin.io.scenefile.task import TABLES

ROOT = Path(__file__).resolve().parents[1]

GOOD = """
title = "test"
gravity = true
damping = { mcp = 1e-5, pip = 2e-5 }

[robot]
source = "finger"
lock = { dip = 0.2 }

[[robot.payload]]
frame = "tip"
mass = 1e-3
center = [0.0, 0.0, 1e-3]
inertia = [1e-8, 1e-8, 1e-8]

[springs]
stiffness = 1e-3
rest = [0.1, 0.2]

[actuation]
joints = ["mcp", "pip"]
gear = { mcp = 2.0, pip = 1.0 }
torque_limit = 0.5

[[noise]]
type = "state"
intensity = 1e-4
center = 0.1

[initial]
q = [0.5, 0.3]
v = { mcp = 0.1 }

[horizon]
dt = 2e-3
duration = 0.1

[integrator]
type = "midpoint"
alpha = 0.5

[[cost]]
type = "tracking"
weight = { mcp = 10.0 }
reference = { offset = { mcp = 1.0 }, sines = [{ of = "mcp", amplitude = 0.2, frequency = 2.0 }] }

[[cost]]
type = "control"
weight = 0.1
hold = true

[simulate]
controls = [0.0, 0.0]
seed = 3

[solve]
max_iterations = 5

[outputs]
save = "plan.npz"
"""


def write(folder, text, name="scene.toml"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def changed(old, new):
    assert GOOD.count(old) == 1, old
    return GOOD.replace(old, new)


def test_everything_in_a_scene_arrives(tmp_path):
    file = loaded(tmp_path, GOOD)
    scene, problem = file.scene, file.problem
    assert file.robot.joint_names == ("mcp", "pip")
    assert dict(file.robot.locked) == {"dip": 0.2}
    np.testing.assert_array_equal(scene.actuation, [[2.0, 0.0], [0.0, 1.0]])
    np.testing.assert_array_equal(problem.control_limits, [[-0.25, -0.5], [0.25, 0.5]])
    turned = loaded(tmp_path, changed("mcp = 2.0, pip", "mcp = -2.0, pip")).problem
    np.testing.assert_array_equal(turned.control_limits, problem.control_limits)
    np.testing.assert_array_equal(file.q0, [0.5, 0.3])
    np.testing.assert_array_equal(file.v0, [0.1, 0.0])
    assert (problem.dt, problem.steps, problem.integrator) == (2e-3, 50, vp.Midpoint(alpha=0.5))
    bare = vp.load_robot("finger", lock={"dip": 0.2})
    assert file.robot.tree.mass.sum() == pytest.approx(bare.tree.mass.sum() + 1e-3, rel=1e-12)
    assert file.outputs["save"] == Path.cwd() / "plan.npz"


def loaded(folder, text, **options):
    return vp.load_scene(write(folder, text), **options)


HORIZON = "[horizon]\ndt = 1e-2\nsteps = 20\n"


def toml(value):
    """A value as in a scene file; a place on a frame is a table."""
    if isinstance(value, tuple):
        value = dict(zip(("frame", "place"), value, strict=True))
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + " }"
    return f'"{value}"' if isinstance(value, str) else str(value).lower()


def table(head, **keys):
    return f"{head}\n" + "".join(f"{key} = {toml(value)}\n" for key, value in keys.items())


def of(kind, make, **given):
    return kind, make, given


ELBOW = {"elbow_joint": 0.1}
APART = {"stiffness": 5.0, "rest": [0.0, 0.01, 0.0], "rotational_stiffness": 0.02}
APART["rest_rotation"] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
# Of scenes the robot, forces and noises by kind and arguments, what else there is, and the springs.
WRITTEN = {
    "joints": (
        "ur5",
        [
            of("friction", vp.CoulombFriction, level={"elbow_joint": 1e-4}, width=0.05),
            of("stop", vp.JointStop, stiffness=0.1, damping=[1e-4, 0, 0, 0, 0, 0], upper={"elbow_joint": 1.0}),
            of("armature", vp.Armature, inertia=1e-6),
        ],
        [
            of("additive", vp.AdditiveNoise, intensity=ELBOW),
            of("control", vp.ControlNoise, intensity=0.2),
            of("state", vp.StateNoise, intensity=0.3, center=0.4),
        ],
        {"damping": ELBOW, "friction": 0.2},
        {"stiffness": 2.0, "rest": {"elbow_joint": 0.3}},
    ),
    "frames": (
        "allegro_right_hand",
        [
            of("frame_spring", vp.FrameSpring, a="link_3.0", b=("link_7.0", [0.0, 0.0, 0.01]), **APART),
            of("frame_damper", vp.FrameDamper, a="link_3.0", b=[0, 0.1, 0.1], damping=[0.1, 0.2, 0.3]),
            of("frame_damper", vp.FrameDamper, a="link_7.0", b="link_3.0", damping=0.0, rotational_damping=0.01),
            of(
                "frame_wrench", vp.FrameWrench, frame="link_7.0", wrench=[0.01, 0.0, 0.02, 0.0, 1e-3, 0.0], axes="frame"
            ),
        ],
        [],
        {"gravity": False},
        {},
    ),
}
SERVOS = (
    """gravity = false
[robot]
source = "ur5"
[[force]]
type = "servo"
stiffness = { elbow_joint = 300.0, wrist_1_joint = 50.0 }
damping = { elbow_joint = 30.0, wrist_1_joint = 5.0 }
effort = { elbow_joint = 80.0 }
[actuation]
joints = ["elbow_joint", "wrist_1_joint", "wrist_2_joint"]
torque_limit = { elbow_joint = 100.0, wrist_1_joint = 20.0, wrist_2_joint = 8.0 }
"""
    + HORIZON
)


def test_pickles_are_the_same_scene():
    file = vp.load_scene("allegro_finger")
    again = pickle.loads(pickle.dumps(file))
    assert (repr(again), again._repr_html_()) == (repr(file), file._repr_html_())
    np.testing.assert_array_equal(again.simulate().q, file.simulate().q)


def same_scene(file, **arguments):
    scene = vp.Scene(file.robot, **arguments)
    assert file.scene.values.keys() == scene.values.keys()
    for key, value in scene.values.items():
        np.testing.assert_array_equal(file.scene.values[key], value, err_msg=key)
    assert (file.scene.elements, file.scene.couplings) == (scene.elements, scene.couplings)
    return scene


@pytest.mark.parametrize("name", WRITTEN)
def test_a_scene_is_the_one_written_in_python(name, tmp_path):
    robot, forces, noise, arguments, springs = WRITTEN[name]
    text = table("", **arguments) + table("[robot]", source=robot) + table("[springs]", **springs) + HORIZON
    for key, kind, _, given in [("force", *own) for own in forces] + [("noise", *own) for own in noise]:
        text += table(f"[[{key}]]", type=kind, **given)
    made = [[make(**given) for _, make, given in found] for found in (forces, noise)]
    file, reduced = loaded(tmp_path, text, required_only=False), loaded(tmp_path, text)
    scene = same_scene(file, **arguments, **springs, forces=made[0], noise=made[1] or None)
    named = {type(force).__name__ for force in scene.forces} - {"JointDamper", "JointSpring"}
    assert set(reduced.required.terms["other forces"].split(", ")) == named
    own = [file.robot.joint_names.index(joint) for joint in reduced.robot.joint_names]
    assert len(own) == {"frames": 8}.get(name, 6)
    np.testing.assert_allclose(reduced.simulate().q, file.simulate().q[:, own], rtol=1e-10, atol=1e-13)


def test_a_plan_of_servos(tmp_path):
    """Torque limits are those of drives: positions have none."""
    goal = table("[[cost]]", type="tracking", terminal=True, reference={"elbow_joint": 0.6})
    file = loaded(tmp_path, SERVOS + goal + table("[[cost]]", type="control", weight=1e-3))
    joints = ["elbow_joint", "wrist_1_joint", "wrist_2_joint"]
    gains = (dict(zip(joints, pair, strict=False)) for pair in ((300.0, 50.0), (30.0, 5.0), (80.0, 20.0)))
    same_scene(file, gravity=False, forces=vp.PositionServo(*gains), actuation=joints)
    np.testing.assert_array_equal(file.problem.control_limits[1], [np.inf, np.inf, 8.0])
    plan = file.solve(max_iterations=3)
    plan.save(tmp_path / "plan.npz")
    again = file.load_solution(tmp_path / "plan.npz")
    assert again.trajectory.q.tobytes() == plan.trajectory.q.tobytes()
    assert again.policy.servos == ("elbow_joint", "wrist_1_joint")


def test_the_velocity_of_a_cubic_input_is_a_control_without_a_limit(tmp_path):
    text = tracked("0.3").replace(
        "[horizon]",
        """[actuation]
torque_limit = 2.0
[[constraint]]
type = "kinematic_input"
joint = "mcp"
interpolation = "cubic"
[horizon]""",
    )
    limits = loaded(tmp_path, text).problem.control_limits
    np.testing.assert_array_equal(limits[1], [np.inf, 2.0, 2.0, np.inf])


RATE = '\n[[cost]]\ntype = "control_rate"\nweight = { mcp = 0.2, pip = 0.1 }\n'


@pytest.mark.parametrize(
    ("start", "before"),
    [("", None), ("before = { mcp = 0.1, pip = -0.2 }", [0.1, -0.2]), ("hold = true", ())],
    ids=["free", "by name", "hold"],
)
def test_cost_of_a_scene_is_that_written_in_python(start, before, tmp_path):
    file = loaded(tmp_path, GOOD + RATE + start)

    def reference(t):
        return [1.0 + 0.2 * np.sin(4.0 * np.pi * t), 0.0]

    hold = np.linalg.solve(file.scene.actuation, -vp.lagrangian_jet(file.scene, file.q0, np.zeros(2)).Lq)
    rate = vp.ControlRateCost([0.2, 0.1], before=hold if before == () else before)
    cost = vp.TrackingCost(reference, [10.0, 0.0]) + vp.ControlCost(0.1, hold) + rate
    problem = vp.OptimalControlProblem(file.scene, cost, file.q0, file.v0, dt=2e-3, steps=50)
    rng = np.random.default_rng(0)
    q, v, u = rng.normal(size=(3, 51, 2))
    assert file.problem.costs(q, v, u[:50]) == pytest.approx(problem.costs(q, v, u[:50]), rel=1e-12)


SINES = '{ offset = { mcp = 1.0 }, sines = [{ of = "mcp", amplitude = 0.2, frequency = 2.0 }] }'
HELD = 'type = "control"\nweight = 0.1\nhold = true'


def tracked(reference):
    return f"""
[robot]
source = "finger"
[horizon]
dt = 1e-2
steps = 10
[[cost]]
type = "tracking"
reference = {reference}
"""


TWO = """
damping = { right_pip = 0.1 }

[[robot]]
source = "finger"
prefix = "left_"
lock = { dip = 0.2 }

[[robot.payload]]
frame = "tip"
mass = 1e-3

[[robot]]
source = "finger"
prefix = "right_"
base = { xyz = [0.02, 0.0, 0.0], rpy = [0.0, 0.0, 3.141592653589793] }

[actuation]
joints = ["left_mcp", "right_mcp"]

[initial]
q = { left_mcp = 0.1, right_dip = -0.2 }

[horizon]
dt = 1e-3
steps = 20
"""


# Wrong files, the key of each mistake, and what else the message says.
DAMPED = GOOD + '[[force]]\ntype = "frame_damper"\na = "tip"\nb = "mcp"\ndamping = 1.0'
MISTAKES = [
    (GOOD + RATE + "terminal = true", "cost[2].terminal"),
    (GOOD + RATE + "before = { sines = [] }", "cost[2].before.sines"),
    (GOOD + RATE + "before = 0.0\nhold = true", "cost[2]"),
    (changed("gravity = true", "gravity ="), "", "line 3"),
    (changed("[springs]", "[spring]"), "spring"),
    (changed('source = "finger"\n', ""), "robot.source"),
    (changed('"finger"', '"fingr"'), "robot.source"),
    (changed("dip = 0.2", "dop = 0.2"), "robot.lock.dop"),
    (changed("damping = { mcp", "damping = { dip"), "damping.dip"),
    (changed('"tip"', '"tipp"'), "robot.payload"),
    (changed("[1e-8, 1e-8, 1e-8]", "[1e-8, 1e-8, 9e-8]"), "robot.payload[0].inertia"),
    (changed("gravity = true", "gravity = 9.81"), "gravity"),
    (changed("mcp = 1e-5", "mcp = -1e-5"), "damping"),
    (changed("stiffness = 1e-3", 'stiffness = "1e-3"'), "springs.stiffness"),
    (changed("amplitude = 0.2", "amplitude = true"), "cost[0].reference.sines[0].amplitude"),
    (changed("duration = 0.1", "duration = 0.1\nsteps = 50"), "horizon.dt"),
    (changed("duration = 0.1", "duration = 0.101"), "horizon.duration"),
    (changed("duration = 0.1", "duration = 1e9"), "horizon"),
    (GOOD + '[[constraint]]\ntype = "joint_tie"\njoint = "pip"\nleader = "mcp"', "initial.q"),
    (changed('["mcp", "pip"]', '["mcp", "mcp"]'), "actuation.joints[1]"),
    (changed("mcp = 2.0, pip", "mcp = 0.0, pip"), "actuation.gear"),
    (changed("torque_limit = 0.5", "torque_limit = 0.0"), "actuation.torque_limit"),
    (changed("controls = [0.0, 0.0]", "controls = [0.0, 0.6]"), "simulate.controls"),
    (GOOD + '[[force]]\ntype = "glue"', "force[0].type"),
    (GOOD + '[[force]]\ntype = "stop"\nstiffness = 1.0\nlower = { mpc = 0.0 }', "force[0].lower.mpc"),
    (changed('type = "state"', 'type = "additive"'), "noise[0].center"),
    (changed("alpha = 0.5", "alpha = 1.5"), "integrator.alpha"),
    (changed("alpha = 0.5", "stages = 2"), "integrator.stages"),
    (changed("duration = 0.1", 'duration = 0.1\ncontrols = "linear"\nsampling = "midpoint"'), "horizon.sampling"),
    (GOOD + '[[plan_constraint]]\ntype = "control_rate"\nlimit = [1.0, 2.0, 3.0, 4.0]', "plan_constraint[0]"),
    (changed("[[noise]]", "[noise]"), "noise"),
    (changed("reference = { offset", "#"), "cost[0].reference"),
    (changed("hold = true", "hold = true\nreference = 0.0"), "cost[1]"),
    (changed("frequency = 2.0", "frequency = 2000"), "cost[0].reference.sines[0].frequency"),
    (changed('of = "mcp"', 'of = "dip"'), "cost[0].reference.sines[0].of"),
    (changed(HELD, 'type = "frame_position"\nframe = "top"\ntarget = [0, 0, 0]'), "cost[1].frame"),
    (changed(HELD, 'type = "frame_position"\nframe = -1\ntarget = [0, 0, 0]'), "cost[1].frame"),
    (changed(HELD, 'type = "joint_limits"\nmargin = "wide"'), "cost[1].margin"),
    (changed(SINES, "{ times = [0.1, 0.0], values = [[0, 0], [1, 1]] }"), "cost[0].reference.times"),
    (changed(SINES, "{ times = [0.0, 0.1], values = [[0, 0], [1]] }"), "cost[0].reference.values[1]"),
    (changed("seed = 3", "seed = 0.5"), "simulate.seed"),
    (changed("max_iterations", "max_iteration"), "solve.max_iteration"),
    (changed('title = "test"', "title = 2020-01-01"), "title"),
    (DAMPED.replace('a = "tip"', 'a = "tipp"'), "force[0].a"),
    (DAMPED.replace('b = "mcp"', 'b = { frame = "mcp", place = [0, 0, 0], at = 1 }'), "force[0].b"),
    (DAMPED.replace("damping = 1.0", "damping = [0.1, 0.2]"), "force[0].damping"),
    (GOOD + '[[force]]\ntype = "frame_wrench"\nframe = "tip"\nwrench = 0.0\naxes = "local"', "force[0].axes"),
    (SERVOS.replace('joints = ["elbow_joint", ', "joints = [").replace("torque_limit", "#"), "actuation"),
    (SERVOS + '[[noise]]\ntype = "control"\nintensity = 0.1', "noise"),
    (SERVOS + '[[force]]\ntype = "servo"\nstiffness = { elbow_joint = 1 }', "force"),
    (SERVOS.replace("80.0", "0.0"), "force[0].effort"),
    (TWO.replace(TWO.split("[[robot]]")[1], "").replace("[[robot]]", "", 1), "robot", "two or more robots"),
    (TWO.replace('prefix = "right_"', 'prefix = "left_"'), "robot", "'left_dip'"),
    (TWO.replace("prefix = ", "prefx = ", 1), "robot[0].prefx"),
    (TWO.replace("dip = 0.2 }", "dop = 0.2 }"), "robot[0].lock.dop", "dip"),
    (TWO.replace('"tip"', '"tipp"'), "robot[0].payload", "tip"),
    (TWO.replace('"left_mcp", "right_mcp"', '"mcp"'), "actuation.joints[0]", "left_mcp"),
    (changed("mass = 1e-3", "mass = -1e-3"), "robot.payload[0].mass", "[kg]", "-0.001"),
    (changed("mass = 1e-3", "mas = 1e-3"), "robot.payload[0].mas", "mas", "'mass'", "frame, mass, center, inertia"),
    (changed('"tracking"', '"traking"'), "cost[0].type", "'traking'", "'tracking'", "velocity"),
    (GOOD + '[[force]]\ntype = "stop"\nstiffness = "stiff"', "force[0].stiffness", "'stiff'"),
    (tracked("0.1").replace("steps = 10", "steps = 2_000_000"), "horizon"),
    *(
        (tracked("0.1").replace("finger", name), "robot.source")
        for name in ("/dev/zero", "fifo.urdf", "x" * 300 + ".urdf", "folder/a.urdf", "our.urdf")
    ),
]


def test_mistakes_name_their_keys_each_in_its_own_words(tmp_path):
    os.mkfifo(tmp_path / "fifo.urdf")
    messages = set()
    for text, key, *facts in MISTAKES:
        with pytest.raises(vp.SceneFileError) as caught:
            loaded(tmp_path, text)
        error = caught.value
        assert error.key == key, error
        assert str(error).startswith(f"scene.toml: {key}")
        assert not unnamed(str(error), *facts)
        assert "\n" not in str(error)
        messages.add(str(error))
    assert len(messages) == len(MISTAKES)


ODD = [
    *(None, True, -1, 0, 3, 2.5, 1e308, 1e-320, float("nan"), float("inf"), 10**400, "", "x", "\0", "a/b", "../x"),
    *([], [1.0], [[1]], ["a"], [True], ["mcp", "mcp"], {}, {"a": 1}, {"file": "x"}, [{}], datetime.date(2020, 1, 1)),
]


def leaves(data, path=()):
    if path:
        yield path
    for key in data if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ():
        yield from leaves(data[key], (*path, key))


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_odd_values_anywhere_are_taken_or_refused_in_words(tmp_path, monkeypatch):
    """Each value of a scene in turn is another: what comes of it is a scene or one line that names a key."""
    path, whole = write(tmp_path, ""), tomllib.loads(GOOD)
    odd = itertools.cycle(ODD)
    refused = []
    for place in leaves(whole):
        for value in itertools.islice(odd, 7):
            data = copy.deepcopy(whole)
            table = functools.reduce(lambda t, key: t[key], place[:-1], data)
            if value is None:
                del table[place[-1]]
            else:
                table[place[-1]] = value
            monkeypatch.setattr(tomllib, "loads", lambda _, data=data: data)
            try:
                vp.load_scene(path)
            except vp.SceneFileError as error:
                refused.append(error)
    assert len(refused) > 300
    for error in refused:
        assert error.key, error
        assert "\n" not in str(error)


def target_of(file):
    return file.problem.cost.terms[0].reference


def test_an_option_of_solve_is_refused_with_its_key(tmp_path):
    file = loaded(tmp_path, changed("max_iterations = 5", "max_iterations = 5\ntolerance = -1.0"))
    with refused(vp.SceneFileError, "solve.tolerance", "-1.0"):
        file.solve()
    with refused(vp.InputError, "tolerance", "-2.0"):
        file.solve(tolerance=-2.0)


def test_waypoints(tmp_path):
    waypoints = "times = [0.0, 0.05, 0.1], values = [[0, 0, 0], [1, 2, 0], [1, 0, 0]]"
    lines = target_of(loaded(tmp_path, tracked(f"{{ {waypoints} }}")))
    np.testing.assert_allclose(lines(0.025), [0.5, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(lines(0.2), [1.0, 0.0, 0.0], atol=1e-15)
    smooth = target_of(loaded(tmp_path, tracked(f'{{ {waypoints}, between = "smooth" }}')))
    np.testing.assert_allclose(smooth.at(np.array([0.0, 0.05, 0.1])), [[0, 0, 0], [1, 2, 0], [1, 0, 0]], atol=1e-15)
    fine = smooth.at(np.linspace(0.0, 0.1, 1001))
    assert fine.max() <= 2.0  # no overshoot


def test_reference_from_files(tmp_path):
    write(tmp_path, "t, dip, mcp, pip\n0, 1, 2, 3\n0.2, 3, 2, 1\n", "path.csv")
    target = target_of(loaded(tmp_path, tracked('{ file = "path.csv" }')))
    np.testing.assert_allclose(target(0.1), [2.0, 2.0, 2.0])
    np.testing.assert_allclose(target(0.0), [2.0, 3.0, 1.0])
    motion = vp.simulate(vp.Scene(vp.load_robot("finger")), [0.1, 0.2, 0.3], np.zeros(3), dt=0.01, steps=10)
    motion.save(tmp_path / "path.npz")
    target = target_of(loaded(tmp_path, tracked('{ file = "path.npz" }')))
    np.testing.assert_array_equal(target.at(motion.t), motion.q)


HEAD = "t, mcp, pip, dip"


@pytest.mark.parametrize(
    "data",
    [
        "t, mcp, pip\n0,1,2\n1,2,3\n",
        f"{HEAD}, mcp\n0,1,2,3,1\n1,2,3,4,2\n",
        f"{HEAD}\n0,1,2,3\n0.05,2,3,4\n",
        f"{HEAD}\n0.05,1,2,3\n1,2,3,4\n",
        f"{HEAD}\n0,1,2,3\n1,2,4\n",
        f"{HEAD}\n0,1,2,3\n1,2,nan,4\n",
        f"{HEAD}\n1,1,2,3\n0,2,3,4\n",
        *(np.zeros((3, 2)), np.zeros(2), np.array(["a", "b", "c"]), np.array([0.0, np.nan, 0.0])),
    ],
)
def test_faulty_files_of_references(data, tmp_path):
    if isinstance(data, str):
        write(tmp_path, data, "path.csv")
    else:
        np.savez(tmp_path / "path.npz", t=np.array([0.0, 0.1, 0.2]), mcp=np.zeros(3), pip=np.zeros(3), dip=data)
    (path,) = tmp_path.iterdir()
    with refused(vp.SceneFileError, "cost[0].reference.file"):
        loaded(tmp_path, tracked(f'{{ file = "{path.name}" }}'))


@pytest.mark.parametrize("name", ["../far.csv", "sub/../../far.csv", "link.csv", "ABSOLUTE"])
def test_paths_are_relative_to_the_file(name, tmp_path):
    inner = tmp_path / "inner"
    (inner / "sub").mkdir(parents=True)
    far = write(tmp_path, f"{HEAD}\n0,1,2,3\n1,2,3,4\n", "far.csv")
    (inner / "link.csv").symlink_to(far)
    vp.load_scene(write(inner, tracked(f'{{ file = "{name.replace("ABSOLUTE", str(far))}" }}')))


def test_robot_beside_the_scene(tmp_path):
    urdf = (ROOT / "models" / "finger.urdf").read_text(encoding="utf-8")
    write(tmp_path, urdf, "my.urdf")
    file = loaded(tmp_path, tracked("0.1").replace('"finger"', '"my.urdf"'))
    assert file.robot.joint_names == ("mcp", "pip", "dip")


def test_files_that_are_no_scenes(tmp_path):
    with refused(vp.FileError, "'finger_tracking'"):
        vp.load_scene("finger_trackin")
    with refused(vp.FileError, str(tmp_path)):
        vp.load_scene(tmp_path)
    with refused(vp.InputError, "path"):
        vp.load_scene(3)
    (tmp_path / "latin.toml").write_bytes(b'title = "\xe9"')
    with refused(vp.SceneFileError, "UTF-8"):
        vp.load_scene(tmp_path / "latin.toml")
    with refused(vp.SceneFileError, "nested"):
        loaded(tmp_path, f"a = {'[' * 100_000}{']' * 100_000}")


@pytest.mark.parametrize("name", scenes())
def test_bundled_scene(name, monkeypatch):
    """Each loads, simulates and, on a coarse and short horizon, lowers its cost; no shape is read for that."""

    def no_shapes(*arguments):
        raise AssertionError("geometry was read")

    monkeypatch.setattr("varpin.model.robot.geometry", no_shapes)
    monkeypatch.setattr("pinocchio.buildGeomFromUrdf", no_shapes)
    file = vp.load_scene(name)
    motion = file.simulate()
    assert motion.steps == file.steps
    assert np.isfinite(motion.q).all()
    problem = file.problem.at(steps=20)
    begin = vp.solve(problem, max_iterations=0)
    plan = vp.solve(problem, max_iterations=3)
    assert plan.expected_cost < begin.expected_cost


TEXT = (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8")


def test_the_documented_scene_is_one(tmp_path):
    whole, *parts = re.findall(r"^```toml\n(.*?)^```$", TEXT, re.M | re.S)
    file = loaded(tmp_path, whole)
    assert file.problem.steps == file.steps
    # Constraints of the mechanism, which no plan goes with, and of plans have pages of their own.
    data = tomllib.loads(whole)
    assert set(data) == set(TABLES) - {"constraint", "plan_constraint"}
    options = inspect.signature(vp.load_robot).parameters
    assert set(options) <= set(re.findall(r"\w+", whole[whole.index("[robot]") : whole.index("[springs]")]))
    for text in parts:
        tomllib.loads(text)
    assert all(f"`{name}`" in TEXT for name in scenes())


@pytest.mark.parametrize(
    ("kind", "keys"),
    [
        *((kind, set(cost_keys(kind)) - {"weight", "terminal"}) for kind in COSTS),
        *((kind, set(inspect.signature(make).parameters)) for kind, make in FORCES.items()),
    ],
)
def test_documented_keys_of_costs_and_forces_are_those_there_are(kind, keys):
    (row,) = re.findall(rf"^\| `{kind}` \|.*\|(.*)\|$", TEXT, re.M)
    assert keys <= set(re.findall(r"`(\w+)`", row))


def test_a_replay_is_told_where_a_frame_is_to_go():
    """To a pose, roll, pitch and yaw as a URDF has them; or along a path."""
    marks = vp.load_scene("ur5_reach").marks()
    assert (marks.trace, marks.reference, marks.ghost) == (["tool0"], None, None)
    pose = pin.SE3(pin.rpy.rpyToMatrix(1.225, 0.748, -2.748), np.array([0.304, 0.583, 0.249]))
    np.testing.assert_allclose(marks.targets["target"], [pose.homogeneous], atol=1e-12)
    marks = vp.load_scene("kinova_circle").marks()
    assert marks.trace == ["j2s6s200_end_effector"]
    path = marks.targets["target"]
    np.testing.assert_array_equal(path, marks.reference["path of target"])
    angle = np.linspace(0.0, 2.0 * np.pi, len(path))
    circle = 0.1 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    np.testing.assert_allclose(path - circle, np.tile([-0.3167, -0.1643, 0.5384], (len(path), 1)), atol=1e-5)


def test_a_replay_is_told_which_motion_is_followed():
    scene = vp.load_scene("finger_tracking")
    for duration in (1.5, 0.4):
        marks = scene.marks(duration)
        assert (marks.targets or None, marks.reference, marks.trace) == (None, None, True)
        t = np.linspace(0.0, duration, len(marks.ghost))
        wanted = [1.0 + 0.25 * np.sin(4.0 * np.pi * t), 0.3 + 0.1 * np.sin(2.0 * np.pi * t), np.full_like(t, 0.2)]
        np.testing.assert_allclose(marks.ghost.T, wanted, atol=1e-12)
    assert scene.marks(0.0).ghost.shape == (1, 3)


def test_of_joints_that_cost_nothing_the_ghost_stays_where_they_start(tmp_path):
    cost = "weight = { mcp = 1.0 }\nterminal = true\nreference = { mcp = 0.7, dip = 0.1 }\n[initial]\nq = { pip = 0.3 }"
    text = tracked("0.0").replace("reference = 0.0", cost)
    np.testing.assert_allclose(loaded(tmp_path, text).marks().ghost, [[0.7, 0.3, 0.0]])


def test_without_an_integrator_a_file_takes_that_of_its_problem(tmp_path):
    text = '[robot]\nsource = "finger"\n[horizon]\ndt = 1e-2\nsteps = 4\n[[cost]]\ntype = "control"\n'
    for damping, expected in ((0.0, vp.Gauss(3)), (10.0, vp.Radau(4))):
        file = loaded(tmp_path, f"damping = {damping}\n{text}", required_only=False)
        plain = vp.OptimalControlProblem(file.scene, file.problem.cost, file.q0, file.v0, dt=1e-2, steps=4)
        assert file.integrator == file.problem.integrator == plain.integrator == expected
        assert file.simulate().integrator == str(expected)


SRDF = """<robot name="made_up">
<group_state name="home" group="arm"><joint name="j1" value="0.5"/><joint name="j2" value="-0.3"/></group_state>
<group_state name="folded" group="arm"><joint name="j1" value="0.1"/></group_state>
<group_state name="folded" group="all"><joint name="j1" value="0.2"/><joint name="j2" value="0.4"/></group_state>
</robot>"""


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "postures.srdf").write_text(SRDF)
    return write_urdf(tmp_path, link("l1"), link("l2"), joint("j1", "base", "l1"), joint("j2", "l1", "l2"))


def test_a_description_without_damping_and_friction_is_named(caplog):
    with caplog.at_level(logging.WARNING):
        assert not vp.Scene(vp.load_robot("ur10"), damping="robot", friction="robot").forces
    assert [unnamed(record.getMessage(), ("'ur10'", "='robot'", "none")) for record in caplog.records] == [[], []]


def test_postures_are_configurations(arm, tmp_path):
    text = f"""
[robot]
source = "{arm.name}"
srdf = "config/postures.srdf"
[springs]
stiffness = 1.0
rest = "arm/folded"
[initial]
q = "home"
[[noise]]
type = "state"
intensity = 0.1
center = "all/folded"
[[cost]]
type = "tracking"
reference = "home"
terminal = true
[[cost]]
type = "control"
hold = "home"

{HORIZON}"""
    file = loaded(tmp_path, text, required_only=False)
    np.testing.assert_array_equal(file.q0, [0.5, -0.3])
    np.testing.assert_array_equal(file.scene.rest, [0.1, 0.0])
    np.testing.assert_array_equal(file.scene.values["noise.center"].ravel()[::2], [0.2, 0.4])
    tracking, control = file.problem.cost.terms
    np.testing.assert_array_equal(tracking.reference, [0.5, -0.3])
    np.testing.assert_allclose(control.reference, file.scene.holding_torque(file.q0), rtol=1e-12)
    with refused(vp.SceneFileError, "initial.q", "'hom'", "home", "folded"):
        loaded(tmp_path, text.replace('q = "home"', 'q = "hom"'))
    with refused(vp.SceneFileError, "springs.rest", "arm/folded", "all/folded"):
        loaded(tmp_path, text.replace('"arm/folded"', '"folded"'))


def test_postures_of_a_command(arm, tmp_path, capsys):
    saved = tmp_path / "motion.npz"
    (arm.parent / "config" / "postures.srdf").rename(arm.with_suffix(".srdf"))
    command = ["simulate", str(arm), "--steps", "2", "--save", str(saved), "--quiet", "--q0"]
    for word, expected in (("home", [0.5, -0.3]), ("all/folded", [0.2, 0.4])):
        assert main([*command, word]) == 0
        np.testing.assert_array_equal(vp.Trajectory.load(saved).q[0], expected)
    capsys.readouterr()
    for words, facts in ((["hom"], ("'hom'", "home", "folded")), (["home", "0.1"], "--q0")):
        assert main([*command, *words]) != 0
        assert not unnamed(capsys.readouterr().err, facts)


def test_arguments_of_a_xacro_file(tmp_path):
    pytest.importorskip("xacro")
    inertial = INERTIAL.replace("1.3", "$(arg mass)")
    text = write_urdf(tmp_path, link("l", inertial), joint("$(arg prefix)j", "base", "l")).read_text()
    head = '<robot name="made_up" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    head += '<xacro:arg name="prefix" default=""/><xacro:arg name="mass" default="1"/>'
    (tmp_path / "arm.urdf.xacro").write_text(text.replace('<robot name="made_up">', head))
    text = '[robot]\nsource = "arm.urdf.xacro"\nxacro_args = { prefix = "left_", mass = 3 }\n'
    robot = loaded(tmp_path, text + HORIZON, required_only=False).robot
    assert (robot.joint_names, robot.tree.mass.tolist()) == (("left_j",), [3.0])


def test_joints_that_stay(tmp_path):
    text = '[robot]\nsource = "ur5"\nkeep = ["elbow_joint", "wrist_1_joint"]\nlock = { shoulder_lift_joint = -1.0 }\n'
    robot = loaded(tmp_path, text + HORIZON).robot
    assert robot.joint_names == ("elbow_joint", "wrist_1_joint")
    assert robot.locked["shoulder_lift_joint"] == -1.0
    with refused(vp.SceneFileError, "robot.keep", "elbow_joint"):
        loaded(tmp_path, text.replace("elbow_joint", "elbow") + HORIZON)


def test_robots_of_a_file_are_those_that_combine_makes(tmp_path):
    file = loaded(tmp_path, TWO, required_only=False)
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned[0, 3] = 0.02
    left = vp.load_robot("finger", lock={"dip": 0.2}, payload=vp.Payload("tip", 1e-3))
    right = vp.load_robot("finger", base=turned)
    robot = vp.combine(left, right, prefixes=["left_", "right_"])
    assert file.robot.joint_names == ("left_mcp", "left_pip", "right_mcp", "right_pip", "right_dip")
    assert dict(file.robot.locked) == {"left_dip": 0.2}
    scene = vp.Scene(robot, damping={"right_pip": 0.1}, actuation=["left_mcp", "right_mcp"])
    start = {"left_mcp": 0.1, "right_dip": -0.2}
    motion = vp.simulate(scene, start, 0.0 * np.zeros(5), dt=1e-3, steps=20, integrator=file.integrator)
    np.testing.assert_allclose(file.simulate().q, motion.q, atol=1e-12)
