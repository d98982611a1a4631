// What Python sees of the core. Shapes are checked here once; nothing below checks them again.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <stdexcept>
#include <string>
#include <tuple>

#include "varpin/jet.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using In1 = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using In2 = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using In3 = nb::ndarray<const double, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Ints = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<nb::numpy, double>;

template <class Array>
void require(const Array& array, const char* name, std::initializer_list<std::size_t> shape) {
    std::size_t axis = 0;
    for (std::size_t size : shape) {
        if (array.shape(axis) != size) {
            throw std::invalid_argument(std::string(name) + " has size " + std::to_string(array.shape(axis)) +
                                        " along axis " + std::to_string(axis) + ", not " + std::to_string(size));
        }
        ++axis;
    }
}

// A NumPy array that owns a copy of some numbers.
Out array_of(const double* values, std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (std::size_t length : shape) size *= length;
    auto* copy = new double[size];
    std::copy(values, values + size, copy);
    nb::capsule owner(copy, [](void* held) noexcept { delete[] static_cast<double*>(held); });
    return Out(copy, shape, owner);
}

// A NumPy array to be filled in.
Out array_for(double*& values, std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (std::size_t length : shape) size *= length;
    values = new double[size]();
    nb::capsule owner(values, [](void* held) noexcept { delete[] static_cast<double*>(held); });
    return Out(values, shape, owner);
}

varpin::Mechanism mechanism_of(Ints parent, Ints prismatic, In3 rotation, In2 translation, In1 mass, In2 center,
                               In2 inertia, Ints coordinate, In1 ratio, In1 offset, Ints origin, In1 armature,
                               Ints group, int groups, In1 gravity, In1 stiffness, In1 rest) {
    const std::size_t bodies = parent.shape(0), n = armature.shape(0);
    for (const auto& [array, name] :
         {std::pair{&prismatic, "prismatic"}, {&coordinate, "coordinate"}, {&origin, "origin"}})
        require(*array, name, {bodies});
    for (const auto& [array, name] : {std::pair{&mass, "mass"}, {&ratio, "ratio"}, {&offset, "offset"}})
        require(*array, name, {bodies});
    require(rotation, "rotation", {bodies, 3, 3});
    require(translation, "translation", {bodies, 3});
    require(center, "center", {bodies, 3});
    require(inertia, "inertia", {bodies, 6});
    require(group, "group", {n});
    require(gravity, "gravity", {3});
    require(stiffness, "stiffness", {n});
    require(rest, "rest", {n});
    varpin::Mechanism out;
    for (std::size_t j = 0; j < bodies; ++j) {
        if (parent(j) < -1 || parent(j) >= static_cast<std::int64_t>(j))
            throw std::invalid_argument("parents come before their children");
        if (coordinate(j) < 0 || coordinate(j) >= static_cast<std::int64_t>(n))
            throw std::invalid_argument("a body's coordinate is out of range");
        if (origin(j) == 0 && parent(j) < 0) throw std::invalid_argument("a root is an origin");
        varpin::Body link;
        link.parent = static_cast<int>(parent(j));
        link.prismatic = prismatic(j) != 0;
        link.rotation = {{rotation(j, 0, 0), rotation(j, 1, 0), rotation(j, 2, 0)},
                         {rotation(j, 0, 1), rotation(j, 1, 1), rotation(j, 2, 1)},
                         {rotation(j, 0, 2), rotation(j, 1, 2), rotation(j, 2, 2)}};
        link.translation = {translation(j, 0), translation(j, 1), translation(j, 2)};
        link.mass = mass(j);
        link.center = {center(j, 0), center(j, 1), center(j, 2)};
        link.inertia = {inertia(j, 0), inertia(j, 1), inertia(j, 2), inertia(j, 3), inertia(j, 4), inertia(j, 5)};
        link.coordinate = static_cast<int>(coordinate(j));
        link.ratio = ratio(j);
        link.offset = offset(j);
        link.origin = origin(j) != 0;
        out.tree.bodies.push_back(link);
    }
    for (std::size_t c = 0; c < n; ++c) {
        if (group(c) < 0 || group(c) >= groups) throw std::invalid_argument("a coordinate's group is out of range");
        out.tree.group.push_back(static_cast<int>(group(c)));
    }
    out.tree.groups = groups;
    out.tree.armature.assign(armature.data(), armature.data() + n);
    out.gravity = {gravity(0), gravity(1), gravity(2)};
    out.stiffness.assign(stiffness.data(), stiffness.data() + n);
    out.rest.assign(rest.data(), rest.data() + n);
    return out;
}

// L, L_q, L_v, L_qq, L_vq, L_vv.
std::tuple<double, Out, Out, Out, Out, Out> jet(const varpin::Mechanism& mechanism, In1 q, In1 v) {
    const std::size_t n = mechanism.tree.dof();
    require(q, "q", {n});
    require(v, "v", {n});
    varpin::Jet<double> w(mechanism.tree);
    varpin::lagrangian_jet(mechanism, q.data(), v.data(), w);
    return {w.kinetic - w.total_potential(), array_of(w.Lq.data(), {n}),   array_of(w.Lv.data(), {n}),
            array_of(w.Lqq.data(), {n, n}),  array_of(w.A.data(), {n, n}), array_of(w.M.data(), {n, n})};
}

// M and L_vq at each row of q and v (N, n).
std::tuple<Out, Out> jets(const varpin::Mechanism& mechanism, In2 q, In2 v) {
    const std::size_t n = mechanism.tree.dof(), rows = q.shape(0);
    require(q, "q", {rows, n});
    require(v, "v", {rows, n});
    double *M = nullptr, *A = nullptr;
    Out Ms = array_for(M, {rows, n, n}), As = array_for(A, {rows, n, n});
    {
        nb::gil_scoped_release release;
        varpin::Jet<double> w(mechanism.tree);
        for (std::size_t s = 0; s < rows; ++s) {
            varpin::lagrangian_jet(mechanism, q.data() + s * n, v.data() + s * n, w);
            std::copy(w.M.begin(), w.M.end(), M + s * n * n);
            std::copy(w.A.begin(), w.A.end(), A + s * n * n);
        }
    }
    return {Ms, As};
}

// Derivatives of M, L_vq and L_qq along (alpha, beta).
std::tuple<Out, Out, Out> jet_along(const varpin::Mechanism& mechanism, In1 q, In1 v, In1 alpha, In1 beta) {
    const std::size_t n = mechanism.tree.dof();
    std::vector<varpin::Dual> at_q(n), at_v(n);
    for (const auto& [array, name] : {std::pair{&q, "q"}, {&v, "v"}, {&alpha, "alpha"}, {&beta, "beta"}})
        require(*array, name, {n});
    for (std::size_t c = 0; c < n; ++c) {
        at_q[c] = {q(c), alpha(c)};
        at_v[c] = {v(c), beta(c)};
    }
    varpin::Jet<varpin::Dual> w(mechanism.tree);
    varpin::lagrangian_jet(mechanism, at_q.data(), at_v.data(), w);
    double* slopes[3] = {};
    Out out[3] = {array_for(slopes[0], {n, n}), array_for(slopes[1], {n, n}), array_for(slopes[2], {n, n})};
    const std::vector<varpin::Dual>* of[3] = {&w.M, &w.A, &w.Lqq};
    for (int i = 0; i < 3; ++i)
        std::transform(of[i]->begin(), of[i]->end(), slopes[i], [](const varpin::Dual& x) { return x.slope; });
    return {out[0], out[1], out[2]};
}

}  // namespace

NB_MODULE(_core, m) {
    m.doc() = "The compiled core.";
    nb::class_<varpin::Mechanism>(m, "Mechanism")
        .def_static("make", &mechanism_of, nb::kw_only(), "parent"_a, "prismatic"_a, "rotation"_a, "translation"_a,
                    "mass"_a, "center"_a, "inertia"_a, "coordinate"_a, "ratio"_a, "offset"_a, "origin"_a, "armature"_a,
                    "group"_a, "groups"_a, "gravity"_a, "stiffness"_a, "rest"_a)
        .def("jet", &jet, "q"_a, "v"_a)
        .def("jets", &jets, "q"_a, "v"_a)
        .def("jet_along", &jet_along, "q"_a, "v"_a, "alpha"_a, "beta"_a);
}
