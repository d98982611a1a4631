// Steppers and derivatives of steps, for arms and methods with one stage whose sizes are known at compile time, and
// derivatives of velocities at nodes.
// docs/core.md, "Processors".
#pragma once

#include <cstddef>
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
// velocity_slopes; false, and nothing done, where the size of the mechanism is none of those that are compiled.
bool small_velocity_slopes(const Mechanism& mechanism, std::size_t rows, const double* q, const double* v,
                           double* slopes);

}  // namespace varpin::border
