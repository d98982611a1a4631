// Forward dynamics and the explicit methods.
#include "varpin/explicit.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/tuple.h>

#include <memory>
#include <optional>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "rollout_arrays.hpp"
#include "units.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

using SharedMechanism = std::shared_ptr<Mechanism>;

// What works on a mechanism, and keeps it alive.
struct BoundDynamics {
    BoundDynamics(SharedMechanism of) : mechanism(std::move(of)), core(*mechanism, false) {}

    SharedMechanism mechanism;
    ForwardDynamics core;
};

struct BoundRollout {
    BoundRollout(SharedMechanism of, ExplicitMethod method, const In<2>& q, const In<2>& v)
        : mechanism(std::move(of)),
          core(*mechanism, method, static_cast<std::int64_t>(q.shape(0)), q.data(), v.data()) {}

    SharedMechanism mechanism;
    ExplicitRollout core;

    Out view(std::vector<double>& values) const {
        return Out(values.data(), {static_cast<std::size_t>(core.paths()), static_cast<std::size_t>(core.dof())});
    }
};

void require_rows(const Mechanism& mechanism, const In<2>& q, const In<2>& v, const In<2>& force) {
    const auto n = static_cast<std::size_t>(mechanism.dof());
    require_each({q.shape(0), n}, "q", q, "v", v, "force", force);
}

// The rate (v, a) of x = (q, v) under a force, and whether the mass matrix is positive definite.
std::tuple<Out, bool> rate(BoundDynamics& dynamics, In<1> x, In<1> force) {
    const auto n = static_cast<std::size_t>(dynamics.core.dof());
    require(x, "x", {2 * n});
    require(force, "force", {n});
    const Out out = array_for({2 * n});
    const bool regular = dynamics.core.at(x.data(), x.data() + n);
    std::copy(x.data() + n, x.data() + 2 * n, out.data());
    dynamics.core.acceleration(force.data(), out.data() + n);
    return {out, regular};
}

// Momentum and energy at x = (q, v), and whether the mass matrix is positive definite.
std::tuple<Out, double, bool> node(BoundDynamics& dynamics, In<1> x) {
    const auto n = static_cast<std::size_t>(dynamics.core.dof());
    require(x, "x", {2 * n});
    const Out momentum = array_for({n});
    const bool regular = dynamics.core.at(x.data(), x.data() + n);
    const double energy = dynamics.core.energy(x.data() + n, momentum.data());
    return {momentum, energy, regular};
}

// Accelerations (N, n) at each row of q, v and force (N, n), and their derivatives in each, (N, n, n); how many rows
// went before one with a mass matrix that is not positive definite.
std::tuple<Out, Out, Out, Out, std::size_t> accelerations(const Mechanism& mechanism, In<2> q, In<2> v, In<2> force) {
    require_rows(mechanism, q, v, force);
    const std::size_t n = static_cast<std::size_t>(mechanism.dof()), rows = q.shape(0);
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
    const std::size_t n = static_cast<std::size_t>(mechanism.dof()), rows = q.shape(0);
    require_each({rows, n}, "q", q, "v", v, "a", a);
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

BoundRollout rollout(SharedMechanism mechanism, ExplicitMethod method, In<2> q, In<2> v) {
    const std::size_t n = static_cast<std::size_t>(mechanism->dof()), paths = q.shape(0);
    require_each({paths, n}, "q", q, "v", v);
    return BoundRollout(std::move(mechanism), method, q, v);
}

bool first_nodes(BoundRollout& rollout, nb::handle nodes) {
    const Nodes to = nodes_of(*rollout.mechanism, nodes, static_cast<std::size_t>(rollout.core.paths()));
    if (to.steps < 1) throw std::invalid_argument("the nodes have no rows for the first nodes");
    return rollout.core.first_nodes(to);
}

void roll(BoundRollout& rollout, double dt, nb::handle commands, In<3> increments, In<3> drift, nb::handle nodes,
          const std::optional<In<4>>& impulses) {
    ExplicitRollout& core = rollout.core;
    roll_paths(*rollout.mechanism, static_cast<std::size_t>(core.paths()), core.abscissae(), commands, increments,
               drift, impulses, nodes,
               [&](const Commands& by, const Additions& more, const Nodes& to) { core.roll(dt, by, more, to); });
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
    nb::class_<BoundDynamics>(m, "ForwardDynamics")
        .def(nb::init<SharedMechanism>(), "mechanism"_a)
        .def("rate", &rate, "x"_a, "force"_a)
        .def("node", &node, "x"_a);
    nb::class_<BoundRollout>(m, "ExplicitRollout")
        .def_static("start", &rollout, "mechanism"_a, "method"_a, "q"_a, "v"_a)
        .def_prop_ro(
            "q", [](BoundRollout& rollout) { return rollout.view(rollout.core.q); }, nb::rv_policy::reference_internal)
        .def_prop_ro(
            "v", [](BoundRollout& rollout) { return rollout.view(rollout.core.v); }, nb::rv_policy::reference_internal)
        .def("copy", [](const BoundRollout& rollout) { return BoundRollout(rollout); })
        .def("first_nodes", &first_nodes, "nodes"_a)
        .def("roll", &roll, "dt"_a, "commands"_a, "increments"_a, "drift"_a, "nodes"_a, "impulses"_a = nb::none());
    m.def("accelerations", &accelerations, "mechanism"_a, "q"_a, "v"_a, "force"_a);
    m.def("inverse_dynamics", &inverse_dynamics, "mechanism"_a, "q"_a, "v"_a, "a"_a);
    m.def("linearize_explicit", &linearize, "mechanism"_a, "method"_a, "dt"_a, "q"_a, "v"_a, "force"_a,
          "ramp"_a = false);
}

}  // namespace varpin::border
