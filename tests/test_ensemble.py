"""Ensembles: the same bytes wherever they are computed, statistics against NumPy, failures, Ctrl-C and bad input."""

import logging
import multiprocessing
import os
import pickle
import signal
import tracemalloc
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import fields

import coal
import numpy as np
import pinocchio as pin
import pytest
from findings import about
from oracles import same
from refusals import naming, refused

import varpin as vp
import varpin.ensemble
from varpin.support.executors import executing, in_order

ARRAYS = ("q", "v", "p", "u", "energy")
START = {"q0": [0.3, -0.2], "v0": [0.0, 1.0]}


def make_scene():
    noise = vp.AdditiveNoise(0.3) + vp.ControlNoise(0.2) + vp.StateNoise(0.1)
    return vp.Scene(vp.planar_chain(2), damping=0.2, stiffness=3.0, noise=noise)


def run(scene=None, **options):
    given = {"dt": 0.01, "steps": 50, "paths": 40, "rng": 7, "controls": [0.3, -0.1], **START} | options
    return vp.simulate_ensemble(make_scene() if scene is None else scene, **given)


def same_statistics(one, other, tolerance=0.0):
    for item in fields(one.statistics):
        a, b = getattr(one.statistics, item.name), getattr(other.statistics, item.name)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance, equal_nan=True)


def same_paths(some, whole):
    """The paths of an ensemble are the first ones of another, to the last bit."""
    for name in ARRAYS:
        mine, other = getattr(some, name), getattr(whole, name)
        assert same(mine, other if mine is None else other[: len(mine)]), name
    assert same(some.t, whole.t)


@pytest.mark.parametrize("kick", ["left", "split"])
def test_same_bytes_for_any_number_of_workers(kick):
    integrator, calls = vp.Midpoint(kick=kick), []
    one, two = (run(paths=200, workers=w, integrator=integrator) for w in (1, 2))
    seven = run(paths=200, workers=7, integrator=integrator, progress=lambda *done: calls.append(done))
    assert calls == [(96, 200), (192, 200), (200, 200)]
    for other in (two, seven):
        assert same(other, one)


def test_a_few_long_paths_are_work_for_four():
    calls = []
    run(paths=64, steps=300, workers=1, progress=lambda *done: calls.append(done))
    assert calls == [(16, 64), (32, 64), (48, 64), (64, 64)]


def test_same_bytes_for_one_path_or_a_thousand():
    many, few, one = (run(paths=paths) for paths in (1000, 45, 1))
    same_paths(few, many)
    same_paths(one, many)
    assert len(np.unique(many.q[:, -1, 0])) == 1000
    assert not one.statistics.covariance.any()
    assert not one.statistics.energy_deviation.any()
    assert (one.statistics.count == 1).all()


def controls_of(kind):
    rng = np.random.default_rng(1)
    policy = rng.normal(size=(10, 2)), -np.abs(rng.normal(size=(10, 2, 4))), rng.normal(size=(11, 4))
    before = {"previous_gains": 0.4 * rng.normal(size=(10, 2, 2)), "previous": rng.normal(size=(10, 2))}
    return {
        "constant": [0.3, -0.1],
        "linear": vp.FirstOrderHold(rng.normal(size=(51, 2))),
        "feedback": vp.LinearPolicy(*policy, hold=5),
        "feedback once a period": vp.LinearPolicy(*policy, period=0.05),
        "feedback on the control before": vp.LinearPolicy(*policy, hold=5, limits=(-0.8, 0.8), **before),
        "and on the first": vp.LinearPolicy(*policy, hold=5, before=[0.7, -0.3], **before),
    }[kind]


@pytest.mark.parametrize("kick", ["left", "split"])
@pytest.mark.parametrize(
    "kind",
    ["constant", "linear", "feedback", "feedback once a period", "feedback on the control before", "and on the first"],
)
def test_paths_are_simulations_from_the_children_of_the_generator(kind, kick):
    scene, (q0, v0) = make_scene(), np.random.default_rng(0).normal(size=(2, 40, 2))
    options = {"dt": 0.01, "steps": 50, "controls": controls_of(kind), "integrator": vp.Midpoint(kick=kick)}
    end = run(scene, rng=np.random.default_rng(7) if kind == "linear" else 7, q0=q0, v0=v0, **options)
    for path, child in enumerate(np.random.default_rng(7).spawn(40)):
        alone = vp.simulate(scene, q0[path], v0[path], rng=child, **options)
        for name in ARRAYS:
            assert getattr(end, name)[path].tobytes() == getattr(alone, name).tobytes()
    np.testing.assert_array_equal(end.t, alone.t)


def check_statistics(end):
    """By NumPy, node by node, over the paths that are not NaN there."""
    own, x = end.statistics, np.concatenate([end.q, end.p], axis=2)
    for j in range(x.shape[1]):
        good = ~np.isnan(end.energy[:, j])
        at, energy = x[good, j], end.energy[good, j]
        covariance = np.cov(at.T)
        assert own.count[j] == good.sum()
        np.testing.assert_allclose(own.mean[j], at.mean(axis=0), rtol=0, atol=1e-13)
        np.testing.assert_allclose(own.covariance[j], covariance, rtol=0, atol=1e-13 * max(1, np.abs(covariance).max()))
        np.testing.assert_array_equal(own.quantiles[:, j], np.quantile(at, own.levels, axis=0))
        assert own.energy_mean[j] == pytest.approx(energy.mean(), rel=1e-13)
        assert own.energy_deviation[j] == pytest.approx(energy.std(ddof=1), rel=1e-10, abs=1e-12)


def test_statistics_are_those_of_the_stored_paths():
    end = run(quantiles=[0.0, 0.1, 0.5, 1.0])
    np.testing.assert_array_equal(end.statistics.levels, [0.0, 0.1, 0.5, 1.0])
    check_statistics(end)
    assert end.statistics.covariance[-1].trace() > 1e-3
    assert run(quantiles=[]).statistics.quantiles.shape == (0, 51, 4)


def test_statistics_do_not_need_stored_paths():
    lean = run(store=False)
    assert all(getattr(lean, name) is None for name in ARRAYS)
    same_statistics(lean, run())


# Without halvings a coarse step fails on a chain that falls from the horizontal, and never on one that hangs still.
FRAGILE = {"dt": 0.05, "steps": 60, "integrator": vp.Midpoint(guard=vp.Guard(max_halvings=0)), "controls": None}


def fragile_scene(links=3):
    return vp.Scene(vp.planar_chain(links), noise=vp.AdditiveNoise(1e-2))


def starts(paths):
    """Every third path falls, from another height each."""
    q0 = np.zeros((paths, 3))
    q0[:, 0] = np.pi / 2
    q0[::3, 0] = np.linspace(-0.5, 0.5, len(q0[::3]))
    return q0


def test_failing_paths_are_left_out_from_where_they_fail(caplog):
    options = FRAGILE | {"paths": 40, "q0": starts(40), "v0": np.zeros(3)}
    with caplog.at_level(logging.WARNING, "varpin.ensemble"):
        end = run(fragile_scene(), **options)
    assert naming(end.warnings, "40 paths")
    failed = {failure.path: failure for failure in end.failures}
    steps = {path: failure.step for path, failure in failed.items()}
    assert len(set(steps.values())) >= 3
    assert set(steps) <= set(range(0, 40, 3))
    assert len(steps) == len(end.failures)
    first = min(end.failures, key=lambda failure: failure.step)
    assert naming(caplog.messages, f"{len(steps)} of 40 paths", f"step {first.step}", first.reason)
    for path, child in enumerate(np.random.default_rng(7).spawn(40)):
        done = steps.get(path, 60)
        for name in ("q", "v", "p", "energy"):
            assert np.isfinite(getattr(end, name)[path, : done + 1]).all()
            assert np.isnan(getattr(end, name)[path, done + 1 :]).all()
        assert np.isfinite(end.u[path, :done]).all()
        assert np.isnan(end.u[path, done:]).all()
        alone = {"dt": 0.05, "steps": 60, "rng": child, "integrator": FRAGILE["integrator"]}
        if path in failed:
            with pytest.raises(vp.StepFailure) as caught:
                vp.simulate(fragile_scene(), starts(40)[path], np.zeros(3), **alone)
            assert caught.value.step == failed[path].step
            assert caught.value.reason == failed[path].reason
            assert caught.value.trajectory.p.tobytes() == end.p[path, : done + 1].tobytes()
    assert end.statistics.count.tolist() == [40 - sum(step < j for step in steps.values()) for j in range(61)]
    check_statistics(end)
    same_statistics(run(fragile_scene(), store=False, **options), end, 1e-13)


def test_all_paths_failing_is_an_error():
    options = FRAGILE | {"paths": 6, "q0": starts(40)[:18:3], "v0": np.zeros(3)}
    with refused(vp.VarpinError, "6 of 6") as caught:
        run(fragile_scene(), **options)
    assert type(caught.value) is vp.VarpinError


def test_interruption_keeps_what_is_done():
    def interrupt(done, total):
        if done == 192:
            raise KeyboardInterrupt

    with refused(vp.PathsInterrupted) as caught:
        run(paths=3000, progress=interrupt, workers=1)
    assert isinstance(caught.value, KeyboardInterrupt)
    part, whole = caught.value.result, run(paths=3000)
    kept = len(part.q)
    assert 192 <= kept < 3000
    assert f"{kept} paths" in str(caught.value)
    same_paths(part, whole)
    check_statistics(part)
    assert part.statistics.count.tolist() == [kept] * 51


def test_interruption_before_anything_is_done(monkeypatch):
    monkeypatch.setattr(varpin.ensemble.paths, "simulate_paths", stop)
    with refused(vp.PathsInterrupted, "0") as caught:
        run()
    assert caught.value.result is None


def test_quantiles_of_very_many_paths_are_those_of_the_first(monkeypatch):
    whole = run(paths=300, steps=20)
    monkeypatch.setattr(varpin.ensemble.run, "_KEPT", 100 * 21 * 4)
    found = run(paths=300, steps=20, store=False, workers=3).statistics
    assert (whole.statistics.quantile_paths, found.quantile_paths) == (300, 100)
    np.testing.assert_array_equal(found.quantiles, run(paths=100, steps=20).statistics.quantiles)
    np.testing.assert_array_equal(found.mean, whole.statistics.mean)


COARSE = {"dt": 0.05, "steps": 40, "controls": None, "integrator": vp.ExplicitEuler(), "store": False}


def test_a_coarse_step_is_told_of(caplog):
    scene = fragile_scene(2)
    with caplog.at_level(logging.WARNING, "varpin.ensemble"):
        end, again = run(scene, **COARSE), run(scene, **COARSE)
    assert naming(about(end.warnings, "error"), "joint2", "varpin.Gauss(6)")
    assert all(warning.startswith("path ") for warning in end.warnings)
    assert again.warnings == end.warnings
    # Once in the log, and in every form of the result.
    assert [record.getMessage() for record in caplog.records] == list(end.warnings)
    assert repr(end).endswith(", 1 warning)")
    for warning in end.warnings:
        assert f"warning: {warning}" in str(end)
        assert about(end._repr_html_(), "error")
    assert run(fragile_scene(2), dt=1e-3).warnings == ()


def stop(*given):
    raise KeyboardInterrupt


def test_an_interrupted_ensemble_carries_warnings(monkeypatch):
    """Those of the same ensemble of as many paths; without a look after a second Ctrl-C."""
    scene = fragile_scene(2)
    with pytest.raises(vp.PathsInterrupted) as caught:
        run(scene, **COARSE | {"paths": 300}, progress=lambda done, total: stop())
    part = caught.value.result
    assert part.warnings == run(scene, **COARSE | {"paths": int(part.statistics.count[0])}).warnings != ()
    monkeypatch.setattr(varpin.ensemble.paths, "examine", stop)
    with pytest.raises(vp.PathsInterrupted) as caught:
        run(scene, **COARSE | {"paths": 300}, progress=lambda done, total: stop())
    assert caught.value.result.warnings == ()


def test_the_paths_that_stand_out_are_looked_at():
    v0 = np.zeros((200, 2))
    v0[137] = 60.0
    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(1e-3))
    end = run(scene, paths=200, v0=v0, dt=0.01, steps=20, store=False)
    assert any(warning.startswith("path 137: ") for warning in end.warnings)


def policy(*shape):
    return vp.LinearPolicy(np.ones(shape[:2]), np.ones(shape), np.ones((shape[0], shape[2])))


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({"scene": "chain"}, ("scene", "varpin.Scene", "str")),
        ({"steps": 10**14}, ("100000000000000", "40")),
        ({"paths": 0}, ("paths", "1", "0")),
        ({"q0": np.zeros((39, 2))}, ("q0", "(40, 2)", "(39, 2)")),
        ({"quantiles": [0.5, 1.5]}, ("quantiles", "[0, 1]", "[0.5, 1.5]")),
        ({"duration": 1.0}, ("dt", "steps", "duration", "all three")),
        ({"workers": 0}, ("workers", "1", "0")),
        ({"controls": policy(49, 2, 4)}, ("49", "1", "50")),
        ({"controls": policy(50, 1, 4)}, ("gains", "(N, 2, 4)", "(50, 1, 4)")),
        ({"controls": policy(50, 2, 6)}, ("gains", "(N, 2, 4)", "(50, 2, 6)")),
    ],
)
def test_bad_input(options, facts):
    with refused(vp.InputError, facts):
        run(**options)


def test_noise_in_python_is_that_of_the_core():
    scenes = [
        vp.Scene(vp.planar_chain(2), damping=0.2, noise=noise)
        for noise in (vp.AdditiveNoise(0.3), vp.CustomNoise(lambda q, v, u: 0.3 * np.eye(2), 2))
    ]
    core, python = (run(scene, paths=5, steps=10) for scene in scenes)
    np.testing.assert_allclose(python.q, core.q, rtol=1e-12)
    same_statistics(python, core, 1e-12)


def test_a_noise_that_fails_names_its_path():
    far = vp.CustomNoise(lambda q, v, u: np.full((2, 2), np.nan if q[0] > 0.4 else 0.3), 2)
    q0 = np.outer(np.arange(5) == 3, [0.39, 0.0])
    with refused(vp.simulation.failures.NoiseError, "path 3: ", "nan") as caught:
        run(vp.Scene(vp.planar_chain(2), noise=far), paths=5, steps=10, q0=q0)
    assert caught.value.trajectory.steps == caught.value.step > 0


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("store", [True, False])
def test_paths_that_blow_up_leave_no_warning_of_numpy(store):
    """Euler's method far beyond its stability: velocities grow to 1e150 and more, and their squares are infinite."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, stiffness=1e5, noise=vp.AdditiveNoise(1.0))
    task = {"dt": 1e-2, "steps": 100, "paths": 200, "rng": 0, "integrator": vp.SemiImplicitEuler(), "store": store}
    end = vp.simulate_ensemble(scene, [0.0], [1e8], **task)
    assert end.statistics.count[-1] == 200
    assert not np.isfinite(end.statistics.energy_deviation[-1])
    np.testing.assert_allclose(end.statistics.mean[1, 0], 1e-2 * 1e8, rtol=1e-6)


@pytest.mark.parametrize("store", [True, False])
def test_a_file_gives_the_ensemble_back(store, tmp_path):
    found = run(fragile_scene(), **FRAGILE | {"paths": 9, "q0": starts(9), "v0": np.zeros(3), "store": store})
    path = found.save(tmp_path / "ensemble.npz")
    again = vp.Ensemble.load(path)
    assert found.failures
    assert str(again) == str(found)
    assert same(again, found)
    with np.load(path) as members:
        np.savez(path, **dict(members) | {"t": np.zeros(3)})
    with pytest.raises(vp.FileError, match="instead of float64"):
        vp.Ensemble.load(path)


# --- on other processes and machines: the bytes of threads, and little on the way ------------------------------------


@pytest.fixture(scope="module", params=["spawn", "fork"])
def pool(request):
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context(request.param)) as opened:
        yield opened


spawned = pytest.mark.parametrize("pool", ["spawn"], indirect=True)


class Shipping(Executor):
    """Takes tasks and gives results as bytes, in this process, and counts them."""

    def __init__(self):
        self.sent, self.returned, self.most = 0, 0, 0

    def submit(self, fn, /, *args, **kwargs):
        task = pickle.dumps((fn, args, kwargs))
        fn, args, kwargs = pickle.loads(task)
        answer = pickle.dumps(fn(*args, **kwargs))
        self.sent, self.returned, self.most = self.sent + 1, self.returned + len(answer), max(self.most, len(task))
        done = Future()
        done.set_result(pickle.loads(answer))
        return done


@pytest.mark.parametrize("store", [True, False])
def test_processes_give_the_bytes_of_threads(pool, store):
    calls = []
    threads = run(paths=300, store=store, workers=3)
    rng = np.random.default_rng(7)
    options = {"executor": pool, "rng": rng, "progress": lambda *done: calls.append(done)}
    assert same(run(paths=300, store=store, **options), threads)
    assert calls[-1] == (300, 300)
    assert rng.spawn(1)[0].random() == np.random.default_rng(7).spawn(301)[300].random()
    assert len(calls) > 2
    with ThreadPoolExecutor(2) as other:
        assert same(run(paths=300, store=store, executor=other), threads)


def test_nothing_comes_back_that_was_not_asked_for():
    shipping = Shipping()
    paths, steps = 2000, 50
    end = run(paths=paths, steps=steps, store=False, quantiles=(), executor=shipping)
    assert same(end, run(paths=paths, steps=steps, store=False, quantiles=()))
    numbers = (steps + 1) * (1 + 5 + 25)
    assert shipping.sent >= 10
    assert shipping.returned < shipping.sent * (8 * numbers + 5000) + 8 * paths
    assert shipping.most < 50_000
    whole = Shipping()
    run(paths=paths, steps=steps, executor=whole)
    assert whole.returned > 8 * paths * steps * 9


def test_meshes_stay_at_home():
    visuals, mesh = pin.GeometryModel(), coal.BVHModelOBBRSS()
    mesh.beginModel(20_000, 60_000)
    mesh.addVertices(np.random.default_rng(0).normal(size=(60_000, 3)))
    mesh.endModel()
    visuals.addGeometryObject(pin.GeometryObject("mesh", 1, pin.SE3.Identity(), mesh))
    robot = vp.load_robot(pin.RobotWrapper(vp.planar_chain(2).model.copy(), visual_model=visuals))
    scene, shipping = vp.Scene(robot, noise=vp.AdditiveNoise(0.1)), Shipping()
    run(scene, executor=shipping)
    assert shipping.most < 50_000
    assert scene.robot.visuals is not None


def plan_of(scene, start=(0.0, 0.0), goal=(0.5, 0.2), **grid):
    cost = vp.ControlCost(1e-2) + vp.TrackingCost(goal, 0.1) + vp.Terminal(vp.TrackingCost(goal, 10.0))
    given = {"dt": 0.02, "steps": 20} | grid
    return vp.solve(vp.OptimalControlProblem(scene, cost, start, [0.0, 0.0], **given), max_iterations=2)


@spawned
def test_monte_carlo_on_processes(pool):
    plan = plan_of(make_scene())
    calls = []
    found = plan.monte_carlo(300, 1, executor=pool, progress=lambda *done: calls.append(done))
    assert found == plan.monte_carlo(300, 1, workers=2) == plan.monte_carlo(300, 1, workers=1)
    assert calls[-1] == (300, 300)
    shipping = Shipping()
    assert plan.monte_carlo(300, 1, executor=shipping) == found
    assert shipping.returned < 300 * 8 + 3000 * shipping.sent


@spawned
def test_references_in_place_are_sampled_before_they_are_sent(pool):
    plan = plan_of(make_scene(), goal=lambda t: [0.1 * t, 0.0])
    assert plan.monte_carlo(50, 1, executor=pool) == plan.monte_carlo(50, 1)


def test_monte_carlo_tells_of_what_its_paths_do(caplog):
    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(0.1))
    plan = plan_of(scene, [1.5, 0.0], dt=0.1, integrator=vp.ExplicitEuler())
    with caplog.at_level(logging.WARNING, "varpin.control.monte_carlo"):
        found = plan.monte_carlo(60, 0)
    assert about(found.warnings, "error")

    def interrupt(done, paths):
        raise KeyboardInterrupt

    with pytest.raises(vp.PathsInterrupted) as caught:
        plan.monte_carlo(600, 0, progress=interrupt)
    assert about(caught.value.result.warnings, "error")
    for warning in found.warnings:
        assert f"warning: {warning}" in str(found)
    assert f"{len(found.warnings)} warning" in repr(found)
    assert about(found._repr_html_(), "error")


@pytest.mark.parametrize(("result_bytes", "ahead"), [(0, 256), (2**26, 32), (2**40, 2)])
def test_tasks_ahead_are_bounded_by_number_and_by_bytes(result_bytes, ahead):
    executor = Shipping()
    results = in_order(executor, abs, range(5000), result_bytes=result_bytes)
    assert next(results) == 0
    assert executor.sent == ahead
    results.close()


def deadly(q, v):
    if q[0] > 2.0:
        os._exit(1)
    return np.zeros(1)


def test_paths_that_were_finished_before_a_worker_was_lost_are_kept():
    scene, q0 = vp.Scene(vp.planar_chain(1), forces=[vp.CustomForce(deadly)]), np.linspace(-1.0, 0.0, 300)[:, None]
    q0[-1], options = 2.1, {"dt": 0.01, "steps": 20, "integrator": vp.ExplicitEuler()}
    with ProcessPoolExecutor(1) as pool, refused(vp.WorkersLost, "lost", ".result") as caught:
        vp.simulate_ensemble(scene, q0, [0.0], paths=300, rng=0, executor=pool, **options)
    assert isinstance(caught.value.__cause__, BrokenProcessPool)
    kept = caught.value.result
    assert 100 < len(kept.q) < 300
    motion = vp.simulate(scene, q0[7], [0.0], check=False, **options)
    assert kept.q[7].tobytes() == motion.q.tobytes()
    assert pickle.loads(pickle.dumps(caught.value)).result.q.shape == kept.q.shape


@spawned
def test_workers_or_executor(pool):
    with refused(vp.InputError, "executor", "workers"):
        run(workers=2, executor=pool)
    with refused(vp.InputError, "executor", "int"):
        run(executor=4)
    with executing(None, 2) as own:
        assert isinstance(own, ThreadPoolExecutor)


@pytest.mark.slow
def test_a_dask_cluster_gives_the_bytes_of_threads():
    distributed = pytest.importorskip("distributed")
    plan = plan_of(make_scene())
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        executor = client.get_executor()
        assert same(run(paths=300, executor=executor), run(paths=300))
        assert plan.monte_carlo(100, 1, executor=executor) == plan.monte_carlo(100, 1)
        killed = []

        def kill(done, paths):
            if not killed:
                killed.append(next(iter(client.run(os.getpid).values())))
                os.kill(killed[0], signal.SIGKILL)

        end = run(paths=3000, store=False, executor=executor, progress=kill)
    assert killed
    assert same(end, run(paths=3000, store=False))


@pytest.mark.slow
def test_many_paths_need_no_more_memory_than_few():
    """The peak of this process while 40 000 paths of 100 steps come back from a pool, over that of 4000."""

    def peak(paths):
        tracemalloc.start()
        with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
            end = run(vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(0.1)), paths=paths, steps=100,
                      store=False, quantiles=(), executor=pool)  # fmt: skip
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert end.statistics.count[-1] == paths
        return size

    few, many = peak(4000), peak(40_000)
    # A number or two for each path; paths themselves would take 100 times as much.
    assert many < few + 40_000 * 64


def failing(task):
    if task == 2:
        raise vp.UnknownJoint("elbow", ("knee",), "a robot")
    return task


@spawned
def test_what_work_raises_comes_back(pool):
    results = in_order(pool, failing, range(5))
    assert [next(results), next(results)] == [0, 1]
    with refused(vp.UnknownJoint, "elbow"):
        next(results)
    # The pool is as good as before.
    assert list(in_order(pool, abs, [-1, 2])) == [1, 2]
