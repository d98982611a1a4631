// Steppers under constraints, which are compiled in a unit of their own. docs/core.md, "The map".
#pragma once

#include <memory>
#include <vector>

#include "varpin/variational.hpp"

namespace varpin::border {

std::unique_ptr<VariationalStepper> constrained_stepper(const Mechanism& mechanism, const Tableau& tableau,
                                                        const std::vector<double>& places, double tolerance,
                                                        const Guards& guards);

}  // namespace varpin::border
