// Rollouts of the variational integrators, and the derivatives of their steps.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstdint>
#include <memory>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "rollout_arrays.hpp"
#include "steps_at.hpp"
#include "units.hpp"
#include "varpin/linearization.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

Tableau tableau_of(In<2> a, In<2> gradient, In<2> force, In<1> b, In<1> c, In<2> ahead, double reach, double skew,
                   bool stiffly_accurate) {
    const std::size_t s = b.shape(0);
    if (s == 0) throw std::invalid_argument("a tableau must have at least one stage");
    require_each({s, s}, "a", a, "gradient", gradient, "force", force);
    require(c, "c", {s});
    require(ahead, "ahead", {s, s + 1});
    return {static_cast<int>(s), copied(a), copied(gradient),
            copied(force),       copied(b), copied(c),
            copied(ahead),       reach,     skew,
            stiffly_accurate};
}

Guards guards_of(bool active, double branch_margin, double energy_balance, double energy_budget, int most_halvings) {
    if (most_halvings < 0 || most_halvings > 62) throw std::invalid_argument("halvings must be from 0 to 62");
    return {active, branch_margin, energy_balance, energy_budget, most_halvings};
}

void require_places(const In<2>& places, const Tableau& tableau) {
    const auto stages = static_cast<std::size_t>(tableau.stages);
    require(places, "places", {stages + 1, stages});
}

// A stepper that the forks of a rollout share; one thread at a time.
struct SharedStepper {
    std::unique_ptr<VariationalStepper> stepper;
    std::atomic<bool> busy = false;
};

class Turn {
  public:
    explicit Turn(SharedStepper& shared) : shared_(shared) {
        if (shared.busy.exchange(true))
            throw std::runtime_error(
                "two threads advance forks of one rollout at once; each thread needs a rollout of its own");
    }
    ~Turn() { shared_.busy = false; }
    Turn(const Turn&) = delete;
    Turn& operator=(const Turn&) = delete;
    VariationalStepper* operator->() const { return shared_.stepper.get(); }

  private:
    SharedStepper& shared_;
};

// P paths with the work arrays of a step, the stepper.
class Rollout {
  public:
    Rollout(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards, double left,
            std::size_t paths, bool held, const std::optional<In<2>>& places)
        : mechanism_(&mechanism),
          shared_(std::make_shared<SharedStepper>()),
          guards_(guards),
          stages_(tableau.stages),
          constrained_(places),
          states_(paths, PathState(mechanism, tableau.stages)) {
        if (places) {
            require_places(*places, tableau);
            shared_->stepper = constrained_stepper(mechanism, tableau, copied(*places), tolerance, guards);
        } else {
            shared_->stepper = std::make_unique<VariationalStepper>(mechanism, tableau, tolerance, guards, left,
                                                                    kernels_of(mechanism));
        }
        shared_->stepper->held = held;
    }

    Rollout fork(const Guards& guards) const {
        Rollout copy = *this;
        copy.guards_ = guards;
        return copy;
    }

    // Start each path at its row of q and v (P, n); false if an M(q) is not positive definite.
    bool begin(In<2> q, In<2> v) {
        const std::size_t n = size();
        require_each({states_.size(), n}, "q", q, "v", v);
        const Turn stepper(*shared_);
        nb::gil_scoped_release release;
        for (std::size_t i = 0; i < states_.size(); ++i) {
            if (!stepper->begin(q.data() + i * n, v.data() + i * n, states_[i])) return false;
        }
        return true;
    }

    void roll(double h, nb::handle commands, In<3> increments, In<3> drift, nb::handle nodes,
              const std::optional<In<4>>& impulses) {
        const Turn stepper(*shared_);
        if (impulses && constrained_ && !stepper->held)
            throw std::invalid_argument("under constraints, impulses have to be held");
        roll_paths(*mechanism_, states_.size(), stages_, commands, increments, drift, impulses, nodes,
                   [&](const Commands& by, const Additions& more, const Nodes& to) {
                       stepper->guards = guards_;
                       stepper->roll(h, by, more, states_, to);
                   });
    }

    // Write the node that each path is at.
    bool first_nodes(nb::handle nodes) const {
        const Nodes to = nodes_of(*mechanism_, nodes, states_.size());
        if (to.steps < 1) throw std::invalid_argument("the nodes have no rows for the first nodes");
        for (std::int64_t i = 0; i < to.paths; ++i) {
            record_node(states_[i], static_cast<int>(size()), to, i * to.steps);
            to.done[i] = 1;
        }
        return true;
    }

    // The halvings of each part of every divided step in the last roll of a path.
    BytesOut halvings(std::size_t path) const { return array_of(state(path).halvings); }

    // Impulses of the constraints in every step of a path's last roll (steps, m); C' times them act on the joints.
    Out impulses(std::size_t path) const {
        const std::vector<double>& all = state(path).impulses;
        const std::size_t m = state(path).impulse.size();
        return array_of(all.data(), {m > 0 ? all.size() / m : 0, m});
    }

    // The constraint row closest to dependence on the others at a path's last state.
    int weakest(std::size_t path) const { return state(path).weakest; }

  private:
    const Mechanism* mechanism_;
    std::shared_ptr<SharedStepper> shared_;
    Guards guards_;
    int stages_;
    bool constrained_;
    std::vector<PathState> states_;

    std::size_t size() const { return static_cast<std::size_t>(mechanism_->dof()); }
    const PathState& state(std::size_t path) const {
        if (path >= states_.size()) throw std::invalid_argument("there is no such path");
        return states_[path];
    }
};

VariationalLinearization linearization(const StepsAt& at) {
    return {at.mechanism, at.tableau, at.tolerance, at.guards, kernels_of(at.mechanism)};
}

// The derivatives of `StepDerivatives` of each step, whose kinds that are not wanted are empty along their last axis;
// the outcome, and the number of steps done. Under constraints there are `places` and `rates`.
std::tuple<Out, Out, Out, Out, Out, std::int64_t, std::size_t> derivatives(const StepsAt& at, bool ramp, bool external,
                                                                           const Parameters* parameters,
                                                                           const std::optional<In<2>>& places,
                                                                           const std::optional<In<2>>& rates) {
    const std::size_t N = at.N, rows = 2 * at.n;
    std::unique_ptr<StepLinearization> work;
    if (places) {
        require_places(*places, at.tableau);
        work = constrained_linearization(at, copied(*places));
    } else {
        work.reset(new VariationalLinearization(linearization(at)));
    }
    work->varies = at.varies;
    if (external) work->take_external();
    work->take(Parameters::of(parameters, at.n));
    const std::size_t driven = rates ? at.mechanism.constraints.driven().size() : 0;
    if (rates) require(*rates, "rates", {N, driven});
    const std::size_t columns[] = {rows, at.n, ramp ? at.n : 0, driven, work->parameters()};
    std::array<Out, 5> found;
    for (int kind = 0; kind < 5; ++kind) found[kind] = array_for({N, rows, columns[kind]});
    const auto [outcome, done] = at.each([&](std::size_t s) {
        RepeatedStep step = at.step(s);
        if (rates) step.rates = rates->data() + s * driven;
        const auto of = [&](int kind) {
            return columns[kind] > 0 ? found[kind].data() + s * rows * columns[kind] : nullptr;
        };
        return work->first(step, {of(0), of(1), of(2), of(3), of(4)});
    });
    return {found[0], found[1], found[2], found[3], found[4], outcome, done};
}

// z . d2(q1, p1)/d(q0, p0, f)2 of each step (N, 3n, 3n), for the rows of z (N, 2n).
std::tuple<Out, std::int64_t, std::size_t> curvatures(const StepsAt& at, In<2> z) {
    const std::size_t N = at.N, n = at.n;
    require(z, "z", {N, 2 * n});
    const Out found = array_for({N, 3 * n, 3 * n});
    VariationalLinearization work = linearization(at);
    work.varies = at.varies;
    const auto [outcome, done] = at.each(
        [&](std::size_t s) { return work.second(at.step(s), z.data() + s * 2 * n, found.data() + s * 9 * n * n); });
    return {found, outcome, done};
}

// Configurations and velocities (N, n) at the end of each step.
std::tuple<Out, Out, std::int64_t, std::size_t> ends(const StepsAt& at) {
    const std::size_t N = at.N, n = at.n;
    const Out Q = array_for({N, n}), V = array_for({N, n});
    VariationalLinearization work = linearization(at);
    work.varies = at.varies;
    const auto [outcome, done] =
        at.each([&](std::size_t s) { return work.end(at.step(s), Q.data() + s * n, V.data() + s * n); });
    return {Q, V, outcome, done};
}

}  // namespace

void register_rollouts(nb::module_& m) {
    nb::class_<Tableau>(m, "Tableau")
        .def_static("make", &tableau_of, nb::kw_only(), "a"_a, "gradient"_a, "force"_a, "b"_a, "c"_a, "ahead"_a,
                    "reach"_a, "skew"_a, "stiffly_accurate"_a);
    nb::class_<Guards>(m, "Guards")
        .def_static("make", &guards_of, nb::kw_only(), "active"_a, "branch_margin"_a, "energy_balance"_a,
                    "energy_budget"_a, "most_halvings"_a);
    nb::class_<Rollout>(m, "Rollout")
        .def(nb::init<const Mechanism&, const Tableau&, double, const Guards&, double, std::size_t, bool,
                      std::optional<In<2>>>(),
             "mechanism"_a, "tableau"_a, "tolerance"_a, "guards"_a, "left"_a, "paths"_a, "held"_a = false,
             "places"_a.none() = nb::none(), nb::keep_alive<1, 2>())
        .def("fork", &Rollout::fork, "guards"_a, nb::keep_alive<0, 1>())
        .def("begin", &Rollout::begin, "q"_a, "v"_a)
        .def("roll", &Rollout::roll, "dt"_a, "commands"_a, "increments"_a, "drift"_a, "nodes"_a,
             "impulses"_a = nb::none())
        .def("first_nodes", &Rollout::first_nodes, "nodes"_a)
        .def("halvings", &Rollout::halvings, "path"_a)
        .def("impulses", &Rollout::impulses, "path"_a)
        .def("weakest", &Rollout::weakest, "path"_a);
    nb::class_<Parameters>(m, "Parameters")
        .def(nb::init<const std::vector<std::pair<const Mechanism*, const Mechanism*>>&, In<1>, In<3>>(), "pairs"_a,
             "distance"_a, "gears"_a, nb::keep_alive<1, 2>());
    nb::class_<StepsAt>(m, "Steps")
        .def(nb::init<const Mechanism&, const Tableau&, double, const Guards&, double, In<2>, In<2>, In<3>, Integers<1>,
                      Bytes, In<3>>(),
             "mechanism"_a, "tableau"_a, "tolerance"_a, "guards"_a, "dt"_a, "q"_a, "p"_a, "force"_a, "substeps"_a,
             "halvings"_a, "guess"_a, nb::keep_alive<1, 2>())
        .def("derivatives", &derivatives, "ramp"_a = false, "external"_a = false, "parameters"_a.none() = nb::none(),
             "places"_a.none() = nb::none(), "rates"_a.none() = nb::none())
        .def("curvatures", &curvatures, "z"_a)
        .def("ends", &ends);
}

}  // namespace varpin::border
