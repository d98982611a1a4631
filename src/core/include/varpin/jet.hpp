// The Lagrangian jet: one forward and one backward sweep over the tree give L and all its derivatives up to second
// order. docs/mathematics.md, "The Lagrangian jet". With S the axis of a joint, V the velocity of its body, W = V x S,
// Y and H the inertia and momentum of its subtree, F = Y S, B = Y W + S x* H, g gravity, and i an ancestor of j or j
// itself:
//
//     L_v[j] = S_j . H_j        M[i,j] = S_i . F_j        L_qq[i,j] = W_i . B_j - F_j . (S_i x g)
//     L_q[j] = W_j . H_j + S_j . (Y_j g)                  A[i,j] = S_i . B_j,  A[j,i] = W_i . F_j
//
// Vectors are taken about the root of their branch, or about the last of the prismatic joints that follow it. This
// point moves with the branch, so that robots far from the world's origin lose no digits. With T = Dual and (q, v)
// along a direction, the slopes of M, A and L_qq are third derivatives of L, contracted with the direction. Equations
// (J1) and (J2) of docs/mathematics.md.
#pragma once

#include <algorithm>
#include <cmath>
#include <type_traits>
#include <vector>

#include "varpin/dual.hpp"
#include "varpin/elementary.hpp"
#include "varpin/mechanism.hpp"
#include "varpin/spatial.hpp"

namespace varpin {

// Sums of the norms of the terms of a body's velocity, momentum and first moment, without cancellation. Rounding errors
// are proportional to them, not to the results.
struct Magnitudes {
    double velocity = 0.0, turning = 0.0;  // V: linear, angular
    double momentum = 0.0, spin = 0.0;     // H: linear, angular
    double moment = 0.0;                   // m c
};

// Products of the axis of a body, and of its rate, with a force; for doubles in one vector register.
template <class T>
struct AxisAndRate {
    Motion<T> axis{}, rate{};

    struct Both {
        T by_axis{}, by_rate{};
    };
    struct Moved {
        Force<T> by_axis{}, by_rate{};
    };
    Both of(const Force<T>& f) const { return {dot(axis, f), dot(rate, f)}; }
    Moved moved(const Inertia<T>& Y) const { return {Y * axis, Y * rate}; }
};
template <>
struct AxisAndRate<double> {
    Motion<Slopes> both{};

    AxisAndRate() = default;
    AxisAndRate(const Motion<double>& axis, const Motion<double>& rate) : both(slopes(rate, axis)) {}

    struct Both {
        double by_axis, by_rate;
    };
    struct Moved {
        Force<double> by_axis, by_rate;
    };
    Both of(const Force<double>& f) const {
        const Slopes found = dot(both, f);
        return {found.v(), found.q()};
    }
    Moved moved(const Inertia<double>& Y) const {
        const Force<Slopes> found = Y * both;
        const auto [l, a] = found;
        return {{{l.x.v(), l.y.v(), l.z.v()}, {a.x.v(), a.y.v(), a.z.v()}},
                {{l.x.q(), l.y.q(), l.z.q()}, {a.x.q(), a.y.q(), a.z.q()}}};
    }
};

// Work arrays and results of a sweep; matrices are (n, n), row-major.
template <class T>
struct Jet {
    // Only steps need the rounding errors of L_q, L_v and the potential.
    static constexpr bool scaled = std::is_same_v<T, double>;

    struct BodyState {
        Mat3<T> rotation{};
        Vec3<T> position{};  // of the joint, from the last origin above it [m]
        Motion<T> axis{};
        Motion<T> velocity{};
        Motion<T> axis_rate{};
        AxisAndRate<T> columns{};  // for second derivatives
        Inertia<T> inertia{};
        Force<T> momentum{};
        Magnitudes magnitude{};
    };

    // Without `matrices`, only functions that do not write any may be called.
    explicit Jet(const Tree& tree, bool matrices = true)
        : body(tree.bodies.size()),
          dof(tree.dof()),
          potential(tree.groups),
          Lq(dof),
          Lv(dof),
          potential_scale(tree.groups),
          Lq_scale(dof),
          Lv_scale(dof) {
        if (matrices) allocate();
    }

    void allocate() {
        for (auto* matrix : {&M, &A, &Lqq}) matrix->resize(entries(dof, dof));
    }

    std::vector<BodyState> body;
    int dof;
    T kinetic{};               // [J]
    std::vector<T> potential;  // of each group [J]
    std::vector<T> Lq, Lv, M, A, Lqq;
    std::vector<double> potential_scale, Lq_scale, Lv_scale;  // sums of the magnitudes of their terms
    CouplingWorkspace<T> couplings;

    T total_potential() const {
        T sum{};
        for (const T& part : potential) sum += part;
        return sum;
    }
};

namespace detail {

template <class T>
double norm1(const Vec3<T>& a) {
    return std::abs(a.x) + std::abs(a.y) + std::abs(a.z);
}

// Orientation, position and axis of a body. Functions that every sweep calls for every body are forced inline, which
// saves 15 % of a sweep.
template <class T>
[[gnu::always_inline]] inline void place_body(const Tree& tree, int j, const T* q, Jet<T>& w) {
    using elementary::turn;
    const Body& link = tree.bodies[j];
    auto& here = w.body[j];
    const T angle = link.ratio * q[link.coordinate] + link.offset;
    Mat3<T> R;
    Vec3<T> p{};
    if (link.parent < 0) {
        const Mat3<double>& E = link.rotation;
        R = {{E.x.x, E.x.y, E.x.z}, {E.y.x, E.y.y, E.y.z}, {E.z.x, E.z.y, E.z.z}};
    } else {
        R = w.body[link.parent].rotation * link.rotation;
    }
    if (!link.origin) {
        const auto& up = w.body[link.parent];
        p = up.position + up.rotation * link.translation;
    }
    if (link.prismatic) {
        if (!link.origin) p += angle * R.z;
        here.axis = {R.z, {}};
        here.rotation = R;
    } else {
        const auto [c, s] = turn(angle);
        here.axis = {cross(p, R.z), R.z};
        here.rotation = {c * R.x + s * R.y, c * R.y - s * R.x, R.z};
    }
    here.position = p;
}

// Velocity V of a body and the rate W of its axis.
template <class T>
[[gnu::always_inline]] inline void move(const Tree& tree, int j, const T* v, Jet<T>& w) {
    const Body& link = tree.bodies[j];
    auto& here = w.body[j];
    const T rate = link.ratio * v[link.coordinate];
    if (link.parent < 0) {
        here.velocity = rate * here.axis;
        here.axis_rate = {};
        return;
    }
    const Motion<T>& up = w.body[link.parent].velocity;
    here.axis_rate = cross(up, here.axis);  // V_j x S_j = V_parent x S_j, since S x S = 0
    here.velocity = up + rate * here.axis;
}

// What a body has by itself for second derivatives: its place, its velocity, and its own inertia and momentum.
template <class T>
[[gnu::always_inline]] inline void enter_body(const Tree& tree, int j, const T* q, const T* v, Jet<T>& w) {
    const Body& link = tree.bodies[j];
    auto& here = w.body[j];
    place_body(tree, j, q, w);
    move(tree, j, v, w);
    here.inertia = placed(here.rotation, here.position, link.mass, link.center, link.inertia);
    here.momentum = here.inertia * here.velocity;
    here.columns = {here.axis, here.axis_rate};
}

[[gnu::always_inline]] inline void measure(const Tree& tree, int j, const double* v, Jet<double>& w) {
    const Body& link = tree.bodies[j];
    auto& here = w.body[j];
    const double rate = std::abs(link.ratio * v[link.coordinate]);
    Magnitudes& magnitude = here.magnitude;
    magnitude.velocity = norm1(here.axis.linear) * rate;
    magnitude.turning = norm1(here.axis.angular) * rate;
    if (link.parent >= 0) {
        magnitude.velocity += w.body[link.parent].magnitude.velocity;
        magnitude.turning += w.body[link.parent].magnitude.turning;
    }
    magnitude.moment = norm1(here.inertia.moment);
    magnitude.momentum = link.mass * magnitude.velocity + magnitude.turning * magnitude.moment;
    magnitude.spin = (link.inertia.xx + link.inertia.yy + link.inertia.zz) * magnitude.turning;
    if (link.mass > 0.0) magnitude.spin += magnitude.moment / link.mass * magnitude.momentum;
}

// Potential energy in gravity of the subtree of an origin: from its moments, and from the position of the origin.
template <class T>
void add_potential(const Mechanism& mechanism, int j, const T* q, Jet<T>& w) {
    const Body& link = mechanism.tree.bodies[j];
    const auto& here = w.body[j];
    Vec3<T> shift{T(link.translation.x), T(link.translation.y), T(link.translation.z)};
    if (link.parent >= 0) shift = w.body[link.parent].rotation * link.translation;
    if (link.prismatic) shift += (link.ratio * q[link.coordinate] + link.offset) * here.axis.linear;
    const int group = mechanism.tree.group[link.coordinate];
    w.potential[group] -= dot(here.inertia.mass * shift + here.inertia.moment, mechanism.gravity);
    if constexpr (Jet<T>::scaled) {
        w.potential_scale[group] +=
            norm1(mechanism.gravity) * (here.inertia.mass * norm1(shift) + norm1(here.inertia.moment));
    }
}

// Contribution of the subtree of body j to L_q and L_v.
template <class T>
[[gnu::always_inline]] inline void project_first(const Mechanism& mechanism, int j, Jet<T>& w) {
    const Body& link = mechanism.tree.bodies[j];
    const auto& here = w.body[j];
    const Vec3<double>& g = mechanism.gravity;
    const Force<T> weight{here.inertia.mass * g, cross(here.inertia.moment, g)};
    const int c = link.coordinate;
    w.Lv[c] += link.ratio * dot(here.axis, here.momentum);
    w.Lq[c] += link.ratio * (dot(here.axis_rate, here.momentum) + dot(here.axis, weight));
    if constexpr (Jet<T>::scaled) {
        const Magnitudes& magnitude = here.magnitude;
        const Magnitudes up = link.parent >= 0 ? w.body[link.parent].magnitude : Magnitudes{};
        const double shift = norm1(here.axis.linear), turn = norm1(here.axis.angular);
        const double Lv_scale = shift * magnitude.momentum + turn * magnitude.spin;
        double Lq_scale =
            (up.turning * shift + up.velocity * turn) * magnitude.momentum + up.turning * turn * magnitude.spin;
        Lq_scale += norm1(g) * (here.inertia.mass * shift + turn * magnitude.moment);
        w.Lv_scale[c] += std::abs(link.ratio) * Lv_scale;
        w.Lq_scale[c] += std::abs(link.ratio) * Lq_scale;
    }
}

// Contribution of the subtree of body j to M and A, and if `curved` to L_qq.
template <bool curved, class T, class Size>
void project_second(const Mechanism& mechanism, int j, Size n, Jet<T>& w) {
    const Tree& tree = mechanism.tree;
    const Body& link = tree.bodies[j];
    const auto& here = w.body[j];
    const int cj = link.coordinate;
    const auto [F, moved] = here.columns.moved(here.inertia);
    const Force<T> B = moved + cross(here.axis, here.momentum);
    // F . (S_i x g) = S_i(angular) . (g x F(linear))
    const Vec3<T> turning = cross(mechanism.gravity, F.linear);
    for (int i = j; i >= 0; i = tree.bodies[i].parent) {
        const Body& above = tree.bodies[i];
        const auto& there = w.body[i];
        const int ci = above.coordinate;
        const double ratio = above.ratio * link.ratio;
        const auto of_F = there.columns.of(F), of_B = there.columns.of(B);
        const T mass = ratio * of_F.by_axis;
        w.M[ci * n + cj] += mass;
        w.A[ci * n + cj] += ratio * of_B.by_axis;
        if (i != j) {
            w.M[cj * n + ci] += mass;
            w.A[cj * n + ci] += ratio * of_F.by_rate;
        }
        if constexpr (curved) {
            const T curvature = ratio * (of_B.by_rate - dot(there.axis.angular, turning));
            w.Lqq[ci * n + cj] += curvature;
            if (i != j) w.Lqq[cj * n + ci] += curvature;
        }
    }
}

// The share of what body j carries in M alone: the composite rigid body algorithm. Returns F.
template <class T, class Size>
Force<T> project_mass(const Tree& tree, int j, Size n, Jet<T>& w) {
    const Body& link = tree.bodies[j];
    const Force<T> F = w.body[j].inertia * w.body[j].axis;
    const int cj = link.coordinate;
    for (int i = j; i >= 0; i = tree.bodies[i].parent) {
        const Body& above = tree.bodies[i];
        const T mass = above.ratio * link.ratio * dot(w.body[i].axis, F);
        w.M[above.coordinate * n + cj] += mass;
        if (i != j) w.M[cj * n + above.coordinate] += mass;
    }
    return F;
}

// Add the subtree of body j to its parent. Joints above an origin are prismatic: only masses and linear momenta count.
template <class T>
[[gnu::always_inline]] inline void pass_inertia(const Body& link, const Inertia<T>& carried, Inertia<T>& up,
                                                bool second) {
    up.mass += carried.mass;
    if (link.origin) return;
    up.moment += carried.moment;
    if (second) up.second += carried.second;
}

template <class T>
[[gnu::always_inline]] inline void pass_momentum(const Body& link, int j, Jet<T>& w) {
    auto& up = w.body[link.parent];
    up.momentum += w.body[j].momentum;
    if constexpr (Jet<T>::scaled) {
        up.magnitude.momentum += w.body[j].magnitude.momentum;
        up.magnitude.spin += w.body[j].magnitude.spin;
        up.magnitude.moment += w.body[j].magnitude.moment;
    }
}

template <class T, class Size>
void clear_first(Size n, Jet<T>& w) {
    std::fill(w.potential.begin(), w.potential.end(), T{});
    std::fill(w.potential_scale.begin(), w.potential_scale.end(), 0.0);
    for (int c = 0; c < n; ++c) {
        w.Lq[c] = w.Lv[c] = T{};
        w.Lq_scale[c] = w.Lv_scale[c] = 0.0;
    }
}

// Set the blocks of a matrix to zero; entries outside of them are never written.
template <class T, class Size>
void clear_blocks(const Tree& tree, Size n, std::vector<T>& matrix) {
    if (blocks_of(tree, n).size() == 1) {
        std::fill_n(matrix.data(), n * n, T{});
        return;
    }
    for (const Block& block : blocks_of(tree, n)) {
        for (int i = block.begin; i < block.end; ++i) {
            std::fill(matrix.begin() + i * n + block.begin, matrix.begin() + i * n + block.end, T{});
        }
    }
}

// Potential energy of the couplings and its derivatives up to an order. Not inlined, since that would slow down sweeps
// without couplings.
template <class T>
[[gnu::noinline]] void add_couplings(const Mechanism& mechanism, const T* q, Jet<T>& w, int order) {
    mechanism.couplings.potentials(q, w.couplings,
                                   [&](const auto& arms, const auto& potential, double scale, double size) {
                                       const int group = mechanism.tree.group[arms.front().coordinate];
                                       w.potential[group] += potential.energy;
                                       if constexpr (Jet<T>::scaled) w.potential_scale[group] += size;
                                       if (order == 0) return;
                                       for (const Arm<T>& arm : arms) {
                                           w.Lq[arm.coordinate] += -dot(potential.slope, arm.linear);
                                           if constexpr (Jet<T>::scaled)
                                               w.Lq_scale[arm.coordinate] += scale * norm1(arm.linear);
                                       }
                                       if (order > 1)
                                           Couplings::subtract_curvature(arms, potential, w.dof, w.Lqq.data());
                                   });
}

// Potential energy of the elements and its derivatives up to an order.
template <class T>
void add_elements(const Mechanism& mechanism, const T* q, Jet<T>& w, int order) {
    mechanism.forces.potentials(q, [&](int c, const Potential<T>& potential) {
        const int group = mechanism.tree.group[c];
        w.potential[group] += potential.energy;
        if (order > 0) w.Lq[c] += potential.force;
        if (order > 1) w.Lqq[c * w.dof + c] += potential.curvature;
        if constexpr (Jet<T>::scaled) {
            w.potential_scale[group] += std::abs(potential.energy);
            if (order > 0) w.Lq_scale[c] += potential.scale;
        }
    });
    if (mechanism.couplings.any()) add_couplings(mechanism, q, w, order);
}

// Momentum of the armature, and the kinetic energy.
template <class T, class Size>
void add_armature(const Tree& tree, const T* v, Size n, Jet<T>& w) {
    w.kinetic = T{};
    for (int c = 0; c < n; ++c) {
        const T momentum = tree.armature[c] * v[c];
        w.Lv[c] += momentum;
        if constexpr (Jet<T>::scaled) w.Lv_scale[c] += std::abs(momentum);
        w.kinetic += 0.5 * (v[c] * w.Lv[c]);
    }
}

}  // namespace detail

// The whole jet, (J1) and (J2), at (q, v) into w. The number of joints may be known at compile time, here and below.
template <class Size = int, class T>
void lagrangian_jet(const Mechanism& mechanism, const T* q, const T* v, Jet<T>& w) {
    const Tree& tree = mechanism.tree;
    const Size n = w.dof;
    const int bodies = bodies_of(tree, n);
    detail::clear_first(n, w);
    for (auto* matrix : {&w.M, &w.A, &w.Lqq}) detail::clear_blocks(tree, n, *matrix);
    for (int j = 0; j < bodies; ++j) {
        detail::enter_body(tree, j, q, v, w);
        if constexpr (Jet<T>::scaled) detail::measure(tree, j, v, w);
    }
    for (int j = bodies - 1; j >= 0; --j) {
        const Body& link = tree.bodies[j];
        detail::project_first(mechanism, j, w);
        detail::project_second<true>(mechanism, j, n, w);
        if (link.parent >= 0) {
            detail::pass_momentum(link, j, w);
            detail::pass_inertia(link, w.body[j].inertia, w.body[link.parent].inertia, true);
        }
        if (link.origin) detail::add_potential(mechanism, j, q, w);
    }
    detail::add_elements(mechanism, q, w, 2);
    for (int c = 0; c < n; ++c) w.M[c * n + c] += T(tree.armature[c]);
    detail::add_armature(tree, v, n, w);
}

// Only M and A at (q, v).
template <class Size = int>
void momentum_slopes(const Mechanism& mechanism, const double* q, const double* v, Jet<double>& w) {
    const Tree& tree = mechanism.tree;
    const Size n = w.dof;
    const int bodies = bodies_of(tree, n);
    for (auto* matrix : {&w.M, &w.A}) detail::clear_blocks(tree, n, *matrix);
    for (int j = 0; j < bodies; ++j) detail::enter_body(tree, j, q, v, w);
    for (int j = bodies - 1; j >= 0; --j) {
        const Body& link = tree.bodies[j];
        detail::project_second<false>(mechanism, j, n, w);
        if (link.parent < 0) continue;
        w.body[link.parent].momentum += w.body[j].momentum;
        detail::pass_inertia(link, w.body[j].inertia, w.body[link.parent].inertia, true);
    }
    for (int c = 0; c < n; ++c) w.M[c * n + c] += tree.armature[c];
}

// Only L_q, L_v and the energies at (q, v). Moments of inertia stay in body axes.
template <class Size = int>
void first_order(const Mechanism& mechanism, const double* q, const double* v, Jet<double>& w) {
    const Tree& tree = mechanism.tree;
    const Size n = w.dof;
    const int bodies = bodies_of(tree, n);
    detail::clear_first(n, w);
    for (int j = 0; j < bodies; ++j) {
        const Body& link = tree.bodies[j];
        auto& here = w.body[j];
        detail::place_body(tree, j, q, w);
        detail::move(tree, j, v, w);
        const Vec3<double> center = here.position + here.rotation * link.center;
        here.inertia.mass = link.mass;
        here.inertia.moment = link.mass * center;
        const Vec3<double>& spin = here.velocity.angular;
        const Vec3<double> momentum = link.mass * (here.velocity.linear + cross(spin, center));
        here.momentum = {momentum,
                         here.rotation * (link.inertia * (transposed(here.rotation) * spin)) + cross(center, momentum)};
        detail::measure(tree, j, v, w);
    }
    for (int j = bodies - 1; j >= 0; --j) {
        const Body& link = tree.bodies[j];
        detail::project_first(mechanism, j, w);
        if (link.parent >= 0) {
            detail::pass_momentum(link, j, w);
            detail::pass_inertia(link, w.body[j].inertia, w.body[link.parent].inertia, false);
        }
        if (link.origin) detail::add_potential(mechanism, j, q, w);
    }
    detail::add_elements(mechanism, q, w, 1);
    detail::add_armature(tree, v, n, w);
}

// Only the potential energy at q. `enter` visits each placed body with its own inertia, from the first to the last;
// then `project` visits each with the inertia of its subtree, from the last to the first.
template <class Size = int, class Visit, class Project>
void inertias(const Mechanism& mechanism, const double* q, Jet<double>& w, const Visit& visit, const Project& project) {
    const Tree& tree = mechanism.tree;
    const Size n = w.dof;
    const int bodies = bodies_of(tree, n);
    std::fill(w.potential.begin(), w.potential.end(), 0.0);
    std::fill(w.potential_scale.begin(), w.potential_scale.end(), 0.0);
    for (int j = 0; j < bodies; ++j) {
        const Body& link = tree.bodies[j];
        auto& here = w.body[j];
        detail::place_body(tree, j, q, w);
        here.inertia = placed(here.rotation, here.position, link.mass, link.center, link.inertia);
        visit(j);
    }
    for (int j = bodies - 1; j >= 0; --j) {
        const Body& link = tree.bodies[j];
        project(j);
        if (link.parent >= 0) detail::pass_inertia(link, w.body[j].inertia, w.body[link.parent].inertia, true);
        if (link.origin) detail::add_potential(mechanism, j, q, w);
    }
    detail::add_elements(mechanism, q, w, 0);
}

// Only M and the potential energy at q.
template <class Size = int>
void mass_matrix(const Mechanism& mechanism, const double* q, Jet<double>& w) {
    const Size n = w.dof;
    detail::clear_blocks(mechanism.tree, n, w.M);
    inertias<Size>(mechanism, q, w, [](int) {}, [&](int j) { detail::project_mass(mechanism.tree, j, n, w); });
    for (int c = 0; c < n; ++c) w.M[c * n + c] += mechanism.tree.armature[c];
}

}  // namespace varpin
