// Steppers, and derivatives of steps, for arms and methods with one stage whose sizes are known at compile time.
// docs/core.md, "Processors".
#pragma once

#include <memory>
#include <vector>

#include "varpin/constrained.hpp"
#include "varpin/linearization.hpp"
#include "varpin/variational.hpp"

namespace varpin::border {

// Null where the size of the mechanism is none of those that are compiled.
std::unique_ptr<Stepper> small_stepper(const Mechanism& mechanism, const Tableau& tableau, double tolerance,
                                       const Guards& guards, double left, Solver solver);
std::unique_ptr<StepDerivatives> small_derivatives(const Mechanism& mechanism, const Tableau& tableau, double tolerance,
                                                   const Guards& guards, Solver solver);
std::unique_ptr<AnyConstrainedStepper> small_constrained_stepper(const Mechanism& mechanism, const Tableau& tableau,
                                                                 const std::vector<double>& places, double tolerance,
                                                                 const Guards& guards);

}  // namespace varpin::border
