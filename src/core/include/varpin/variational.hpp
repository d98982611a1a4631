// The variational stepper: collocation steps that the guards accept or that are halved, repeatedly if need be; noise
// impulses (kicks) before the step, or one half before and one half after, or held over it as a force. constrained.hpp
// overrides what differs under constraints. docs/mathematics.md, "The principal branch" and "Noise".
// Equations (C2) and (N2) of docs/mathematics.md.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "varpin/guards.hpp"
#include "varpin/nodes.hpp"
#include "varpin/policy.hpp"
#include "varpin/step_equation.hpp"
#include "varpin/substeps.hpp"

namespace varpin {

// State of a path.
struct PathState {
    // Most rows of backward differences; more rows would amplify rounding.
    static constexpr int most_misses = 3;

    PathState(const Mechanism& mechanism, int stages)
        : n(mechanism.dof()),
          m(mechanism.constraints.rows()),
          stages(stages),
          position(n),
          p(n),
          energies(mechanism.tree),
          center(zeros(n, mechanism.diffusion.processes)) {}

    int n, m, stages;  // coordinates, rows of constraints
    std::vector<Coordinate> position;
    std::vector<Compensated> p;
    std::vector<double> q = zeros(n);         // rounded, with whole turns
    std::vector<double> momentum = zeros(n);  // p, rounded
    std::vector<double> v = zeros(n);         // M(q)^-1 p
    Energies energies;
    std::vector<double> center;                                 // (n, k) of the diffusion fields, for this rollout
    std::vector<double> past = zeros(stages, n);                // stage velocities of the last whole step
    std::vector<double> miss = zeros(most_misses * stages, n);  // error of the guess of these velocities, and its
                                                                // backward differences over the steps before
    std::vector<double> past_end = zeros(n);                    // velocity at the end of that step
    std::vector<double> past_force = zeros(n);                  // force of that step
    int known = 0;                       // consecutive whole steps before, up to the number in use
    int trend = 0;                       // number of rows of `miss` that would have predicted the last step best
    int level = 0;                       // halvings of the last step
    std::vector<std::uint8_t> halvings;  // of each part of every divided step in the last `roll`

    // Under constraints with m rows:
    int rank = -1;                           // of the constraints, for the whole rollout
    int weakest = 0;                         // the row that a failed step would name
    std::vector<double> rate = zeros(m);     // rates of kinematic inputs at the node; zero for other rows
    std::vector<double> impulse = zeros(m);  // impulses of the last step, the negative sum of Lam [N s or N m s]
    std::vector<double> past_impulse = zeros(stages, m);                // Lam of the last whole step
    std::vector<double> impulse_miss = zeros(most_misses * stages, m);  // errors of its guess, as `miss`
    int impulse_trend = 0;                                              // as `trend`
    std::vector<double> impulses;                                       // (steps, m) impulses of the last roll
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

// With the kernels of a number of joints, the mechanism has to be an arm of so many in a single block (tree.hpp).
class VariationalStepper {
  public:
    VariationalStepper(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                       double left, const Kernels& kernels = kernels_for<>)
        : VariationalStepper(mechanism, tableau, tolerance, guards, left, kernels, 0) {}
    virtual ~VariationalStepper() = default;
    VariationalStepper(const VariationalStepper&) = delete;
    VariationalStepper& operator=(const VariationalStepper&) = delete;

    Guards guards;
    bool held = false;  // whether the noise of a step is a force that is constant over it, instead of impulses
    const Mechanism& mechanism;
    const Tableau tableau;
    double tolerance;
    double left;  // share of each kick before the step; the rest acts after it
    StepEquation equation;
    EnergyGuard energy_guard;
    int n;
    int m;  // rows of constraints
    int stages;
    std::vector<double> force =
        zeros(stages, n);                // constant over the step, or (s, n) at the stages of the step or its part
    int stride = 0;                      // distance of rows of `force`; 0 for a constant
    const double* outer = nullptr;       // (n) external force, null for none
    Effort effort;                       // of the last step
    std::vector<std::uint8_t> halvings;  // of each part of the last step; empty for an undivided step

    // Start a path at (q, p) without history; false where M(q) is not positive definite. With `project`, constraints
    // absorb the part of p that is normal to them.
    bool begin_at(const double* q, const double* p, PathState& state, bool project = true) {
        place(q, p, state);
        diffusion_centers(mechanism, q, state.center.data());
        state.known = state.level = state.trend = state.impulse_trend = 0;
        if (!enter(state, project)) return false;
        energy_guard.begin(at.data(), state.momentum.data(), state.v.data(), state.energies);
        return true;
    }

    // Start a path at (q, v).
    bool begin(const double* q, const double* v, PathState& state) {
        Jet<double>& jet = equation.stage[0];
        equation.kernels.first_order(mechanism, q, v, jet);
        if (!begin_at(q, jet.Lv.data(), state)) return false;
        if (m == 0) std::copy(v, v + n, state.v.begin());
        return true;
    }

    // Factor M at a path's node, for kicks and guesses, and find its constraints.
    virtual bool factor_at(PathState& state) {
        for (int i = 0; i < n; ++i) at[i] = state.position[i].value.high;
        return energy_guard.node(at.data(), state.momentum.data(), state.v.data());
    }

    // Add an impulse (n) to the momentum; constraints absorb its normal part. Its change of the energy counts as work,
    // not as an error.
    void kick(const double* impulse, PathState& state) {
        for (int i = 0; i < n; ++i) {
            state.p[i] = state.p[i].plus(impulse[i]);
            state.momentum[i] = state.p[i].high;
            at[i] = state.position[i].value.high;
        }
        absorb(state);
        energy_guard.kicked(at.data(), state.momentum.data(), state.v.data(), state.energies);
    }

    // Set the force of a step: (n) constant over it, or (s, n) at its stages if it `varies`; and the rates of cubic
    // kinematic inputs at their goals, in the order of their rows, unless null.
    void take_force(const double* own, bool varies, const double* rates = nullptr) {
        stride = varies ? n : 0;
        std::copy(own, own + (varies ? stages * n : n), force.begin());
        if (varies) given = force;
        take_goals(1);
        if (rates) take_rates(rates);
    }

    // Put a path at (q, p).
    void place(const double* q, const double* p, PathState& state) const {
        for (int i = 0; i < n; ++i) {
            state.position[i] = {{q[i], 0.0}, 0.0};
            unwind(i, state);
            state.q[i] = q[i];
            state.p[i] = {p[i], 0.0};
            state.momentum[i] = p[i];
        }
    }

    // Move a path to (q, p); false where M(q) is not positive definite. Its past stays, for guesses.
    bool move_to(const double* q, const double* p, PathState& state) {
        place(q, p, state);
        return factor_at(state);
    }

    // One step with the force that was set, in one part, of a path that has been moved to (q, p) since its last step.
    // Its guess is that of the path, and it leaves the jets at the root in `equation`.
    Outcome step_from(double h, const double* q, const double* p, PathState& state) {
        if (!move_to(q, p, state)) return Outcome::singular;
        energy_guard.begin(at.data(), state.momentum.data(), state.v.data(), state.energies);
        if (state.known > 0) {
            extrapolate(h, state);
        } else {
            guess_velocity(state);
        }
        const Outcome outcome = attempt(h, state, true);
        if (outcome == Outcome::solved) remember(state);
        return outcome;
    }

    // Interpolate a varying force to the stages of the part of the step at `begin` with length `share`, both in units
    // of the step, by the polynomial through the stages of the whole step.
    virtual void force_in_part(double begin, double share) {
        if (stride != 0) bring_to_part(tableau, n, given.data(), begin, share, force.data());
    }

    // One step with the force that was set, in as many substeps as the guards require. The first attempt starts from
    // the extrapolated past, the others from the current velocity.
    Outcome step(double h, PathState& state) {
        effort = {};
        std::fill(state.impulse.begin(), state.impulse.end(), 0.0);
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
    // velocity, as for every part. Leaves the jets at the root in `equation`.
    Outcome part(double h, int level, double begin, PathState& state) {
        force_in_part(begin, length_of(1.0, level));
        guess_velocity(state);
        return attempt(length_of(h, level), state, true);
    }

    // A whole step from a guess (s, n) close to its root.
    Outcome from_guess(double h, const double* V, PathState& state) {
        std::copy(V, V + stages * n, equation.V.begin());
        std::fill(impulse.begin(), impulse.end(), 0.0);
        force_in_part(0.0, 1.0);
        return attempt(h, state, true);
    }

    // Advances every path by N steps of length h; impulses in addition to the noise act before and after each step, or
    // are held over it as the noise.
    void roll(double h, const Commands& commands, const Additions& more, std::vector<PathState>& states,
              const Nodes& nodes) {
        const auto begin = [&](std::int64_t path) {
            PathState& state = states[path];
            state.halvings.clear();
            state.impulses.clear();
            state.impulses.reserve(nodes.steps * m);
            const Outcome outcome = factor_at(state) ? Outcome::solved : Outcome::singular;
            return Entry{outcome, state.q.data(), state.momentum.data()};
        };
        driver.roll(mechanism, commands, more, stages, nodes, begin,
                    [&](const StepInputs& in) { return noisy_step(h, commands.hold, in, states[in.path], nodes); });
        outer = nullptr;
    }

    // Whether the Lagrangian is periodic in coordinate i, so that whole turns may be removed.
    bool unwinds(int i) const {
        return mechanism.tree.periodic[i] && !mechanism.forces.anchors(i) && !mechanism.couplings.has_outer();
    }

    void unwind(int i, PathState& state) const {
        if (unwinds(i)) state.position[i].unwind();
    }

  protected:
    VariationalStepper(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                       double left, const Kernels& kernels, int rows)
        : guards(guards),
          mechanism(mechanism),
          tableau(tableau),
          tolerance(tolerance),
          left(left),
          equation(mechanism, this->tableau, rows > 0, kernels),
          energy_guard(mechanism, rows > 0, rows > 0 || !equation.eliminated(), kernels),
          n(mechanism.dof()),
          m(rows),
          stages(tableau.stages),
          trial(n) {}

    // What differs under constraints.

    // Enter the first node of a path, with or without a projection of its momentum.
    virtual bool enter(PathState& state, bool) { return factor_at(state); }
    // Remove the part of a path's momentum that is normal to the constraints.
    virtual void absorb(PathState&) {}
    // Read the goals of kinematic inputs, so many steps ahead, from `force`, and their rates from the controls.
    virtual void take_goals(int, const double* = nullptr) {}
    virtual void take_rates(const double*) {}
    // Solve the step equation of a substep from the guess.
    virtual Outcome solve(double h, PathState& state, bool jets_wanted) {
        return equation.solve(h, start_of(state), tolerance, jets_wanted, effort);
    }
    // The branch margin of the root.
    virtual Outcome measure_branch(double h, double& margin) {
        margin = energy_guard.branch_margin(h, guards, equation);
        return margin > 0.0 ? Outcome::solved : Outcome::fold;
    }
    // Finish the node in `trial`.
    virtual Outcome end(double, PathState&, bool) { return Outcome::solved; }
    // Follow a path that has moved to the node; `turned` if whole turns were removed.
    virtual Outcome arrive(PathState&, bool) { return Outcome::solved; }

    Start start_of(const PathState& state) const {
        return {state.position.data(), state.p.data(), force.data(), stride, outer};
    }

    Trial trial;
    std::vector<double> given = zeros(stages, n);    // varying force at the stages of the whole step
    std::vector<double> impulse = zeros(stages, m);  // Lam_k of the constraints, zero for omitted rows
    // C_k' Lam_k and the size of its terms; empty without constraints
    std::vector<double> pushed = zeros(m > 0 ? stages * n : 0), push_size = pushed;
    std::vector<double> at = zeros(n);

  private:
    PathDriver driver;
    std::vector<double> guess = zeros(stages, n);  // extrapolated stage velocities
    std::vector<double> bend = zeros(2, n);
    std::vector<double> extras = zeros(n);  // forces in addition to the controls
    StepNoise own;                          // where Python has it

    // The force on coordinate c, without those of elements, if it is constant over the step.
    double constant(int c) const { return outer ? force[c] + outer[c] : force[c]; }

    void guess_velocity(const PathState& state) {
        for (int i = 0; i < stages; ++i) std::copy(state.v.begin(), state.v.end(), equation.V.begin() + i * n);
        std::fill(impulse.begin(), impulse.end(), 0.0);
    }

    // One substep from the guess in equation.V; advances the path only if the substep is accepted.
    Outcome attempt(double h, PathState& state, bool jets_wanted) {
        Outcome outcome = solve(h, state, jets_wanted);
        double margin = infinity;
        if (outcome == Outcome::solved && guards.active) outcome = measure_branch(h, margin);
        if (outcome != Outcome::solved) return outcome;
        stages == 1 ? advance(1, h, state) : advance(stages, h, state);
        outcome = end(h, state, jets_wanted);
        if (outcome != Outcome::solved) return outcome;
        outcome = energy_guard.accept(guards, tableau, state.energies, state.position, state.v, trial, m > 0);
        if (outcome != Outcome::solved) return outcome;
        effort.branch_margin = std::min(effort.branch_margin, margin);
        ++effort.substeps;
        std::swap(state.position, trial.position);
        std::swap(state.p, trial.p);
        bool turned = false;
        for (int i = 0; i < n; ++i) {
            const double turns = state.position[i].turns;
            unwind(i, state);
            turned = turned || state.position[i].turns != turns;
            state.q[i] = state.position[i].shown();
        }
        std::copy(trial.momentum.begin(), trial.momentum.end(), state.momentum.begin());
        std::copy(trial.v.begin(), trial.v.end(), state.v.begin());
        return arrive(state, turned);
    }

    // The node after the substep, (C2), and the work of forces in it, into `trial`.
    [[gnu::always_inline]] inline void advance(const int stages, double h, const PathState& state) {
        for (int c = 0; c < n; ++c) {
            double move = 0.0, momentum = 0.0, rest = 0.0, across_rows = 0.0;
            trial.work[c] = trial.dissipated[c] = trial.magnitude[c] = 0.0;
            // The rounding of q is proportional to its distance from 0, without whole turns.
            const double distance =
                std::min(std::abs(state.position[c].value.high), unwinds(c) ? Coordinate::turn : infinity);
            for (int i = 0; i < stages; ++i) {
                const double share = h * tableau.b[i], velocity = equation.V[i * n + c];
                const JointForce<double>& element = equation.acting[i * n + c];
                move += tableau.b[i] * velocity;
                momentum += tableau.b[i] * equation.force_sum[i * n + c];
                rest += tableau.b[i] * equation.force_rest[i * n + c];
                const double given_force = force[i * stride + c];
                trial.work[c] += share * (given_force + element.value) * velocity;
                trial.dissipated[c] += share * element.lost;
                const double scale = equation.stage[i].Lq_scale[c] + std::abs(given_force) + element.scale;
                // Rounding of the terms that cancel, and change of the potential by rounding of q.
                trial.magnitude[c] +=
                    share * scale * std::abs(velocity) + tableau.b[i] * std::abs(equation.stage[i].Lq[c]) * distance;
                if (pushed.empty()) continue;
                across_rows += pushed[i * n + c];
                trial.magnitude[c] += push_size[i * n + c] * std::abs(velocity);
            }
            trial.position[c] = {state.position[c].value.plus(h * move), state.position[c].turns};
            trial.p[c] = state.p[c].plus(h * momentum - across_rows, h * rest);
        }
    }

    // Extrapolate the last whole step to the stage velocities: the polynomial through its stages and its end, shifted
    // by later kicks of the velocity, and without constraints corrected for the change of a constant force; and the
    // last impulses of constraints. The error of this guess is
    // extrapolated too, by backward differences of the order that would have predicted the last step best.
    void extrapolate(double h, const PathState& state) {
        double *change = bend.data(), *acceleration = change + n;
        bool changed = false;
        for (int c = 0; c < n; ++c) {
            change[c] = stride == 0 && m == 0 ? constant(c) - state.past_force[c] : 0.0;
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
                equation.V[k] = guess[k] + missing;
            }
        }
        for (int k = 0; k < stages * m; ++k) {
            impulse[k] = state.past_impulse[k];
            for (int r = 0; r < state.impulse_trend; ++r) impulse[k] += state.impulse_miss[r * stages * m + k];
        }
    }

    void remember(PathState& state) {
        if (state.known > 0) {
            state.trend = follow_misses(equation.V.data(), guess.data(), stages * n, state.known, state.miss.data());
            state.impulse_trend = follow_misses(impulse.data(), state.past_impulse.data(), stages * m, state.known,
                                                state.impulse_miss.data());
        }
        std::copy(equation.V.begin(), equation.V.end(), state.past.begin());
        state.past_impulse = impulse;
        std::copy(state.v.begin(), state.v.end(), state.past_end.begin());
        for (int c = 0; c < n; ++c) state.past_force[c] = constant(c);
        state.known = std::min(state.known + 1, PathState::most_misses + 1);
    }

    // A step with its controls and noise, and its node.
    Outcome noisy_step(double h, int hold, const StepInputs& in, PathState& state, const Nodes& nodes) {
        const bool kicks = in.increments && !held;
        const double* const pushes = held ? nullptr : in.impulses;
        const double* drift = read_noise(in, state);
        if (kicks) noise_kick(left, in.felt, in.increments, state);
        if (pushes) kick(pushes, state);
        const Extra extra =
            held_noise(mechanism, h, drift, held ? in.impulses : nullptr, state.q.data(), state.center.data(), in.felt,
                       held ? in.increments : nullptr, own, extras.data());
        outer = extra.external;
        stride = in.within ? n : 0;
        constant_force(mechanism, extra.driven, in.u, force.data());
        if (in.within) stage_forces(mechanism, extra.driven, in.within, stages, given.data());
        take_goals(hold - static_cast<int>(in.step % hold), in.u);
        const Outcome outcome = step(h, state);
        record_effort(effort, nodes, in.row);
        if (outcome != Outcome::solved) return outcome;
        state.halvings.insert(state.halvings.end(), halvings.begin(), halvings.end());
        state.impulses.insert(state.impulses.end(), state.impulse.begin(), state.impulse.end());
        if (kicks && left < 1.0) {
            read_noise(in, state);
            noise_kick(1.0 - left, in.felt, in.increments, state);
        }
        if (pushes) kick(pushes + n, state);
        record_node(state, n, nodes, in.row);
        return outcome;
    }

    const double* read_noise(const StepInputs& in, PathState& state) {
        const double share = 1.0 - 2.0 * left * (1.0 - left);
        return varpin::read_noise(mechanism, share, state.q.data(), state.v.data(), state.center.data(), in, own);
    }

    // The impulse of `part` of the increments dw, (N2).
    void noise_kick(double part, const Felt& felt, const double* dw, PathState& state) {
        noise_impulse(mechanism, part, state.q.data(), state.center.data(), felt, dw, own, bend.data());
        kick(bend.data(), state);
    }
};

}  // namespace varpin
