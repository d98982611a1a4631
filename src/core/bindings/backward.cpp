// The backward pass, and what its plan foresees.
#include "varpin/backward.hpp"

#include "arrays.hpp"
#include "units.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

// The number of decisions of N steps, with each control held over `hold` of them.
std::size_t decisions_of(std::size_t N, int hold) {
    if (hold < 1 || N % static_cast<std::size_t>(hold) != 0)
        throw std::invalid_argument("hold does not divide the steps");
    return N / static_cast<std::size_t>(hold);
}

void make_pass(BackwardPass* self, int controls, In<1> gradient, In<2> hessian) {
    const std::size_t x = gradient.shape(0);
    if (x % 2 != 0) throw std::invalid_argument("gradient has an odd size");
    if (controls < 0) throw std::invalid_argument("controls must not be negative");
    require(hessian, "hessian", {x, x});
    new (self) BackwardPass(static_cast<int>(x / 2), controls, gradient.data(), hessian.data());
}

// A pass over steps, whose gains are written to arrays; see ExpandedSteps and Gains.
std::ptrdiff_t run(BackwardPass& pass, double h, int hold, double regularization, In<3> A, In<3> B, In<3> G, In<4> Gx,
                   In<4> Gu, In<2> gradient, In<3> hessian, InOut<2> feedforward, InOut<3> feedback,
                   InOut<2> control_gradient, InOut<3> spread, InOut<3> factors) {
    const std::size_t N = A.shape(0), x = A.shape(1), m = B.shape(2), k = G.shape(2), size = x + m;
    const std::size_t R = decisions_of(N, hold);
    if (x != 2 * static_cast<std::size_t>(pass.dof()) || m != static_cast<std::size_t>(pass.controls()))
        throw std::invalid_argument("the steps have other states or controls than the pass");
    require(A, "A", {N, x, x});
    require(B, "B", {N, x, m});
    require(G, "G", {N, x, k});
    require(Gx, "Gx", {N, x, k, x});
    require(Gu, "Gu", {N, x, k, m});
    require(gradient, "gradient", {N, size});
    const bool one_hessian = hessian.shape(0) == 1;
    require(hessian, "hessian", {one_hessian ? 1 : N, size, size});
    require(feedforward, "feedforward", {R, m});
    require(feedback, "feedback", {R, m, x});
    require(control_gradient, "control_gradient", {R, m});
    if (k > 0) require(spread, "spread", {N, x, x});
    require(factors, "factors", {R, m, m});
    const ExpandedSteps steps{.steps = static_cast<std::ptrdiff_t>(N),
                              .dof = pass.dof(),
                              .controls = pass.controls(),
                              .processes = static_cast<int>(k),
                              .A = A.data(),
                              .B = B.data(),
                              .G = G.data(),
                              .Gx = Gx.data(),
                              .Gu = Gu.data(),
                              .gradient = gradient.data(),
                              .hessian = hessian.data(),
                              .one_hessian = one_hessian};
    const Gains gains{.feedforward = feedforward.data(),
                      .feedback = feedback.data(),
                      .control_gradient = control_gradient.data(),
                      .spread = spread.data(),
                      .factors = factors.data()};
    nb::gil_scoped_release release;
    return pass.run(h, hold, regularization, steps, gains);
}

// The changes of the controls, moves (R, m), and the states after each step, after (N, 2n), of a linearized motion
// under a plan. True where a control reaches a limit.
bool foresee(int hold, In<3> A, In<3> B, In<2> feedforward, In<3> feedback, In<3> slack, InOut<2> moves,
             InOut<2> after) {
    const std::size_t N = A.shape(0), x = A.shape(1), m = B.shape(2), R = decisions_of(N, hold);
    require(A, "A", {N, x, x});
    require(B, "B", {N, x, m});
    require(feedforward, "feedforward", {R, m});
    require(feedback, "feedback", {R, m, x});
    require(moves, "moves", {R, m});
    require(after, "after", {N, x});
    const LinearizedPlan plan{.steps = static_cast<std::ptrdiff_t>(N),
                              .states = static_cast<int>(x),
                              .controls = static_cast<int>(m),
                              .hold = hold,
                              .A = A.data(),
                              .B = B.data(),
                              .feedforward = feedforward.data(),
                              .feedback = feedback.data(),
                              .slack = given(slack, "slack", {R, 2, m}) ? slack.data() : nullptr};
    nb::gil_scoped_release release;
    return predict(plan, moves.data(), after.data());
}

// The first rows of a triangular form of `rows`.
Out triangular(In<2> rows, int leading) {
    const std::size_t columns = rows.shape(1), kept = static_cast<std::size_t>(leading);
    if (leading < 0 || kept > std::min(rows.shape(0), columns))
        throw std::invalid_argument("there are fewer rows or columns than are to be triangular");
    std::vector<double> values = copied(rows);
    triangularize(values.data(), static_cast<int>(rows.shape(0)), static_cast<int>(columns), leading);
    return array_of(values.data(), {kept, columns});
}

}  // namespace

void register_backward(nb::module_& m) {
    nb::class_<BackwardPass>(m, "BackwardPass")
        .def("__init__", &make_pass, "controls"_a, "gradient"_a, "hessian"_a)
        .def("run", &run, "h"_a, "hold"_a, "regularization"_a, nb::kw_only(), "A"_a, "B"_a, "G"_a, "Gx"_a, "Gu"_a,
             "gradient"_a, "hessian"_a, "feedforward"_a.noconvert(), "feedback"_a.noconvert(),
             "control_gradient"_a.noconvert(), "spread"_a.noconvert(), "factors"_a.noconvert())
        .def_prop_ro("slope", [](const BackwardPass& pass) { return pass.found.slope; })
        .def_prop_ro("curvature", [](const BackwardPass& pass) { return pass.found.curvature; })
        .def_prop_ro("noise", [](const BackwardPass& pass) { return pass.found.noise; })
        .def_prop_ro("loss", [](const BackwardPass& pass) { return pass.found.loss; });
    m.def("foresee", &foresee, "hold"_a, "A"_a, "B"_a, "feedforward"_a, "feedback"_a, "slack"_a, "moves"_a.noconvert(),
          "after"_a.noconvert());
    m.def("triangular", &triangular, "rows"_a, "leading"_a);
}

}  // namespace varpin::border
