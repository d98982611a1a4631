"""Explicit integrators of q' = v, M v' = f - bias: explicit and semi-implicit Euler, Runge and Kutta's of order 4.

Noise makes the velocity jump by M^-1 sum_i F_i dw_i: in explicit Euler beside the step (the paper's footnote), in the
others before it.
"""

from typing import NamedTuple

import numpy as np

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.drive import apply_policy, constant_force, noise_impulse
from varpin.kernels.dynamics import Dynamics, acceleration_at_node, node, solve_mass
from varpin.kernels.tree import Commands, Floats, Mechanism, Nodes, block

EULER = 0
SEMI_IMPLICIT = 1
RUNGE_KUTTA = 2

SOLVED = 0
NOT_FINITE = 1
SINGULAR = 2


class ExplicitState(NamedTuple):
    """Where the paths of a rollout stand."""

    q: Floats  # (P, n)
    v: Floats  # (P, n)
    lead: Floats  # (P, n) change of v over the last step
    center: Floats  # (P, n, k) of the diffusion fields


def new_explicit_state(q: Floats, v: Floats, center: Floats) -> ExplicitState:
    """Paths at (q, v) (P, n); ``center`` (n, k) with NaN for the start."""
    centers = np.broadcast_to(center, (len(q), *center.shape))
    return ExplicitState(q.copy(), v.copy(), np.zeros_like(v), np.where(np.isnan(centers), q[:, :, None], centers))


@inlined
def write_node(mechanism: Mechanism, q: Floats, v: Floats, d: Dynamics, nodes: Nodes, i: int, s: int) -> int:
    """Enter (q, v) as node ``s`` of path ``i``; leaves its mass matrix and bias in ``d``."""
    regular, potential = node(mechanism, q, v, d)
    kinetic = 0.0
    ends = mechanism.tree.ends
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for r in range(begin, end):
            momentum = 0.0
            for c in range(begin, end):
                momentum += d.sweep.M[r, c] * v[c]
            kinetic += 0.5 * v[r] * momentum
            nodes.q[i, s, r], nodes.v[i, s, r], nodes.p[i, s, r] = q[r], v[r], momentum
    nodes.energy[i, s] = kinetic + potential
    if not abs(nodes.energy[i, s]) < np.inf:
        return NOT_FINITE
    return SOLVED if regular else SINGULAR


@inlined
def runge_kutta(mechanism: Mechanism, h: float, q: Floats, v: Floats, force: Floats, d: Dynamics, room: Floats) -> bool:
    """One step of the classical method, in place; ``d`` holds the node at (q, v), and ``room`` is (5, n)."""
    n = q.size
    at_q, at_v, a, sum_q, sum_v = room[0], room[1], room[2], room[3], room[4]
    for i in range(n):
        at_q[i], at_v[i] = q[i], v[i]
        sum_q[i], sum_v[i] = 0.0, 0.0
    for stage in range(4):
        if stage > 0:
            regular, _ = node(mechanism, at_q, at_v, d)
            if not regular:
                return False
        acceleration_at_node(mechanism, force, d, a)
        weight = h / 3.0 if stage in (1, 2) else h / 6.0
        ahead = h if stage == 2 else 0.5 * h
        for i in range(n):
            sum_q[i] += weight * at_v[i]
            sum_v[i] += weight * a[i]
            at_q[i] = q[i] + ahead * at_v[i]
            at_v[i] = v[i] + ahead * a[i]
    for i in range(n):
        q[i] += sum_q[i]
        v[i] += sum_v[i]
    return True


@kernel
def rollout(
    mechanism: Mechanism,
    scheme: int,
    h: float,
    commands: Commands,
    increments: Floats,
    drift: Floats,
    states: ExplicitState,
    d: Dynamics,
    room: Floats,
    nodes: Nodes,
) -> None:
    """Steps of P paths from ``states``, as :func:`varpin.kernels.midpoint.rollout`; x of the commands is (q, v)."""
    n = states.q.shape[1]
    force, jump, a = room[5], room[6], room[7]
    noisy = increments.shape[0] > 0 and increments.shape[2] > 0
    for i in range(states.q.shape[0]):
        q, v, lead = states.q[i], states.v[i], states.lead[i]
        nodes.ended[i] = SOLVED
        nodes.done[i] = 0
        regular, _ = node(mechanism, q, v, d)
        for s in range(nodes.u.shape[1]):
            apply_policy(commands, i, s, q, v, nodes.u[i])
            constant_force(mechanism, drift, i, s, nodes.u[i, s], force)
            # From here d holds the node at (q, v): the first, or the one that ended the step before.
            if not regular:
                nodes.ended[i] = SINGULAR
                break
            for r in range(n):
                lead[r] = -v[r]
                jump[r] = 0.0
            if noisy:
                noise_impulse(mechanism, 1.0, q, states.center[i], nodes.u[i, s], increments[i, s], a)
                solve_mass(mechanism, a, d, jump)
            if scheme != EULER and noisy:
                for r in range(n):
                    v[r] += jump[r]
                regular, _ = node(mechanism, q, v, d)
            if scheme == RUNGE_KUTTA:
                regular = runge_kutta(mechanism, h, q, v, force, d, room)
            else:
                acceleration_at_node(mechanism, force, d, a)
                for r in range(n):
                    before = v[r]
                    v[r] += h * a[r]
                    q[r] += h * (before if scheme == EULER else v[r])
                    if scheme == EULER:
                        v[r] += jump[r]
            for r in range(n):
                lead[r] += v[r]
            nodes.tally[i, s, 2] = 4 if scheme == RUNGE_KUTTA else 1
            nodes.ended[i] = write_node(mechanism, q, v, d, nodes, i, s) if regular else SINGULAR
            if nodes.ended[i] != SOLVED:
                break
            nodes.done[i] = s + 1


@kernel
def first_nodes(mechanism: Mechanism, states: ExplicitState, d: Dynamics, nodes: Nodes) -> bool:
    """The node that each path starts at; False where a mass matrix is not positive definite."""
    for i in range(states.q.shape[0]):
        if write_node(mechanism, states.q[i], states.v[i], d, nodes, i, 0) == SINGULAR:
            return False
        nodes.done[i] = 1
    return True


@kernel
def enter_node(mechanism: Mechanism, x: Floats, d: Dynamics, nodes: Nodes, i: int, s: int) -> int:
    """Enter x = (q, v) (2n,) as node ``s`` of path ``i``, as :func:`write_node`."""
    n = d.bias.size
    return write_node(mechanism, x[:n], x[n:], d, nodes, i, s)
