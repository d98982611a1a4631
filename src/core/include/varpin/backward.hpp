// The backward pass of stochastic differential dynamic programming (Theodorou, Tassa and Todorov 2010).
// docs/mathematics.md, "The backward pass", "Digits" and "Smooth controls".
//
// The value after a step is v0 + Wx . x' + Wu . u + (1/2) (x', u) W (x', u), in deviations from the nominal trajectory;
// it depends on u only while a control is held over several steps. With x' = A x + B u + sum_i (g_i + Gx_i x + Gu_i u)
// dw_i, the cost of the step expanded at its samples z = D (x, u), and S = h (Wxx + h dz/dx'' l_zz dz/dx' + w_xx)
// with w a further cost of the noise's jump, if any,
//
//     Q_x  = h D'l_z + A'Wx + sum_i Gx_i' S g_i,        Q_xx = h D'l_zz D + A'Wxx A + sum_i Gx_i' S Gx_i,
//     k    = -Q_uu^-1 Q_u,    K = -Q_uu^-1 Q_ux,        V_xx = Q_xx + K'(Q_uu K + Q_ux) + Q_ux'K,
//
// and likewise in u; v0 grows by (1/2) sum_i g_i' S g_i. A cost (1/2) (u - w)' R (u - w) of the change from the
// previous control w adds R to Q_uu and to Q_ww and -R to Q_uw at a decision: gains on w follow from the formula for x
// with -R in place of Q_ux, and the value before the decision depends on (x, w).
//
// Equations (O2) and (O6) of docs/mathematics.md.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/linear_step.hpp"
#include "varpin/simd.hpp"
#include "varpin/steps.hpp"

namespace varpin {

// The recursion (O2) over the steps, from the last to the first.
class BackwardPass {
  public:
    // Starts from the gradient (2n) and the Hessian (2n, 2n) of the terminal cost in x.
    BackwardPass(int dof, int controls, const double* terminal_gradient, const double* terminal_hessian)
        : n(dof),
          m(controls),
          x(2 * dof),
          size(2 * dof + controls),
          W(size, size),
          gradient(size),
          costate(size),
          scale(size),
          step(dof, controls),
          S(x, x),
          T(size, size),
          Q(size, size),
          Qz(TiledMatrix::padded(size)),
          Cz(TiledMatrix::padded(size)),
          terms(size),
          row(TiledMatrix::padded(size)),
          Quu(m * m),
          factors(m * m),
          K(m, x),
          Qux(m, x),
          rest(m, x),
          residual(m) {
        for (int i = 0; i < x; ++i) {
            gradient[i] = costate[i] = terminal_gradient[i];
            std::copy_n(terminal_hessian + i * x, x, W[i]);
            scale[i] = std::sqrt(std::abs(W[i][i]));
        }
    }

    // A pass over a block of steps, with each control held over `hold` of them; blocks follow each other from the last
    // to the first. Returns -1, or the decision without a minimum.
    std::ptrdiff_t run(double h, int hold, double regularization, const ExpandedSteps& steps, const Gains& gains) {
#if defined(__x86_64__) && defined(__GNUC__)
        if (has_avx2()) return run_avx2(h, hold, regularization, steps, gains);
#endif
        return run_steps(h, hold, regularization, steps, gains);
    }

    int dof() const { return n; }
    int controls() const { return m; }

    Found found;

  private:
#if defined(__x86_64__) && defined(__GNUC__)
    [[gnu::target("avx2"), gnu::flatten]] std::ptrdiff_t run_avx2(double h, int hold, double regularization,
                                                                  const ExpandedSteps& steps, const Gains& gains) {
        return run_steps(h, hold, regularization, steps, gains);
    }
#endif

    [[gnu::always_inline]] inline std::ptrdiff_t run_steps(double h, int hold, double regularization,
                                                           const ExpandedSteps& steps, const Gains& gains) {
        if (steps.one_hessian) common = shape_of(steps.hessian);
        for (std::ptrdiff_t s = steps.steps - 1; s >= 0; --s) {
            if (gains.costate) std::copy_n(costate.data(), x, gains.costate + s * x);
            carry(steps, s, steps.rate || (s + 1) % hold != 0);
            if (steps.processes > 0) add_noise(h, steps, s, gains.spread + s * x * x);
            add_running_cost(h, steps, s);
            const bool decides = s % hold == 0;
            mirror(Q, {decides ? x : 0, size});
            if (!decides) {
                keep();
            } else if (!decide(regularization, steps, s / hold, gains)) {
                return s / hold;
            }
        }
        return -1;
    }

    // Q and its gradients from the value after step s. With `held`, the value has rows for the control: that of the
    // next step, or the previous control of a change with a cost.
    void carry(const ExpandedSteps& steps, std::ptrdiff_t s, bool held) {
        step.load(steps, s);
        std::fill_n(terms.begin(), size, 0.0);
        for (int c = 0; c < size; ++c) {
            Qz[c] = c < x ? 0.0 : gradient[c];
            Cz[c] = c < x ? 0.0 : costate[c];
        }
        for (int i = 0; i < x; ++i) {
            const double* __restrict row_of_J = step.J[i];
            double* __restrict magnitude = terms.data();
            for (int c = 0; c < size; ++c) magnitude[c] += std::abs(row_of_J[c]) * scale[i];
        }
        add_rows(gradient.data(), step.J, x, Qz.data(), size);
        add_rows(costate.data(), step.J, x, Cz.data(), size);
        for (int c = x; c < size; ++c) terms[c] = std::sqrt(terms[c] * terms[c] + scale[c] * scale[c]);
        transposed_product(W, step.J, x, T, held ? size : x);
        if (steps.curvature) {
            for (int r = 0; r < size; ++r) std::copy_n(steps.curvature + (s * size + r) * size, size, Q[r]);
            add_transposed_product(step.J, T, x, Q, size, Part::upper);
        } else {
            transposed_product(step.J, T, x, Q, size, Part::upper);
        }
        if (!held) return;
        for (int r = x; r < size; ++r) {
            for (int c = 0; c < size; ++c) Q[c][r] += T[r][c];
            for (int c = x; c < size; ++c) Q[r][c] += T[r][c] + W[r][c];
        }
    }

    // What a Hessian H of the running cost depends on.
    struct Shape {
        int begin, end;  // rows of (q, v); begin >= end for none
        bool crossed;    // whether there are entries in (u, q) or (u, v)
    };
    Shape shape_of(const double* H) const {
        const auto empty = [](const double* row, int count) {
            return std::all_of(row, row + count, [](double entry) { return entry == 0.0; });
        };
        Shape shape{0, x, false};
        while (shape.end > 0 && empty(H + (shape.end - 1) * size, size)) --shape.end;
        while (shape.begin < shape.end && empty(H + shape.begin * size, size)) ++shape.begin;
        for (int r = x; r < size; ++r) shape.crossed = shape.crossed || !empty(H + r * size, x);
        return shape;
    }

    // The rows of (q, v) on which the running cost at a sample depends.
    Range rows_of(const double* g, const Shape& shape) const {
        const bool none = shape.begin >= shape.end;
        int begin = none ? x : shape.begin, end = none ? 0 : shape.end;
        for (int i = x; i > end; --i) {
            if (g[i - 1] != 0.0) end = i;
        }
        for (int i = 0; i < begin; ++i) {
            if (g[i] != 0.0) begin = i;
        }
        return {std::min(begin, end), end};
    }

    // T = factor H D in these rows of the running cost's Hessian.
    void weigh(double factor, const double* H, const TiledMatrix& of, Range rows) {
        for (int i = rows.begin; i < rows.end; ++i) {
            std::fill_n(T[i], T.stride(), 0.0);
            for (int j = rows.begin; j < rows.end; ++j) {
                const double entry = factor * H[i * size + j];
                if (entry != 0.0) add_scaled_row(entry, of[j], of.stride(), T[i]);
            }
        }
    }

    // Add the samples h w l(z) of step s, with z = D (x, u).
    void add_running_cost(double h, const ExpandedSteps& steps, std::ptrdiff_t s) {
        const auto samples = static_cast<std::ptrdiff_t>(steps.rule.size());
        for (std::ptrdiff_t sample = 0; sample < samples; ++sample) {
            const std::ptrdiff_t point = s * samples + sample;
            const double* g = steps.gradient_at(point);
            const double* H = steps.hessian_at(point);
            const double weight = h * steps.rule[sample].weight;
            const Shape shape = steps.one_hessian ? common : shape_of(H);
            const Range rows = rows_of(g, shape);
            step.expand(steps.rule[sample], rows);
            std::fill_n(row.begin(), x, 0.0);
            std::copy_n(g + x, m, row.begin() + x);
            add_rows(g, step.D, rows, row.data(), size);
            add_row(weight, row.data(), Qz);
            add_row(weight, row.data(), Cz);
            weigh(weight, H, step.D, rows);
            add_transposed_product(step.D, T, rows, Q, size, Part::upper);
            for (int r = x; r < size; ++r) {
                for (int i = rows.begin; shape.crossed && i < rows.end; ++i) {
                    const double entry = weight * H[r * size + i];
                    if (entry == 0.0) continue;
                    for (int c = 0; c < size; ++c) Q[c][r] += entry * step.D[i][c];
                    for (int c = x; c < size; ++c) Q[r][c] += entry * step.D[i][c];
                }
                for (int c = x; c < size; ++c) Q[r][c] += weight * H[r * size + c];
            }
        }
    }

    // Add the terms of the noise, including running costs sampled after the kick; writes S into `spread`.
    void add_noise(double h, const ExpandedSteps& steps, std::ptrdiff_t s, double* spread) {
        const auto samples = static_cast<std::ptrdiff_t>(steps.rule.size());
        for (int i = 0; i < x; ++i) {
            for (int j = 0; j < x; ++j) S[i][j] = h * W[i][j];
        }
        if (steps.within) {
            const double* more = steps.within + s * x * x;
            for (int i = 0; i < x; ++i) {
                for (int j = 0; j < x; ++j) S[i][j] += h * more[i * x + j];
            }
        }
        for (std::ptrdiff_t k = 0; k < samples; ++k) {
            if (!step.expand_after(steps.rule[k])) continue;
            const double* H = steps.hessian_at(s * samples + k);
            const Range rows = rows_of(steps.gradient_at(s * samples + k), steps.one_hessian ? common : shape_of(H));
            weigh(h * h * steps.rule[k].weight, H, step.P, rows);
            add_transposed_product(step.P, T, rows, S, x, Part::upper);
        }
        mirror(S, x);
        for (int i = 0; i < x; ++i) std::copy_n(S[i], x, spread + i * x);
        for (int w = 0; w < steps.processes; ++w) {
            const bool depends = step.read_process(steps, s, w);
            std::fill_n(row.begin(), x, 0.0);
            for (int i = 0; i < x; ++i) add_row(step.jump[i], S[i], row, x);
            for (int i = 0; i < x; ++i) found.noise += 0.5 * step.jump[i] * row[i];
            if (!depends) continue;
            for (int i = 0; i < x; ++i) {
                add_row(row[i], step.F[i], Qz);
                add_row(row[i], step.F[i], Cz);
            }
            transposed_product(S, step.F, x, T, x);
            add_transposed_product(step.F, T, x, Q, size, Part::upper);
        }
    }

    // The value before a step whose control is held: Q itself.
    void keep() {
        for (int c = 0; c < size; ++c) {
            gradient[c] = Qz[c];
            costate[c] = Cz[c];
            scale[c] = c < x ? std::sqrt(std::abs(Q[c][c])) : terms[c];
            std::copy_n(Q[c], size, W[c]);
        }
        of_control = true;
    }

    // Gains of decision r, and the value under them; false where Quu is not positive definite.
    bool decide(double regularization, const ExpandedSteps& steps, std::ptrdiff_t r, const Gains& gains) {
        const double* rate = steps.rate ? steps.rate + r * m * m : nullptr;
        const double* pull = steps.rate ? steps.pull + r * m : nullptr;
        if (rate) add_rate(rate, pull);
        if (!regularize(regularization)) return false;
        factors = Quu;
        for (int i = 0; i < m; ++i) {
            if (!steps.holds(r, i)) continue;
            for (int j = 0; j < m; ++j) factors[i * m + j] = factors[j * m + i] = i == j ? 1.0 : 0.0;
        }
        if (!factor_ldl(factors.data(), m, {0, m})) return false;
        double* k = gains.feedforward + r * m;
        for (int i = 0; i < m; ++i) k[i] = steps.holds(r, i) ? 0.0 : -Qz[x + i];
        solve_ldl(factors.data(), m, {0, m}, k, k);
        for (int i = 0; i < m; ++i) {
            if (steps.holds(r, i)) continue;
            const double largest = std::max(terms[x + i] * terms[x + i], std::abs(Q[x + i][x + i]));
            found.loss = std::max(found.loss, epsilon * largest / factors[i * m + i]);
        }
        find_feedback(steps, r);
        for (int i = 0; i < m; ++i) std::copy_n(K[i], x, gains.feedback + (r * m + i) * x);
        if (gains.factors) std::copy_n(factors.begin(), m * m, gains.factors + r * m * m);
        std::copy_n(Cz.begin() + x, m, gains.control_gradient + r * m);
        minimized_value(k);
        if (rate) value_of_previous(steps, r, k, gains.previous + r * m * m);
        return true;
    }

    // Add the cost of the change of a control, in that control.
    void add_rate(const double* rate, const double* pull) {
        for (int i = 0; i < m; ++i) {
            Qz[x + i] += pull[i];
            Cz[x + i] += pull[i];
            for (int j = 0; j < m; ++j) Q[x + i][x + j] += rate[i * m + j];
        }
    }

    // Quu with each control regularized in proportion to its own diagonal entry, independent of units. A control
    // without any effect is not regularized, if there are others. False if the diagonal is not positive.
    bool regularize(double regularization) {
        double largest = 0.0;
        for (int i = 0; i < m; ++i) largest = std::max(largest, std::abs(Q[x + i][x + i]));
        for (int i = 0; i < m; ++i) {
            std::copy_n(Q[x + i] + x, m, &Quu[i * m]);
            double& pivot = Quu[i * m + i];
            pivot += regularization * std::abs(pivot);
            if (largest > 0.0 && pivot == 0.0 && is_idle(i)) pivot = largest;
            if (!(pivot > 0.0)) return false;
        }
        return true;
    }

    // Whether control i has no effect.
    bool is_idle(int i) const {
        return Qz[x + i] == 0.0 && std::all_of(Q[x + i], Q[x + i] + size, [](double entry) { return entry == 0.0; });
    }

    // K = -Quu^-1 Qux, zero for controls that are held.
    void find_feedback(const ExpandedSteps& steps, std::ptrdiff_t r) {
        for (int i = 0; i < m; ++i) {
            std::copy_n(Q[x + i], x, Qux[i]);
            const double sign = steps.holds(r, i) ? 0.0 : -1.0;
            std::transform(Qux[i], Qux[i] + x, K[i], [sign](double entry) { return sign * entry; });
        }
        solve_ldl_rows(factors.data(), m, K[0], K.stride());
    }

    // The value in x before a decision: V_xx = Q_xx + K'(Quu K + Qux) + Qux'K, valid for regularized gains too.
    void minimized_value(const double* k) {
        for (int i = 0; i < m; ++i) {
            double moved = 0.0;
            std::copy_n(Qux[i], x, rest[i]);
            for (int j = 0; j < m; ++j) moved += Q[x + i][x + j] * k[j];
            add_rows(Q[x + i] + x, K, m, rest[i], x);
            found.slope += Qz[x + i] * k[i];
            found.curvature += k[i] * moved;
            residual[i] = moved + Qz[x + i];
            add_row(residual[i], K[i], Qz, x);
            add_row(k[i], Qux[i], Qz, x);
        }
        if (of_control) W.clear();
        of_control = false;
        for (int b = 0; b < x; ++b) {
            gradient[b] = Qz[b];
            costate[b] = Cz[b];
            scale[b] = std::sqrt(std::abs(Q[b][b]));
            std::copy_n(Q[b], x, W[b]);
        }
        for (int c = x; c < size; ++c) gradient[c] = costate[c] = scale[c] = 0.0;
        add_transposed_product(K, rest, m, W, x, Part::upper);
        add_transposed_product(Qux, K, m, W, x, Part::upper);
        mirror(W, x);
    }

    // Gains G on the previous control of a decision, and the rows and columns of the value in it, (O6).
    void value_of_previous(const ExpandedSteps& steps, std::ptrdiff_t r, const double* k, double* G) {
        const double *R = steps.rate + r * m * m, *pull = steps.pull + r * m;
        for (int i = 0; i < m; ++i) {
            for (int c = 0; c < m; ++c) G[i * m + c] = steps.holds(r, i) ? 0.0 : R[i * m + c];
        }
        solve_ldl_rows(factors.data(), m, G, m);
        of_control = true;
        for (int c = 0; c < m; ++c) {
            gradient[x + c] = costate[x + c] = -pull[c];
            scale[x + c] = std::sqrt(std::abs(R[c * m + c]));
            for (int i = 0; i < m; ++i) gradient[x + c] += G[i * m + c] * residual[i] - R[i * m + c] * k[i];
        }
        for (int c = 0; c < m; ++c) {
            // V_xw = (Quu K + Qux)' G - K' R
            for (int b = 0; b < x; ++b) {
                double total = 0.0;
                for (int i = 0; i < m; ++i) total += rest[i][b] * G[i * m + c] - K[i][b] * R[i * m + c];
                W[b][x + c] = W[x + c][b] = total;
            }
            // V_ww = R + G' (Quu G - R) - R G
            for (int b = 0; b <= c; ++b) {
                double total = R[b * m + c];
                for (int i = 0; i < m; ++i) {
                    double product = -R[i * m + c];
                    for (int j = 0; j < m; ++j) product += Q[x + i][x + j] * G[j * m + c];
                    total += G[i * m + b] * product - R[i * m + b] * G[i * m + c];
                }
                W[x + b][x + c] = W[x + c][x + b] = total;
            }
        }
    }

    static void add_row(double factor, const double* from, std::vector<double>& to, int count) {
        detail::subtract_scaled(to.data(), -factor, from, 0, count);
    }
    void add_row(double factor, const double* from, std::vector<double>& to) const { add_row(factor, from, to, size); }

    static constexpr double epsilon = std::numeric_limits<double>::epsilon();

    int n, m, x, size;  // x = 2n states, and controls
    // The value: its Hessian, its gradient, and
    TiledMatrix W;
    bool of_control = false;  // whether it has rows for a control
    std::vector<double> gradient;
    std::vector<double> costate;  // the gradient of the cost, without feedback and feed-forward
    std::vector<double> scale;    // the rounding error of entry (i, j) of W is about eps scale_i scale_j

    // Work arrays of a step.
    LinearStep step;
    TiledMatrix S;              // (x, x)
    TiledMatrix T;              // (size, size) a product
    TiledMatrix Q;              // (size, size); upper triangle alone until the decision, which has its rows in u
    Shape common{};             // of the one Hessian of all samples
    std::vector<double> Qz;     // (size) gradient, in whole tiles
    std::vector<double> Cz;     // (size) gradient of the cost itself, in whole tiles
    std::vector<double> terms;  // (size) of Q, as the scale of the value
    std::vector<double> row;    // (size) in whole tiles
    // And of a decision.
    std::vector<double> Quu,
        factors;               // (m, m) regularized; L D L' of it, with rows and columns that are held of the identity
    TiledMatrix K, Qux, rest;  // (m, x); the last is Quu K + Qux
    std::vector<double> residual;  // (m) Quu k + Qu
};

}  // namespace varpin
