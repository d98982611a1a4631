// First derivatives of a collocation step. docs/mathematics.md, "Linearization".
// Equations (L1) and (L2) of docs/mathematics.md.
#pragma once

#include <algorithm>
#include <vector>

#include "varpin/collocation.hpp"

namespace varpin {

// The step equation with its derivatives.
class StepEquation : public Collocation {
  public:
    StepEquation(const Mechanism& mechanism, const Tableau& tableau, bool dense, const Kernels& kernels = kernels_for<>)
        : Collocation(mechanism, tableau, dense, kernels), weight(stages, 1.0) {}

    std::vector<double> weight;  // (s) factor of the force f at each stage, for derivatives in f
    bool weighted = false;       // whether any factor is not 1

    // Take derivatives in f for a force that grows linearly from 0 to f over the whole step, of which this is the part
    // at `begin` with length `share`, both in units of the step.
    void weigh_ramp(double begin, double share) {
        weighted = true;
        for (int i = 0; i < stages; ++i) weight[i] = begin + share * tableau.c[i];
    }
    // Take derivatives in f for a constant force again.
    void weigh_constant() {
        weighted = false;
        std::fill(weight.begin(), weight.end(), 1.0);
    }

    // Derivatives at the root, from the jets of its stages: dV (s, n, 3n), and of (q1, p1), all in (q0, p0, f); Jx is
    // (2n, 2n), Jf (2n, n). Only blocks of dV are written.
    void derivatives(double h, std::vector<double>& dV, double* Jx, double* Jf) {
        if (stages == 1) return (this->*kernels.derivatives)(h, dV, Jx, Jf);
        derivatives_by_blocks<int, int>(h, dV, Jx, Jf);
    }

    // The same. Numbers of joints and stages may be known at compile time, here and in
    // the three parts of it.
    template <class Size, class Stages>
    void derivatives_by_blocks(double h, std::vector<double>& dV, double* Jx, double* Jf) {
        const Size n = this->n;
        const Stages stages = this->stages;
        const auto& blocks = blocks_of(mechanism.tree, n);
        if (blocks.size() > 1) {
            std::fill(Jx, Jx + 4 * n * n, 0.0);
            std::fill(Jf, Jf + 2 * n * n, 0.0);
        }
        factor_blocks(h);
        const double* matrix = lu.data();
        const int* rows = order.data();
        for (const Block& block : blocks) {
            const int width = block.end - block.begin, size = stages * width;
            right_sides(n, stages, h, block, dV);
            solve_columns(n, stages, h, matrix, rows, block, dV);
            end_derivatives(n, stages, h, block, dV, Jx, Jf);
            matrix += size * size;
            rows += size;
        }
    }

    // x with N' x = right, after `derivatives`.
    void solve_transposed(const double* right, double* x) {
        solve_blocks(right, x, [this](const double* matrix, int size, const int* rows, double* b, double* y) {
            solve_lu_transposed(matrix, size, stages == 1 ? nullptr : rows, b, y);
        });
    }

    // Add what a change dV (s, n) of the stage velocities gives to the end of the step, (L1) and (L2).
    void add_end_change(double h, const double* dV, double* dq, double* dp) {
        std::vector<double> dQ(n);
        for (int i = 0; i < stages; ++i) {
            const double* own = dV + i * n;
            std::fill(dQ.begin(), dQ.end(), 0.0);
            for (int j = 0; j < stages; ++j) {
                for (int c = 0; c < n; ++c) dQ[c] += h * tableau.a[i * stages + j] * dV[j * n + c];
            }
            for (int r = 0; r < n; ++r) {
                const JointForce<double>& force = acting[i * n + r];
                double total = force.by_q * dQ[r] + force.by_v * own[r];
                for (int c = 0; c < n; ++c) total += stage[i].Lqq[r * n + c] * dQ[c] + stage[i].A[c * n + r] * own[c];
                for (int c = 0; c < n && coupled(); ++c)
                    total += coupled_q[(i * n + r) * n + c] * dQ[c] + coupled_v[(i * n + r) * n + c] * own[c];
                dq[r] += h * tableau.b[i] * own[r];
                dp[r] += h * tableau.b[i] * total;
            }
        }
    }

    // How many of q0, p0 and f need a solve. With one stage, the columns of the force are proportional to those of the
    // momentum, unless `every_kind` is set.
    int kinds() const { return stages == 1 && !every_kind ? 2 : 3; }
    bool every_kind = false;

    // The effect of a force on coordinate c on a single stage, relative to that of a momentum.
    double by_momentum(double h, int c) const { return h * (weight[0] * tableau.force[0] + changed(0, c)); }

  private:
    template <class>
    friend struct Sized;
    friend class ConstrainedLinearization;

    std::vector<double> columns, gain;

    // sum_j f_ij w_j (F_f,j - 1): the change of a constant force in r_i by elements.
    double changed(int i, int c) const {
        double total = 0.0;
        for (int j = 0; j < stages; ++j) total += weight[j] * tableau.force[i * stages + j] * acting[j * n + c].by_f;
        return total;
    }
    // sum_j b_j w_j F_f,j: the factor of a constant force in p1.
    double passed(int c) const {
        double total = weighted ? 0.0 : 1.0;
        for (int j = 0; j < stages && weighted; ++j) total += weight[j] * tableau.b[j];
        for (int j = 0; j < stages; ++j) total += weight[j] * tableau.b[j] * acting[j * n + c].by_f;
        return total;
    }

    // dr_i in (q0, p0, f): h sum_j (abar_ij L_qq,j + f_ij F_q,j) - A_i, 1, and h sum_j f_ij w_j F_f,j.
    template <class Size, class Stages>
    void right_sides(Size n, Stages stages, double h, Block block, std::vector<double>& dV) const {
        for (int i = 0; i < stages; ++i) {
            double share = 0.0;
            for (int j = 0; j < stages; ++j) share += weight[j] * tableau.force[i * stages + j];
            for (int r = block.begin; r < block.end; ++r) {
                double* row = &dV[(i * n + r) * 3 * n];
                for (int c = block.begin; c < block.end; ++c) {
                    double total = 0.0;
                    for (int j = 0; j < stages; ++j)
                        total += tableau.gradient[i * stages + j] * stage[j].Lqq[r * n + c];
                    for (int j = 0; j < stages && r == c; ++j)
                        total += tableau.force[i * stages + j] * acting[j * n + r].by_q;
                    for (int j = 0; j < stages && coupled(); ++j)
                        total += tableau.force[i * stages + j] * coupled_q[(j * n + r) * n + c];
                    row[c] = h * total - stage[i].A[r * n + c];
                    row[n + c] = r == c ? 1.0 : 0.0;
                    if (kinds() == 3) row[2 * n + c] = r == c ? h * (share + changed(i, r)) : 0.0;
                }
            }
        }
    }

    // N dV = dr in place, whole rows at a time.
    template <class Size, class Stages>
    void solve_columns(Size n, Stages stages, double h, const double* matrix, const int* rows, Block block,
                       std::vector<double>& dV) {
        const int width = block.end - block.begin, size = stages * width;
        if (stages == 1 && width == n) {
            solve_lu_rows(matrix, n, {0, n}, dV.data(), 2 * n, 3 * n);
        } else {
            const int across = kinds() * width;
            columns.resize(entries(size, across));
            // Row k of the block's system, at (stage, coordinate) in dV.
            const auto line = [&](int k) { return &dV[((k / width) * n + block.begin + k % width) * 3 * n]; };
            for (int k = 0; k < size; ++k) {
                const double* from = line(stages == 1 ? k : rows[k]);
                for (int kind = 0; kind < kinds(); ++kind)
                    std::copy_n(from + kind * n + block.begin, width, &columns[k * across + kind * width]);
            }
            solve_lu_rows(matrix, size, {0, size}, columns.data(), across, across);
            for (int k = 0; k < size; ++k) {
                for (int kind = 0; kind < kinds(); ++kind)
                    std::copy_n(&columns[k * across + kind * width], width, line(k) + kind * n + block.begin);
            }
        }
        if (kinds() == 3) return;
        for (int r = block.begin; r < block.end; ++r) {
            double* row = &dV[r * 3 * n];
            for (int c = block.begin; c < block.end; ++c) row[2 * n + c] = by_momentum(h, c) * row[n + c];
        }
    }

    // Equations (L1) and (L2) for any number of stages:
    // dq1 = dq0 + h sum_i b_i dV_i,  dp1 = dp0 + h F_f df + h sum_i b_i K_i dq0 + sum_j G_j dV_j, with K = L_qq + F_q
    // and G_j = h b_j (A_j' + F_v,j) + h^2 sum_i b_i a_ij K_i.
    template <class Size, class Stages>
    void end_derivatives(Size n, Stages stages, double h, Block block, const std::vector<double>& dV, double* Jx,
                         double* Jf) {
        const int width = block.end - block.begin, size = stages * width;
        gain.resize(size);
        const auto curvature = [&](int i, int r, int c) {
            double entry = stage[i].Lqq[r * n + c];
            if (r == c) entry += acting[i * n + r].by_q;
            if (coupled()) entry += coupled_q[(i * n + r) * n + c];
            return entry;
        };
        for (int r = block.begin; r < block.end; ++r) {
            double *q = Jx + r * 2 * n, *p = q + 2 * n * n, *qf = Jf + r * n, *pf = qf + n * n;
            for (int c = block.begin; c < block.end; ++c) {
                double by_q = 0.0, by_p = 0.0, by_f = 0.0, bend = 0.0;
                for (int i = 0; i < stages; ++i) {
                    const double* dV_entry = &dV[(i * n + r) * 3 * n + c];
                    by_q += tableau.b[i] * dV_entry[0];
                    by_p += tableau.b[i] * dV_entry[n];
                    by_f += tableau.b[i] * dV_entry[2 * n];
                    bend += tableau.b[i] * curvature(i, r, c);
                }
                q[c] = h * by_q + (r == c ? 1.0 : 0.0);
                q[n + c] = h * by_p;
                qf[c] = h * by_f;
                p[c] = h * bend;
                p[n + c] = pf[c] = 0.0;
                for (int j = 0; j < stages; ++j) {
                    double entry = tableau.b[j] * stage[j].A[c * n + r];
                    if (r == c) entry += tableau.b[j] * acting[j * n + r].by_v;
                    if (coupled()) entry += tableau.b[j] * coupled_v[(j * n + r) * n + c];
                    for (int i = 0; i < stages; ++i)
                        entry += h * tableau.b[i] * tableau.a[i * stages + j] * curvature(i, r, c);
                    gain[j * width + c - block.begin] = -h * entry;
                }
            }
            const auto add = [&](double* out, int kind, int across) {
                for (int j = 0; j < stages; ++j) {
                    const double* from = &dV[(j * n + block.begin) * 3 * n + kind * n + block.begin];
                    subtract_rows(
                        out + block.begin, across, 0, width, [&](int m) { return gain[j * width + m]; },
                        [&](int m) { return from + m * 3 * n; });
                }
            };
            if (width == n) {
                add(p, 0, 2 * n);
            } else {
                add(p, 0, width);
                add(p + n, 1, width);
            }
            if (kinds() == 3) {
                add(pf, 2, width);
            } else {
                for (int c = block.begin; c < block.end; ++c) pf[c] = by_momentum(h, c) * p[n + c];
            }
            p[n + r] += 1.0;
            pf[r] += h * passed(r);
        }
    }
};

}  // namespace varpin
