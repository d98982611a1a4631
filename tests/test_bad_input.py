"""Every mistake is an error of its own kind that names the argument, the value it had and what is allowed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import INERTIAL, arm, joint, link, mimic, random_inertia, write_urdf
from refusals import refused

import varpin as vp


@pytest.fixture(scope="module")
def robot() -> vp.Robot:
    return vp.planar_chain(2)


@pytest.fixture(scope="module")
def scene(robot) -> vp.Scene:
    return vp.Scene(robot)


class TestFiles:
    @pytest.mark.parametrize(
        ("source", "kind", "facts"),
        [
            ("arm.urdf", vp.RobotNotFound, "arm.urdf"),
            ("{}/arm.urdf", vp.RobotNotFound, "arm.urdf"),
            ("{}/mad_up.urdf", vp.RobotNotFound, ("made_up.urdf", "{}")),
            ("{}/no/arm.urdf", vp.RobotNotFound, "urdf"),
            ("a\0b.urdf", vp.InputError, "source"),
            ("{}/pipe.urdf", vp.RobotNotFound, "pipe.urdf"),
            ("", vp.RobotNotFound, "robot_names"),
            ("qwertyuiop", vp.RobotNotFound, "robot_names"),
            ("ur55", vp.RobotNotFound, ("'ur55'", "ur5")),
            ("Panda", vp.RobotNotFound, ("'Panda'", "panda")),
            ("fingr", vp.RobotNotFound, ("'fingr'", "finger")),
            ("talos", vp.RobotError, ("'talos'", "URDF")),
            ("{}", vp.RobotError, ("{}", "folder", "made_up.urdf")),
            ("{}/empty", vp.RobotError, ("folder", "no URDF")),
            # A regular file whose every read fails, even for root.
            ("/proc/self/mem", vp.FileError, ("/proc/", "Input/output error")),
            ("a" * 5000 + ".urdf", vp.RobotNotFound, "URDF"),
            *(
                (source, vp.InputError, ("source", type(source).__name__))
                for source in (3, None, b"ur5", ["ur5"], object)
            ),
        ],
    )
    def test_source(self, tmp_path, source, kind, facts):
        arm(tmp_path)
        (tmp_path / "empty").mkdir()
        os.mkfifo(tmp_path / "pipe.urdf")
        given, facts = [source], (facts,) if isinstance(facts, str) else facts
        if isinstance(source, str):
            given = [source.format(tmp_path), *([Path(source.format(tmp_path))] if "{}" in source else [])]
        for each in given:
            with refused(kind, *(fact.format(tmp_path) for fact in facts)) as info:
                vp.load_robot(each)
            assert "{}" not in str(source) or "ur5" not in str(info.value)
            if kind is vp.RobotNotFound and "'" in facts[0]:
                assert (info.value.name, info.value.matches[0]) == (source, facts[1])

    @pytest.mark.parametrize("start", ["", "\n", "<?xml version='1.0'?>\n"])
    def test_text_for_a_path(self, tmp_path, start):
        with refused(vp.InputError, "text of a file", "path") as info:
            vp.load_robot(start + arm(tmp_path).read_text())
        assert len(str(info.value)) < 240

    @pytest.mark.parametrize(
        ("content", "facts"),
        [
            (b"hello world\n", ("XML", "line 1")),
            (b"", ("XML", "no element found")),
            (b"<!DOCTYPE html>\n<html><head><meta charset=utf8></head></html>", "XML"),
            (b"<sdf/>", ("not a URDF", "'robot' element")),
            (b"<mujoco><worldbody/></mujoco>", ("not a URDF", "'robot' element")),
            (b"<robot name='a'>\n<link name='x'>\n</robot>", ("XML", "line 3")),
            (b"<robot name='a'>\n<link name='x'/>\n", ("XML", "line 3")),
            (b"<robot name='a'>\0\0</robot>", "XML"),
            (
                b"<robot name='a'><link name='x'><inertial><mass value='${m}'/></inertial></link></robot>",
                ("xacro", "mass [${m}]"),
            ),
            (bytes(range(256)) * 20, "XML"),
            (b"\x7fELF\x02\x01\x01" + bytes(500), "XML"),
            (b"<robot><link name='x'/></robot>", "No name given for the robot"),
            (b"<robot name='a'/>", "link"),
            (b"<robot name='a'><link name='x'/></robot>", "joint"),
            (
                b"<robot name='a' xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:property name='b'/></robot>",
                "xacro",
            ),
        ],
    )
    def test_no_urdf(self, tmp_path, content, facts):
        path = tmp_path / "arm.urdf"
        path.write_bytes(content)
        with refused(vp.RobotError, facts):
            vp.load_robot(path)

    def test_one_package_dir_is_a_list_of_one(self, tmp_path):
        for folder in (tmp_path, str(tmp_path), [tmp_path]):
            assert vp.load_robot("ur5", package_dirs=folder).package_dirs[0] == str(tmp_path)


class TestLinks:
    @pytest.mark.parametrize("inertial", ["", re.sub(r'(value|i..)="[^"]*"', r'\1="0"', INERTIAL)])
    def test_massless_at_the_tip(self, tmp_path, inertial):
        path = write_urdf(tmp_path, link("a"), link("b", inertial), joint("j1", "base", "a"), joint("j2", "a", "b"))
        with refused(vp.SingularMassMatrix, "'j2'", "armature", "lock") as info:
            vp.load_robot(path)
        assert info.value.joints == ("j2",)
        assert vp.load_robot(path, lock={"j2": 0}).joint_names == ("j1",)

    def test_two_joints_that_only_move_the_same_point(self, tmp_path):
        # A point mass on two parallel axes through it: only the sum of the angles moves anything, and it nothing.
        point = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
        straight = '<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/><axis xyz="0 0 1"/>' + (
            '<limit effort="1" velocity="1"/></joint>'
        )
        path = write_urdf(
            tmp_path,
            link("a", ""),
            link("b", point),
            straight.format("j1", "base", "a"),
            straight.format("j2", "a", "b"),
        )
        with refused(vp.SingularMassMatrix, "'j1', 'j2'"):
            vp.load_robot(path)


class TestJoints:
    @pytest.mark.parametrize(
        ("changes", "facts"),
        [
            ({"axis": "0 0 0"}, ("'j1'", "axis")),
            ({"axis": "nan 0 0"}, ("axis", "[j1]")),
            ({"axis": "up"}, ("axis", "[j1]")),
            ({"kind": "hinge"}, ("[j1]", "[hinge]")),
            ({"kind": ""}, "[j1]"),
        ],
    )
    def test_description(self, tmp_path, changes, facts):
        with refused(vp.RobotError, facts) as info:
            vp.load_robot(arm(tmp_path, **changes))
        assert ".cpp" not in str(info.value)
        assert "\n" not in str(info.value)

    @pytest.mark.parametrize(
        ("old", "new", "facts"),
        [
            ('rpy="0.1 0.2 0.3"/><parent', 'rpy="0 nan 0"/><parent', ("origin", "[j1]")),
            ('<child link="l1"/>', '<child link="l9"/>', ("child", "[l9]", "[j1]")),
            ('<parent link="base"/>', '<parent link="l9"/>', ("parent", "[l9]", "[j1]")),
            ('<parent link="base"/>', '<parent link="l1"/>', ("'l1'", "loop")),
            ("</robot>", '<link name="l2"/></robot>', ("[base]", "[l2]")),
            ("</robot>", '<link name="l1"/></robot>', "'l1'"),
        ],
    )
    def test_structure(self, tmp_path, old, new, facts):
        path = arm(tmp_path)
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        with refused(vp.RobotError, "made_up.urdf", facts):
            vp.load_robot(path)

    @pytest.mark.parametrize(
        ("joints", "facts"),
        [
            (("j1 base a", "j1 a b"), "'j1'"),
            # Pinocchio loads it, with a joint that moves nothing.
            (("j1 base a", "j2 a b", "j3 base b"), ("'b'", "'j2'", "'j3'", "closed loops")),
            # Pinocchio drops them without a word.
            (("j1 base a", "j2 b c", "j3 c b"), ("'b', 'c'", "loop")),
            (("j1 base a", ("j2 a b", mimic("j1", "nan"))), ("'j2'", "multiplier", "'nan'")),
            (("j1 base a", ("j2 a b", mimic("j1", "twice"))), ("'j2'", "multiplier", "'twice'")),
            (("j1 base a", ("j2 a b", mimic("j1", 1, "inf"))), ("'j2'", "offset", "'inf'")),
            (("j1 base a", ("j2 a b", "<mimic/>")), ("'j2'", "mimic")),
            (("j1 base a", ("j2 a b", mimic("j1", "-1e200"))), "finite"),
            (("j1 base a", ("j2 a b", mimic("j2"))), ("'j2'", "itself")),
            ((("j1 base a", mimic("j2")), ("j2 a b", mimic("j1"))), ("'j1'", "itself")),
        ],
    )
    def test_tree(self, tmp_path, joints, facts):
        given = [(each, "") if isinstance(each, str) else each for each in joints]
        names = sorted({word for words, _ in given for word in words.split()[1:]} - {"base"})
        parts = [joint(*words.split(), inside=inside) for words, inside in given]
        with refused(vp.RobotError, facts):
            vp.load_robot(write_urdf(tmp_path, *map(link, names), *parts))

    def test_two_joints_of_one_name_in_memory(self):
        model = pin.Model()
        for k in range(2):
            parent = model.addJoint(k, pin.JointModelRY(), pin.SE3.Identity(), "same")
            model.appendBodyToJoint(parent, random_inertia(np.random.default_rng(k)), pin.SE3.Identity())
        with refused(vp.RobotError, "'same'"):
            vp.load_robot(model)

    def test_nothing_moves(self, tmp_path):
        with refused(vp.RobotError, "'made_up'", "joint"):
            vp.load_robot(arm(tmp_path, kind="fixed"))
        with refused(vp.RobotError, "'made_up'", "joint"):
            vp.load_robot(arm(tmp_path), lock={"j1": 0.0})
        with refused(vp.RobotError, "'model'", "joint"):
            vp.load_robot(pin.Model())

    @pytest.mark.parametrize(
        ("change", "facts"),
        [
            (lambda m: setattr(m.inertias[1], "mass", np.nan), "finite"),
            (lambda m: setattr(m.inertias[1], "lever", np.full(3, np.inf)), "finite"),
            (lambda m: m.jointPlacements.__setitem__(1, pin.SE3(2 * np.eye(3), np.zeros(3))), ("placement", "'j1'")),
            (lambda m: m.jointPlacements.__setitem__(1, pin.SE3(np.eye(3), np.full(3, np.nan))), "placement"),
            *(
                (lambda m, x=x: setattr(m, "armature", np.array([x])), ("armature", "0"))
                for x in (-1.0, np.nan, np.inf)
            ),
        ],
    )
    def test_in_memory(self, tmp_path, change, facts):
        model = pin.buildModelFromUrdf(str(arm(tmp_path)))
        change(model)
        with refused(vp.RobotError, facts):
            vp.load_robot(model)


NOT_NUMBERS = ["text", ["1", "2"], [1j, 0], np.array([1j, 0]), [[1], [1, 2]], [10**400, 0], [None, 0], {1, 2}]
STATES = [
    ([0.0, np.nan], ("[1]", "nan")),
    ([np.inf, 0.0], ("[0]", "inf")),
    ([0.0], ("(2,)", "(1,)")),
    ([0.0, 0.0, 0.0], ("(2,)", "(3,)")),
    (0.0, ("(2,)", "()")),
    ([[0.0, 0.0]], ("(2,)", "(1, 2)")),
    ("text", "real numbers"),
]
TIME_STEPS = [
    *((value, ("dt", str(value))) for value in (0, -0.01, np.nan, np.inf, True, 1j, [0.01])),
    ("0.01", ("dt", "'0.01'")),
    (np.array([0.01]), ("dt", "array([0.01])")),
    (10**400, "dt"),
]
OF_SCENES = [
    *(
        (name, value, ("'robot'", "'text'") if (name, value) == ("damping", "text") else facts)
        for name in ("damping", "stiffness", "rest")
        for value, facts in (
            ([0.0, np.nan], ("[1]", "nan")),
            (np.inf, "inf"),
            ([1, 2, 3], ("(2,)", "(3,)")),
            ([[1, 2]], ("(2,)", "(1, 2)")),
            ("text", "real numbers"),
        )
    ),
    *((name, [1.0, -0.5], (f"{name}[1]", "-0.5")) for name in ("damping", "stiffness")),
    *((name, True, "True") for name in ("damping", "friction")),
    ("gravity", [0, 0, np.nan], ("gravity[2]", "nan")),
    ("gravity", [-np.inf, 0, 0], ("gravity[0]", "-inf")),
    ("gravity", [0, 0], ("(3,)", "(2,)")),
    ("gravity", -9.81, "-9.81"),
    ("gravity", {"z": -9.81}, ()),
    *(("gravity", value, "real numbers") for value in NOT_NUMBERS),
    ("actuation", np.eye(3), ("(2, 3)", "(3, 3)")),
    ("actuation", [[1.0], [np.nan]], ("actuation[1, 0]", "nan")),
    ("actuation", [1.0, 2.0], ("2", "(2,)")),
    ("actuation", 3, ("2", "()")),
    ("actuation", ["joint1", 3], ()),
    ("actuation", [[1], [1, 2]], ()),
    ("actuation", ["joint1", "joint2", "joint1"], "'joint1'"),
    *(("robot", value, ("load_robot", type(value).__name__)) for value in ("ur5", None, pin.Model())),
]
# Options of load_robot("ur5").
OF_ROBOTS = [
    *(("package_dirs", value, ()) for value in (3, [3], [None], {"a": 1}.items())),
    *(("mimic", value, ("'tied'", "'free'")) for value in (True, "yes", None)),
    *(("lock", value, repr(value)) for value in (["elbow_joint"], "elbow_joint", 3)),
    *(("lock", {"elbow_joint": value}, ("lock['elbow_joint']", str(value))) for value in (np.nan, -np.inf, None, 1j)),
    ("lock", {"elbow_joint": "x"}, ("lock['elbow_joint']", "'x'")),
    ("lock", {"elbow_joint": [1, 2]}, ("lock['elbow_joint']", "(2,)")),
    ("lock", {"elbow_joint": []}, ("lock['elbow_joint']", "(0,)")),
    ("lock", {"elbow_joint": [[1], [1, 2]]}, ("lock['elbow_joint']", "real numbers")),
]
OF_MOTIONS = [
    *((name, value, facts) for name in ("q0", "v0") for value, facts in STATES),
    *(("dt", value, facts) for value, facts in TIME_STEPS),
    *((name, None, ("dt", "steps", "duration", "tolerance")) for name in ("dt", "steps")),
    *(("steps", value, repr(value)) for value in (-1, 5.0, 2.5, "5", True)),
    *(("steps", value, (str(value), "memory")) for value in (10**15, 10**18, 10**30)),
    *(("controls", np.zeros(shape), ("(5, 2)", "(2,)", str(shape))) for shape in ((4, 2), (6, 2), (5, 3), (3,), ())),
    ("controls", np.array([[0, 0]] * 4 + [[0, np.nan]]), ("controls[4, 1]", "nan")),
    ("controls", [0, np.inf], ("controls[1]", "inf")),
    ("controls", "text", "real numbers"),
    ("controls", lambda t: [0.0, 0.0], ("(t, q, v)", "varpin.OpenLoop(f)")),
    ("controls", lambda t, q: [0.0, 0.0], "(t, q, v)"),
    *(("integrator", value, "varpin.Midpoint()") for value in ("rk4", vp.Midpoint, 3)),
    *(("period", value, repr(value)) for value in (0, 1.5)),
]


@pytest.mark.parametrize(("name", "value", "facts"), OF_ROBOTS)
def test_options_of_robots(name, value, facts):
    with refused(vp.InputError, name, facts):
        vp.load_robot("ur5", **{name: value})


def test_joints_that_are_not_there(robot):
    with refused(vp.UnknownJoint, "'ur5'", "'elbow_joit'", "'elbow_joint'") as info:
        vp.load_robot("ur5", lock={"elbow_joit": 0.0})
    assert info.value.matches[0] == "elbow_joint"
    with refused(vp.UnknownJoint, "'3'", "shoulder_pan_joint"):
        vp.load_robot("ur5", lock={3: 0.0})
    with refused(vp.InputError, "'panda_finger_joint2'", "'panda_finger_joint1'"):
        vp.load_robot("panda", lock={"panda_finger_joint2": 0.0})
    for value in ("jont2", ["joint1", "jont2"]):
        with refused(vp.UnknownJoint, "'chain2'", "'jont2'", "'joint2'"):
            vp.Scene(robot, actuation=value)


@pytest.mark.parametrize(("name", "value", "facts"), OF_SCENES)
def test_options_of_scenes(robot, name, value, facts):
    with refused(vp.InputError, name, facts):
        vp.Scene(**{"robot": robot} | {name: value})


class TestLagrangian:
    @pytest.mark.parametrize(("value", "facts"), STATES)
    def test_states(self, scene, value, facts):
        ok = [0.0, 0.0]
        for name, call in {
            "q": lambda: vp.lagrangian_jet(scene, value, ok),
            "v": lambda: vp.lagrangian_jet(scene, ok, value),
            "q0": lambda: vp.discrete_lagrangian(scene, value, ok, 0.1),
            "q1": lambda: vp.discrete_lagrangian(scene, ok, value, 0.1),
        }.items():
            with refused(vp.InputError, name, facts):
                call()

    def test_backend(self, scene):
        with refused(vp.InputError, "backend", "'compiled'", "'pinocchio'", "'casadi'"):
            vp.lagrangian_jet(scene, [0, 0], [0, 0], backend="casadi")

    @pytest.mark.parametrize("value", [None, "ur5"])
    def test_scene(self, robot, value):
        with refused(vp.InputError, "scene", "varpin.Scene", type(value).__name__):
            vp.lagrangian_jet(value, [0, 0], [0, 0])
        with refused(vp.InputError, "scene", "varpin.Scene", "Robot"):
            vp.discrete_lagrangian(robot, [0, 0], [0, 0], 0.1)

    def test_configuration(self, robot):
        for q, shape in (([1.0], "(1,)"), (np.zeros((2, 3)), "(2, 3)"), (1.0, "()")):
            with refused(vp.InputError, "q", "(..., 2)", shape):
                robot.configuration(q)


class TestSimulation:
    @staticmethod
    def run(scene, **changes):
        arguments = {"q0": [0.1, 0.2], "v0": [0.0, 0.0], "dt": 0.01, "steps": 5} | changes
        return vp.simulate(scene, arguments.pop("q0"), arguments.pop("v0"), **arguments)

    @pytest.mark.parametrize(("name", "value", "facts"), OF_MOTIONS)
    def test_arguments(self, scene, name, value, facts):
        with refused(vp.InputError, name, facts):
            self.run(scene, **{name: value})

    @pytest.mark.parametrize("kind", ["law", "open loop"])
    @pytest.mark.parametrize(
        ("value", "facts"),
        [
            ([1.0], ("(2,)", "(1,)")),
            ([0.0, np.nan], ("[1]", "nan")),
            (None, "None"),
            (0.0, ("(2,)", "()")),
            (ZeroDivisionError("no torque"), "ZeroDivisionError('no torque')"),
        ],
    )
    def test_control_functions(self, scene, kind, value, facts):
        def swing(t):
            if t < 0.03:
                return [0.1, 0.2]
            if isinstance(value, Exception):
                raise value
            return value

        controls, source = (lambda t, q, v: swing(t)), "controls(t, q, v)"
        if kind == "open loop":
            controls, source = vp.OpenLoop(swing), "OpenLoop: f(t)"
        with refused(vp.ControlError, "step 3", "t = ", source, facts, "error.trajectory") as info:
            self.run(scene, controls=controls, integrator=vp.Midpoint())
        error = info.value
        assert (error.step, error.trajectory.steps) == (3, 3)
        assert 0.03 - 1e-12 <= error.time < 0.04
        whole = self.run(scene, steps=3, controls=[0.1, 0.2], integrator=vp.Midpoint())
        np.testing.assert_allclose(error.trajectory.q, whole.q, rtol=0, atol=1e-14)
        np.testing.assert_allclose(error.trajectory.u, whole.u, rtol=1e-14)
        if isinstance(value, Exception):
            assert error.__cause__ is value

    @pytest.mark.parametrize(
        ("function", "facts"),
        [
            (lambda t, q, v: [0.0, 0.0], ("(t, q, v)", "controls=law")),
            (lambda: [0.0, 0.0], ("OpenLoop", "time")),
            ([0.0, 0.0], ("OpenLoop", "[0.0, 0.0]")),
        ],
    )
    def test_open_loops_of_something_else(self, function, facts):
        with refused(vp.InputError, facts):
            vp.OpenLoop(function)

    @pytest.mark.parametrize("controls", [None, [0.1, 0.2], vp.OpenLoop(lambda t: [0.1, 0.2])])
    def test_a_period_is_of_a_law(self, scene, controls):
        with refused(vp.InputError, "period = 2"):
            self.run(scene, controls=controls, period=2)

    def test_an_ensemble_takes_no_law(self, scene):
        noisy = vp.Scene(scene.robot, noise=vp.AdditiveNoise(0.1))
        with refused(vp.InputError, "simulate"):
            vp.simulate_ensemble(
                noisy, [0, 0], [0, 0], dt=0.01, steps=2, paths=2, rng=0, controls=lambda t, q, v: [0.0, 0.0]
            )
        with refused(vp.ControlError, "step 1", "OpenLoop", "(2,)") as info:
            broken = vp.OpenLoop(lambda t: [0.0, 0.0] if t < 0.01 else [0.0])
            vp.simulate_ensemble(noisy, [0, 0], [0, 0], dt=0.01, steps=2, paths=2, rng=0, controls=broken)
        assert info.value.trajectory is None

    @pytest.mark.parametrize("value", [None, "ur5"])
    def test_scene(self, value):
        with refused(vp.InputError, "scene", "varpin.Scene"):
            self.run(value)

    @pytest.mark.parametrize("state", [{"q0": [1e308, 0.0]}, {"v0": [1e200, 0.0]}, {"v0": [1e160, -1e160]}])
    def test_numbers_beyond_reason_fail_and_say_where(self, scene, state):
        with refused(vp.StepFailure, "step 0", "t = 0 s", "dt") as info:
            self.run(scene, **state)
        assert info.value.trajectory.steps == 0


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        ({"links": 0}, ("links", "1", "0")),
        ({"links": 1.5}, ("links", "1.5")),
        ({"links": "2"}, ("links", "'2'")),
        ({"links": 2, "length": 0.0}, ("length", "0.0")),
        ({"links": 2, "length": "long"}, ("length", "'long'")),
        ({"links": 2, "mass": np.nan}, ("mass", "nan")),
    ],
)
def test_planar_chain(arguments, facts):
    with refused(vp.InputError, facts):
        vp.planar_chain(**arguments)


ARRAY = np.zeros(17)
FREE = {"dt": 0.01, "steps": 2}
REST = ([0.0, 0.0], [0.0, 0.0])


def the_problem(scene, **options):
    return vp.OptimalControlProblem(scene, vp.ControlCost(1.0), *REST, **FREE, **options)


def noisy(robot):
    return vp.Scene(robot, noise=vp.AdditiveNoise(0.1))


def clear(robot, **options):
    body = {"link1": ([0.0, 0.0, 0.0], [0.0, 0.0, -1.0], 0.05)}
    return vp.KeepClear(robot, **{"obstacles": [vp.Obstacle.sphere([2.0, 0.0, 0.0], 0.1)], "capsules": body} | options)


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda r, s: vp.simulate(s, *REST, **FREE, check="no"), ("check", "'no'")),
        (lambda r, s: vp.simulate(s, *REST, **FREE, check=ARRAY), "check"),
        (lambda r, s: vp.simulate_ensemble(s, *REST, **FREE, paths=2, rng=0, store="no"), ("store", "'no'")),
        (lambda r, s: vp.simulate_ensemble(s, *REST, **FREE, paths=2, rng=0, progress=3), ("progress", "3")),
        (
            lambda r, s: vp.simulate_ensemble(s, *REST, **FREE, paths=2, rng=0, progress=lambda done: None),
            ("progress", "paths done"),
        ),
        (lambda r, s: vp.solve(the_problem(s)).monte_carlo(4, 0, progress=3), ("progress", "3")),
        (lambda r, s: vp.solve(the_problem(s), check="no"), ("check", "'no'")),
        (lambda r, s: vp.solve(the_problem(s), second_order=ARRAY), "second_order"),
        (lambda r, s: vp.solve(the_problem(s), time_limit=ARRAY), "time_limit"),
        (lambda r, s: the_problem(s, t0=float("nan")), ("t0", "nan")),
        (lambda r, s: the_problem(s).at(t0=float("inf")), ("t0", "inf")),
        (
            lambda r, s: the_problem(s, constraints=[vp.WithinControlRate(1.0, before=float("nan"))]),
            ("before", "nan"),
        ),
        (lambda r, s: vp.propagate_moments(ARRAY), ("linearization", "ndarray")),
        (lambda r, s: vp.discrete_lagrangian(s, *REST, 0.0), ("dt", "0.0")),
        (lambda r, s: vp.discrete_lagrangian(s, *REST, 0.1, alpha=1.1), ("alpha", "[0, 1]", "1.1")),
        (lambda r, s: vp.Midpoint(alpha=np.nan), ("alpha", "[0, 1]", "nan")),
        (lambda r, s: vp.Midpoint(alpha=None), ("alpha", "None")),
        (lambda r, s: vp.load_robot("ur5", lock=ARRAY), "lock"),
        (
            lambda r, s: vp.work_precision(vp.Scene(r), *REST, duration=0.1, integrators=3, dts=[0.01]),
            ("integrators", "3"),
        ),
        (lambda r, s: clear(r, obstacles=3), ("obstacles", "3")),
        (lambda r, s: clear(r, links=3), ("links", "3")),
        (lambda r, s: clear(r, capsules=3), ("capsules", "3")),
        (lambda r, s: clear(r, itself="no"), ("itself", "'no'")),
        (lambda r, s: vp.LiveView(r, marks=vp.Marks(constraints=3), open=False), ("constraints", "3")),
        (lambda r, s: vp.LiveView(r, open="no"), ("open", "'no'")),
        (lambda r, s: vp.replay(r, ARRAY, open="no"), ("open", "'no'")),
        (lambda r, s: vp.replay(r, ARRAY, html="x.html", marks=vp.Marks(growing=ARRAY)), "growing"),
    ],
)
def test_what_is_no_flag_function_list_or_record(robot, call, facts):
    """Refused by name, before anything is computed or written; neither taken for True nor a failure inside."""
    with refused(vp.InputError, facts):
        call(robot, noisy(robot))


@pytest.mark.parametrize("value", [True, np.True_])
def test_what_is_a_flag(scene, value):
    assert vp.simulate(scene, *REST, **FREE, check=value).steps == 2


@pytest.mark.parametrize("content", ["", "from nose import tools\n"])
def test_another_package_of_pinocchio_s_name(tmp_path, content):
    (tmp_path / "nose").mkdir()
    (tmp_path / "nose" / "tools.py").touch()
    (tmp_path / "pinocchio.py").write_text(content)
    paths = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    run = [sys.executable, "-S", "-c", "import varpin"]
    found = subprocess.run(run, env={"PYTHONPATH": paths}, capture_output=True, text=True, check=False)
    assert found.returncode == 1
    assert "pip uninstall -y pinocchio" in found.stderr.splitlines()[-1]
