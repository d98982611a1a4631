#include "arrays.hpp"
#include "registrations.hpp"

namespace varpin::border {

void register_kinematics(nb::module_&) {}

}  // namespace varpin::border
