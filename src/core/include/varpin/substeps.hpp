// Division of a step into parts by repeated halving. docs/mathematics.md, "The principal branch". A part after `level`
// halvings has length h / 2^level and begins at a multiple of 1 / 2^level of the step.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "varpin/nodes.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// The length h / 2^level of a part.
inline double length_of(double h, int level) { return h / static_cast<double>(std::int64_t{1} << level); }

// A step that needs more parts than so many is given up, as when a control loop runs away at 1000 rad/s. Few steps need
// short parts all over: dry friction that turns round within a step needs a few of them, however short. Of 540 motions
// with sharp friction, stops and stiff springs 10 fail with 1024 and with 4096, and 20 with 256.
constexpr std::size_t most_parts = 1024;

struct Division {
    Outcome outcome = Outcome::solved;
    int deepest = 0;  // halvings of the shortest part
};

// Take a step in as many parts as it needs, the first one after `level` halvings. attempt(level, begin, extrapolated)
// takes a part at `begin`, in units of the step. A part that fails is halved; if its guess was extrapolated, which only
// the first guess is, it is first repeated without extrapolation. After a success that ends at an even position, the
// next part is twice as long. `halvings` are those of each part, empty for an undivided step.
template <class Attempt>
Division divide(int level, bool extrapolated, int most_halvings, std::vector<std::uint8_t>& halvings,
                const Attempt& attempt) {
    int deepest = level;
    std::int64_t begin = 0;  // in units of 1 / 2^level
    halvings.clear();
    while (begin < (std::int64_t{1} << level)) {
        const Outcome outcome = attempt(level, length_of(static_cast<double>(begin), level), extrapolated);
        if (outcome == Outcome::solved) {
            if (level > 0) halvings.push_back(static_cast<std::uint8_t>(level));
            ++begin;
            if (level > 0 && begin % 2 == 0) {
                --level;
                begin /= 2;
            }
        } else if (!(extrapolated && outcome != Outcome::energy)) {
            if (level >= most_halvings || halvings.size() >= most_parts) return {outcome, deepest};
            ++level;
            begin *= 2;
        }
        deepest = std::max(deepest, level);
        extrapolated = false;
    }
    return {Outcome::solved, deepest};
}

// Repeat a part: part(level, begin), or both of its halves if that fails.
template <class Part>
Outcome part_again(int level, double begin, int most_halvings, const Part& part) {
    const Outcome outcome = part(level, begin);
    if (outcome == Outcome::solved || level >= most_halvings) return outcome;
    const Outcome half = part_again(level + 1, begin, most_halvings, part);
    if (half != Outcome::solved) return half;
    return part_again(level + 1, begin + length_of(1.0, level + 1), most_halvings, part);
}

// Repeat a step in the parts of these halvings, or undivided if there are none.
template <class Part>
Outcome parts_again(std::span<const std::uint8_t> halvings, int most_halvings, const Part& part) {
    if (halvings.empty()) return part_again(0, 0.0, most_halvings, part);
    double begin = 0.0;
    for (const std::uint8_t level : halvings) {
        const Outcome outcome = part_again(level, begin, most_halvings, part);
        if (outcome != Outcome::solved) return outcome;
        begin += length_of(1.0, level);
    }
    return Outcome::solved;
}

}  // namespace varpin
