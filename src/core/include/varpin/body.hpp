// A body of a tree, with its joint: docs/core.md, "The map".
#pragma once

#include "varpin/spatial.hpp"

namespace varpin {

// Body and joint. The joint position is ratio * q[coordinate] + offset; mimic joints have ratios other than 1.
struct Body {
    int parent = -1;  // -1 for a root; parents come first
    bool prismatic = false;
    Mat3<double> rotation{};     // of the joint's frame in the parent body, at joint position 0
    Vec3<double> translation{};  // [m]
    double mass = 0.0;           // [kg]
    Vec3<double> center{};       // in the body's frame [m]
    Sym3<double> inertia{};      // about the centre, in the body's axes [kg m^2]
    int coordinate = 0;
    double ratio = 1.0;
    double offset = 0.0;  // [rad or m]
    bool origin = false;  // no ancestor is revolute: moments of this branch are taken about this joint
};

}  // namespace varpin
