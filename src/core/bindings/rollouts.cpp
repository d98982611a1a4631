// Rollouts of the variational integrators, and the derivatives of their steps.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <memory>
#include <optional>
#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "registrations.hpp"
#include "rollout.hpp"
#include "rollout_arrays.hpp"
#include "small_arms.hpp"
#include "varpin/linearization.hpp"
#include "watched.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

Tableau tableau_of(In<2> a, In<2> gradient, In<2> force, In<1> b, In<1> c, In<2> ahead, double reach, double skew,
                   bool stiffly_accurate) {
    const std::size_t s = b.shape(0);
    if (s == 0) throw std::invalid_argument("a tableau must have at least one stage");
    for (const auto& [array, name] : {std::pair{&a, "a"}, {&gradient, "gradient"}, {&force, "force"}})
        require(*array, name, {s, s});
    require(c, "c", {s});
    require(ahead, "ahead", {s, s + 1});
    const auto copied = [](const auto& array) {
        return std::vector<double>(array.data(), array.data() + array.size());
    };
    return {static_cast<int>(s), copied(a), copied(gradient),
            copied(force),       copied(b), copied(c),
            copied(ahead),       reach,     skew,
            stiffly_accurate};
}

Guards guards_of(bool active, double branch_margin, double energy_balance, double energy_budget, int most_halvings) {
    if (most_halvings < 0 || most_halvings > 62) throw std::invalid_argument("halvings must be from 0 to 62");
    return {active, branch_margin, energy_balance, energy_budget, most_halvings};
}

class VariationalRollout : public Rollout<VariationalStepper, PathState> {
  public:
    VariationalRollout(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                       double left, std::size_t paths, bool held)
        : Rollout(mechanism, tableau, guards, paths, held,
                  std::make_shared<VariationalStepper>(mechanism, tableau, tolerance, guards, left,
                                                       kernels_of(mechanism))) {}

    VariationalRollout fork(const Guards& guards) const { return forked(*this, guards); }

    void roll(double h, nb::handle commands, In<3> increments, In<3> drift, nb::handle nodes, HeldWatch* watch,
              const std::optional<In<4>>& impulses) {
        const double* kicks = impulses_of(*mechanism_, impulses, nodes);
        roll_paths(*mechanism_, states_.size(), stages_, commands, increments, drift, nodes,
                   [&](const Commands& by, const double* dw, const double* more, const Nodes& to) {
                       Watch* watching = watch ? watch->of(to) : nullptr;
                       stepper_->guards = guards_;
                       stepper_->roll(h, by, dw, more, kicks, states_, to, watching);
                   });
    }
};

std::tuple<Out, Out, Out, std::int64_t, std::size_t> variational_derivatives(
    const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards, double h, In<2> q,
    In<2> p, In<3> force, Integers<1> substeps, Bytes halvings, In<3> guess, bool ramp, bool external) {
    const StepsAt at(mechanism, tableau, q, p, force, substeps, halvings);
    VariationalLinearization work(mechanism, tableau, tolerance, guards, kernels_of(mechanism));
    work.varies = at.varies;
    if (external) work.take_external();
    double* in_ramps = nullptr;
    const Out R = array_for(in_ramps, {ramp ? at.N : 0, 2 * at.n, at.n});
    const auto [X, F, outcome, done] =
        derivatives_of(at, tableau, guess, [&](std::size_t s, const double* next, double* Jx, double* Jf) {
            double* Jr = ramp ? in_ramps + s * 2 * at.n * at.n : nullptr;
            return work.first(h, at.q(s), at.p(s), next, at.force(s), at.halvings(s), Jx, Jf, at.past(s), Jr);
        });
    return {X, F, R, outcome, done};
}

// z . d2(q1, p1)/d(q0, p0, f)2 of each step (N, 3n, 3n), for the rows of z (N, 2n).
std::tuple<Out, std::int64_t, std::size_t> variational_curvatures(const Mechanism& mechanism, const Tableau& tableau,
                                                                  double tolerance, const Guards& guards, double h,
                                                                  In<2> q, In<2> p, In<3> force, Integers<1> substeps,
                                                                  Bytes halvings, In<3> guess, In<2> z) {
    const StepsAt at(mechanism, tableau, q, p, force, substeps, halvings);
    const std::size_t N = at.N, n = at.n, stages = static_cast<std::size_t>(tableau.stages);
    require(guess, "guess", {N, stages, n});
    require(z, "z", {N, 2 * n});
    double* H = nullptr;
    const Out curvatures = array_for(H, {N, 3 * n, 3 * n});
    VariationalLinearization work(mechanism, tableau, tolerance, guards, kernels_of(mechanism));
    work.varies = at.varies;
    const auto [outcome, done] = each_step(N, [&](std::size_t s) {
        return work.second(h, at.q(s), at.p(s), guess.data() + s * stages * n, at.force(s), at.halvings(s),
                           z.data() + s * 2 * n, H + s * 9 * n * n, at.past(s));
    });
    return {curvatures, static_cast<std::int64_t>(outcome), done};
}

// Configurations and velocities (N, n) at the end of each step.
std::tuple<Out, Out, std::int64_t, std::size_t> variational_ends(const Mechanism& mechanism, const Tableau& tableau,
                                                                 double tolerance, const Guards& guards, double h,
                                                                 In<2> q, In<2> p, In<3> force, Integers<1> substeps,
                                                                 Bytes halvings) {
    const StepsAt at(mechanism, tableau, q, p, force, substeps, halvings);
    const std::size_t N = at.N, n = at.n;
    double *q1 = nullptr, *v1 = nullptr;
    const Out Q = array_for(q1, {N, n}), V = array_for(v1, {N, n});
    VariationalLinearization work(mechanism, tableau, tolerance, guards, kernels_of(mechanism));
    work.varies = at.varies;
    const auto [outcome, done] = each_step(N, [&](std::size_t s) {
        return work.end(h, at.q(s), at.p(s), at.force(s), at.halvings(s), q1 + s * n, v1 + s * n);
    });
    return {Q, V, static_cast<std::int64_t>(outcome), done};
}

}  // namespace

void register_rollouts(nb::module_& m) {
    nb::class_<Tableau>(m, "Tableau")
        .def_static("make", &tableau_of, nb::kw_only(), "a"_a, "gradient"_a, "force"_a, "b"_a, "c"_a, "ahead"_a,
                    "reach"_a, "skew"_a, "stiffly_accurate"_a);
    nb::class_<Guards>(m, "Guards")
        .def_static("make", &guards_of, nb::kw_only(), "active"_a, "branch_margin"_a, "energy_balance"_a,
                    "energy_budget"_a, "most_halvings"_a);
    nb::class_<VariationalRollout>(m, "VariationalRollout")
        .def(nb::init<const Mechanism&, const Tableau&, double, const Guards&, double, std::size_t, bool>(),
             "mechanism"_a, "tableau"_a, "tolerance"_a, "guards"_a, "left"_a, "paths"_a, "held"_a = false,
             nb::keep_alive<1, 2>())
        .def("fork", &VariationalRollout::fork, "guards"_a, nb::keep_alive<0, 1>())
        .def("begin", &VariationalRollout::begin, "q"_a, "v"_a)
        .def("roll", &VariationalRollout::roll, "dt"_a, "commands"_a, "increments"_a, "drift"_a, "nodes"_a,
             "watch"_a.none() = nb::none(), "impulses"_a = nb::none())
        .def("kick", &VariationalRollout::kick, "impulse"_a)
        .def("nodes", &VariationalRollout::nodes)
        .def("halvings", &VariationalRollout::halvings, "path"_a);
    m.def("variational_derivatives", &variational_derivatives, "mechanism"_a, "tableau"_a, "tolerance"_a, "guards"_a,
          "dt"_a, "q"_a, "p"_a, "force"_a, "substeps"_a, "halvings"_a, nb::kw_only(), "guess"_a, "ramp"_a = false,
          "external"_a = false);
    m.def("variational_curvatures", &variational_curvatures, "mechanism"_a, "tableau"_a, "tolerance"_a, "guards"_a,
          "dt"_a, "q"_a, "p"_a, "force"_a, "substeps"_a, "halvings"_a, nb::kw_only(), "guess"_a, "z"_a);
    m.def("variational_ends", &variational_ends, "mechanism"_a, "tableau"_a, "tolerance"_a, "guards"_a, "dt"_a, "q"_a,
          "p"_a, "force"_a, "substeps"_a, "halvings"_a);
}

}  // namespace varpin::border
