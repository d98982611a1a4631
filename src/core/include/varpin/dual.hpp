// Numbers with one derivative: value + slope e, e^2 = 0. The jet of such numbers is differentiated along a direction.
// docs/mathematics.md, "Linearization" and "Second derivatives".
#pragma once

#include <cmath>

#include "varpin/elementary.hpp"

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

}  // namespace varpin
