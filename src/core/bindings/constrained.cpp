// Rollouts under holonomic constraints, and the derivatives of their steps.
#include "varpin/constrained.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "registrations.hpp"
#include "rollout.hpp"
#include "small_arms.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

std::vector<double> places_of(const Tableau& tableau, In<2> places) {
    const auto stages = static_cast<std::size_t>(tableau.stages);
    require(places, "places", {stages + 1, stages});
    return {places.data(), places.data() + places.size()};
}

class ConstrainedRollout : public Rollout<ConstrainedStepper, ConstrainedState> {
  public:
    ConstrainedRollout(const Mechanism& mechanism, const Tableau& tableau, In<2> places, double tolerance,
                       const Guards& guards, std::size_t paths, bool held)
        : Rollout(mechanism, tableau, guards, paths, held,
                  std::make_shared<ConstrainedStepper>(mechanism, tableau, places_of(tableau, places), tolerance,
                                                       guards, kernels_of(mechanism))) {}

    ConstrainedRollout fork(const Guards& guards) const { return forked(*this, guards); }

    void roll(double h, nb::handle commands, In<3> increments, In<3> drift, nb::handle nodes,
              const std::optional<In<4>>& impulses) {
        if (impulses && !stepper_->held) throw std::invalid_argument("under constraints, impulses have to be held");
        const double* pushes = impulses_of(*mechanism_, impulses, nodes);
        roll_paths(*mechanism_, states_.size(), stages_, commands, increments, drift, nodes,
                   [&](const Commands& by, const double* dw, const double* more, const Nodes& to) {
                       stepper_->guards = guards_;
                       stepper_->roll(h, by, dw, more, pushes, states_, to);
                   });
    }

    // Impulses of the constraints in every step of a path's last roll (steps, m); C' times them act on the joints.
    Out impulses(std::size_t path) const {
        const auto m = static_cast<std::size_t>(mechanism_->constraints.rows());
        const std::vector<double>& all = state(path).impulses;
        return array_of(all.data(), {all.size() / m, m});
    }

    // The constraint row closest to dependence on the others at a path's last state.
    int weakest(std::size_t path) const { return state(path).weakest; }
};

std::tuple<Out, Out, Out, std::int64_t, std::size_t> constrained_derivatives(
    const Mechanism& mechanism, const Tableau& tableau, In<2> places, double tolerance, const Guards& guards, double h,
    In<2> q, In<2> p, In<3> force, In<2> rates, Integers<1> substeps, Bytes halvings, In<3> guess, bool ramp,
    bool external) {
    const StepsAt at(mechanism, tableau, q, p, force, substeps, halvings);
    ConstrainedLinearization work(mechanism, tableau, places_of(tableau, places), tolerance, guards,
                                  kernels_of(mechanism));
    work.varies = at.varies;
    work.ramp = ramp;
    if (external) work.take_external();
    const std::size_t moved = mechanism.constraints.driven().size();
    require(rates, "rates", {at.N, moved});
    double* by_rate = nullptr;
    const Out R = array_for(by_rate, {at.N, 2 * at.n, moved});
    const auto [X, F, outcome, done] =
        derivatives_of(at, tableau, guess, [&](std::size_t s, const double* next, double* Jx, double* Jf) {
            return work.first(h, at.q(s), at.p(s), next, at.force(s), rates.data() + s * moved, at.halvings(s), Jx, Jf,
                              by_rate + s * 2 * at.n * moved);
        });
    return {X, F, R, outcome, done};
}

}  // namespace

void register_constrained(nb::module_& m) {
    nb::class_<ConstrainedRollout>(m, "ConstrainedRollout")
        .def(nb::init<const Mechanism&, const Tableau&, In<2>, double, const Guards&, std::size_t, bool>(),
             "mechanism"_a, "tableau"_a, "places"_a, "tolerance"_a, "guards"_a, "paths"_a, "held"_a = false,
             nb::keep_alive<1, 2>())
        .def("fork", &ConstrainedRollout::fork, "guards"_a, nb::keep_alive<0, 1>())
        .def("begin", &ConstrainedRollout::begin, "q"_a, "v"_a)
        .def("roll", &ConstrainedRollout::roll, "dt"_a, "commands"_a, "increments"_a, "drift"_a, "nodes"_a,
             "impulses"_a = nb::none())
        .def("kick", &ConstrainedRollout::kick, "impulse"_a)
        .def("nodes", &ConstrainedRollout::nodes)
        .def("halvings", &ConstrainedRollout::halvings, "path"_a)
        .def("impulses", &ConstrainedRollout::impulses, "path"_a)
        .def("weakest", &ConstrainedRollout::weakest, "path"_a);
    m.def("constrained_derivatives", &constrained_derivatives, "mechanism"_a, "tableau"_a, "places"_a, "tolerance"_a,
          "guards"_a, "dt"_a, "q"_a, "p"_a, "force"_a, "rates"_a, "substeps"_a, "halvings"_a, nb::kw_only(), "guess"_a,
          "ramp"_a = false, "external"_a = false);
}

}  // namespace varpin::border
