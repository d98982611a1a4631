"""The backward pass of stochastic differential dynamic programming (Theodorou, Tassa and Todorov 2010).

The value after a step is v0 + Wx . x' + Wu . u + (1/2) (x', u) W (x', u), in deviations from the nominal trajectory;
u is in it only while a control is held over several steps. With x' = A x + B u + sum_i (g_i + Gx_i x + Gu_i u) dw_i,
the cost of the step expanded at its sample z = D (x, u), and S = h Wxx,

    Q_x  = D'l_z + A'Wx + sum_i Gx_i' S g_i,        Q_xx = D'l_zz D + A'Wxx A + sum_i Gx_i' S Gx_i,

and so on in u; v0 grows by (1/2) sum_i g_i' S g_i. Everything is symmetric and only dense products of small matrices.

Where the change of the control costs (1/2) (u - w)' R (u - w), w the control before, the decision adds R to Q_uu and to
Q_ww and -R to Q_uw: gains on w are those on x with -R in place of Q_ux, and the value before it is one of (x, w).
"""

from typing import NamedTuple

import numpy as np

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.box import solve_box
from varpin.kernels.linalg import factor_ldl, solve_ldl, solve_ldl_rows
from varpin.kernels.tree import Floats

EPS = float(np.finfo(np.float64).eps)


class Steps(NamedTuple):
    """The linearized dynamics and the expanded costs of N steps."""

    A: Floats  # (N, 2n, 2n)
    B: Floats  # (N, 2n, m)
    G: Floats  # (N, 2n, k)
    Gx: Floats  # (N, 2n, k, 2n)
    Gu: Floats  # (N, 2n, k, m)
    rule: Floats  # (s, 9) of each sample of the running cost in a step: its weight, then q and v as below
    gradient: Floats  # (N s, 2n + m) of the running cost at the samples (q, v, u)
    hessian: Floats  # (N s, 2n + m, 2n + m), or (1, 2n + m, 2n + m)
    velocity: Floats  # (N + 1, n, 2n) dv/dx at the nodes; (0, n, 2n) where x holds v itself, or no sample asks for it
    curvature: Floats  # (N, 2n + m, 2n + m) to be added to the Hessian in (x, u), or (0, 2n + m, 2n + m)
    slack: Floats  # (R, 2, m) least and greatest change of each control, or (0, 2, m) where controls have no limits
    rate: Floats  # (R, m, m) Hessian of what the change from the control before costs, or (0, m, m) for nothing
    pull: Floats  # (R, m) its gradient in the control, or (0, m)


class Value(NamedTuple):
    """Quadratic model of the cost to go, in (x, u) while u is held, and else in x alone, or with the control before."""

    gradient: Floats  # (2n + m,)
    hessian: Floats  # (2n + m, 2n + m)
    costate: Floats  # (2n + m,) the gradient without feedback and feed-forward: of the cost itself
    noise: Floats  # (1,) what noise adds to the cost so far
    decrease: Floats  # (2,) sums of Qu . k and k . Quu k
    scale: Floats  # (2n + m,) rounding has left entry (i, j) of the Hessian off by about eps scale_i scale_j
    loss: Floats  # (1,) the largest relative error of a pivot of Quu so far, by these scales


class Gains(NamedTuple):
    """What the backward pass is for: u + k + K (x - x_nominal), one row for each of R decisions."""

    feedforward: Floats  # (R, m)
    feedback: Floats  # (R, m, 2n)
    previous: Floats  # (R, m, m) gains on the control before; (0, m, m) where its change costs nothing
    control_gradient: Floats  # (R, m) of the cost in each control
    costate: Floats  # (N, 2n) gradient of the cost after each step in the state there; (0, 2n) if not asked for
    spread: Floats  # (N, 2n, 2n) S; (0, 2n, 2n) without noise


class Room(NamedTuple):
    """Work arrays of the backward pass."""

    J: Floats  # (2n, 2n + m) [A B]
    D: Floats  # (2n, 2n + m) of (q, v) at the sample
    P: Floats  # (2n, 2n) of the same in the state at one node
    T: Floats  # (2n + m, 2n + m) a product
    Q: Floats  # (2n + m, 2n + m)
    Qz: Floats  # (2n + m,)
    costate: Floats  # (2n + m,)
    Quu: Floats  # (m, m)
    row: Floats  # (2n + m,)
    solved: Floats  # (2n + m,)
    scale: Floats  # (2n + m,) of Q, as that of the value
    box: Floats  # (3, m) of the minimum within limits
    H: Floats  # (m, m) Quu, kept while Quu is factored


def new_value(dof: int, controls: int) -> Value:
    """A value of zero."""
    size = 2 * dof + controls
    return Value(
        np.zeros(size), np.zeros((size, size)), np.zeros(size), np.zeros(1), np.zeros(2), np.zeros(size), np.zeros(1)
    )


def new_room(dof: int, controls: int) -> Room:
    """Allocate the work arrays."""
    x, size = 2 * dof, 2 * dof + controls
    return Room(
        J=np.zeros((x, size)),
        D=np.zeros((x, size)),
        P=np.zeros((x, x)),
        T=np.zeros((size, size)),
        Q=np.zeros((size, size)),
        Qz=np.zeros(size),
        costate=np.zeros(size),
        Quu=np.zeros((controls, controls)),
        row=np.zeros(size),
        solved=np.zeros(size),
        scale=np.zeros(size),
        box=np.zeros((3, controls)),
        H=np.zeros((controls, controls)),
    )


@inlined
def add_two_rows(a: float, b: float, x: Floats, y: Floats, size: int, out: Floats) -> None:
    """Add a x + b y to a row, which the processor loads and stores once for both; zeros cost nothing."""
    if a == 0.0 and b == 0.0:
        return
    for c in range(size):
        out[c] += a * x[c] + b * y[c]


@inlined
def add_congruence(J: Floats, W: Floats, rows: int, scale: float, T: Floats, Q: Floats) -> None:
    """Q += scale J' W J for the leading ``rows`` rows of J and of W.

    Whole rows at a time, which the processor takes several entries of at once.
    """
    size = Q.shape[0]
    for i in range(rows):
        for c in range(size):
            T[i, c] = 0.0
        for j in range(0, rows - 1, 2):
            add_two_rows(scale * W[i, j], scale * W[i, j + 1], J[j], J[j + 1], size, T[i])
        if rows % 2 == 1:
            add_two_rows(scale * W[i, rows - 1], 0.0, J[rows - 1], J[rows - 1], size, T[i])
    for i in range(0, rows - 1, 2):
        for r in range(size):
            add_two_rows(J[i, r], J[i + 1, r], T[i], T[i + 1], size, Q[r])
    if rows % 2 == 1:
        for r in range(size):
            add_two_rows(J[rows - 1, r], 0.0, T[rows - 1], T[rows - 1], size, Q[r])


@inlined
def state_at_sample(rule: Floats, velocity: Floats, node: int, after: int, D: Floats) -> None:
    """Derivative D (2n, 2n) of (q, v) at a sample in the state x at ``node``.

    A row of the rule is (weight, q of q0, v0, q1, v1, v of q0, v0, q1, v1): q and v at the sample are those sums of the
    nodes' own; ``after`` is 2 for the node after the step and 0 for the one before.
    """
    n = D.shape[0] // 2
    for half in range(2):
        in_q, in_v = rule[1 + 4 * half + after], rule[2 + 4 * half + after]
        for i in range(n):
            row = D[half * n + i]
            for c in range(2 * n):
                row[c] = 0.0
            row[i] = in_q
            if velocity.shape[0] == 0:
                row[n + i] = in_v
            elif in_v != 0.0:
                for c in range(2 * n):
                    row[c] += in_v * velocity[node, i, c]


@inlined
def add_running_cost(steps: Steps, s: int, h: float, in_velocity: bool, room: Room) -> None:
    """Add the samples h w l(z) to Q and Qz, with z = D (x, u)."""
    D, T, Q, Qz, J, P = room.D, room.T, room.Q, room.Qz, room.J, room.P
    x, size = J.shape
    n = x // 2
    rows = x if in_velocity else n
    samples = steps.rule.shape[0]
    for k in range(samples):
        point = s * samples + k
        g = steps.gradient[point]
        H = steps.hessian[point if steps.hessian.shape[0] > 1 else 0]
        weight = h * steps.rule[k, 0]
        if steps.velocity.shape[0] == 0:
            for half in range(2):
                rule = steps.rule[k, 1 + 4 * half : 5 + 4 * half]
                for i in range(n):
                    row = D[half * n + i]
                    for c in range(size):
                        row[c] = rule[2] * J[i, c] + rule[3] * J[n + i, c]
                    row[i] += rule[0]
                    row[n + i] += rule[1]
        else:
            for i in range(x):
                for c in range(size):
                    D[i, c] = 0.0
            state_at_sample(steps.rule[k], steps.velocity, s + 1, 2, P)
            for i in range(x):
                for j in range(x):
                    factor = P[i, j]
                    for c in range(size):
                        D[i, c] += factor * J[j, c]
            state_at_sample(steps.rule[k], steps.velocity, s, 0, P)
            for i in range(x):
                for c in range(x):
                    D[i, c] += P[i, c]
        for c in range(size):
            room.row[c] = g[c] if c >= x else 0.0
        for i in range(x):
            for c in range(size):
                room.row[c] += D[i, c] * g[i]
        for c in range(size):
            Qz[c] += weight * room.row[c]
            room.costate[c] += weight * room.row[c]
        add_congruence(D, H, rows, weight, T, Q)
        for r in range(x, size):
            for c in range(x, size):
                Q[r, c] += weight * H[r, c]
            for i in range(rows):
                factor = weight * H[r, i]
                if factor != 0.0:
                    for c in range(size):
                        Q[r, c] += factor * D[i, c]
                        Q[c, r] += factor * D[i, c]


@inlined
def add_noise(steps: Steps, s: int, h: float, value: Value, gains: Gains, room: Room) -> None:
    """Add the terms of the noise to Q, Qz and the cost; keeps S.

    Where the running cost is sampled after the kick, it counts too.
    """
    Q, Qz, row = room.Q, room.Qz, room.row
    x, size = room.J.shape
    S = gains.spread[s]
    for i in range(x):
        for j in range(x):
            S[i, j] = h * value.hessian[i, j]
    samples = steps.rule.shape[0]
    for k in range(samples):
        point = s * samples + k
        state_at_sample(steps.rule[k], steps.velocity, s + 1, 2, room.P)
        H = steps.hessian[point if steps.hessian.shape[0] > 1 else 0]
        add_congruence(room.P, H, x, h * h * steps.rule[k, 0], room.T, S)
    for w in range(steps.G.shape[2]):
        for i in range(x):
            total = 0.0
            for j in range(x):
                total += S[i, j] * steps.G[s, j, w]
            row[i] = total
        for i in range(x):
            value.noise[0] += 0.5 * steps.G[s, i, w] * row[i]
        for c in range(size):
            total = 0.0
            for i in range(x):
                total += row[i] * (steps.Gx[s, i, w, c] if c < x else steps.Gu[s, i, w, c - x])
            Qz[c] += total
            room.costate[c] += total
        for c in range(size):
            for i in range(x):
                total = 0.0
                for j in range(x):
                    total += S[i, j] * (steps.Gx[s, j, w, c] if c < x else steps.Gu[s, j, w, c - x])
                room.solved[i] = total
            for r in range(size):
                total = 0.0
                for i in range(x):
                    total += room.solved[i] * (steps.Gx[s, i, w, r] if r < x else steps.Gu[s, i, w, r - x])
                Q[r, c] += total


@inlined
def carry_scale(value: Value, room: Room) -> None:
    """How large the terms are that cancel in J'WJ, whose entries are off by about eps scale_r scale_c."""
    J, scale = room.J, room.scale
    x, size = J.shape
    for c in range(size):
        scale[c] = 0.0
    for i in range(x):
        own = value.scale[i]
        for c in range(size):
            scale[c] += abs(J[i, c]) * own
    for c in range(x, size):
        scale[c] = np.sqrt(scale[c] * scale[c] + value.scale[c] * value.scale[c])


@inlined
def add_rate(steps: Steps, r: int, room: Room) -> None:
    """Add to Q and Qz what the change to control ``r`` costs, its part in that control."""
    x, size = room.J.shape
    for i in range(size - x):
        room.Qz[x + i] += steps.pull[r, i]
        room.costate[x + i] += steps.pull[r, i]
        for j in range(size - x):
            room.Q[x + i, x + j] += steps.rate[r, i, j]


@inlined
def value_of_previous(steps: Steps, r: int, value: Value, gains: Gains, room: Room) -> None:
    """Rows and columns of the value in the control before decision ``r``, from its gains on it.

    ``room.row`` holds Quu k + Qu and ``room.T`` the product Quu K + Qux.
    """
    Q, T = room.Q, room.T
    x, size = room.J.shape
    m = size - x
    R, K, W, k = steps.rate[r], gains.feedback[r], gains.previous[r], gains.feedforward[r]
    for c in range(m):
        value.gradient[x + c] = -steps.pull[r, c]
        value.costate[x + c] = -steps.pull[r, c]
        value.scale[x + c] = np.sqrt(abs(R[c, c]))
        for i in range(m):
            value.gradient[x + c] += W[i, c] * room.row[i] - R[i, c] * k[i]
    for c in range(m):
        # V_xw = (Quu K + Qux)' W - K' R
        for b in range(x):
            total = 0.0
            for i in range(m):
                total += T[i, b] * W[i, c] - K[i, b] * R[i, c]
            value.hessian[b, x + c] = total
            value.hessian[x + c, b] = total
        # V_ww = R + W' (Quu W - R) - R W
        for b in range(c + 1):
            total = R[b, c]
            for i in range(m):
                product = -R[i, c]
                for j in range(m):
                    product += Q[x + i, x + j] * W[j, c]
                total += W[i, b] * product - R[i, b] * W[i, c]
            value.hessian[x + b, x + c] = total
            value.hessian[x + c, x + b] = total


@inlined
def is_idle(i: int, room: Room) -> bool:
    """Whether nothing depends on control ``i``."""
    Q, Qz = room.Q, room.Qz
    x, size = room.J.shape
    total = abs(Qz[x + i])
    for c in range(size):
        total += abs(Q[x + i, c])
    return total == 0.0


@inlined
def decide(regularization: float, r: int, steps: Steps, value: Value, gains: Gains, room: Room) -> bool:
    """Gains of decision ``r`` from Q and Qz, and the value under them; False where Quu is not positive definite.

    Within limits the feed-forward part minimizes the model there, and controls at a limit have no feedback (Tassa,
    Mansard and Todorov 2014). Each control is regularized by its own diagonal entry, whatever the others' units; one
    that nothing depends on stays as it is, if there are others.
    """
    Q, Qz, Quu, row, solved, slack = room.Q, room.Qz, room.Quu, room.row, room.solved, steps.slack
    x, size = room.J.shape
    m = size - x
    rated = steps.rate.shape[0] > 0
    if rated:
        add_rate(steps, r, room)
    largest = 0.0
    for i in range(m):
        largest = max(largest, abs(Q[x + i, x + i]))
    for i in range(m):
        for j in range(m):
            Quu[i, j] = Q[x + i, x + j]
        Quu[i, i] += regularization * abs(Quu[i, i])
        if largest > 0.0 and Quu[i, i] == 0.0 and is_idle(i, room):
            Quu[i, i] = largest
        if not Quu[i, i] > 0.0:
            return False
    limited = slack.shape[0] > 0
    if limited:
        for i in range(m):
            for j in range(m):
                room.H[i, j] = Quu[i, j]
    if not factor_ldl(Quu, 0, m):
        return False
    for i in range(m):
        row[i] = -Qz[x + i]
        gains.control_gradient[r, i] = room.costate[x + i]
    solve_ldl(Quu, row[:m], solved[:m], 0, m)
    if limited and not solve_box(room.H, Qz[x:], slack[r], solved[:m], Quu, room.box):
        return False
    for i in range(m):
        gains.feedforward[r, i] = solved[i]
        if not limited or room.box[0, i] == 0.0:
            terms = max(room.scale[x + i] * room.scale[x + i], abs(Q[x + i, x + i]))
            value.loss[0] = max(value.loss[0], EPS * terms / Quu[i, i])
    K, k = gains.feedback[r], gains.feedforward[r]
    for i in range(m):
        for c in range(x):
            K[i, c] = 0.0 if limited and room.box[0, i] != 0.0 else -Q[x + i, c]
    solve_ldl_rows(Quu, K)
    if rated:
        W = gains.previous[r]
        for i in range(m):
            for c in range(m):
                W[i, c] = 0.0 if limited and room.box[0, i] != 0.0 else steps.rate[r, i, c]
        solve_ldl_rows(Quu, W)
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += Q[x + i, x + j] * k[j]
        value.decrease[0] += Qz[x + i] * k[i]
        value.decrease[1] += k[i] * total
        row[i] = total + Qz[x + i]
    for c in range(x):
        value.gradient[c] = Qz[c]
        value.costate[c] = room.costate[c]
    # Vxx = Qxx + K'(Quu K + Qux) + Qux'K, whatever the regularization.
    T = room.T
    for i in range(m):
        for c in range(x):
            value.gradient[c] += K[i, c] * row[i] + Q[x + i, c] * k[i]
            T[i, c] = Q[x + i, c]
        for j in range(m):
            for c in range(x):
                T[i, c] += Q[x + i, x + j] * K[j, c]
    for b in range(x):
        for c in range(x):
            value.hessian[b, c] = Q[b, c]
        for i in range(m):
            for c in range(x):
                value.hessian[b, c] += K[i, b] * T[i, c] + Q[x + i, b] * K[i, c]
        value.scale[b] = np.sqrt(abs(Q[b, b]))
    for c in range(x):
        for b in range(c):
            mean = 0.5 * (value.hessian[b, c] + value.hessian[c, b])
            value.hessian[b, c] = mean
            value.hessian[c, b] = mean
    for c in range(x, size):
        value.gradient[c] = 0.0
        value.costate[c] = 0.0
        value.scale[c] = 0.0
        for b in range(size):
            value.hessian[b, c] = 0.0
            value.hessian[c, b] = 0.0
    if rated:
        value_of_previous(steps, r, value, gains, room)
    return True


@kernel
def backward_pass(
    h: float,
    hold: int,
    in_velocity: bool,
    regularization: float,
    steps: Steps,
    value: Value,
    gains: Gains,
    room: Room,
) -> int:
    """From the value after the last step to the value before the first; -1, or the decision that has no minimum.

    Each control is held over ``hold`` steps. ``in_velocity`` says whether the running cost's Hessian has anything in v.
    """
    J, Q, Qz = room.J, room.Q, room.Qz
    x, size = J.shape
    rated = steps.rate.shape[0] > 0
    for s in range(steps.A.shape[0] - 1, -1, -1):
        if gains.costate.shape[0] > 0:
            for i in range(x):
                gains.costate[s, i] = value.costate[i]
        for i in range(x):
            for c in range(x):
                J[i, c] = steps.A[s, i, c]
            for c in range(x, size):
                J[i, c] = steps.B[s, i, c - x]
        carry_scale(value, room)
        for c in range(size):
            Qz[c] = value.gradient[c] if c >= x else 0.0
            room.costate[c] = value.costate[c] if c >= x else 0.0
        for i in range(x):
            for c in range(size):
                Qz[c] += J[i, c] * value.gradient[i]
                room.costate[c] += J[i, c] * value.costate[i]
        for r in range(size):
            for c in range(size):
                Q[r, c] = 0.0
        if steps.curvature.shape[0] > 0:
            for r in range(size):
                for c in range(size):
                    Q[r, c] = steps.curvature[s, r, c]
        add_congruence(J, value.hessian, x, 1.0, room.T, Q)
        # The control is that of the next step, or what its change is counted from: its own rows of the value.
        if rated or (s + 1) % hold != 0:
            for r in range(x, size):
                for c in range(x, size):
                    Q[r, c] += value.hessian[r, c]
                for c in range(size):
                    total = 0.0
                    for i in range(x):
                        total += value.hessian[r, i] * J[i, c]
                    Q[r, c] += total
                    Q[c, r] += total
        if steps.G.shape[2] > 0:
            add_noise(steps, s, h, value, gains, room)
        add_running_cost(steps, s, h, in_velocity, room)
        if s % hold == 0:
            if not decide(regularization, s // hold, steps, value, gains, room):
                return s // hold
            continue
        for c in range(size):
            value.gradient[c] = Qz[c]
            value.costate[c] = room.costate[c]
            value.scale[c] = np.sqrt(abs(Q[c, c])) if c < x else room.scale[c]
            for r in range(size):
                value.hessian[r, c] = Q[r, c]
    return -1
