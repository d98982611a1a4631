"""The Lagrangian jet: one forward and one backward sweep over the tree give every derivative.

Spatial vectors are (linear, angular), in world axes. The point they are taken at is not the world's origin but the
root of their branch, or the last joint of a run of sliders there: it moves with them, so that what stands or slides
far away keeps its digits. The Lagrangian does not care: of what a slider below other sliders carries, they see masses
and linear momenta alone, which are the same about every point.

With S the motion axis of a joint, V the velocity of its body, W = V x S, Y and H the inertia and the momentum
of the whole subtree, F = Y S, B = Y W + S x* H and g gravity, for i an ancestor of j or j itself:

    L_v[j]   = S_j . H_j                     L_q[j]    = W_j . H_j + S_j . (Y_j g)
    M[i, j]  = S_i . F_j                     L_qq[i,j] = W_i . B_j - F_j . (S_i x g)
    A[i, j]  = S_i . B_j  (dp_i/dq_j)        A[j, i]   = W_i . F_j

Why: the kinetic energy does not change when everything is rotated along, so d/dq_i may be replaced by
d/dq_i - S_i x; under that, for j below i, dS_j = 0, dV_j = W_i, dH_j = Y_j W_i, and gravity turns by -S_i x g.
"""

import math

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.tree import Floats, Mechanism, Sweep, Tree, block


@inlined
def place_body(tree: Tree, j: int, q: Floats, w: Sweep) -> float:
    """Orientation, position and motion axis of body ``j``; returns its joint's position [rad or m]."""
    R, P, S = w.rotation, w.position, w.axis
    angle = tree.ratio[j] * q[tree.coordinate[j]] + tree.offset[j]
    E = tree.rotation
    parent = tree.parent[j]
    if parent < 0:
        r00, r01, r02 = E[j, 0, 0], E[j, 0, 1], E[j, 0, 2]
        r10, r11, r12 = E[j, 1, 0], E[j, 1, 1], E[j, 1, 2]
        r20, r21, r22 = E[j, 2, 0], E[j, 2, 1], E[j, 2, 2]
    else:
        k = parent
        a00, a01, a02 = R[k, 0], R[k, 1], R[k, 2]
        a10, a11, a12 = R[k, 3], R[k, 4], R[k, 5]
        a20, a21, a22 = R[k, 6], R[k, 7], R[k, 8]
        r00 = a00 * E[j, 0, 0] + a01 * E[j, 1, 0] + a02 * E[j, 2, 0]
        r01 = a00 * E[j, 0, 1] + a01 * E[j, 1, 1] + a02 * E[j, 2, 1]
        r02 = a00 * E[j, 0, 2] + a01 * E[j, 1, 2] + a02 * E[j, 2, 2]
        r10 = a10 * E[j, 0, 0] + a11 * E[j, 1, 0] + a12 * E[j, 2, 0]
        r11 = a10 * E[j, 0, 1] + a11 * E[j, 1, 1] + a12 * E[j, 2, 1]
        r12 = a10 * E[j, 0, 2] + a11 * E[j, 1, 2] + a12 * E[j, 2, 2]
        r20 = a20 * E[j, 0, 0] + a21 * E[j, 1, 0] + a22 * E[j, 2, 0]
        r21 = a20 * E[j, 0, 1] + a21 * E[j, 1, 1] + a22 * E[j, 2, 1]
        r22 = a20 * E[j, 0, 2] + a21 * E[j, 1, 2] + a22 * E[j, 2, 2]
    origin = tree.origin[j]
    if origin:
        px, py, pz = 0.0, 0.0, 0.0
    else:
        tx, ty, tz = tree.translation[j, 0], tree.translation[j, 1], tree.translation[j, 2]
        px = P[parent, 0] + R[parent, 0] * tx + R[parent, 1] * ty + R[parent, 2] * tz
        py = P[parent, 1] + R[parent, 3] * tx + R[parent, 4] * ty + R[parent, 5] * tz
        pz = P[parent, 2] + R[parent, 6] * tx + R[parent, 7] * ty + R[parent, 8] * tz
    if tree.prismatic[j]:
        if not origin:
            px += r02 * angle
            py += r12 * angle
            pz += r22 * angle
        S[j, 0], S[j, 1], S[j, 2] = r02, r12, r22
        S[j, 3], S[j, 4], S[j, 5] = 0.0, 0.0, 0.0
        R[j, 0], R[j, 1] = r00, r01
        R[j, 3], R[j, 4] = r10, r11
        R[j, 6], R[j, 7] = r20, r21
    else:
        c = math.cos(angle)
        s = math.sin(angle)
        S[j, 0] = py * r22 - pz * r12
        S[j, 1] = pz * r02 - px * r22
        S[j, 2] = px * r12 - py * r02
        S[j, 3], S[j, 4], S[j, 5] = r02, r12, r22
        R[j, 0], R[j, 1] = c * r00 + s * r01, c * r01 - s * r00
        R[j, 3], R[j, 4] = c * r10 + s * r11, c * r11 - s * r10
        R[j, 6], R[j, 7] = c * r20 + s * r21, c * r21 - s * r20
    R[j, 2], R[j, 5], R[j, 8] = r02, r12, r22
    P[j, 0], P[j, 1], P[j, 2] = px, py, pz
    return angle


@inlined
def move_body(tree: Tree, j: int, v: Floats, w: Sweep) -> None:
    """Velocity V of body ``j`` and the rate W of its axis."""
    S, V, W = w.axis, w.velocity, w.axis_rate
    rate = tree.ratio[j] * v[tree.coordinate[j]]
    s0, s1, s2, s3, s4, s5 = S[j, 0], S[j, 1], S[j, 2], S[j, 3], S[j, 4], S[j, 5]
    k = tree.parent[j]
    if k < 0:
        for i in range(6):
            V[j, i] = S[j, i] * rate
            W[j, i] = 0.0
        return
    v0, v1, v2, v3, v4, v5 = V[k, 0], V[k, 1], V[k, 2], V[k, 3], V[k, 4], V[k, 5]
    # V_j x S_j = V_parent x S_j, since S x S = 0.
    W[j, 0] = v4 * s2 - v5 * s1 + v1 * s5 - v2 * s4
    W[j, 1] = v5 * s0 - v3 * s2 + v2 * s3 - v0 * s5
    W[j, 2] = v3 * s1 - v4 * s0 + v0 * s4 - v1 * s3
    W[j, 3] = v4 * s5 - v5 * s4
    W[j, 4] = v5 * s3 - v3 * s5
    W[j, 5] = v3 * s4 - v4 * s3
    V[j, 0], V[j, 1], V[j, 2] = v0 + s0 * rate, v1 + s1 * rate, v2 + s2 * rate
    V[j, 3], V[j, 4], V[j, 5] = v3 + s3 * rate, v4 + s4 * rate, v5 + s5 * rate


@inlined
def body_inertia(tree: Tree, j: int, w: Sweep) -> None:
    """Y of body ``j`` alone: mass, first moment and inertia about the last origin, in world axes."""
    R, Y = w.rotation, w.inertia
    r00, r01, r02 = R[j, 0], R[j, 1], R[j, 2]
    r10, r11, r12 = R[j, 3], R[j, 4], R[j, 5]
    r20, r21, r22 = R[j, 6], R[j, 7], R[j, 8]
    m = tree.mass[j]
    x, y, z = tree.center[j, 0], tree.center[j, 1], tree.center[j, 2]
    cx = w.position[j, 0] + r00 * x + r01 * y + r02 * z
    cy = w.position[j, 1] + r10 * x + r11 * y + r12 * z
    cz = w.position[j, 2] + r20 * x + r21 * y + r22 * z
    ixx, ixy, iyy = tree.inertia[j, 0], tree.inertia[j, 1], tree.inertia[j, 2]
    ixz, iyz, izz = tree.inertia[j, 3], tree.inertia[j, 4], tree.inertia[j, 5]
    t00 = r00 * ixx + r01 * ixy + r02 * ixz
    t01 = r00 * ixy + r01 * iyy + r02 * iyz
    t02 = r00 * ixz + r01 * iyz + r02 * izz
    t10 = r10 * ixx + r11 * ixy + r12 * ixz
    t11 = r10 * ixy + r11 * iyy + r12 * iyz
    t12 = r10 * ixz + r11 * iyz + r12 * izz
    t20 = r20 * ixx + r21 * ixy + r22 * ixz
    t21 = r20 * ixy + r21 * iyy + r22 * iyz
    t22 = r20 * ixz + r21 * iyz + r22 * izz
    hx, hy, hz = m * cx, m * cy, m * cz
    Y[j, 0] = m
    Y[j, 1], Y[j, 2], Y[j, 3] = hx, hy, hz
    Y[j, 4] = t00 * r00 + t01 * r01 + t02 * r02 + hy * cy + hz * cz
    Y[j, 5] = t00 * r10 + t01 * r11 + t02 * r12 - hx * cy
    Y[j, 6] = t10 * r10 + t11 * r11 + t12 * r12 + hx * cx + hz * cz
    Y[j, 7] = t00 * r20 + t01 * r21 + t02 * r22 - hx * cz
    Y[j, 8] = t10 * r20 + t11 * r21 + t12 * r22 - hy * cz
    Y[j, 9] = t20 * r20 + t21 * r21 + t22 * r22 + hx * cx + hy * cy


@inlined
def times_inertia(Y: Floats, j: int, x: Floats, out: Floats) -> None:
    """out[j] = Y_j x_j."""
    m, hx, hy, hz = Y[j, 0], Y[j, 1], Y[j, 2], Y[j, 3]
    x0, x1, x2, x3, x4, x5 = x[j, 0], x[j, 1], x[j, 2], x[j, 3], x[j, 4], x[j, 5]
    out[j, 0] = m * x0 + x4 * hz - x5 * hy
    out[j, 1] = m * x1 + x5 * hx - x3 * hz
    out[j, 2] = m * x2 + x3 * hy - x4 * hx
    out[j, 3] = Y[j, 4] * x3 + Y[j, 5] * x4 + Y[j, 7] * x5 + hy * x2 - hz * x1
    out[j, 4] = Y[j, 5] * x3 + Y[j, 6] * x4 + Y[j, 8] * x5 + hz * x0 - hx * x2
    out[j, 5] = Y[j, 7] * x3 + Y[j, 8] * x4 + Y[j, 9] * x5 + hx * x1 - hy * x0


@inlined
def dot6(a: Floats, i: int, b: Floats, j: int) -> float:
    """a[i] . b[j] of two stacks of spatial vectors."""
    return (
        a[i, 0] * b[j, 0]
        + a[i, 1] * b[j, 1]
        + a[i, 2] * b[j, 2]
        + a[i, 3] * b[j, 3]
        + a[i, 4] * b[j, 4]
        + a[i, 5] * b[j, 5]
    )


@inlined
def origin_potential(mechanism: Mechanism, j: int, q: Floats, w: Sweep) -> float:
    """Gravity's potential energy [J] of what body ``j``, an origin, carries: of its moments, and of all masses' shift.

    Adds it, and its scale, to its group's.
    """
    tree, g = mechanism.tree, mechanism.gravity
    c, k = tree.coordinate[j], tree.parent[j]
    group = tree.group[c]
    strength = abs(g[0]) + abs(g[1]) + abs(g[2])
    R, Y = w.rotation, w.inertia
    potential = 0.0
    for i in range(3):
        shift = tree.translation[j, i]
        if k >= 0:
            shift = 0.0
            for a in range(3):
                shift += R[k, 3 * i + a] * tree.translation[j, a]
        if tree.prismatic[j]:
            shift += w.axis[j, i] * (tree.ratio[j] * q[c] + tree.offset[j])
        potential -= g[i] * (Y[j, 0] * shift + Y[j, i + 1])
        w.V_scale[group] += strength * (Y[j, 0] * abs(shift) + abs(Y[j, i + 1]))
    w.V[group] += potential
    return potential


@inlined
def pass_inertia(tree: Tree, j: int, entries: int, w: Sweep) -> None:
    """Add the first entries of Y of body ``j`` to its parent's; past an origin moments are nobody's any more."""
    Y, k = w.inertia, tree.parent[j]
    if tree.origin[j]:
        entries = 1
    for i in range(entries):
        Y[k, i] += Y[j, i]


@inlined
def add_springs(mechanism: Mechanism, q: Floats, w: Sweep) -> float:
    """Add the springs to L_q and its scale; returns their potential energy [J]."""
    potential = 0.0
    for c in range(q.size):
        force = -mechanism.stiffness[c] * (q[c] - mechanism.rest[c])
        w.Lq[c] += force
        w.Lq_scale[c] += abs(mechanism.stiffness[c]) * (abs(q[c]) + abs(mechanism.rest[c]))
        spring = -0.5 * force * (q[c] - mechanism.rest[c])
        potential += spring
        w.V[mechanism.tree.group[c]] += spring
        w.V_scale[mechanism.tree.group[c]] += spring
    return potential


@inlined
def add_armature(mechanism: Mechanism, v: Floats, w: Sweep) -> float:
    """Add the armature to L_v and its scale; returns the kinetic energy [J]."""
    kinetic = 0.0
    for c in range(v.size):
        momentum = mechanism.tree.armature[c] * v[c]
        w.Lv[c] += momentum
        w.Lv_scale[c] += abs(momentum)
        kinetic += 0.5 * v[c] * w.Lv[c]
    return kinetic


@inlined
def project(mechanism: Mechanism, j: int, w: Sweep) -> None:
    """Add the share of body ``j``'s subtree to L_v and L_q."""
    tree, g = mechanism.tree, mechanism.gravity
    S, W, H, Y = w.axis, w.axis_rate, w.momentum, w.inertia
    m, hx, hy, hz = Y[j, 0], Y[j, 1], Y[j, 2], Y[j, 3]
    gx, gy, gz = g[0], g[1], g[2]
    Lv = dot6(S, j, H, j)
    weight = m * (S[j, 0] * gx + S[j, 1] * gy + S[j, 2] * gz)
    weight += S[j, 3] * (hy * gz - hz * gy) + S[j, 4] * (hz * gx - hx * gz) + S[j, 5] * (hx * gy - hy * gx)
    Lq = dot6(W, j, H, j) + weight
    X = w.magnitude
    k = tree.parent[j]
    above, turning_above = (X[k, 0], X[k, 1]) if k >= 0 else (0.0, 0.0)
    shift, turn = abs(S[j, 0]) + abs(S[j, 1]) + abs(S[j, 2]), abs(S[j, 3]) + abs(S[j, 4]) + abs(S[j, 5])
    Lv_scale = shift * X[j, 2] + turn * X[j, 3]
    Lq_scale = (turning_above * shift + above * turn) * X[j, 2] + turning_above * turn * X[j, 3]
    Lq_scale += (abs(gx) + abs(gy) + abs(gz)) * (m * shift + turn * X[j, 4])
    c = tree.coordinate[j]
    ratio = tree.ratio[j]
    w.Lv[c] += ratio * Lv
    w.Lq[c] += ratio * Lq
    w.Lv_scale[c] += abs(ratio) * Lv_scale
    w.Lq_scale[c] += abs(ratio) * Lq_scale


@inlined
def measure(tree: Tree, j: int, rate: float, w: Sweep) -> None:
    """Magnitudes of the terms that make up body ``j``'s velocity, momentum and first moment.

    Sums of norms, in which nothing cancels: rounding errors are in proportion to them and not to the results, which
    may be small by cancellation of large terms.
    """
    S, X, Y = w.axis, w.magnitude, w.inertia
    k = tree.parent[j]
    shift, turn = abs(S[j, 0]) + abs(S[j, 1]) + abs(S[j, 2]), abs(S[j, 3]) + abs(S[j, 4]) + abs(S[j, 5])
    velocity, turning = shift * abs(rate), turn * abs(rate)
    if k >= 0:
        velocity += X[k, 0]
        turning += X[k, 1]
    moment = abs(Y[j, 1]) + abs(Y[j, 2]) + abs(Y[j, 3])
    m = tree.mass[j]
    momentum = m * velocity + turning * moment
    X[j, 0], X[j, 1], X[j, 2], X[j, 4] = velocity, turning, momentum, moment
    X[j, 3] = (tree.inertia[j, 0] + tree.inertia[j, 2] + tree.inertia[j, 5]) * turning
    if m > 0.0:
        X[j, 3] += moment / m * momentum


@inlined
def clear_first(w: Sweep) -> None:
    """Zero what the first-order sweep adds up."""
    for c in range(w.Lq.size):
        w.V[c] = 0.0
        w.V_scale[c] = 0.0
        w.Lq[c] = 0.0
        w.Lv[c] = 0.0
        w.Lq_scale[c] = 0.0
        w.Lv_scale[c] = 0.0


@inlined
def first_order(mechanism: Mechanism, q: Floats, v: Floats, w: Sweep) -> tuple[float, float]:
    """L_q and L_v at (q, v), left in ``w``; returns kinetic and potential energy [J]."""
    tree = mechanism.tree
    bodies = tree.parent.size
    R, V, H, Y = w.rotation, w.velocity, w.momentum, w.inertia
    potential = 0.0
    clear_first(w)
    for j in range(bodies):
        place_body(tree, j, q, w)
        move_body(tree, j, v, w)
        r00, r01, r02 = R[j, 0], R[j, 1], R[j, 2]
        r10, r11, r12 = R[j, 3], R[j, 4], R[j, 5]
        r20, r21, r22 = R[j, 6], R[j, 7], R[j, 8]
        m = tree.mass[j]
        x, y, z = tree.center[j, 0], tree.center[j, 1], tree.center[j, 2]
        cx = w.position[j, 0] + r00 * x + r01 * y + r02 * z
        cy = w.position[j, 1] + r10 * x + r11 * y + r12 * z
        cz = w.position[j, 2] + r20 * x + r21 * y + r22 * z
        Y[j, 0] = m
        Y[j, 1], Y[j, 2], Y[j, 3] = m * cx, m * cy, m * cz
        wx, wy, wz = V[j, 3], V[j, 4], V[j, 5]
        fx = m * (V[j, 0] + wy * cz - wz * cy)
        fy = m * (V[j, 1] + wz * cx - wx * cz)
        fz = m * (V[j, 2] + wx * cy - wy * cx)
        bx = r00 * wx + r10 * wy + r20 * wz
        by = r01 * wx + r11 * wy + r21 * wz
        bz = r02 * wx + r12 * wy + r22 * wz
        ixx, ixy, iyy = tree.inertia[j, 0], tree.inertia[j, 1], tree.inertia[j, 2]
        ixz, iyz, izz = tree.inertia[j, 3], tree.inertia[j, 4], tree.inertia[j, 5]
        lx = ixx * bx + ixy * by + ixz * bz
        ly = ixy * bx + iyy * by + iyz * bz
        lz = ixz * bx + iyz * by + izz * bz
        H[j, 0], H[j, 1], H[j, 2] = fx, fy, fz
        H[j, 3] = r00 * lx + r01 * ly + r02 * lz + cy * fz - cz * fy
        H[j, 4] = r10 * lx + r11 * ly + r12 * lz + cz * fx - cx * fz
        H[j, 5] = r20 * lx + r21 * ly + r22 * lz + cx * fy - cy * fx
        measure(tree, j, tree.ratio[j] * v[tree.coordinate[j]], w)
    for j in range(bodies - 1, -1, -1):
        project(mechanism, j, w)
        k = tree.parent[j]
        if k >= 0:
            for i in range(6):
                H[k, i] += H[j, i]
            for i in range(2, 5):
                w.magnitude[k, i] += w.magnitude[j, i]
            pass_inertia(tree, j, 4, w)
        if tree.origin[j]:
            potential += origin_potential(mechanism, j, q, w)
    potential += add_springs(mechanism, q, w)
    return add_armature(mechanism, v, w), potential


@inlined
def second_order(mechanism: Mechanism, q: Floats, v: Floats, w: Sweep) -> tuple[float, float]:
    """The whole jet at (q, v), left in ``w``; returns kinetic and potential energy [J]."""
    tree, g = mechanism.tree, mechanism.gravity
    bodies = tree.parent.size
    S, V, W, Y, H, F, B = w.axis, w.velocity, w.axis_rate, w.inertia, w.momentum, w.dual_axis, w.dual_rate
    M, A, Lqq = w.M, w.A, w.Lqq
    gx, gy, gz = g[0], g[1], g[2]
    potential = 0.0
    clear_first(w)
    for b in range(len(tree.ends)):
        begin, end = block(tree.ends, b)
        for j in range(begin, end):
            for c in range(begin, end):
                M[j, c] = 0.0
                A[j, c] = 0.0
                Lqq[j, c] = 0.0
    for j in range(bodies):
        place_body(tree, j, q, w)
        move_body(tree, j, v, w)
        body_inertia(tree, j, w)
        times_inertia(Y, j, V, H)
        measure(tree, j, tree.ratio[j] * v[tree.coordinate[j]], w)
    for j in range(bodies - 1, -1, -1):
        project(mechanism, j, w)
        times_inertia(Y, j, S, F)
        times_inertia(Y, j, W, B)
        s0, s1, s2, s3, s4, s5 = S[j, 0], S[j, 1], S[j, 2], S[j, 3], S[j, 4], S[j, 5]
        h0, h1, h2, h3, h4, h5 = H[j, 0], H[j, 1], H[j, 2], H[j, 3], H[j, 4], H[j, 5]
        B[j, 0] += s4 * h2 - s5 * h1
        B[j, 1] += s5 * h0 - s3 * h2
        B[j, 2] += s3 * h1 - s4 * h0
        B[j, 3] += s4 * h5 - s5 * h4 + s1 * h2 - s2 * h1
        B[j, 4] += s5 * h3 - s3 * h5 + s2 * h0 - s0 * h2
        B[j, 5] += s3 * h4 - s4 * h3 + s0 * h1 - s1 * h0
        # F . (S_i x g) = S_i(angular) . (g x F(linear))
        nx = gy * F[j, 2] - gz * F[j, 1]
        ny = gz * F[j, 0] - gx * F[j, 2]
        nz = gx * F[j, 1] - gy * F[j, 0]
        cj = tree.coordinate[j]
        i = j
        while i >= 0:
            ci = tree.coordinate[i]
            ratio = tree.ratio[i] * tree.ratio[j]
            mass = ratio * dot6(S, i, F, j)
            curvature = dot6(W, i, B, j) - (S[i, 3] * nx + S[i, 4] * ny + S[i, 5] * nz)
            curvature *= ratio
            M[ci, cj] += mass
            Lqq[ci, cj] += curvature
            A[ci, cj] += ratio * dot6(S, i, B, j)
            if i != j:
                M[cj, ci] += mass
                Lqq[cj, ci] += curvature
                A[cj, ci] += ratio * dot6(W, i, F, j)
            i = tree.parent[i]
        k = tree.parent[j]
        if k >= 0:
            for i in range(6):
                H[k, i] += H[j, i]
            for i in range(2, 5):
                w.magnitude[k, i] += w.magnitude[j, i]
            pass_inertia(tree, j, 10, w)
        if tree.origin[j]:
            potential += origin_potential(mechanism, j, q, w)
    potential += add_springs(mechanism, q, w)
    for c in range(q.size):
        M[c, c] += tree.armature[c]
        Lqq[c, c] -= mechanism.stiffness[c]
    return add_armature(mechanism, v, w), potential


@inlined
def add_mass(tree: Tree, j: int, w: Sweep) -> None:
    """Add what body ``j`` shares with its ancestors, and with itself, to M: the composite rigid body algorithm."""
    S, F, M = w.axis, w.dual_axis, w.M
    times_inertia(w.inertia, j, S, F)
    cj = tree.coordinate[j]
    i = j
    while i >= 0:
        ci = tree.coordinate[i]
        mass = tree.ratio[i] * tree.ratio[j] * dot6(S, i, F, j)
        M[ci, cj] += mass
        if i != j:
            M[cj, ci] += mass
        i = tree.parent[i]


@inlined
def clear_mass(tree: Tree, w: Sweep) -> None:
    """Zero the blocks of M; outside of them nothing is ever written."""
    for b in range(len(tree.ends)):
        begin, end = block(tree.ends, b)
        for i in range(begin, end):
            for j in range(begin, end):
                w.M[i, j] = 0.0


@inlined
def mass_matrix(mechanism: Mechanism, q: Floats, w: Sweep) -> float:
    """M at q, left in ``w.M``; returns the potential energy [J]."""
    tree = mechanism.tree
    bodies = tree.parent.size
    M = w.M
    potential = 0.0
    for j in range(q.size):
        w.V[j] = 0.0
        w.V_scale[j] = 0.0
    clear_mass(tree, w)
    for j in range(bodies):
        place_body(tree, j, q, w)
        body_inertia(tree, j, w)
    for j in range(bodies - 1, -1, -1):
        add_mass(tree, j, w)
        k = tree.parent[j]
        if k >= 0:
            pass_inertia(tree, j, 10, w)
        if tree.origin[j]:
            potential += origin_potential(mechanism, j, q, w)
    for c in range(q.size):
        M[c, c] += tree.armature[c]
        deflection = q[c] - mechanism.rest[c]
        spring = 0.5 * mechanism.stiffness[c] * deflection * deflection
        potential += spring
        w.V[tree.group[c]] += spring
        w.V_scale[tree.group[c]] += spring
    return potential


@kernel
def lagrangian_sweep(mechanism: Mechanism, q: Floats, v: Floats, w: Sweep) -> tuple[float, float]:
    """:func:`second_order` for callers in Python."""
    return second_order(mechanism, q, v, w)


@kernel
def jets(mechanism: Mechanism, q: Floats, v: Floats, w: Sweep, M: Floats, A: Floats) -> None:
    """M and L_vq at each row of q and v (N, n), written into M and A (N, n, n)."""
    for s in range(q.shape[0]):
        second_order(mechanism, q[s], v[s], w)
        for i in range(q.shape[1]):
            for j in range(q.shape[1]):
                M[s, i, j] = w.M[i, j]
                A[s, i, j] = w.A[i, j]
