"""What leaves the process comes back as it was: simulations and solves of the same bytes, arrays of the same kind."""

import copy
import pickle

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


def arrays_in(x):
    found = {}
    for name, value in getattr(x, "__dict__", {}).items():
        items = value.items() if hasattr(value, "items") else enumerate(value if isinstance(value, tuple) else [value])
        found |= {(name, key): item for key, item in items if isinstance(item, np.ndarray)}
    return found


def goes_round(x, use):
    """Each way keeps the arrays of ``x``, and what ``use`` makes of it."""
    expected = use(x)
    for way in WAYS:
        back = way(x)
        for where, array in arrays_in(back).items():
            own = arrays_in(x)[where]
            assert array.tobytes() == own.tobytes(), where
            assert array.flags.writeable == own.flags.writeable, where
            assert array.flags.aligned, where
        np.testing.assert_equal(use(back), expected)


def moved(scene):
    n, m = scene.robot.dof, scene.controls
    start = np.linspace(0.1, 0.3, n), np.linspace(-0.5, 0.5, n)
    motion = vp.simulate(scene, *start, dt=1e-3, steps=5, rng=3, controls=np.full(m, 0.1))
    return [motion.q, motion.p, motion.u, motion.dw, motion.energy, motion.warnings]


def scene_of(robot):
    noise = vp.AdditiveNoise(1e-2) + vp.ControlNoise(0.1) + vp.StateNoise(1e-3)
    return vp.Scene(robot, damping=np.linspace(0.1, 0.2, robot.dof), stiffness=1.0, noise=noise)


def robot_goes_round(robot):
    goes_round(robot, lambda own: [own.joint_names, dict(own.locked), own.urdf, own.package_dirs, own.name])
    goes_round(robot, lambda own: moved(scene_of(own)))
    goes_round(scene_of(robot), moved)


def test_chains_and_locked_joints_go_round():
    robot_goes_round(vp.planar_chain(2))
    robot_goes_round(vp.load_robot("ur5", lock={"elbow_joint": 0.3, "wrist_1_joint": 0.1, "wrist_2_joint": 0.0}))


@pytest.mark.slow
@pytest.mark.parametrize("name", vp.robot_names())
def test_every_robot_that_goes_by_a_name_simulates_as_before(name, load):
    robot_goes_round(load(name))


def make_problem(**scene):
    cost = vp.ControlCost(1e-2) + vp.Terminal(vp.TrackingCost(np.full(2, 0.5), 10.0))
    return vp.OptimalControlProblem(vp.Scene(vp.planar_chain(2), **scene), cost, [0, 0], [0, 0], dt=0.02, steps=20)


def numbers(plan):
    return [plan.controls, plan.gains, plan.feedforward, plan.gradient, plan.cost, plan.status, plan.reason]


def test_problems_plans_controllers_and_ensembles_go_round():
    problem = make_problem(noise=vp.AdditiveNoise(1e-2))
    plan = vp.solve(problem, max_iterations=3)
    goes_round(problem, lambda own: numbers(vp.solve(own, max_iterations=3)))
    goes_round(plan, lambda own: numbers(vp.solve(own.problem, resume=own, max_iterations=6)))
    goes_round(plan, lambda own: repr(own.monte_carlo(20, rng=1)))
    quiet = make_problem()
    plant = vp.Plant(quiet.scene, substeps=2)
    goes_round((vp.Mpc(quiet), plant), lambda own: own[0].run(own[1], duration=0.06).motion.q)
    goes_round(vp.Mpc(quiet).run(plant, duration=0.06), lambda own: [own.motion.q, own.planned()])
    paths = vp.simulate_ensemble(problem.scene, [0.1, 0.2], [0.0, 0.0], dt=1e-3, steps=5, paths=3, rng=0)
    goes_round(paths, repr)


@pytest.mark.parametrize("name", scenes())
def test_problems_of_scene_files_go_round(name):
    """Their references are functions of time."""
    problem = vp.load_scene(name).problem
    n, m = problem.scene.robot.dof, problem.scene.controls
    q, v, u = np.ones((problem.steps + 1, n)), np.ones((problem.steps + 1, n)), np.ones((problem.steps, m))
    goes_round(problem, lambda own: own.at(dt=problem.dt).costs(q, v, u))


def test_what_was_logged_stays_in_its_process():
    """Another process has another log; the bytes of a scene do not tell what was logged of it."""
    scene = scene_of(vp.planar_chain(2))
    before = pickle.dumps(scene)
    scene.announced.add(("energy", 0.1, None))
    assert pickle.dumps(scene) == before
    for way in WAYS:
        assert way(scene).announced == set()


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


ERRORS = {kind for kind in vars(vp).values() if isinstance(kind, type) and issubclass(kind, vp.VarpinError)}


@pytest.mark.parametrize("kind", sorted(ERRORS, key=lambda kind: kind.__name__), ids=lambda kind: kind.__name__)
def test_errors_of_every_kind_go_round(kind):
    """Whatever they are made of: with what they say and hold."""
    error = kind.__new__(kind, "said")
    error.step, error.known = 3, ("a", "b")
    for way in WAYS:
        back = way(error)
        assert (type(back), str(back), vars(back)) == (kind, "said", vars(error))
