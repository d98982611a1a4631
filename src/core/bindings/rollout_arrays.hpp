// Input and output of a rollout at the border: the Python named tuples Commands and RolloutArrays, checked and
// converted to those of policy.hpp and nodes.hpp. docs/core.md, "The map".
#pragma once

#include <cstdint>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>

#include "arrays.hpp"
#include "varpin/nodes.hpp"
#include "varpin/policy.hpp"

namespace varpin::border {

// An array of a named tuple. It is never converted, so that its owner sees what is written to it.
template <class Array>
Array field(nb::handle record, const char* name) {
    Array array;
    if (!nb::try_cast(record.attr(name), array, false)) {
        throw nb::type_error((std::string(name) + " is no contiguous array of the right kind").c_str());
    }
    return array;
}

// Nodes of P paths over N steps.
class NodeArrays {
  public:
    NodeArrays(const Mechanism& mechanism, nb::handle nodes)
        : q(field<InOut<3>>(nodes, "q")),
          p(field<InOut<3>>(nodes, "p")),
          v(field<InOut<3>>(nodes, "v")),
          energy(field<InOut<2>>(nodes, "energy")),
          u(field<InOut<3>>(nodes, "u")),
          tally(field<IntegersInOut<3>>(nodes, "tally")),
          quality(field<InOut<3>>(nodes, "quality")),
          ended(field<IntegersInOut<1>>(nodes, "ended")),
          done(field<IntegersInOut<1>>(nodes, "done")) {
        const auto n = static_cast<std::size_t>(mechanism.dof()), m = static_cast<std::size_t>(mechanism.controls);
        const std::size_t P = paths(), N = steps();
        require_each({P, N, n}, "q", q, "p", p, "v", v);
        require(energy, "energy", {P, N});
        require(u, "u", {P, N, m});
        require(tally, "tally", {P, N, 4});
        require(quality, "quality", {P, N, 3});
        require_each({P}, "ended", ended, "done", done);
    }

    std::size_t paths() const { return q.shape(0); }
    std::size_t steps() const { return q.shape(1); }
    void require_paths(std::size_t wanted) const {
        if (paths() != wanted) throw std::invalid_argument("the nodes have another number of paths");
    }
    Nodes view() const {
        return {static_cast<std::int64_t>(paths()),
                static_cast<std::int64_t>(steps()),
                q.data(),
                p.data(),
                v.data(),
                energy.data(),
                u.data(),
                tally.data(),
                quality.data(),
                ended.data(),
                done.data()};
    }

  private:
    InOut<3> q, p, v;
    InOut<2> energy;
    InOut<3> u;
    IntegersInOut<3> tally;
    InOut<3> quality;
    IntegersInOut<1> ended, done;
};

// Commands for P paths over N steps; controls that change within steps are given at `stages` stages.
class CommandArrays {
  public:
    CommandArrays(const Mechanism& mechanism, nb::handle commands, std::size_t paths, std::size_t steps, int stages)
        : u(field<In<2>>(commands, "u")),
          gains(field<In<3>>(commands, "gains")),
          reference(field<In<2>>(commands, "reference")),
          limits(field<In<2>>(commands, "limits")),
          before(field<In<2>>(commands, "before")),
          within(field<In<3>>(commands, "within")),
          stage_times(field<In<1>>(commands, "stage_times")),
          hold(nb::cast<int>(commands.attr("hold"))),
          own(nb::cast<std::size_t>(commands.attr("own"))) {
        const auto n = static_cast<std::size_t>(mechanism.dof()), m = static_cast<std::size_t>(mechanism.controls);
        const std::size_t decisions = own > 0 ? own : u.shape(0), width = gains.shape(2);
        if (hold < 1 || decisions * static_cast<std::size_t>(hold) != steps)
            throw std::invalid_argument("commands and nodes have different numbers of steps");
        require(u, "u", {own > 0 ? paths * own : decisions, m});
        feedback = given(gains, "gains", {decisions, m, width}) && decisions > 0;
        if (feedback) {
            if (width != 2 * n && width != 2 * n + m)
                throw std::invalid_argument("gains must have a column for each of (q, p) or (q, p, previous control)");
            require(reference, "reference", {decisions, width});
        }
        require(limits, "limits", {2, m});
        earlier = given(before, "before", {paths, m});
        linear = stage_times.shape(0) > 0;
        if (linear) {
            require(stage_times, "stage_times", {static_cast<std::size_t>(stages)});
            if (!earlier && steps > 0)
                throw std::invalid_argument("linear controls need the control before the first step");
            if (within.shape(0) > 0) throw std::invalid_argument("controls are either linear or given at stages");
        }
        if (within.shape(0) == 0) return;
        require(within, "within", {steps, static_cast<std::size_t>(stages), m});
        if (feedback || hold != 1)
            throw std::invalid_argument("controls that change within a step allow neither feedback nor a hold");
        changing = true;
    }

    Commands view() const {
        const int m = static_cast<int>(u.shape(1));
        return {m,
                hold,
                u.data(),
                feedback ? gains.data() : nullptr,
                feedback ? reference.data() : nullptr,
                static_cast<int>(gains.shape(2)),
                limits.data(),
                limits.data() + m,
                earlier ? before.data() : nullptr,
                changing ? within.data() : nullptr,
                linear ? stage_times.data() : nullptr,
                static_cast<std::ptrdiff_t>(own)};
    }

  private:
    In<2> u;
    In<3> gains;
    In<2> reference, limits, before;
    In<3> within;
    In<1> stage_times;
    int hold;
    std::size_t own;        // decisions of each path where it has controls of its own, else 0
    bool feedback = false;  // whether there are gains
    bool earlier = false;   // whether the controls before the first step are known
    bool changing = false;  // whether controls change within steps
    bool linear = false;    // whether controls are linear over the steps of each decision
};

// Roll `paths` paths: calls move(commands, additions, nodes) without the interpreter's lock, after all checks. `stages`
// is the number of stages at which controls may change within a step. Increments (P, N, K), for as many processes as
// the commands see, and the drift (P, N, n) may be left out as (0, 0, .), impulses (P, N, 2, n) as None.
template <class Move>
void roll_paths(const Mechanism& mechanism, std::size_t paths, int stages, nb::handle commands, const In<3>& increments,
                const In<3>& drift, const std::optional<In<4>>& impulses, nb::handle nodes, const Move& move) {
    const NodeArrays to(mechanism, nodes);
    to.require_paths(paths);
    const CommandArrays by(mechanism, commands, paths, to.steps(), stages);
    Commands view = by.view();
    view.sloped = view.stage_times && increments.shape(2) > static_cast<std::size_t>(mechanism.diffusion.processes);
    const auto n = static_cast<std::size_t>(mechanism.dof());
    const auto width = static_cast<std::size_t>(increments_of_step(mechanism, view));
    Additions more;
    if (given(increments, "increments", {paths, to.steps(), width}) && width > 0) more.increments = increments.data();
    if (given(drift, "drift", {paths, to.steps(), n})) more.drift = drift.data();
    if (impulses) {
        require(*impulses, "impulses", {paths, to.steps(), 2, n});
        more.impulses = impulses->data();
    }
    nb::gil_scoped_release release;
    move(view, more, to.view());
}

}  // namespace varpin::border
