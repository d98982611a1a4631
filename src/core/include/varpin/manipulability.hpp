// Yoshikawa's manipulability of some rows of a Jacobian, w = sqrt(det(J J')) of J (d, n), and its slope dw/dJ.
// docs/mathematics.md, "Costs in the task".
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace varpin {

// J = L Q by Householder transformations, L (d, d) lower triangular: w = |det L|, and dw/dJ is the cofactor matrix of L
// times Q, times the sign of det L. Cofactors are also valid where J is singular.
class Manipulability {
  public:
    // Allocate for at most `rows` rows with `columns` entries, rows <= columns.
    void allocate(int rows, int columns) {
        const std::size_t size = static_cast<std::size_t>(rows) * static_cast<std::size_t>(columns);
        if (L_.size() >= size) return;
        for (std::vector<double>* array : {&L_, &normals_, &slope_}) array->resize(size);
    }

    // w of the rows `chosen` of a Jacobian (6, n).
    double measure(const double* jacobian, const std::vector<int>& chosen, int n) {
        rows_ = static_cast<int>(chosen.size());
        columns_ = n;
        for (int i = 0; i < rows_; ++i) std::copy_n(jacobian + chosen[i] * n, n, L_.begin() + i * n);
        determinant_ = 1.0;
        for (int k = 0; k < rows_; ++k) determinant_ *= reflect(k);
        return std::abs(determinant_);
    }

    // dw/dJ (d, n) at the last Jacobian of `measure`.
    const double* slope() {
        for (int r = 0; r < rows_; ++r) cofactors(r);
        for (int k = rows_ - 1; k >= 0; --k)
            for (int r = 0; r < rows_; ++r) apply(k, slope_.data() + r * columns_);
        return slope_.data();
    }

  private:
    int rows_ = 0, columns_ = 0;
    double determinant_ = 0.0;
    std::vector<double> L_, normals_, slope_;  // (d, n); normals of the reflections have length sqrt(2)

    // Reflects row k onto its diagonal entry, which is returned.
    double reflect(int k) {
        double* row = L_.data() + k * columns_;
        double* normal = normals_.data() + k * columns_;
        double square = 0.0;
        for (int c = k; c < columns_; ++c) square += row[c] * row[c];
        const double length = std::sqrt(square), end = row[k] > 0.0 ? -length : length;
        std::copy_n(row, columns_, normal);
        std::fill(normal, normal + k, 0.0);
        normal[k] -= end;
        // |own - end e_k|^2 / 2
        const double half = length * (length + std::abs(row[k])), scale = half > 0.0 ? 1.0 / std::sqrt(half) : 0.0;
        for (int c = k; c < columns_; ++c) normal[c] *= scale;
        for (int i = k + 1; i < rows_; ++i) apply(k, L_.data() + i * columns_);
        row[k] = end;
        return end;
    }

    // Apply reflection k to a row.
    void apply(int k, double* row) const {
        const double* normal = normals_.data() + k * columns_;
        double along = 0.0;
        for (int c = k; c < columns_; ++c) along += normal[c] * row[c];
        for (int c = k; c < columns_; ++c) row[c] -= along * normal[c];
    }

    double at(int i, int k) const { return L_[i * columns_ + k]; }

    // Row r of the cofactors of L, times the sign of det L: L x = det(L) e_r by substitution, without divisions, since
    // the quotients cancel with factors of the determinant.
    void cofactors(int r) {
        double* x = slope_.data() + r * columns_;
        std::fill(x, x + columns_, 0.0);
        double before = determinant_ < 0.0 ? -1.0 : 1.0;
        for (int s = 0; s < r; ++s) before *= at(s, s);
        x[r] = 1.0;
        for (int c = r + 1; c < rows_; ++c) {
            double sum = 0.0;
            for (int k = r; k < c; ++k) sum = sum * at(k, k) + at(c, k) * x[k];
            x[c] = -sum;
        }
        double after = before;
        for (int c = rows_ - 1; c >= r; --c) {
            x[c] *= after;
            after *= at(c, c);
        }
    }
};

}  // namespace varpin
