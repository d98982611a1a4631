// A step in parts: whole, or in halves, and halves of halves. docs/mathematics.md, "The principal branch". A part that
// was halved `level` times is h / 2^level long and begins at a multiple of 1 / 2^level of the step.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "varpin/nodes.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// What h becomes by so many halvings.
inline double length_of(double h, int level) { return h / static_cast<double>(std::int64_t{1} << level); }

// A step that needs more parts than so many is given up. Few steps need short parts all over: dry friction that turns
// round within a step needs a few of them, however short.
constexpr std::size_t most_parts = 4096;

struct Division {
    Outcome outcome = Outcome::solved;
    int deepest = 0;  // halvings of the shortest part
};

// Take a step in as many parts as it needs, the first one halved `level` times. attempt(level, begin, extrapolated)
// takes a part that begins at `begin`, in units of the step. One that fails is halved, unless only the guess may be to
// blame, which is `extrapolated` the first time at most; after a success at an even place parts are doubled again.
// `halvings` are those of each part; none if the step was taken whole.
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

// Take a part again: part(level, begin), or both of its halves where that fails.
template <class Part>
Outcome part_again(int level, double begin, int most_halvings, const Part& part) {
    const Outcome outcome = part(level, begin);
    if (outcome == Outcome::solved || level >= most_halvings) return outcome;
    const Outcome half = part_again(level + 1, begin, most_halvings, part);
    if (half != Outcome::solved) return half;
    return part_again(level + 1, begin + length_of(1.0, level + 1), most_halvings, part);
}

// Take a step again in the parts of these halvings, or whole if there are none.
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

// Derivatives (2n, 2n) and (2n, n) of a step from those of its parts, `part` and `part_f`.
class ChainedDerivatives {
  public:
    explicit ChainedDerivatives(int n, int rates = 0)
        : part(entries(2 * n, 2 * n)),
          part_f(entries(2 * n, n)),
          part_rate(entries(2 * n, rates)),
          n_(n),
          rates_(rates),
          product_(part.size()) {}

    std::vector<double> part, part_f, part_rate;  // of the last part

    // Of a step of no length.
    void begin(double* Jx, double* Jf) const {
        std::fill(Jx, Jx + 4 * n_ * n_, 0.0);
        std::fill(Jf, Jf + 2 * n_ * n_, 0.0);
        for (int i = 0; i < 2 * n_; ++i) Jx[i * 2 * n_ + i] = 1.0;
    }

    // Let the last part follow those before; the same of derivatives in rates (2n, rates).
    void follow_rates(double* Jr) {
        times(rates_, Jr);
        for (int i = 0; i < 2 * n_ * rates_; ++i) Jr[i] += part_rate[i];
    }
    void follow(double* Jx, double* Jf) {
        times(2 * n_, Jx);
        times(n_, Jf);
        for (int i = 0; i < 2 * n_ * n_; ++i) Jf[i] += part_f[i];
    }

  private:
    int n_, rates_;
    std::vector<double> product_;

    void times(int columns, double* right) {
        const int x = 2 * n_;
        std::fill(product_.begin(), product_.begin() + x * columns, 0.0);
        for (int i = 0; i < x; ++i) {
            for (int j = 0; j < x; ++j) {
                const double factor = part[i * x + j];
                if (factor == 0.0) continue;
                for (int c = 0; c < columns; ++c) product_[i * columns + c] += factor * right[j * columns + c];
            }
        }
        std::copy(product_.begin(), product_.begin() + x * columns, right);
    }
};

}  // namespace varpin
