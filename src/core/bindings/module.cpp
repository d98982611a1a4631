// What Python sees of the core: one registration for each idea.
#include "registrations.hpp"

NB_MODULE(_core, m) {
    m.doc() = "The compiled core.";
    // A function of the user's own may hold the scene that holds it: what is left then when Python ends is no mistake.
    nanobind::set_leak_warnings(false);
    varpin::border::register_mechanism(m);
    varpin::border::register_kinematics(m);
    varpin::border::register_elimination(m);
    varpin::border::register_explicit(m);
    varpin::border::register_backward(m);
    varpin::border::register_rollouts(m);
    varpin::border::register_constrained(m);
    varpin::border::register_look(m);
    varpin::border::register_costs(m);
}
