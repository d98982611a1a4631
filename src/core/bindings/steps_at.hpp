// The steps of a trajectory that are repeated for their derivatives. docs/core.md, "The map".
#pragma once

#include <nanobind/stl/tuple.h>

#include <cstdint>
#include <span>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "varpin/guards.hpp"

namespace varpin::border {

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

    const double* q(std::size_t s) const { return q_.data() + s * n; }
    const double* p(std::size_t s) const { return p_.data() + s * n; }
    const double* force(std::size_t s) const { return force_.data() + s * force_.shape(1) * n; }
    // The halvings of the parts of a step; empty for an undivided step.
    std::span<const std::uint8_t> halvings(std::size_t s) const {
        return {halvings_.data() + place_[s], place_[s + 1] - place_[s]};
    }
    // The number of consecutive undivided steps before a step, up to the number that its guess uses.
    int past(std::size_t s) const {
        int found = 0;
        while (found < 8 && s > static_cast<std::size_t>(found) && place_[s - found - 1] == place_[s]) ++found;
        return found;
    }

    // Stage velocities (s, n) close to those of an undivided step.
    const double* guess(std::size_t s) const { return guess_.data() + s * guess_.shape(1) * n; }

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

    // d(q1, p1)/d(q0, p0) (N, 2n, 2n), d(q1, p1)/df (N, 2n, n) and `more` further columns (N, 2n, more) of each step,
    // and what `each` returns. first(step, Jx, Jf, Jr) writes the derivatives of one step.
    template <class First>
    std::tuple<Out, Out, Out, std::int64_t, std::size_t> derivatives(std::size_t more, const First& first) const {
        const Out X = array_for({N, 2 * n, 2 * n}), F = array_for({N, 2 * n, n}), R = array_for({N, 2 * n, more});
        const auto [outcome, done] = each([&](std::size_t s) {
            return first(s, X.data() + s * 4 * n * n, F.data() + s * 2 * n * n, R.data() + s * 2 * n * more);
        });
        return {X, F, R, outcome, done};
    }

  private:
    In<2> q_, p_;
    In<3> force_;  // (N, 1, n) constant over a step, or (N, s, n)
    Bytes halvings_;
    In<3> guess_;
    std::vector<std::size_t> place_;  // (N + 1) index of the first part of each step
};

}  // namespace varpin::border
