// Elements: forces on single joints besides inertia and gravity. docs/core.md, "Forces". docs/extending.md has an
// example of a new one.
//
// An element acts on one coordinate, has a `name` and `numbers`, its members in the order in which they are given, and
// has one or both of
//
//     potential(q)    an energy V, part of the Lagrangian: -V' belongs to L_q, -V'' to the diagonal of L_qq
//     force(q, v)     a force F without potential, besides L_q, with its derivatives and dissipated power;
//                     force(q, v, f) if it depends on f, the constant force of controls on its joint, to which it adds
//
// Jets, step equations, guards, linearizations and forward dynamics use this list. With T = Dual and (q, v, f) along a
// direction, the slopes of -V'', dF/dq, dF/dv and dF/df are second derivatives of the forces.
#pragma once

#include <algorithm>
#include <cmath>
#include <tuple>
#include <type_traits>
#include <variant>
#include <vector>

#include "varpin/dual.hpp"
#include "varpin/elementary.hpp"

namespace varpin {

// An energy V, and the derivatives of -V.
template <class T>
struct Potential {
    T energy{};          // V [J]
    T force{};           // -V' [N m or N]
    T curvature{};       // -V''
    double scale = 0.0;  // magnitude of the terms that cancel in the force

    // Magnitude of the terms of the energy at q, including its change by rounding of q.
    double magnitude(double q) const { return std::abs(value_of(energy)) + std::abs(value_of(force) * q); }
};

// A force F(q, v, f) of one coordinate, or the sum of several.
template <class T>
struct JointForce {
    T value{};           // F [N m or N]
    T by_q{};            // dF/dq
    T by_v{};            // dF/dv
    T by_f{};            // dF/df
    double scale = 0.0;  // sum of the magnitudes of its terms
    double lost = 0.0;   // dissipated power [W]

    JointForce& operator+=(const JointForce& other) {
        value += other.value;
        by_q += other.by_q;
        by_v += other.by_v;
        by_f += other.by_f;
        scale += other.scale;
        lost += other.lost;
        return *this;
    }
};

struct JointSpring {
    int coordinate = 0;
    double stiffness = 0.0;  // [N m/rad or N/m]
    double rest = 0.0;       // position without force [rad or m]

    static constexpr const char* name = "JointSpring";
    static constexpr std::tuple numbers{&JointSpring::stiffness, &JointSpring::rest};
    static constexpr bool anchored = true;
    static constexpr bool linear() { return true; }

    template <class T>
    Potential<T> potential(T q) const {
        const T stretch = q - T(rest);
        const T force = -stiffness * stretch;
        return {-0.5 * force * stretch, force, T(-stiffness),
                std::abs(stiffness) * (std::abs(value_of(q)) + std::abs(rest))};
    }
};

struct JointDamper {
    int coordinate = 0;
    double damping = 0.0;  // [N m s/rad or N s/m]

    static constexpr const char* name = "JointDamper";
    static constexpr std::tuple numbers{&JointDamper::damping};
    static constexpr bool anchored = false;
    static constexpr bool linear() { return true; }

    template <class T>
    JointForce<T> force(T, T v) const {
        const double drag = damping * value_of(v);
        return {-damping * v, T(0.0), T(-damping), T(0.0), std::abs(drag), drag * value_of(v)};
    }
};

// Dry friction -g(v) tanh(v / width); g falls from `breakaway` at rest to `level` with increasing speed (Stribeck):
// g = level + (breakaway - level) exp(-(v / stribeck_velocity)^2).
struct CoulombFriction {
    int coordinate = 0;
    double level = 0.0;              // [N m or N]
    double width = 0.0;              // velocity scale of the change of sign [rad/s or m/s]
    double breakaway = 0.0;          // [N m or N]
    double stribeck_velocity = 0.0;  // [rad/s or m/s]

    static constexpr const char* name = "CoulombFriction";
    static constexpr std::tuple numbers{&CoulombFriction::level, &CoulombFriction::width, &CoulombFriction::breakaway,
                                        &CoulombFriction::stribeck_velocity};
    static constexpr bool anchored = false;
    static constexpr bool linear() { return true; }

    template <class T>
    JointForce<T> force(T, T v) const {
        using elementary::tanh, elementary::exp;
        const T side = tanh((1.0 / width) * v), turn = (1.0 / width) * (T(1.0) - side * side);
        T g = T(level), slope = T(0.0);
        if (breakaway != level) {
            const T ratio = (1.0 / stribeck_velocity) * v;
            const T more = (breakaway - level) * exp(-(ratio * ratio));
            g += more;
            slope = (-2.0 / stribeck_velocity) * (ratio * more);
        }
        const T value = -(g * side);
        return {value,
                T(0.0),
                -(slope * side + g * turn),
                T(0.0),
                std::abs(value_of(value)),
                -value_of(value) * value_of(v)};
    }
};

// A spring and a damper beyond each end of a joint's range. Stiffness and damping rise from 0 to their full values over
// the first `width` beyond the end, by s(y) = 3 y^2 - 2 y^3, y = depth / width: forces have continuous derivatives.
struct JointStop {
    int coordinate = 0;
    double lower = 0.0, upper = 0.0;  // infinite where there is none [rad or m]
    double stiffness = 0.0;           // [N m/rad or N/m]
    double damping = 0.0;             // [N m s/rad or N s/m]
    double width = 0.0;               // [rad or m]

    static constexpr const char* name = "JointStop";
    static constexpr std::tuple numbers{&JointStop::lower, &JointStop::upper, &JointStop::stiffness,
                                        &JointStop::damping, &JointStop::width};
    static constexpr bool anchored = true;
    static constexpr bool linear() { return false; }

    template <class T>
    Potential<T> potential(T q) const {
        const double side = this->side(value_of(q));
        if (side == 0.0) return {};
        const T x = depth(q, side);
        T first{}, second{};  // integrals of s over the depth
        if (value_of(x) < width) {
            const T y = (1.0 / width) * x, cube = y * y * y;
            first = width * (cube - 0.5 * (cube * y));
            second = (width * width) * (0.25 * (cube * y) - 0.1 * (cube * y * y));
        } else {
            const T past = x - T(width);
            first = past + T(0.5 * width);
            second = 0.5 * (past * past) + (0.5 * width) * past + T(0.15 * width * width);
        }
        const double scale = stiffness * (std::abs(value_of(q)) + std::abs(side > 0.0 ? upper : lower));
        return {stiffness * second, (-side * stiffness) * first, -stiffness * share(x), scale};
    }

    template <class T>
    JointForce<T> force(T q, T v) const {
        const double side = this->side(value_of(q));
        if (side == 0.0) return {};
        const T x = depth(q, side), y = (1.0 / width) * x;
        const T grown = damping * share(x);
        T growing{};
        if (value_of(x) < width) growing = (6.0 * damping / width) * (y - y * y);
        const T drag = grown * v;
        return {-drag, (-side) * (growing * v), -grown, T(0.0), std::abs(value_of(drag)), value_of(drag) * value_of(v)};
    }

  private:
    // 1 beyond the upper end, -1 beyond the lower one.
    double side(double q) const { return q > upper ? 1.0 : q < lower ? -1.0 : 0.0; }
    template <class T>
    T depth(T q, double side) const {
        return side > 0.0 ? q - T(upper) : T(lower) - q;
    }
    template <class T>
    T share(T x) const {
        if (!(value_of(x) < width)) return T(1.0);
        const T y = (1.0 / width) * x;
        return y * y * (T(3.0) - 2.0 * y);
    }
};

// A position servo. It replaces f = stiffness * command by the drive's force S(f - stiffness q - damping v). S is the
// identity up to 0.9 of the effort, a parabola from 0.9 to 1.1, and constant at the effort beyond.
struct PositionServo {
    int coordinate = 0;
    double stiffness = 0.0;  // [N m/rad or N/m]
    double damping = 0.0;    // [N m s/rad or N s/m]
    double effort = 0.0;     // infinite where there is no limit [N m or N]

    static constexpr const char* name = "PositionServo";
    static constexpr std::tuple numbers{&PositionServo::stiffness, &PositionServo::damping, &PositionServo::effort};
    static constexpr bool anchored = true;
    static constexpr double straight = 0.9;
    bool linear() const { return std::isinf(effort); }

    template <class T>
    JointForce<T> force(T q, T v, T f) const {
        const T back = -(stiffness * q + damping * v), wanted = f + back;
        const double scale = std::abs(stiffness * value_of(q)) + std::abs(damping * value_of(v));
        const double wanted_effort = std::abs(value_of(wanted));
        if (wanted_effort <= straight * effort)
            return {back, T(-stiffness), T(-damping), T(0.0), scale, damping * value_of(v) * value_of(v)};
        const double side = value_of(wanted) > 0.0 ? 1.0 : -1.0, past = (1.0 - straight) * effort;
        if (wanted_effort >= effort + past)
            return {T(side * effort) - f, T(0.0), T(0.0), T(-1.0), scale + effort + std::abs(value_of(f)), 0.0};
        const T over = side * wanted - T(straight * effort), slope = T(1.0) - (0.5 / past) * over;
        const T drive = side * (T(straight * effort) + over - (0.25 / past) * (over * over));
        return {drive - f,
                -stiffness * slope,
                -damping * slope,
                slope - T(1.0),
                scale + std::abs(value_of(f)),
                damping * value_of(slope) * value_of(v) * value_of(v)};
    }
};

// Every kind of element. `anchored`: the force depends on the joint's position, whole turns included. `linear`: the
// error estimate of Newton's method (collocation.hpp) treats the force as linear in (q, v).
using Element = std::variant<JointSpring, JointDamper, CoulombFriction, JointStop, PositionServo>;

// The list of elements, grouped by kind, so that kinds without elements cost nothing.
class Forces {
  public:
    Forces() = default;
    Forces(const std::vector<Element>& elements) {
        for (const Element& element : elements) std::visit([this](const auto& element) { add(element); }, element);
    }

    bool any() const { return any_; }

    // Whether all forces are linear functions of (q, v).
    bool linear() const { return linear_; }

    // Whether an element on coordinate c is anchored.
    bool anchors(int c) const { return c < static_cast<int>(anchored_.size()) && anchored_[c] != 0; }

    // Calls visit(coordinate, Potential) for each element that has one, at q (n).
    template <class T, class Visit>
    void potentials(const T* q, const Visit& visit) const {
        each([&](const auto& element) {
            if constexpr (requires { element.potential(T{}); })
                visit(element.coordinate, element.potential(q[element.coordinate]));
        });
    }

    // The sum (n) of the forces besides L_q on each coordinate at q, v and f (n). Without elements `out` is not written
    // and must be zero.
    template <class T>
    void sum(int n, const T* q, const T* v, const T* f, JointForce<T>* out) const {
        if (!any_) return;
        std::fill(out, out + n, JointForce<T>{});
        each([&](const auto& element) {
            const int c = element.coordinate;
            if constexpr (requires { element.force(T{}, T{}); }) out[c] += element.force(q[c], v[c]);
            if constexpr (requires { element.force(T{}, T{}, T{}); }) out[c] += element.force(q[c], v[c], f[c]);
        });
    }

    // Whether an element limits the constant force on its joint.
    bool limits() const { return limits_; }

  private:
    template <class>
    struct ByKind;
    template <class... Kinds>
    struct ByKind<std::variant<Kinds...>> {
        using type = std::tuple<std::vector<Kinds>...>;
    };

    ByKind<Element>::type kinds_;
    std::vector<char> anchored_;
    bool any_ = false;
    bool linear_ = true;
    bool limits_ = false;

    template <class Kind>
    void add(const Kind& element) {
        std::get<std::vector<Kind>>(kinds_).push_back(element);
        any_ = true;
        linear_ = linear_ && element.linear();
        if constexpr (requires { element.force(0.0, 0.0, 0.0); }) limits_ = limits_ || !element.linear();
        if (!Kind::anchored) return;
        if (!anchors(element.coordinate))
            anchored_.resize(std::max<std::size_t>(anchored_.size(), element.coordinate + 1));
        anchored_[element.coordinate] = 1;
    }

    template <class Visit>
    void each(const Visit& visit) const {
        const auto list = [&](const auto& kind) {
            for (const auto& element : kind) visit(element);
        };
        std::apply([&](const auto&... kind) { (list(kind), ...); }, kinds_);
    }
};

}  // namespace varpin
