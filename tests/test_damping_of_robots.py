"""Damping and dry friction of a robot's description: told of where a scene leaves them out, taken on request."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from findings import about
from mechanisms import joint, link, mimic, write_urdf
from refusals import refused, unnamed

import varpin as vp


@pytest.fixture
def arm(tmp_path):
    """Two joints and one that follows the second at twice its speed, with dampers and dry friction."""

    def make(damping=("0.3", "0.5", "0.25"), friction=("0", "0.1", "0.2")):
        inside = [f'<dynamics damping="{d}" friction="{f}"/>' for d, f in zip(damping, friction, strict=True)]
        inside[2] += mimic("j2", ratio=-2)
        parts = [link(f"l{i}") for i in (1, 2, 3)]
        bodies = zip(("j1", "j2", "j3"), ("base", "l1", "l2"), ("l1", "l2", "l3"), inside, strict=True)
        parts += [joint(name, parent, child, inside=text) for name, parent, child, text in bodies]
        return vp.load_robot(write_urdf(tmp_path, *parts))

    return make


def said(caplog):
    return about((record.getMessage() for record in caplog.records), "left out of the description")


def test_a_scene_that_leaves_dampers_out_says_so_once(arm, caplog):
    robot = arm()
    with caplog.at_level(logging.WARNING):
        scene = vp.Scene(robot)
        for _ in range(2):
            vp.simulate(scene, [0, 0], [0, 0], dt=1e-3, steps=3)
    for sentence, name in zip(said(caplog), ("damping", "friction"), strict=True):
        assert not unnamed(sentence, f"{name}='robot'", f"{name}=0")
    assert not scene.damping.any()


def test_nothing_is_said_where_the_description_has_none(arm, caplog):
    with caplog.at_level(logging.WARNING):
        vp.Scene(arm(("0", "0", "0"), ("0", "0", "0")))
        vp.Scene(vp.load_robot("ur5"))
        vp.Scene(vp.planar_chain(2))
    assert said(caplog) == []


def test_the_description_s_dampers_take_what_pinocchio_s_model_says(arm, caplog):
    """Power of the dampers of all joints of the free model, followers too, at a velocity of the coordinates."""
    robot = arm()
    with caplog.at_level(logging.WARNING):
        scene = vp.Scene(robot, damping="robot")
    (sentence,) = said(caplog)
    assert "friction='robot'" in sentence
    assert "N m s/rad" not in sentence
    v = np.array([0.7, -1.3])
    free = robot.velocity(v)
    assert scene.damping @ v**2 == pytest.approx(np.asarray(robot.model.damping) @ free**2, rel=1e-14)
    assert robot.friction @ np.abs(v) == pytest.approx(np.asarray(robot.model.friction) @ np.abs(free), rel=1e-14)
    # And it is what forces of that size do in the equations of motion.
    given = vp.Scene(robot, damping=[0.3, 0.5 + 4 * 0.25])
    ends = [vp.simulate(s, [0.1, 0.2], v, dt=1e-3, steps=20).q for s in (scene, given)]
    np.testing.assert_array_equal(*ends)


def test_other_words_are_refused(arm):
    with refused(vp.InputError, "damping", "'robot'"):
        vp.Scene(arm(), damping="urdf")


def test_scene_files_take_it(tmp_path, caplog):
    text = '{}\n[robot]\nsource = "xarm7"\n[horizon]\ndt = 1e-2\nsteps = 3\n'
    path = tmp_path / "arm.toml"
    found = {}
    for line in ("", 'damping = "robot"', "damping = 0.0"):
        path.write_text(text.format(line))
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            scene = vp.load_scene(path, required_only=False).scene
        found[line] = scene.damping.tolist(), len(said(caplog))
    own = vp.load_robot("xarm7").damping.tolist()
    assert own == [10.0, 10.0, 5.0, 5.0, 5.0, 2.0, 2.0]
    # Its file gives dry friction, too, which is told of wherever the rest is taken.
    assert found == {"": ([0.0] * 7, 2), 'damping = "robot"': (own, 1), "damping = 0.0": ([0.0] * 7, 0)}
    path.write_text(text.format('damping = "urdf"'))
    with refused(vp.SceneFileError, "'urdf'", "robot"):
        vp.load_scene(path)
