// The backward pass of stochastic differential dynamic programming (Theodorou, Tassa and Todorov 2010).
// docs/mathematics.md, "The backward pass" and "Digits"; equation (O2). The value after a step depends on the control u
// only while it is held over several steps. S = h Wxx weighs the jumps of noise.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/simd.hpp"

namespace varpin {

// Views are of row-major arrays over N steps, with x = (q, p) or (q, v) of 2n entries and m controls.

// The linearized dynamics and the expanded costs.
struct ExpandedSteps {
    std::ptrdiff_t steps = 0;  // N
    int dof = 0;
    int controls = 0;
    int processes = 0;                 // k
    const double* A = nullptr;         // (N, 2n, 2n)
    const double* B = nullptr;         // (N, 2n, m)
    const double* G = nullptr;         // (N, 2n, k) change of x per unit of each process
    const double* Gx = nullptr;        // (N, 2n, k, 2n)
    const double* Gu = nullptr;        // (N, 2n, k, m)
    const double* gradient = nullptr;  // (N, 2n + m) of the running cost in (x, u) at the start of each step
    const double* hessian = nullptr;   // (N, 2n + m, 2n + m), or one for all steps
    bool one_hessian = false;

    int states() const { return 2 * dof; }
    int size() const { return 2 * dof + controls; }
    const double* gradient_at(std::ptrdiff_t s) const { return gradient + s * size(); }
    const double* hessian_at(std::ptrdiff_t s) const { return one_hessian ? hessian : hessian + s * size() * size(); }
};

// One step in (x, u): its linearization and the jumps of noise.
class LinearStep {
  public:
    LinearStep(int dof, int controls) : x(2 * dof), size(2 * dof + controls) {}

    const int x, size;
    TiledMatrix J{x, size};  // [A B]
    TiledMatrix F{x, size};  // of a process' jump
    std::vector<double> jump = zeros(x);

    // Load step s: J.
    void load(const ExpandedSteps& steps, std::ptrdiff_t s) {
        const int m = size - x;
        for (int i = 0; i < x; ++i) {
            std::copy_n(steps.A + (s * x + i) * x, x, J[i]);
            std::copy_n(steps.B + (s * x + i) * m, m, J[i] + x);
        }
    }

    // The jump of process w, and F; false if F is zero.
    bool read_process(const ExpandedSteps& steps, std::ptrdiff_t s, int w) {
        const int m = size - x;
        bool depends = false;
        for (int i = 0; i < x; ++i) {
            const std::ptrdiff_t entry = (s * x + i) * steps.processes + w;
            jump[i] = steps.G[entry];
            std::copy_n(steps.Gx + entry * x, x, F[i]);
            std::copy_n(steps.Gu + entry * m, m, F[i] + x);
            for (int c = 0; c < size; ++c) depends = depends || F[i][c] != 0.0;
        }
        return depends;
    }
};

// Gains of u + k + K (x - x_nominal) for each of R decisions, and further results.
struct Gains {
    double* feedforward = nullptr;       // (R, m)
    double* feedback = nullptr;          // (R, m, 2n)
    double* control_gradient = nullptr;  // (R, m) gradient of the cost in each control
    double* spread = nullptr;            // (N, 2n, 2n) S, with noise only
    double* factors = nullptr;           // (R, m, m) L D L' of the regularized Quu, or null
};

// A plan on N linearized steps, whose controls are each held over `hold` of them.
struct LinearizedPlan {
    std::ptrdiff_t steps = 0;  // N
    int states = 0;            // 2n
    int controls = 0;          // m
    int hold = 1;
    const double* A = nullptr;            // (N, 2n, 2n)
    const double* B = nullptr;            // (N, 2n, m)
    const double* feedforward = nullptr;  // (R, m)
    const double* feedback = nullptr;     // (R, m, 2n)
    const double* slack = nullptr;        // (R, 2, m) lower and upper limit of the change of each control, or null
};

// The changes of the controls, each clipped to its limits, into `moves` (R, m), and the deviations of the state after
// each step into `after` (N, 2n), of the linearized motion from the nominal state. True where a control reaches a
// limit.
inline bool predict(const LinearizedPlan& plan, double* moves, double* after) {
    const int x = plan.states, m = plan.controls;
    const std::vector<double> start(x);
    const double* state = start.data();
    bool limited = false;
    for (std::ptrdiff_t s = 0; s < plan.steps; ++s) {
        const std::ptrdiff_t r = s / plan.hold;
        double* move = moves + r * m;
        for (int i = 0; i < m && s % plan.hold == 0; ++i) {
            const double* row = plan.feedback + (r * m + i) * x;
            move[i] = plan.feedforward[r * m + i];
            for (int c = 0; c < x; ++c) move[i] += row[c] * state[c];
            if (!plan.slack) continue;
            const double *least = plan.slack + r * 2 * m, *most = least + m;
            limited = limited || move[i] <= least[i] || move[i] >= most[i];
            move[i] = std::min(std::max(move[i], least[i]), most[i]);
        }
        const double *A = plan.A + s * x * x, *B = plan.B + s * x * m;
        double* next = after + s * x;
        for (int i = 0; i < x; ++i) {
            double total = 0.0;
            for (int c = 0; c < x; ++c) total += A[i * x + c] * state[c];
            for (int c = 0; c < m; ++c) total += B[i * m + c] * move[c];
            next[i] = total;
        }
        state = next;
    }
    return limited;
}

// Sums over a pass.
struct Found {
    double slope = 0.0;      // of Qu . k
    double curvature = 0.0;  // of k . Quu k
    double noise = 0.0;      // of the cost of noise
    double loss = 0.0;       // largest relative rounding error of a pivot of Quu, or of its root
};

// The recursion (O2) over the steps, from the last to the first.
class BackwardPass {
  public:
    // Starts from the gradient (2n) and the Hessian (2n, 2n) of the terminal cost in x.
    BackwardPass(int dof, int controls, const double* terminal_gradient, const double* terminal_hessian)
        : n(dof), m(controls), x(2 * dof), size(2 * dof + controls), step(dof, controls) {
        for (int i = 0; i < x; ++i) {
            gradient[i] = costate[i] = terminal_gradient[i];
            std::copy_n(terminal_hessian + i * x, x, W[i]);
            scale[i] = std::sqrt(std::abs(W[i][i]));
        }
    }

    // A pass over a block of steps, with each control held over `hold` of them; blocks follow each other from the last
    // to the first. Returns -1, or the decision without a minimum.
    std::ptrdiff_t run(double h, int hold, double regularization, const ExpandedSteps& steps, const Gains& gains) {
#if defined(__x86_64__)
        if (has_avx2()) return run_avx2(h, hold, regularization, steps, gains);
#endif
        return run_steps(h, hold, regularization, steps, gains);
    }

    int dof() const { return n; }
    int controls() const { return m; }

    Found found;

  private:
#if defined(__x86_64__)
    [[gnu::target("avx2"), gnu::flatten]] std::ptrdiff_t run_avx2(double h, int hold, double regularization,
                                                                  const ExpandedSteps& steps, const Gains& gains) {
        return run_steps(h, hold, regularization, steps, gains);
    }
#endif

    [[gnu::always_inline]] inline std::ptrdiff_t run_steps(double h, int hold, double regularization,
                                                           const ExpandedSteps& steps, const Gains& gains) {
        for (std::ptrdiff_t s = steps.steps - 1; s >= 0; --s) {
            carry(steps, s, (s + 1) % hold != 0);
            if (steps.processes > 0) add_noise(h, steps, s, gains.spread + s * x * x);
            add_running_cost(h, steps, s);
            const bool decides = s % hold == 0;
            mirror(Q, {decides ? x : 0, size});
            if (!decides) {
                keep();
            } else if (!decide(regularization, s / hold, gains)) {
                return s / hold;
            }
        }
        return -1;
    }

    // Q and its gradients from the value after step s. With `held`, the value has rows for the control, which stays.
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
        transposed_product(step.J, T, x, Q, size, Part::upper);
        if (!held) return;
        for (int r = x; r < size; ++r) {
            for (int c = 0; c < size; ++c) Q[c][r] += T[r][c];
            for (int c = x; c < size; ++c) Q[r][c] += T[r][c] + W[r][c];
        }
    }

    // Add h l(x, u) of step s; the Hessian in (x, u) is that of its rows in u.
    void add_running_cost(double h, const ExpandedSteps& steps, std::ptrdiff_t s) {
        const double *g = steps.gradient_at(s), *H = steps.hessian_at(s);
        for (int r = 0; r < size; ++r) {
            Qz[r] += h * g[r];
            Cz[r] += h * g[r];
            for (int c = r; c < (r < x ? x : size); ++c) Q[r][c] += h * H[r * size + c];
            for (int c = 0; r >= x && c < x; ++c) Q[c][r] += h * H[r * size + c];
        }
    }

    // Add the terms of the noise; writes S into `spread`.
    void add_noise(double h, const ExpandedSteps& steps, std::ptrdiff_t s, double* spread) {
        for (int i = 0; i < x; ++i) {
            for (int j = 0; j < x; ++j) S[i][j] = h * W[i][j];
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
    bool decide(double regularization, std::ptrdiff_t r, const Gains& gains) {
        if (!regularize(regularization)) return false;
        factors = Quu;
        if (!factor_ldl(factors.data(), m, {0, m})) return false;
        double* k = gains.feedforward + r * m;
        for (int i = 0; i < m; ++i) k[i] = -Qz[x + i];
        solve_ldl(factors.data(), m, {0, m}, k, k);
        for (int i = 0; i < m; ++i) {
            const double largest = std::max(terms[x + i] * terms[x + i], std::abs(Q[x + i][x + i]));
            found.loss = std::max(found.loss, epsilon * largest / factors[i * m + i]);
        }
        find_feedback();
        for (int i = 0; i < m; ++i) std::copy_n(K[i], x, gains.feedback + (r * m + i) * x);
        if (gains.factors) std::copy_n(factors.begin(), m * m, gains.factors + r * m * m);
        std::copy_n(Cz.begin() + x, m, gains.control_gradient + r * m);
        minimized_value(k);
        return true;
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

    // K = -Quu^-1 Qux.
    void find_feedback() {
        for (int i = 0; i < m; ++i) {
            std::copy_n(Q[x + i], x, Qux[i]);
            std::transform(Qux[i], Qux[i] + x, K[i], [](double entry) { return -entry; });
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
            add_row(moved + Qz[x + i], K[i], Qz, x);
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

    static void add_row(double factor, const double* from, std::vector<double>& to, int count) {
        detail::subtract_scaled(to.data(), -factor, from, 0, count);
    }
    void add_row(double factor, const double* from, std::vector<double>& to) const { add_row(factor, from, to, size); }

    static constexpr double epsilon = std::numeric_limits<double>::epsilon();

    int n, m, x, size;  // x = 2n states, and controls
    // The value: its Hessian, its gradient, and
    TiledMatrix W{size, size};
    bool of_control = false;  // whether it has rows for a control
    std::vector<double> gradient = zeros(size);
    std::vector<double> costate = zeros(size);  // the gradient of the cost, without feedback and feed-forward
    std::vector<double> scale = zeros(size);    // the rounding error of entry (i, j) of W is about eps scale_i scale_j

    // Work arrays of a step.
    LinearStep step;
    TiledMatrix S{x, x};
    TiledMatrix T{size, size};  // a product
    TiledMatrix Q{size, size};  // (size, size); upper triangle alone until the decision, which has its rows in u
    std::vector<double> Qz = zeros(TiledMatrix::padded(size));   // gradient, in whole tiles
    std::vector<double> Cz = zeros(TiledMatrix::padded(size));   // gradient of the cost itself, in whole tiles
    std::vector<double> terms = zeros(size);                     // of Q, as the scale of the value
    std::vector<double> row = zeros(TiledMatrix::padded(size));  // in whole tiles
    // And of a decision.
    std::vector<double> Quu = zeros(m, m), factors = zeros(m, m);  // regularized; L D L' of it
    TiledMatrix K{m, x}, Qux{m, x}, rest{m, x};                    // (m, x); the last is Quu K + Qux
};

}  // namespace varpin
