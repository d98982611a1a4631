// Variational steps under holonomic constraints g(q) = 0 (docs/constraints.md). The discrete action is
// h sum_i b_i L(Q_i, V_i) - sum_k Lam_k . g(Q~_k), with Lobatto points Q~_k = q0 + h sum_j t_kj V_j, and t_kj the
// integral of the j-th Lagrange polynomial on Gauss's points from 0 to the k-th Lobatto point. It gives
//
//     L_v(Q_i, V_i) = p0 + h sum_j a_ij (L_q + F)_j - sum_{k<s} w_ik C_k' Lam_k,    w_ik = 1 - t_ki / b_i
//     g(Q~_k) = 0 for k = 1 .. s
//     p1 = p0 + h sum_j b_j (L_q + F)_j - sum_{k<=s} C_k' Lam_k,    C(q1) M(q1)^-1 p1 = 0
//
// Newton's matrix for all (V, Lam) at once is solved with pivoting. Rows of C that depend on others, in the metric of
// the kinetic energy at the start of a substep, are left out of it: the other rows imply them.
// Equations (H1) and (H2) of docs/constraints.md.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <span>
#include <vector>

#include "varpin/collocation.hpp"
#include "varpin/constraints.hpp"
#include "varpin/guards.hpp"
#include "varpin/substeps.hpp"
#include "varpin/variational.hpp"

namespace varpin {

// C at a node: its independent rows, orthogonalized in the metric of the kinetic energy with pivoting.
struct ConstraintBasis {
    ConstraintJet jet;
    std::vector<double> ldl;   // (n, n) factors of M
    std::vector<double> root;  // (n) D^-1/2
    std::vector<double> rows;  // (m, n) rows of C in this metric, D^-1/2 L^-1 C' transposed
    std::vector<double> Q;     // (r, n) an orthonormal basis of these rows
    std::vector<double> R;     // (r, r) upper triangular: row order[k] = sum_{i<=k} R_ik Q_i
    std::vector<double> size;  // (m) size of the terms that cancel in a row
    std::vector<int> order;    // (r) the rows that are kept, in pivoting order
    double least = 1.0;        // the smallest diagonal entry of R, in units of its row
    int weakest = 0;           // the row of this entry
    int rank() const { return static_cast<int>(order.size()); }
};

// Three moves of so many arrays take a twentieth of a small step.
inline void exchange(ConstraintBasis& a, ConstraintBasis& b) {
    exchange(a.jet, b.jet);
    a.ldl.swap(b.ldl);
    a.root.swap(b.root);
    a.rows.swap(b.rows);
    a.Q.swap(b.Q);
    a.R.swap(b.R);
    a.size.swap(b.size);
    a.order.swap(b.order);
    std::swap(a.least, b.least);
    std::swap(a.weakest, b.weakest);
}

// State of a constrained path, in addition to PathState.
struct ConstrainedState {
    ConstrainedState(const Mechanism& mechanism, int stages)
        : path(mechanism, stages),
          rate(mechanism.constraints.rows()),
          impulse(mechanism.constraints.rows()),
          past_impulse(stages * mechanism.constraints.rows()),
          miss(PathState::most_misses * past_impulse.size()) {}
    PathState path;
    int rank = -1;                     // of the constraints, for the whole rollout
    int weakest = 0;                   // the constraint row that a failed step would name
    std::vector<double> rate;          // (m) rates of kinematic inputs at the node; zero for other rows
    std::vector<double> impulse;       // (m) impulses of the last step, the negative sum of Lam [N s or N m s]
    std::vector<double> past_impulse;  // (s, m) Lam of the last whole step
    std::vector<double> miss;          // (misses, s, m) errors of its guess, as PathState's
    int trend = 0;                     // rows of `miss` that would have made the best guess
    std::vector<double> impulses;      // (steps, m) impulses of the last roll
};

// Steps that make the action (H1) stationary.
class ConstrainedStepper {
  public:
    // `places` is t_kj (s + 1, s).
    ConstrainedStepper(const Mechanism& mechanism, const Tableau& tableau, const std::vector<double>& places,
                       double tolerance, const Guards& guards, const Kernels& kernels = kernels_for<>)
        : guards(guards),
          mechanism(mechanism),
          tableau(tableau),
          tolerance(tolerance),
          equation(mechanism, this->tableau, true, kernels),
          energy_guard(mechanism, true, true, kernels),
          n(mechanism.dof()),
          m(mechanism.constraints.rows()),
          stages(tableau.stages),
          force(stages * n),
          given(stages * n),
          at(places),
          weight(stages * stages),
          trial(n),
          point(stages),
          impulse(stages * m),
          total(m),
          Qk(n),
          scaled(n),
          row_scale(m),
          y(n),
          extras(n),
          bent(n * n),
          pushed(stages * n),
          push_size(stages * n),
          unit(n),
          foreseen(stages * n),
          white(n),
          along(n),
          wanted(n),
          rest(m * n),
          parts(m * n),
          product(n * n),
          mass(n * n),
          curved(n * n),
          unspanned(n),
          taken(m) {
        equation.every_kind = !mechanism.constraints.driven().empty();
        for (int i = 0; i < stages; ++i) {
            for (int k = 0; k < stages; ++k) weight[i * stages + k] = 1.0 - at[k * stages + i] / tableau.b[i];
        }
        const std::vector<DrivenRow>& driven = mechanism.constraints.driven();
        goal_rate.assign(driven.size(), 0.0);
        begun.assign(driven.size(), 0.0);
        curved_paths = std::any_of(driven.begin(), driven.end(), [](const DrivenRow& own) { return own.rate >= 0; });
        if (curved_paths) from_q.resize(n), from_v.resize(n);
    }
    ConstrainedStepper(const ConstrainedStepper&) = delete;
    ConstrainedStepper& operator=(const ConstrainedStepper&) = delete;

    Guards guards;
    bool held = false;  // whether the noise of a step is a force that is constant over it, instead of an impulse
    const Mechanism& mechanism;
    const Tableau tableau;
    double tolerance;
    Collocation equation;
    EnergyGuard energy_guard;
    int n;
    int m;
    int stages;
    std::vector<double> force;           // (n) constant over the step; (s, n) at its stages, or those of a part of it
    int stride = 0;                      // from one row of `force` to the next
    const double* outer = nullptr;       // (n) external force, null for none
    Effort effort;                       // work of the last step
    std::vector<std::uint8_t> halvings;  // of each part of the last step; none if it was taken whole

    // A joint with a kinematic input moves to its goal, its entry of the step's force: at a constant rate, or on the
    // cubic between the rates at both ends, the second given by a control. Its constraint row is g = q - (this motion),
    // and no force but the row's acts on it. Where a control is held over several steps, the goal is at the end of the
    // last of them, `left` steps from here.

    // Set a path's state to (q, p), with p projected onto the tangent space; false where M(q) is not positive definite.
    bool begin_at(const double* q, const double* p, ConstrainedState& state, bool project = true) {
        PathState& path = state.path;
        for (int i = 0; i < n; ++i) {
            path.position[i] = {{q[i], 0.0}, 0.0};
            unwind(i, path);
            path.q[i] = q[i];
            path.p[i] = {p[i], 0.0};
            path.momentum[i] = p[i];
        }
        diffusion_centers(mechanism, q, path.center.data());
        path.known = path.level = path.trend = state.trend = 0;
        state.rank = -1;
        if (!look_at(state)) return false;
        state.rank = here.rank();
        for (const DrivenRow& own : mechanism.constraints.driven()) state.rate[own.row] = path.v[own.coordinate];
        if (project) absorb(state);
        for (int i = 0; i < n; ++i) unit[i] = path.position[i].value.high;
        energy_guard.velocity(path.momentum.data(), path.v.data());
        energy_guard.begin(unit.data(), path.momentum.data(), path.v.data(), path.energies);
        return true;
    }

    // Set a path's state to (q, v).
    bool begin(const double* q, const double* v, ConstrainedState& state) {
        Jet<double>& jet = equation.stage[0];
        equation.kernels.first_order(mechanism, q, v, jet);
        const std::vector<double> p = jet.Lv;
        return begin_at(q, p.data(), state);
    }

    // The constraints and the factors of M at a path's node.
    bool look_at(ConstrainedState& state) {
        for (int i = 0; i < n; ++i) unit[i] = state.path.position[i].value.high;
        if (!find_basis(unit.data(), state.rank, here)) return false;
        energy_guard.velocity(state.path.momentum.data(), state.path.v.data());
        return true;
    }

    // Add an impulse (n) to the momentum; constraints absorb its normal part.
    void kick(const double* push, ConstrainedState& state) {
        PathState& path = state.path;
        for (int i = 0; i < n; ++i) {
            path.p[i] = path.p[i].plus(push[i]);
            path.momentum[i] = path.p[i].high;
            unit[i] = path.position[i].value.high;
        }
        absorb(state);
        energy_guard.kicked(unit.data(), path.momentum.data(), path.v.data(), path.energies);
    }

    // Set the rates of cubic kinematic inputs at their goals, in the order of their rows; others are not read.
    void take_rates(const double* own) { std::copy(own, own + goal_rate.size(), goal_rate.begin()); }

    // Take the force (n) of a step, constant over it, or (s, n) at its stages if it `varies`. The entry of a driven
    // joint is its goal, at all stages.
    void take_force(const double* own, bool varies) {
        stride = varies ? n : 0;
        std::copy(own, own + n, force.begin());
        take_goals();
        if (varies) take_stages(own);
    }

    // One whole step, in as many substeps as the guards require; as VariationalStepper::step.
    Outcome step(double h, ConstrainedState& state) {
        effort = {};
        std::fill(state.impulse.begin(), state.impulse.end(), 0.0);
        PathState& path = state.path;
        const int level = std::max(path.level - 1, 0);
        const auto take = [&](int level, double begin, bool extrapolated) {
            if (extrapolated) {
                extrapolate(state);
            } else {
                guess(path);
            }
            bring_force(begin, level);
            return attempt(length_of(h, level), state, false);
        };
        const auto [outcome, deepest] =
            divide(level, level == 0 && path.known > 0, guards.most_halvings, halvings, take);
        if (outcome != Outcome::solved) return outcome;
        path.level = deepest;
        const int known = path.known;
        path.known = 0;
        if (deepest == 0) {
            if (known > 0) {
                path.trend = follow_misses(equation.V.data(), foreseen.data(), stages * n, known, path.miss.data());
                state.trend =
                    follow_misses(impulse.data(), state.past_impulse.data(), stages * m, known, state.miss.data());
            }
            std::copy(equation.V.begin(), equation.V.end(), path.past.begin());
            std::copy(path.v.begin(), path.v.end(), path.past_end.begin());
            state.past_impulse = impulse;
            path.known = std::min(known + 1, PathState::most_misses + 1);
        }
        return Outcome::solved;
    }

    // The part of a step of length h that was halved `level` times and begins at `begin` in units of the step; begun
    // from the current velocity.
    Outcome part(double h, int level, double begin, ConstrainedState& state) {
        bring_force(begin, level);
        guess(state.path);
        return attempt(length_of(h, level), state, true);
    }

    // A whole step from a guess (s, n) close to its root.
    Outcome from_guess(double h, const double* V, ConstrainedState& state) {
        std::copy(V, V + stages * n, equation.V.begin());
        std::fill(impulse.begin(), impulse.end(), 0.0);
        left = 1;
        bring_force(0.0, 0);
        return attempt(h, state, true);
    }

    // As of VariationalStepper; `impulses` (P, N, 2, n) are held over the step, as the noise is.
    void roll(double h, const Commands& commands, const double* increments, const double* drift, const double* impulses,
              std::vector<ConstrainedState>& states, const Nodes& nodes) {
        const std::int64_t steps = nodes.steps;
        const int controls = mechanism.controls;
        const std::int64_t width = increments_of_step(mechanism, commands);
        const bool noisy = increments != nullptr && width > 0;
        for (std::int64_t p = 0; p < nodes.paths; ++p) {
            ConstrainedState& state = states[p];
            PathState& path = state.path;
            double* u = nodes.u + p * steps * controls;
            path.halvings.clear();
            state.impulses.clear();
            state.impulses.reserve(steps * m);
            nodes.done[p] = 0;
            nodes.ended[p] = static_cast<std::int64_t>(Outcome::solved);
            if (!look_at(state)) {
                nodes.ended[p] = static_cast<std::int64_t>(Outcome::singular);
                continue;
            }
            for (std::int64_t s = 0; s < steps; ++s) {
                const std::int64_t row = p * steps + s;
                const double* dw = noisy ? increments + row * width : nullptr;
                apply_policy(commands, p, s, n, path.q.data(), path.momentum.data(), u);
                const Felt felt = noisy ? felt_controls(commands, p, s, u, seen) : Felt{};
                if (noisy && !held) {
                    noise_impulse(mechanism, 1.0, path.q.data(), path.center.data(), felt, dw, y.data());
                    kick(y.data(), state);
                }
                const double* within = stage_controls(commands, p, s, stages, u, line);
                const Extra extra =
                    held_noise(mechanism, h, row_of(drift, row, n), row_of(impulses, row, 2 * n), path.q.data(),
                               path.center.data(), felt, held ? dw : nullptr, extras.data());
                outer = extra.external;
                stride = within ? n : 0;
                constant_force(mechanism, extra.driven, u + s * controls, force.data());
                take_goals();
                if (within) {
                    stage_forces(mechanism, extra.driven, within, stages, given.data());
                    take_stages(given.data());
                }
                for (std::size_t d = 0; d < goal_rate.size(); ++d) {
                    const int control = mechanism.constraints.driven()[d].rate;
                    if (control >= 0) goal_rate[d] = u[s * controls + control];
                }
                left = commands.hold - static_cast<int>(s % commands.hold);
                const Outcome outcome = step(h, state);
                record_effort(effort, nodes, row);
                nodes.ended[p] = static_cast<std::int64_t>(outcome);
                if (outcome != Outcome::solved) break;
                path.halvings.insert(path.halvings.end(), halvings.begin(), halvings.end());
                state.impulses.insert(state.impulses.end(), state.impulse.begin(), state.impulse.end());
                record_node(path, n, nodes, row);
                nodes.done[p] = s + 1;
            }
        }
        outer = nullptr;
    }

    // Derivatives of the last substep, from (q0, p0) under the force f, as a map on all of R^2n: of (q1, p1) in (q0,
    // p0), Jx (2n, 2n), in f, Jf (2n, n), and in the rates of kinematic inputs at their goals, Jr (2n, driven rows),
    // zero for linear ones. The map does not require g(q0) = 0, and absorbs the part of p0 normal to the constraints.
    void derivatives(double h, const PathState& path, double* Jx, double* Jf, double* Jr) {
        exchange(here, origin);
        const int size = stages * (n + here.rank());
        assemble(h);
        factor_lu_pivoting(saddle.data(), size, rows.data());
        bend_points();
        state_columns(h);
        end_columns(h, Jx, Jf);
        for (int end = 0; end < 2 && curved_paths; ++end) {
            rate_columns(end);
            by_rates[end].resize(6 * n * n);
            end_columns(h, by_rates[end].data(), by_rates[end].data() + 4 * n * n);
        }
        exchange(here, origin);
        project_derivatives(h, path, Goal::position, Jx, Jf);
        if (!curved_paths) return;
        for (int end = 0; end < 2; ++end) {
            project_derivatives(h, path, end == 0 ? Goal::begin : Goal::end, by_rates[end].data(),
                                by_rates[end].data() + 4 * n * n);
        }
        join_rates(Jx, Jr);
    }

    ConstraintBasis here;    // at the path's state
    ConstraintBasis origin;  // at the beginning of the last substep, once the path has moved on

  private:
    ConstraintBasis there;  // at the end of a trial substep

    // Threshold, in units of a row's terms, below which the row depends on the others. Rounding leaves 1e-15.
    static constexpr double dependent = 1e-9;
    // Threshold below which independent constraints are too close to a singular point.
    static constexpr double near_toggle = 1e-5;
    // Greatest relative change of C within a substep, where guards are active.
    static constexpr double most_turn = 0.7;
    static constexpr double stagnation = 100.0;
    static constexpr double sure = 10.0;  // as Collocation's
    static constexpr int most_corrections = 12;

    int left = 1;                                 // steps to the goal of kinematic inputs
    double share = 1.0;                           // the next part's share of the time to the goal
    std::vector<double> goal;                     // goal positions of the kinematic inputs
    std::vector<double> goal_rate, begun;         // rates at the goal and at the beginning of the part
    bool curved_paths = false;                    // whether any input is cubic
    std::vector<double> from_q, from_v;           // (n) state at the beginning of the part, if so
    std::array<std::vector<double>, 2> by_rates;  // (2n, 2n) and (2n, n), derivatives in rates at both ends
    std::vector<double> given;                    // (s, n) force at the stages of the whole step, if it varies
    std::vector<double> line;                     // (s, m) controls at the stages, if they are linear in time
    std::vector<double> seen;                     // (2, m) what the noise sees of them
    std::vector<double> at;                       // (s + 1, s) t_kj
    std::vector<double> weight;                   // (s, s) w_ik
    Trial trial;
    std::vector<ConstraintJet> point;  // of Lobatto points 1 .. s
    std::vector<double> impulse;       // (s, m) Lam_k, zero for omitted rows
    std::vector<double> total;         // (m)
    std::vector<double> last;          // (m) Lam_s
    std::vector<double> rate;          // (m) rates of kinematic inputs in the part
    double unresolved = 0.0;           // velocity below the rounding of the last residuals
    std::vector<double> Qk, scaled, row_scale, y, extras, bent, pushed, push_size, unit;
    std::vector<double> block, saddle, right, solution;
    std::vector<int> rows;
    std::vector<double> null, reduced_mass, reduced;
    std::vector<double> foreseen;              // (s, n) stage velocities extrapolated without the guesses' errors
    std::vector<double> white, along, wanted;  // (n)
    std::vector<double> rest, parts;           // (m, n)
    std::vector<double> product;               // (r, r)
    std::vector<double> mass, curved;          // (n, n)
    std::vector<double> unspanned;             // (n) squared norms of the rest of the unit vectors
    std::vector<char> taken;                   // whether a row is in the basis

    std::vector<double> dV, columns, bends;

    // Lam_k . g_qq (s, n, n) at the Lobatto points but the last.
    void bend_points() {
        bends.assign(entries(stages * n, n), 0.0);
        for (int k = 0; k < stages; ++k)
            mechanism.constraints.add_curvature(&impulse[k * m], 1.0, k == 0 ? here.jet : point[k - 1],
                                                &bends[k * n * n]);
    }

    // Parameters of a kinematic input's motion: the goal, or the rates at both ends of a cubic.
    enum class Goal { position, begin, end };

    // A driven joint's displacement is ahead * (distance to the goal) + T (begin * (rate at the start) + end * (rate at
    // the goal)), with T the time to the goal.
    struct Way {
        double ahead, begin, end;
    };
    // These coefficients after the share `at` of T.
    Way way_at(int d, double at) const {
        if (mechanism.constraints.driven()[d].rate < 0) return {at, 0.0, 0.0};
        return {at * at * (3.0 - 2.0 * at), at * (1.0 - at) * (1.0 - at), at * at * (at - 1.0)};
    }
    // Those of the joint's rate: ahead * (distance / T) + begin * (rate at the start) + end * (rate at the goal).
    Way pace_at(int d, double at) const {
        if (mechanism.constraints.driven()[d].rate < 0) return {1.0, 0.0, 0.0};
        return {6.0 * at * (1.0 - at), (1.0 - at) * (1.0 - 3.0 * at), at * (3.0 * at - 2.0)};
    }
    double rate_at(int d, double at, double h, double from) const {
        const Way pace = pace_at(d, at);
        return pace.ahead * share * (goal[d] - from) / h + pace.begin * begun[d] + pace.end * goal_rate[d];
    }
    // Index of the kinematic input of a row, or -1.
    int driven_of(int row) const {
        const std::vector<DrivenRow>& driven = mechanism.constraints.driven();
        for (std::size_t d = 0; d < driven.size(); ++d) {
            if (driven[d].row == row) return static_cast<int>(d);
        }
        return -1;
    }

    // Right sides for derivatives in (q0, p0) and in the goals of kinematic inputs.
    void state_columns(double h) {
        const int r = here.rank(), wide = stages * n, size = stages * (n + r), w = 3 * n;
        dV.resize(entries(wide, w));
        equation.right_sides(n, stages, h, {0, n}, dV);
        for (int row = 0; equation.kinds() == 2 && row < n; ++row) {
            for (int c = 0; c < n; ++c) dV[row * w + 2 * n + c] = equation.by_momentum(h, c) * dV[row * w + n + c];
        }
        for (const DrivenRow& own : mechanism.constraints.driven()) {
            for (int i = 0; i < wide; ++i) dV[i * w + 2 * n + own.coordinate] = 0.0;
        }
        columns.assign(entries(size, w), 0.0);
        for (int i = 0; i < wide; ++i) {
            for (int c = 0; c < w; ++c) {
                double entry = dV[i * w + c];
                for (int k = 0; k < stages && c < n; ++k)
                    entry -= weight[(i / n) * stages + k] * bends[(k * n + i % n) * n + c];
                columns[i * w + c] = scaled[i % n] * entry;
            }
        }
        for (int k = 0; k < stages; ++k) {
            for (int a = 0; a < r; ++a) {
                const int row = here.order[a];
                double* own = &columns[(wide + k * r + a) * w];
                for (int c = 0; c < n; ++c) own[c] = -row_scale[row] * point[k].C[row * n + c] / h;
                const int d = driven_of(row);
                if (d < 0) continue;
                const int c = mechanism.constraints.driven()[d].coordinate;
                const Way way = way_at(d, way_to(k + 1));
                own[2 * n + c] = row_scale[row] * way.ahead / h;
                own[c] += row_scale[row] * (1.0 - way.ahead) / h;
            }
        }
    }

    // Right sides for derivatives in the rate of each cubic input at the beginning (`end` 0) or at its goal (1), in the
    // column of the goal.
    void rate_columns(int end) {
        const int r = here.rank(), wide = stages * n, size = stages * (n + r), w = 3 * n;
        columns.assign(entries(size, w), 0.0);
        for (int k = 0; k < stages; ++k) {
            for (int a = 0; a < r; ++a) {
                const int d = driven_of(here.order[a]);
                if (d < 0) continue;
                const DrivenRow& own = mechanism.constraints.driven()[d];
                const Way way = way_at(d, way_to(k + 1));
                columns[(wide + k * r + a) * w + 2 * n + own.coordinate] =
                    row_scale[own.row] * (end == 0 ? way.begin : way.end) / share;
            }
        }
    }

    // Write the derivatives in the rates at the goals, and add those by way of the rates at the beginning, which follow
    // from the momentum: v = M^-1 p, M dv = dp - L_vq dq.
    void join_rates(double* Jx, double* Jr) {
        const std::vector<DrivenRow>& driven = mechanism.constraints.driven();
        equation.kernels.jet(mechanism, from_q.data(), from_v.data(), equation.stage[0]);
        for (std::size_t d = 0; d < driven.size(); ++d) {
            const double *at_begin = by_rates[0].data() + 4 * n * n, *at_end = by_rates[1].data() + 4 * n * n;
            for (int i = 0; i < 2 * n; ++i)
                Jr[i * driven.size() + d] = driven[d].rate < 0 ? 0.0 : at_end[i * n + driven[d].coordinate];
            if (driven[d].rate < 0) continue;
            std::fill(y.begin(), y.end(), 0.0);
            y[driven[d].coordinate] = 1.0;
            whiten(origin, y.data(), y.data());
            for (int i = 0; i < n; ++i) y[i] *= origin.root[i];
            solve_upper(origin.ldl.data(), n, {0, n}, y.data());
            for (int c = 0; c < n; ++c) {
                double by_q = 0.0;
                for (int j = 0; j < n; ++j) by_q -= y[j] * equation.stage[0].A[j * n + c];
                for (int i = 0; i < 2 * n; ++i) {
                    const double own = at_begin[i * n + driven[d].coordinate];
                    Jx[i * 2 * n + c] += own * by_q;
                    Jx[i * 2 * n + n + c] += own * y[c];
                }
            }
        }
    }

    // Derivatives of the end of a substep without its last impulse, from the right sides in `columns` and the factors
    // of the bordered matrix.
    void end_columns(double h, double* Jx, double* Jf) {
        const int r = here.rank(), wide = stages * n, size = stages * (n + r), w = 3 * n;
        std::vector<double> sorted(columns.size());
        for (int i = 0; i < size; ++i) std::copy_n(&columns[rows[i] * w], w, &sorted[i * w]);
        solve_lu_rows(saddle.data(), size, {0, size}, sorted.data(), w, w);
        for (int i = 0; i < wide; ++i) {
            for (int c = 0; c < w; ++c) dV[i * w + c] = scaled[i % n] * sorted[i * w + c];
        }
        equation.end_derivatives(n, stages, h, {0, n}, dV, Jx, Jf);
        // The impulses up to the last one contribute C_k' dLam_k + Lam_k . g_qq dQ~_k.
        std::vector<double> dQ(n);
        for (int c = 0; c < w; ++c) {
            for (int k = 0; k < stages; ++k) {
                for (int i = 0; i < n; ++i) {
                    double sum = 0.0;
                    for (int j = 0; j < stages; ++j) sum += at[k * stages + j] * dV[(j * n + i) * w + c];
                    dQ[i] = h * sum + (c == i ? 1.0 : 0.0);
                }
                for (int i = 0; i < n; ++i) {
                    double sum = inner(&bends[(k * n + i) * n], dQ.data());
                    for (int a = 0; a < r; ++a) {
                        const int row = here.order[a];
                        sum += jet_at(k).C[row * n + i] * row_scale[row] * sorted[(wide + k * r + a) * w + c];
                    }
                    entry(Jx, Jf, n + i, c) -= sum;
                }
            }
        }
    }

    double& entry(double* Jx, double* Jf, int row, int c) const {
        return c < 2 * n ? Jx[row * 2 * n + c] : Jf[row * n + c - 2 * n];
    }

    // The last impulse: M dv1 + C1' dLam = dp - (L_vq + Lam . g_qq) dq1, C1 dv1 = -(g_qq v1) dq1, and dp1 = M dv1 +
    // L_vq dq1.
    void project_derivatives(double h, const PathState& path, Goal what, double* Jx, double* Jf) {
        const auto end = [&](int row, int c) -> double& { return entry(Jx, Jf, row, c); };
        const int r = here.rank();
        for (int i = 0; i < n; ++i) unit[i] = path.position[i].value.high;
        Jet<double>& jet = equation.stage[0];
        equation.kernels.jet(mechanism, unit.data(), path.v.data(), jet);
        std::vector<double> bend(m * n), curvature(n * n), z(n), along(r), dq(n), turned(n);
        mechanism.constraints.bend(path.v.data(), here.jet, bend.data());
        mechanism.constraints.add_curvature(last.data(), 1.0, here.jet, curvature.data());
        for (int c = 0; c < 3 * n; ++c) {
            for (int i = 0; i < n; ++i) dq[i] = end(i, c);
            for (int i = 0; i < n; ++i) {
                turned[i] = inner(&jet.A[i * n], dq.data());
                z[i] = end(n + i, c) - turned[i] - inner(&curvature[i * n], dq.data());
            }
            whiten(here, z.data(), z.data());
            for (int k = 0; k < r; ++k) {
                double own = -inner(&bend[here.order[k] * n], dq.data());
                if (const int d = driven_of(here.order[k]); d >= 0) {
                    const int moved = mechanism.constraints.driven()[d].coordinate;
                    const Way pace = pace_at(d, share);
                    if (what == Goal::position) {
                        own += pace.ahead * share / h * ((c == 2 * n + moved) - (c == moved));
                    } else if (c == 2 * n + moved) {
                        own += what == Goal::begin ? pace.begin : pace.end;
                    }
                }
                for (int j = 0; j < k; ++j) own -= here.R[j * r + k] * along[j];
                along[k] = own / here.R[k * r + k];
            }
            const std::vector<double> before = z;
            for (int k = 0; k < r; ++k) {
                const double change = along[k] - inner(&here.Q[k * n], before.data());
                for (int i = 0; i < n; ++i) z[i] += change * here.Q[k * n + i];
            }
            for (int i = 0; i < n; ++i) z[i] *= std::sqrt(here.ldl[i * n + i]);
            for (int i = n - 1; i >= 0; --i) {
                double sum = z[i];
                for (int j = 0; j < i; ++j) sum += here.ldl[i * n + j] * z[j];
                end(n + i, c) = sum + turned[i];
            }
        }
    }

    bool unwinds(int i) const {
        return mechanism.tree.periodic[i] && !mechanism.forces.anchors(i) && !mechanism.couplings.has_outer();
    }
    void unwind(int i, PathState& path) const {
        if (unwinds(i)) path.position[i].unwind();
    }

    // Compute the factors of M and the basis of C at q, of the `rank` most independent rows, or of all independent ones
    // for -1. False where M is not positive definite. C is known already where it has `visited` q.
    bool find_basis(const double* q, int rank, ConstraintBasis& basis, bool visited = false) {
        if (!energy_guard.factor(q)) return false;
        basis.ldl = energy_guard.factors();
        basis.root.resize(n);
        for (int i = 0; i < n; ++i) basis.root[i] = 1.0 / std::sqrt(basis.ldl[i * n + i]);
        if (!visited) mechanism.constraints.at(q, basis.jet);
        measure_rows(basis);
        const double next = choose_rows(rank, basis);
        const int found = basis.rank();
        basis.R.assign(found * found, 0.0);
        for (int k = 0; k < found; ++k) {
            for (int i = 0; i <= k; ++i) basis.R[i * found + k] = parts[basis.order[k] * n + i];
        }
        // Dependent rows have become independent: the rollout began at a singular configuration.
        if (rank >= 0 && (next > 1e3 * dependent || found < rank)) basis.least = 0.0;
        return true;
    }

    // The rows of C in the metric of the kinetic energy, and the size of the terms that cancel in each: their squares
    // times the diagonal of M^-1.
    void measure_rows(ConstraintBasis& basis) {
        basis.rows.resize(m * n);
        basis.size.assign(m, 0.0);
        for (int c = 0; c < n; ++c) {
            double inverse = 0.0;
            for (int i = c; i < n; ++i) {
                double entry = i == c ? 1.0 : 0.0;
                for (int j = c; j < i; ++j) entry -= basis.ldl[i * n + j] * white[j];
                white[i] = entry;
                inverse += entry * entry * basis.root[i] * basis.root[i];
            }
            for (int r = 0; r < m; ++r)
                basis.size[r] += basis.jet.size[r * n + c] * basis.jet.size[r * n + c] * inverse;
        }
        for (int r = 0; r < m; ++r) {
            whiten(basis, &basis.jet.C[r * n], &basis.rows[r * n]);
            basis.size[r] = std::sqrt(basis.size[r]);
        }
    }

    // Write Q, the order and the least row of a basis by Gram-Schmidt, twice, with pivoting: next is the row with the
    // largest rest in units of its size. Returns the rest of the first row beyond `rank`.
    double choose_rows(int rank, ConstraintBasis& basis) {
        std::copy(basis.rows.begin(), basis.rows.end(), rest.begin());
        std::fill(taken.begin(), taken.end(), 0);
        basis.order.clear();
        basis.Q.clear();
        basis.least = 1.0;
        basis.weakest = 0;
        const int most = rank < 0 ? std::min(m, n) : rank;
        for (int k = 0; k <= most && k < m; ++k) {
            const auto [best, farthest] = farthest_row(basis);
            if (k == most) return farthest;
            if (!(farthest > dependent) && rank < 0) break;
            basis.least = farthest;
            basis.weakest = best;
            taken[best] = 1;
            const double length = norm(&rest[best * n]);
            if (!(length > 0.0)) break;
            basis.order.push_back(best);
            for (int c = 0; c < n; ++c) basis.Q.push_back(rest[best * n + c] / length);
            parts[best * n + k] = inner(&basis.Q[k * n], &rest[best * n]);
            for (int r = 0; r < m; ++r) {
                if (!taken[r]) leave_rest(basis, k, r);
            }
        }
        return 0.0;
    }

    // The row with the largest rest, in units of its size, of those that are not taken.
    std::pair<int, double> farthest_row(const ConstraintBasis& basis) const {
        int best = -1;
        double farthest = 0.0;
        for (int r = 0; r < m; ++r) {
            if (taken[r]) continue;
            const double own = norm(&rest[r * n]) / std::max(basis.size[r], nothing);
            if (best < 0 || own > farthest) best = r, farthest = own;
        }
        return {best, farthest};
    }

    // Remove the part along Q_k from the rest of a row, and what rounding has left along Q_0 .. Q_k.
    void leave_rest(const ConstraintBasis& basis, int k, int row) {
        double *own = &rest[row * n], *part = &parts[row * n];
        const auto remove = [&](int i) {
            const double* unit = &basis.Q[i * n];
            const double along = inner(unit, own);
            for (int c = 0; c < n; ++c) own[c] -= along * unit[c];
            return along;
        };
        part[k] = remove(k);
        for (int i = 0; i <= k; ++i) part[i] += remove(i);
    }

    // D^-1/2 L^-1 b.
    void whiten(const ConstraintBasis& basis, const double* b, double* x) const {
        solve_lower(basis.ldl.data(), n, {0, n}, b, x);
        for (int i = 0; i < n; ++i) x[i] *= basis.root[i];
    }

    double inner(const double* a, const double* b) const {
        double sum = 0.0;
        for (int i = 0; i < n; ++i) sum += a[i] * b[i];
        return sum;
    }
    double norm(const double* a) const { return std::sqrt(inner(a, a)); }
    // y += s x.
    static void add_scaled(int size, double s, const double* x, double* y) {
        detail::subtract_scaled(y, -s, x, 0, size);
    }

    // Read the goals of kinematic inputs from the step's force.
    void take_goals() {
        const std::vector<DrivenRow>& driven = mechanism.constraints.driven();
        goal.resize(driven.size());
        for (std::size_t d = 0; d < driven.size(); ++d) {
            goal[d] = force[driven[d].coordinate];
            force[driven[d].coordinate] = 0.0;
        }
    }

    // Take forces (s, n) at the stages of the step; no force but that of its row acts on a driven joint.
    void take_stages(const double* own) {
        if (own != given.data()) std::copy(own, own + stages * n, given.begin());
        for (const DrivenRow& row : mechanism.constraints.driven()) {
            for (int i = 0; i < stages; ++i) given[i * n + row.coordinate] = 0.0;
        }
    }

    // Share of the time to the goal that has passed at Lobatto point k of the part.
    double way_to(int k) const {
        double sum = 0.0;
        for (int j = 0; j < stages; ++j) sum += at[k * stages + j];
        return share * sum;
    }

    // Solve C M^-1 (p - C' Lam) = rate for Lam (m) of the basis' rows; zero for other rows.
    void find_impulse(const ConstraintBasis& basis, const double* p, const double* rate, double* Lam) {
        const int r = basis.rank();
        whiten(basis, p, white.data());
        for (int k = 0; k < r; ++k) {
            double own = rate[basis.order[k]];
            for (int j = 0; j < k; ++j) own -= basis.R[j * r + k] * wanted[j];
            wanted[k] = own / basis.R[k * r + k];
            along[k] = inner(&basis.Q[k * n], white.data()) - wanted[k];
        }
        std::fill(Lam, Lam + m, 0.0);
        for (int k = r - 1; k >= 0; --k) {
            double own = along[k];
            for (int j = k + 1; j < r; ++j) own -= basis.R[k * r + j] * Lam[basis.order[j]];
            Lam[basis.order[k]] = own / basis.R[k * r + k];
        }
    }

    // Remove the part of a momentum that is normal to the constraints at the path's node, with the basis `here`.
    void absorb(ConstrainedState& state) {
        PathState& path = state.path;
        for (int again = 0; again < 2; ++again) {
            find_impulse(here, path.momentum.data(), state.rate.data(), total.data());
            across(here.jet, total.data(), y.data());
            for (int c = 0; c < n; ++c) {
                path.p[c] = path.p[c].plus(-y[c]);
                path.momentum[c] = path.p[c].high;
            }
        }
    }

    // C' Lam (n).
    void across(const ConstraintJet& jet, const double* Lam, double* out) const {
        std::fill(out, out + n, 0.0);
        for (int r = 0; r < m; ++r) add_scaled(n, Lam[r], &jet.C[r * n], out);
    }

    const ConstraintJet& jet_at(int k) const { return k == 0 ? here.jet : point[k - 1]; }

    void guess(const PathState& path) {
        for (int i = 0; i < stages; ++i) std::copy(path.v.begin(), path.v.end(), equation.V.begin() + i * n);
        std::fill(impulse.begin(), impulse.end(), 0.0);
    }

    // Guess of the stages: the polynomial through the last step's stage velocities and the velocity at its end, shifted
    // by kicks since, and the last impulses. The errors of guesses are extrapolated, too, as in VariationalStepper.
    void extrapolate(const ConstrainedState& state) {
        const PathState& path = state.path;
        const bool steady = mechanism.diffusion.processes == 0;
        const int trend = steady ? path.trend : 0, impulse_trend = steady ? state.trend : 0;
        for (int i = 0; i < stages; ++i) {
            const double* ahead = &tableau.ahead[i * (stages + 1)];
            for (int c = 0; c < n; ++c) {
                const int k = i * n + c;
                double sum = path.v[c] - path.past_end[c];
                for (int j = 0; j < stages; ++j) sum += ahead[j] * path.past[j * n + c];
                foreseen[k] = sum + ahead[stages] * path.past_end[c];
                double missing = 0.0;
                for (int r = 0; r < trend; ++r) missing += path.miss[r * stages * n + k];
                equation.V[k] = foreseen[k] + missing;
            }
        }
        for (int k = 0; k < stages * m; ++k) {
            impulse[k] = state.past_impulse[k];
            for (int r = 0; r < impulse_trend; ++r) impulse[k] += state.miss[r * stages * m + k];
        }
    }

    // One substep from the path's state; moves the path only if it is accepted.
    Outcome attempt(double h, ConstrainedState& state, bool jets_wanted) {
        PathState& path = state.path;
        state.weakest = here.weakest;
        if (!(here.least > near_toggle) && m > 0 && here.rank() > 0) return Outcome::toggle;
        keep_start(state);
        Outcome outcome = solve(h, path, jets_wanted);
        if (outcome != Outcome::solved) return outcome;
        double margin = infinity;
        if (guards.active) {
            for (int k = 1; k <= stages; ++k) {
                if (!(turn_to(point[k - 1]) <= most_turn)) return Outcome::assembly;
            }
            margin = branch_margin(h);
            if (!(margin > 0.0)) return Outcome::fold;
        }
        advance(h, path);
        outcome = end_on_constraints(h, state, !jets_wanted);
        if (outcome != Outcome::solved) return outcome;
        for (std::size_t d = 0; d < goal.size(); ++d) add_work(static_cast<int>(d), h, path);
        outcome = energy_guard.accept(guards, tableau, path.energies, path.position, path.v, trial, true);
        if (outcome != Outcome::solved) return outcome;
        effort.branch_margin = std::min(effort.branch_margin, margin);
        ++effort.substeps;
        return move_to_end(state);
    }

    // Keep what kinematic inputs need of the beginning of a part.
    void keep_start(const ConstrainedState& state) {
        const PathState& path = state.path;
        for (std::size_t d = 0; d < goal.size(); ++d) begun[d] = state.rate[mechanism.constraints.driven()[d].row];
        if (!curved_paths) return;
        for (int i = 0; i < n; ++i) from_q[i] = path.position[i].value.high;
        std::copy(path.v.begin(), path.v.end(), from_v.begin());
    }

    // Find the basis at the end in `trial`, and the last impulse, which makes its momentum tangent. C at the end is
    // that at the last Lobatto point if it was `visited` there.
    Outcome end_on_constraints(double h, ConstrainedState& state, bool visited) {
        const PathState& path = state.path;
        rate.assign(m, 0.0);
        for (std::size_t d = 0; d < goal.size(); ++d) {
            const DrivenRow& own = mechanism.constraints.driven()[d];
            rate[own.row] = rate_at(static_cast<int>(d), share, h, path.position[own.coordinate].value.high);
        }
        for (int i = 0; i < n; ++i) unit[i] = trial.position[i].value.high;
        if (visited) exchange(there.jet, point.back());
        if (!find_basis(unit.data(), state.rank, there, visited)) return Outcome::singular;
        if (!(there.least > near_toggle) && there.rank() > 0) {
            state.weakest = there.weakest;
            return Outcome::toggle;
        }
        last.assign(m, 0.0);
        for (int again = 0; again < 2; ++again) {
            for (int i = 0; i < n; ++i) y[i] = trial.p[i].high;
            find_impulse(there, y.data(), rate.data(), total.data());
            across(there.jet, total.data(), y.data());
            for (int c = 0; c < n; ++c) trial.p[c] = trial.p[c].plus(-y[c]);
            for (int r = 0; r < m; ++r) last[r] += total[r];
        }
        return Outcome::solved;
    }

    // Move the path to the end of an accepted substep; `singular` where M is not positive definite after whole turns
    // were removed.
    Outcome move_to_end(ConstrainedState& state) {
        PathState& path = state.path;
        for (int r = 0; r < m; ++r) {
            double sum = last[r];
            for (int k = 0; k < stages; ++k) sum += impulse[k * m + r];
            state.impulse[r] -= sum;
        }
        std::swap(path.position, trial.position);
        std::swap(path.p, trial.p);
        state.rate = rate;
        exchange(origin, here);
        exchange(here, there);
        bool turned = false;
        for (int i = 0; i < n; ++i) {
            const double turns = path.position[i].turns;
            unwind(i, path);
            turned = turned || path.position[i].turns != turns;
            path.q[i] = path.position[i].shown();
        }
        std::copy(trial.momentum.begin(), trial.momentum.end(), path.momentum.begin());
        std::copy(trial.v.begin(), trial.v.end(), path.v.begin());
        if (turned) return look_at(state) ? Outcome::solved : Outcome::singular;
        return Outcome::solved;
    }

    // Newton's method on the stages and the constraints, as Collocation::solve. Factors are kept while they contract.
    // A correction that is certain to be the last one is not evaluated unless `jets_wanted`. With `jets_wanted` it ends
    // with the jets and C at the root, else with those of the last iterate.
    Outcome solve(double h, const PathState& path, bool jets_wanted) {
        const Start start{path.position.data(), path.p.data(), force.data(), stride, outer};
        scale_unknowns();
        const int size = stages * (n + here.rank());
        double before = infinity, worst = infinity, worst_before = infinity;
        bool fresh = true;
        for (int iteration = 0; iteration < most_corrections + 1; ++iteration) {
            equation.sweep(h, start, fresh, effort);
            visit_points(h, start);
            worst = residuals(h, start);
            if (worst <= tolerance) {
                if (fresh || !jets_wanted) break;
                fresh = true;
                continue;
            }
            if (!(worst < infinity)) return Outcome::not_finite;
            if (iteration == most_corrections) break;
            if (fresh) {
                assemble(h);
                if (factor_lu_pivoting(saddle.data(), size, rows.data()) == 0) return Outcome::fold;
            }
            find_correction();
            const double moved = equation.kinetic_size(equation.delta.data());
            // Impulses may be far from the root where velocities are not.
            if (!(moved <= 0.25 * before) && !(worst <= 0.25 * worst_before)) {
                // The cause may be factors of an earlier iterate.
                if (fresh) break;
                fresh = true;
                continue;
            }
            take_correction();
            ++effort.newton_iterations;
            // With one stage there is no impulse between the ends, so constraints add no curvature.
            double left = fresh && stages == 1 ? equation.left_by_bending(h, worst) : infinity;
            fresh = false;
            if (before < infinity) {
                const double contraction = std::sqrt(moved / before);
                left = std::min(left, contraction * worst);
                fresh = !(worst * contraction * contraction * contraction <= tolerance);
            }
            if (!jets_wanted && sure * left <= tolerance) {
                visit_points(h, start);
                const double open = rows_error(h);
                if (open <= tolerance) {
                    equation.correct_slopes(h);
                    push();
                    worst = std::max(left, open);
                    break;
                }
            }
            before = moved;
            worst_before = worst;
        }
        if (!(worst <= std::max(stagnation, tolerance))) return Outcome::diverged;
        effort.residual = std::max(effort.residual, worst);
        return Outcome::solved;
    }

    // Units in which the entries of Newton's matrix are of order 1; rows that are left out have no impulse.
    void scale_unknowns() {
        for (int c = 0; c < n; ++c) scaled[c] = 1.0 / std::sqrt(mass_diagonal(c));
        for (int r = 0; r < m; ++r) row_scale[r] = 1.0 / std::max(norm(&here.rows[r * n]), nothing);
        for (int r = 0; r < m; ++r) {
            if (std::find(here.order.begin(), here.order.end(), r) != here.order.end()) continue;
            for (int k = 0; k < stages; ++k) impulse[k * m + r] = 0.0;
        }
    }

    // Newton's correction from the factors: of the velocities in equation.delta, of the impulses at the end of
    // `solution`.
    void find_correction() {
        const int size = stages * (n + here.rank());
        solve_lu_pivoting(saddle.data(), size, rows.data(), right.data(), solution.data());
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) equation.delta[i * n + c] = scaled[c] * solution[i * n + c];
        }
    }

    // Add Newton's correction to the velocities and impulses.
    void take_correction() {
        for (int k = 0; k < stages * n; ++k) equation.V[k] += equation.delta[k];
        const int r = here.rank();
        for (int k = 0; k < stages; ++k) {
            for (int a = 0; a < r; ++a) {
                const int row = here.order[a];
                impulse[k * m + row] += row_scale[row] * solution[stages * n + k * r + a];
            }
        }
    }

    // Interpolate a varying force to the stages of a part of the step.
    void bring_force(double begin, int level) {
        share = length_of(1.0, level) / (left - begin);
        if (stride == 0) return;
        bring_to_part(tableau, n, given.data(), begin, length_of(1.0, level), force.data());
    }

    double mass_diagonal(int c) const {
        double sum = here.ldl[c * n + c];
        for (int j = 0; j < c; ++j) sum += here.ldl[c * n + j] * here.ldl[c * n + j] * here.ldl[j * n + j];
        return sum;
    }

    // Work of the kinematic inputs' impulses; the first impulse also acts at the velocity before it.
    void add_work(int d, double h, const PathState& path) {
        const DrivenRow& own = mechanism.constraints.driven()[d];
        const double from = path.position[own.coordinate].value.high;
        for (int k = 0; k <= stages; ++k) {
            const double Lam = k < stages ? impulse[k * m + own.row] : last[own.row];
            double velocity = rate_at(d, way_to(k), h, from);
            if (k == 0) velocity = 0.5 * (path.v[own.coordinate] + velocity);
            const double work = -Lam * velocity;
            trial.work[own.coordinate] += work;
            trial.magnitude[own.coordinate] += std::abs(work);
        }
    }

    void visit_points(double h, const Start& start) {
        for (int k = 1; k <= stages; ++k) {
            for (int c = 0; c < n; ++c) {
                double sum = 0.0;
                for (int j = 0; j < stages; ++j) sum += at[k * stages + j] * equation.V[j * n + c];
                Qk[c] = start.position[c].value.high + (start.position[c].value.low + h * sum);
            }
            mechanism.constraints.at(Qk.data(), point[k - 1]);
            for (std::size_t d = 0; d < goal.size(); ++d) {
                const DrivenRow& own = mechanism.constraints.driven()[d];
                const Coordinate& from = start.position[own.coordinate];
                const Way way = way_at(static_cast<int>(d), way_to(k));
                const double ahead = goal[d] - from.value.high, swing = begun[d] * way.begin + goal_rate[d] * way.end;
                const double moved = way.ahead * ahead + h / share * swing;
                point[k - 1].g[own.row] = Qk[own.coordinate] - (from.value.high + (from.value.low + moved));
                point[k - 1].scale[own.row] =
                    std::abs(Qk[own.coordinate]) + std::abs(ahead) + h / share * std::abs(swing);
            }
        }
    }

    // Write C_k' Lam_k to `pushed`, and the size of its terms.
    void push() {
        std::fill(pushed.begin(), pushed.end(), 0.0);
        std::fill(push_size.begin(), push_size.end(), 0.0);
        const int r = here.rank();
        for (int k = 0; k < stages; ++k) {
            const ConstraintJet& jet = jet_at(k);
            for (int a = 0; a < r; ++a) {
                const int row = here.order[a];
                const double own = impulse[k * m + row];
                add_scaled(n, own, &jet.C[row * n], &pushed[k * n]);
                add_scaled(n, std::abs(own), &jet.size[row * n], &push_size[k * n]);
            }
        }
    }

    // Write the residuals of the stages, (H2), to `right`, then -g / h; returns the largest in rounding units of its
    // terms.
    double residuals(double h, const Start& start) {
        return stages == 1 ? residuals_of(1, h, start) : residuals_of(stages, h, start);
    }

    // As Collocation's.
    [[gnu::always_inline]] inline double residuals_of(const int stages, double h, const Start& start) {
        double worst = 0.0;
        const int r = here.rank();
        right.resize(stages * (n + r));
        solution.resize(right.size());
        push();
        unresolved = 0.0;
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) {
                const int k = i * n + c;
                equation.slope[k] = equation.stage[i].Lq[c] + (start.force_at(i)[c] + equation.acting[k].value);
                equation.slope_rest[k] = 0.0;
            }
        }
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) {
                double sum = 0.0, scale = 0.0, across_rows = 0.0, across_size = 0.0;
                for (int j = 0; j < stages; ++j) {
                    const double a = tableau.a[i * stages + j];
                    sum += a * equation.slope[j * n + c];
                    scale += std::abs(a) * (equation.stage[j].Lq_scale[c] + std::abs(start.force_at(j)[c]) +
                                            equation.acting[j * n + c].scale);
                    across_rows += weight[i * stages + j] * pushed[j * n + c];
                    across_size += std::abs(weight[i * stages + j]) * push_size[j * n + c];
                }
                double error = (start.p[c].high - equation.stage[i].Lv[c]) + (start.p[c].low + (h * sum - across_rows));
                right[i * n + c] = scaled[c] * error;
                scale = h * scale + std::abs(start.p[c].high) + equation.stage[i].Lv_scale[c] + across_size;
                unresolved = std::max(unresolved, rounding_unit * scale * scaled[c] * scaled[c]);
                if (scale > nothing) error = std::abs(error) / (rounding_unit * scale);
                worst = larger(error, worst);
            }
        }
        for (int k = 0; k < stages; ++k) {
            for (int a = 0; a < r; ++a) {
                const int row = here.order[a];
                right[stages * n + k * r + a] = -row_scale[row] * point[k].g[row] / h;
            }
        }
        const double open = rows_error(h);
        return open > worst || std::isnan(open) ? open : worst;
    }

    // The largest g at the Lobatto points in rounding units of its terms.
    double rows_error(double h) const {
        // Velocities that are rounding alone are as large as the last residuals leave them, at rest too.
        double worst = 0.0, swiftest = unresolved;
        for (const double velocity : equation.V) swiftest = std::max(swiftest, std::abs(velocity));
        for (const ConstraintJet& jet : point) {
            for (const int row : here.order) {
                // Terms may vanish where the row holds; its error is then the rounding of the stages' displacement.
                double scale = jet.scale[row];
                for (int c = 0; c < n; ++c) scale += std::abs(jet.C[row * n + c]) * h * swiftest;
                const double open = std::abs(jet.g[row]),
                             error = scale > nothing ? open / (rounding_unit * scale) : open;
                worst = larger(error, worst);
            }
        }
        return worst;
    }

    // Newton's matrix, (V, Lam) in units of `scaled` and `row_scale`.
    void assemble(double h) {
        const int r = here.rank(), wide = stages * n, size = stages * (n + r);
        write_stages(h);
        saddle.resize(size * size);
        rows.resize(size);
        for (int i = 0; i < stages; ++i) {
            for (int b = 0; b < n; ++b) {
                const double* from = &block[(i * n + b) * wide];
                double* to = &saddle[(i * n + b) * size];
                for (int j = 0; j < wide; j += n) {
                    for (int c = 0; c < n; ++c) to[j + c] = scaled[b] * from[j + c] * scaled[c];
                }
            }
        }
        for (int k = 0; k < stages; ++k) {
            for (int a = 0; a < r; ++a) {
                const int row = here.order[a];
                const double *behind = &jet_at(k).C[row * n], *ahead = &point[k].C[row * n];
                const int border = wide + k * r + a;
                std::fill_n(&saddle[border * size + wide], stages * r, 0.0);
                for (int i = 0; i < stages; ++i) {
                    for (int c = 0; c < n; ++c) {
                        const double unit_entry = row_scale[row] * scaled[c];
                        saddle[(i * n + c) * size + border] = weight[i * stages + k] * behind[c] * unit_entry;
                        saddle[border * size + i * n + c] = at[(k + 1) * stages + i] * ahead[c] * unit_entry;
                    }
                }
            }
        }
    }

    // Add the terms of the impulses between the ends to N: w_ik h t_kj Lam_k . g_qq.
    void write_stages(double h) {
        const int wide = stages * n;
        block.resize(wide * wide);
        equation.assemble(h, {0, n}, block.data());
        for (int k = 1; k < stages; ++k) {
            std::fill(bent.begin(), bent.end(), 0.0);
            mechanism.constraints.add_curvature(&impulse[k * m], h, point[k - 1], bent.data());
            for (int i = 0; i < stages; ++i) {
                for (int j = 0; j < stages; ++j) {
                    const double share = weight[i * stages + k] * at[k * stages + j];
                    for (int b = 0; b < n; ++b) {
                        for (int c = 0; c < n; ++c) block[(i * n + b) * wide + j * n + c] += share * bent[b * n + c];
                    }
                }
            }
        }
    }

    // Change of the rows between `here` and another point: the distance of C0 W C1' (C0 W C0')^-1 from the identity,
    // with W = M^-1 or, where that gives less, the squared greatest displacement of each joint. While it is below one
    // for any W, the rows stay independent, and a root belongs to the same assembly. Where light joints carry heavy
    // ones, a small turn of the rows is large in the metric of the kinetic energy.
    double turn_to(const ConstraintJet& jet) {
        const int r = here.rank();
        for (int a = 0; a < r; ++a) {
            whiten(here, &jet.C[here.order[a] * n], white.data());
            for (int k = 0; k < r; ++k) product[k * r + a] = inner(&here.Q[k * n], white.data());
        }
        const double turn = from_one(r, here.R.data());
        return turn <= most_turn ? turn : std::min(turn, even_turn_to(jet));
    }

    double even_turn_to(const ConstraintJet& jet) {
        const int r = here.rank();
        // Gram-Schmidt on the rows at `here`; R uses the storage of the branch margin's matrices.
        std::vector<double>&Q = rest, &R = curved;
        for (int c = 0; c < n; ++c) {
            double most = 0.0;
            for (const int row : here.order)
                most = std::max({most, std::abs(here.jet.C[row * n + c]), std::abs(jet.C[row * n + c])});
            unit[c] = most > 0.0 ? 1.0 / most : 0.0;
        }
        for (int k = 0; k < r; ++k) {
            double* own = &Q[k * n];
            for (int c = 0; c < n; ++c) own[c] = unit[c] * here.jet.C[here.order[k] * n + c];
            for (int b = 0; b < k; ++b) {
                R[b * r + k] = inner(&Q[b * n], own);
                for (int c = 0; c < n; ++c) own[c] -= R[b * r + k] * Q[b * n + c];
            }
            R[k * r + k] = norm(own);
            for (int c = 0; c < n; ++c) own[c] /= R[k * r + k];
        }
        for (int a = 0; a < r; ++a) {
            for (int c = 0; c < n; ++c) white[c] = unit[c] * jet.C[here.order[a] * n + c];
            for (int k = 0; k < r; ++k) product[k * r + a] = inner(&Q[k * n], white.data());
        }
        return from_one(r, R.data());
    }

    // The distance of X from the identity, with X' R = product.
    double from_one(int r, const double* R) {
        for (int k = 0; k < r; ++k) {
            for (int a = 0; a < r; ++a) {
                double own = product[k * r + a];
                for (int b = 0; b < a; ++b) own -= product[k * r + b] * R[b * r + a];
                product[k * r + a] = own / R[a * r + a];
            }
        }
        double sum = 0.0;
        for (int k = 0; k < r; ++k) {
            for (int a = 0; a < r; ++a) {
                const double off = product[k * r + a] - (k == a ? 1.0 : 0.0);
                sum += off * off;
            }
        }
        return std::sqrt(sum);
    }

    // As EnergyGuard's, on the tangent space at the start: with a basis Z of C Z = 0, it compares Z'(M - h^2 reach / (1
    // - margin) (L_qq - Lam . g_qq / h))Z with Z' M Z.
    double branch_margin(double h) {
        const int free = n - here.rank();
        if (free == 0) return infinity;
        find_null();
        const double exaggerated = h * h * tableau.reach / (1.0 - guards.branch_margin);
        std::fill(mass.begin(), mass.end(), 0.0);
        for (int s = 0; s < stages; ++s) add_scaled(n * n, tableau.b[s], equation.stage[s].M.data(), mass.data());
        std::copy(mass.begin(), mass.end(), curved.begin());
        for (int s = 0; s < stages; ++s)
            add_scaled(n * n, -exaggerated * tableau.b[s], equation.stage[s].Lqq.data(), curved.data());
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < n && equation.coupled(); ++j)
                curved[i * n + j] += equation.coupled_stiffening(i, j, 0.5 * h, exaggerated);
            curved[i * n + i] += equation.stiffening(i, 0.5 * h, exaggerated);
        }
        for (int k = 1; k < stages; ++k)
            mechanism.constraints.add_curvature(&impulse[k * m], exaggerated / h, point[k - 1], curved.data());
        reduce(mass, free, reduced_mass);
        reduce(curved, free, reduced);
        return least_pivot_ratio(reduced.data(), reduced_mass.data(), free, {0, free});
    }

    // A basis (free, n) of the orthogonal complement of Q in the metric of the kinetic energy, by pivoted Gram-Schmidt
    // on the unit vectors.
    void find_null() {
        const int r = here.rank(), free = n - r;
        null.assign(free * n, 0.0);
        std::fill(unspanned.begin(), unspanned.end(), 1.0);
        const auto span = [&](const double* x) {
            for (int i = 0; i < n; ++i) unspanned[i] -= x[i] * x[i];
        };
        for (int k = 0; k < r; ++k) span(&here.Q[k * n]);
        for (int f = 0; f < free; ++f) {
            const auto best = std::max_element(unspanned.begin(), unspanned.end()) - unspanned.begin();
            double* z = &null[f * n];
            z[best] = 1.0;
            orthogonalize(z, here.Q, r, null, f);
            const double length = norm(z);
            for (int c = 0; c < n; ++c) z[c] /= length;
            span(z);
        }
        for (int f = 0; f < free; ++f) {
            double* z = &null[f * n];
            for (int c = 0; c < n; ++c) z[c] *= here.root[c];
            solve_upper(here.ldl.data(), n, {0, n}, z);
        }
    }

    // Twice, for rounding.
    void orthogonalize(double* x, const std::vector<double>& basis, int count, const std::vector<double>& more,
                       int others) const {
        const auto take = [&](const double* unit) {
            const double along = inner(x, unit);
            for (int c = 0; c < n; ++c) x[c] -= along * unit[c];
        };
        for (int again = 0; again < 2; ++again) {
            for (int k = 0; k < count; ++k) take(&basis[k * n]);
            for (int k = 0; k < others; ++k) take(&more[k * n]);
        }
    }

    // The lower triangle of Z' X Z for a symmetric X.
    void reduce(const std::vector<double>& full, int free, std::vector<double>& out) {
        out.resize(free * free);
        for (int b = 0; b < free; ++b) {
            std::fill(y.begin(), y.end(), 0.0);
            for (int i = 0; i < n; ++i) add_scaled(n, null[b * n + i], &full[i * n], y.data());
            for (int a = b; a < free; ++a) out[a * free + b] = inner(&null[a * n], y.data());
        }
    }

    // Write the end of the substep to `trial`, with its last impulse separate, and the work in the substep.
    void advance(double h, const PathState& path) {
        for (int c = 0; c < n; ++c) {
            double move = 0.0, sum = 0.0, rest = 0.0, across_rows = 0.0;
            trial.work[c] = trial.dissipated[c] = trial.magnitude[c] = 0.0;
            const double distance =
                std::min(std::abs(path.position[c].value.high), unwinds(c) ? Coordinate::turn : infinity);
            for (int i = 0; i < stages; ++i) {
                const double share = h * tableau.b[i], velocity = equation.V[i * n + c];
                const JointForce<double>& element = equation.acting[i * n + c];
                move += tableau.b[i] * velocity;
                sum += tableau.b[i] * equation.slope[i * n + c];
                rest += tableau.b[i] * equation.slope_rest[i * n + c];
                across_rows += pushed[i * n + c];
                const double given_force = force[i * stride + c];
                trial.work[c] += share * (given_force + element.value) * velocity;
                trial.dissipated[c] += share * element.lost;
                const double scale = equation.stage[i].Lq_scale[c] + std::abs(given_force) + element.scale;
                trial.magnitude[c] += share * scale * std::abs(velocity) +
                                      tableau.b[i] * std::abs(equation.stage[i].Lq[c]) * distance +
                                      push_size[i * n + c] * std::abs(velocity);
            }
            trial.position[c] = {path.position[c].value.plus(h * move), path.position[c].turns};
            trial.p[c] = path.p[c].plus(h * sum - across_rows, h * rest);
        }
    }
};

// Derivatives of the steps of a trajectory; as VariationalLinearization.
class ConstrainedLinearization {
  public:
    ConstrainedLinearization(const Mechanism& mechanism, const Tableau& tableau, const std::vector<double>& places,
                             double tolerance, const Guards& guards, const Kernels& kernels = kernels_for<>)
        : stepper(mechanism, tableau, places, tolerance, guards, kernels),
          n(mechanism.dof()),
          state(mechanism, tableau.stages),
          chained(n, static_cast<int>(mechanism.constraints.driven().size())) {}

    Outcome first(double h, const double* q, const double* p, const double* guess, const double* force,
                  const double* rates, std::span<const std::uint8_t> halvings, double* Jx, double* Jf, double* Jr) {
        stepper.take_force(force, varies);
        stepper.take_rates(rates);
        if (!stepper.begin_at(q, p, state, false)) return Outcome::singular;
        if (halvings.empty()) {
            Outcome outcome = stepper.from_guess(h, guess, state);
            if (outcome != Outcome::solved) outcome = stepper.part(h, 0, 0.0, state);
            if (outcome == Outcome::solved) {
                if (ramp) stepper.equation.weigh_ramp(0.0, 1.0);
                stepper.derivatives(h, state.path, Jx, Jf, Jr);
                return outcome;
            }
            if (!stepper.guards.active) return outcome;
        }
        chained.begin(Jx, Jf);
        std::fill(Jr, Jr + chained.part_rate.size(), 0.0);
        return parts_again(halvings, stepper.guards.halvings_again(), [&](int level, double begin) {
            const Outcome outcome = stepper.part(h, level, begin, state);
            if (outcome != Outcome::solved) return outcome;
            if (ramp) stepper.equation.weigh_ramp(begin, length_of(1.0, level));
            stepper.derivatives(length_of(h, level), state.path, chained.part.data(), chained.part_f.data(),
                                chained.part_rate.data());
            chained.follow(Jx, Jf);
            chained.follow_rates(Jr);
            return outcome;
        });
    }

    // As of VariationalLinearization.
    bool varies = false, ramp = false;
    void take_external() { stepper.equation.by_external = true; }

  private:
    ConstrainedStepper stepper;
    int n;
    ConstrainedState state;
    ChainedDerivatives chained;
};

}  // namespace varpin
