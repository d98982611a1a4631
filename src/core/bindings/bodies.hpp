// Bodies with their joints from Python arrays, and rotations as row-major NumPy arrays. docs/core.md, "The map".
#pragma once

#include <stdexcept>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "varpin/tree.hpp"

namespace varpin::border {

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

// Bodies with the data of their joints, but without inertia; n coordinates.
inline std::vector<Body> jointed_bodies(const Integers<1>& parent, const Integers<1>& prismatic, const In<3>& rotation,
                                        const In<2>& translation, const Integers<1>& coordinate, const In<1>& ratio,
                                        const In<1>& offset, std::size_t n) {
    const std::size_t bodies = parent.shape(0);
    require_each({bodies}, "prismatic", prismatic, "coordinate", coordinate);
    require_each({bodies}, "ratio", ratio, "offset", offset);
    require(rotation, "rotation", {bodies, 3, 3});
    require(translation, "translation", {bodies, 3});
    std::vector<Body> out(bodies);
    for (std::size_t j = 0; j < bodies; ++j) {
        if (parent(j) < -1 || parent(j) >= static_cast<std::int64_t>(j))
            throw std::invalid_argument("parents must come before their children");
        if (coordinate(j) < 0 || coordinate(j) >= static_cast<std::int64_t>(n))
            throw std::invalid_argument("a body's coordinate is out of range");
        Body& link = out[j];
        link.parent = static_cast<int>(parent(j));
        link.prismatic = prismatic(j) != 0;
        link.rotation = rotation_at(rotation.data() + 9 * j);
        link.translation = {translation(j, 0), translation(j, 1), translation(j, 2)};
        link.coordinate = static_cast<int>(coordinate(j));
        link.ratio = ratio(j);
        link.offset = offset(j);
    }
    return out;
}

}  // namespace varpin::border
