"""Backward passes of the core: on any model against the equations with whole matrices, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from varpin import core
from varpin.control.riccati import squares_of

H = 0.1  # the step
OPTIONS = [{}, {"rated": True}, {"velocity": False, "samples": 1}, {"within": True}, {"rated": True, "held": True}]


def random_steps(
    dof, m, k, *, seed, steps=6, hold=1, samples=2, velocity=True, rated=False, curved=False, within=False, held=False
):
    """Arrays of :class:`varpin.core.ExpandedSteps` with nothing special about them, every Hessian positive definite."""
    rng = np.random.default_rng(seed)
    x, size, decisions = 2 * dof, 2 * dof + m, steps // hold

    def definite(*shape):
        root = rng.normal(size=(*shape, shape[-1]))
        return np.swapaxes(root, -1, -2) @ root + 0.1 * np.eye(shape[-1])

    curvature = definite(steps, size)
    return {
        "A": np.eye(x) + 0.3 * rng.normal(size=(steps, x, x)),
        "B": rng.normal(size=(steps, x, m)),
        "G": rng.normal(size=(steps, x, k)),
        "Gx": 0.3 * rng.normal(size=(steps, x, k, x)),
        "Gu": 0.3 * rng.normal(size=(steps, x, k, m)),
        "rule": np.hstack([np.full((samples, 1), 1.0 / samples), rng.normal(size=(samples, 8))]),
        "gradient": rng.normal(size=(steps * samples, size)),
        "hessian": definite(steps * samples, size),
        "velocity": rng.normal(size=(steps + 1, dof, x) if velocity else (0, dof, x)),
        "curvature": curvature if curved else np.zeros((0, size, size)),
        "rate": definite(decisions, m) if rated else np.zeros((0, m, m)),
        "pull": rng.normal(size=(decisions if rated else 0, m)),
        "within": definite(steps, x) if within else np.zeros((0, x, x)),
        "held": rng.random((decisions, m)) < 0.5 if held else None,
    }


def gains_for(given, hold):
    """Empty arrays for a pass to fill in."""
    (N, x, m), k = given["B"].shape, given["G"].shape[2]
    R = N // hold
    return {
        "feedforward": np.full((R, m), np.nan),
        "feedback": np.full((R, m, x), np.nan),
        "previous": np.full(given["rate"].shape, np.nan),
        "control_gradient": np.full((R, m), np.nan),
        "costate": np.full((N, x), np.nan),
        "spread": np.full((N if k else 0, x, x), np.nan),
    }


def at_node(velocity, node, in_q, in_v, dof):
    """Rows in_q dq/dx + in_v dv/dx."""
    rates = velocity[node] if len(velocity) else np.eye(dof, 2 * dof, dof)
    return in_q * np.eye(dof, 2 * dof) + in_v * rates


def plainly(given, hold, regularization, end_gradient, end_hessian):
    """The equations of docs/mathematics.md with whole matrices: the state is (x, the control before) throughout."""
    A, B, G, Gx, Gu, rule = (given[name] for name in ("A", "B", "G", "Gx", "Gu", "rule"))
    (N, x, m), k, n, s = B.shape, G.shape[2], A.shape[1] // 2, len(rule)
    size, rated = x + m, len(given["rate"]) > 0
    out = gains_for(given, hold)
    V, g, z = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    V[:x, :x], g[:x], z[:x] = end_hessian, end_gradient, end_gradient
    slope = curvature = noise = 0.0
    for i in range(N - 1, -1, -1):
        out["costate"][i] = z[:x]
        step = np.block([[A[i], B[i]], [np.zeros((m, x)), np.eye(m)]])
        Q, Qz, Qc = step.T @ V @ step, step.T @ g, step.T @ z
        S = H * (V[:x, :x] + (given["within"][i] if len(given["within"]) else 0.0))
        if len(given["curvature"]):
            Q = Q + given["curvature"][i]
        for j in range(s):
            weight, q0, v0, q1, v1, *of_v = rule[j]
            point = i * s + j
            after, before = (
                np.vstack([at_node(given["velocity"], node, *in_q, n), at_node(given["velocity"], node, *in_v, n)])
                for node, in_q, in_v in ((i + 1, (q1, v1), of_v[2:]), (i, (q0, v0), of_v[:2]))
            )
            D = np.eye(size)
            D[:x] = after @ step[:x]
            D[:x, :x] += before
            Q = Q + H * weight * D.T @ given["hessian"][point] @ D
            Qz, Qc = (part + H * weight * D.T @ given["gradient"][point] for part in (Qz, Qc))
            S = S + H * H * weight * after.T @ given["hessian"][point, :x, :x] @ after
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
        r = i // hold
        rate = given["rate"][r] if rated else np.zeros((m, m))
        pull = given["pull"][r] if rated else np.zeros(m)
        # In (x, u, w), where the change u - w costs.
        whole, gradient = np.zeros((size + m, size + m)), np.concatenate([Qz, np.zeros(m)])
        whole[:size, :size] = Q
        change = np.hstack([np.zeros((m, x)), np.eye(m), -np.eye(m)])
        whole, gradient = whole + change.T @ rate @ change, gradient + change.T @ pull
        u, others = slice(x, size), np.r_[0:x, size : size + m]
        firm = whole[u, u] + regularization * np.diag(np.diagonal(whole[u, u]))
        free = np.eye(m) if given["held"] is None else np.diag(np.where(given["held"][r], 0.0, 1.0))
        gain = -free @ np.linalg.inv(free @ firm @ free + np.eye(m) - free) @ free
        K, kk = gain @ whole[u, others], gain @ gradient[u]
        out["feedforward"][r], out["feedback"][r] = kk, K[:, :x]
        if rated:
            out["previous"][r] = K[:, x:]
        out["control_gradient"][r] = Qc[u] + pull
        slope, curvature = slope + gradient[u] @ kk, curvature + kk @ whole[u, u] @ kk
        closed = np.zeros((size + m, size))
        closed[others], closed[u] = np.eye(size), K
        V = closed.T @ whole @ closed
        g = closed.T @ (gradient + whole[:, u] @ kk)
        z = np.concatenate([Qc[:x], -pull])
        # The control after this decision is the one before the next: it has a state of its own where it costs only.
        if not rated:
            V[x:], V[:, x:], g[x:] = 0.0, 0.0, 0.0
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
@pytest.mark.parametrize(
    "options",
    [{}, {"rated": True}, {"velocity": False, "samples": 1}, {"within": True}, {"rated": True, "held": True}],
    ids=str,
)
@pytest.mark.parametrize("hold", [1, 3])
@pytest.mark.parametrize(("dof", "m"), [(1, 1), (2, 3), (6, 6)])
def test_both_passes_are_the_equations(dof, m, hold, options, k, regularization):
    given = random_steps(dof, m, k, seed=dof, hold=hold, **options)
    gradient, hessian = terminal(2 * dof)
    right, sums = plainly(given, hold, regularization, gradient, hessian)
    steps = core.ExpandedSteps(**given)
    plain = core.BackwardPass(m, gradient, hessian)
    ours = gains_for(given, hold)
    assert plain.run(H, hold, regularization, steps, core.Gains(**ours)) == -1
    close(ours, right, 10)
    np.testing.assert_allclose((plain.slope, plain.curvature, plain.noise), sums, rtol=1e-10)
    roots = core.RootPass(m, squares_of(gradient[None], hessian[None]).core, gradient)
    ours = gains_for(given, hold)
    running, change = squares_of(given["gradient"], given["hessian"]), squares_of(given["pull"], given["rate"])
    within = squares_of(np.zeros(given["within"].shape[:2]), given["within"]).core
    assert roots.run(H, hold, regularization, steps, core.Gains(**ours), running.core, change.core, within) == -1
    close(ours, right, 9)
    np.testing.assert_allclose((roots.slope, roots.curvature, roots.noise), sums, rtol=1e-9)


def test_curvature_and_blocks():
    """Second derivatives are added, and two blocks of steps are one."""
    given = random_steps(3, 2, 1, seed=1, hold=2, curved=True)
    gradient, hessian = terminal(6)
    right, sums = plainly(given, 2, 0.0, gradient, hessian)
    ours = gains_for(given, 2)
    run = core.BackwardPass(2, gradient, hessian)
    for begin, end in ((4, 6), (0, 4)):
        part = dict(given)
        for name, array in given.items():
            each = {"rule": 0, "gradient": 2, "hessian": 2}.get(name, 1)
            if each and array is not None and len(array):
                part[name] = array[begin * each : end * each + (name == "velocity")]
        views = {
            name: array[begin:end] if name in ("costate", "spread") else array[begin // 2 : end // 2]
            for name, array in ours.items()
        }
        assert run.run(H, 2, 0.0, core.ExpandedSteps(**part), core.Gains(**views)) == -1
    close(ours, right, 10)
    np.testing.assert_allclose((run.slope, run.curvature, run.noise), sums, rtol=1e-10)


@pytest.mark.parametrize("hold", [1, 3])
@pytest.mark.parametrize("rated", [False, True])
@pytest.mark.parametrize("limited", [False, True])
def test_the_linearized_motion_under_gains_is_the_sum_of_its_steps(hold, rated, limited):
    """With controls that are clipped to their slack, and the states after all steps, also within a decision."""
    given = random_steps(2, 2, 0, seed=4, hold=hold, rated=rated)
    A, B, R, rng = given["A"], given["B"], 6 // hold, np.random.default_rng(5)
    slack = np.zeros((0, 2, 2))
    if limited:
        slack = np.stack([-rng.uniform(0.1, 1.0, (R, 2)), rng.uniform(0.1, 1.0, (R, 2))], axis=1)
    gains = {name: rng.normal(size=array.shape) for name, array in gains_for(given, hold).items()}
    state, expected, moves, after = rng.normal(size=6), np.empty((R, 6)), np.empty((R, 2)), np.empty((6, 4))
    begin = state.copy()
    plan = (gains["feedforward"], gains["feedback"], gains["previous"], slack)
    core.foresee(hold, A, B, *plan, state, expected, moves, after)
    x, before = begin[:4], begin[4:]
    for s in range(6):
        r = s // hold
        if s % hold == 0:
            np.testing.assert_allclose(expected[r], [*x, *before], rtol=1e-12)
            before = (
                gains["feedforward"][r] + gains["feedback"][r] @ x + (gains["previous"][r] @ before if rated else 0)
            )
            before = np.clip(before, *slack[r]) if limited else before
            np.testing.assert_allclose(moves[r], before, rtol=1e-12)
        x = A[s] @ x + B[s] @ before
        np.testing.assert_allclose(after[s], x, rtol=1e-12)
    np.testing.assert_allclose(state, [*x, *before], rtol=1e-12)
    with refused(ValueError, ("after", "5", "6")):
        core.foresee(hold, A, B, *plan, begin, expected, moves, after[:5])
    with refused(ValueError, "hold"):
        core.foresee(4, A, B, *plan, begin, expected, moves)


def test_the_decision_without_a_minimum_is_told():
    given = random_steps(2, 2, 0, seed=2)
    given["hessian"][2 * 3 : 2 * 4, 4:, 4:] = -1e6 * np.eye(2)
    gradient, hessian = terminal(4)
    assert core.BackwardPass(2, gradient, hessian).run(
        H, 1, 0.0, core.ExpandedSteps(**given), core.Gains(**gains_for(given, 1))
    ) == 3  # fmt: skip


@pytest.mark.parametrize(
    ("name", "shape", "facts"),
    [
        ("A", (6, 3, 3), "states"),
        ("B", (6, 3, 2), ("B", "3", "1", "4")),
        ("Gx", (6, 4, 1, 3), ("Gx", "3", "4")),
        ("rule", (2, 8), ("rule", "8", "1", "9")),
        ("hessian", (5, 6, 6), ("hessian", "5", "0", "12")),
        ("velocity", (6, 2, 4), ("velocity", "6", "0", "7")),
        ("pull", (1, 2), ("pull", "1", "0")),
    ],
)
def test_steps_that_do_not_fit_are_refused(name, shape, facts):
    given = random_steps(2, 2, 1, seed=3) | {name: np.zeros(shape)}
    with refused(ValueError, facts):
        core.ExpandedSteps(**given)


def test_gains_that_do_not_fit_are_refused():
    """Before anything is written; what is written to is never a copy."""
    given = random_steps(2, 2, 1, seed=3, rated=True)
    steps, (gradient, hessian) = core.ExpandedSteps(**given), terminal(4)
    for name, shape, facts in (
        ("feedback", (6, 2, 3), ("feedback", "3", "2", "4")),
        ("previous", (0, 2, 2), ("previous", "0", "6")),
        ("spread", (0, 4, 4), ("spread", "0", "6")),
    ):
        gains = core.Gains(**gains_for(given, 1) | {name: np.zeros(shape)})
        with refused(ValueError, facts):
            core.BackwardPass(2, gradient, hessian).run(H, 1, 0.0, steps, gains)
    for strided in (np.zeros((6, 4))[:, ::2], np.zeros((6, 2), dtype=np.float32)):
        with pytest.raises(TypeError):
            core.Gains(**gains_for(given, 1) | {"feedforward": strided})
    gains = core.Gains(**gains_for(given, 1))
    with refused(ValueError, "hold"):
        core.BackwardPass(2, gradient, hessian).run(H, 4, 0.0, steps, gains)
    with refused(ValueError, "states"):
        core.BackwardPass(1, gradient, hessian).run(H, 1, 0.0, steps, gains)
    with refused(ValueError, "change"):
        core.RootPass(2, squares_of(gradient[None], hessian[None]).core, gradient).run(
            H, 1, 0.0, steps, gains, squares_of(given["gradient"], given["hessian"]).core
        )
    with refused(ValueError, "hessian", "3", "0", "4"):
        core.BackwardPass(2, gradient, hessian[:3])
