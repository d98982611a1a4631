// The running cost of a motion during its simulation, and whether to stop the motion early. Its costs:
// docs/mathematics.md, "Costs in the task".
#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "varpin/costs.hpp"

namespace varpin {

class Watch {
  public:
    enum class Verdict : std::int64_t {
        going = 0,
        cut = 1,   // its steps are divided into too many parts
        dear = 2,  // its cost exceeds the limit
    };

    // Watches a motion over N steps, whose nodes q and v (N + 1, n) and controls u (N, m) are written during the watch,
    // except the first node. Writes the cost terms at the s samples of each step by `rule` (s, 9) into `values` (N s,
    // terms).
    Watch(const CostTerms& costs, const double* rule, std::size_t samples, const double* q, const double* v,
          const double* u, double* values)
        : costs_(costs),
          sample_(costs),
          rule_(rule),
          samples_(samples),
          q_(q),
          v_(v),
          u_(u),
          values_(values),
          at_q_(samples * costs.dof),
          at_v_(at_q_.size()) {}

    double weight = 1.0;                                          // of a value in the cost
    double most = std::numeric_limits<double>::infinity();        // largest cost,
    std::ptrdiff_t from = 0;                                      // checked from this number of steps on
    double most_parts = std::numeric_limits<double>::infinity();  // most parts of the first `from` steps together
    Verdict verdict = Verdict::going;

    // Account for step s, which was divided into `parts`; false to stop the motion.
    bool after(std::ptrdiff_t s, std::int64_t parts) {
        const auto n = static_cast<std::size_t>(costs_.dof), m = static_cast<std::size_t>(costs_.controls);
        const auto step = static_cast<std::size_t>(s);
        const std::size_t terms = costs_.terms.size();
        sample_steps(rule_, samples_, 1, n, q_ + step * n, v_ + step * n, at_q_.data(), at_v_.data());
        for (std::size_t k = 0; k < samples_; ++k) {
            const std::size_t row = step * samples_ + k;
            double* found = values_ + row * terms;
            sample_.values(at_q_.data() + k * n, at_v_.data() + k * n, u_ + step * m, row, found);
            for (std::size_t t = 0; t < terms; ++t) spent_ += found[t];
        }
        parts_ += parts;
        if (s + 1 < from) return true;
        if (s + 1 == from && static_cast<double>(parts_) > most_parts) verdict = Verdict::cut;
        if (verdict == Verdict::going && weight * spent_ > most) verdict = Verdict::dear;
        return verdict == Verdict::going;
    }

  private:
    const CostTerms& costs_;
    CostSample sample_;
    const double* rule_;
    std::size_t samples_;
    const double *q_, *v_, *u_;
    double* values_;
    std::vector<double> at_q_, at_v_;
    double spent_ = 0.0;
    std::int64_t parts_ = 0;
};

}  // namespace varpin
