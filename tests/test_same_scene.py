"""A motion is linearized in the scene that made it: any other is told from it, by name."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from mechanisms import random_tree
from refusals import refused

import varpin as vp
from varpin.control import solution_trajectory

UR5 = {"damping": 0.1, "stiffness": 2.0, "rest": 0.3, "noise": vp.AdditiveNoise(1e-3)}
PUSH = vp.FrameWrench("tool0", [3.0, -2.0, 5.0, 0.0, 0.0, 0.0])
SPRING = vp.FrameSpring("tool0", ("forearm_link", [0.05, 0.1, 0.0]), 8.0)
OTHERS = {
    "damping": {"damping": [0.1, 0.1, 0.4, 0.1, 0.1, 0.1]},
    "stiffness": {"stiffness": 3.0},
    "rest": {"rest": 0.2},
    "gravity": {"gravity": False},
    "actuation": {"actuation": 2.0 * np.eye(6)},
    "armature": {"forces": vp.Armature(0.1)},
    "CoulombFriction": {"friction": 1.0},
    "FrameLoad": {"forces": PUSH},
    "FrameSpring": {"forces": SPRING},
    "functions": {"forces": vp.CustomForce(lambda q, v: -5.0 * v)},
    "constraints.ties": {"constraints": vp.JointTie("wrist_3_joint", "wrist_2_joint")},
    "constraints.between": {"constraints": vp.PointOnPlane("tool0", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))},
}


def motion_of(scene, **options):
    n = scene.robot.dof
    return vp.simulate(scene, np.full(n, 0.2), np.full(n, 0.5), dt=1e-3, steps=5, **options)


@pytest.mark.parametrize("name", OTHERS)
def test_another_scene_is_refused_by_what_differs(load, name, tmp_path):
    """Whichever of the two has it, and where the motion has been in a file."""
    robot = load("ur5")
    one, other = vp.Scene(robot, **UR5), vp.Scene(robot, **UR5 | OTHERS[name])
    motion = motion_of(one)
    for calls in (vp.linearize, lambda scene, motion: vp.second_order(scene, motion, np.ones(12))):
        with refused(vp.InputError, name) as caught:
            calls(other, vp.Trajectory.load(motion.save(tmp_path / "motion.npz")))
    assert "differs in " + name + ". " in str(caught.value)
    if not other.constraints:
        with refused(vp.InputError, name):
            vp.linearize(one, motion_of(other))


@pytest.mark.parametrize("rows", [[], [[0.0, 3.0, 5.0, 0.7]]], ids=["idle", "acting"])
def test_forces_of_another_core_are_refused_by_name(load, rows, tmp_path):
    """A core with a force of one's own stores it under its name, without rows where it did not act."""
    scene = vp.Scene(load("ur5"))
    motion = motion_of(scene)
    values = {**motion.scene_values, "RubberBush": np.array(rows)}
    loaded = vp.Trajectory.load(replace(motion, scene_values=values).save(tmp_path / "motion.npz"))
    np.testing.assert_array_equal(loaded.scene_values["RubberBush"], rows)
    with refused(vp.InputError, "RubberBush") if rows else contextlib.nullcontext():
        assert vp.linearize(scene, loaded).A.shape == (5, 12, 12)


@pytest.mark.parametrize("fact", ["masses", "translation", "inertia", "armature", ""])
def test_robots_of_the_same_joints_are_told_apart(fact):
    model = random_tree(3, bodies=3)
    motion, other = motion_of(vp.Scene(vp.load_robot(model))), model.copy()
    body, place = other.inertias[2], other.jointPlacements[2]
    if fact == "masses":
        body.mass *= 1.5
    elif fact == "translation":
        place.translation = 1.1 * place.translation
    elif fact == "inertia":
        body.inertia = 1.2 * body.inertia
    elif fact == "armature":
        other.armature = other.armature + np.array([0.0, 0.0, 0.5])
    scene = vp.Scene(vp.load_robot(other))
    with refused(vp.InputError, fact) if fact else contextlib.nullcontext():
        assert vp.linearize(scene, motion).steps == 5


def test_scenes_that_are_alike_are_the_same(load, tmp_path):
    """Other objects of the same numbers, rounding apart, a motion that has been away, noise of which none was drawn."""
    motion = motion_of(vp.Scene(load("ur5"), **UR5))
    back = vp.Trajectory.load(motion.save(tmp_path / "motion.npz"))
    for name, values in motion.scene_values.items():
        np.testing.assert_array_equal(back.scene_values[name], values)
    again = vp.Scene(vp.load_robot("ur5"), **UR5 | {"damping": 0.1 * (1.0 + 1e-13)})
    stronger = vp.Scene(load("ur5"), **UR5 | {"noise": vp.AdditiveNoise(0.1)})
    exact = vp.linearize(vp.Scene(load("ur5"), **UR5), motion)
    for given in (motion, back, motion.part(1, 4)):
        assert vp.linearize(again, given).steps == given.steps
    np.testing.assert_array_equal(vp.linearize(stronger, motion).A, exact.A)
    kicked = motion_of(vp.Scene(load("ur5"), **UR5), rng=0)
    with refused(vp.InputError, "noise"):
        vp.linearize(stronger, kicked)


def test_plans_in_files_keep_their_scene(tmp_path):
    scene = vp.Scene(vp.planar_chain(2), damping=0.3)
    cost = vp.ControlCost(1.0) + vp.Terminal(vp.TrackingCost([0.1, 0.1]))
    problem = vp.OptimalControlProblem(scene, cost, [0.0, 0.0], [0.0, 0.0], dt=0.02, steps=5)
    plan = vp.solve(problem, max_iterations=2)
    path = plan.save(tmp_path / "plan.npz")
    for motion in (vp.Solution.load(path, problem).trajectory, solution_trajectory(path)):
        assert vp.linearize(scene, motion).steps == 5
        with refused(vp.InputError, "damping"):
            vp.linearize(vp.Scene(vp.planar_chain(2)), motion)
