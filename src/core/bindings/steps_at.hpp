// The steps of a trajectory that are repeated for their derivatives. docs/core.md, "The map".
#pragma once

#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <span>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "varpin/guards.hpp"
#include "varpin/repeated_steps.hpp"

namespace varpin::border {

// Parameters from pairs of mechanisms, whose owner keeps them alive, their distances, and the gears (k, 2, n).
struct Parameters {
    Parameters(const std::vector<std::pair<const Mechanism*, const Mechanism*>>& pairs, In<1> distance, In<3> gears) {
        const std::size_t n = gears.shape(2);
        require(distance, "distance", {pairs.size()});
        require(gears, "gears", {pairs.size(), 2, n});
        for (std::size_t k = 0; k < pairs.size(); ++k) {
            const auto& [above, below] = pairs[k];
            for (const Mechanism* each : {above, below}) {
                if (static_cast<std::size_t>(each->dof()) != n)
                    throw std::invalid_argument("a parameter's mechanisms must have as many coordinates as gears");
            }
            const double* gear = gears.data() + k * 2 * n;
            all.push_back({above, below, distance(k), {gear, gear + n}, {gear + n, gear + 2 * n}});
        }
    }

    std::vector<Parameter> all;

    // Those of steps of n coordinates; empty for none.
    static std::vector<Parameter> of(const Parameters* given, std::size_t n) {
        if (given && !given->all.empty() && given->all[0].gear_above.size() != n)
            throw std::invalid_argument("parameters must be of a mechanism with the coordinates of the steps");
        return given ? given->all : std::vector<Parameter>();
    }
};

class StepsAt {
  public:
    StepsAt(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards, double h,
            In<2> q, In<2> p, In<3> force, Integers<1> substeps, Bytes halvings, In<3> guess)
        : mechanism(mechanism),
          tableau(tableau),
          tolerance(tolerance),
          guards(guards),
          h(h),
          n(static_cast<std::size_t>(mechanism.dof())),
          N(q.shape(0)),
          varies(force.shape(1) != 1),
          q_(q),
          p_(p),
          force_(force),
          halvings_(halvings),
          guess_(guess),
          place_(N + 1, 0) {
        require_each({N, n}, "q", q, "p", p);
        require(force, "force", {N, varies ? static_cast<std::size_t>(tableau.stages) : 1, n});
        require(substeps, "substeps", {N});
        require(guess, "guess", {N, static_cast<std::size_t>(tableau.stages), n});
        for (std::size_t s = 0; s < N; ++s) {
            const std::int64_t parts = substeps(s);
            if (parts < 1 || parts > (std::int64_t{1} << 30))
                throw std::invalid_argument("a step must have from 1 to 2^30 parts");
            place_[s + 1] = place_[s] + (parts > 1 ? static_cast<std::size_t>(parts) : 0);
        }
        require(halvings, "halvings", {place_[N]});
        for (std::size_t k = 0; k < halvings.size(); ++k) {
            if (halvings(k) < 1 || halvings(k) > 62)
                throw std::invalid_argument("parts must have from 1 to 62 halvings");
        }
    }

    const Mechanism& mechanism;
    const Tableau tableau;
    const double tolerance;
    const Guards guards;
    const double h;
    const std::size_t n, N;
    const bool varies;  // whether there is a force for each stage

    // Step s. Its guess may use the consecutive undivided steps before it, eight at most.
    RepeatedStep step(std::size_t s) const {
        int past = 0;
        while (past < 8 && s > static_cast<std::size_t>(past) && place_[s - past - 1] == place_[s]) ++past;
        return {.h = h,
                .q = q_.data() + s * n,
                .p = p_.data() + s * n,
                .force = force_.data() + s * force_.shape(1) * n,
                .guess = guess_.data() + s * guess_.shape(1) * n,
                .halvings = {halvings_.data() + place_[s], place_[s + 1] - place_[s]},
                .past = past};
    }

    // The outcome of the first step that was not solved, and the number of steps before it. take(step) takes a step.
    template <class Take>
    std::pair<std::int64_t, std::size_t> each(const Take& take) const {
        nb::gil_scoped_release release;
        for (std::size_t s = 0; s < N; ++s) {
            const Outcome outcome = take(s);
            if (outcome != Outcome::solved) return {static_cast<std::int64_t>(outcome), s};
        }
        return {static_cast<std::int64_t>(Outcome::solved), N};
    }

  private:
    In<2> q_, p_;
    In<3> force_;  // (N, 1, n) constant over a step, or (N, s, n)
    Bytes halvings_;
    In<3> guess_;
    std::vector<std::size_t> place_;  // (N + 1) index of the first part of each step
};

}  // namespace varpin::border
