// Couplings: forces at points of bodies, and between them. docs/core.md, "Couplings".
//
// A coupling acts between points a and b, d = x_a - x_b. Let l_i and w_i be the velocity and the angular velocity of a
// point per unit rate of joint i, with l_i negative for b, and J the matrix of the sums of l_i over both points. Then
// d(l_j)/dq_i = w_i x l_j for i an ancestor of j or j itself, symmetric in i and j, and d(w_j)/dq_i = w_i x w_j for i
// an ancestor of j only. A coupling is one of
//
//     potential(d)   an energy V(d), part of the Lagrangian: V_q = J' V_d,  V_qq = J' V_dd J + V_d . d(J)/dq
//     a damper       F = -J' D J v; for angular velocities, J has w_i in place of l_i
//     a wrench       F_i = l_i . f + w_i . m, constant in world axes or in the axes of a's body
//
// Points may be replaced by directions, unit vectors fixed to bodies: d is their difference, l_i = w_i x the direction,
// and |d|^2 / 2 = 1 - cos of the angle between them.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <functional>
#include <stdexcept>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

#include "varpin/dual.hpp"
#include "varpin/forces.hpp"
#include "varpin/kinematics.hpp"
#include "varpin/spatial.hpp"

namespace varpin {

namespace detail {

template <class T>
Vec3<T> entrywise(const Vec3<double>& a, const Vec3<T>& b) {
    return {a.x * b.x, a.y * b.y, a.z * b.z};
}
template <class T>
double size_of(const Vec3<T>& a) {
    return std::abs(value_of(a.x)) + std::abs(value_of(a.y)) + std::abs(value_of(a.z));
}

}  // namespace detail

// An energy V(d) of the vector from b to a.
template <class T>
struct VectorPotential {
    T energy{};           // V [J]
    Vec3<T> slope{};      // V_d [N]
    Sym3<T> curvature{};  // V_dd [N/m]
};

// A constant force at a, in world axes; b is the world's origin.
struct FrameLoad {
    Anchor a, b;
    Vec3<double> force{};  // [N]

    static constexpr const char* name = "FrameLoad";
    static constexpr std::tuple numbers{&FrameLoad::force};

    template <class T>
    VectorPotential<T> potential(const Vec3<T>& d) const {
        return {-dot(force, d), {T(-force.x), T(-force.y), T(-force.z)}, {}};
    }
    // Magnitude of the terms that cancel in the force, for points at this distance from the origin.
    double scale(double) const { return detail::size_of(force); }
};

// Three springs along the world axes, without force at d = rest.
struct FrameSpring {
    Anchor a, b;
    Vec3<double> stiffness{};  // [N/m]
    Vec3<double> rest{};       // [m]

    static constexpr const char* name = "FrameSpring";
    static constexpr std::tuple numbers{&FrameSpring::stiffness, &FrameSpring::rest};

    template <class T>
    VectorPotential<T> potential(const Vec3<T>& d) const {
        const Vec3<T> stretch = d + -1.0 * rest;
        const Vec3<T> slope = detail::entrywise(stiffness, stretch);
        return {0.5 * dot(slope, stretch), slope, {T(stiffness.x), T{}, T(stiffness.y), T{}, T{}, T(stiffness.z)}};
    }
    double scale(double far) const { return detail::size_of(stiffness) * (far + detail::size_of(rest)); }
};

// A spring along d, without force where |d| is its length, which is positive.
struct FrameLengthSpring {
    Anchor a, b;
    double stiffness = 0.0;  // [N/m]
    double length = 0.0;     // [m]

    static constexpr const char* name = "FrameLengthSpring";
    static constexpr std::tuple numbers{&FrameLengthSpring::stiffness, &FrameLengthSpring::length};

    template <class T>
    VectorPotential<T> potential(const Vec3<T>& d) const {
        using std::sqrt;
        // At d = 0 the force has no direction and is set to zero.
        const T square = dot(d, d);
        if (!(value_of(square) > 0.0)) return {T(0.5 * stiffness * length * length), {}, {}};
        const T far = sqrt(square), stretch = far - T(length), inverse = reciprocal(far);
        const Vec3<T> e = inverse * d;
        const T across = stiffness * (stretch * inverse), along = T(stiffness) - across;
        return {0.5 * stiffness * (stretch * stretch),
                stiffness * stretch * e,
                {across + along * (e.x * e.x), along * (e.x * e.y), across + along * (e.y * e.y), along * (e.x * e.z),
                 along * (e.y * e.z), across + along * (e.z * e.z)}};
    }
    double scale(double far) const { return stiffness * (far + length); }

  private:
    static double reciprocal(double x) { return 1.0 / x; }
    static Dual reciprocal(Dual x) { return {1.0 / x.value, -x.slope / (x.value * x.value)}; }
};

// Three dampers along the world axes.
struct FrameDamper {
    Anchor a, b;
    Vec3<double> damping{};  // [N s/m]

    static constexpr const char* name = "FrameDamper";
    static constexpr std::tuple numbers{&FrameDamper::damping};
};

// A spring between a direction of a's body and one of b's: V = stiffness (1 - cos angle). Three of them, for the axes
// of a frame, resist every rotation. Single stiffnesses may be negative, sums of two are not.
struct FrameTurnSpring {
    Anchor a, b;
    double stiffness = 0.0;  // [N m]

    static constexpr const char* name = "FrameTurnSpring";
    static constexpr std::tuple numbers{&FrameTurnSpring::stiffness};
    static constexpr bool directions = true;

    template <class T>
    VectorPotential<T> potential(const Vec3<T>& d) const {
        const T stiff(stiffness), none{};
        return {0.5 * stiffness * dot(d, d), stiffness * d, {stiff, none, stiff, none, none, stiff}};
    }
    double scale(double far) const { return std::abs(stiffness) * far; }
};

// A damper of the angular velocity of a's body relative to b's, along the world axes.
struct FrameTurnDamper {
    Anchor a, b;
    Vec3<double> damping{};  // [N m s/rad]

    static constexpr const char* name = "FrameTurnDamper";
    static constexpr std::tuple numbers{&FrameTurnDamper::damping};
};

// A constant wrench at a; b is the world's origin.
struct FrameWrench {
    Anchor a, b;
    Vec3<double> force{};   // [N]
    Vec3<double> moment{};  // about a [N m]
    bool carried = false;   // in the axes of a's body instead of world axes

    static constexpr const char* name = "FrameWrench";
    static constexpr std::tuple numbers{&FrameWrench::force, &FrameWrench::moment, &FrameWrench::carried};
};

using CoupledElement =
    std::variant<FrameLoad, FrameSpring, FrameLengthSpring, FrameTurnSpring, FrameDamper, FrameTurnDamper, FrameWrench>;

// A force F (n) on all coordinates at q and v (n), evaluated by code outside of the core, with dF/dq and dF/dv (n, n),
// which may be null.
using OuterForce = std::function<void(const double* q, const double* v, double* F, double* by_q, double* by_v)>;

// Work arrays; Couplings::fit allocates them, at their first use at the latest.
template <class T>
struct CouplingWorkspace {
    std::vector<PlacementOf<T>> at;
    std::vector<Arm<T>> arms;
    std::vector<Vec3<T>> change;  // derivative of the velocity of d in the coordinate of each arm
    Vec3<T> point[2];             // of the current coupling
    Mat3<T> rotation{};           // of a's body
};

class Couplings {
  public:
    Couplings() = default;
    // Couplings between points of bodies, given parents first.
    Couplings(const std::vector<CoupledElement>& couplings, const std::vector<Body>& bodies) {
        LinkCollector collector(bodies, links_);
        for (CoupledElement coupling : couplings) {
            Joined joined;
            std::visit(
                [&](auto& element) {
                    Anchor* const anchors[2] = {&element.a, &element.b};
                    for (int point = 0; point < 2; ++point) {
                        anchors[point]->body = collector.take(anchors[point]->body);
                        joined.path[point] = links_.path(anchors[point]->body);
                    }
                    if constexpr (!has_potential<std::decay_t<decltype(element)>>) pushes_ = true;
                },
                coupling);
            most_arms_ = std::max(most_arms_, joined.path[0].size() + joined.path[1].size());
            joined.element = std::move(coupling);
            joined_.push_back(std::move(joined));
        }
    }

    void take_outer(OuterForce force) {
        outer_ = std::move(force);
        pushes_ = true;
    }

    bool any() const { return !joined_.empty() || outer_; }
    // Whether there is a force of code outside of the core; it may depend on whole turns of joints.
    bool has_outer() const { return static_cast<bool>(outer_); }
    // Whether there are forces without potential.
    bool pushes() const { return pushes_; }

    template <class T>
    void fit(CouplingWorkspace<T>& workspace) const {
        workspace.at.resize(links_.bodies.size());
        workspace.arms.reserve(most_arms_);
        workspace.change.reserve(most_arms_);
    }

    // Calls visit(arms, VectorPotential, scale, magnitude) for each coupling with a potential, at q: `scale` is the
    // magnitude of the terms that cancel in V_d, `magnitude` that of the terms of the energy.
    template <class T, class Visit>
    void potentials(const T* q, CouplingWorkspace<T>& workspace, const Visit& visit) const {
        update_placements(q, workspace);
        for (const Joined& joined : joined_) {
            std::visit(
                [&](const auto& element) {
                    if constexpr (has_potential<std::decay_t<decltype(element)>>) {
                        write_arms(element, joined, workspace);
                        const VectorPotential<T> potential = element.potential(workspace.point[0] - workspace.point[1]);
                        const double far = detail::size_of(workspace.point[0]) + detail::size_of(workspace.point[1]);
                        visit(std::as_const(workspace.arms), potential, element.scale(far),
                              std::abs(value_of(potential.energy)) + detail::size_of(potential.slope) * far);
                    }
                },
                joined.element);
        }
    }

    // Adds -V_qq of a potential to a matrix (n, n).
    template <class T>
    static void subtract_curvature(const std::vector<Arm<T>>& arms, const VectorPotential<T>& potential, int n,
                                   T* Lqq) {
        for (const Arm<T>& i : arms) {
            const Vec3<T> stiff = potential.curvature * i.linear;
            for (const Arm<T>& j : arms) Lqq[i.coordinate * n + j.coordinate] -= dot(stiff, j.linear);
        }
        turning(arms, potential.slope, [&](int i, int j, const T& term) { Lqq[i * n + j] -= term; });
    }

    // Adds the forces without potential to `out` (n); writes their derivatives by_q and by_v (n, n), which may be null.
    template <class T>
    void add_forces(int n, const T* q, const T* v, CouplingWorkspace<T>& workspace, JointForce<T>* out, T* by_q,
                    T* by_v) const {
        for (T* matrix : {by_q, by_v}) {
            if (matrix) std::fill(matrix, matrix + n * n, T{});
        }
        update_placements(q, workspace);
        for (const Joined& joined : joined_) {
            std::visit(
                [&](const auto& element) {
                    if constexpr (!has_potential<std::decay_t<decltype(element)>>) {
                        write_arms(element, joined, workspace);
                        push(element, n, v, workspace, out, by_q, by_v);
                    }
                },
                joined.element);
        }
        if (outer_) add_outer(n, q, v, out, by_q, by_v);
    }

  private:
    template <class Element>
    static constexpr bool has_potential = requires(const Element& element) { element.potential(Vec3<double>{}); };

    struct Joined {
        CoupledElement element;
        std::vector<int> path[2];  // of bodies, from the root to each point
    };

    Links links_;
    std::vector<Joined> joined_;
    OuterForce outer_;
    std::size_t most_arms_ = 0;
    bool pushes_ = false;

    // Dissipated power is the smaller of -F . v and -v' dF/dv v, and not negative.
    template <class T>
    [[gnu::noinline]] void add_outer(int n, const T* q, const T* v, JointForce<T>* out, T* by_q, T* by_v) const {
        if constexpr (std::is_same_v<T, double>) {
            const bool slopes = by_q && by_v;
            std::vector<double> force(n), in_q(slopes ? n * n : 0), in_v(in_q.size());
            outer_(q, v, force.data(), slopes ? in_q.data() : nullptr, slopes ? in_v.data() : nullptr);
            double power = 0.0, damped = 0.0;
            for (int i = 0; i < n; ++i) {
                out[i].value += force[i];
                out[i].scale += std::abs(force[i]);
                power -= force[i] * v[i];
                for (int j = 0; j < n && slopes; ++j) {
                    by_q[i * n + j] += in_q[i * n + j];
                    by_v[i * n + j] += in_v[i * n + j];
                    damped -= v[i] * in_v[i * n + j] * v[j];
                }
            }
            out[0].lost += std::max(0.0, std::min(power, damped));
        } else {
            throw std::logic_error("a force in Python has no second derivatives");
        }
    }

    template <class T>
    void update_placements(const T* q, CouplingWorkspace<T>& workspace) const {
        fit(workspace);
        forward_kinematics(links_, q, workspace.at.data());
    }

    template <class T, class Element>
    void write_arms(const Element& element, const Joined& joined, CouplingWorkspace<T>& workspace) const {
        workspace.arms.clear();
        const Anchor* const anchors[2] = {&element.a, &element.b};
        for (int point = 0; point < 2; ++point) {
            const Anchor& anchor = *anchors[point];
            workspace.point[point] =
                add_arms(links_, joined.path[point], anchor, point, workspace.at.data(), workspace.arms);
            if (point == 0 && anchor.body >= 0) workspace.rotation = workspace.at[anchor.body].rotation;
        }
    }

    // Calls add(i, j, g . dl_i/dq_j) for all pairs of coordinates with a nonzero derivative.
    template <class T, class Add>
    static void turning(const std::vector<Arm<T>>& arms, const Vec3<T>& g, const Add& add) {
        for (std::size_t i = 0; i < arms.size(); ++i) {
            for (std::size_t j = i; j < arms.size() && arms[j].point == arms[i].point; ++j) {
                const T term = dot(g, cross(arms[i].angular, arms[j].linear));
                add(arms[i].coordinate, arms[j].coordinate, term);
                if (i != j) add(arms[j].coordinate, arms[i].coordinate, term);
            }
        }
    }

    // Adds the forces of a damper on the sum of v_i lever(i), and dF/dv; returns the drag.
    template <class T, class Lever>
    static Vec3<T> add_drag(const Vec3<double>& damping, int n, const T* v, const std::vector<Arm<T>>& arms,
                            const Lever& lever, JointForce<T>* out, T* by_v) {
        Vec3<T> rate{};
        double rates = 0.0;
        for (const Arm<T>& arm : arms) {
            const Vec3<T> share = v[arm.coordinate] * lever(arm);
            rate += share;
            rates += detail::size_of(share);
        }
        const Vec3<T> drag = detail::entrywise(damping, rate);
        for (const Arm<T>& i : arms) {
            JointForce<T>& at = out[i.coordinate];
            at.value += -dot(drag, lever(i));
            at.scale += detail::size_of(damping) * rates * detail::size_of(lever(i));
            const Vec3<T> damped = detail::entrywise(damping, lever(i));
            for (std::size_t j = 0; by_v && j < arms.size(); ++j)
                by_v[i.coordinate * n + arms[j].coordinate] -= dot(damped, lever(arms[j]));
        }
        if (!arms.empty()) out[arms[0].coordinate].lost += value_of(dot(drag, rate));
        return drag;
    }

    template <class T>
    static void push(const FrameDamper& damper, int n, const T* v, CouplingWorkspace<T>& workspace, JointForce<T>* out,
                     T* by_q, T* by_v) {
        const auto& arms = workspace.arms;
        const auto linear = [](const Arm<T>& arm) { return arm.linear; };
        const Vec3<T> drag = add_drag(damper.damping, n, v, arms, linear, out, by_v);
        if (!by_q) return;
        turning(arms, drag, [&](int i, int j, const T& term) { by_q[i * n + j] -= term; });
        // d(J v)/dq_j = w_j x sum of l_i v_i from j on + (sum of w_i v_i before j) x l_j
        workspace.change.assign(arms.size(), Vec3<T>{});
        Vec3<T> before{}, beyond{};
        for (std::size_t j = 0; j < arms.size(); ++j) {
            if (j > 0 && arms[j].point != arms[j - 1].point) before = {};
            workspace.change[j] = cross(before, arms[j].linear);
            before += v[arms[j].coordinate] * arms[j].angular;
        }
        for (std::size_t j = arms.size(); j-- > 0;) {
            if (j + 1 < arms.size() && arms[j].point != arms[j + 1].point) beyond = {};
            beyond += v[arms[j].coordinate] * arms[j].linear;
            workspace.change[j] += cross(arms[j].angular, beyond);
        }
        for (const Arm<T>& i : arms) {
            const Vec3<T> damped = detail::entrywise(damper.damping, i.linear);
            for (std::size_t j = 0; j < arms.size(); ++j)
                by_q[i.coordinate * n + arms[j].coordinate] -= dot(damped, workspace.change[j]);
        }
    }

    // Derivatives with w in place of l, negative for b: dw_j/dq_i = w_i x w_j for i an ancestor of j only.
    template <class T>
    static void push(const FrameTurnDamper& damper, int n, const T* v, CouplingWorkspace<T>& workspace,
                     JointForce<T>* out, T* by_q, T* by_v) {
        const auto& arms = workspace.arms;
        const auto signed_axis = [](const Arm<T>& arm) { return (arm.point == 0 ? 1.0 : -1.0) * arm.angular; };
        const Vec3<T> drag = add_drag(damper.damping, n, v, arms, signed_axis, out, by_v);
        if (!by_q) return;
        workspace.change.assign(arms.size(), Vec3<T>{});
        Vec3<T> beyond{};
        for (std::size_t j = arms.size(); j-- > 0;) {
            if (j + 1 < arms.size() && arms[j].point != arms[j + 1].point) beyond = {};
            workspace.change[j] = cross(arms[j].angular, beyond);
            beyond += v[arms[j].coordinate] * signed_axis(arms[j]);
        }
        for (std::size_t i = 0; i < arms.size(); ++i) {
            const Vec3<T> axis = signed_axis(arms[i]), damped = detail::entrywise(damper.damping, axis);
            for (std::size_t j = 0; j < arms.size(); ++j) {
                T term = dot(damped, workspace.change[j]);
                if (j < i && arms[j].point == arms[i].point) term += dot(drag, cross(arms[j].angular, axis));
                by_q[arms[i].coordinate * n + arms[j].coordinate] -= term;
            }
        }
    }

    template <class T>
    static void push(const FrameWrench& wrench, int n, const T*, CouplingWorkspace<T>& workspace, JointForce<T>* out,
                     T* by_q, T*) {
        const auto& arms = workspace.arms;
        Vec3<T> force{T(wrench.force.x), T(wrench.force.y), T(wrench.force.z)};
        Vec3<T> moment{T(wrench.moment.x), T(wrench.moment.y), T(wrench.moment.z)};
        if (wrench.carried) {
            force = workspace.rotation * wrench.force;
            moment = workspace.rotation * wrench.moment;
        }
        for (const Arm<T>& arm : arms) {
            JointForce<T>& at = out[arm.coordinate];
            at.value += dot(force, arm.linear) + dot(moment, arm.angular);
            at.scale += detail::size_of(wrench.force) * detail::size_of(arm.linear) +
                        detail::size_of(wrench.moment) * detail::size_of(arm.angular);
        }
        if (!by_q) return;
        turning(arms, force, [&](int i, int j, const T& term) { by_q[i * n + j] += term; });
        for (std::size_t i = 0; i < arms.size(); ++i) {
            for (std::size_t j = 0; j < arms.size(); ++j) {
                const Vec3<T>& turn = arms[j].angular;
                T term{};
                if (j < i) term += dot(moment, cross(turn, arms[i].angular));
                if (wrench.carried) {
                    term += dot(arms[i].linear, cross(turn, force)) + dot(arms[i].angular, cross(turn, moment));
                }
                by_q[arms[i].coordinate * n + arms[j].coordinate] += term;
            }
        }
    }
};

}  // namespace varpin
