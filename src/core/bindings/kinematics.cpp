// Placements of frames for many configurations at once.
#include "varpin/kinematics.hpp"

#include <nanobind/stl/tuple.h>

#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "bodies.hpp"
#include "units.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

Links links_of(Integers<1> parent, Integers<1> prismatic, In<3> rotation, In<2> translation, Integers<1> coordinate,
               In<1> ratio, In<1> offset, In<1> mass, In<2> center, int dof) {
    if (dof < 0) throw std::invalid_argument("the number of coordinates must not be negative");
    Links out{jointed_bodies(parent, prismatic, rotation, translation, coordinate, ratio, offset,
                             static_cast<std::size_t>(dof)),
              dof};
    require(mass, "mass", {out.bodies.size()});
    require(center, "center", {out.bodies.size(), 3});
    for (std::size_t j = 0; j < out.bodies.size(); ++j) {
        out.bodies[j].mass = mass(j);
        out.bodies[j].center = {center(j, 0), center(j, 1), center(j, 2)};
    }
    return out;
}

// Rotations (N, 3, 3), positions (N, 3) and Jacobians (N, 6, n), (0, 6, n) if not wanted, of a frame with rotation
// `turned` and position `shifted` in the last body.
std::tuple<Out, Out, Out> place_frame(const Links& links, In<2> turned, In<1> shifted, In<2> q, bool jacobian) {
    const std::size_t n = static_cast<std::size_t>(links.dof), rows = q.shape(0), count = links.bodies.size();
    require(turned, "turned", {3, 3});
    require(shifted, "shifted", {3});
    require(q, "q", {rows, n});
    if (count == 0) throw std::invalid_argument("a frame needs at least one body");
    const Out rotation = array_for({rows, 3, 3}), position = array_for({rows, 3}),
              jacobians = array_for({jacobian ? rows : 0, 6, n});
    {
        nb::gil_scoped_release release;
        const Placement offset{rotation_at(turned.data()), {shifted(0), shifted(1), shifted(2)}};
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

}  // namespace

void register_kinematics(nb::module_& m) {
    nb::class_<Links>(m, "Links")
        .def_static("make", &links_of, nb::kw_only(), "parent"_a, "prismatic"_a, "rotation"_a, "translation"_a,
                    "coordinate"_a, "ratio"_a, "offset"_a, "mass"_a, "center"_a, "dof"_a)
        .def("place_frame", &place_frame, "turned"_a, "shifted"_a, "q"_a, "jacobian"_a);
}

}  // namespace varpin::border
