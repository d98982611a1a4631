// Input and output of a backward pass over N steps: views of row-major arrays, with x = (q, p) or (q, v) of 2n entries
// and m controls. docs/mathematics.md, "The backward pass".
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/simd.hpp"

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

}  // namespace varpin
