// Derivatives of the steps of a trajectory, first and second. docs/mathematics.md, "Linearization" and "Second
// derivatives"; equation (L4). With multipliers lam, N' lam = dphi/dV, second derivatives of phi = zq . q1 + zp . p1
// need first derivatives of V alone, and those of psi = sum_i alpha_i . L_q + beta_i . L_v + gamma_i . F at the stages
// with
//
//     alpha_i = h (b_i zp + sum_j abar_ji lam_j),    beta_i = -lam_i,    gamma_i = h (b_i zp + sum_j f_ji lam_j).
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "varpin/sensitivities.hpp"
#include "varpin/substeps.hpp"
#include "varpin/variational.hpp"

namespace varpin {

class VariationalLinearization {
  public:
    // With active guards, a part that they refuse is halved, since a step may need other parts without its noise.
    // Without them, the parts are exactly those given.
    VariationalLinearization(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                             const Kernels& kernels = kernels_for<>)
        : stepper(mechanism, tableau, tolerance, guards, 1.0, kernels),
          n(mechanism.dof()),
          stages(tableau.stages),
          state(mechanism, stages),
          from(n),
          from_p(n),
          chained(n, n),
          direction(mechanism.tree),
          at_q(n),
          at_v(n),
          at_f(n),
          along_q(n),
          along_v(n),
          along_f(n) {
        for (int c = 0; c < n; ++c) df[c * 3 * n + 2 * n + c] = 1.0;
    }

    bool varies = false;  // each step has forces (s, n) at its stages instead of a constant force (n)

    // Parameters in which `first` takes derivatives.
    void take(std::vector<Parameter> parameters) {
        columns.emplace(stepper.equation, std::move(parameters));
        in_parameters.resize(entries(2 * n, columns->count()));
    }
    std::size_t parameters() const { return columns->parameters.size(); }

    // Take derivatives in an external force (n), which acts beside f unless null, in the place of f, which drives
    // limit.
    void take_external(const double* force = nullptr) {
        stepper.equation.by_external = true;
        stepper.outer = force;
    }

    // d(q1, p1)/d(q0, p0) (2n, 2n) and d(q1, p1)/df (2n, n) of one step from (q, p) under a force f, and unless null
    // Jr (2n, n) in a force that grows linearly from 0 at the start of the step to f at its end, and Jp (2n, k) in the
    // parameters. An undivided step
    // is solved again from a guess (s, n) close to its root; the arrays q, p and force have `past` earlier steps before
    // the pointers. A divided step has `halvings`: its parts are repeated, and their derivatives are multiplied.
    Outcome first(double h, const double* q, const double* p, const double* guess, const double* force,
                  std::span<const std::uint8_t> halvings, double* Jx, double* Jf, int past = 0, double* Jr = nullptr,
                  double* Jp = nullptr) {
        if (halvings.empty() && !stepper.guards.active) {
            const Outcome outcome = root(h, q, p, guess, force, past);
            if (outcome == Outcome::solved) {
                stepper.equation.derivatives(h, dV, Jx, Jf);
                if (Jr) ramp_derivatives(h, 0.0, 1.0, Jr);
                if (Jp) parameter_derivatives(h, Jp);
            }
            return outcome;
        }
        return in_parts(h, q, p, force, halvings, Jx, Jf, Jr, Jp);
    }

    // Takes x = (q, p) to the end of a step, in the parts that the guards require, with its derivatives Jx in x and Jf
    // in the external force (n), which may be null. `spread` (n, n), the covariance of forces in a unit of time,
    // becomes that of the jumps of p, which it is.
    Outcome step(double h, double* x, const double* force, const double* external, double* Jx, double* Jf, double*) {
        take_external(external);
        stepper.take_force(force, varies);
        Outcome outcome = stepper.step_from(h, x, x + n, state);
        if (outcome == Outcome::solved) {
            stepper.equation.derivatives(h, dV, Jx, Jf);
        } else {
            outcome = in_parts(h, x, x + n, force, {}, Jx, Jf, nullptr);
        }
        std::copy(state.q.begin(), state.q.end(), x);
        std::copy(state.momentum.begin(), state.momentum.end(), x + n);
        return outcome;
    }

    // q1 and M(q1)^-1 p1 (n) of the step of which `first` gives the derivatives.
    Outcome end(double h, const double* q, const double* p, const double* force, std::span<const std::uint8_t> halvings,
                double* q1, double* v1) {
        const Outcome outcome = parts(h, q, p, force, halvings, [](double, double) {});
        if (outcome != Outcome::solved) return outcome;
        std::copy(state.q.begin(), state.q.end(), q1);
        std::copy(state.v.begin(), state.v.end(), v1);
        return Outcome::solved;
    }

    // v = M(q)^-1 p and its derivatives in x = (q, p), into zeros (n, 2n); false where M(q) is not positive definite.
    bool velocity(const double* x, double* v, double* slopes) {
        if (!stepper.move_to(x, x + n, state)) return false;
        std::copy(state.v.begin(), state.v.end(), v);
        stepper.equation.kernels.velocity_slopes(stepper.mechanism, 1, x, v, slopes);
        return true;
    }

    // z . d2(q1, p1)/d(q0, p0, f)2 of one step, into H (3n, 3n). For a divided step, z is propagated backward by the
    // derivative of each part, and the second derivatives of each part are transformed to the start of the step.
    Outcome second(double h, const double* q, const double* p, const double* guess, const double* force,
                   std::span<const std::uint8_t> halvings, const double* z, double* H, int past = 0) {
        std::fill(H, H + entries(3 * n, 3 * n), 0.0);
        if (halvings.empty() && !stepper.guards.active) {
            const Outcome outcome = root(h, q, p, guess, force, past);
            if (outcome != Outcome::solved) return outcome;
            part_derivatives(h);
            add_curvature(h, z, nullptr, H);
            return Outcome::solved;
        }
        std::vector<Substep> trail;
        std::vector<double> row(z, z + 2 * n), before(2 * n);
        const Outcome outcome = follow(h, q, p, force, halvings, trail);
        if (outcome != Outcome::solved) return outcome;
        for (std::size_t k = trail.size(); k-- > 0;) {
            const Outcome again = root_of(h, trail[k]);
            if (again != Outcome::solved) return again;
            part_derivatives(trail[k].length);
            add_curvature(trail[k].length, row.data(), trail[k].start.data(), H);
            back(row.data(), before.data());
            std::swap(before, row);
        }
        return Outcome::solved;
    }

  private:
    // Factor of the tolerance for derivatives, which need a root to about 1e-10 only.
    static constexpr double loose = 1e6;

    // A part of a step that has been solved.
    struct Substep {
        std::vector<Coordinate> position;
        std::vector<Compensated> p;
        std::vector<double> V;      // (s, n) at its root
        double begin = 0.0;         // in units of the step
        double length = 0.0;        // [s]
        std::vector<double> start;  // (2n, 3n) derivatives from the start of the step to its own
    };

    VariationalStepper stepper;
    int n;
    int stages;
    PathState state;
    std::vector<Coordinate> from;  // where the last part began
    std::vector<Compensated> from_p;
    std::vector<double> dV = zeros(stages * n, 3 * n);
    std::vector<double> dQ = zeros(n, 3 * n);  // of one stage
    ChainedDerivatives chained;
    std::optional<ParameterColumns> columns;
    std::vector<double> in_parameters;                  // (2n, k) of a part
    std::vector<double> in_ramp = zeros(2 * n, 2 * n);  // derivatives in the state again, which nobody reads
    std::vector<double> multiplier = zeros(stages, n), slope = zeros(stages, n);
    Jet<Dual> direction;
    std::vector<Dual> at_q, at_v;
    std::vector<double> inner = zeros(2 * n, 3 * n);
    std::vector<double> df = zeros(n, 3 * n);  // of the force
    std::vector<Dual> at_f;
    std::vector<Dual> coupled_q, coupled_v;                   // (n, n) of couplings, along a direction
    std::vector<JointForce<Dual>> along_q, along_v, along_f;  // (n) of the elements, with derivatives in q, in v, in f

    Outcome in_parts(double h, const double* q, const double* p, const double* force,
                     std::span<const std::uint8_t> halvings, double* Jx, double* Jf, double* Jr, double* Jp = nullptr) {
        chained.begin(Jx, Jf);
        if (Jr) std::fill(Jr, Jr + entries(2 * n, n), 0.0);
        if (Jp) std::fill(Jp, Jp + in_parameters.size(), 0.0);
        return parts(h, q, p, force, halvings, [&](double begin, double length) {
            part_derivatives(length);
            chained.follow(Jx, Jf);
            if (Jp) {
                parameter_derivatives(length, in_parameters.data());
                chained.follow_more(Jp, in_parameters);
            }
            if (!Jr) return;
            ramp_derivatives(length, begin, length / h, chained.part_rate.data());
            chained.follow_rates(Jr);
        });
    }

    // The root of an undivided step, from a guess (s, n). If the guess is too far away, for example because friction
    // changes its sign within the step, from the initial velocity, and then by repetition of the steps before.
    Outcome root(double h, const double* q, const double* p, const double* guess, const double* force, int past) {
        std::copy(guess, guess + stages * n, stepper.equation.V.begin());
        Outcome outcome = root_at(h, q, p, force);
        if (outcome == Outcome::solved) return outcome;
        if (!stepper.begin_at(q, p, state)) return Outcome::singular;
        outcome = stepper.part(h, 0, 0.0, state);
        if (outcome == Outcome::solved || past == 0) return outcome;
        const Outcome alone = outcome;
        if (!stepper.begin_at(q - past * n, p - past * n, state)) return alone;
        for (int k = past; k >= 0; --k) {
            stepper.take_force(force - k * (varies ? stages * n : n), varies);
            if (stepper.step(h, state) != Outcome::solved) return alone;
        }
        return root_at(h, q, p, force);
    }

    // The root from the guess in the step equation.
    Outcome root_at(double h, const double* q, const double* p, const double* force) {
        for (int i = 0; i < n; ++i) {
            state.position[i] = {{q[i], 0.0}, 0.0};
            stepper.unwind(i, state);
            state.p[i] = {p[i], 0.0};
        }
        stepper.take_force(force, varies);
        return stepper.equation.solve(h, {state.position.data(), state.p.data(), stepper.force.data(), stepper.stride},
                                      loose, true, stepper.effort);
    }

    Outcome root_of(double h, const Substep& part) {
        stepper.force_in_part(part.begin, part.length / h);
        std::copy(part.V.begin(), part.V.end(), stepper.equation.V.begin());
        return stepper.equation.solve(part.length,
                                      {part.position.data(), part.p.data(), stepper.force.data(), stepper.stride},
                                      loose, true, stepper.effort);
    }

    // Repeat the parts of a step. After each solved part, with its root in the stepper, calls visit(begin, length),
    // with the begin in units of the step.
    template <class Visit>
    Outcome parts(double h, const double* q, const double* p, const double* force,
                  std::span<const std::uint8_t> halvings, const Visit& visit) {
        stepper.take_force(force, varies);
        if (!stepper.begin_at(q, p, state)) return Outcome::singular;
        return parts_again(halvings, stepper.guards.halvings_again(), [&](int level, double begin) {
            from = state.position;
            from_p = state.p;
            const Outcome outcome = stepper.part(h, level, begin, state);
            if (outcome == Outcome::solved) visit(begin, length_of(h, level));
            return outcome;
        });
    }

    // The parts of a step, repeated.
    Outcome follow(double h, const double* q, const double* p, const double* force,
                   std::span<const std::uint8_t> halvings, std::vector<Substep>& trail) {
        std::vector<double> Jx(4 * n * n), Jf(2 * n * n);
        chained.begin(Jx.data(), Jf.data());
        return parts(h, q, p, force, halvings, [&](double begin, double length) {
            trail.push_back({from, from_p, stepper.equation.V, begin, length, joined(Jx, Jf)});
            part_derivatives(length);
            chained.follow(Jx.data(), Jf.data());
        });
    }

    // A row (2n) on the end of a part, brought to its beginning by the part's derivatives.
    void back(const double* row, double* before) const {
        for (int c = 0; c < 2 * n; ++c) {
            before[c] = 0.0;
            for (int r = 0; r < 2 * n; ++r) before[c] += chained.part[r * 2 * n + c] * row[r];
        }
    }

    // Derivatives (2n, n) in a ramp of the force over the whole step, of the part whose root is in the stepper.
    void ramp_derivatives(double h, double begin, double share, double* Jr) {
        stepper.equation.weigh_ramp(begin, share);
        stepper.equation.derivatives(h, dV, in_ramp.data(), Jr);
        stepper.equation.weigh_constant();
    }

    // Derivatives (2n, k) in the parameters, of the part whose root and factors are in the stepper.
    void parameter_derivatives(double h, double* Jp) {
        const int k = columns->count();
        std::vector<double> right, dp, dq(n), by(stages * n);
        for (int a = 0; a < k; ++a) {
            columns->right_side(a, h, stepper.force.data(), stepper.stride, right, dp);
            stepper.equation.solve_factored(right.data(), by.data());
            std::fill(dq.begin(), dq.end(), 0.0);
            stepper.equation.add_end_change(h, by.data(), dq.data(), dp.data());
            for (int r = 0; r < n; ++r) {
                Jp[r * k + a] = dq[r];
                Jp[(n + r) * k + a] = dp[r];
            }
        }
    }

    // Derivatives of the part whose root is in the stepper.
    void part_derivatives(double length) {
        stepper.equation.derivatives(length, dV, chained.part.data(), chained.part_f.data());
    }

    std::vector<double> joined(const std::vector<double>& Jx, const std::vector<double>& Jf) const {
        std::vector<double> both(6 * n * n);
        for (int r = 0; r < 2 * n; ++r) {
            std::copy_n(&Jx[r * 2 * n], 2 * n, &both[r * 3 * n]);
            std::copy_n(&Jf[r * n], n, &both[r * 3 * n + 2 * n]);
        }
        return both;
    }

    // Add start' (z . d2(q1, p1)) start, (L4), at the stepper's root, after part_derivatives; `start` (2n, 3n) may be
    // null.
    void add_curvature(double h, const double* z, const double* start, double* H) {
        const Collocation& equation = stepper.equation;
        const int w = 3 * n;
        write_slopes(h, z);
        stepper.equation.solve_transposed(slope.data(), multiplier.data());
        if (start != nullptr) bring_to_start(start);
        for (int i = 0; i < stages; ++i) {
            differentiate_along(h, i, z);
            move_stage(h, i, start);
            std::fill(inner.begin(), inner.end(), 0.0);
            bend_stage(i);
            if (stepper.mechanism.forces.any()) add_elements(h, i, z, H + 2 * n * w);
            if (equation.coupled()) add_couplings(h, i, z);
            for (int c = 0; c < n; ++c) {
                const double *dq = &dQ[c * w], *dv = &dV[(i * n + c) * w];
                const double *in_q = &inner[c * w], *in_v = &inner[(n + c) * w];
                for (int r = 0; r < w; ++r) {
                    double* row = H + r * w;
                    for (int k = 0; k < w; ++k) row[k] += dq[r] * in_q[k] + dv[r] * in_v[k];
                }
            }
        }
        for (int r = 0; r < w; ++r) {
            for (int k = 0; k < r; ++k) H[r * w + k] = H[k * w + r] = 0.5 * (H[r * w + k] + H[k * w + r]);
        }
    }

    // dphi/dV_m = h b_m (zq + (A_m + F_v,m) zp) + h^2 sum_i b_i a_im (L_qq,i + F_q,i) zp into `slope`.
    void write_slopes(double h, const double* z) {
        const Collocation& equation = stepper.equation;
        const Tableau& tableau = equation.tableau;
        for (int m = 0; m < stages; ++m) {
            for (int c = 0; c < n; ++c) {
                double total = tableau.b[m] * (z[c] + equation.acting[m * n + c].by_v * z[n + c]);
                for (int j = 0; j < n; ++j) total += tableau.b[m] * equation.stage[m].A[c * n + j] * z[n + j];
                for (int i = 0; i < stages; ++i) {
                    const double factor = h * tableau.b[i] * tableau.a[i * stages + m];
                    total += factor * equation.acting[i * n + c].by_q * z[n + c];
                    for (int j = 0; j < n; ++j) total += factor * equation.stage[i].Lqq[c * n + j] * z[n + j];
                    for (int j = 0; j < n && equation.coupled(); ++j)
                        total += factor * equation.coupled_q[(i * n + j) * n + c] * z[n + j];
                }
                for (int j = 0; j < n && equation.coupled(); ++j)
                    total += tableau.b[m] * equation.coupled_v[(m * n + j) * n + c] * z[n + j];
                slope[m * n + c] = h * total;
            }
        }
    }

    // The jet at stage i and its derivative along (alpha, -multiplier), of which psi is the Lagrangian's share.
    void differentiate_along(double h, int i, const double* z) {
        const Collocation& equation = stepper.equation;
        const Tableau& tableau = equation.tableau;
        for (int c = 0; c < n; ++c) {
            double alpha = tableau.b[i] * z[n + c];
            for (int j = 0; j < stages; ++j) alpha += tableau.gradient[j * stages + i] * multiplier[j * n + c];
            at_q[c] = {equation.Q[i * n + c], h * alpha};
            at_v[c] = {equation.V[i * n + c], -multiplier[i * n + c]};
        }
        lagrangian_jet(stepper.mechanism, at_q.data(), at_v.data(), direction);
    }

    // Derivatives of Q at stage i into dQ.
    void move_stage(double h, int i, const double* start) {
        const Tableau& tableau = stepper.equation.tableau;
        const int w = 3 * n;
        for (int c = 0; c < n; ++c) {
            for (int k = 0; k < w; ++k) {
                double total = start == nullptr ? (c == k ? 1.0 : 0.0) : start[c * w + k];
                for (int j = 0; j < stages; ++j) total += h * tableau.a[i * stages + j] * dV[(j * n + c) * w + k];
                dQ[c * w + k] = total;
            }
        }
    }

    // Add (psi_qq dQ + psi_qv dV; psi_vq dQ + psi_vv dV) at stage i, that of `direction`, to `inner`.
    void bend_stage(int i) {
        const int w = 3 * n;
        for (int r = 0; r < n; ++r) {
            double *in_q = &inner[r * w], *in_v = &inner[(n + r) * w];
            for (int j = 0; j < n; ++j) {
                const double qq = direction.Lqq[r * n + j].slope, vq = direction.A[r * n + j].slope;
                const double qv = direction.A[j * n + r].slope, vv = direction.M[r * n + j].slope;
                const double *dq = &dQ[j * w], *dv = &dV[(i * n + j) * w];
                for (int k = 0; k < w; ++k) {
                    in_q[k] += qq * dq[k] + qv * dv[k];
                    in_v[k] += vq * dq[k] + vv * dv[k];
                }
            }
        }
    }

    // The elements' forces at stage i, with derivatives in q, in v and in f.
    void differentiate_elements(int i) {
        const Collocation& equation = stepper.equation;
        for (auto* along : {&along_q, &along_v, &along_f}) {
            for (int c = 0; c < n; ++c) {
                at_q[c] = {equation.Q[i * n + c], along == &along_q ? 1.0 : 0.0};
                at_v[c] = {equation.V[i * n + c], along == &along_v ? 1.0 : 0.0};
                at_f[c] = {stepper.force[i * stepper.stride + c], along == &along_f ? 1.0 : 0.0};
            }
            stepper.mechanism.forces.sum(n, at_q.data(), at_v.data(), at_f.data(), along->data());
        }
    }

    // Add the diagonal second derivatives of gamma . F of elements at stage i, those in f to `by_f` (n, 3n).
    void add_elements(double h, int i, const double* z, double* by_f) {
        const int w = 3 * n;
        differentiate_elements(i);
        for (int c = 0; c < n; ++c) {
            const double gamma = weight(h, i, c, z);
            const double qq = gamma * along_q[c].by_q.slope, qv = gamma * along_q[c].by_v.slope;
            const double vv = gamma * along_v[c].by_v.slope, ff = gamma * along_f[c].by_f.slope;
            const double qf = gamma * along_f[c].by_q.slope, vf = gamma * along_f[c].by_v.slope;
            const double *dq = &dQ[c * w], *dv = &dV[(i * n + c) * w], *of_f = &df[c * w];
            double *in_q = &inner[c * w], *in_v = &inner[(n + c) * w], *in_f = by_f + c * w;
            for (int k = 0; k < w; ++k) {
                in_q[k] += qq * dq[k] + qv * dv[k] + qf * of_f[k];
                in_v[k] += qv * dq[k] + vv * dv[k] + vf * of_f[k];
                in_f[k] += qf * dq[k] + vf * dv[k] + ff * of_f[k];
            }
        }
    }

    // The weight gamma of the force of stage i on coordinate c.
    double weight(double h, int i, int c, const double* z) const {
        const Tableau& tableau = stepper.equation.tableau;
        double gamma = tableau.b[i] * z[n + c];
        for (int j = 0; j < stages; ++j) gamma += tableau.force[j * stages + i] * multiplier[j * n + c];
        return h * gamma;
    }

    // Add the second derivatives of gamma . F of couplings at stage i, by columns of the Hessian.
    void add_couplings(double h, int i, const double* z) {
        const Collocation& equation = stepper.equation;
        const int w = 3 * n;
        for (auto* matrix : {&coupled_q, &coupled_v}) matrix->resize(n * n);
        for (int along = 0; along < 2 * n; ++along) {
            for (int c = 0; c < n; ++c) {
                at_q[c] = {equation.Q[i * n + c], c == along ? 1.0 : 0.0};
                at_v[c] = {equation.V[i * n + c], n + c == along ? 1.0 : 0.0};
            }
            std::fill(along_q.begin(), along_q.end(), JointForce<Dual>{});
            stepper.mechanism.couplings.add_forces(n, at_q.data(), at_v.data(), direction.couplings, along_q.data(),
                                                   coupled_q.data(), coupled_v.data());
            const double* change = along < n ? &dQ[along * w] : &dV[(i * n + along - n) * w];
            for (int c = 0; c < n; ++c) {
                double by_q = 0.0, by_v = 0.0;
                for (int r = 0; r < n; ++r) {
                    const double gamma = weight(h, i, r, z);
                    by_q += gamma * coupled_q[r * n + c].slope;
                    by_v += gamma * coupled_v[r * n + c].slope;
                }
                double *in_q = &inner[c * w], *in_v = &inner[(n + c) * w];
                for (int k = 0; k < w; ++k) {
                    in_q[k] += by_q * change[k];
                    in_v[k] += by_v * change[k];
                }
            }
        }
    }

    // Transform dV in (q0, p0, f) of the part to that of the step: dV start, with the same f.
    void bring_to_start(const double* start) {
        const int w = 3 * n;
        std::vector<double> row(w);
        for (int k = 0; k < stages * n; ++k) {
            double* own = &dV[k * w];
            std::fill(row.begin(), row.end(), 0.0);
            for (int j = 0; j < 2 * n; ++j) {
                for (int c = 0; c < w; ++c) row[c] += own[j] * start[j * w + c];
            }
            for (int c = 2 * n; c < w; ++c) row[c] += own[c];
            std::copy(row.begin(), row.end(), own);
        }
    }
};

}  // namespace varpin
