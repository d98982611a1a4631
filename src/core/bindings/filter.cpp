// The Kalman filter over a log.
#include "varpin/filter.hpp"

#include <nanobind/stl/tuple.h>

#include <cstdint>
#include <tuple>

#include "arrays.hpp"
#include "rollout_arrays.hpp"
#include "units.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

// Moments before and after each sample, transitions, innovations and rows, as `Estimates`; why the
// filter ended, and the samples that it reached. `log` is the Python named tuple FilterLog.
using Filtered = std::tuple<Out, Out, Out, Out, Out, Out, Out, std::int64_t, std::int64_t>;

template <class Model>
Filtered filter(Model& model, std::size_t n, nb::handle log) {
    const auto measured = field<In<2>>(log, "measured");
    const auto start = field<In<1>>(log, "mean");
    const std::size_t K = measured.shape(0), z = measured.shape(1), d = start.shape(0), N = K > 0 ? K - 1 : 0;
    if (K == 0 || (z != n && z != 2 * n) || (d != 2 * n && d != 3 * n))
        throw std::invalid_argument("a log has samples of n or 2n numbers, of a state of 2n or 3n");
    const LogView view{.samples = static_cast<std::int64_t>(K),
                       .rows = static_cast<int>(z),
                       .measured = measured.data(),
                       .variance = field<In<1>>(log, "variance", {z}),
                       .parts = field<Integers<1>>(log, "parts", {N}),
                       .h = field<In<1>>(log, "h", {N}),
                       .force = field<In<2>>(log, "force", {N, n}),
                       .spread = field<In<3>>(log, "spread", {N, n, n}),
                       .kept = field<In<1>>(log, "kept", {N}),
                       .added = field<In<2>>(log, "added", {N, n})};
    const Out predicted = array_for({K, d}), predicted_covariance = array_for({K, d, d}), state = array_for({K, d}),
              covariance = array_for({K, d, d}), transition = array_for({N, d, d}), innovations = array_for({K, z}),
              rows = array_for({K, z, 2 * n});
    std::copy_n(start.data(), d, predicted.data());
    std::copy_n(field<In<2>>(log, "covariance", {d, d}), d * d, predicted_covariance.data());
    const auto [outcome, done] = [&] {
        nb::gil_scoped_release release;
        return Filter<Model>(model, static_cast<int>(n), static_cast<int>(d))
            .run(view, {predicted.data(), predicted_covariance.data(), state.data(), covariance.data(),
                        transition.data(), innovations.data(), rows.data()});
    }();
    return {predicted,  predicted_covariance, state, covariance,
            transition, innovations,          rows,  static_cast<std::int64_t>(outcome),
            done};
}

Filtered filter_variational(const Mechanism& mechanism, const Tableau& tableau, double tolerance, const Guards& guards,
                            nb::handle log) {
    if (mechanism.constraints.rows() > 0) throw std::invalid_argument("a filter takes no constraints");
    VariationalLinearization model(mechanism, tableau, tolerance, guards, kernels_of(mechanism));
    return filter(model, static_cast<std::size_t>(mechanism.dof()), log);
}

Filtered filter_explicit(const Mechanism& mechanism, ExplicitMethod method, nb::handle log) {
    ExplicitStepper model(mechanism, method, true);
    return filter(model, static_cast<std::size_t>(mechanism.dof()), log);
}

}  // namespace

void register_filter(nb::module_& m) {
    m.def("filter_variational", &filter_variational, "mechanism"_a, "tableau"_a, "tolerance"_a, "guards"_a, "log"_a);
    m.def("filter_explicit", &filter_explicit, "mechanism"_a, "method"_a, "log"_a);
}

}  // namespace varpin::border
