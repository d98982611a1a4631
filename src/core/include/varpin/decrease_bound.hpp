// The cost at stake along a motion. docs/mathematics.md, equation (O9).
#pragma once

#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace varpin {

// Sums over quadratic models g . dz + (1/2) dz' H dz at some points.
struct DecreaseBound {
    double free = 0.0;   // decrease if each variable were free; infinite where a model has no minimum
    double moved = 0.0;  // the same, with each model's decrease bounded by its change over a displacement

    // Add the model of `size` variables at a point with its displacement.
    void add(const double* g, const double* H, const double* displacement, std::size_t size) {
        step_.resize(size);
        double slope = 0.0;
        bool endless = false;
        for (std::size_t i = 0; i < size; ++i) {
            // Steepest descent, scaled by the diagonal: exact where no variables are coupled.
            const bool curved = H[i * size + i] > 0.0;
            step_[i] = curved ? g[i] / H[i * size + i] : 0.0;
            slope += g[i] * step_[i];
            endless = endless || (g[i] != 0.0 && !curved);
        }
        const double curvature = form(H, step_.data(), size);
        double fall = slope > 0.0 ? 0.5 * slope * slope / (curvature > 0.0 ? curvature : 1.0) : 0.0;
        if (endless || (slope > 0.0 && curvature <= 0.0)) fall = std::numeric_limits<double>::infinity();
        const double change = 0.5 * form(H, displacement, size), bound = change <= 0.0 ? 0.0 : change;
        free += fall;
        moved += bound < fall || std::isnan(bound) ? bound : fall;
    }

  private:
    // z' H z. The sum z' H goes row by row of H, since a compiler may not reorder the sums of H z.
    double form(const double* H, const double* z, std::size_t size) {
        sums_.assign(size, 0.0);
        double* __restrict sums = sums_.data();
        for (std::size_t i = 0; i < size; ++i) {
            if (z[i] == 0.0) continue;
            const double* __restrict row = H + i * size;
            for (std::size_t j = 0; j < size; ++j) sums[j] += z[i] * row[j];
        }
        double total = 0.0;
        for (std::size_t j = 0; j < size; ++j) total += sums[j] * z[j];
        return total;
    }

    std::vector<double> step_, sums_;
};

}  // namespace varpin
