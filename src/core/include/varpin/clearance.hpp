// Motions that are clearly right, from the residual of the equations of motion along their record. docs/mathematics.md,
// "The error of a motion".
//
// Through the nodes of one step or of two goes the polynomial with their q, v and accelerations a, of degree 5 or 8.
// With the accelerations a(t) of the scene on it, each of its steps is off by
//
//     dv = v1 - v0 - integral of a(t)        dq = q1 - q0 - h v0 - integral of (t1 - t) a(t)
//
// and by the error of the quadrature. Either is small for small errors in steps that resolve the motion, and not for
// others. What is off propagates as the linearized motion does.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/dynamics.hpp"
#include "varpin/mechanism.hpp"
#include "varpin/policy.hpp"

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

// N steps and their nodes, row-major.
struct Record {
    std::int64_t steps = 0;
    const double* q = nullptr;  // (N + 1, n)
    const double* v = nullptr;  // (N + 1, n)
    const double* u = nullptr;  // (N, m)
    double h = 0.0;             // [s]
};

class Clearance {
  public:
    // `wide` is a stretch of two steps, or null. With fast dampers, `damped`, errors are not known along single steps.
    Clearance(const Mechanism& mechanism, const Record& record, const double* within, const Stretch& narrow,
              const Stretch* wide, bool damped)
        : mechanism_(mechanism),
          record_(record),
          within_(within),
          narrow_(narrow),
          wide_(wide),
          damped_(damped),
          n_(mechanism.dof()),
          dynamics_(mechanism, false),
          slopes_(mechanism, true) {
        const int points = std::max(narrow.points, wide ? wide->points : 0);
        const int steps = std::max(narrow.steps, wide ? wide->steps : 0);
        for (auto* rows : {&force_, &a_}) rows->resize(points * n_);
        for (auto* rows : {&step_q_, &step_v_}) rows->resize(steps * n_);
    }

    // The largest errors of q at the nodes (n), from the defects of the steps. Infinite where they are not known, as
    // along steps that dampers outpace, or where some exceed `most_q` or, of v, `most_v` (n).
    std::vector<double> errors(const double* most_q, const double* most_v) {
        std::vector<double> found = propagated(most_q, most_v);
        // Controls may have kinks at the nodes.
        if (!(found.empty() || std::isfinite(found[0])) && wide_ && within_) {
            wide_ = nullptr;
            found = propagated(most_q, most_v);
        }
        return found;
    }

  private:
    const Mechanism& mechanism_;
    const Record& record_;
    const double* within_;  // (N, s, m) controls at the stages; null for controls that are constant over each step
    const Stretch& narrow_;
    const Stretch* wide_;
    bool damped_;
    int n_;
    ForwardDynamics dynamics_, slopes_;
    std::vector<double> force_, a_;  // (points, n) of a stretch: of the controls, and accelerations
    std::vector<double> before_ = zeros(n_), last_ = zeros(n_);  // the same at the end of the stretch before
    std::vector<double> step_q_, step_v_;                        // defects of the steps of a stretch (steps, n)
    std::int64_t from_ = 0, until_ = 0;                          // its nodes
    std::vector<double> q_ = zeros(n_), v_ = zeros(n_), rate_ = zeros(n_), error_q_ = zeros(n_), error_v_ = zeros(n_);
    std::vector<double> aq_ = zeros(n_, n_), av_ = zeros(n_, n_), af_ = zeros(n_, n_), lu_ = zeros(n_, n_);

    // The error e of the motion from its defects l: e -> Phi e + l, with the flow Phi of the motion linearized in the
    // middle of each few steps, by the implicit midpoint rule.
    std::vector<double> propagated(const double* most_q, const double* most_v) {
        const std::vector<double> none(n_, std::numeric_limits<double>::infinity());
        std::vector<double> found(n_, 0.0);
        std::fill(error_q_.begin(), error_q_.end(), 0.0);
        std::fill(error_v_.begin(), error_v_.end(), 0.0);
        from_ = until_ = -1;
        for (std::int64_t k = 0; k < record_.steps; ++k) {
            if (k >= until_ && !examine(k)) return none;
            if (k % frozen == 0 && !linearize(std::min(k + frozen / 2, record_.steps - 1))) return none;
            advance();
            for (int c = 0; c < n_; ++c) {
                error_q_[c] += step_q_[(k - from_) * n_ + c];
                error_v_[c] += step_v_[(k - from_) * n_ + c];
                found[c] = larger(found[c], std::abs(error_q_[c]));
                if (!(found[c] <= most_q[c] && std::abs(error_v_[c]) <= most_v[c])) return none;
            }
        }
        return found;
    }

    // Number of steps with the same linearization.
    static constexpr std::int64_t frozen = 4;

    // The derivatives of the accelerations at a node, and the factors of 1 - h/2 av - h^2/4 aq.
    bool linearize(std::int64_t node) {
        const double *q = record_.q + node * n_, *v = record_.v + node * n_, h = record_.h;
        for (auto* matrix : {&aq_, &av_, &af_}) std::fill(matrix->begin(), matrix->end(), 0.0);
        force_at(node, rate_.data());
        if (!slopes_.at(q, v)) return false;
        std::vector<double>& a = q_;
        slopes_.acceleration(rate_.data(), a.data());
        slopes_.differentiate(v, a.data());
        slopes_.derivatives(aq_.data(), av_.data(), af_.data());
        for (int i = 0; i < n_ * n_; ++i)
            lu_[i] = (i % (n_ + 1) == 0 ? 1.0 : 0.0) - 0.5 * h * av_[i] - 0.25 * h * h * aq_[i];
        return factor_lu(lu_.data(), n_, {0, n_});
    }

    // One step of the linearized motion: v1 = 2 vm - v0 and q1 = q0 + h vm, with the mean velocity vm.
    void advance() {
        const double h = record_.h;
        for (int i = 0; i < n_; ++i) {
            double sum = error_v_[i];
            for (int j = 0; j < n_; ++j) sum += 0.5 * h * aq_[i * n_ + j] * error_q_[j];
            rate_[i] = sum;
        }
        solve_lu(lu_.data(), n_, {0, n_}, rate_.data(), rate_.data());
        for (int i = 0; i < n_; ++i) {
            error_q_[i] += h * rate_[i];
            error_v_[i] = 2.0 * rate_[i] - error_v_[i];
        }
    }

    // The errors of the steps of a stretch with step k; false where they are not known.
    bool examine(std::int64_t k) {
        const bool pair = wide_ && record_.steps > 1;
        if (pair && k + 1 < record_.steps && alike(k)) return examine(*wide_, k);
        if (pair && k > 0 && alike(k - 1)) return examine(*wide_, k - 1);
        // Along one step, methods of few stages fulfil the equations however wrong a fast damper's velocity is.
        return !damped_ && examine(narrow_, k);
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
                step_v_[j * n_ + c] = v[n_ + c] - v[c] - h * gained;
                step_q_[j * n_ + c] = q[n_ + c] - q[c] - h * (v[c] + h * moved);
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
};

}  // namespace varpin
