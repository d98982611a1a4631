// Two numbers in one vector register, and four in one or two. Compilers vectorize long loops by themselves, but not the
// short loops over the entries of a six-vector or a row of a small matrix. docs/mathematics.md, "Linear in the number
// of joints".
#pragma once

namespace varpin {

#if defined(__GNUC__)

// Without alignment beyond that of double.
typedef double Pair __attribute__((vector_size(16), aligned(8), may_alias));

inline Pair pair_at(const double* x) { return *reinterpret_cast<const Pair*>(x); }
inline void put_pair(Pair a, double* x) { *reinterpret_cast<Pair*>(x) = a; }

// Functions take and return references, since how four numbers are passed depends on the processor.
typedef double Quad __attribute__((vector_size(32), aligned(8), may_alias));

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

struct Quad {
    double values[4];
};

inline Quad operator+(const Quad& a, const Quad& b) {
    return {
        {a.values[0] + b.values[0], a.values[1] + b.values[1], a.values[2] + b.values[2], a.values[3] + b.values[3]}};
}
inline Quad operator*(const Quad& a, const Quad& b) {
    return {
        {a.values[0] * b.values[0], a.values[1] * b.values[1], a.values[2] * b.values[2], a.values[3] * b.values[3]}};
}
inline Quad& operator+=(Quad& a, const Quad& b) { return a = a + b; }

#endif

inline Quad& quad_at(double* x) { return *reinterpret_cast<Quad*>(x); }
inline const Quad& quad_at(const double* x) { return *reinterpret_cast<const Quad*>(x); }

}  // namespace varpin
