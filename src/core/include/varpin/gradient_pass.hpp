// The backward pass again with other gradients of the cost: the feed-forward part alone, of the gains and factors of a
// pass with the same dynamics and Hessians. Linear in the gradients, and O(n^2) a step where a pass takes O(n^3).
// docs/mathematics.md, "The search".
#pragma once

#include <algorithm>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/steps.hpp"

namespace varpin {

class GradientPass {
  public:
    // Starts from the gradient (2n) of the terminal cost in x.
    GradientPass(int dof, int controls, const double* terminal_gradient)
        : n(dof),
          m(controls),
          x(2 * dof),
          size(2 * dof + controls),
          gradient(size),
          q0(dof),
          v0(dof),
          q1(dof),
          v1(dof),
          Q(size),
          jump(2 * dof),
          residual(controls) {
        std::copy_n(terminal_gradient, x, gradient.begin());
    }

    // Writes the feed-forward part. `gains` has the other gains, factors and spread of the pass, which had no limits.
    void run(double h, int hold, double regularization, const ExpandedSteps& steps, const Gains& gains) {
        for (std::ptrdiff_t s = steps.steps - 1; s >= 0; --s) {
            collect(h, steps, s);
            carry(steps, s);
            if (steps.processes > 0) add_noise(steps, s, gains.spread + s * x * x);
            if (s % hold != 0) {
                gradient = Q;
            } else {
                decide(regularization, steps, s / hold, gains);
            }
        }
    }

  private:
    // The running cost of step s: its gradients in q and v at the nodes, and in u, added to Q's part in u.
    void collect(double h, const ExpandedSteps& steps, std::ptrdiff_t s) {
        for (auto* part : {&q0, &v0, &q1, &v1}) std::fill(part->begin(), part->end(), 0.0);
        std::copy(gradient.begin() + x, gradient.end(), Q.begin() + x);
        const auto samples = static_cast<std::ptrdiff_t>(steps.rule.size());
        for (std::ptrdiff_t k = 0; k < samples; ++k) {
            const Sample& sample = steps.rule[k];
            const double* g = steps.gradient_at(s * samples + k);
            const double weight = h * sample.weight;
            for (int i = 0; i < n; ++i) {
                const double by_q = weight * g[i], by_v = weight * g[n + i];
                q0[i] += sample.q.q0 * by_q + sample.v.q0 * by_v;
                v0[i] += sample.q.v0 * by_q + sample.v.v0 * by_v;
                q1[i] += sample.q.q1 * by_q + sample.v.q1 * by_v;
                v1[i] += sample.q.v1 * by_q + sample.v.v1 * by_v;
            }
            for (int c = 0; c < m; ++c) Q[x + c] += weight * g[x + c];
        }
    }

    // Add gradients in q and v at a node to one in x; dv/dx (n, 2n) is null for x = (q, v).
    void add_node(const std::vector<double>& by_q, const std::vector<double>& by_v, const double* velocity,
                  std::vector<double>& out) const {
        for (int i = 0; i < n; ++i) {
            out[i] += by_q[i];
            if (!velocity) {
                out[n + i] += by_v[i];
            } else if (by_v[i] != 0.0) {
                for (int c = 0; c < x; ++c) out[c] += by_v[i] * velocity[i * x + c];
            }
        }
    }

    // Q's gradient in x and u from those of the value after step s and of the running cost.
    void carry(const ExpandedSteps& steps, std::ptrdiff_t s) {
        const double* before = steps.velocity ? steps.velocity + s * n * x : nullptr;
        add_node(q1, v1, before ? before + n * x : nullptr, gradient);
        std::fill_n(Q.begin(), x, 0.0);
        for (int i = 0; i < x; ++i) {
            const double pull = gradient[i];
            const double *A = steps.A + (s * x + i) * x, *B = steps.B + (s * x + i) * m;
            for (int c = 0; c < x; ++c) Q[c] += pull * A[c];
            for (int c = 0; c < m; ++c) Q[x + c] += pull * B[c];
        }
        add_node(q0, v0, before, Q);
    }

    // Add the gradient of the cost of noise, from S (2n, 2n).
    void add_noise(const ExpandedSteps& steps, std::ptrdiff_t s, const double* S) {
        for (int w = 0; w < steps.processes; ++w) {
            for (int i = 0; i < x; ++i) jump[i] = steps.G[(s * x + i) * steps.processes + w];
            for (int i = 0; i < x; ++i) {
                const std::ptrdiff_t entry = (s * x + i) * steps.processes + w;
                double pull = 0.0;
                for (int c = 0; c < x; ++c) pull += S[i * x + c] * jump[c];
                for (int c = 0; c < x; ++c) Q[c] += pull * steps.Gx[entry * x + c];
                for (int c = 0; c < m; ++c) Q[x + c] += pull * steps.Gu[entry * m + c];
            }
        }
    }

    // k of decision r, and the gradient of the value: with Quu' the regularized Quu, Q_ux = -Quu' K and Q_u = -Quu' k,
    // so that V_x = Q_x + K'(Quu k + Q_u) + Q_ux'k = Q_x + K'((Quu - Quu') k + Q_u).
    void decide(double regularization, const ExpandedSteps& steps, std::ptrdiff_t r, const Gains& gains) {
        const double* factors = gains.factors + r * m * m;
        double* k = gains.feedforward + r * m;
        for (int i = 0; i < m; ++i) {
            if (steps.rate) Q[x + i] += steps.pull[r * m + i];
            k[i] = -Q[x + i];
        }
        solve_ldl(factors, m, {0, m}, k, k);
        std::copy_n(Q.begin(), x, gradient.begin());
        for (int i = 0; i < m; ++i) {
            double pivot = factors[i * m + i];
            for (int j = 0; j < i; ++j) pivot += factors[i * m + j] * factors[i * m + j] * factors[j * m + j];
            residual[i] = -regularization / (1.0 + regularization) * pivot * k[i];
            const double pull = residual[i] + Q[x + i];
            const double* K = gains.feedback + (r * m + i) * x;
            for (int c = 0; c < x; ++c) gradient[c] += pull * K[c];
        }
        for (int c = 0; c < m; ++c) {
            double total = 0.0;
            if (steps.rate) {
                total = -steps.pull[r * m + c];
                for (int i = 0; i < m; ++i) {
                    total += gains.previous[(r * m + i) * m + c] * residual[i] - steps.rate[(r * m + i) * m + c] * k[i];
                }
            }
            gradient[x + c] = total;
        }
    }

    int n, m, x, size;                   // x = 2n states, and controls
    std::vector<double> gradient;        // (size) of the value after a step
    std::vector<double> q0, v0, q1, v1;  // (n) of the running cost of a step, in the nodes before and after
    std::vector<double> Q;               // (size)
    std::vector<double> jump, residual;  // (2n) of a process; (m) Quu k + Q_u
};

}  // namespace varpin
