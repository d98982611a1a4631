// Positions of bodies, frames and the centre of mass, their Jacobians, and differences of rotations.
// docs/mathematics.md, "Costs in the task". Positions are in world axes from the world's origin, unlike in the jet.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "varpin/elementary.hpp"
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

template <class T>
struct PlacementOf {
    Mat3<T> rotation{};
    Vec3<T> position{};  // [m]
};
using Placement = PlacementOf<double>;

template <class T>
constexpr PlacementOf<T> operator*(const PlacementOf<T>& a, const Placement& b) {
    return {a.rotation * b.rotation, a.position + a.rotation * b.position};
}

// Some bodies of a tree with all their ancestors; n coordinates of the tree.
struct Links {
    std::vector<Body> bodies;
    int dof = 0;

    int size() const { return static_cast<int>(bodies.size()); }

    // The bodies from the root to a body, that body included.
    std::vector<int> path(int body) const {
        std::vector<int> out;
        for (int j = body; j >= 0; j = bodies[j].parent) out.push_back(j);
        std::reverse(out.begin(), out.end());
        return out;
    }
};

// Collects some bodies of a tree into links.
class LinkCollector {
  public:
    LinkCollector(const std::vector<Body>& bodies, Links& links)
        : bodies_(bodies), links_(links), own_(bodies.size(), -1) {}

    // The index of a body among the links, to which it is added after its ancestors; -1 is the world.
    int take(int body) {
        if (body < 0) return -1;
        if (own_[body] < 0) {
            Body link = bodies_[body];
            link.parent = take(link.parent);
            own_[body] = links_.size();
            links_.bodies.push_back(link);
        }
        return own_[body];
    }

  private:
    const std::vector<Body>& bodies_;
    Links& links_;
    std::vector<int> own_;
};

// The placement of every body at q.
template <class T>
void forward_kinematics(const Links& links, const T* q, PlacementOf<T>* at) {
    using elementary::turn;
    for (int j = 0; j < links.size(); ++j) {
        const Body& link = links.bodies[j];
        const Mat3<double>& E = link.rotation;
        const Vec3<double>& p = link.translation;
        PlacementOf<T> here;
        if (link.parent >= 0) {
            here = at[link.parent] * Placement{E, p};
        } else {
            here = {{{E.x.x, E.x.y, E.x.z}, {E.y.x, E.y.y, E.y.z}, {E.z.x, E.z.y, E.z.z}}, {p.x, p.y, p.z}};
        }
        const T angle = link.ratio * q[link.coordinate] + link.offset;
        const Mat3<T>& R = here.rotation;
        if (link.prismatic) {
            here.position += angle * R.z;
        } else {
            const auto [c, s] = turn(angle);
            here.rotation = {c * R.x + s * R.y, c * R.y - s * R.x, R.z};
        }
        at[j] = here;
    }
}

// The velocity of a point in a joint's subtree per unit of the joint's rate, in world axes.
template <class T>
Motion<T> given_by(const Body& link, const PlacementOf<T>& at, const Vec3<T>& point) {
    const Vec3<T>& axis = at.rotation.z;
    return link.prismatic ? Motion<T>{axis, {}} : Motion<T>{cross(axis, point - at.position), axis};
}

// A point, relative to the joint of its body in body axes, or in the world for body -1. Or a direction.
struct Anchor {
    int body = -1;
    Vec3<double> point{};  // [m]; a unit vector for a direction
    bool direction = false;
};

// Velocities of one of the points per unit rate of a joint.
template <class T>
struct Arm {
    int coordinate = 0;
    int point = 0;      // 0 for a, 1 for b
    Vec3<T> linear{};   // of a - b
    Vec3<T> angular{};  // of the point's body
};

// Adds the arms of an anchor, from the root on; `path` are the bodies that move it. Returns its place.
template <class T>
Vec3<T> add_arms(const Links& links, const std::vector<int>& path, const Anchor& anchor, int point,
                 const PlacementOf<T>* at, std::vector<Arm<T>>& arms) {
    const Vec3<double>& offset = anchor.point;
    if (anchor.body < 0) return {T(offset.x), T(offset.y), T(offset.z)};
    Vec3<T> x = at[anchor.body].rotation * offset;
    if (!anchor.direction) x += at[anchor.body].position;
    for (int j : path) {
        const Body& link = links.bodies[j];
        const double side = point == 0 ? link.ratio : -link.ratio;
        const Motion<T> gives = given_by(link, at[j], x);
        const Vec3<T> linear = anchor.direction ? cross(gives.angular, x) : gives.linear;
        arms.push_back({link.coordinate, point, side * linear, link.ratio * gives.angular});
    }
    return x;
}

// Add a vector to three rows of a column; rows have n entries.
inline void add_column(const Vec3<double>& a, int n, double* column) {
    column[0] += a.x;
    column[n] += a.y;
    column[2 * n] += a.z;
}

// The Jacobian (6, n) of a frame at a point of the last body: linear, then angular velocity, in world axes.
inline void frame_jacobian(const Links& links, const Placement* at, const Vec3<double>& point, double* J) {
    const int n = links.dof;
    std::fill(J, J + 6 * n, 0.0);
    for (int j = 0; j < links.size(); ++j) {
        const Body& link = links.bodies[j];
        const Motion<double> gives = given_by(link, at[j], point);
        add_column(link.ratio * gives.linear, n, J + link.coordinate);
        add_column(link.ratio * gives.angular, n, J + 3 * n + link.coordinate);
    }
}

// Mass and first moment of a joint's subtree.
struct Load {
    double mass = 0.0;      // [kg]
    Vec3<double> moment{};  // [kg m]
};

// The centre of mass of all bodies and its Jacobian J (3, n), which may be null. `loads` is work, one for each body.
inline Vec3<double> center_of_mass(const Links& links, const Placement* at, Load* loads, double* J) {
    const int n = links.dof;
    for (int j = 0; j < links.size(); ++j) {
        const Body& link = links.bodies[j];
        loads[j] = {link.mass, link.mass * (at[j].position + at[j].rotation * link.center)};
    }
    Load all;
    for (int j = links.size() - 1; j >= 0; --j) {
        Load& carrier = links.bodies[j].parent >= 0 ? loads[links.bodies[j].parent] : all;
        carrier = {carrier.mass + loads[j].mass, carrier.moment + loads[j].moment};
    }
    if (J != nullptr) {
        std::fill(J, J + 3 * n, 0.0);
        for (int j = 0; j < links.size(); ++j) {
            // The joint moves its subtree as one body.
            const Body& link = links.bodies[j];
            const auto& [mass, moment] = loads[j];
            const Vec3<double>& axis = at[j].rotation.z;
            const Vec3<double> momentum = link.prismatic ? mass * axis : cross(axis, moment - mass * at[j].position);
            const Vec3<double> gives = (link.ratio / all.mass) * momentum;
            add_column(gives, n, J + link.coordinate);
        }
    }
    return (1.0 / all.mass) * all.moment;
}

struct Quaternion {
    double w = 1.0;
    Vec3<double> vector{};
};

// A multiple of the quaternion of a rotation, with w >= 0. It is computed from its largest entry to avoid cancellation
// (Shepperd, "Quaternion from rotation matrix", 1978).
inline Quaternion quaternion(const Mat3<double>& R) {
    const auto& [x, y, z] = R;
    const double trace = x.x + y.y + z.z;
    Quaternion out;
    if (trace >= std::max({x.x, y.y, z.z})) {
        return {1.0 + trace, {y.z - z.y, z.x - x.z, x.y - y.x}};
    }
    if (x.x >= y.y && x.x >= z.z) {
        out = {y.z - z.y, {1.0 + x.x - y.y - z.z, x.y + y.x, x.z + z.x}};
    } else if (y.y >= z.z) {
        out = {z.x - x.z, {x.y + y.x, 1.0 + y.y - z.z - x.x, y.z + z.y}};
    } else {
        out = {x.y - y.x, {x.z + z.x, y.z + z.y, 1.0 + z.z - x.x - y.y}};
    }
    return out.w < 0.0 ? Quaternion{-out.w, -1.0 * out.vector} : out;
}

// The rotation vector of E, of length a in [0, pi].
inline Vec3<double> logarithm(const Mat3<double>& E) {
    const Quaternion z = quaternion(E);
    const double sine = std::sqrt(dot(z.vector, z.vector));
    return (sine > 0.0 ? 2.0 * elementary::angle_above(sine, z.w) / sine : 0.0) * z.vector;
}

// The D with dr = D w dt for the logarithm r of a rotation with angular velocity w in its own axes,
//     D = 1 + [r]/2 + (1 - (a/2) cot(a/2)) [r]^2 / a^2,    a = |r|
// (Chirikjian, Stochastic Models, Information Theory, and Lie Groups 2, 2011, 10.86).
inline Mat3<double> logarithm_derivative(const Vec3<double>& r) {
    const double square = dot(r, r), angle = std::sqrt(square), half = 0.5 * angle;
    const auto [c, s] = elementary::turn(half);
    const double factor = angle < 1e-3 ? 1.0 / 12.0 + square / 720.0 : (1.0 - half * (c / s)) / square;
    // [r]^2 = r r' - a^2
    const double diagonal = 1.0 - factor * square;
    const auto column = [&](const Vec3<double>& unit, double along) {
        return (factor * along) * r + diagonal * unit + 0.5 * cross(r, unit);
    };
    return {column({1.0, 0.0, 0.0}, r.x), column({0.0, 1.0, 0.0}, r.y), column({0.0, 0.0, 1.0}, r.z)};
}

}  // namespace varpin
