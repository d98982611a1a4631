// The robot as a tree of bodies, each on one joint about or along the z axis of its own frame, and what a scene adds.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "varpin/body.hpp"
#include "varpin/constraints.hpp"
#include "varpin/couplings.hpp"
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
    Couplings couplings;     // between points of bodies
    int controls = 0;        // m
    std::vector<Transmission> actuation;
    Diffusion diffusion;
    Constraints constraints;  // holonomic; steps that keep them are those of constrained.hpp

    int dof() const { return tree.dof(); }

    // Whether there are forces beside L_q.
    bool pushes() const { return forces.any() || couplings.pushes(); }
};

// The sum (n) of the forces beside L_q on each coordinate at q, v and the controls' f (n), into what is zero if there
// are none. Of couplings its derivatives are diagonal no more: they go into by_q and by_v (n, n), which may be null.
template <class T>
void sum_forces(const Mechanism& mechanism, const T* q, const T* v, const T* f, JointForce<T>* out,
                CouplingWorkspace<T>& workspace, T* by_q, T* by_v) {
    const int n = mechanism.dof();
    mechanism.forces.sum(n, q, v, f, out);
    if (!mechanism.couplings.pushes()) return;
    if (!mechanism.forces.any()) std::fill(out, out + n, JointForce<T>{});
    mechanism.couplings.add_forces(n, q, v, workspace, out, by_q, by_v);
}

}  // namespace varpin
