// What the units of bindings give each other. docs/core.md, "The map".
#pragma once

#include <nanobind/nanobind.h>

#include <memory>
#include <vector>

namespace varpin {

struct Guards;
struct Kernels;
struct Mechanism;
struct Tableau;
class StepLinearization;
class VariationalStepper;

namespace border {

class StepsAt;

// The inner loops for the number of joints of a mechanism; those for any number where none that is compiled fits.
const Kernels& kernels_of(const Mechanism& mechanism);

std::unique_ptr<VariationalStepper> constrained_stepper(const Mechanism& mechanism, const Tableau& tableau,
                                                        const std::vector<double>& places, double tolerance,
                                                        const Guards& guards);
std::unique_ptr<StepLinearization> constrained_linearization(const StepsAt& at, const std::vector<double>& places);

// Of each unit.
void register_mechanism(nanobind::module_& m);
void register_explicit(nanobind::module_& m);
void register_backward(nanobind::module_& m);
void register_rollouts(nanobind::module_& m);
void register_costs(nanobind::module_& m);
void register_filter(nanobind::module_& m);

}  // namespace border

}  // namespace varpin
