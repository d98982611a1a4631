// Derivatives of velocities at nodes in the state (q, p). docs/mathematics.md, "Linearization".
#pragma once

#include <algorithm>
#include <cstddef>
#include <limits>

#include "varpin/dense.hpp"
#include "varpin/jet.hpp"
#include "varpin/size.hpp"

namespace varpin {

// The derivative of v in (q, p) (rows, n, 2n), into `slopes`, at each row of q and v (rows, n): at fixed q dv = M^-1
// dp, at fixed p dv = -M^-1 L_vq dq. NaN where M is not positive definite; entries outside of blocks stay. The number
// of joints may be known at compile time.
template <class Size>
void velocity_slopes(const Mechanism& mechanism, std::size_t rows, const double* q, const double* v, double* slopes) {
    const Size n = mechanism.dof();
    const int width = 2 * n;
    Jet<double> jet(mechanism.tree);
    for (std::size_t s = 0; s < rows; ++s) {
        momentum_slopes<Size>(mechanism, q + s * n, v + s * n, jet);
        double* slope = slopes + s * n * width;
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < n; ++j) slope[i * width + j] = -jet.A[i * n + j];
            slope[i * width + n + i] = 1.0;
        }
        for (const Block& block : blocks_of(mechanism.tree, n)) {
            double* first = slope + block.begin * width;
            if (factor_ldl(jet.M.data(), n, block)) {
                solve_ldl_rows(jet.M.data(), n, block, first, width, width);
            } else {
                std::fill_n(first, (block.end - block.begin) * width, std::numeric_limits<double>::quiet_NaN());
            }
        }
    }
}

}  // namespace varpin
