"""Ensembles: the same bytes however they are computed, statistics against NumPy, failures, Ctrl-C and bad input."""

import logging
from dataclasses import fields

import numpy as np
import pytest
from findings import about
from refusals import naming, refused

import varpin as vp
import varpin.ensemble

ARRAYS = ("q", "v", "p", "u", "energy")
START = {"q0": [0.3, -0.2], "v0": [0.0, 1.0]}


def make_scene(strength=0.3, **options):
    noise = vp.AdditiveNoise(strength) + vp.ControlNoise(0.2) + vp.StateNoise(0.1)
    return vp.Scene(vp.planar_chain(2), damping=0.2, stiffness=3.0, noise=noise, **options)


def run(scene=None, **options):
    given = {"dt": 0.01, "steps": 50, "paths": 40, "rng": 7, "controls": [0.3, -0.1], **START} | options
    return vp.simulate_ensemble(make_scene() if scene is None else scene, **given)


def same_statistics(one, other, tolerance=0.0):
    for item in fields(one.statistics):
        a, b = getattr(one.statistics, item.name), getattr(other.statistics, item.name)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance, equal_nan=True)


@pytest.mark.parametrize("kick", ["left", "split"])
def test_same_bytes_for_any_number_of_workers(kick):
    integrator, calls = vp.Midpoint(kick=kick), []
    one, two = (run(paths=200, workers=w, integrator=integrator) for w in (1, 2))
    seven = run(paths=200, workers=7, integrator=integrator, progress=lambda *done: calls.append(done))
    # 4000 steps, twice as many, and then 96 paths.
    assert calls == [(80, 200), (176, 200), (200, 200)]
    for other in (two, seven):
        for name in ARRAYS:
            assert getattr(other, name).tobytes() == getattr(one, name).tobytes()
        same_statistics(other, one)


def test_same_bytes_for_one_path_or_a_thousand():
    many, few, one = (run(paths=paths) for paths in (1000, 45, 1))
    for name in ARRAYS:
        assert getattr(few, name).tobytes() == getattr(many, name)[:45].tobytes()
        assert getattr(one, name).tobytes() == getattr(many, name)[:1].tobytes()
    assert len(np.unique(many.q[:, -1, 0])) == 1000


@pytest.mark.parametrize("kick", ["left", "split"])
@pytest.mark.parametrize("seed", [7, "generator"])
def test_paths_are_simulations_from_the_children_of_the_generator(seed, kick):
    scene, integrator = make_scene(), vp.Midpoint(kick=kick)
    end = run(scene, rng=np.random.default_rng(7) if seed == "generator" else 7, integrator=integrator)
    for path, child in enumerate(np.random.default_rng(7).spawn(40)):
        options = {"dt": 0.01, "steps": 50, "controls": [0.3, -0.1], "integrator": integrator}
        if path % 2:
            alone = vp.simulate(scene, *START.values(), rng=child, **options)
        else:
            dw = child.normal(scale=0.1, size=(50, scene.processes))
            alone = vp.simulate(scene, *START.values(), increments=dw, **options)
        for name in ARRAYS:
            assert getattr(end, name)[path].tobytes() == getattr(alone, name).tobytes()
    np.testing.assert_array_equal(end.t, alone.t)


def test_each_path_may_have_its_own_start():
    q0, v0 = np.random.default_rng(0).normal(size=(2, 40, 2))
    end = run(q0=q0, v0=v0)
    np.testing.assert_array_equal(end.q[:, 0], q0)
    np.testing.assert_array_equal(end.v[:, 0], v0)
    for path, child in enumerate(np.random.default_rng(7).spawn(40)):
        alone = vp.simulate(make_scene(), q0[path], v0[path], dt=0.01, steps=50, rng=child, controls=[0.3, -0.1])
        assert end.p[path].tobytes() == alone.p.tobytes()


def test_without_noise_all_paths_are_one():
    end = run(vp.Scene(vp.planar_chain(2)), paths=3)
    options = {"dt": 0.01, "steps": 50, "controls": [0.3, -0.1]}
    alone = vp.simulate(vp.Scene(vp.planar_chain(2)), *START.values(), **options)
    assert end.integrator == alone.integrator == "Gauss(stages=2)"
    for path in range(3):
        assert end.q[path].tobytes() == alone.q.tobytes()
    assert np.abs(end.statistics.covariance).max() < 1e-28


def expected_statistics(x, energy, levels):
    """By NumPy, node by node, over the paths that are not NaN there."""
    for j in range(x.shape[1]):
        good = ~np.isnan(energy[:, j])
        deviation = energy[good, j].std(ddof=1)
        quantiles = np.quantile(x[good, j], levels, axis=0)
        yield good.sum(), x[good, j].mean(axis=0), np.cov(x[good, j].T), quantiles, energy[good, j].mean(), deviation


def check_statistics(end):
    own = end.statistics
    x = np.concatenate([end.q, end.p], axis=2)
    for j, (count, mean, covariance, quantiles, energy, deviation) in enumerate(
        expected_statistics(x, end.energy, own.levels)
    ):
        assert own.count[j] == count
        np.testing.assert_allclose(own.mean[j], mean, rtol=0, atol=1e-13)
        np.testing.assert_allclose(own.covariance[j], covariance, rtol=0, atol=1e-13 * max(1, np.abs(covariance).max()))
        np.testing.assert_array_equal(own.quantiles[:, j], quantiles)
        assert own.energy_mean[j] == pytest.approx(energy, rel=1e-13)
        assert own.energy_deviation[j] == pytest.approx(deviation, rel=1e-10, abs=1e-12)


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


def test_one_path_has_no_covariance():
    alone = run(paths=1).statistics
    assert not alone.covariance.any()
    assert not alone.energy_deviation.any()
    assert (alone.count == 1).all()


def feedback(scene, steps, seed=1):
    rng = np.random.default_rng(seed)
    m, n = scene.controls, scene.robot.dof
    gains = -np.abs(rng.normal(size=(steps, m, 2 * n)))
    return vp.LinearPolicy(rng.normal(size=(steps, m)), gains, rng.normal(size=(steps + 1, 2 * n)))


@pytest.mark.parametrize("kick", ["left", "split"])
def test_linear_feedback(kick):
    """Applied in the core, against single steps with the control worked out in NumPy."""
    scene, integrator = make_scene(actuation=["joint2"]), vp.Midpoint(kick=kick)
    policy = feedback(scene, 50)
    # The center of StateNoise must stay the same over single steps.
    noise = vp.AdditiveNoise(0.3) + vp.ControlNoise(0.2) + vp.StateNoise(0.1, center=START["q0"])
    single = vp.Scene(vp.planar_chain(2), damping=0.2, stiffness=3.0, noise=noise, actuation=["joint2"])
    end = run(scene, controls=policy, paths=3, integrator=integrator)
    whole = vp.simulate(
        scene, *START.values(), dt=0.01, steps=50, controls=policy, rng=np.random.default_rng(7).spawn(1)[0],
        integrator=integrator,
    )  # fmt: skip
    assert whole.p.tobytes() == end.p[0].tobytes()
    assert whole.u.tobytes() == end.u[0].tobytes()
    for path, child in enumerate(np.random.default_rng(7).spawn(3)):
        dw = child.normal(scale=0.1, size=(50, scene.processes))
        q, v = (np.array(value) for value in START.values())
        p = vp.lagrangian_jet(scene, q, v).Lv
        for k in range(50):
            u = policy.u[k] + policy.gains[k] @ (np.concatenate([q, p]) - policy.reference[k])
            np.testing.assert_allclose(end.u[path, k], u, rtol=0, atol=1e-10)
            step = vp.simulate(
                single, q, v, dt=0.01, steps=1, controls=u, increments=dw[k : k + 1], integrator=integrator
            )
            q, v, p = step.q[1], step.v[1], step.p[1]
            np.testing.assert_allclose(end.q[path, k + 1], q, rtol=0, atol=1e-10)
            np.testing.assert_allclose(end.p[path, k + 1], p, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("shape", "facts"),
    [
        ((49, 2, 4), ("49", "1", "50")),
        ((50, 1, 4), ("gains", "(N, 2, 4)", "(50, 1, 4)")),
        ((50, 2, 6), ("gains", "(N, 2, 4)", "(50, 2, 6)")),
    ],
)
def test_policies_that_do_not_fit_the_scene(shape, facts):
    steps, m, size = shape
    policy = vp.LinearPolicy(np.ones((steps, m)), np.ones(shape), np.ones((steps, size)))
    with refused(vp.InputError, facts):
        run(controls=policy)


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
        if done == 176:
            raise KeyboardInterrupt

    with refused(vp.EnsembleInterrupted) as caught:
        run(paths=3000, progress=interrupt, workers=1)
    assert isinstance(caught.value, KeyboardInterrupt)
    part, whole = caught.value.ensemble, run(paths=3000)
    kept = len(part.q)
    assert 176 <= kept < 3000
    assert f"{kept} paths" in str(caught.value)
    assert part.t.tobytes() == whole.t.tobytes()
    for name in ARRAYS:
        assert getattr(part, name).tobytes() == getattr(whole, name)[:kept].tobytes()
    check_statistics(part)
    assert part.statistics.count.tolist() == [kept] * 51


def test_interruption_before_anything_is_done(monkeypatch):
    def stop(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(varpin.ensemble.run, "simulate_paths", stop)
    with refused(vp.EnsembleInterrupted, "0") as caught:
        run()
    assert caught.value.ensemble is None


def test_quantiles_of_very_many_paths_are_those_of_the_first(monkeypatch):
    whole = run(paths=300, steps=20)
    monkeypatch.setattr(varpin.ensemble.statistics, "_KEPT", 100 * 21 * 4)
    found = run(paths=300, steps=20, store=False, workers=3).statistics
    assert (whole.statistics.quantile_paths, found.quantile_paths) == (300, 100)
    np.testing.assert_array_equal(found.quantiles, run(paths=100, steps=20).statistics.quantiles)
    np.testing.assert_array_equal(found.mean, whole.statistics.mean)


def test_a_coarse_step_is_told_of(caplog):
    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(1e-2))
    coarse = {"dt": 0.05, "steps": 40, "controls": None, "integrator": vp.ExplicitEuler(), "store": False}
    with caplog.at_level(logging.WARNING, "varpin.ensemble"):
        end = run(scene, **coarse)
        again = run(scene, **coarse)
    assert naming(about(end.warnings, "error"), "joint2", "varpin.Gauss(3)")
    assert all(warning.startswith("path ") for warning in end.warnings)
    assert again.warnings == end.warnings
    # Once in the log, and in every form of the result.
    assert [record.getMessage() for record in caplog.records] == list(end.warnings)
    assert repr(end).endswith(", 1 warning)")
    for warning in end.warnings:
        assert f"warning: {warning}" in str(end)
        assert about(end._repr_html_(), "error")
    assert run(vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(1e-2)), dt=1e-3).warnings == ()


COARSE = {"dt": 0.05, "steps": 40, "controls": None, "integrator": vp.ExplicitEuler(), "store": False}


def test_the_worst_path_of_few_is_told_of():
    """One falls among others that hang, and tremble in errors of their own."""
    q0 = np.tile([-np.pi / 2, 0.0], (5, 1))
    q0[3, 0] = 0.0
    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(1e-9))
    end = run(scene, **COARSE | {"paths": 5, "q0": q0, "v0": np.zeros((5, 2))})
    assert about(end.warnings, "error")[0].startswith("path 3: ")


def test_an_interrupted_ensemble_carries_warnings(monkeypatch):
    """Those of the same ensemble of as many paths; without a look after a second Ctrl-C."""

    def interrupt(done, total):
        raise KeyboardInterrupt

    def stop(*given):
        raise KeyboardInterrupt

    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(1e-2))
    with pytest.raises(vp.EnsembleInterrupted) as caught:
        run(scene, **COARSE | {"paths": 300}, progress=interrupt)
    part = caught.value.ensemble
    assert part.warnings == run(scene, **COARSE | {"paths": int(part.statistics.count[0])}).warnings != ()
    monkeypatch.setattr(varpin.ensemble.looks, "_examine", stop)
    with pytest.raises(vp.EnsembleInterrupted) as caught:
        run(scene, **COARSE | {"paths": 300}, progress=interrupt)
    assert caught.value.ensemble.warnings == ()


def test_the_paths_that_stand_out_are_looked_at():
    """One of 200 starts so fast that its steps are taken in parts."""
    v0 = np.zeros((200, 2))
    v0[137] = 60.0
    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(1e-3))
    end = run(scene, paths=200, v0=v0, dt=0.01, steps=20, store=False)
    assert any(warning.startswith("path 137: ") for warning in end.warnings)


CUSTOM = vp.CustomNoise(lambda q, v, u: np.eye(2), 2)


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({"scene": "chain"}, ("scene", "varpin.Scene", "str")),
        ({"scene": vp.Scene(vp.planar_chain(2), noise=CUSTOM)}, "noise"),
        ({"dt": 0.0}, ("dt", "0.0")),
        ({"steps": 10**14}, ("100000000000000", "40")),
        ({"paths": 0}, ("paths", "1", "0")),
        ({"rng": -3}, ("rng", "0", "-3")),
        ({"q0": np.zeros((39, 2))}, ("q0", "(40, 2)", "(39, 2)")),
        ({"v0": [0.0, np.nan]}, ("v0[1]", "nan")),
        ({"controls": np.zeros((49, 2))}, ("controls", "(50, 2)", "(2,)", "(49, 2)")),
        ({"controls": lambda t, q, v: q}, ("simulate", "law")),
        ({"integrator": "midpoint"}, "integrator"),
        ({"quantiles": [0.5, 1.5]}, ("quantiles", "[0, 1]", "[0.5, 1.5]")),
        ({"quantiles": 0.5}, ("quantiles", "[0, 1]", "0.5")),
        ({"duration": 1.0}, ("dt", "steps", "duration", "all three")),
        ({"workers": 0}, ("workers", "1", "0")),
    ],
)
def test_bad_input(options, facts):
    with refused(vp.InputError, facts):
        run(**options)


@pytest.mark.parametrize("kick", [pytest.param("left", marks=pytest.mark.slow), "split"])
def test_small_noise_has_the_predicted_covariance(kick):
    """Mean and covariance of 20 000 paths against :func:`varpin.propagate_moments` around the quiet motion."""
    paths, strength, integrator = 20_000, 2e-4, vp.Midpoint(kick=kick)
    noise = vp.AdditiveNoise(strength) + vp.StateNoise(strength) + vp.ControlNoise(strength)
    scene = vp.Scene(vp.planar_chain(2), damping=0.2, stiffness=3.0, noise=noise)
    options = {"dt": 0.01, "controls": [0.3, -0.1], "steps": 50, "integrator": integrator}
    quiet = vp.simulate(scene, *START.values(), **options)
    moments = vp.propagate_moments(vp.linearize(scene, quiet, integrator=integrator))
    own = vp.simulate_ensemble(scene, *START.values(), paths=paths, rng=5, store=False, **options).statistics
    for j in (1, 10, 50):
        P = moments.covariance[j]
        variances = np.diag(P)
        x = np.concatenate([quiet.q[j], quiet.p[j]])
        # Of Gaussian samples: var(mean) = P_aa / N, var(P_ab) = (P_aa P_bb + P_ab^2) / N.
        assert (np.abs(own.mean[j] - x) < 4.0 * np.sqrt(variances / paths)).all()
        error = np.sqrt((np.outer(variances, variances) + P**2) / paths)
        assert (np.abs(own.covariance[j] - P) < 4.0 * error).all()
        # A covariance tenth as large again would show.
        assert (0.1 * variances > 4.0 * np.diag(error)).all()


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.RungeKutta4()], ids=str)
def test_a_held_policy_is_the_same_policy_decided_less_often(integrator):
    scene = vp.Scene(vp.load_robot("finger"), noise=vp.AdditiveNoise(1e-6))
    rng = np.random.default_rng(3)
    u, gains = 1e-5 * rng.normal(size=(6, 3)), 1e-5 * rng.normal(size=(6, 3, 6))
    reference = rng.normal(size=(6, 6))
    policy = vp.LinearPolicy(u, gains, reference, hold=5)
    motion = vp.simulate(
        scene, [0.3, 0.2, 0.1], np.zeros(3), dt=1e-3, steps=30, controls=policy, integrator=integrator, rng=4
    )
    second = motion.p if integrator.variational else motion.v
    x = np.hstack([motion.q, second])[:-1:5]
    expected = u + np.einsum("kmx,kx->km", gains, x - reference)
    np.testing.assert_allclose(motion.u, np.repeat(expected, 5, axis=0), rtol=1e-12, atol=1e-18)
    ensemble = vp.simulate_ensemble(
        scene,
        [0.3, 0.2, 0.1],
        np.zeros(3),
        dt=1e-3,
        steps=30,
        paths=2,
        rng=4,
        controls=policy,
        integrator=integrator,
    )
    assert np.array_equal(ensemble.u[:, ::5], ensemble.u[:, 4::5])
    with refused(vp.InputError, "6", "5", "30", "31"):
        vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-3, steps=31, controls=policy)


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
    assert (str(again), again.failures, again.warnings) == (str(found), found.failures, found.warnings)
    for name in ("t", *ARRAYS):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    same_statistics(again, found)
    with np.load(path) as members:
        np.savez(path, **dict(members) | {"t": np.zeros(3)})
    with pytest.raises(vp.FileError, match="instead of float64"):
        vp.Ensemble.load(path)
