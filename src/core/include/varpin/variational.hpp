// The variational stepper: collocation steps that the guards accept or that are halved, repeatedly if need be; noise
// impulses (kicks) before the step, or one half before and one half after, or held over it as a force.
// docs/mathematics.md, "The principal branch" and "Noise".
// Equations (C2) and (N2) of docs/mathematics.md.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "varpin/collocation.hpp"
#include "varpin/guards.hpp"
#include "varpin/nodes.hpp"
#include "varpin/policy.hpp"
#include "varpin/substeps.hpp"
#include "varpin/watch.hpp"

namespace varpin {

// State of a path.
struct PathState {
    // Most rows of backward differences; more rows would amplify rounding.
    static constexpr int most_misses = 3;

    PathState(const Mechanism& mechanism, int stages)
        : position(mechanism.dof()),
          p(mechanism.dof()),
          q(mechanism.dof()),
          momentum(mechanism.dof()),
          v(mechanism.dof()),
          energies(mechanism.tree),
          center(mechanism.dof() * mechanism.diffusion.processes),
          past(stages * mechanism.dof()),
          miss(most_misses * stages * mechanism.dof()),
          past_end(mechanism.dof()),
          past_force(mechanism.dof()) {}

    std::vector<Coordinate> position;
    std::vector<Compensated> p;
    std::vector<double> q;         // (n) rounded, with whole turns
    std::vector<double> momentum;  // (n) p, rounded
    std::vector<double> v;         // (n) M(q)^-1 p
    Energies energies;
    std::vector<double> center;          // (n, k) of the diffusion fields, for this rollout
    std::vector<double> past;            // (s, n) stage velocities of the last whole step
    std::vector<double> miss;            // (misses, s, n) error of the guess of these velocities, and its backward
                                         // differences over the steps before
    std::vector<double> past_end;        // (n) velocity at the end of that step
    std::vector<double> past_force;      // (n) force of that step
    int known = 0;                       // consecutive whole steps before, up to the number in use
    int trend = 0;                       // number of rows of `miss` that would have predicted the last step best
    int level = 0;                       // halvings of the last step
    std::vector<std::uint8_t> halvings;  // of each part of every divided step in the last `roll`
};

// Writes the error of a guess (size) and its backward differences over `known` guesses into `miss` (misses, size). The
// difference of order r is the error that a correction with r rows would have left; returns the best r.
inline int follow_misses(const double* root, const double* guess, int size, int known, double* miss) {
    constexpr int most = PathState::most_misses;
    const int orders = std::min(known, most + 1);
    double left[most + 1] = {};
    for (int k = 0; k < size; ++k) {
        double now = root[k] - guess[k];
        for (int r = 0; r < orders; ++r) {
            left[r] += std::abs(now);
            if (r == most) break;
            const double then = miss[r * size + k];
            miss[r * size + k] = now;
            now -= then;
        }
    }
    return orders == 1 ? 1 : static_cast<int>(std::min_element(left, left + orders) - left);
}

// Writes the solver statistics of a step.
inline void record_effort(const Effort& effort, const Nodes& nodes, std::int64_t row) {
    std::int64_t* tally = nodes.tally + 4 * row;
    tally[0] = effort.newton_iterations;
    tally[1] = effort.jets;
    tally[2] = effort.sweeps;
    tally[3] = effort.substeps;
    nodes.quality[3 * row] = effort.residual;
    nodes.quality[3 * row + 1] = effort.branch_margin;
}

// Writes the node after a step.
inline void record_node(const PathState& state, int n, const Nodes& nodes, std::int64_t row) {
    std::copy(state.q.begin(), state.q.end(), nodes.q + row * n);
    std::copy(state.momentum.begin(), state.momentum.end(), nodes.p + row * n);
    std::copy(state.v.begin(), state.v.end(), nodes.v + row * n);
    nodes.energy[row] = state.energies.total();
    nodes.quality[3 * row + 2] = state.energies.defect();
}

// With the kernels of a number of joints, the mechanism has to be an arm of so many in a single block (size.hpp).
class VariationalStepper {
  public:
    VariationalStepper(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                       double left, const Kernels& kernels = kernels_for<>)
        : guards(guards),
          mechanism(mechanism),
          tableau(tableau),
          tolerance(tolerance),
          left(left),
          step_equation(mechanism, this->tableau, false, kernels),
          energy_guard(mechanism, false, !step_equation.eliminated(), kernels),
          n(mechanism.dof()),
          force(step_equation.stages * n),
          trial(n),
          given(step_equation.stages * n),
          guess(step_equation.stages * n),
          bend(2 * n),
          extras(n),
          at(n) {}
    VariationalStepper(const VariationalStepper&) = delete;
    VariationalStepper& operator=(const VariationalStepper&) = delete;

    Guards guards;
    bool held = false;  // whether the noise of a step is a force that is constant over it, instead of impulses
    const Mechanism& mechanism;
    const Tableau tableau;
    double tolerance;
    double left;  // share of each kick before the step; the rest acts after it
    Collocation step_equation;
    EnergyGuard energy_guard;
    int n;
    std::vector<double> force;           // (n) constant over the step, or (s, n) at the stages of the step or its part
    int stride = 0;                      // distance of rows of `force`; 0 for a constant
    const double* outer = nullptr;       // (n) external force, null for none
    Effort effort;                       // of the last step
    std::vector<std::uint8_t> halvings;  // of each part of the last step; empty for an undivided step

    // Start a path at (q, p) without history; false where M(q) is not positive definite.
    bool begin_at(const double* q, const double* p, PathState& state) {
        for (int i = 0; i < n; ++i) {
            state.position[i] = {{q[i], 0.0}, 0.0};
            unwind(i, state);
            state.q[i] = q[i];
            state.p[i] = {p[i], 0.0};
            state.momentum[i] = p[i];
        }
        diffusion_centers(mechanism, q, state.center.data());
        state.known = state.level = state.trend = 0;
        if (!look_at(state)) return false;
        energy_guard.begin(at.data(), state.momentum.data(), state.v.data(), state.energies);
        return true;
    }

    // Start a path at (q, v).
    bool begin(const double* q, const double* v, PathState& state) {
        Jet<double>& jet = step_equation.stage[0];
        step_equation.kernels.first_order(mechanism, q, v, jet);
        if (!begin_at(q, jet.Lv.data(), state)) return false;
        std::copy(v, v + n, state.v.begin());
        return true;
    }

    // Factor M at a path's node, for kicks and guesses.
    bool look_at(PathState& state) {
        for (int i = 0; i < n; ++i) at[i] = state.position[i].value.high;
        return energy_guard.node(at.data(), state.momentum.data(), state.v.data());
    }

    // Add an impulse (n) to the momentum. Its change of the energy counts as work, not as an error.
    void kick(const double* impulse, PathState& state) {
        for (int i = 0; i < n; ++i) {
            state.p[i] = state.p[i].plus(impulse[i]);
            state.momentum[i] = state.p[i].high;
            at[i] = state.position[i].value.high;
        }
        energy_guard.kicked(at.data(), state.momentum.data(), state.v.data(), state.energies);
    }

    // Set the force of a step: (n) constant over it, or (s, n) at its stages if it `varies`.
    void take_force(const double* own, bool varies) {
        stride = varies ? n : 0;
        std::copy(own, own + (varies ? step_equation.stages * n : n), force.begin());
        if (varies) given = force;
    }

    // Interpolate a varying force to the stages of the part of the step at `begin` with length `share`, both in units
    // of the step, by the polynomial through the stages of the whole step.
    void force_in_part(double begin, double share) {
        if (stride != 0) bring_to_part(tableau, n, given.data(), begin, share, force.data());
    }

    // One step with the force that was set, in as many substeps as the guards require. The first attempt starts from
    // the extrapolated past, the others from the current velocity.
    Outcome step(double h, PathState& state) {
        effort = {};
        const int level = std::max(state.level - 1, 0);
        const auto take = [&](int level, double begin, bool extrapolated) {
            if (extrapolated) {
                extrapolate(h, state);
            } else {
                guess_velocity(state);
            }
            force_in_part(begin, length_of(1.0, level));
            return attempt(length_of(h, level), state, false);
        };
        const auto [outcome, deepest] =
            divide(level, level == 0 && state.known > 0, guards.most_halvings, halvings, take);
        if (outcome != Outcome::solved) return outcome;
        state.level = deepest;
        if (deepest > 0) {
            state.known = 0;
        } else {
            remember(state);
        }
        return Outcome::solved;
    }

    // The part of a step of length h at `begin`, in units of the step, after `level` halvings. The guess is the current
    // velocity, as for every part. Leaves the jets at the root in step_equation.
    Outcome part(double h, int level, double begin, PathState& state) {
        force_in_part(begin, length_of(1.0, level));
        guess_velocity(state);
        return attempt(length_of(h, level), state, true);
    }

    // Advances every path by N steps. Writes the node after each step, its controls and its statistics into `nodes`. A
    // path that fails stops; nodes.ended and nodes.done hold the reason and the number of steps. These may be null:
    // `increments` of the Wiener processes (P, N, K) with K = increments_of_step, `drift`, a force in addition to the
    // controls (P, N, n), and `impulses` in addition to the noise, before and after each step, or held over it as the
    // noise (P, N, 2, n). A `watch` may stop a single path.
    void roll(double h, const Commands& commands, const double* increments, const double* drift, const double* impulses,
              std::vector<PathState>& states, const Nodes& nodes, Watch* watch = nullptr) {
        const std::int64_t steps = nodes.steps;
        const int m = mechanism.controls, stages = step_equation.stages;
        const std::int64_t width = increments_of_step(mechanism, commands);
        const bool noisy = increments != nullptr && width > 0;
        const bool kicks = noisy && !held;
        const double *pushes = held ? nullptr : impulses, *spread = held ? impulses : nullptr;
        for (std::int64_t path = 0; path < nodes.paths; ++path) {
            PathState& state = states[path];
            double* u = nodes.u + path * steps * m;
            look_at(state);
            state.halvings.clear();
            nodes.ended[path] = static_cast<std::int64_t>(Outcome::solved);
            nodes.done[path] = 0;
            for (std::int64_t s = 0; s < steps; ++s) {
                const std::int64_t row = path * steps + s;
                const double* dw = noisy ? increments + row * width : nullptr;
                apply_policy(commands, path, s, n, state.q.data(), state.momentum.data(), u);
                const Felt felt = noisy ? felt_controls(commands, path, s, u, seen) : Felt{};
                if (kicks) noise_kick(left, felt, dw, state);
                if (pushes) kick(pushes + 2 * row * n, state);
                const double* within = stage_controls(commands, path, s, stages, u, line);
                const Extra extra =
                    held_noise(mechanism, h, row_of(drift, row, n), row_of(spread, row, 2 * n), state.q.data(),
                               state.center.data(), felt, held ? dw : nullptr, extras.data());
                outer = extra.external;
                stride = within ? n : 0;
                if (within) {
                    stage_forces(mechanism, extra.driven, within, stages, given.data());
                } else {
                    constant_force(mechanism, extra.driven, u + s * m, force.data());
                }
                const Outcome outcome = step(h, state);
                record_effort(effort, nodes, row);
                nodes.ended[path] = static_cast<std::int64_t>(outcome);
                if (outcome != Outcome::solved) break;
                state.halvings.insert(state.halvings.end(), halvings.begin(), halvings.end());
                if (kicks && left < 1.0) noise_kick(1.0 - left, felt, dw, state);
                if (pushes) kick(pushes + (2 * row + 1) * n, state);
                record_node(state, n, nodes, row);
                nodes.done[path] = s + 1;
                if (watch && !watch->after(s, effort.substeps)) break;
            }
        }
        outer = nullptr;
    }

    // Whether the Lagrangian is periodic in coordinate i, so that whole turns may be removed.
    bool unwinds(int i) const {
        return mechanism.tree.periodic[i] && !mechanism.forces.anchors(i) && !mechanism.couplings.has_outer();
    }

    void unwind(int i, PathState& state) const {
        if (unwinds(i)) state.position[i].unwind();
    }

  private:
    Trial trial;
    std::vector<double> given;   // (s, n) varying force at the stages of the whole step
    std::vector<double> line;    // (s, m) linear controls at these stages
    std::vector<double> seen;    // (2, m) what the noise sees of them
    std::vector<double> guess;   // (s, n) extrapolated stage velocities
    std::vector<double> bend;    // (2, n)
    std::vector<double> extras;  // (n) forces in addition to the controls
    std::vector<double> at;      // (n)

    // The force on coordinate c, without those of elements, if it is constant over the step.
    double constant(int c) const { return outer ? force[c] + outer[c] : force[c]; }

    void guess_velocity(const PathState& state) {
        for (int i = 0; i < step_equation.stages; ++i)
            std::copy(state.v.begin(), state.v.end(), step_equation.V.begin() + i * n);
    }

    // One substep from the guess in step_equation.V; advances the path only if the substep is accepted.
    Outcome attempt(double h, PathState& state, bool jets_wanted) {
        auto& equation = step_equation;
        const Outcome solved = equation.solve(h, {state.position.data(), state.p.data(), force.data(), stride, outer},
                                              tolerance, jets_wanted, effort);
        if (solved != Outcome::solved) return solved;
        const double margin = guards.active ? energy_guard.branch_margin(h, guards, equation) : infinity;
        if (!(margin > 0.0)) return Outcome::fold;
        equation.stages == 1 ? advance(1, h, state) : advance(equation.stages, h, state);
        const Outcome outcome = energy_guard.accept(guards, tableau, state.energies, state.position, state.v, trial);
        if (outcome != Outcome::solved) return outcome;
        effort.branch_margin = std::min(effort.branch_margin, margin);
        ++effort.substeps;
        std::swap(state.position, trial.position);
        std::swap(state.p, trial.p);
        for (int i = 0; i < n; ++i) {
            unwind(i, state);
            state.q[i] = state.position[i].shown();
        }
        std::copy(trial.momentum.begin(), trial.momentum.end(), state.momentum.begin());
        std::copy(trial.v.begin(), trial.v.end(), state.v.begin());
        return Outcome::solved;
    }

    // The node after the substep, (C2), and the work of forces in it, into `trial`.
    [[gnu::always_inline]] inline void advance(const int stages, double h, const PathState& state) {
        const auto& equation = step_equation;
        for (int c = 0; c < n; ++c) {
            double move = 0.0, impulse = 0.0, rest = 0.0;
            trial.work[c] = trial.dissipated[c] = trial.magnitude[c] = 0.0;
            // The rounding of q is proportional to its distance from 0, without whole turns.
            const double distance =
                std::min(std::abs(state.position[c].value.high), unwinds(c) ? Coordinate::turn : infinity);
            for (int i = 0; i < stages; ++i) {
                const double share = h * tableau.b[i], velocity = equation.V[i * n + c];
                const JointForce<double>& element = equation.acting[i * n + c];
                move += tableau.b[i] * velocity;
                impulse += tableau.b[i] * equation.slope[i * n + c];
                rest += tableau.b[i] * equation.slope_rest[i * n + c];
                const double given_force = force[i * stride + c];
                trial.work[c] += share * (given_force + element.value) * velocity;
                trial.dissipated[c] += share * element.lost;
                const double scale = equation.stage[i].Lq_scale[c] + std::abs(given_force) + element.scale;
                // Rounding of the terms that cancel, and change of the potential by rounding of q.
                trial.magnitude[c] +=
                    share * scale * std::abs(velocity) + tableau.b[i] * std::abs(equation.stage[i].Lq[c]) * distance;
            }
            trial.position[c] = {state.position[c].value.plus(h * move), state.position[c].turns};
            trial.p[c] = state.p[c].plus(h * impulse, h * rest);
        }
    }

    // Extrapolate the last whole step to the stage velocities: the polynomial through its stages and its end, shifted
    // by later kicks of the velocity, and corrected for the change of a constant force. The error of this guess is
    // extrapolated too, by backward differences of the order that would have predicted the last step best.
    void extrapolate(double h, const PathState& state) {
        const int stages = step_equation.stages;
        double *change = bend.data(), *acceleration = change + n;
        bool changed = false;
        for (int c = 0; c < n; ++c) {
            change[c] = stride == 0 ? constant(c) - state.past_force[c] : 0.0;
            changed = changed || change[c] != 0.0;
        }
        if (changed) {
            energy_guard.solve(change, acceleration);
        } else {
            std::fill(acceleration, acceleration + n, 0.0);
        }
        for (int i = 0; i < stages; ++i) {
            const double* ahead = &tableau.ahead[i * (stages + 1)];
            for (int c = 0; c < n; ++c) {
                double total = state.v[c] - state.past_end[c];
                for (int j = 0; j < stages; ++j) total += ahead[j] * state.past[j * n + c];
                total += ahead[stages] * state.past_end[c];
                const int k = i * n + c;
                guess[k] = total + h * tableau.c[i] * acceleration[c];
                double missing = 0.0;
                for (int r = 0; r < state.trend; ++r) missing += state.miss[r * stages * n + k];
                step_equation.V[k] = guess[k] + missing;
            }
        }
    }

    void remember(PathState& state) {
        std::copy(step_equation.V.begin(), step_equation.V.end(), state.past.begin());
        if (state.known > 0) {
            state.trend = follow_misses(step_equation.V.data(), guess.data(), step_equation.stages * n, state.known,
                                        state.miss.data());
        }
        std::copy(state.v.begin(), state.v.end(), state.past_end.begin());
        for (int c = 0; c < n; ++c) state.past_force[c] = constant(c);
        state.known = std::min(state.known + 1, PathState::most_misses + 1);
    }

    // The impulse of `part` of the increments dw, (N2).
    void noise_kick(double part, const Felt& felt, const double* dw, PathState& state) {
        noise_impulse(mechanism, part, state.q.data(), state.center.data(), felt, dw, bend.data());
        kick(bend.data(), state);
    }
};

}  // namespace varpin
