// Numbers with one derivative: value + slope e, e^2 = 0. The jet of such numbers is differentiated along a direction.
// docs/mathematics.md, "Linearization" and "Second derivatives".
#pragma once

#include <cmath>

#include "varpin/elementary.hpp"
#include "varpin/simd.hpp"
#include "varpin/spatial.hpp"

namespace varpin {

struct Dual {
    double value = 0.0;
    double slope = 0.0;

    constexpr Dual() = default;
    constexpr Dual(double value, double slope = 0.0) : value(value), slope(slope) {}
};

constexpr Dual operator+(Dual a, Dual b) { return {a.value + b.value, a.slope + b.slope}; }
constexpr Dual operator-(Dual a, Dual b) { return {a.value - b.value, a.slope - b.slope}; }
constexpr Dual operator-(Dual a) { return {-a.value, -a.slope}; }
constexpr Dual operator*(Dual a, Dual b) { return {a.value * b.value, a.slope * b.value + a.value * b.slope}; }
constexpr Dual operator*(double a, Dual b) { return {a * b.value, a * b.slope}; }
constexpr Dual operator*(Dual a, double b) { return b * a; }
constexpr Dual& operator+=(Dual& a, Dual b) { return a = a + b; }
constexpr Dual& operator-=(Dual& a, Dual b) { return a = a - b; }
constexpr double value_of(double a) { return a; }
constexpr double value_of(Dual a) { return a.value; }
inline Dual sqrt(Dual a) {
    const double root = std::sqrt(a.value);
    return {root, 0.5 * a.slope / root};
}
inline elementary::Turn<Dual> turn(Dual a) {
    const auto [c, s] = elementary::turn(a.value);
    return {{c, -a.slope * s}, {s, a.slope * c}};
}
inline Dual tanh(Dual a) {
    const double t = elementary::tanh(a.value);
    return {t, a.slope * (1.0 - t * t)};
}
inline Dual exp(Dual a) {
    const double e = elementary::exp(a.value);
    return {e, a.slope * e};
}

// The derivatives of a number in a coordinate and in its velocity, in one vector register. docs/mathematics.md,
// "Explicit methods".
struct Slopes {
    Pair both{0.0, 0.0};

    Slopes() = default;
    explicit Slopes(Pair both) : both(both) {}
    Slopes(double q, double v) : both{q, v} {}

    double q() const { return both[0]; }
    double v() const { return both[1]; }
};

inline Slopes operator+(Slopes a, Slopes b) { return Slopes(a.both + b.both); }
inline Slopes operator-(Slopes a, Slopes b) { return Slopes(a.both - b.both); }
inline Slopes operator*(double s, Slopes a) { return Slopes(Pair{s, s} * a.both); }
inline Slopes operator*(Slopes a, double s) { return s * a; }
inline Slopes& operator+=(Slopes& a, Slopes b) { return a = a + b; }

inline Vec3<Slopes> slopes(const Vec3<double>& q, const Vec3<double>& v) {
    return {{q.x, v.x}, {q.y, v.y}, {q.z, v.z}};
}
inline Motion<Slopes> slopes(const Motion<double>& q, const Motion<double>& v) {
    return {slopes(q.linear, v.linear), slopes(q.angular, v.angular)};
}

}  // namespace varpin
