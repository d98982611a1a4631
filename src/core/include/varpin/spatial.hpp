// Spatial algebra (Featherstone 2008): motions and forces as (linear, angular) pairs, inertias as mass, first and
// second moments, all about one point and in the same axes. T is double, or Dual for derivatives along a direction.
// docs/mathematics.md, "The Lagrangian jet".
#pragma once

namespace varpin {

template <class T>
struct Vec3 {
    T x{}, y{}, z{};
};

template <class T, class U>
constexpr auto operator+(const Vec3<T>& a, const Vec3<U>& b) -> Vec3<decltype(a.x + b.x)> {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class T>
constexpr Vec3<T> operator-(const Vec3<T>& a, const Vec3<T>& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class S, class T>
constexpr auto operator*(const S& s, const Vec3<T>& a) -> Vec3<decltype(s * a.x)> {
    return {s * a.x, s * a.y, s * a.z};
}
template <class T>
constexpr Vec3<T>& operator+=(Vec3<T>& a, const Vec3<T>& b) {
    return a = a + b;
}
template <class T, class U>
constexpr auto dot(const Vec3<T>& a, const Vec3<U>& b) -> decltype(a.x * b.x) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class T, class U>
constexpr auto cross(const Vec3<T>& a, const Vec3<U>& b) -> Vec3<decltype(a.x * b.x)> {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// A matrix by its columns.
template <class T>
struct Mat3 {
    Vec3<T> x{}, y{}, z{};
};

template <class T, class U>
[[gnu::always_inline]] constexpr auto operator*(const Mat3<T>& R, const Vec3<U>& a) -> Vec3<decltype(R.x.x * a.x)> {
    return {R.x.x * a.x + R.y.x * a.y + R.z.x * a.z, R.x.y * a.x + R.y.y * a.y + R.z.y * a.z,
            R.x.z * a.x + R.y.z * a.y + R.z.z * a.z};
}
template <class T, class U>
constexpr auto operator*(const Mat3<T>& R, const Mat3<U>& A) -> Mat3<decltype(R.x.x * A.x.x)> {
    return {R * A.x, R * A.y, R * A.z};
}
template <class T>
constexpr Mat3<T> transposed(const Mat3<T>& R) {
    return {{R.x.x, R.y.x, R.z.x}, {R.x.y, R.y.y, R.z.y}, {R.x.z, R.y.z, R.z.z}};
}

// A symmetric matrix.
template <class T>
struct Sym3 {
    T xx{}, xy{}, yy{}, xz{}, yz{}, zz{};
};

template <class T, class U>
constexpr auto operator*(const Sym3<T>& I, const Vec3<U>& a) -> Vec3<decltype(I.xx * a.x)> {
    return {I.xx * a.x + I.xy * a.y + I.xz * a.z, I.xy * a.x + I.yy * a.y + I.yz * a.z,
            I.xz * a.x + I.yz * a.y + I.zz * a.z};
}
template <class T>
constexpr Sym3<T>& operator+=(Sym3<T>& a, const Sym3<T>& b) {
    return a = {a.xx + b.xx, a.xy + b.xy, a.yy + b.yy, a.xz + b.xz, a.yz + b.yz, a.zz + b.zz};
}

// R I R'.
template <class T>
constexpr Sym3<T> rotated(const Mat3<T>& R, const Sym3<double>& I) {
    const Mat3<double> columns{{I.xx, I.xy, I.xz}, {I.xy, I.yy, I.yz}, {I.xz, I.yz, I.zz}};
    const Mat3<T> t = transposed(R * columns);  // its columns are the rows of R I
    const Mat3<T> r = transposed(R);
    return {dot(t.x, r.x), dot(t.x, r.y), dot(t.y, r.y), dot(t.x, r.z), dot(t.y, r.z), dot(t.z, r.z)};
}

// A motion or a force, which are not to be confused.
template <class T, class Kind>
struct Six {
    Vec3<T> linear{}, angular{};
};
template <class T>
using Motion = Six<T, struct IsMotion>;
template <class T>
using Force = Six<T, struct IsForce>;

template <class T, class Kind>
constexpr Six<T, Kind> operator+(const Six<T, Kind>& a, const Six<T, Kind>& b) {
    return {a.linear + b.linear, a.angular + b.angular};
}
template <class T, class Kind>
constexpr Six<T, Kind>& operator+=(Six<T, Kind>& a, const Six<T, Kind>& b) {
    return a = a + b;
}
template <class T, class Kind>
constexpr Six<T, Kind> operator*(const T& s, const Six<T, Kind>& a) {
    return {s * a.linear, s * a.angular};
}
template <class T, class U>
constexpr auto dot(const Motion<T>& a, const Force<U>& f) -> decltype(a.linear.x * f.linear.x) {
    return a.linear.x * f.linear.x + a.linear.y * f.linear.y + a.linear.z * f.linear.z + a.angular.x * f.angular.x +
           a.angular.y * f.angular.y + a.angular.z * f.angular.z;
}
// a x b, the rate of a motion that is fixed to a body with velocity a.
template <class T>
[[gnu::always_inline]] constexpr Motion<T> cross(const Motion<T>& a, const Motion<T>& b) {
    return {cross(a.angular, b.linear) + cross(a.linear, b.angular), cross(a.angular, b.angular)};
}
// a x* f, the rate of a force that is fixed to a body with velocity a.
template <class T>
constexpr Force<T> cross(const Motion<T>& a, const Force<T>& f) {
    return {cross(a.angular, f.linear), cross(a.angular, f.angular) + cross(a.linear, f.linear)};
}

// Mass, first moment m c and second moments about the common reference point.
template <class T>
struct Inertia {
    T mass{};
    Vec3<T> moment{};
    Sym3<T> second{};
};

template <class T, class U>
[[gnu::always_inline]] constexpr auto operator*(const Inertia<T>& Y, const Motion<U>& a)
    -> Force<decltype(Y.mass * a.linear.x)> {
    return {Y.mass * a.linear + cross(a.angular, Y.moment), Y.second * a.angular + cross(Y.moment, a.linear)};
}

// The inertia of a body with mass m, centre c and inertia I about c, in body axes with orientation R and position p.
template <class T>
constexpr Inertia<T> placed(const Mat3<T>& R, const Vec3<T>& p, double m, const Vec3<double>& c,
                            const Sym3<double>& I) {
    const Vec3<T> at = p + R * c;
    const Vec3<T> h = m * at;
    Sym3<T> second = rotated(R, I);
    second += {h.y * at.y + h.z * at.z, -(h.x * at.y), h.x * at.x + h.z * at.z,
               -(h.x * at.z),           -(h.y * at.z), h.x * at.x + h.y * at.y};
    return {T(m), h, second};
}

}  // namespace varpin
