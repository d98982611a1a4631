// How many there are of something, and what follows from it for a tree. A number known to the compiler makes loops over
// it straight lines; an int is the same code for any number.
#pragma once

#include <array>
#include <vector>

#include "varpin/tree.hpp"

namespace varpin {

// Stands where an int would.
template <int count>
struct Known {
    constexpr Known(int) {}
    constexpr operator int() const { return count; }
};

// Bodies and blocks of a tree of n coordinates. That n is known says of a tree that each body has a coordinate of its
// own, and that all make one block.
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
