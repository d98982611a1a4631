// Common bindings of rollouts and derivatives of steps for the variational integrators, with and without constraints.
// docs/core.md, "The map".
#pragma once

#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "rollout_arrays.hpp"
#include "varpin/variational.hpp"

namespace varpin::border {

// P paths with the work arrays of a step, the `stepper`. Forks share these arrays, so only one of them advances at a
// time. A State is a PathState, or has one as its `path`.
template <class Stepper, class State>
class Rollout {
  public:
    Rollout(const Mechanism& mechanism, const Tableau& tableau, const Guards& guards, std::size_t paths, bool held,
            std::shared_ptr<Stepper> stepper)
        : mechanism_(&mechanism),
          stepper_(std::move(stepper)),
          guards_(guards),
          stages_(tableau.stages),
          states_(paths, State(mechanism, tableau.stages)) {
        stepper_->held = held;
    }

    // Start each path at its row of q and v (P, n); false if an M(q) is not positive definite.
    bool begin(In<2> q, In<2> v) {
        const std::size_t n = size();
        require(q, "q", {states_.size(), n});
        require(v, "v", {states_.size(), n});
        nb::gil_scoped_release release;
        for (std::size_t i = 0; i < states_.size(); ++i) {
            if (!stepper_->begin(q.data() + i * n, v.data() + i * n, states_[i])) return false;
        }
        return true;
    }

    // Add an impulse (P, n) to the momenta.
    void kick(In<2> impulse) {
        require(impulse, "impulse", {states_.size(), size()});
        for (std::size_t i = 0; i < states_.size(); ++i) {
            stepper_->look_at(states_[i]);
            stepper_->kick(impulse.data() + i * size(), states_[i]);
        }
    }

    // Configurations, momenta, velocities (P, n) and energies (P).
    std::tuple<Out, Out, Out, Out> nodes() const {
        const std::size_t n = size(), P = states_.size();
        double *q = nullptr, *p = nullptr, *v = nullptr, *energy = nullptr;
        const Out Q = array_for(q, {P, n}), MV = array_for(p, {P, n}), V = array_for(v, {P, n});
        const Out E = array_for(energy, {P});
        for (std::size_t i = 0; i < P; ++i) {
            const PathState& path = path_of(states_[i]);
            std::copy(path.q.begin(), path.q.end(), q + i * n);
            std::copy(path.momentum.begin(), path.momentum.end(), p + i * n);
            std::copy(path.v.begin(), path.v.end(), v + i * n);
            energy[i] = path.energies.total();
        }
        return {Q, MV, V, E};
    }

    // The halvings of each part of every divided step in the last roll of a path.
    BytesOut halvings(std::size_t path) const { return array_of(path_of(state(path)).halvings); }

  protected:
    const Mechanism* mechanism_;
    std::shared_ptr<Stepper> stepper_;
    Guards guards_;
    int stages_;
    std::vector<State> states_;

    const State& state(std::size_t path) const {
        if (path >= states_.size()) throw std::invalid_argument("there is no such path");
        return states_[path];
    }

    template <class Own>
    Own forked(const Own& own, const Guards& guards) const {
        Own copy = own;
        copy.guards_ = guards;
        return copy;
    }

  private:
    std::size_t size() const { return static_cast<std::size_t>(mechanism_->dof()); }

    static const PathState& path_of(const PathState& state) { return state; }
    template <class Holder>
    static const PathState& path_of(const Holder& state) {
        return state.path;
    }
};

// d(q1, p1)/d(q0, p0) (N, 2n, 2n) and d(q1, p1)/df (N, 2n, n) of each step, the outcome, and the number of steps done.
// first(step, guess, Jx, Jf) writes the derivatives of one step.
template <class First>
std::tuple<Out, Out, std::int64_t, std::size_t> derivatives_of(const StepsAt& at, const Tableau& tableau,
                                                               const In<3>& guess, const First& first) {
    const std::size_t N = at.N, n = at.n, stages = static_cast<std::size_t>(tableau.stages);
    require(guess, "guess", {N, stages, n});
    double *Jx = nullptr, *Jf = nullptr;
    const Out X = array_for(Jx, {N, 2 * n, 2 * n}), F = array_for(Jf, {N, 2 * n, n});
    const auto [outcome, done] = each_step(N, [&](std::size_t s) {
        return first(s, guess.data() + s * stages * n, Jx + s * 4 * n * n, Jf + s * 2 * n * n);
    });
    return {X, F, static_cast<std::int64_t>(outcome), done};
}

}  // namespace varpin::border
