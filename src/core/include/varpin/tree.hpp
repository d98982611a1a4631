// The robot as a tree of bodies, each on one joint about or along the z axis of its own frame, in a scene.
// docs/mathematics.md, "The Lagrangian jet".
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
    std::vector<Block> blocks;  // in order; they cover all coordinates
    std::vector<LightPart> light_parts;

    int dof() const { return static_cast<int>(armature.size()); }
    int size() const { return static_cast<int>(bodies.size()); }
};

// Diffusion fields F_i of k Wiener processes, entry by entry
// F = constant + control u + quadratic (q - center)^2; a center of NaN is the initial q of a rollout.
struct Diffusion {
    int processes = 0;
    std::vector<double> constant;   // (n, k) generalized force per square root of time
    std::vector<double> control;    // (n, k, m)
    std::vector<double> quadratic;  // (n, k)
    std::vector<double> center;     // (n, k) [rad or m]
    std::vector<int> sloped;        // the processes whose strength depends on the control
};

// A nonzero entry of B, generalized force per unit of a control.
struct Transmission {
    int coordinate = 0;
    int control = 0;
    double ratio = 0.0;
};

// A tree with the forces, constraints, actuation and noise of a scene.
struct Mechanism {
    Tree tree;
    Vec3<double> gravity{};  // [m/s^2]
    Forces forces;           // of single joints
    Couplings couplings;     // between points of bodies
    int controls = 0;        // m
    std::vector<Transmission> actuation;
    Diffusion diffusion;
    Constraints constraints;  // holonomic; constrained.hpp has the steps that satisfy them

    int dof() const { return tree.dof(); }

    // Whether there are forces besides L_q.
    bool pushes() const { return forces.any() || couplings.pushes(); }
};

// The sum (n) of the forces besides L_q on each coordinate at q, v and the controls' f (n). Without such forces the
// output is not written and must be zero. Derivatives of couplings, which are not diagonal, go into by_q and by_v (n,
// n), which may be null.
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
