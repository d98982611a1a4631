// Steps of the variational integrators and their derivatives, for sizes known at compile time or at run time.
// docs/core.md, "Processors".
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "varpin/linearization.hpp"
#include "varpin/variational.hpp"

namespace varpin::border {

struct Stepping {
    virtual ~Stepping() = default;
    virtual bool begin(const double* q, const double* v, PathState& state) = 0;
    virtual void kick(const double* impulse, PathState& state) = 0;
    virtual void roll(const Guards& guards, double h, const Commands& commands, const double* increments,
                      const double* drift, const double* impulses, std::vector<PathState>& states, const Nodes& nodes,
                      Watch* watch) = 0;
};

struct Differentiation {
    virtual ~Differentiation() = default;
    virtual Outcome first(double h, const double* q, const double* p, const double* guess, const double* force,
                          bool varies, bool ramp, std::span<const std::uint8_t> halvings, double* Jx, double* Jf,
                          int past) = 0;
};

template <class Size, class Stages>
struct SteppingOf final : Stepping {
    SteppingOf(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards, double left,
               Solver solver)
        : core(mechanism, tableau, tolerance, guards, left, solver) {}

    VariationalStepper<Size, Stages> core;

    bool begin(const double* q, const double* v, PathState& state) override { return core.begin(q, v, state); }
    void kick(const double* impulse, PathState& state) override {
        core.look_at(state);
        core.kick(impulse, state);
    }
    void roll(const Guards& guards, double h, const Commands& commands, const double* increments, const double* drift,
              const double* impulses, std::vector<PathState>& states, const Nodes& nodes, Watch* watch) override {
        core.guards = guards;
        core.roll(h, commands, increments, drift, impulses, states, nodes, watch);
    }
};

template <class Size, class Stages>
struct DifferentiationOf final : Differentiation {
    DifferentiationOf(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                      Solver solver)
        : core(mechanism, tableau, tolerance, guards, solver) {}

    VariationalLinearization<Size, Stages> core;

    Outcome first(double h, const double* q, const double* p, const double* guess, const double* force, bool varies,
                  bool ramp, std::span<const std::uint8_t> halvings, double* Jx, double* Jf, int past) override {
        core.varies = varies;
        core.ramp = ramp;
        return core.first(h, q, p, guess, force, halvings, Jx, Jf, past);
    }
};

// Stepping with a size known at compile time, for arms and methods with one stage; null if there is none.
std::unique_ptr<Stepping> small_stepping(const Mechanism& mechanism, const Tableau& tableau, double tolerance,
                                         const Guards& guards, double left, Solver solver);
std::unique_ptr<Differentiation> small_differentiation(const Mechanism& mechanism, const Tableau& tableau,
                                                       double tolerance, const Guards& guards, Solver solver);

}  // namespace varpin::border
