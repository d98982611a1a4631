// Explicit integrators of q' = v, M v' = force - bias (docs/mathematics.md, "Noise"), one step of length h:
//
//     Euler                 q1 = q0 + h v0,  v1 = v0 + h a(q0, v0)
//     semi-implicit Euler   v1 = v0 + h a(q0, v0),  q1 = q0 + h v1
//     Runge and Kutta       the classical four stages
//
// Derivatives of (q, v) follow the same stages as (q, v) itself. Noise makes the velocity jump by M^-1 sum_i F_i dw_i:
// in Euler's method beside the step, in the others before it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "varpin/dynamics.hpp"
#include "varpin/nodes.hpp"
#include "varpin/policy.hpp"

namespace varpin {

enum class ExplicitMethod { euler, semi_implicit, runge_kutta };

// What moves with q' = v, v' = a through the stages of a step: a state, or derivatives of one.
struct Flow {
    explicit Flow(int size) : q(size), v(size), stage_q(size), stage_v(size), stage_a(size), sum_q(size), sum_v(size) {}

    std::vector<double> q, v;                       // at the beginning, then at the end of the step
    std::vector<double> stage_q, stage_v, stage_a;  // at a stage
    std::vector<double> sum_q, sum_v;               // of what stages add

    int size() const { return static_cast<int>(q.size()); }

    void begin() {
        stage_q = q;
        stage_v = v;
        std::fill(sum_q.begin(), sum_q.end(), 0.0);
        std::fill(sum_v.begin(), sum_v.end(), 0.0);
    }

    // Enter the slopes of this stage with a weight, and go where the next one is.
    void pass(double weight, double ahead) {
        for (int i = 0; i < size(); ++i) {
            sum_q[i] += weight * stage_v[i];
            sum_v[i] += weight * stage_a[i];
            stage_q[i] = q[i] + ahead * stage_v[i];
            stage_v[i] = v[i] + ahead * stage_a[i];
        }
    }

    void end() {
        for (int i = 0; i < size(); ++i) {
            q[i] += sum_q[i];
            v[i] += sum_v[i];
        }
    }

    void euler(double h) {
        for (int i = 0; i < size(); ++i) {
            q[i] += h * v[i];
            v[i] += h * stage_a[i];
        }
    }

    void semi_implicit(double h) {
        for (int i = 0; i < size(); ++i) {
            v[i] += h * stage_a[i];
            q[i] += h * v[i];
        }
    }
};

// One step after another from any state; with derivatives in (q, v, force), if asked for.
class ExplicitStepper {
  public:
    ExplicitStepper(const Mechanism& mechanism, ExplicitMethod method, bool derivatives)
        : state(mechanism.dof()),
          dynamics(mechanism),
          mechanism_(&mechanism),
          method_(method),
          derivatives_(derivatives),
          tangent_(derivatives ? tangent_size(mechanism.tree) : 0) {}

    Flow state;                // of which q and v are the state
    ForwardDynamics dynamics;  // at the state, when a step begins

    int stages() const { return method_ == ExplicitMethod::runge_kutta ? 4 : 1; }

    // From the state that `dynamics` is at; false where a mass matrix on the way is not positive definite.
    bool step(double h, const double* force) {
        begin();
        if (method_ == ExplicitMethod::runge_kutta) return runge_kutta(h, force);
        slopes(force);
        if (method_ == ExplicitMethod::euler) {
            each([h](Flow& flow) { flow.euler(h); });
        } else {
            each([h](Flow& flow) { flow.semi_implicit(h); });
        }
        return true;
    }

    // The derivatives of the last step into J (2n, 3n), zero outside of blocks already.
    void write_derivatives(double* J) const {
        const int n = state.size();
        int first = 0;
        for (const Block& block : mechanism_->tree.blocks) {
            const int size = block.end - block.begin;
            for (int i = 0; i < size; ++i) {
                for (int part = 0; part < 3; ++part) {
                    const int from = first + i * 3 * size + part * size;
                    const int to = (block.begin + i) * 3 * n + part * n + block.begin;
                    std::copy_n(&tangent_.q[from], size, J + to);
                    std::copy_n(&tangent_.v[from], size, J + n * 3 * n + to);
                }
            }
            first += 3 * size * size;
        }
    }

  private:
    // Of each block of b coordinates derivatives (b, 3b) in its q, v and force, block after block.
    static int tangent_size(const Tree& tree) {
        int size = 0;
        for (const Block& block : tree.blocks) size += 3 * (block.end - block.begin) * (block.end - block.begin);
        return size;
    }

    template <class Change>
    void each(Change change) {
        change(state);
        if (derivatives_) change(tangent_);
    }

    void begin() {
        if (derivatives_) {
            std::fill(tangent_.q.begin(), tangent_.q.end(), 0.0);
            std::fill(tangent_.v.begin(), tangent_.v.end(), 0.0);
            int first = 0;
            for (const Block& block : mechanism_->tree.blocks) {
                const int size = block.end - block.begin;
                for (int i = 0; i < size; ++i) {
                    tangent_.q[first + i * 3 * size + i] = 1.0;
                    tangent_.v[first + i * 3 * size + size + i] = 1.0;
                }
                first += 3 * size * size;
            }
        }
        each([](Flow& flow) { flow.begin(); });
    }

    // Accelerations at the stage that `dynamics` is at.
    void slopes(const double* force) {
        dynamics.acceleration(force, state.stage_a.data());
        if (!derivatives_) return;
        dynamics.differentiate(state.stage_v.data(), state.stage_a.data());
        int first = 0;
        for (const Block& block : mechanism_->tree.blocks) {
            const int size = block.end - block.begin;
            dynamics.slope(block, &tangent_.stage_q[first], &tangent_.stage_v[first], 3 * size,
                           &tangent_.stage_a[first]);
            first += 3 * size * size;
        }
    }

    bool runge_kutta(double h, const double* force) {
        constexpr double shares[4] = {6.0, 3.0, 3.0, 6.0}, reach[4] = {0.5, 0.5, 1.0, 0.0};
        for (int stage = 0; stage < 4; ++stage) {
            if (stage > 0 && !dynamics.at(state.stage_q.data(), state.stage_v.data())) return false;
            slopes(force);
            each([&](Flow& flow) { flow.pass(h / shares[stage], reach[stage] * h); });
        }
        each([](Flow& flow) { flow.end(); });
        return true;
    }

    const Mechanism* mechanism_;
    ExplicitMethod method_;
    bool derivatives_;
    Flow tangent_;
};

// P paths on their way, each from its own state.
class ExplicitRollout {
  public:
    ExplicitRollout(const Mechanism& mechanism, ExplicitMethod method, std::int64_t paths, const double* q0,
                    const double* v0)
        : q(q0, q0 + paths * mechanism.dof()),
          v(v0, v0 + paths * mechanism.dof()),
          mechanism_(&mechanism),
          method_(method),
          paths_(paths),
          center_(q.size() * mechanism.diffusion.processes),
          stepper_(mechanism, method, false),
          force_(mechanism.dof()),
          jump_(mechanism.dof()) {
        for (std::int64_t i = 0; i < paths; ++i) diffusion_centers(mechanism, q0 + i * mechanism.dof(), center(i));
    }

    std::vector<double> q, v;  // (P, n) where the paths stand

    std::int64_t paths() const { return paths_; }
    int dof() const { return mechanism_->dof(); }

    // The node that each path starts at; false where a mass matrix is not positive definite.
    bool first_nodes(const Nodes& nodes) {
        for (std::int64_t i = 0; i < paths_; ++i) {
            load(i);
            if (enter_node(nodes, i, 0) == Outcome::singular) return false;
            nodes.done[i] = 1;
        }
        return true;
    }

    // All steps, each of length h. Increments (P, N, k) and a drift (P, N, n) on top of the controls' force are null
    // for none.
    void roll(double h, const Commands& commands, const double* increments, const double* drift, const Nodes& nodes) {
        for (std::int64_t i = 0; i < paths_; ++i) {
            load(i);
            nodes.done[i] = 0;
            Outcome outcome = Outcome::solved;
            bool regular = at_state();
            for (std::int64_t s = 0; s < nodes.steps && outcome == Outcome::solved; ++s) {
                const std::int64_t row = i * nodes.steps + s;
                const double* dw = increments ? increments + row * mechanism_->diffusion.processes : nullptr;
                outcome = step(h, commands, dw, drift ? drift + row * dof() : nullptr, regular, nodes, i, s);
                if (outcome == Outcome::solved) nodes.done[i] = s + 1;
            }
            nodes.ended[i] = static_cast<std::int64_t>(outcome);
            store(i);
        }
    }

  private:
    double* center(std::int64_t path) { return center_.data() + path * dof() * mechanism_->diffusion.processes; }

    void load(std::int64_t path) {
        std::copy_n(q.data() + path * dof(), dof(), stepper_.state.q.data());
        std::copy_n(v.data() + path * dof(), dof(), stepper_.state.v.data());
    }
    void store(std::int64_t path) {
        std::copy_n(stepper_.state.q.data(), dof(), q.data() + path * dof());
        std::copy_n(stepper_.state.v.data(), dof(), v.data() + path * dof());
    }

    bool at_state() { return stepper_.dynamics.at(stepper_.state.q.data(), stepper_.state.v.data()); }

    // One step of a path, with its node; the dynamics are at its state before and after.
    Outcome step(double h, const Commands& commands, const double* dw, const double* drift, bool regular,
                 const Nodes& nodes, std::int64_t path, std::int64_t s) {
        const int n = dof(), m = mechanism_->controls;
        std::vector<double>& at_q = stepper_.state.q;
        std::vector<double>& at_v = stepper_.state.v;
        double* u = nodes.u + path * nodes.steps * m;
        apply_policy(commands, path, s, n, at_q.data(), at_v.data(), u);
        u += s * m;
        constant_force(*mechanism_, drift, u, force_.data());
        if (!regular) return Outcome::singular;
        const bool beside = method_ == ExplicitMethod::euler;
        if (dw) {
            noise_impulse(*mechanism_, 1.0, at_q.data(), center(path), u, dw, jump_.data());
            stepper_.dynamics.solve_mass(jump_.data(), jump_.data());
            if (!beside) {
                add_jump();
                at_state();
            }
        }
        regular = stepper_.step(h, force_.data());
        if (dw && beside) add_jump();
        nodes.tally[(path * nodes.steps + s) * 4 + 2] = stepper_.stages();
        return regular ? enter_node(nodes, path, s) : Outcome::singular;
    }

    void add_jump() {
        for (int r = 0; r < dof(); ++r) stepper_.state.v[r] += jump_[r];
    }

    // Enter the state as node s of a path; the dynamics are at it then.
    Outcome enter_node(const Nodes& nodes, std::int64_t path, std::int64_t s) {
        const std::int64_t row = path * nodes.steps + s;
        const bool regular = at_state();
        std::copy_n(stepper_.state.q.data(), dof(), nodes.q + row * dof());
        std::copy_n(stepper_.state.v.data(), dof(), nodes.v + row * dof());
        nodes.energy[row] = stepper_.dynamics.energy(stepper_.state.v.data(), nodes.p + row * dof());
        if (!std::isfinite(nodes.energy[row])) return Outcome::not_finite;
        return regular ? Outcome::solved : Outcome::singular;
    }

    const Mechanism* mechanism_;
    ExplicitMethod method_;
    std::int64_t paths_;
    std::vector<double> center_;  // (P, n, k) of the diffusion fields
    ExplicitStepper stepper_;
    std::vector<double> force_, jump_;
};

}  // namespace varpin
