// Two numbers in one vector register, and four in one or two; whether the processor has vectors of four; and products
// of small matrices in tiles of 4 x 4 entries, whose sums stay in registers. Compilers vectorize long loops by
// themselves, but not the short loops over the entries of a six-vector or a row of a small matrix. The products are
// inlined into a function that is compiled for both kinds of processor (backward.hpp), without fused multiply-add:
// identical results, with half the instructions of vectors of two. docs/core.md, "Processors".
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#if defined(__x86_64__)
#include <cpuid.h>
#endif

namespace varpin {

#if !defined(__GNUC__)
#error "varpin needs GCC or Clang, whose vectors of numbers it uses"
#endif

// Without alignment beyond that of double.
typedef double Pair __attribute__((vector_size(16), aligned(8), may_alias));

inline Pair pair_at(const double* x) { return *reinterpret_cast<const Pair*>(x); }
inline void put_pair(Pair a, double* x) { *reinterpret_cast<Pair*>(x) = a; }

// Functions take and return references, since how four numbers are passed depends on the processor.
typedef double Quad __attribute__((vector_size(32), aligned(8), may_alias));

inline Quad& quad_at(double* x) { return *reinterpret_cast<Quad*>(x); }
inline const Quad& quad_at(const double* x) { return *reinterpret_cast<const Quad*>(x); }

// Whether processor and system have AVX2.
inline bool has_avx2() {
#if defined(__x86_64__)
    static const bool found = [] {
        unsigned a = 0, b = 0, c = 0, d = 0, low = 0, high = 0;
        constexpr unsigned saved = 1u << 27, avx = 1u << 28, avx2 = 1u << 5;
        if (!__get_cpuid(1, &a, &b, &c, &d) || (c & saved) == 0 || (c & avx) == 0) return false;
        __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
        return (low & 6u) == 6u && __get_cpuid_count(7, 0, &a, &b, &c, &d) && (b & avx2) != 0;
    }();
    return found;
#else
    return false;
#endif
}

// Matrices are padded with zeros to whole tiles, so that products have no remaining rows or columns.
constexpr int tile = 4;

class TiledMatrix {
  public:
    TiledMatrix(int rows, int columns)
        : stride_(padded(columns)), values_(static_cast<std::size_t>(padded(rows)) * stride_) {}

    double* operator[](int i) { return values_.data() + i * stride_; }
    const double* operator[](int i) const { return values_.data() + i * stride_; }
    int stride() const { return stride_; }
    void clear() { std::fill(values_.begin(), values_.end(), 0.0); }

    static int padded(int size) { return (size + tile - 1) / tile * tile; }

  private:
    int stride_;
    std::vector<double> values_;
};

enum class Part { all, upper };  // upper: the tiles on and above the diagonal, of no more rows than columns

// Rows begin .. end; of a number, that many leading rows.
struct Range {
    Range(int count) : end(count) {}
    Range(int first, int last) : begin(first), end(last) {}

    int begin = 0, end;
};

namespace detail {

// `rows` rows and one tile of columns of out = a'b, or of out += a'b, over `depth` rows of a and b.
template <bool adds, int rows>
[[gnu::always_inline]] inline void find_block(const double* __restrict a, int a_stride, const double* __restrict b,
                                              int b_stride, int depth, double* __restrict out, int out_stride) {
    Quad sum[rows] = {};
    for (int l = 0; l < depth; ++l, a += a_stride, b += b_stride) {
        const Quad& row = quad_at(b);
        for (int r = 0; r < rows; ++r) sum[r] += Quad{a[r], a[r], a[r], a[r]} * row;
    }
    for (int r = 0; r < rows; ++r) {
        Quad& entries = quad_at(out + r * out_stride);
        entries = adds ? entries + sum[r] : sum[r];
    }
}

// Two rows of tiles at a time: as many sums as hide the time that an addition takes.
template <bool adds>
[[gnu::always_inline]] inline void find_tiles(const TiledMatrix& a, const TiledMatrix& b, Range range, TiledMatrix& out,
                                              int rows, Part part) {
    const int columns = std::min(b.stride(), out.stride()), depth = range.end - range.begin;
    const double *top_a = a[range.begin], *top_b = b[range.begin];
    const auto one = [&](int i, int j) {
        find_block<adds, tile>(top_a + i, a.stride(), top_b + j, b.stride(), depth, out[i] + j, out.stride());
    };
    int i = 0;
    for (; i + tile < rows; i += 2 * tile) {
        int j = 0;
        if (part == Part::upper) {
            one(i, i);
            j = i + tile;
        }
        for (; j < columns; j += tile)
            find_block<adds, 2 * tile>(top_a + i, a.stride(), top_b + j, b.stride(), depth, out[i] + j, out.stride());
    }
    for (; i < rows; i += tile) {
        for (int j = part == Part::upper ? i : 0; j < columns; j += tile) one(i, j);
    }
}

}  // namespace detail

// The leading `rows` rows of out += a'b, over the rows of a and b in `range`, for the columns that both have.
[[gnu::always_inline]] inline void add_transposed_product(const TiledMatrix& a, const TiledMatrix& b, Range range,
                                                          TiledMatrix& out, int rows, Part part = Part::all) {
    detail::find_tiles<true>(a, b, range, out, rows, part);
}

// The same of out = a'b: whatever was there is gone.
[[gnu::always_inline]] inline void transposed_product(const TiledMatrix& a, const TiledMatrix& b, Range range,
                                                      TiledMatrix& out, int rows, Part part = Part::all) {
    detail::find_tiles<false>(a, b, range, out, rows, part);
}

namespace detail {

// Sums of `tiles` tiles from column c on, in registers.
template <int tiles>
[[gnu::always_inline]] inline void add_rows_at(int c, const double* __restrict factor, const TiledMatrix& a,
                                               Range range, double* __restrict out) {
    Quad sum[tiles];
    for (int k = 0; k < tiles; ++k) sum[k] = quad_at(out + c + tile * k);
    const double* row = a[range.begin] + c;
    for (int i = range.begin; i < range.end; ++i, row += a.stride()) {
        const Quad all{factor[i], factor[i], factor[i], factor[i]};
        for (int k = 0; k < tiles; ++k) sum[k] += all * quad_at(row + tile * k);
    }
    for (int k = 0; k < tiles; ++k) quad_at(out + c + tile * k) = sum[k];
}

}  // namespace detail

// out += sum_i factor_i a_i over the rows of a in `range`, one after another; out has whole tiles.
[[gnu::always_inline]] inline void add_rows(const double* __restrict factor, const TiledMatrix& a, Range range,
                                            double* __restrict out, int columns) {
    int c = 0;
    for (; c + 3 * tile < columns; c += 4 * tile) detail::add_rows_at<4>(c, factor, a, range, out);
    for (; c + tile < columns; c += 2 * tile) detail::add_rows_at<2>(c, factor, a, range, out);
    if (c < columns) detail::add_rows_at<1>(c, factor, a, range, out);
}

// Copy the upper triangle to the lower one, in these rows.
inline void mirror(TiledMatrix& a, Range rows) {
    const int stride = a.stride();
    for (int i = rows.begin; i < rows.end; ++i) {
        double* row = a[i];
        const double* above = a[0] + i;
        for (int j = 0; j < i; ++j) row[j] = above[j * stride];
    }
}

}  // namespace varpin
