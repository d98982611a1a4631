// Input and output of a backward pass over N steps: views of row-major arrays, with x = (q, p) or (q, v) of 2n entries
// and m controls. docs/mathematics.md, "The backward pass".
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

namespace varpin {

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

// The linearized motion under a plan, each control clipped to its limits, from `state` (2n + m): the deviation of
// the state and of the previous control at the start, overwritten by those at the end. Writes the deviations before
// each decision into `expected` (R, 2n + m), the changes of the controls into `moves` (R, m), and unless it is null
// the states after each step into `after` (N, 2n). True where a control reaches a limit.
inline bool predict(const LinearizedPlan& plan, double* state, double* expected, double* moves,
                    double* after = nullptr) {
    const int x = plan.states, m = plan.controls, size = x + m, hold = plan.hold;
    std::vector<double> next(x);
    bool limited = false;
    for (std::ptrdiff_t s = 0; s < plan.steps; ++s) {
        const std::ptrdiff_t r = s / hold;
        if (s % hold == 0) {
            std::copy_n(state, size, expected + r * size);
            for (int i = 0; i < m; ++i) {
                double move = plan.feedforward[r * m + i];
                const double* row = plan.feedback + (r * m + i) * x;
                for (int c = 0; c < x; ++c) move += row[c] * state[c];
                if (plan.slack) {
                    const double* slack = plan.slack + r * 2 * m;
                    limited = limited || move <= slack[i] || move >= slack[m + i];
                    move = std::min(std::max(move, slack[i]), slack[m + i]);
                }
                moves[r * m + i] = state[x + i] = move;
            }
        }
        const double *A = plan.A + s * x * x, *B = plan.B + s * x * m;
        for (int i = 0; i < x; ++i) {
            double total = 0.0;
            for (int c = 0; c < x; ++c) total += A[i * x + c] * state[c];
            for (int c = 0; c < m; ++c) total += B[i * m + c] * state[x + c];
            next[i] = total;
        }
        std::copy_n(next.data(), x, state);
        if (after) std::copy_n(state, x, after + s * x);
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

}  // namespace varpin
