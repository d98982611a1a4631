// The robot as a tree of bodies, each on one joint about or along the z axis of its own frame, and what a scene adds.
#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "varpin/forces.hpp"
#include "varpin/spatial.hpp"

namespace varpin {

// How many entries a matrix has. Indices into matrices are ints: a larger one is refused before there is room for it.
inline int entries(std::int64_t rows, std::int64_t columns) {
    if (columns > 0 && rows > std::numeric_limits<int>::max() / columns)
        throw std::length_error("a matrix of " + std::to_string(rows) + " by " + std::to_string(columns) +
                                " numbers is more than varpin can index, 2^31: the robot has too many joints, or the "
                                "integrator too many stages for so many");
    return static_cast<int>(rows * columns);
}

// Body and joint. The joint stands at ratio * q[coordinate] + offset; mimic joints have ratios other than 1.
struct Body {
    int parent = -1;  // -1 at a root; parents come first
    bool prismatic = false;
    Mat3<double> rotation{};     // of the joint's frame in its parent's, at joint position 0
    Vec3<double> translation{};  // [m]
    double mass = 0.0;           // [kg]
    Vec3<double> center{};       // in the body's frame [m]
    Sym3<double> inertia{};      // about the centre, in the body's axes [kg m^2]
    int coordinate = 0;
    double ratio = 1.0;
    double offset = 0.0;  // [rad or m]
    bool origin = false;  // no joint above turns: moments of what it carries are taken about its own joint
};

// Coordinates [begin, end) outside of which a block of M, L_vq and L_qq vanishes.
struct Block {
    int begin = 0;
    int end = 0;
};

// A part that is light beside what carries it, with an energy balance of its own (guards.hpp).
struct LightPart {
    int body = 0;               // with which it begins
    std::vector<char> carried;  // (n) whether a coordinate belongs to it
};

struct Tree {
    std::vector<Body> bodies;
    std::vector<double> armature;  // (n) [kg m^2 or kg]
    std::vector<char> periodic;    // (n) the Lagrangian without elements is the same after a whole turn
    std::vector<int> group;        // (n) mechanically independent group of a coordinate
    int groups = 0;
    std::vector<Block> blocks;  // in order; together they hold all coordinates
    std::vector<LightPart> light_parts;

    int dof() const { return static_cast<int>(armature.size()); }
    int size() const { return static_cast<int>(bodies.size()); }
};

// Diffusion fields F_i of k Wiener processes, entry by entry
// F = constant + control u + quadratic (q - center)^2; a center of NaN stands for the q at which a rollout starts.
struct Diffusion {
    int processes = 0;
    std::vector<double> constant;   // (n, k) generalized force per square root of time
    std::vector<double> control;    // (n, k, m)
    std::vector<double> quadratic;  // (n, k)
    std::vector<double> center;     // (n, k) [rad or m]
};

// Generalized force per unit of a control, one of the entries of B that are not zero.
struct Transmission {
    int coordinate = 0;
    int control = 0;
    double ratio = 0.0;
};

// A tree in its surroundings.
struct Mechanism {
    Tree tree;
    Vec3<double> gravity{};  // [m/s^2]
    Forces forces;           // of single joints
    int controls = 0;        // m
    std::vector<Transmission> actuation;
    Diffusion diffusion;

    int dof() const { return tree.dof(); }
};

}  // namespace varpin
