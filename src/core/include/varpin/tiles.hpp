// Products of small matrices in tiles of 4 x 4 entries, whose sums stay in registers. Matrices are padded with zeros to
// whole tiles, so that products have no remaining rows or columns.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "varpin/wide.hpp"

namespace varpin {

constexpr int tile = 4;

class TiledMatrix {
  public:
    TiledMatrix(int rows, int columns)
        : stride_(padded(columns)), values_(static_cast<std::size_t>(padded(rows)) * stride_) {}

    double* operator[](int i) { return values_.data() + i * stride_; }
    const double* operator[](int i) const { return values_.data() + i * stride_; }
    int stride() const { return stride_; }
    void clear() { std::fill(values_.begin(), values_.end(), 0.0); }

  private:
    static int padded(int size) { return (size + tile - 1) / tile * tile; }

    int stride_;
    std::vector<double> values_;
};

enum class Part { all, upper };  // upper: the tiles on and above the diagonal

namespace detail {

// One tile of out += a'b, over `depth` rows.
[[gnu::always_inline]] inline void add_tile(const double* __restrict a, int a_stride, const double* __restrict b,
                                            int b_stride, int depth, double* __restrict out, int out_stride) {
    double sum[tile][tile] = {};
    for (int l = 0; l < depth; ++l, a += a_stride, b += b_stride) {
        for (int r = 0; r < tile; ++r) {
            for (int c = 0; c < tile; ++c) sum[r][c] += a[r] * b[c];
        }
    }
    for (int r = 0; r < tile; ++r) {
        for (int c = 0; c < tile; ++c) out[r * out_stride + c] += sum[r][c];
    }
}

[[gnu::always_inline]] inline void add_tiles(const TiledMatrix& a, const TiledMatrix& b, int depth, TiledMatrix& out,
                                             int rows, Part part) {
    const int columns = std::min(b.stride(), out.stride());
    for (int i = 0; i < rows; i += tile) {
        for (int j = part == Part::upper ? i : 0; j < columns; j += tile)
            add_tile(a[0] + i, a.stride(), b[0] + j, b.stride(), depth, out[i] + j, out.stride());
    }
}

#if defined(__x86_64__) && defined(__GNUC__)
// The same sums four at a time: no other bytes, and half the instructions.
[[gnu::target("avx2")]] inline void add_wide_tiles(const TiledMatrix& a, const TiledMatrix& b, int depth,
                                                   TiledMatrix& out, int rows, Part part) {
    add_tiles(a, b, depth, out, rows, part);
}
#endif

}  // namespace detail

// The leading `rows` rows of out += a'b, over the leading `depth` rows of a and b, for the columns that both have.
inline void add_transposed_product(const TiledMatrix& a, const TiledMatrix& b, int depth, TiledMatrix& out, int rows,
                                   Part part = Part::all) {
#if defined(__x86_64__) && defined(__GNUC__)
    if (has_wide()) return detail::add_wide_tiles(a, b, depth, out, rows, part);
#endif
    detail::add_tiles(a, b, depth, out, rows, part);
}

// Copy the upper triangle to the lower one.
inline void mirror(TiledMatrix& a, int size) {
    for (int i = 1; i < size; ++i) {
        for (int j = 0; j < i; ++j) a[i][j] = a[j][i];
    }
}

}  // namespace varpin
