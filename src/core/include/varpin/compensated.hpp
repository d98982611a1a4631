// Compensated sums, and angles without whole turns: the Lagrangian is periodic in them, and after a million turns an
// angle has only nine decimals. docs/mathematics.md, "Solving a step".
#pragma once

#ifdef __FAST_MATH__
#error "varpin needs IEEE arithmetic: -ffast-math reorders its compensated sums and removes its checks for NaN"
#endif

#include <cmath>
#include <numbers>

namespace varpin {

// The sum high + low, where low is the rounding error of high.
struct Compensated {
    double high = 0.0;
    double low = 0.0;

    // Knuth's two-sum; `rest` is what the increment's last digits leave of it.
    [[nodiscard]] Compensated plus(double increment, double rest = 0.0) const {
        increment += low + rest;
        const double total = high + increment;
        const double part = total - high;
        return {total, (high - (total - part)) + (increment - part)};
    }
};

// A coordinate: its value within one turn, and its whole turns.
struct Coordinate {
    Compensated value;
    double turns = 0.0;

    // A turn in two parts, the first with so few digits that its multiples are exact (Cody and Waite 1980).
    static constexpr double turn = 2.0 * std::numbers::pi;
    static constexpr double turn_high = 6.28125;
    static constexpr double turn_low = 0.0019353071795864769253;

    // Remove whole turns.
    void unwind() {
        if (std::abs(value.high) <= turn) return;
        const double whole = std::floor(value.high / turn + 0.5);
        value = value.plus(-whole * turn_high).plus(-whole * turn_low);
        turns += whole;
    }

    double shown() const {
        if (turns == 0.0) return value.high;
        return turns * turn_high + (value.high + (turns * turn_low + value.low));
    }
};

}  // namespace varpin
