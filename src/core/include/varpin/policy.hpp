// Inputs of a step: controls with feedback, and noise impulses. docs/mathematics.md, "Noise". Controls are
// u = u_r + gains_r (x - reference_r) with decision r; a noise impulse is sum_i F_i(q, u) dw_i. Controls that change
// within a step are given at the stages of the method, and u is their mean. Or controls are linear in time over the
// steps of each decision, from the previous control to u at the end.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "varpin/mechanism.hpp"
#include "varpin/nodes.hpp"

namespace varpin {

// R decisions, each held over `hold` steps; x is the state, optionally followed by the previous control.
struct Commands {
    int controls = 0;                     // m
    int hold = 1;                         // steps of a decision
    const double* u = nullptr;            // (R, m)
    const double* gains = nullptr;        // (R, m, width), or null for none
    const double* reference = nullptr;    // (R, width)
    int width = 0;                        // 2n, or 2n + m if x has the previous control
    const double* least = nullptr;        // (m) infinite where there is no limit
    const double* greatest = nullptr;     // (m)
    const double* before = nullptr;       // (P, m) control of each path before its first, or null for the reference
    const double* within = nullptr;       // (N, s, m) controls at the stages of each step, or null for constant ones
    const double* stage_times = nullptr;  // (s) times of the stages for linear controls, which need `before`; or null
    std::ptrdiff_t own = 0;               // R where u has rows for each path, (P R, m); 0 where paths share them
    bool sloped = false;                  // whether steps have increments for the slopes of linear controls as well
};

// Number of increments of a step, (N3): one for each process, then one for each whose strength depends on the control
// where these see the slopes of linear controls.
inline std::int64_t increments_of_step(const Mechanism& mechanism, const Commands& commands) {
    const Diffusion& fields = mechanism.diffusion;
    return fields.processes + (commands.sloped ? static_cast<std::int64_t>(fields.sloped.size()) : 0);
}

// Controls of step s of a path, clipped to their limits, into row s of u (N, m).
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
        double total = commands.u[(path * commands.own + r) * m + c];
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
        // Both comparisons are false for NaN, which is kept.
        if (total < commands.least[c]) total = commands.least[c];
        if (total > commands.greatest[c]) total = commands.greatest[c];
        decision[c] = total;
    }
}

// The controls (stages, m) at the stages of step s of a path, after apply_policy; null if they are constant over the
// step. Linear controls are written to `line`.
inline const double* stage_controls(const Commands& commands, std::ptrdiff_t path, std::ptrdiff_t s, int stages,
                                    const double* u, std::vector<double>& line) {
    const int m = commands.controls;
    if (commands.within) return commands.within + s * stages * m;
    if (!commands.stage_times) return nullptr;
    const std::ptrdiff_t first = s - s % commands.hold;
    const double* from = first > 0 ? u + (first - 1) * m : commands.before + path * m;
    const double* to = u + s * m;
    line.resize(static_cast<std::size_t>(stages) * m);
    for (int i = 0; i < stages; ++i) {
        const double share = (static_cast<double>(s - first) + commands.stage_times[i]) / commands.hold;
        for (int c = 0; c < m; ++c) line[i * m + c] = (1.0 - share) * from[c] + share * to[c];
    }
    return line.data();
}

// What the noise of a step sees of its controls, (N3).
struct Felt {
    const double* mean = nullptr;    // (m) over the step
    const double* change = nullptr;  // (m) from its start to its end, or null where the noise does not see it
};

// The controls of step s of a path that its noise sees, after apply_policy, with the change of linear ones if `sloped`.
// Those of linear controls are written to `work`.
inline Felt felt_controls(const Commands& commands, std::ptrdiff_t path, std::ptrdiff_t s, bool sloped, const double* u,
                          std::vector<double>& work) {
    const int m = commands.controls;
    const double* to = u + s * m;
    if (!commands.stage_times) return {to, nullptr};
    const std::ptrdiff_t first = s - s % commands.hold;
    const double* from = first > 0 ? u + (first - 1) * m : commands.before + path * m;
    const double share = (static_cast<double>(s - first) + 0.5) / commands.hold;
    work.resize(2 * static_cast<std::size_t>(m));
    for (int c = 0; c < m; ++c) {
        work[c] = (1.0 - share) * from[c] + share * to[c];
        work[m + c] = (to[c] - from[c]) / commands.hold;
    }
    return {work.data(), sloped ? work.data() + m : nullptr};
}

// The force drift + B u of a step with constant controls; drift (n) may be null.
inline void constant_force(const Mechanism& mechanism, const double* drift, const double* u, double* force) {
    for (int r = 0; r < mechanism.dof(); ++r) force[r] = drift ? drift[r] : 0.0;
    for (const Transmission& transmission : mechanism.actuation)
        force[transmission.coordinate] += transmission.ratio * u[transmission.control];
}

// The forces (stages, n) at the stages of a step, from controls u (stages, m).
inline void stage_forces(const Mechanism& mechanism, const double* drift, const double* u, int stages, double* force) {
    for (int i = 0; i < stages; ++i)
        constant_force(mechanism, drift, u + i * mechanism.controls, force + i * mechanism.dof());
}

// Add to an impulse the part of the increments for the slopes of the controls, (N3).
inline void add_slope_noise(const Mechanism& mechanism, double part, const double* change, const double* increments,
                            double* impulse) {
    const Diffusion& fields = mechanism.diffusion;
    const int n = mechanism.dof(), m = mechanism.controls, k = fields.processes;
    const double share = part / std::sqrt(12.0);
    for (std::size_t a = 0; a < fields.sloped.size(); ++a) {
        for (int i = 0; i < n; ++i) {
            const double* row = fields.control.data() + (static_cast<std::size_t>(i) * k + fields.sloped[a]) * m;
            double field = 0.0;
            for (int c = 0; c < m; ++c) field += row[c] * change[c];
            impulse[i] += share * field * increments[k + a];
        }
    }
}

// The impulse part * sum_i F_i(q, u) dw_i, and that of the slopes of linear controls.
inline void noise_impulse(const Mechanism& mechanism, double part, const double* q, const double* center,
                          const Felt& felt, const double* increments, const StepNoise& own, double* impulse) {
    const Diffusion& fields = mechanism.diffusion;
    const int n = mechanism.dof(), m = mechanism.controls, k = fields.processes;
    if (fields.outer) {
        for (int i = 0; i < n; ++i) impulse[i] = part * own.impulse[i];
        return;
    }
    for (int i = 0; i < n; ++i) {
        double total = 0.0;
        for (int w = 0; w < k; ++w) {
            const double offset = q[i] - center[i * k + w];
            double field = fields.constant[i * k + w] + fields.quadratic[i * k + w] * offset * offset;
            for (int c = 0; c < m; ++c) field += fields.control[(i * k + w) * m + c] * felt.mean[c];
            total += field * increments[w];
        }
        impulse[i] = part * total;
    }
    if (felt.change) add_slope_noise(mechanism, part, felt.change, increments, impulse);
}

// A row of an array, or null where there is none.
inline const double* row_of(const double* array, std::int64_t row, std::int64_t size) {
    return array ? array + row * size : nullptr;
}

// The constant forces (n) over a step in addition to its controls; both may be null.
struct Extra {
    const double* driven = nullptr;    // on the joint's drive, with its limit
    const double* external = nullptr;  // on the joint itself; null where no drive has a limit, which is the same
};

// The extra forces of a step of length h over which the impulses of the noise, (N2), are held, and `impulses` (2, n) in
// addition to it; `increments` and `impulses` may be null. `sum` (n) is work space.
inline Extra held_noise(const Mechanism& mechanism, double h, const double* drift, const double* impulses,
                        const double* q, const double* center, const Felt& felt, const double* increments,
                        const StepNoise& own, double* sum) {
    if (!increments && !impulses) return {drift, nullptr};
    const int n = mechanism.dof();
    if (increments) {
        noise_impulse(mechanism, 1.0 / h, q, center, felt, increments, own, sum);
    } else {
        std::fill(sum, sum + n, 0.0);
    }
    for (int i = 0; impulses && i < n; ++i) sum[i] += (impulses[i] + impulses[n + i]) / h;
    // The entry of a driven joint is its goal, and its drive absorbs the noise.
    for (const DrivenRow& own : mechanism.constraints.driven()) sum[own.coordinate] = 0.0;
    if (mechanism.forces.limits()) return {drift, sum};
    for (int i = 0; drift && i < n; ++i) sum[i] += drift[i];
    return {sum, nullptr};
}

// The centres of the diffusion fields for a rollout from q.
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

// What acts on P paths over N steps in addition to their commands; each may be null.
struct Additions {
    const double* increments = nullptr;  // (P, N, K) of the Wiener processes, K = increments_of_step
    const double* drift = nullptr;       // (P, N, n) a force, instead of the drift of the noise
    const double* impulses = nullptr;    // (P, N, 2, n) before and after each step
};

// The inputs of one step; those that are not given are null.
struct StepInputs {
    std::int64_t path = 0, step = 0, row = 0;  // row = path N + step, of arrays (P, N, ...)
    const double* u = nullptr;                 // (m)
    const double* within = nullptr;            // (s, m) at the stages
    Felt felt;                                 // empty without noise
    const double* increments = nullptr;        // (K)
    const double* drift = nullptr;             // (n)
    const double* impulses = nullptr;          // (2, n)
};

// Read the noise of a step at a state, if Python has it; returns the drift of the step, `share` of that of the noise.
inline const double* read_noise(const Mechanism& mechanism, double share, const double* q, const double* v,
                                const double* center, const StepInputs& in, StepNoise& own) {
    if (!in.felt.mean || !mechanism.diffusion.outer) return in.drift;
    mechanism.diffusion.outer(q, v, center, in.felt.mean, in.felt.change, in.increments, own);
    for (double& entry : own.drift) entry *= share;
    return in.drift || own.drift.empty() ? in.drift : own.drift.data();
}

// How a path begins: whether it can, and its state, which commands see.
struct Entry {
    Outcome outcome = Outcome::solved;
    const double *first = nullptr, *second = nullptr;  // (n)
};

// Advances paths, whatever their method.
class PathDriver {
  public:
    // N steps of each path: begin(path) enters it, take(inputs) takes a step and records its node. A path that fails
    // stops; nodes.ended and nodes.done hold the reason and the number of steps.
    template <class Begin, class Take>
    void roll(const Mechanism& mechanism, const Commands& commands, const Additions& more, int stages,
              const Nodes& nodes, const Begin& begin, const Take& take) {
        const int n = mechanism.dof(), m = mechanism.controls;
        const std::int64_t width = increments_of_step(mechanism, commands);
        const bool sloped = commands.sloped || !more.increments;
        const bool noisy = more.increments || (mechanism.diffusion.by_velocity && !more.drift);
        for (std::int64_t path = 0; path < nodes.paths; ++path) {
            double* u = nodes.u + path * nodes.steps * m;
            auto [outcome, first, second] = begin(path);
            nodes.done[path] = 0;
            for (std::int64_t s = 0; s < nodes.steps && outcome == Outcome::solved; ++s) {
                const std::int64_t row = path * nodes.steps + s;
                apply_policy(commands, path, s, n, first, second, u);
                const double* within = stage_controls(commands, path, s, stages, u, line_);
                const Felt felt = noisy ? felt_controls(commands, path, s, sloped, u, seen_) : Felt{};
                outcome = take({path, s, row, u + s * m, within, felt, row_of(more.increments, row, width),
                                row_of(more.drift, row, n), row_of(more.impulses, row, 2 * n)});
                if (outcome == Outcome::solved) nodes.done[path] = s + 1;
            }
            nodes.ended[path] = static_cast<std::int64_t>(outcome);
        }
    }

  private:
    std::vector<double> line_;  // (s, m) linear controls at the stages
    std::vector<double> seen_;  // (2, m) what the noise sees of them
};

}  // namespace varpin
