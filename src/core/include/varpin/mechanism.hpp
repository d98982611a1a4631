// A robot in its scene: the tree with forces, constraints, actuation and noise. docs/core.md, "The map".
#pragma once

#include <algorithm>
#include <functional>
#include <vector>

#include "varpin/constraints.hpp"
#include "varpin/couplings.hpp"
#include "varpin/forces.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// The impulse of the noise of a step at a state (n), and its drift (n), (N1), empty if no field depends on v.
struct StepNoise {
    std::vector<double> impulse, drift;
};

// Diffusion fields F_i of k Wiener processes, entry by entry
// F = constant + control u + quadratic (q - center)^2; a center of NaN is the initial q of a rollout.
struct Diffusion {
    int processes = 0;
    std::vector<double> constant;   // (n, k) generalized force per square root of time
    std::vector<double> control;    // (n, k, m)
    std::vector<double> quadratic;  // (n, k)
    std::vector<double> center;     // (n, k) [rad or m]
    std::vector<int> sloped{};      // the processes whose strength depends on the control
    // Where functions of a user are among the fields, all of them at (q, v), for these centers, the mean of the control
    // over the step, its change and the increments, or null; and whether a field depends on v.
    std::function<void(const double* q, const double* v, const double* center, const double* mean, const double* change,
                       const double* increments, StepNoise&)>
        outer{};
    bool by_velocity = false;
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
