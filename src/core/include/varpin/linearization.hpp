// Derivatives of the steps of a trajectory, first and second. docs/mathematics.md, "Linearization" and "Second
// derivatives"; equation (L4). With multipliers lam, N' lam = dphi/dV, second derivatives of phi = zq . q1 + zp . p1
// need first derivatives of V alone, and those of psi = sum_i alpha_i . L_q + beta_i . L_v + gamma_i . F at the stages
// with
//
//     alpha_i = h (b_i zp + sum_j abar_ji lam_j),    beta_i = -lam_i,    gamma_i = h (b_i zp + sum_j f_ji lam_j).
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "varpin/repeated_steps.hpp"

namespace varpin {

class VariationalLinearization : public StepLinearization {
  public:
    VariationalLinearization(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                             const Kernels& kernels = kernels_for<>)
        : StepLinearization(std::make_unique<VariationalStepper>(mechanism, tableau, tolerance, guards, 1.0, kernels)),
          direction(mechanism.tree),
          at_q(n),
          at_v(n),
          at_f(n),
          along_q(n),
          along_v(n),
          along_f(n) {
        dV.resize(entries(stages * n, 3 * n));
        for (int c = 0; c < n; ++c) df[c * 3 * n + 2 * n + c] = 1.0;
    }

    // Takes x = (q, p) to the end of a step, in the parts that the guards require, with its derivatives Jx in x and Jf
    // in the external force (n), which may be null. `spread` (n, n), the covariance of forces in a unit of time,
    // becomes that of the jumps of p, which it is.
    Outcome step(double h, double* x, const double* force, const double* external, double* Jx, double* Jf, double*) {
        take_external(external);
        stepper->take_force(force, varies);
        Outcome outcome = stepper->step_from(h, x, x + n, state);
        if (outcome == Outcome::solved) {
            equation().derivatives(h, dV, Jx, Jf);
        } else {
            outcome = in_parts({.h = h, .q = x, .p = x + n, .force = force}, {.state = Jx, .force = Jf});
        }
        std::copy(state.q.begin(), state.q.end(), x);
        std::copy(state.momentum.begin(), state.momentum.end(), x + n);
        return outcome;
    }

    // q1 and M(q1)^-1 p1 (n) of the step of which `first` gives the derivatives.
    Outcome end(const RepeatedStep& at, double* q1, double* v1) {
        const Outcome outcome = parts(at, [](double, double) {});
        if (outcome != Outcome::solved) return outcome;
        std::copy(state.q.begin(), state.q.end(), q1);
        std::copy(state.v.begin(), state.v.end(), v1);
        return Outcome::solved;
    }

    // v = M(q)^-1 p and its derivatives in x = (q, p), into zeros (n, 2n); false where M(q) is not positive definite.
    bool velocity(const double* x, double* v, double* slopes) {
        if (!stepper->move_to(x, x + n, state)) return false;
        std::copy(state.v.begin(), state.v.end(), v);
        equation().kernels.velocity_slopes(stepper->mechanism, 1, x, v, slopes);
        return true;
    }

    // z . d2(q1, p1)/d(q0, p0, f)2 of one step, into H (3n, 3n). For a divided step, z is propagated backward by the
    // derivative of each part, and the second derivatives of each part are transformed to the start of the step.
    Outcome second(const RepeatedStep& at, const double* z, double* H) {
        std::fill(H, H + entries(3 * n, 3 * n), 0.0);
        if (at.halvings.empty() && !stepper->guards.active) {
            const Outcome outcome = root(at);
            if (outcome != Outcome::solved) return outcome;
            differentiate(at.h, 0.0, 1.0, chained.part);
            add_curvature(at.h, z, nullptr, H);
            return Outcome::solved;
        }
        std::vector<Substep> trail;
        std::vector<double> row(z, z + 2 * n), before(2 * n);
        const Outcome outcome = follow(at, trail);
        if (outcome != Outcome::solved) return outcome;
        for (std::size_t k = trail.size(); k-- > 0;) {
            const Substep& part = trail[k];
            stepper->force_in_part(part.begin, part.length / at.h);
            const Outcome solved = solve(part.length, part.V.data(), part.position, part.p);
            if (solved != Outcome::solved) return solved;
            differentiate(part.length, part.begin, part.length / at.h, chained.part);
            add_curvature(part.length, row.data(), part.start.data(), H);
            detail::multiply(row.data(), chained.part.state, 1, 2 * n, 2 * n, before.data());
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

    std::vector<double> dQ = zeros(n, 3 * n);  // of one stage
    std::vector<double> multiplier = zeros(stages, n), slope = zeros(stages, n);
    Jet<Dual> direction;
    std::vector<Dual> at_q, at_v;
    std::vector<double> inner = zeros(2 * n, 3 * n);
    std::vector<double> df = zeros(n, 3 * n);  // of the force
    std::vector<Dual> at_f;
    std::vector<Dual> coupled_q, coupled_v;                   // (n, n) of couplings, along a direction
    std::vector<JointForce<Dual>> along_q, along_v, along_f;  // (n) of the elements, with derivatives in q, in v, in f

    StepEquation& equation() { return stepper->equation; }

    // From a guess (s, n). If the guess is too far away, for example because friction changes its sign within the step,
    // from the initial velocity, and then by repetition of the steps before.
    Outcome root(const RepeatedStep& at) override {
        Outcome outcome = root_from(at, at.guess);
        if (outcome == Outcome::solved) return outcome;
        if (!stepper->begin_at(at.q, at.p, state)) return Outcome::singular;
        outcome = stepper->part(at.h, 0, 0.0, state);
        if (outcome == Outcome::solved || at.past == 0) return outcome;
        const Outcome alone = outcome;
        if (!stepper->begin_at(at.q - at.past * n, at.p - at.past * n, state)) return alone;
        for (int k = at.past; k >= 0; --k) {
            stepper->take_force(at.force - k * (varies ? stages * n : n), varies);
            if (stepper->step(at.h, state) != Outcome::solved) return alone;
        }
        const std::vector<double> last = equation().V;
        return root_from(at, last.data());
    }

    Outcome root_from(const RepeatedStep& at, const double* V) {
        stepper->place(at.q, at.p, state);
        stepper->take_force(at.force, varies);
        return solve(at.h, V, state.position, state.p);
    }

    // The root from stage velocities V (s, n) that are close to it.
    Outcome solve(double h, const double* V, const std::vector<Coordinate>& position,
                  const std::vector<Compensated>& p) {
        std::copy(V, V + stages * n, equation().V.begin());
        const Start start{position.data(), p.data(), stepper->force.data(), stepper->stride};
        return equation().solve(h, start, loose, true, stepper->effort);
    }

    // The parts of a step, repeated.
    Outcome follow(const RepeatedStep& at, std::vector<Substep>& trail) {
        std::vector<double> Jx(4 * n * n), Jf(2 * n * n);
        const StepDerivatives to{.state = Jx.data(), .force = Jf.data()};
        chained.begin(to);
        return parts(at, [&](double begin, double length) {
            trail.push_back({from, from_p, equation().V, begin, length, joined(Jx, Jf)});
            differentiate(length, begin, length / at.h, chained.part);
            chained.follow(to);
        });
    }

    void differentiate(double h, double begin, double share, const StepDerivatives& to) override {
        equation().derivatives(h, dV, to.state, to.force);
        if (to.parameters) parameter_derivatives(h, to.parameters);
        if (!to.ramp) return;
        equation().weigh_ramp(begin, share);
        equation().derivatives(h, dV, again.data(), to.ramp);
        equation().weigh_constant();
    }

    // Derivatives (2n, k) in the parameters, of the part whose root and factors are in the stepper.
    void parameter_derivatives(double h, double* Jp) {
        const int k = columns->count();
        std::vector<double> right, dp, dq(n), by(stages * n);
        for (int a = 0; a < k; ++a) {
            columns->right_side(a, h, stepper->force.data(), stepper->stride, right, dp);
            equation().solve_factored(right.data(), by.data());
            std::fill(dq.begin(), dq.end(), 0.0);
            equation().add_end_change(h, by.data(), dq.data(), dp.data());
            for (int r = 0; r < n; ++r) {
                Jp[r * k + a] = dq[r];
                Jp[(n + r) * k + a] = dp[r];
            }
        }
    }

    std::vector<double> joined(const std::vector<double>& Jx, const std::vector<double>& Jf) const {
        std::vector<double> both(6 * n * n);
        for (int r = 0; r < 2 * n; ++r) {
            std::copy_n(&Jx[r * 2 * n], 2 * n, &both[r * 3 * n]);
            std::copy_n(&Jf[r * n], n, &both[r * 3 * n + 2 * n]);
        }
        return both;
    }

    // Add start' (z . d2(q1, p1)) start, (L4), at the stepper's root, after `differentiate`; `start` (2n, 3n) may be
    // null.
    void add_curvature(double h, const double* z, const double* start, double* H) {
        const Collocation& equation = stepper->equation;
        const int w = 3 * n;
        write_slopes(h, z);
        stepper->equation.solve_transposed(slope.data(), multiplier.data());
        if (start != nullptr) bring_to_start(start);
        for (int i = 0; i < stages; ++i) {
            differentiate_along(h, i, z);
            move_stage(h, i, start);
            std::fill(inner.begin(), inner.end(), 0.0);
            bend_stage(i);
            if (stepper->mechanism.forces.any()) add_elements(h, i, z, H + 2 * n * w);
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
        const Collocation& equation = stepper->equation;
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
        const Collocation& equation = stepper->equation;
        const Tableau& tableau = equation.tableau;
        for (int c = 0; c < n; ++c) {
            double alpha = tableau.b[i] * z[n + c];
            for (int j = 0; j < stages; ++j) alpha += tableau.gradient[j * stages + i] * multiplier[j * n + c];
            at_q[c] = {equation.Q[i * n + c], h * alpha};
            at_v[c] = {equation.V[i * n + c], -multiplier[i * n + c]};
        }
        lagrangian_jet(stepper->mechanism, at_q.data(), at_v.data(), direction);
    }

    // Derivatives of Q at stage i into dQ.
    void move_stage(double h, int i, const double* start) {
        const Tableau& tableau = stepper->equation.tableau;
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
        const Collocation& equation = stepper->equation;
        for (auto* along : {&along_q, &along_v, &along_f}) {
            for (int c = 0; c < n; ++c) {
                at_q[c] = {equation.Q[i * n + c], along == &along_q ? 1.0 : 0.0};
                at_v[c] = {equation.V[i * n + c], along == &along_v ? 1.0 : 0.0};
                at_f[c] = {stepper->force[i * stepper->stride + c], along == &along_f ? 1.0 : 0.0};
            }
            stepper->mechanism.forces.sum(n, at_q.data(), at_v.data(), at_f.data(), along->data());
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
        const Tableau& tableau = stepper->equation.tableau;
        double gamma = tableau.b[i] * z[n + c];
        for (int j = 0; j < stages; ++j) gamma += tableau.force[j * stages + i] * multiplier[j * n + c];
        return h * gamma;
    }

    // Add the second derivatives of gamma . F of couplings at stage i, by columns of the Hessian.
    void add_couplings(double h, int i, const double* z) {
        const Collocation& equation = stepper->equation;
        const int w = 3 * n;
        for (auto* matrix : {&coupled_q, &coupled_v}) matrix->resize(n * n);
        for (int along = 0; along < 2 * n; ++along) {
            for (int c = 0; c < n; ++c) {
                at_q[c] = {equation.Q[i * n + c], c == along ? 1.0 : 0.0};
                at_v[c] = {equation.V[i * n + c], n + c == along ? 1.0 : 0.0};
            }
            std::fill(along_q.begin(), along_q.end(), JointForce<Dual>{});
            stepper->mechanism.couplings.add_forces(n, at_q.data(), at_v.data(), direction.couplings, along_q.data(),
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
            detail::multiply(own, start, 1, 2 * n, w, row.data());
            for (int c = 2 * n; c < w; ++c) row[c] += own[c];
            std::copy(row.begin(), row.end(), own);
        }
    }
};

}  // namespace varpin
