// A watch with references to its arrays. docs/core.md, "The map".
#pragma once

#include <cstdint>
#include <stdexcept>

#include "arrays.hpp"
#include "varpin/nodes.hpp"
#include "varpin/watch.hpp"

namespace varpin::border {

class HeldWatch {
  public:
    HeldWatch(const CostTerms& costs, In<2> rule, In<2> q, In<2> v, In<2> u, InOut<2> values)
        : costs_(costs),
          terms_(costs.terms.size()),
          rule_(rule),
          q_(q),
          v_(v),
          u_(u),
          values_(values),
          core(costs, rule.data(), rule.shape(0), q.data(), v.data(), u.data(), values.data()) {
        const std::size_t N = u.shape(0), n = static_cast<std::size_t>(costs.dof);
        require(rule, "rule", {rule.shape(0), 9});
        require(q, "q", {N + 1, n});
        require(v, "v", {N + 1, n});
        require(u, "u", {N, static_cast<std::size_t>(costs.controls)});
        require(values, "values", {N * rule.shape(0), costs.terms.size()});
    }

    // The watch of a rollout of one path, after a check of the number of steps.
    Watch* of(const Nodes& nodes) {
        if (nodes.paths != 1 || nodes.steps != static_cast<std::int64_t>(u_.shape(0)))
            throw std::invalid_argument("a watch needs one path and the same number of steps");
        require_same();
        return &core;
    }

    bool after(std::size_t step, std::int64_t parts) {
        if (step >= u_.shape(0)) throw std::invalid_argument("there is no such step");
        require_same();
        return core.after(static_cast<std::ptrdiff_t>(step), parts);
    }

  private:
    // The work arrays are those of the terms that there were.
    void require_same() const {
        if (costs_.terms.size() != terms_) throw std::invalid_argument("terms were added to the costs after the watch");
    }

    const CostTerms& costs_;
    std::size_t terms_;
    In<2> rule_, q_, v_, u_;
    InOut<2> values_;

  public:
    Watch core;
};

}  // namespace varpin::border
