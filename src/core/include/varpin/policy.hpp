// What drives a step from outside: controls with their feedback, and the impulses of noise.
// docs/mathematics.md, "Noise". Controls u = u_r + gains_r (x - reference_r), r the decision; an impulse is
// sum_i F_i(q, u) dw_i. Controls that change within a step are given at the stages of the method; u is their mean then.
#pragma once

#include <cmath>
#include <cstddef>

#include "varpin/tree.hpp"

namespace varpin {

// Decisions, each held over `hold` steps; x is (first, second) or (first, second, the control before).
struct Commands {
    int controls = 0;                   // m
    int hold = 1;                       // steps between two looks at the state
    const double* u = nullptr;          // (R, m)
    const double* gains = nullptr;      // (R, m, width), or null for none
    const double* reference = nullptr;  // (R, width)
    int width = 0;                      // 2n, or 2n + m where the control before belongs to x
    const double* least = nullptr;      // (m) infinite where there is no limit
    const double* greatest = nullptr;   // (m)
    const double* before = nullptr;     // (P, m) the control before the first of each path, or null for the reference's
    const double* within = nullptr;     // (N, s, m) at the stages of each step, or null where they are held over it
};

// Controls of step s of a path into row s of u (N, m). Beyond a limit a control is that limit.
inline void apply_policy(const Commands& commands, std::ptrdiff_t path, std::ptrdiff_t s, int n, const double* first,
                         const double* second, double* u) {
    const int m = commands.controls;
    double* decision = u + s * m;
    const double* last = s > 0 ? decision - m : commands.before ? commands.before + path * m : nullptr;
    if (s % commands.hold != 0) {
        for (int c = 0; c < m; ++c) decision[c] = last[c];
        return;
    }
    const std::ptrdiff_t r = s / commands.hold;
    for (int c = 0; c < m; ++c) {
        double total = commands.u[r * m + c];
        if (commands.gains) {
            const double* gains = commands.gains + (r * m + c) * commands.width;
            const double* reference = commands.reference + r * commands.width;
            for (int j = 0; j < n; ++j) {
                total += gains[j] * (first[j] - reference[j]);
                total += gains[n + j] * (second[j] - reference[n + j]);
            }
            if (commands.width > 2 * n && last) {
                for (int j = 0; j < m; ++j) total += gains[2 * n + j] * (last[j] - reference[2 * n + j]);
            }
        }
        // Neither comparison is true of NaN, which stays.
        if (total < commands.least[c]) total = commands.least[c];
        if (total > commands.greatest[c]) total = commands.greatest[c];
        decision[c] = total;
    }
}

// The force drift + B u that is constant over a step; drift (n) is null for none.
inline void constant_force(const Mechanism& mechanism, const double* drift, const double* u, double* force) {
    for (int r = 0; r < mechanism.dof(); ++r) force[r] = drift ? drift[r] : 0.0;
    for (const Transmission& transmission : mechanism.actuation)
        force[transmission.coordinate] += transmission.ratio * u[transmission.control];
}

// The same at each of `stages` stages, whose controls are the rows of u, into the rows of force (stages, n).
inline void stage_forces(const Mechanism& mechanism, const double* drift, const double* u, int stages, double* force) {
    for (int i = 0; i < stages; ++i)
        constant_force(mechanism, drift, u + i * mechanism.controls, force + i * mechanism.dof());
}

// The impulse part * sum_i F_i(q, u) dw_i.
inline void noise_impulse(const Mechanism& mechanism, double part, const double* q, const double* center,
                          const double* u, const double* increments, double* impulse) {
    const Diffusion& fields = mechanism.diffusion;
    const int n = mechanism.dof(), m = mechanism.controls, k = fields.processes;
    for (int i = 0; i < n; ++i) {
        double total = 0.0;
        for (int w = 0; w < k; ++w) {
            const double offset = q[i] - center[i * k + w];
            double field = fields.constant[i * k + w] + fields.quadratic[i * k + w] * offset * offset;
            for (int c = 0; c < m; ++c) field += fields.control[(i * k + w) * m + c] * u[c];
            total += field * increments[w];
        }
        impulse[i] = part * total;
    }
}

// The centres of the diffusion fields of a rollout that starts at q.
inline void diffusion_centers(const Mechanism& mechanism, const double* q, double* center) {
    const Diffusion& fields = mechanism.diffusion;
    const int k = fields.processes;
    for (int i = 0; i < mechanism.dof(); ++i) {
        for (int w = 0; w < k; ++w) {
            const double given = fields.center[i * k + w];
            center[i * k + w] = std::isnan(given) ? q[i] : given;
        }
    }
}

}  // namespace varpin
