// Forward dynamics and its derivatives, for the integrators on (q, v). docs/mathematics.md, "Explicit methods";
// equations (X3) and (X4). Inverse dynamics is tau = S . Phi, with Phi the force on the subtree of a joint. With
// U_i = (W_i, S_i), X_i = (Z_i, 2 W_i), columns for (dq_i, dv_i), and C of `Coupling`, i an ancestor of j or j itself:
//
//     dtau_j/d(q,v)_i = F_j . X_i + (C_j' S_j) . U_i
//     dtau_i/d(q,v)_j = S_i . (Y_j X_j + C_j U_j + (S_j x* Phi_j, 0))
#pragma once

#include <algorithm>
#include <optional>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/dual.hpp"
#include "varpin/elimination.hpp"
#include "varpin/jet.hpp"
#include "varpin/mechanism.hpp"
#include "varpin/spatial.hpp"

namespace varpin {

// C x = Y (x x V) + x x* H + V x* Y x. Of a body with first moment h, second moments J, velocity (u, w) and linear
// momentum P it is
//
//     C (a, b) = (2 b x P, D b),    D b = w x T b + 2 (h . u) b - 2 (h . b) u,    T = 2 J - tr J;
//
// a drops out by Jacobi's identity. P and D are additive over bodies.
struct Coupling {
    Vec3<double> momentum{};  // P
    Mat3<double> turn{};      // D

    static Coupling of(const Inertia<double>& Y, const Motion<double>& V, const Force<double>& H) {
        const auto& [xx, xy, yy, xz, yz, zz] = Y.second;
        const Vec3<double>& h = Y.moment;
        const double along = 2.0 * dot(h, V.linear);
        Mat3<double> D{cross(V.angular, Vec3<double>{xx - yy - zz, 2.0 * xy, 2.0 * xz}) - (2.0 * h.x) * V.linear,
                       cross(V.angular, Vec3<double>{2.0 * xy, yy - xx - zz, 2.0 * yz}) - (2.0 * h.y) * V.linear,
                       cross(V.angular, Vec3<double>{2.0 * xz, 2.0 * yz, zz - xx - yy}) - (2.0 * h.z) * V.linear};
        D.x.x += along;
        D.y.y += along;
        D.z.z += along;
        return {H.linear, D};
    }

    // The angular part of C' x; the linear one vanishes.
    Vec3<double> back(const Motion<double>& x) const {
        const Vec3<double>& b = x.angular;
        return 2.0 * cross(momentum, x.linear) + Vec3<double>{dot(turn.x, b), dot(turn.y, b), dot(turn.z, b)};
    }
};

constexpr Coupling& operator+=(Coupling& a, const Coupling& b) {
    a.momentum += b.momentum;
    a.turn.x += b.turn.x;
    a.turn.y += b.turn.y;
    a.turn.z += b.turn.z;
    return a;
}
// C x for an x with angular part b.
template <class T>
constexpr Force<T> operator*(const Coupling& C, const Vec3<T>& b) {
    return {2.0 * cross(b, C.momentum), C.turn * b};
}

// Forward dynamics M a = force - bias at consecutive states, with work arrays. Derivatives need a mass matrix; without
// them large trees use the articulated body algorithm.
class ForwardDynamics {
  public:
    ForwardDynamics(const Mechanism& mechanism, bool derivatives)
        : mechanism_(&mechanism), jet_(mechanism.tree, false), body_(mechanism.tree.bodies.size()), acting_(jet_.dof) {
        const int n = jet_.dof;
        mechanism.couplings.fit(jet_.couplings);
        if (!derivatives && eliminates(mechanism.tree)) {
            articulated_.emplace(mechanism.tree);
            return;
        }
        jet_.M.resize(entries(n, n));
        ldl_.resize(n * n);
        if (!derivatives) return;
        slopes_.resize(entries(n, 2 * n));
        if (mechanism.couplings.any()) {
            for (auto* matrix : {&coupled_q_, &coupled_v_, &coupled_curvature_}) matrix->resize(n * n);
        }
    }

    int dof() const { return jet_.dof; }

    // Mass matrix, its factors, bias and energies at (q, v), the state of the calls below; false where the mass matrix
    // is not positive definite.
    bool at(const double* q, const double* v) {
        const Tree& tree = mechanism_->tree;
        std::fill(jet_.potential.begin(), jet_.potential.end(), 0.0);
        std::fill(jet_.potential_scale.begin(), jet_.potential_scale.end(), 0.0);
        if (!articulated_) detail::clear_blocks(tree, jet_.dof, jet_.M);
        add_potentials(q);
        std::copy_n(q, jet_.dof, q_.data());
        std::copy_n(v, jet_.dof, v_.data());
        for (int j = 0; j < tree.size(); ++j) {
            const Body& link = tree.bodies[j];
            auto& here = jet_.body[j];
            detail::place_body(tree, j, q, jet_);
            detail::move(tree, j, v, jet_);
            here.inertia = placed(here.rotation, here.position, link.mass, link.center, link.inertia);
            here.momentum = here.inertia * here.velocity;
            body_[j].inertia = here.inertia;
            if (articulated_) articulated_->set_body(j, link.ratio * here.axis, here.inertia);
            accelerate(j, v, nullptr);
        }
        for (int c = 0; c < jet_.dof && articulated_; ++c) momentum_[c] = tree.armature[c] * v[c];
        bool regular = true;
        for (int j = tree.size() - 1; j >= 0; --j) {
            const Body& link = tree.bodies[j];
            if (articulated_) {
                regular = regular && articulated_->eliminate(j);
                const int c = link.coordinate;
                momentum_[c] += link.ratio * dot(jet_.body[j].axis, jet_.body[j].momentum);
                if (link.parent >= 0) jet_.body[link.parent].momentum += jet_.body[j].momentum;
            } else {
                body_[j].mass = detail::project_mass(tree, j, jet_.dof, jet_);
            }
            bias_[link.coordinate] += link.ratio * dot(jet_.body[j].axis, body_[j].force);
            if (link.parent >= 0) {
                detail::pass_inertia(link, jet_.body[j].inertia, jet_.body[link.parent].inertia, true);
                body_[link.parent].force += body_[j].force;
            }
            if (link.origin) detail::add_potential(*mechanism_, j, q, jet_);
        }
        return articulated_ ? regular : factor();
    }

    // p = M v, and the energy [J].
    double energy(const double* v, double* p) const {
        const int n = jet_.dof;
        double kinetic = 0.0;
        if (articulated_) {
            for (int i = 0; i < n; ++i) {
                p[i] = momentum_[i];
                kinetic += 0.5 * v[i] * p[i];
            }
            return kinetic + jet_.total_potential();
        }
        times_mass(v, p);
        for (int i = 0; i < n; ++i) kinetic += 0.5 * v[i] * p[i];
        return kinetic + jet_.total_potential();
    }

    // The x with M x = b; x may be b.
    void solve_mass(const double* b, double* x) {
        if (articulated_) return articulated_->solve(b, x, nullptr);
        for (const Block& block : mechanism_->tree.blocks) solve_ldl(ldl_.data(), jet_.dof, block, b, x);
    }

    // The accelerations a under a force; derivatives are taken at this force.
    void acceleration(const double* force, double* a) {
        double* const by_q = coupled_q_.empty() ? nullptr : coupled_q_.data();
        double* const by_v = coupled_v_.empty() ? nullptr : coupled_v_.data();
        sum_forces(*mechanism_, q_.data(), v_.data(), force, acting_.data(), jet_.couplings, by_q, by_v);
        for (int i = 0; i < jet_.dof; ++i) room_[i] = force[i] + acting_[i].value - bias_[i];
        solve_mass(room_.data(), a);
    }

    // Inverse dynamics at (q, v, a): the forces M a + bias that are needed besides those without a potential. It takes
    // a mass matrix, as derivatives do.
    void inverse(const double* q, const double* v, const double* a, double* force) {
        at(q, v);
        times_mass(a, force);
        for (int i = 0; i < jet_.dof; ++i) force[i] += bias_[i];
    }

    // The derivatives of inverse dynamics at accelerations a, once after at() with the same v; for the calls below.
    void differentiate(const double* v, const double* a) {
        const Tree& tree = mechanism_->tree;
        const int n = jet_.dof;
        for (const Block& block : tree.blocks) {
            for (int i = block.begin; i < block.end; ++i) {
                double* row = slopes_.data() + i * 2 * n;
                std::fill(row + block.begin, row + block.end, 0.0);
                std::fill(row + n + block.begin, row + n + block.end, 0.0);
                row[i] = acting_[i].by_q + curvature_[i];
                row[n + i] = acting_[i].by_v;
            }
        }
        for (int i = 0; i < n && !coupled_curvature_.empty(); ++i) {
            for (int k = 0; k < n; ++k) {
                slopes_[i * 2 * n + k] += coupled_q_[i * n + k] + coupled_curvature_[i * n + k];
                slopes_[i * 2 * n + n + k] += coupled_v_[i * n + k];
            }
        }
        for (int j = 0; j < tree.size(); ++j) {
            const auto& here = jet_.body[j];
            accelerate(j, v, a);
            body_[j].coupling = Coupling::of(body_[j].inertia, here.velocity, here.momentum);
            const int k = tree.bodies[j].parent;
            Motion<double> Z = cross(acceleration_above(j), here.axis);
            if (k >= 0) Z += cross(jet_.body[k].velocity, here.axis_rate);
            body_[j].turning_slopes = slopes(here.axis_rate.angular, here.axis.angular);
            body_[j].acceleration_slopes = slopes(Z, 2.0 * here.axis_rate);
        }
        for (int j = tree.size() - 1; j >= 0; --j) {
            project_slopes(j);
            const int k = tree.bodies[j].parent;
            if (k >= 0) {
                body_[k].force += body_[j].force;
                body_[k].coupling += body_[j].coupling;
            }
        }
    }

    // The derivatives (n, n) of the accelerations in q, v and force, once after differentiate(). Only blocks are
    // written; the arrays must be zero elsewhere.
    void derivatives(double* in_q, double* in_v, double* in_force) const {
        const int n = jet_.dof;
        for (const Block& block : mechanism_->tree.blocks) {
            const int size = block.end - block.begin, corner = block.begin * n + block.begin;
            for (int i = block.begin; i < block.end; ++i) {
                const double* by = slopes_.data() + i * 2 * n + block.begin;
                std::copy_n(by, size, in_q + i * n + block.begin);
                std::copy_n(by + n, size, in_v + i * n + block.begin);
                in_force[i * n + i] = 1.0 + acting_[i].by_f;
            }
            for (double* x : {in_q, in_v, in_force}) {
                solve_ldl_rows(ldl_.data(), n, block, x + corner, size, n);
            }
        }
    }

    // A contribution of an earlier stage to the derivatives: q and v change by in_q x and in_v x, where x (b, 3b)
    // are the derivatives of that stage's accelerations.
    struct Before {
        const double* x = nullptr;
        double in_q = 0.0, in_v = 0.0;
    };

    // How the accelerations of one block of b coordinates change with q, v and force, columns side by side in `a`
    // (b, 3b), once after differentiate(): M^-1 (-tau_q, -tau_v - reach tau_q, ramp) with reach = 0 and ramp 1; in_q x
    // and in_v x are changes of q and v besides.
    void slope(Block block, double* a, double reach, const Before* others, int count, double ramp) const {
        const int n = jet_.dof, size = block.end - block.begin, columns = 3 * size;
        const double *by_q = slopes_.data() + block.begin * 2 * n + block.begin, *by_v = by_q + n;
        for (int i = 0; i < size; ++i) {
            double* row = a + i * columns;
            const double *of_q = by_q + i * 2 * n, *of_v = by_v + i * 2 * n;
            std::copy_n(of_q, size, row);
            for (int j = 0; j < size; ++j) row[size + j] = of_v[j] + reach * of_q[j];
            std::fill(row + 2 * size, row + columns, 0.0);
            row[2 * size + i] = ramp * (1.0 + acting_[block.begin + i].by_f);
            for (int o = 0; o < count; ++o) {
                const auto add = [&](double scale, const double* weight) {
                    if (scale == 0.0) return;
                    subtract_rows(
                        row, columns, 0, size, [=](int k) { return -scale * weight[k]; },
                        [=](int k) { return others[o].x + k * columns; });
                };
                add(others[o].in_q, of_q);
                add(others[o].in_v, of_v);
            }
        }
        solve_ldl_rows(ldl_.data() + block.begin * (n + 1), n, {0, size}, a, columns, columns);
    }

  private:
    struct BodyState {
        Inertia<double> inertia{};             // of the body alone
        Motion<double> acceleration{};         // A
        Vec3<Slopes> turning_slopes{};         // U, angular
        Motion<Slopes> acceleration_slopes{};  // X
        Force<double> force{};                 // Phi
        Force<double> mass{};                  // F
        Coupling coupling{};
    };

    // Potential energy of elements and couplings; its force is part of the bias.
    void add_potentials(const double* q) {
        std::fill(bias_.begin(), bias_.end(), 0.0);
        std::fill(curvature_.begin(), curvature_.end(), 0.0);
        mechanism_->forces.potentials(q, [&](int c, const Potential<double>& own) {
            jet_.potential[mechanism_->tree.group[c]] += own.energy;
            bias_[c] -= own.force;
            curvature_[c] += own.curvature;
        });
        if (!mechanism_->couplings.any()) return;
        std::fill(coupled_curvature_.begin(), coupled_curvature_.end(), 0.0);
        mechanism_->couplings.potentials(q, jet_.couplings, [&](const auto& arms, const auto& own, double, double) {
            jet_.potential[mechanism_->tree.group[arms.front().coordinate]] += own.energy;
            for (const Arm<double>& arm : arms) bias_[arm.coordinate] += dot(own.slope, arm.linear);
            if (coupled_curvature_.empty()) return;
            Couplings::subtract_curvature(arms, own, jet_.dof, coupled_curvature_.data());
        });
    }

    // y = M x.
    void times_mass(const double* x, double* y) const {
        const int n = jet_.dof;
        for (const Block& block : mechanism_->tree.blocks) {
            for (int i = block.begin; i < block.end; ++i) {
                y[i] = 0.0;
                for (int j = block.begin; j < block.end; ++j) y[i] += jet_.M[i * n + j] * x[j];
            }
        }
    }

    bool factor() {
        const Tree& tree = mechanism_->tree;
        const int n = jet_.dof;
        bool regular = true;
        for (int i = 0; i < n; ++i) jet_.M[i * n + i] += tree.armature[i];
        for (const Block& block : tree.blocks) {
            for (int i = block.begin; i < block.end; ++i) {
                std::copy(&jet_.M[i * n + block.begin], &jet_.M[i * n + i] + 1, &ldl_[i * n + block.begin]);
            }
            regular = factor_ldl(ldl_.data(), n, block) && regular;
        }
        return regular;
    }

    Motion<double> acceleration_above(int j) const {
        const int k = mechanism_->tree.bodies[j].parent;
        return k < 0 ? Motion<double>{-1.0 * mechanism_->gravity, {}} : body_[k].acceleration;
    }

    // A and Phi of body j alone, with joint accelerations a (n), null for zero.
    void accelerate(int j, const double* v, const double* a) {
        const Body& link = mechanism_->tree.bodies[j];
        const auto& here = jet_.body[j];
        BodyState& own = body_[j];
        own.acceleration = acceleration_above(j);
        if (a) own.acceleration += (link.ratio * a[link.coordinate]) * here.axis;
        own.acceleration += (link.ratio * v[link.coordinate]) * here.axis_rate;
        own.force = own.inertia * own.acceleration + cross(here.velocity, here.momentum);
    }

    // Contribution of the subtree of body j to the derivatives of inverse dynamics, (X3) and (X4).
    void project_slopes(int j) {
        const Tree& tree = mechanism_->tree;
        const Body& link = tree.bodies[j];
        const auto& here = jet_.body[j];
        const BodyState& own = body_[j];
        const Force<double> F = own.mass;
        const Vec3<double> back = own.coupling.back(here.axis);
        const Force<double> turned = cross(here.axis, own.force);
        Force<Slopes> moved = here.inertia * own.acceleration_slopes + own.coupling * own.turning_slopes;
        moved += {slopes(turned.linear, {}), slopes(turned.angular, {})};
        const int n = jet_.dof;
        double* const to = slopes_.data();
        const auto add = [&](int row, int column, Slopes more) {
            double* entry = to + row * 2 * n + column;
            entry[0] += more.q();
            entry[n] += more.v();
        };
        for (int i = j; i >= 0; i = tree.bodies[i].parent) {
            const Body& above = tree.bodies[i];
            const BodyState& there = body_[i];
            const double ratio = -above.ratio * link.ratio;
            add(link.coordinate, above.coordinate,
                ratio * (dot(there.acceleration_slopes, F) + dot(there.turning_slopes, back)));
            if (i != j) add(above.coordinate, link.coordinate, ratio * dot(jet_.body[i].axis, moved));
        }
    }

    const Mechanism* mechanism_;
    Jet<double> jet_;  // placements, velocities, inertias of subtrees, M, potential
    std::vector<BodyState> body_;
    std::vector<double> q_ = zeros(jet_.dof), v_ = zeros(jet_.dof);
    std::vector<JointForce<double>> acting_;                         // (n) of elements, at the last force
    std::vector<double> curvature_ = zeros(jet_.dof);                // of the elements' potentials
    std::vector<double> coupled_q_, coupled_v_, coupled_curvature_;  // (n, n) of couplings, for derivatives
    std::vector<double> bias_ = zeros(jet_.dof), room_ = zeros(jet_.dof);
    std::optional<ArticulatedBodies> articulated_;    // in place of M
    std::vector<double> momentum_ = zeros(jet_.dof);  // with articulated bodies only
    std::vector<double> ldl_;                         // (n, n) factors of M
    std::vector<double> slopes_;                      // (n, 2n) of inverse dynamics in (q, v), their negatives
};

}  // namespace varpin
