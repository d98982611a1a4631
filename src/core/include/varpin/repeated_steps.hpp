// The steps of a trajectory, repeated for their derivatives. docs/mathematics.md, "Linearization".
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/sensitivities.hpp"
#include "varpin/substeps.hpp"
#include "varpin/variational.hpp"

namespace varpin {

// A step that is to be repeated.
struct RepeatedStep {
    double h = 0.0;
    const double *q = nullptr, *p = nullptr;   // (n) its start
    const double* force = nullptr;             // (n) constant over it, or (s, n) at its stages
    const double* guess = nullptr;             // (s, n) stage velocities close to those of an undivided step
    std::span<const std::uint8_t> halvings{};  // of its parts; none for an undivided step
    int past = 0;                              // earlier steps that q, p and force have before the pointers
    const double* rates = nullptr;             // of kinematic inputs at their goals
};

// Derivatives of the end (q1, p1) of a step, in 2n rows each; null where they are not wanted.
struct StepDerivatives {
    double* state = nullptr;       // (2n, 2n) in (q0, p0)
    double* force = nullptr;       // (2n, n) in a constant force f
    double* ramp = nullptr;        // (2n, n) in one that grows linearly from 0 at the start of the step to f at its end
    double* rates = nullptr;       // (2n, i) in the rates of kinematic inputs at their goals
    double* parameters = nullptr;  // (2n, k)

    std::array<double*, 5> kinds() const { return {state, force, ramp, rates, parameters}; }
};

// Derivatives of a step from those of its parts.
class ChainedDerivatives {
  public:
    ChainedDerivatives(int n, int rates) : rows_(2 * n), columns_{2 * n, n, n, rates, 0}, product_(rows_ * rows_) {
        for (int kind = 0; kind < 4; ++kind) values_[kind].resize(entries(rows_, columns_[kind]));
        part = {.state = values_[0].data(), .force = values_[1].data()};
    }

    StepDerivatives part;  // of the last part

    void take_parameters(int count) {
        columns_[4] = count;
        values_[4].resize(entries(rows_, count));
        product_.resize(rows_ * std::max(rows_, count));
    }

    // The derivatives of a step of zero length; those of parts are of the same kinds.
    void begin(const StepDerivatives& to) {
        const auto own = [&](int kind) { return to.kinds()[kind] ? values_[kind].data() : nullptr; };
        part = {own(0), own(1), own(2), own(3), own(4)};
        for (int kind = 0; kind < 5; ++kind) {
            if (to.kinds()[kind]) std::fill_n(to.kinds()[kind], rows_ * columns_[kind], 0.0);
        }
        for (int i = 0; i < rows_; ++i) to.state[i * (rows_ + 1)] = 1.0;
    }

    // Multiply by the derivatives of the last part.
    void follow(const StepDerivatives& to) {
        for (int kind = 0; kind < 5; ++kind) {
            double* whole = to.kinds()[kind];
            const int size = rows_ * columns_[kind];
            if (!whole) continue;
            detail::multiply(part.state, whole, rows_, rows_, columns_[kind], product_.data());
            for (int i = 0; i < size; ++i) whole[i] = product_[i] + (kind > 0 ? values_[kind][i] : 0.0);
        }
    }

  private:
    int rows_;
    std::array<int, 5> columns_;
    std::array<std::vector<double>, 5> values_;
    std::vector<double> product_;
};

// Derivatives of steps: those of the map of a stepper. With active guards, a part that they refuse is halved, since a
// step may need other parts without its noise. Without them, the parts are exactly those given.
class StepLinearization {
  public:
    virtual ~StepLinearization() = default;

    bool varies = false;  // each step has forces (s, n) at its stages instead of a constant force (n)

    // Parameters in which `first` takes derivatives.
    void take(std::vector<Parameter> parameters) {
        columns.emplace(stepper->equation, std::move(parameters));
        chained.take_parameters(columns->count());
    }
    std::size_t parameters() const { return columns ? columns->parameters.size() : 0; }

    // Take derivatives in an external force (n), which acts beside f unless null, in the place of f, which drives
    // limit.
    void take_external(const double* force = nullptr) {
        stepper->equation.by_external = true;
        stepper->outer = force;
    }

    // Derivatives of a step. An undivided one is solved again from its guess; the parts of a divided one are repeated,
    // and their derivatives are multiplied.
    Outcome first(const RepeatedStep& at, const StepDerivatives& to) {
        if (at.halvings.empty() && (stepper->m > 0 || !stepper->guards.active)) {
            const Outcome outcome = root(at);
            if (outcome == Outcome::solved) differentiate(at.h, 0.0, 1.0, to);
            if (outcome == Outcome::solved || !stepper->guards.active) return outcome;
        }
        return in_parts(at, to);
    }

  protected:
    explicit StepLinearization(std::unique_ptr<VariationalStepper> made, int rates = 0)
        : stepper(std::move(made)),
          n(stepper->n),
          stages(stepper->stages),
          state(stepper->mechanism, stages),
          from(n),
          from_p(n),
          chained(n, rates) {}

    std::unique_ptr<VariationalStepper> stepper;
    int n, stages;
    PathState state;
    std::vector<Coordinate> from;  // where the last part began
    std::vector<Compensated> from_p;
    ChainedDerivatives chained;
    std::optional<ParameterColumns> columns;
    std::vector<double> dV;                           // derivatives of the stage velocities
    std::vector<double> again = zeros(2 * n, 2 * n);  // derivatives in the state once more, which nobody reads

    // Solve an undivided step.
    virtual Outcome root(const RepeatedStep& at) = 0;
    // Derivatives of the part of a step, at `begin` with length `share` in units of the step, whose root is in the
    // stepper.
    virtual void differentiate(double h, double begin, double share, const StepDerivatives& to) = 0;

    // Repeat the parts of a step. After each solved part, with its root in the stepper, calls visit(begin, length),
    // with the begin in units of the step.
    template <class Visit>
    Outcome parts(const RepeatedStep& at, const Visit& visit) {
        if (!enter(at)) return Outcome::singular;
        return parts_again(at.halvings, stepper->guards.halvings_again(), [&](int level, double begin) {
            from = state.position;
            from_p = state.p;
            const Outcome outcome = stepper->part(at.h, level, begin, state);
            if (outcome == Outcome::solved) visit(begin, length_of(at.h, level));
            return outcome;
        });
    }

    Outcome in_parts(const RepeatedStep& at, const StepDerivatives& to) {
        chained.begin(to);
        return parts(at, [&](double begin, double length) {
            differentiate(length, begin, length / at.h, chained.part);
            chained.follow(to);
        });
    }

    // Begin a step; false where M is not positive definite. Its momentum may have a part normal to constraints.
    bool enter(const RepeatedStep& at) {
        stepper->take_force(at.force, varies, at.rates);
        return stepper->begin_at(at.q, at.p, state, false);
    }
};

}  // namespace varpin
