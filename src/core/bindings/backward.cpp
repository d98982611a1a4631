#include "arrays.hpp"
#include "registrations.hpp"

namespace varpin::border {

void register_backward(nb::module_&) {}

}  // namespace varpin::border
