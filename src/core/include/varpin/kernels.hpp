// The inner loops of steps and of their derivatives, for a number of joints that the compiler knows or does not: the
// same templates, and the same bytes. Everything above them is compiled once. docs/core.md, "Processors".
#pragma once

#include <algorithm>
#include <cstddef>
#include <limits>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/jet.hpp"

namespace varpin {

class Collocation;
class StepEquation;
class EnergyGuard;
struct Guards;
struct Start;

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

// The parts of Collocation are those for a single stage.
struct Kernels {
    void (*jet)(const Mechanism& mechanism, const double* q, const double* v, Jet<double>& w);
    void (*first_order)(const Mechanism& mechanism, const double* q, const double* v, Jet<double>& w);
    double (Collocation::*residuals)(double h, const Start& start);
    bool (Collocation::*factor)(double h);
    void (Collocation::*solve)(const double* right, double* x) const;
    double (Collocation::*kinetic_size)(const double* x) const;
    void (StepEquation::*derivatives)(double h, std::vector<double>& dV, double* Jx, double* Jf);
    double (EnergyGuard::*branch_margin)(double h, const Guards& guards, const Collocation& step);
    bool (EnergyGuard::*factor_mass)(const double* q);
    void (EnergyGuard::*velocity)(const double* p, double* v);
    void (*velocity_slopes)(const Mechanism& mechanism, std::size_t rows, const double* q, const double* v,
                            double* slopes);
};

// Defined in guards.hpp, where all of them are known.
template <class Size>
struct Sized {
    static const Kernels kernels;
};
template <class Size = int>
inline constexpr const Kernels& kernels_for = Sized<Size>::kernels;

}  // namespace varpin
