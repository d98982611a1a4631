// The Python module of the core.
#include "units.hpp"

NB_MODULE(_core, m) {
    m.doc() = "The compiled core.";
    // A user's function may refer to the scene that owns it; such cycles at the exit of Python are no leaks.
    nanobind::set_leak_warnings(false);
    varpin::border::register_mechanism(m);
    varpin::border::register_explicit(m);
    varpin::border::register_backward(m);
    varpin::border::register_rollouts(m);
    varpin::border::register_costs(m);
    varpin::border::register_filter(m);
}
