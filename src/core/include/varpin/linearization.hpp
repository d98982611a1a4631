// Derivatives of the steps of a trajectory, first and second. docs/mathematics.md, "Structured linearization" and
// "Second derivatives".
//
// For z = (zq, zp) the step equation is joined to phi = zq . q1 + zp . p1 with multipliers lam_i that make the sum
// stationary in V: N' lam = dphi/dV. What is not linear in (q0, p0, f, V) there is
//
//     psi = sum_i alpha_i . L_q(Q_i, V_i) + beta_i . L_v(Q_i, V_i),
//     alpha_i = h (b_i zp + sum_j abar_ji lam_j),    beta_i = -lam_i,
//
// and at a root first derivatives of V are enough: d2 phi = sum_i (dQ_i, dV_i)' d2 psi_i (dQ_i, dV_i).
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <vector>

#include "varpin/variational.hpp"

namespace varpin {

class VariationalLinearization {
  public:
    VariationalLinearization(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                             double left, Solver solver = Solver::automatic)
        : stepper(mechanism, tableau, tolerance, guards, left, solver),
          n(mechanism.dof()),
          stages(tableau.stages),
          state(mechanism, stages),
          dV(stages * n * 3 * n),
          dQ(n * 3 * n),
          link(4 * n * n),
          link_f(2 * n * n),
          product(4 * n * n),
          multiplier(stages * n),
          slope(stages * n),
          direction(mechanism.tree),
          at_q(n),
          at_v(n),
          inner(2 * n * 3 * n) {}

    // d(q1, p1)/d(q0, p0) (2n, 2n) and d(q1, p1)/df (2n, n) of one step from (q, p) under a constant force f. A step
    // that was taken whole is solved once more from a guess (s, n) next to its root; another is taken again, guards and
    // all, and the derivatives of its parts are chained.
    Outcome first(double h, const double* q, const double* p, const double* guess, const double* force,
                  std::int64_t substeps, double* Jx, double* Jf) {
        if (substeps == 1) {
            const Outcome outcome = root(h, q, p, guess, force);
            if (outcome == Outcome::solved) stepper.step_equation.derivatives(h, dV, Jx, Jf);
            return outcome;
        }
        const Outcome outcome = parts(h, q, p, force, substeps);
        if (outcome != Outcome::solved) return outcome;
        identity(Jx, Jf);
        for (const Substep& part : trail) {
            const Outcome again = root_of(part);
            if (again != Outcome::solved) return again;
            stepper.step_equation.derivatives(part.length, dV, link.data(), link_f.data());
            chain(Jx, Jf);
        }
        return Outcome::solved;
    }

    // z . d2(q1, p1)/d(q0, p0, f)2 of one step, into H (3n, 3n). A step taken in parts: z goes back by each part's
    // derivative, and the curvature of each part to the start of the step.
    Outcome second(double h, const double* q, const double* p, const double* guess, const double* force,
                   std::int64_t substeps, const double* z, double* H) {
        std::fill(H, H + 9 * n * n, 0.0);
        if (substeps == 1) {
            const Outcome outcome = root(h, q, p, guess, force);
            if (outcome != Outcome::solved) return outcome;
            stepper.step_equation.derivatives(h, dV, link.data(), link_f.data());
            add_curvature(h, z, nullptr, H);
            return Outcome::solved;
        }
        const Outcome outcome = parts(h, q, p, force, substeps);
        if (outcome != Outcome::solved) return outcome;
        // Derivatives (2n, 3n) from the start of the step to the start of each part.
        std::vector<std::vector<double>> starts(1, std::vector<double>(6 * n * n));
        std::vector<double> Jx(4 * n * n), Jf(2 * n * n), back(z, z + 2 * n), before(2 * n);
        identity(Jx.data(), Jf.data());
        join(Jx, Jf, starts[0]);
        for (const Substep& part : trail) {
            const Outcome again = root_of(part);
            if (again != Outcome::solved) return again;
            stepper.step_equation.derivatives(part.length, dV, link.data(), link_f.data());
            chain(Jx.data(), Jf.data());
            starts.emplace_back(6 * n * n);
            join(Jx, Jf, starts.back());
        }
        for (std::size_t k = trail.size(); k-- > 0;) {
            const Outcome again = root_of(trail[k]);
            if (again != Outcome::solved) return again;
            stepper.step_equation.derivatives(trail[k].length, dV, link.data(), link_f.data());
            add_curvature(trail[k].length, back.data(), starts[k].data(), H);
            for (int c = 0; c < 2 * n; ++c) {
                before[c] = 0.0;
                for (int r = 0; r < 2 * n; ++r) before[c] += link[r * 2 * n + c] * back[r];
            }
            std::swap(before, back);
        }
        return Outcome::solved;
    }

  private:
    // A root that is known to 1e-10 is good enough for derivatives.
    static constexpr double loose = 1e6;

    VariationalStepper stepper;
    int n;
    int stages;
    PathState state;
    std::vector<Substep> trail;
    std::vector<double> dV;  // (s, n, 3n)
    std::vector<double> dQ;  // (n, 3n) of one stage
    std::vector<double> link, link_f, product;
    std::vector<double> multiplier, slope;  // (s, n)
    Jet<Dual> direction;
    std::vector<Dual> at_q, at_v;
    std::vector<double> inner;  // (2n, 3n)

    Outcome root(double h, const double* q, const double* p, const double* guess, const double* force) {
        for (int i = 0; i < n; ++i) {
            state.place[i] = {{q[i], 0.0}, 0.0};
            stepper.unwind(i, state);
            state.p[i] = {p[i], 0.0};
        }
        std::copy(force, force + n, stepper.force.begin());
        std::copy(guess, guess + stages * n, stepper.step_equation.V.begin());
        return stepper.step_equation.solve(h, {state.place.data(), state.p.data(), stepper.force.data()}, loose, true,
                                           stepper.effort);
    }

    Outcome root_of(const Substep& part) {
        std::copy(part.V.begin(), part.V.end(), stepper.step_equation.V.begin());
        return stepper.step_equation.solve(part.length, {part.place.data(), part.p.data(), stepper.force.data()}, loose,
                                           true, stepper.effort);
    }

    // Take the step again, with its parts noted down. The motion's own step may have begun with shorter parts than a
    // fresh start does: then it is taken once more, beginning with those.
    Outcome parts(double h, const double* q, const double* p, const double* force, std::int64_t substeps) {
        std::copy(force, force + n, stepper.force.begin());
        Outcome outcome = Outcome::solved;
        for (const bool again : {false, true}) {
            if (!stepper.begin_at(q, p, state)) return Outcome::singular;
            if (again) state.level = std::bit_width(static_cast<std::uint64_t>(substeps - 1)) + 1;
            trail.clear();
            stepper.trail = &trail;
            outcome = stepper.step(h, state);
            stepper.trail = nullptr;
            if (stepper.effort.substeps == substeps) break;
        }
        return outcome;
    }

    void identity(double* Jx, double* Jf) const {
        std::fill(Jx, Jx + 4 * n * n, 0.0);
        std::fill(Jf, Jf + 2 * n * n, 0.0);
        for (int i = 0; i < 2 * n; ++i) Jx[i * 2 * n + i] = 1.0;
    }

    // Let the part whose derivatives stand in `link` and `link_f` follow those before.
    void chain(double* Jx, double* Jf) {
        const int x = 2 * n;
        const auto times = [&](const double* right, int columns) {
            std::fill(product.begin(), product.begin() + x * columns, 0.0);
            for (int i = 0; i < x; ++i) {
                for (int j = 0; j < x; ++j) {
                    const double factor = link[i * x + j];
                    if (factor == 0.0) continue;
                    for (int c = 0; c < columns; ++c) product[i * columns + c] += factor * right[j * columns + c];
                }
            }
        };
        times(Jx, x);
        std::copy(product.begin(), product.end(), Jx);
        times(Jf, n);
        for (int i = 0; i < x * n; ++i) Jf[i] = product[i] + link_f[i];
    }

    void join(const std::vector<double>& Jx, const std::vector<double>& Jf, std::vector<double>& both) const {
        for (int r = 0; r < 2 * n; ++r) {
            std::copy_n(&Jx[r * 2 * n], 2 * n, &both[r * 3 * n]);
            std::copy_n(&Jf[r * n], n, &both[r * 3 * n + 2 * n]);
        }
    }

    // Add start' (z . d2(q1, p1)) start at the root in the stepper, its dV at hand; `start` (2n, 3n) may be null.
    void add_curvature(double h, const double* z, const double* start, double* H) {
        const Collocation& equation = stepper.step_equation;
        const Tableau& tableau = equation.tableau;
        const Mechanism& mechanism = stepper.mechanism;
        const int w = 3 * n;
        // dphi/dV_m = h b_m (zq + A_m zp - D zp) + h^2 sum_i b_i a_im L_qq,i zp
        for (int m = 0; m < stages; ++m) {
            for (int c = 0; c < n; ++c) {
                double total = tableau.b[m] * (z[c] - mechanism.damping[c] * z[n + c]);
                for (int j = 0; j < n; ++j) total += tableau.b[m] * equation.stage[m].A[c * n + j] * z[n + j];
                for (int i = 0; i < stages; ++i) {
                    const double factor = h * tableau.b[i] * tableau.a[i * stages + m];
                    for (int j = 0; j < n; ++j) total += factor * equation.stage[i].Lqq[c * n + j] * z[n + j];
                }
                slope[m * n + c] = h * total;
            }
        }
        stepper.step_equation.solve_transposed(h, slope.data(), multiplier.data());
        if (start != nullptr) bring_to_start(start);
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) {
                double alpha = tableau.b[i] * z[n + c];
                for (int j = 0; j < stages; ++j) alpha += tableau.gradient[j * stages + i] * multiplier[j * n + c];
                at_q[c] = {equation.Q[i * n + c], h * alpha};
                at_v[c] = {equation.V[i * n + c], -multiplier[i * n + c]};
            }
            lagrangian_jet(mechanism, at_q.data(), at_v.data(), direction);
            for (int c = 0; c < n; ++c) {
                for (int k = 0; k < w; ++k) {
                    double total = start == nullptr ? (c == k ? 1.0 : 0.0) : start[c * w + k];
                    for (int j = 0; j < stages; ++j) total += h * tableau.a[i * stages + j] * dV[(j * n + c) * w + k];
                    dQ[c * w + k] = total;
                }
            }
            // (psi_qq dQ + psi_qv dV; psi_vq dQ + psi_vv dV)
            std::fill(inner.begin(), inner.end(), 0.0);
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

    // dV in (q0, p0, f) of the part becomes that of the step: dV start, f being common to both.
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
