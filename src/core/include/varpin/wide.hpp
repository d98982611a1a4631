// Whether the processor has vectors of four numbers. Functions that profit are compiled twice from one inlined
// function, without fused multiply-add: identical results with half the instructions of vectors of two.
// docs/core.md, "Processors".
#pragma once

#if defined(__x86_64__) && defined(__GNUC__)
#include <cpuid.h>
#endif

namespace varpin {

#if defined(__x86_64__) && defined(__GNUC__)

namespace detail {

// Whether processor and system have AVX2.
inline bool find_wide() {
    unsigned a = 0, b = 0, c = 0, d = 0;
    constexpr unsigned saved = 1u << 27, avx = 1u << 28, avx2 = 1u << 5;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & saved) == 0 || (c & avx) == 0) return false;
    unsigned low = 0, high = 0;
    __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    if ((low & 6u) != 6u) return false;
    return __get_cpuid_count(7, 0, &a, &b, &c, &d) && (b & avx2) != 0;
}

}  // namespace detail

inline bool has_wide() {
    static const bool wide = detail::find_wide();
    return wide;
}

#endif

}  // namespace varpin
