"""Backward passes of the core: on any model against the equations with whole matrices, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from varpin import core
from varpin.control.riccati import squares_of

H = 0.1  # the step


def random_steps(dof, m, k, *, seed, steps=6):
    """Steps for a backward pass with nothing special about them, every Hessian positive definite."""
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


def gains_for(given, hold):
    """Empty arrays for a pass to fill in."""
    (N, x, m), k = given["B"].shape, given["G"].shape[2]
    R = N // hold
    return {
        "feedforward": np.full((R, m), np.nan),
        "feedback": np.full((R, m, x), np.nan),
        "control_gradient": np.full((R, m), np.nan),
        "spread": np.full((N if k else 0, x, x), np.nan),
    }


def run_over(run, given, gains, hold=1, regularization=0.0, **more):
    """The result of a pass over steps that fills in the gains."""
    R, m = gains["feedforward"].shape
    return run.run(H, hold, regularization, **given, **{"factors": np.empty((R, m, m)), **gains}, **more)


def plainly(given, hold, regularization, end_gradient, end_hessian):
    """The equations of docs/mathematics.md with whole matrices: the state is (x, u) throughout."""
    A, B, G, Gx, Gu = (given[name] for name in ("A", "B", "G", "Gx", "Gu"))
    (N, x, m), k = B.shape, G.shape[2]
    size = x + m
    out = gains_for(given, hold)
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
    return out, (slope, curvature, noise)


def close(ours, theirs, digits):
    for name, right in theirs.items():
        if right.size:
            scale = np.abs(right).max()
            np.testing.assert_allclose(ours[name], right, rtol=0, atol=10.0**-digits * scale, err_msg=name)


def terminal(x):
    rng = np.random.default_rng(7)
    root = rng.normal(size=(x, x))
    return rng.normal(size=x), root.T @ root


@pytest.mark.parametrize("regularization", [0.0, 0.3])
@pytest.mark.parametrize("k", [0, 2])
@pytest.mark.parametrize("hold", [1, 3])
@pytest.mark.parametrize(("dof", "m"), [(1, 1), (2, 3), (6, 6)])
def test_both_passes_are_the_equations(dof, m, hold, k, regularization):
    given = random_steps(dof, m, k, seed=dof)
    gradient, hessian = terminal(2 * dof)
    right, sums = plainly(given, hold, regularization, gradient, hessian)
    plain = core.BackwardPass(m, gradient, hessian)
    ours = gains_for(given, hold)
    assert run_over(plain, given, ours, hold, regularization) == -1
    close(ours, right, 10)
    np.testing.assert_allclose((plain.slope, plain.curvature, plain.noise), sums, rtol=1e-10)
    roots = core.RootPass(m, squares_of(gradient[None], hessian[None]).core, gradient)
    ours = gains_for(given, hold)
    running = squares_of(given["gradient"], given["hessian"]).core
    assert run_over(roots, given, ours, hold, regularization, running=running) == -1
    close(ours, right, 9)
    np.testing.assert_allclose((roots.slope, roots.curvature, roots.noise), sums, rtol=1e-9)


def test_blocks():
    """Two blocks of steps are one."""
    given = random_steps(3, 2, 1, seed=1)
    gradient, hessian = terminal(6)
    right, sums = plainly(given, 2, 0.0, gradient, hessian)
    ours = gains_for(given, 2)
    run = core.BackwardPass(2, gradient, hessian)
    for begin, end in ((4, 6), (0, 4)):
        part = {name: array[begin:end] for name, array in given.items()}
        views = {
            name: array[begin:end] if name == "spread" else array[begin // 2 : end // 2] for name, array in ours.items()
        }
        assert run_over(run, part, views, 2) == -1
    close(ours, right, 10)
    np.testing.assert_allclose((run.slope, run.curvature, run.noise), sums, rtol=1e-10)


@pytest.mark.parametrize("hold", [1, 3])
@pytest.mark.parametrize("limited", [False, True])
def test_the_linearized_motion_under_gains_is_the_sum_of_its_steps(hold, limited):
    """With controls that are clipped to their slack, and the states after all steps, also within a decision."""
    given = random_steps(2, 2, 0, seed=4)
    A, B, R, rng = given["A"], given["B"], 6 // hold, np.random.default_rng(5)
    slack = np.zeros((0, 2, 2))
    if limited:
        slack = np.stack([-rng.uniform(0.1, 1.0, (R, 2)), rng.uniform(0.1, 1.0, (R, 2))], axis=1)
    gains = {name: rng.normal(size=array.shape) for name, array in gains_for(given, hold).items()}
    moves, after = np.empty((R, 2)), np.empty((6, 4))
    plan = (gains["feedforward"], gains["feedback"], slack)
    core.foresee(hold, A, B, *plan, moves, after)
    x = np.zeros(4)
    for s in range(6):
        r = s // hold
        if s % hold == 0:
            u = gains["feedforward"][r] + gains["feedback"][r] @ x
            u = np.clip(u, *slack[r]) if limited else u
            np.testing.assert_allclose(moves[r], u, rtol=1e-12)
        x = A[s] @ x + B[s] @ u
        np.testing.assert_allclose(after[s], x, rtol=1e-12)
    with refused(ValueError, ("after", "5", "6")):
        core.foresee(hold, A, B, *plan, moves, after[:5])
    with refused(ValueError, "hold"):
        core.foresee(4, A, B, *plan, moves, after)


def test_the_decision_without_a_minimum_is_told():
    given = random_steps(2, 2, 0, seed=2)
    given["hessian"][3, 4:, 4:] = -1e6 * np.eye(2)
    gradient, hessian = terminal(4)
    assert run_over(core.BackwardPass(2, gradient, hessian), given, gains_for(given, 1)) == 3


@pytest.mark.parametrize(
    ("name", "shape", "facts"),
    [
        ("A", (6, 3, 3), "states"),
        ("B", (6, 3, 2), ("B", "3", "1", "4")),
        ("Gx", (6, 4, 1, 3), ("Gx", "3", "4")),
        ("gradient", (5, 6), ("gradient", "5", "0", "6")),
        ("hessian", (5, 6, 6), ("hessian", "5", "0", "6")),
        ("feedback", (6, 2, 3), ("feedback", "3", "2", "4")),
        ("spread", (0, 4, 4), ("spread", "0", "6")),
        ("factors", (6, 2, 1), ("factors", "1", "2")),
    ],
)
def test_arrays_that_do_not_fit_are_refused(name, shape, facts):
    given = random_steps(2, 2, 1, seed=3)
    gains = gains_for(given, 1)
    (given if name in given else gains)[name] = np.zeros(shape)
    with refused(ValueError, facts):
        run_over(core.BackwardPass(2, *terminal(4)), given, gains)


def test_what_is_written_to_is_never_a_copy():
    given = random_steps(2, 2, 1, seed=3)
    for strided in (np.zeros((6, 4))[:, ::2], np.zeros((6, 2), dtype=np.float32)):
        with pytest.raises(TypeError):
            run_over(core.BackwardPass(2, *terminal(4)), given, gains_for(given, 1) | {"feedforward": strided})


def test_passes_that_do_not_fit_are_refused():
    given = random_steps(2, 2, 1, seed=3)
    gains, (gradient, hessian) = gains_for(given, 1), terminal(4)
    with refused(ValueError, "hold"):
        run_over(core.BackwardPass(2, gradient, hessian), given, gains, 4)
    with refused(ValueError, "states"):
        run_over(core.BackwardPass(1, gradient, hessian), given, gains)
    with refused(ValueError, "hessian", "3", "0", "4"):
        core.BackwardPass(2, gradient, hessian[:3])
