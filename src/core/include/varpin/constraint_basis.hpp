// The constraints at a node: their independent rows, orthogonalized in the metric of the kinetic energy with pivoting.
// docs/constraints.md, "Steps".
#pragma once

#include <algorithm>
#include <cmath>
#include <tuple>
#include <utility>
#include <vector>

#include "varpin/collocation.hpp"
#include "varpin/constraints.hpp"
#include "varpin/dense.hpp"

namespace varpin {

namespace detail {

inline double inner(int n, const double* a, const double* b) {
    double sum = 0.0;
    for (int i = 0; i < n; ++i) sum += a[i] * b[i];
    return sum;
}
inline double norm(int n, const double* a) { return std::sqrt(inner(n, a, a)); }
// y += s x.
inline void add_row(int n, double s, const double* x, double* y) { subtract_scaled(y, -s, x, 0, n); }
// Removes from x its part along a unit vector, and returns its length.
inline double remove_along(int n, const double* unit, double* x) {
    const double along = inner(n, unit, x);
    for (int c = 0; c < n; ++c) x[c] -= along * unit[c];
    return along;
}

}  // namespace detail

struct ConstraintBasis {
    // Threshold, in units of a row's terms, below which the row depends on the others. Rounding leaves 1e-15.
    static constexpr double dependent = 1e-9;
    // Threshold below which independent constraints are too close to a singular point.
    static constexpr double near_toggle = 1e-5;

    ConstraintJet jet;
    std::vector<double> ldl;   // (n, n) factors of M
    std::vector<double> root;  // (n) D^-1/2
    std::vector<double> rows;  // (m, n) rows of C in this metric, D^-1/2 L^-1 C' transposed
    std::vector<double> Q;     // (r, n) an orthonormal basis of these rows
    std::vector<double> R;     // (r, r) upper triangular: row order[k] = sum_{i<=k} R_ik Q_i
    std::vector<double> size;  // (m) size of the terms that cancel in a row
    std::vector<int> order;    // (r) the rows that are kept, in pivoting order
    double least = 1.0;        // the smallest diagonal entry of R, in units of its row
    int weakest = 0;           // the row of this entry

    auto all() { return std::tie(jet, ldl, root, rows, Q, R, size, order, least, weakest); }
    int dof() const { return static_cast<int>(root.size()); }
    int rank() const { return static_cast<int>(order.size()); }
    bool toggles() const { return !(least > near_toggle) && rank() > 0; }

    // D^-1/2 L^-1 b, and its inverse transposed L'^-1 D^-1/2 x.
    void whiten(const double* b, double* x) const {
        solve_lower(ldl.data(), dof(), {0, dof()}, b, x);
        for (int i = 0; i < dof(); ++i) x[i] *= root[i];
    }
    void colour(double* x) const {
        for (int i = 0; i < dof(); ++i) x[i] *= root[i];
        solve_upper(ldl.data(), dof(), {0, dof()}, x);
    }

    double mass_diagonal(int c) const {
        double sum = ldl[c * dof() + c];
        for (int j = 0; j < c; ++j) sum += ldl[c * dof() + j] * ldl[c * dof() + j] * ldl[j * dof() + j];
        return sum;
    }

    // C' Lam (n).
    void across(const double* Lam, double* out) const {
        std::fill(out, out + dof(), 0.0);
        for (std::size_t r = 0; r < size.size(); ++r) detail::add_row(dof(), Lam[r], &jet.C[r * dof()], out);
    }
};

inline void swap(ConstraintBasis& a, ConstraintBasis& b) {
    auto own = a.all(), other = b.all();
    own.swap(other);
}

// Work on bases of n coordinates and m rows.
class ConstraintAlgebra {
  public:
    ConstraintAlgebra(int n, int m) : n(n), m(m), taken(m) {}

    // Fill a basis from its jet and the factors of M: the `rank` most independent rows, or all independent ones for -1.
    void orthogonalize(const std::vector<double>& factors, int rank, ConstraintBasis& basis) {
        basis.ldl = factors;
        basis.root.resize(n);
        for (int i = 0; i < n; ++i) basis.root[i] = 1.0 / std::sqrt(basis.ldl[i * n + i]);
        measure_rows(basis);
        const double next = choose_rows(rank, basis);
        const int found = basis.rank();
        basis.R.assign(found * found, 0.0);
        for (int k = 0; k < found; ++k) {
            for (int i = 0; i <= k; ++i) basis.R[i * found + k] = parts[basis.order[k] * n + i];
        }
        // Dependent rows have become independent: the rollout began at a singular configuration.
        if (rank >= 0 && (next > 1e3 * ConstraintBasis::dependent || found < rank)) basis.least = 0.0;
    }

    // Solve C M^-1 (p - C' Lam) = rate for Lam (m) of the basis' rows; zero for other rows.
    void find_impulse(const ConstraintBasis& basis, const double* p, const double* rate, double* Lam) {
        const int r = basis.rank();
        basis.whiten(p, white.data());
        for (int k = 0; k < r; ++k) {
            double own = rate[basis.order[k]];
            for (int j = 0; j < k; ++j) own -= basis.R[j * r + k] * wanted[j];
            wanted[k] = own / basis.R[k * r + k];
            along[k] = detail::inner(n, &basis.Q[k * n], white.data()) - wanted[k];
        }
        std::fill(Lam, Lam + m, 0.0);
        for (int k = r - 1; k >= 0; --k) {
            double own = along[k];
            for (int j = k + 1; j < r; ++j) own -= basis.R[k * r + j] * Lam[basis.order[j]];
            Lam[basis.order[k]] = own / basis.R[k * r + k];
        }
    }

    // Change of the rows between `basis` and another point: the distance of C0 W C1' (C0 W C0')^-1 from the identity,
    // with W = M^-1 or, where that gives less, the squared greatest displacement of each joint. While it is below one
    // for any W, the rows stay independent, and a root belongs to the same assembly. Where light joints carry heavy
    // ones, a small turn of the rows is large in the metric of the kinetic energy.
    double turn(const ConstraintBasis& basis, const ConstraintJet& jet, double most) {
        const int r = basis.rank();
        for (int a = 0; a < r; ++a) {
            basis.whiten(&jet.C[basis.order[a] * n], white.data());
            for (int k = 0; k < r; ++k) product[k * r + a] = detail::inner(n, &basis.Q[k * n], white.data());
        }
        const double own = from_one(r, basis.R.data());
        return own <= most ? own : std::min(own, even_turn(basis, jet));
    }

    // A basis (free, n) of the null space of the rows: C z = 0.
    void find_null(const ConstraintBasis& basis, std::vector<double>& null) {
        const int r = basis.rank(), free = n - r;
        null.assign(free * n, 0.0);
        std::fill(unspanned.begin(), unspanned.end(), 1.0);
        const auto span = [&](const double* x) {
            for (int i = 0; i < n; ++i) unspanned[i] -= x[i] * x[i];
        };
        for (int k = 0; k < r; ++k) span(&basis.Q[k * n]);
        for (int f = 0; f < free; ++f) {
            const auto best = std::max_element(unspanned.begin(), unspanned.end()) - unspanned.begin();
            double* z = &null[f * n];
            z[best] = 1.0;
            // Twice, for rounding.
            for (int again = 0; again < 2; ++again) {
                for (int k = 0; k < r; ++k) detail::remove_along(n, &basis.Q[k * n], z);
                for (int k = 0; k < f; ++k) detail::remove_along(n, &null[k * n], z);
            }
            const double length = detail::norm(n, z);
            for (int c = 0; c < n; ++c) z[c] /= length;
            span(z);
        }
        for (int f = 0; f < free; ++f) basis.colour(&null[f * n]);
    }

  private:
    int n, m;
    std::vector<double> white = zeros(n), along = zeros(n), wanted = zeros(n);
    std::vector<double> unit = zeros(n);       // greatest displacements
    std::vector<double> unspanned = zeros(n);  // squared norms of the rest of the unit vectors
    std::vector<double> rest = zeros(m, n), parts = zeros(m, n);
    std::vector<double> product = zeros(n, n), even = zeros(n, n);
    std::vector<char> taken;  // whether a row is in the basis

    // The rows of C in the metric of the kinetic energy, and the size of the terms that cancel in each: their squares
    // times the diagonal of M^-1.
    void measure_rows(ConstraintBasis& basis) {
        basis.rows.resize(m * n);
        basis.size.assign(m, 0.0);
        for (int c = 0; c < n; ++c) {
            double inverse = 0.0;
            for (int i = c; i < n; ++i) {
                double entry = i == c ? 1.0 : 0.0;
                for (int j = c; j < i; ++j) entry -= basis.ldl[i * n + j] * white[j];
                white[i] = entry;
                inverse += entry * entry * basis.root[i] * basis.root[i];
            }
            for (int r = 0; r < m; ++r)
                basis.size[r] += basis.jet.size[r * n + c] * basis.jet.size[r * n + c] * inverse;
        }
        for (int r = 0; r < m; ++r) {
            basis.whiten(&basis.jet.C[r * n], &basis.rows[r * n]);
            basis.size[r] = std::sqrt(basis.size[r]);
        }
    }

    // Write Q, the order and the least row of a basis by Gram-Schmidt, twice, with pivoting: next is the row with the
    // largest rest in units of its size. Returns the rest of the first row beyond `rank`.
    double choose_rows(int rank, ConstraintBasis& basis) {
        std::copy(basis.rows.begin(), basis.rows.end(), rest.begin());
        std::fill(taken.begin(), taken.end(), 0);
        basis.order.clear();
        basis.Q.clear();
        basis.least = 1.0;
        basis.weakest = 0;
        const int most = rank < 0 ? std::min(m, n) : rank;
        for (int k = 0; k <= most && k < m; ++k) {
            const auto [best, farthest] = farthest_row(basis);
            if (k == most) return farthest;
            if (!(farthest > ConstraintBasis::dependent) && rank < 0) break;
            basis.least = farthest;
            basis.weakest = best;
            taken[best] = 1;
            const double length = detail::norm(n, &rest[best * n]);
            if (!(length > 0.0)) break;
            basis.order.push_back(best);
            for (int c = 0; c < n; ++c) basis.Q.push_back(rest[best * n + c] / length);
            parts[best * n + k] = detail::inner(n, &basis.Q[k * n], &rest[best * n]);
            for (int r = 0; r < m; ++r) {
                if (taken[r]) continue;
                // The part along Q_k, and what rounding has left along Q_0 .. Q_k.
                parts[r * n + k] = detail::remove_along(n, &basis.Q[k * n], &rest[r * n]);
                for (int i = 0; i <= k; ++i) parts[r * n + i] += detail::remove_along(n, &basis.Q[i * n], &rest[r * n]);
            }
        }
        return 0.0;
    }

    // The row with the largest rest, in units of its size, of those that are not taken.
    std::pair<int, double> farthest_row(const ConstraintBasis& basis) const {
        int best = -1;
        double farthest = 0.0;
        for (int r = 0; r < m; ++r) {
            if (taken[r]) continue;
            const double own = detail::norm(n, &rest[r * n]) / std::max(basis.size[r], nothing);
            if (best < 0 || own > farthest) best = r, farthest = own;
        }
        return {best, farthest};
    }

    // `turn` with the greatest displacements, by Gram-Schmidt on the rows at the basis.
    double even_turn(const ConstraintBasis& basis, const ConstraintJet& jet) {
        const int r = basis.rank();
        std::vector<double>&Q = rest, &R = even;
        for (int c = 0; c < n; ++c) {
            double most = 0.0;
            for (const int row : basis.order)
                most = std::max({most, std::abs(basis.jet.C[row * n + c]), std::abs(jet.C[row * n + c])});
            unit[c] = most > 0.0 ? 1.0 / most : 0.0;
        }
        for (int k = 0; k < r; ++k) {
            double* own = &Q[k * n];
            for (int c = 0; c < n; ++c) own[c] = unit[c] * basis.jet.C[basis.order[k] * n + c];
            for (int b = 0; b < k; ++b) R[b * r + k] = detail::remove_along(n, &Q[b * n], own);
            R[k * r + k] = detail::norm(n, own);
            for (int c = 0; c < n; ++c) own[c] /= R[k * r + k];
        }
        for (int a = 0; a < r; ++a) {
            for (int c = 0; c < n; ++c) white[c] = unit[c] * jet.C[basis.order[a] * n + c];
            for (int k = 0; k < r; ++k) product[k * r + a] = detail::inner(n, &Q[k * n], white.data());
        }
        return from_one(r, R.data());
    }

    // The distance of X from the identity, with X' R = product.
    double from_one(int r, const double* R) {
        for (int k = 0; k < r; ++k) {
            for (int a = 0; a < r; ++a) {
                double own = product[k * r + a];
                for (int b = 0; b < a; ++b) own -= product[k * r + b] * R[b * r + a];
                product[k * r + a] = own / R[a * r + a];
            }
        }
        double sum = 0.0;
        for (int k = 0; k < r; ++k) {
            for (int a = 0; a < r; ++a) {
                const double off = product[k * r + a] - (k == a ? 1.0 : 0.0);
                sum += off * off;
            }
        }
        return std::sqrt(sum);
    }
};

}  // namespace varpin
