// Solves with the matrix of a step by elimination from the leaves to the roots, without forming the matrix: the work is
// proportional to the number of bodies. docs/mathematics.md, "Linear in the number of joints"; equations (E1) to (E4).
// Here a joint has one unknown for each stage c, and its rows and columns nine entries for each:
//
//     row_i = (delta_ic S - h abar_ic W, h abar_ic S(angular))_c      u0_m = h a_cm (S x* H, g x (Y S)(linear))_c
//     column_m = (delta_cm S + h a_cm W, h a_cm S(angular))_c         l0_i = -h abar_ic (S x* H, -g x (Y S)(linear))_c
//
// After elimination of the subtree below j, its force for a motion w is X w + z, and u = X column + u0, l = X' row +
// l0, D = d + row . u is a matrix (s, s). The symmetric part is eliminated in the same way with rows and columns (S,
// W).
#pragma once

#include <algorithm>
#include <limits>
#include <memory>
#include <type_traits>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/elimination_rows.hpp"
#include "varpin/jet.hpp"
#include "varpin/mechanism.hpp"
#include "varpin/spatial.hpp"
#include "varpin/subtree_sums.hpp"
#include "varpin/symmetric_elimination.hpp"
#include "varpin/tableau.hpp"

namespace varpin {

// Model of computing times, in units of the time to eliminate a body in a step with one stage. A dense step takes
// body_cost for each body, pair_cost for each pair of a body and itself or an ancestor, and block_cost times the cubed
// size of each block. Elimination of a body takes stages_cost with more stages, mimic_cost with one stage and mimic
// joints, and a share of slot_cost more for each slot of mimic joints. Measured on chains with and without mimic
// joints, on hands and on arms.
inline constexpr double body_cost = 0.6, pair_cost = 0.033, block_cost = 0.0004, stages_cost = 1.3, mimic_cost = 1.45,
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
    const int slots = Mimics(tree).slots;
    const double cost = stages > 1 ? stages_cost : slots > 0 ? mimic_cost : 1.0;
    return cost * (1.0 + slot_cost * slots) * tree.size() < dense;
}

// Couplings fill entries of a step's matrix for which elimination has no form.
inline bool eliminates(const Mechanism& mechanism, int stages) {
    return !mechanism.couplings.any() && eliminates(mechanism.tree, stages);
}

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
    double change_of_force(double rate_of_x, const double* moved, const double* above, double* z) const {
        double added[10];
        detail::write_padded(inertia * detail::motion_at(moved) + rate_of_x * turned, rate_of_x * lifted, added);
        for (int r = 0; r < 9; ++r) z[r] += added[r];
        const Force<double> force{{z[0], z[1], z[2]}, {z[3], z[4], z[5]}};
        const Vec3<double> lift{z[6], z[7], z[8]}, turn{above[6], above[7], above[8]};
        return dot(rate, force) - dot(axis.angular, lift) + dot(detail::motion_at(above), turned) - dot(turn, lifted);
    }
};

// The matrix of a step, the sum over stages of (E1) and (E2): factored and solved with by (E3), at consecutive (q, v).
class StepElimination {
  public:
    static constexpr int most_stages = 16;

    virtual ~StepElimination() = default;
    // Set the state of stage c from its sweep of first order.
    virtual void take(int c, const Jet<double>& jet) = 0;
    // Factor N with diagonals d (s, s, n), armature included; false if its determinant, or with one stage a pivot, is
    // not positive.
    virtual bool factor(double h, const double* diagonal) = 0;
    // x with N x = b, both (s, n).
    virtual void solve(const double* b, double* x) = 0;
    // y_c = A_c' x_c + L_qq,c h sum_m a_cm x_m, (s, n), for the x of the last `solve`.
    virtual void change_of_force(const double* x, double* y) = 0;
    // sum_c b_c x_c' M_c x_c, armature included.
    virtual double kinetic_size(const double* x) = 0;
    // The smallest ratio of a pivot of M + c (A + A') - k L_qq + diag(d) to the same pivot of M, armature included, all
    // averaged over the stages with b; 0 if one is not positive. The factors of `factor` are kept.
    virtual double least_pivot_ratio(double coupling, double k, const double* diagonal) = 0;
};

// The same for numbers that the compiler knows, one stage without mimic joints, or does not.
template <class Stages, class Width, class Mass, class Curved>
class SizedElimination final : public StepElimination {
  public:
    SizedElimination(const Mechanism& mechanism, const Tableau& tableau,
                     const std::shared_ptr<const SubtreeOrder>& order)
        : mechanism_(&mechanism),
          tree_(&mechanism.tree),
          tableau_(&tableau),
          stages_(tableau.stages),
          order_(order),
          bodies_(9 * stages_),
          width_(detail::even(bodies_ + stages_ * order->mimics.slots)),
          state_(tree_->size() * stages_),
          matrix_(order, width_ * width_),
          force_(order, width_),
          twist_(tree_->size()),
          rows_(stages_),
          curved_(*tree_, order, 12 * stages_),
          masses_(*tree_, order, 6 * stages_) {}

    void take(int c, const Jet<double>& jet) override {
        for (int j = 0; j < tree_->size(); ++j) state_[j * stages_ + c] = EliminatedBody::of(*mechanism_, j, jet);
    }

    [[gnu::flatten]] bool factor(double h, const double* diagonal) override {
        h_ = h;
        diagonal_ = diagonal;
        sign_ = 1;
        for (int j = tree_->size() - 1; j >= 0 && sign_ != 0; --j) eliminate(j);
        if (slots() > 0) eliminate_mimics(-1, matrix_.of_ground());
        return sign_ > 0;
    }

    [[gnu::flatten]] void solve(const double* b, double* x) override {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            double* z = force_.of(j);
            const int c = link.coordinate, slot = slot_of(c);
            double along[most_stages];
            for (int i = 0; i < stages_; ++i) along[i] = detail::product(width_, factors(j).row + i * width_, z);
            if (slot < 0) {
                substitute(c, j, b, along, z, x);
            } else {
                for (int i = 0; i < stages_; ++i) z[at(slot) + i] += along[i];
            }
            if (link.parent < 0 && slots() == 0) continue;
            if (slots() > 0) substitute_mimics(j, b, z, x);
            if (link.origin) detail::keep_linear(bodies_, 9, z);
            force_.hand_on(j, link.parent);
        }
        if (slots() > 0) substitute_mimics(-1, b, force_.of_ground(), x), move_mimics(-1, x);
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const double* above = motion(link.parent);
            double* moved = motion(j);
            if (slots() > 0) {
                std::copy(above, above + width_, moved);
                move_mimics(j, x);
                above = moved;
            }
            if (slot_of(link.coordinate) < 0) find(link.coordinate, j, above, x);
            for (int m = 0; m < stages_; ++m)
                detail::write_sum(width_, m == 0 ? above : moved, x[m * tree_->dof() + link.coordinate],
                                  factors(j).column + m * width_, moved);
        }
    }

    void change_of_force(const double* x, double* y) override {
        const int n = tree_->dof();
        std::fill(y, y + stages_ * n, 0.0);
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            double* z = force_.of(j);
            for (int c = 0; c < stages_; ++c) {
                const EliminatedBody& state = state_[j * stages_ + c];
                const double *moved = motion(j) + 9 * c, *above = motion(link.parent) + 9 * c;
                double rate_of_x = 0.0;
                for (int m = 0; m < stages_; ++m)
                    rate_of_x += h_ * tableau_->a[c * stages_ + m] * x[m * n + link.coordinate];
                y[c * n + link.coordinate] += state.change_of_force(rate_of_x, moved, above, z + 9 * c);
            }
            if (link.parent < 0) continue;
            if (link.origin) detail::keep_linear(bodies_, 9, z);
            force_.hand_on(j, link.parent);
        }
    }

    double kinetic_size(const double* x) override {
        double total = 0.0;
        for (int c = 0; c < stages_; ++c) {
            const double* x_stage = x + c * tree_->dof();
            double size = 0.0;
            for (int j = 0; j < tree_->size(); ++j) {
                const Body& link = tree_->bodies[j];
                const EliminatedBody& state = state_[j * stages_ + c];
                twist_[j] = x_stage[link.coordinate] * state.axis;
                if (link.parent >= 0) twist_[j] += twist_[link.parent];
                size += dot(twist_[j], state.inertia * twist_[j]);
            }
            for (int k = 0; k < tree_->dof(); ++k) size += tree_->armature[k] * x_stage[k] * x_stage[k];
            total += tableau_->b[c] * size;
        }
        return total;
    }

    [[gnu::flatten]] double least_pivot_ratio(double coupling, double k, const double* diagonal) override {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            for (int c = 0; c < stages_; ++c) {
                const EliminatedBody& state = state_[j * stages_ + c];
                const double b = tableau_->b[c];
                const Force<double> by_axis = state.inertia * state.axis,
                                    by_rate = state.inertia * state.rate + state.turned;
                detail::write(state.axis, masses_.row(j) + 6 * c);
                detail::write(b * by_axis, masses_.u() + 6 * c);
                detail::write(state.axis, curved_.row(j) + 12 * c);
                detail::write(state.rate, curved_.row(j) + 12 * c + 6);
                detail::write(b * (by_axis + coupling * by_rate + Force<double>{{}, k * state.lifted}),
                              curved_.u() + 12 * c);
                detail::write(b * (coupling * by_axis + (-k) * by_rate), curved_.u() + 12 * c + 6);
            }
            const auto inertia = [&](int c) { return detail::InertiaRows(state_[j * stages_ + c].inertia); };
            const double* b = tableau_->b.data();
            if (!masses_.eliminate(j, tree_->armature.data(), detail::OwnInertia{inertia, stages_, b, 6, 0.0, 0.0}))
                return 0.0;
            if (!curved_.eliminate(j, diagonal, detail::OwnInertia{inertia, stages_, b, 12, coupling, k})) return 0.0;
        }
        double least = std::numeric_limits<double>::infinity();
        for (int c = 0; c < tree_->dof(); ++c) least = std::min(least, curved_.pivot(c) / masses_.pivot(c));
        return least;
    }

  private:
    // Factors of one body: (s, width), and the inverse of D (s, s), or D itself with one stage. l is multiplied by this
    // inverse. u, l and D of a mimic coordinate are stored with the first body that it moves.
    struct Factors {
        double *row, *column, *u, *l, *inverse;
    };

    int factor_size() const { return 4 * stages_ * width_ + stages_ * stages_; }
    Factors factors(int j) {
        double* at = factors_.data() + j * factor_size();
        const int size = stages_ * width_;
        return {at, at + size, at + 2 * size, at + 3 * size, at + 4 * size};
    }
    double* motion(int j) { return motion_.data() + width_ * (j + 1); }

    int slots() const { return std::is_same_v<Width, int> ? order_->mimics.slots : 0; }
    int slot_of(int coordinate) const { return std::is_same_v<Width, int> ? order_->mimics.slot[coordinate] : -1; }
    int at(int slot) const { return bodies_ + slot * stages_; }

    void eliminate(int j) {
        const Body& link = tree_->bodies[j];
        const Factors factors_here = factors(j);
        write_rows(j, factors_here);
        double* X = matrix_.of(j);
        for (int m = 0; m < stages_; ++m) {
            detail::add_product(width_, X, factors_here.column + m * width_, factors_here.u + m * width_);
            detail::add_transposed_product(width_, X, factors_here.row + m * width_, factors_here.l + m * width_);
        }
        for (int i = 0; i < stages_; ++i) {
            for (int m = 0; m < stages_; ++m)
                lu_[i * stages_ + m] =
                    detail::product(width_, factors_here.row + i * width_, factors_here.u + m * width_);
        }
        const int slot = slot_of(link.coordinate);
        const auto inertia = [&](int c) { return detail::InertiaRows(state_[j * stages_ + c].inertia); };
        const detail::OwnInertia own{inertia, stages_, nullptr, 9, 0.0, 0.0};
        if (slot < 0) {
            const bool last = link.parent < 0 && slots() == 0;
            take_out(link.coordinate, factors_here, own, last ? nullptr : X);
            if (sign_ == 0 || last) return;
        } else {
            for (int m = 0; m < stages_; ++m) {
                for (int r = 0; r < width_; ++r) X[r * width_ + at(slot) + m] += factors_here.u[m * width_ + r];
            }
            for (int i = 0; i < stages_; ++i) {
                double* line = X + (at(slot) + i) * width_;
                detail::write_sum(width_, line, 1.0, factors_here.l + i * width_, line);
                for (int m = 0; m < stages_; ++m) line[at(slot) + m] += lu_[i * stages_ + m];
            }
        }
        if constexpr (std::is_same_v<Width, int>) own.add(X, width_);
        if (slots() > 0) eliminate_mimics(j, X);
        if (link.origin) detail::keep_linear_rows(bodies_, 9, width_, X);
        matrix_.hand_on(j, link.parent);
    }

    // Add the bodies of mimic joints that end at body j to X, and eliminate their coordinates, (E4).
    void eliminate_mimics(int j, double* X) {
        for (const Mimics::Mimic& mimic : order_->mimics.ending(j)) {
            if (sign_ == 0) return;
            const Factors factors_here = factors(mimic.body);
            const int slot = at(mimic.slot);
            for (int i = 0; i < stages_; ++i) {
                const double* line = X + (slot + i) * width_;
                std::copy(line + slot, line + slot + stages_, &lu_[i * stages_]);
                std::copy(line, line + width_, factors_here.l + i * width_);
                for (int r = 0; r < width_; ++r) factors_here.u[i * width_ + r] = X[r * width_ + slot + i];
            }
            for (int i = 0; i < stages_; ++i) {
                for (double* x : {factors_here.u, factors_here.l}) std::fill_n(x + i * width_ + slot, stages_, 0.0);
            }
            take_out(mimic.coordinate, factors_here, detail::NoInertia{}, X);
            detail::clear_slot(slot, stages_, width_, X);
        }
    }

    // Eliminate coordinate c with its u, l and D, to which its diagonal is added; updates sign_ by that of det D.
    template <class Own>
    void take_out(int c, const Factors& factors_here, const Own& own, double* X) {
        for (int k = 0; k < stages_ * stages_; ++k) lu_[k] += diagonal_[k * tree_->dof() + c];
        if (stages_ == 1) {
            sign_ = lu_[0] > 0.0;
            if (sign_ == 0) return;
            factors_here.inverse[0] = lu_[0];
            const double inverse = 1.0 / lu_[0];
            for (int r = 0; r < width_; ++r) factors_here.l[r] *= inverse;
        } else {
            sign_ *= factor_lu_pivoting(lu_.data(), stages_, rows_.data());
            if (sign_ == 0) return;
            invert(factors_here.inverse);
            for (int r = 0; r < width_; ++r) {
                double small[most_stages];
                for (int i = 0; i < stages_; ++i) small[i] = factors_here.l[i * width_ + r];
                for (int m = 0; m < stages_; ++m) {
                    double total = 0.0;
                    for (int i = 0; i < stages_; ++i) total += factors_here.inverse[m * stages_ + i] * small[i];
                    factors_here.l[m * width_ + r] = total;
                }
            }
        }
        for (int m = 0; m < stages_ && X; ++m)
            detail::subtract_outer<detail::Kept::all>(width_, factors_here.u + m * width_, factors_here.l + m * width_,
                                                      own, X);
    }

    // t = D^-1 (b - along) of coordinate c into x; adds u t to z.
    void substitute(int c, int body, const double* b, const double* along, double* z, double* x) {
        const int n = tree_->dof();
        const Factors own = factors(body);
        double left[most_stages];
        for (int i = 0; i < stages_; ++i) left[i] = b[i * n + c] - along[i];
        for (int m = 0; m < stages_; ++m) {
            double t = 0.0;
            for (int i = 0; i < stages_; ++i) t += own.inverse[m * stages_ + i] * left[i];
            if (stages_ == 1) t = left[0] / own.inverse[0];
            x[m * n + c] = t;
            detail::write_sum(width_, z, t, own.u + m * width_, z);
        }
    }
    void substitute_mimics(int j, const double* b, double* z, double* x) {
        for (const Mimics::Mimic& mimic : order_->mimics.ending(j)) {
            double* kept = z + at(mimic.slot);
            double along[most_stages];
            std::copy(kept, kept + stages_, along);
            substitute(mimic.coordinate, mimic.body, b, along, z, x);
            std::fill(kept, kept + stages_, 0.0);
        }
    }

    // x = t - l . w_parent
    void find(int c, int body, const double* above, double* x) {
        for (int m = 0; m < stages_; ++m)
            x[m * tree_->dof() + c] -= detail::product(width_, factors(body).l + m * width_, above);
    }
    // In the order opposite to elimination.
    void move_mimics(int j, double* x) {
        const std::vector<Mimics::Mimic>& ending = order_->mimics.ending(j);
        for (auto mimic = ending.rbegin(); mimic != ending.rend(); ++mimic) {
            find(mimic->coordinate, mimic->body, motion(j), x);
            for (int m = 0; m < stages_; ++m) motion(j)[at(mimic->slot) + m] = x[m * tree_->dof() + mimic->coordinate];
        }
    }

    // Rows and columns of body j, and the parts of u and l from its own inertia.
    void write_rows(int j, const Factors& factors_here) const {
        for (int i = 0; i < stages_; ++i) {
            for (int c = 0; c < stages_; ++c) {
                const EliminatedBody& state = state_[j * stages_ + c];
                const double there = i == c ? 1.0 : 0.0;
                const double ahead = h_ * tableau_->a[c * stages_ + i];
                const double behind = h_ * tableau_->gradient[i * stages_ + c];
                const int at = i * width_ + 9 * c;
                const Motion<double> row = there * state.axis + (-behind) * state.rate;
                const Motion<double> column = there * state.axis + ahead * state.rate;
                detail::write(row, behind * state.axis.angular, factors_here.row + at);
                detail::write(column, ahead * state.axis.angular, factors_here.column + at);
                detail::write(state.inertia * column + ahead * state.turned, ahead * state.lifted, factors_here.u + at);
                detail::write(state.inertia * row + (-behind) * state.turned, behind * state.lifted,
                              factors_here.l + at);
            }
            for (double* x : {factors_here.row, factors_here.column, factors_here.u, factors_here.l})
                std::fill(x + i * width_ + bodies_, x + (i + 1) * width_, 0.0);
        }
    }

    // The inverse (s, s) of the matrix whose factors are in lu_.
    void invert(double* inverse) {
        for (int m = 0; m < stages_; ++m) {
            double column[most_stages], unit[most_stages] = {};
            unit[m] = 1.0;
            solve_lu_pivoting(lu_.data(), stages_, rows_.data(), unit, column);
            for (int i = 0; i < stages_; ++i) inverse[i * stages_ + m] = column[i];
        }
    }

    const Mechanism* mechanism_;
    const Tree* tree_;
    const Tableau* tableau_;
    Stages stages_;
    std::shared_ptr<const SubtreeOrder> order_;
    int bodies_;   // nine entries for each stage
    Width width_;  // plus one for each stage and slot of mimic joints, rounded up to an even number
    std::vector<EliminatedBody> state_;  // (b, s)
    std::vector<double> factors_ = zeros(tree_->size(), factor_size());
    detail::SubtreeSums matrix_, force_;
    std::vector<double> motion_ = zeros(width_, tree_->size() + 1);  // for the x of `solve`, after a zero for the base
    std::vector<Motion<double>> twist_;
    std::vector<double> lu_ = zeros(stages_, stages_);
    std::vector<int> rows_;
    SymmetricElimination<Curved> curved_;
    SymmetricElimination<Mass> masses_;
    double h_ = 0.0;
    int sign_ = 0;
    const double* diagonal_ = nullptr;
};

inline std::unique_ptr<StepElimination> elimination_of(const Mechanism& mechanism, const Tableau& tableau) {
    const auto order = std::make_shared<const SubtreeOrder>(mechanism.tree);
    if (tableau.stages == 1 && order->mimics.slots == 0)
        return std::make_unique<SizedElimination<Known<1>, Known<10>, Known<6>, Known<12>>>(mechanism, tableau, order);
    return std::make_unique<SizedElimination<int, int, int, int>>(mechanism, tableau, order);
}

}  // namespace varpin
