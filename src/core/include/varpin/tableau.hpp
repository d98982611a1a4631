// Collocation over a step of unit length. docs/mathematics.md, "Higher order". With s stages, Q_i = q0 + h sum_j a_ij
// V_j and the momentum equation of stage i weighted with abar (L_q) and f (forces):
//
//     L_v(Q_i, V_i) = p0 + h sum_j (abar_ij L_q + f_ij F)(Q_j, V_j)
//     q1 = q0 + h sum_i b_i V_i,    p1 = p0 + h sum_i b_i (L_q + F)(Q_i, V_i)
//
// Gauss and Radau IIA: a = abar = f. The midpoint rule: a = alpha, abar = 1 - alpha, f = 1/2.
#pragma once

#include <algorithm>
#include <vector>

namespace varpin {

struct Tableau {
    int stages = 0;
    std::vector<double> a;          // (s, s)
    std::vector<double> gradient;   // (s, s) abar
    std::vector<double> force;      // (s, s) f
    std::vector<double> b;          // (s)
    std::vector<double> c;          // (s)
    std::vector<double> ahead;      // (s, s + 1) extrapolation from the stages and end of a step to the next stages
    double reach = 0.0;             // the largest Rayleigh quotient of abar a in the metric of b
    double skew = 0.0;              // alpha - 1/2 of the midpoint rule; the order is 2 only where it is zero
    bool stiffly_accurate = false;  // the last stage is the end of the step; damping faster than the step decays

    // The Lagrange polynomial of stage j at a time in units of the step.
    double lagrange(int j, double at) const {
        double value = 1.0;
        for (int k = 0; k < stages; ++k) {
            if (k != j) value *= (at - c[k]) / (c[j] - c[k]);
        }
        return value;
    }
};

// Rows (s, n) at the stages of the part of a step at `begin` with length `share`, both in units of the step, from the
// polynomial through the rows `given` (s, n) at the stages of the whole step.
inline void bring_to_part(const Tableau& tableau, int n, const double* given, double begin, double share, double* out) {
    for (int i = 0; i < tableau.stages; ++i) {
        const double at = begin + share * tableau.c[i];
        std::fill(out + i * n, out + (i + 1) * n, 0.0);
        for (int j = 0; j < tableau.stages; ++j) {
            const double part = tableau.lagrange(j, at);
            for (int c = 0; c < n; ++c) out[i * n + c] += part * given[j * n + c];
        }
    }
}

}  // namespace varpin
