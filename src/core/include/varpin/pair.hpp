// Two numbers in one vector register. Compilers vectorize long loops by themselves, but not the short loops over the
// entries of a six-vector. docs/mathematics.md, "Linear in the number of joints".
#pragma once

namespace varpin {

#if defined(__GNUC__)

// Without alignment beyond that of double.
typedef double Pair __attribute__((vector_size(16), aligned(8), may_alias));

inline Pair pair_at(const double* x) { return *reinterpret_cast<const Pair*>(x); }
inline void put_pair(Pair a, double* x) { *reinterpret_cast<Pair*>(x) = a; }

#else

struct Pair {
    double values[2];
    double operator[](int k) const { return values[k]; }
};

inline Pair operator+(Pair a, Pair b) { return {{a[0] + b[0], a[1] + b[1]}}; }
inline Pair operator-(Pair a, Pair b) { return {{a[0] - b[0], a[1] - b[1]}}; }
inline Pair operator*(Pair a, Pair b) { return {{a[0] * b[0], a[1] * b[1]}}; }
inline Pair pair_at(const double* x) { return {{x[0], x[1]}}; }
inline void put_pair(Pair a, double* x) { x[0] = a[0], x[1] = a[1]; }

#endif

}  // namespace varpin
