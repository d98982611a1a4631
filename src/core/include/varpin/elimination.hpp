// Solves with the matrix of a step of one stage by elimination from the leaves to the roots, without forming the
// matrix: the work is proportional to the number of bodies. docs/mathematics.md, "Linear in the number of joints";
// equations (E1) to (E3). Every body has a joint of its own, with nine entries, and a tenth of zero:
//
//     row = (S - h abar W, h abar S(angular))     u0 = h a (S x* H, g x (Y S)(linear))
//     column = (S + h a W, h a S(angular))        l0 = -h abar (S x* H, -g x (Y S)(linear))
//
// After elimination of the subtree below j, its force for a motion w is X w + z, and u = X column + u0, l = X' row +
// l0, D = d + row . u. The symmetric part is eliminated in the same way with rows and columns (S, W).
#pragma once

#include <algorithm>
#include <limits>
#include <vector>

#include "varpin/jet.hpp"
#include "varpin/mechanism.hpp"
#include "varpin/spatial.hpp"
#include "varpin/symmetric_elimination.hpp"
#include "varpin/tableau.hpp"

namespace varpin {

// Model of computing times, in units of the time to eliminate a body. A dense step takes body_cost for each body,
// pair_cost for each pair of a body and itself or an ancestor, and block_cost times the cubed size of each block.
// Measured on chains, hands and arms.
inline constexpr double body_cost = 0.6, pair_cost = 0.033, block_cost = 0.0004;

// Whether solves with M, or with the matrix of a step of one stage, are faster without forming the matrix. Mimic
// joints, by which bodies share a coordinate, have no elimination.
inline bool eliminates(const Tree& tree) {
    if (tree.size() != tree.dof()) return false;
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
    return tree.size() < dense;
}

// The data of a body that elimination needs from a sweep of first order.
struct EliminatedBody {
    Inertia<double> inertia{};  // of the body alone
    Motion<double> axis{};      // S
    Motion<double> rate{};      // W
    Force<double> turned{};     // S x* H
    Vec3<double> lifted{};      // g x (Y S)(linear)
};

// The matrix of a step, (E1) and (E2): factored and solved with by (E3), at consecutive (q, v).
class StepElimination {
  public:
    StepElimination(const Mechanism& mechanism, const Tableau& tableau)
        : mechanism_(&mechanism),
          tree_(&mechanism.tree),
          a_(tableau.a[0]),
          abar_(tableau.gradient[0]),
          state_(tree_->size()),
          factors_(tree_->size()),
          matrix_(*tree_, width * width),
          force_(*tree_, width),
          twist_(tree_->size()),
          curved_(*tree_),
          masses_(*tree_) {}

    // Set the state from a sweep of first order.
    void take(const Jet<double>& jet) {
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const auto& here = jet.body[j];
            EliminatedBody& own = state_[j];
            own.inertia = placed(here.rotation, here.position, link.mass, link.center, link.inertia);
            own.axis = link.ratio * here.axis;
            own.rate = link.ratio * here.axis_rate;
            own.turned = cross(own.axis, here.momentum);
            own.lifted = cross(mechanism_->gravity,
                               here.inertia.mass * own.axis.linear + cross(own.axis.angular, here.inertia.moment));
        }
    }

    // Factor N with diagonal d (n), armature included; false at a pivot that is not positive.
    [[gnu::flatten]] bool factor(double h, const double* diagonal) {
        h_ = h;
        const double ahead = h * a_, behind = h * abar_;
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const EliminatedBody& own = state_[j];
            auto& [row, column, u, l, D] = factors_[j];
            const Motion<double> left = own.axis + (-behind) * own.rate, right = own.axis + ahead * own.rate;
            detail::write(left, behind * own.axis.angular, row);
            detail::write(right, ahead * own.axis.angular, column);
            detail::write(own.inertia * right + ahead * own.turned, ahead * own.lifted, u);
            detail::write(own.inertia * left + (-behind) * own.turned, behind * own.lifted, l);
            double* X = matrix_.of(j);
            detail::add_product<width>(X, column, u);
            detail::add_transposed_product<width>(X, row, l);
            D = detail::product<width>(row, u) + diagonal[link.coordinate];
            if (!(D > 0.0)) return false;
            const double inverse = 1.0 / D;
            for (double& entry : l) entry *= inverse;
            if (link.parent < 0) continue;
            detail::replace<detail::Kept::all>(u, detail::Pairs<width>(l), detail::OwnInertia<width>(own.inertia), X);
            if (link.origin) detail::keep_linear_rows<width, 9>(X);
            matrix_.hand_on(j, link.parent);
        }
        return true;
    }

    // x with N x = b.
    [[gnu::flatten]] void solve(const double* b, double* x) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const Factors& own = factors_[j];
            double* z = force_.of(j);
            const double t = (b[link.coordinate] - detail::product<width>(own.row, z)) / own.D;
            x[link.coordinate] = t;
            detail::write_sum<width>(z, t, own.u, z);
            if (link.parent < 0) continue;
            if (link.origin) detail::keep_linear<width, 9>(z);
            force_.hand_on(j, link.parent);
        }
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const double* above = motion(link.parent);
            x[link.coordinate] -= detail::product<width>(factors_[j].l, above);
            detail::write_sum<width>(above, x[link.coordinate], factors_[j].column, motion(j));
        }
    }

    // A' x + L_qq h a x, for the x of the last `solve`.
    void change_of_force(const double* x, double* out) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const EliminatedBody& own = state_[j];
            const double *moved = motion(j), *above = motion(link.parent);
            const double rate_of_x = h_ * a_ * x[link.coordinate];
            double* z = force_.of(j);
            double added[width];
            detail::write(own.inertia * detail::motion_at(moved) + rate_of_x * own.turned, rate_of_x * own.lifted,
                          added);
            for (int r = 0; r < 9; ++r) z[r] += added[r];
            const Force<double> force{{z[0], z[1], z[2]}, {z[3], z[4], z[5]}};
            const Vec3<double> lift{z[6], z[7], z[8]}, turn{above[6], above[7], above[8]};
            out[link.coordinate] = dot(own.rate, force) - dot(own.axis.angular, lift) +
                                   dot(detail::motion_at(above), own.turned) - dot(turn, own.lifted);
            if (link.parent < 0) continue;
            if (link.origin) detail::keep_linear<width, 9>(z);
            force_.hand_on(j, link.parent);
        }
    }

    // x' M x, armature included.
    double kinetic_size(const double* x) {
        double size = 0.0;
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            twist_[j] = x[link.coordinate] * state_[j].axis;
            if (link.parent >= 0) twist_[j] += twist_[link.parent];
            size += dot(twist_[j], state_[j].inertia * twist_[j]);
        }
        for (int k = 0; k < tree_->dof(); ++k) size += tree_->armature[k] * x[k] * x[k];
        return size;
    }

    // The smallest ratio of a pivot of M + c (A + A') - k L_qq + diag(d) to the same pivot of M, armature included; 0
    // if one is not positive. The factors of `factor` are kept.
    [[gnu::flatten]] double least_pivot_ratio(double c, double k, const double* diagonal) {
        double least = std::numeric_limits<double>::infinity();
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const EliminatedBody& own = state_[j];
            const Force<double> by_axis = own.inertia * own.axis, by_rate = own.inertia * own.rate + own.turned;
            detail::write(own.axis, masses_.row(j));
            detail::write(by_axis, masses_.u());
            detail::write(own.axis, curved_.row(j));
            detail::write(own.rate, curved_.row(j) + 6);
            detail::write(by_axis + c * by_rate + Force<double>{{}, k * own.lifted}, curved_.u());
            detail::write(c * by_axis + (-k) * by_rate, curved_.u() + 6);
            if (!masses_.eliminate(j, tree_->armature.data(), detail::OwnInertia<6>(own.inertia))) return 0.0;
            if (!curved_.eliminate(j, diagonal, detail::OwnInertia<12>(own.inertia, c, k))) return 0.0;
            const int coordinate = tree_->bodies[j].coordinate;
            least = std::min(least, curved_.pivot(coordinate) / masses_.pivot(coordinate));
        }
        return least;
    }

  private:
    static constexpr int width = 10;

    // Of one body; l is divided by D.
    struct Factors {
        double row[width], column[width], u[width], l[width], D;
    };

    double* motion(int j) { return motion_.data() + width * (j + 1); }

    const Mechanism* mechanism_;
    const Tree* tree_;
    double a_, abar_;
    std::vector<EliminatedBody> state_;
    std::vector<Factors> factors_;
    SubtreeSums matrix_, force_;
    std::vector<double> motion_ = zeros(width, tree_->size() + 1);  // for the x of `solve`, after a zero for the base
    std::vector<Motion<double>> twist_;
    SymmetricElimination<12> curved_;
    SymmetricElimination<6> masses_;
    double h_ = 0.0;
};

}  // namespace varpin
