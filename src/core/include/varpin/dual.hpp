// Numbers with one derivative: value + slope e, e^2 = 0. The jet of such numbers is differentiated along a direction.
// docs/mathematics.md, "Linearization" and "Second derivatives".
#pragma once

#include <cmath>

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
inline Dual sin(Dual a) { return {std::sin(a.value), a.slope * std::cos(a.value)}; }
inline Dual tanh(Dual a) {
    const double t = std::tanh(a.value);
    return {t, a.slope * (1.0 - t * t)};
}
inline Dual exp(Dual a) {
    const double e = std::exp(a.value);
    return {e, a.slope * e};
}
inline Dual cos(Dual a) { return {std::cos(a.value), -a.slope * std::sin(a.value)}; }

}  // namespace varpin
