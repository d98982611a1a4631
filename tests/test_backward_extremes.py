"""The backward pass where weights and inertias lie many digits apart, against plain recursions in 60 digits."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from findings import about

import varpin as vp
from varpin import core
from varpin.control.riccati import TRUSTED, squares_of

INERTIAS = {"unit": np.ones(3), "finger": np.array([1e-5, 1e-6, 1e-7]), "mixed": np.array([1.0, 1e-3, 1e-6])}
EXTREMES = (1e-9, 1.0, 1e9)


def exact(array):
    return np.vectorize(Decimal, otypes=[object])(np.asarray(array, dtype=float))


def solved(A, B):
    """Gaussian elimination, column by column."""
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
    """Three coupled springs, three controls: A, B, gradient and Hessian of the running cost and of the end's."""
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


def passes(A, B, gradient, hessian, end_gradient, end_hessian, h):
    """(failed, gains, feed-forward, loss) of the compiled recursion and of the one on square roots."""
    N, x, m = B.shape
    nothing = np.zeros((N, x, 0))
    given = {"A": A, "B": B, "G": nothing, "Gx": np.zeros((N, x, 0, x)), "Gu": np.zeros((N, x, 0, m))}
    given |= {"gradient": gradient, "hessian": hessian}
    for roots in (False, True):
        feedforward, feedback = np.zeros((N, m)), np.zeros((N, m, x))
        gains = {"feedforward": feedforward, "feedback": feedback, "control_gradient": np.zeros((N, m))}
        gains |= {"spread": np.zeros((0, x, x)), "factors": np.zeros((N, m, m))}
        if roots:
            run = core.RootPass(m, squares_of(end_gradient[None], end_hessian[None]).core, end_gradient)
            failed = run.run(h, 1, 0.0, **given, **gains, running=squares_of(gradient, hessian).core)
        else:
            run = core.BackwardPass(m, end_gradient, end_hessian)
            failed = run.run(h, 1, 0.0, **given, **gains)
        yield failed, feedback, feedforward, run.loss


def off(found, right):
    """Largest error, for each node and each control in units of the largest entry of its own row over all states."""
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
            given = made_up(INERTIAS[name], control, running, terminal)
            K, k = riccati(*given)
            plain, by_roots = passes(*given)
            assert by_roots[0] == -1
            assert off(by_roots[1], K) < 1e-10
            assert off_over_time(by_roots[2], k) < 1e-10
            if plain[0] >= 0 or plain[3] > TRUSTED:
                lost += 1
            else:
                assert off(plain[1], K) < 1e-5
                assert off_over_time(plain[2], k) < 1e-5
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
    """Springs without gravity are linear: one step of the search, where the plain recursion finds no minimum."""
    robot = vp.planar_chain(2)
    scene = vp.Scene(robot, gravity=False)
    cost = vp.ControlCost(1e-9) + vp.Terminal(vp.TrackingCost([1e-3, -1e-3], 1e9) + vp.VelocityCost(1e7))
    problem = vp.OptimalControlProblem(scene, cost, np.zeros(2), np.zeros(2), dt=0.01, steps=40)
    sol = vp.solve(problem)
    assert sol.status is vp.Status.CONVERGED, sol.reason
    assert np.abs(sol.trajectory.q[-1] - [1e-3, -1e-3]).max() < 1e-9


def test_what_is_lost_is_told(caplog):
    """Six decades of inertia under eighteen of weights: the plan, and what rounding may have done to it."""
    sol = vp.solve(reach("finger", 1e-9, 1e-9, 1e9, integrator=vp.Midpoint(), sampling="midpoint"))
    assert about(sol.reason, "rounding in Quu")
    assert about(caplog.messages, "untrusted gains")
    caplog.clear()
    ordinary = vp.solve(reach(vp.planar_chain(3), 1e-2, 1.0, 10.0))
    assert not about(ordinary.reason, "rounding in Quu")
    assert not about(caplog.messages, "untrusted gains")
