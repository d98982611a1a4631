// First derivatives of steps under constraints. docs/constraints.md, "Steps".
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <vector>

#include "varpin/constrained.hpp"
#include "varpin/repeated_steps.hpp"

namespace varpin {

// The map of steps under constraints is on all of R^2n: it does not require g(q0) = 0, and absorbs the part of p0 that
// is normal to the constraints. Derivatives in the rates of linear inputs are zero.
class ConstrainedLinearization : public StepLinearization {
  public:
    ConstrainedLinearization(const Mechanism& mechanism, const Tableau& tableau, const std::vector<double>& places,
                             double tolerance, const Guards& guards, const Kernels& kernels = kernels_for<>)
        : StepLinearization(
              std::make_unique<ConstrainedStepper>(mechanism, tableau, places, tolerance, guards, kernels)),
          constrained(static_cast<ConstrainedStepper&>(*stepper)),
          inputs(constrained.inputs),
          here(constrained.here),
          m(constrained.m) {}

  private:
    // Parameters of a kinematic input's motion: the goal, or the rates at both ends of a cubic.
    enum class Goal { position, begin, end };

    ConstrainedStepper& constrained;
    KinematicInputs& inputs;
    ConstraintBasis& here;
    int m;
    std::array<std::vector<double>, 2> by_rates;  // (2n, 2n) and (2n, n), derivatives in rates at both ends
    std::vector<double> sides, bends, y = zeros(n), shift = zeros(n);
    std::vector<double> at = zeros(n), bend = zeros(m, n), curvature = zeros(n, n);  // at the end

    // From the guess, or else from the initial velocity.
    Outcome root(const RepeatedStep& step) override {
        if (!enter(step)) return Outcome::singular;
        const Outcome outcome = constrained.from_guess(step.h, step.guess, state);
        return outcome == Outcome::solved ? outcome : constrained.part(step.h, 0, 0.0, state);
    }

    void differentiate(double h, double begin, double share, const StepDerivatives& to) override {
        swap(here, constrained.origin);
        constrained.factor(h);
        bend_points();
        state_columns(h);
        end_columns(h, to.state, to.force);
        if (to.ramp) {
            constrained.equation.weigh_ramp(begin, share);
            state_columns(h);
            end_columns(h, again.data(), to.ramp);
            constrained.equation.weigh_constant();
        }
        for (int end = 0; end < 2 && inputs.cubic; ++end) {
            rate_columns(end);
            by_rates[end].resize(6 * n * n);
            end_columns(h, by_rates[end].data(), by_rates[end].data() + 4 * n * n);
        }
        if (to.parameters) parameter_columns(h, to.parameters);
        swap(here, constrained.origin);
        look_at_end();
        project(h, Goal::position, to.state, to.force);
        if (to.ramp) project(h, Goal::position, again.data(), to.ramp);
        if (to.parameters) project_parameters(to.parameters);
        if (!inputs.cubic) return;
        for (int end = 0; end < 2; ++end)
            project(h, end == 0 ? Goal::begin : Goal::end, by_rates[end].data(), by_rates[end].data() + 4 * n * n);
        join_rates(to);
    }

    // Lam_k . g_qq (s, n, n) at the Lobatto points but the last.
    void bend_points() {
        bends.assign(entries(stages * n, n), 0.0);
        for (int k = 0; k < stages; ++k)
            constrained.mechanism.constraints.add_curvature(
                &constrained.impulse[k * m], 1.0, k == 0 ? here.jet : constrained.point[k - 1], &bends[k * n * n]);
    }

    // Row a of the border at Lobatto point k.
    double* border(int k, int a) { return &sides[entries(stages * n + k * here.rank() + a, 3 * n)]; }

    // Right sides for derivatives in (q0, p0) and in the goals of kinematic inputs.
    void state_columns(double h) {
        StepEquation& equation = constrained.equation;
        const int r = here.rank(), wide = stages * n, w = 3 * n;
        dV.resize(entries(wide, w));
        equation.right_sides(n, stages, h, {0, n}, dV);
        for (int row = 0; equation.kinds() == 2 && row < n; ++row) {
            for (int c = 0; c < n; ++c) dV[row * w + 2 * n + c] = equation.by_momentum(h, c) * dV[row * w + n + c];
        }
        for (const DrivenRow& own : inputs.driven) {
            for (int i = 0; i < wide; ++i) dV[i * w + 2 * n + own.coordinate] = 0.0;
        }
        sides.assign(entries(stages * (n + r), w), 0.0);
        for (int i = 0; i < wide; ++i) {
            for (int c = 0; c < w; ++c) {
                double entry = dV[i * w + c];
                for (int k = 0; k < stages && c < n; ++k)
                    entry -= constrained.weight[(i / n) * stages + k] * bends[(k * n + i % n) * n + c];
                sides[i * w + c] = constrained.scaled[i % n] * entry;
            }
        }
        for (int k = 0; k < stages; ++k) {
            for (int a = 0; a < r; ++a) {
                const int row = here.order[a];
                double* own = border(k, a);
                for (int c = 0; c < n; ++c)
                    own[c] = -constrained.row_scale[row] * constrained.point[k].C[row * n + c] / h;
                const int d = inputs.of_row(row);
                if (d < 0) continue;
                const int c = inputs.driven[d].coordinate;
                const KinematicInputs::Way way = inputs.way_at(d, constrained.way_to(k + 1));
                own[2 * n + c] = constrained.row_scale[row] * way.ahead / h;
                own[c] += constrained.row_scale[row] * (1.0 - way.ahead) / h;
            }
        }
    }

    // Right sides for derivatives in the rate of each cubic input at the beginning (`end` 0) or at its goal (1), in the
    // column of the goal.
    void rate_columns(int end) {
        const int r = here.rank();
        sides.assign(entries(stages * (n + r), 3 * n), 0.0);
        for (int k = 0; k < stages; ++k) {
            for (int a = 0; a < r; ++a) {
                const int d = inputs.of_row(here.order[a]);
                if (d < 0) continue;
                const auto& [row, coordinate, control] = inputs.driven[d];
                const KinematicInputs::Way way = inputs.way_at(d, constrained.way_to(k + 1));
                border(k, a)[2 * n + coordinate] =
                    constrained.row_scale[row] * (end == 0 ? way.begin : way.end) / inputs.share;
            }
        }
    }

    // Derivatives of the end of a substep without its last impulse, from the right sides in `sides` and the factors
    // of the bordered matrix.
    void end_columns(double h, double* Jx, double* Jf) {
        const int r = here.rank(), wide = stages * n, size = stages * (n + r), w = 3 * n;
        std::vector<double> sorted(sides.size());
        for (int i = 0; i < size; ++i) std::copy_n(&sides[constrained.rows[i] * w], w, &sorted[i * w]);
        solve_lu_rows(constrained.saddle.data(), size, {0, size}, sorted.data(), w, w);
        for (int i = 0; i < wide; ++i) {
            for (int c = 0; c < w; ++c) dV[i * w + c] = constrained.scaled[i % n] * sorted[i * w + c];
        }
        constrained.equation.end_derivatives(n, stages, h, {0, n}, dV, Jx, Jf);
        for (int c = 0; c < w; ++c)
            subtract_impulses(h, &dV[c], &sorted[wide * w + c], w, c,
                              [&](int i) -> double& { return entry(Jx, Jf, n + i, c); });
    }

    // The impulses up to the last one take C_k' dLam_k + Lam_k . g_qq dQ~_k from dp1. Rows of dV and dLam are `w`
    // apart; coordinate `own` of q0 moves by 1.
    template <class End>
    void subtract_impulses(double h, const double* dV, const double* dLam, int w, int own, const End& dp) const {
        const int r = here.rank();
        std::vector<double> dQ(n);
        for (int k = 0; k < stages; ++k) {
            for (int i = 0; i < n; ++i) {
                double sum = 0.0;
                for (int j = 0; j < stages; ++j) sum += constrained.places[k * stages + j] * dV[(j * n + i) * w];
                dQ[i] = h * sum + (own == i ? 1.0 : 0.0);
            }
            for (int i = 0; i < n; ++i) {
                double sum = detail::inner(n, &bends[(k * n + i) * n], dQ.data());
                for (int a = 0; a < r; ++a) {
                    const int row = here.order[a];
                    sum += constrained.jet_at(k).C[row * n + i] * constrained.row_scale[row] * dLam[(k * r + a) * w];
                }
                dp(i) -= sum;
            }
        }
    }

    // Derivatives in the parameters of the end of a substep without its last impulse, from the factors of the bordered
    // matrix.
    void parameter_columns(double h, double* Jp) {
        const int r = here.rank(), wide = stages * n, size = stages * (n + r), w = columns->count();
        std::vector<double> right, dp, dq(n), by(size), sorted(entries(size, w));
        for (int a = 0; a < w; ++a) {
            columns->right_side(a, h, constrained.force.data(), constrained.stride, right, dp);
            for (int i = 0; i < size; ++i) {
                const int from = constrained.rows[i];
                sorted[i * w + a] = from < wide ? constrained.scaled[from % n] * right[from] : 0.0;
            }
            for (int i = 0; i < n; ++i) Jp[(n + i) * w + a] = dp[i];
        }
        solve_lu_rows(constrained.saddle.data(), size, {0, size}, sorted.data(), w, w);
        for (int a = 0; a < w; ++a) {
            for (int i = 0; i < size; ++i) by[i] = (i < wide ? constrained.scaled[i % n] : 1.0) * sorted[i * w + a];
            std::fill(dq.begin(), dq.end(), 0.0);
            std::fill(dp.begin(), dp.end(), 0.0);
            constrained.equation.add_end_change(h, by.data(), dq.data(), dp.data());
            subtract_impulses(h, by.data(), &by[wide], 1, -1, [&](int i) -> double& { return dp[i]; });
            for (int i = 0; i < n; ++i) {
                Jp[i * w + a] = dq[i];
                Jp[(n + i) * w + a] += dp[i];
            }
        }
    }

    double& entry(double* Jx, double* Jf, int row, int c) const {
        return c < 2 * n ? Jx[row * 2 * n + c] : Jf[row * n + c - 2 * n];
    }

    // The jet and the constraints at the end.
    void look_at_end() {
        for (auto* sum : {&bend, &curvature}) std::fill(sum->begin(), sum->end(), 0.0);
        for (int i = 0; i < n; ++i) at[i] = state.position[i].value.high;
        Jet<double>& jet = constrained.equation.stage[0];
        constrained.equation.kernels.jet(constrained.mechanism, at.data(), state.v.data(), jet);
        constrained.mechanism.constraints.bend(state.v.data(), here.jet, bend.data());
        constrained.mechanism.constraints.add_curvature(constrained.last.data(), 1.0, here.jet, curvature.data());
    }

    void project(double h, Goal what, double* Jx, double* Jf) {
        std::vector<double> dq(n);
        std::fill(shift.begin(), shift.end(), 0.0);
        for (int c = 0; c < 3 * n; ++c) {
            for (int i = 0; i < n; ++i) dq[i] = entry(Jx, Jf, i, c);
            project_column(
                dq, shift, [&](int row) { return goal_rate(row, what, h, c); },
                [&](int i) -> double& { return entry(Jx, Jf, n + i, c); });
        }
    }

    void project_parameters(double* Jp) {
        const int w = columns->count();
        std::vector<double> dq(n);
        for (int a = 0; a < w; ++a) {
            for (int i = 0; i < n; ++i) dq[i] = Jp[i * w + a];
            columns->momentum(a, at.data(), state.v.data(), shift);
            project_column(dq, shift, [](int) { return 0.0; }, [&](int i) -> double& { return Jp[(n + i) * w + a]; });
        }
    }

    // The last impulse: M dv1 + C1' dLam = dp - (L_vq + Lam . g_qq) dq1 - dM v1, C1 dv1 = -(g_qq v1) dq1, and dp1 =
    // M dv1 + L_vq dq1 + dM v1, with the derivative of a row's rate and dM v1, `shift` (n).
    template <class Rate, class End>
    void project_column(const std::vector<double>& dq, const std::vector<double>& shift, const Rate& rate,
                        const End& dp) const {
        const int r = here.rank();
        const Jet<double>& jet = constrained.equation.stage[0];
        std::vector<double> z(n), along(r), turned(n);
        for (int i = 0; i < n; ++i) {
            turned[i] = detail::inner(n, &jet.A[i * n], dq.data()) + shift[i];
            z[i] = dp(i) - turned[i] - detail::inner(n, &curvature[i * n], dq.data());
        }
        here.whiten(z.data(), z.data());
        for (int k = 0; k < r; ++k) {
            double own = -detail::inner(n, &bend[here.order[k] * n], dq.data()) + rate(here.order[k]);
            for (int j = 0; j < k; ++j) own -= here.R[j * r + k] * along[j];
            along[k] = own / here.R[k * r + k];
        }
        const std::vector<double> before = z;
        for (int k = 0; k < r; ++k) {
            const double change = along[k] - detail::inner(n, &here.Q[k * n], before.data());
            for (int i = 0; i < n; ++i) z[i] += change * here.Q[k * n + i];
        }
        for (int i = 0; i < n; ++i) z[i] *= std::sqrt(here.ldl[i * n + i]);
        for (int i = n - 1; i >= 0; --i) {
            double sum = z[i];
            for (int j = 0; j < i; ++j) sum += here.ldl[i * n + j] * z[j];
            dp(i) = sum + turned[i];
        }
    }

    // The derivative of a row's rate at the end in parameter c; 0 for rows that are no kinematic input's.
    double goal_rate(int row, Goal what, double h, int c) const {
        const int d = inputs.of_row(row);
        if (d < 0) return 0.0;
        const int moved = inputs.driven[d].coordinate;
        const KinematicInputs::Way pace = inputs.pace_at(d, inputs.share);
        if (what == Goal::position) return pace.ahead * inputs.share / h * ((c == 2 * n + moved) - (c == moved));
        if (c != 2 * n + moved) return 0.0;
        return what == Goal::begin ? pace.begin : pace.end;
    }

    // Write the derivatives in the rates at the goals, and add those by way of the rates at the beginning, which follow
    // from the momentum: v = M^-1 p, M dv = dp - L_vq dq.
    void join_rates(const StepDerivatives& to) {
        const std::vector<DrivenRow>& driven = inputs.driven;
        Jet<double>& jet = constrained.equation.stage[0];
        constrained.equation.kernels.jet(constrained.mechanism, constrained.from_q.data(), constrained.from_v.data(),
                                         jet);
        const double *at_begin = by_rates[0].data() + 4 * n * n, *at_end = by_rates[1].data() + 4 * n * n;
        for (std::size_t d = 0; d < driven.size(); ++d) {
            const int moved = driven[d].coordinate;
            if (driven[d].rate < 0) continue;
            for (int i = 0; i < 2 * n && to.rates; ++i) to.rates[i * driven.size() + d] = at_end[i * n + moved];
            std::fill(y.begin(), y.end(), 0.0);
            y[moved] = 1.0;
            constrained.origin.whiten(y.data(), y.data());
            constrained.origin.colour(y.data());
            for (int c = 0; c < n; ++c) {
                double by_q = 0.0;
                for (int j = 0; j < n; ++j) by_q -= y[j] * jet.A[j * n + c];
                for (int i = 0; i < 2 * n; ++i) {
                    to.state[i * 2 * n + c] += at_begin[i * n + moved] * by_q;
                    to.state[i * 2 * n + n + c] += at_begin[i * n + moved] * y[c];
                }
            }
            for (int a = 0; to.parameters && a < columns->count(); ++a) {
                columns->momentum(a, constrained.from_q.data(), constrained.from_v.data(), shift);
                const double by = -detail::inner(n, y.data(), shift.data());
                for (int i = 0; i < 2 * n; ++i) to.parameters[i * columns->count() + a] += at_begin[i * n + moved] * by;
            }
        }
    }
};

}  // namespace varpin
