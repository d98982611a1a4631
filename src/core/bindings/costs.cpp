// Costs at samples and of changes of controls.
#include "varpin/costs.hpp"

#include <nanobind/stl/tuple.h>

#include <tuple>
#include <utility>

#include "arrays.hpp"
#include "bodies.hpp"
#include "registrations.hpp"
#include "varpin/decrease_bound.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

CostTerms terms_for(int dof, int controls) {
    if (dof < 0 || controls < 0)
        throw std::invalid_argument("numbers of coordinates and controls must not be negative");
    return {dof, controls, {}, {}};
}

std::size_t add_frame(CostTerms& costs, const Links& links, In<2> turned, In<1> shifted) {
    require(turned, "turned", {3, 3});
    require(shifted, "shifted", {3});
    if (links.bodies.empty()) throw std::invalid_argument("a frame needs at least one body");
    if (links.dof != costs.dof)
        throw std::invalid_argument("the frame has another number of coordinates than the costs");
    costs.frames.push_back({links, {rotation_at(turned.data()), {shifted(0), shifted(1), shifted(2)}}});
    return costs.frames.size() - 1;
}

std::size_t add_center(CostTerms& costs, const Links& links) {
    double mass = 0.0;
    for (const Body& link : links.bodies) mass += link.mass;
    if (!(mass > 0.0)) throw std::invalid_argument("the total mass must be > 0 for a centre of mass");
    if (links.dof != costs.dof)
        throw std::invalid_argument("the bodies have another number of coordinates than the costs");
    costs.frames.push_back({links, {}, true});
    return costs.frames.size() - 1;
}

void add_term(CostTerms& costs, Subject subject, int index, In<2> weight, In<2> target, Integers<1> directions) {
    const std::size_t size = weight.shape(0);
    const bool entries = subject == Subject::entries || subject == Subject::excess;
    const int last = entries ? costs.size() - static_cast<int>(size) : static_cast<int>(costs.frames.size()) - 1;
    if (index < 0 || index > last) throw std::invalid_argument("the term's frame or entries do not exist");
    const bool measures = subject == Subject::manipulability;
    if (!entries) {
        if (costs.frames[index].center && subject != Subject::position)
            throw std::invalid_argument("a centre of mass has only a position");
        if (size != (subject == Subject::twist ? 6u : measures ? 1u : 3u))
            throw std::invalid_argument("a weight has a wrong size");
    }
    require(weight, "weight", {size, size});
    require(target, "target", {target.shape(0), target_width(subject, size)});
    if (target.shape(0) == 0) throw std::invalid_argument("there is no target");
    const std::vector<int> rows(directions.data(), directions.data() + directions.size());
    if (rows.empty() == measures || rows.size() > static_cast<std::size_t>(costs.dof))
        throw std::invalid_argument("only a manipulability has directions, at most one for each coordinate");
    for (int row : rows)
        if (row < 0 || row > 5) throw std::invalid_argument("directions must be rows of a Jacobian");
    costs.terms.push_back({subject,
                           static_cast<int>(size),
                           index,
                           {weight.data(), weight.data() + weight.size()},
                           {target.data(), target.data() + target.size()},
                           rows});
}

std::size_t rows_of(const CostTerms& costs, const In<2>& q, const In<2>& v, const In<2>& u) {
    const std::size_t rows = q.shape(0), n = static_cast<std::size_t>(costs.dof);
    for (const auto& [array, name] : {std::pair{&q, "q"}, {&v, "v"}}) require(*array, name, {rows, n});
    require(u, "u", {rows, static_cast<std::size_t>(costs.controls)});
    return rows;
}

// Values (N, terms) at rows of q, v and u.
Out values(const CostTerms& costs, In<2> q, In<2> v, In<2> u) {
    const std::size_t rows = rows_of(costs, q, v, u), count = costs.terms.size();
    double* found = nullptr;
    const Out out = array_for(found, {rows, count});
    nb::gil_scoped_release release;
    CostSample sample(costs);
    for (std::size_t s = 0; s < rows; ++s)
        sample.values(&q(s, 0), &v(s, 0), u.data() + s * u.shape(1), s, found + s * count);
    return out;
}

// Gradient (N, 2n + m) and Hessian (N, 2n + m, 2n + m) of all terms; one Hessian if it is the same for all rows.
std::tuple<Out, Out> expand(const CostTerms& costs, In<2> q, In<2> v, In<2> u) {
    const std::size_t rows = rows_of(costs, q, v, u), size = static_cast<std::size_t>(costs.size());
    const std::size_t matrices = costs.linear() ? 1 : rows;
    double *g = nullptr, *H = nullptr;
    const Out gradient = array_for(g, {rows, size}), hessian = array_for(H, {matrices, size, size});
    {
        nb::gil_scoped_release release;
        CostSample sample(costs);
        for (std::size_t s = 0; s < matrices; ++s) sample.add_constant_hessian(H + s * size * size);
        for (std::size_t s = 0; s < rows; ++s) {
            double* hessian = H + (matrices > 1 ? s * size * size : 0);
            sample.expand(&q(s, 0), &v(s, 0), u.data() + s * u.shape(1), s, g + s * size, hessian);
        }
    }
    return {gradient, hessian};
}

// `expand` at the samples of the steps of a motion with nodes q and v (N + 1, n) and controls u (N, m).
std::tuple<Out, Out> expand_steps(const CostTerms& costs, In<2> rule, In<2> q, In<2> v, In<2> u) {
    const std::size_t N = u.shape(0), n = static_cast<std::size_t>(costs.dof), samples = rule.shape(0);
    const std::size_t rows = N * samples, size = static_cast<std::size_t>(costs.size());
    require(rule, "rule", {samples, 9});
    for (const auto& [array, name] : {std::pair{&q, "q"}, {&v, "v"}}) require(*array, name, {N + 1, n});
    require(u, "u", {N, static_cast<std::size_t>(costs.controls)});
    const std::size_t matrices = costs.linear() ? 1 : rows;
    double *g = nullptr, *H = nullptr;
    const Out gradient = array_for(g, {rows, size}), hessian = array_for(H, {matrices, size, size});
    {
        nb::gil_scoped_release release;
        CostSample sample(costs);
        std::vector<double> at_q(samples * n), at_v(samples * n);
        for (std::size_t s = 0; s < matrices; ++s) sample.add_constant_hessian(H + s * size * size);
        for (std::size_t step = 0; step < N; ++step) {
            sample_steps(rule.data(), samples, 1, n, q.data() + step * n, v.data() + step * n, at_q.data(),
                         at_v.data());
            for (std::size_t k = 0; k < samples; ++k) {
                const std::size_t s = step * samples + k;
                double* hessian = H + (matrices > 1 ? s * size * size : 0);
                sample.expand(at_q.data() + k * n, at_v.data() + k * n, u.data() + step * u.shape(1), s, g + s * size,
                              hessian);
            }
        }
    }
    return {gradient, hessian};
}

ChangeCost change_cost(const In<2>& weight, const In<2>& before, std::size_t m) {
    require(weight, "weight", {m, m});
    const bool starts = given(before, "before", {1, m});
    return {static_cast<int>(m),
            {weight.data(), weight.data() + weight.size()},
            {before.data(), before.data() + (starts ? m : 0)}};
}

// Values (P, N) of the changes of controls (P, N, m).
Out change_values(In<2> weight, In<2> before, In<3> u) {
    const std::size_t paths = u.shape(0), count = u.shape(1), m = u.shape(2);
    ChangeCost cost = change_cost(weight, before, m);
    double* found = nullptr;
    const Out out = array_for(found, {paths, count});
    nb::gil_scoped_release release;
    for (std::size_t p = 0; p < paths; ++p)
        for (std::size_t k = 0; k < count; ++k) *found++ = cost.value(u.data() + p * count * m, k);
    return out;
}

// Gradients (N, m) and Hessians (N, m, m) of the changes of controls (N, m).
std::tuple<Out, Out> expand_changes(In<2> weight, In<2> before, In<2> u) {
    const std::size_t count = u.shape(0), m = u.shape(1);
    ChangeCost cost = change_cost(weight, before, m);
    double *g = nullptr, *H = nullptr;
    const Out gradient = array_for(g, {count, m}), hessian = array_for(H, {count, m, m});
    {
        nb::gil_scoped_release release;
        for (std::size_t k = 0; k < count; ++k) cost.expand(u.data(), k, g + k * m, H + k * m * m);
    }
    return {gradient, hessian};
}

std::tuple<Out, Out> samples(In<2> rule, In<3> q, In<3> v) {
    const std::size_t motions = q.shape(0), nodes = q.shape(1), n = q.shape(2), count = rule.shape(0);
    require(rule, "rule", {count, 9});
    require(v, "v", {motions, nodes, n});
    if (nodes == 0) throw std::invalid_argument("a motion needs at least one node");
    double *at_q = nullptr, *at_v = nullptr;
    const std::size_t rows = (nodes - 1) * count;
    const Out sampled_q = array_for(at_q, {motions, rows, n}), sampled_v = array_for(at_v, {motions, rows, n});
    nb::gil_scoped_release release;
    for (std::size_t i = 0; i < motions; ++i)
        sample_steps(rule.data(), count, nodes - 1, n, q.data() + i * nodes * n, v.data() + i * nodes * n,
                     at_q + i * rows * n, at_v + i * rows * n);
    return {sampled_q, sampled_v};
}

// Free and moved bound of the decrease of models with gradients (N, k) and Hessians (N, k, k), or one (1, k, k), at
// points displaced by `displacement` (N, k).
std::tuple<double, double> stake_of(In<2> gradient, In<3> hessian, In<2> displacement) {
    const std::size_t rows = gradient.shape(0), size = gradient.shape(1);
    const bool one = hessian.shape(0) == 1;
    require(hessian, "hessian", {one ? 1 : rows, size, size});
    require(displacement, "displacement", {rows, size});
    nb::gil_scoped_release release;
    DecreaseBound bound;
    for (std::size_t s = 0; s < rows; ++s) {
        bound.add(gradient.data() + s * size, hessian.data() + (one ? 0 : s * size * size),
                  displacement.data() + s * size, size);
    }
    return {bound.free, bound.moved};
}

}  // namespace

void register_costs(nb::module_& m) {
    nb::enum_<Subject>(m, "Subject")
        .value("entries", Subject::entries)
        .value("excess", Subject::excess)
        .value("position", Subject::position)
        .value("orientation", Subject::orientation)
        .value("twist", Subject::twist)
        .value("manipulability", Subject::manipulability);
    nb::class_<CostTerms>(m, "CostTerms")
        .def_static("make", &terms_for, "dof"_a, "controls"_a)
        .def("add_frame", &add_frame, "links"_a, "turned"_a, "shifted"_a)
        .def("add_center", &add_center, "links"_a)
        .def("add_term", &add_term, "subject"_a, "index"_a, "weight"_a, "target"_a, "directions"_a)
        .def("values", &values, "q"_a, "v"_a, "u"_a)
        .def("expand", &expand, "q"_a, "v"_a, "u"_a)
        .def("expand_steps", &expand_steps, "rule"_a, "q"_a, "v"_a, "u"_a);
    m.def("change_values", &change_values, "weight"_a, "before"_a, "u"_a);
    m.def("expand_changes", &expand_changes, "weight"_a, "before"_a, "u"_a);
    m.def("stake_of", &stake_of, "gradient"_a, "hessian"_a, "displacement"_a);
    m.def("sample_steps", &samples, "rule"_a, "q"_a, "v"_a);
}

}  // namespace varpin::border
