// Solves with the second derivatives of L by elimination from the leaves to the roots: work in proportion to the number
// of bodies, and no matrix. docs/mathematics.md, "Linear in the number of joints".
//
// With vectors of the jet (jet.hpp), f momentum and I inertia of each body by itself, s = (S(angular) x g, 0), and for
//
//     N = c_M M + c_A A + c_T A' + c_Q L_qq + diag(d)
//
// a body moves by w = w_parent + G x with G = (S, W), x its coordinate, and
//
//     (N x)_j = L_j . (sum over what j carries of X w) + l_j . w_parent + d_j x_j,      X = (I 0; C I),  C a = a x* f
//     L = (c_M S + c_T W - c_Q s,  c_A S + c_Q W),      l = ((c_A + c_T) P + c_Q R,  c_Q P)
//     P = S x* H,    R = W x* H + Y s - (0, g x (Y S)(linear)).
//
// Once all that j carries is eliminated, what is left of it answers w_j by X w_j + z, and so
//
//     u = X G,  D = d + L . u,  l += L' X:      x = (r - L . z) / D - l . w_parent / D
//     handed on to the parent: X - u l' / D,  z + u (r - L . z) / D.
//
// For N = M + diag(armature) this is the articulated body algorithm (Featherstone 2008), where u = l = X S.
#pragma once

#include <algorithm>
#include <limits>
#include <vector>

#include "varpin/jet.hpp"
#include "varpin/spatial.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// Times of dense work per pair and per cubed size of a block, in units of what an eliminated body costs; measured with
// benchmarks/joints.py.
inline constexpr double pair_cost = 0.04, factor_cost = 0.002;

// Coefficients of M, L_vq, its transpose and L_qq in a matrix.
struct Combination {
    double M = 1.0;
    double A = 0.0;
    double At = 0.0;
    double Lqq = 0.0;
};

// How to solve with M and with the matrix of a step; elimination cannot where two bodies share a coordinate.
enum class Solver { automatic, dense, elimination };

inline bool eliminates(const Tree& tree, Solver solver) {
    if (solver == Solver::dense || tree.size() != tree.dof()) return false;
    if (solver == Solver::elimination) return true;
    // Dense work: sums over pairs of a body and one above it, and factors of blocks.
    double dense = 0.0;
    std::vector<int> depth(tree.size(), 1);
    for (int j = 0; j < tree.size(); ++j) {
        if (tree.bodies[j].parent >= 0) depth[j] += depth[tree.bodies[j].parent];
        dense += pair_cost * depth[j];
    }
    for (const Block& block : tree.blocks) {
        const double width = block.end - block.begin;
        dense += factor_cost * width * width * width;
    }
    return tree.size() < dense;
}

// Where each body gathers what it carries while bodies are eliminated, the last one first. Places are used again: along
// a chain there is one, and it stays in the cache.
struct Gathering {
    explicit Gathering(const Tree& tree) : place(tree.size(), -1), joins(tree.size(), 0), leaf(tree.size(), 1) {
        std::vector<int> free;
        for (int j = tree.size() - 1; j >= 0; --j) {
            if (place[j] < 0) {
                if (free.empty()) free.push_back(places++);
                place[j] = free.back();
                free.pop_back();
            }
            const int k = tree.bodies[j].parent;
            if (k >= 0 && place[k] < 0) {
                place[k] = place[j];
                leaf[k] = 0;
                continue;
            }
            joins[j] = k >= 0;
            free.push_back(place[j]);
        }
    }

    int places = 0;
    std::vector<int> place;   // of each body; the first child's is its parent's
    std::vector<char> joins;  // adds to what its parent has already, from a place of its own
    std::vector<char> leaf;   // nothing is at its place before it
};

namespace detail {

inline void write(const Motion<double>& a, double* x) {
    x[0] = a.linear.x, x[1] = a.linear.y, x[2] = a.linear.z;
    x[3] = a.angular.x, x[4] = a.angular.y, x[5] = a.angular.z;
}
inline void write(const Force<double>& f, double* x) {
    x[0] = f.linear.x, x[1] = f.linear.y, x[2] = f.linear.z;
    x[3] = f.angular.x, x[4] = f.angular.y, x[5] = f.angular.z;
}
inline Motion<double> motion_at(const double* x) { return {{x[0], x[1], x[2]}, {x[3], x[4], x[5]}}; }

// Functions of vectors (size) and matrices (size, size), row by row. Sums of products have two parts, of even and odd
// terms: a processor adds both at once.
template <int size>
double product(const double* a, const double* b) {
    double even = 0.0, odd = 0.0;
    for (int c = 0; c < size; c += 2) {
        even += a[c] * b[c];
        odd += a[c + 1] * b[c + 1];
    }
    return even + odd;
}
template <int size>
void multiply(const double* X, const double* x, double* __restrict y) {
    for (int r = 0; r < size; ++r) y[r] = product<size>(X + r * size, x);
}
template <int size>
void add_transposed(const double* X, const double* x, double* __restrict y) {
    for (int r = 0; r < size; ++r) {
        for (int c = 0; c < size; ++c) y[c] += x[r] * X[r * size + c];
    }
}
template <int size>
void subtract_outer(const double* u, const double* l, double* __restrict X) {
    for (int r = 0; r < size; ++r) {
        for (int c = 0; c < size; ++c) X[r * size + c] -= u[r] * l[c];
    }
}

// The matrix of a x, and that of an inertia, added to a part of a matrix whose rows have length `stride`.
inline void add_cross(const Vec3<double>& a, int stride, double* x) {
    x[1] -= a.z, x[2] += a.y;
    x[stride] += a.z, x[stride + 2] -= a.x;
    x[2 * stride] -= a.y, x[2 * stride + 1] += a.x;
}
inline void add_inertia(const Inertia<double>& I, int stride, double* x) {
    for (int r = 0; r < 3; ++r) x[r * stride + r] += I.mass;
    add_cross(-1.0 * I.moment, stride, x + 3);
    double* angular = x + 3 * stride;
    add_cross(I.moment, stride, angular);
    angular[3] += I.second.xx, angular[4] += I.second.xy, angular[5] += I.second.xz;
    angular += stride;
    angular[3] += I.second.xy, angular[4] += I.second.yy, angular[5] += I.second.yz;
    angular += stride;
    angular[3] += I.second.xz, angular[4] += I.second.yz, angular[5] += I.second.zz;
}

// Above an origin all slide: they see linear parts alone, which are the same about any point.
template <int size>
void keep_linear(double* z) {
    for (int part = 3; part < size; part += 6) std::fill(z + part, z + part + 3, 0.0);
}
template <int size>
void keep_linear_rows(double* X) {
    for (int r = 0; r < size; ++r) {
        if (r % 6 < 3) {
            keep_linear<size>(X + r * size);
        } else {
            std::fill(X + r * size, X + (r + 1) * size, 0.0);
        }
    }
}

// What bodies have gathered while the last of them are eliminated; `entries` numbers at each place.
template <int entries>
class Gathered {
  public:
    explicit Gathered(const Gathering& order) : order_(&order), at_(order.places * entries) {}

    // What body j has of those it carries.
    double* of(int j) {
        double* own = at_.data() + order_->place[j] * entries;
        if (order_->leaf[j]) std::fill(own, own + entries, 0.0);
        return own;
    }
    // Body j is done with: its parent goes on with what it leaves, or adds that to its own.
    void hand_on(int j, int parent) {
        if (!order_->joins[j]) return;
        const double* own = at_.data() + order_->place[j] * entries;
        double* __restrict up = at_.data() + order_->place[parent] * entries;
        for (int k = 0; k < entries; ++k) up[k] += own[k];
    }

  private:
    const Gathering* order_;
    std::vector<double> at_;
};

}  // namespace detail

// M + diag(armature) as pivots and what goes with them, at one configuration after another.
class ArticulatedBodies {
  public:
    explicit ArticulatedBodies(const Tree& tree)
        : tree_(&tree),
          order_(tree),
          body_(tree.size()),
          inertia_(order_),
          force_(order_),
          motion_(6 * (tree.size() + 1)) {}
    ArticulatedBodies(const ArticulatedBodies&) = delete;
    ArticulatedBodies& operator=(const ArticulatedBodies&) = delete;

    // Bodies where the jet has them, each with its inertia by itself, in the order of a sweep.
    void place(int j, const Motion<double>& axis, const Inertia<double>& inertia) {
        detail::write(tree_->bodies[j].ratio * axis, body_[j].axis);
        body_[j].inertia = inertia;
    }

    // False at a pivot that is not positive.
    bool factor() {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            if (!eliminate(j)) return false;
        }
        return true;
    }

    // One body after another, from the last to the first.
    bool eliminate(int j) {
        const Body& link = tree_->bodies[j];
        State& own = body_[j];
        double* X = inertia_.of(j);
        detail::add_inertia(own.inertia, 6, X);
        detail::multiply<6>(X, own.axis, own.u);
        own.pivot = tree_->armature[link.coordinate] + detail::product<6>(own.axis, own.u);
        if (!(own.pivot > 0.0)) return false;
        for (int r = 0; r < 6; ++r) own.answer[r] = own.u[r] / own.pivot;
        if (link.parent < 0) return true;
        detail::subtract_outer<6>(own.answer, own.u, X);
        if (link.origin) detail::keep_linear_rows<6>(X);
        inertia_.hand_on(j, link.parent);
        return true;
    }

    // The inertia of coordinate c with all it carries free [kg m^2 or kg].
    double pivot(int body) const { return body_[body].pivot; }

    // x with (M + diag(armature)) x = b; x may be b. `share`, unless null, receives the terms of 1/2 b . x, none of
    // which is negative: that of coordinate i is what is left of b_i when all it carries is free.
    void solve(const double* b, double* x, double* share) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const State& own = body_[j];
            double* z = force_.of(j);
            const int c = link.coordinate;
            const double left = b[c] - detail::product<6>(own.axis, z);
            x[c] = left / own.pivot;
            if (share) share[c] = 0.5 * left * x[c];
            if (link.parent < 0) continue;
            for (int r = 0; r < 6; ++r) z[r] += own.answer[r] * left;
            if (link.origin) detail::keep_linear<6>(z);
            force_.hand_on(j, link.parent);
        }
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const State& own = body_[j];
            const double* above = &motion_[6 * (link.parent + 1)];  // still, where there is none
            x[link.coordinate] -= detail::product<6>(own.answer, above);
            for (int r = 0; r < 6; ++r) motion_[6 * (j + 1) + r] = above[r] + own.axis[r] * x[link.coordinate];
        }
    }

  private:
    struct State {
        double axis[6] = {};  // S
        Inertia<double> inertia{};
        double u[6] = {}, answer[6] = {};  // X S, and that by the pivot
        double pivot = 0.0;
    };

    const Tree* tree_;
    Gathering order_;
    std::vector<State> body_;
    detail::Gathered<36> inertia_;
    detail::Gathered<6> force_;
    std::vector<double> motion_;  // (b + 1, 6) of each body, after what stands still
};

// Combinations of all second derivatives, at one (q, v) after another.
class Elimination {
  public:
    explicit Elimination(const Mechanism& mechanism)
        : mechanism_(&mechanism),
          tree_(&mechanism.tree),
          order_(mechanism.tree),
          body_(mechanism.tree.size()),
          factors_(mechanism.tree.size()),
          matrix_(order_),
          force_(order_),
          motion_(12 * (mechanism.tree.size() + 1)),
          masses_(mechanism.tree) {}
    Elimination(const Elimination&) = delete;
    Elimination& operator=(const Elimination&) = delete;

    // Take over from a sweep of first order what follows is about.
    void take(const Jet<double>& jet) {
        const Vec3<double>& g = mechanism_->gravity;
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const auto& here = jet.body[j];
            State& own = body_[j];
            own.inertia = placed(here.rotation, here.position, link.mass, link.center, link.inertia);
            own.momentum = own.inertia * here.velocity;
            masses_.place(j, here.axis, own.inertia);
            const Motion<double> S = link.ratio * here.axis, W = link.ratio * here.axis_rate;
            const Motion<double> s{cross(S.angular, g), {}};
            const Vec3<double>& h = here.inertia.moment;
            const Vec3<double> YS = here.inertia.mass * S.linear + cross(S.angular, h);
            const Force<double> Ys{here.inertia.mass * s.linear, cross(h, s.linear) - cross(g, YS)};
            detail::write(S, own.G);
            detail::write(W, own.G + 6);
            detail::write(s, own.s);
            detail::write(cross(S, here.momentum), own.P);
            detail::write(cross(W, here.momentum) + Ys, own.R);
        }
    }

    // Factor N; false at a pivot that is not positive.
    bool factor(const Combination& of, const double* diagonal) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            if (!eliminate(j, of, diagonal[tree_->bodies[j].coordinate], factors_[j])) return false;
        }
        return true;
    }

    // The smallest ratio of a pivot of N to the same one of M, armature included; 0 if one is not positive. What
    // `factor` left remains.
    double least_pivot_ratio(const Combination& of, const double* diagonal) {
        Factors own;
        double least = std::numeric_limits<double>::infinity();
        for (int j = tree_->size() - 1; j >= 0; --j) {
            if (!eliminate(j, of, diagonal[tree_->bodies[j].coordinate], own) || !masses_.eliminate(j)) return 0.0;
            least = std::min(least, own.pivot / masses_.pivot(j));
        }
        return least;
    }

    // x with N x = b.
    void solve(const double* b, double* x) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const Factors& own = factors_[j];
            double* z = force_.of(j);
            const double t = (b[link.coordinate] - detail::product<12>(own.L, z)) / own.pivot;
            x[link.coordinate] = t;
            if (link.parent < 0) continue;
            for (int r = 0; r < 12; ++r) z[r] += own.u[r] * t;
            if (link.origin) detail::keep_linear<12>(z);
            force_.hand_on(j, link.parent);
        }
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const double* above = &motion_[12 * (link.parent + 1)];
            x[link.coordinate] -= detail::product<12>(factors_[j].l, above);
            for (int r = 0; r < 12; ++r) motion_[12 * (j + 1) + r] = above[r] + body_[j].G[r] * x[link.coordinate];
        }
    }

    // x' M x, armature included, of the x that `solve` left.
    double kinetic_size(const double* x) const {
        double total = 0.0;
        for (int j = 0; j < tree_->size(); ++j) {
            const Motion<double> moved = detail::motion_at(&motion_[12 * (j + 1)]);
            total += dot(moved, body_[j].inertia * moved);
        }
        for (int c = 0; c < tree_->dof(); ++c) total += tree_->armature[c] * x[c] * x[c];
        return total;
    }

    // y = N x of the x that `solve` left, apart from diag(d).
    void multiply(const Combination& of, double* y) {
        Factors own;
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const State& state = body_[j];
            double* z = force_.of(j);
            const double* w = &motion_[12 * (j + 1)];
            const Motion<double> by_S = detail::motion_at(w), by_W = detail::motion_at(w + 6);
            double added[12];
            detail::write(state.inertia * by_S, added);
            detail::write(cross(by_S, state.momentum) + state.inertia * by_W, added + 6);
            for (int r = 0; r < 12; ++r) z[r] += added[r];
            rows(j, of, own);
            const double* above = &motion_[12 * (link.parent + 1)];
            y[link.coordinate] = detail::product<12>(own.L, z) + detail::product<12>(own.l, above);
            if (link.parent < 0) continue;
            if (link.origin) detail::keep_linear<12>(z);
            force_.hand_on(j, link.parent);
        }
    }

  private:
    struct State {
        Inertia<double> inertia{};     // of the body by itself
        Force<double> momentum{};      // f
        double G[12] = {}, s[6] = {};  // (S, W); the turn of gravity
        double P[6] = {}, R[6] = {};   // of what the body carries
    };
    struct Factors {
        double L[12] = {}, l[12] = {}, u[12] = {};  // l by the pivot, once factored
        double pivot = 0.0;
    };

    // L and, before any elimination, l.
    void rows(int j, const Combination& of, Factors& own) const {
        const State& state = body_[j];
        const double *S = state.G, *W = state.G + 6;
        for (int r = 0; r < 6; ++r) {
            own.L[r] = of.M * S[r] + of.At * W[r] - of.Lqq * state.s[r];
            own.L[6 + r] = of.A * S[r] + of.Lqq * W[r];
            own.l[r] = (of.A + of.At) * state.P[r] + of.Lqq * state.R[r];
            own.l[6 + r] = of.Lqq * state.P[r];
        }
    }

    bool eliminate(int j, const Combination& of, double diagonal, Factors& own) {
        const Body& link = tree_->bodies[j];
        const State& state = body_[j];
        double* X = matrix_.of(j);
        detail::add_inertia(state.inertia, 12, X);
        detail::add_inertia(state.inertia, 12, X + 6 * 12 + 6);
        // C a = a x* f
        const Vec3<double> linear = -1.0 * state.momentum.linear;
        detail::add_cross(linear, 12, X + 6 * 12 + 3);
        detail::add_cross(linear, 12, X + 9 * 12);
        detail::add_cross(-1.0 * state.momentum.angular, 12, X + 9 * 12 + 3);
        rows(j, of, own);
        detail::multiply<12>(X, state.G, own.u);
        own.pivot = diagonal + detail::product<12>(own.L, own.u);
        if (!(own.pivot > 0.0)) return false;
        if (link.parent < 0) {
            std::fill(own.l, own.l + 12, 0.0);
            return true;
        }
        detail::add_transposed<12>(X, own.L, own.l);
        for (double& entry : own.l) entry /= own.pivot;
        detail::subtract_outer<12>(own.u, own.l, X);
        if (link.origin) detail::keep_linear_rows<12>(X);
        matrix_.hand_on(j, link.parent);
        return true;
    }

    const Mechanism* mechanism_;
    const Tree* tree_;
    Gathering order_;
    std::vector<State> body_;
    std::vector<Factors> factors_;
    detail::Gathered<144> matrix_;
    detail::Gathered<12> force_;
    std::vector<double> motion_;  // (b + 1, 12) of each body under the x of `solve`, after what stands still
    ArticulatedBodies masses_;
};

}  // namespace varpin
