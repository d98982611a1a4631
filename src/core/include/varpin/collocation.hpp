// The equation of a collocation step, its Newton iteration and its derivatives. docs/mathematics.md, "Higher order" and
// "Structured linearization". The unknowns are the stage velocities V_i (tableau.hpp); with F = f + the forces of the
// elements (forces.hpp), whose derivatives F_q, F_v and F_f - 1 are diagonal, and of couplings (couplings.hpp), whose
// F_q and F_v are full in their blocks,
//
//     r_i(V) = p0 + h sum_j (abar_ij L_q + f_ij F)(Q_j, V_j) - L_v(Q_i, V_i) = 0
//     N_im = -dr_i/dV_m = delta_im M_i + h (a_im A_i - abar_im A_m' - f_im F_v,m)
//                         - h^2 sum_j a_jm (abar_ij L_qq,j + f_ij F_q,j)
//
// N falls apart into one matrix for each block of the tree; elimination needs none of them. On the
// branch of solutions that is connected to h -> 0 its determinant is positive.
// Equations (D3), (D4), (S1), (C1), (C3), (L1) and (L2) of docs/mathematics.md; (1.8) and (1.9) of the paper.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <vector>

#include "varpin/compensated.hpp"
#include "varpin/dense.hpp"
#include "varpin/elimination.hpp"
#include "varpin/jet.hpp"
#include "varpin/nodes.hpp"
#include "varpin/stage_elimination.hpp"
#include "varpin/tableau.hpp"

namespace varpin {

inline constexpr double infinity = std::numeric_limits<double>::infinity();
inline constexpr double rounding_unit = std::numeric_limits<double>::epsilon();
// Below it squares and products with the rounding unit underflow: what dies out ends at rest.
inline constexpr double nothing = 1e-290;

// What a step took.
struct Effort {
    std::int64_t newton_iterations = 0;
    std::int64_t jets = 0;
    std::int64_t sweeps = 0;  // of first order
    std::int64_t substeps = 0;
    double residual = 0.0;  // the worst, in rounding units of the terms that cancel in it
    double branch_margin = infinity;
};

// Where a step begins.
struct Start {
    const Place* place = nullptr;    // (n)
    const Compensated* p = nullptr;  // (n)
    const double* force = nullptr;   // (n) constant over the step: the controls', and the drift of the noise
};

class Collocation {
  public:
    Collocation(const Mechanism& mechanism, const Tableau& tableau, Solver solver)
        : mechanism(mechanism),
          tableau(tableau),
          n(mechanism.dof()),
          stages(tableau.stages),
          stage(stages, Jet<double>(mechanism.tree, false)),
          V(stages * n),
          Q(stages * n),
          slope(stages * n),
          acting(stages * n),
          residual(stages * n),
          delta(stages * n) {
        for (Jet<double>& jet : stage) mechanism.couplings.fit(jet.couplings);
        if (mechanism.couplings.pushes()) {
            coupled_q.resize(entries(stages * n, n));
            coupled_v.resize(stages * n * n);
        }
        if (stages > StageElimination::most_stages || !eliminates(mechanism, solver, stages)) {
            make_room();
            return;
        }
        element_curvature.resize(stages * n);
        diagonal.resize(stages * stages * n);
        if (stages == 1 && mechanism.tree.size() == n) {
            elimination.emplace(mechanism);
        } else {
            stage_elimination.emplace(mechanism, tableau);
        }
        eliminated_columns = solver == Solver::elimination;
        for (const Block& block : mechanism.tree.blocks)
            eliminated_columns = eliminated_columns || block.end - block.begin >= few_columns;
    }

    const Mechanism& mechanism;
    const Tableau& tableau;
    int n;
    int stages;
    std::vector<Jet<double>> stage;          // without matrices where there is an elimination
    std::optional<Elimination> elimination;  // at the iterate of the last factors; of one stage, without ties
    std::optional<StageElimination> stage_elimination;
    std::vector<double> V;                   // (s, n) stage velocities: the guess, then the root
    std::vector<double> Q;                   // (s, n)
    std::vector<double> slope;               // (s, n) L_q + F
    std::vector<JointForce<double>> acting;  // (s, n) of the elements and couplings; derivatives of elements alone
    std::vector<double> coupled_q;           // (s, n, n) dF/dq of the couplings, if there are such forces
    std::vector<double> coupled_v;           // (s, n, n) dF/dv

    // Solve the step equation from the guess in V.
    //
    // The first factorization is kept at least until a second correction shows how fast it contracts, and for as long
    // as three more would do. Gives up when a correction exceeds half of the one before (natural monotonicity,
    // Deuflhard 2004), unless the residual is down at its rounding floor. A last correction is not looked at again if
    // that contraction takes the residual below a tenth of the tolerance: slopes are then corrected to first order.
    // Where `jets_wanted`, it ends with the jets of the root.
    Outcome solve(double h, const Start& start, double tolerance, bool jets_wanted, Effort& effort) {
        double before = infinity, worst = infinity;
        bool fresh = true;
        for (int iteration = 0; iteration < most_corrections + 2; ++iteration) {
            sweep(h, start, fresh, effort);
            worst = residuals(h, start);
            if (worst <= tolerance) {
                if (fresh || !jets_wanted) break;
                fresh = true;
                continue;
            }
            if (!(worst < infinity)) return Outcome::not_finite;
            if (fresh && !factor(h)) return Outcome::fold;
            solve_factored(residual.data(), delta.data());
            const double size = kinetic_size(delta.data());
            if (iteration >= most_corrections) break;
            if (!(size <= 0.25 * before)) {
                // The factors may be to blame, if they are of another iterate.
                if (fresh) break;
                fresh = true;
                continue;
            }
            for (int k = 0; k < stages * n; ++k) V[k] += delta[k];
            ++effort.newton_iterations;
            fresh = false;
            if (before < infinity) {
                const double contraction = std::sqrt(size / before);
                if (sure * contraction * worst <= tolerance && !jets_wanted) {
                    correct_slopes(h);
                    worst *= contraction;
                    break;
                }
                fresh = !(worst * contraction * contraction * contraction <= tolerance);
            }
            before = size;
        }
        if (!(worst <= std::max(stagnation, tolerance))) return Outcome::diverged;
        if (jets_wanted && eliminated()) write_jets();
        effort.residual = std::max(effort.residual, worst);
        return Outcome::solved;
    }

    bool eliminated() const { return elimination || stage_elimination; }

    // Factor N from the stages' jets; false where its determinant is not positive.
    bool factor(double h) {
        if (!eliminated()) return factor_blocks(h);
        write_diagonal(h);
        if (stage_elimination) return stage_elimination->factor(h, diagonal.data());
        return elimination->factor(h * tableau.a[0], h * tableau.gradient[0], diagonal.data());
    }

    // What the elements add to the pivot of coordinate c: -(by_rate F_v + by_place F_q) averaged over the step, and
    // where no jet has the curvature of their potentials, that with F_q.
    double stiffening(int c, double by_rate, double by_place) const {
        if (!mechanism.forces.any()) return 0.0;
        double total = 0.0;
        for (int i = 0; i < stages; ++i) {
            const JointForce<double>& own = acting[i * n + c];
            const double in_place = own.by_q + (eliminated() ? element_curvature[i * n + c] : 0.0);
            total -= tableau.b[i] * (by_rate * own.by_v + by_place * in_place);
        }
        return total;
    }

    bool coupled() const { return !coupled_q.empty(); }

    // The same of couplings at an entry of the symmetric part.
    [[gnu::noinline]] double coupled_stiffening(int r, int c, double by_rate, double by_place) const {
        double total = 0.0;
        for (int i = 0; i < stages; ++i) {
            const int one = (i * n + r) * n + c, other = (i * n + c) * n + r;
            total -= 0.5 * tableau.b[i] *
                     (by_rate * (coupled_v[one] + coupled_v[other]) + by_place * (coupled_q[one] + coupled_q[other]));
        }
        return total;
    }

    // The same of the matrices in the stages' jets.
    bool factor_blocks(double h) {
        double* matrix = lu.data();
        int* rows = order.data();
        for (const Block& block : mechanism.tree.blocks) {
            const int size = stages * (block.end - block.begin);
            assemble(h, block, matrix);
            if (stages == 1) {
                // The symmetric part is positive definite on the branch sought.
                if (!factor_lu(matrix, size, {0, size})) return false;
            } else if (factor_lu_pivoting(matrix, size, rows) <= 0) {
                return false;
            }
            matrix += size * size;
            rows += size;
        }
        return true;
    }

    // Derivatives at the root, from the jets of its stages: dV (s, n, 3n), and of (q1, p1), all in (q0, p0, f); Jx is
    // (2n, 2n), Jf (2n, n). Blocks alone are written into dV.
    void derivatives(double h, std::vector<double>& dV, double* Jx, double* Jf) {
        if (eliminated_columns) return eliminate_derivatives(h, dV, Jx, Jf);
        const auto& blocks = mechanism.tree.blocks;
        if (blocks.size() > 1) {
            std::fill(Jx, Jx + 4 * n * n, 0.0);
            std::fill(Jf, Jf + 2 * n * n, 0.0);
        }
        factor_blocks(h);
        const double* matrix = lu.data();
        const int* rows = order.data();
        for (const Block& block : blocks) {
            const int width = block.end - block.begin, size = stages * width;
            right_sides(h, block, dV);
            solve_columns(matrix, rows, block, dV);
            end_derivatives(h, block, dV, Jx, Jf);
            matrix += size * size;
            rows += size;
        }
    }

    // x with N x = right (s, n), from what `factor` left.
    void solve_factored(const double* right, double* x) {
        if (elimination) return elimination->solve(right, x);
        if (stage_elimination) return stage_elimination->solve(right, x);
        solve_blocks(right, x, [this](const double* matrix, int size, const int* rows, double* b, double* y) {
            if (stages == 1) {
                solve_lu(matrix, size, {0, size}, b, y);
            } else {
                solve_lu_pivoting(matrix, size, rows, b, y);
            }
        });
    }

    // x with N' x = right, after `derivatives`.
    void solve_transposed(double h, const double* right, double* x) {
        if (eliminated_columns) factor_blocks(h);
        solve_blocks(right, x, [this](const double* matrix, int size, const int* rows, double* b, double* y) {
            solve_lu_transposed(matrix, size, stages == 1 ? nullptr : rows, b, y);
        });
    }

  private:
    template <class Solve>
    void solve_blocks(const double* right, double* x, const Solve& solve_block) {
        const double* matrix = lu.data();
        const int* rows = order.data();
        for (const Block& block : mechanism.tree.blocks) {
            const int width = block.end - block.begin, size = stages * width;
            double *b = local.data(), *y = b + size;
            for (int i = 0; i < stages; ++i)
                std::copy(right + i * n + block.begin, right + i * n + block.end, b + i * width);
            solve_block(matrix, size, rows, b, y);
            for (int i = 0; i < stages; ++i) std::copy(y + i * width, y + (i + 1) * width, x + i * n + block.begin);
            matrix += size * size;
            rows += size;
        }
    }

    static constexpr int most_corrections = 10;
    // Columns of a block that are solved for at once with its matrix rather than one by one by elimination. Measured.
    static constexpr int few_columns = 45;
    // In rounding units: a residual below may stagnate; without rounding's own scatter it would be 1.
    static constexpr double stagnation = 100.0;
    // A residual that is expected this far below the tolerance need not be looked at.
    static constexpr double sure = 10.0;

    std::vector<double> residual, delta;  // (s, n)
    std::vector<double> lu;               // the factors of each block, one after another
    std::vector<int> order;               // of their rows
    std::vector<double> change, local, columns, shift;
    bool eliminated_columns = false;        // of derivatives
    std::vector<double> element_curvature;  // (s, n) of the elements' potentials, where there is an elimination
    std::vector<double> diagonal;           // (s, s, n) of N, besides what elimination takes from the bodies

    // For matrices and their factors.
    void make_room() {
        int size = 0, largest = 0;
        for (const Block& block : mechanism.tree.blocks) {
            const int own = stages * (block.end - block.begin);
            size = entries(1, std::int64_t{size} + entries(own, own));
            largest = std::max(largest, own);
        }
        for (Jet<double>& jet : stage) jet.make_room();
        lu.resize(size);
        order.resize(stages * n);
        change.resize(stages * largest);
        local.resize(2 * largest);
    }

    // Matrices too at an iterate that elimination had no need of them for.
    void write_jets() {
        if (lu.empty()) make_room();
        for (int i = 0; i < stages; ++i) lagrangian_jet(mechanism, &Q[i * n], &V[i * n], stage[i]);
        take_over();
    }

    void take_over() {
        if (elimination) elimination->take(stage[0]);
        if (!stage_elimination) return;
        for (int i = 0; i < stages; ++i) stage_elimination->take(i, stage[i]);
    }

    [[gnu::always_inline]] inline void move_stages(const int stages, double h, const Start& start) {
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) {
                double total = 0.0;
                for (int j = 0; j < stages; ++j) total += tableau.a[i * stages + j] * V[j * n + c];
                Q[i * n + c] = start.place[c].place.high + (start.place[c].place.low + h * total);
            }
        }
    }

    void sweep(double h, const Start& start, bool second, Effort& effort) {
        stages == 1 ? move_stages(1, h, start) : move_stages(stages, h, start);
        for (int i = 0; i < stages; ++i) {
            if (second && !eliminated()) {
                lagrangian_jet(mechanism, &Q[i * n], &V[i * n], stage[i]);
            } else {
                first_order(mechanism, &Q[i * n], &V[i * n], stage[i]);
            }
        }
        if (second) take_over();
        if (mechanism.pushes()) look_at_elements(start.force);
        (second ? effort.jets : effort.sweeps) += stages;
    }

    void look_at_elements(const double* force) {
        for (int i = 0; i < stages; ++i) {
            double* const by_q = coupled() ? &coupled_q[i * n * n] : nullptr;
            double* const by_v = coupled() ? &coupled_v[i * n * n] : nullptr;
            sum_forces(mechanism, &Q[i * n], &V[i * n], force, &acting[i * n], stage[i].couplings, by_q, by_v);
        }
        if (!eliminated()) return;
        std::fill(element_curvature.begin(), element_curvature.end(), 0.0);
        for (int i = 0; i < stages; ++i) {
            double* own = &element_curvature[i * n];
            mechanism.forces.potentials(
                &Q[i * n], [own](int c, const Potential<double>& element) { own[c] += element.curvature; });
        }
    }

    // What the elements add to N_im of coordinate c: by F, and where `potentials` are not in jets, by those too.
    double element_entry(double h, int i, int m, int c, bool potentials) const {
        double by_place = 0.0;
        for (int j = 0; j < stages; ++j) {
            double share = tableau.force[i * stages + j] * acting[j * n + c].by_q;
            if (potentials) share += tableau.gradient[i * stages + j] * element_curvature[j * n + c];
            by_place += tableau.a[j * stages + m] * share;
        }
        return -h * tableau.force[i * stages + m] * acting[m * n + c].by_v - h * h * by_place;
    }

    void write_diagonal(double h) {
        const bool elements = mechanism.forces.any();
        for (int i = 0; i < stages; ++i) {
            for (int m = 0; m < stages; ++m) {
                for (int c = 0; c < n; ++c) {
                    double entry = i == m ? mechanism.tree.armature[c] : 0.0;
                    if (elements) entry += element_entry(h, i, m, c, true);
                    diagonal[(i * stages + m) * n + c] = entry;
                }
            }
        }
    }

    // r(V); returns its largest entry in rounding units of its terms.
    double residuals(double h, const Start& start) {
        return stages == 1 ? residuals_of(1, h, start) : residuals_of(stages, h, start);
    }

    // Here and elsewhere, loops over stages whose number the compiler knows to be one are none.
    [[gnu::always_inline]] inline double residuals_of(const int stages, double h, const Start& start) {
        double worst = 0.0;
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) slope[i * n + c] = stage[i].Lq[c] + (start.force[c] + acting[i * n + c].value);
        }
        for (int i = 0; i < stages; ++i) {
            const double* abar = &tableau.gradient[i * stages];
            const double* f = &tableau.force[i * stages];
            for (int c = 0; c < n; ++c) {
                double total = 0.0, scale = 0.0;
                for (int j = 0; j < stages; ++j) {
                    const JointForce<double>& element = acting[j * n + c];
                    total += abar[j] * stage[j].Lq[c] + f[j] * (start.force[c] + element.value);
                    scale += std::abs(abar[j]) * stage[j].Lq_scale[c] +
                             std::abs(f[j]) * (std::abs(start.force[c]) + element.scale);
                }
                double error = (start.p[c].high - stage[i].Lv[c]) + (start.p[c].low + h * total);
                residual[i * n + c] = error;
                scale = h * scale + std::abs(start.p[c].high) + stage[i].Lv_scale[c];
                if (scale > nothing) error = std::abs(error) / (rounding_unit * scale);
                if (!(error <= worst)) worst = error;  // NaN ends up in worst
            }
        }
        return worst;
    }

    // The block's part of N, (s width, s width).
    void assemble(double h, Block block, double* matrix) {
        if (stages == 1) return assemble_one(h, block, matrix);
        const int width = block.end - block.begin, size = stages * width;
        std::fill(matrix, matrix + size * size, 0.0);
        // Row r of slope j's derivative in all of V, of which the rows of N take their share in one long loop.
        for (int r = 0; r < width; ++r) {
            const int row = block.begin + r;
            for (int j = 0; j < stages; ++j) {
                double* own = &change[j * size];
                for (int m = 0; m < stages; ++m) {
                    const double factor = h * tableau.a[j * stages + m];
                    const double* curvature = &stage[j].Lqq[row * n + block.begin];
                    for (int c = 0; c < width; ++c) own[m * width + c] = factor * curvature[c];
                }
                for (int c = 0; c < width; ++c) own[j * width + c] += stage[j].A[(block.begin + c) * n + row];
            }
            for (int i = 0; i < stages; ++i) {
                double* __restrict line = matrix + (i * width + r) * size;
                for (int j = 0; j < stages; ++j) {
                    const double factor = h * tableau.gradient[i * stages + j];
                    const double* __restrict own = &change[j * size];
                    for (int k = 0; k < size; ++k) line[k] -= factor * own[k];
                }
                for (int j = 0; j < stages; ++j) {
                    const double factor = h * tableau.a[i * stages + j];
                    const double* A = &stage[i].A[row * n + block.begin];
                    for (int c = 0; c < width; ++c) line[j * width + c] += factor * A[c];
                    if (mechanism.forces.any()) line[j * width + r] += element_entry(h, i, j, row, false);
                    if (coupled()) add_coupled_row(h, i, j, row, block, line + j * width);
                }
                const double* M = &stage[i].M[row * n + block.begin];
                for (int c = 0; c < width; ++c) line[i * width + c] += M[c];
            }
        }
    }

    // The same of a single stage, which asks for no sums over stages.
    void assemble_one(double h, Block block, double* matrix) const {
        const double ahead = h * tableau.a[0], behind = h * tableau.gradient[0];
        const double *M = stage[0].M.data(), *A = stage[0].A.data(), *Lqq = stage[0].Lqq.data();
        const bool elements = mechanism.forces.any();
        for (int r = block.begin; r < block.end; ++r) {
            const int row = r * n;
            double* line = matrix + (r - block.begin) * (block.end - block.begin) - block.begin;
            for (int c = block.begin; c < block.end; ++c) {
                line[c] = ahead * A[row + c] - behind * (ahead * Lqq[row + c] + A[c * n + r]);
            }
            if (elements) line[r] += element_entry(h, 0, 0, r, false);
            if (coupled()) add_coupled_row(h, 0, 0, r, block, line + block.begin);
            for (int c = block.begin; c < block.end; ++c) line[c] += M[row + c];
        }
    }

    // What the couplings' forces add to a row of N_im. Inlined it would slow down steps without any.
    [[gnu::noinline]] void add_coupled_row(double h, int i, int m, int row, Block block, double* line) const {
        const int width = block.end - block.begin;
        const double by_rate = h * tableau.force[i * stages + m];
        const double* own = &coupled_v[(m * n + row) * n + block.begin];
        for (int c = 0; c < width; ++c) line[c] -= by_rate * own[c];
        for (int j = 0; j < stages; ++j) {
            const double by_place = h * h * tableau.a[j * stages + m] * tableau.force[i * stages + j];
            own = &coupled_q[(j * n + row) * n + block.begin];
            for (int c = 0; c < width; ++c) line[c] -= by_place * own[c];
        }
    }

    // The square of x (s, n) in the metric of the kinetic energy, averaged over the step.
    double kinetic_size(const double* x) {
        if (elimination) return elimination->kinetic_size(x);
        if (stage_elimination) return stage_elimination->kinetic_size(x);
        double total = 0.0;
        for (int i = 0; i < stages; ++i) {
            for (const Block& block : mechanism.tree.blocks)
                total += tableau.b[i] * quadratic_form(stage[i].M.data(), n, block, x + i * n);
        }
        return total;
    }

    // (A_i' + F_v,i) x_i + (L_qq,i + F_q,i) h sum_j a_ij x_j into `change`, of the x in `delta` that elimination has
    // solved for.
    void change_of_slope(double h, std::vector<double>& change) {
        if (elimination) {
            elimination->change_of_slope(delta.data(), change.data());
        } else {
            stage_elimination->change_of_slope(delta.data(), change.data());
        }
        if (!mechanism.forces.any()) return;
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) {
                double moved = 0.0;
                for (int j = 0; j < stages; ++j) moved += tableau.a[i * stages + j] * delta[j * n + c];
                const int k = i * n + c;
                change[k] += acting[k].by_v * delta[k] + h * (element_curvature[k] + acting[k].by_q) * moved;
            }
        }
    }

    // `derivatives` column by column.
    void eliminate_derivatives(double h, std::vector<double>& dV, double* Jx, double* Jf) {
        factor(h);
        columns.resize(stages * n);
        for (int k = 0; k < n; ++k) {
            for (int kind = 0; kind < 3; ++kind) {
                // With one stage the force acts in proportion to the momentum, whose column has just been solved for.
                const double scale = stages == 1 && kind == 2 ? h * tableau.force[0] * (1.0 + acting[k].by_f) : 1.0;
                if (stages > 1 || kind < 2) {
                    right_side(h, kind, k);
                    solve_factored(residual.data(), delta.data());
                    change_of_slope(h, columns);
                }
                double* out = kind == 2 ? Jf + k : Jx + kind * n + k;
                const int stride = kind == 2 ? n : 2 * n;
                for (int r = 0; r < n; ++r) {
                    double q = 0.0, p = 0.0;
                    for (int i = 0; i < stages; ++i) {
                        dV[(i * n + r) * 3 * n + kind * n + k] = scale * delta[i * n + r];
                        q += tableau.b[i] * delta[i * n + r];
                        p += tableau.b[i] * columns[i * n + r];
                        if (kind == 0) p += tableau.b[i] * stage[i].Lqq[k * n + r];
                        if (kind == 0 && r == k) p += tableau.b[i] * acting[i * n + k].by_q;
                    }
                    out[r * stride] = h * scale * q;
                    out[(n + r) * stride] = h * scale * p;
                }
                if (kind == 0) out[k * stride] += 1.0;
                if (kind > 0) out[(n + k) * stride] += kind == 1 ? 1.0 : h * passed(k);
            }
        }
    }

    // Into `residual` dr in one of q0, p0 or f: h sum_j (abar_ij L_qq,j + f_ij F_q,j) - A_i, 1, or h sum_j f_ij F_f,j.
    void right_side(double h, int kind, int k) {
        std::fill(residual.begin(), residual.end(), 0.0);
        for (int i = 0; i < stages; ++i) {
            double* b = &residual[i * n];
            double share = 0.0;
            for (int j = 0; j < stages; ++j) {
                share += tableau.force[i * stages + j];
                if (kind > 0) continue;
                const double* curvature = &stage[j].Lqq[k * n];
                for (int r = 0; r < n; ++r) b[r] += h * tableau.gradient[i * stages + j] * curvature[r];
                b[k] += h * tableau.force[i * stages + j] * acting[j * n + k].by_q;
            }
            if (kind == 0) {
                for (int r = 0; r < n; ++r) b[r] -= stage[i].A[r * n + k];
            } else {
                b[k] = kind == 1 ? 1.0 : h * share;
                if (kind == 2) b[k] += h * changed(i, k);
            }
        }
    }

    // sum_j f_ij (F_f,j - 1): what elements make of a constant force in r_i.
    double changed(int i, int c) const {
        double total = 0.0;
        for (int j = 0; j < stages; ++j) total += tableau.force[i * stages + j] * acting[j * n + c].by_f;
        return total;
    }
    // sum_j b_j F_f,j: what of it arrives at the end.
    double passed(int c) const {
        double total = 1.0;
        for (int j = 0; j < stages; ++j) total += tableau.b[j] * acting[j * n + c].by_f;
        return total;
    }

    // Bring L_q + F to where the correction in `delta` has taken the stages, to first order in it.
    void correct_slopes(double h) {
        std::vector<double>& moved = residual;
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) {
                double total = 0.0;
                for (int j = 0; j < stages; ++j) total += tableau.a[i * stages + j] * delta[j * n + c];
                moved[i * n + c] = h * total;
            }
        }
        if (mechanism.forces.any()) {
            for (int k = 0; k < stages * n; ++k)
                acting[k].value += acting[k].by_v * delta[k] + acting[k].by_q * moved[k];
        }
        for (int k = 0; k < stages * n && coupled(); ++k) {
            const double *own_q = &coupled_q[k * n], *own_v = &coupled_v[k * n];
            const int first = k - k % n;
            double total = 0.0;
            for (int c = 0; c < n; ++c) total += own_v[c] * delta[first + c] + own_q[c] * moved[first + c];
            acting[k].value += total;
            slope[k] += total;
        }
        if (eliminated()) {
            change_of_slope(h, moved);
            for (int k = 0; k < stages * n; ++k) slope[k] += moved[k];
            return;
        }
        for (int i = 0; i < stages; ++i) {
            for (const Block& block : mechanism.tree.blocks) {
                for (int r = block.begin; r < block.end; ++r) {
                    const JointForce<double>& element = acting[i * n + r];
                    double total = element.by_v * delta[i * n + r] + element.by_q * moved[i * n + r];
                    for (int c = block.begin; c < block.end; ++c)
                        total += stage[i].Lqq[r * n + c] * moved[i * n + c] + stage[i].A[c * n + r] * delta[i * n + c];
                    slope[i * n + r] += total;
                }
            }
        }
    }

    // dr_i in (q0, p0, f): h sum_j (abar_ij L_qq,j + f_ij F_q,j) - A_i, 1, and h sum_j f_ij F_f,j.
    void right_sides(double h, Block block, std::vector<double>& dV) const {
        for (int i = 0; i < stages; ++i) {
            double share = 0.0;
            for (int j = 0; j < stages; ++j) share += tableau.force[i * stages + j];
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
                    row[2 * n + c] = r == c ? h * (share + changed(i, r)) : 0.0;
                }
            }
        }
    }

    // N dV = dr in place, whole rows at a time.
    void solve_columns(const double* matrix, const int* rows, Block block, std::vector<double>& dV) {
        const int width = block.end - block.begin, size = stages * width;
        columns.resize(entries(size, 3 * width));
        // Row k of the block's own system, which stands at (stage, coordinate) in dV.
        const auto line = [&](int k) { return &dV[((k / width) * n + block.begin + k % width) * 3 * n]; };
        for (int k = 0; k < size; ++k) {
            const double* from = line(stages == 1 ? k : rows[k]);
            for (int kind = 0; kind < 3; ++kind)
                std::copy(from + kind * n + block.begin, from + kind * n + block.end, &columns[(k * 3 + kind) * width]);
        }
        solve_lu_rows(matrix, size, {0, size}, columns.data(), 3 * width, 3 * width);
        for (int k = 0; k < size; ++k) {
            double* to = line(k);
            for (int kind = 0; kind < 3; ++kind)
                std::copy_n(&columns[(k * 3 + kind) * width], width, to + kind * n + block.begin);
        }
    }

    // dq1 = dq0 + h sum_i b_i dV_i,  dp1 = dp0 + h sum_i b_i ((L_qq,i + F_q,i) dQ_i + (A_i' + F_v,i) dV_i + F_f,i df).
    void end_derivatives(double h, Block block, const std::vector<double>& dV, double* Jx, double* Jf) {
        const int width = block.end - block.begin;
        shift.resize(entries(width, 3 * width));
        const auto entry = [&](int r, int kind, int c) -> double& {
            return kind == 2 ? Jf[r * n + c] : Jx[r * 2 * n + kind * n + c];
        };
        for (int r = block.begin; r < block.end; ++r) {
            for (int kind = 0; kind < 3; ++kind) {
                for (int c = block.begin; c < block.end; ++c) {
                    double total = 0.0;
                    for (int i = 0; i < stages; ++i) total += tableau.b[i] * dV[(i * n + r) * 3 * n + kind * n + c];
                    entry(r, kind, c) = h * total + (kind == 0 && r == c ? 1.0 : 0.0);
                    entry(n + r, kind, c) = r != c ? 0.0 : kind == 1 ? 1.0 : kind == 2 ? h * passed(r) : 0.0;
                }
            }
        }
        for (int i = 0; i < stages; ++i) {
            for (int r = 0; r < width; ++r) {
                for (int kind = 0; kind < 3; ++kind) {
                    double* row = &shift[(r * 3 + kind) * width];
                    for (int c = 0; c < width; ++c) row[c] = kind == 0 && r == c ? 1.0 : 0.0;
                    for (int j = 0; j < stages; ++j) {
                        const double factor = h * tableau.a[i * stages + j];
                        const double* from = &dV[(j * n + block.begin + r) * 3 * n + kind * n + block.begin];
                        for (int c = 0; c < width; ++c) row[c] += factor * from[c];
                    }
                }
            }
            const double weight = h * tableau.b[i];
            for (int r = block.begin; r < block.end; ++r) {
                for (int m = block.begin; m < block.end; ++m) {
                    const JointForce<double> own = m == r ? acting[i * n + r] : JointForce<double>{};
                    double curvature = weight * (stage[i].Lqq[r * n + m] + own.by_q);
                    double coupling = weight * (stage[i].A[m * n + r] + own.by_v);
                    if (coupled()) {
                        curvature += weight * coupled_q[(i * n + r) * n + m];
                        coupling += weight * coupled_v[(i * n + r) * n + m];
                    }
                    for (int kind = 0; kind < 3; ++kind) {
                        const double* __restrict dQ = &shift[((m - block.begin) * 3 + kind) * width];
                        const double* __restrict dv = &dV[(i * n + m) * 3 * n + kind * n + block.begin];
                        double* __restrict out = &entry(n + r, kind, block.begin);
                        for (int c = 0; c < width; ++c) out[c] += curvature * dQ[c] + coupling * dv[c];
                    }
                }
            }
        }
    }
};

}  // namespace varpin
