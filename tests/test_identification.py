"""Parameters from logs: found again, with right deviations, within what a body can have, and with what is not told."""

import functools
import logging

import numpy as np
import pytest
from refusals import naming, refused
from ur5_logs import DAMPING, MIDDLE, NAMES, NOISE, TRUTH, motion, start

import varpin as vp
from varpin.estimation.consistency import Body
from varpin.estimation.fit import Stretch, simulations
from varpin.estimation.parameters import parameters_of


def log(seed=0, noise=NOISE, **options):
    q, u = motion(**options)
    t = 1e-2 * np.arange(len(q))
    return vp.Log(t, q + noise * np.random.default_rng(seed).standard_normal(q.shape), u)


def within(found, truth, deviations=4.0):
    return (np.abs(found.values - truth) <= deviations * found.deviations).all()


def test_dampers_and_payload_with_their_deviations():
    found = vp.identify(start(), log(), NAMES, q_noise=NOISE, held_out=log(seed=1))
    assert found.status == "converged"
    assert not found.warnings
    assert not found.null_space
    assert within(found, TRUTH)
    assert found.values[-1] == pytest.approx(2.0, rel=1e-3)
    assert (found.deviations < 0.02 * TRUTH).all()
    for residuals in (*found.residuals, *found.held_out):
        assert np.sqrt(np.mean(residuals**2)) == pytest.approx(NOISE, rel=0.1)
    before = np.sqrt(np.mean((found.logs[0].q - found.predicted_before[0]) ** 2))
    assert before > 100.0 * NOISE
    assert parameters_of(found.scene, NAMES).values[:6] == pytest.approx(found.values[:6])
    assert found.scene.robot.tree.mass[-1] == pytest.approx(start().robot.tree.mass[-1] + found.values[-1])


@pytest.mark.slow
def test_deviations_are_those_of_many_logs():
    found = [vp.identify(start(), log(seed), NAMES, q_noise=NOISE, delay=0.0) for seed in range(40)]
    off = np.array([(each.values - TRUTH) / each.deviations for each in found])
    # Of 280 numbers of deviation 1 the mean square is 1 +- 0.085.
    assert np.mean(off**2) == pytest.approx(1.0, abs=0.3)


def test_residuals_beyond_the_noise_that_is_given_make_deviations_as_large():
    told, known = (
        vp.identify(start(), log(noise=5.0 * NOISE), NAMES, q_noise=size * NOISE, delay=0.0) for size in (1.0, 5.0)
    )
    np.testing.assert_allclose(told.deviations, known.deviations, rtol=0.1)


def test_derivatives_of_what_is_minimized():
    # The covariance of a linear problem is that of its derivatives: against differences of the minimum.
    rows = []
    for shift in (-1.0, 1.0):
        q, u = motion()
        moved = q.copy()
        moved[37, 2] += shift * NOISE
        at = vp.Log(1e-2 * np.arange(len(q)), moved, u)
        rows.append(vp.identify(start(), at, NAMES, q_noise=NOISE, delay=0.0).values)
    influence = (rows[1] - rows[0]) / 2.0
    found = vp.identify(start(), log(noise=0.0), NAMES, q_noise=NOISE, delay=0.0)
    assert (np.abs(influence) < found.deviations).all()
    assert np.abs(influence / found.deviations).max() > 1e-3


def test_a_delay_is_found_and_told():
    found = vp.identify(start(), log(late=8), NAMES, q_noise=NOISE)
    assert found.delay == pytest.approx(8e-3, abs=1e-4)
    assert naming(found.warnings, "controls", "later")
    assert within(found, TRUTH, 5.0)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.RungeKutta4(), vp.Gauss(2)], ids=str)
def test_uneven_samples_and_missing_ones(integrator):
    q, u = motion()
    t, rng = 1e-2 * np.arange(len(q)), np.random.default_rng(2)
    encoders = q + NOISE * rng.standard_normal(q.shape)
    encoders[rng.random(q.shape) < 0.2] = np.nan
    kept = np.sort(rng.choice(len(t), 170, replace=False))
    # The controls stay those of each 10 ms, which are no longer all in the log: hold them.
    keep = np.union1d(kept, np.flatnonzero(np.abs(np.diff(u, axis=0)).max(axis=1) > 0.0) + 1)
    found = vp.identify(start(), vp.Log(t[keep], encoders[keep], u[keep]), NAMES, q_noise=NOISE, dt=5e-3,
                        integrator=integrator)  # fmt: skip
    assert within(found, TRUTH, 5.0)


STRENGTH = 0.02


@functools.cache
def shaken():
    """Positions each 1 ms of the arm under noise, and its torques each 10 ms."""
    robot = vp.load_robot("ur5", payload=vp.Payload("tool0", 2.0))
    scene = vp.Scene(robot, damping=DAMPING, noise=vp.AdditiveNoise(STRENGTH))
    _, u = motion(duration=1.5)
    made = vp.simulate(scene, MIDDLE, np.zeros(6), dt=1e-3, steps=1500, controls=np.repeat(u[:-1], 10, axis=0), rng=3,
                       integrator=vp.Midpoint(kick="held"), check=False)  # fmt: skip
    return made.q, u


def under_noise(t, q, u, **options):
    return vp.identify(start(noise=vp.AdditiveNoise(STRENGTH)), vp.Log(t, q, u), NAMES, q_noise=NOISE, **options)


def test_prediction_errors_under_noise():
    q, u = shaken()
    q = q[::10] + NOISE * np.random.default_rng(8).standard_normal(u.shape)
    found = under_noise(1e-2 * np.arange(len(q)), q, u)
    assert within(found, TRUTH)
    assert (found.deviations < 0.2 * TRUTH).all()


def test_rows_that_are_missing_under_noise_are_as_rows_of_nan():
    q, u = shaken()
    q = q[::10] + NOISE * np.random.default_rng(8).standard_normal(u.shape)
    t, kept = 1e-2 * np.arange(len(q)), np.delete(np.arange(len(q)), [20, 40, 42, 77])
    # What the log does not have of the torques is as before them.
    held = u[np.repeat(kept, np.diff(np.r_[kept, len(q)]))]
    gaps = np.full_like(q, np.nan)
    gaps[kept] = q[kept]
    few, whole = (under_noise(*given, delay=0.0) for given in ((t[kept], q[kept], u[kept]), (t, gaps, held)))
    np.testing.assert_allclose(few.values, whole.values, rtol=1e-6)
    np.testing.assert_allclose(few.deviations, whole.deviations, rtol=1e-6)


@pytest.mark.parametrize("dt", [None, 4e-3])
def test_an_uneven_clock_under_noise(dt):
    q, u = shaken()
    rng = np.random.default_rng(5)
    at = np.union1d(np.sort(rng.choice(1500, 140, replace=False)), np.arange(0, 1500, 10))
    encoders = q[at] + NOISE * rng.standard_normal((len(at), 6))
    found = under_noise(1e-3 * at, encoders, u[at // 10], dt=dt)
    assert within(found, TRUTH)
    assert found.delay == pytest.approx(0.0, abs=4.0 * found.delay_deviation)
    assert not found.warnings


def test_what_logs_do_not_tell():
    names = ["damping", "payload:tool0", "payload:ee_link", "inertia:shoulder_link:m"]
    found = vp.identify(start(), log(), names, q_noise=NOISE)
    texts = sorted(found.null_space)
    assert len(texts) == 2
    assert "inertia:shoulder_link:m: the logs do not depend on it" in texts
    # Two frames at one place: only the sum of the masses.
    assert "only payload:" in "".join(texts)
    assert np.isinf(found.deviations[6:]).all()
    assert (np.abs(found.values[:6] - DAMPING) <= 4.0 * found.deviations[:6]).all()
    assert found.values[6] + found.values[7] == pytest.approx(2.0, rel=1e-3)


def test_bodies_stay_bodies():
    numbers = parameters_of(start(), "inertia:forearm_link").values
    body, rng = Body.around(numbers), np.random.default_rng(6)
    assert body.numbers(np.zeros(10))[0] == pytest.approx(numbers, rel=1e-9, abs=1e-12)
    for _ in range(20):
        y = rng.normal(0.0, 2.0, 10)
        values, slopes = body.numbers(y)
        m, c = values[0], values[1:4] / values[0]
        about = np.array([[values[4], values[5], values[7]], [values[5], values[6], values[8]],
                          [values[7], values[8], values[9]]]) - m * (c @ c * np.eye(3) - np.outer(c, c))  # fmt: skip
        moments = np.linalg.eigvalsh(about)
        assert m > 0.0
        assert moments[0] > 0.0
        assert moments[2] < moments[:2].sum() * (1.0 + 1e-9)
        shifts = np.array([body.numbers(y + 1e-6 * e)[0] - body.numbers(y - 1e-6 * e)[0] for e in np.eye(10)]).T / 2e-6
        np.testing.assert_allclose(slopes, shifts, rtol=1e-5, atol=1e-6 * np.abs(shifts).max())


def test_a_link_is_found_and_what_is_not_told_stays():
    robot = vp.load_robot("ur5", payload=vp.Payload("forearm_link", 1.5, center=(0.0, 0.05, 0.2)))
    truth = vp.Scene(robot, damping=DAMPING)
    _, u = motion()
    made = vp.simulate(truth, MIDDLE, np.zeros(6), dt=1e-3, steps=10 * (len(u) - 1), check=False,
                       controls=np.repeat(u[:-1], 10, axis=0), integrator=vp.Gauss(3))  # fmt: skip
    logged = vp.Log(1e-2 * np.arange(len(u)), made.q[::10], u)
    scene = vp.Scene(vp.load_robot("ur5"), damping=DAMPING)
    found = vp.identify(scene, logged, "inertia:forearm_link", q_noise=NOISE, delay=0.0)
    q = np.random.default_rng(9).uniform(-2.0, 2.0, (5, 6))
    for at in q:
        assert found.scene.holding_torque(at) == pytest.approx(truth.holding_torque(at), abs=0.02)
    assert np.abs(scene.holding_torque(q[0]) - truth.holding_torque(q[0])).max() > 1.0


def test_what_is_refused_and_interrupted(caplog):
    scene, right = start(), log()
    for wrong, facts in [({"q_noise": 0.0}, ("q_noise",)), ({"dt": -1.0}, ("dt",)), ({"horizon": 0.0}, ("horizon",))]:
        with refused(vp.InputError, *facts):
            vp.identify(scene, right, NAMES, **({"q_noise": NOISE} | wrong))
    for logs, names, facts in [
        ([], NAMES, ("logs", "empty")),
        (None, NAMES, ("logs", "varpin.Log", "None")),
        (right, [], ("parameters", "empty")),
    ]:
        with refused(vp.InputError, *facts):
            vp.identify(scene, logs, names, q_noise=NOISE)
    with refused(vp.InputError, "v_noise", "velocities"):
        vp.identify(scene, right, NAMES, q_noise=NOISE, v_noise=0.1)
    loop = vp.Scene(CHAIN, constraints=vp.JointTie("joint2", "joint1", [0.0, 1.0]))
    with refused(vp.InputError, "identify", "JointTie"):
        vp.identify(loop, right, NAMES, q_noise=NOISE)
    seen = []

    def stop(evaluation, residual):
        seen.append(residual)
        if evaluation == 3:
            raise KeyboardInterrupt

    with caplog.at_level(logging.ERROR):
        found = vp.identify(scene, right, NAMES, q_noise=NOISE, callback=stop)
    assert found.status == "interrupted"
    assert seen[-1] < seen[0]
    assert found.values[-1] > 0.5


def test_ctrl_c_after_the_search_keeps_its_values(monkeypatch):
    """Motions with the values and the check of the step come after it."""
    calls = []

    def interrupted(*given):
        calls.append(given)
        raise KeyboardInterrupt

    monkeypatch.setattr("varpin.estimation.identification._step_error", interrupted)
    found = vp.identify(start(), log(), NAMES, q_noise=NOISE)
    assert calls
    assert found.status == "interrupted"
    assert within(found, TRUTH)
    assert np.isfinite(found.residuals[0]).all()
    monkeypatch.setattr("varpin.estimation.fit.Run.settled", interrupted)
    np.testing.assert_array_equal(vp.identify(start(), log(), NAMES, q_noise=NOISE).values, found.values)
    turned = log()
    turned = vp.Log(turned.t, turned.q, turned.u * [1, 1, 1, -1, 1, 1])
    found = vp.identify(start(), turned, NAMES, q_noise=NOISE, evaluations=5)
    assert naming(found.warnings, "times q_noise", "column"), found.warnings


@pytest.mark.parametrize("searches", [0, 1])
def test_ctrl_c_in_the_first_evaluation_of_a_search(searches, monkeypatch):
    begun = set()

    def interrupted(fit, stretches, y):
        begun.add(len(stretches))
        if len(begun) > searches:
            raise KeyboardInterrupt
        return simulations(fit, stretches, y)

    monkeypatch.setattr("varpin.estimation.identification.simulations", interrupted)
    found = vp.identify(start(), log(), NAMES, q_noise=NOISE)
    assert found.status == "interrupted"
    assert not naming(found.warnings, "cannot be simulated")
    assert not found.null_space
    assert (np.isfinite([*found.deviations, found.delay_deviation]) == bool(searches)).all()
    assert not np.isnan(found.covariance).any()


def test_a_value_at_its_bound_is_told_where_less_would_fit():
    still = log(damping=(0.0,) * 6)
    for forces, told in [((), False), ((vp.FrameDamper("tool0", "base_link", 5.0),), True)]:
        found = vp.identify(start(forces=forces), still, NAMES, q_noise=NOISE)
        assert (found.values[:6] == 0.0).any()
        assert any(each.kind == "bound" for each in found.warnings) == told, found.warnings


def chain_log(scene, period=1e-2, samples=100, noise=1e-4, seed=0):
    """A chain under waves of torque, by steps of a tenth of the period."""
    n, rng = scene.robot.dof, np.random.default_rng(seed)
    t = period * np.arange(samples)
    u = 2.0 * np.sin(2.0 * np.pi * np.outer(t, [0.8, 1.7][:n]))
    made = vp.simulate(scene, [0.5, -0.4], np.zeros(n), dt=0.1 * period, steps=10 * (samples - 1), check=False,
                       controls=np.repeat(u[:-1], 10, axis=0), integrator=vp.Gauss(3))  # fmt: skip
    return vp.Log(t, made.q[::10] + noise * rng.standard_normal((samples, n)), u)


CHAIN = vp.planar_chain(2)


def test_dry_friction_leads_no_start_astray():
    truth, begin = (vp.Scene(CHAIN, damping=d, friction=f) for d, f in (([0.5, 0.3], [0.3, 0.2]), (0.1, 0.1)))
    found = vp.identify(
        begin, chain_log(truth, 2e-3, 500), ["damping", "friction"], q_noise=1e-4, delay=0.0, horizon=0.2
    )
    assert not found.warnings
    assert within(found, [0.5, 0.3, 0.3, 0.2])


def test_sharp_friction_is_found():
    truth, begin = (vp.Scene(CHAIN, damping=0.3, forces=vp.CoulombFriction(level, 3e-4)) for level in ([1.0, 0.6], 0.3))
    found = vp.identify(begin, chain_log(truth), "friction", q_noise=1e-4, delay=0.0)
    assert found.values == pytest.approx([1.0, 0.6], rel=0.02)


def test_steps_of_values_that_are_far_off_are_not_in_hundreds_of_parts(monkeypatch):
    parts, whole = [], Stretch.motion

    def counted(*given):
        motion = whole(*given)
        parts.append(0 if motion is None else motion.statistics.substeps.max(initial=1))
        return motion

    monkeypatch.setattr(Stretch, "motion", counted)
    truth, begin = (vp.Scene(CHAIN, damping=damping) for damping in ([0.5, 0.3], 2e3))
    found = vp.identify(begin, chain_log(truth), "damping", q_noise=1e-4, delay=0.0)
    assert max(parts) <= 16
    assert within(found, [0.5, 0.3])


@pytest.mark.parametrize("begin", [(20.0, -1.0), (5.0, 0.0)])
def test_springs_and_their_rests_are_told_together(begin):
    truth = vp.Scene(CHAIN, damping=0.3, forces=vp.JointSpring(8.0, 0.5))
    scene = vp.Scene(CHAIN, damping=0.3, forces=vp.JointSpring(*begin))
    found = vp.identify(scene, chain_log(truth), ["stiffness", "rest"], q_noise=1e-4, delay=0.0)
    again = vp.identify(truth, chain_log(truth), ["stiffness", "rest"], q_noise=1e-4, delay=0.0)
    assert within(found, [8.0, 8.0, 0.5, 0.5])
    assert found.deviations == pytest.approx(again.deviations, rel=0.02)


def test_gains_of_servos_are_found_from_others():
    truth, begin = (
        vp.Scene(CHAIN, forces=vp.PositionServo(*gains)) for gains in (([60.0, 30.0], [4.0, 2.0]), (100.0, 0.0))
    )
    shown = chain_log(truth)
    found = vp.identify(begin, shown, ["servo_stiffness", "servo_damping"], q_noise=1e-4, delay=0.0)
    assert within(found, [60.0, 30.0, 4.0, 2.0])


def test_logs_of_other_rates_and_with_gaps():
    truth, begin = vp.Scene(CHAIN, damping=[0.5, 0.3]), vp.Scene(CHAIN, damping=0.1)
    fine, coarse = chain_log(truth, 1e-3, 600), chain_log(truth, 1e-2, 100, seed=1)
    for logs in ([fine, coarse], [coarse, fine]):
        assert within(vp.identify(begin, logs, "damping", q_noise=1e-4, delay=0.0), [0.5, 0.3])
    whole = chain_log(truth, 1e-2, 300)
    kept = np.r_[0:120, 210:300]
    gap = vp.Log(1.7e9 + whole.t[kept], whole.q[kept], whole.u[kept])
    assert within(vp.identify(begin, gap, "damping", q_noise=1e-4, delay=0.0), [0.5, 0.3])


def test_less_than_the_scene_carries():
    scene = vp.Scene(vp.load_robot("ur5", payload=vp.Payload("tool0", 2.5)), damping=DAMPING)
    found = vp.identify(scene, log(), "payload", q_noise=NOISE, delay=0.0)
    assert found.values == pytest.approx([-0.5], abs=1e-2)
