// Derivatives of a step in parameters of the mechanism. docs/mathematics.md, "Sensitivities". The parameters change
// L_q, L_v and F at the stages of a step, (Q_j, V_j) fixed, and so its equation and its end:
//
//     N dV = h sum_j (abar_ij dL_q + f_ij dF)_j - dL_v,i        dp1 = h sum_j b_j (dL_q + dF)_j + what dV gives
//
// A parameter is two mechanisms, above and below the present one. L and F are linear in most parameters, in which their
// difference is the derivative.
#pragma once

#include <algorithm>
#include <utility>
#include <vector>

#include "varpin/step_equation.hpp"

namespace varpin {

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

}  // namespace varpin
