// Forward dynamics, the explicit methods, and the error of a finished motion.
#include "varpin/explicit.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "rollout_arrays.hpp"
#include "units.hpp"
#include "varpin/clearance.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

// The rate (v, a) of x = (q, v) under a force, and whether the mass matrix is positive definite.
std::tuple<Out, bool> rate(ForwardDynamics& dynamics, In<1> x, In<1> force) {
    const auto n = static_cast<std::size_t>(dynamics.dof());
    require(x, "x", {2 * n});
    require(force, "force", {n});
    const Out out = array_for({2 * n});
    const bool regular = dynamics.at(x.data(), x.data() + n);
    std::copy(x.data() + n, x.data() + 2 * n, out.data());
    dynamics.acceleration(force.data(), out.data() + n);
    return {out, regular};
}

// Momentum and energy at x = (q, v), and whether the mass matrix is positive definite.
std::tuple<Out, double, bool> node(ForwardDynamics& dynamics, In<1> x) {
    const auto n = static_cast<std::size_t>(dynamics.dof());
    require(x, "x", {2 * n});
    const Out momentum = array_for({n});
    const bool regular = dynamics.at(x.data(), x.data() + n);
    const double energy = dynamics.energy(x.data() + n, momentum.data());
    return {momentum, energy, regular};
}

// Accelerations (N, n) at each row of q, v and force (N, n), and their derivatives in each, (N, n, n); how many rows
// went before one with a mass matrix that is not positive definite.
std::tuple<Out, Out, Out, Out, std::size_t> accelerations(const Mechanism& mechanism, In<2> q, In<2> v, In<2> force) {
    const auto [n, rows] = rows_of(mechanism, "q", q, "v", v, "force", force);
    const Out values = array_for({rows, n}), aq = array_for({rows, n, n}), av = array_for({rows, n, n}),
              af = array_for({rows, n, n});
    std::size_t s = 0;
    {
        nb::gil_scoped_release release;
        ForwardDynamics dynamics(mechanism, true);
        for (; s < rows && dynamics.at(q.data() + s * n, v.data() + s * n); ++s) {
            dynamics.acceleration(force.data() + s * n, values.data() + s * n);
            dynamics.differentiate(v.data() + s * n, values.data() + s * n);
            dynamics.derivatives(aq.data() + s * n * n, av.data() + s * n * n, af.data() + s * n * n);
        }
    }
    return {values, aq, av, af, s};
}

// The joint forces (N, n) that accelerations a need at each row of q, v and a (N, n), besides those without a
// potential.
Out inverse_dynamics(const Mechanism& mechanism, In<2> q, In<2> v, In<2> a) {
    const auto [n, rows] = rows_of(mechanism, "q", q, "v", v, "a", a);
    const Out out = array_for({rows, n});
    nb::gil_scoped_release release;
    ForwardDynamics dynamics(mechanism, true);
    for (std::size_t s = 0; s < rows; ++s)
        dynamics.inverse(q.data() + s * n, v.data() + s * n, a.data() + s * n, out.data() + s * n);
    return out;
}

// Derivatives of one step from each row of q and v, in (q, v), (N, 2n, 2n), and in the force, (N, 2n, n), or in one
// that grows over the step to it as a ramp; how many rows went before one with a mass matrix that is not positive
// definite. The force (N, r, n) is constant, r = 1, or that at each time of a stage.
std::tuple<Out, Out, std::size_t> linearize(const Mechanism& mechanism, ExplicitMethod method, double dt, In<2> q,
                                            In<2> v, In<3> force, bool ramp) {
    const std::size_t n = static_cast<std::size_t>(mechanism.dof()), rows = q.shape(0);
    ExplicitStepper stepper(mechanism, method, true);
    stepper.ramp = ramp;
    const std::size_t abscissae = force.shape(1);
    require_each({rows, n}, "q", q, "v", v);
    if (abscissae != 1) require(force, "force", {rows, static_cast<std::size_t>(stepper.abscissae()), n});
    require(force, "force", {rows, abscissae, n});
    const Out Jx = array_for({rows, 2 * n, 2 * n}), Jf = array_for({rows, 2 * n, n});
    std::size_t s = 0;
    {
        nb::gil_scoped_release release;
        for (; s < rows; ++s) {
            std::copy_n(q.data() + s * n, n, stepper.q.data());
            std::copy_n(v.data() + s * n, n, stepper.v.data());
            if (!stepper.dynamics.at(q.data() + s * n, v.data() + s * n)) break;
            if (!stepper.step(dt, force.data() + s * abscissae * n, abscissae > 1 ? static_cast<int>(n) : 0)) break;
            stepper.write_derivatives(dt, Jx.data() + s * 4 * n * n, Jf.data() + s * 2 * n * n);
        }
    }
    return {Jx, Jf, s};
}

// The coefficients c (s), k and l (s, s), x and y (s) of a method.
std::tuple<Out, Out, Out, Out, Out> nystroem(ExplicitMethod method) {
    const Nystroem own = nystroem_of(method);
    const auto s = static_cast<std::size_t>(own.stages);
    const Out k = array_for({s, s}), l = array_for({s, s});
    for (std::size_t i = 0; i < s; ++i) {
        std::copy_n(own.stage_q[i], s, k.data() + i * s);
        std::copy_n(own.stage_v[i], s, l.data() + i * s);
    }
    return {array_of(own.reach, {s}), k, l, array_of(own.end_q, {s}), array_of(own.end_v, {s})};
}

ExplicitRollout rollout(const Mechanism& mechanism, ExplicitMethod method, In<2> q, In<2> v) {
    const auto [n, paths] = rows_of(mechanism, "q", q, "v", v);
    return {mechanism, method, static_cast<std::int64_t>(paths), q.data(), v.data()};
}

// A view of the states of paths (P, n).
Out view(const ExplicitRollout& rollout, std::vector<double>& values) {
    return Out(values.data(), {static_cast<std::size_t>(rollout.paths()), static_cast<std::size_t>(rollout.dof())});
}

bool first_nodes(ExplicitRollout& rollout, nb::handle nodes) {
    const Nodes to = nodes_of(rollout.mechanism(), nodes, static_cast<std::size_t>(rollout.paths()));
    if (to.steps < 1) throw std::invalid_argument("the nodes have no rows for the first nodes");
    return rollout.first_nodes(to);
}

void roll(ExplicitRollout& rollout, double dt, nb::handle commands, In<3> increments, In<3> drift, nb::handle nodes,
          const std::optional<In<4>>& impulses) {
    roll_paths(rollout.mechanism(), static_cast<std::size_t>(rollout.paths()), rollout.abscissae(), commands,
               increments, drift, impulses, nodes,
               [&](const Commands& by, const Additions& more, const Nodes& to) { rollout.roll(dt, by, more, to); });
}

Stretch stretch_of(In<3> curves, In<3> sums, In<2> places) {
    const std::size_t steps = sums.shape(1), points = sums.shape(2), all = places.shape(1);
    if (steps == 0 || points < 2 || (points - 1) % steps != 0 || all % steps != 0)
        throw std::invalid_argument("a stretch needs its nodes evenly among its points, and its steps the same stages");
    require(curves, "curves", {2, points, 3 * (steps + 1)});
    require(sums, "sums", {2, steps, points});
    require(places, "places", {points, all});
    return {
        static_cast<int>(steps), static_cast<int>(points), static_cast<int>(all / steps), copied(curves), copied(sums),
        copied(places)};
}

Out propagated_errors(const Mechanism& mechanism, In<2> q, In<2> v, In<2> u, In<3> within, double dt,
                      const Stretch& narrow, const Stretch* wide, bool damped, In<1> most_q, In<1> most_v) {
    const auto n = static_cast<std::size_t>(mechanism.dof()), m = static_cast<std::size_t>(mechanism.controls);
    const std::size_t steps = u.shape(0), stages = within.shape(1);
    require_each({steps + 1, n}, "q", q, "v", v);
    require_each({n}, "most_q", most_q, "most_v", most_v);
    require(u, "u", {steps, m});
    require(within, "within", {steps, stages, m});
    if (!(dt > 0.0)) throw std::invalid_argument("dt must be positive");
    if (narrow.steps != 1 || (wide && wide->steps != 2))
        throw std::invalid_argument("narrow and wide must be stretches of one step and of two");
    if (static_cast<std::size_t>(narrow.stages) != stages || (wide && wide->stages != narrow.stages))
        throw std::invalid_argument("narrow and wide must have the stages of the controls");
    std::vector<double> found;
    {
        nb::gil_scoped_release release;
        const Record record{static_cast<std::int64_t>(steps), q.data(), v.data(), u.data(), dt};
        Clearance clearance(mechanism, record, stages > 0 ? within.data() : nullptr, narrow, wide, damped);
        found = clearance.errors(most_q.data(), most_v.data());
    }
    return array_of(found.data(), {n});
}

}  // namespace

void register_explicit(nb::module_& m) {
    nb::enum_<Outcome>(m, "Outcome", nb::is_arithmetic())
        .value("solved", Outcome::solved)
        .value("diverged", Outcome::diverged)
        .value("not_finite", Outcome::not_finite)
        .value("fold", Outcome::fold)
        .value("energy", Outcome::energy)
        .value("singular", Outcome::singular)
        .value("toggle", Outcome::toggle)
        .value("assembly", Outcome::assembly);
    nb::enum_<ExplicitMethod>(m, "ExplicitMethod")
        .value("euler", ExplicitMethod::euler)
        .value("semi_implicit", ExplicitMethod::semi_implicit)
        .value("runge_kutta", ExplicitMethod::runge_kutta);
    nb::class_<ForwardDynamics>(m, "ForwardDynamics")
        .def(
            "__init__", [](ForwardDynamics* self, const Mechanism& of) { new (self) ForwardDynamics(of, false); },
            "mechanism"_a, nb::keep_alive<1, 2>())
        .def("rate", &rate, "x"_a, "force"_a)
        .def("node", &node, "x"_a);
    nb::class_<ExplicitRollout>(m, "ExplicitRollout")
        .def_static("start", &rollout, "mechanism"_a, "method"_a, "q"_a, "v"_a, nb::keep_alive<0, 1>())
        .def_prop_ro(
            "q", [](ExplicitRollout& own) { return view(own, own.q); }, nb::rv_policy::reference_internal)
        .def_prop_ro(
            "v", [](ExplicitRollout& own) { return view(own, own.v); }, nb::rv_policy::reference_internal)
        .def(
            "copy", [](const ExplicitRollout& own) { return ExplicitRollout(own); }, nb::keep_alive<0, 1>())
        .def("first_nodes", &first_nodes, "nodes"_a)
        .def("roll", &roll, "dt"_a, "commands"_a, "increments"_a, "drift"_a, "nodes"_a, "impulses"_a = nb::none());
    m.def("nystroem", &nystroem, "method"_a);
    m.def("accelerations", &accelerations, "mechanism"_a, "q"_a, "v"_a, "force"_a);
    m.def("inverse_dynamics", &inverse_dynamics, "mechanism"_a, "q"_a, "v"_a, "a"_a);
    m.def("linearize_explicit", &linearize, "mechanism"_a, "method"_a, "dt"_a, "q"_a, "v"_a, "force"_a,
          "ramp"_a = false);
    nb::class_<Stretch>(m, "Stretch").def_static("make", &stretch_of, nb::kw_only(), "curves"_a, "sums"_a, "places"_a);
    m.def("propagated_errors", &propagated_errors, "mechanism"_a, "q"_a, "v"_a, "u"_a, "within"_a, "dt"_a,
          nb::kw_only(), "narrow"_a, "wide"_a.none(), "damped"_a, "most_q"_a, "most_v"_a);
}

}  // namespace varpin::border
