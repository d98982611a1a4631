// The forced discrete Euler-Lagrange equations of a collocation step: their residual r (`residuals_of`), Newton's
// matrix N (`assemble`) and iteration (`solve`). docs/mathematics.md, "Solving a step" and "Higher order"; equations
// (D3), (D4), (S1), (C1) and (C3), (1.8) and (1.9) of the paper. step_equation.hpp has the derivatives of a step,
// constrained.hpp steps with constraints. The unknowns are the stage velocities V_i (tableau.hpp). With F = f + the
// forces of elements, whose derivatives are diagonal, and of couplings, whose F_q and F_v are full in their blocks,
//
//     r_i(V) = p0 + h sum_j (abar_ij L_q + f_ij F)(Q_j, V_j) - L_v(Q_i, V_i) = 0
//     N_im = -dr_i/dV_m = delta_im M_i + h (a_im A_i - abar_im A_m' - f_im F_v,m)
//                         - h^2 sum_j a_jm (abar_ij L_qq,j + f_ij F_q,j)
//
// N is block-diagonal, with one matrix for each block of the tree; elimination needs none of them.
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
#include "varpin/kernels.hpp"
#include "varpin/nodes.hpp"
#include "varpin/tableau.hpp"

namespace varpin {

inline constexpr double infinity = std::numeric_limits<double>::infinity();
inline constexpr double rounding_unit = std::numeric_limits<double>::epsilon();
// Numbers below this count as zero, since their squares and products with the rounding unit underflow.
inline constexpr double nothing = 1e-290;

// Solver statistics of a step.
struct Effort {
    std::int64_t newton_iterations = 0;
    std::int64_t jets = 0;
    std::int64_t sweeps = 0;  // of first order
    std::int64_t substeps = 0;
    double residual = 0.0;  // the largest, in rounding units of its cancelling terms
    double branch_margin = infinity;
};

// The start of a step.
struct Start {
    const Coordinate* position = nullptr;  // (n)
    const Compensated* p = nullptr;        // (n)
    const double* force = nullptr;         // (n) of controls and drift of noise, or (s, n) at the stages
    int stride = 0;                        // distance of rows; 0 for a constant force
    const double* external = nullptr;      // (n) another constant force, which drives do not limit; null for none

    const double* force_at(int stage) const { return force + stage * stride; }
};

// The step equation: (D3) with the forces (D4), the paper's (1.8) and (1.9).
class Collocation {
  public:
    Collocation(const Mechanism& mechanism, const Tableau& tableau, bool dense, const Kernels& kernels = kernels_for<>)
        : mechanism(mechanism),
          tableau(tableau),
          kernels(kernels),
          n(mechanism.dof()),
          stages(tableau.stages),
          stage(stages, Jet<double>(mechanism.tree, false)),
          acting(stages * n) {
        for (Jet<double>& jet : stage) mechanism.couplings.fit(jet.couplings);
        measure_turning();
        if (mechanism.couplings.pushes()) {
            coupled_q.resize(entries(stages * n, n));
            coupled_v.resize(stages * n * n);
        }
        // Couplings fill entries of the matrix for which elimination has no form.
        if (dense || stages > 1 || mechanism.couplings.any() || !eliminates(mechanism.tree)) {
            allocate();
            return;
        }
        element_curvature.resize(n);
        diagonal.resize(n);
        elimination.emplace(mechanism, tableau);
    }

    const Mechanism& mechanism;
    const Tableau& tableau;
    const Kernels& kernels;
    int n;
    int stages;
    std::vector<Jet<double>> stage;              // without matrices if there is an elimination
    std::optional<StepElimination> elimination;  // of one stage, at the iterate of the last factors
    std::vector<double> V = zeros(stages, n);    // stage velocities: the guess, then the root
    std::vector<double> Q = zeros(stages, n);
    std::vector<double> force_sum = zeros(stages, n);   // L_q + F
    std::vector<double> force_rest = zeros(stages, n);  // of correct_forces; less than the last digit of `force_sum`
    std::vector<JointForce<double>> acting;  // (s, n) of elements and couplings; derivatives of elements only
    std::vector<double> coupled_q;           // (s, n, n) dF/dq of couplings, if there are such forces
    std::vector<double> coupled_v;           // (s, n, n) dF/dv
    bool by_external = false;                // whether derivatives in f are those in the external force

    // Solve the step equation from the guess in V.
    //
    // The first factorization is kept until a second correction shows its contraction, and for as long as three more
    // corrections would suffice. The iteration fails when a correction exceeds half of the one before (natural
    // monotonicity, Deuflhard 2004), unless the residual is at its rounding floor. The residual after the last
    // correction is not evaluated if its estimate is below a tenth of the tolerance; `force_rest` then corrects
    // `force_sum` to first order. The estimate follows from the contraction, or after a first correction from the
    // nonlinearity of the equation. A guess within the tolerance is corrected too: extrapolated guesses have a similar
    // error in every step, and energy would drift. With `jets_wanted`, the iteration ends with the jets at the root.
    //
    // Where drives come to their limits, the equation bends within a fraction of a correction. If the iteration fails
    // there, it begins again where shortened corrections have led.
    Outcome solve(double h, const Start& start, double tolerance, bool jets_wanted, Effort& effort) {
        if (!mechanism.forces.limits()) return iterate(h, start, tolerance, jets_wanted, effort);
        guess = V;
        Outcome outcome = iterate(h, start, tolerance, jets_wanted, effort);
        if (outcome == Outcome::diverged) V = guess;
        for (int again = 0; again < most_approaches && outcome == Outcome::diverged; ++again) {
            outcome = approach(h, start, effort);
            if (outcome != Outcome::solved) break;
            outcome = iterate(h, start, tolerance, jets_wanted, effort);
        }
        return outcome;
    }

    bool eliminated() const { return elimination.has_value(); }

    // Factor N from the stages' jets; false where its determinant is not positive.
    bool factor(double h) {
        if (!eliminated()) return factor_blocks(h);
        for (int c = 0; c < n; ++c) {
            diagonal[c] = mechanism.tree.armature[c];
            if (mechanism.forces.any()) diagonal[c] += element_entry(h, 0, 0, c, true);
        }
        return elimination->factor(h, diagonal.data());
    }

    // The contribution of elements to the pivot of coordinate c: -(by_rate F_v + by_position F_q) averaged over the
    // step. F_q includes the curvature of their potentials if the jets do not have it.
    double stiffening(int c, double by_rate, double by_position) const {
        if (!mechanism.forces.any()) return 0.0;
        double total = 0.0;
        for (int i = 0; i < stages; ++i) {
            const JointForce<double>& force = acting[i * n + c];
            const double by_own_q = force.by_q + (eliminated() ? element_curvature[c] : 0.0);
            total -= tableau.b[i] * (by_rate * force.by_v + by_position * by_own_q);
        }
        return total;
    }

    bool coupled() const { return !coupled_q.empty(); }

    // The contribution of couplings to an entry of the symmetric part.
    [[gnu::noinline]] double coupled_stiffening(int r, int c, double by_rate, double by_position) const {
        double total = 0.0;
        for (int i = 0; i < stages; ++i) {
            const int one = (i * n + r) * n + c, other = (i * n + c) * n + r;
            total -=
                0.5 * tableau.b[i] *
                (by_rate * (coupled_v[one] + coupled_v[other]) + by_position * (coupled_q[one] + coupled_q[other]));
        }
        return total;
    }

    // `factor` for the matrices in the stages' jets.
    bool factor_blocks(double h) {
        if (stages == 1) return (this->*kernels.factor)(h);
        double* matrix = lu.data();
        int* rows = order.data();
        for (const Block& block : blocks_of(mechanism.tree, n)) {
            const int size = stages * (block.end - block.begin);
            assemble(h, block, matrix);
            if (factor_lu_pivoting(matrix, size, rows) <= 0) return false;
            matrix += size * size;
            rows += size;
        }
        return true;
    }

    // x with N x = right (s, n), from the factors of `factor`.
    void solve_factored(const double* right, double* x) {
        if (eliminated()) return elimination->solve(right, x);
        if (stages == 1) return (this->*kernels.solve)(right, x);
        solve_blocks(right, x, [](const double* matrix, int size, const int* rows, double* b, double* y) {
            solve_lu_pivoting(matrix, size, rows, b, y);
        });
    }

  private:
    template <class>
    friend struct Sized;
    friend class StepEquation;        // adds its derivatives
    friend class ConstrainedStepper;  // adds rows and columns of constraints to the matrix

    template <class Solve>
    void solve_blocks(const double* right, double* x, const Solve& solve_block) {
        const double* matrix = lu.data();
        const int* rows = order.data();
        for (const Block& block : blocks_of(mechanism.tree, n)) {
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
    static constexpr bool bordered = false;
    // Of shortened corrections: how often they begin, how many there are each time, and how short they may be.
    static constexpr int most_approaches = 4;
    static constexpr int most_shortened = 40;
    static constexpr double least_share = 1.0 / 256.0;
    // Residuals below this may stagnate, in rounding units; without the scatter of rounding it would be 1.
    static constexpr double stagnation = 100.0;
    // A residual whose estimate is below the tolerance by this factor is not evaluated.
    static constexpr double sure = 10.0;
    // Safety factor of the estimate in left_by_bending; measured ratios of residual and estimate are below 1.
    static constexpr double bending = 10.0;

    std::vector<double> residual = zeros(stages, n), delta = zeros(stages, n);
    std::vector<double> guess, from, next = zeros(stages, n);  // of `approach`
    std::vector<double> lu;                                    // the factors of each block, one after another
    std::vector<int> order;                                    // permutation of their rows
    std::vector<double> change, local;
    std::vector<double> turning;  // (n) rotation of bodies per unit of a coordinate; infinite for a coordinate that
                                  // translates a body on a rotating one, where its product is NaN without motion
    std::vector<double> element_curvature;  // (n) of the elements' potentials, if there is an elimination
    std::vector<double> diagonal;           // (n) of N, without the contributions of bodies in an elimination

    // Whether a first iterate is improved though its residual is small: a guess may be as good as the tolerance.
    template <class Equation>
    static bool improves_first(double worst, bool jets_wanted) {
        return !Equation::bordered && !jets_wanted && worst > 0.0;
    }

    // Newton's method, as in `solve`, on this equation or on one that borders it with constraints: their impulses may
    // be far from the root where the velocities are not.
    template <class Equation>
    static Outcome newton(Equation& equation, double h, const Start& start, double tolerance, bool jets_wanted,
                          Effort& effort) {
        double before = infinity, worst = infinity, worst_before = infinity;
        bool fresh = true;
        for (int iteration = 0; iteration < Equation::most_corrections + 2; ++iteration) {
            worst = equation.evaluate(h, start, fresh, effort);
            if (worst <= tolerance && !(iteration == 0 && improves_first<Equation>(worst, jets_wanted))) {
                if (fresh || !jets_wanted) break;
                fresh = true;
                continue;
            }
            if (!(worst < infinity)) return Outcome::not_finite;
            if (iteration >= Equation::most_corrections) break;
            if (fresh && !equation.factor(h)) return Outcome::fold;
            const double size = equation.correct();
            if (!(size <= 0.25 * before) && !(Equation::bordered && worst <= 0.25 * worst_before)) {
                // The factors may be the cause, if they are from another iterate.
                if (fresh) break;
                fresh = true;
                continue;
            }
            equation.take_correction();
            ++effort.newton_iterations;
            worst_before = worst;
            // The factor by which corrections shrink.
            const double contraction = before < infinity ? std::sqrt(size / before) : infinity;
            if (!jets_wanted && equation.settles(h, start, fresh, contraction, tolerance, worst)) break;
            fresh = before < infinity && !(worst * contraction * contraction * contraction <= tolerance);
            before = size;
        }
        if (!(worst <= std::max(stagnation, tolerance))) return Outcome::diverged;
        effort.residual = std::max(effort.residual, worst);
        return Outcome::solved;
    }

    Outcome iterate(double h, const Start& start, double tolerance, bool jets_wanted, Effort& effort) {
        const Outcome outcome = newton(*this, h, start, tolerance, jets_wanted, effort);
        if (outcome == Outcome::solved && jets_wanted && eliminated()) write_jets();
        return outcome;
    }

    double evaluate(double h, const Start& start, bool fresh, Effort& effort) {
        sweep(h, start, fresh, effort);
        return residuals(h, start);
    }

    double correct() {
        solve_factored(residual.data(), delta.data());
        return kinetic_size(delta.data());
    }

    // Corrections with fresh factors, each shortened until the one after it, with the same factors, is smaller (natural
    // monotonicity test, Deuflhard 2004, section 3.3); until a whole one leaves a hundredth.
    Outcome approach(double h, const Start& start, Effort& effort) {
        double share = 1.0;
        for (int iteration = 0; iteration < most_shortened; ++iteration) {
            if (!(evaluate(h, start, true, effort) < infinity)) return Outcome::not_finite;
            if (!factor(h)) return Outcome::fold;
            const double size = correct();
            ++effort.newton_iterations;
            from = V;
            for (share = std::min(1.0, 4.0 * share);; share *= 0.5) {
                if (share < least_share) return Outcome::diverged;
                for (int k = 0; k < stages * n; ++k) V[k] = from[k] + share * delta[k];
                evaluate(h, start, false, effort);
                solve_factored(residual.data(), next.data());
                const double left = kinetic_size(next.data());
                if (share == 1.0 && left <= 1e-4 * size) return Outcome::solved;
                if (left <= (1.0 - 0.5 * share) * size) break;
            }
        }
        return Outcome::diverged;
    }

    void take_correction() {
        for (int k = 0; k < stages * n; ++k) V[k] += delta[k];
    }

    // Whether a correction needs no evaluation of the residual that it leaves, `worst` before it: by the nonlinearity
    // of the equation if its factors were `fresh`, or by the contraction. If so, `worst` becomes the estimate.
    bool settles(double h, const Start&, bool fresh, double contraction, double tolerance, double& worst) {
        const double left = fresh ? left_by_bending(h, worst) : infinity;
        if (fresh && (worst <= tolerance || sure * left <= tolerance)) {
            worst = std::min(worst, left);
        } else if (sure * contraction * worst <= tolerance) {
            worst *= contraction;
        } else {
            return false;
        }
        correct_forces(h);
        return true;
    }

    // Estimate of the residual, in rounding units, that second derivatives of r leave after the correction in `delta`
    // with fresh factors. Kinetic and potential energy are nonlinear in the angles of bodies: the estimate is the angle
    // times the change of momenta, plus the squared angle times the momenta. Infinite if forces are nonlinear too.
    double left_by_bending(double h, double before) const {
        if (!mechanism.forces.linear() || mechanism.couplings.any()) return infinity;
        double turn = 0.0;
        for (int c = 0; c < n; ++c) {
            double largest = 0.0;
            for (int i = 0; i < stages; ++i) largest = std::max(largest, std::abs(delta[i * n + c]));
            turn += turning[c] * largest;
        }
        turn *= h;
        return bending * turn * (before + turn / rounding_unit);
    }

    void measure_turning() {
        turning.assign(n, 0.0);
        for (const Body& link : mechanism.tree.bodies) {
            if (!link.prismatic) turning[link.coordinate] += std::abs(link.ratio);
            if (link.prismatic && !link.origin) turning[link.coordinate] = infinity;
        }
    }

    // Allocate matrices and their factors.
    void allocate() {
        int size = 0, largest = 0;
        for (const Block& block : blocks_of(mechanism.tree, n)) {
            const int unknowns = stages * (block.end - block.begin);
            size = entries(1, std::int64_t{size} + entries(unknowns, unknowns));
            largest = std::max(largest, unknowns);
        }
        for (Jet<double>& jet : stage) jet.allocate();
        lu.resize(size);
        order.resize(stages * n);
        change.resize(stages * largest);
        local.resize(2 * largest);
    }

    // Compute the matrices of the jets at an iterate of elimination, which does not need them.
    void write_jets() {
        if (lu.empty()) allocate();
        kernels.jet(mechanism, Q.data(), V.data(), stage[0]);
        elimination->take(stage[0]);
    }

    [[gnu::always_inline]] inline void move_stages(const int stages, double h, const Start& start) {
        for (int i = 0; i < stages; ++i) {
            for (int c = 0; c < n; ++c) {
                double total = 0.0;
                for (int j = 0; j < stages; ++j) total += tableau.a[i * stages + j] * V[j * n + c];
                Q[i * n + c] = start.position[c].value.high + (start.position[c].value.low + h * total);
            }
        }
    }

    void sweep(double h, const Start& start, bool second, Effort& effort) {
        stages == 1 ? move_stages(1, h, start) : move_stages(stages, h, start);
        for (int i = 0; i < stages; ++i) {
            if (second && !eliminated()) {
                kernels.jet(mechanism, &Q[i * n], &V[i * n], stage[i]);
            } else {
                kernels.first_order(mechanism, &Q[i * n], &V[i * n], stage[i]);
            }
        }
        if (second && eliminated()) elimination->take(stage[0]);
        if (mechanism.pushes()) find_forces(start);
        (second ? effort.jets : effort.sweeps) += stages;
    }

    void find_forces(const Start& start) {
        for (int i = 0; i < stages; ++i) {
            double* const by_q = coupled() ? &coupled_q[i * n * n] : nullptr;
            double* const by_v = coupled() ? &coupled_v[i * n * n] : nullptr;
            sum_forces(mechanism, &Q[i * n], &V[i * n], start.force_at(i), &acting[i * n], stage[i].couplings, by_q,
                       by_v);
            if (start.external || by_external) pass_drives(start, i);
        }
        if (!eliminated()) return;
        std::fill(element_curvature.begin(), element_curvature.end(), 0.0);
        mechanism.forces.potentials(
            Q.data(), [&](int c, const Potential<double>& element) { element_curvature[c] += element.curvature; });
    }

    // Add the external force to those of elements at stage i. Nothing but F itself depends on it.
    [[gnu::noinline]] void pass_drives(const Start& start, int i) {
        for (int c = 0; c < n; ++c) {
            JointForce<double>& element = acting[i * n + c];
            if (start.external) {
                element.value += start.external[c];
                element.scale += std::abs(start.external[c]);
            }
            if (by_external) element.by_f = 0.0;
        }
    }

    // The contribution of elements to N_im of coordinate c: of F and, with `potentials`, which elimination needs, of
    // their potentials.
    double element_entry(double h, int i, int m, int c, bool potentials = false) const {
        double by_position = 0.0;
        for (int j = 0; j < stages; ++j) {
            double share = tableau.force[i * stages + j] * acting[j * n + c].by_q;
            if (potentials) share += tableau.gradient[0] * element_curvature[c];
            by_position += tableau.a[j * stages + m] * share;
        }
        return -h * tableau.force[i * stages + m] * acting[m * n + c].by_v - h * h * by_position;
    }

    // r(V); returns its largest entry in rounding units of its terms.
    double residuals(double h, const Start& start) {
        return stages == 1 ? (this->*kernels.residuals)(h, start) : residuals_of<int, int>(h, start);
    }

    // The discrete Euler-Lagrange residual r_i(V) of each stage, (S1) and (C1), into `residual`; returns the largest in
    // rounding units.
    template <class Size, class Stages>
    double residuals_of(double h, const Start& start) {
        const Size n = this->n;
        const Stages stages = this->stages;
        double worst = 0.0;
        for (int i = 0; i < stages; ++i) {
            const double* force = start.force_at(i);
            for (int c = 0; c < n; ++c) {
                force_sum[i * n + c] = stage[i].Lq[c] + (force[c] + acting[i * n + c].value);
                force_rest[i * n + c] = 0.0;
            }
        }
        for (int i = 0; i < stages; ++i) {
            const double* abar = &tableau.gradient[i * stages];
            const double* f = &tableau.force[i * stages];
            for (int c = 0; c < n; ++c) {
                double total = 0.0, scale = 0.0;
                for (int j = 0; j < stages; ++j) {
                    const JointForce<double>& element = acting[j * n + c];
                    const double force = start.force_at(j)[c];
                    total += abar[j] * stage[j].Lq[c] + f[j] * (force + element.value);
                    scale +=
                        std::abs(abar[j]) * stage[j].Lq_scale[c] + std::abs(f[j]) * (std::abs(force) + element.scale);
                }
                double error = (start.p[c].high - stage[i].Lv[c]) + (start.p[c].low + h * total);
                residual[i * n + c] = error;
                scale = h * scale + std::abs(start.p[c].high) + stage[i].Lv_scale[c];
                if (scale > nothing) error = std::abs(error) / (rounding_unit * scale);
                worst = larger(error, worst);
            }
        }
        return worst;
    }

    // The block (s width, s width) of N, (C3).
    void assemble(double h, Block block, double* matrix) {
        if (stages == 1) return assemble_one<int>(h, block, matrix);
        const int width = block.end - block.begin, size = stages * width;
        std::fill(matrix, matrix + size * size, 0.0);
        // Row r of the derivative of L_q + F at stage j in all of V, added to the rows of N in one long loop.
        for (int r = 0; r < width; ++r) {
            const int row = block.begin + r;
            for (int j = 0; j < stages; ++j) {
                double* row_change = &change[j * size];
                for (int m = 0; m < stages; ++m) {
                    const double factor = h * tableau.a[j * stages + m];
                    const double* curvature = &stage[j].Lqq[row * n + block.begin];
                    for (int c = 0; c < width; ++c) row_change[m * width + c] = factor * curvature[c];
                }
                for (int c = 0; c < width; ++c) row_change[j * width + c] += stage[j].A[(block.begin + c) * n + row];
            }
            for (int i = 0; i < stages; ++i) {
                double* __restrict line = matrix + (i * width + r) * size;
                for (int j = 0; j < stages; ++j) {
                    const double factor = h * tableau.gradient[i * stages + j];
                    const double* __restrict row_change = &change[j * size];
                    for (int k = 0; k < size; ++k) line[k] -= factor * row_change[k];
                }
                for (int j = 0; j < stages; ++j) {
                    const double factor = h * tableau.a[i * stages + j];
                    const double* A = &stage[i].A[row * n + block.begin];
                    for (int c = 0; c < width; ++c) line[j * width + c] += factor * A[c];
                    if (mechanism.forces.any()) line[j * width + r] += element_entry(h, i, j, row);
                    if (coupled()) add_coupled_row(h, i, j, row, block, line + j * width);
                }
                const double* M = &stage[i].M[row * n + block.begin];
                for (int c = 0; c < width; ++c) line[i * width + c] += M[c];
            }
        }
    }

    // `assemble` for a single stage, without sums over stages.
    template <class Size>
    void assemble_one(double h, Block block, double* matrix) const {
        const Size n = this->n;
        const double ahead = h * tableau.a[0], behind = h * tableau.gradient[0];
        const double *M = stage[0].M.data(), *A = stage[0].A.data(), *Lqq = stage[0].Lqq.data();
        const bool elements = mechanism.forces.any();
        for (int r = block.begin; r < block.end; ++r) {
            const int row = r * n;
            double* line = matrix + (r - block.begin) * (block.end - block.begin) - block.begin;
            for (int c = block.begin; c < block.end; ++c) {
                line[c] = ahead * A[row + c] - behind * (ahead * Lqq[row + c] + A[c * n + r]);
            }
            if (elements) line[r] += element_entry(h, 0, 0, r);
            if (coupled()) add_coupled_row(h, 0, 0, r, block, line + block.begin);
            for (int c = block.begin; c < block.end; ++c) line[c] += M[row + c];
        }
    }

    // `factor` for a single stage. On the desired branch, the symmetric part of N is positive definite.
    template <class Size>
    bool factor_one(double h) {
        const Size n = this->n;
        double* matrix = lu.data();
        for (const Block& block : blocks_of(mechanism.tree, n)) {
            const int width = block.end - block.begin;
            assemble_one<Size>(h, block, matrix);
            if (!factor_lu(matrix, width, {0, width})) return false;
            matrix += width * width;
        }
        return true;
    }

    template <class Size>
    void solve_one(const double* right, double* x) const {
        const double* matrix = lu.data();
        for (const Block& block : blocks_of(mechanism.tree, Size(n))) {
            const int width = block.end - block.begin;
            solve_lu(matrix, width, {0, width}, right + block.begin, x + block.begin);
            matrix += width * width;
        }
    }

    template <class Size>
    double kinetic_size_of_one(const double* x) const {
        const Size n = this->n;
        double total = 0.0;
        for (const Block& block : blocks_of(mechanism.tree, n))
            total += tableau.b[0] * quadratic_form(stage[0].M.data(), n, block, x);
        return total;
    }

    // The contribution of couplings to a row of N_im. Not inlined, since that would slow down steps without couplings.
    [[gnu::noinline]] void add_coupled_row(double h, int i, int m, int row, Block block, double* line) const {
        const int width = block.end - block.begin;
        const double by_rate = h * tableau.force[i * stages + m];
        const double* coupled = &coupled_v[(m * n + row) * n + block.begin];
        for (int c = 0; c < width; ++c) line[c] -= by_rate * coupled[c];
        for (int j = 0; j < stages; ++j) {
            const double by_position = h * h * tableau.a[j * stages + m] * tableau.force[i * stages + j];
            coupled = &coupled_q[(j * n + row) * n + block.begin];
            for (int c = 0; c < width; ++c) line[c] -= by_position * coupled[c];
        }
    }

    // The square of x (s, n) in the metric of the kinetic energy, averaged over the step.
    double kinetic_size(const double* x) {
        if (eliminated()) return elimination->kinetic_size(x);
        if (stages == 1) return (this->*kernels.kinetic_size)(x);
        double total = 0.0;
        for (int i = 0; i < stages; ++i) {
            for (const Block& block : blocks_of(mechanism.tree, n))
                total += tableau.b[i] * quadratic_form(stage[i].M.data(), n, block, x + i * n);
        }
        return total;
    }

    // Correct L_q + F of the stages for the step `delta`, to first order, in `force_rest`. Rounding would take the
    // correction from a sum with `force_sum`; the errors of guesses have a similar sign in every step, and energy
    // drifts.
    void correct_forces(double h) {
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
            force_rest[k] += total;
        }
        if (eliminated()) {
            elimination->change_of_force(delta.data(), moved.data());
            for (int c = 0; c < n; ++c) {
                double total = moved[c];
                if (mechanism.forces.any()) {
                    const double slope = element_curvature[c] + acting[c].by_q;
                    total += acting[c].by_v * delta[c] + h * slope * (tableau.a[0] * delta[c]);
                }
                force_rest[c] += total;
            }
            return;
        }
        for (int i = 0; i < stages; ++i) {
            for (const Block& block : blocks_of(mechanism.tree, n)) {
                for (int r = block.begin; r < block.end; ++r) {
                    const JointForce<double>& element = acting[i * n + r];
                    double total = element.by_v * delta[i * n + r] + element.by_q * moved[i * n + r];
                    for (int c = block.begin; c < block.end; ++c)
                        total += stage[i].Lqq[r * n + c] * moved[i * n + c] + stage[i].A[c * n + r] * delta[i * n + c];
                    force_rest[i * n + r] += total;
                }
            }
        }
    }
};

}  // namespace varpin
