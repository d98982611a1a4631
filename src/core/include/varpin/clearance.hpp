// Motions that are clearly right, from the residual of the equations of motion along their record. docs/limits.md, "The
// warnings".
//
// Through the nodes of one step or of two goes the polynomial with their q, v and accelerations a, of degree 5 or 8.
// With the accelerations a(t) of the scene on it, each of its steps is off by
//
//     dv = v1 - v0 - integral of a(t)        dq = q1 - q0 - h v0 - integral of (t1 - t) a(t)
//
// and by the error of the quadrature. Either is small for small errors in steps that resolve the motion, and not for
// others.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/dynamics.hpp"
#include "varpin/look.hpp"
#include "varpin/policy.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// Polynomials over some consecutive steps of unit length, and a quadrature on them. The first of the points is the
// start of the steps, the last one is their end, and all nodes between are evenly spaced among them.
struct Stretch {
    int steps = 0, points = 0, stages = 0;
    // (2, points, 3 (steps + 1)): values and slopes at the points of the polynomials that belong to q, v, a of each
    // node.
    std::vector<double> curves;
    // (2, steps, points): weights of the integrals of a and of (t1 - t) a over each step to t1.
    std::vector<double> sums;
    // (points, steps stages): factors of the controls at the stages of the steps on those at the points.
    std::vector<double> places;

    int node(int j) const { return j * (points - 1) / steps; }
};

// Largest errors of a motion that is clearly right.
struct Clear {
    double still = 0.0;          // velocity up to which nothing moves
    double energy = 0.0;         // of the balance, as a share of the energy that is turned over
    double damping = 0.0;        // rates of dampers along single steps, in units of 1 / h
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
    // `wide` is a stretch of two steps, or null.
    Clearance(const Mechanism& mechanism, const Record& record, const double* within, const Stretch& narrow,
              const Stretch* wide, const Clear& clear)
        : mechanism_(mechanism),
          record_(record),
          within_(within),
          narrow_(narrow),
          wide_(wide),
          clear_(clear),
          n_(mechanism.dof()),
          dynamics_(mechanism, false),
          inertias_(mechanism),
          before_(n_),
          last_(n_),
          q_(n_),
          v_(n_),
          off_q_(n_),
          off_v_(n_) {
        const int points = std::max(narrow.points, wide ? wide->points : 0);
        const int steps = std::max(narrow.steps, wide ? wide->steps : 0);
        for (auto* rows : {&force_, &a_}) rows->resize(points * n_);
        for (auto* rows : {&step_q_, &step_v_}) rows->resize(steps * n_);
    }

    // The factor up to which disturbances may grow over the motion for it to be clearly right: infinite where they grow
    // less, 0 where it is not. `defect` (N) is the error of the energy balance, `substeps` (N) the number of parts of
    // each step.
    double growth(const double* defect, const std::int64_t* substeps) {
        const Glance seen = glance(mechanism_, record_, substeps);
        const bool plain = seen.fastest > clear_.still && !seen.split && !seen.pulled && balanced(defect) &&
                           !(clear_.known >= 0.0 && damped());
        if (!plain) return 0.0;
        double found = growth_of_errors();
        // Controls may have kinks at the nodes.
        if (found == 0.0 && wide_ && within_) {
            wide_ = nullptr;
            found = growth_of_errors();
        }
        return found;
    }

  private:
    const Mechanism& mechanism_;
    const Record& record_;
    const double* within_;  // (N, s, m) controls at the stages; null for controls that are constant over each step
    const Stretch& narrow_;
    const Stretch* wide_;
    const Clear& clear_;
    int n_;
    ForwardDynamics dynamics_;
    Inertias inertias_;
    std::vector<double> force_, a_;        // (points, n) of a stretch: of the controls, and accelerations
    std::vector<double> before_, last_;    // the same at the end of the stretch before
    std::vector<double> step_q_, step_v_;  // errors of the steps of a stretch (steps, n)
    std::int64_t from_ = 0, until_ = 0;    // its nodes
    std::vector<double> q_, v_, off_q_, off_v_;
    std::optional<bool> damped_;

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
        if (!damped_) damped_ = outpaced();
        return *damped_;
    }

    bool outpaced() {
        if (!mechanism_.forces.any()) return false;
        std::vector<double> force(n_);
        const std::int64_t last = clear_.damped_at - 1;
        for (std::int64_t i = 0; i <= last; ++i) {
            const std::int64_t node = i * record_.steps / last;
            force_at(std::min(node, record_.steps - 1), force.data());
            inertias_.masses_at(record_.q + node * n_);
            inertias_.forces_at(record_.q + node * n_, record_.v + node * n_, force.data());
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
        from_ = until_ = -1;
        for (std::int64_t piece = 0; piece < pieces; ++piece) {
            const std::int64_t begin = piece * steps / pieces, end = (piece + 1) * steps / pieces;
            std::fill(off_q_.begin(), off_q_.end(), known ? clear_.known : 0.0);
            // No mode turns or decays by much in a step here.
            std::fill(off_v_.begin(), off_v_.end(), known ? 2.0 * clear_.known / record_.h : 0.0);
            for (std::int64_t k = begin; k < end && !known; ++k) {
                if (k >= until_ && !examine(k)) return 0.0;
                const double left = record_.h * static_cast<double>(end - k - 1);
                for (int c = 0; c < n_; ++c) {
                    const double dv = step_v_[(k - from_) * n_ + c];
                    off_v_[c] += dv;
                    off_q_[c] += step_q_[(k - from_) * n_ + c] + left * dv;
                }
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

    // The errors of the steps of a stretch with step k; false where they are not known.
    bool examine(std::int64_t k) {
        const bool pair = wide_ && record_.steps > 1;
        if (pair && k + 1 < record_.steps && alike(k)) return examine(*wide_, k);
        if (pair && k > 0 && alike(k - 1)) return examine(*wide_, k - 1);
        // Along one step, methods of few stages fulfil the equations however wrong a fast damper's velocity is.
        return !damped() && examine(narrow_, k);
    }

    // Whether the controls of steps k and k + 1 do not jump between them.
    bool alike(std::int64_t k) const {
        const int m = mechanism_.controls;
        const double* u = record_.u + k * m;
        return within_ || std::equal(u, u + m, u + m);
    }

    bool examine(const Stretch& rule, std::int64_t k) {
        const double *q = record_.q + k * n_, *v = record_.v + k * n_, h = record_.h;
        const int last = rule.points - 1, terms = 3 * (rule.steps + 1);
        apply_controls(rule, k);
        // The acceleration at the first node is the last one, unless the controls differ.
        if (k == until_ && std::equal(before_.begin(), before_.end(), force_.begin())) {
            std::copy(last_.begin(), last_.end(), a_.begin());
        } else if (!accelerate(q, v, 0)) {
            return false;
        }
        for (int j = 1; j <= rule.steps; ++j) {
            if (!accelerate(q + j * n_, v + j * n_, rule.node(j))) return false;
        }
        for (int i = 1; i < last; ++i) {
            if (i * rule.steps % last == 0) continue;
            const double* value = &rule.curves[i * terms];
            const double* slope = value + rule.points * terms;
            std::copy_n(q, n_, q_.begin());
            std::fill(v_.begin(), v_.end(), 0.0);
            for (int j = 0; j <= rule.steps; ++j, value += 3, slope += 3) {
                const double* a = &a_[rule.node(j) * n_];
                for (int c = 0; c < n_; ++c) {
                    const double moved = q[j * n_ + c] - q[c], speed = h * v[j * n_ + c], bend = h * h * a[c];
                    q_[c] += value[0] * moved + value[1] * speed + value[2] * bend;
                    v_[c] += (slope[0] * moved + slope[1] * speed + slope[2] * bend) / h;
                }
            }
            if (!accelerate(q_.data(), v_.data(), i)) return false;
        }
        for (int j = 0; j < rule.steps; ++j, q += n_, v += n_) {
            const double* gains = &rule.sums[j * rule.points];
            const double* moves = gains + rule.steps * rule.points;
            for (int c = 0; c < n_; ++c) {
                double gained = 0.0, moved = 0.0;
                for (int i = 0; i <= last; ++i) {
                    gained += gains[i] * a_[i * n_ + c];
                    moved += moves[i] * a_[i * n_ + c];
                }
                step_v_[j * n_ + c] = std::abs(v[n_ + c] - v[c] - h * gained);
                step_q_[j * n_ + c] = std::abs(q[n_ + c] - q[c] - h * (v[c] + h * moved));
            }
        }
        std::copy_n(&force_[last * n_], n_, before_.begin());
        std::copy_n(&a_[last * n_], n_, last_.begin());
        from_ = k;
        until_ = k + rule.steps;
        return true;
    }

    // The forces of the controls at the points of a stretch.
    void apply_controls(const Stretch& rule, std::int64_t k) {
        if (!within_) {
            force_at(k, force_.data());
            for (int i = 1; i < rule.points; ++i) std::copy_n(force_.data(), n_, &force_[i * n_]);
            return;
        }
        const int m = mechanism_.controls, stages = rule.steps * rule.stages;
        const double* u = within_ + k * rule.stages * m;
        std::fill(force_.begin(), force_.end(), 0.0);
        for (int i = 0; i < rule.points; ++i) {
            for (int s = 0; s < stages; ++s) {
                const double share = rule.places[i * stages + s];
                for (const Transmission& own : mechanism_.actuation)
                    force_[i * n_ + own.coordinate] += share * own.ratio * u[s * m + own.control];
            }
        }
    }

    bool accelerate(const double* q, const double* v, int point) {
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
            inertias_.masses_at(q);
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
