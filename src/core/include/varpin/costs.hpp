// Costs weight . r^2 at samples (q, v, u), with their gradients and the Hessians of Gauss and Newton, 2 J' weight J,
// in z = (q, v, u). docs/mathematics.md, "Costs in the task".
#pragma once

#include <algorithm>
#include <cstddef>
#include <utility>
#include <vector>

#include "varpin/kinematics.hpp"

namespace varpin {

// A frame that stands at `own` in the last of some bodies.
struct CostFrame {
    Links links;
    Placement own;
};

// What a residual r is of: entries of z; or the position, the orientation or the twist of a frame.
enum class Subject { entries, position, orientation, twist };

struct CostTerm {
    Subject subject = Subject::entries;
    int size = 0;                // of r
    int place = 0;               // the first of its entries in z, or the index of its frame
    std::vector<double> weight;  // (r, r) symmetric
    std::vector<double> target;  // (T, r), of an orientation (T, 9), row by row; sample s has row s % T
};

struct CostTerms {
    int dof = 0;
    int controls = 0;
    std::vector<CostFrame> frames;
    std::vector<CostTerm> terms;

    int size() const { return 2 * dof + controls; }
    // Whether every residual is linear, and so the Hessian the same at all samples.
    bool linear() const { return frames.empty(); }
};

// Work arrays for a sample at a time.
class CostSample {
  public:
    explicit CostSample(const CostTerms& costs)
        : costs_(costs), z_(costs.size()), frames_(costs.frames.size()), J_(6 * 2 * costs.dof), WJ_(J_.size()) {
        std::size_t most = 0, bodies = 0;
        for (const CostTerm& term : costs.terms) most = std::max(most, static_cast<std::size_t>(term.size));
        for (std::size_t f = 0; f < frames_.size(); ++f) {
            frames_[f].jacobian.resize(6 * costs.dof);
            frames_[f].joints.resize(costs.frames[f].links.bodies.size());
            bodies = std::max(bodies, frames_[f].joints.size());
        }
        gives_.resize(bodies);
        error_.resize(most);
        weighted_.resize(most);
    }

    // The value of each term at (q, v, u), which has row `row` of the targets.
    void values(const double* q, const double* v, const double* u, std::size_t row, double* found) {
        look(q, v, u, false);
        for (const CostTerm& term : costs_.terms) *found++ = weigh(term, row);
    }

    // Add the gradient of all terms (2n + m), and the Hessians (2n + m, 2n + m) of those of frames.
    void expand(const double* q, const double* v, const double* u, std::size_t row, double* gradient, double* hessian) {
        look(q, v, u, true);
        for (const CostTerm& term : costs_.terms) {
            weigh(term, row);
            if (term.subject == Subject::entries) {
                for (int i = 0; i < term.size; ++i) gradient[term.place + i] += 2.0 * weighted_[i];
                continue;
            }
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
                    hessian[(term.place + i) * costs_.size() + term.place + k] += 2.0 * term.weight[i * term.size + k];
            }
        }
    }

  private:
    struct FrameAt {
        Placement placement;
        std::vector<Placement> joints;
        std::vector<double> jacobian;  // (6, n)
    };

    const CostTerms& costs_;
    std::vector<double> z_;
    std::vector<FrameAt> frames_;
    std::vector<double> J_, WJ_;  // (r, columns)
    std::vector<Motion<double>> gives_;
    std::vector<double> error_, weighted_;

    void look(const double* q, const double* v, const double* u, bool slopes) {
        const int n = costs_.dof;
        std::copy_n(q, n, z_.begin());
        std::copy_n(v, n, z_.begin() + n);
        std::copy_n(u, costs_.controls, z_.begin() + 2 * n);
        for (std::size_t f = 0; f < frames_.size(); ++f) {
            const auto& [links, own] = costs_.frames[f];
            FrameAt& here = frames_[f];
            place(links, q, here.joints.data());
            here.placement = here.joints.back() * own;
            const bool moves = std::any_of(costs_.terms.begin(), costs_.terms.end(), [&](const CostTerm& term) {
                return term.subject == Subject::twist && term.place == static_cast<int>(f);
            });
            if (slopes || moves)
                frame_jacobian(links, here.joints.data(), here.placement.position, here.jacobian.data());
        }
    }

    // The value r' W r of a term, with r and W r.
    double weigh(const CostTerm& term, std::size_t row) {
        residual(term, row);
        double total = 0.0;
        for (int i = 0; i < term.size; ++i) {
            double sum = 0.0;
            for (int k = 0; k < term.size; ++k) sum += term.weight[i * term.size + k] * error_[k];
            weighted_[i] = sum;
            total += sum * error_[i];
        }
        return total;
    }

    void residual(const CostTerm& term, std::size_t row) {
        const std::size_t width = term.subject == Subject::orientation ? 9 : static_cast<std::size_t>(term.size);
        const double* target = term.target.data() + (row % (term.target.size() / width)) * width;
        if (term.subject == Subject::entries) {
            for (int i = 0; i < term.size; ++i) error_[i] = z_[term.place + i] - target[i];
            return;
        }
        const FrameAt& frame = frames_[term.place];
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
            // A matrix has its columns in a row, and so the transposed target's rows.
            const Mat3<double> back{{target[0], target[1], target[2]},
                                    {target[3], target[4], target[5]},
                                    {target[6], target[7], target[8]}};
            r = logarithm(back * frame.placement.rotation);
        }
        error_[0] = r.x;
        error_[1] = r.y;
        error_[2] = r.z;
    }

    // J (r, columns) of a term on a frame, after its residual.
    void differentiate(const CostTerm& term, int columns) {
        const FrameAt& frame = frames_[term.place];
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
        } else {
            std::fill(J_.begin(), J_.end(), 0.0);
            for (int i = 0; i < 6; ++i) std::copy_n(frame.jacobian.begin() + i * n, n, J_.begin() + i * columns + n);
            twist_in_q(costs_.frames[term.place].links, frame, columns);
        }
    }

    // The derivative of a twist in q into the first n of `columns` of J. A joint turns the axes of all after it: with
    // w_i and l_i what joint i gives to the frame, d l_j / dq_i is w_i x l_j for i up to j and w_j x l_i beyond, and
    // d w_j / dq_i is w_i x w_j for i before j, else zero.
    void twist_in_q(const Links& links, const FrameAt& frame, int columns) {
        const double* v = z_.data() + costs_.dof;
        Motion<double> ahead{};
        for (int j = 0; j < links.size(); ++j) {
            const Body& link = links.bodies[j];
            const Vec3<double>& axis = frame.joints[j].rotation.z;
            gives_[j] = link.prismatic
                            ? Motion<double>{axis, {}}
                            : Motion<double>{cross(axis, frame.placement.position - frame.joints[j].position), axis};
            ahead = ahead + link.ratio * v[link.coordinate] * gives_[j];
        }
        Vec3<double> before{};
        for (int j = 0; j < links.size(); ++j) {
            const Body& link = links.bodies[j];
            const Motion<double>& own = gives_[j];
            const double rate = link.ratio * v[link.coordinate];
            const Vec3<double> linear = cross(own.angular, ahead.linear) + cross(before, own.linear);
            before = before + rate * own.angular;
            ahead = {ahead.linear - rate * own.linear, ahead.angular - rate * own.angular};
            const Vec3<double> angular = cross(own.angular, ahead.angular);
            const double slopes[6] = {linear.x, linear.y, linear.z, angular.x, angular.y, angular.z};
            for (int i = 0; i < 6; ++i) J_[i * columns + link.coordinate] += link.ratio * slopes[i];
        }
    }
};

// The samples of the steps of a motion, q and v: row s of the rule (s, 9) is (weight, q from q0, v0, q1, v1, v from q0,
// v0, q1, v1). Nodes (N + 1, n); samples (N s, n).
inline void sample_steps(const double* rule, std::size_t samples, std::size_t steps, std::size_t n, const double* q,
                         const double* v, double* at_q, double* at_v) {
    for (std::size_t k = 0; k < steps; ++k) {
        const double* nodes[4] = {q + k * n, v + k * n, q + (k + 1) * n, v + (k + 1) * n};
        for (std::size_t s = 0; s < samples; ++s) {
            const double* row = rule + 9 * s;
            for (const auto& [to, weights] : {std::pair{at_q, row + 1}, {at_v, row + 5}}) {
                double* __restrict found = to + (k * samples + s) * n;
                std::fill(found, found + n, 0.0);
                for (int part = 0; part < 4; ++part) {
                    // What has no weight may be no number.
                    if (weights[part] == 0.0) continue;
                    for (std::size_t c = 0; c < n; ++c) found[c] += weights[part] * nodes[part][c];
                }
            }
        }
    }
}

}  // namespace varpin
