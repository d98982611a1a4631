"""The derivatives of every step of a trajectory that Gauss collocation has made."""

from varpin.kernels._compile import kernel
from varpin.kernels.gauss import step
from varpin.kernels.gauss_equation import Stages, newton_stages
from varpin.kernels.gauss_jacobian import stages_jacobian
from varpin.kernels.gauss_tableau import Tableau
from varpin.kernels.midpoint import begin_at, path
from varpin.kernels.midpoint_equation import SINGULAR, SOLVED, Options, State, Work
from varpin.kernels.midpoint_jacobian import identity
from varpin.kernels.place import put
from varpin.kernels.tree import Floats, Integers, Mechanism


@kernel
def linearize(
    mechanism: Mechanism,
    tableau: Tableau,
    options: Options,
    h: float,
    q: Floats,
    p: Floats,
    guess: Floats,
    force: Floats,
    substeps: Integers,
    states: State,
    k: Work,
    g: Stages,
    Jx: Floats,
    Jf: Floats,
) -> tuple[int, int]:
    """As :func:`varpin.kernels.midpoint_linearize.linearize`, with a guess of the stage velocities (N, s, n)."""
    stages, n = g.V.shape
    state = path(states, 0)
    for s in range(q.shape[0]):
        for r in range(n):
            k.force[r] = force[s, r]
        if substeps[s] == 1:
            put(mechanism, q[s], p[s], state)
            for r in range(n):
                for i in range(stages):
                    g.V[i, r] = guess[s, i, r]
            outcome = newton_stages(mechanism, tableau, options, h, state, k, g)
            if outcome != SOLVED:
                return outcome, s
            stages_jacobian(mechanism, tableau, h, g, Jx[s], Jf[s])
            continue
        if not begin_at(mechanism, q[s], p[s], state, k):
            return SINGULAR, s
        identity(k)
        outcome = step(mechanism, tableau, options, h, state, k, g)
        if outcome != SOLVED:
            return outcome, s
        for i in range(2 * n):
            for j in range(2 * n):
                Jx[s, i, j] = k.Jx[i, j]
            for j in range(n):
                Jf[s, i, j] = k.Jf[i, j]
    return SOLVED, q.shape[0]
