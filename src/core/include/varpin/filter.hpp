// The extended Kalman filter over a log, in x = (q, p) or (q, v) on the exact derivatives of steps, and in external
// forces on the joints if wanted. docs/mathematics.md, "Filter and smoother"; equations (K1) and (K2).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "varpin/explicit.hpp"
#include "varpin/linearization.hpp"

namespace varpin {

// A log of K samples of z numbers, positions and then velocities if there are any, and what acts in its K - 1
// intervals.
struct LogView {
    std::int64_t samples = 0;
    int rows = 0;                         // z: n or 2n
    const double* measured = nullptr;     // (K, z), NaN where missing
    const double* variance = nullptr;     // (z)
    const std::int64_t* parts = nullptr;  // (K - 1) steps in an interval
    const double* h = nullptr;            // (K - 1) their length [s]
    const double* force = nullptr;        // (K - 1, n) of the controls
    const double* spread = nullptr;       // (K - 1, n, n) F F' of the noise
    const double* kept = nullptr;         // (K - 1) share of external forces that a step keeps
    const double* added = nullptr;        // (K - 1, n) variance that it adds to them
};

// Moments (K, d) and (K, d, d) of the state before and after each sample, for d = 2n, or 3n with external forces.
struct Estimates {
    double *predicted = nullptr, *predicted_covariance = nullptr;  // those of the first sample are given
    double *state = nullptr, *covariance = nullptr;
    double* transition = nullptr;   // (K - 1, d, d) derivative of a prediction in the state before
    double* innovations = nullptr;  // (K, z), NaN where missing
    double* rows = nullptr;         // (K, z, 2n) derivatives of the predicted samples in the state
};

namespace detail {

// out (rows, columns) = a (rows, depth) b (depth, columns).
inline void multiply(const double* a, const double* b, int rows, int depth, int columns, double* out) {
    std::fill(out, out + rows * columns, 0.0);
    for (int i = 0; i < rows; ++i) {
        subtract_rows(
            out + i * columns, columns, 0, depth, [&](int k) { return -a[i * depth + k]; },
            [&](int k) { return b + k * columns; });
    }
}

// Of a (n, n), in place.
inline void transpose(double* a, int n) {
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < i; ++j) std::swap(a[i * n + j], a[j * n + i]);
    }
}

}  // namespace detail

// Steps of a variational integrator in (q, p).
class VariationalModel {
  public:
    VariationalModel(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                     const Kernels& kernels)
        : steps_(mechanism, tableau, tolerance, guards, kernels), n_(mechanism.dof()) {}

    // The end x1 (2n) of a step from x and its derivatives in x and in the external force (n), which may be null; and
    // the covariance (n, n) in a unit of time of the jumps of noise of `spread`.
    Outcome step(double h, const double* x, const double* force, const double* external, const double* spread,
                 double* x1, double* A, double* B, double* jumps) {
        std::copy_n(spread, n_ * n_, jumps);
        steps_.take_external(external);
        return steps_.step(h, x, x + n_, force, A, B, x1, x1 + n_);
    }

    // The velocity (n) at x and its derivatives, into zeros (n, 2n); false where the mass matrix is not positive
    // definite.
    bool velocity(const double* x, double* v, double* slopes) { return steps_.velocity(x, x + n_, v, slopes); }

  private:
    VariationalLinearization steps_;
    int n_;
};

// The same of an explicit method in (q, v).
class ExplicitModel {
  public:
    ExplicitModel(const Mechanism& mechanism, ExplicitMethod method)
        : stepper_(mechanism, method, true), n_(mechanism.dof()), sum_(n_) {}

    Outcome step(double h, const double* x, const double* force, const double* external, const double* spread,
                 double* x1, double* A, double* B, double* jumps) {
        std::copy_n(x, n_, stepper_.q.begin());
        std::copy_n(x + n_, n_, stepper_.v.begin());
        if (!stepper_.dynamics.at(x, x + n_)) return Outcome::singular;
        std::copy_n(spread, n_ * n_, jumps);
        for (int turn = 0; turn < 2; ++turn) {
            // M^-1 times the rows of a symmetric matrix, and then of the transpose of that.
            for (int i = 0; i < n_; ++i) stepper_.dynamics.solve_mass(jumps + i * n_, jumps + i * n_);
            detail::transpose(jumps, n_);
        }
        for (int i = 0; i < n_; ++i) sum_[i] = force[i] + (external ? external[i] : 0.0);
        if (!stepper_.step(h, sum_.data())) return Outcome::singular;
        std::fill(A, A + 4 * n_ * n_, 0.0);
        std::fill(B, B + 2 * n_ * n_, 0.0);
        stepper_.write_derivatives(h, A, B);
        std::copy_n(stepper_.q.begin(), n_, x1);
        std::copy_n(stepper_.v.begin(), n_, x1 + n_);
        return Outcome::solved;
    }

    bool velocity(const double* x, double* v, double* slopes) {
        std::copy_n(x + n_, n_, v);
        for (int i = 0; i < n_; ++i) slopes[i * 2 * n_ + n_ + i] = 1.0;
        return true;
    }

  private:
    ExplicitStepper stepper_;
    int n_;
    std::vector<double> sum_;
};

template <class Model>
class Filter {
  public:
    // With `external`, the forces on the n joints are n more states.
    Filter(Model& model, int n, bool external) : model_(model), n(n), d(external ? 3 * n : 2 * n) {}

    // Why it ended, and the samples that were reached.
    std::pair<Outcome, std::int64_t> run(const LogView& log, const Estimates& to) {
        std::copy_n(to.predicted, d, x.begin());
        std::copy_n(to.predicted_covariance, d * d, P.begin());
        for (std::int64_t k = 0; k < log.samples; ++k) {
            if (k > 0) {
                const Outcome outcome = predict(log, k - 1, to.transition + (k - 1) * d * d);
                if (outcome != Outcome::solved) return {outcome, k};
            }
            std::copy_n(x.begin(), d, to.predicted + k * d);
            std::copy_n(P.begin(), d * d, to.predicted_covariance + k * d * d);
            double* rows = to.rows + k * log.rows * 2 * n;
            for (int i = 0; i < n; ++i) rows[i * (2 * n + 1)] = 1.0;
            std::copy_n(x.begin(), n, sample.begin());
            if (log.rows > n && !model_.velocity(x.data(), sample.data() + n, rows + 2 * n * n))
                return {Outcome::singular, k};
            if (!update(log, k, rows, to.innovations + k * log.rows)) return {Outcome::not_finite, k};
            std::copy_n(x.begin(), d, to.state + k * d);
            std::copy_n(P.begin(), d * d, to.covariance + k * d * d);
        }
        return {Outcome::solved, log.samples};
    }

  private:
    Model& model_;
    const int n, d;
    std::vector<double> x = zeros(d), P = zeros(d, d);
    std::vector<double> sample = zeros(2 * n), x1 = zeros(2 * n), A = zeros(2 * n, 2 * n), B = zeros(2 * n, n);
    std::vector<double> jumps = zeros(n, n), step = zeros(d, d), product = zeros(d, d);
    std::vector<double> shift = zeros(d), weight = zeros(d);

    // Over interval k, with the product of the derivatives of its steps into `transition`.
    Outcome predict(const LogView& log, std::int64_t k, double* transition) {
        for (std::int64_t part = 0; part < log.parts[k]; ++part) {
            const double h = log.h[k], *external = d > 2 * n ? x.data() + 2 * n : nullptr;
            const Outcome outcome = model_.step(h, x.data(), log.force + k * n, external, log.spread + k * n * n,
                                                x1.data(), A.data(), B.data(), jumps.data());
            if (outcome != Outcome::solved) return outcome;
            for (double value : x1) {
                if (!std::isfinite(value)) return Outcome::not_finite;
            }
            std::copy(x1.begin(), x1.end(), x.begin());
            for (int i = 2 * n; i < d; ++i) x[i] *= log.kept[k];
            write_step(external ? log.kept[k] : 0.0);
            spread(h, external ? log.added + k * n : nullptr);
            if (part == 0) {
                std::copy(step.begin(), step.end(), transition);
            } else {
                detail::multiply(step.data(), transition, d, d, d, product.data());
                std::copy(product.begin(), product.end(), transition);
            }
        }
        return Outcome::solved;
    }

    // [[A, B], [0, kept]].
    void write_step(double kept) {
        for (int i = 0; i < 2 * n; ++i) {
            std::copy_n(A.begin() + i * 2 * n, 2 * n, step.begin() + i * d);
            if (d > 2 * n) std::copy_n(B.begin() + i * n, n, step.begin() + i * d + 2 * n);
        }
        for (int i = 2 * n; i < d; ++i) step[i * d + i] = kept;
    }

    // P of the end of a step from that of its start, (K1): a third of the noise acts at either end, and what both share
    // is a sixth of A times it.
    void spread(double h, const double* added) {
        add_jumps(h / 3.0);
        detail::multiply(step.data(), P.data(), d, d, d, product.data());
        detail::transpose(product.data(), d);
        detail::multiply(step.data(), product.data(), d, d, d, P.data());
        for (int i = 0; i < 2 * n; ++i) {
            for (int j = 0; j < n; ++j) {
                double total = 0.0;
                for (int k = 0; k < n; ++k) total += A[i * 2 * n + n + k] * jumps[k * n + j];
                P[i * d + n + j] += h / 6.0 * total;
                P[(n + j) * d + i] += h / 6.0 * total;
            }
        }
        add_jumps(h / 3.0);
        for (int i = 0; added && i < n; ++i) P[(2 * n + i) * (d + 1)] += added[i];
        for (int i = 0; i < d; ++i) {
            for (int j = 0; j < i; ++j) P[i * d + j] = P[j * d + i] = 0.5 * (P[i * d + j] + P[j * d + i]);
        }
    }

    void add_jumps(double share) {
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < n; ++j) P[(n + i) * d + n + j] += share * jumps[i * n + j];
        }
    }

    // Take sample k, one number after another: their errors are independent, so that this is the joint update, (K2).
    // False where the variance of a prediction is no positive number.
    bool update(const LogView& log, std::int64_t k, const double* row, double* innovations) {
        std::fill(shift.begin(), shift.end(), 0.0);
        for (int i = 0; i < log.rows; ++i, row += 2 * n) {
            innovations[i] = log.measured[k * log.rows + i] - sample[i];
            if (std::isnan(innovations[i])) continue;
            double sum = log.variance[i], left = innovations[i];
            detail::multiply(row, P.data(), 1, 2 * n, d, weight.data());
            for (int c = 0; c < 2 * n; ++c) {
                sum += row[c] * weight[c];
                left -= row[c] * shift[c];
            }
            if (!(sum > 0.0) || !std::isfinite(sum)) return false;
            for (int r = 0; r < d; ++r) {
                const double gain = weight[r] / sum;
                shift[r] += gain * left;
                detail::subtract_scaled(P.data() + r * d, gain, weight.data(), 0, d);
            }
        }
        for (int c = 0; c < d; ++c) x[c] += shift[c];
        return true;
    }
};

}  // namespace varpin
