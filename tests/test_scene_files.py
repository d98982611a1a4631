"""Scene files: what they may say, each mistake in its own words, and that they reach no further than what they name."""

import copy
import datetime
import functools
import inspect
import itertools
import os
import re
import tomllib
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused, unnamed

import varpin as vp
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
    file = vp.load_scene(write(tmp_path, GOOD))
    scene, problem = file.scene, file.problem
    assert file.robot.joint_names == ("mcp", "pip")
    assert dict(file.robot.locked) == {"dip": 0.2}
    np.testing.assert_array_equal(scene.gravity, [0.0, 0.0, -9.81])
    np.testing.assert_array_equal(scene.damping, [1e-5, 2e-5])
    np.testing.assert_array_equal(scene.stiffness, [1e-3, 1e-3])
    np.testing.assert_array_equal(scene.rest, [0.1, 0.2])
    np.testing.assert_array_equal(scene.actuation, [[2.0, 0.0], [0.0, 1.0]])
    np.testing.assert_array_equal(problem.control_limits, [[-0.25, -0.5], [0.25, 0.5]])
    np.testing.assert_array_equal(
        scene.noise.fields(np.ones((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(2)).F[0],
        np.diag([1e-4 * 0.81] * 2),
    )
    np.testing.assert_array_equal(file.q0, [0.5, 0.3])
    np.testing.assert_array_equal(file.v0, [0.1, 0.0])
    assert (problem.dt, problem.steps, problem.integrator) == (2e-3, 50, vp.Midpoint(alpha=0.5))
    bare = vp.load_robot("finger", lock={"dip": 0.2})
    assert file.robot.tree.mass.sum() == pytest.approx(bare.tree.mass.sum() + 1e-3, rel=1e-12)
    assert file.outputs["save"] == Path.cwd() / "plan.npz"


STOPPED = """
[[force]]
type = "friction"
level = { mcp = 1e-4 }
width = 0.05

[[force]]
type = "stop"
stiffness = 0.1
damping = [1e-4, 0.0]
upper = { pip = 1.0 }

[[force]]
type = "armature"
inertia = 1e-6
"""


def test_forces_of_a_scene_are_those_written_in_python(tmp_path):
    file = vp.load_scene(write(tmp_path, GOOD + STOPPED))
    forces = [
        vp.CoulombFriction([1e-4, 0.0], 0.05),
        vp.JointStop(0.1, [1e-4, 0.0], upper=[np.inf, 1.0]),
        vp.Armature(1e-6),
    ]
    scene = vp.Scene(file.robot, damping=[1e-5, 2e-5], stiffness=1e-3, rest=[0.1, 0.2], forces=forces)
    assert file.scene.elements == scene.elements
    np.testing.assert_array_equal(file.scene.armature, scene.armature)
    assert file.required.terms["other forces"] == "Armature, CoulombFriction, JointStop"
    assert file.required.terms["not modelled"].startswith("contact;")
    assert vp.load_scene(write(tmp_path, GOOD)).required.terms["not modelled"].startswith("stops at joint limits, dry")


SERVED = """
gravity = false
damping = 0.5
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
[initial]
q = { elbow_joint = 0.5, wrist_1_joint = 0.2 }
[horizon]
dt = 1e-2
steps = 20
[integrator]
type = "gauss"
stages = 2
[[cost]]
type = "tracking"
weight = 10.0
terminal = true
reference = { elbow_joint = 0.6, wrist_1_joint = 0.2 }
[[cost]]
type = "control"
weight = 1e-2
hold = true
[simulate]
controls = { elbow_joint = 0.8, wrist_1_joint = 0.2, wrist_2_joint = 1.0 }
"""


def test_servos_of_a_scene_are_commanded_positions(tmp_path):
    file = vp.load_scene(write(tmp_path, SERVED))
    servo = vp.PositionServo(
        {"elbow_joint": 300.0, "wrist_1_joint": 50.0},
        {"elbow_joint": 30.0, "wrist_1_joint": 5.0},
        {"elbow_joint": 80.0, "wrist_1_joint": 20.0},
    )
    driven = ["elbow_joint", "wrist_1_joint", "wrist_2_joint"]
    scene = vp.Scene(file.robot, gravity=False, damping=0.5, forces=servo, actuation=driven)
    assert file.scene.elements == scene.elements
    np.testing.assert_array_equal(file.scene.actuation, scene.actuation)
    # Torque limits are those of drives: positions have none.
    np.testing.assert_array_equal(file.problem.control_limits[1], [np.inf, np.inf, 8.0])
    assert file.required.terms["other forces"] == "PositionServo"
    motion = file.simulate()
    same = vp.simulate(scene, file.q0, file.v0, dt=1e-2, steps=20, controls=[0.8, 0.2, 1.0], integrator=vp.Gauss(2))
    assert motion.q.tobytes() == same.q.tobytes()
    motion.save(tmp_path / "motion.npz")
    back = vp.Trajectory.load(tmp_path / "motion.npz")
    np.testing.assert_array_equal(back.scene_values["PositionServo"], scene.values["PositionServo"])
    plan = file.solve()
    assert plan.status.converged
    assert plan.trajectory.q[-1, 2] == pytest.approx(0.6, abs=0.02)
    plan.save(tmp_path / "plan.npz")
    again = file.load_solution(tmp_path / "plan.npz")
    assert again.trajectory.q.tobytes() == plan.trajectory.q.tobytes()
    assert again.policy.servos == ("elbow_joint", "wrist_1_joint")


ON_FRAMES = """
gravity = false
[robot]
source = "allegro_right_hand"
[[force]]
type = "frame_spring"
a = "link_3.0"
b = { frame = "link_7.0", place = [0.0, 0.0, 0.01] }
stiffness = 5.0
rest = [0.0, 0.01, 0.0]
rotational_stiffness = 0.02
rest_rotation = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
[[force]]
type = "frame_damper"
a = "link_3.0"
b = [0.0, 0.1, 0.1]
damping = [0.1, 0.2, 0.3]
rotational_damping = 0.01
[[force]]
type = "frame_wrench"
frame = "link_7.0"
wrench = [0.01, 0.0, 0.02, 0.0, 1e-3, 0.0]
axes = "frame"
[horizon]
dt = 1e-3
steps = 20
"""


def test_forces_on_frames_of_a_scene_are_those_written_in_python(tmp_path):
    """Two fingers that a spring joins are one group; the two others are left out with the damper on one of them."""
    more = '[[force]]\ntype = "frame_damper"\na = "link_11.0"\nb = [0, 0, 0]\ndamping = 1.0\n[horizon]'
    path = write(tmp_path, ON_FRAMES.replace("[horizon]", more))
    file = vp.load_scene(path)
    forces = [
        vp.FrameSpring(
            "link_3.0", ("link_7.0", [0.0, 0.0, 0.01]), 5.0, [0.0, 0.01, 0.0], 0.02, [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
        ),
        vp.FrameDamper("link_3.0", [0.0, 0.1, 0.1], [0.1, 0.2, 0.3], 0.01),
        vp.FrameWrench("link_7.0", [0.01, 0.0, 0.02, 0.0, 1e-3, 0.0], "frame"),
    ]
    assert file.robot.dof == 8
    assert file.scene.couplings == vp.Scene(file.robot, forces=forces).couplings
    assert file.required.parts == (file.robot.joint_names,)
    assert file.required.terms["other forces"] == "FrameDamper, FrameSpring, FrameWrench"
    whole = vp.load_scene(path, required_only=False)
    assert len(whole.scene.couplings) == 8
    own = [whole.robot.joint_names.index(name) for name in file.robot.joint_names]
    np.testing.assert_allclose(file.simulate().q, whole.simulate().q[:, own], rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (('a = "link_3.0"\nb = {', 'a = "link_33"\nb = {'), "force[0].a"),
        (("0.01] }", "0.01], at = 1 }"), "force[0].b"),
        (("b = [0.0, 0.1, 0.1]", "b = 3"), "force[1].b"),
        (("damping = [0.1, 0.2, 0.3]", "damping = -1"), "force[1].damping"),
        (("damping = [0.1, 0.2, 0.3]", "damping = [0.1, 0.2]"), "force[1].damping"),
        (('axes = "frame"', 'axes = "local"'), "force[2].axes"),
        (('frame = "link_7.0"\nwrench', "frame = [0, 0, 0]\nwrench"), "force[2].frame"),
        (('a = "link_3.0"\nb = [', "a = [1, 1, 1]\nb = ["), "force[1]"),
    ],
)
def test_forces_on_frames_that_cannot_be(change, key, tmp_path):
    text = ON_FRAMES.replace(*change)
    assert text != ON_FRAMES
    with pytest.raises(vp.SceneFileError) as caught:
        vp.load_scene(write(tmp_path, text))
    assert caught.value.key == key


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
    limits = vp.load_scene(write(tmp_path, text)).problem.control_limits
    np.testing.assert_array_equal(limits[1], [np.inf, 2.0, 2.0, np.inf])


def test_servos_that_stand_where_they_are_told_leave_joints_idle(tmp_path):
    """A finger that nothing moves is left out with its servos; told to go elsewhere, it is not."""
    text = """
gravity = false
[robot]
source = "allegro_right_hand"
[[force]]
type = "servo"
stiffness = 2.0
damping = 0.05
[initial]
q = { "joint_12.0" = 0.3, "joint_5.0" = 0.4 }
[horizon]
dt = 5e-3
steps = 10
[simulate]
controls = { "joint_0.0" = 0.1, "joint_12.0" = 0.3, "joint_5.0" = %s }
"""
    fingers = [vp.load_scene(write(tmp_path, text % command)) for command in (0.4, 0.5)]
    assert [len(file.robot.joint_names) for file in fingers] == [4, 8]
    alone, whole = fingers[0].simulate(), vp.load_scene(write(tmp_path, text % 0.4), required_only=False).simulate()
    np.testing.assert_allclose(alone.q, whole.q[:, :4], rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(whole.q[:, 4:], np.tile(whole.q[0, 4:], (11, 1)))


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (('joints = ["elbow_joint", ', "joints = ["), "actuation"),
        (("torque_limit", "gear = 2.0\ntorque_limit"), "actuation"),
        (("wrist_2_joint = 1.0", "wrist_2_joint = 9.0"), "simulate.controls"),
        (("[initial]", '[[noise]]\ntype = "control"\nintensity = 0.1\n[initial]'), "noise"),
        (
            ("[actuation]", '[[force]]\ntype = "servo"\nstiffness = { elbow_joint = 1 }\n[actuation]'),
            "force",
        ),
        (("effort = { elbow_joint = 80.0", "effort = { elbow_joint = 0.0"), "force[0].effort"),
    ],
)
def test_servos_that_cannot_be(change, key, tmp_path):
    text = SERVED.replace(*change)
    assert text != SERVED
    if key == "actuation" or "joints = [" in change[0]:
        text = text.replace("torque_limit = { elbow_joint = 100.0, wrist_1_joint = 20.0, wrist_2_joint = 8.0 }", "")
    with pytest.raises(vp.SceneFileError) as caught:
        vp.load_scene(write(tmp_path, text))
    assert caught.value.key == key


def test_cost_of_a_scene_is_that_written_in_python(tmp_path):
    file = vp.load_scene(write(tmp_path, GOOD))

    def reference(t):
        return [1.0 + 0.2 * np.sin(4.0 * np.pi * t), 0.0]

    hold = np.linalg.solve(file.scene.actuation, -vp.lagrangian_jet(file.scene, file.q0, np.zeros(2)).Lq)
    cost = vp.TrackingCost(reference, [10.0, 0.0]) + vp.ControlCost(0.1, hold)
    problem = vp.OptimalControlProblem(file.scene, cost, file.q0, file.v0, dt=2e-3, steps=50)
    rng = np.random.default_rng(0)
    q, v, u = rng.normal(size=(3, 51, 2))
    assert file.problem.costs(q, v, u[:50]) == pytest.approx(problem.costs(q, v, u[:50]), rel=1e-12)


RATE = """
[[cost]]
type = "control_rate"
weight = { mcp = 0.2, pip = 0.1 }
"""


@pytest.mark.parametrize(
    ("start", "before"),
    [
        ("", None),
        ("before = { mcp = 0.1, pip = -0.2 }", [0.1, -0.2]),
        ("before = 0.3", [0.3, 0.3]),
        ("hold = true", ()),
    ],
    ids=["free", "by name", "a number", "hold"],
)
def test_rate_of_controls(tmp_path, start, before):
    file = vp.load_scene(write(tmp_path, GOOD + RATE + start))
    if before == ():
        before = np.linalg.solve(file.scene.actuation, -vp.lagrangian_jet(file.scene, file.q0, np.zeros(2)).Lq)
    rate = file.problem.rate
    np.testing.assert_array_equal(rate.weight, np.diag([0.2, 0.1]))
    assert (rate.before is None) == (before is None)
    if before is not None:
        np.testing.assert_allclose(rate.before, before, rtol=1e-12)
    bare = vp.load_scene(write(tmp_path, GOOD, "bare.toml")).problem
    rng = np.random.default_rng(0)
    q, v, u = rng.normal(size=(3, 51, 2))
    own = np.diff(u[:50], axis=0) if before is None else np.diff(u[:50], axis=0, prepend=[before])
    expected = (own**2 @ [0.2, 0.1]).sum() / 2e-3
    assert file.problem.costs(q, v, u[:50]) - bare.costs(q, v, u[:50]) == pytest.approx(expected, rel=1e-9)


SINES = '{ offset = { mcp = 1.0 }, sines = [{ of = "mcp", amplitude = 0.2, frequency = 2.0 }] }'
HELD = 'type = "control"\nweight = 0.1\nhold = true'
# What is replaced by what, or added, and the key of the mistake.
MISTAKES = [
    (RATE + "terminal = true", "cost[2].terminal"),
    (RATE + "before = { sines = [] }", "cost[2].before.sines"),
    (RATE + "before = 0.0\nhold = true", "cost[2]"),
    (RATE + "before = { dip = 0.0 }", "cost[2].before.dip"),
    ("gravity = true", "gravity =", ""),
    ("\n[robot]\nsource = 'ur5'\n", ""),
    ("[springs]", "[spring]", "spring"),
    ('source = "finger"\n', "", "robot.source"),
    ('"finger"', '"fingr"', "robot.source"),
    ("dip = 0.2", "dop = 0.2", "robot.lock.dop"),
    ("dip = 0.2", "dip = 20", "robot.lock.dip"),
    ("damping = { mcp", "damping = { dip", "damping.dip"),
    ('"tip"', '"tipp"', "robot.payload"),
    ("mass = 1e-3", "mass = -1e-3", "robot.payload[0].mass"),
    ("[1e-8, 1e-8, 1e-8]", "[1e-8, 1e-8, 9e-8]", "robot.payload[0].inertia"),
    ("gravity = true", "gravity = 9.81", "gravity"),
    ("mcp = 1e-5", "mcp = -1e-5", "damping"),
    ("rest = [0.1, 0.2]", "rest = [0.1]", "springs.rest"),
    ("stiffness = 1e-3", 'stiffness = "1e-3"', "springs.stiffness"),
    ("amplitude = 0.2", "amplitude = true", "cost[0].reference.sines[0].amplitude"),
    ("dt = 2e-3", "dt = nan", "horizon.dt"),
    ("duration = 0.1", "duration = 0.1\nsteps = 50", "horizon"),
    ("duration = 0.1", "duration = 0.101", "horizon.duration"),
    ("duration = 0.1", "duration = 1e9", "horizon"),
    ("q = [0.5, 0.3]", "q = [30.0, 20.0]", "initial.q"),
    ('[[constraint]]\ntype = "joint_tie"\njoint = "pip"\nleader = "mcp"', "initial.q"),
    ('["mcp", "pip"]', '["mcp", "mcp"]', "actuation.joints[1]"),
    ("mcp = 2.0, pip", "mcp = 0.0, pip", "actuation.gear"),
    ("torque_limit = 0.5", "torque_limit = 0.0", "actuation.torque_limit"),
    ("controls = [0.0, 0.0]", "controls = [0.0, 0.6]", "simulate.controls"),
    ('[[force]]\ntype = "glue"', "force[0].type"),
    ('[[force]]\ntype = "stop"\nstiffness = 1.0\nlower = { mpc = 0.0 }', "force[0].lower.mpc"),
    ('[[force]]\ntype = "armature"', "force[0].inertia"),
    ('[[force]]\ntype = "friction"\nlevel = -1', "force[0].level"),
    ('type = "state"', 'type = "white"', "noise[0].type"),
    ('type = "state"', 'type = "additive"', "noise[0].center"),
    ('type = "midpoint"', 'type = "mid_point"', "integrator.type"),
    ("alpha = 0.5", "alpha = 1.5", "integrator.alpha"),
    ("alpha = 0.5", "stages = 2", "integrator.stages"),
    ("duration = 0.1", 'duration = 0.1\ncontrols = "linear"\nsampling = "midpoint"', "horizon.sampling"),
    ('[[plan_constraint]]\ntype = "control_rate"\nlimit = [1.0, 2.0, 3.0, 4.0]', "plan_constraint[0]"),
    ("[[noise]]", "[noise]", "noise"),
    ("weight = 0.1", "weight = -0.1", "cost[1].weight"),
    ("reference = { offset", "#", "cost[0].reference"),
    ("hold = true", "hold = true\nreference = 0.0", "cost[1]"),
    ("frequency = 2.0", "frequency = 2000", "cost[0].reference.sines[0].frequency"),
    ('of = "mcp"', 'of = "dip"', "cost[0].reference.sines[0].of"),
    (HELD, 'type = "frame_position"\nframe = "top"\ntarget = [0, 0, 0]', "cost[1].frame"),
    (HELD, 'type = "frame_position"\nframe = "tip"\ntarget = [0, 0]', "cost[1].target"),
    (SINES, "{ times = [0.1, 0.0], values = [[0, 0], [1, 1]] }", "cost[0].reference.times"),
    (SINES, "{ times = [0.0, 0.1], values = [[0, 0], [1]] }", "cost[0].reference.values[1]"),
    ("seed = 3", "seed = 0.5", "simulate.seed"),
    ("max_iterations", "max_iteration", "solve.max_iteration"),
    ('"plan.npz"', "3", "outputs.save"),
    ('title = "test"', "title = 2020-01-01", "title"),
]


def test_mistakes_name_their_keys_each_in_its_own_words(tmp_path):
    messages = set()
    for *words, key in MISTAKES:
        with pytest.raises(vp.SceneFileError) as caught:
            vp.load_scene(write(tmp_path, changed(*words) if len(words) == 2 else GOOD + words[0]))
        error = caught.value
        assert error.key == key, error
        assert str(error).startswith(f"scene.toml: {key}")
        assert "\n" not in str(error)
        messages.add(str(error))
    assert len(messages) == len(MISTAKES)


@pytest.mark.parametrize(
    ("words", "facts"),
    [
        (("mass = 1e-3", "mass = -1e-3"), ("[kg]", "-0.001")),
        (("mass = 1e-3", "mas = 1e-3"), ("mas", "'mass'", "frame, mass, center, inertia")),
        (('"tracking"', '"traking"'), ("'traking'", "'tracking'", "velocity")),
        (("gravity = true", "gravity ="), "line 3"),
        (("[initial]", '[[force]]\ntype = "stop"\nstiffness = "stiff"\n[initial]'), "'stiff'"),
    ],
)
def test_a_message_says_what_is_allowed(words, facts, tmp_path):
    with pytest.raises(vp.SceneFileError) as caught:
        vp.load_scene(write(tmp_path, changed(*words)))
    assert not unnamed(str(caught.value), facts)


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


def target_of(file):
    return file._task.terms[0].target


def test_an_option_of_solve_is_refused_with_its_key(tmp_path):
    file = vp.load_scene(write(tmp_path, changed("max_iterations = 5", "max_iterations = 5\ntolerance = -1.0")))
    with refused(vp.SceneFileError, "solve.tolerance", "-1.0"):
        file.solve()
    with refused(vp.InputError, "tolerance", "-2.0"):
        file.solve(tolerance=-2.0)


def test_waypoints(tmp_path):
    waypoints = "times = [0.0, 0.05, 0.1], values = [[0, 0, 0], [1, 2, 0], [1, 0, 0]]"
    lines = target_of(vp.load_scene(write(tmp_path, tracked(f"{{ {waypoints} }}"))))
    np.testing.assert_allclose(lines(0.025), [0.5, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(lines(0.2), [1.0, 0.0, 0.0], atol=1e-15)
    smooth = target_of(vp.load_scene(write(tmp_path, tracked(f'{{ {waypoints}, between = "smooth" }}'))))
    np.testing.assert_allclose(smooth.at(np.array([0.0, 0.05, 0.1])), [[0, 0, 0], [1, 2, 0], [1, 0, 0]], atol=1e-15)
    fine = smooth.at(np.linspace(0.0, 0.1, 1001))
    assert fine.max() <= 2.0  # no overshoot


def test_reference_from_files(tmp_path):
    write(tmp_path, "t, dip, mcp, pip\n0, 1, 2, 3\n0.2, 3, 2, 1\n", "path.csv")
    target = target_of(vp.load_scene(write(tmp_path, tracked('{ file = "path.csv" }'))))
    np.testing.assert_allclose(target(0.1), [2.0, 2.0, 2.0])
    np.testing.assert_allclose(target(0.0), [2.0, 3.0, 1.0])
    motion = vp.simulate(vp.Scene(vp.load_robot("finger")), [0.1, 0.2, 0.3], np.zeros(3), dt=0.01, steps=10)
    motion.save(tmp_path / "path.npz")
    target = target_of(vp.load_scene(write(tmp_path, tracked('{ file = "path.npz" }'))))
    np.testing.assert_array_equal(target.at(motion.t), motion.q)


@pytest.mark.parametrize(
    "text",
    [
        "t, mcp, pip\n0,1,2\n1,2,3\n",
        "t, mcp, pip, dip, mcp\n0,1,2,3,1\n1,2,3,4,2\n",
        "t, mcp, pip, dip\n0,1,2,3\n0.05,2,3,4\n",
        "t, mcp, pip, dip\n0,1,2,3\n1,2,x,4\n",
        "t, mcp, pip, dip\n0,1,2,3\n1,2,4\n",
        "t, mcp, pip, dip\n0,1,2,3\n1,2,nan,4\n",
        "t, mcp, pip, dip\n1,1,2,3\n0,2,3,4\n",
        "",
        *(np.zeros((3, 2)), np.zeros(2), np.array(["a", "b", "c"]), np.array([0.0, np.nan, 0.0])),
    ],
)
def test_faulty_files_of_references(text, tmp_path):
    name = "path.csv" if isinstance(text, str) else "path.npz"
    if isinstance(text, str):
        write(tmp_path, text, name)
    else:
        np.savez(tmp_path / name, t=np.array([0.0, 0.1, 0.2]), mcp=np.zeros(3), pip=np.zeros(3), dip=text)
    with pytest.raises(vp.SceneFileError) as caught:
        vp.load_scene(write(tmp_path, tracked(f'{{ file = "{name}" }}')))
    assert caught.value.key == "cost[0].reference.file"


@pytest.mark.parametrize("name", ["../far.csv", "sub/../../far.csv", "link.csv", "ABSOLUTE"])
def test_paths_are_relative_to_the_file(name, tmp_path):
    inner = tmp_path / "inner"
    (inner / "sub").mkdir(parents=True)
    far = write(tmp_path, "t, mcp, pip, dip\n0,1,2,3\n1,2,3,4\n", "far.csv")
    (inner / "link.csv").symlink_to(far)
    vp.load_scene(write(inner, tracked(f'{{ file = "{name.replace("ABSOLUTE", str(far))}" }}')))


@pytest.mark.parametrize("name", ["/dev/zero", "fifo.urdf", "x" * 300 + ".urdf", "folder/a.urdf"])
def test_paths_that_are_no_files(name, tmp_path):
    os.mkfifo(tmp_path / "fifo.urdf")
    with pytest.raises(vp.SceneFileError) as caught:
        vp.load_scene(write(tmp_path, tracked("0.1").replace("finger", name)))
    assert caught.value.key == "robot.source"


@pytest.mark.parametrize("steps", [2_000_000, 100_000_000])
def test_horizons_beyond_memory(steps, tmp_path):
    with pytest.raises(vp.SceneFileError) as caught:
        vp.load_scene(write(tmp_path, tracked("0.1").replace("steps = 10", f"steps = {steps}")))
    assert caught.value.key.startswith("horizon")


def test_robot_beside_the_scene(tmp_path):
    urdf = (ROOT / "models" / "finger.urdf").read_text(encoding="utf-8")
    write(tmp_path, urdf, "my.urdf")
    file = vp.load_scene(write(tmp_path, tracked("0.1").replace('"finger"', '"my.urdf"')))
    assert file.robot.joint_names == ("mcp", "pip", "dip")
    with refused(vp.SceneFileError, "our.urdf"):
        vp.load_scene(write(tmp_path, tracked("0.1").replace('"finger"', '"our.urdf"')))


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
        vp.load_scene(write(tmp_path, f"a = {'[' * 100_000}{']' * 100_000}"))


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
    file = vp.load_scene(write(tmp_path, whole))
    assert file.problem.steps == file.steps
    # Constraints of the mechanism, which no plan goes with, and of plans have pages of their own.
    data = tomllib.loads(whole)
    assert set(data) == set(TABLES) - {"constraint", "plan_constraint"}
    options = inspect.signature(vp.load_robot).parameters
    assert set(options) <= set(re.findall(r"\w+", whole[whole.index("[robot]") : whole.index("[springs]")]))
    for text in parts:
        tomllib.loads(text)


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


def test_every_scene_is_documented():
    assert all(f"`{name}`" in TEXT for name in scenes())


def test_a_replay_is_told_where_a_frame_is_to_go():
    scene = vp.load_scene("ur5_reach")
    marks = scene.marks()
    assert marks.trace == ["tool0"]
    assert marks.reference is None
    assert marks.ghost is None
    # Roll, pitch and yaw as a URDF has them.
    pose = pin.SE3(pin.rpy.rpyToMatrix(1.225, 0.748, -2.748), np.array([0.304, 0.583, 0.249]))
    np.testing.assert_allclose(marks.targets["target"], [pose.homogeneous], atol=1e-12)


def test_a_replay_is_told_the_path_of_a_frame():
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
        assert not marks.targets
        assert marks.reference is None
        assert marks.trace is True
        t = np.linspace(0.0, duration, len(marks.ghost))
        wanted = [1.0 + 0.25 * np.sin(4.0 * np.pi * t), 0.3 + 0.1 * np.sin(2.0 * np.pi * t), np.full_like(t, 0.2)]
        np.testing.assert_allclose(marks.ghost.T, wanted, atol=1e-12)
    assert scene.marks(0.0).ghost.shape == (1, 3)


def test_of_joints_that_cost_nothing_the_ghost_stays_where_they_start(tmp_path):
    cost = "weight = { mcp = 1.0 }\nterminal = true\nreference = { mcp = 0.7, dip = 0.1 }\n[initial]\nq = { pip = 0.3 }"
    text = tracked("0.0").replace("reference = 0.0", cost)
    np.testing.assert_allclose(vp.load_scene(write(tmp_path, text)).marks().ghost, [[0.7, 0.3, 0.0]])


def test_without_an_integrator_a_file_takes_that_of_its_problem(tmp_path):
    """As in Python: dampers far faster than the step are for an L-stable method."""
    text = '[robot]\nsource = "finger"\n[horizon]\ndt = 1e-2\nsteps = 4\n[[cost]]\ntype = "control"\n'
    path = tmp_path / "stiff.toml"
    for damping, expected in ((0.0, vp.Gauss(3)), (10.0, vp.Radau(4))):
        path.write_text(f"damping = {damping}\n{text}")
        file = vp.load_scene(path, required_only=False)
        plain = vp.OptimalControlProblem(file.scene, file.problem.cost, file.q0, file.v0, dt=1e-2, steps=4)
        assert file.integrator == file.problem.integrator == plain.integrator == expected
        assert file.simulate().integrator == str(expected)
