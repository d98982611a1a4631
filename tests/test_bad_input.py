"""Every mistake has one clear message, and is a VarpinError. What the messages say is part of the library."""

from __future__ import annotations

import contextlib
import os
import re

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import INERTIAL, arm, joint, link, mimic, random_inertia, write_urdf

import varpin as vp


@contextlib.contextmanager
def refused(kind: type[vp.VarpinError], *words: str):
    """The error is of exactly this kind, and its message holds all ``words`` in order, literally."""
    assert issubclass(kind, vp.VarpinError)
    with pytest.raises(kind, match="(?s)" + ".*".join(map(re.escape, words))) as info:
        yield info
    assert type(info.value) is kind


@pytest.fixture(scope="module")
def robot() -> vp.Robot:
    return vp.planar_chain(2)


@pytest.fixture(scope="module")
def scene(robot) -> vp.Scene:
    return vp.Scene(robot)


class TestFiles:
    def test_missing(self, tmp_path):
        for source in (str(tmp_path / "arm.urdf"), tmp_path / "arm.urdf", "arm.urdf"):
            with refused(vp.RobotNotFound, "no robot or URDF file", "arm.urdf'", "looked in"):
                vp.load_robot(source)

    @pytest.mark.parametrize(("name", "match"), [("ur55", "ur5"), ("Panda", "panda"), ("fingr", "finger")])
    def test_unknown_name_lists_close_ones(self, name, match):
        with refused(vp.RobotNotFound, f"no robot or URDF file '{name}'; close matches: ", match) as info:
            vp.load_robot(name)
        assert (info.value.name, info.value.matches[0]) == (name, match)

    @pytest.mark.parametrize("name", ["", "qwertyuiop", "a\0b.urdf"])
    def test_a_name_like_no_other_lists_all(self, name):
        with refused(vp.RobotNotFound, "known names: ", "finger", "ur5", "z1"):
            vp.load_robot(name)

    def test_robots_on_a_free_flyer(self):
        with refused(vp.RobotError, "'talos' has a free-flyer base", "load its URDF file by path"):
            vp.load_robot("talos")

    def test_folder(self, tmp_path):
        for source in (tmp_path, str(tmp_path)):
            with refused(vp.RobotError, f"{tmp_path} is a folder", "it contains no URDF file"):
                vp.load_robot(source)
        arm(tmp_path)
        with refused(vp.RobotError, "is a folder", "it contains made_up.urdf"):
            vp.load_robot(tmp_path)

    def test_unreadable(self):
        # A regular file whose every read fails, even for root.
        with refused(vp.FileError, "cannot read /proc/", "mem: Input/output error"):
            vp.load_robot("/proc/self/mem")

    def test_pipe(self, tmp_path):
        os.mkfifo(tmp_path / "pipe.urdf")
        with refused(vp.RobotNotFound, "no robot or URDF file"):
            vp.load_robot(tmp_path / "pipe.urdf")

    def test_name_too_long(self):
        with refused(vp.FileError, "cannot read the URDF file: File name too long"):
            vp.load_robot("a" * 5000 + ".urdf")

    @pytest.mark.parametrize("source", [3, None, b"ur5", ["ur5"], 1.5, object])
    def test_source_of_a_wrong_type(self, source):
        with refused(vp.InputError, "source must be a URDF path, a robot's name", f"got {type(source).__name__}"):
            vp.load_robot(source)

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            (b"hello world\n", "is not a URDF: it is not well-formed XML: syntax error: line 1"),
            (b"", "is not a URDF: it is empty"),
            (b"<!DOCTYPE html>\n<html><head><meta charset=utf8></head></html>", "is a web page, not a URDF"),
            (b"\n <html><body></html>", "is a web page, not a URDF"),
            (b"<sdf/>", "is not a URDF: its root element is <sdf>, not <robot>"),
            (b"<mujoco><worldbody/></mujoco>", "its root element is <mujoco>, not <robot>"),
            (b"<robot name='a'>\n<link name='x'>\n</robot>", "not well-formed XML: mismatched tag: line 3"),
            (b"<robot name='a'>\n<link name='x'/>\n", "not well-formed XML: no element found: line 3"),
            (b"<robot name='a'>\0\0</robot>", "not well-formed XML"),
            (bytes(range(256)) * 20, "not well-formed XML"),
            (b"\x7fELF\x02\x01\x01" + bytes(500), "not well-formed XML"),
            (b"<robot><link name='x'/></robot>", "its <robot> has no name"),
            (b"<robot name='a'/>", "describes no link"),
            (b"<robot name='a'><link name='x'/></robot>", "has no joint that moves"),
            (
                b"<robot name='a' xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:property name='b'/></robot>",
                "is a xacro file: expand it first",
            ),
        ],
    )
    def test_no_urdf(self, tmp_path, content, words):
        path = tmp_path / "arm.urdf"
        path.write_bytes(content)
        with refused(vp.RobotError, words):
            vp.load_robot(path)

    @pytest.mark.parametrize("package_dirs", [3, [3], [None], {"a": 1}.items()])
    def test_package_dirs(self, package_dirs):
        with refused(vp.InputError, "package_dirs must be a list of folders, got"):
            vp.load_robot("ur5", package_dirs=package_dirs)

    def test_one_package_dir_is_a_list_of_one(self, tmp_path):
        for folder in (tmp_path, str(tmp_path), [tmp_path]):
            assert vp.load_robot("ur5", package_dirs=folder).package_dirs[0] == str(tmp_path)

    @pytest.mark.parametrize("value", [True, "yes", None])
    def test_mimic(self, value):
        with refused(vp.InputError, "mimic must be 'tied' or 'free', got"):
            vp.load_robot("ur5", mimic=value)


class TestLinks:
    @pytest.mark.parametrize("inertial", ["", re.sub(r'(value|i..)="[^"]*"', r'\1="0"', INERTIAL)])
    def test_massless_at_the_tip(self, tmp_path, inertial):
        path = write_urdf(tmp_path, link("a"), link("b", inertial), joint("j1", "base", "a"), joint("j2", "a", "b"))
        with refused(vp.SingularMassMatrix, "motion of 'j2' carries no inertia", "add armature", "lock it") as info:
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
        with refused(vp.SingularMassMatrix, "motion of 'j1', 'j2' carries no inertia"):
            vp.load_robot(path)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"mass": np.nan}, "the link moved by joint 'j1' has a mass or inertia that is not finite"),
            ({"lever": np.full(3, np.inf)}, "the link moved by joint 'j1' has a mass or inertia that is not finite"),
        ],
    )
    def test_of_a_model_in_memory(self, tmp_path, change, words):
        model = pin.buildModelFromUrdf(str(arm(tmp_path)))
        body = model.inertias[1]
        for name, value in change.items():
            setattr(body, name, value)
        model.inertias[1] = body
        with refused(vp.RobotError, words):
            vp.load_robot(model)


class TestJoints:
    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"axis": "0 0 0"}, ["joint 'j1' has no axis"]),
            ({"axis": "nan 0 0"}, ["not a URDF that Pinocchio can read", "Malformed axis element for joint [j1]"]),
            ({"axis": "up"}, ["Malformed axis element for joint [j1]"]),
            ({"kind": "hinge"}, ["Joint [j1] has no known type [hinge]"]),
            ({"kind": ""}, ["Joint [j1] has no known type []"]),
        ],
    )
    def test_description(self, tmp_path, changes, words):
        with refused(vp.RobotError, *words) as info:
            vp.load_robot(arm(tmp_path, **changes))
        assert ".cpp" not in str(info.value)
        assert "\n" not in str(info.value)

    @pytest.mark.parametrize(
        ("old", "new", "words"),
        [
            ('<limit effort="9" velocity="8" lower="-1" upper="1"/>', "", "it does not specify limits"),
            ('rpy="0.1 0.2 0.3"/><parent', 'rpy="0 nan 0"/><parent', "Malformed parent origin element for joint [j1]"),
            ('<child link="l1"/>', '<child link="l9"/>', "child link [l9] of joint [j1] not found"),
            ('<parent link="base"/>', '<parent link="l9"/>', "parent link [l9] of joint [j1] not found"),
            ('<parent link="base"/>', '<parent link="l1"/>', "links 'l1' form a loop without a root"),
            ("</robot>", '<link name="l2"/></robot>', "Two root links found: [base] and [l2]"),
            ("</robot>", '<link name="l1"/></robot>', "link 'l1' is not unique"),
        ],
    )
    def test_structure(self, tmp_path, old, new, words):
        path = arm(tmp_path)
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        with refused(vp.RobotError, "made_up.urdf", words):
            vp.load_robot(path)

    def test_two_joints_of_one_name(self, tmp_path):
        with refused(vp.RobotError, "joint 'j1' is not unique"):
            vp.load_robot(write_urdf(tmp_path, link("a"), link("b"), joint("j1", "base", "a"), joint("j1", "a", "b")))
        model = pin.Model()
        for k in range(2):
            parent = model.addJoint(k, pin.JointModelRY(), pin.SE3.Identity(), "same")
            model.appendBodyToJoint(parent, random_inertia(np.random.default_rng(k)), pin.SE3.Identity())
        with refused(vp.RobotError, "has several joints named 'same'"):
            vp.load_robot(model)

    def test_closed_loop(self, tmp_path):
        # Pinocchio loads it, with a joint that moves nothing.
        path = write_urdf(
            tmp_path, link("a"), link("b"), joint("j1", "base", "a"), joint("j2", "a", "b"), joint("j3", "base", "b")
        )
        with refused(vp.RobotError, "link 'b' is the child of joints 'j2' and 'j3'", "no closed loops"):
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
        with refused(vp.RobotError, "links 'c', 'b' form a loop without a root"):
            vp.load_robot(path)

    def test_nothing_moves(self, tmp_path):
        with refused(vp.RobotError, "robot 'made_up' has no joint that moves"):
            vp.load_robot(arm(tmp_path, kind="fixed"))
        with refused(vp.RobotError, "robot 'made_up' has no joint that moves"):
            vp.load_robot(arm(tmp_path), lock={"j1": 0.0})
        with refused(vp.RobotError, "robot 'model' has no joint that moves"):
            vp.load_robot(pin.Model())

    @pytest.mark.parametrize(
        ("tie", "words"),
        [
            (mimic("j1", "nan"), "its mimic multiplier is 'nan', where a finite number belongs"),
            (mimic("j1", "twice"), "its mimic multiplier is 'twice', where a finite number belongs"),
            (mimic("j1", 1, "inf"), "its mimic offset is 'inf', where a finite number belongs"),
            ("<mimic/>", "its mimic element names no joint"),
            (mimic("j1", "1e308"), "mimics 'j1' with multiplier 1e+308 and offset 0: the offset and the square"),
            (mimic("j1", "-1e200"), "mimics 'j1' with multiplier -1e+200 and offset 0"),
            (mimic("j2"), "joint 'j2' mimics itself through a loop of mimic joints"),
        ],
    )
    def test_mimic(self, tmp_path, tie, words):
        path = write_urdf(tmp_path, link("a"), link("b"), joint("j1", "base", "a"), joint("j2", "a", "b", inside=tie))
        with refused(vp.RobotError, "joint 'j2'", words.removeprefix("joint 'j2' ")):
            vp.load_robot(path)

    def test_mimics_in_a_loop(self, tmp_path):
        path = write_urdf(
            tmp_path,
            link("a"),
            link("b"),
            joint("j1", "base", "a", inside=mimic("j2")),
            joint("j2", "a", "b", inside=mimic("j1")),
        )
        with refused(vp.RobotError, "joint 'j1' mimics itself through a loop of mimic joints"):
            vp.load_robot(path)

    @pytest.mark.parametrize("placement", [pin.SE3(2 * np.eye(3), np.zeros(3)), pin.SE3(np.eye(3), np.full(3, np.nan))])
    def test_placement_of_a_model_in_memory(self, tmp_path, placement):
        model = pin.buildModelFromUrdf(str(arm(tmp_path)))
        model.jointPlacements[1] = placement
        with refused(vp.RobotError, "the placement of joint 'j1' must be a finite rotation and translation"):
            vp.load_robot(model)

    @pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
    def test_armature_of_a_model_in_memory(self, tmp_path, value):
        model = pin.buildModelFromUrdf(str(arm(tmp_path)))
        model.armature = np.array([value])
        with refused(vp.RobotError, "armature must be finite and >= 0, got"):
            vp.load_robot(model)


class TestLock:
    def test_unknown_joint(self):
        with refused(vp.UnknownJoint, "lock of robot 'ur5'", "'elbow_joit'", "did you mean 'elbow_joint'") as info:
            vp.load_robot("ur5", lock={"elbow_joit": 0.0})
        assert info.value.matches[0] == "elbow_joint"
        with refused(vp.UnknownJoint, "the robot has no joint '3'", "joints: shoulder_pan_joint"):
            vp.load_robot("ur5", lock={3: 0.0})

    def test_follower(self):
        with refused(vp.InputError, "mimics 'panda_finger_joint1'; locking 'panda_finger_joint1'"):
            vp.load_robot("panda", lock={"panda_finger_joint2": 0.0})

    @pytest.mark.parametrize(
        ("value", "words"),
        [
            (np.nan, "is nan; it must be finite"),
            (-np.inf, "is -inf; it must be finite"),
            ("x", "must be an array of real numbers, got 'x'"),
            (None, "must be an array of real numbers, got None"),
            (1j, "must be an array of real numbers, got 1j"),
            ([1, 2], "must have 1 value(s), got shape (2,)"),
            ([], "must have 1 value(s), got shape (0,)"),
            ([[1], [1, 2]], "must be an array of real numbers"),
        ],
    )
    def test_position(self, value, words):
        with refused(vp.InputError, "lock['elbow_joint']", words):
            vp.load_robot("ur5", lock={"elbow_joint": value})

    @pytest.mark.parametrize("lock", [["elbow_joint"], "elbow_joint", 3])
    def test_no_mapping(self, lock):
        with refused(vp.InputError, "lock must map joint names to positions", "got"):
            vp.load_robot("ur5", lock=lock)


NOT_NUMBERS = [
    ("text", "must be an array of real numbers, got 'text'"),
    (["1", "2"], "must be an array of real numbers, got"),
    ([1j, 0], "must be an array of real numbers, got"),
    (np.array([1j, 0]), "must be an array of real numbers, got"),
    ([[1], [1, 2]], "must be an array of real numbers: "),
    ([10**400, 0], "must be an array of real numbers: "),
    ([None, 0], "must be an array of real numbers, got"),
    ({1, 2}, "must be an array of real numbers, got"),
]


class TestScene:
    @pytest.mark.parametrize("name", ["damping", "stiffness", "rest"])
    @pytest.mark.parametrize(
        ("value", "words"),
        [
            ([0.0, np.nan], "[1] is nan; it must be finite"),
            (np.inf, " is inf; it must be finite"),
            ([1, 2, 3], " must be one number or have shape (2,), got (3,)"),
            ([[1, 2]], " must be one number or have shape (2,), got (1, 2)"),
            *((value, " " + words) for value, words in NOT_NUMBERS),
        ],
    )
    def test_joint_properties(self, robot, name, value, words):
        if name == "damping" and isinstance(value, str):
            words = " must be numbers, or 'robot' for those of the robot's description, got 'text'"
        with refused(vp.InputError, name + words):
            vp.Scene(robot, **{name: value})

    @pytest.mark.parametrize("name", ["damping", "stiffness"])
    def test_negative(self, robot, name):
        with refused(vp.InputError, f"{name}[1] is -0.5; it must be >= 0"):
            vp.Scene(robot, **{name: [1.0, -0.5]})

    @pytest.mark.parametrize(
        ("value", "words"),
        [
            ([0, 0, np.nan], "gravity[2] is nan; it must be finite"),
            ([-np.inf, 0, 0], "gravity[0] is -inf; it must be finite"),
            ([0, 0], "gravity must have shape (3,), got (2,)"),
            (-9.81, "gravity is a vector in world axes, z up [m/s^2], got the number -9.81; did you mean"),
            ({"z": -9.81}, "gravity must be an array of real numbers, got"),
            *((value, f"gravity {words}") for value, words in NOT_NUMBERS),
        ],
    )
    def test_gravity(self, robot, value, words):
        with refused(vp.InputError, words):
            vp.Scene(robot, gravity=value)

    @pytest.mark.parametrize(
        ("value", "words"),
        [
            (np.eye(3), "actuation must have shape (2, 3), got (3, 3)"),
            ([[1.0], [np.nan]], "actuation[1, 0] is nan; it must be finite"),
            ([1.0, 2.0], "actuation must be a matrix with 2 rows, or joint names, got shape (2,)"),
            (3, "actuation must be a matrix with 2 rows, or joint names, got shape ()"),
            (["joint1", 3], "actuation must be an array of real numbers, got"),
            ([[1], [1, 2]], "actuation must be an array of real numbers: "),
            (["joint1", "joint2", "joint1"], "actuation names 'joint1' more than once"),
        ],
    )
    def test_actuation(self, robot, value, words):
        with refused(vp.InputError, words):
            vp.Scene(robot, actuation=value)

    @pytest.mark.parametrize("value", ["jont2", ["joint1", "jont2"]])
    def test_actuation_of_an_unknown_joint(self, robot, value):
        with refused(vp.UnknownJoint, "robot 'chain2'", "no joint 'jont2'; did you mean 'joint2'"):
            vp.Scene(robot, actuation=value)

    @pytest.mark.parametrize("value", ["ur5", None, pin.Model()])
    def test_robot(self, value):
        with refused(vp.InputError, "robot must come from load_robot, got", type(value).__name__):
            vp.Scene(value)


STATES = [
    ([0.0, np.nan], "[1] is nan; it must be finite"),
    ([np.inf, 0.0], "[0] is inf; it must be finite"),
    ([0.0], " must have shape (2,), got (1,)"),
    ([0.0, 0.0, 0.0], " must have shape (2,), got (3,)"),
    (0.0, " must have shape (2,), got ()"),
    ([[0.0, 0.0]], " must have shape (2,), got (1, 2)"),
    *((value, " " + words) for value, words in NOT_NUMBERS),
]

TIME_STEPS = [
    (0, "dt must be positive and finite [s], got 0"),
    (-0.01, "dt must be positive and finite [s], got -0.01"),
    (np.nan, "dt must be positive and finite [s], got nan"),
    (np.inf, "dt must be positive and finite [s], got inf"),
    ("0.01", "dt must be a number, got '0.01'"),
    (None, "dt must be a number, got None"),
    (True, "dt must be a number, got True"),
    (1j, "dt must be a number, got 1j"),
    ([0.01], "dt must be a number, got [0.01]"),
    (np.array([0.01]), "dt must be a number, got array([0.01])"),
    (10**400, "dt is beyond the range of floating-point numbers"),
]

ALPHAS = [
    (-0.1, "alpha must be in [0, 1], got -0.1"),
    (1.1, "alpha must be in [0, 1], got 1.1"),
    (np.nan, "alpha must be in [0, 1], got nan"),
    ("half", "alpha must be a number, got 'half'"),
    (None, "alpha must be a number, got None"),
]


class TestLagrangian:
    @pytest.mark.parametrize(("value", "words"), STATES)
    def test_states(self, scene, value, words):
        ok = [0.0, 0.0]
        for name, call in {
            "q": lambda: vp.lagrangian_jet(scene, value, ok),
            "v": lambda: vp.lagrangian_jet(scene, ok, value),
            "q0": lambda: vp.discrete_lagrangian(scene, value, ok, 0.1),
            "q1": lambda: vp.discrete_lagrangian(scene, ok, value, 0.1),
        }.items():
            with refused(vp.InputError, name + words):
                call()

    @pytest.mark.parametrize(("value", "words"), TIME_STEPS)
    def test_time_step(self, scene, value, words):
        with refused(vp.InputError, words):
            vp.discrete_lagrangian(scene, [0, 0], [0, 0], value)

    @pytest.mark.parametrize(("value", "words"), ALPHAS)
    def test_alpha(self, scene, value, words):
        with refused(vp.InputError, words):
            vp.discrete_lagrangian(scene, [0, 0], [0, 0], 0.1, alpha=value)
        with refused(vp.InputError, words):
            vp.Midpoint(alpha=value)

    def test_backend(self, scene):
        with refused(vp.InputError, "backend must be 'compiled' or 'pinocchio', got 'casadi'"):
            vp.lagrangian_jet(scene, [0, 0], [0, 0], backend="casadi")

    @pytest.mark.parametrize("value", [None, "ur5"])
    def test_scene(self, robot, value):
        with refused(vp.InputError, "scene must be a varpin.Scene, got", type(value).__name__):
            vp.lagrangian_jet(value, [0, 0], [0, 0])
        with refused(vp.InputError, "scene must be a varpin.Scene, got Robot"):
            vp.discrete_lagrangian(robot, [0, 0], [0, 0], 0.1)

    def test_configuration(self, robot):
        for q, shape in (([1.0], "(1,)"), (np.zeros((2, 3)), "(2, 3)"), (1.0, "()")):
            with refused(vp.InputError, f"q must have shape (..., 2), got {shape}"):
                robot.configuration(q)


class TestSimulation:
    @staticmethod
    def run(scene, **changes):
        arguments = {"q0": [0.1, 0.2], "v0": [0.0, 0.0], "dt": 0.01, "steps": 5} | changes
        return vp.simulate(scene, arguments.pop("q0"), arguments.pop("v0"), **arguments)

    @pytest.mark.parametrize("name", ["q0", "v0"])
    @pytest.mark.parametrize(("value", "words"), STATES)
    def test_states(self, scene, name, value, words):
        with refused(vp.InputError, name + words):
            self.run(scene, **{name: value})

    @pytest.mark.parametrize(
        ("value", "words"),
        [
            *(case for case in TIME_STEPS if case[0] is not None),
            (None, "give two of dt [s], steps and duration [s], or duration and tolerance"),
        ],
    )
    def test_time_step(self, scene, value, words):
        with refused(vp.InputError, words):
            self.run(scene, dt=value)

    @pytest.mark.parametrize(
        ("value", "words"),
        [
            (-1, "steps must be at least 0, got -1"),
            (5.0, "steps must be an integer, got 5.0"),
            (2.5, "steps must be an integer, got 2.5"),
            ("5", "steps must be an integer, got '5'"),
            (None, "give two of dt [s], steps and duration [s], or duration and tolerance"),
            (True, "steps must be an integer, got True"),
        ],
    )
    def test_steps(self, scene, value, words):
        with refused(vp.InputError, words):
            self.run(scene, steps=value)

    @pytest.mark.parametrize("steps", [10**15, 10**18, 10**30])
    def test_more_steps_than_memory(self, scene, steps):
        with refused(vp.InputError, f"steps = {steps} needs more memory than there is"):
            self.run(scene, steps=steps)

    @pytest.mark.parametrize(
        ("value", "words"),
        [
            (np.zeros((4, 2)), "controls must have shape (5, 2), one row a step, or (2,), got (4, 2)"),
            (np.zeros((6, 2)), "controls must have shape (5, 2), one row a step, or (2,), got (6, 2)"),
            (np.zeros((5, 3)), "controls must have shape (5, 2), one row a step, or (2,), got (5, 3)"),
            (np.zeros(3), "got (3,)"),
            (0.0, "got ()"),
            (np.array([[0, 0]] * 4 + [[0, np.nan]]), "controls[4, 1] is nan; it must be finite"),
            ([0, np.inf], "controls[1] is inf; it must be finite"),
            *((value, f"controls {words}") for value, words in NOT_NUMBERS),
        ],
    )
    def test_controls(self, scene, value, words):
        with refused(vp.InputError, words):
            self.run(scene, controls=value)

    @pytest.mark.parametrize("kind", ["law", "open loop"])
    @pytest.mark.parametrize(
        ("value", "words"),
        [
            ([1.0], "controls(t, q, v) must have shape (2,), got (1,)"),
            ([0.0, np.nan], "controls(t, q, v)[1] is nan; it must be finite"),
            (None, "controls(t, q, v) must be an array of real numbers, got None"),
            (0.0, "controls(t, q, v) must have shape (2,), got ()"),
            (ZeroDivisionError("no torque"), "raised ZeroDivisionError('no torque')"),
        ],
    )
    def test_control_functions(self, scene, kind, value, words):
        def swing(t):
            if t < 0.03:
                return [0.1, 0.2]
            if isinstance(value, Exception):
                raise value
            return value

        controls, time = (lambda t, q, v: swing(t)), 0.03
        if kind == "open loop":
            controls, time, words = vp.OpenLoop(swing), 0.035, words.replace("controls(t, q, v)", "OpenLoop: f(t)")
        with refused(vp.ControlError, f"step 3 (t = {time:g} s)", words, "error.trajectory") as info:
            self.run(scene, controls=controls, integrator=vp.Midpoint())
        error = info.value
        assert (error.step, error.time, error.trajectory.steps) == (3, pytest.approx(time), 3)
        whole = self.run(scene, steps=3, controls=[0.1, 0.2], integrator=vp.Midpoint())
        assert np.array_equal(error.trajectory.q, whole.q)
        assert np.array_equal(error.trajectory.u, whole.u)
        if isinstance(value, Exception):
            assert error.__cause__ is value

    def test_a_control_function_of_wrong_arguments(self, scene):
        with refused(vp.InputError, "a control law takes (t, q, v)", "varpin.OpenLoop(f)"):
            self.run(scene, controls=lambda t: [0.0, 0.0])
        with refused(vp.InputError, "must be a function of (t, q, v)"):
            self.run(scene, controls=lambda t, q: [0.0, 0.0])

    @pytest.mark.parametrize(
        ("function", "words"),
        [
            (lambda t, q, v: [0.0, 0.0], "a law of (t, q, v) is given as it is, controls=law"),
            (lambda: [0.0, 0.0], "OpenLoop takes a function of one argument, the time t"),
            ([0.0, 0.0], "OpenLoop takes a function of the time t, got [0.0, 0.0]"),
        ],
    )
    def test_open_loops_of_something_else(self, function, words):
        with refused(vp.InputError, words):
            vp.OpenLoop(function)

    @pytest.mark.parametrize(("period", "words"), [(0, "at least 1, got 0"), (1.5, "an integer, got 1.5")])
    def test_period(self, scene, period, words):
        with refused(vp.InputError, f"period must be {words}"):
            self.run(scene, controls=lambda t, q, v: [0.0, 0.0], period=period)

    @pytest.mark.parametrize("controls", [None, [0.1, 0.2], vp.OpenLoop(lambda t: [0.1, 0.2])])
    def test_a_period_is_of_a_law(self, scene, controls):
        with refused(vp.InputError, "period = 2 is of a control law"):
            self.run(scene, controls=controls, period=2)

    def test_an_ensemble_takes_no_law(self, scene):
        noisy = vp.Scene(scene.robot, noise=vp.AdditiveNoise(0.1))
        with refused(vp.InputError, "only simulate takes a control law"):
            vp.simulate_ensemble(
                noisy, [0, 0], [0, 0], dt=0.01, steps=2, paths=2, rng=0, controls=lambda t, q, v: [0.0, 0.0]
            )
        with refused(vp.ControlError, "step 1 (t = 0.015 s)", "OpenLoop: f(t) must have shape (2,)") as info:
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
        with refused(vp.InputError, "integrator must be one of varpin's, for example varpin.Midpoint(), got"):
            self.run(scene, integrator=value)

    @pytest.mark.parametrize("value", [None, "ur5"])
    def test_scene(self, value):
        with refused(vp.InputError, "scene must be a varpin.Scene, got"):
            self.run(value)

    @pytest.mark.parametrize("state", [{"q0": [1e308, 0.0]}, {"v0": [1e200, 0.0]}, {"v0": [1e160, -1e160]}])
    def test_numbers_beyond_reason_fail_and_say_where(self, scene, state):
        with refused(vp.StepFailure, "step 0 (t = 0 s) cannot be trusted", "smaller dt") as info:
            self.run(scene, **state)
        assert info.value.trajectory.steps == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"links": 0}, "links must be at least 1, got 0"),
        ({"links": 1.5}, "links must be an integer, got 1.5"),
        ({"links": "2"}, "links must be an integer, got '2'"),
        ({"links": 2, "length": 0.0}, "length must be positive and finite [m], got 0.0"),
        ({"links": 2, "length": "long"}, "length must be a number, got 'long'"),
        ({"links": 2, "mass": np.nan}, "mass must be positive and finite [kg], got nan"),
    ],
)
def test_planar_chain(arguments, words):
    with refused(vp.InputError, words):
        vp.planar_chain(**arguments)
