// Rollouts under holonomic constraints, and the derivatives of their steps.
#include "varpin/constrained.hpp"

#include <nanobind/stl/tuple.h>

#include <memory>
#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "registrations.hpp"
#include "rollout_arrays.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

std::vector<double> places_of(const Tableau& tableau, In<2> places) {
    const auto stages = static_cast<std::size_t>(tableau.stages);
    require(places, "places", {stages + 1, stages});
    return {places.data(), places.data() + places.size()};
}

// As VariationalRollout.
class ConstrainedRollout {
  public:
    ConstrainedRollout(const Mechanism& mechanism, const Tableau& tableau, In<2> places, double tolerance,
                       const Guards& guards, std::size_t paths)
        : stepper_(
              std::make_shared<ConstrainedStepper>(mechanism, tableau, places_of(tableau, places), tolerance, guards)),
          guards_(guards),
          states_(paths, ConstrainedState(mechanism, tableau.stages)) {}

    ConstrainedRollout fork(const Guards& guards) const {
        ConstrainedRollout copy = *this;
        copy.guards_ = guards;
        return copy;
    }

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

    void roll(double h, nb::handle commands, In<3> increments, In<3> drift, nb::handle nodes) {
        const Mechanism& mechanism = stepper_->mechanism;
        const NodeArrays written(mechanism, nodes);
        if (written.paths() != states_.size())
            throw std::invalid_argument("there is not one row of nodes for each path");
        const CommandArrays given_commands(mechanism, commands, written.paths(), written.steps(), stepper_->stages);
        const double* dw = increments_of(mechanism, increments, written);
        const double* extra = drift_of(mechanism, drift, written);
        nb::gil_scoped_release release;
        stepper_->guards = guards_;
        stepper_->roll(h, given_commands.view(), dw, extra, states_, written.view());
    }

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
            const PathState& path = states_[i].path;
            std::copy(path.q.begin(), path.q.end(), q + i * n);
            std::copy(path.momentum.begin(), path.momentum.end(), p + i * n);
            std::copy(path.v.begin(), path.v.end(), v + i * n);
            energy[i] = path.energies.total();
        }
        return {Q, MV, V, E};
    }

    BytesOut halvings(std::size_t path) const { return array_of(state(path).path.halvings); }

    // Of every step of a path in its last roll (steps, m): what the constraints gave, C' times it.
    Out impulses(std::size_t path) const {
        const auto m = static_cast<std::size_t>(stepper_->m);
        const std::vector<double>& all = state(path).impulses;
        return array_of(all.data(), {all.size() / m, m});
    }

    // The row of the constraints that depended most on the others where a path was last.
    int weakest(std::size_t path) const { return state(path).weakest; }

  private:
    std::shared_ptr<ConstrainedStepper> stepper_;
    Guards guards_;
    std::vector<ConstrainedState> states_;

    std::size_t size() const { return static_cast<std::size_t>(stepper_->n); }
    const ConstrainedState& state(std::size_t path) const {
        if (path >= states_.size()) throw std::invalid_argument("there is no such path");
        return states_[path];
    }
};

// As variational_derivatives.
std::tuple<Out, Out, std::int64_t, std::size_t> constrained_derivatives(
    const Mechanism& mechanism, const Tableau& tableau, In<2> places, double tolerance, const Guards& guards, double h,
    In<2> q, In<2> p, In<3> force, Integers<1> substeps, Bytes halvings, In<3> guess, bool ramp) {
    const StepsAt at(mechanism, tableau, q, p, force, substeps, halvings);
    const std::size_t N = at.N, n = at.n, stages = static_cast<std::size_t>(tableau.stages);
    require(guess, "guess", {N, stages, n});
    double *Jx = nullptr, *Jf = nullptr;
    const Out X = array_for(Jx, {N, 2 * n, 2 * n}), F = array_for(Jf, {N, 2 * n, n});
    ConstrainedLinearization work(mechanism, tableau, places_of(tableau, places), tolerance, guards);
    work.varies = at.varies;
    work.ramp = ramp;
    const auto [outcome, done] = each_step(N, [&](std::size_t s) {
        return work.first(h, at.q(s), at.p(s), guess.data() + s * stages * n, at.force(s), at.halvings(s),
                          Jx + s * 4 * n * n, Jf + s * 2 * n * n);
    });
    return {X, F, static_cast<std::int64_t>(outcome), done};
}

}  // namespace

void register_constrained(nb::module_& m) {
    nb::class_<ConstrainedRollout>(m, "ConstrainedRollout")
        .def(nb::init<const Mechanism&, const Tableau&, In<2>, double, const Guards&, std::size_t>(), "mechanism"_a,
             "tableau"_a, "places"_a, "tolerance"_a, "guards"_a, "paths"_a, nb::keep_alive<1, 2>())
        .def("fork", &ConstrainedRollout::fork, "guards"_a, nb::keep_alive<0, 1>())
        .def("begin", &ConstrainedRollout::begin, "q"_a, "v"_a)
        .def("roll", &ConstrainedRollout::roll, "dt"_a, "commands"_a, "increments"_a, "drift"_a, "nodes"_a)
        .def("kick", &ConstrainedRollout::kick, "impulse"_a)
        .def("nodes", &ConstrainedRollout::nodes)
        .def("halvings", &ConstrainedRollout::halvings, "path"_a)
        .def("impulses", &ConstrainedRollout::impulses, "path"_a)
        .def("weakest", &ConstrainedRollout::weakest, "path"_a);
    m.def("constrained_derivatives", &constrained_derivatives, "mechanism"_a, "tableau"_a, "places"_a, "tolerance"_a,
          "guards"_a, "dt"_a, "q"_a, "p"_a, "force"_a, "substeps"_a, "halvings"_a, nb::kw_only(), "guess"_a,
          "ramp"_a = false);
}

}  // namespace varpin::border
