// The robot as a tree of bodies, each on one joint about or along the z axis of its own frame.
// docs/mathematics.md, "The Lagrangian jet".
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "varpin/kinematics.hpp"

namespace varpin {

// Number of entries of a matrix. Indices into matrices are ints, so larger matrices are refused before allocation.
inline int entries(std::int64_t rows, std::int64_t columns) {
    if (columns > 0 && rows > std::numeric_limits<int>::max() / columns)
        throw std::length_error("a matrix of " + std::to_string(rows) + " by " + std::to_string(columns) +
                                " numbers is more than varpin can index, 2^31: the robot has too many joints, or the "
                                "integrator too many stages for so many");
    return static_cast<int>(rows * columns);
}

// An array of zeros, or a matrix, as entries() allows.
inline std::vector<double> zeros(std::int64_t rows, std::int64_t columns = 1) {
    return std::vector<double>(entries(rows, columns));
}

// Coordinates [begin, end) of a diagonal block of M, L_vq and L_qq.
struct Block {
    int begin = 0;
    int end = 0;
};

// A subtree that is light compared with the bodies that carry it, with an energy balance of its own (guards.hpp).
struct LightPart {
    int body = 0;               // root of the subtree
    std::vector<char> carried;  // (n) whether a coordinate belongs to it
};

struct Tree {
    std::vector<Body> bodies;
    std::vector<double> armature;  // (n) [kg m^2 or kg]
    std::vector<char> periodic;    // (n) whether the Lagrangian without elements is periodic in a whole turn
    std::vector<int> group;        // (n) mechanically independent group of a coordinate
    int groups = 0;
    std::vector<Block> blocks{};  // in order; they cover all coordinates
    std::vector<LightPart> light_parts{};

    int dof() const { return static_cast<int>(armature.size()); }
    int size() const { return static_cast<int>(bodies.size()); }
};

// A size known at compile time, in the place of an int: the compiler unrolls loops, with the same code. docs/core.md,
// "Processors".
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
