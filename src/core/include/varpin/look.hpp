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
#include "varpin/policy.hpp"
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
    const double* p = nullptr;  // (N + 1, n)
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
    const auto look = [&](const double* values, int kind, bool& inside) {
        const double *least = bounds + 2 * kind * n, *most = least + n;
        for (int c = 0; c < n; ++c) inside = inside && values[c] >= least[c] && values[c] <= most[c];
    };
    for (std::int64_t k = 0; k <= record.steps; ++k) {
        look(record.q + k * n, 0, found.position);
        look(record.v + k * n, 1, found.velocity);
    }
    std::vector<double> force(n);
    const auto push = [&](const double* u) {
        constant_force(mechanism, nullptr, u, force.data());
        look(force.data(), 2, found.effort);
    };
    for (std::int64_t k = 0; k < record.steps; ++k) push(record.u + k * m);
    for (std::int64_t row = 0; within && row < record.steps * stages; ++row) push(within + row * m);
    return found;
}

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
        inertias.masses_at(record.q + node * n);
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

// Units of the errors of a motion over a window of its steps: each joint's travel and its largest velocity there, with
// the lower bounds of Allowed.
class Yardstick {
  public:
    explicit Yardstick(const Mechanism& mechanism)
        : slides_(mechanism.dof()),
          inertias_(mechanism),
          position_(mechanism.dof()),
          speed_(mechanism.dof()),
          root_(mechanism.dof()),
          unit_(mechanism.dof()) {
        for (const Body& body : mechanism.tree.bodies) {
            if (body.prismatic) slides_[body.coordinate] = true;
        }
    }

    // The window of `length` steps of h [s] that begins at q and v (length + 1, n).
    void lay(const double* q, const double* v, std::size_t length, double h, const Allowed& allowed) {
        const std::size_t n = unit_.size();
        std::fill(position_.begin(), position_.end(), Extent{});
        std::fill(speed_.begin(), speed_.end(), Extent{});
        for (std::size_t k = 0; k <= length; ++k) {
            for (std::size_t c = 0; c < n; ++c) {
                position_[c].add(q[k * n + c]);
                speed_[c].add(v[k * n + c]);
            }
        }
        inertias_.masses_at(q);
        energy_ = 0.0;
        double far = 0.0;
        for (std::size_t c = 0; c < n; ++c) {
            root_[c] = std::sqrt(inertias_.diagonal(static_cast<int>(c)));
            energy_ = larger(energy_, root_[c] * speed_[c].change(allowed.even));
            far = larger(far, std::abs(q[c]));
        }
        rounding_ = 1e3 * std::numeric_limits<double>::epsilon() * (1.0 + far);
        time_ = static_cast<double>(length) * h;
    }

    // The largest error of q (n) in units of the travel. Rounding is no error.
    double of_travel(std::vector<double>& off, const Allowed& allowed) {
        for (std::size_t c = 0; c < off.size(); ++c) {
            if (off[c] <= rounding_) off[c] = 0.0;
            unit_[c] = position_[c].width();
        }
        return largest_share(off, time_, allowed);
    }

    // The largest error of v (n) in units of the largest velocity.
    double of_speed(const std::vector<double>& off, const Allowed& allowed) {
        for (std::size_t c = 0; c < off.size(); ++c) unit_[c] = speed_[c].magnitude;
        return largest_share(off, 1.0, allowed);
    }

  private:
    std::vector<char> slides_;
    Inertias inertias_;
    std::vector<Extent> position_, speed_;
    std::vector<double> root_, unit_;
    double energy_ = 0.0, rounding_ = 0.0, time_ = 0.0;

    double largest_share(const std::vector<double>& off, double time, const Allowed& allowed) const {
        double largest[2] = {0.0, 0.0}, share = 0.0;
        for (std::size_t c = 0; c < off.size(); ++c) {
            double& of_kind = largest[int{slides_[c]}];
            of_kind = larger(of_kind, unit_[c]);
        }
        for (std::size_t c = 0; c < off.size(); ++c) {
            const double least = allowed.light * energy_ / root_[c] * time;
            const double size = larger(unit_[c], std::min(allowed.little * largest[int{slides_[c]}], least));
            if (off[c] == 0.0) continue;
            share = larger(share, off[c] / size);
        }
        return share;
    }
};

// Whether windows of a motion, `length` steps of h [s] from the nodes `begins` on, agree with the results `again_q` and
// `again_v` (windows, looks, n) of other steps, at `looks` evenly spaced nodes of each window.
inline bool agree_in_windows(const Mechanism& mechanism, const double* q, const double* v, const std::int64_t* begins,
                             std::size_t windows, std::size_t length, double h, const double* again_q,
                             const double* again_v, std::size_t looks, const Allowed& allowed) {
    const int n = mechanism.dof();
    Yardstick yardstick(mechanism);
    std::vector<double> off_q(n), off_v(n);
    for (std::size_t w = 0; w < windows; ++w) {
        const double* const first_q = q + begins[w] * n;
        const double* const first_v = v + begins[w] * n;
        std::fill(off_q.begin(), off_q.end(), 0.0);
        std::fill(off_v.begin(), off_v.end(), 0.0);
        for (std::size_t k = 0; k < looks; ++k) {
            const std::size_t row = (w * looks + k) * n, whole = (k + 1) * (length / looks) * n;
            for (int c = 0; c < n; ++c) {
                off_q[c] = larger(off_q[c], std::abs(again_q[row + c] - first_q[whole + c]));
                off_v[c] = larger(off_v[c], std::abs(again_v[row + c] - first_v[whole + c]));
            }
        }
        yardstick.lay(first_q, first_v, length, h, allowed);
        if (!(yardstick.of_travel(off_q, allowed) <= allowed.travel)) return false;
        if (!(yardstick.of_speed(off_v, allowed) <= allowed.velocity)) return false;
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
