// Explicit integrators of q' = v, M v' = force - bias (docs/mathematics.md, "Explicit methods"). One step of length h
// from (q0, v0), in the form of Nystroem: with accelerations a_i at the stages
//
//     Q_i = q0 + c_i h v0 + h^2 sum_j k_ij a_j     V_i = v0 + h sum_j l_ij a_j     (j < i)
//     q1  = q0 +     h v0 + h^2 sum_i x_i a_i      v1  = v0 + h sum_i y_i a_i
//
// The derivatives of (q1, v1) in (q0, v0, force) are the same sums of the derivatives of a_i. Noise makes the velocity
// jump by M^-1 sum_i F_i dw_i: in Euler's method beside the step, in the others before it.
// Equations (X1) and (X2) of docs/mathematics.md.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "varpin/dynamics.hpp"
#include "varpin/nodes.hpp"
#include "varpin/policy.hpp"

namespace varpin {

enum class ExplicitMethod { euler, semi_implicit, runge_kutta };

struct Nystroem {
    int stages = 1;
    double reach[4] = {};                           // c
    int abscissa[4] = {};                           // index of each stage's c among the distinct ones
    int abscissae = 1;                              // number of distinct c
    double stage_q[4][4] = {}, stage_v[4][4] = {};  // k, l
    double end_q[4] = {}, end_v[4] = {1.0};         // x, y
};

constexpr Nystroem nystroem_of(ExplicitMethod method) {
    Nystroem of;
    if (method == ExplicitMethod::semi_implicit) of.end_q[0] = 1.0;
    if (method == ExplicitMethod::runge_kutta) {
        // The classical method of fourth order.
        of = {4,
              {0.0, 0.5, 0.5, 1.0},
              {0, 1, 1, 2},
              3,
              {},
              {},
              {1.0 / 6.0, 1.0 / 6.0, 1.0 / 6.0, 0.0},
              {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0}};
        of.stage_v[1][0] = of.stage_v[2][1] = 0.5;
        of.stage_v[3][2] = 1.0;
        of.stage_q[2][0] = 0.25;
        of.stage_q[3][1] = 0.5;
    }
    return of;
}

// Explicit steps (X1) from any state, with derivatives (X2) in (q, v, force) if `derivatives`.
class ExplicitStepper {
  public:
    ExplicitStepper(const Mechanism& mechanism, ExplicitMethod method, bool derivatives)
        : q(mechanism.dof()),
          v(mechanism.dof()),
          dynamics(mechanism, derivatives),
          mechanism_(&mechanism),
          coefficients_(nystroem_of(method)),
          derivatives_(derivatives) {
        for (int i = 0; i < stages(); ++i) {
            a_[i].resize(mechanism.dof());
            for (const Block& block : mechanism.tree.blocks) {
                const int size = block.end - block.begin;
                if (derivatives) slope_[i].resize(slope_[i].size() + 3 * size * size);
            }
        }
    }

    std::vector<double> q, v;  // the state
    ForwardDynamics dynamics;  // at the state at the beginning of a step

    // Whether derivatives are in the final value of a force that grows linearly from 0 over the step.
    bool ramp = false;

    int stages() const { return coefficients_.stages; }
    // Number of distinct times of the stages.
    int abscissae() const { return coefficients_.abscissae; }

    // One step from the state of `dynamics`, under a force (n), or with a `stride` of n under forces (abscissae, n),
    // one for each time; false where a mass matrix is not positive definite.
    bool step(double h, const double* force, int stride = 0) {
        for (int i = 0; i < stages(); ++i) {
            move(h, coefficients_.reach[i], coefficients_.stage_q[i], coefficients_.stage_v[i], i, stage_q_.data(),
                 stage_v_.data());
            if (i > 0 && !dynamics.at(stage_q_.data(), stage_v_.data())) return false;
            dynamics.acceleration(force + coefficients_.abscissa[i] * stride, a_[i].data());
            if (derivatives_) differentiate(h, i);
        }
        move(h, 1.0, coefficients_.end_q, coefficients_.end_v, stages(), q.data(), v.data());
        return true;
    }

    // The same of x = (q, v), as VariationalLinearization::step; the jumps of v are M^-1 times the forces.
    Outcome step(double h, double* x, const double* force, const double* external, double* Jx, double* Jf,
                 double* spread) {
        const int n = mechanism_->dof();
        q.assign(x, x + n);
        v.assign(x + n, x + 2 * n);
        if (!dynamics.at(x, x + n)) return Outcome::singular;
        for (int turn = 0; turn < 2; ++turn) {
            for (int i = 0; i < n; ++i) dynamics.solve_mass(spread + i * n, spread + i * n);
            detail::transpose(spread, n);
        }
        for (int i = 0; i < n; ++i) sum_[i] = force[i] + (external ? external[i] : 0.0);
        if (!step(h, sum_.data())) return Outcome::singular;
        std::fill_n(Jx, 4 * n * n, 0.0);
        std::fill_n(Jf, 2 * n * n, 0.0);
        write_derivatives(h, Jx, Jf);
        std::copy_n(q.begin(), n, x);
        std::copy_n(v.begin(), n, x + n);
        return Outcome::solved;
    }

    // As VariationalLinearization::velocity.
    bool velocity(const double* x, double* to, double* slopes) const {
        const int n = mechanism_->dof();
        std::copy_n(x + n, n, to);
        for (int i = 0; i < n; ++i) slopes[i * 2 * n + n + i] = 1.0;
        return true;
    }

    // Write the derivatives of the last step in (q, v) and in the force to Jx (2n, 2n) and Jf (2n, n), whose entries
    // outside of blocks are zero already.
    void write_derivatives(double h, double* Jx, double* Jf) {
        const int n = mechanism_->dof();
        int first = 0;
        for (const Block& block : mechanism_->tree.blocks) {
            const int size = block.end - block.begin;
            for (int row = block.begin; row < block.end; ++row, first += 3 * size) {
                const auto write = [&](double scale, const double* weight, int to) {
                    std::fill_n(row_.begin(), 3 * size, 0.0);
                    for (int i = 0; i < stages(); ++i)
                        detail::subtract_scaled(row_.data(), -scale * weight[i], &slope_[i][first], 0, 3 * size);
                    double* x = Jx + to * 2 * n + block.begin;
                    std::copy_n(row_.data(), size, x);
                    std::copy_n(row_.data() + size, size, x + n);
                    std::copy_n(row_.data() + 2 * size, size, Jf + to * n + block.begin);
                };
                write(h * h, coefficients_.end_q, row);
                write(h, coefficients_.end_v, n + row);
                Jx[row * 2 * n + row] += 1.0;
                Jx[row * 2 * n + n + row] += h;
                Jx[(n + row) * 2 * n + n + row] += 1.0;
            }
        }
    }

  private:
    // Set to_q = q + reach h v + h^2 sum_i in_q[i] a_i and to_v = v + h sum_i in_v[i] a_i, with sums over `stages`.
    void move(double h, double reach, const double* in_q, const double* in_v, int stages, double* to_q,
              double* to_v) const {
        for (int r = 0; r < mechanism_->dof(); ++r) {
            double sum_q = 0.0, sum_v = 0.0;
            for (int i = 0; i < stages; ++i) {
                sum_q += in_q[i] * a_[i][r];
                sum_v += in_v[i] * a_[i][r];
            }
            to_q[r] = q[r] + h * (reach * v[r] + h * sum_q);
            to_v[r] = v[r] + h * sum_v;
        }
    }

    // Derivatives of the accelerations at stage i, the state of `dynamics`.
    void differentiate(double h, int i) {
        dynamics.differentiate(stage_v_.data(), a_[i].data());
        ForwardDynamics::Before before[4];
        for (int k = 0; k < i; ++k)
            before[k] = {nullptr, h * h * coefficients_.stage_q[i][k], h * coefficients_.stage_v[i][k]};
        int first = 0;
        for (const Block& block : mechanism_->tree.blocks) {
            const int size = block.end - block.begin;
            for (int k = 0; k < i; ++k) before[k].x = slope_[k].data() + first;
            dynamics.slope(block, slope_[i].data() + first, h * coefficients_.reach[i], before, i,
                           ramp ? coefficients_.reach[i] : 1.0);
            first += 3 * size * size;
        }
    }

    const Mechanism* mechanism_;
    Nystroem coefficients_;
    bool derivatives_;
    std::vector<double> stage_q_ = zeros(mechanism_->dof()), stage_v_ = zeros(mechanism_->dof());
    std::vector<double> sum_ = zeros(mechanism_->dof());  // of forces
    std::vector<double> a_[4];                            // (n) of each stage
    std::vector<double> slope_[4];  // their derivatives (b, 3b) in q, v and force, block after block
    std::vector<double> row_ = zeros(3, mechanism_->dof());  // one row of their sum
};

// Rollouts of P paths, each from its own state.
class ExplicitRollout {
  public:
    ExplicitRollout(const Mechanism& mechanism, ExplicitMethod method, std::int64_t paths, const double* q0,
                    const double* v0)
        : q(q0, q0 + paths * mechanism.dof()),
          v(v0, v0 + paths * mechanism.dof()),
          mechanism_(&mechanism),
          method_(method),
          paths_(paths),
          stepper_(mechanism, method, false) {
        for (std::int64_t i = 0; i < paths; ++i) diffusion_centers(mechanism, q0 + i * mechanism.dof(), center(i));
    }

    std::vector<double> q, v;  // (P, n) present states of the paths

    const Mechanism& mechanism() const { return *mechanism_; }
    std::int64_t paths() const { return paths_; }
    int dof() const { return mechanism_->dof(); }
    int abscissae() const { return stepper_.abscissae(); }

    // The node that each path starts at; false where a mass matrix is not positive definite.
    bool first_nodes(const Nodes& nodes) {
        for (std::int64_t i = 0; i < paths_; ++i) {
            load(i);
            if (enter_node(nodes, i * nodes.steps) == Outcome::singular) return false;
            nodes.done[i] = 1;
        }
        return true;
    }

    // Advance every path by N steps of length h.
    void roll(double h, const Commands& commands, const Additions& more, const Nodes& nodes) {
        const auto begin = [&](std::int64_t path) {
            load(path);
            return Entry{at_state() ? Outcome::solved : Outcome::singular, stepper_.q.data(), stepper_.v.data()};
        };
        driver_.roll(*mechanism_, commands, more, stepper_.abscissae(), nodes, begin, [&](const StepInputs& in) {
            const Outcome outcome = step(h, in, nodes);
            store(in.path);
            return outcome;
        });
    }

  private:
    double* center(std::int64_t path) { return center_.data() + path * dof() * mechanism_->diffusion.processes; }

    void load(std::int64_t path) {
        std::copy_n(q.data() + path * dof(), dof(), stepper_.q.data());
        std::copy_n(v.data() + path * dof(), dof(), stepper_.v.data());
    }
    void store(std::int64_t path) {
        std::copy_n(stepper_.q.data(), dof(), q.data() + path * dof());
        std::copy_n(stepper_.v.data(), dof(), v.data() + path * dof());
    }

    bool at_state() { return stepper_.dynamics.at(stepper_.q.data(), stepper_.v.data()); }

    // One step of a path, with its node. `dynamics` is at the path's state before and after.
    Outcome step(double h, const StepInputs& in, const Nodes& nodes) {
        const bool beside = method_ == ExplicitMethod::euler;
        const double *q = stepper_.q.data(), *v = stepper_.v.data();
        const double* drift = read_noise(*mechanism_, 1.0, q, v, center(in.path), in, own_);
        stage_forces(*mechanism_, drift, in.within ? in.within : in.u, in.within ? stepper_.abscissae() : 1,
                     force_.data());
        if (in.impulses) kick(in.impulses);
        if (in.increments) {
            noise_impulse(*mechanism_, 1.0, q, center(in.path), in.felt, in.increments, own_, jump_.data());
            stepper_.dynamics.solve_mass(jump_.data(), jump_.data());
            if (!beside) {
                add_jump();
                at_state();
            }
        }
        const bool regular = stepper_.step(h, force_.data(), in.within ? dof() : 0);
        if (in.increments && beside) add_jump();
        if (in.impulses && regular && at_state()) kick(in.impulses + dof());
        nodes.tally[in.row * 4 + 2] = stepper_.stages();
        return regular ? enter_node(nodes, in.row) : Outcome::singular;
    }

    // Apply an impulse (n) at the state, which is that of `dynamics`.
    void kick(const double* impulse) {
        stepper_.dynamics.solve_mass(impulse, jump_.data());
        add_jump();
        at_state();
    }

    void add_jump() {
        for (int r = 0; r < dof(); ++r) stepper_.v[r] += jump_[r];
    }

    // Write the state as the node of a row; `dynamics` is at the state afterwards.
    Outcome enter_node(const Nodes& nodes, std::int64_t row) {
        const bool regular = at_state();
        std::copy_n(stepper_.q.data(), dof(), nodes.q + row * dof());
        std::copy_n(stepper_.v.data(), dof(), nodes.v + row * dof());
        nodes.energy[row] = stepper_.dynamics.energy(stepper_.v.data(), nodes.p + row * dof());
        if (!std::isfinite(nodes.energy[row])) return Outcome::not_finite;
        return regular ? Outcome::solved : Outcome::singular;
    }

    const Mechanism* mechanism_;
    ExplicitMethod method_;
    std::int64_t paths_;
    std::vector<double> center_ = zeros(paths_ * dof(), mechanism_->diffusion.processes);  // of the diffusion fields
    ExplicitStepper stepper_;
    std::vector<double> force_ = zeros(stepper_.abscissae(), dof()), jump_ = zeros(dof());
    StepNoise own_;  // where Python has it
    PathDriver driver_;
};

}  // namespace varpin
