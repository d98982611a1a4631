// The Lagrangian jet: one forward and one backward sweep over the tree give L and all its derivatives up to second
// order. docs/mathematics.md, "The Lagrangian jet". With S the axis of a joint, V the velocity of its body, W = V x S,
// Y and H inertia and momentum of all that it carries, F = Y S, B = Y W + S x* H, g gravity, i an ancestor of j or j
// itself:
//
//     L_v[j] = S_j . H_j        M[i,j] = S_i . F_j        L_qq[i,j] = W_i . B_j - F_j . (S_i x g)
//     L_q[j] = W_j . H_j + S_j . (Y_j g)                  A[i,j] = S_i . B_j,  A[j,i] = W_i . F_j
//
// Vectors are taken about the root of their branch, or the last joint of a run of sliders there: it moves with them, so
// that what stands or slides far away keeps its digits. With T = Dual and (q, v) moving along a direction, the slopes
// of M, A and L_qq are third derivatives of L, contracted with the direction.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "varpin/dual.hpp"
#include "varpin/spatial.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// Work arrays of a sweep, and where it leaves its results; matrices are (n, n), row by row.
template <class T>
struct Jet {
    explicit Jet(const Tree& tree)
        : body(tree.bodies.size()),
          dof(tree.dof()),
          potential(static_cast<std::size_t>(tree.groups)),
          Lq(dof),
          Lv(dof),
          M(dof * dof),
          A(dof * dof),
          Lqq(dof * dof) {}

    struct BodyState {
        Mat3<T> rotation{};
        Vec3<T> position{};  // of the joint, from the last origin above it [m]
        Motion<T> axis{};
        Motion<T> velocity{};
        Motion<T> axis_rate{};
        Inertia<T> inertia{};
        Force<T> momentum{};
    };

    std::vector<BodyState> body;
    std::size_t dof;
    T kinetic{};               // [J]
    std::vector<T> potential;  // of each group [J]
    std::vector<T> Lq, Lv, M, A, Lqq;

    T total_potential() const {
        T sum{};
        for (const T& part : potential) sum += part;
        return sum;
    }
};

namespace detail {

// Orientation, position and axis of a body; returns its joint's position [rad or m].
template <class T>
T place(const Tree& tree, std::size_t j, const T* q, Jet<T>& w) {
    using std::cos, std::sin;
    const Body& link = tree.bodies[j];
    auto& here = w.body[j];
    const T angle = link.ratio * q[link.coordinate] + link.offset;
    Mat3<T> R;
    Vec3<T> p{};
    if (link.parent < 0) {
        const Mat3<double>& E = link.rotation;
        R = {{E.x.x, E.x.y, E.x.z}, {E.y.x, E.y.y, E.y.z}, {E.z.x, E.z.y, E.z.z}};
    } else {
        R = w.body[static_cast<std::size_t>(link.parent)].rotation * link.rotation;
    }
    if (!link.origin) {
        const auto& up = w.body[static_cast<std::size_t>(link.parent)];
        p = up.position + up.rotation * link.translation;
    }
    if (link.prismatic) {
        if (!link.origin) p += angle * R.z;
        here.axis = {R.z, {}};
        here.rotation = R;
    } else {
        const T c = cos(angle), s = sin(angle);
        here.axis = {cross(p, R.z), R.z};
        here.rotation = {c * R.x + s * R.y, c * R.y - s * R.x, R.z};
    }
    here.position = p;
    return angle;
}

// Velocity V of a body and the rate W of its axis.
template <class T>
void move(const Tree& tree, std::size_t j, const T* v, Jet<T>& w) {
    const Body& link = tree.bodies[j];
    auto& here = w.body[j];
    const T rate = link.ratio * v[link.coordinate];
    if (link.parent < 0) {
        here.velocity = rate * here.axis;
        here.axis_rate = {};
        return;
    }
    const Motion<T>& up = w.body[static_cast<std::size_t>(link.parent)].velocity;
    here.axis_rate = cross(up, here.axis);  // V_j x S_j = V_parent x S_j, since S x S = 0
    here.velocity = up + rate * here.axis;
}

// Gravity's potential energy of what an origin carries: of its moments, and of all masses' shift.
template <class T>
void add_potential(const Mechanism& mechanism, std::size_t j, const T& angle, Jet<T>& w) {
    const Body& link = mechanism.tree.bodies[j];
    const auto& here = w.body[j];
    Vec3<T> shift{T(link.translation.x), T(link.translation.y), T(link.translation.z)};
    if (link.parent >= 0) shift = w.body[static_cast<std::size_t>(link.parent)].rotation * link.translation;
    if (link.prismatic) shift += angle * here.axis.linear;
    const auto group = static_cast<std::size_t>(mechanism.tree.group[static_cast<std::size_t>(link.coordinate)]);
    w.potential[group] -= dot(here.inertia.mass * shift + here.inertia.moment, mechanism.gravity);
}

// The share of what body j carries in L_q, L_v, M, A and L_qq.
template <class T>
void project(const Mechanism& mechanism, std::size_t j, Jet<T>& w) {
    const Tree& tree = mechanism.tree;
    const Body& link = tree.bodies[j];
    const auto& here = w.body[j];
    const std::size_t n = w.dof, cj = static_cast<std::size_t>(link.coordinate);
    const Vec3<double>& g = mechanism.gravity;
    const Force<T> weight{here.inertia.mass * g, cross(here.inertia.moment, g)};
    w.Lv[cj] += link.ratio * dot(here.axis, here.momentum);
    w.Lq[cj] += link.ratio * (dot(here.axis_rate, here.momentum) + dot(here.axis, weight));

    const Force<T> F = here.inertia * here.axis;
    const Force<T> B = here.inertia * here.axis_rate + cross(here.axis, here.momentum);
    // F . (S_i x g) = S_i(angular) . (g x F(linear))
    const Vec3<T> turning = cross(g, F.linear);
    for (int i = static_cast<int>(j); i >= 0; i = tree.bodies[static_cast<std::size_t>(i)].parent) {
        const Body& above = tree.bodies[static_cast<std::size_t>(i)];
        const auto& there = w.body[static_cast<std::size_t>(i)];
        const std::size_t ci = static_cast<std::size_t>(above.coordinate);
        const double ratio = above.ratio * link.ratio;
        const T mass = ratio * dot(there.axis, F);
        const T curvature = ratio * (dot(there.axis_rate, B) - dot(there.axis.angular, turning));
        w.M[ci * n + cj] += mass;
        w.Lqq[ci * n + cj] += curvature;
        w.A[ci * n + cj] += ratio * dot(there.axis, B);
        if (i != static_cast<int>(j)) {
            w.M[cj * n + ci] += mass;
            w.Lqq[cj * n + ci] += curvature;
            w.A[cj * n + ci] += ratio * dot(there.axis_rate, F);
        }
    }
}

// Springs and armature.
template <class T>
void add_joints(const Mechanism& mechanism, const T* q, const T* v, Jet<T>& w) {
    const Tree& tree = mechanism.tree;
    w.kinetic = T{};
    for (std::size_t c = 0; c < w.dof; ++c) {
        const T stretch = q[c] - T(mechanism.rest[c]);
        w.Lq[c] -= mechanism.stiffness[c] * stretch;
        w.Lqq[c * w.dof + c] -= T(mechanism.stiffness[c]);
        w.potential[static_cast<std::size_t>(tree.group[c])] += 0.5 * mechanism.stiffness[c] * (stretch * stretch);
        w.M[c * w.dof + c] += T(tree.armature[c]);
        w.Lv[c] += tree.armature[c] * v[c];
        w.kinetic += 0.5 * (v[c] * w.Lv[c]);
    }
}

}  // namespace detail

// The whole jet at (q, v), left in w.
template <class T>
void lagrangian_jet(const Mechanism& mechanism, const T* q, const T* v, Jet<T>& w) {
    const Tree& tree = mechanism.tree;
    for (auto* sum : {&w.potential, &w.Lq, &w.Lv, &w.M, &w.A, &w.Lqq}) std::fill(sum->begin(), sum->end(), T{});
    for (std::size_t j = 0; j < tree.bodies.size(); ++j) {
        const Body& link = tree.bodies[j];
        auto& here = w.body[j];
        detail::place(tree, j, q, w);
        detail::move(tree, j, v, w);
        here.inertia = placed(here.rotation, here.position, link.mass, link.center, link.inertia);
        here.momentum = here.inertia * here.velocity;
    }
    for (std::size_t j = tree.bodies.size(); j-- > 0;) {
        const Body& link = tree.bodies[j];
        const auto& here = w.body[j];
        detail::project(mechanism, j, w);
        if (link.parent >= 0) {
            auto& up = w.body[static_cast<std::size_t>(link.parent)];
            up.momentum += here.momentum;
            up.inertia.mass += here.inertia.mass;
            // Above an origin all slide: they see masses and linear momenta alone.
            if (!link.origin) {
                up.inertia.moment += here.inertia.moment;
                up.inertia.second += here.inertia.second;
            }
        }
        if (link.origin) detail::add_potential(mechanism, j, link.ratio * q[link.coordinate] + link.offset, w);
    }
    detail::add_joints(mechanism, q, v, w);
}

}  // namespace varpin
