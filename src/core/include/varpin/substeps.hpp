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

// A step that needs more parts than so many is given up. Few steps need short parts all over: dry friction that turns
// round within a step needs a few of them, however short.
constexpr std::size_t most_parts = 4096;

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

// Derivatives (2n, 2n) and (2n, n) of a step from those of its parts, `part` and `part_f`.
class ChainedDerivatives {
  public:
    explicit ChainedDerivatives(int n, int rates = 0) : n(n), rates(rates) {}

    const int n, rates;
    std::vector<double> part = zeros(2 * n, 2 * n), part_f = zeros(2 * n, n);  // of the last part
    std::vector<double> part_rate = zeros(2 * n, rates);

    // The derivatives of a step of zero length.
    void begin(double* Jx, double* Jf) const {
        std::fill(Jx, Jx + 4 * n * n, 0.0);
        std::fill(Jf, Jf + 2 * n * n, 0.0);
        for (int i = 0; i < 2 * n; ++i) Jx[i * 2 * n + i] = 1.0;
    }

    // Multiply by the derivatives of the last part; follow_rates does so for derivatives in rates (2n, rates).
    void follow_rates(double* Jr) { follow_more(Jr, part_rate); }
    // As follow_rates, with those of the last part in any further `columns` (2n, k).
    void follow_more(double* J, const std::vector<double>& columns) {
        times(static_cast<int>(columns.size()) / (2 * n), J);
        for (std::size_t i = 0; i < columns.size(); ++i) J[i] += columns[i];
    }
    void follow(double* Jx, double* Jf) {
        times(2 * n, Jx);
        times(n, Jf);
        for (int i = 0; i < 2 * n * n; ++i) Jf[i] += part_f[i];
    }

  private:
    std::vector<double> product_ = zeros(2 * n, 2 * n);

    void times(int columns, double* right) {
        const int x = 2 * n;
        product_.resize(entries(x, std::max(columns, x)));
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
