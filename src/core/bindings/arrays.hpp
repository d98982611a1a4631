// Arrays at the border to Python: their types, and the check of their shapes. docs/core.md, "The map".
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <stdexcept>
#include <string>
#include <vector>

namespace varpin::border {

namespace nb = nanobind;

template <int dimensions>
using In = nb::ndarray<const double, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;
template <int dimensions>
using InOut = nb::ndarray<double, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;
template <int dimensions>
using Integers = nb::ndarray<const std::int64_t, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;
template <int dimensions>
using IntegersInOut = nb::ndarray<std::int64_t, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;
template <int dimensions>
using Flags = nb::ndarray<const bool, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<nb::numpy, double>;
using BytesOut = nb::ndarray<nb::numpy, std::uint8_t>;

// std::invalid_argument becomes ValueError.
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

// Check of an array that may be left out: empty along its first axis, or of this shape.
template <class Array>
bool given(const Array& array, const char* name, std::initializer_list<std::size_t> shape) {
    if (array.shape(0) == 0 && *shape.begin() != 0) return false;
    require(array, name, shape);
    return true;
}

// The same of several arrays of one shape, names and arrays in turn.
inline void require_each(std::initializer_list<std::size_t>) {}
template <class Array, class... More>
void require_each(std::initializer_list<std::size_t> shape, const char* name, const Array& array, const More&... more) {
    require(array, name, shape);
    require_each(shape, more...);
}

// An array of a named tuple. It is never converted: its owner sees what is written to it, and keeps it.
template <class Array>
Array field(nb::handle record, const char* name) {
    Array array;
    if (!nb::try_cast(record.attr(name), array, false))
        throw nb::type_error((std::string(name) + " is no contiguous array of the right kind").c_str());
    return array;
}

// Its numbers, of this shape.
template <class Array>
auto field(nb::handle record, const char* name, std::initializer_list<std::size_t> shape) {
    const Array array = field<Array>(record, name);
    require(array, name, shape);
    return array.data();
}

// The same of an array that may be left out, empty along its first axis; null then.
template <class Array>
auto optional_field(nb::handle record, const char* name, std::initializer_list<std::size_t> shape) {
    return field<Array>(record, name).shape(0) == 0 ? nullptr : field<Array>(record, name, shape);
}

// The numbers n of coordinates and N of rows of arrays (N, n), names and arrays in turn.
struct Rows {
    std::size_t n, N;
};
template <class Model, class... More>
Rows rows_of(const Model& model, const char* name, const In<2>& first, const More&... more) {
    const Rows rows{static_cast<std::size_t>(model.dof()), first.shape(0)};
    require_each({rows.N, rows.n}, name, first, more...);
    return rows;
}

// A NumPy array of zeros, to be filled in.
inline Out array_for(std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (std::size_t length : shape) size *= length;
    auto* values = new double[size]();
    nb::capsule owner(values, [](void* held) noexcept { delete[] static_cast<double*>(held); });
    return Out(values, shape, owner);
}

// The numbers of an array.
template <class Array>
std::vector<double> copied(const Array& array) {
    return {array.data(), array.data() + array.size()};
}

// A NumPy array that owns a copy of some bytes.
inline BytesOut array_of(const std::vector<std::uint8_t>& bytes) {
    auto* copy = new std::vector<std::uint8_t>(bytes);
    nb::capsule owner(copy, [](void* held) noexcept { delete static_cast<std::vector<std::uint8_t>*>(held); });
    return BytesOut(copy->data(), {copy->size()}, owner);
}

// A NumPy array that owns a copy of some numbers.
inline Out array_of(const double* values, std::initializer_list<std::size_t> shape) {
    Out out = array_for(shape);
    std::copy(values, values + out.size(), out.data());
    return out;
}

}  // namespace varpin::border
