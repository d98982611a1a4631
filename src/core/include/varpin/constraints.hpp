// Holonomic constraints g(q) = 0, m rows, with all derivatives that steps need. docs/constraints.md.
//
// Rows between frames are products g = factor X . Y - constant of vectors on bodies: a point of a body, the vector
// between two points, or a direction. A vector depends on the joints from the root to its body: with w_i the angular
// velocity per unit rate of joint i, d2X/dq_i dq_j = w_i x dX/dq_j for i an ancestor of j or j itself, so that
//
//     g_j  = X_j . Y + X . Y_j
//     g_ij = X_ij . Y + X_i . Y_j + X_j . Y_i + X . Y_ij
//
// A row that ties a joint to another is a polynomial. Other rows are functions from Python.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <functional>
#include <tuple>
#include <utility>
#include <vector>

#include "varpin/kinematics.hpp"
#include "varpin/spatial.hpp"

namespace varpin {

// A vector, or the difference of two.
struct VectorSum {
    std::vector<Anchor> parts;  // one or two
};

// factor X . Y - constant; x and y are indices into the list of vectors.
struct ProductRow {
    int x = 0;
    int y = 0;
    double factor = 1.0;
    double constant = 0.0;
};

// q_follower - sum_k coefficients_k q_leader^k. A joint that leads itself, without coefficients, is driven: its motion
// is prescribed by a control.
struct TieRow {
    int follower = 0;
    int leader = 0;
    std::vector<double> coefficients;
    int rate = -1;  // of a driven joint: the control of its rate at the goal, or -1 for linear motion
};

// The row of a driven joint, q - goal; the goal is in the force of the step.
struct DrivenRow {
    int row = 0;
    int coordinate = 0;
    int rate = -1;  // as in TieRow
};

// A function of q with several rows.
struct CustomRows {
    int rows = 0;
    std::function<void(const double* q, double* g, double* C)> value;                        // g (rows), C (rows, n)
    std::function<void(const double* q, const double* weights, double* curvature)> bending;  // (n, n)
};

// Constraints at one q.
struct ConstraintJet {
    std::vector<double> g;       // (m)
    std::vector<double> scale;   // (m) magnitude of the terms that cancel in g
    std::vector<double> C;       // (m, n)
    std::vector<double> size;    // (m, n) magnitude of the terms that cancel in C
    std::vector<double> at_q;    // (n)
    std::vector<double> custom;  // (n, n)
    // Work arrays of derivatives.
    std::vector<Placement> at;
    std::vector<std::vector<Arm<double>>> arms;  // of each part of each vector, from the root on
    std::vector<Vec3<double>> value;             // of each vector
    std::vector<double> reach;                   // of each vector
    std::vector<Vec3<double>> slope;             // (vectors, n)
    std::vector<double> slope_size;              // (vectors, n)
    std::vector<Vec3<double>> moved;             // (vectors, n)
    std::vector<Vec3<double>> weight;            // of each vector

    auto arrays() {
        return std::tie(g, scale, C, size, at_q, custom, at, arms, value, reach, slope, slope_size, moved, weight);
    }
};

// One by one: three moves of so many arrays take a twentieth of a small step.
inline void swap(ConstraintJet& a, ConstraintJet& b) {
    auto own = a.arrays(), other = b.arrays();
    own.swap(other);
}

class Constraints {
  public:
    Constraints() = default;
    Constraints(std::vector<VectorSum> vectors, std::vector<ProductRow> products, std::vector<TieRow> ties,
                std::vector<CustomRows> customs, const std::vector<Body>& bodies, int dof)
        : products_(std::move(products)), ties_(std::move(ties)), customs_(std::move(customs)), n_(dof) {
        LinkCollector collector(bodies, links_);
        for (VectorSum& sum : vectors) {
            Joined joined{std::move(sum), {}, legs_, false};
            for (Anchor& part : joined.sum.parts) {
                part.body = collector.take(part.body);
                joined.moves = joined.moves || part.body >= 0;
                joined.paths.push_back(links_.path(part.body));
            }
            legs_ += joined.sum.parts.size();
            vectors_.push_back(std::move(joined));
        }
        for (const Body& link : links_.bodies) span_.push_back(length(link.translation));
        rows_ = static_cast<int>(products_.size() + ties_.size());
        for (const CustomRows& own_rows : customs_) rows_ += own_rows.rows;
        for (std::size_t k = 0; k < ties_.size(); ++k) {
            if (ties_[k].follower != ties_[k].leader || !ties_[k].coefficients.empty()) continue;
            driven_.push_back({static_cast<int>(products_.size() + k), ties_[k].follower, ties_[k].rate});
        }
    }

    // m: products first, then ties, then functions.
    int rows() const { return rows_; }

    // Rows of driven joints.
    const std::vector<DrivenRow>& driven() const { return driven_; }

    // g and C at q.
    void at(const double* q, ConstraintJet& w) const {
        fit(w);
        std::copy(q, q + n_, w.at_q.begin());
        forward_kinematics(links_, q, w.at.data());
        for (std::size_t a = 0; a < vectors_.size(); ++a) {
            if (vectors_[a].moves) move_vector(q, a, w);
        }
        int r = 0;
        for (const ProductRow& product : products_) write_product(product, r++, w);
        std::fill(w.C.begin() + r * n_, w.C.end(), 0.0);
        for (const TieRow& tie : ties_) {
            const double leader = q[tie.leader];
            double total = 0.0, slope = 0.0, size = std::abs(q[tie.follower]);
            for (std::size_t k = tie.coefficients.size(); k-- > 0;) {
                slope = slope * leader + total;
                total = total * leader + tie.coefficients[k];
                size = std::max(size, std::abs(total));
            }
            w.g[r] = q[tie.follower] - total;
            w.scale[r] = size;
            w.C[r * n_ + tie.follower] += 1.0;
            w.C[r * n_ + tie.leader] -= slope;
            for (int c = 0; c < n_; ++c) w.size[r * n_ + c] = std::abs(w.C[r * n_ + c]);
            ++r;
        }
        for (const CustomRows& custom : customs_) {
            custom.value(q, &w.g[r], &w.C[r * n_]);
            for (int k = r; k < r + custom.rows; ++k) {
                double size = 0.0;
                for (int c = 0; c < n_; ++c) {
                    w.size[k * n_ + c] = std::abs(w.C[k * n_ + c]);
                    size += w.size[k * n_ + c] * std::max(std::abs(q[c]), 1.0);
                }
                w.scale[k] = size;
            }
            r += custom.rows;
        }
    }

    // Adds factor sum_r weights_r g_r,qq to a matrix (n, n), at the q of the last `at`.
    void add_curvature(const double* weights, double factor, ConstraintJet& w, double* H) const {
        std::fill(w.weight.begin(), w.weight.end(), Vec3<double>{});
        int r = 0;
        for (const ProductRow& product : products_) {
            const double scale = factor * weights[r++] * product.factor;
            if (scale == 0.0) continue;
            w.weight[product.x] += scale * w.value[product.y];
            w.weight[product.y] += scale * w.value[product.x];
            if (!vectors_[product.x].moves || !vectors_[product.y].moves) continue;
            const Vec3<double>*X = &w.slope[product.x * n_], *Y = &w.slope[product.y * n_];
            for (int i = 0; i < n_; ++i) {
                for (int j = 0; j <= i; ++j) {
                    const double term = scale * (dot(X[i], Y[j]) + dot(X[j], Y[i]));
                    H[i * n_ + j] += term;
                    if (i != j) H[j * n_ + i] += term;
                }
            }
        }
        for (std::size_t a = 0; a < vectors_.size(); ++a) {
            if (!vectors_[a].moves) continue;
            for (std::size_t part = 0; part < vectors_[a].sum.parts.size(); ++part) {
                const auto& arms = w.arms[vectors_[a].first_leg + part];
                for (std::size_t i = 0; i < arms.size(); ++i) {
                    const Vec3<double> turned = cross(w.weight[a], arms[i].angular);
                    for (std::size_t j = i; j < arms.size(); ++j) {
                        const double term = dot(turned, arms[j].linear);
                        H[arms[i].coordinate * n_ + arms[j].coordinate] += term;
                        if (i != j) H[arms[j].coordinate * n_ + arms[i].coordinate] += term;
                    }
                }
            }
        }
        for (const TieRow& tie : ties_) {
            const double leader = w.at_q[tie.leader];
            double bend = 0.0;
            for (std::size_t k = tie.coefficients.size(); k-- > 2;)
                bend = bend * leader + static_cast<double>(k * (k - 1)) * tie.coefficients[k];
            H[tie.leader * n_ + tie.leader] -= factor * weights[r++] * bend;
        }
        for (const CustomRows& custom : customs_) {
            custom.bending(w.at_q.data(), weights + r, w.custom.data());
            for (int i = 0; i < n_ * n_; ++i) H[i] += factor * w.custom[i];
            r += custom.rows;
        }
    }

    // g_qq v (m, n), at the q of the last `at`.
    void bend(const double* v, ConstraintJet& w, double* out) const {
        // For each vector: sum_i X_ij v_i by j, and sum_i X_i v_i.
        std::fill(w.moved.begin(), w.moved.end(), Vec3<double>{});
        std::fill(w.weight.begin(), w.weight.end(), Vec3<double>{});
        for (std::size_t a = 0; a < vectors_.size(); ++a) {
            for (std::size_t part = 0; part < vectors_[a].sum.parts.size(); ++part) {
                const auto& arms = w.arms[vectors_[a].first_leg + part];
                Vec3<double> before{}, beyond{};
                for (const auto& arm : arms) {
                    w.moved[a * n_ + arm.coordinate] += cross(before, arm.linear);
                    before += v[arm.coordinate] * arm.angular;
                }
                for (std::size_t j = arms.size(); j-- > 0;) {
                    beyond += v[arms[j].coordinate] * arms[j].linear;
                    w.moved[a * n_ + arms[j].coordinate] += cross(arms[j].angular, beyond);
                }
                w.weight[a] += beyond;
            }
        }
        int r = 0;
        for (const ProductRow& product : products_) {
            const Vec3<double>*X = &w.slope[product.x * n_], *Y = &w.slope[product.y * n_];
            const Vec3<double>*Xm = &w.moved[product.x * n_], *Ym = &w.moved[product.y * n_];
            for (int c = 0; c < n_; ++c) {
                out[r * n_ + c] = product.factor * (dot(Xm[c], w.value[product.y]) + dot(w.weight[product.x], Y[c]) +
                                                    dot(X[c], w.weight[product.y]) + dot(w.value[product.x], Ym[c]));
            }
            ++r;
        }
        for (; r < rows_; ++r) {
            // For custom rows, one at a time.
            std::vector<double> unit(rows_), H(n_ * n_);
            unit[r] = 1.0;
            add_curvature(unit.data(), 1.0, w, H.data());
            for (int c = 0; c < n_; ++c) {
                out[r * n_ + c] = 0.0;
                for (int i = 0; i < n_; ++i) out[r * n_ + c] += H[c * n_ + i] * v[i];
            }
        }
    }

  private:
    struct Joined {
        VectorSum sum;
        std::vector<std::vector<int>> paths;  // bodies from the root to that of each part
        std::size_t first_leg = 0;            // of its parts, in ConstraintJet::arms
        bool moves = false;                   // with any body; else it is constant
    };

    Links links_;
    std::vector<Joined> vectors_;
    std::vector<ProductRow> products_;
    std::vector<TieRow> ties_;
    std::vector<DrivenRow> driven_;
    std::vector<CustomRows> customs_;
    std::vector<double> span_;  // of each link: the length of its translation
    std::size_t legs_ = 0;      // parts of all vectors
    int n_ = 0;
    int rows_ = 0;

    static double length(const Vec3<double>& a) { return std::sqrt(dot(a, a)); }

    void fit(ConstraintJet& w) const {
        if (w.at_q.size() == static_cast<std::size_t>(n_)) return;
        w.g.resize(rows_);
        w.scale.resize(rows_);
        w.C.resize(rows_ * n_);
        w.size.resize(rows_ * n_);
        w.at_q.resize(n_);
        w.custom.resize(customs_.empty() ? 0 : n_ * n_);
        w.at.resize(links_.bodies.size());
        w.arms.resize(legs_);
        w.value.resize(vectors_.size());
        w.reach.resize(vectors_.size());
        w.slope.resize(vectors_.size() * n_);
        w.slope_size.resize(vectors_.size() * n_);
        w.moved.resize(vectors_.size() * n_);
        w.weight.resize(vectors_.size());
        // Vectors that do not move are found once.
        const std::vector<double> any(n_);
        for (std::size_t a = 0; a < vectors_.size(); ++a) {
            if (!vectors_[a].moves) move_vector(any.data(), a, w);
        }
    }

    void write_product(const ProductRow& product, int r, ConstraintJet& w) const {
        const Vec3<double> X = w.value[product.x], Y = w.value[product.y];
        const double X_length = length(X), Y_length = length(Y), factor = product.factor, size = std::abs(factor);
        w.g[r] = factor * dot(X, Y) - product.constant;
        w.scale[r] =
            size * (w.reach[product.x] * Y_length + X_length * w.reach[product.y]) + std::abs(product.constant);
        double *C = &w.C[r * n_], *C_size = &w.size[r * n_];
        std::fill(C, C + n_, 0.0);
        std::fill(C_size, C_size + n_, 0.0);
        if (vectors_[product.x].moves) add_slope(product.x, factor * Y, size * Y_length, w, C, C_size);
        if (vectors_[product.y].moves) add_slope(product.y, factor * X, size * X_length, w, C, C_size);
    }

    // Add the slope of vector a times another vector, and its size times that vector's.
    void add_slope(int a, const Vec3<double>& other, double other_size, const ConstraintJet& w, double* C,
                   double* C_size) const {
        const Vec3<double>* slope = &w.slope[a * n_];
        const double* slope_size = &w.slope_size[a * n_];
        for (int c = 0; c < n_; ++c) C[c] += dot(slope[c], other);
        for (int c = 0; c < n_; ++c) C_size[c] += slope_size[c] * other_size;
    }

    void move_vector(const double* q, std::size_t a, ConstraintJet& w) const {
        Vec3<double>* slope = &w.slope[a * n_];
        double* size = &w.slope_size[a * n_];
        std::fill(slope, slope + n_, Vec3<double>{});
        std::fill(size, size + n_, 0.0);
        Vec3<double> value{};
        double reach = 0.0;
        const auto& parts = vectors_[a].sum.parts;
        for (std::size_t part = 0; part < parts.size(); ++part) {
            auto& arms = w.arms[vectors_[a].first_leg + part];
            arms.clear();
            const std::vector<int>& path = vectors_[a].paths[part];
            const Vec3<double> x = add_arms(links_, path, parts[part], static_cast<int>(part), w.at.data(), arms);
            value = part == 0 ? x : value - x;
            reach += length(x);
            for (std::size_t i = 0; i < arms.size(); ++i) {
                const Arm<double>& arm = arms[i];
                slope[arm.coordinate] += arm.linear;
                const double moved = length(arm.linear);
                size[arm.coordinate] += moved;
                // The rounding of joint positions limits the precision of a point.
                reach += moved * std::abs(q[arm.coordinate]);
                if (!parts[part].direction) reach += span_[path[i]];
            }
        }
        w.value[a] = value;
        w.reach[a] = reach;
    }
};

// Joints whose motion is given: each moves to its goal, its entry of the step's force, at a constant rate, or on the
// cubic between the rates at both ends, the second given by a control. Its row is g = q - (this motion), and no force
// but the row's acts on it. A control that is held over several steps has its goal at the end of the last one.
class KinematicInputs {
  public:
    explicit KinematicInputs(const std::vector<DrivenRow>& driven) : driven(driven) {
        cubic = std::any_of(driven.begin(), driven.end(), [](const DrivenRow& own) { return own.rate >= 0; });
    }

    const std::vector<DrivenRow>& driven;
    std::vector<double> goal = std::vector<double>(driven.size());
    std::vector<double> goal_rate = goal, begun = goal;  // rates at the goal and at the beginning of the part
    bool cubic = false;                                  // whether any is
    int left = 1;                                        // steps to the goal
    double share = 1.0;                                  // the next part's share of the time to the goal

    int count() const { return static_cast<int>(driven.size()); }
    // Index of the input of a row, or -1.
    int of_row(int row) const {
        for (int d = 0; d < count(); ++d) {
            if (driven[d].row == row) return d;
        }
        return -1;
    }

    // The displacement is ahead * (distance to the goal) + T (begin * (rate at the start) + end * (rate at the goal)),
    // with T the time to the goal.
    struct Way {
        double ahead, begin, end;
    };
    // These coefficients after the share `at` of T.
    Way way_at(int d, double at) const {
        if (driven[d].rate < 0) return {at, 0.0, 0.0};
        return {at * at * (3.0 - 2.0 * at), at * (1.0 - at) * (1.0 - at), at * at * (at - 1.0)};
    }
    // Those of the rate: ahead * (distance / T) + begin * (rate at the start) + end * (rate at the goal).
    Way pace_at(int d, double at) const {
        if (driven[d].rate < 0) return {1.0, 0.0, 0.0};
        return {6.0 * at * (1.0 - at), (1.0 - at) * (1.0 - 3.0 * at), at * (3.0 * at - 2.0)};
    }
    double rate_at(int d, double at, double h, double from) const {
        const Way pace = pace_at(d, at);
        return pace.ahead * share * (goal[d] - from) / h + pace.begin * begun[d] + pace.end * goal_rate[d];
    }
};

}  // namespace varpin
