// A body of a tree and the joint that it is on.
#pragma once

#include "varpin/spatial.hpp"

namespace varpin {

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

}  // namespace varpin
