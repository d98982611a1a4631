// One block of a matrix is factored and solved, whatever stands around it: NaN here.
#include "varpin/dense.hpp"

#include <cmath>
#include <cstdio>
#include <limits>
#include <vector>

namespace {

constexpr int n = 9;
constexpr varpin::Block block{2, 6};
int failures = 0;

void expect(bool holds, const char* what) {
    if (holds) return;
    std::printf("%s\n", what);
    ++failures;
}

std::vector<double> matrix(bool symmetric) {
    std::vector<double> a(n * n, std::numeric_limits<double>::quiet_NaN());
    for (int i = block.begin; i < block.end; ++i) {
        for (int j = block.begin; j < block.end; ++j) {
            const int row = symmetric && j > i ? j : i, column = symmetric && j > i ? i : j;
            a[i * n + j] = std::sin(1.0 + 3.0 * row + 7.0 * column) + (i == j ? 6.0 : 0.0);
        }
    }
    return a;
}

void solved(const std::vector<double>& a, const std::vector<double>& b, const std::vector<double>& x, bool transposed,
            const char* what) {
    for (int i = 0; i < n; ++i) {
        if (i < block.begin || i >= block.end) {
            expect(x[i] == 7.0, what);
            continue;
        }
        double total = -b[i];
        for (int j = block.begin; j < block.end; ++j) total += (transposed ? a[j * n + i] : a[i * n + j]) * x[j];
        expect(std::abs(total) < 1e-13, what);
    }
}

void untouched(const std::vector<double>& a, const std::vector<double>& factors, const char* what) {
    for (int k = 0; k < n * n; ++k) expect(std::isnan(a[k]) == std::isnan(factors[k]), what);
}

}  // namespace

int main() {
    std::vector<double> b(n);
    for (int i = 0; i < n; ++i) b[i] = std::cos(2.0 * i);
    {
        const std::vector<double> a = matrix(false);
        std::vector<double> lu = a, x(n, 7.0);
        expect(varpin::factor_lu(lu.data(), n, block), "factor_lu");
        varpin::solve_lu(lu.data(), n, block, b.data(), x.data());
        solved(a, b, x, false, "solve_lu");
        untouched(a, lu, "factor_lu outside of its block");
        std::vector<double> rows(4 * 3);
        for (int i = 0; i < 4; ++i) rows[3 * i] = rows[3 * i + 1] = rows[3 * i + 2] = b[2 + i];
        varpin::solve_lu_rows(lu.data(), n, block, rows.data(), 3, 3);
        for (int k = 0; k < 12; ++k) expect(std::abs(rows[k] - x[2 + k / 3]) < 1e-14, "solve_lu_rows");
    }
    {
        const std::vector<double> a = matrix(true);
        std::vector<double> ldl = a, x(n, 7.0);
        expect(varpin::factor_ldl(ldl.data(), n, block), "factor_ldl");
        varpin::solve_ldl(ldl.data(), n, block, b.data(), x.data());
        solved(a, b, x, false, "solve_ldl");
        untouched(a, ldl, "factor_ldl outside of its block");
    }
    {
        // Rows are exchanged here.
        constexpr int m = 4;
        const double a[m * m] = {0, 2, 1, -1, 3, 0, 1, 2, 1, 1, 0, 4, -2, 5, 1, 1};
        double lu[m * m], right[m], x[m];
        int order[m];
        std::copy(a, a + m * m, lu);
        expect(varpin::factor_lu_pivoting(lu, m, order) == 1, "the sign of the determinant, 5");
        varpin::solve_lu_pivoting(lu, m, order, b.data(), x);
        for (int i = 0; i < m; ++i) {
            double total = -b[i];
            for (int j = 0; j < m; ++j) total += a[i * m + j] * x[j];
            expect(std::abs(total) < 1e-14, "solve_lu_pivoting");
        }
        std::copy(b.begin(), b.begin() + m, right);
        varpin::solve_lu_transposed(lu, m, order, right, x);
        for (int i = 0; i < m; ++i) {
            double total = -b[i];
            for (int j = 0; j < m; ++j) total += a[j * m + i] * x[j];
            expect(std::abs(total) < 1e-14, "solve_lu_transposed");
        }
        const double singular[4] = {1, 2, 2, 4};
        std::copy(singular, singular + 4, lu);
        expect(varpin::factor_lu_pivoting(lu, 2, order) == 0, "a singular matrix has no sign");
    }
    {
        const double nan = std::numeric_limits<double>::quiet_NaN();
        expect(varpin::larger(2.0, 1.0) == 2.0 && varpin::larger(1.0, 2.0) == 2.0, "larger");
        expect(std::isnan(varpin::larger(nan, 1.0)) && std::isnan(varpin::larger(1.0, nan)), "larger of NaN");
    }
    return failures;
}
