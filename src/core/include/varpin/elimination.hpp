// Solves with the matrix of a midpoint step by elimination from the leaves to the roots, without forming the matrix;
// the work is proportional to the number of bodies. docs/mathematics.md, "Linear in the number of joints". For a joint
// j and an ancestor i,
//
//     N = M + ha A - hb A' - ha hb L_qq + diag(d)
//     N_ij = row_i . (Y_j column_j) + row_i . u0_j,      u0 = ha (S x* H, g x (Y S)(linear))
//     N_ji = (Y_j row_j) . column_i + l0_j . column_i,   l0 = -hb (S x* H, -g x (Y S)(linear))
//
// with nine entries each, row = (S - hb W, hb S(angular)) and column = (S + ha W, ha S(angular)); the inertia Y of the
// subtree of j multiplies the first six. After elimination of the subtree below j, its force for a motion w is X w + z.
// So, with x the coordinate and w = w_parent + column x,
//
//     u = X column + u0,  l = X' row + l0,  D = d + row . u:      x = (r - row . z) / D - l . w_parent / D
//     passed to the parent: X - u l' / D,  z + u (r - row . z) / D.
//
// The symmetric part M + c (A + A') - k L_qq is eliminated in the same way with rows and columns (S, W) of twelve
// entries, and M alone with S: the articulated body algorithm (Featherstone 2008).
// Equations (E1), (E2) and (E3) of docs/mathematics.md.
#pragma once

#include <algorithm>
#include <limits>
#include <memory>
#include <optional>
#include <vector>

#include "varpin/gathering.hpp"
#include "varpin/jet.hpp"
#include "varpin/pair.hpp"
#include "varpin/spatial.hpp"
#include "varpin/symmetric_elimination.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// Model of computing times, in units of the time to eliminate a body in a step with one stage. A dense step takes
// body_cost for each body, pair_cost for each pair of a body and itself or an ancestor, and block_cost times the cubed
// size of each block. Elimination of a body takes stages_cost with more stages, tied_cost with one stage and ties, and
// a share of slot_cost more for each slot of ties. Measured on chains with and without ties, on hands and on arms.
inline constexpr double body_cost = 0.6, pair_cost = 0.033, block_cost = 0.0004, stages_cost = 1.3, tied_cost = 1.45,
                        slot_cost = 0.1;

// Whether solves with M, or with the matrix of a step of so many stages, are faster without forming the matrix.
inline bool eliminates(const Tree& tree, int stages = 1) {
    double dense = body_cost * tree.size();
    std::vector<int> depth(tree.size(), 1);
    for (int j = 0; j < tree.size(); ++j) {
        if (tree.bodies[j].parent >= 0) depth[j] += depth[tree.bodies[j].parent];
        dense += pair_cost * depth[j];
    }
    for (const Block& block : tree.blocks) {
        const double size = block.end - block.begin;
        dense += block_cost * size * size * size;
    }
    const int slots = Ties(tree).slots;
    const double cost = stages > 1 ? stages_cost : slots > 0 ? tied_cost : 1.0;
    return cost * (1.0 + slot_cost * slots) * tree.size() < dense;
}

// Couplings fill entries of a step's matrix for which elimination has no form.
inline bool eliminates(const Mechanism& mechanism, int stages) {
    return !mechanism.couplings.any() && eliminates(mechanism.tree, stages);
}

namespace detail {

// Numbers that are read in pairs are also written in pairs: a load of a pair stalls after stores of single numbers.
template <class Six>
void write(const Six& a, double* x) {
    put_pair(Pair{a.linear.x, a.linear.y}, x);
    put_pair(Pair{a.linear.z, a.angular.x}, x + 2);
    put_pair(Pair{a.angular.y, a.angular.z}, x + 4);
}
// Writes nine entries.
template <class Six>
void write(const Six& a, const Vec3<double>& b, double* x) {
    write(a, x);
    put_pair(Pair{b.x, b.y}, x + 6);
    x[8] = b.z;
}
// Writes nine entries and a zero.
template <class Six>
void write_padded(const Six& a, const Vec3<double>& b, double* x) {
    write(a, x);
    put_pair(Pair{b.x, b.y}, x + 6);
    put_pair(Pair{b.z, 0.0}, x + 8);
}
inline Motion<double> motion_at(const double* x) { return {{x[0], x[1], x[2]}, {x[3], x[4], x[5]}}; }

// Functions of vectors (size) and row-major matrices (size, size) of even size. Sums add even and odd terms apart.
template <int size>
double product(const double* a, const double* b) {
    Pair sum = pair_at(a) * pair_at(b);
    for (int c = 2; c < size; c += 2) sum = sum + pair_at(a + c) * pair_at(b + c);
    return sum[0] + sum[1];
}
template <int size>
struct Pairs {
    explicit Pairs(const double* x) {
        for (int c = 0; c < size; c += 2) at[c / 2] = pair_at(x + c);
    }
    Pair at[size / 2];
};
// y = a + s b
template <int size>
void write_sum(const double* a, double s, const double* b, double* y) {
    const Pair factor{s, s};
    for (int c = 0; c < size; c += 2) put_pair(pair_at(a + c) + factor * pair_at(b + c), y + c);
}
// y += X x
template <int size>
void add_product(const double* X, const double* x, double* y) {
    const Pairs<size> factor(x);
    for (int r = 0; r < size; r += 2, X += 2 * size) {
        Pair first = pair_at(X) * factor.at[0], second = pair_at(X + size) * factor.at[0];
        for (int c = 2; c < size; c += 2) {
            first = first + pair_at(X + c) * factor.at[c / 2];
            second = second + pair_at(X + size + c) * factor.at[c / 2];
        }
        put_pair(pair_at(y + r) + (Pair{first[0], second[0]} + Pair{first[1], second[1]}), y + r);
    }
}
// y += X' x
template <int size>
void add_transposed_product(const double* X, const double* x, double* y) {
    Pairs<size> sum(y);
    for (int r = 0; r < size; ++r, X += size) {
        const Pair factor{x[r], x[r]};
        for (int c = 0; c < size; c += 2) sum.at[c / 2] = sum.at[c / 2] + factor * pair_at(X + c);
    }
    for (int c = 0; c < size; c += 2) put_pair(sum.at[c / 2], y + c);
}
// y += X x with a symmetric X, of which each row holds the pairs from the diagonal on.
template <int size>
void add_symmetric_product(const double* X, const double* x, double* y) {
    const Pairs<size> factor(x);
    Pairs<size> sum(y);
    for (int r = 0; r < size; r += 2) {
        const double *above = X + r * size, *below = above + size;
        const Pair first{x[r], x[r]}, second{x[r + 1], x[r + 1]};
        Pair along = first * pair_at(above + r), beside = second * pair_at(below + r);
        sum.at[r / 2] = sum.at[r / 2] + (along + beside);
        if (r + 2 == size) break;
        along = beside = Pair{0.0, 0.0};
        for (int c = r + 2; c < size; c += 2) {
            const Pair upper = pair_at(above + c), lower = pair_at(below + c);
            sum.at[c / 2] = sum.at[c / 2] + (first * upper + second * lower);
            along = along + upper * factor.at[c / 2];
            beside = beside + lower * factor.at[c / 2];
        }
        sum.at[r / 2] = sum.at[r / 2] + (Pair{along[0], beside[0]} + Pair{along[1], beside[1]});
    }
    for (int c = 0; c < size; c += 2) put_pair(sum.at[c / 2], y + c);
}

// The matrix of an inertia, in pairs along its rows.
struct InertiaRows {
    explicit InertiaRows(const Inertia<double>& I)
        : at{{{I.mass, 0.0}, {0.0, 0.0}, {I.moment.z, -I.moment.y}},
             {{0.0, I.mass}, {0.0, -I.moment.z}, {0.0, I.moment.x}},
             {{0.0, 0.0}, {I.mass, I.moment.y}, {-I.moment.x, 0.0}},
             {{0.0, -I.moment.z}, {I.moment.y, I.second.xx}, {I.second.xy, I.second.xz}},
             {{I.moment.z, 0.0}, {-I.moment.x, I.second.xy}, {I.second.yy, I.second.yz}},
             {{-I.moment.y, I.moment.x}, {0.0, I.second.xz}, {I.second.yz, I.second.zz}}} {}
    Pair at[6][3];
};

// The pairs that a matrix holds: all, or those from the diagonal on if it is symmetric.
enum class Kept { all, upper };

// Overwrites X by X - u l', with each pair (r, c) mapped by `finished`, in one pass, since the next body needs it.
template <int size, Kept kept, int r = 0, class Finished>
void replace(const double* u, const Pairs<size>& l, const Finished& finished, double* X) {
    if constexpr (r < size) {
        const Pair factor{u[r], u[r]};
        for (int c = kept == Kept::upper ? r & ~1 : 0; c < size; c += 2)
            put_pair(finished(pair_at(X + c) - factor * l.at[c / 2], r, c), X + c);
        replace<size, kept, r + 1>(u, l, finished, X + size);
    }
}

// Adds s I to a part of a matrix with rows of length `stride`.
inline void add_inertia(double s, const InertiaRows& I, int stride, double* x) {
    const Pair scale{s, s};
    for (int r = 0; r < 6; ++r, x += stride) {
        for (int c = 0; c < 3; ++c) put_pair(pair_at(x + 2 * c) + scale * I.at[r][c], x + 2 * c);
    }
}

// Joints above an origin are prismatic: they need only linear parts, which are independent of the reference point.
// `linear` tells whether an entry is a linear part.
template <int size>
constexpr bool linear(int entry) {
    return entry < 9 ? entry % 6 < 3 && (size == 12 || entry < 6) : false;
}
template <int size>
void keep_linear(double* z) {
    for (int r = 0; r < size; ++r) {
        if (!linear<size>(r)) z[r] = 0.0;
    }
}
template <int size>
void keep_linear_rows(double* X) {
    for (int r = 0; r < size; ++r) {
        if (linear<size>(r)) {
            keep_linear<size>(X + r * size);
        } else {
            std::fill(X + r * size, X + (r + 1) * size, 0.0);
        }
    }
}

}  // namespace detail

// The factors of M + diag(armature) at consecutive configurations.
class ArticulatedBodies {
  public:
    explicit ArticulatedBodies(const Tree& tree) : ArticulatedBodies(tree, std::make_shared<Gathering>(tree)) {}
    ArticulatedBodies(const Tree& tree, const std::shared_ptr<const Gathering>& order)
        : tree_(&tree), body_(tree.size()), inertia_(order, 36), force_(order, 6), motion_(6 * (tree.size() + 1)) {
        if (order->ties.slots > 0) tied_.emplace(tree, order, 6);
    }

    // Factor M at q, with potential energies in `jet`; false at a pivot that is not positive.
    bool at(const Mechanism& mechanism, const double* q, Jet<double>& jet) {
        const auto visit = [&](int j) { set_body(j, tree_->bodies[j].ratio * jet.body[j].axis, jet.body[j].inertia); };
        inertias(mechanism, q, jet, visit, [](int) {});
        for (int j = tree_->size() - 1; j >= 0; --j) {
            if (!eliminate(j)) return false;
        }
        return true;
    }

    // Set the axis and the inertia of body j alone.
    void set_body(int j, const Motion<double>& axis, const Inertia<double>& inertia) {
        detail::write(axis, body_[j].axis);
        body_[j].inertia = inertia;
        if (!tied_) return;
        detail::write(axis, tied_->row(j));
    }

    // Eliminate body j, from the last body to the first; false at a pivot that is not positive. Here and below, the
    // attribute `flatten` inlines all calls in the loop over bodies, which saves a tenth of a step.
    [[gnu::flatten]] bool eliminate(int j) {
        const Body& link = tree_->bodies[j];
        State& state = body_[j];
        if (tied_) {
            detail::write(state.inertia * detail::motion_at(state.axis), tied_->u());
            return tied_->eliminate(j, tree_->armature.data(), [&state](double* X, int width) {
                detail::add_inertia(1.0, detail::InertiaRows(state.inertia), width, X);
            });
        }
        double* X = inertia_.of(j);
        detail::write(state.inertia * detail::motion_at(state.axis), state.u);
        detail::add_symmetric_product<6>(X, state.axis, state.u);
        state.pivot = tree_->armature[link.coordinate] + detail::product<6>(state.axis, state.u);
        if (!(state.pivot > 0.0)) return false;
        const double inverse = 1.0 / state.pivot;
        for (int r = 0; r < 6; ++r) state.answer[r] = state.u[r] * inverse;
        if (link.parent < 0) return true;
        const detail::InertiaRows inertia(state.inertia);
        detail::replace<6, detail::Kept::upper>(
            state.answer, detail::Pairs<6>(state.u),
            [&](Pair rest, int r, int c) { return rest + inertia.at[r][c / 2]; }, X);
        if (link.origin) detail::keep_linear_rows<6>(X);
        inertia_.hand_on(j, link.parent);
        return true;
    }

    // The inertia of a body's coordinate with its subtree free [kg m^2 or kg].
    double pivot(int body) const { return body_[body].pivot; }

    // x with (M + diag(armature)) x = b; x may be b. `share`, unless null, receives the terms of 1/2 b . x, which are
    // not negative: left^2 / (2 pivot), with `left` the remainder of b_i when the subtree of coordinate i is free.
    void solve(const double* b, double* x, double* share) {
        if (tied_) return tied_->solve(b, x, share);
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const State& state = body_[j];
            double* z = force_.of(j);
            const int c = link.coordinate;
            const double left = b[c] - detail::product<6>(state.axis, z);
            x[c] = left / state.pivot;
            if (share) share[c] = 0.5 * left * x[c];
            if (link.parent < 0) continue;
            detail::write_sum<6>(z, left, state.answer, z);
            if (link.origin) detail::keep_linear<6>(z);
            force_.hand_on(j, link.parent);
        }
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const State& state = body_[j];
            const double* above = &motion_[6 * (link.parent + 1)];  // zero for a root
            x[link.coordinate] -= detail::product<6>(state.answer, above);
            detail::write_sum<6>(above, x[link.coordinate], state.axis, &motion_[6 * (j + 1)]);
        }
    }

  private:
    struct State {
        double axis[6] = {};  // S
        Inertia<double> inertia{};
        double u[6] = {}, answer[6] = {};  // X S, and X S / pivot
        double pivot = 0.0;
    };

    const Tree* tree_;
    std::vector<State> body_;
    detail::Gathered inertia_, force_;
    std::vector<double> motion_;                // (b + 1, 6) of each body, after a zero for the base
    std::optional<SymmetricElimination> tied_;  // for coordinates that move several bodies
};

// The data of a body that elimination needs from a sweep of first order.
struct EliminatedBody {
    Inertia<double> inertia{};  // of the body alone
    Motion<double> axis{};      // S
    Motion<double> rate{};      // W
    Force<double> turned{};     // S x* H
    Vec3<double> lifted{};      // g x (Y S)(linear)

    static EliminatedBody of(const Mechanism& mechanism, int j, const Jet<double>& jet) {
        const Body& link = mechanism.tree.bodies[j];
        const auto& here = jet.body[j];
        EliminatedBody made;
        made.inertia = placed(here.rotation, here.position, link.mass, link.center, link.inertia);
        made.axis = link.ratio * here.axis;
        made.rate = link.ratio * here.axis_rate;
        made.turned = cross(made.axis, here.momentum);
        made.lifted = cross(mechanism.gravity,
                            here.inertia.mass * made.axis.linear + cross(made.axis.angular, here.inertia.moment));
        return made;
    }

    // The body's entry of (A' + ha L_qq) x. `rate_of_x` is ha x of its coordinate, `moved` and `above` are the motions
    // of the body and its parent, nine entries each, and z is the sum of its children, to which the body is added.
    double change_of_slope(double rate_of_x, const double* moved, const double* above, double* z) const {
        double added[10];
        detail::write_padded(inertia * detail::motion_at(moved) + rate_of_x * turned, rate_of_x * lifted, added);
        for (int r = 0; r < 9; ++r) z[r] += added[r];
        const Force<double> force{{z[0], z[1], z[2]}, {z[3], z[4], z[5]}};
        const Vec3<double> lift{z[6], z[7], z[8]}, turn{above[6], above[7], above[8]};
        return dot(rate, force) - dot(axis.angular, lift) + dot(detail::motion_at(above), turned) - dot(turn, lifted);
    }
};

// The matrix of a midpoint step, (E1) and (E2), and its symmetric part, at consecutive (q, v): factored and solved with
// by (E3).
class Elimination {
  public:
    explicit Elimination(const Mechanism& mechanism)
        : Elimination(mechanism, std::make_shared<Gathering>(mechanism.tree)) {}

    // Set the state from a sweep of first order.
    void take(const Jet<double>& jet) {
        for (int j = 0; j < tree_->size(); ++j) body_[j] = EliminatedBody::of(*mechanism_, j, jet);
    }

    // Factor N; false at a pivot that is not positive.
    [[gnu::flatten]] bool factor(double ahead, double behind, const double* diagonal) {
        ahead_ = ahead;
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const EliminatedBody& state = body_[j];
            Factors& factors = factors_[j];
            const Motion<double> row = state.axis + (-behind) * state.rate, column = state.axis + ahead * state.rate;
            detail::write_padded(row, behind * state.axis.angular, factors.row);
            detail::write_padded(column, ahead * state.axis.angular, factors.column);
            detail::write_padded(state.inertia * column + ahead * state.turned, ahead * state.lifted, factors.u);
            detail::write_padded(state.inertia * row + (-behind) * state.turned, behind * state.lifted, factors.l);
            double* X = matrix_.of(j);
            detail::add_product<width>(X, factors.column, factors.u);
            factors.pivot = diagonal[link.coordinate] + detail::product<width>(factors.row, factors.u);
            if (!(factors.pivot > 0.0)) return false;
            if (link.parent < 0) {
                std::fill(factors.l, factors.l + width, 0.0);
                continue;
            }
            detail::add_transposed_product<width>(X, factors.row, factors.l);
            const double inverse = 1.0 / factors.pivot;
            for (double& entry : factors.l) entry *= inverse;
            const detail::InertiaRows inertia(state.inertia);
            detail::replace<width, detail::Kept::all>(
                factors.u, detail::Pairs<width>(factors.l),
                [&](Pair rest, int r, int c) { return r < 6 && c < 6 ? rest + inertia.at[r][c / 2] : rest; }, X);
            if (link.origin) detail::keep_linear_rows<width>(X);
            matrix_.hand_on(j, link.parent);
        }
        return true;
    }

    // x with N x = b.
    void solve(const double* b, double* x) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const Factors& factors = factors_[j];
            double* z = force_.of(j);
            const double t = (b[link.coordinate] - detail::product<width>(factors.row, z)) / factors.pivot;
            x[link.coordinate] = t;
            if (link.parent < 0) continue;
            detail::write_sum<width>(z, t, factors.u, z);
            if (link.origin) detail::keep_linear<width>(z);
            force_.hand_on(j, link.parent);
        }
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const Factors& factors = factors_[j];
            const double* above = motion_above(j);
            x[link.coordinate] -= detail::product<width>(factors.l, above);
            detail::write_sum<width>(above, x[link.coordinate], factors.column, &motion_[width * (j + 1)]);
        }
    }

    // y = (A' + ha L_qq) x for the x of the last `solve`.
    void change_of_slope(const double* x, double* y) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            double* z = force_.of(j);
            const double* moved = motion_.data() + width * (j + 1);
            const double rate_of_x = ahead_ * x[link.coordinate];
            y[link.coordinate] = body_[j].change_of_slope(rate_of_x, moved, motion_above(j), z);
            if (link.parent < 0) continue;
            if (link.origin) detail::keep_linear<width>(z);
            force_.hand_on(j, link.parent);
        }
    }

    // x' M x, armature included.
    double kinetic_size(const double* x) {
        double total = 0.0;
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            moved_[j] = x[link.coordinate] * body_[j].axis;
            if (link.parent >= 0) moved_[j] += moved_[link.parent];
            total += dot(moved_[j], body_[j].inertia * moved_[j]);
        }
        for (int c = 0; c < tree_->dof(); ++c) total += tree_->armature[c] * x[c] * x[c];
        return total;
    }

    // The smallest ratio of a pivot of M + c (A + A') - k L_qq + diag(d) to the same pivot of M, armature included; 0
    // if one is not positive. The factors of `factor` are kept.
    [[gnu::flatten]] double least_pivot_ratio(double c, double k, const double* diagonal) {
        double least = std::numeric_limits<double>::infinity();
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const EliminatedBody& state = body_[j];
            double row[12], u[12], answer[12];
            detail::write(state.axis, row);
            detail::write(state.rate, row + 6);
            const Force<double> by_axis = state.inertia * state.axis,
                                by_rate = state.inertia * state.rate + state.turned;
            detail::write(by_axis + c * by_rate + Force<double>{{}, k * state.lifted}, u);
            detail::write(c * by_axis + (-k) * by_rate, u + 6);
            double* X = symmetric_.of(j);
            detail::add_symmetric_product<12>(X, row, u);
            const double pivot = diagonal[link.coordinate] + detail::product<12>(row, u);
            masses_.set_body(j, state.axis, state.inertia);
            if (!(pivot > 0.0) || !masses_.eliminate(j)) return 0.0;
            least = std::min(least, pivot / masses_.pivot(j));
            if (link.parent < 0) continue;
            const double inverse = 1.0 / pivot;
            for (int r = 0; r < 12; ++r) answer[r] = u[r] * inverse;
            const detail::InertiaRows inertia(state.inertia);
            const Pair scale[2][2] = {{{1.0, 1.0}, {c, c}}, {{c, c}, {-k, -k}}};
            detail::replace<12, detail::Kept::upper>(
                answer, detail::Pairs<12>(u),
                [&](Pair rest, int r, int e) { return rest + scale[r / 6][e / 6] * inertia.at[r % 6][e % 6 / 2]; }, X);
            if (link.origin) detail::keep_linear_rows<12>(X);
            symmetric_.hand_on(j, link.parent);
        }
        return least;
    }

  private:
    Elimination(const Mechanism& mechanism, const std::shared_ptr<const Gathering>& order)
        : mechanism_(&mechanism),
          tree_(&mechanism.tree),
          body_(mechanism.tree.size()),
          moved_(mechanism.tree.size()),
          factors_(mechanism.tree.size()),
          matrix_(order, width * width),
          symmetric_(order, 144),
          force_(order, width),
          motion_(width * (mechanism.tree.size() + 1)),
          masses_(mechanism.tree, order) {}

    static constexpr int width = 10;  // nine entries and a zero

    struct Factors {
        double row[width] = {}, column[width] = {};
        double u[width] = {}, l[width] = {};  // l divided by the pivot
        double pivot = 0.0;
    };

    const double* motion_above(int j) const { return motion_.data() + width * (tree_->bodies[j].parent + 1); }

    const Mechanism* mechanism_;
    const Tree* tree_;
    std::vector<EliminatedBody> body_;
    std::vector<Motion<double>> moved_;  // of each body, for some x
    std::vector<Factors> factors_;
    detail::Gathered matrix_, symmetric_, force_;
    std::vector<double> motion_;  // (b + 1, 10) of each body for the x of `solve`, after a zero for the base
    double ahead_ = 0.0;
    ArticulatedBodies masses_;
};

}  // namespace varpin
