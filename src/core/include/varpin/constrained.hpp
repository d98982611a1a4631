// Variational steps under holonomic constraints g(q) = 0. docs/constraints.md; equations (H1) and (H2). With Lobatto
// points Q~_k = q0 + h sum_j t_kj V_j, t_kj the integral of the j-th Lagrange polynomial on Gauss's points up to the
// k-th point, and w_ik = 1 - t_ki / b_i,
//
//     L_v(Q_i, V_i) = p0 + h sum_j a_ij (L_q + F)_j - sum_{k<s} w_ik C_k' Lam_k,    g(Q~_k) = 0 for k = 1 .. s
//     p1 = p0 + h sum_j b_j (L_q + F)_j - sum_{k<=s} C_k' Lam_k,    C(q1) M(q1)^-1 p1 = 0
//
// Rows of C that depend on others, in the metric of the kinetic energy, are left out: the other rows imply them.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "varpin/constraint_basis.hpp"
#include "varpin/guards.hpp"
#include "varpin/variational.hpp"

namespace varpin {

// Steps that make the action (H1) stationary.
class ConstrainedStepper : public VariationalStepper {
  public:
    // `places` is t_kj (s + 1, s).
    ConstrainedStepper(const Mechanism& mechanism, const Tableau& tableau, const std::vector<double>& places,
                       double tolerance, const Guards& guards, const Kernels& kernels = kernels_for<>)
        : VariationalStepper(mechanism, tableau, tolerance, guards, 1.0, kernels, mechanism.constraints.rows()),
          inputs(mechanism.constraints.driven()),
          algebra(n, m),
          places(places),
          point(stages) {
        equation.every_kind = inputs.count() > 0;
        for (int i = 0; i < stages; ++i) {
            for (int k = 0; k < stages; ++k) weight[i * stages + k] = 1.0 - places[k * stages + i] / tableau.b[i];
        }
        if (inputs.cubic) from_q.resize(n), from_v.resize(n);
    }

    bool factor_at(PathState& state) override {
        for (int i = 0; i < n; ++i) at[i] = state.position[i].value.high;
        if (!find_basis(at.data(), state.rank, here)) return false;
        energy_guard.velocity(state.momentum.data(), state.v.data());
        return true;
    }

    void force_in_part(double begin, double share) override {
        inputs.share = share / (inputs.left - begin);
        VariationalStepper::force_in_part(begin, share);
    }

  protected:
    friend class Collocation;
    friend class ConstrainedLinearization;

    static constexpr double most_turn = 0.7;  // greatest relative change of C within a guarded substep
    static constexpr int most_corrections = 12;
    static constexpr bool bordered = true;

    KinematicInputs inputs;
    ConstraintAlgebra algebra;
    ConstraintBasis here;                // at the path's state
    ConstraintBasis origin;              // at the beginning of the last substep, once the path has moved on
    ConstraintBasis there;               // at the end of a trial substep
    std::vector<double> from_q, from_v;  // (n) state at the beginning of the part, if there are cubic inputs
    std::vector<double> places;          // (s + 1, s) t_kj
    std::vector<double> weight = zeros(stages, stages);  // w_ik
    std::vector<ConstraintJet> point;                    // of Lobatto points 1 .. s
    std::vector<double> total = zeros(m);
    std::vector<double> last;  // (m) Lam_s
    std::vector<double> rate;  // (m) rates of kinematic inputs in the part
    double unresolved = 0.0;   // velocity below the rounding of the last residuals
    std::vector<double> Qk = zeros(n), scaled = zeros(n), row_scale = zeros(m), y = zeros(n), bent = zeros(n, n);
    std::vector<double> block, saddle, right, solution;
    std::vector<int> rows;
    std::vector<double> null, reduced_mass, reduced;
    std::vector<double> mass = zeros(n, n), curved = zeros(n, n);

    const ConstraintJet& jet_at(int k) const { return k == 0 ? here.jet : point[k - 1]; }

    // Compute the factors of M and the basis of C at q, as ConstraintAlgebra::orthogonalize. False where M is not
    // positive definite. C is known already where it has `visited` q.
    bool find_basis(const double* q, int rank, ConstraintBasis& basis, bool visited = false) {
        if (!energy_guard.factor(q)) return false;
        if (!visited) mechanism.constraints.at(q, basis.jet);
        algebra.orthogonalize(energy_guard.factors(), rank, basis);
        return true;
    }

    bool enter(PathState& state, bool project) override {
        state.rank = -1;
        if (!factor_at(state)) return false;
        state.rank = here.rank();
        for (const DrivenRow& own : inputs.driven) state.rate[own.row] = state.v[own.coordinate];
        if (project) absorb(state);
        energy_guard.velocity(state.momentum.data(), state.v.data());
        return true;
    }

    void absorb(PathState& state) override {
        for (int again = 0; again < 2; ++again) {
            algebra.find_impulse(here, state.momentum.data(), state.rate.data(), total.data());
            here.across(total.data(), y.data());
            for (int c = 0; c < n; ++c) {
                state.p[c] = state.p[c].plus(-y[c]);
                state.momentum[c] = state.p[c].high;
            }
        }
    }

    // No force but that of its row acts on a driven joint.
    void take_goals(int steps, const double* controls) override {
        inputs.left = steps;
        for (int d = 0; d < inputs.count(); ++d) {
            const auto& [row, coordinate, control] = inputs.driven[d];
            inputs.goal[d] = force[coordinate];
            force[coordinate] = 0.0;
            if (stride != 0) {
                for (int i = 0; i < stages; ++i) given[i * n + coordinate] = 0.0;
            }
            if (controls && control >= 0) inputs.goal_rate[d] = controls[control];
        }
    }

    void take_rates(const double* rates) override {
        std::copy(rates, rates + inputs.count(), inputs.goal_rate.begin());
    }

    // Newton's method on the stages and the constraints, as Collocation::solve. With `jets_wanted` it ends with the
    // jets and C at the root, else with those of the last iterate.
    Outcome solve(double h, PathState& state, bool jets_wanted) override {
        state.weakest = here.weakest;
        if (here.toggles()) return Outcome::toggle;
        keep_start(state);
        const Start start = start_of(state);
        scale_unknowns();
        return Collocation::newton(*this, h, start, tolerance, jets_wanted, effort);
    }

    // As EnergyGuard's, on the tangent space at the start: with a basis Z of C Z = 0, it compares Z'(M - h^2 reach / (1
    // - margin) (L_qq - Lam . g_qq / h))Z with Z' M Z.
    Outcome measure_branch(double h, double& margin) override {
        for (const ConstraintJet& jet : point) {
            if (!(algebra.turn(here, jet, most_turn) <= most_turn)) return Outcome::assembly;
        }
        const int free = n - here.rank();
        if (free == 0) return Outcome::solved;
        algebra.find_null(here, null);
        const double exaggerated = h * h * tableau.reach / (1.0 - guards.branch_margin);
        std::fill(mass.begin(), mass.end(), 0.0);
        for (int s = 0; s < stages; ++s) detail::add_row(n * n, tableau.b[s], equation.stage[s].M.data(), mass.data());
        std::copy(mass.begin(), mass.end(), curved.begin());
        for (int s = 0; s < stages; ++s)
            detail::add_row(n * n, -exaggerated * tableau.b[s], equation.stage[s].Lqq.data(), curved.data());
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < n && equation.coupled(); ++j)
                curved[i * n + j] += equation.coupled_stiffening(i, j, 0.5 * h, exaggerated);
            curved[i * n + i] += equation.stiffening(i, 0.5 * h, exaggerated);
        }
        for (int k = 1; k < stages; ++k)
            mechanism.constraints.add_curvature(&impulse[k * m], exaggerated / h, point[k - 1], curved.data());
        reduce(mass, free, reduced_mass);
        reduce(curved, free, reduced);
        margin = least_pivot_ratio(reduced.data(), reduced_mass.data(), free, {0, free});
        return margin > 0.0 ? Outcome::solved : Outcome::fold;
    }

    // Find the basis at the end in `trial`, and the last impulse, which makes its momentum tangent. C at the end is
    // that at the last Lobatto point unless jets were wanted.
    Outcome end(double h, PathState& state, bool jets_wanted) override {
        rate.assign(m, 0.0);
        for (int d = 0; d < inputs.count(); ++d) {
            const auto& [row, coordinate, control] = inputs.driven[d];
            rate[row] = inputs.rate_at(d, inputs.share, h, state.position[coordinate].value.high);
        }
        for (int i = 0; i < n; ++i) at[i] = trial.position[i].value.high;
        if (!jets_wanted) swap(there.jet, point.back());
        if (!find_basis(at.data(), state.rank, there, !jets_wanted)) return Outcome::singular;
        if (there.toggles()) {
            state.weakest = there.weakest;
            return Outcome::toggle;
        }
        last.assign(m, 0.0);
        for (int again = 0; again < 2; ++again) {
            for (int i = 0; i < n; ++i) y[i] = trial.p[i].high;
            algebra.find_impulse(there, y.data(), rate.data(), total.data());
            there.across(total.data(), y.data());
            for (int c = 0; c < n; ++c) trial.p[c] = trial.p[c].plus(-y[c]);
            for (int r = 0; r < m; ++r) last[r] += total[r];
        }
        for (int d = 0; d < inputs.count(); ++d) add_work(d, h, state);
        return Outcome::solved;
    }

    // `singular` where M is not positive definite after whole turns were removed.
    Outcome arrive(PathState& state, bool turned) override {
        for (int r = 0; r < m; ++r) {
            double sum = last[r];
            for (int k = 0; k < stages; ++k) sum += impulse[k * m + r];
            state.impulse[r] -= sum;
        }
        state.rate = rate;
        swap(origin, here);
        swap(here, there);
        return turned && !factor_at(state) ? Outcome::singular : Outcome::solved;
    }

  private:
    // Keep what kinematic inputs need of the beginning of a part.
    void keep_start(const PathState& state) {
        for (int d = 0; d < inputs.count(); ++d) inputs.begun[d] = state.rate[inputs.driven[d].row];
        if (!inputs.cubic) return;
        for (int i = 0; i < n; ++i) from_q[i] = state.position[i].value.high;
        std::copy(state.v.begin(), state.v.end(), from_v.begin());
    }

    // Units in which the entries of Newton's matrix are of order 1; rows that are left out have no impulse.
    void scale_unknowns() {
        for (int c = 0; c < n; ++c) scaled[c] = 1.0 / std::sqrt(here.mass_diagonal(c));
        for (int r = 0; r < m; ++r) row_scale[r] = 1.0 / std::max(detail::norm(n, &here.rows[r * n]), nothing);
        for (int r = 0; r < m; ++r) {
            if (std::find(here.order.begin(), here.order.end(), r) != here.order.end()) continue;
            for (int k = 0; k < stages; ++k) impulse[k * m + r] = 0.0;
        }
    }

    double evaluate(double h, const Start& start, bool fresh, Effort& effort) {
        equation.sweep(h, start, fresh, effort);
        visit_points(h, start);
        return residuals(h, start);
    }

    bool factor(double h) {
        assemble(h);
        return factor_lu_pivoting(saddle.data(), stages * (n + here.rank()), rows.data()) != 0;
    }

    // Newton's correction from the factors: of the velocities in equation.delta, of the impulses at the end of
    // `solution`.
    double correct() {
        const int size = stages * (n + here.rank());
        solve_lu_pivoting(saddle.data(), size, rows.data(), right.data(), solution.data());
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) equation.delta[i * n + c] = scaled[c] * solution[i * n + c];
        }
        return equation.kinetic_size(equation.delta.data());
    }

    // As Collocation's, by the nonlinearity with one stage alone: without an impulse between the ends, constraints add
    // no curvature.
    bool settles(double h, const Start& start, bool fresh, double contraction, double tolerance, double& worst) {
        const double by_bending = fresh && stages == 1 ? equation.left_by_bending(h, worst) : infinity;
        const double left = std::min(by_bending, contraction * worst);
        if (!(Collocation::sure * left <= tolerance)) return false;
        visit_points(h, start);
        const double open = rows_error(h);
        if (!(open <= tolerance)) return false;
        equation.correct_forces(h);
        push();
        worst = std::max(left, open);
        return true;
    }

    // Add Newton's correction to the velocities and impulses.
    void take_correction() {
        equation.take_correction();
        const int r = here.rank();
        for (int k = 0; k < stages; ++k) {
            for (int a = 0; a < r; ++a) {
                const int row = here.order[a];
                impulse[k * m + row] += row_scale[row] * solution[stages * n + k * r + a];
            }
        }
    }

    // Share of the time to the goal that has passed at Lobatto point k of the part.
    double way_to(int k) const {
        double sum = 0.0;
        for (int j = 0; j < stages; ++j) sum += places[k * stages + j];
        return inputs.share * sum;
    }

    // Work of the kinematic inputs' impulses; the first impulse also acts at the velocity before it.
    void add_work(int d, double h, const PathState& state) {
        const auto& [row, coordinate, control] = inputs.driven[d];
        const double from = state.position[coordinate].value.high;
        for (int k = 0; k <= stages; ++k) {
            const double Lam = k < stages ? impulse[k * m + row] : last[row];
            double velocity = inputs.rate_at(d, way_to(k), h, from);
            if (k == 0) velocity = 0.5 * (state.v[coordinate] + velocity);
            const double work = -Lam * velocity;
            trial.work[coordinate] += work;
            trial.magnitude[coordinate] += std::abs(work);
        }
    }

    void visit_points(double h, const Start& start) {
        for (int k = 1; k <= stages; ++k) {
            for (int c = 0; c < n; ++c) {
                double sum = 0.0;
                for (int j = 0; j < stages; ++j) sum += places[k * stages + j] * equation.V[j * n + c];
                Qk[c] = start.position[c].value.high + (start.position[c].value.low + h * sum);
            }
            ConstraintJet& jet = point[k - 1];
            mechanism.constraints.at(Qk.data(), jet);
            for (int d = 0; d < inputs.count(); ++d) {
                const auto& [row, coordinate, control] = inputs.driven[d];
                const Compensated& from = start.position[coordinate].value;
                const KinematicInputs::Way way = inputs.way_at(d, way_to(k));
                const double ahead = inputs.goal[d] - from.high,
                             swing = inputs.begun[d] * way.begin + inputs.goal_rate[d] * way.end;
                const double moved = way.ahead * ahead + h / inputs.share * swing;
                jet.g[row] = Qk[coordinate] - (from.high + (from.low + moved));
                jet.scale[row] = std::abs(Qk[coordinate]) + std::abs(ahead) + h / inputs.share * std::abs(swing);
            }
        }
    }

    // Write C_k' Lam_k to `pushed`, and the size of its terms.
    void push() {
        std::fill(pushed.begin(), pushed.end(), 0.0);
        std::fill(push_size.begin(), push_size.end(), 0.0);
        for (int k = 0; k < stages; ++k) {
            const ConstraintJet& jet = jet_at(k);
            for (const int row : here.order) {
                const double own = impulse[k * m + row];
                detail::add_row(n, own, &jet.C[row * n], &pushed[k * n]);
                detail::add_row(n, std::abs(own), &jet.size[row * n], &push_size[k * n]);
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
                equation.force_sum[k] = equation.stage[i].Lq[c] + (start.force_at(i)[c] + equation.acting[k].value);
                equation.force_rest[k] = 0.0;
            }
        }
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) {
                double sum = 0.0, scale = 0.0, across_rows = 0.0, across_size = 0.0;
                for (int j = 0; j < stages; ++j) {
                    const double a = tableau.a[i * stages + j];
                    sum += a * equation.force_sum[j * n + c];
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

  protected:
    // Newton's matrix, (V, Lam) in units of `scaled` and `row_scale`.
    void assemble(double h) {
        const int r = here.rank(), wide = stages * n, size = stages * (n + r);
        write_stages(h);
        saddle.resize(size * size);
        rows.resize(size);
        for (int k = 0; k < wide; ++k) {
            for (int c = 0; c < wide; ++c) saddle[k * size + c] = scaled[k % n] * block[k * wide + c] * scaled[c % n];
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
                        saddle[border * size + i * n + c] = places[(k + 1) * stages + i] * ahead[c] * unit_entry;
                    }
                }
            }
        }
    }

  private:
    // N with the terms of the impulses between the ends: w_ik h t_kj Lam_k . g_qq.
    void write_stages(double h) {
        const int wide = stages * n;
        block.resize(wide * wide);
        equation.assemble(h, {0, n}, block.data());
        for (int k = 1; k < stages; ++k) {
            std::fill(bent.begin(), bent.end(), 0.0);
            mechanism.constraints.add_curvature(&impulse[k * m], h, point[k - 1], bent.data());
            for (int i = 0; i < stages; ++i) {
                for (int j = 0; j < stages; ++j) {
                    const double share = weight[i * stages + k] * places[k * stages + j];
                    for (int b = 0; b < n; ++b) {
                        for (int c = 0; c < n; ++c) block[(i * n + b) * wide + j * n + c] += share * bent[b * n + c];
                    }
                }
            }
        }
    }

    // The lower triangle of Z' X Z for a symmetric X.
    void reduce(const std::vector<double>& full, int free, std::vector<double>& out) {
        out.resize(free * free);
        for (int b = 0; b < free; ++b) {
            std::fill(y.begin(), y.end(), 0.0);
            for (int i = 0; i < n; ++i) detail::add_row(n, null[b * n + i], &full[i * n], y.data());
            for (int a = b; a < free; ++a) out[a * free + b] = detail::inner(n, &null[a * n], y.data());
        }
    }
};

}  // namespace varpin
