"""Logs, and filter and smoother against plain ones, a Gaussian of all samples at once, and noisy motions."""

import math

import numpy as np
import pytest
from refusals import naming, refused, unnamed
from scipy.stats import multivariate_normal

import varpin as vp
from varpin.estimation import as_log

H, ENCODER = 0.01, 2e-4
# Controls of a lively motion and intensities of unknown forces, for the size of each robot.
ARMS = {
    "ur5": ([60.0, 60.0, 30.0, 6.0, 6.0, 1.0], [0.2, 0.2, 0.12, 0.03, 0.03, 0.005], 0.5),
    "finger": ([5e-4, 1.5e-4, 2e-5], [2e-6, 5e-7, 1e-7], 2e-6),
}


def scene_of(robot, strength, damping, **options):
    return vp.Scene(robot, damping=damping, noise=vp.AdditiveNoise(np.array(strength)), **options)


def waves(size, steps, n):
    return np.array(size) * np.sin(0.1 * np.arange(steps)[:, None] + np.arange(n))


def true_motions(scene, size, *, steps=100, paths=1, fine=20, h=H, seed=0, more=0.0):
    """Motions (P, steps + 1, n) of the continuous equation, and their controls (steps + 1, m)."""
    n = scene.robot.dof
    u = waves(size, steps, n)
    q0 = np.linspace(0.3, -0.9, n)
    paths = vp.simulate_ensemble(
        scene,
        q0,
        np.zeros(n),
        dt=h / fine,
        steps=steps * fine,
        paths=paths,
        rng=seed,
        controls=np.repeat(u + more, fine, axis=0),
        integrator=vp.Midpoint(kick="held"),
        quantiles=[],
    )
    return paths.q[:, ::fine], paths.v[:, ::fine], np.vstack([u, u[-1:]])


def log_of(q, u, *, h=H, seed=1, noise=ENCODER, **options):
    rng = np.random.default_rng(seed)
    return vp.Log(h * np.arange(len(q)), q + noise * rng.normal(size=q.shape), u, **options)


# Against plain filters of a linear system.


def springs(links=2):
    """A chain on springs without gravity: for tiny motions M q'' = u - D q' - K q, with its M, D and K."""
    robot = vp.planar_chain(links)
    k, d = np.array([40.0, 25.0])[:links], np.array([0.3, 0.2])[:links]
    noise = vp.AdditiveNoise(1e-5 * np.array([[1.0, 0.3], [0.0, 0.5]])[:links, :links])
    scene = vp.Scene(robot, gravity=False, stiffness=k, damping=d, noise=noise)
    return scene, vp.lagrangian_jet(scene, np.zeros(links), np.zeros(links)).Lvv, np.diag(d), np.diag(k)


def plain_steps(method, scene, M, D, K, h):
    """A (2n, 2n), B (2n, n) and the process covariance of a step, from the matrices of the linear system."""
    n, inverse, eye = len(M), np.linalg.inv(M), np.eye(2 * len(M))
    F = scene.noise.arrays.constant
    if method == vp.Midpoint():
        C, B = np.block([[np.zeros((n, n)), inverse], [-K, -D @ inverse]]), np.vstack([np.zeros((n, n)), np.eye(n)])
        half = np.linalg.inv(eye - 0.5 * h * C)
        A, B, jump = half @ (eye + 0.5 * h * C), h * half @ B, np.vstack([np.zeros((n, n)), F])
    else:
        C, B = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ D]]), np.vstack([0 * M, inverse])
        powers = [np.linalg.matrix_power(h * C, k) / math.factorial(k) for k in range(5)]
        A, B = sum(powers), h * sum(power / (k + 1) for k, power in enumerate(powers[:4])) @ B
        jump = np.vstack([np.zeros((n, n)), inverse @ F])
    # A jump at the share s of the step has become, on a line, (1 - s) A jump + s jump: Simpson's rule is exact.
    at = [(1.0 - s) * A @ jump + s * jump for s in (0.0, 0.5, 1.0)]
    return A, B, h / 6.0 * sum(w * x @ x.T for w, x in zip((1.0, 4.0, 1.0), at, strict=True))


def plain_filter(A, B, Q, rows, R, z, u, x, P):
    """Kalman's filter and the smoother of Rauch, Tung and Striebel, as in a textbook: (x, P) of each."""
    states, before = [], []
    for k, now in enumerate(z):
        if k:
            x, P = A @ x + B @ u[k - 1], A @ P @ A.T + Q
        before.append((x, P))
        there = np.isfinite(now)
        C = rows[there]
        G = P @ C.T @ np.linalg.inv(C @ P @ C.T + R[np.ix_(there, there)])
        x, P = x + G @ (now[there] - C @ x), (np.eye(len(x)) - G @ C) @ P
        states.append((x, P))
    smoothed = [states[-1]]
    for (x, P), (x1, P1) in zip(states[-2::-1], before[:0:-1], strict=True):
        G = P @ A.T @ np.linalg.inv(P1)
        smoothed.append((x + G @ (smoothed[-1][0] - x1), P + G @ (smoothed[-1][1] - P1) @ G.T))
    return states, smoothed[::-1]


@pytest.mark.parametrize("speeds", [False, True])
@pytest.mark.parametrize("method", [vp.Midpoint(), vp.RungeKutta4()], ids=["Midpoint", "RungeKutta4"])
def test_a_linear_system_against_a_plain_filter_and_a_gaussian_of_all_samples(method, speeds):
    scene, M, D, K = springs()
    rng, count, n = np.random.default_rng(2), 12, 2
    q, v = 1e-6 * rng.normal(size=(2, count, n))
    q[4, 0] = q[5] = v[3, 1] = np.nan
    u = 1e-6 * rng.normal(size=(count, n))
    start, P = np.array([1e-6, -2e-6, 3e-6, 1e-6]), 1e-12 * (np.eye(4) + 0.2)
    noise = {"q_noise": np.array([1e-6, 2e-6])} | ({"v_noise": 3e-6} if speeds else {})
    log = vp.Log(H * np.arange(count), q, u, v)
    given = {"q0": start[:n], "v0": start[n:], "covariance": P, "integrator": method, **noise}
    found, smoothed = vp.kalman_filter(scene, log, **given), vp.smooth(scene, log, **given)

    A, B, Q = plain_steps(method, scene, M, D, K, H)
    to = np.eye(4)
    if method.variational:
        to[n:, n:] = M
    back = np.linalg.inv(to)
    rows = np.vstack([np.eye(2, 4), back[n:]])[: 2 * n if speeds else n]
    z = (np.hstack([q, v]) if speeds else q)[:, : len(rows)]
    R = np.diag(np.array([1e-6, 2e-6, 3e-6, 3e-6])[: len(rows)] ** 2)
    states, backward = plain_filter(A, B, Q, rows, R, z, u, to @ start, to @ P @ to.T)
    for estimate, plain in ((found, states), (smoothed, backward)):
        for k, (x, Px) in enumerate(plain):
            np.testing.assert_allclose(np.r_[estimate.q[k], estimate.v[k]], back @ x, rtol=1e-8, atol=1e-14)
            np.testing.assert_allclose(estimate.covariance[k], back @ Px @ back.T, rtol=1e-8, atol=1e-20)

    # All samples at once: their joint mean and covariance.
    mean, moments = [to @ start], [to @ P @ to.T]
    for k in range(count - 1):
        mean.append(A @ mean[-1] + B @ u[k])
        moments.append(A @ moments[-1] @ A.T + Q)
    cross = np.zeros((count, len(rows), count, len(rows)))
    for i in range(count):
        for j in range(i, count):
            cross[j, :, i] = rows @ np.linalg.matrix_power(A, j - i) @ moments[i] @ rows.T
            cross[i, :, j] = cross[j, :, i].T
        cross[i, :, i] += R
    there, scale = np.isfinite(z).ravel(), 1e6
    whole = cross.reshape(z.size, z.size)[np.ix_(there, there)] * scale**2
    centre = (np.array(mean) @ rows.T).ravel()[there] * scale
    density = multivariate_normal.logpdf(z.ravel()[there] * scale, centre, whole) + there.sum() * math.log(scale)
    assert found.log_likelihood == pytest.approx(density, rel=1e-9)
    assert smoothed.log_likelihood == found.log_likelihood
    gained = found.forward.predicted + np.einsum("Kdz,Kz->Kd", found.gains, np.nan_to_num(found.innovations))
    np.testing.assert_allclose(gained, found.forward.state, rtol=1e-8, atol=1e-16)


# The covariance of a step.


@pytest.mark.parametrize("method", [vp.Gauss(2), vp.RungeKutta4()], ids=str)
@pytest.mark.parametrize("name", ARMS)
def test_the_covariance_of_a_step_is_that_of_the_continuous_equation(load, name, method):
    size, strength, damping = ARMS[name]
    scene = scene_of(load(name), strength, damping)
    n, h = scene.robot.dof, 0.005
    start = {"q0": np.linspace(0.3, -0.9, n), "v0": np.linspace(-1.0, 1.0, n), "controls": np.array(size)}
    # The samples of the log come after the step.
    log = vp.Log(h * np.arange(4), np.where(np.arange(4)[:, None] < 2, np.nan, np.zeros(n)), np.tile(size, (4, 1)))
    known = {"q0": start["q0"], "v0": start["v0"], "covariance": np.zeros((2 * n, 2 * n))}
    found = vp.kalman_filter(scene, log, q_noise=1.0, integrator=method, **known).forward.predicted_covariance[1]
    fine = {"dt": h / 20, "steps": 20}
    by = vp.Midpoint(kick="held")
    drawn = vp.simulate_ensemble(scene, quantiles=[], paths=8000, rng=3, integrator=by, **start, **fine)
    sample = np.cov(np.hstack([drawn.q[:, -1], drawn.p[:, -1] if method.variational else drawn.v[:, -1]]).T)
    deviation = np.sqrt(np.diag(found))
    # 4 standard deviations of the sample's entries, and a quarter of damping's rate times h.
    np.testing.assert_allclose((sample - found) / np.outer(deviation, deviation), 0.0, atol=0.07)
    assert np.linalg.eigvalsh(found / np.outer(deviation, deviation)).min() > 1e-5


def test_a_filter_refuses_constraints():
    robot = vp.planar_chain(2)
    scene = vp.Scene(robot, noise=vp.AdditiveNoise(1.0), constraints=vp.JointTie("joint2", "joint1"))
    step = vp.simulate(scene, [0.0, 0.0], [0.0, 0.0], dt=H, steps=1, increments=0, integrator=vp.Midpoint())
    with refused(vp.InputError, "Kalman filter does not take scenes with constraints"):
        vp.kalman_filter(scene, step, q_noise=ENCODER)


# Noisy motions of arms.


@pytest.mark.parametrize("method", [None, vp.RungeKutta4()], ids=["Gauss", "RungeKutta4"])
@pytest.mark.parametrize("name", ARMS)
def test_errors_are_as_large_as_they_are_said_to_be(load, name, method):
    size, strength, damping = ARMS[name]
    scene = scene_of(load(name), strength, damping)
    q, v, u = true_motions(scene, size, paths=50)
    nees, nis, error, plain = [], [], [], []
    for path in range(50):
        log = log_of(q[path], u, seed=path)
        both = [run(scene, log, q_noise=ENCODER, integrator=method) for run in (vp.kalman_filter, vp.smooth)]
        nees.append([own.nees(q[path], v[path]).mean() for own in both])
        nis.append(both[0].nis()[2:].mean())
        error.append([np.abs(own.v - v[path])[1:-1] ** 2 for own in both])
        # Differences as they are usual: of the sample before, or of both neighbours.
        behind, middle = np.diff(log.q, axis=0)[:-1] / H, (log.q[2:] - log.q[:-2]) / (2.0 * H)
        plain.append([(behind - v[path, 1:-1]) ** 2, (middle - v[path, 1:-1]) ** 2])
    n = scene.robot.dof
    assert np.mean(nees, axis=0) == pytest.approx([2 * n, 2 * n], rel=1.0 / 12.0)
    assert np.mean(nis) == pytest.approx(n, rel=0.05)
    shares = np.sqrt(np.mean(error, axis=(0, 2)) / np.mean(plain, axis=(0, 2)))
    assert shares.max() < 0.8


def test_steps_within_an_interval_and_missing_samples(load):
    size, strength, damping = ARMS["ur5"]
    scene = scene_of(load("ur5"), strength, damping)
    u = np.repeat(waves(size, 10, 6), 4, axis=0)
    motion = vp.simulate(scene, np.zeros(6), np.zeros(6), dt=H, steps=40, controls=u, rng=0)
    log = log_of(motion.q, np.vstack([u, u[-1:]]))
    seldom = np.where((np.arange(41) % 4 == 0)[:, None], log.q, np.nan)
    given = {"q_noise": ENCODER, "dt": H}
    gaps = vp.smooth(scene, vp.Log(log.t, seldom, log.u), **given)
    thin = vp.smooth(scene, vp.Log(log.t[::4], log.q[::4], log.u[::4]), **given)
    for name in ("q", "v", "covariance"):
        np.testing.assert_allclose(getattr(gaps, name)[::4], getattr(thin, name), rtol=1e-7, atol=1e-12)
    assert gaps.log_likelihood == pytest.approx(thin.log_likelihood, rel=1e-10)
    # Uneven samples: no step is longer than dt, and usual intervals have one.
    there = np.delete(np.arange(41), [5, 6, 7, 20])
    uneven = vp.kalman_filter(scene, vp.Log(log.t[there], log.q[there], log.u[there]), q_noise=ENCODER)
    assert uneven.given.parts.tolist() == np.ceil(np.diff(there) / 1.5).tolist()
    assert vp.kalman_filter(scene, log, q_noise=ENCODER, dt=0.3 * H).given.parts.tolist() == [4] * 40


def test_a_joint_without_first_samples_begins_on_the_line_of_the_next_ones():
    t = 0.01 * np.arange(20)
    q = (0.3 + 0.5 * t)[:, None]
    q[:5] = np.nan
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=0.0, noise=vp.AdditiveNoise(1e-3))
    found = vp.kalman_filter(scene, vp.Log(t, q, np.zeros((20, 1))), q_noise=1e-4)
    np.testing.assert_allclose([found.q[0, 0], found.v[0, 0]], [0.3, 0.5], rtol=1e-9)


def test_without_samples_the_filter_is_the_motion_and_its_linearization():
    robot = vp.planar_chain(3)
    scene = vp.Scene(robot, noise=vp.AdditiveNoise(0.1))
    q0, v0 = np.array([0.2, 0.5, -0.4]), np.array([1.0, -1.0, 0.5])
    for method in (vp.Gauss(2), vp.RungeKutta4()):
        motion = vp.simulate(scene, q0, v0, dt=H, steps=20, increments=0, integrator=method)
        q = np.where((np.arange(21) > 18)[:, None], motion.q, np.nan)
        log = vp.Log(motion.t, q, np.zeros((21, 3)))
        P = 1e-6 * np.eye(6)
        found = vp.kalman_filter(scene, log, q_noise=1.0, q0=q0, v0=v0, covariance=P, integrator=method)
        np.testing.assert_allclose(found.q[:18], motion.q[:18], atol=1e-11)
        np.testing.assert_allclose(found.v[:18], motion.v[:18], atol=1e-11)
        model = vp.linearize(scene, motion)
        np.testing.assert_allclose(found.forward.transition[:18], model.A[:18], atol=1e-8)
        moments = found.given.covariance
        # White forces of intensity F add, over a step, the integral of r(s) r(s)^T, with r linear in s.
        n = scene.robot.dof
        jump = model.F if model.variational else np.linalg.solve(model.J[:, n:], model.K[:, n:] @ model.F)
        late = np.concatenate([np.zeros_like(jump), jump], axis=1)
        for A, end in zip(model.A[:18], late, strict=False):
            middle, change = 0.5 * (A @ end + end), A @ end - end
            moments = A @ moments @ A.T + H * (middle @ middle.T + change @ change.T / 12.0)
        np.testing.assert_allclose(found.forward.predicted_covariance[18], moments, rtol=1e-6, atol=1e-12)
    # Long steps are divided, and symplectic all the same.
    t = 0.3 * np.arange(20)
    swing = vp.Log(t, np.where(t[:, None] > 5.2, q0, np.nan), np.zeros((20, 3)))
    wide = vp.kalman_filter(scene, swing, q_noise=9.0, q0=q0, v0=v0, covariance=P, integrator=vp.Midpoint())
    A, J = wide.forward.transition, np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(3))
    assert np.abs(np.swapaxes(A, 1, 2) @ J @ A - J).max() < 1e-6 * np.abs(A).max() ** 2
    long = vp.simulate(scene, q0, v0, dt=0.3, steps=17, increments=0, integrator=vp.Midpoint(), check=False)
    assert long.statistics.split_steps > 5


@pytest.mark.parametrize("method", [None, vp.RungeKutta4()], ids=["Gauss", "RungeKutta4"])
def test_an_external_push_is_found(load, method):
    size, strength, damping = ARMS["ur5"]
    scene = scene_of(load("ur5"), strength, damping)
    push = np.array([0.0, 0.0, 8.0, 0.0, 0.0, 0.0])
    (q,), (v,), u = true_motions(scene, size, steps=150, more=push)
    given = {"q_noise": ENCODER, "external": (5.0, 10.0), "integrator": method}
    for run in (vp.kalman_filter, vp.smooth):
        found = run(scene, log_of(q, u), **given)
        late = slice(50, None)
        off = found.external - push
        spread = np.sqrt(np.diagonal(found.external_covariance, axis1=1, axis2=2))
        assert np.abs(off[late].mean(axis=0)).max() < 1.0
        assert np.sqrt(np.mean((off / spread)[late] ** 2)) == pytest.approx(1.0, abs=0.5)
        assert found.nees(q, v)[late].mean() == pytest.approx(12.0, abs=3.0)
    assert vp.kalman_filter(scene, log_of(q, u), q_noise=ENCODER).external is None


def test_noise_of_any_model_that_does_not_see_the_velocity():
    robot, log = vp.planar_chain(2), vp.Log(**good())
    F = np.array([[0.3], [0.1]])
    own = vp.CustomNoise(lambda q, v, u: F * np.cos(q[0]), 1, dq=lambda q, v, u: -np.sin(q[0]) * F[:, :, None] * [1, 0])
    noise = [vp.ControlNoise(0.2), vp.StateNoise(0.1, center=0.5), own]
    found = vp.kalman_filter(vp.Scene(robot, noise=noise), log, q_noise=ENCODER)
    fields = [np.diag(0.2 * log.u[3]), np.diag(0.1 * (log.q[3] - 0.5) ** 2), F * np.cos(log.q[3, 0])]
    np.testing.assert_allclose(found.given.spread[3], sum(field @ field.T for field in fields), rtol=1e-12)


# Logs.


def good(n=2, rows=20, **changes):
    rng = np.random.default_rng(0)
    t = H * np.arange(rows)
    given = {"t": t, "q": np.sin(t[:, None] + np.arange(n)) + 1e-4 * rng.normal(size=(rows, n))}
    return given | {"u": np.cos(t[:, None] + np.arange(n))} | changes


def test_a_log_in_files(tmp_path):
    q = good()["q"]
    q[3, 1] = np.nan
    log = vp.Log(**good(q=q, v=2.0 * q), joints=("joint2", "joint1"))
    for name in ("log.npz", "log.csv"):
        again = vp.Log.load(log.save(tmp_path / name))
        for own in ("t", "q", "u", "v"):
            np.testing.assert_array_equal(getattr(again, own), getattr(log, own))
        assert again.joints == again.controls == log.joints
    path = tmp_path / "own.csv"
    path.write_text("u_a, q_a ,t,hot\n1,0.5,0.0,1\n1,,0.1,2\n", encoding="utf-8")
    own = vp.Log.load(path, joints=["b"])
    assert (own.joints, own.controls, np.isnan(own.q[:, 0]).tolist()) == (("b",), ("a",), [False, True])
    np.savez(tmp_path / "plain.npz", **{name: value.astype(np.float32) for name, value in good().items()})
    assert vp.Log.load(tmp_path / "plain.npz").joints is None
    np.savez(tmp_path / "short.npz", t=[0.0, 1.0])
    for text, why in (
        ("t,q_a,u_a\n0,1,two\n", "two"),
        ("t,q_a\n0,1\n", "u_<joint>"),
        ("t,q_a,u_a\n0,1\n", "2 col"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(vp.FileError, match=why):
            vp.Log.load(path)
    for lost, why in (("short.npz", "missing"), ("none.csv", "no file")):
        with pytest.raises(vp.FileError, match=why):
            vp.Log.load(tmp_path / lost)
    with refused(vp.InputError, "names its columns"):
        vp.Log(**good()).save(path)


def test_columns_are_taken_by_name(load):
    scene = scene_of(load("ur5"), *ARMS["ur5"][1:])
    (q,), _, u = true_motions(scene, ARMS["ur5"][0], steps=20)
    log, names, order = log_of(q, u), scene.robot.joint_names, [3, 5, 0, 1, 4, 2]
    other = vp.Log(log.t, log.q[:, order], log.u[:, order], None, [names[j] for j in order])
    one, two = (vp.kalman_filter(scene, own, q_noise=ENCODER) for own in (log, other))
    np.testing.assert_array_equal(one.v, two.v)
    assert as_log(log) is log


def test_a_motion_is_a_log_of_itself():
    scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(0.1))
    motion = vp.simulate(scene, [0.1, 0.2], [0.0, 0.0], dt=H, steps=20, rng=0, controls=np.ones((20, 2)))
    log = as_log(motion)
    assert (log.u.shape, log.joints) == ((21, 2), ("joint1", "joint2"))
    found = vp.smooth(scene, motion, q_noise=1e-5)
    assert np.abs(found.q - motion.q).max() < 1e-4
    assert repr(found).startswith("Estimate(21 samples, 2 joints, smoothed by Gauss")


BAD = {
    "must increase": good(t=np.r_[0.0, 0.2, 0.1, np.arange(1, 18)]),
    "Log t[4] is nan": good(t=np.r_[np.arange(4.0), np.nan, np.arange(5.0, 20.0)]),
    "Log u[3, 1] is nan": good(u=np.where(np.arange(40).reshape(20, 2) == 7, np.nan, 1.0)),
    "Log q[0, 0] is inf": good(q=np.full((20, 2), np.inf)),
    "fewer than 2 samples of joint 'joint2'": good(q=np.array([[1.0, np.nan]] * 20)),
    "'elbow'": good(joints=("joint1", "elbow")),
    "different names": good(joints=("joint1", "joint1")),
    "1 columns of q, the scene 2, of joint1, joint2": {**good(), "q": good()["q"][:, :1], "joints": ("joint1",)},
    "columns of u": good(u=np.ones((20, 3))),
    "a row for each of the 20 times": good(u=np.ones((19, 2))),
    "must have the shape of q": good(v=np.ones((20, 1))),
    "at least 2 samples": good(t=[0.0]),
}


@pytest.mark.parametrize("why", BAD)
def test_a_wrong_log_is_refused(why):
    with pytest.raises(vp.InputError) as error:
        vp.Log(**BAD[why]).matched(vp.Scene(vp.planar_chain(2)))
    assert not unnamed(str(error.value), why), str(error.value)


def jump(t):
    return np.where(t > 0.1, t + 1.0, t)


DOUBTS = {
    "clock of the log": ("milliseconds", lambda own: own | {"t": 1e3 * own["t"]}),
    "gap in the log": ("no samples for 1.01 s", lambda own: own | {"t": jump(own["t"])}),
    "degrees": ("looks like degrees", lambda own: own | {"q": np.rad2deg(own["q"]) + 100.0 * np.arange(6)}),
    "log beyond limits": ("another order", lambda own: own | {"q": own["q"] + 6.0 * np.eye(6)[1]}),
    "dead encoder": ("'elbow_joint'", lambda own: own | {"q": own["q"] * (np.arange(6) != 2)}),
}


@pytest.mark.parametrize("kind", DOUBTS)
def test_a_doubtful_log_is_told(load, kind, caplog):
    why, change = DOUBTS[kind]
    log = vp.Log(**change(good(6))).matched(vp.Scene(load("ur5")))
    assert [found.kind for found in log.warnings] == [kind]
    assert [why in sentence for sentence in caplog.messages] == [True]


def test_a_right_log_is_not_doubted(load, caplog):
    still = good(6)
    still["q"][:] = still["q"][0]
    for own in (good(6), still):
        assert not vp.Log(**own).matched(vp.Scene(load("ur5"))).warnings
    assert not caplog.messages


@pytest.mark.parametrize(("intensity", "told"), [(0.05, False), (0.01, True), (0.005, True)])
def test_innovations_that_noise_does_not_explain_are_told(intensity, told, caplog):
    robot, rest = vp.planar_chain(2), np.zeros(2)
    arm = vp.Scene(robot, gravity=np.zeros(3), damping=0.5, noise=vp.AdditiveNoise(0.05))
    for seed in range(1 if told else 20):
        motion = vp.simulate(arm, rest, rest, dt=1e-2, steps=100, rng=seed, check=False)
        encoders = motion.q + ENCODER * np.random.default_rng(seed).standard_normal(motion.q.shape)
        log = vp.Log(motion.t, encoders, np.vstack([motion.u, motion.u[-1:]]))
        scene = vp.Scene(robot, gravity=np.zeros(3), damping=0.5, noise=vp.AdditiveNoise(intensity))
        found = vp.smooth(scene, log, q_noise=ENCODER)
        assert bool(naming(found.warnings, "innovations", f"{found.nis().mean():.3g}", "2")) == told
        assert str(found).splitlines() == [repr(found), *(f"warning: {warning}" for warning in found.warnings)]
    assert bool(caplog.messages) == told


def test_what_a_filter_refuses():
    robot = vp.planar_chain(2)
    scene, log = vp.Scene(robot, noise=vp.AdditiveNoise(1.0)), vp.Log(**good())
    fast = vp.CustomNoise(lambda q, v, u: v[:, None], 1, dv=lambda q, v, u: np.eye(2)[:, None])
    for why, given in {
        "the scene has no noise": {"scene": vp.Scene(robot)},
        "depend on the velocity": {"scene": vp.Scene(robot, noise=fast)},
        "q_noise must be positive": {"q_noise": 0.0},
        "no velocities": {"v_noise": 1.0},
        "external must be": {"external": 5.0},
        "external: time": {"external": (5.0, 0.0)},
        "dt must be positive": {"dt": -1.0},
        "positive semidefinite": {"covariance": -np.eye(4)},
        "q0 must have shape": {"q0": [0.0]},
        "has no Kalman filter": {"integrator": vp.Reference()},
        "must be a varpin.Log": {"log": 3},
    }.items():
        with refused(vp.InputError, why):
            vp.kalman_filter(**({"scene": scene, "log": log, "q_noise": ENCODER} | given))
    with refused(vp.InputError, "must have shape"):
        vp.kalman_filter(scene, log, q_noise=ENCODER).nees([0.0], [0.0])
