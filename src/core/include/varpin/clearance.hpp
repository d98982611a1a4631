// Motions that are clearly right, from the residual of the equations of motion along their record. docs/limits.md, "The
// warnings".
//
// Through the nodes of a step goes the polynomial of fifth degree with their q, v and accelerations a. With the
// accelerations a_i of the scene on it at the points c_i of a quadrature (c_1 = 0, c_r = 1, weights w_i) the step is
// off by
//
//     dv = v1 - v0 - h sum_i w_i a_i        dq = q1 - q0 - h v0 - h^2 sum_i w_i (1 - c_i) a_i
//
// and by the error of the quadrature. Either is small for small errors in steps that resolve the motion, and not for
// others.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/dynamics.hpp"
#include "varpin/look.hpp"
#include "varpin/policy.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// Points and weights of a quadrature on [0, 1], its ends included; and the factors of the controls at `stages` stages
// of a step on those at the points (points, stages).
struct Quadrature {
    std::span<const double> points, weights;
    const double* places = nullptr;
    int stages = 0;
};

// Largest errors of a motion that is clearly right.
struct Clear {
    double still = 0.0;          // velocity up to which nothing moves
    double energy = 0.0;         // of the balance, as a share of the energy that is turned over
    double damping = 0.0;        // rates of dampers, in units of 1 / h
    double whole = 0.0;          // sum over the motion, as a share of the travel
    double grown = 0.0;          // this sum, grown as the fastest mode does
    double aligned = 0.0;        // share of a mode's exponent by which errors grow
    std::int64_t window = 0;     // most steps of a window
    std::int64_t few = 0;        // number of steps below which errors do not grow
    std::int64_t damped_at = 0;  // nodes at which dampers are looked at
    double known = -1.0;         // error of q at all nodes, if it is known, else negative
    Allowed allowed;             // in each window
};

class Clearance {
  public:
    Clearance(const Mechanism& mechanism, const Record& record, const double* within, const Quadrature& rule,
              const Clear& clear)
        : mechanism_(mechanism),
          record_(record),
          within_(within),
          rule_(rule),
          clear_(clear),
          n_(mechanism.dof()),
          dynamics_(mechanism, false),
          inertias_(mechanism),
          force_(rule.points.size() * n_),
          before_(n_),
          a_(rule.points.size() * n_),
          q_(n_),
          v_(n_),
          off_q_(n_),
          off_v_(n_) {
        for (double t : rule.points) basis_.push_back(Basis::at(t));
    }

    // The factor up to which disturbances may grow over the motion for it to be clearly right: infinite where they grow
    // less, 0 where it is not. `defect` (N) is the error of the energy balance, `substeps` (N) the number of parts of
    // each step.
    double growth(const double* defect, const std::int64_t* substeps) {
        const Glance seen = glance(mechanism_, record_, substeps);
        const bool plain = seen.fastest > clear_.still && !seen.split && !seen.pulled && balanced(defect) && !damped();
        return plain ? growth_of_errors() : 0.0;
    }

  private:
    // Values and slopes on [0, 1] of the polynomials that belong to q1 - q0, v0, v1, a0, a1.
    struct Basis {
        double value[5], slope[5];

        static Basis at(double t) {
            const double s = t * t, c = s * t;
            return {{c * (10.0 - 15.0 * t + 6.0 * s), t - c * (6.0 - 8.0 * t + 3.0 * s), -c * (4.0 - 7.0 * t + 3.0 * s),
                     0.5 * s * (1.0 - 3.0 * t + 3.0 * s - c), 0.5 * c * (1.0 - 2.0 * t + s)},
                    {30.0 * s * (1.0 - 2.0 * t + s), 1.0 - s * (18.0 - 32.0 * t + 15.0 * s),
                     -s * (12.0 - 28.0 * t + 15.0 * s), t - 4.5 * s + 6.0 * c - 2.5 * s * s,
                     s * (1.5 - 4.0 * t + 2.5 * s)}};
        }
    };

    const Mechanism& mechanism_;
    const Record& record_;
    const double* within_;  // (N, s, m) controls at the stages; null for controls that are constant over each step
    const Quadrature& rule_;
    const Clear& clear_;
    int n_;
    ForwardDynamics dynamics_;
    Inertias inertias_;
    std::vector<Basis> basis_;
    std::vector<double> force_, before_;  // (r, n) of the controls at the points; at the end of the step before
    std::vector<double> a_;               // (r, n)
    std::vector<double> q_, v_, off_q_, off_v_;

    bool balanced(const double* defect) const {
        double off = 0.0;
        for (std::int64_t k = 0; k < record_.steps; ++k) off = larger(off, std::abs(defect[k]));
        const Turnover found = turnover(mechanism_, record_, clear_.allowed.even, 2);
        double turned = 0.0;
        for (double part : found.kinetic_of) turned += part;
        return off <= clear_.energy * (std::min(found.kinetic, turned) + found.work);
    }

    // Whether a damper may be faster than the step.
    bool damped() {
        if (!mechanism_.forces.any()) return false;
        const std::int64_t last = clear_.damped_at - 1;
        for (std::int64_t i = 0; i <= last; ++i) {
            const std::int64_t node = i * record_.steps / last;
            force_at(std::min(node, record_.steps - 1), force_.data());
            inertias_.at(record_.q + node * n_, record_.v + node * n_, force_.data());
            if (!inertias_.outpaces_dampers(clear_.damping / record_.h)) return true;
        }
        return false;
    }

    // `growth` from the errors in each window and in the whole motion.
    double growth_of_errors() {
        const std::int64_t steps = record_.steps, pieces = (steps + clear_.window - 1) / clear_.window;
        const bool known = clear_.known >= 0.0;
        Yardstick yardstick(mechanism_);
        double total = 0.0;
        bool first = true;
        for (std::int64_t piece = 0; piece < pieces; ++piece) {
            const std::int64_t begin = piece * steps / pieces, end = (piece + 1) * steps / pieces;
            std::fill(off_q_.begin(), off_q_.end(), known ? clear_.known : 0.0);
            // No mode turns or decays by much in a step here.
            std::fill(off_v_.begin(), off_v_.end(), known ? 2.0 * clear_.known / record_.h : 0.0);
            for (std::int64_t k = begin; k < end && !known; ++k, first = false) {
                if (!step(k, first, record_.h * static_cast<double>(end - k - 1))) return 0.0;
            }
            const double* q = record_.q + begin * n_;
            const auto length = static_cast<std::size_t>(end - begin);
            yardstick.lay(q, record_.v + begin * n_, length, record_.h, clear_.allowed);
            const double travel = yardstick.of_travel(off_q_, clear_.allowed);
            if (!(travel <= clear_.allowed.travel)) return 0.0;
            if (!(yardstick.of_speed(off_v_, clear_.allowed) <= clear_.allowed.velocity)) return 0.0;
            total = larger(total, travel * static_cast<double>(steps) / static_cast<double>(length));
        }
        if (known) return std::numeric_limits<double>::infinity();
        if (!(total <= clear_.whole)) return 0.0;
        const double factor = total > 0.0 ? clear_.grown / total : std::numeric_limits<double>::infinity();
        return steps < clear_.few || grows_less(factor) ? std::numeric_limits<double>::infinity() : factor;
    }

    // Adds the errors of a step to those of its window, of which `left` [s] follows; false where a mass matrix is not
    // positive definite.
    bool step(std::int64_t k, bool first, double left) {
        const double *q0 = record_.q + k * n_, *v0 = record_.v + k * n_, *q1 = q0 + n_, *v1 = v0 + n_, h = record_.h;
        const std::size_t last = rule_.points.size() - 1;
        if (within_ && rule_.stages > 0) {
            const int m = mechanism_.controls;
            for (std::size_t i = 0; i <= last; ++i) {
                double* force = &force_[i * n_];
                std::fill(force, force + n_, 0.0);
                for (int s = 0; s < rule_.stages; ++s) {
                    const double* u = within_ + (k * rule_.stages + s) * m;
                    const double share = rule_.places[i * rule_.stages + s];
                    for (const Transmission& own : mechanism_.actuation)
                        force[own.coordinate] += share * own.ratio * u[own.control];
                }
            }
        } else {
            force_at(k, force_.data());
            for (std::size_t i = 1; i <= last; ++i) std::copy_n(force_.data(), n_, &force_[i * n_]);
        }
        // The acceleration at the first node is the last one, unless the controls jump.
        if (!first && std::equal(before_.begin(), before_.end(), force_.begin())) {
            std::copy_n(&a_[last * n_], n_, a_.data());
        } else if (!accelerate(q0, v0, 0)) {
            return false;
        }
        if (!accelerate(q1, v1, last)) return false;
        std::copy_n(&force_[last * n_], n_, before_.data());
        for (std::size_t i = 1; i < last; ++i) {
            const auto& [value, slope] = basis_[i];
            for (int c = 0; c < n_; ++c) {
                const double move = q1[c] - q0[c], rate = h * h;
                const double bend0 = rate * a_[c], bend1 = rate * a_[last * n_ + c];
                q_[c] = q0[c] + value[0] * move + h * (value[1] * v0[c] + value[2] * v1[c]) + value[3] * bend0 +
                        value[4] * bend1;
                v_[c] =
                    (slope[0] * move + slope[3] * bend0 + slope[4] * bend1) / h + slope[1] * v0[c] + slope[2] * v1[c];
            }
            if (!accelerate(q_.data(), v_.data(), i)) return false;
        }
        for (int c = 0; c < n_; ++c) {
            double gained = 0.0, moved = 0.0;
            for (std::size_t i = 0; i <= last; ++i) {
                const double part = rule_.weights[i] * a_[i * n_ + c];
                gained += part;
                moved += (1.0 - rule_.points[i]) * part;
            }
            const double dv = std::abs(v1[c] - v0[c] - h * gained);
            off_v_[c] += dv;
            off_q_[c] += std::abs(q1[c] - q0[c] - h * (v0[c] + h * moved)) + left * dv;
        }
        return true;
    }

    bool accelerate(const double* q, const double* v, std::size_t point) {
        if (!dynamics_.at(q, v)) return false;
        dynamics_.acceleration(&force_[point * n_], &a_[point * n_]);
        return true;
    }

    void force_at(std::int64_t k, double* force) const {
        constant_force(mechanism_, nullptr, record_.u + k * mechanism_.controls, force);
    }

    // Whether disturbances grow by less than a factor: whether r is above the logarithmic norm of the motion linearized
    // at two of its nodes, and so above the rates of all modes, for errors that grow as exp(aligned r t). Of (dq, dv)
    // the norm is r^2 dq'M dq + dv'M dv.
    bool grows_less(double factor) {
        if (!(factor < std::numeric_limits<double>::infinity())) return true;
        const double r = std::log(factor) / (clear_.aligned * record_.h * static_cast<double>(record_.steps));
        if (!(r > 0.0)) return false;
        const int n = n_, size = 2 * n;
        ForwardDynamics dynamics(mechanism_, true);
        std::vector<double> aq(n * n), av(n * n), af(n * n), by_q(n * n), by_v(n * n), test(size * size);
        for (std::int64_t node : {record_.steps / 3, 2 * record_.steps / 3}) {
            const double *q = record_.q + node * n, *v = record_.v + node * n;
            for (auto* matrix : {&aq, &av, &af}) std::fill(matrix->begin(), matrix->end(), 0.0);
            force_at(node, force_.data());
            if (!dynamics.at(q, v)) return false;
            dynamics.acceleration(force_.data(), a_.data());
            dynamics.differentiate(v, a_.data());
            dynamics.derivatives(aq.data(), av.data(), af.data());
            inertias_.at(q);
            const auto times_mass = [&](const std::vector<double>& x, std::vector<double>& out) {
                for (int i = 0; i < n; ++i) {
                    for (int j = 0; j < n; ++j) {
                        double sum = 0.0;
                        for (int k = 0; k < n; ++k) sum += inertias_.mass(i, k) * x[k * n + j];
                        out[i * n + j] = sum;
                    }
                }
            };
            times_mass(aq, by_q);
            times_mass(av, by_v);
            for (int i = 0; i < n; ++i) {
                for (int j = 0; j < n; ++j) {
                    const double mass = inertias_.mass(i, j);
                    test[i * size + j] = r * r * r * mass;
                    test[(n + i) * size + j] = -0.5 * (r * r * mass + by_q[i * n + j]);
                    test[(n + i) * size + n + j] = r * mass - 0.5 * (by_v[i * n + j] + by_v[j * n + i]);
                }
            }
            if (!factor_ldl(test.data(), size, {0, size})) return false;
        }
        return true;
    }
};

}  // namespace varpin
