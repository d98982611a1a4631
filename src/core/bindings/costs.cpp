// Costs at samples.
#include "varpin/costs.hpp"

#include <nanobind/stl/tuple.h>

#include <tuple>
#include <utility>

#include "arrays.hpp"
#include "bodies.hpp"
#include "registrations.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

CostTerms terms_for(int dof, int controls) {
    if (dof < 0 || controls < 0) throw std::invalid_argument("numbers of coordinates and controls are not negative");
    return {dof, controls, {}, {}};
}

std::size_t add_frame(CostTerms& costs, const Links& links, In<2> turned, In<1> shifted) {
    require(turned, "turned", {3, 3});
    require(shifted, "shifted", {3});
    if (links.bodies.empty()) throw std::invalid_argument("a frame stands on a body");
    if (links.dof != costs.dof) throw std::invalid_argument("the frame is of another number of coordinates");
    costs.frames.push_back({links, {rotation_at(turned.data()), {shifted(0), shifted(1), shifted(2)}}});
    return costs.frames.size() - 1;
}

void add_term(CostTerms& costs, Subject subject, int place, In<2> weight, In<2> target) {
    const std::size_t size = weight.shape(0);
    const bool entries = subject == Subject::entries;
    const int last = entries ? costs.size() - static_cast<int>(size) : static_cast<int>(costs.frames.size()) - 1;
    if (place < 0 || place > last) throw std::invalid_argument("the term is of what is not there");
    if (!entries && size != (subject == Subject::twist ? 6u : 3u))
        throw std::invalid_argument("a weight of a wrong size");
    require(weight, "weight", {size, size});
    require(target, "target", {target.shape(0), subject == Subject::orientation ? 9 : size});
    if (target.shape(0) == 0) throw std::invalid_argument("there is no target");
    costs.terms.push_back({subject,
                           static_cast<int>(size),
                           place,
                           {weight.data(), weight.data() + weight.size()},
                           {target.data(), target.data() + target.size()}});
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

// Gradient (N, 2n + m) and Hessian (N, 2n + m, 2n + m) of all terms, the latter (1, 2n + m, 2n + m) where it is the
// same at all rows.
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
            double* own = H + (matrices > 1 ? s * size * size : 0);
            sample.expand(&q(s, 0), &v(s, 0), u.data() + s * u.shape(1), s, g + s * size, own);
        }
    }
    return {gradient, hessian};
}

std::tuple<Out, Out> samples(In<2> rule, In<3> q, In<3> v) {
    const std::size_t motions = q.shape(0), nodes = q.shape(1), n = q.shape(2), count = rule.shape(0);
    require(rule, "rule", {count, 9});
    require(v, "v", {motions, nodes, n});
    if (nodes == 0) throw std::invalid_argument("a motion has a node");
    double *at_q = nullptr, *at_v = nullptr;
    const std::size_t rows = (nodes - 1) * count;
    const Out sampled_q = array_for(at_q, {motions, rows, n}), sampled_v = array_for(at_v, {motions, rows, n});
    nb::gil_scoped_release release;
    for (std::size_t i = 0; i < motions; ++i)
        sample_steps(rule.data(), count, nodes - 1, n, q.data() + i * nodes * n, v.data() + i * nodes * n,
                     at_q + i * rows * n, at_v + i * rows * n);
    return {sampled_q, sampled_v};
}

}  // namespace

void register_costs(nb::module_& m) {
    nb::enum_<Subject>(m, "Subject")
        .value("entries", Subject::entries)
        .value("position", Subject::position)
        .value("orientation", Subject::orientation)
        .value("twist", Subject::twist);
    nb::class_<CostTerms>(m, "CostTerms")
        .def_static("make", &terms_for, "dof"_a, "controls"_a)
        .def("add_frame", &add_frame, "links"_a, "turned"_a, "shifted"_a)
        .def("add_term", &add_term, "subject"_a, "place"_a, "weight"_a, "target"_a)
        .def("values", &values, "q"_a, "v"_a, "u"_a)
        .def("expand", &expand, "q"_a, "v"_a, "u"_a);
    m.def("sample_steps", &samples, "rule"_a, "q"_a, "v"_a);
}

}  // namespace varpin::border
