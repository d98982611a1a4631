"""Every mistake is an error of its own kind that names the argument, the value it had and what is allowed."""

from __future__ import annotations

import os
import re
import subprocess
import sys

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
    def test_missing(self, tmp_path):
        for source in (str(tmp_path / "arm.urdf"), tmp_path / "arm.urdf", "arm.urdf"):
            with refused(vp.RobotNotFound, "arm.urdf"):
                vp.load_robot(source)

    @pytest.mark.parametrize(("name", "match"), [("ur55", "ur5"), ("Panda", "panda"), ("fingr", "finger")])
    def test_unknown_name_lists_close_ones(self, name, match):
        with refused(vp.RobotNotFound, f"'{name}'", match) as info:
            vp.load_robot(name)
        assert (info.value.name, info.value.matches[0]) == (name, match)

    @pytest.mark.parametrize("name", ["", "qwertyuiop"])
    def test_a_name_like_no_other_tells_where_names_are(self, name):
        with refused(vp.RobotNotFound, "robot_names"):
            vp.load_robot(name)

    def test_a_path_that_is_not_there_tells_of_its_folder_alone(self, tmp_path):
        arm(tmp_path)
        with refused(vp.RobotNotFound, "made_up.urdf", str(tmp_path)) as info:
            vp.load_robot(tmp_path / "mad_up.urdf")
        assert "ur5" not in str(info.value)
        for path in (tmp_path / "no" / "arm.urdf", "a\0b.urdf"):
            with refused(vp.RobotNotFound, "urdf"):
                vp.load_robot(path)

    @pytest.mark.parametrize("start", ["", "\n", "<?xml version='1.0'?>\n"])
    def test_text_for_a_path(self, tmp_path, start):
        with refused(vp.InputError, "text of a file", "path") as info:
            vp.load_robot(start + arm(tmp_path).read_text())
        assert len(str(info.value)) < 240

    def test_robots_on_a_free_flyer(self):
        with refused(vp.RobotError, "'talos'", "URDF"):
            vp.load_robot("talos")

    def test_folder(self, tmp_path):
        for source in (tmp_path, str(tmp_path)):
            with refused(vp.RobotError, str(tmp_path), "folder", "no URDF"):
                vp.load_robot(source)
        arm(tmp_path)
        with refused(vp.RobotError, "folder", "made_up.urdf"):
            vp.load_robot(tmp_path)

    def test_unreadable(self):
        # A regular file whose every read fails, even for root.
        with refused(vp.FileError, "/proc/", "Input/output error"):
            vp.load_robot("/proc/self/mem")

    def test_pipe(self, tmp_path):
        os.mkfifo(tmp_path / "pipe.urdf")
        with refused(vp.RobotNotFound, "pipe.urdf"):
            vp.load_robot(tmp_path / "pipe.urdf")

    def test_name_too_long(self):
        with refused(vp.FileError, "File name too long"):
            vp.load_robot("a" * 5000 + ".urdf")

    @pytest.mark.parametrize("source", [3, None, b"ur5", ["ur5"], 1.5, object])
    def test_source_of_a_wrong_type(self, source):
        with refused(vp.InputError, "source", type(source).__name__):
            vp.load_robot(source)

    @pytest.mark.parametrize(
        ("content", "facts"),
        [
            (b"hello world\n", ("XML", "line 1")),
            (b"", "empty"),
            (b"<!DOCTYPE html>\n<html><head><meta charset=utf8></head></html>", "web page"),
            (b"\n <html><body></html>", "web page"),
            (b"<sdf/>", ("<sdf>", "<robot>")),
            (b"<mujoco><worldbody/></mujoco>", ("<mujoco>", "<robot>")),
            (b"<robot name='a'>\n<link name='x'>\n</robot>", ("XML", "line 3")),
            (b"<robot name='a'>\n<link name='x'/>\n", ("XML", "line 3")),
            (b"<robot name='a'>\0\0</robot>", "XML"),
            (bytes(range(256)) * 20, "XML"),
            (b"\x7fELF\x02\x01\x01" + bytes(500), "XML"),
            (b"<robot><link name='x'/></robot>", ("<robot>", "name")),
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

    @pytest.mark.parametrize("package_dirs", [3, [3], [None], {"a": 1}.items()])
    def test_package_dirs(self, package_dirs):
        with refused(vp.InputError, "package_dirs"):
            vp.load_robot("ur5", package_dirs=package_dirs)

    def test_one_package_dir_is_a_list_of_one(self, tmp_path):
        for folder in (tmp_path, str(tmp_path), [tmp_path]):
            assert vp.load_robot("ur5", package_dirs=folder).package_dirs[0] == str(tmp_path)

    @pytest.mark.parametrize("value", [True, "yes", None])
    def test_mimic(self, value):
        with refused(vp.InputError, "mimic", "'tied'", "'free'"):
            vp.load_robot("ur5", mimic=value)


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

    @pytest.mark.parametrize(
        ("change", "facts"),
        [
            ({"mass": np.nan}, ("'j1'", "finite")),
            ({"lever": np.full(3, np.inf)}, ("'j1'", "finite")),
        ],
    )
    def test_of_a_model_in_memory(self, tmp_path, change, facts):
        model = pin.buildModelFromUrdf(str(arm(tmp_path)))
        body = model.inertias[1]
        for name, value in change.items():
            setattr(body, name, value)
        model.inertias[1] = body
        with refused(vp.RobotError, facts):
            vp.load_robot(model)


class TestJoints:
    @pytest.mark.parametrize(
        ("changes", "facts"),
        [
            ({"axis": "0 0 0"}, ("'j1'", "axis")),
            ({"axis": "nan 0 0"}, ("axis", "'j1'")),
            ({"axis": "up"}, ("axis", "'j1'")),
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
            ('rpy="0.1 0.2 0.3"/><parent', 'rpy="0 nan 0"/><parent', ("origin", "'j1'")),
            ('<child link="l1"/>', '<child link="l9"/>', ("child", "'l9'", "'j1'")),
            ('<parent link="base"/>', '<parent link="l9"/>', ("parent", "'l9'", "'j1'")),
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

    def test_two_joints_of_one_name(self, tmp_path):
        with refused(vp.RobotError, "'j1'"):
            vp.load_robot(write_urdf(tmp_path, link("a"), link("b"), joint("j1", "base", "a"), joint("j1", "a", "b")))
        model = pin.Model()
        for k in range(2):
            parent = model.addJoint(k, pin.JointModelRY(), pin.SE3.Identity(), "same")
            model.appendBodyToJoint(parent, random_inertia(np.random.default_rng(k)), pin.SE3.Identity())
        with refused(vp.RobotError, "'same'"):
            vp.load_robot(model)

    def test_closed_loop(self, tmp_path):
        # Pinocchio loads it, with a joint that moves nothing.
        path = write_urdf(
            tmp_path, link("a"), link("b"), joint("j1", "base", "a"), joint("j2", "a", "b"), joint("j3", "base", "b")
        )
        with refused(vp.RobotError, "'b'", "'j2'", "'j3'", "closed loops"):
            vp.load_robot(path)

    def test_links_in_a_circle(self, tmp_path):
        # Pinocchio drops them without a word.
        path = write_urdf(
            tmp_path,
            *(link(name) for name in "abc"),
            joint("j1", "base", "a"),
            joint("j2", "b", "c"),
            joint("j3", "c", "b"),
        )
        with refused(vp.RobotError, "'b', 'c'", "loop"):
            vp.load_robot(path)

    def test_nothing_moves(self, tmp_path):
        with refused(vp.RobotError, "'made_up'", "joint"):
            vp.load_robot(arm(tmp_path, kind="fixed"))
        with refused(vp.RobotError, "'made_up'", "joint"):
            vp.load_robot(arm(tmp_path), lock={"j1": 0.0})
        with refused(vp.RobotError, "'model'", "joint"):
            vp.load_robot(pin.Model())

    @pytest.mark.parametrize(
        ("tie", "facts"),
        [
            (mimic("j1", "nan"), ("multiplier", "'nan'")),
            (mimic("j1", "twice"), ("multiplier", "'twice'")),
            (mimic("j1", 1, "inf"), ("offset", "'inf'")),
            ("<mimic/>", "mimic"),
            (mimic("j1", "1e308"), ("'j1'", "1e+308", "offset")),
            (mimic("j1", "-1e200"), ("'j1'", "-1e+200")),
            (mimic("j2"), "itself"),
        ],
    )
    def test_mimic(self, tmp_path, tie, facts):
        path = write_urdf(tmp_path, link("a"), link("b"), joint("j1", "base", "a"), joint("j2", "a", "b", inside=tie))
        with refused(vp.RobotError, "'j2'", facts):
            vp.load_robot(path)

    def test_mimics_in_a_loop(self, tmp_path):
        path = write_urdf(
            tmp_path,
            link("a"),
            link("b"),
            joint("j1", "base", "a", inside=mimic("j2")),
            joint("j2", "a", "b", inside=mimic("j1")),
        )
        with refused(vp.RobotError, "'j1'", "itself"):
            vp.load_robot(path)

    @pytest.mark.parametrize("placement", [pin.SE3(2 * np.eye(3), np.zeros(3)), pin.SE3(np.eye(3), np.full(3, np.nan))])
    def test_placement_of_a_model_in_memory(self, tmp_path, placement):
        model = pin.buildModelFromUrdf(str(arm(tmp_path)))
        model.jointPlacements[1] = placement
        with refused(vp.RobotError, "placement", "'j1'"):
            vp.load_robot(model)

    @pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
    def test_armature_of_a_model_in_memory(self, tmp_path, value):
        model = pin.buildModelFromUrdf(str(arm(tmp_path)))
        model.armature = np.array([value])
        with refused(vp.RobotError, "armature", "0"):
            vp.load_robot(model)


class TestLock:
    def test_unknown_joint(self):
        with refused(vp.UnknownJoint, "'ur5'", "'elbow_joit'", "'elbow_joint'") as info:
            vp.load_robot("ur5", lock={"elbow_joit": 0.0})
        assert info.value.matches[0] == "elbow_joint"
        with refused(vp.UnknownJoint, "'3'", "shoulder_pan_joint"):
            vp.load_robot("ur5", lock={3: 0.0})

    def test_follower(self):
        with refused(vp.InputError, "'panda_finger_joint2'", "'panda_finger_joint1'"):
            vp.load_robot("panda", lock={"panda_finger_joint2": 0.0})

    @pytest.mark.parametrize(
        ("value", "facts"),
        [
            (np.nan, "nan"),
            (-np.inf, "-inf"),
            ("x", "'x'"),
            (None, "None"),
            (1j, "1j"),
            ([1, 2], "(2,)"),
            ([], "(0,)"),
            ([[1], [1, 2]], "real numbers"),
        ],
    )
    def test_position(self, value, facts):
        with refused(vp.InputError, "lock['elbow_joint']", facts):
            vp.load_robot("ur5", lock={"elbow_joint": value})

    @pytest.mark.parametrize("lock", [["elbow_joint"], "elbow_joint", 3])
    def test_no_mapping(self, lock):
        with refused(vp.InputError, "lock", repr(lock)):
            vp.load_robot("ur5", lock=lock)


NOT_NUMBERS = ["text", ["1", "2"], [1j, 0], np.array([1j, 0]), [[1], [1, 2]], [10**400, 0], [None, 0], {1, 2}]


class TestScene:
    @pytest.mark.parametrize("name", ["damping", "stiffness", "rest"])
    @pytest.mark.parametrize(
        ("value", "facts"),
        [
            ([0.0, np.nan], ("[1]", "nan")),
            (np.inf, "inf"),
            ([1, 2, 3], ("(2,)", "(3,)")),
            ([[1, 2]], ("(2,)", "(1, 2)")),
            ("text", "real numbers"),
        ],
    )
    def test_joint_properties(self, robot, name, value, facts):
        if name == "damping" and isinstance(value, str):
            facts = ("'robot'", "'text'")
        with refused(vp.InputError, name, facts):
            vp.Scene(robot, **{name: value})

    @pytest.mark.parametrize("name", ["damping", "stiffness"])
    def test_negative(self, robot, name):
        with refused(vp.InputError, f"{name}[1]", "-0.5"):
            vp.Scene(robot, **{name: [1.0, -0.5]})

    @pytest.mark.parametrize(
        ("value", "facts"),
        [
            ([0, 0, np.nan], ("gravity[2]", "nan")),
            ([-np.inf, 0, 0], ("gravity[0]", "-inf")),
            ([0, 0], ("gravity", "(3,)", "(2,)")),
            (-9.81, ("gravity", "-9.81")),
            ({"z": -9.81}, "gravity"),
            *((value, ("gravity", "real numbers")) for value in NOT_NUMBERS),
        ],
    )
    def test_gravity(self, robot, value, facts):
        with refused(vp.InputError, facts):
            vp.Scene(robot, gravity=value)

    @pytest.mark.parametrize(
        ("value", "facts"),
        [
            (np.eye(3), ("actuation", "(2, 3)", "(3, 3)")),
            ([[1.0], [np.nan]], ("actuation[1, 0]", "nan")),
            ([1.0, 2.0], ("actuation", "2", "(2,)")),
            (3, ("actuation", "2", "()")),
            (["joint1", 3], "actuation"),
            ([[1], [1, 2]], "actuation"),
            (["joint1", "joint2", "joint1"], ("actuation", "'joint1'")),
        ],
    )
    def test_actuation(self, robot, value, facts):
        with refused(vp.InputError, facts):
            vp.Scene(robot, actuation=value)

    @pytest.mark.parametrize("value", ["jont2", ["joint1", "jont2"]])
    def test_actuation_of_an_unknown_joint(self, robot, value):
        with refused(vp.UnknownJoint, "'chain2'", "'jont2'", "'joint2'"):
            vp.Scene(robot, actuation=value)

    @pytest.mark.parametrize("value", ["ur5", None, pin.Model()])
    def test_robot(self, value):
        with refused(vp.InputError, "robot", "load_robot", type(value).__name__):
            vp.Scene(value)


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
    (0, ("dt", "0")),
    (-0.01, ("dt", "-0.01")),
    (np.nan, ("dt", "nan")),
    (np.inf, ("dt", "inf")),
    ("0.01", ("dt", "'0.01'")),
    (None, ("dt", "None")),
    (True, ("dt", "True")),
    (1j, ("dt", "1j")),
    ([0.01], ("dt", "[0.01]")),
    (np.array([0.01]), ("dt", "array([0.01])")),
    (10**400, "dt"),
]

ALPHAS = [
    (-0.1, ("alpha", "[0, 1]", "-0.1")),
    (1.1, ("alpha", "[0, 1]", "1.1")),
    (np.nan, ("alpha", "[0, 1]", "nan")),
    ("half", ("alpha", "'half'")),
    (None, ("alpha", "None")),
]


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

    @pytest.mark.parametrize(("value", "facts"), TIME_STEPS)
    def test_time_step(self, scene, value, facts):
        with refused(vp.InputError, facts):
            vp.discrete_lagrangian(scene, [0, 0], [0, 0], value)

    @pytest.mark.parametrize(("value", "facts"), ALPHAS)
    def test_alpha(self, scene, value, facts):
        with refused(vp.InputError, facts):
            vp.discrete_lagrangian(scene, [0, 0], [0, 0], 0.1, alpha=value)
        with refused(vp.InputError, facts):
            vp.Midpoint(alpha=value)

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

    @pytest.mark.parametrize("name", ["q0", "v0"])
    @pytest.mark.parametrize(("value", "facts"), STATES)
    def test_states(self, scene, name, value, facts):
        with refused(vp.InputError, name, facts):
            self.run(scene, **{name: value})

    @pytest.mark.parametrize(
        ("value", "facts"),
        [
            *(case for case in TIME_STEPS if case[0] is not None),
            (None, ("dt", "steps", "duration", "tolerance")),
        ],
    )
    def test_time_step(self, scene, value, facts):
        with refused(vp.InputError, facts):
            self.run(scene, dt=value)

    @pytest.mark.parametrize(
        ("value", "facts"),
        [
            (-1, ("steps", "0", "-1")),
            (5.0, ("steps", "5.0")),
            (2.5, ("steps", "2.5")),
            ("5", ("steps", "'5'")),
            (None, ("dt", "steps", "duration", "tolerance")),
            (True, ("steps", "True")),
        ],
    )
    def test_steps(self, scene, value, facts):
        with refused(vp.InputError, facts):
            self.run(scene, steps=value)

    @pytest.mark.parametrize("steps", [10**15, 10**18, 10**30])
    def test_more_steps_than_memory(self, scene, steps):
        with refused(vp.InputError, "steps", str(steps), "memory"):
            self.run(scene, steps=steps)

    @pytest.mark.parametrize(
        ("value", "facts"),
        [
            (np.zeros((4, 2)), ("controls", "(5, 2)", "(2,)", "(4, 2)")),
            (np.zeros((6, 2)), ("controls", "(5, 2)", "(2,)", "(6, 2)")),
            (np.zeros((5, 3)), ("controls", "(5, 2)", "(2,)", "(5, 3)")),
            (np.zeros(3), "(3,)"),
            (0.0, "()"),
            (np.array([[0, 0]] * 4 + [[0, np.nan]]), ("controls[4, 1]", "nan")),
            ([0, np.inf], ("controls[1]", "inf")),
            ("text", ("controls", "real numbers")),
        ],
    )
    def test_controls(self, scene, value, facts):
        with refused(vp.InputError, facts):
            self.run(scene, controls=value)

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

    def test_a_control_function_of_wrong_arguments(self, scene):
        with refused(vp.InputError, "(t, q, v)", "varpin.OpenLoop(f)"):
            self.run(scene, controls=lambda t: [0.0, 0.0])
        with refused(vp.InputError, "(t, q, v)"):
            self.run(scene, controls=lambda t, q: [0.0, 0.0])

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

    @pytest.mark.parametrize(("period", "facts"), [(0, ("1", "0")), (1.5, "1.5")])
    def test_period(self, scene, period, facts):
        with refused(vp.InputError, "period", facts):
            self.run(scene, controls=lambda t, q, v: [0.0, 0.0], period=period)

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

    def test_a_control_function_cannot_reach_into_the_state(self, scene):
        def law(t, q, v):
            q[:], v[:] = 99.0, 99.0
            return [0.0, 0.0]

        meddled = self.run(scene, controls=law)
        assert np.array_equal(meddled.q, self.run(scene, controls=lambda t, q, v: [0.0, 0.0]).q)

    def test_keyboard_interrupt_in_a_control_function_is_no_control_error(self, scene):
        def law(t, q, v):
            if t > 0.015:
                raise KeyboardInterrupt
            return [0.0, 0.0]

        with pytest.raises(vp.Interrupted) as info:
            self.run(scene, controls=law)
        assert info.value.trajectory.steps == 2

    @pytest.mark.parametrize("value", ["rk4", vp.Midpoint, 3])
    def test_integrator(self, scene, value):
        with refused(vp.InputError, "integrator", "varpin.Midpoint()"):
            self.run(scene, integrator=value)

    @pytest.mark.parametrize("name", ["damping", "friction"])
    def test_true_is_no_number(self, name):
        with refused(vp.InputError, name, "True"):
            vp.Scene(vp.planar_chain(2), **{name: True})

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
        (lambda r, s: vp.load_robot("ur5", lock=ARRAY), "lock"),
        (lambda r, s: vp.Scene(r, constraints=[vp.KinematicInput(ARRAY)]), "KinematicInput"),
        (
            lambda r, s: vp.work_precision(vp.Scene(r), *REST, duration=0.1, integrators=3, dts=[0.01]),
            ("integrators", "3"),
        ),
        (lambda r, s: clear(r, obstacles=3), ("obstacles", "3")),
        (lambda r, s: clear(r, links=3), ("links", "3")),
        (lambda r, s: clear(r, links="link1"), ("links", "'link1'")),
        (lambda r, s: clear(r, capsules=3), ("capsules", "3")),
        (lambda r, s: clear(r, itself="no"), ("itself", "'no'")),
        (lambda r, s: vp.LiveView(r, marks=vp.Marks(constraints=3), open=False), ("constraints", "3")),
        (lambda r, s: vp.LiveView(r, open="no"), ("open", "'no'")),
        (lambda r, s: vp.replay(r, ARRAY, html="x.html", loop="no"), ("loop", "'no'")),
        (lambda r, s: vp.replay(r, ARRAY, html="x.html", marks=vp.Marks(growing=ARRAY)), "growing"),
        (lambda r, s: vp.plots.plot_energy_error(vp.simulate(s, *REST, **FREE), relative="no"), ("relative", "'no'")),
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
