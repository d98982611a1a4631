// Conditions on accepted steps. docs/mathematics.md, "The principal branch"; equation (G1).
//
// The branch guard: the step equation has other roots than the one that is connected to h -> 0, where the symmetric
// part of N = -dr/dv is positive definite. The energy guard: |dE - work of the forces| over a substep must be a small
// part of the energy turned over, for each mechanically independent group. That balance does not resolve parts that
// ride on far heavier ones, so light parts have a balance of their own, of their Jacobi energy sum_i p_i v_i - L.
#pragma once

#include <algorithm>
#include <cmath>
#include <optional>
#include <vector>

#include "varpin/collocation.hpp"
#include "varpin/compensated.hpp"
#include "varpin/dense.hpp"
#include "varpin/elimination.hpp"
#include "varpin/jet.hpp"
#include "varpin/kernels.hpp"
#include "varpin/step_equation.hpp"

namespace varpin {

struct Guards {
    bool active = true;             // else every step whose equation is solved is accepted
    double branch_margin = 0.5;     // required distance of a root from the fold, in [0, 1)
    double energy_balance = 0.005;  // largest energy error of a substep, in units of the energy it turns over
    double energy_budget = 0.02;    // largest sum of errors, in units of the largest energy moved in a substep so far
    int most_halvings = 20;

    // Most halvings of a part that is repeated; none without guards.
    int halvings_again() const { return active ? most_halvings : 0; }
};

// The energy of one group at the last node.
struct Ledger {
    double kinetic = 0.0;
    double potential = 0.0;
    double defect = 0.0;  // sum of errors
    double most = 0.0;    // largest kinetic energy moved in a substep
};

// The share of a coordinate in the kinetic energy while the coordinates before it, or in its subtree if M is not
// formed, are free; its recent bounds.
struct Share {
    double now = 0.0;
    double least = 0.0;
    double largest = 0.0;
};

// The balance of a light part at a node; the carrier's L_q and L_v in all coordinates.
struct PartLedger {
    explicit PartLedger(int n) : Lq(n), Lv(n) {}

    double jacobi = 0.0;
    double potential = 0.0;
    double scale = 0.0;  // magnitude of their terms
    double defect = 0.0;
    double most = 0.0;
    std::vector<double> Lq, Lv;  // (n)
};

// Energies of a path at its last node.
struct Energies {
    explicit Energies(const Tree& tree)
        : group(tree.groups), share(tree.dof()), part(tree.light_parts.size(), PartLedger(tree.dof())) {}
    std::vector<Ledger> group;
    std::vector<Share> share;
    std::vector<PartLedger> part;

    double total() const {
        double sum = 0.0;
        for (const Ledger& ledger : group) sum += ledger.kinetic + ledger.potential;
        return sum;
    }
    double defect() const {
        double sum = 0.0;
        for (const Ledger& ledger : group) sum += std::abs(ledger.defect);
        return sum;
    }
};

// A node that a substep has reached.
struct Trial {
    explicit Trial(int n) : position(n), p(n), at(n), momentum(n), v(n), work(n), dissipated(n), magnitude(n) {}
    std::vector<Coordinate> position;
    std::vector<Compensated> p;
    std::vector<double> at, momentum;  // (n) rounded, for sweeps
    std::vector<double> v;             // (n) M^-1 p
    std::vector<double> work;          // (n) of the forces on each coordinate over the substep [J]
    std::vector<double> dissipated;    // (n) by friction [J]
    std::vector<double> magnitude;     // (n) sum of |work| of all terms of the force on each coordinate [J]
};

class EnergyGuard {
  public:
    EnergyGuard(const Mechanism& mechanism, bool dense, bool matrices, const Kernels& kernels = kernels_for<>)
        : mechanism(mechanism),
          kernels(kernels),
          n(mechanism.dof()),
          jet(mechanism.tree, false),
          part(Energies(mechanism.tree).part) {
        mechanism.couplings.fit(jet.couplings);
        if (!dense && eliminates(mechanism.tree)) {
            articulated.emplace(mechanism.tree);
        } else {
            jet.M.resize(entries(n, n));
            ldl.resize(n * n);
        }
        if (matrices) {
            curved.resize(entries(n, n));
            mass.resize(n * n);
        }
    }

    // v = M(q)^-1 p at a node, and the kinetic and potential energy there; false where M is not positive definite.
    // Leaves the factors of M.
    bool node(const double* q, const double* p, double* v) {
        if (!(articulated ? articulated->at(mechanism, q, jet) : factor(q))) return false;
        velocity(p, v);
        return true;
    }

    // Energies and the factors L D L' of M at q, in the lower triangles of blocks, if bodies are not articulated.
    bool factor(const double* q) { return (this->*kernels.factor_mass)(q); }
    const std::vector<double>& factors() const { return ldl; }

    // v = M^-1 p from the factors of `node`. The shares of the coordinates are the terms of the kinetic energy
    // 1/2 y' D^-1 y with L y = p, which are not negative.
    void velocity(const double* p, double* v) {
        std::fill(kinetic.begin(), kinetic.end(), 0.0);
        if (articulated) {
            articulated->solve(p, v, share.data());
        } else {
            (this->*kernels.velocity)(p, v);
        }
        for (int i = 0; i < n; ++i) kinetic[mechanism.tree.group[i]] += share[i];
    }

    // x = M^-1 b.
    void solve(const double* b, double* x) {
        if (articulated) return articulated->solve(b, x, nullptr);
        for (const Block& block : blocks_of(mechanism.tree, n)) solve_ldl(ldl.data(), n, block, b, x);
    }

    // Start at a node, without earlier errors.
    void begin(const double* q, const double* p, const double* v, Energies& energies) {
        for (int r = 0; r < mechanism.tree.groups; ++r) energies.group[r] = {kinetic[r], jet.potential[r], 0.0, 0.0};
        for (int i = 0; i < n; ++i) energies.share[i] = {share[i], share[i], share[i]};
        light_parts(q, p, v);
        for (std::size_t r = 0; r < part.size(); ++r) {
            part[r].defect = part[r].most = 0.0;
            energies.part[r] = part[r];
        }
    }

    // Update velocity and energy after a kick of the momentum, without an error.
    void kicked(const double* q, const double* p, double* v, Energies& energies) {
        velocity(p, v);
        find_turnover(energies);
        for (int r = 0; r < mechanism.tree.groups; ++r) {
            energies.group[r].kinetic = kinetic[r];
            energies.group[r].most = std::max(energies.group[r].most, turnover[r]);
        }
        update_shares(0.0, energies);
        light_parts(q, p, v);
        for (std::size_t r = 0; r < part.size(); ++r) {
            part[r].defect = energies.part[r].defect;
            part[r].most = energies.part[r].most;
            energies.part[r] = part[r];
        }
    }

    // The distance of the root from the fold where branches of solutions meet, (G1): 1 as h -> 0, <= 0 for a refused
    // root. It is the smallest ratio of a pivot of M - (h/2) dF/dv + h skew (A + A') - h^2 reach (L_qq + dF/dq) / (1 -
    // margin) to the same pivot of M, all averaged over the stages with b.
    double branch_margin(double h, const Guards& guards, Collocation& step) {
        const Tableau& tableau = step.tableau;
        const double exaggerated = h * h * tableau.reach / (1.0 - guards.branch_margin);
        if (step.eliminated()) {
            for (int i = 0; i < n; ++i)
                diagonal[i] = mechanism.tree.armature[i] + step.stiffening(i, 0.5 * h, exaggerated);
            const double coupling = h * tableau.skew;
            return step.elimination->least_pivot_ratio(coupling, exaggerated, diagonal.data());
        }
        if (step.stages == 1) return (this->*kernels.branch_margin)(h, guards, step);
        return branch_margin_of<int, int>(h, guards, step);
    }

    // Velocity and energy at the end of a substep, and whether its energy balance closes; if so, updates the ledgers.
    // `factored`: the factors of M at the end are known.
    Outcome accept(const Guards& guards, const Tableau& tableau, Energies& energies,
                   const std::vector<Coordinate>& from, const std::vector<double>& from_v, Trial& trial,
                   bool factored = false) {
        for (int i = 0; i < n; ++i) {
            trial.at[i] = trial.position[i].value.high;
            trial.momentum[i] = trial.p[i].high;
        }
        if (factored) {
            velocity(trial.momentum.data(), trial.v.data());
        } else if (!node(trial.at.data(), trial.momentum.data(), trial.v.data())) {
            return Outcome::singular;
        }
        find_turnover(energies);
        const Tree& tree = mechanism.tree;
        std::fill(work.begin(), work.end(), 0.0);
        std::fill(lost.begin(), lost.end(), 0.0);
        std::fill(magnitude.begin(), magnitude.end(), 0.0);
        for (int i = 0; i < n; ++i) {
            magnitude[tree.group[i]] += trial.magnitude[i];
            work[tree.group[i]] += trial.work[i];
            lost[tree.group[i]] += trial.dissipated[i];
        }
        // Methods of first order: Midpoint with another alpha, and Radau with one stage, which is alpha = 1.
        const double off_middle = tableau.stages == 1 && tableau.stiffly_accurate ? 1.0 : 2.0 * std::abs(tableau.skew);
        const Limit limit{guards.energy_balance * (1.0 + 9.0 * off_middle), guards.energy_budget};
        if (guards.active) {
            for (int r = 0; r < tree.groups; ++r) {
                if (!balanced(limit, off_middle, tableau.stiffly_accurate, energies.group[r], r))
                    return Outcome::energy;
            }
        }
        if (guards.active && !part.empty()) {
            light_parts(trial.at.data(), trial.momentum.data(), trial.v.data());
            for (std::size_t r = 0; r < part.size(); ++r) {
                if (!part_balanced(limit, energies, from, from_v, trial, r)) return Outcome::energy;
            }
            std::copy(part.begin(), part.end(), energies.part.begin());
        }
        for (int r = 0; r < tree.groups; ++r) update_ledger(energies.group[r], r);
        update_shares(fade, energies);
        return Outcome::solved;
    }

  private:
    template <class>
    friend struct Sized;
    static constexpr double fade = 1.0 / 256.0;     // decay per substep of the recorded variation of kinetic energies
    static constexpr double rounding = 1e-12;       // relative to the magnitudes of the terms of an energy or a work
    static constexpr double part_factor = 4.0;      // for light parts, because of the error of the trapezoidal rule
    static constexpr double least_fraction = 0.02;  // of the limit remains, or a full ledger would stop the motion

    struct Limit {
        double balance = 0.0;
        double budget = 0.0;

        // The largest error over a substep. For an error of the sign of `defect`, it decreases as the ledger fills.
        double of(double error, double defect, double turnover, double exchanged, double most) const {
            double limit = balance * (turnover + exchanged);
            if (std::abs(defect + error) > std::abs(defect)) {
                const double margin = budget * std::max({most, turnover, exchanged});
                if (margin > 0.0) limit *= std::max(least_fraction, 1.0 - std::abs(defect) / margin);
            }
            return limit;
        }
    };

    const Mechanism& mechanism;
    const Kernels& kernels;
    int n;
    Jet<double> jet;
    std::optional<ArticulatedBodies> articulated;
    std::vector<double> ldl;  // (n, n) factors of M, unless bodies are articulated
    std::vector<double> kinetic = zeros(mechanism.tree.groups),
                        turnover = zeros(mechanism.tree.groups);  // of each group [J]
    std::vector<double> work = zeros(mechanism.tree.groups),
                        lost = zeros(mechanism.tree.groups);  // of each group over the substep, and by friction [J]
    std::vector<double> magnitude = zeros(mechanism.tree.groups);  // of each group, as in Trial
    std::vector<double> share = zeros(n);
    std::vector<double> diagonal = zeros(n);  // of the branch guard
    std::vector<double> curved, mass;  // (n, n) of the branch guard, unless the step equation is solved by elimination
    std::vector<PartLedger> part;      // at the trial node

    template <class Size>
    bool factor_sized(const double* q) {
        const Size n = this->n;
        mass_matrix<Size>(mechanism, q, jet);
        for (const Block& block : blocks_of(mechanism.tree, n)) {
            for (int i = block.begin; i < block.end; ++i) {
                const double* row = &jet.M[i * n];
                std::copy(row + block.begin, row + i + 1, &ldl[i * n + block.begin]);
            }
            if (!factor_ldl(ldl.data(), n, block)) return false;
        }
        return true;
    }

    template <class Size>
    void velocity_sized(const double* p, double* v) {
        const Size n = this->n;
        for (const Block& block : blocks_of(mechanism.tree, n)) {
            solve_lower(ldl.data(), n, block, p, v);
            for (int i = block.begin; i < block.end; ++i) {
                const double y = v[i];
                v[i] /= ldl[i * n + i];
                share[i] = 0.5 * v[i] * y;
            }
            solve_upper(ldl.data(), n, block, v);
        }
    }

    // branch_margin from the matrices of the stages' jets.
    template <class Size, class Stages>
    double branch_margin_of(double h, const Guards& guards, const Collocation& step) {
        const Size n = this->n;
        const Stages stages = step.stages;
        const Tableau& tableau = step.tableau;
        const double exaggerated = h * h * tableau.reach / (1.0 - guards.branch_margin);
        double least = infinity;
        for (const Block& block : blocks_of(mechanism.tree, n)) {
            for (int i = block.begin; i < block.end; ++i) {
                double *inertia = &mass[i * n], *line = &curved[i * n];
                std::fill(inertia + block.begin, inertia + i + 1, 0.0);
                for (int s = 0; s < stages; ++s)
                    detail::subtract_scaled(inertia, -tableau.b[s], &step.stage[s].M[i * n], block.begin, i + 1);
                std::copy(inertia + block.begin, inertia + i + 1, line + block.begin);
                for (int s = 0; s < stages; ++s) {
                    const Jet<double>& jet_here = step.stage[s];
                    detail::subtract_scaled(line, exaggerated * tableau.b[s], &jet_here.Lqq[i * n], block.begin, i + 1);
                    if (tableau.skew == 0.0) continue;
                    const double twist = h * tableau.skew * tableau.b[s];
                    for (int j = block.begin; j <= i; ++j)
                        line[j] += twist * (jet_here.A[i * n + j] + jet_here.A[j * n + i]);
                }
                if (step.coupled()) {
                    for (int j = block.begin; j <= i; ++j)
                        line[j] += step.coupled_stiffening(i, j, 0.5 * h, exaggerated);
                }
                line[i] += step.stiffening(i, 0.5 * h, exaggerated);
            }
            least = std::min(least, least_pivot_ratio(curved.data(), mass.data(), n, block));
        }
        return least;
    }

    // The kinetic energy that a coordinate turns over: the recent variation of its share. The share itself would permit
    // any error of what a heavy, evenly turning wheel carries.
    double varied(const Energies& energies, int i) const {
        const Share& range = energies.share[i];
        return std::min(std::max(range.now, share[i]),
                        std::max(range.largest, share[i]) - std::min(range.least, share[i]));
    }

    void find_turnover(const Energies& energies) {
        std::fill(turnover.begin(), turnover.end(), 0.0);
        for (int i = 0; i < n; ++i) turnover[mechanism.tree.group[i]] += varied(energies, i);
        for (std::size_t r = 0; r < turnover.size(); ++r)
            turnover[r] = std::min(turnover[r], std::max(kinetic[r], energies.group[r].kinetic));
    }

    void update_shares(double forget, Energies& energies) const {
        for (int i = 0; i < n; ++i) {
            Share& range = energies.share[i];
            const double now = share[i];
            range.now = now;
            range.least = std::min(range.least + forget * (now - range.least), now);
            range.largest = std::max(range.largest + forget * (now - range.largest), now);
        }
    }

    // The change of the energy of group r minus the work of forces [J].
    double error_of(const Ledger& ledger, int r) const {
        return (kinetic[r] - ledger.kinetic) + (jet.potential[r] - ledger.potential) - work[r];
    }

    // Whether the balance of group r closes. Stiffly accurate methods damp modes that friction stops within a step; for
    // them, errors up to the work of friction are accepted.
    bool balanced(const Limit& limit, double off_middle, bool stiffly_accurate, const Ledger& ledger, int r) const {
        const double error = error_of(ledger, r);
        if (stiffly_accurate && std::abs(error) <= lost[r]) return true;
        const double exchanged = std::abs(jet.potential[r] - ledger.potential) + std::abs(work[r]);
        const double scale = jet.potential_scale[r];
        const double rounding_margin =
            rounding * (scale + kinetic[r] + magnitude[r]) + 1e-3 * off_middle * scale + nothing;
        return std::abs(error) <= limit.of(error, ledger.defect, turnover[r], exchanged, ledger.most) + rounding_margin;
    }

    // Update a ledger after an accepted substep. Friction reduces earlier errors together with the energy.
    void update_ledger(Ledger& ledger, int r) const {
        double defect = ledger.defect + error_of(ledger, r);
        if (lost[r] > 0.0) defect *= std::max(0.0, 1.0 - lost[r] / (lost[r] + std::max(kinetic[r], ledger.kinetic)));
        ledger = {kinetic[r], jet.potential[r], defect, std::max(ledger.most, turnover[r])};
    }

    // Whether a body is in the subtree of `top`; parents come first.
    bool below(int body, int top) const {
        while (body > top) body = mechanism.tree.bodies[body].parent;
        return body == top;
    }

    // Jacobi energy, potential energy and the carrier's derivatives of each light part at a node.
    void light_parts(const double* q, const double* p, const double* v) {
        if (part.empty()) return;
        const Tree& tree = mechanism.tree;
        const Vec3<double>& g = mechanism.gravity;
        const double strength = detail::norm1(g);
        kernels.first_order(mechanism, q, v, jet);
        for (std::size_t r = 0; r < part.size(); ++r) {
            const LightPart& light = tree.light_parts[r];
            PartLedger& ledger = part[r];
            const auto& top = jet.body[light.body];
            const int carrier = tree.bodies[light.body].parent;
            const double carried = 0.5 * dot(jet.body[carrier].velocity, top.momentum);
            // The height of the part's origin is left out of the potential, and of the carrier's L_q.
            ledger.potential = -dot(g, top.inertia.moment);
            ledger.scale = strength * detail::norm1(top.inertia.moment) + std::abs(carried);
            for (int b = light.body; b < tree.size(); ++b) {
                const Body& link = tree.bodies[b];
                if (!link.origin || !below(b, light.body)) continue;
                const auto& there = jet.body[b];
                // Moments below an origin are taken about it, and it translates.
                if (b > light.body) {
                    ledger.potential -= dot(g, there.inertia.moment);
                    ledger.scale += strength * detail::norm1(there.inertia.moment);
                }
                if (link.prismatic) {
                    const double slid = link.ratio * q[link.coordinate] + link.offset;
                    ledger.potential -= there.inertia.mass * slid * dot(g, there.axis.linear);
                    ledger.scale += strength * there.inertia.mass * std::abs(slid);
                }
            }
            ledger.jacobi = -carried;
            std::fill(ledger.Lq.begin(), ledger.Lq.end(), 0.0);
            std::fill(ledger.Lv.begin(), ledger.Lv.end(), 0.0);
            for (int c = 0; c < n; ++c) {
                if (!light.carried[c]) continue;
                ledger.jacobi += 0.5 * p[c] * v[c];
                ledger.scale += std::abs(p[c] * v[c]);
            }
            mechanism.forces.potentials(q, [&](int c, const Potential<double>& element) {
                if (!light.carried[c]) return;
                ledger.potential += element.energy;
                ledger.scale += element.magnitude(q[c]);
            });
            // A coupling on the part belongs to its Lagrangian, and depends on other coordinates too.
            mechanism.couplings.potentials(
                q, jet.couplings, [&](const auto& arms, const auto& coupling, double, double size) {
                    const auto carried = [&](const Arm<double>& arm) { return light.carried[arm.coordinate] != 0; };
                    if (std::none_of(arms.begin(), arms.end(), carried)) return;
                    ledger.potential += coupling.energy;
                    ledger.scale += size;
                    for (const Arm<double>& arm : arms) {
                        if (!carried(arm)) ledger.Lq[arm.coordinate] -= dot(coupling.slope, arm.linear);
                    }
                });
            const Force<double> weight{top.inertia.mass * g, cross(top.inertia.moment, g)};
            for (int a = carrier; a >= 0; a = tree.bodies[a].parent) {
                const Body& link = tree.bodies[a];
                const auto& there = jet.body[a];
                double slope = dot(there.axis_rate, top.momentum);
                if (!(link.origin && link.prismatic)) slope += dot(there.axis, weight);
                ledger.Lq[link.coordinate] += link.ratio * slope;
                ledger.Lv[link.coordinate] += link.ratio * dot(there.axis, top.momentum);
            }
            ledger.jacobi += ledger.potential;
        }
    }

    // Whether the balance of light part r closes over a substep; writes its ledger into `part`.
    bool part_balanced(const Limit& limit, const Energies& energies, const std::vector<Coordinate>& from,
                       const std::vector<double>& from_v, const Trial& trial, std::size_t r) {
        const PartLedger& old = energies.part[r];
        PartLedger& ledger = part[r];
        double work = 0.0, drive = 0.0, exchanged = 0.0, turned = 0.0, magnitude = 0.0;
        for (int c = 0; c < n; ++c) {
            if (mechanism.tree.light_parts[r].carried[c]) {
                work += trial.work[c];
                magnitude += trial.magnitude[c];
                turned += varied(energies, c);
                continue;
            }
            const Compensated &now = trial.position[c].value, &then = from[c].value;
            const double by_position =
                0.5 * (old.Lq[c] + ledger.Lq[c]) * ((now.high - then.high) + (now.low - then.low));
            const double by_rate = 0.5 * (old.Lv[c] + ledger.Lv[c]) * (trial.v[c] - from_v[c]);
            drive += by_position + by_rate;
            exchanged += std::abs(by_position) + std::abs(by_rate);
        }
        const double error = (ledger.jacobi - old.jacobi) - work + drive;
        exchanged += std::abs(ledger.potential - old.potential) + std::abs(work);
        const double most = limit.of(error, old.defect, turned, exchanged, part_factor * old.most);
        ledger.defect = old.defect + error;
        ledger.most = std::max(old.most, turned);
        return std::abs(error) <=
               part_factor * most + rounding * (old.scale + ledger.scale + exchanged + magnitude) + nothing;
    }
};

template <class Size>
const Kernels Sized<Size>::kernels{
    .jet = &lagrangian_jet<Size, double>,
    .first_order = &varpin::first_order<Size>,
    .residuals = &Collocation::residuals_of<Size, Known<1>>,
    .factor = &Collocation::factor_one<Size>,
    .solve = &Collocation::solve_one<Size>,
    .kinetic_size = &Collocation::kinetic_size_of_one<Size>,
    .derivatives = &StepEquation::derivatives_by_blocks<Size, Known<1>>,
    .branch_margin = &EnergyGuard::branch_margin_of<Size, Known<1>>,
    .factor_mass = &EnergyGuard::factor_sized<Size>,
    .velocity = &EnergyGuard::velocity_sized<Size>,
    .velocity_slopes = &varpin::velocity_slopes<Size>,
};

}  // namespace varpin
