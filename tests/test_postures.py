"""Postures of SRDF files are the configurations that Pinocchio reads from them."""

from __future__ import annotations

import pickle

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import joint, link, mimic, write_urdf
from refusals import refused, unnamed

import varpin as vp

# Robots of example-robot-data and the postures in their SRDF files, under srdf/ of each.
PUBLISHED = {name: (name, ("default",)) for name in ("alex_nub_hands", "alex_psyonic_hands", "alex_sake_hands")}
PUBLISHED |= {"panda": ("panda", ("default",)), "panda_collision": ("panda", ("default",))}
PUBLISHED |= {"finger_edu": ("finger_edu", ("hanging",)), "kinova": ("kinova", ("arm_up",))}
PUBLISHED |= {"talos_arm": ("talos", ("half_sitting",)), "xarm7": ("xarm7", ("home", "hold-up"))}
PUBLISHED |= {"z1": ("z1", ("home", "arm_up"))}


def of_joint(model, q, name):
    own = model.joints[model.getJointId(name)]
    return q[own.idx_q : own.idx_q + own.nq]


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_postures_are_pinocchio_s(load, name):
    robot, (file, names) = load(name), PUBLISHED[name]
    assert robot.postures == names
    model = pin.buildModelFromUrdf(str(robot.urdf))
    pin.loadReferenceConfigurations(model, str(robot.urdf.parent.parent / "srdf" / f"{file}.srdf"))
    for posture in names:
        q, expected = robot.configuration(robot.posture(posture)), model.referenceConfigurations[posture]
        for each in robot.joint_names:
            np.testing.assert_allclose(of_joint(robot.model, q, each), of_joint(model, expected, each), atol=1e-12)


SRDF = """<robot name="made_up">
<group_state name="home" group="arm"><joint name="j1" value="0.5"/><joint name="j2" value="9"/></group_state>
<group_state name="home" group="hand"><joint name="j3" value="-0.25"/>
<joint name="root" value="0 0 0 0 0 0 1"/></group_state>
<group_state name="there" group="arm"><joint name="j3" value="0.6 0.8"/></group_state>
<group_state name="there" group="hand"><joint name="j3" value="0.1"/></group_state>
<group_state name="none" group="other"><joint name="k1" value="1"/></group_state></robot>"""


@pytest.fixture
def urdf(tmp_path):
    parts = [link(f"l{k}") for k in (1, 2, 3, 4)]
    joints = [joint("j1", "base", "l1"), joint("j2", "l1", "l2", inside=mimic("j1", 2, 0.1))]
    joints += [joint("j3", "l2", "l3", "continuous"), joint("j4", "l3", "l4", "prismatic")]
    return write_urdf(tmp_path, *parts, *joints)


def test_coordinates_of_a_posture(urdf):
    (urdf.parent / "made_up.srdf").write_text(SRDF)
    robot = vp.load_robot(urdf)
    assert robot.joint_names == ("j1", "j3", "j4")
    assert robot.postures == ("home", "there")
    np.testing.assert_array_equal(robot.posture("home"), [0.5, -0.25, 0.0])
    np.testing.assert_array_equal(robot.posture("home", others={"j4": 0.3, "j1": 7.0}), [0.5, -0.25, 0.3])
    np.testing.assert_array_equal(robot.posture("hand/home", others=[1.0, 2.0, 3.0]), [1.0, -0.25, 3.0])
    assert robot.posture("arm/there")[1] == pytest.approx(np.arctan2(0.8, 0.6))
    assert vp.load_robot(urdf, lock={"j3": 1.0}).posture("home").tolist() == [0.5, 0.0]
    assert pickle.loads(pickle.dumps(robot)).posture("home").tolist() == [0.5, -0.25, 0.0]


def test_names_and_files_that_are_not_there(urdf):
    (urdf.parent / "made_up.srdf").write_text(SRDF)
    robot = vp.load_robot(urdf)
    with refused(vp.UnknownPosture, "'hme'", "'home'", "'there'") as caught:
        robot.posture("hme")
    assert caught.value.known == ("home", "there")
    with refused(vp.InputError, "'j3'", "'arm/there'", "'hand/there'"):
        robot.posture("there")
    with refused(vp.UnknownPosture, "'leg/home'"):
        robot.posture("leg/home")
    with refused(vp.UnknownJoint, "'j9'"):
        robot.posture("home", others={"j9": 1.0})
    with refused(vp.UnknownPosture, "srdf=path"):
        vp.load_robot("ur5").posture("home")
    with refused(vp.FileError, "lost.srdf"):
        vp.load_robot(urdf, srdf="lost.srdf")
    with refused(vp.InputError, "srdf", "3"):
        vp.load_robot(urdf, srdf=3)


@pytest.mark.parametrize(
    ("place", "name", "found"),
    [
        ("{}/made_up.srdf", "another", True),
        ("srdf/made_up.srdf", "another", True),
        ("srdf/any.srdf", "made_up", True),
        ("srdf/any.srdf", "another", False),
        ("srdf/one.srdf srdf/two.srdf", "made_up", False),
        ("deep/srdf/made_up.srdf", "made_up", False),
    ],
)
def test_where_the_file_is_looked_for(urdf, tmp_path, place, name, found):
    folder = tmp_path / "urdf"
    folder.mkdir()
    urdf = urdf.rename(folder / urdf.name)
    for each in place.format("urdf").split():
        file = tmp_path / each
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(SRDF.replace("made_up", name))
    assert bool(vp.load_robot(urdf).postures) == found
    assert vp.load_robot(urdf, srdf=str(file)).postures == ("home", "there")


BAD = {
    "no number": (SRDF.replace('"0.5"', '"half"'), ("'home'", "'j1'", "'half'")),
    "no value": (SRDF.replace('value="0.5"', ""), ("'j1'", "''")),
    "infinite": (SRDF.replace('"0.5"', '"inf"'), ("'j1'", "'inf'")),
    "broken": (SRDF[:-5], ("made_up.srdf", "XML")),
    "empty": ("", ("made_up.srdf", "empty")),
    "another format": (SRDF.replace("robot", "sdf"), ("made_up.srdf", "<sdf>")),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_files(urdf, caplog, kind):
    text, facts = BAD[kind]
    path = urdf.parent / "made_up.srdf"
    path.write_text(text)
    with refused(vp.RobotError, facts):
        vp.load_robot(urdf, srdf=path)
    # One that nobody asks for is told of.
    assert vp.load_robot(urdf).postures == ()
    assert not unnamed(caplog.text, facts)


def test_reference_configurations_of_a_model(urdf):
    model = pin.buildModelFromUrdf(str(urdf))
    q = pin.randomConfiguration(model, -np.ones(model.nq), np.ones(model.nq))
    model.referenceConfigurations["here"] = q
    robot = vp.load_robot(model)
    np.testing.assert_allclose(robot.configuration(robot.posture("here")), q, atol=1e-15)
