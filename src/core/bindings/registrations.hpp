// One function for each file of bindings. docs/core.md, "The map".
#pragma once

#include <nanobind/nanobind.h>

namespace varpin::border {

void register_mechanism(nanobind::module_& m);
void register_kinematics(nanobind::module_& m);
void register_explicit(nanobind::module_& m);
void register_backward(nanobind::module_& m);
void register_rollouts(nanobind::module_& m);
void register_constrained(nanobind::module_& m);
void register_checks(nanobind::module_& m);
void register_costs(nanobind::module_& m);

}  // namespace varpin::border
