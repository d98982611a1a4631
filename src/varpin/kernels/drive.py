"""What drives a step from outside: controls with their feedback, and the impulses of noise."""

from varpin.kernels._compile import inlined
from varpin.kernels.tree import Commands, Floats, Mechanism


@inlined
def apply_policy(commands: Commands, i: int, s: int, first: Floats, second: Floats, u: Floats) -> None:
    """Controls of step ``s`` of path ``i`` into u (N, m): u = u_r + gains_r (x - x_r), r = s // hold.

    x is (first, second), or (first, second, the control before). Without gains u = u_r; beyond a limit u is that limit;
    between two decisions the control before is held.
    """
    n = first.size
    if s % commands.hold != 0:
        for c in range(u.shape[1]):
            u[s, c] = u[s - 1, c]
        return
    r = s // commands.hold
    for c in range(u.shape[1]):
        total = commands.u[r, c]
        if commands.gains.shape[0] > 0:
            for j in range(n):
                total += commands.gains[r, c, j] * (first[j] - commands.reference[r, j])
                total += commands.gains[r, c, n + j] * (second[j] - commands.reference[r, n + j])
            if commands.gains.shape[2] > 2 * n and (s > 0 or commands.before.shape[0] > 0):
                for j in range(u.shape[1]):
                    before = u[s - 1, j] if s > 0 else commands.before[i, j]
                    total += commands.gains[r, c, 2 * n + j] * (before - commands.reference[r, 2 * n + j])
        # Neither comparison is true of NaN, which stays; max and min need not keep it.
        if total < commands.limits[0, c]:  # noqa: PLR1730
            total = commands.limits[0, c]
        if total > commands.limits[1, c]:  # noqa: PLR1730
            total = commands.limits[1, c]
        u[s, c] = total


@inlined
def constant_force(mechanism: Mechanism, drift: Floats, i: int, s: int, u: Floats, force: Floats) -> None:
    """The force drift + B u over step ``s`` of path ``i``; ``drift`` is (P, N, n), or (0, 0, n) for none."""
    for r in range(force.size):
        total = 0.0
        if drift.shape[0] > 0:
            total = drift[i, s, r]
        for c in range(u.size):
            total += mechanism.actuation[r, c] * u[c]
        force[r] = total


@inlined
def noise_impulse(
    mechanism: Mechanism, part: float, q: Floats, center: Floats, u: Floats, increments: Floats, impulse: Floats
) -> None:
    """The impulse part * sum_i F_i(q, u) dw_i of noise."""
    fields = mechanism.diffusion
    for i in range(q.size):
        total = 0.0
        for w in range(increments.size):
            offset = q[i] - center[i, w]
            field = fields.constant[i, w] + fields.quadratic[i, w] * offset * offset
            for c in range(u.size):
                field += fields.control[i, w, c] * u[c]
            total += field * increments[w]
        impulse[i] = part * total
