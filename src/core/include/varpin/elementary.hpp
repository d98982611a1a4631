// Sine, cosine, exponential, hyperbolic tangent and arc tangent with the same bytes on every machine: those of the C
// library differ in the last digit between processors, for it takes fused multiplications where there are any. Sums and
// products alone are used here, in a fixed order; they are good to about one unit in the last place.
// Algorithms: FreeBSD's msun (sine, cosine, exponential) and S. L. Moshier's Cephes (tangents). See docs/core.md.
#pragma once

#include <cmath>
#include <limits>

namespace varpin::elementary {

// The nearest integer of a number below 2^51.
inline double nearest(double x) {
    constexpr double shift = 6755399441055744.0;  // 1.5 * 2^52: no digit behind the point is left beside it
    return (x + shift) - shift;
}

// An angle less a multiple of pi / 2: the quadrant, and what is left in two parts.
struct Reduced {
    int quadrant;
    double value, rest;
};

// Beyond this angle [rad] the parts of pi / 2 have too few digits, and the C library's functions are taken.
inline constexpr double largest_angle = 1.6e6;

inline Reduced reduced(double x) {
    constexpr double quarter = 0.78539816339744830962, per_turn = 6.36619772367581382433e-01;
    // pi / 2 in parts of 33 digits, and what each leaves.
    constexpr double first = 1.57079632673412561417e+00, second = 6.07710050630396597660e-11,
                     second_rest = 2.02226624879595063154e-21, third = 2.02226624871116645580e-21,
                     third_rest = 8.47842766036889956997e-32;
    if (std::abs(x) <= quarter) return {0, x, 0.0};
    const double turns = nearest(x * per_turn);
    const double begun = x - turns * first;
    double part = turns * second, left = begun - part;
    double rest = turns * second_rest - ((begun - left) - part);
    double value = left - rest;
    if (std::abs(value) < 0x1p-49 * std::abs(x)) {
        const double before = left;
        part = turns * third;
        left = before - part;
        rest = turns * third_rest - ((before - left) - part);
        value = left - rest;
    }
    return {static_cast<int>(static_cast<long long>(turns) & 3), value, (left - value) - rest};
}

inline double sine_near_zero(double x, double rest) {
    const double z = x * x, cube = z * x;
    const double r =
        8.33333333332248946124e-03 +
        z * (-1.98412698298579493134e-04 +
             z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)));
    return x - ((z * (0.5 * rest - cube * r) - rest) - cube * -1.66666666666666324348e-01);
}

inline double cosine_near_zero(double x, double rest) {
    const double z = x * x, square = z * z;
    const double r =
        z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * 2.48015872894767294178e-05)) +
        square * square *
            (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11));
    const double half = 0.5 * z, w = 1.0 - half;
    return w + (((1.0 - w) - half) + (z * r - x * rest));
}

// The cosine and sine of an angle [rad].
template <class T>
struct Turn {
    T cosine, sine;
};

inline Turn<double> turn(double x) {
    if (!(std::abs(x) <= largest_angle)) return {std::cos(x), std::sin(x)};
    const auto [quadrant, value, rest] = reduced(x);
    const double c = cosine_near_zero(value, rest), s = sine_near_zero(value, rest);
    switch (quadrant) {
        case 0:
            return {c, s};
        case 1:
            return {-s, c};
        case 2:
            return {-c, -s};
        default:
            return {s, -c};
    }
}

inline double exp(double x) {
    if (std::isnan(x)) return x;
    if (x > 709.782712893383973096) return std::numeric_limits<double>::infinity();
    if (x < -745.13321910194110842) return 0.0;
    const double power = nearest(x * 1.44269504088896338700e+00);
    const double high = x - power * 6.93147180369123816490e-01, low = power * 1.90821492927058770002e-10;
    const double r = high - low, t = r * r;
    const double c = r - t * (1.66666666666666019037e-01 +
                              t * (-2.77777777770155933842e-03 +
                                   t * (6.61375632143793436117e-05 +
                                        t * (-1.65339022054652515390e-06 + t * 4.13813679705723846039e-08))));
    return std::ldexp(1.0 - ((low - (r * c) / (2.0 - c)) - high), static_cast<int>(power));
}

inline double tanh(double x) {
    const double size = std::abs(x);
    if (size < 0.625) {
        const double z = x * x;
        const double top = (-9.64399179425052238628e-1 * z - 9.92877231001918586564e1) * z - 1.61468768441708447952e3;
        const double bottom =
            ((z + 1.12811678491632931402e2) * z + 2.23548839060100448583e3) * z + 4.84406305325125486048e3;
        return x + x * z * (top / bottom);
    }
    const double found = size > 22.0 ? 1.0 : 1.0 - 2.0 / (exp(2.0 * size) + 1.0);
    return std::isnan(x) ? x : std::copysign(found, x);
}

inline double atan(double x) {
    constexpr double half_pi = 1.57079632679489661923, more_digits = 6.123233995736765886130e-17;
    const double size = std::abs(x);
    double base = 0.0, left = size, rest = 0.0;
    if (size > 2.41421356237309504880) {
        base = half_pi, left = -1.0 / size, rest = more_digits;
    } else if (size > 0.66) {
        base = 0.5 * half_pi, left = (size - 1.0) / (size + 1.0), rest = 0.5 * more_digits;
    }
    const double z = left * left;
    const double top =
        (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z -
         1.228866684490136173410e2) *
            z -
        6.485021904942025371773e1;
    const double bottom =
        ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2) * z +
         4.853903996359136964868e2) *
            z +
        1.945506571482613964425e2;
    return std::copysign(base + ((left + left * (z * (top / bottom))) + rest), x);
}

// The angle of (x, y), y >= 0.
inline double angle_above(double y, double x) {
    constexpr double pi = 3.14159265358979323846, more_digits = 1.22464679914735317723e-16;
    if (x > 0.0) return atan(y / x);
    if (x == 0.0) return y == 0.0 ? 0.0 : 0.5 * pi;
    return pi + (atan(y / x) + more_digits);
}

}  // namespace varpin::elementary
