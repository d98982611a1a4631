// Checks of a finished motion: rates of the scene that its steps cannot resolve, bounds. The caller sets the
// thresholds. docs/mathematics.md, "The error of a motion".
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/forces.hpp"
#include "varpin/jet.hpp"
#include "varpin/policy.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// M at consecutive configurations, and matrices of M, L_qq at rest and the derivatives of forces.
class Inertias {
  public:
    explicit Inertias(const Mechanism& mechanism)
        : mechanism_(mechanism),
          jet_(mechanism.tree),
          still_(mechanism.dof()),
          work_(jet_.M.size()),
          forces_(mechanism.dof()) {
        if (!mechanism.couplings.pushes()) return;
        by_q_.resize(work_.size());
        by_v_.resize(work_.size());
    }

    int dof() const { return jet_.dof; }
    void at(const double* q) { lagrangian_jet(mechanism_, q, still_.data(), jet_); }
    // Only M.
    void masses_at(const double* q) { mass_matrix(mechanism_, q, jet_); }
    // With the forces at velocities v under the controls' forces f (n).
    void at(const double* q, const double* v, const double* f) {
        at(q);
        forces_at(q, v, f);
    }
    void forces_at(const double* q, const double* v, const double* f) {
        sum_forces(mechanism_, q, v, f, forces_.data(), jet_.couplings, by_q_.data(), by_v_.data());
    }
    double diagonal(int c) const { return mass(c, c); }
    double mass(int row, int column) const { return jet_.M[row * jet_.dof + column]; }

    // Whether rate M - D, D = -dF/dv, is positive definite: all damping is slower than the rate. Friction that
    // decreases with the velocity does not damp.
    bool outpaces_dampers(double rate) {
        std::transform(jet_.M.begin(), jet_.M.end(), work_.begin(), [&](double m) { return rate * m; });
        for (int c = 0; c < dof(); ++c) work_[c * dof() + c] += std::min(forces_[c].by_v, 0.0);
        add_symmetric(1.0, by_v_);
        return definite();
    }

    // Whether M + weight (L_qq + dF/dq) is positive definite.
    bool carries(double weight) {
        for (std::size_t i = 0; i < work_.size(); ++i) work_[i] = jet_.M[i] + weight * jet_.Lqq[i];
        for (int c = 0; c < dof(); ++c) work_[c * dof() + c] += weight * forces_[c].by_q;
        add_symmetric(weight, by_q_);
        return definite();
    }

  private:
    const Mechanism& mechanism_;
    Jet<double> jet_;
    std::vector<double> still_, work_;
    std::vector<JointForce<double>> forces_;
    std::vector<double> by_q_, by_v_;  // (n, n) of couplings, if there are such forces

    void add_symmetric(double weight, const std::vector<double>& matrix) {
        for (std::size_t i = 0; i < matrix.size(); ++i) {
            const std::size_t n = dof(), mirrored = i % n * n + i / n;
            work_[i] += 0.5 * weight * (matrix[i] + matrix[mirrored]);
        }
    }

    bool definite() {
        const auto& blocks = mechanism_.tree.blocks;
        return std::all_of(blocks.begin(), blocks.end(),
                           [&](const Block& block) { return factor_ldl(work_.data(), dof(), block); });
    }
};

// Rows of q, v and the controls' forces f (rows, n).
struct States {
    const double* q = nullptr;
    const double* v = nullptr;
    const double* f = nullptr;
    std::size_t rows = 0;
};

// The fastest damping rate [1/s], the largest eigenvalue of M^-1 D, over some states; 0 if none is faster than `least`.
inline double fastest_damping(Inertias& inertias, const States& states, double least) {
    double fastest = 0.0;
    for (std::size_t r = 0; r < states.rows; ++r) {
        const std::size_t row = r * inertias.dof();
        inertias.at(states.q + row, states.v + row, states.f + row);
        double low = std::max(fastest, least), high = 2.0 * low;
        if (inertias.outpaces_dampers(low)) continue;
        while (!inertias.outpaces_dampers(high)) {
            low = high;
            high *= 2.0;
            if (!(high < std::numeric_limits<double>::infinity())) return high;
        }
        while (high - low > 1e-12 * high) {
            const double middle = 0.5 * (low + high);
            (inertias.outpaces_dampers(middle) ? high : low) = middle;
        }
        fastest = high;
    }
    return fastest;
}

// Whether springs, servos or gravity advance a mode by more than a radian over h [s] in one of some states.
inline bool pulls_fast(Inertias& inertias, const States& states, double h) {
    for (std::size_t r = 0; r < states.rows; ++r) {
        const std::size_t row = r * inertias.dof();
        inertias.at(states.q + row, states.v + row, states.f + row);
        if (!inertias.carries(h * h) || !inertias.carries(-h * h)) return true;
    }
    return false;
}

// N steps and their nodes, row-major.
struct Record {
    std::int64_t steps = 0;
    const double* q = nullptr;  // (N + 1, n)
    const double* v = nullptr;  // (N + 1, n)
    const double* u = nullptr;  // (N, m)
    double h = 0.0;             // [s]
};

// Whether q of all nodes, v of all nodes and the controls' forces of all steps are each within bounds (3, 2, n), the
// least and the most. `within` (N, stages, m), the controls at the stages of each step, may be null. NaN is beyond
// them.
struct Inside {
    bool position = true, velocity = true, effort = true;
};
inline Inside inside_of(const Mechanism& mechanism, const Record& record, const double* within, int stages,
                        const double* bounds) {
    const int n = mechanism.dof(), m = mechanism.controls;
    Inside found;
    const auto check = [&](const double* values, int kind, bool& inside) {
        const double *least = bounds + 2 * kind * n, *most = least + n;
        for (int c = 0; c < n; ++c) inside = inside && values[c] >= least[c] && values[c] <= most[c];
    };
    for (std::int64_t k = 0; k <= record.steps; ++k) {
        check(record.q + k * n, 0, found.position);
        check(record.v + k * n, 1, found.velocity);
    }
    std::vector<double> force(n);
    const auto push = [&](const double* u) {
        constant_force(mechanism, nullptr, u, force.data());
        check(force.data(), 2, found.effort);
    };
    for (std::int64_t k = 0; k < record.steps; ++k) push(record.u + k * m);
    for (std::int64_t row = 0; within && row < record.steps * stages; ++row) push(within + row * m);
    return found;
}

}  // namespace varpin
