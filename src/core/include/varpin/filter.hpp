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

// A log of K samples of z numbers, and what acts in its K - 1 intervals: FilterLog of src/varpin/core/arrays.py.
struct LogView {
    std::int64_t samples = 0;
    int rows = 0;  // z
    const double *measured = nullptr, *variance = nullptr;
    const std::int64_t* parts = nullptr;
    const double *h = nullptr, *force = nullptr, *spread = nullptr, *kept = nullptr, *added = nullptr;
};

// FilterArrays of the same file, in zeros. The moments of the first prediction are given.
struct Estimates {
    double *predicted = nullptr, *predicted_covariance = nullptr, *state = nullptr, *covariance = nullptr;
    double *transition = nullptr, *innovations = nullptr, *rows = nullptr;
};

// By the steps of a VariationalLinearization or an ExplicitStepper.
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
