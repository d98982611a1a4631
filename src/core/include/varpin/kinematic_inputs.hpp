// Joints whose motion is given: each moves to its goal, its entry of the step's force, at a constant rate, or on the
// cubic between the rates at both ends, the second given by a control. Its constraint row is g = q - (this motion), and
// no force but the row's acts on it. Where a control is held over several steps, the goal is at the end of the last of
// them. docs/constraints.md.
#pragma once

#include <algorithm>
#include <vector>

#include "varpin/constraints.hpp"

namespace varpin {

class KinematicInputs {
  public:
    explicit KinematicInputs(const std::vector<DrivenRow>& driven) : driven(driven) {
        cubic = std::any_of(driven.begin(), driven.end(), [](const DrivenRow& own) { return own.rate >= 0; });
    }

    const std::vector<DrivenRow>& driven;
    std::vector<double> goal = zeros(count());
    std::vector<double> goal_rate = zeros(count()),
                        begun = zeros(count());  // rates at the goal and at the beginning of the part
    bool cubic = false;                          // whether any is
    int left = 1;                                // steps to the goal
    double share = 1.0;                          // the next part's share of the time to the goal

    int count() const { return static_cast<int>(driven.size()); }
    // Index of the input of a row, or -1.
    int of_row(int row) const {
        for (int d = 0; d < count(); ++d) {
            if (driven[d].row == row) return d;
        }
        return -1;
    }

    // The displacement is ahead * (distance to the goal) + T (begin * (rate at the start) + end * (rate at the goal)),
    // with T the time to the goal.
    struct Way {
        double ahead, begin, end;
    };
    // These coefficients after the share `at` of T.
    Way way_at(int d, double at) const {
        if (driven[d].rate < 0) return {at, 0.0, 0.0};
        return {at * at * (3.0 - 2.0 * at), at * (1.0 - at) * (1.0 - at), at * at * (at - 1.0)};
    }
    // Those of the rate: ahead * (distance / T) + begin * (rate at the start) + end * (rate at the goal).
    Way pace_at(int d, double at) const {
        if (driven[d].rate < 0) return {1.0, 0.0, 0.0};
        return {6.0 * at * (1.0 - at), (1.0 - at) * (1.0 - 3.0 * at), at * (3.0 * at - 2.0)};
    }
    double rate_at(int d, double at, double h, double from) const {
        const Way pace = pace_at(d, at);
        return pace.ahead * share * (goal[d] - from) / h + pace.begin * begun[d] + pace.end * goal_rate[d];
    }
};

}  // namespace varpin
