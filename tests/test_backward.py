"""Backward passes: equations with whole matrices, and 60 digits where weights lie far apart."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from findings import about
from numpy.testing import assert_allclose
from refusals import refused

import varpin as vp
from varpin import core
from varpin.control.sizes import HARMLESS
from varpin.control.square_root import RootPass, squares_of

H = 0.1  # the step
INERTIAS = {"unit": np.ones(3), "finger": np.array([1e-5, 1e-6, 1e-7]), "mixed": np.array([1.0, 1e-3, 1e-6])}
EXTREMES = (1e-9, 1.0, 1e9)


def random_steps(dof, m, k, *, seed, steps=6):
    rng = np.random.default_rng(seed)
    x, size = 2 * dof, 2 * dof + m

    def definite(*shape):
        root = rng.normal(size=(*shape, shape[-1]))
        return np.swapaxes(root, -1, -2) @ root + 0.1 * np.eye(shape[-1])

    return {
        "A": np.eye(x) + 0.3 * rng.normal(size=(steps, x, x)),
        "B": rng.normal(size=(steps, x, m)),
        "G": rng.normal(size=(steps, x, k)),
        "Gx": 0.3 * rng.normal(size=(steps, x, k, x)),
        "Gu": 0.3 * rng.normal(size=(steps, x, k, m)),
        "gradient": rng.normal(size=(steps, size)),
        "hessian": definite(steps, size),
    }


def empty(given, hold):
    (N, x, m), k = given["B"].shape, given["G"].shape[2]
    R = N // hold
    return {
        "feedforward": np.full((R, m), np.nan),
        "feedback": np.full((R, m, x), np.nan),
        "control_gradient": np.full((R, m), np.nan),
        "spread": np.full((N if k else 0, x, x), np.nan),
        "factors": np.full((R, m, m), np.nan),
    }


def run_over(given, end_gradient, end_hessian, *, roots, hold=1, regularization=0.0, h=H):
    """(-1 or the decision without a minimum, what the pass filled in, the pass)."""
    m, gains = given["B"].shape[2], empty(given, hold)
    if roots:
        run = RootPass(m, squares_of(end_gradient[None], end_hessian[None]), end_gradient)
        given = given | {"hessian": squares_of(given["gradient"], given["hessian"])}
    else:
        run = core.BackwardPass(m, end_gradient, end_hessian)
    return run.run(h, hold, regularization, **given, **gains), gains, run


def plainly(given, hold, regularization, end_gradient, end_hessian):
    """The equations of docs/mathematics.md with whole matrices: the state is (x, u) throughout."""
    A, B, G, Gx, Gu = (given[name] for name in ("A", "B", "G", "Gx", "Gu"))
    (N, x, m), k = B.shape, G.shape[2]
    size = x + m
    out = empty(given, hold)
    V, g, z = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    V[:x, :x], g[:x], z[:x] = end_hessian, end_gradient, end_gradient
    slope = curvature = noise = 0.0
    for i in range(N - 1, -1, -1):
        step = np.block([[A[i], B[i]], [np.zeros((m, x)), np.eye(m)]])
        Q = step.T @ V @ step + H * given["hessian"][i]
        Qz, Qc = (step.T @ part + H * given["gradient"][i] for part in (g, z))
        S = H * V[:x, :x]
        for w in range(k):
            F = np.hstack([Gx[i, :, w], Gu[i, :, w]])
            Q = Q + F.T @ S @ F
            Qz, Qc = Qz + F.T @ S @ G[i, :, w], Qc + F.T @ S @ G[i, :, w]
            noise += 0.5 * G[i, :, w] @ S @ G[i, :, w]
        if k:
            out["spread"][i] = S
        if i % hold:
            V, g, z = Q, Qz, Qc
            continue
        r, u = i // hold, slice(x, size)
        Quu = Q[u, u]
        firm = np.linalg.inv(Quu + regularization * np.diag(np.diagonal(Quu)))
        kk, K = -firm @ Qz[u], -firm @ Q[u, :x]
        out["feedforward"][r], out["feedback"][r], out["control_gradient"][r] = kk, K, Qc[u]
        slope, curvature = slope + Qz[u] @ kk, curvature + kk @ Quu @ kk
        closed = np.vstack([np.eye(x), K])
        # Nothing before a decision depends on the control after it.
        V, g, z = np.zeros((size, size)), np.zeros(size), np.zeros(size)
        V[:x, :x], g[:x], z[:x] = closed.T @ Q @ closed, closed.T @ (Qz + Q[:, u] @ kk), Qc[:x]
    del out["factors"]
    return out, (slope, curvature, noise)


def close(ours, theirs, digits):
    for name, right in theirs.items():
        if right.size:
            scale = np.abs(right).max()
            assert_allclose(ours[name], right, rtol=0, atol=10.0**-digits * scale, err_msg=name)


def terminal(x):
    rng = np.random.default_rng(7)
    root = rng.normal(size=(x, x))
    return rng.normal(size=x), root.T @ root


@pytest.mark.parametrize("regularization", [0.0, 0.3])
@pytest.mark.parametrize("k", [0, 2])
@pytest.mark.parametrize("hold", [1, 3])
@pytest.mark.parametrize(("dof", "m"), [(1, 1), (2, 3), (6, 6)])
@pytest.mark.parametrize("roots", [False, True], ids=["plain", "roots"])
def test_a_pass_is_the_equations(roots, dof, m, hold, k, regularization):
    given, ends = random_steps(dof, m, k, seed=dof), terminal(2 * dof)
    right, sums = plainly(given, hold, regularization, *ends)
    failed, ours, run = run_over(given, *ends, roots=roots, hold=hold, regularization=regularization)
    assert failed == -1
    close(ours, right, 9 if roots else 10)
    assert_allclose((run.slope, run.curvature, run.noise), sums, rtol=1e-9 if roots else 1e-10)


def test_two_blocks_are_one_pass():
    given, ends = random_steps(3, 2, 1, seed=1), terminal(6)
    right, sums = plainly(given, 2, 0.0, *ends)
    ours, run = empty(given, 2), core.BackwardPass(2, *ends)
    for begin, end in ((4, 6), (0, 4)):
        part = {name: array[begin:end] for name, array in given.items()}
        views = {
            name: array[begin:end] if name == "spread" else array[begin // 2 : end // 2] for name, array in ours.items()
        }
        assert run.run(H, 2, 0.0, **part, **views) == -1
    close(ours, right, 10)
    assert_allclose((run.slope, run.curvature, run.noise), sums, rtol=1e-10)


@pytest.mark.parametrize("hold", [1, 3])
@pytest.mark.parametrize("limited", [False, True])
def test_the_linearized_motion_under_gains_is_the_sum_of_its_steps(hold, limited):
    given = random_steps(2, 2, 0, seed=4)
    A, B, R, rng = given["A"], given["B"], 6 // hold, np.random.default_rng(5)
    slack = np.zeros((0, 2, 2))
    if limited:
        slack = np.stack([-rng.uniform(0.1, 1.0, (R, 2)), rng.uniform(0.1, 1.0, (R, 2))], axis=1)
    gains = {name: rng.normal(size=array.shape) for name, array in empty(given, hold).items()}
    moves, after = np.empty((R, 2)), np.empty((6, 4))
    plan = (gains["feedforward"], gains["feedback"], slack)
    core.foresee(hold, A, B, *plan, moves, after)
    x = np.zeros(4)
    for s in range(6):
        r = s // hold
        if s % hold == 0:
            u = gains["feedforward"][r] + gains["feedback"][r] @ x
            u = np.clip(u, *slack[r]) if limited else u
            assert_allclose(moves[r], u, rtol=1e-12)
        x = A[s] @ x + B[s] @ u
        assert_allclose(after[s], x, rtol=1e-12)
    with refused(ValueError, ("after", "5", "6")):
        core.foresee(hold, A, B, *plan, moves, after[:5])
    with refused(ValueError, "hold"):
        core.foresee(4, A, B, *plan, moves, after)


def test_the_decision_without_a_minimum_is_told():
    given = random_steps(2, 2, 0, seed=2)
    given["hessian"][3, 4:, 4:] = -1e6 * np.eye(2)
    assert run_over(given, *terminal(4), roots=False)[0] == 3


@pytest.mark.parametrize("roots", [False, True], ids=["plain", "roots"])
def test_a_control_without_any_effect_leaves_the_others_as_they_are(roots):
    given, ends = random_steps(2, 3, 0, seed=6), terminal(4)
    given["B"][..., 2] = given["gradient"][:, 6] = 0.0
    given["hessian"][:, 6] = given["hessian"][:, :, 6] = 0.0
    failed, ours, _ = run_over(given, *ends, roots=roots)
    assert failed == -1
    others = {"B": given["B"][..., :2], "Gu": given["Gu"][..., :2]}
    others |= {"gradient": given["gradient"][:, :6], "hessian": given["hessian"][:, :6, :6]}
    right, _ = plainly(given | others, 1, 0.0, *ends)
    for name in ("feedforward", "feedback"):
        assert_allclose(ours[name][:, :2], right[name], rtol=1e-8, atol=1e-10)
        assert not ours[name][:, 2].any()


def test_what_is_written_to_is_never_a_copy():
    given, run = random_steps(2, 2, 1, seed=3), core.BackwardPass(2, *terminal(4))
    for strided in (np.zeros((6, 4))[:, ::2], np.zeros((6, 2), dtype=np.float32)):
        with pytest.raises(TypeError):
            run.run(H, 1, 0.0, **given, **(empty(given, 1) | {"feedforward": strided}))


def test_periods_that_do_not_fit_are_refused():
    given, (gradient, hessian) = random_steps(2, 2, 1, seed=3), terminal(4)
    with refused(ValueError, "hold"):
        core.BackwardPass(2, gradient, hessian).run(H, 4, 0.0, **given, **empty(given, 1))


def test_rows_are_made_triangular():
    rows = np.random.default_rng(2).normal(size=(7, 4)) * [[1e6], [1.0], [1e-6], [1.0], [1e6], [1.0], [0.0]]
    found = core.triangular(rows, 4)
    assert_allclose(found.T @ found, rows.T @ rows, rtol=1e-12)
    assert (np.tril(found, -1) == 0.0).all()
    for leading in (-1, 5):
        with refused(ValueError, "triangular"):
            core.triangular(rows, leading)


def exact(array):
    return np.vectorize(Decimal, otypes=[object])(np.asarray(array, dtype=float))


def solved(A, B):
    A, B, n = A.copy(), B.copy(), len(A)
    for k in range(n):
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            A[i], B[i] = A[i] - factor * A[k], B[i] - factor * B[k]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            B[i] = B[i] - A[i, j] * B[j]
        B[i] = B[i] / A[i, i]
    return B


def riccati(A, B, gradient, hessian, end_gradient, end_hessian, h):
    """Gains and feed-forward parts of the textbook recursion in 60 digits."""
    x = A.shape[1]
    with localcontext() as context:
        context.prec = 60
        W, w, h = exact(end_hessian), exact(end_gradient)[:, None], Decimal(h)
        gains, changes = [], []
        for k in range(len(A) - 1, -1, -1):
            J = np.hstack([exact(A[k]), exact(B[k])])
            Q = J.T.dot(W).dot(J) + h * exact(hessian[k])
            g = J.T.dot(w) + h * exact(gradient[k])[:, None]
            both = -solved(Q[x:, x:], np.hstack([Q[x:, :x], g[x:]]))
            K = both[:, :x]
            W, w = Q[:x, :x] + Q[:x, x:].dot(K), g[:x] + K.T.dot(g[x:])
            gains.append(K.astype(float))
            changes.append(both[:, x].astype(float))
    return np.array(gains[::-1]), np.array(changes[::-1])


def made_up(inertia, control, running, terminal, *, steps=20, h=1e-2):
    """Three coupled springs: A, B, gradient and Hessian of the running cost and of the end's."""
    n, rng = 3, np.random.default_rng(0)
    scale = np.sqrt(np.outer(inertia, inertia))
    A, B = np.zeros((steps, 2 * n, 2 * n)), np.zeros((steps, 2 * n, n))
    for k in range(steps):
        M = scale * (np.eye(n) + 0.1 * rng.uniform(-1.0, 1.0, (n, n)))
        inverse = np.linalg.inv(0.5 * (M + M.T))
        springs = scale * rng.normal(size=(n, n)) * 30.0
        A[k] = np.eye(2 * n)
        A[k, :n, n:] += h * np.eye(n)
        A[k, n:] -= h * np.hstack([inverse @ springs, 0.1 * np.eye(n)])
        B[k] = np.vstack([0.5 * h * h * inverse, h * inverse])
    weights = np.repeat([running, 1e-3 * running, control], n)
    gradient, hessian = rng.normal(size=(steps, 3 * n)) * weights, np.tile(np.diag(weights), (steps, 1, 1))
    end = terminal * np.diag(np.repeat([1.0, 0.01], n))
    return A, B, gradient, hessian, end @ rng.normal(size=2 * n), end, h


def off(found, right):
    """Largest error, in units of the largest entry of its row over all states."""
    size = np.abs(right).max(axis=-1, keepdims=True)
    return (np.abs(found - right) / np.where(size > 0.0, size, 1.0)).max()


def off_over_time(found, right):
    """Largest error of feed-forward parts, each control in units of its own largest."""
    return (np.abs(found - right) / np.abs(right).max(axis=0)).max()


@pytest.mark.parametrize("control", [1e-9, 1e-3, 1.0, 1e9])
@pytest.mark.parametrize("name", INERTIAS)
def test_gains_over_eighteen_decades_of_weights(name, control):
    lost = 0
    for running in EXTREMES:
        for terminal in EXTREMES:
            made = made_up(INERTIAS[name], control, running, terminal)
            K, k = riccati(*made)
            A, B, gradient, hessian, *ends, h = made
            N, x, m = B.shape
            given = {"A": A, "B": B, "G": np.zeros((N, x, 0)), "Gx": np.zeros((N, x, 0, x))}
            given |= {"Gu": np.zeros((N, x, 0, m)), "gradient": gradient, "hessian": hessian}
            failed, plain, run = run_over(given, *ends, roots=False, h=h)
            by_roots = run_over(given, *ends, roots=True, h=h)[:2]
            assert by_roots[0] == -1
            assert off(by_roots[1]["feedback"], K) < 1e-10
            assert off_over_time(by_roots[1]["feedforward"], k) < 1e-10
            if failed >= 0 or run.loss > HARMLESS:
                lost += 1
            else:
                assert off(plain["feedback"], K) < 1e-5
                assert off_over_time(plain["feedforward"], k) < 1e-5
    # With light controls the plain recursion has to know that it is lost, and with heavy ones that it is not.
    assert control > 1e-9 or lost > 0
    assert control < 1e9 or lost <= 2


def reach(robot, control, running, terminal, **options):
    robot = vp.load_robot(robot) if isinstance(robot, str) else robot
    n = robot.dof
    cost = vp.ControlCost(control) + vp.TrackingCost(np.linspace(0.2, -0.3, n), running)
    cost += vp.Terminal(vp.TrackingCost(np.linspace(0.4, 0.1, n), terminal) + vp.VelocityCost(1e-2 * terminal))
    options = {"dt": 0.01, "steps": 30, "sampling": "start", "integrator": vp.RungeKutta4()} | options
    scene = vp.Scene(robot, noise=options.pop("noise", None), gravity=False)
    return vp.OptimalControlProblem(scene, cost, np.linspace(0.1, 0.5, n), np.zeros(n), **options)


def test_an_optimum_at_extreme_weights_is_found_at_once():
    """Where the plain recursion finds no minimum."""
    robot = vp.planar_chain(2)
    scene = vp.Scene(robot, gravity=False)
    cost = vp.ControlCost(1e-9) + vp.Terminal(vp.TrackingCost([1e-3, -1e-3], 1e9) + vp.VelocityCost(1e7))
    problem = vp.OptimalControlProblem(scene, cost, np.zeros(2), np.zeros(2), dt=0.01, steps=40)
    sol = vp.solve(problem)
    assert sol.status.converged, sol.reason
    assert np.abs(sol.trajectory.q[-1] - [1e-3, -1e-3]).max() < 1e-9


def test_what_is_lost_is_told(caplog):
    """Six decades of inertia under eighteen of weights."""
    sol = vp.solve(reach("finger", 1e-9, 1e-9, 1e9, integrator=vp.Midpoint(), sampling="midpoint"))
    assert about(sol.reason, "rounding in Quu")
    assert about(caplog.messages, "untrusted gains")
    caplog.clear()
    ordinary = vp.solve(reach(vp.planar_chain(3), 1e-2, 1.0, 10.0))
    assert not about(ordinary.reason, "rounding in Quu")
    assert not about(caplog.messages, "untrusted gains")
