// The output of a rollout of P paths over N steps: the node after each step, and solver statistics.
// docs/core.md, "The map".
#pragma once

#include <cstdint>

namespace varpin {

// The reason for the end of a path's rollout; Python has the messages.
enum class Outcome : std::int64_t {
    solved = 0,
    diverged = 1,    // a correction exceeded half of the one before
    not_finite = 2,  // the state, or the step equation
    fold = 3,        // another branch of the step equation's solutions
    energy = 4,      // the energy balance of the step does not close
    singular = 5,    // the mass matrix is not positive definite
    toggle = 6,      // the constraints are about to become dependent, or to cease to be
    assembly = 7,    // the constraints turn so far in the step that it may end in another assembly
};

// Views of arrays (P, N, ...), row by row.
struct Nodes {
    std::int64_t paths = 0;
    std::int64_t steps = 0;
    double* q = nullptr;            // (P, N, n)
    double* p = nullptr;            // (P, N, n)
    double* v = nullptr;            // (P, N, n)
    double* energy = nullptr;       // (P, N) [J]
    double* u = nullptr;            // (P, N, m) controls applied
    std::int64_t* tally = nullptr;  // (P, N, 4) Newton iterations, jets, first-order sweeps, substeps
    double* quality = nullptr;      // (P, N, 3) worst scaled residual, smallest branch margin, energy error so far [J]
    std::int64_t* ended = nullptr;  // (P) an Outcome
    std::int64_t* done = nullptr;   // (P) steps
};

}  // namespace varpin
