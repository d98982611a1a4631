// The mechanism and its Lagrangian jet.
#include <nanobind/stl/array.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <variant>

#include "arrays.hpp"
#include "bodies.hpp"
#include "units.hpp"
#include "varpin/dense.hpp"
#include "varpin/jet.hpp"
#include "varpin/kernels.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

// Numbers of a member of an element or a coupling.
template <class Member>
constexpr std::size_t width = 1;
template <>
constexpr std::size_t width<Vec3<double>> = 3;

const double* read(const double* from, double& to) { return to = *from, from + 1; }
const double* read(const double* from, bool& to) { return to = *from != 0.0, from + 1; }
const double* read(const double* from, Vec3<double>& to) { return to = {from[0], from[1], from[2]}, from + 3; }

template <class Kind>
constexpr std::size_t numbers_of() {
    const auto sum = [](auto... member) { return (width<std::decay_t<decltype(Kind{}.*member)>> + ...); };
    return std::apply(sum, Kind::numbers);
}

// Set the members that are a kind's numbers from the values behind the first `before`.
template <class Kind>
void take_numbers(Kind& kind, const std::vector<double>& values, std::size_t before = 0) {
    const std::size_t count = before + numbers_of<Kind>();
    if (values.size() != count)
        throw std::invalid_argument("a force of kind " + std::string(Kind::name) + " has " + std::to_string(count) +
                                    " numbers, not " + std::to_string(values.size()));
    const double* from = values.data() + before;
    std::apply([&](auto... member) { ((from = read(from, kind.*member)), ...); }, Kind::numbers);
}

// Calls visit with an instance of each kind of a variant.
template <class... Kinds, class Visit>
void each_kind(std::type_identity<std::variant<Kinds...>>, const Visit& visit) {
    (visit(Kinds{}), ...);
}

// The instance of the kind with a name, after visit(instance).
template <class Variant, class Visit>
Variant one_of(const std::string& name, const Visit& visit) {
    std::optional<Variant> found;
    each_kind(std::type_identity<Variant>{}, [&](auto kind) {
        if (name == kind.name) visit(kind), found = kind;
    });
    if (!found) throw std::invalid_argument("there is no force of kind " + name);
    return *found;
}

// Elements: name of the kind, coordinate, numbers.
using Named = std::vector<std::tuple<std::string, int, std::vector<double>>>;

Element element_of(const std::string& name, int coordinate, const std::vector<double>& values) {
    return one_of<Element>(name, [&](auto& element) {
        element.coordinate = coordinate;
        take_numbers(element, values);
    });
}

// Couplings: name of the kind, bodies of both points (-1 for the world), numbers, from the positions of both points on.
using NamedCouplings = std::vector<std::tuple<std::string, int, int, std::vector<double>>>;

CoupledElement coupling_of(const std::string& name, int a, int b, const std::vector<double>& values) {
    return one_of<CoupledElement>(name, [&](auto& coupling) {
        take_numbers(coupling, values, 6);
        constexpr bool directions = requires { coupling.directions; };
        coupling.a = {a, {values[0], values[1], values[2]}, directions};
        coupling.b = {b, {values[3], values[4], values[5]}, directions};
    });
}

// By the name of each kind of force: how many numbers it has besides its points, whether it has a potential, and a
// force without one.
template <class Variant>
std::map<std::string, std::tuple<std::size_t, bool, bool>> kinds_of() {
    std::map<std::string, std::tuple<std::size_t, bool, bool>> found;
    each_kind(std::type_identity<Variant>{}, [&](auto kind) {
        const bool potential = requires { kind.potential(0.0); } || requires { kind.potential(Vec3<double>{}); };
        const bool force = !potential || requires { kind.force(0.0, 0.0); };
        found[kind.name] = {numbers_of<decltype(kind)>(), potential, force};
    });
    return found;
}

// Constraints: vectors fixed to bodies (body, whether it is a direction, coordinates), rows that are products (x, y,
// factor, constant), ties (follower, leader, coefficients, control of the rate or -1), and functions (number of rows,
// function of q for (g, C), function of q and weights for the curvature).
using NamedVector = std::vector<std::tuple<int, bool, std::array<double, 3>>>;
using NamedConstraints = std::tuple<std::vector<NamedVector>, std::vector<std::tuple<int, int, double, double>>,
                                    std::vector<std::tuple<int, int, std::vector<double>, int>>,
                                    std::vector<std::tuple<int, nb::object, nb::object>>>;

// A Python function whose references are released under the interpreter's lock.
std::shared_ptr<nb::object> held(const nb::object& function) {
    return {new nb::object(function), [](nb::object* owned) {
                nb::gil_scoped_acquire acquire;
                delete owned;
            }};
}

void copy_result(const nb::handle& given, std::size_t size, double* out) {
    const auto array = nb::cast<nb::ndarray<const double, nb::c_contig, nb::device::cpu>>(given);
    if (array.size() != size) throw std::invalid_argument("a constraint's function returned another shape than before");
    std::copy(array.data(), array.data() + size, out);
}

CustomRows custom_rows(int rows, const nb::object& value, const nb::object& bending, std::size_t n) {
    const std::size_t m = static_cast<std::size_t>(rows);
    const auto first = held(value), second = held(bending);
    return {rows,
            [first, n, m](const double* q, double* g, double* C) {
                nb::gil_scoped_acquire acquire;
                const nb::object both = (*first)(array_of(q, {n}));
                copy_result(both[0], m, g);
                copy_result(both[1], m * n, C);
            },
            [second, n, m](const double* q, const double* weights, double* curvature) {
                nb::gil_scoped_acquire acquire;
                copy_result((*second)(array_of(q, {n}), array_of(weights, {m})), n * n, curvature);
            }};
}

Constraints constraints_of(const NamedConstraints& named, const std::vector<Body>& bodies, std::size_t n,
                           std::size_t controls) {
    const auto& [vectors, products, ties, customs] = named;
    const auto require_below = [](int index, std::size_t count) {
        if (index < 0 || index >= static_cast<int>(count))
            throw std::invalid_argument("a constraint's vectors, coordinates or control are out of range");
    };
    std::vector<VectorSum> sums;
    for (const NamedVector& parts : vectors) {
        VectorSum sum;
        for (const auto& [body, direction, point] : parts) {
            require_below(body + 1, bodies.size() + 1);
            sum.parts.push_back({body, {point[0], point[1], point[2]}, direction});
        }
        sums.push_back(sum);
    }
    std::vector<ProductRow> rows;
    for (const auto& [x, y, factor, constant] : products) {
        require_below(x, sums.size());
        require_below(y, sums.size());
        rows.push_back({x, y, factor, constant});
    }
    std::vector<TieRow> tied;
    for (const auto& [follower, leader, coefficients, rate] : ties) {
        require_below(follower, n);
        require_below(leader, n);
        require_below(rate + 1, controls + 1);
        tied.push_back({follower, leader, coefficients, rate});
    }
    std::vector<CustomRows> functions;
    for (const auto& [count, value, bending] : customs) functions.push_back(custom_rows(count, value, bending, n));
    return Constraints(sums, rows, tied, functions, bodies, static_cast<int>(n));
}

// A force in Python: a function of (q, v, whether derivatives are wanted) that returns (F, dF/dq, dF/dv). Its
// exceptions propagate to the caller.
OuterForce outer_force_of(nb::object function, std::size_t n) {
    return [function = std::move(function), n](const double* q, const double* v, double* F, double* by_q,
                                               double* by_v) {
        nb::gil_scoped_acquire acquire;
        const auto found =
            nb::cast<std::tuple<In<1>, In<2>, In<2>>>(function(array_of(q, {n}), array_of(v, {n}), by_q != nullptr));
        const auto& [value, in_q, in_v] = found;
        require(value, "F", {n});
        std::copy_n(value.data(), n, F);
        if (!by_q) return;
        require(in_q, "dF/dq", {n, n});
        require(in_v, "dF/dv", {n, n});
        std::copy_n(in_q.data(), n * n, by_q);
        std::copy_n(in_v.data(), n * n, by_v);
    };
}

// The tree of bodies, the Python named tuple Tree.
Tree tree_of(nb::handle tree) {
    const auto armature = field<In<1>>(tree, "armature");
    const auto loads = field<Integers<1>>(tree, "loads"), ends = field<Integers<1>>(tree, "ends");
    const std::size_t n = armature.shape(0);
    const std::int64_t *group = field<Integers<1>>(tree, "group", {n}),
                       *periodic = field<Integers<1>>(tree, "periodic", {n}),
                       *carried = field<Integers<2>>(tree, "carried", {loads.shape(0), n});
    Tree out{.bodies = bodies_of(tree, n),
             .armature = copied(armature),
             .periodic = {periodic, periodic + n},
             .group = {group, group + n},
             .groups = nb::cast<int>(tree.attr("groups"))};
    for (const int own : out.group)
        if (own < 0 || own >= out.groups) throw std::invalid_argument("a coordinate's group is out of range");
    for (std::size_t b = 0; b < ends.shape(0); ++b) {
        const int begin = b > 0 ? out.blocks.back().end : 0;
        if (ends(b) <= begin || ends(b) > static_cast<std::int64_t>(n))
            throw std::invalid_argument("the ends of blocks must increase up to the number of coordinates");
        out.blocks.push_back({begin, static_cast<int>(ends(b))});
    }
    if ((out.blocks.empty() ? 0 : out.blocks.back().end) != static_cast<int>(n))
        throw std::invalid_argument("the last block must end with the last coordinate");
    for (std::size_t r = 0; r < loads.shape(0); ++r, carried += n) {
        if (loads(r) < 0 || loads(r) >= static_cast<std::int64_t>(out.bodies.size()) || out.bodies[loads(r)].parent < 0)
            throw std::invalid_argument("the first body of a light part must have a parent");
        out.light_parts.push_back({static_cast<int>(loads(r)), {carried, carried + n}});
    }
    return out;
}

// A Python function that has the noise of a step, the processes that see slopes, and whether a field depends on v.
using OuterNoise = std::optional<std::tuple<nb::object, Integers<1>, bool>>;

// The diffusion fields of n coordinates and m controls, the Python named tuple Diffusion.
Diffusion diffusion_of(nb::handle fields, const OuterNoise& outer, std::size_t n, std::size_t m) {
    const std::size_t k = field<In<2>>(fields, "constant").shape(1);
    const auto numbers = [&](const double* from, std::size_t size) { return std::vector<double>(from, from + size); };
    const auto entries = [&](const char* name) { return numbers(field<In<2>>(fields, name, {n, k}), n * k); };
    Diffusion out{.processes = static_cast<int>(k),
                  .constant = entries("constant"),
                  .control = numbers(field<In<3>>(fields, "control", {n, k, m}), n * k * m),
                  .quadratic = entries("quadratic"),
                  .center = entries("center")};
    for (std::size_t w = 0; w < k; ++w) {
        bool depends = false;
        for (std::size_t r = 0; r < n; ++r) {
            for (std::size_t c = 0; c < m; ++c) depends = depends || out.control[(r * k + w) * m + c] != 0.0;
        }
        if (depends) out.sloped.push_back(static_cast<int>(w));
    }
    if (!outer) return out;
    const auto& [function, sloped, by_velocity] = *outer;
    out.sloped.assign(sloped.data(), sloped.data() + sloped.size());
    out.by_velocity = by_velocity;
    out.outer = [function, n, m, k, all = k + sloped.size(), by_velocity](
                    const double* q, const double* v, const double* center, const double* mean, const double* change,
                    const double* increments, StepNoise& to) {
        nb::gil_scoped_acquire acquire;
        const auto found = nb::cast<std::tuple<In<1>, In<1>>>(
            function(array_of(q, {n}), array_of(v, {n}), array_of(center, {n, k}), array_of(mean, {m}),
                     array_of(change, {change ? m : 0}), array_of(increments, {increments ? change ? all : k : 0})));
        const auto& [impulse, drift] = found;
        require(impulse, "impulse", {n});
        require(drift, "drift", {by_velocity ? n : 0});
        to = {copied(impulse), copied(drift)};
    };
    return out;
}

Forces forces_of(const Named& forces, int n) {
    std::vector<Element> elements;
    for (const auto& [kind, coordinate, values] : forces) {
        if (coordinate < 0 || coordinate >= n) throw std::invalid_argument("an element's coordinate is out of range");
        elements.push_back(element_of(kind, coordinate, values));
    }
    return elements;
}

Couplings couplings_of(const NamedCouplings& couplings, const std::vector<Body>& bodies) {
    std::vector<CoupledElement> between;
    for (const auto& [kind, a, b, values] : couplings) {
        if (std::min(a, b) < -1 || std::max(a, b) >= static_cast<int>(bodies.size()) || std::max(a, b) < 0)
            throw std::invalid_argument("a coupling's bodies are out of range");
        between.push_back(coupling_of(kind, a, b, values));
    }
    return {between, bodies};
}

Mechanism mechanism_of(nb::handle tree, In<1> gravity, const Named& forces, const NamedCouplings& couplings,
                       const NamedConstraints& constraints, nb::object custom, In<2> actuation, nb::handle diffusion,
                       const OuterNoise& noise) {
    Mechanism out;
    out.tree = tree_of(tree);
    const std::size_t n = out.tree.armature.size(), m = actuation.shape(1);
    require(gravity, "gravity", {3});
    require(actuation, "actuation", {n, m});
    out.gravity = vector_at(gravity.data());
    out.forces = forces_of(forces, static_cast<int>(n));
    out.couplings = couplings_of(couplings, out.tree.bodies);
    out.constraints = constraints_of(constraints, out.tree.bodies, n, m);
    if (!custom.is_none()) out.couplings.take_outer(outer_force_of(std::move(custom), n));
    out.controls = static_cast<int>(m);
    for (std::size_t r = 0; r < n; ++r) {
        for (std::size_t c = 0; c < m; ++c) {
            if (actuation(r, c) != 0.0)
                out.actuation.push_back({static_cast<int>(r), static_cast<int>(c), actuation(r, c)});
        }
    }
    out.diffusion = diffusion_of(diffusion, noise, n, m);
    return out;
}

// L, L_q, L_v, L_qq, L_vq, L_vv.
std::tuple<double, Out, Out, Out, Out, Out> jet(const Mechanism& mechanism, In<1> q, In<1> v) {
    const auto n = static_cast<std::size_t>(mechanism.dof());
    require_each({n}, "q", q, "v", v);
    Jet<double> w(mechanism.tree);
    lagrangian_jet(mechanism, q.data(), v.data(), w);
    return {w.kinetic - w.total_potential(), array_of(w.Lq.data(), {n}),   array_of(w.Lv.data(), {n}),
            array_of(w.Lqq.data(), {n, n}),  array_of(w.A.data(), {n, n}), array_of(w.M.data(), {n, n})};
}

// M and L_vq at each row of q and v (N, n).
std::tuple<Out, Out> jets(const Mechanism& mechanism, In<2> q, In<2> v) {
    const auto [n, rows] = rows_of(mechanism, "q", q, "v", v);
    Out Ms = array_for({rows, n, n}), As = array_for({rows, n, n});
    {
        nb::gil_scoped_release release;
        Jet<double> w(mechanism.tree);
        for (std::size_t s = 0; s < rows; ++s) {
            momentum_slopes(mechanism, q.data() + s * n, v.data() + s * n, w);
            std::copy(w.M.begin(), w.M.end(), Ms.data() + s * n * n);
            std::copy(w.A.begin(), w.A.end(), As.data() + s * n * n);
        }
    }
    return {Ms, As};
}

// The derivative of v in (q, p) (N, n, 2n) at each row of q and v (N, n). NaN where M is not positive definite.
Out velocity_slopes_at(const Mechanism& mechanism, In<2> q, In<2> v) {
    const auto [n, rows] = rows_of(mechanism, "q", q, "v", v);
    const Out out = array_for({rows, n, 2 * n});
    nb::gil_scoped_release release;
    kernels_of(mechanism).velocity_slopes(mechanism, rows, q.data(), v.data(), out.data());
    return out;
}

// At each row of q, v and the constant force f (N, n): the forces of elements and couplings besides L_q, dF/dq and
// dF/dv of the elements, and the dissipated power.
std::tuple<Out, Out, Out, Out> forces(const Mechanism& mechanism, In<2> q, In<2> v, In<2> f) {
    const auto [n, rows] = rows_of(mechanism, "q", q, "v", v, "f", f);
    const std::array<Out, 4> found{array_for({rows, n}), array_for({rows, n}), array_for({rows, n}),
                                   array_for({rows, n})};
    std::vector<JointForce<double>> sum(n);
    CouplingWorkspace<double> workspace;
    for (std::size_t s = 0; s < rows; ++s) {
        sum_forces(mechanism, q.data() + s * n, v.data() + s * n, f.data() + s * n, sum.data(), workspace,
                   static_cast<double*>(nullptr), static_cast<double*>(nullptr));
        for (std::size_t c = 0; c < n; ++c) {
            const JointForce<double>& force = sum[c];
            for (int i = 0; i < 4; ++i)
                found[i].data()[s * n + c] = std::array{force.value, force.by_q, force.by_v, force.lost}[i];
        }
    }
    return {found[0], found[1], found[2], found[3]};
}

// At each row of q and v (N, n): the forces of couplings besides L_q, and dF/dq and dF/dv (N, n, n).
std::tuple<Out, Out, Out> coupled_forces(const Mechanism& mechanism, In<2> q, In<2> v) {
    const auto [n, rows] = rows_of(mechanism, "q", q, "v", v);
    const Out F = array_for({rows, n}), Fq = array_for({rows, n, n}), Fv = array_for({rows, n, n});
    std::vector<JointForce<double>> sum(n);
    CouplingWorkspace<double> workspace;
    for (std::size_t s = 0; s < rows; ++s) {
        std::fill(sum.begin(), sum.end(), JointForce<double>{});
        mechanism.couplings.add_forces(static_cast<int>(n), q.data() + s * n, v.data() + s * n, workspace, sum.data(),
                                       Fq.data() + s * n * n, Fv.data() + s * n * n);
        for (std::size_t c = 0; c < n; ++c) F.data()[s * n + c] = sum[c].value;
    }
    return {F, Fq, Fv};
}

// Derivatives of M, L_vq and L_qq along (alpha, beta) at each row of q, v, alpha and beta (N, n).
std::tuple<Out, Out, Out> jets_along(const Mechanism& mechanism, In<2> q, In<2> v, In<2> alpha, In<2> beta) {
    const auto [n, rows] = rows_of(mechanism, "q", q, "v", v, "alpha", alpha, "beta", beta);
    const Out M = array_for({rows, n, n}), A = array_for({rows, n, n}), Lqq = array_for({rows, n, n});
    {
        nb::gil_scoped_release release;
        Jet<Dual> w(mechanism.tree);
        std::vector<Dual> at_q(n), at_v(n);
        for (std::size_t s = 0; s < rows; ++s) {
            for (std::size_t c = 0; c < n; ++c) {
                at_q[c] = {q(s, c), alpha(s, c)};
                at_v[c] = {v(s, c), beta(s, c)};
            }
            lagrangian_jet(mechanism, at_q.data(), at_v.data(), w);
            for (std::size_t i = 0; i < n * n; ++i) {
                M.data()[s * n * n + i] = w.M[i].slope;
                A.data()[s * n * n + i] = w.A[i].slope;
                Lqq.data()[s * n * n + i] = w.Lqq[i].slope;
            }
        }
    }
    return {M, A, Lqq};
}

// g (N, m), the magnitudes of the terms that cancel in it (N, m), and C (N, m, n) at each row of q (N, n).
std::tuple<Out, Out, Out> constraints(const Mechanism& mechanism, In<2> q) {
    const std::size_t n = static_cast<std::size_t>(mechanism.dof()), rows = q.shape(0);
    const std::size_t m = static_cast<std::size_t>(mechanism.constraints.rows());
    require(q, "q", {rows, n});
    const Out G = array_for({rows, m}), S = array_for({rows, m}), J = array_for({rows, m, n});
    ConstraintJet w;
    for (std::size_t s = 0; s < rows; ++s) {
        mechanism.constraints.at(q.data() + s * n, w);
        std::copy(w.g.begin(), w.g.end(), G.data() + s * m);
        std::copy(w.scale.begin(), w.scale.end(), S.data() + s * m);
        std::copy(w.C.begin(), w.C.end(), J.data() + s * m * n);
    }
    return {G, S, J};
}

// weights . g_qq (n, n) and g_qq v (m, n) at q.
std::tuple<Out, Out> constraint_curvature(const Mechanism& mechanism, In<1> q, In<1> weights, In<1> v) {
    const std::size_t n = static_cast<std::size_t>(mechanism.dof());
    const std::size_t m = static_cast<std::size_t>(mechanism.constraints.rows());
    require_each({n}, "q", q, "v", v);
    require(weights, "weights", {m});
    const Out curvature = array_for({n, n}), bent = array_for({m, n});
    ConstraintJet w;
    mechanism.constraints.at(q.data(), w);
    mechanism.constraints.add_curvature(weights.data(), 1.0, w, curvature.data());
    mechanism.constraints.bend(v.data(), w, bent.data());
    return {curvature, bent};
}

}  // namespace

void register_mechanism(nb::module_& m) {
    m.def("element_kinds", &kinds_of<Element>);
    m.def("coupling_kinds", &kinds_of<CoupledElement>);
    nb::class_<Mechanism>(m, "Mechanism")
        .def_static("make", &mechanism_of, "tree"_a, nb::kw_only(), "gravity"_a, "forces"_a, "couplings"_a,
                    "constraints"_a, "custom"_a.none(), "actuation"_a, "diffusion"_a, "noise"_a.none() = nb::none())
        .def("jet", &jet, "q"_a, "v"_a)
        .def("jets", &jets, "q"_a, "v"_a)
        .def("velocity_slopes", &velocity_slopes_at, "q"_a, "v"_a)
        .def("forces", &forces, "q"_a, "v"_a, "f"_a)
        .def("coupled_forces", &coupled_forces, "q"_a, "v"_a)
        .def("constraints", &constraints, "q"_a)
        .def("constraint_curvature", &constraint_curvature, "q"_a, "weights"_a, "v"_a)
        .def("jets_along", &jets_along, "q"_a, "v"_a, "alpha"_a, "beta"_a);
}

}  // namespace varpin::border
