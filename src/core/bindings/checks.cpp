// The error of a finished motion.
#include <utility>

#include "arrays.hpp"
#include "units.hpp"
#include "varpin/clearance.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

Stretch stretch_of(In<3> curves, In<3> sums, In<2> places) {
    const std::size_t steps = sums.shape(1), points = sums.shape(2), all = places.shape(1);
    if (steps == 0 || points < 2 || (points - 1) % steps != 0 || all % steps != 0)
        throw std::invalid_argument("a stretch needs its nodes evenly among its points, and its steps the same stages");
    require(curves, "curves", {2, points, 3 * (steps + 1)});
    require(sums, "sums", {2, steps, points});
    require(places, "places", {points, all});
    return {
        static_cast<int>(steps), static_cast<int>(points), static_cast<int>(all / steps), copied(curves), copied(sums),
        copied(places)};
}

Out propagated_errors(const Mechanism& mechanism, In<2> q, In<2> v, In<2> u, In<3> within, double dt,
                      const Stretch& narrow, const Stretch* wide, bool damped, In<1> most_q, In<1> most_v) {
    const auto n = static_cast<std::size_t>(mechanism.dof()), m = static_cast<std::size_t>(mechanism.controls);
    const std::size_t steps = u.shape(0), stages = within.shape(1);
    require_each({steps + 1, n}, "q", q, "v", v);
    require_each({n}, "most_q", most_q, "most_v", most_v);
    require(u, "u", {steps, m});
    require(within, "within", {steps, stages, m});
    if (!(dt > 0.0)) throw std::invalid_argument("dt must be positive");
    if (narrow.steps != 1 || (wide && wide->steps != 2))
        throw std::invalid_argument("narrow and wide must be stretches of one step and of two");
    if (static_cast<std::size_t>(narrow.stages) != stages || (wide && wide->stages != narrow.stages))
        throw std::invalid_argument("narrow and wide must have the stages of the controls");
    std::vector<double> found;
    {
        nb::gil_scoped_release release;
        const Record record{static_cast<std::int64_t>(steps), q.data(), v.data(), u.data(), dt};
        Clearance clearance(mechanism, record, stages > 0 ? within.data() : nullptr, narrow, wide, damped);
        found = clearance.errors(most_q.data(), most_v.data());
    }
    return array_of(found.data(), {n});
}

}  // namespace

void register_checks(nb::module_& m) {
    nb::class_<Stretch>(m, "Stretch").def_static("make", &stretch_of, nb::kw_only(), "curves"_a, "sums"_a, "places"_a);
    m.def("propagated_errors", &propagated_errors, "mechanism"_a, "q"_a, "v"_a, "u"_a, "within"_a, "dt"_a,
          nb::kw_only(), "narrow"_a, "wide"_a.none(), "damped"_a, "most_q"_a, "most_v"_a);
}

}  // namespace varpin::border
