// Placements of frames for many configurations at once, and costs at samples.
#include "varpin/costs.hpp"

#include <nanobind/stl/tuple.h>

#include <tuple>
#include <utility>

#include "arrays.hpp"
#include "bodies.hpp"
#include "units.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

Links links_of(nb::handle tree) {
    const std::size_t n = field<In<1>>(tree, "armature").shape(0);
    return {bodies_of(tree, n), static_cast<int>(n)};
}

// A frame with rotation `turned` and position `shifted` in a body.
Placement placement_of(const In<2>& turned, const In<1>& shifted) {
    require(turned, "turned", {3, 3});
    require(shifted, "shifted", {3});
    return {rotation_at(turned.data()), vector_at(shifted.data())};
}

// Rotations (N, 3, 3), positions (N, 3) and Jacobians (N, 6, n), (0, 6, n) if not wanted, of a frame with rotation
// `turned` and position `shifted` in the last body.
std::tuple<Out, Out, Out> place_frame(const Links& links, In<2> turned, In<1> shifted, In<2> q, bool jacobian) {
    const std::size_t n = static_cast<std::size_t>(links.dof), rows = q.shape(0), count = links.bodies.size();
    require(q, "q", {rows, n});
    if (count == 0) throw std::invalid_argument("a frame needs at least one body");
    const Out rotation = array_for({rows, 3, 3}), position = array_for({rows, 3}),
              jacobians = array_for({jacobian ? rows : 0, 6, n});
    {
        nb::gil_scoped_release release;
        const Placement offset = placement_of(turned, shifted);
        std::vector<Placement> at(count);
        for (std::size_t s = 0; s < rows; ++s) {
            forward_kinematics(links, q.data() + s * n, at.data());
            const Placement frame = at.back() * offset;
            write(frame.rotation, rotation.data() + 9 * s);
            write(frame.position, position.data() + 3 * s);
            if (jacobian) frame_jacobian(links, at.data(), frame.position, jacobians.data() + 6 * n * s);
        }
    }
    return {rotation, position, jacobians};
}

CostTerms terms_for(int dof, int controls) {
    if (dof < 0 || controls < 0)
        throw std::invalid_argument("numbers of coordinates and controls must not be negative");
    return {dof, controls, {}, {}};
}

std::size_t add_frame(CostTerms& costs, const Links& links, In<2> turned, In<1> shifted) {
    if (links.bodies.empty()) throw std::invalid_argument("a frame needs at least one body");
    if (links.dof != costs.dof)
        throw std::invalid_argument("the frame has another number of coordinates than the costs");
    costs.frames.push_back({links, placement_of(turned, shifted)});
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
    costs.terms.push_back({subject, static_cast<int>(size), index, copied(weight), copied(target), rows});
}

std::size_t rows_of(const CostTerms& costs, const In<2>& q, const In<2>& v, const In<2>& u) {
    const std::size_t rows = q.shape(0), n = static_cast<std::size_t>(costs.dof);
    require_each({rows, n}, "q", q, "v", v);
    require(u, "u", {rows, static_cast<std::size_t>(costs.controls)});
    return rows;
}

// Values (N, terms) at rows of q, v and u.
Out values(const CostTerms& costs, In<2> q, In<2> v, In<2> u) {
    const std::size_t rows = rows_of(costs, q, v, u), count = costs.terms.size();
    const Out out = array_for({rows, count});
    nb::gil_scoped_release release;
    CostSample sample(costs);
    for (std::size_t s = 0; s < rows; ++s)
        sample.values(&q(s, 0), &v(s, 0), u.data() + s * u.shape(1), s, out.data() + s * count);
    return out;
}

// Gradient (N, 2n + m) and Hessian (N, 2n + m, 2n + m) of all terms; one Hessian if it is the same for all rows.
std::tuple<Out, Out> expand(const CostTerms& costs, In<2> q, In<2> v, In<2> u) {
    const std::size_t rows = rows_of(costs, q, v, u), size = static_cast<std::size_t>(costs.size());
    const std::size_t matrices = costs.linear() ? 1 : rows;
    const Out gradient = array_for({rows, size}), hessian = array_for({matrices, size, size});
    {
        nb::gil_scoped_release release;
        CostSample sample(costs);
        for (std::size_t s = 0; s < matrices; ++s) sample.add_constant_hessian(hessian.data() + s * size * size);
        for (std::size_t s = 0; s < rows; ++s) {
            sample.expand(&q(s, 0), &v(s, 0), u.data() + s * u.shape(1), s, gradient.data() + s * size,
                          hessian.data() + (matrices > 1 ? s * size * size : 0));
        }
    }
    return {gradient, hessian};
}

}  // namespace

void register_costs(nb::module_& m) {
    nb::class_<Links>(m, "Links")
        .def_static("make", &links_of, "tree"_a)
        .def("place_frame", &place_frame, "turned"_a, "shifted"_a, "q"_a, "jacobian"_a);
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
        .def("expand", &expand, "q"_a, "v"_a, "u"_a);
}

}  // namespace varpin::border
