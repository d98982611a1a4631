// Sizes known at compile time, for which the compiler unrolls loops, or at run time, as int, with the same code.
// docs/core.md, "Processors".
#pragma once

#include <array>
#include <vector>

#include "varpin/tree.hpp"

namespace varpin {

// A size known at compile time, in the place of an int.
template <int count>
struct Known {
    constexpr Known(int) {}
    constexpr operator int() const { return count; }
};

// Bodies and blocks of a tree of n coordinates. With n known at compile time, each body has a coordinate of its own,
// and all coordinates form one block.
inline int bodies_of(const Tree& tree, int) { return tree.size(); }
inline const std::vector<Block>& blocks_of(const Tree& tree, int) { return tree.blocks; }
template <int n>
constexpr int bodies_of(const Tree&, Known<n>) {
    return n;
}
template <int n>
constexpr std::array<Block, 1> blocks_of(const Tree&, Known<n>) {
    return {Block{0, n}};
}

}  // namespace varpin
