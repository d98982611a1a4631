// Placements of bodies and frames, and rotation errors, for many configurations at once.
#include "varpin/kinematics.hpp"

#include <nanobind/stl/tuple.h>

#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "bodies.hpp"
#include "registrations.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

Links links_of(Integers<1> parent, Integers<1> prismatic, In<3> rotation, In<2> translation, Integers<1> coordinate,
               In<1> ratio, In<1> offset, int dof) {
    if (dof < 0) throw std::invalid_argument("a number of coordinates is not negative");
    return {jointed_bodies(parent, prismatic, rotation, translation, coordinate, ratio, offset,
                           static_cast<std::size_t>(dof)),
            dof};
}

// Rotations (N, c, 3, 3) and positions (N, c, 3) of the bodies at q (N, n).
std::tuple<Out, Out> place_all(const Links& links, In<2> q) {
    const std::size_t n = static_cast<std::size_t>(links.dof), rows = q.shape(0), count = links.bodies.size();
    require(q, "q", {rows, n});
    double *R = nullptr, *p = nullptr;
    const Out rotation = array_for(R, {rows, count, 3, 3}), position = array_for(p, {rows, count, 3});
    {
        nb::gil_scoped_release release;
        std::vector<Placement> at(count);
        for (std::size_t s = 0; s < rows; ++s) {
            place(links, q.data() + s * n, at.data());
            for (std::size_t j = 0; j < count; ++j) {
                write(at[j].rotation, R + 9 * (s * count + j));
                write(at[j].position, p + 3 * (s * count + j));
            }
        }
    }
    return {rotation, position};
}

// Rotations (N, 3, 3), positions (N, 3) and, where wanted, Jacobians (N, 6, n), else (0, 6, n), of a frame that stands
// at (turned, shifted) in the last body.
std::tuple<Out, Out, Out> place_frame(const Links& links, In<2> turned, In<1> shifted, In<2> q, bool jacobian) {
    const std::size_t n = static_cast<std::size_t>(links.dof), rows = q.shape(0), count = links.bodies.size();
    require(turned, "turned", {3, 3});
    require(shifted, "shifted", {3});
    require(q, "q", {rows, n});
    if (count == 0) throw std::invalid_argument("a frame stands on a body");
    double *R = nullptr, *p = nullptr, *J = nullptr;
    const Out rotation = array_for(R, {rows, 3, 3}), position = array_for(p, {rows, 3}),
              jacobians = array_for(J, {jacobian ? rows : 0, 6, n});
    {
        nb::gil_scoped_release release;
        const Placement own{rotation_at(turned.data()), {shifted(0), shifted(1), shifted(2)}};
        std::vector<Placement> at(count);
        for (std::size_t s = 0; s < rows; ++s) {
            place(links, q.data() + s * n, at.data());
            const Placement frame = at.back() * own;
            write(frame.rotation, R + 9 * s);
            write(frame.position, p + 3 * s);
            if (jacobian) frame_jacobian(links, at.data(), frame.position, J + 6 * n * s);
        }
    }
    return {rotation, position, jacobians};
}

// Logarithms (N, 3) of target' R for R (N, 3, 3) and targets that repeat after T of them (T, 3, 3); where wanted, their
// derivatives (N, 3, 3), else (0, 3, 3).
std::tuple<Out, Out> rotation_logarithms(In<3> target, In<3> R, bool derivative) {
    const std::size_t targets = target.shape(0), rows = R.shape(0);
    require(target, "target", {targets, 3, 3});
    require(R, "R", {rows, 3, 3});
    if (targets == 0 && rows > 0) throw std::invalid_argument("there is no target");
    double *r = nullptr, *D = nullptr;
    const Out logarithms = array_for(r, {rows, 3}), derivatives = array_for(D, {derivative ? rows : 0, 3, 3});
    {
        nb::gil_scoped_release release;
        for (std::size_t s = 0; s < rows; ++s) {
            const Mat3<double> back = transposed(rotation_at(target.data() + 9 * (s % targets)));
            const Vec3<double> error = logarithm(back * rotation_at(R.data() + 9 * s));
            write(error, r + 3 * s);
            if (derivative) write(logarithm_derivative(error), D + 9 * s);
        }
    }
    return {logarithms, derivatives};
}

}  // namespace

void register_kinematics(nb::module_& m) {
    nb::class_<Links>(m, "Links")
        .def_static("make", &links_of, nb::kw_only(), "parent"_a, "prismatic"_a, "rotation"_a, "translation"_a,
                    "coordinate"_a, "ratio"_a, "offset"_a, "dof"_a)
        .def("place", &place_all, "q"_a)
        .def("place_frame", &place_frame, "turned"_a, "shifted"_a, "q"_a, "jacobian"_a);
    m.def("rotation_logarithms", &rotation_logarithms, "target"_a, "R"_a, "derivative"_a);
}

}  // namespace varpin::border
