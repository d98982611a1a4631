"""The derivatives of every step of a midpoint trajectory."""

from varpin.kernels._compile import kernel
from varpin.kernels.midpoint import begin_at, path, step
from varpin.kernels.midpoint_equation import SINGULAR, SOLVED, Options, State, Work
from varpin.kernels.midpoint_jacobian import identity, solve_at, substep_jacobian
from varpin.kernels.tree import Floats, Integers, Mechanism


@kernel
def linearize(
    mechanism: Mechanism,
    options: Options,
    h: float,
    q: Floats,
    p: Floats,
    guess: Floats,
    force: Floats,
    substeps: Integers,
    states: State,
    k: Work,
    Jx: Floats,
    Jf: Floats,
) -> tuple[int, int]:
    """Derivatives of the step from each (q, p) (N, n) under a constant force (N, n).

    Where ``substeps`` (N,) is 1 the step equation is solved once more from ``guess`` (N, n), which is next to its
    root; elsewhere the step is taken again, guards and all, and its parts are chained. Writes d(q1, p1)/d(q0, p0) into
    Jx (N, 2n, 2n) and d(q1, p1)/df into Jf (N, 2n, n). Returns how it ended and how many steps were done.
    """
    n = k.v.size
    state = path(states, 0)
    for s in range(q.shape[0]):
        if substeps[s] == 1:
            outcome = solve_at(mechanism, options, h, q[s], p[s], guess[s], force[s], state, k)
            if outcome != SOLVED:
                return outcome, s
            substep_jacobian(mechanism, options, h, k, Jx[s], Jf[s])
            continue
        for i in range(n):
            k.force[i] = force[s, i]
        if not begin_at(mechanism, q[s], p[s], state, k):
            return SINGULAR, s
        identity(k)
        outcome = step(mechanism, options, h, state, k)
        if outcome != SOLVED:
            return outcome, s
        for i in range(2 * n):
            for j in range(2 * n):
                Jx[s, i, j] = k.Jx[i, j]
            for j in range(n):
                Jf[s, i, j] = k.Jf[i, j]
    return SOLVED, q.shape[0]
