// Steppers under holonomic constraints, and the derivatives of their steps.
#include <cstdint>
#include <memory>
#include <tuple>
#include <vector>

#include "steps_at.hpp"
#include "units.hpp"
#include "varpin/constrained_linearization.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

auto constrained_derivatives(const StepsAt& at, In<2> places, In<2> rates, bool ramp, bool external,
                             const Parameters* parameters) {
    const auto stages = static_cast<std::size_t>(at.tableau.stages);
    require(places, "places", {stages + 1, stages});
    const std::vector<double> t(places.data(), places.data() + places.size());
    ConstrainedLinearization work(at.mechanism, at.tableau, t, at.tolerance, at.guards, kernels_of(at.mechanism));
    work.varies = at.varies;
    work.ramp = ramp;
    if (external) work.take_external();
    const std::size_t moved = at.mechanism.constraints.driven().size();
    require(rates, "rates", {at.N, moved});
    work.take(Parameters::of(parameters, at.n));
    return at.derivatives(moved, work.parameters(), [&](std::size_t s, double* Jx, double* Jf, double* Jr, double* Jp) {
        return work.first(at.h, at.q(s), at.p(s), at.guess(s), at.force(s), rates.data() + s * moved, at.halvings(s),
                          Jx, Jf, Jr, Jp);
    });
}

}  // namespace

std::unique_ptr<VariationalStepper> constrained_stepper(const Mechanism& mechanism, const Tableau& tableau,
                                                        const std::vector<double>& places, double tolerance,
                                                        const Guards& guards) {
    return std::make_unique<ConstrainedStepper>(mechanism, tableau, places, tolerance, guards, kernels_of(mechanism));
}

void register_constrained(nb::module_& m) {
    m.def("constrained_derivatives", &constrained_derivatives, "steps"_a, nb::kw_only(), "places"_a, "rates"_a,
          "ramp"_a = false, "external"_a = false, "parameters"_a.none() = nb::none());
}

}  // namespace varpin::border
