// A quadratic function's minimum in a box, by a primal active set (Nocedal and Wright, Numerical Optimization, 16.5);
// docs/mathematics.md, "Limits". Control-limited differential dynamic programming (Tassa, Mansard and Todorov 2014)
// projects Newton steps onto the box instead. For ill-conditioned Hessians that may end at a point from which no
// projected step descends.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "varpin/dense.hpp"

namespace varpin {

// The decision within limits.
class BoxMinimum {
  public:
    explicit BoxMinimum(int size) : factors(size * size), held(size), m(size), downhill(size), step(size) {}

    // The x (m) with least <= x <= greatest that minimizes g.x + (1/2) x'Hx, from a first guess in x; H (m, m) is
    // positive definite. False if it is not, or if the iteration does not end.
    bool solve(const double* H, const double* g, const double* least, const double* greatest, double* x) {
        for (int i = 0; i < m; ++i) x[i] = clipped(x[i], least[i], greatest[i]);
        for (int i = 0; i < m; ++i) {
            const double slope = gradient(H, g, x, i).value;
            held[i] = (x[i] <= least[i] && slope >= 0.0) || (x[i] >= greatest[i] && slope <= 0.0);
        }
        for (int iteration = 0; iteration < 10 * m + 10; ++iteration) {
            if (!find_step(H, g, x)) return false;
            if (go(least, greatest, x)) continue;
            const int freed = most_to_gain(H, g, least, greatest, x);
            if (freed < 0) return true;
            held[freed] = false;
        }
        return false;
    }

    std::vector<double> factors;  // (m, m) L D L' of H with held rows and columns replaced by those of the identity
    std::vector<char> held;       // (m) whether the box holds an entry

  private:
    // An entry of the gradient below this part of its cancelling terms counts as zero.
    static constexpr double rounding = 1e-13;

    struct Entry {
        double value, size;  // the sum, and that of the magnitudes
    };

    Entry gradient(const double* H, const double* g, const double* x, int i) const {
        Entry sum{g[i], std::abs(g[i])};
        for (int j = 0; j < m; ++j) {
            const double term = H[i * m + j] * x[j];
            sum.value += term;
            sum.size += std::abs(term);
        }
        return sum;
    }

    // NaN becomes the least.
    static double clipped(double x, double least, double greatest) { return std::min(std::max(least, x), greatest); }

    // The step to the minimum over the free entries.
    bool find_step(const double* H, const double* g, const double* x) {
        for (int i = 0; i < m; ++i) {
            downhill[i] = held[i] ? 0.0 : -gradient(H, g, x, i).value;
            for (int j = 0; j < m; ++j) factors[i * m + j] = held[i] || held[j] ? 0.0 : H[i * m + j];
            if (held[i]) factors[i * m + i] = 1.0;
        }
        if (!factor_ldl(factors.data(), m, {0, m})) return false;
        solve_ldl(factors.data(), m, {0, m}, downhill.data(), step.data());
        return true;
    }

    // Move along the step until the first free entry reaches a limit; returns whether one did.
    bool go(const double* least, const double* greatest, double* x) {
        double length = 1.0;
        int first = -1;
        for (int i = 0; i < m; ++i) {
            if (held[i]) continue;
            const double distance = std::abs((step[i] < 0.0 ? least[i] : greatest[i]) - x[i]);
            if (std::abs(step[i]) * length > distance) {
                length = distance / std::abs(step[i]);
                first = i;
            }
        }
        for (int i = 0; i < m; ++i) {
            if (!held[i]) x[i] = clipped(x[i] + length * step[i], least[i], greatest[i]);
        }
        if (first < 0) return false;
        held[first] = true;
        x[first] = step[first] < 0.0 ? least[first] : greatest[first];
        return true;
    }

    // The held entry whose release would decrease the function most, or -1 if there is none.
    int most_to_gain(const double* H, const double* g, const double* least, const double* greatest,
                     const double* x) const {
        double most = 0.0;
        int best = -1;
        for (int i = 0; i < m; ++i) {
            if (!held[i] || least[i] == greatest[i]) continue;
            const Entry slope = gradient(H, g, x, i);
            const double gain = (x[i] <= least[i] ? -slope.value : slope.value) - rounding * slope.size;
            if (gain > most) {
                most = gain;
                best = i;
            }
        }
        return best;
    }

    int m;
    std::vector<double> downhill, step;
};

}  // namespace varpin
