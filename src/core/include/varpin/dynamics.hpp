// Forward dynamics and its derivatives, for the integrators that work on (q, v). Inverse dynamics by the recursive
// Newton-Euler algorithm is tau = S . Phi, with Phi the force that moves what a joint carries. Its derivatives follow
// from the rotate-along rule of the jet: for a body b below i, with V_p and A_p velocity and acceleration (gravity
// taken off) of i's parent,
//
//     dV_b = W_i,    dA_b = Z_i + W_i x V_b,    Z_i = A_p x S_i + V_p x W_i,
//
// and with C of `Coupling`, summed over what a joint carries like its inertia Y, for i above j or j itself,
//
//     dtau_j/dq_i = F_j . Z_i + (C_j' S_j) . W_i        dtau_i/dq_j = S_i . (Y_j Z_j + C_j W_j + S_j x* Phi_j)
//     dtau_j/dv_i = 2 F_j . W_i + (C_j' S_j) . S_i      dtau_i/dv_j = S_i . (2 Y_j W_j + C_j S_j)
#pragma once

#include <algorithm>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/jet.hpp"
#include "varpin/spatial.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// C x = Y (x x V) + x x* H + V x* Y x. Of a body with mass m, first moment h, second moments J, velocity (u, w) and
// linear momentum P it is
//
//     C (a, b) = (2 b x P, D b),    D b = w x (2 J b - tr(J) b) + 2 h x (b x u);
//
// a drops out by Jacobi's identity. P and D add up over bodies.
struct Coupling {
    Vec3<double> momentum{};  // P
    Mat3<double> turn{};      // D

    static Coupling of(const Inertia<double>& Y, const Motion<double>& V, const Force<double>& H) {
        const double trace = Y.second.xx + Y.second.yy + Y.second.zz;
        const auto column = [&](const Vec3<double>& unit) {
            const Vec3<double> turned = 2.0 * (Y.second * unit) - trace * unit;
            return cross(V.angular, turned) + 2.0 * cross(Y.moment, cross(unit, V.linear));
        };
        return {H.linear, {column({1.0, 0.0, 0.0}), column({0.0, 1.0, 0.0}), column({0.0, 0.0, 1.0})}};
    }
};

constexpr Coupling& operator+=(Coupling& a, const Coupling& b) {
    a.momentum += b.momentum;
    a.turn.x += b.turn.x;
    a.turn.y += b.turn.y;
    a.turn.z += b.turn.z;
    return a;
}
constexpr Force<double> operator*(const Coupling& C, const Motion<double>& x) {
    return {2.0 * cross(x.angular, C.momentum), C.turn * x.angular};
}
// C' x.
constexpr Force<double> transposed_times(const Coupling& C, const Motion<double>& x) {
    return {{}, 2.0 * cross(C.momentum, x.linear) + transposed(C.turn) * x.angular};
}

// Forward dynamics M a = force - bias at one state after another, with work arrays.
class ForwardDynamics {
  public:
    explicit ForwardDynamics(const Mechanism& mechanism)
        : mechanism_(&mechanism),
          jet_(mechanism.tree),
          body_(mechanism.tree.bodies.size()),
          bias_(jet_.dof),
          room_(jet_.dof),
          ldl_(jet_.M.size()),
          dq_(jet_.M.size()),
          dv_(jet_.M.size()) {}

    int dof() const { return jet_.dof; }

    // Mass matrix, its factors, bias and energies at (q, v), which what follows is about; false where the mass matrix
    // is not positive definite.
    bool at(const double* q, const double* v) {
        const Tree& tree = mechanism_->tree;
        std::fill(jet_.potential.begin(), jet_.potential.end(), 0.0);
        std::fill(jet_.potential_scale.begin(), jet_.potential_scale.end(), 0.0);
        detail::clear_blocks(tree, jet_.M);
        detail::add_springs(*mechanism_, q, jet_, false);
        for (int i = 0; i < jet_.dof; ++i) {
            bias_[i] = mechanism_->damping[i] * v[i] + mechanism_->stiffness[i] * (q[i] - mechanism_->rest[i]);
        }
        for (int j = 0; j < tree.size(); ++j) {
            const Body& link = tree.bodies[j];
            auto& here = jet_.body[j];
            detail::place(tree, j, q, jet_);
            detail::move(tree, j, v, jet_);
            here.inertia = placed(here.rotation, here.position, link.mass, link.center, link.inertia);
            here.momentum = here.inertia * here.velocity;
            body_[j].inertia = here.inertia;
            accelerate(j, v, nullptr);
        }
        for (int j = tree.size() - 1; j >= 0; --j) {
            const Body& link = tree.bodies[j];
            detail::project_mass(tree, j, jet_);
            bias_[link.coordinate] += link.ratio * dot(jet_.body[j].axis, body_[j].force);
            if (link.parent >= 0) {
                detail::pass_inertia(link, jet_.body[j].inertia, jet_.body[link.parent].inertia, true);
                body_[link.parent].force += body_[j].force;
            }
            if (link.origin) detail::add_potential(*mechanism_, j, q, jet_);
        }
        return factor();
    }

    // p = M v, and the energy [J].
    double energy(const double* v, double* p) const {
        const int n = jet_.dof;
        double kinetic = 0.0;
        for (const Block& block : mechanism_->tree.blocks) {
            for (int i = block.begin; i < block.end; ++i) {
                p[i] = 0.0;
                for (int j = block.begin; j < block.end; ++j) p[i] += jet_.M[i * n + j] * v[j];
                kinetic += 0.5 * v[i] * p[i];
            }
        }
        return kinetic + jet_.total_potential();
    }

    // The x with M x = b; x may be b.
    void solve_mass(const double* b, double* x) const {
        for (const Block& block : mechanism_->tree.blocks) solve_ldl(ldl_.data(), jet_.dof, block, b, x);
    }

    // The accelerations a under a force.
    void acceleration(const double* force, double* a) {
        for (int i = 0; i < jet_.dof; ++i) room_[i] = force[i] - bias_[i];
        solve_mass(room_.data(), a);
    }

    // The derivatives of inverse dynamics where the joints accelerate by a, once after at(), for what follows; v as
    // there.
    void differentiate(const double* v, const double* a) {
        const Tree& tree = mechanism_->tree;
        const int n = jet_.dof;
        detail::clear_blocks(tree, dq_);
        detail::clear_blocks(tree, dv_);
        for (int i = 0; i < n; ++i) {
            dq_[i * n + i] = mechanism_->stiffness[i];
            dv_[i * n + i] = mechanism_->damping[i];
        }
        for (int j = 0; j < tree.size(); ++j) {
            const auto& here = jet_.body[j];
            accelerate(j, v, a);
            body_[j].coupling = Coupling::of(body_[j].inertia, here.velocity, here.momentum);
            body_[j].turning = cross(acceleration_above(j), here.axis);
            const int k = tree.bodies[j].parent;
            if (k >= 0) body_[j].turning += cross(jet_.body[k].velocity, here.axis_rate);
        }
        for (int j = tree.size() - 1; j >= 0; --j) {
            project_derivatives(j);
            const int k = tree.bodies[j].parent;
            if (k >= 0) {
                body_[k].force += body_[j].force;
                body_[k].coupling += body_[j].coupling;
            }
        }
    }

    // Derivatives (n, 3n) of the accelerations in q, v and force into J, zero outside of blocks already.
    void derivatives(double* J) const {
        const int n = jet_.dof;
        for (const Block& block : mechanism_->tree.blocks) {
            const int size = block.end - block.begin;
            double* first = J + block.begin * 3 * n + block.begin;
            for (int i = 0; i < size; ++i) {
                const int from = (block.begin + i) * n + block.begin;
                double* row = first + i * 3 * n;
                for (int j = 0; j < size; ++j) {
                    row[j] = -dq_[from + j];
                    row[n + j] = -dv_[from + j];
                }
                row[2 * n + i] = 1.0;
            }
            for (int part = 0; part < 3; ++part) {
                solve_ldl_rows(ldl_.data(), n, block, first + part * n, size, 3 * n);
            }
        }
    }

    // Of one block of b coordinates: how accelerations change with what q and v (b, columns) change with, and with the
    // force itself, which the last b columns stand for: a' = M^-1 (-dq q - dv v + (0, 1)).
    void slope(Block block, const double* q, const double* v, int columns, double* a) const {
        const int n = jet_.dof, size = block.end - block.begin;
        for (int i = 0; i < size; ++i) {
            const double* in_q = dq_.data() + (block.begin + i) * n + block.begin;
            const double* in_v = dv_.data() + (block.begin + i) * n + block.begin;
            double* __restrict row = a + i * columns;
            std::fill(row, row + columns, 0.0);
            row[columns - size + i] = 1.0;
            for (int j = 0; j < size; ++j) {
                const double by_q = in_q[j], by_v = in_v[j];
                const double* __restrict row_q = q + j * columns;
                const double* __restrict row_v = v + j * columns;
                for (int c = 0; c < columns; ++c) row[c] -= by_q * row_q[c] + by_v * row_v[c];
            }
        }
        solve_ldl_rows(ldl_.data(), n, block, a, columns, columns);
    }

  private:
    struct BodyState {
        Inertia<double> inertia{};      // of the body alone
        Motion<double> acceleration{};  // A
        Motion<double> turning{};       // Z
        Force<double> force{};          // Phi
        Coupling coupling{};
    };

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

    // A and Phi of body j alone; the joints accelerate by a (n), or not at all.
    void accelerate(int j, const double* v, const double* a) {
        const Body& link = mechanism_->tree.bodies[j];
        const auto& here = jet_.body[j];
        BodyState& own = body_[j];
        own.acceleration = acceleration_above(j);
        if (a) own.acceleration += (link.ratio * a[link.coordinate]) * here.axis;
        own.acceleration += (link.ratio * v[link.coordinate]) * here.axis_rate;
        own.force = own.inertia * own.acceleration + cross(here.velocity, here.momentum);
    }

    // The share of what body j carries in dq and dv.
    void project_derivatives(int j) {
        const Tree& tree = mechanism_->tree;
        const int n = jet_.dof;
        const Body& link = tree.bodies[j];
        const auto& here = jet_.body[j];
        const BodyState& own = body_[j];
        const Force<double> F = here.inertia * here.axis;
        const Force<double> back = transposed_times(own.coupling, here.axis);
        const Force<double> by_q =
            here.inertia * own.turning + own.coupling * here.axis_rate + cross(here.axis, own.force);
        const Force<double> by_v = 2.0 * (here.inertia * here.axis_rate) + own.coupling * here.axis;
        const int cj = link.coordinate;
        for (int i = j; i >= 0; i = tree.bodies[i].parent) {
            const Body& above = tree.bodies[i];
            const auto& there = jet_.body[i];
            const int ci = above.coordinate;
            const double ratio = above.ratio * link.ratio;
            dq_[cj * n + ci] += ratio * (dot(body_[i].turning, F) + dot(there.axis_rate, back));
            dv_[cj * n + ci] += ratio * (2.0 * dot(there.axis_rate, F) + dot(there.axis, back));
            if (i == j) continue;
            dq_[ci * n + cj] += ratio * dot(there.axis, by_q);
            dv_[ci * n + cj] += ratio * dot(there.axis, by_v);
        }
    }

    const Mechanism* mechanism_;
    Jet<double> jet_;  // placements, velocities, inertias of what bodies carry, M, potential
    std::vector<BodyState> body_;
    std::vector<double> bias_, room_;
    std::vector<double> ldl_, dq_, dv_;  // (n, n), of which blocks are used
};

}  // namespace varpin
