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
            (b"", "empty"),
            (b"<!DOCTYPE html>\n<html><head><meta charset=utf8></head></html>", "XML"),
            (b"<sdf/>", ("not a URDF", "<sdf>")),
            (b"<mujoco><worldbody/></mujoco>", ("not a URDF", "<mujoco>")),
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


MESSAGES = [
    *((name, value, facts) for name in ("q0", "v0") for value, facts in (
        ([0.0, np.nan], ("[1]", "nan")), ([np.inf, 0.0], ("[0]", "inf")), ([0.0], ("(2,)", "(1,)")),
        (0.0, ("(2,)", "()")), ("text", "real numbers"))),
    *(("dt", value, str(value)) for value in (0, -0.01, np.nan, np.inf, True)),
    *((name, None, ("dt", "steps", "duration", "tolerance")) for name in ("dt", "steps")),
    *(("steps", value, repr(value)) for value in (-1, 2.5, "5")),
    ("steps", 10**15, ("1000000000000000", "memory")),
    *(("controls", np.zeros(shape), ("(5, 2)", "(2,)", str(shape))) for shape in ((4, 2), (5, 3), (3,), ())),
    ("controls", np.array([[0, 0]] * 4 + [[0, np.nan]]), ("controls[4, 1]", "nan")),
    ("controls", lambda t: [0.0, 0.0], ("(t, q, v)", "varpin.OpenLoop(f)")),
    ("integrator", vp.Midpoint, "varpin.Midpoint()"),
    ("period", 0, "0"),
]  # fmt: skip


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


class TestSimulation:
    @staticmethod
    def run(scene, **changes):
        arguments = {"q0": [0.1, 0.2], "v0": [0.0, 0.0], "dt": 0.01, "steps": 5} | changes
        return vp.simulate(scene, arguments.pop("q0"), arguments.pop("v0"), **arguments)

    @pytest.mark.parametrize(("name", "value", "facts"), MESSAGES)
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

    @pytest.mark.parametrize("state", [{"q0": [1e308, 0.0]}, {"v0": [1e200, 0.0]}, {"v0": [1e160, -1e160]}])
    def test_numbers_beyond_reason_fail_and_say_where(self, scene, state):
        with refused(vp.StepFailure, "step 0", "t = 0 s", "dt") as info:
            self.run(scene, **state)
        assert info.value.trajectory.steps == 0


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
