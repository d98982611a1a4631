// One step of a backward pass in (x, u): its linearization, the samples of its running cost, and the jumps of noise.
// docs/mathematics.md, "The backward pass".
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/simd.hpp"
#include "varpin/steps.hpp"

namespace varpin {

class LinearStep {
  public:
    LinearStep(int dof, int controls)
        : J(2 * dof, 2 * dof + controls),
          D(2 * dof, 2 * dof + controls),
          P(2 * dof, 2 * dof),
          F(2 * dof, 2 * dof + controls),
          jump(2 * dof),
          n(dof),
          x(2 * dof),
          size(2 * dof + controls),
          speeds(dof, 2 * dof + controls) {}

    // Load step s: J, and the data of the other functions.
    void load(const ExpandedSteps& steps, std::ptrdiff_t s) {
        const int m = size - x;
        for (int i = 0; i < x; ++i) {
            std::copy_n(steps.A + (s * x + i) * x, x, J[i]);
            std::copy_n(steps.B + (s * x + i) * m, m, J[i] + x);
        }
        before = steps.velocity ? steps.velocity + s * n * x : nullptr;
        after = steps.velocity ? before + n * x : nullptr;
        if (!after) {
            for (int i = 0; i < n; ++i) std::copy_n(J[n + i], size, speeds[i]);
            return;
        }
        for (int i = 0; i < n; ++i) {
            std::fill_n(speeds[i], speeds.stride(), 0.0);
            add_rows(after + i * x, J, x, speeds[i], size);
        }
    }

    // D, the derivative of (q, v) at a sample, in some rows.
    void expand(const Sample& sample, Range rows) {
        for (int row = rows.begin; row < rows.end; ++row) {
            const Sample::Sum& of = row < n ? sample.q : sample.v;
            const int i = row < n ? row : row - n;
            combine_rows(of.q1, J[i], of.v1, speeds[i], size, D[row]);
            add_node(of.q0, of.v0, before, i, D[row]);
        }
    }

    // P, the derivative of (q, v) at a sample in the state after the step; false if it is zero.
    bool expand_after(const Sample& sample) {
        P.clear();
        for (int i = 0; i < n; ++i) {
            add_node(sample.q.q1, sample.q.v1, after, i, P[i]);
            add_node(sample.v.q1, sample.v.v1, after, i, P[n + i]);
        }
        return sample.q.q1 != 0.0 || sample.q.v1 != 0.0 || sample.v.q1 != 0.0 || sample.v.v1 != 0.0;
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

    TiledMatrix J;             // (2n, 2n + m) [A B]
    TiledMatrix D;             // (2n, 2n + m) of (q, v) at the sample
    TiledMatrix P;             // (2n, 2n) of (q, v) in the state after the step
    TiledMatrix F;             // (2n, 2n + m) of a process' jump
    std::vector<double> jump;  // (2n)

  private:
    // Row i of in_q dq/dx + in_v dv/dx at a node; dv/dx (n, 2n) is null for x = (q, v).
    void add_node(double in_q, double in_v, const double* velocity, int i, double* out) const {
        out[i] += in_q;
        if (!velocity) {
            out[n + i] += in_v;
        } else if (in_v != 0.0) {
            detail::subtract_scaled(out, -in_v, velocity + i * x, 0, x);
        }
    }

    int n, x, size;
    TiledMatrix speeds;  // (n, 2n + m) of v after the step
    const double* before = nullptr;
    const double* after = nullptr;
};

}  // namespace varpin
