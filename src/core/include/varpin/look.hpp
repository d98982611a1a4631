// Checks of a finished motion: the energy that it turns over, rates of the scene that its steps cannot resolve, and
// whether other steps give the same motion. The caller sets the thresholds. docs/limits.md, "The warnings".
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/forces.hpp"
#include "varpin/jet.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// Maximum, minimum and largest magnitude of some numbers.
struct Extent {
    double least = std::numeric_limits<double>::infinity();
    double most = -std::numeric_limits<double>::infinity();
    double magnitude = 0.0;

    void add(double x) {
        least = -larger(-least, -x);
        most = larger(most, x);
        magnitude = larger(magnitude, std::abs(x));
    }
    double width() const { return most - least; }
    // The change of a velocity, at least the share `even` of its largest magnitude, for joints that turn evenly.
    double change(double even) const { return std::min(larger(width(), even * magnitude), magnitude); }
};

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
    // With the forces at velocities v under the controls' forces f (n).
    void at(const double* q, const double* v, const double* f) {
        at(q);
        sum_forces(mechanism_, q, v, f, forces_.data(), jet_.couplings, by_q_.data(), by_v_.data());
    }
    double diagonal(int c) const { return jet_.M[c * jet_.dof + c]; }

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
    const double* p = nullptr;  // (N + 1, n)
    const double* u = nullptr;  // (N, m)
    double h = 0.0;             // [s]
};

// The energy that a motion turns over [J].
struct Turnover {
    double kinetic = 0.0;            // the largest kinetic energy
    double work = 0.0;               // the largest accumulated work of controls, for servos that of their drives
    std::vector<double> kinetic_of;  // (n) for the largest change of each joint's velocity, with the inertia it moves
    std::vector<double> work_of;     // (n) as `work`, for each joint
};

// Inertias are evaluated at `looks` evenly spaced nodes.
inline Turnover turnover(const Mechanism& mechanism, const Record& record, double even, int looks) {
    const int n = mechanism.dof(), m = mechanism.controls;
    const auto nodes = static_cast<std::size_t>(record.steps) + 1;
    Turnover found{-std::numeric_limits<double>::infinity(), 0.0, std::vector<double>(n), std::vector<double>(n)};
    std::vector<Extent> speed(n);
    for (std::size_t k = 0; k < nodes; ++k) {
        double kinetic = 0.0;
        for (int c = 0; c < n; ++c) {
            kinetic += record.p[k * n + c] * record.v[k * n + c];
            speed[c].add(record.v[k * n + c]);
        }
        found.kinetic = larger(found.kinetic, 0.5 * kinetic);
    }
    std::vector<double> force(n), work_of(n), middle(n), rate(n);
    double work = 0.0;
    for (std::size_t k = 0; k + 1 < nodes; ++k) {
        std::fill(force.begin(), force.end(), 0.0);
        for (const Transmission& transmission : mechanism.actuation)
            force[transmission.coordinate] += transmission.ratio * record.u[k * m + transmission.control];
        if (mechanism.forces.drives()) {
            for (int c = 0; c < n; ++c) {
                const double before = record.q[k * n + c], after = record.q[(k + 1) * n + c];
                middle[c] = 0.5 * (before + after);
                rate[c] = (after - before) / record.h;
            }
            mechanism.forces.drive(middle.data(), rate.data(), force.data());
        }
        for (int c = 0; c < n; ++c) {
            const double done = force[c] * (record.q[(k + 1) * n + c] - record.q[k * n + c]);
            work += done;
            work_of[c] += done;
            found.work_of[c] = larger(found.work_of[c], std::abs(work_of[c]));
        }
        found.work = larger(found.work, std::abs(work));
    }
    Inertias inertias(mechanism);
    std::int64_t before = -1;
    for (int i = 0; i < looks; ++i) {
        const bool last = i + 1 == looks;
        const double even_share = static_cast<double>(record.steps) / (looks - 1);
        const auto node = last ? record.steps : static_cast<std::int64_t>(i * even_share);
        if (node == before) continue;
        before = node;
        inertias.at(record.q + node * n);
        for (int c = 0; c < n; ++c) found.kinetic_of[c] = larger(found.kinetic_of[c], inertias.diagonal(c));
    }
    for (int c = 0; c < n; ++c) {
        const double change = speed[c].change(even);
        found.kinetic_of[c] *= 0.5 * change * change;
    }
    return found;
}

// Quick facts about a record.
struct Glance {
    double fastest = 0.0;  // the largest velocity of all joints [rad/s or m/s]
    bool split = false;    // whether a step was divided
    bool steady = true;    // whether all steps have the same controls
    bool pulled = false;   // pulls_fast over a step, at the first node or at the last
};

// `substeps` (N) may be null for undivided steps.
inline Glance glance(const Mechanism& mechanism, const Record& record, const std::int64_t* substeps) {
    const std::size_t n = mechanism.dof(), m = mechanism.controls, steps = record.steps;
    Glance seen;
    for (std::size_t i = 0; i < (steps + 1) * n; ++i) seen.fastest = larger(seen.fastest, std::abs(record.v[i]));
    for (std::size_t k = 0; substeps && k < steps; ++k) seen.split = seen.split || substeps[k] > 1;
    for (std::size_t i = m; i < steps * m; ++i) seen.steady = seen.steady && record.u[i] == record.u[i - m];
    Inertias inertias(mechanism);
    std::vector<double> force(n);
    for (const std::size_t node : {std::size_t{0}, steps}) {
        std::fill(force.begin(), force.end(), 0.0);
        for (const Transmission& transmission : mechanism.actuation)
            force[transmission.coordinate] +=
                transmission.ratio * record.u[std::min(node, steps - 1) * m + transmission.control];
        seen.pulled =
            seen.pulled || pulls_fast(inertias, {record.q + node * n, record.v + node * n, force.data(), 1}, record.h);
    }
    return seen;
}

// Largest differences between motions with different steps: of q relative to a joint's travel, of v relative to its
// largest velocity. Lower bounds of these units are the share `little` of the travel of other joints of the same kind,
// and the share `light` of the velocity that would have their energy.
struct Allowed {
    double travel = 0.0;
    double velocity = 0.0;
    double little = 0.0;
    double light = 0.0;
    double even = 0.0;  // as in Extent::change
};

// Whether windows of a motion, `length` steps of h [s] from the nodes `begins` on, agree with the results `again_q` and
// `again_v` (windows, looks, n) of other steps, at `looks` evenly spaced nodes of each window.
inline bool agree_in_windows(const Mechanism& mechanism, const double* q, const double* v, const std::int64_t* begins,
                             std::size_t windows, std::size_t length, double h, const double* again_q,
                             const double* again_v, std::size_t looks, const Allowed& allowed) {
    const int n = mechanism.dof();
    std::vector<char> slides(n);
    for (const Body& body : mechanism.tree.bodies) {
        if (body.prismatic) slides[body.coordinate] = true;
    }
    Inertias inertias(mechanism);
    std::vector<Extent> position(n), speed(n);
    std::vector<double> off_q(n), off_v(n), root(n), unit(n);
    // Whether errors are within the allowed share of `unit`, which has lower bounds: `least`, and a share of the
    // largest unit of the same kind.
    const auto within = [&](const std::vector<double>& off, double part, double energy, double time) {
        double largest[2] = {0.0, 0.0};
        for (int c = 0; c < n; ++c) largest[int{slides[c]}] = larger(largest[int{slides[c]}], unit[c]);
        for (int c = 0; c < n; ++c) {
            const double least = allowed.light * energy / root[c] * time;
            const double size = larger(unit[c], std::min(allowed.little * largest[int{slides[c]}], least));
            if (!(off[c] <= part * size)) return false;
        }
        return true;
    };
    for (std::size_t w = 0; w < windows; ++w) {
        const double* const first_q = q + begins[w] * n;
        const double* const first_v = v + begins[w] * n;
        std::fill(position.begin(), position.end(), Extent{});
        std::fill(speed.begin(), speed.end(), Extent{});
        std::fill(off_q.begin(), off_q.end(), 0.0);
        std::fill(off_v.begin(), off_v.end(), 0.0);
        for (std::size_t k = 0; k <= length; ++k) {
            for (int c = 0; c < n; ++c) {
                position[c].add(first_q[k * n + c]);
                speed[c].add(first_v[k * n + c]);
            }
        }
        for (std::size_t k = 0; k < looks; ++k) {
            const std::size_t row = (w * looks + k) * n, whole = (k + 1) * (length / looks) * n;
            for (int c = 0; c < n; ++c) {
                off_q[c] = larger(off_q[c], std::abs(again_q[row + c] - first_q[whole + c]));
                off_v[c] = larger(off_v[c], std::abs(again_v[row + c] - first_v[whole + c]));
            }
        }
        inertias.at(first_q);
        double energy = 0.0, far = 0.0;
        for (int c = 0; c < n; ++c) {
            root[c] = std::sqrt(inertias.diagonal(c));
            energy = larger(energy, root[c] * speed[c].change(allowed.even));
            far = larger(far, std::abs(first_q[c]));
        }
        const double rounding = 1e3 * std::numeric_limits<double>::epsilon() * (1.0 + far);
        for (int c = 0; c < n; ++c) {
            if (off_q[c] <= rounding) off_q[c] = 0.0;
            unit[c] = position[c].width();
        }
        if (!within(off_q, allowed.travel, energy, static_cast<double>(length) * h)) return false;
        for (int c = 0; c < n; ++c) unit[c] = speed[c].magnitude;
        if (!within(off_v, allowed.velocity, energy, 1.0)) return false;
    }
    return true;
}

// A sequence of consecutive sign changes in the second differences of a velocity: coordinate, number, first node.
struct Alternation {
    std::int64_t joint = 0;
    std::int64_t changes = 0;
    std::int64_t first = 0;
};

// Second differences that count: above `counts` of the joint's largest velocity and above `idle` of that of all joints;
// consecutive ones differ by less than the factor `even`.
struct Turns {
    double counts = 0.0;
    double idle = 0.0;
    double even = 0.0;
};

// The longest sequence over N + 1 nodes of v (N + 1, n). It is interrupted where a control of u (N, m) reverses by more
// than the share `counts` of its largest value, since the control then explains it; u may be null.
inline Alternation longest_alternation(const double* v, std::int64_t steps, int n, const double* u, int m,
                                       const Turns& what) {
    const auto bend = [&](std::int64_t k, int c) {
        const double* at = v + k * n + c;
        return (at[2 * n] - at[n]) - (at[n] - at[0]);
    };
    std::vector<double> fastest(n), greatest(u ? m : 0);
    for (std::int64_t k = 0; k <= steps; ++k) {
        for (int c = 0; c < n; ++c) fastest[c] = larger(fastest[c], std::abs(v[k * n + c]));
    }
    for (std::int64_t k = 0; u && k < steps; ++k) {
        for (int c = 0; c < m; ++c) greatest[c] = larger(greatest[c], std::abs(u[k * m + c]));
    }
    double all = 0.0;
    for (double speed : fastest) all = larger(all, speed);
    Alternation longest;
    std::vector<std::int64_t> row(n);
    for (std::int64_t k = 0; k + 2 < steps; ++k) {
        bool driven = false;
        for (int c = 0; u && c < m; ++c) {
            const double* at = u + k * m + c;
            const double before = at[m] - at[0], after = at[2 * m] - at[m];
            driven = driven || (before * after < 0.0 && std::abs(after) > what.counts * greatest[c]);
        }
        for (int c = 0; c < n; ++c) {
            const double before = bend(k, c), after = bend(k + 1, c);
            const double small = std::min(std::abs(before), std::abs(after));
            const double large = std::max(std::abs(before), std::abs(after));
            const bool turns = !driven && before * after < 0.0 && small > what.counts * fastest[c] &&
                               small > what.idle * all && large < what.even * small;
            row[c] = turns ? row[c] + 1 : 0;
            if (row[c] > longest.changes) longest = {c, row[c], k + 1 - row[c]};
        }
    }
    return longest;
}

}  // namespace varpin
