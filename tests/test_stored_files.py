"""Files of every kind of record: damaged or foreign ones are refused by name."""

import copy
import dataclasses
import functools
import os
import pickle
import socket
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from oracles import same
from refusals import refused

import varpin as vp
from varpin.io.archive import read_npz
from varpin.io.scenefile import scenes
from varpin.model.robot import geometry

DATA = Path(__file__).parent / "data" / "files"


@functools.cache
def problem() -> vp.OptimalControlProblem:
    scene = vp.Scene(vp.planar_chain(2), damping=0.2, noise=vp.AdditiveNoise(0.1))
    cost = vp.TrackingCost([0.8, 0.1], 10.0) + vp.ControlCost(0.1) + vp.ControlRateCost(0.01)
    return vp.OptimalControlProblem(scene, cost, [0.4, -0.3], [0.0, 0.0], dt=0.02, steps=8, integrator=vp.Gauss(4))


LOADERS: dict[str, Callable[[Path], Any]] = {
    "trajectory.npz": vp.Trajectory.load,
    "solution.npz": lambda path: vp.Solution.load(path, problem()),
}


def members_of(name: str) -> dict[str, np.ndarray]:
    with np.load(DATA / name) as archive:
        return dict(archive)


def changed(folder: Path, name: str, **members: Any) -> Path:
    """A stored file with other entries, or without those that are None."""
    path = folder / name
    np.savez(path, **{key: value for key, value in {**members_of(name), **members}.items() if value is not None})
    return path


def unread(name: str, path: Path, *facts: str) -> None:
    with refused(vp.FileError, path.name, *facts):
        LOADERS[name](path)


def test_a_stored_solution_is_gone_on_from():
    stored = vp.Solution.load(DATA / "solution.npz", problem())
    again = vp.solve(problem(), max_iterations=3)
    assert stored.history[0].cost == pytest.approx(again.history[0].cost, rel=1e-9)
    assert vp.solve(problem(), resume=stored).cost == pytest.approx(again.cost, rel=1e-6)


@pytest.mark.parametrize("name", LOADERS)
def test_read_and_written_again_it_is_the_same(name, tmp_path):
    record, before = LOADERS[name](DATA / name), members_of(name)
    motion = record.trajectory if name == "solution.npz" else record
    for key in ("q", "v", "u", "dw"):
        np.testing.assert_array_equal(getattr(motion, key), before[key])
    path = record.save(tmp_path / name)
    LOADERS[name](path)
    after = read_npz(path)
    lost = {key for key in before.keys() - after.keys() if not key.startswith("scene.") or before[key].size}
    assert lost <= {"accuracy", "motion"}
    for key in before.keys() & after.keys():
        assert before[key].dtype == after[key].dtype
        np.testing.assert_array_equal(before[key], after[key])


@pytest.mark.parametrize("name", LOADERS)
def test_what_is_no_such_record(name, tmp_path):
    whole, path = (DATA / name).read_bytes(), tmp_path / name
    for share in (0.0, 0.3, 0.9, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        unread(name, path, "truncated")
    # Of the file of a plan the motion can be read alone.
    others = [(DATA / other).read_bytes() for other in LOADERS if other not in (name, "solution.npz")]
    for content in (b"hello", b"\x93NUMPY", bytes(1000), pickle.dumps({"q": 1}), *others):
        path.write_bytes(content)
        unread(name, path)
    form = str(members_of(name)["format"])
    unread(name, changed(tmp_path, name, format=form[:-1] + "9"), "/9")
    os.mkfifo(tmp_path / "pipe.npz")
    for missing in (tmp_path / "none.npz", tmp_path, tmp_path / "pipe.npz"):
        unread(name, missing)


@pytest.mark.parametrize("name", ["trajectory.npz"])
def test_any_damaged_byte_is_an_error_or_harmless(name, tmp_path):
    whole, sound = (DATA / name).read_bytes(), members_of(name)
    rng, refusals, path = np.random.default_rng(0), 0, tmp_path / name
    for place in rng.choice(len(whole), 40, replace=False):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            loaded = LOADERS[name](path)
        except vp.FileError:
            refusals += 1
        else:
            loaded.save(path)
            np.testing.assert_equal(
                members_of(name), {**sound, **{k: v for k, v in read_npz(path).items() if k in sound}}
            )
    assert refusals > 15


@pytest.mark.parametrize("entry", ["x", "[1]", "3", '{"kind": "a"}', '{"kind": "a", "text": "b", "odd": 1}'])
def test_damaged_warnings(entry, tmp_path):
    unread("trajectory.npz", changed(tmp_path, "trajectory.npz", warnings=np.array([entry])), "warnings")


# The last part of the names of entries that may be missing.
OPTIONAL = {"version", "warnings", "missing", "fingerprint", "accuracy", "motion", "constraint_labels"}


@pytest.mark.parametrize("name", LOADERS)
def test_every_entry_is_checked(name, tmp_path):
    """An entry that is missing, of another shape or of another type is named: one of the three for each."""
    same = ("scene.", "statistics.", "best.") if name == "solution.npz" else ("scene.",)
    entries = {key: array for key, array in members_of(name).items() if not key.startswith(same)}
    for index, (entry, array) in enumerate(entries.items()):
        other = (None, array[None], array.astype("S9"))[index % 3]
        if entry.split(".")[-1] in OPTIONAL and (other is None or not array.size or entry.endswith("motion")):
            continue
        with pytest.raises(vp.FileError) as caught:
            LOADERS[name](changed(tmp_path, name, **{entry: other}))
        assert entry.split(".")[-1] in str(caught.value), entry


def last(value: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda array: np.where(np.arange(array.size).reshape(array.shape) == array.size - 1, value, array)


@pytest.mark.parametrize(
    ("name", "entry", "change"),
    [
        *(
            ("trajectory.npz", entry, last(value))
            for entry in ("t", "q", "v", "p", "u", "dw", "dt")
            for value in (np.nan, np.inf)
        ),
        ("trajectory.npz", "t", lambda t: t[::-1]),
        ("trajectory.npz", "dt", lambda dt: -dt),
        ("trajectory.npz", "dt", lambda dt: 0.0 * dt),
        # Parts that do not fill the steps.
        ("trajectory.npz", "statistics.substeps", lambda counts: np.append(0, counts[1:])),
        ("trajectory.npz", "statistics.substeps", lambda counts: counts * 2**62),
        ("trajectory.npz", "statistics.substeps", lambda counts: counts * 3),
        ("trajectory.npz", "statistics.halvings", lambda levels: np.append(levels, np.uint8(1))),
        ("solution.npz", "gains", last(np.nan)),
        ("solution.npz", "history.index", lambda rows: rows + 0.5),
        ("solution.npz", "search.iterations", lambda count: -1 - count),
        ("solution.npz", "status", lambda _: "DONE"),
        ("solution.npz", "cost", lambda cost: 1.1 * cost),
    ],
)
def test_numbers_that_no_record_has(name, entry, change, tmp_path):
    unread(name, changed(tmp_path, name, **{entry: change(members_of(name)[entry])}), entry.split(".")[-1])


@pytest.mark.parametrize("name", LOADERS)
def test_pickles_are_not_opened(name, tmp_path):
    witness = tmp_path / "witness"

    class Trap:
        def __reduce__(self):
            return (Path.touch, (witness,))

    path = changed(tmp_path, name, format=np.array([Trap()], dtype=object))
    unread(name, path, "format")
    assert not witness.exists()
    # The trap is live.
    with np.load(path, allow_pickle=True) as archive:
        archive["format"]
    assert witness.exists()


def test_a_wrong_shape_costs_no_memory(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, **{**members_of("trajectory.npz"), "q": np.zeros((10_000_000, 1, 1))})
    assert path.stat().st_size > 1_000
    tracemalloc.start()
    with refused(vp.FileError, "a.npz", "q", "(10000000, 1, 1)"):
        vp.Trajectory.load(path)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_names_that_are_too_long_are_refused_by_name(tmp_path):
    motion = vp.Trajectory.load(DATA / "trajectory.npz")
    longest = tmp_path / f"{'a' * 251}.npz"
    assert vp.Trajectory.load(motion.save(longest)).steps == motion.steps
    for call in (motion.save, vp.Trajectory.load, vp.load_scene, vp.load_robot):
        with pytest.raises(vp.VarpinError, match="aaaa"):
            call(tmp_path / f"{'a' * 300}.npz")


def test_what_a_killed_save_left_is_gone_after_the_next(tmp_path):
    """And what another process that runs is writing stays."""
    motion = vp.Trajectory.load(DATA / "trajectory.npz")
    words = "import os, pathlib, signal, sys\nfrom varpin.io.archive import atomic_file\n"
    words += "with atomic_file(pathlib.Path(sys.argv[1])): os.kill(os.getpid(), signal.SIGKILL)"
    subprocess.run([sys.executable, "-c", words, tmp_path / "a.npz"], check=False)
    assert len(list(tmp_path.iterdir())) == 1
    running = tmp_path / f".varpin-{socket.gethostname()}-{os.getppid()}-0123456789abcdef"
    running.touch()
    motion.save(tmp_path / "a.npz")
    assert sorted(path.name for path in tmp_path.iterdir()) == [running.name, "a.npz"]


@pytest.fixture(scope="module")
def motion() -> vp.Trajectory:
    scene = vp.Scene(vp.planar_chain(2), damping=0.1, actuation=["joint2"])
    return vp.simulate(scene, [0.1, 0.2], [1.0, -1.0], dt=0.01, steps=20, controls=lambda t, q, v: [np.sin(t)])


def still(motion: vp.Trajectory) -> vp.Trajectory:
    return vp.simulate(vp.Scene(vp.planar_chain(1), actuation=[]), [0.3], [0.0], dt=0.01, steps=0)


def away(motion: vp.Trajectory) -> vp.Trajectory:
    """Energies overflow long before velocities do."""
    start, step = ([0.1, 0.2], [1e300, -1e300]), {"dt": 1e-3, "steps": 3, "integrator": vp.ExplicitEuler()}
    with pytest.raises(vp.StepFailure) as caught:
        vp.simulate(vp.Scene(vp.planar_chain(2)), *start, **step)
    assert not np.isfinite(caught.value.trajectory.energy).all()
    return caught.value.trajectory


def with_odd_statistics(motion: vp.Trajectory) -> vp.Trajectory:
    odd = np.resize([np.inf, -np.inf, np.nan, 0.0], motion.steps)
    own = dataclasses.replace(motion.statistics, energy_defect=odd, residual=odd, branch_margin=odd)
    return dataclasses.replace(motion, statistics=own)


def with_odd_names(motion: vp.Trajectory) -> vp.Trajectory:
    return dataclasses.replace(motion, robot="Häßlich 臂", joint_names=("épaule", "肘"))


@pytest.mark.parametrize("make", [still, away, with_odd_statistics, with_odd_names])
def test_odd_motions_come_back_to_the_last_bit(make, motion, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    odd = make(motion)
    odd.save("~/ünï")
    back = vp.Trajectory.load("~/ünï")
    assert same(back, odd)
    for own in (odd, odd.statistics, back, back.statistics):
        for array in (each for each in vars(own).values() if isinstance(each, np.ndarray)):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
    with pytest.raises(dataclasses.FrozenInstanceError):
        back.dt = 1.0


def test_saving_that_fails_leaves_the_old_file(motion, tmp_path, monkeypatch):
    saved = motion.save(tmp_path / "run.npz")
    before = saved.read_bytes()

    def fail(stream, **members):
        stream.write(b"half a file")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with refused(vp.FileError, "No space left on device"):
        motion.save(saved)
    assert saved.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [saved.name]


def test_places_of_files(motion, tmp_path):
    """Replacing a pipe would turn /dev/null into a file; a link is kept, and so is the umask."""
    pipe, real, link = (tmp_path / name for name in ("pipe", "real.npz", "link.npz"))
    os.mkfifo(pipe)
    for path, fact in ((pipe, "device"), (tmp_path, "folder"), (tmp_path / "no" / "a.npz", "no"), ("/proc/a", "/proc")):
        with refused(vp.FileError, fact):
            motion.save(path)
    assert pipe.is_fifo()
    real.write_bytes(b"old")
    link.symlink_to(real)
    old = os.umask(0o027)
    try:
        motion.save(link)
        motion.save(tmp_path / "new.npz")
    finally:
        os.umask(old)
    assert link.is_symlink()
    assert vp.Trajectory.load(real).steps == 20
    assert (tmp_path / "new.npz").stat().st_mode & 0o777 == 0o640


def test_robots_of_motions_are_told_apart(motion, tmp_path):
    """The UR arms share their joint names; their links weigh differently."""
    small, other = vp.load_robot("ur5"), vp.load_robot("ur10")
    path = vp.simulate(vp.Scene(small), np.zeros(6), np.zeros(6), dt=1e-3, steps=3).save(tmp_path / "a.npz")
    assert vp.Trajectory.load(path, small).steps == 3
    for robot, facts in (
        (other, ("ur5", "'ur10'", "kg", "payloads", "--robot")),
        (vp.planar_chain(3), ("ur5", "'chain3'", "elbow_joint")),
    ):
        with refused(vp.FileError, *facts):
            vp.Trajectory.load(path, robot)
    with refused(vp.InputError, "robot", "load_robot", "str"):
        vp.Trajectory.load(path, "finger")


def problem_of(
    *, noise=None, damping=0.2, dt=0.02, weight=0.1, integrator=None, q0=(0.4, -0.3), mass=1.0, forces=()
) -> vp.OptimalControlProblem:
    scene = vp.Scene(vp.planar_chain(2, mass=mass), damping=damping, noise=noise, forces=forces)
    cost = vp.TrackingCost([0.8, 0.1], 10.0) + vp.ControlCost(weight) + vp.Terminal(vp.VelocityCost(1.0))
    return vp.OptimalControlProblem(scene, cost, q0, [0.0, 0.0], dt=dt, steps=round(0.6 / dt), integrator=integrator)


@pytest.mark.parametrize(
    ("other", "of_file", "of_plan"),
    [
        ({"dt": 0.03}, "0.03", "0.03"),
        ({"q0": (0.4, -0.2)}, "q0", "q0"),
        ({"weight": 0.2}, "cost", "cost"),
        ({"damping": 0.3}, "damping", "damping"),
        ({"noise": vp.AdditiveNoise(0.1)}, "noise", "noise"),
        ({"integrator": vp.Midpoint(alpha=0.4)}, "integrator", "integrator"),
        ({"mass": 2.0}, "links", "scene"),
        ({"forces": vp.CoulombFriction(1e-3, 1.0)}, "scene", "scene"),
        ({"forces": vp.Armature(0.1)}, "scene", "armature"),
        ({"forces": vp.FrameWrench("tip", (0.0, 0.0, 0.1, 0.0, 0.0, 0.0))}, "scene", "scene"),
    ],
)
def test_a_solution_of_another_problem_is_refused(other, of_file, of_plan, tmp_path):
    pair = [problem_of(), problem_of(**other)]
    for mine, theirs in (pair, pair[::-1]):
        plan = vp.solve(mine, max_iterations=1, second_order=True, check=False)
        path = plan.save(tmp_path / "plan.npz")
        assert vp.Solution.load(path, mine).cost == plan.cost
        with refused(vp.FileError, of_file):
            vp.Solution.load(path, theirs)
        with refused(vp.InputError, of_plan):
            vp.solve(theirs, resume=plan)


# --- what leaves the process comes back as it was: the same bytes, arrays of the same kind ---------------------------


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
    writable = {where: array.flags.writeable for where, array in arrays_in(x).items()}
    copy.copy(x)
    assert writable == {where: array.flags.writeable for where, array in arrays_in(x).items()}
    for way in WAYS:
        back = way(x)
        for where, array in arrays_in(back).items():
            own = arrays_in(x)[where]
            assert array.tobytes() == own.tobytes(), where
            assert not array.flags.writeable, where
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


def numbers(plan):
    return [plan.controls, plan.gains, plan.feedforward, plan.gradient, plan.cost, plan.status, plan.reason]


def test_problems_plans_controllers_and_ensembles_go_round():
    problem = problem_of(noise=vp.AdditiveNoise(1e-2))
    plan = vp.solve(problem, max_iterations=3)
    goes_round(problem, lambda own: numbers(vp.solve(own, max_iterations=3)))
    goes_round(plan, lambda own: numbers(vp.solve(own.problem, resume=own, max_iterations=6)))
    goes_round(plan, lambda own: repr(own.monte_carlo(20, rng=1)))
    quiet = problem_of()
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
