// One step of a backward pass in (x, u): its linearization and the jumps of noise.
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

}  // namespace varpin
