"""Work on other processes and machines: the bytes of threads, and little on the way."""

import logging
import multiprocessing
import os
import pickle
import signal
import tracemalloc
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import coal
import numpy as np
import pinocchio as pin
import pytest
from findings import about
from refusals import refused
from test_ensemble import make_scene, run, same_ensembles

import varpin as vp
from varpin.support.executors import executing, in_order


@pytest.fixture(scope="module", params=["fork", "spawn"])
def pool(request):
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context(request.param)) as opened:
        yield opened


@pytest.fixture(scope="module")
def spawned():
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as opened:
        yield opened


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
    same_ensembles(run(paths=300, store=store, **options), threads)
    assert calls[-1] == (300, 300)
    assert rng.spawn(1)[0].random() == np.random.default_rng(7).spawn(301)[300].random()
    assert len(calls) > 2
    with ThreadPoolExecutor(2) as other:
        same_ensembles(run(paths=300, store=store, executor=other), threads)


def test_nothing_comes_back_that_was_not_asked_for():
    shipping = Shipping()
    paths, steps = 2000, 50
    end = run(paths=paths, steps=steps, store=False, quantiles=(), executor=shipping)
    same_ensembles(end, run(paths=paths, steps=steps, store=False, quantiles=()))
    numbers = (steps + 1) * (1 + 5 + 16 + 1)
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


def test_monte_carlo_on_processes(spawned):
    plan = plan_of(make_scene())
    calls = []
    found = plan.monte_carlo(300, 1, executor=spawned, progress=lambda *done: calls.append(done))
    assert found == plan.monte_carlo(300, 1, workers=2) == plan.monte_carlo(300, 1, workers=1)
    assert calls[-1] == (300, 300)
    shipping = Shipping()
    assert plan.monte_carlo(300, 1, executor=shipping) == found
    assert shipping.returned < 300 * 8 + 3000 * shipping.sent


def test_references_in_place_are_sampled_before_they_are_sent(spawned):
    plan = plan_of(make_scene(), goal=lambda t: [0.1 * t, 0.0])
    assert plan.monte_carlo(50, 1, executor=spawned) == plan.monte_carlo(50, 1)


def test_monte_carlo_tells_of_what_its_paths_do(caplog):
    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(0.1))
    plan = plan_of(scene, [1.5, 0.0], dt=0.1, integrator=vp.ExplicitEuler())
    with caplog.at_level(logging.WARNING, "varpin.control.monte_carlo"):
        found = plan.monte_carlo(60, 0)
    assert about(found.warnings, "error")

    def interrupt(done, paths):
        raise KeyboardInterrupt

    with pytest.raises(vp.MonteCarloInterrupted) as caught:
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
    with ProcessPoolExecutor(1) as pool, refused(vp.WorkersLost, "lost", ".ensemble") as caught:
        vp.simulate_ensemble(scene, q0, [0.0], paths=300, rng=0, executor=pool, **options)
    assert isinstance(caught.value.__cause__, BrokenProcessPool)
    kept = caught.value.ensemble
    assert 100 < len(kept.q) < 300
    motion = vp.simulate(scene, q0[7], [0.0], check=False, **options)
    assert kept.q[7].tobytes() == motion.q.tobytes()
    assert pickle.loads(pickle.dumps(caught.value)).ensemble.q.shape == kept.q.shape


def test_workers_or_executor(spawned):
    with refused(vp.InputError, "executor", "workers"):
        run(workers=2, executor=spawned)
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
        same_ensembles(run(paths=300, executor=executor), run(paths=300))
        assert plan.monte_carlo(100, 1, executor=executor) == plan.monte_carlo(100, 1)
        killed = []

        def kill(done, paths):
            if not killed:
                killed.append(next(iter(client.run(os.getpid).values())))
                os.kill(killed[0], signal.SIGKILL)

        end = run(paths=3000, store=False, executor=executor, progress=kill)
    assert killed
    same_ensembles(end, run(paths=3000, store=False))


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


def test_what_work_raises_comes_back(spawned):
    results = in_order(spawned, failing, range(5))
    assert [next(results), next(results)] == [0, 1]
    with refused(vp.UnknownJoint, "elbow"):
        next(results)
    # The pool is as good as before.
    assert list(in_order(spawned, abs, [-1, 2])) == [1, 2]
