// Costs weight . r^2 at samples (q, v, u), with their gradients and Gauss-Newton Hessians 2 J' weight J in
// z = (q, v, u). docs/mathematics.md, "Costs in the task"; equations (O7) and (O8).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "varpin/kinematics.hpp"

namespace varpin {

// A frame at `offset` on the last of some bodies; or the centre of mass of all of them, which has a position only.
struct CostFrame {
    Links links;
    Placement offset;
    bool center = false;
};

// The quantity of a residual r: entries of z; their excess beyond limits; the position, orientation or twist of a
// frame; or the deficit of its manipulability.
enum class Subject { entries, excess, position, orientation, twist, manipulability };

// Number of entries of a target for a residual of some size: lower limits and then upper limits, a row-major rotation
// matrix, the least manipulability, or one number for each entry of r.
constexpr std::size_t target_width(Subject subject, std::size_t size) {
    return subject == Subject::excess ? 2 * size : subject == Subject::orientation ? 9 : size;
}

struct CostTerm {
    Subject subject = Subject::entries;
    int size = 0;                   // of r
    int index = 0;                  // the first of its entries in z, or the index of its frame
    std::vector<double> weight;     // (r, r) symmetric
    std::vector<double> target;     // (T, target_width); sample s has row s % T
    std::vector<int> directions{};  // rows of the frame's Jacobian in its manipulability
};

struct CostTerms {
    int dof = 0;
    int controls = 0;
    std::vector<CostFrame> frames;
    std::vector<CostTerm> terms;

    int size() const { return 2 * dof + controls; }
    // Whether all residuals are linear, so that the Hessian is the same at all samples.
    bool linear() const {
        return std::all_of(terms.begin(), terms.end(), [](const CostTerm& t) { return t.subject == Subject::entries; });
    }
};

// r' W r for r (size), and W r.
inline double quadratic(const double* W, const double* r, int size, double* Wr) {
    double total = 0.0;
    for (int i = 0; i < size; ++i) {
        double sum = 0.0;
        for (int k = 0; k < size; ++k) sum += W[i * size + k] * r[k];
        Wr[i] = sum;
        total += sum * r[i];
    }
    return total;
}

// Yoshikawa's manipulability of some rows of a Jacobian, w = sqrt(det(J J')) of J (d, n), and its slope dw/dJ.
//
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

// The evaluation of costs, (O7) and (O8), at single samples, with work arrays.
class CostSample {
  public:
    explicit CostSample(const CostTerms& costs)
        : costs_(costs), z_(costs.size()), frames_(costs.frames.size()), J_(6 * 2 * costs.dof), WJ_(J_.size()) {
        std::size_t most = 0, bodies = 0;
        for (std::size_t f = 0; f < frames_.size(); ++f) {
            frames_[f].jacobian.resize(6 * costs.dof);
            frames_[f].joints.resize(costs.frames[f].links.bodies.size());
            bodies = std::max(bodies, frames_[f].joints.size());
        }
        for (const CostTerm& term : costs.terms) {
            most = std::max(most, static_cast<std::size_t>(term.size));
            const bool measures = term.subject == Subject::manipulability;
            if (measures || term.subject == Subject::twist) frames_[term.index].moves = true;
            if (measures) dexterity_.allocate(static_cast<int>(term.directions.size()), costs.dof);
        }
        gives_.resize(bodies);
        loads_.resize(bodies);
        error_.resize(most);
        weighted_.resize(most);
    }

    // The value of each term at (q, v, u), with row `row` of the targets.
    void values(const double* q, const double* v, const double* u, std::size_t row, double* found) {
        evaluate(q, v, u, false);
        for (const CostTerm& term : costs_.terms) *found++ = weigh(term, row);
    }

    // Add the gradient of all terms (2n + m), and the Hessians (2n + m, 2n + m) of terms that are not linear.
    void expand(const double* q, const double* v, const double* u, std::size_t row, double* gradient, double* hessian) {
        evaluate(q, v, u, true);
        for (const CostTerm& term : costs_.terms) {
            weigh(term, row);
            if (term.subject == Subject::entries) {
                for (int i = 0; i < term.size; ++i) gradient[term.index + i] += 2.0 * weighted_[i];
                continue;
            }
            if (term.subject == Subject::excess) {
                add_excess(term, gradient, hessian);
                continue;
            }
            // Without a deficit the gradient is zero, too.
            if (term.subject == Subject::manipulability && error_[0] == 0.0) continue;
            const int columns = term.subject == Subject::twist ? 2 * costs_.dof : costs_.dof;
            differentiate(term, columns);
            for (int i = 0; i < term.size; ++i) {
                const double* __restrict J = J_.data() + i * columns;
                double* __restrict WJ = WJ_.data() + i * columns;
                for (int c = 0; c < columns; ++c) gradient[c] += 2.0 * weighted_[i] * J[c];
                std::fill(WJ, WJ + columns, 0.0);
                for (int k = 0; k < term.size; ++k) {
                    const double w = 2.0 * term.weight[i * term.size + k];
                    const double* __restrict other = J_.data() + k * columns;
                    if (w == 0.0) continue;
                    for (int c = 0; c < columns; ++c) WJ[c] += w * other[c];
                }
            }
            for (int a = 0; a < columns; ++a) {
                double* __restrict to = hessian + a * costs_.size();
                for (int i = 0; i < term.size; ++i) {
                    const double slope = J_[i * columns + a];
                    const double* __restrict WJ = WJ_.data() + i * columns;
                    for (int b = 0; b < columns; ++b) to[b] += slope * WJ[b];
                }
            }
        }
    }

    // Add the Hessians (2n + m, 2n + m) of the terms on entries of z.
    void add_constant_hessian(double* hessian) const {
        for (const CostTerm& term : costs_.terms) {
            if (term.subject != Subject::entries) continue;
            for (int i = 0; i < term.size; ++i) {
                for (int k = 0; k < term.size; ++k)
                    hessian[(term.index + i) * costs_.size() + term.index + k] += 2.0 * term.weight[i * term.size + k];
            }
        }
    }

  private:
    struct FrameAt {
        Placement placement;
        std::vector<Placement> joints;
        std::vector<double> jacobian;  // (6, n)
        bool moves = false;            // whether values need the Jacobian
    };

    const CostTerms& costs_;
    std::vector<double> z_;
    std::vector<FrameAt> frames_;
    std::vector<double> J_, WJ_;  // (r, columns)
    std::vector<Motion<double>> gives_;
    std::vector<Load> loads_;
    Manipulability dexterity_;
    std::vector<double> error_, weighted_;

    void evaluate(const double* q, const double* v, const double* u, bool slopes) {
        const int n = costs_.dof;
        std::copy_n(q, n, z_.begin());
        std::copy_n(v, n, z_.begin() + n);
        std::copy_n(u, costs_.controls, z_.begin() + 2 * n);
        for (std::size_t f = 0; f < frames_.size(); ++f) {
            const auto& [links, offset, center] = costs_.frames[f];
            FrameAt& here = frames_[f];
            forward_kinematics(links, q, here.joints.data());
            if (center) {
                double* J = slopes ? here.jacobian.data() : nullptr;
                here.placement.position = center_of_mass(links, here.joints.data(), loads_.data(), J);
                continue;
            }
            here.placement = here.joints.back() * offset;
            if (slopes || here.moves)
                frame_jacobian(links, here.joints.data(), here.placement.position, here.jacobian.data());
        }
    }

    // The value r' W r of a term, with r and W r.
    double weigh(const CostTerm& term, std::size_t row) {
        residual(term, row);
        return quadratic(term.weight.data(), error_.data(), term.size, weighted_.data());
    }

    void residual(const CostTerm& term, std::size_t row) {
        const std::size_t width = target_width(term.subject, static_cast<std::size_t>(term.size));
        const double* target = term.target.data() + (row % (term.target.size() / width)) * width;
        if (term.subject == Subject::entries) {
            for (int i = 0; i < term.size; ++i) error_[i] = z_[term.index + i] - target[i];
            return;
        }
        if (term.subject == Subject::excess) {
            for (int i = 0; i < term.size; ++i) {
                const double y = z_[term.index + i], least = target[i], most = target[term.size + i];
                // y - y keeps NaN.
                error_[i] = y > most ? y - most : y < least ? y - least : y - y;
            }
            return;
        }
        const FrameAt& frame = frames_[term.index];
        if (term.subject == Subject::manipulability) {
            const double lack = target[0] - dexterity_.measure(frame.jacobian.data(), term.directions, costs_.dof);
            error_[0] = lack <= 0.0 ? 0.0 : lack;
            return;
        }
        if (term.subject == Subject::twist) {
            const int n = costs_.dof;
            for (int i = 0; i < 6; ++i) {
                double sum = 0.0;
                for (int c = 0; c < n; ++c) sum += frame.jacobian[i * n + c] * z_[n + c];
                error_[i] = sum - target[i];
            }
            return;
        }
        Vec3<double> r = frame.placement.position - Vec3<double>{target[0], target[1], target[2]};
        if (term.subject == Subject::orientation) {
            // Mat3 takes columns, so the rows of the target give its transpose.
            const Mat3<double> back{{target[0], target[1], target[2]},
                                    {target[3], target[4], target[5]},
                                    {target[6], target[7], target[8]}};
            r = logarithm(back * frame.placement.rotation);
        }
        error_[0] = r.x;
        error_[1] = r.y;
        error_[2] = r.z;
    }

    // Gradient and Hessian of the excess of entries of z, whose derivative beyond the limits is one.
    void add_excess(const CostTerm& term, double* gradient, double* hessian) const {
        for (int i = 0; i < term.size; ++i) {
            if (error_[i] == 0.0) continue;
            gradient[term.index + i] += 2.0 * weighted_[i];
            double* row = hessian + (term.index + i) * costs_.size() + term.index;
            for (int k = 0; k < term.size; ++k)
                if (error_[k] != 0.0) row[k] += 2.0 * term.weight[i * term.size + k];
        }
    }

    // J (r, columns) of a term on a frame, after its residual.
    void differentiate(const CostTerm& term, int columns) {
        const FrameAt& frame = frames_[term.index];
        const int n = costs_.dof;
        if (term.subject == Subject::position) {
            std::copy_n(frame.jacobian.begin(), 3 * n, J_.begin());
        } else if (term.subject == Subject::orientation) {
            const Mat3<double> turn =
                logarithm_derivative({error_[0], error_[1], error_[2]}) * transposed(frame.placement.rotation);
            const double* angular = frame.jacobian.data() + 3 * n;
            for (int c = 0; c < n; ++c) {
                const Vec3<double> slope = turn * Vec3<double>{angular[c], angular[n + c], angular[2 * n + c]};
                J_[c] = slope.x;
                J_[n + c] = slope.y;
                J_[2 * n + c] = slope.z;
            }
        } else if (term.subject == Subject::manipulability) {
            lack_in_q(term, frame);
        } else {
            std::fill(J_.begin(), J_.end(), 0.0);
            for (int i = 0; i < 6; ++i) std::copy_n(frame.jacobian.begin() + i * n, n, J_.begin() + i * columns + n);
            twist_in_q(costs_.frames[term.index].links, frame, columns);
        }
    }

    // The derivative of a twist in q, into the first n of `columns` of J. With w_i and l_i the angular and linear
    // velocity of the frame per unit rate of joint i, d l_j / dq_i is w_i x l_j for i up to j and w_j x l_i beyond, and
    // d w_j / dq_i is w_i x w_j for i before j, else zero; these are multiplied by the joints' rates.
    void twist_in_q(const Links& links, const FrameAt& frame, int columns) {
        const double* v = z_.data() + costs_.dof;
        Motion<double> ahead{};
        for (int j = 0; j < links.size(); ++j) {
            const Body& link = links.bodies[j];
            gives_[j] = given_by(link, frame.joints[j], frame.placement.position);
            ahead = ahead + link.ratio * v[link.coordinate] * gives_[j];
        }
        Vec3<double> before{};
        for (int j = 0; j < links.size(); ++j) {
            const Body& link = links.bodies[j];
            const Motion<double>& twist = gives_[j];
            const double rate = link.ratio * v[link.coordinate];
            const Vec3<double> linear = cross(twist.angular, ahead.linear) + cross(before, twist.linear);
            before = before + rate * twist.angular;
            ahead = {ahead.linear - rate * twist.linear, ahead.angular - rate * twist.angular};
            const Vec3<double> angular = cross(twist.angular, ahead.angular);
            const double slopes[6] = {linear.x, linear.y, linear.z, angular.x, angular.y, angular.z};
            for (int i = 0; i < 6; ++i) J_[i * columns + link.coordinate] += link.ratio * slopes[i];
        }
    }

    // The derivative of the deficit of a manipulability w, -sum dw/dJ . dJ/dq, into the first row of J.
    void lack_in_q(const CostTerm& term, const FrameAt& frame) {
        const Links& links = costs_.frames[term.index].links;
        const double* W = dexterity_.slope();
        const auto weight = [&](const Body& link) {
            double parts[6] = {};
            for (std::size_t d = 0; d < term.directions.size(); ++d)
                parts[term.directions[d]] = link.ratio * W[d * costs_.dof + link.coordinate];
            return Force<double>{{parts[0], parts[1], parts[2]}, {parts[3], parts[4], parts[5]}};
        };
        std::fill(J_.begin(), J_.begin() + costs_.dof, 0.0);
        Vec3<double> before{};
        for (int i = 0; i < links.size(); ++i) {
            const Body& link = links.bodies[i];
            gives_[i] = given_by(link, frame.joints[i], frame.placement.position);
            J_[link.coordinate] -= link.ratio * dot(gives_[i].linear, before);
            before += cross(weight(link).linear, gives_[i].angular);
        }
        Vec3<double> from_here{}, beyond{};
        for (int i = links.size() - 1; i >= 0; --i) {
            const Body& link = links.bodies[i];
            const Force<double> wrench = weight(link);
            from_here += cross(gives_[i].linear, wrench.linear);
            J_[link.coordinate] -= link.ratio * dot(gives_[i].angular, from_here + beyond);
            beyond += cross(gives_[i].angular, wrench.angular);
        }
    }
};

}  // namespace varpin
