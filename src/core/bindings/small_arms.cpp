// The inner loops of arms with up to seven joints, whose number is known at compile time.
#include "units.hpp"
#include "varpin/guards.hpp"
#include "varpin/step_equation.hpp"

namespace varpin::border {

// Such an arm's bodies each have a joint of their own, in a single block.
const Kernels& kernels_of(const Mechanism& mechanism) {
    const Tree& tree = mechanism.tree;
    if (tree.size() != tree.dof() || tree.blocks.size() != 1) return kernels_for<>;
    switch (tree.dof()) {
        case 3:
            return kernels_for<Known<3>>;
#ifndef VARPIN_FEW_SIZES
        case 2:
            return kernels_for<Known<2>>;
        case 4:
            return kernels_for<Known<4>>;
        case 6:
            return kernels_for<Known<6>>;
        case 7:
            return kernels_for<Known<7>>;
#endif
        default:
            return kernels_for<>;
    }
}

}  // namespace varpin::border
