// Steppers, passes and costs have all their memory once they are made, and linearizations after their first step: a
// controller may run them at its rate.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <new>
#include <span>
#include <vector>

#include "arm.hpp"
#include "varpin/backward.hpp"
#include "varpin/constrained.hpp"
#include "varpin/costs.hpp"
#include "varpin/explicit.hpp"
#include "varpin/linearization.hpp"
#include "varpin/variational.hpp"

namespace {

int allocations = 0;

constexpr int n = 3, N = 20;
constexpr double infinity = std::numeric_limits<double>::infinity();

// The chain with a spring and a damper from its tip to the world.
varpin::Mechanism coupled_chain() {
    varpin::Mechanism out = arm();
    const varpin::Anchor tip{n - 1, {1.0, 0.0, 0.0}};
    out.couplings = {
        {varpin::FrameSpring{tip, {}, {20.0, 20.0, 20.0}, {}}, varpin::FrameDamper{tip, {}, {0.5, 0.5, 0.5}}},
        out.tree.bodies};
    return out;
}

template <class Run>
bool without_allocation(const char* what, const Run& run) {
    const int before = allocations;
    const bool done = run();
    if (!done) std::printf("%s: not done\n", what);
    if (allocations != before) std::printf("%s: %d allocations\n", what, allocations - before);
    return done && allocations == before;
}

}  // namespace

void* operator new(std::size_t size) {
    ++allocations;
    if (void* memory = std::malloc(size)) return memory;
    throw std::bad_alloc();
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

const varpin::Tableau midpoint{.stages = 1,
                               .a = {0.5},
                               .gradient = {0.5},
                               .force = {0.5},
                               .b = {1.0},
                               .c = {0.5},
                               .ahead = {-1.0, 2.0},
                               .reach = 0.25};

bool allocates_nothing(const varpin::Mechanism& mechanism) {
    const double q0[n] = {0.3, -0.2, 0.1}, v0[n] = {}, h = 0.01;
    std::vector<double> u(N * n, 0.5), q(N * n), p(N * n), v(N * n), energy(N), applied(N * n), quality(3 * N);
    std::vector<double> least(n, -infinity), greatest(n, infinity);
    std::vector<std::int64_t> tally(4 * N);
    std::int64_t ended = 0, done = 0;
    const varpin::Commands commands{
        .controls = n, .u = u.data(), .width = 2 * n, .least = least.data(), .greatest = greatest.data()};
    const varpin::Nodes nodes{.paths = 1,
                              .steps = N,
                              .q = q.data(),
                              .p = p.data(),
                              .v = v.data(),
                              .energy = energy.data(),
                              .u = applied.data(),
                              .tally = tally.data(),
                              .quality = quality.data(),
                              .ended = &ended,
                              .done = &done};
    bool right = true;

    varpin::ExplicitRollout runge_kutta(mechanism, varpin::ExplicitMethod::runge_kutta, 1, q0, v0);
    right &= without_allocation("Runge and Kutta", [&] {
        runge_kutta.roll(h, commands, {}, nodes);
        return done == N;
    });

    const std::vector<double> impulses(2 * N * n, 1e-3);
    right &= without_allocation("Runge and Kutta under impulses", [&] {
        runge_kutta.roll(h, commands, {.impulses = impulses.data()}, nodes);
        return done == N;
    });

    varpin::VariationalStepper stepper(mechanism, midpoint, 0.5, {}, 1.0);
    std::vector<varpin::PathState> paths(1, varpin::PathState(mechanism, midpoint.stages));
    right &= without_allocation("midpoint steps", [&] {
        if (!stepper.begin(q0, v0, paths[0])) return false;
        stepper.roll(h, commands, {}, paths, nodes);
        return done == N;
    });

    right &= without_allocation("midpoint steps under impulses", [&] {
        if (!stepper.begin(q0, v0, paths[0])) return false;
        stepper.roll(h, commands, {.impulses = impulses.data()}, paths, nodes);
        return done == N;
    });

    varpin::VariationalLinearization linearization(mechanism, midpoint, 0.5, {.active = false});
    std::vector<double> A(N * 4 * n * n), B(N * 2 * n * n);
    std::span<const std::uint8_t> halvings;
    const auto differentiate = [&] {
        double guess[n];
        for (int s = 1; s < N; ++s) {
            for (int i = 0; i < n; ++i) guess[i] = (q[s * n + i] - q[(s - 1) * n + i]) / h;
            const varpin::RepeatedStep step{.h = h,
                                            .q = &q[(s - 1) * n],
                                            .p = &p[(s - 1) * n],
                                            .force = &u[s * n],
                                            .guess = guess,
                                            .halvings = halvings};
            const varpin::StepDerivatives to{.state = &A[s * 4 * n * n], .force = &B[s * 2 * n * n]};
            const varpin::Outcome outcome = linearization.first(step, to);
            if (outcome != varpin::Outcome::solved) return false;
        }
        return true;
    };
    right &= differentiate() && without_allocation("their derivatives", differentiate);
    const std::uint8_t parts[] = {1, 2, 2};
    halvings = parts;
    right &= without_allocation("those of steps in parts", differentiate);

    constexpr int x = 2 * n, size = 3 * n;
    std::vector<double> gradient(N * size, 0.1), hessian(size * size), terminal(x, 1.0), terminal_hessian(x * x);
    for (int i = 0; i < size; ++i) hessian[i * size + i] = 1.0;
    for (int i = 0; i < x; ++i) terminal_hessian[i * x + i] = 1.0;
    std::vector<double> k(N * n), K(N * n * x), slopes(N * n), factors(N * n * n);
    const varpin::ExpandedSteps steps{.steps = N,
                                      .dof = n,
                                      .controls = n,
                                      .A = A.data(),
                                      .B = B.data(),
                                      .gradient = gradient.data(),
                                      .hessian = hessian.data(),
                                      .one_hessian = true};
    varpin::BackwardPass pass(n, n, terminal.data(), terminal_hessian.data());
    right &= without_allocation("the backward pass", [&] {
        return pass.run(h, 1, 0.0, steps,
                        {.feedforward = k.data(),
                         .feedback = K.data(),
                         .control_gradient = slopes.data(),
                         .factors = factors.data()}) < 0;
    });
    const varpin::Links links{mechanism.tree.bodies, n};
    const varpin::Placement tip{{{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}}, {1.0, 0.0, 0.0}};
    const std::vector<double> one{1.0}, three{1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0};
    std::vector<double> six(36);
    for (int i = 0; i < 6; ++i) six[i * 7] = 1.0;
    using varpin::Subject;
    const varpin::CostTerms costs{.dof = n,
                                  .controls = n,
                                  .frames = {{links, tip}, {.links = links, .offset = {}, .center = true}},
                                  .terms = {{Subject::entries, 3, 0, three, {0.0, 0.0, 0.0}},
                                            {Subject::excess, 3, n, three, {0.1, 0.1, 0.1, 0.2, 0.2, 0.2}},
                                            {Subject::position, 3, 0, three, {0.0, 0.0, 0.0}},
                                            {Subject::orientation, 3, 0, three, three},
                                            {Subject::twist, 6, 0, six, std::vector<double>(6)},
                                            {Subject::manipulability, 1, 0, one, {100.0}, {0, 2}},
                                            {Subject::position, 3, 1, three, {0.0, 0.0, 0.0}}}};
    varpin::CostSample sample(costs);
    std::vector<double> own_gradient(size), own_hessian(size * size), values(costs.terms.size());
    right &= without_allocation("costs", [&] {
        for (int s = 0; s + 1 < N; ++s) {
            sample.values(&q[s * n], &v[s * n], &u[s * n], 0, values.data());
            sample.expand(&q[s * n], &v[s * n], &u[s * n], 0, own_gradient.data(), own_hessian.data());
        }
        return values[5] > 0.0;
    });
    return right;
}

// A chain whose tip slides along a line, from rest.
bool constrained_steps_allocate_nothing() {
    varpin::Mechanism mechanism = arm();
    const varpin::Anchor tip{n - 1, 2.0 * mechanism.tree.bodies[n - 1].center};
    const varpin::Anchor across{-1, {0.0, 0.0, 1.0}, true};
    const double q0[n] = {0.4, 0.3, -0.5}, v0[n] = {}, h = 0.001;
    const double height = -std::sin(0.4) - std::sin(0.7) - std::sin(0.2);
    mechanism.constraints = {
        {{{tip}}, {{across}}}, {{.x = 0, .y = 1, .constant = height}}, {}, {}, mechanism.tree.bodies, n};
    varpin::ConstrainedStepper stepper(mechanism, midpoint, {0.0, 1.0}, 0.5, {});
    varpin::PathState state(mechanism, 1);
    const std::vector<double> force(n);
    const auto steps = [&] {
        for (int s = 0; s < N; ++s) {
            if (stepper.step(h, state) != varpin::Outcome::solved) return false;
        }
        return true;
    };
    if (!stepper.begin(q0, v0, state)) return false;
    stepper.take_force(force.data(), false);
    // The first steps make room at the start, the end and the start before.
    return steps() && without_allocation("steps under constraints", steps);
}

int main() {
    const bool alone = allocates_nothing(arm()), coupled = allocates_nothing(coupled_chain());
    return alone && coupled && constrained_steps_allocate_nothing() ? 0 : 1;
}
