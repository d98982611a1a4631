#include "arrays.hpp"
#include "registrations.hpp"

namespace varpin::border {

void register_rollouts(nb::module_&) {}

}  // namespace varpin::border
