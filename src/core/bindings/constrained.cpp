// Steppers under holonomic constraints, and the derivatives of their steps.
#include <memory>
#include <vector>

#include "steps_at.hpp"
#include "units.hpp"
#include "varpin/constrained_linearization.hpp"

namespace varpin::border {

std::unique_ptr<VariationalStepper> constrained_stepper(const Mechanism& mechanism, const Tableau& tableau,
                                                        const std::vector<double>& places, double tolerance,
                                                        const Guards& guards) {
    return std::make_unique<ConstrainedStepper>(mechanism, tableau, places, tolerance, guards, kernels_of(mechanism));
}

std::unique_ptr<StepLinearization> constrained_linearization(const StepsAt& at, const std::vector<double>& places) {
    return std::make_unique<ConstrainedLinearization>(at.mechanism, at.tableau, places, at.tolerance, at.guards,
                                                      kernels_of(at.mechanism));
}

}  // namespace varpin::border
