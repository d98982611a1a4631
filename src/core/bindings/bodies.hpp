// Bodies with their joints from Python arrays, and rotations as row-major NumPy arrays. docs/core.md, "The map".
#pragma once

#include <stdexcept>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "varpin/tree.hpp"

namespace varpin::border {

inline Vec3<double> vector_at(const double* x) { return {x[0], x[1], x[2]}; }

inline Mat3<double> rotation_at(const double* rows) {
    return {{rows[0], rows[3], rows[6]}, {rows[1], rows[4], rows[7]}, {rows[2], rows[5], rows[8]}};
}

inline void write(const Vec3<double>& a, double* values) {
    values[0] = a.x;
    values[1] = a.y;
    values[2] = a.z;
}

inline void write(const Mat3<double>& R, double* rows) {
    const Mat3<double> t = transposed(R);
    write(t.x, rows);
    write(t.y, rows + 3);
    write(t.z, rows + 6);
}

// The bodies of a tree of n coordinates, the Python named tuple Tree.
inline std::vector<Body> bodies_of(nb::handle tree, std::size_t n) {
    const auto parent = field<Integers<1>>(tree, "parent");
    const std::size_t count = parent.shape(0);
    const auto integers = [&](const char* name) { return field<Integers<1>>(tree, name, {count}); };
    const auto numbers = [&](const char* name) { return field<In<1>>(tree, name, {count}); };
    const auto vectors = [&](const char* name) { return field<In<2>>(tree, name, {count, 3}); };
    const std::int64_t *prismatic = integers("prismatic"), *coordinate = integers("coordinate"),
                       *origin = integers("origin");
    const double *ratio = numbers("ratio"), *offset = numbers("offset"), *mass = numbers("mass");
    const double *translation = vectors("translation"), *center = vectors("center");
    const double *rotation = field<In<3>>(tree, "rotation", {count, 3, 3}),
                 *inertia = field<In<2>>(tree, "inertia", {count, 6});
    std::vector<Body> out;
    for (std::size_t j = 0; j < count; ++j, rotation += 9, translation += 3, center += 3, inertia += 6) {
        if (parent(j) < -1 || parent(j) >= static_cast<std::int64_t>(j))
            throw std::invalid_argument("parents must come before their children");
        if (coordinate[j] < 0 || coordinate[j] >= static_cast<std::int64_t>(n))
            throw std::invalid_argument("a body's coordinate is out of range");
        if (origin[j] == 0 && parent(j) < 0) throw std::invalid_argument("a root must be an origin");
        out.push_back({.parent = static_cast<int>(parent(j)),
                       .prismatic = prismatic[j] != 0,
                       .rotation = rotation_at(rotation),
                       .translation = vector_at(translation),
                       .mass = mass[j],
                       .center = vector_at(center),
                       .inertia = {inertia[0], inertia[1], inertia[2], inertia[3], inertia[4], inertia[5]},
                       .coordinate = static_cast<int>(coordinate[j]),
                       .ratio = ratio[j],
                       .offset = offset[j],
                       .origin = origin[j] != 0});
    }
    return out;
}

}  // namespace varpin::border
