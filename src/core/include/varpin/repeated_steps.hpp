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

// Derivatives of a step in parameters of the mechanism. docs/mathematics.md, "Sensitivities". The parameters change
// L_q, L_v and F at the stages of a step, (Q_j, V_j) fixed, and so its equation and its end:
//
//     N dV = h sum_j (abar_ij dL_q + f_ij dF)_j - dL_v,i        dp1 = h sum_j b_j (dL_q + dF)_j + what dV gives
//
// A parameter is two mechanisms, above and below the present one. L and F are linear in most parameters, in which their
// difference is the derivative.
struct Parameter {
    const Mechanism* above;
    const Mechanism* below;
    double distance;                             // of the parameter between them
    std::vector<double> gear_above, gear_below;  // (n) by which forces of controls are greater
};

class ParameterColumns {
  public:
    ParameterColumns(const StepEquation& equation, std::vector<Parameter> parameters)
        : parameters(std::move(parameters)),
          equation_(equation),
          jet_(equation.mechanism.tree, false),
          acting_(equation.n),
          force_(equation.n) {}

    const std::vector<Parameter> parameters;
    int count() const { return static_cast<int>(parameters.size()); }

    // Equation (L5): the right side (s, n) of the step equation at its root, and the direct part (n) of the end's
    // momentum.
    void right_side(int which, double h, const double* force, int stride, std::vector<double>& right,
                    std::vector<double>& end) {
        const int n = equation_.n, stages = equation_.stages;
        const Tableau& tableau = equation_.tableau;
        right.assign(entries(stages, n), 0.0);
        end.assign(n, 0.0);
        for (int j = 0; j < stages; ++j) {
            const auto add = [&](double sign) {
                act(which, sign, &equation_.Q[j * n], &equation_.V[j * n], force + j * stride);
                const double by = sign / parameters[which].distance;
                for (int c = 0; c < n; ++c) {
                    const double F = force_[c] + acting_[c].value;
                    for (int i = 0; i < stages; ++i)
                        right[i * n + c] +=
                            by * h *
                            (tableau.gradient[i * stages + j] * jet_.Lq[c] + tableau.force[i * stages + j] * F);
                    right[j * n + c] -= by * jet_.Lv[c];
                    end[c] += by * h * tableau.b[j] * (jet_.Lq[c] + F);
                }
            };
            add(1.0);
            add(-1.0);
        }
    }

    // dL_v (n) at (q, v).
    void momentum(int which, const double* q, const double* v, std::vector<double>& out) {
        out.assign(equation_.n, 0.0);
        std::fill(force_.begin(), force_.end(), 0.0);
        for (const double sign : {1.0, -1.0}) {
            equation_.kernels.first_order(mechanism(which, sign), q, v, jet_);
            for (int c = 0; c < equation_.n; ++c) out[c] += sign / parameters[which].distance * jet_.Lv[c];
        }
    }

  private:
    const StepEquation& equation_;
    Jet<double> jet_;
    std::vector<JointForce<double>> acting_;
    std::vector<double> force_;

    const Mechanism& mechanism(int which, double sign) const {
        return sign > 0.0 ? *parameters[which].above : *parameters[which].below;
    }

    // L_q, L_v and the forces at a stage, of one of a parameter's mechanisms.
    void act(int which, double sign, const double* q, const double* v, const double* force) {
        const Mechanism& other = mechanism(which, sign);
        const std::vector<double>& gear = sign > 0.0 ? parameters[which].gear_above : parameters[which].gear_below;
        for (int c = 0; c < equation_.n; ++c) force_[c] = gear[c] * force[c];
        other.couplings.fit(jet_.couplings);
        equation_.kernels.first_order(other, q, v, jet_);
        std::fill(acting_.begin(), acting_.end(), JointForce<double>{});
        if (other.pushes())
            sum_forces(other, q, v, force_.data(), acting_.data(), jet_.couplings, static_cast<double*>(nullptr),
                       static_cast<double*>(nullptr));
    }
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
    explicit StepLinearization(std::unique_ptr<VariationalStepper> made)
        : stepper(std::move(made)),
          n(stepper->n),
          stages(stepper->stages),
          state(stepper->mechanism, stages),
          from(n),
          from_p(n),
          chained(n, static_cast<int>(stepper->mechanism.constraints.driven().size())) {}

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
