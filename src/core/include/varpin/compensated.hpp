// Sums that keep what rounding takes from them, and angles with whole turns taken off.
//
// A joint that has turned a million times stands at an angle of which floating point keeps nine decimals, and a sweep
// would see no more of it. The Lagrangian does not know how often an angle went round, so sweeps see it within one
// turn; the turns are counted beside it, and the angle that is shown is continuous.
#pragma once

#include <cmath>
#include <numbers>

namespace varpin {

// high + low, low being what rounding took from high.
struct Compensated {
    double high = 0.0;
    double low = 0.0;

    // Knuth's two-sum.
    [[nodiscard]] Compensated plus(double increment) const {
        increment += low;
        const double total = high + increment;
        const double part = total - high;
        return {total, (high - (total - part)) + (increment - part)};
    }
};

// A coordinate: its value within one turn, and the whole turns beside it.
struct Coordinate {
    Compensated value;
    double turns = 0.0;

    // A turn in two parts, the first so short that its multiples are exact (Cody and Waite 1980).
    static constexpr double turn = 2.0 * std::numbers::pi;
    static constexpr double turn_high = 6.28125;
    static constexpr double turn_low = 0.0019353071795864769253;

    // Take whole turns off.
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
