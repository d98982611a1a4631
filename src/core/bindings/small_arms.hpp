// The inner loops for the number of joints of a mechanism, which the compiler knows for small arms.
// docs/core.md, "Processors".
#pragma once

#include "varpin/kernels.hpp"

namespace varpin::border {

// Those for any number of joints where none of those that are compiled fits.
const Kernels& kernels_of(const Mechanism& mechanism);

}  // namespace varpin::border
