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

    // Takes x (2n) to the end of a step, with its derivatives A in x and B in the external force (n), which may be
    // null, and `spread` (n, n), that of the noise's forces in a unit of time, to that of its jumps.
    Outcome step(double h, double* x, const double* force, const double* external, double* A, double* B, double*) {
        steps_.take_external(external);
        return steps_.step(h, x, x + n_, force, A, B, x, x + n_);
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

    Outcome step(double h, double* x, const double* force, const double* external, double* A, double* B,
                 double* spread) {
        std::copy_n(x, n_, stepper_.q.begin());
        std::copy_n(x + n_, n_, stepper_.v.begin());
        if (!stepper_.dynamics.at(x, x + n_)) return Outcome::singular;
        for (int turn = 0; turn < 2; ++turn) {
            // M^-1 times the rows of a symmetric matrix, and then of the transpose of that.
            for (int i = 0; i < n_; ++i) stepper_.dynamics.solve_mass(spread + i * n_, spread + i * n_);
            detail::transpose(spread, n_);
        }
        for (int i = 0; i < n_; ++i) sum_[i] = force[i] + (external ? external[i] : 0.0);
        if (!stepper_.step(h, sum_.data())) return Outcome::singular;
        std::fill_n(A, 4 * n_ * n_, 0.0);
        std::fill_n(B, 2 * n_ * n_, 0.0);
        stepper_.write_derivatives(h, A, B);
        std::copy_n(stepper_.q.begin(), n_, x);
        std::copy_n(stepper_.v.begin(), n_, x + n_);
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
    // With d = 3n, the forces on the n joints are states, too.
    Filter(Model& model, int n, int d) : model_(model), n(n), d(d) {}

    // Why it ended, and the samples that were reached.
    std::pair<Outcome, std::int64_t> run(const LogView& log, const Estimates& to) {
        for (std::int64_t k = 0; k < log.samples; ++k) {
            double *x = to.predicted + k * d, *P = to.predicted_covariance + k * d * d;
            if (k > 0) {
                std::copy_n(to.state + (k - 1) * d, d, x);
                std::copy_n(to.covariance + (k - 1) * d * d, d * d, P);
                const Outcome outcome = predict(log, k - 1, x, P, to.transition + (k - 1) * d * d);
                if (outcome != Outcome::solved) return {outcome, k};
            }
            double* rows = to.rows + k * log.rows * 2 * n;
            for (int i = 0; i < n; ++i) rows[i * (2 * n + 1)] = 1.0;
            std::copy_n(x, n, sample.begin());
            if (log.rows > n && !model_.velocity(x, sample.data() + n, rows + 2 * n * n)) return {Outcome::singular, k};
            double *after = to.state + k * d, *left = to.covariance + k * d * d;
            std::copy_n(x, d, after);
            std::copy_n(P, d * d, left);
            if (!update(log, k, rows, to.innovations + k * log.rows, after, left)) return {Outcome::not_finite, k};
        }
        return {Outcome::solved, log.samples};
    }

  private:
    Model& model_;
    const int n, d;
    std::vector<double> sample = zeros(2 * n), A = zeros(2 * n, 2 * n), B = zeros(2 * n, n), jumps = zeros(n, n);
    std::vector<double> step = zeros(d, d), product = zeros(d, d), shift = zeros(d), weight = zeros(d);

    // Over interval k, with the product of the derivatives of its steps into `transition`.
    Outcome predict(const LogView& log, std::int64_t k, double* x, double* P, double* transition) {
        const double h = log.h[k], *external = d > 2 * n ? x + 2 * n : nullptr;
        for (std::int64_t part = 0; part < log.parts[k]; ++part) {
            std::copy_n(log.spread + k * n * n, n * n, jumps.begin());
            const Outcome outcome = model_.step(h, x, log.force + k * n, external, A.data(), B.data(), jumps.data());
            if (outcome != Outcome::solved) return outcome;
            if (!std::all_of(x, x + 2 * n, [](double value) { return std::isfinite(value); }))
                return Outcome::not_finite;
            // [[A, B], [0, kept]].
            for (int i = 0; i < 2 * n; ++i) {
                std::copy_n(A.begin() + i * 2 * n, 2 * n, step.begin() + i * d);
                std::copy_n(B.begin() + i * n, d - 2 * n, step.begin() + i * d + 2 * n);
            }
            for (int i = 2 * n; i < d; ++i) x[i] *= step[i * d + i] = log.kept[k];
            spread(h / 3.0, P);
            for (int i = 2 * n; i < d; ++i) P[i * d + i] += log.added[k * n + i - 2 * n];
            if (part > 0) detail::multiply(step.data(), transition, d, d, d, product.data());
            std::copy_n(part > 0 ? product.data() : step.data(), d * d, transition);
        }
        return Outcome::solved;
    }

    // P of the end of a step from that of its start, (K1): with a third of the noise, E, it is the symmetric part of
    // A ((P + E) A' + E) + E.
    void spread(double third, double* P) {
        const auto add_noise = [&](double* to) {
            for (int i = 0; i < n; ++i)
                detail::subtract_scaled(to + (n + i) * d + n, -third, jumps.data() + i * n, 0, n);
        };
        add_noise(P);
        detail::multiply(step.data(), P, d, d, d, product.data());
        detail::transpose(product.data(), d);
        add_noise(product.data());
        detail::multiply(step.data(), product.data(), d, d, d, P);
        add_noise(P);
        for (int i = 0; i < d; ++i) {
            for (int j = 0; j < i; ++j) P[i * d + j] = P[j * d + i] = 0.5 * (P[i * d + j] + P[j * d + i]);
        }
    }

    // Take sample k, one number after another: their errors are independent, so that this is the joint update, (K2).
    // False where the variance of a prediction is no positive number.
    bool update(const LogView& log, std::int64_t k, const double* row, double* innovations, double* x, double* P) {
        std::fill(shift.begin(), shift.end(), 0.0);
        for (int i = 0; i < log.rows; ++i, row += 2 * n) {
            innovations[i] = log.measured[k * log.rows + i] - sample[i];
            if (std::isnan(innovations[i])) continue;
            double sum = log.variance[i], left = innovations[i];
            detail::multiply(row, P, 1, 2 * n, d, weight.data());
            for (int c = 0; c < 2 * n; ++c) {
                sum += row[c] * weight[c];
                left -= row[c] * shift[c];
            }
            if (!(sum > 0.0) || !std::isfinite(sum)) return false;
            for (int r = 0; r < d; ++r) {
                const double gain = weight[r] / sum;
                shift[r] += gain * left;
                detail::subtract_scaled(P + r * d, gain, weight.data(), 0, d);
            }
        }
        for (int c = 0; c < d; ++c) x[c] += shift[c];
        return true;
    }
};

}  // namespace varpin
