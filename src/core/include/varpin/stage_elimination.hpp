// Elimination (elimination.hpp) for collocation of more than one stage. docs/mathematics.md, "Linear in the number of
// joints". A joint has one unknown for each stage, and
//
//     N_im = delta_im M_i + h (a_im A_i - abar_im A_m') - h^2 sum_c abar_ic a_cm L_qq,c + diag(d_im)
//
// is a sum over stages c of what elimination.hpp has for one, with
//
//     row_i = (delta_ic S - h abar_ic W, h abar_ic S(angular))_c      u0_m = h a_cm (S x* H, g x (Y S)(linear))_c
//     column_m = (delta_cm S + h a_cm W, h a_cm S(angular))_c         l0_i = -h abar_ic (S x* H, -g x (Y S)(linear))_c
//
// all of nine entries for each c; D is a small matrix in place of a number.
#pragma once

#include <algorithm>
#include <limits>
#include <memory>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/elimination.hpp"
#include "varpin/jet.hpp"
#include "varpin/spatial.hpp"
#include "varpin/tableau.hpp"
#include "varpin/tree.hpp"

namespace varpin {

namespace detail {

// Functions of vectors of even size.
inline double product(int size, const double* a, const double* b) {
    double even = 0.0, odd = 0.0;
    for (int c = 0; c < size; c += 2) {
        even += a[c] * b[c];
        odd += a[c + 1] * b[c + 1];
    }
    return even + odd;
}
inline void add_scaled(int size, double factor, const double* a, double* __restrict b) {
    for (int c = 0; c < size; ++c) b[c] += factor * a[c];
}
// Entries that are no linear parts become zero, those being the first three of every `part`.
inline void keep_linear(int size, int part, double* z) {
    for (int r = 0; r < size; ++r) {
        if (r % part >= 3) z[r] = 0.0;
    }
}
inline void keep_linear_rows(int size, int part, double* X) {
    for (int r = 0; r < size; ++r) {
        if (r % part < 3) {
            keep_linear(size, part, X + r * size);
        } else {
            std::fill(X + r * size, X + (r + 1) * size, 0.0);
        }
    }
}

// A symmetric matrix of which pivots alone are asked for: u = X row + u0, D = d + row . u, X - u u' / D is handed on.
class Pivots {
  public:
    Pivots(int size, const std::shared_ptr<const Gathering>& order)
        : row(size), u(size), size_(size), matrix_(order, size * size) {}

    std::vector<double> row, u;  // u0, then u

    // The pivot of body j.
    double eliminate(int j, double diagonal) {
        double* X = matrix_.of(j);
        for (int r = 0; r < size_; ++r) add_scaled(size_, row[r], X + r * size_, u.data());
        return diagonal + product(size_, row.data(), u.data());
    }
    // What is left without body j, to which its own inertias have to be added.
    double* rest(int j, double pivot) {
        double* X = matrix_.of_again(j);
        for (int r = 0; r < size_; ++r) add_scaled(size_, -u[r] / pivot, u.data(), X + r * size_);
        return X;
    }
    void hand_on(int j, const Body& link) {
        if (link.origin) keep_linear_rows(size_, 6, matrix_.of_again(j));
        matrix_.hand_on(j, link.parent);
    }

  private:
    int size_;
    Gathered matrix_;
};

}  // namespace detail

class StageElimination {
  public:
    static constexpr int most_stages = 16;

    StageElimination(const Mechanism& mechanism, const Tableau& tableau)
        : StageElimination(mechanism, tableau, std::make_shared<Gathering>(mechanism.tree)) {}

    // Take over from stage c's sweep of first order what follows is about.
    void take(int c, const Jet<double>& jet) {
        for (int j = 0; j < tree_->size(); ++j) state_[j * stages_ + c] = EliminatedBody::of(*mechanism_, j, jet);
    }

    // Factor N with diagonals d (s, s, n), armature included; false where its determinant is not positive.
    bool factor(double h, const double* diagonal) {
        h_ = h;
        diagonal_ = diagonal;
        int sign = 1;
        for (int j = tree_->size() - 1; j >= 0 && sign != 0; --j) sign *= eliminate(j);
        return sign > 0;
    }

    // x with N x = b, (s, n) both.
    void solve(const double* b, double* x) {
        const int n = tree_->dof();
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            const Factors own = factors(j);
            double* z = force_.of(j);
            for (int i = 0; i < stages_; ++i)
                small_[i] = b[i * n + link.coordinate] - detail::product(width_, own.row + i * width_, z);
            for (int m = 0; m < stages_; ++m) {
                double t = 0.0;
                for (int i = 0; i < stages_; ++i) t += own.inverse[m * stages_ + i] * small_[i];
                x[m * n + link.coordinate] = t;
                if (link.parent >= 0) detail::add_scaled(width_, t, own.u + m * width_, z);
            }
            if (link.parent < 0) continue;
            if (link.origin) detail::keep_linear(width_, 9, z);
            force_.hand_on(j, link.parent);
        }
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const Factors own = factors(j);
            const double* above = motion(link.parent);
            double* moved = motion(j);
            std::copy(above, above + width_, moved);
            for (int m = 0; m < stages_; ++m) {
                double& coordinate = x[m * n + link.coordinate];
                coordinate -= detail::product(width_, own.l + m * width_, above);
                detail::add_scaled(width_, coordinate, own.column + m * width_, moved);
            }
        }
    }

    // y_c = A_c' x_c + L_qq,c h sum_m a_cm x_m, (s, n), of the x that `solve` left.
    void change_of_slope(const double* x, double* y) {
        const int n = tree_->dof();
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            double* z = force_.of(j);
            for (int c = 0; c < stages_; ++c) {
                const EliminatedBody& state = state_[j * stages_ + c];
                const double *moved = motion(j) + 9 * c, *above = motion(link.parent) + 9 * c;
                double own = 0.0;
                for (int m = 0; m < stages_; ++m) own += h_ * tableau_->a[c * stages_ + m] * x[m * n + link.coordinate];
                y[c * n + link.coordinate] = state.change_of_slope(own, moved, above, z + 9 * c);
            }
            if (link.parent < 0) continue;
            if (link.origin) detail::keep_linear(width_, 9, z);
            force_.hand_on(j, link.parent);
        }
    }

    // sum_c b_c x_c' M_c x_c, armature included.
    double kinetic_size(const double* x) {
        double total = 0.0;
        for (int c = 0; c < stages_; ++c) {
            const double* own = x + c * tree_->dof();
            double size = 0.0;
            for (int j = 0; j < tree_->size(); ++j) {
                const Body& link = tree_->bodies[j];
                const EliminatedBody& state = state_[j * stages_ + c];
                twist_[j] = own[link.coordinate] * state.axis;
                if (link.parent >= 0) twist_[j] += twist_[link.parent];
                size += dot(twist_[j], state.inertia * twist_[j]);
            }
            for (int k = 0; k < tree_->dof(); ++k) size += tree_->armature[k] * own[k] * own[k];
            total += tableau_->b[c] * size;
        }
        return total;
    }

    // The smallest ratio of a pivot of M - k L_qq + diag(d) to the same one of M, armature included, both averaged over
    // the stages with b; 0 if one is not positive. What `factor` left remains.
    double least_pivot_ratio(double k, const double* diagonal) {
        double least = std::numeric_limits<double>::infinity();
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            for (int c = 0; c < stages_; ++c) {
                const EliminatedBody& state = state_[j * stages_ + c];
                const double b = tableau_->b[c];
                const Force<double> by_axis = b * (state.inertia * state.axis);
                detail::write(state.axis, &masses_.row[6 * c]);
                detail::write(by_axis, &masses_.u[6 * c]);
                detail::write(state.axis, &curved_.row[12 * c]);
                detail::write(state.rate, &curved_.row[12 * c + 6]);
                detail::write(by_axis + Force<double>{{}, (b * k) * state.lifted}, &curved_.u[12 * c]);
                detail::write((-b * k) * (state.inertia * state.rate + state.turned), &curved_.u[12 * c + 6]);
            }
            const double mass = masses_.eliminate(j, tree_->armature[link.coordinate]);
            const double pivot = curved_.eliminate(j, diagonal[link.coordinate]);
            if (!(mass > 0.0 && pivot > 0.0)) return 0.0;
            least = std::min(least, pivot / mass);
            if (link.parent < 0) continue;
            double *M = masses_.rest(j, mass), *C = curved_.rest(j, pivot);
            for (int c = 0; c < stages_; ++c) {
                const detail::InertiaRows inertia(state_[j * stages_ + c].inertia);
                const double b = tableau_->b[c];
                const int m = 6 * stages_, w = 12 * stages_;
                detail::add_inertia(b, inertia, m, M + 6 * c * (m + 1));
                detail::add_inertia(b, inertia, w, C + 12 * c * (w + 1));
                detail::add_inertia(-b * k, inertia, w, C + (12 * c + 6) * (w + 1));
            }
            masses_.hand_on(j, link);
            curved_.hand_on(j, link);
        }
        return least;
    }

  private:
    // Of one body: (s, width), and the inverse of D (s, s). l is multiplied by it.
    struct Factors {
        double *row, *column, *u, *l, *inverse;
    };

    StageElimination(const Mechanism& mechanism, const Tableau& tableau, const std::shared_ptr<const Gathering>& order)
        : mechanism_(&mechanism),
          tree_(&mechanism.tree),
          tableau_(&tableau),
          stages_(tableau.stages),
          width_(9 * stages_ + stages_ % 2),
          state_(tree_->size() * stages_),
          factors_(tree_->size() * factor_size()),
          matrix_(order, width_ * width_),
          force_(order, width_),
          motion_(width_ * (tree_->size() + 1)),
          twist_(tree_->size()),
          small_(stages_),
          lu_(stages_ * stages_),
          rows_(stages_),
          curved_(12 * stages_, order),
          masses_(6 * stages_, order) {}

    int factor_size() const { return 4 * stages_ * width_ + stages_ * stages_; }
    Factors factors(int j) {
        double* own = factors_.data() + j * factor_size();
        const int size = stages_ * width_;
        return {own, own + size, own + 2 * size, own + 3 * size, own + 4 * size};
    }
    double* motion(int j) { return motion_.data() + width_ * (j + 1); }

    // The sign of D's determinant.
    int eliminate(int j) {
        const Body& link = tree_->bodies[j];
        const Factors own = factors(j);
        write_rows(j, own);
        double* X = matrix_.of(j);
        for (int r = 0; r < width_; ++r) {
            const double* line = X + r * width_;
            for (int m = 0; m < stages_; ++m) {
                own.u[m * width_ + r] += detail::product(width_, line, own.column + m * width_);
                detail::add_scaled(width_, own.row[m * width_ + r], line, own.l + m * width_);
            }
        }
        const int c = link.coordinate;
        for (int i = 0; i < stages_; ++i) {
            for (int m = 0; m < stages_; ++m) {
                const double D = detail::product(width_, own.row + i * width_, own.u + m * width_);
                lu_[i * stages_ + m] = D + diagonal_[(i * stages_ + m) * tree_->dof() + c];
            }
        }
        const int sign = factor_lu_pivoting(lu_.data(), stages_, rows_.data());
        if (sign == 0) return 0;
        invert(own.inverse);
        if (link.parent < 0) {
            std::fill(own.l, own.l + stages_ * width_, 0.0);
            return sign;
        }
        for (int r = 0; r < width_; ++r) {
            for (int i = 0; i < stages_; ++i) small_[i] = own.l[i * width_ + r];
            for (int m = 0; m < stages_; ++m) {
                double total = 0.0;
                for (int i = 0; i < stages_; ++i) total += own.inverse[m * stages_ + i] * small_[i];
                own.l[m * width_ + r] = total;
            }
        }
        for (int r = 0; r < width_; ++r) {
            for (int m = 0; m < stages_; ++m)
                detail::add_scaled(width_, -own.u[m * width_ + r], own.l + m * width_, X + r * width_);
        }
        for (int k = 0; k < stages_; ++k)
            detail::add_inertia(1.0, detail::InertiaRows(state_[j * stages_ + k].inertia), width_,
                                X + 9 * k * (width_ + 1));
        if (link.origin) detail::keep_linear_rows(width_, 9, X);
        matrix_.hand_on(j, link.parent);
        return sign;
    }

    // Rows and columns of body j, and u and l as far as they are its own.
    void write_rows(int j, const Factors& own) const {
        for (int i = 0; i < stages_; ++i) {
            for (int c = 0; c < stages_; ++c) {
                const EliminatedBody& state = state_[j * stages_ + c];
                const double there = i == c ? 1.0 : 0.0;
                const double ahead = h_ * tableau_->a[c * stages_ + i];
                const double behind = h_ * tableau_->gradient[i * stages_ + c];
                const int at = i * width_ + 9 * c;
                const Motion<double> row = there * state.axis + (-behind) * state.rate;
                const Motion<double> column = there * state.axis + ahead * state.rate;
                detail::write(row, behind * state.axis.angular, own.row + at);
                detail::write(column, ahead * state.axis.angular, own.column + at);
                detail::write(state.inertia * column + ahead * state.turned, ahead * state.lifted, own.u + at);
                detail::write(state.inertia * row + (-behind) * state.turned, behind * state.lifted, own.l + at);
            }
            if (width_ > 9 * stages_) {
                for (double* x : {own.row, own.column, own.u, own.l}) x[(i + 1) * width_ - 1] = 0.0;
            }
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
    int stages_;
    int width_;                          // nine entries for each stage, and a zero where that is odd
    std::vector<EliminatedBody> state_;  // (b, s)
    std::vector<double> factors_;
    detail::Gathered matrix_, force_;
    std::vector<double> motion_;  // (b + 1, width) under the x of `solve`, after what stands still
    std::vector<Motion<double>> twist_;
    std::vector<double> small_, lu_;
    std::vector<int> rows_;
    detail::Pivots curved_, masses_;
    double h_ = 0.0;
    const double* diagonal_ = nullptr;
};

}  // namespace varpin
