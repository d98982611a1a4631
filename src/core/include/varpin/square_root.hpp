// The backward pass on a square root of the value's Hessian, for problems in which the plain recursion loses all
// digits. docs/mathematics.md, "Digits"; equation (O3). The value is a sum of squares (1/2) |R x + r|^2, and so is the
// cost to go from a step in (u, x), whose rows an orthogonal transformation brings to
//
//     ( R_uu  R_ux  r_u )        K = -R_uu^-1 R_ux,  k = -R_uu^-1 r_u,
//     (   0   R_xx  r_x )        and the last rows are the value before the step.
//
// Every Hessian must be positive semidefinite; the part of a gradient outside its range is stored separately.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include "varpin/steps.hpp"

namespace varpin {

// Convex quadratic functions (1/2) |L z + r|^2 + c . z, up to constants.
struct Squares {
    const double* root = nullptr;  // L (N, z, z), or one for all functions
    bool one_root = false;
    const double* shift = nullptr;   // r (N, z)
    const double* linear = nullptr;  // c (N, z)

    const double* root_of(std::ptrdiff_t point, int size) const { return one_root ? root : root + point * size * size; }
};

// Overwrites a (rows, columns) so that its first `leading` columns are triangular, leading <= min(rows, columns). The
// signs of rows are arbitrary. `work` is (columns).
//
// The row with the largest entry in a column is the pivot row. Otherwise a large row with a zero there would destroy
// digits of small rows (Powell and Reid, "On applying Householder transformations to linear least squares problems",
// 1969).
inline void triangularize(double* a, int rows, int columns, int leading, double* __restrict work) {
    for (int k = 0; k < leading; ++k) {
        int best = k;
        for (int i = k + 1; i < rows; ++i) {
            if (std::abs(a[i * columns + k]) > std::abs(a[best * columns + k])) best = i;
        }
        const double largest = std::abs(a[best * columns + k]);
        if (!(largest > 0.0)) continue;
        double total = 0.0;
        for (int i = k; i < rows; ++i) {
            const double part = a[i * columns + k] / largest;
            total += part * part;
        }
        double* __restrict top = a + k * columns;
        if (best != k) std::swap_ranges(top, top + columns, a + best * columns);
        const double norm = largest * std::sqrt(total);
        const double end = top[k] > 0.0 ? -norm : norm;
        // The vector of the reflection, scaled by its first entry, is (1, w) with length^2 = 2 norm / (norm + |a_kk|).
        const double first = top[k] - end, factor = (norm + std::abs(top[k])) / norm;
        for (int j = k + 1; j < columns; ++j) work[j] = top[j];
        for (int i = k + 1; i < rows; ++i) {
            double* __restrict row = a + i * columns;
            row[k] /= first;
            const double entry = row[k];
            if (entry == 0.0) continue;
            for (int j = k + 1; j < columns; ++j) work[j] += entry * row[j];
        }
        for (int j = k + 1; j < columns; ++j) {
            work[j] *= factor;
            top[j] -= work[j];
        }
        for (int i = k + 1; i < rows; ++i) {
            double* __restrict row = a + i * columns;
            const double entry = row[k];
            row[k] = 0.0;
            if (entry == 0.0) continue;
            for (int j = k + 1; j < columns; ++j) row[j] -= entry * work[j];
        }
        top[k] = end;
    }
}

// A stack of rows of equal length.
class RowStack {
  public:
    void reset(int width) {
        width_ = width;
        rows_ = 0;
    }
    int rows() const { return rows_; }
    int width() const { return width_; }
    double* operator[](int i) { return values_.data() + i * width_; }
    const double* operator[](int i) const { return values_.data() + i * width_; }

    // Append a row of zeros. Pointers to earlier rows become invalid.
    double* push() {
        const auto end = static_cast<std::size_t>(rows_ + 1) * width_;
        if (values_.size() < end) values_.resize(end);
        double* row = (*this)[rows_++];
        std::fill_n(row, width_, 0.0);
        return row;
    }

    // Make the leading columns triangular by an orthogonal transformation; appends rows of zeros up to `leading` rows.
    void triangularize(int leading) {
        while (rows_ < leading) push();
        work_.resize(width_);
        varpin::triangularize(values_.data(), rows_, width_, leading, work_.data());
    }

  private:
    int rows_ = 0, width_ = 0;
    std::vector<double> values_, work_;
};

// The recursion of the backward pass on R and r of (O3), from the last step to the first.
class RootPass {
  public:
    // Starts from the terminal cost in x (2n), and its gradient.
    RootPass(int dof, int controls, const Squares& terminal, const double* terminal_gradient)
        : n(dof), m(controls), x(2 * dof), size(2 * dof + controls), step(dof, controls) {
        root.reset(size + 1);
        for (int i = 0; i < x; ++i) {
            double* row = root.push();
            std::copy_n(terminal.root + i * x, x, row);
            row[size] = terminal.shift[i];
            linear[i] = terminal.linear[i];
            costate[i] = terminal_gradient[i];
        }
        column_norms(root, 0, scale.data(), x);
    }

    // A pass over a block of steps, as BackwardPass::run, with their running costs.
    std::ptrdiff_t run(double h, int hold, double regularization, const ExpandedSteps& steps, const Squares& running,
                       const Gains& gains) {
        for (std::ptrdiff_t s = steps.steps - 1; s >= 0; --s) {
            stack.reset(size + 1);
            carry(steps, s, (s + 1) % hold != 0);
            add_running_cost(h, steps, s, running);
            if (steps.processes > 0) add_noise(h, steps, s, gains.spread + s * x * x);
            linear.swap(before);
            costate.swap(gradient);
            scale.swap(terms);
            if (s % hold != 0) {
                keep();
            } else if (!decide(regularization, s / hold, gains)) {
                return s / hold;
            }
        }
        return -1;
    }

    int dof() const { return n; }
    int controls() const { return m; }

    Found found;

  private:
    // Rows of `stack` are in (u, x, shift); everything else is in (x, u).
    void add_to_row(double factor, const double* from, double* row) const {
        if (factor == 0.0) return;
        for (int c = 0; c < x; ++c) row[m + c] += factor * from[c];
        for (int c = 0; c < m; ++c) row[c] += factor * from[x + c];
    }
    void add_row(double factor, const double* from, std::vector<double>& to) const {
        for (int c = 0; c < size; ++c) to[c] += factor * from[c];
    }
    double& shift(int i) { return stack[i][size]; }

    // The value after step s as rows in (x, u); its linear part, its gradient, and the scale of its terms.
    void carry(const ExpandedSteps& steps, std::ptrdiff_t s, bool held) {
        step.load(steps, s);
        for (int i = 0; i < root.rows(); ++i) {
            double* row = stack.push();
            for (int j = 0; j < x; ++j) add_to_row(root[i][j], step.J[j], row);
            if (held) {
                for (int c = 0; c < m; ++c) row[c] += root[i][x + c];
            }
            shift(stack.rows() - 1) = root[i][size];
        }
        for (int c = 0; c < size; ++c) {
            before[c] = held && c >= x ? linear[c] : 0.0;
            gradient[c] = held && c >= x ? costate[c] : 0.0;
            terms[c] = 0.0;
        }
        for (int i = 0; i < x; ++i) {
            add_row(linear[i], step.J[i], before);
            add_row(costate[i], step.J[i], gradient);
            for (int c = 0; c < size; ++c) terms[c] += std::abs(step.J[i][c]) * scale[i];
        }
        if (!held) return;
        for (int c = x; c < size; ++c) {
            // sqrt(a^2 + b^2) without overflow; what is not a number stays so.
            const double a = terms[c], b = scale[c], larger = a >= b ? a : b, smaller = a >= b ? b : a;
            const double share = larger == 0.0 ? 0.0 : smaller / larger;
            terms[c] = larger * std::sqrt(1.0 + share * share);
        }
    }

    // Add h l(x, u) of step s.
    void add_running_cost(double h, const ExpandedSteps& steps, std::ptrdiff_t s, const Squares& running) {
        const double *L = running.root_of(s, size), factor = std::sqrt(h);
        for (int i = 0; i < size; ++i) {
            double* row = stack.push();
            add_to_row(factor, L + i * size, row);
            row[size] = factor * running.shift[s * size + i];
        }
        add_row(h, running.linear + s * size, before);
        add_row(h, steps.gradient_at(s), gradient);
    }

    // Add the terms of the noise, with rows N of S = N'N; writes S into `spread`.
    void add_noise(double h, const ExpandedSteps& steps, std::ptrdiff_t s, double* spread) {
        const double factor = std::sqrt(h);
        noise_root.reset(x);
        for (int i = 0; i < root.rows(); ++i) {
            double* row = noise_root.push();
            for (int c = 0; c < x; ++c) row[c] = factor * root[i][c];
        }
        noise_root.triangularize(x);
        std::fill_n(spread, x * x, 0.0);
        for (int l = 0; l < x; ++l) {
            for (int i = 0; i < x; ++i) {
                for (int j = 0; j < x; ++j) spread[i * x + j] += noise_root[l][i] * noise_root[l][j];
            }
        }
        for (int w = 0; w < steps.processes; ++w) {
            const bool depends = step.read_process(steps, s, w);
            for (int i = 0; i < x; ++i) {
                double jump = 0.0;
                for (int j = 0; j < x; ++j) jump += noise_root[i][j] * step.jump[j];
                found.noise += 0.5 * jump * jump;
                if (!depends) continue;
                double* row = stack.push();
                for (int j = 0; j < x; ++j) {
                    add_to_row(noise_root[i][j], step.F[j], row);
                    add_row(jump * noise_root[i][j], step.F[j], gradient);
                }
                shift(stack.rows() - 1) = jump;
            }
        }
    }

    // The value before a step whose control is held: the rows themselves.
    void keep() {
        stack.triangularize(size);
        root.reset(size + 1);
        for (int i = 0; i < size; ++i) {
            double* row = root.push();
            std::copy_n(stack[i] + m, x, row);
            std::copy_n(stack[i], m, row + x);
            row[size] = shift(i);
        }
    }

    // Gains of decision r, and the value under them; false if there is no minimum.
    bool decide(double regularization, std::ptrdiff_t r, const Gains& gains) {
        column_norms(stack, 0, control_norm.data(), m);
        column_norms(stack, m, terms.data(), x);
        stack.triangularize(size);
        if (!std::all_of(stack[0], stack[size],
                         [](double entry) { return std::abs(entry) < std::numeric_limits<double>::infinity(); }))
            return false;
        const double largest = m > 0 ? *std::max_element(control_norm.begin(), control_norm.end()) : 0.0;
        if (!(largest > 0.0)) return false;
        for (int i = 0; i < m; ++i) {
            Qu[i] = linear[x + i];
            for (int l = 0; l <= i; ++l) Qu[i] += stack[l][i] * shift(l);
        }
        const bool regular = regularize(regularization, largest);
        double* k = gains.feedforward + r * m;
        if (!note_loss()) return false;
        solve(k);
        for (int i = 0; i < m; ++i) {
            std::copy_n(&K[i * x], x, gains.feedback + (r * m + i) * x);
            gains.control_gradient[r * m + i] = costate[x + i];
            Ruu_k[i] = 0.0;
            for (int j = i; j < m; ++j) Ruu_k[i] += stack[i][j] * k[j];
            found.slope += Qu[i] * k[i];
            found.curvature += Ruu_k[i] * Ruu_k[i];
        }
        if (gains.factors) write_factors(gains.factors + r * m * m);
        // The rest of the controls' rows is zero up to rounding where they are as they were.
        minimized_value(!regular);
        set_linear_before();
        return true;
    }

    // Regularize the rows of controls, each in proportion to the norm of its own column. A control without any effect
    // is not regularized, if there are others. True if there is nothing to do.
    bool regularize(double regularization, double largest) {
        bool regular = true;
        firm.reset(stack.width());
        for (int i = 0; i < m; ++i) std::copy_n(stack[i], stack.width(), firm.push());
        for (int i = 0; i < m; ++i) {
            weight[i] = is_idle(i) ? largest : std::sqrt(regularization) * control_norm[i];
            regular = regular && weight[i] == 0.0;
        }
        if (regular) return true;
        for (int i = 0; i < m; ++i) firm.push()[i] = weight[i];
        firm.triangularize(m);
        return false;
    }

    // Whether control i has no effect.
    bool is_idle(int i) const { return control_norm[i] == 0.0 && Qu[i] == 0.0; }

    // Add the rounding errors of the firm rows to the loss; false where a control has no minimum.
    bool note_loss() {
        for (int i = 0; i < m; ++i) {
            const double pivot = std::abs(firm[i][i]);
            if (!(pivot > 0.0)) return false;
            if (is_idle(i)) continue;
            found.loss = std::max(found.loss, epsilon * std::max(scale[x + i], control_norm[i]) / pivot);
        }
        return true;
    }

    // L D L' of the regularized Quu from its root.
    void write_factors(double* factors) {
        for (int i = 0; i < m; ++i) {
            factors[i * m + i] = firm[i][i] * firm[i][i];
            for (int j = i + 1; j < m; ++j) factors[j * m + i] = firm[i][j] / firm[i][i];
        }
    }

    // k and K: R_uu (k, K) = -(shift + R_uu'^-1 linear, R_ux) in the firm rows.
    void solve(double* k) {
        for (int i = 0; i < m; ++i) {
            double total = linear[x + i];
            for (int j = 0; j < i; ++j) total -= firm[j][i] * forced[j];
            forced[i] = total / firm[i][i];
        }
        for (int i = m - 1; i >= 0; --i) {
            const double* row = firm[i];
            double* __restrict gains = &K[i * x];
            double total = -row[size] - forced[i];
            for (int c = 0; c < x; ++c) gains[c] = -row[m + c];
            for (int j = i + 1; j < m; ++j) {
                const double* __restrict other = &K[j * x];
                total -= row[j] * k[j];
                for (int c = 0; c < x; ++c) gains[c] -= row[j] * other[c];
            }
            k[i] = total / row[i];
            for (int c = 0; c < x; ++c) gains[c] /= row[i];
        }
    }

    // The value before a decision: the rows without controls, and the rest of the others if `left`.
    void minimized_value(bool left) {
        root.reset(size + 1);
        for (int i = left ? 0 : m; i < size; ++i) {
            double* row = root.push();
            std::copy_n(stack[i] + m, x, row);
            row[size] = shift(i);
            if (i >= m) continue;
            for (int j = i; j < m; ++j) {
                for (int c = 0; c < x; ++c) row[c] += stack[i][j] * K[j * x + c];
            }
            row[size] += Ruu_k[i];
        }
        std::copy_n(terms.begin(), x, scale.begin());
    }

    // The linear part of the value before a decision; nothing depends on u there.
    void set_linear_before() {
        std::fill_n(before.begin(), size, 0.0);
        std::copy_n(linear.begin(), x, before.begin());
        for (int i = 0; i < m; ++i) {
            for (int c = 0; c < x; ++c) before[c] += K[i * x + c] * linear[x + i];
        }
        linear.swap(before);
        for (int c = x; c < size; ++c) costate[c] = scale[c] = 0.0;
    }

    static void column_norms(const RowStack& rows, int first, double* norms, int count) {
        std::fill_n(norms, count, 0.0);
        for (int i = 0; i < rows.rows(); ++i) {
            for (int c = 0; c < count; ++c) norms[c] += rows[i][first + c] * rows[i][first + c];
        }
        for (int c = 0; c < count; ++c) norms[c] = std::sqrt(norms[c]);
    }

    static constexpr double epsilon = std::numeric_limits<double>::epsilon();

    int n, m, x, size;  // x = 2n states, and controls
    // The value: rows (R r) in (x, u), its linear part, and as in BackwardPass:
    RowStack root;
    std::vector<double> linear = zeros(size);
    std::vector<double> costate = zeros(size);
    std::vector<double> scale = zeros(size);

    // Work arrays of a step.
    LinearStep step;
    RowStack stack;                              // rows of the cost in (u, x)
    RowStack noise_root;                         // (., x) N
    std::vector<double> before = zeros(size);    // the next `linear`
    std::vector<double> gradient = zeros(size);  // the next costate
    std::vector<double> terms = zeros(size);     // the next scale
    // Work arrays of a decision.
    RowStack firm;  // regularized rows of the controls
    std::vector<double> control_norm = zeros(m),
                        weight = zeros(m);  // norms of the controls' columns; regularization
    std::vector<double> Qu = zeros(m);      // gradient
    std::vector<double> Ruu_k = zeros(m), forced = zeros(m), K = zeros(m, x);  // R_uu k; firm'^-1 linear; (m, x)
};

}  // namespace varpin
