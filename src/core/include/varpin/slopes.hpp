// Derivatives in a coordinate and in its velocity, in one vector register. docs/mathematics.md,
// "Explicit methods".
#pragma once

#include "varpin/simd.hpp"
#include "varpin/spatial.hpp"

namespace varpin {

// The derivatives of a number in a coordinate and in its velocity.
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
