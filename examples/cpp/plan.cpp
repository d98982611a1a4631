// A reach of an arm, planned and followed with varpin's headers alone: rollouts of the midpoint integrator, their
// derivatives, backward passes, and the gains at work on an arm that starts elsewhere. `plan FILE` writes what it found
// as doubles: controls (N, m), nodes q and p (N, n), gains (N, m, 2n), nodes q of the disturbed arm (N, n).
//
// The cost is (1/2) sum h r |u - u0|^2 + (1/2) (a |q_N - goal|^2 + b |p_N|^2): an arm at rest has no momentum.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <limits>
#include <span>
#include <vector>

#include "arm.hpp"
#include "varpin/backward.hpp"
#include "varpin/jet.hpp"
#include "varpin/linearization.hpp"
#include "varpin/variational.hpp"

namespace {

using Vector = std::vector<double>;

constexpr int N = 100;
constexpr double h = 0.01;  // [s]
constexpr double effort = 1e-4, at_goal = 1e3, at_rest = 10.0;
const Vector start{0.0, -1.5, 1.5, 0.0, 0.5, 0.0}, goal{0.6, -1.0, 1.2, -0.4, 0.8, 0.3};  // [rad]

const varpin::Mechanism mechanism = arm();
const int n = mechanism.dof(), m = mechanism.controls, x = 2 * n;
const varpin::Tableau midpoint{.stages = 1,
                               .a = {0.5},
                               .gradient = {0.5},
                               .force = {0.5},
                               .b = {1.0},
                               .c = {0.5},
                               .ahead = {-1.0, 2.0},
                               .reach = 0.25};
constexpr double tolerance = 0.5;  // in units of what rounding leaves of the step equation

// Controls and the nodes after each step.
struct Motion {
    Vector u = Vector(N * m), q = Vector(N * n), p = Vector(N * n), v = Vector(N * n), energy = Vector(N),
           quality = Vector(3 * N);
    std::vector<std::int64_t> tally = std::vector<std::int64_t>(4 * N);
    std::vector<std::uint8_t> halvings;  // of the parts of steps that were not taken whole
    std::int64_t ended = 0, done = 0;

    bool whole() const { return done == N; }
    // At the beginning of step s.
    const double* q_before(int s) const { return s > 0 ? &q[(s - 1) * n] : start.data(); }
    const double* p_before(int s) const { return s > 0 ? &p[(s - 1) * n] : rest.data(); }

  private:
    Vector rest = Vector(n);
};

// The motion from rest at q0, under u or, with gains (N, m, 2n), under u + gains (x - reference).
Motion rollout(const Vector& q0, const Vector& u, const Vector* gains = nullptr, const Vector* reference = nullptr) {
    constexpr double infinity = std::numeric_limits<double>::infinity();
    const Vector least(m, -infinity), greatest(m, infinity), rest(n);
    varpin::VariationalStepper stepper(mechanism, midpoint, tolerance, {}, 1.0);
    std::vector<varpin::PathState> paths(1, varpin::PathState(mechanism, midpoint.stages));
    Motion motion;
    if (!stepper.begin(q0.data(), rest.data(), paths[0])) return motion;
    stepper.roll(h,
                 {.controls = m,
                  .u = u.data(),
                  .gains = gains ? gains->data() : nullptr,
                  .reference = reference ? reference->data() : nullptr,
                  .width = x,
                  .least = least.data(),
                  .greatest = greatest.data()},
                 {}, paths,
                 {.paths = 1,
                  .steps = N,
                  .q = motion.q.data(),
                  .p = motion.p.data(),
                  .v = motion.v.data(),
                  .energy = motion.energy.data(),
                  .u = motion.u.data(),
                  .tally = motion.tally.data(),
                  .quality = motion.quality.data(),
                  .ended = &motion.ended,
                  .done = &motion.done});
    motion.halvings = paths[0].halvings;
    return motion;
}

double cost(const Motion& motion, const Vector& u0) {
    double total = 0.0;
    for (int k = 0; k < N * m; ++k) {
        const double off = motion.u[k] - u0[k % m];
        total += 0.5 * h * effort * off * off;
    }
    for (int i = 0; i < n; ++i) {
        const double off = motion.q_before(N)[i] - goal[i], p = motion.p_before(N)[i];
        total += 0.5 * (at_goal * off * off + at_rest * p * p);
    }
    return total;
}

// A (N, 2n, 2n) and B (N, 2n, m) of every step; false where a step has no derivative.
bool linearize(const Motion& motion, Vector& A, Vector& B) {
    varpin::VariationalLinearization linearization(mechanism, midpoint, tolerance, {.active = false});
    Vector guess(n), force(n), by_force(x * n);
    auto next = motion.halvings.begin();
    for (int s = 0; s < N; ++s) {
        const double* q = motion.q_before(s);
        for (int i = 0; i < n; ++i) guess[i] = (motion.q_before(s + 1)[i] - q[i]) / h;
        varpin::constant_force(mechanism, nullptr, &motion.u[s * m], force.data());
        const std::int64_t parts = motion.tally[4 * s + 3];
        const std::span halvings(next, parts > 1 ? parts : 0);
        next += halvings.size();
        const varpin::Outcome outcome = linearization.first({.h = h,
                                                             .q = q,
                                                             .p = motion.p_before(s),
                                                             .force = force.data(),
                                                             .guess = guess.data(),
                                                             .halvings = halvings},
                                                            {.state = &A[s * x * x], .force = by_force.data()});
        if (outcome != varpin::Outcome::solved) return false;
        for (int i = 0; i < x; ++i) {
            double* row = &B[(s * x + i) * m];
            std::fill(row, row + m, 0.0);
            for (const varpin::Transmission& entry : mechanism.actuation)
                row[entry.control] += by_force[i * n + entry.coordinate] * entry.ratio;
        }
    }
    return true;
}

// How to change the controls along a motion: feedforward k (N, m) and gains K (N, m, 2n).
bool backward(const Motion& motion, const Vector& u0, Vector& k, Vector& K) {
    const int size = x + m;
    Vector A(N * x * x), B(N * x * m), gradient(N * size), hessian(size * size), by_u(N * m);
    if (!linearize(motion, A, B)) return false;
    for (int s = 0; s < N; ++s) {
        for (int c = 0; c < m; ++c) gradient[s * size + x + c] = effort * (motion.u[s * m + c] - u0[c]);
    }
    for (int c = x; c < size; ++c) hessian[c * size + c] = effort;
    Vector last(x), curvature(x * x);
    for (int i = 0; i < n; ++i) {
        last[i] = at_goal * (motion.q_before(N)[i] - goal[i]);
        last[n + i] = at_rest * motion.p_before(N)[i];
        curvature[i * x + i] = at_goal;
        curvature[(n + i) * x + n + i] = at_rest;
    }
    const varpin::ExpandedSteps steps{.steps = N,
                                      .dof = n,
                                      .controls = m,
                                      .A = A.data(),
                                      .B = B.data(),
                                      .gradient = gradient.data(),
                                      .hessian = hessian.data(),
                                      .one_hessian = true};
    varpin::BackwardPass pass(n, m, last.data(), curvature.data());
    return pass.run(h, 1, 0.0, steps,
                    {.feedforward = k.data(), .feedback = K.data(), .control_gradient = by_u.data()}) < 0;
}

// x (N, 2n) at the beginning of each step.
Vector states(const Motion& motion) {
    Vector out;
    for (int s = 0; s < N; ++s) {
        out.insert(out.end(), motion.q_before(s), motion.q_before(s) + n);
        out.insert(out.end(), motion.p_before(s), motion.p_before(s) + n);
    }
    return out;
}

double miss(const Motion& motion) {
    double largest = 0.0;
    for (int i = 0; i < n; ++i) largest = std::max(largest, std::abs(motion.q_before(N)[i] - goal[i]));
    return largest;
}

}  // namespace

int main(int arguments, char** argument) {
    // What carries the arm where it starts: -L_q(q, 0).
    varpin::Jet<double> jet(mechanism.tree);
    varpin::lagrangian_jet(mechanism, start.data(), Vector(n).data(), jet);
    Vector u0(m), u(N * m), k(N * m), K(N * m * x);
    for (int c = 0; c < m; ++c) u0[c] = -jet.Lq[c];
    for (int i = 0; i < N * m; ++i) u[i] = u0[i % m];

    Motion motion = rollout(start, u);
    if (!motion.whole()) return 1;
    double least = cost(motion, u0);
    std::printf("iteration 0: cost %.6f\n", least);
    for (int iteration = 1; iteration <= 20; ++iteration) {
        if (!backward(motion, u0, k, K)) return 1;
        const Vector reference = states(motion);
        const double before = least;
        for (double part = 1.0; part > 1e-3; part *= 0.5) {
            for (int i = 0; i < N * m; ++i) u[i] = motion.u[i] + part * k[i];
            const Motion trial = rollout(start, u, &K, &reference);
            if (trial.whole() && cost(trial, u0) < least) {
                least = cost(trial, u0);
                motion = trial;
                break;
            }
        }
        std::printf("iteration %d: cost %.6f\n", iteration, least);
        if (before - least < 1e-6 * before) break;
    }
    if (!backward(motion, u0, k, K)) return 1;

    const Vector reference = states(motion);
    Vector elsewhere = start;
    for (double& angle : elsewhere) angle += 0.05;
    const Motion alone = rollout(elsewhere, motion.u), followed = rollout(elsewhere, motion.u, &K, &reference);
    std::printf("off the goal by %.4f rad as planned\n", miss(motion));
    std::printf("from 0.05 rad beside the start: %.4f rad with the controls alone, %.4f rad with feedback\n",
                miss(alone), miss(followed));
    if (arguments > 1) {
        std::ofstream file(argument[1], std::ios::binary);
        for (const Vector& values : {motion.u, motion.q, motion.p, K, followed.q})
            file.write(reinterpret_cast<const char*>(values.data()),
                       static_cast<std::streamsize>(values.size() * sizeof(double)));
        if (!file) return 1;
    }
    return 0;
}
