"""What leaves the process comes back as it was: simulations and solves of the same bytes, arrays of the same kind."""

import copy
import dataclasses
import pickle
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin
import pytest

import varpin as vp
from varpin.io.scenefile import scenes
from varpin.model.robot import geometry


def by_pickle(x):
    return pickle.loads(pickle.dumps(x))


def beside(x):
    """As over a network: arrays travel beside the pickle, as bytes that cannot be written to, at odd places."""
    buffers = []
    data = pickle.dumps(x, protocol=5, buffer_callback=buffers.append)
    return pickle.loads(data, buffers=[memoryview(b"." + bytes(buffer.raw()))[1:] for buffer in buffers])


WAYS = (by_pickle, beside, copy.deepcopy)


def arrays_in(x, seen=None, path=""):
    """All arrays that an object of varpin holds, by where they are."""
    seen = set() if seen is None else seen
    if id(x) in seen:
        return {}
    seen.add(id(x))
    if isinstance(x, np.ndarray):
        return {path: x}
    if isinstance(x, tuple):
        items = zip(getattr(x, "_fields", range(len(x))), x, strict=True)
    elif type(x).__module__.startswith("varpin."):
        cached = {n for kind in type(x).__mro__ for n, v in vars(kind).items() if isinstance(v, cached_property)}
        items = ((name, value) for name, value in vars(x).items() if name not in cached)
    else:
        return {}
    return {where: array for name, value in items for where, array in arrays_in(value, seen, f"{path}.{name}").items()}


def same_arrays(one, other):
    a, b = arrays_in(one), arrays_in(other)
    # What several objects share may be restored as copies.
    assert set(a) <= set(b)
    for where, array in a.items():
        assert array.tobytes() == b[where].tobytes(), where
        assert array.flags.writeable == b[where].flags.writeable, where
        assert b[where].flags.aligned, where
    return len(a)


def scene_of(robot, **options):
    n = robot.dof
    noise = vp.AdditiveNoise(1e-2) + vp.ControlNoise(0.1) + vp.StateNoise(1e-3)
    return vp.Scene(robot, damping=np.linspace(0.1, 0.2, n), stiffness=1.0, noise=noise, **options)


def motion_of(scene, **options):
    n, m = scene.robot.dof, scene.controls
    given = {"dt": 1e-3, "steps": 5, "rng": 3, "controls": np.full(m, 0.1)} | options
    return vp.simulate(scene, np.linspace(0.1, 0.3, n), np.linspace(-0.5, 0.5, n), **given)


def same_motion(one, other):
    for name in ("t", "q", "v", "p", "u", "dw", "energy"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name
    for item in dataclasses.fields(one.statistics):
        assert getattr(one.statistics, item.name).tobytes() == getattr(other.statistics, item.name).tobytes()
    assert one.warnings == other.warnings


def goes_round(robot):
    scene = scene_of(robot)
    motion = motion_of(scene)
    for way in WAYS:
        back = way(robot)
        assert back.joint_names == robot.joint_names
        assert dict(back.locked) == dict(robot.locked)
        assert back.model == robot.model
        assert (back.urdf, back.package_dirs, back.name) == (robot.urdf, robot.package_dirs, robot.name)
        same_motion(motion_of(scene_of(back)), motion)
        same_motion(motion_of(way(scene)), motion)


def test_chains_and_locked_joints_go_round():
    goes_round(vp.planar_chain(2))
    goes_round(vp.load_robot("ur5", lock={"elbow_joint": 0.3, "wrist_1_joint": 0.1, "wrist_2_joint": 0.0}))


@pytest.mark.slow
@pytest.mark.parametrize("name", vp.robot_names())
def test_every_robot_that_goes_by_a_name_simulates_as_before(name, load):
    goes_round(load(name))


def same_plan(one, other):
    same_motion(one.trajectory, other.trajectory)
    for name in ("gains", "feedforward", "gradient"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name
    assert (one.cost, one.noise_cost, one.status, one.reason) == (
        other.cost,
        other.noise_cost,
        other.status,
        other.reason,
    )


def test_arrays_keep_their_kind():
    scene = scene_of(vp.planar_chain(2))
    problem = make_problem(scene)
    policy = vp.LinearPolicy(
        np.zeros((5, 2)), np.ones((5, 2, 4)), np.zeros((5, 4)), previous_gains=np.zeros((5, 2, 2)), before=[0.0, 0.0]
    )
    for x in (scene, motion_of(scene), policy, problem):
        for way in WAYS:
            assert same_arrays(x, way(x)) >= 5


def make_problem(scene, **options):
    n = scene.robot.dof
    cost = vp.ControlCost(1e-2) + vp.Terminal(vp.TrackingCost(np.full(n, 0.5), 10.0))
    given = {"dt": 0.02, "steps": 20} | options
    return vp.OptimalControlProblem(scene, cost, np.zeros(n), np.zeros(n), **given)


def test_problems_and_solutions_go_on_as_before():
    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(1e-2))
    problem = make_problem(scene)
    plan = vp.solve(problem, max_iterations=3)
    whole, expected = vp.solve(problem, resume=plan, max_iterations=6), plan.monte_carlo(20, rng=1)
    for way in WAYS:
        same_plan(vp.solve(way(problem), max_iterations=3), plan)
        back = way(plan)
        same_plan(back, plan)
        assert same_arrays(plan, back) > 20
        same_plan(vp.solve(back.problem, resume=back, max_iterations=6), whole)
        assert back.monte_carlo(20, rng=1) == expected
        assert way(expected) == expected


def test_a_controller_its_plant_and_its_run_go_round():
    scene = vp.Scene(vp.planar_chain(2))
    controller = vp.Mpc(make_problem(scene))
    plant = vp.Plant(scene, substeps=2)
    done = controller.run(plant, duration=0.06)
    for way in WAYS:
        again = way(controller).run(way(plant), duration=0.06)
        same_motion(again.motion, done.motion)
        back = way(done)
        same_motion(back.motion, done.motion)
        assert back.planned().tobytes() == done.planned().tobytes()


def test_an_ensemble_goes_round():
    scene = scene_of(vp.planar_chain(2))
    end = vp.simulate_ensemble(scene, [0.1, 0.2], [0.0, 0.0], dt=1e-3, steps=5, paths=3, rng=0)
    for way in WAYS:
        assert same_arrays(end, way(end)) >= 10
        assert repr(way(end)) == repr(end)


@pytest.mark.parametrize("name", scenes())
def test_problems_of_scene_files_go_round(name):
    """Their references are functions of time."""
    problem = vp.load_scene(name).problem
    for way in WAYS:
        back = way(problem).at(dt=problem.dt)
        same_arrays(problem.running, back.running)
        same_arrays(problem.terminal, back.terminal)


def test_what_was_logged_stays_in_its_process():
    """Another process has another log; the bytes of a scene do not tell what was logged of it."""
    scene = scene_of(vp.planar_chain(2))
    before = pickle.dumps(scene)
    scene.announced.add(("energy", 0.1, None))
    assert pickle.dumps(scene) == before
    for way in WAYS:
        back = way(scene)
        assert back.announced == set()
        back.announced.add(("energy", 0.2, None))
        assert scene.announced == {("energy", 0.1, None)}


def shapes_of(robot):
    return [
        (shape.name, shape.parentJoint, shape.placement.homogeneous.tolist(), shape.meshScale.tolist(), shape.meshPath)
        for shape in geometry(robot).geometryObjects
    ]


def test_geometry_goes_along():
    """Of a file it is read again; what came in memory travels."""
    finger = vp.load_robot("finger")
    assert shapes_of(by_pickle(finger)) == shapes_of(finger)
    model = finger.model.copy()
    visuals = pin.GeometryModel()
    box = pin.GeometryObject("box", 1, pin.SE3.Random(), coal.Box(0.1, 0.2, 0.3))
    box.meshColor = np.array([0.1, 0.2, 0.3, 0.4])
    visuals.addGeometryObject(box)
    robot = vp.load_robot(pin.RobotWrapper(model, visual_model=visuals))
    for way in WAYS:
        back = way(robot)
        assert shapes_of(back) == shapes_of(robot)
        (shape,) = geometry(back).geometryObjects
        assert shape.geometry.halfSide.tolist() == [0.05, 0.1, 0.15]
        assert shape.meshColor.tolist() == [0.1, 0.2, 0.3, 0.4]
