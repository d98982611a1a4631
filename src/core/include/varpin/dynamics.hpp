// Forward dynamics and its derivatives, for the integrators on (q, v). docs/mathematics.md, "Explicit methods";
// equation (X3). Inverse dynamics is tau = d(L_v)/dt - L_q. Along (v, a), the rate of (q, v), the jet changes by dM and
// dA, and
//
//     tau_q = dA - L_qq        tau_v = dM + A - A'
#pragma once

#include <algorithm>
#include <optional>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/elimination.hpp"
#include "varpin/jet.hpp"
#include "varpin/mechanism.hpp"
#include "varpin/spatial.hpp"

namespace varpin {

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
        along_.emplace(mechanism.tree);
        mechanism.couplings.fit(along_->couplings);
        slopes_.resize(entries(n, 2 * n));
        if (mechanism.couplings.pushes()) {
            for (auto* matrix : {&coupled_q_, &coupled_v_}) matrix->resize(n * n);
        }
    }

    int dof() const { return jet_.dof; }

    // Mass matrix, its factors, bias and energies at (q, v), the state of the calls below; false where the mass matrix
    // is not positive definite.
    bool at(const double* q, const double* v) {
        const Tree& tree = mechanism_->tree;
        detail::clear_first(jet_.dof, jet_);
        if (!articulated_) detail::clear_blocks(tree, jet_.dof, jet_.M);
        detail::add_elements(*mechanism_, q, jet_, 1);
        for (int c = 0; c < jet_.dof; ++c) bias_[c] = -jet_.Lq[c];
        std::copy_n(q, jet_.dof, q_.data());
        std::copy_n(v, jet_.dof, v_.data());
        for (int j = 0; j < tree.size(); ++j) {
            const Body& link = tree.bodies[j];
            auto& here = jet_.body[j];
            detail::place_body(tree, j, q, jet_);
            detail::move(tree, j, v, jet_);
            here.inertia = placed(here.rotation, here.position, link.mass, link.center, link.inertia);
            here.momentum = here.inertia * here.velocity;
            if (articulated_) articulated_->set_body(j, link.ratio * here.axis, here.inertia);
            BodyState& own = body_[j];
            own.acceleration =
                link.parent < 0 ? Motion<double>{-1.0 * mechanism_->gravity, {}} : body_[link.parent].acceleration;
            own.acceleration += (link.ratio * v[link.coordinate]) * here.axis_rate;
            own.force = here.inertia * own.acceleration + cross(here.velocity, here.momentum);
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
                detail::project_mass(tree, j, jet_.dof, jet_);
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

    // The derivatives of inverse dynamics at accelerations a, (X3), once after `acceleration`; for the calls below.
    void differentiate(const double* a) {
        const int n = jet_.dof;
        for (int c = 0; c < n; ++c) {
            at_q_[c] = {q_[c], v_[c]};
            at_v_[c] = {v_[c], a[c]};
        }
        Jet<Dual>& along = *along_;
        lagrangian_jet(*mechanism_, at_q_.data(), at_v_.data(), along);
        for (const Block& block : mechanism_->tree.blocks) {
            for (int i = block.begin; i < block.end; ++i) {
                double* row = slopes_.data() + i * 2 * n;
                for (int k = block.begin; k < block.end; ++k) {
                    const Dual A = along.A[i * n + k];
                    row[k] = along.Lqq[i * n + k].value - A.slope;
                    row[n + k] = along.A[k * n + i].value - A.value - along.M[i * n + k].slope;
                    if (coupled_q_.empty()) continue;
                    row[k] += coupled_q_[i * n + k];
                    row[n + k] += coupled_v_[i * n + k];
                }
                row[i] += acting_[i].by_q;
                row[n + i] += acting_[i].by_v;
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
        Motion<double> acceleration{};  // A, without those of joints
        Force<double> force{};          // Phi
    };

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

    const Mechanism* mechanism_;
    Jet<double> jet_;  // placements, velocities, inertias of subtrees, M, potential
    std::vector<BodyState> body_;
    std::vector<double> q_ = zeros(jet_.dof), v_ = zeros(jet_.dof);
    std::vector<JointForce<double>> acting_;     // (n) of elements, at the last force
    std::vector<double> coupled_q_, coupled_v_;  // (n, n) of couplings, for derivatives
    std::optional<Jet<Dual>> along_;             // the jet along (v, a), for derivatives
    std::vector<Dual> at_q_ = std::vector<Dual>(jet_.dof), at_v_ = at_q_;
    std::vector<double> bias_ = zeros(jet_.dof), room_ = zeros(jet_.dof);
    std::optional<ArticulatedBodies> articulated_;    // in place of M
    std::vector<double> momentum_ = zeros(jet_.dof);  // with articulated bodies only
    std::vector<double> ldl_;                         // (n, n) factors of M
    std::vector<double> slopes_;                      // (n, 2n) of inverse dynamics in (q, v), their negatives
};

}  // namespace varpin
