// Input and output of a rollout at the border: the Python named tuples Commands and RolloutArrays, checked and
// converted to those of policy.hpp and nodes.hpp. docs/core.md, "The map".
#pragma once

#include <cstdint>
#include <optional>
#include <stdexcept>

#include "arrays.hpp"
#include "varpin/nodes.hpp"
#include "varpin/policy.hpp"

namespace varpin::border {

// The nodes of `paths` paths.
inline Nodes nodes_of(const Mechanism& mechanism, nb::handle nodes, std::size_t paths) {
    const auto n = static_cast<std::size_t>(mechanism.dof()), m = static_cast<std::size_t>(mechanism.controls);
    const std::size_t P = paths, N = field<InOut<3>>(nodes, "q").shape(1);
    return {.paths = static_cast<std::int64_t>(P),
            .steps = static_cast<std::int64_t>(N),
            .q = field<InOut<3>>(nodes, "q", {P, N, n}),
            .p = field<InOut<3>>(nodes, "p", {P, N, n}),
            .v = field<InOut<3>>(nodes, "v", {P, N, n}),
            .energy = field<InOut<2>>(nodes, "energy", {P, N}),
            .u = field<InOut<3>>(nodes, "u", {P, N, m}),
            .tally = field<IntegersInOut<3>>(nodes, "tally", {P, N, 4}),
            .quality = field<InOut<3>>(nodes, "quality", {P, N, 3}),
            .ended = field<IntegersInOut<1>>(nodes, "ended", {P}),
            .done = field<IntegersInOut<1>>(nodes, "done", {P})};
}

// Commands for P paths over N steps; controls that change within steps are given at s stages.
inline Commands commands_of(const Mechanism& mechanism, nb::handle commands, std::size_t P, std::size_t N,
                            std::size_t s) {
    const auto n = static_cast<std::size_t>(mechanism.dof()), m = static_cast<std::size_t>(mechanism.controls);
    const auto own = nb::cast<std::size_t>(commands.attr("own"));
    const std::size_t R = own > 0 ? own : field<In<2>>(commands, "u").shape(0),
                      width = field<In<3>>(commands, "gains").shape(2);
    const int hold = nb::cast<int>(commands.attr("hold"));
    if (hold < 1 || R * static_cast<std::size_t>(hold) != N)
        throw std::invalid_argument("commands and nodes have different numbers of steps");
    const double* limits = field<In<2>>(commands, "limits", {2, m});
    Commands out{.controls = static_cast<int>(m),
                 .hold = hold,
                 .u = field<In<2>>(commands, "u", {own > 0 ? P * own : R, m}),
                 .gains = optional_field<In<3>>(commands, "gains", {R, m, width}),
                 .width = static_cast<int>(width),
                 .least = limits,
                 .greatest = limits + m,
                 .before = optional_field<In<2>>(commands, "before", {P, m}),
                 .within = optional_field<In<3>>(commands, "within", {N, s, m}),
                 .stage_times = optional_field<In<1>>(commands, "stage_times", {s}),
                 .own = static_cast<std::ptrdiff_t>(own)};
    if (out.gains && width != 2 * n && width != 2 * n + m)
        throw std::invalid_argument("gains must have a column for each of (q, p) or (q, p, previous control)");
    if (out.gains) out.reference = field<In<2>>(commands, "reference", {R, width});
    if (out.stage_times && ((!out.before && N > 0) || out.within))
        throw std::invalid_argument("linear controls need the control before the first step, and none at stages");
    if (out.within && (out.gains || hold != 1))
        throw std::invalid_argument("controls that change within a step allow neither feedback nor a hold");
    return out;
}

// Roll `paths` paths: calls move(commands, additions, nodes) without the interpreter's lock, after all checks. `stages`
// is the number of stages at which controls may change within a step. Increments (P, N, K), for as many processes as
// the commands see, and the drift (P, N, n) may be left out as (0, 0, .), impulses (P, N, 2, n) as None.
template <class Move>
void roll_paths(const Mechanism& mechanism, std::size_t paths, int stages, nb::handle commands, const In<3>& increments,
                const In<3>& drift, const std::optional<In<4>>& impulses, nb::handle nodes, const Move& move) {
    const Nodes to = nodes_of(mechanism, nodes, paths);
    const auto N = static_cast<std::size_t>(to.steps);
    Commands view = commands_of(mechanism, commands, paths, N, static_cast<std::size_t>(stages));
    view.sloped = view.stage_times && increments.shape(2) > static_cast<std::size_t>(mechanism.diffusion.processes);
    const auto n = static_cast<std::size_t>(mechanism.dof());
    const auto width = static_cast<std::size_t>(increments_of_step(mechanism, view));
    Additions more;
    if (given(increments, "increments", {paths, N, width}) && width > 0) more.increments = increments.data();
    if (given(drift, "drift", {paths, N, n})) more.drift = drift.data();
    if (impulses) {
        require(*impulses, "impulses", {paths, N, 2, n});
        more.impulses = impulses->data();
    }
    nb::gil_scoped_release release;
    move(view, more, to);
}

}  // namespace varpin::border
