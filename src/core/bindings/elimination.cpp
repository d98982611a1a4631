// Elimination from the leaves to the roots, to be looked at by itself.
#include "varpin/elimination.hpp"

#include <nanobind/stl/tuple.h>

#include <tuple>

#include "arrays.hpp"
#include "registrations.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

// Everything at one (q, v).
class BoundElimination {
  public:
    BoundElimination(const Mechanism& mechanism, In<1> q, In<1> v)
        : n_(static_cast<std::size_t>(mechanism.dof())),
          jet_(mechanism.tree, false),
          articulated_(mechanism.tree),
          own_(mechanism) {
        require(q, "q", {n_});
        require(v, "v", {n_});
        if (!eliminates(mechanism, Solver::elimination))
            throw std::invalid_argument("a coordinate moves more than one joint, or couplings act");
        regular_ = articulated_.at(mechanism, q.data(), jet_);
        first_order(mechanism, q.data(), v.data(), jet_);
        own_.take(jet_);
    }

    // x with (M + ha A - hb A' - ha hb L_qq + diag(d)) x = b, (A' + ha L_qq) x, x' M x, and whether pivots are
    // positive.
    std::tuple<Out, Out, double, bool> step(double ahead, double behind, In<1> diagonal, In<1> b) {
        require(diagonal, "diagonal", {n_});
        require(b, "b", {n_});
        double *x = nullptr, *y = nullptr;
        const Out X = array_for(x, {n_}), Y = array_for(y, {n_});
        if (!own_.factor(ahead, behind, diagonal.data())) return {X, Y, 0.0, false};
        own_.solve(b.data(), x);
        own_.change_of_slope(x, y);
        return {X, Y, own_.kinetic_size(x), true};
    }

    double least_pivot_ratio(double coupling, double curvature, In<1> diagonal) {
        require(diagonal, "diagonal", {n_});
        return own_.least_pivot_ratio(coupling, curvature, diagonal.data());
    }

    // x with M x = b, the shares of 1/2 b . x, and whether M is positive definite.
    std::tuple<Out, Out, bool> mass(In<1> b) {
        require(b, "b", {n_});
        double *x = nullptr, *share = nullptr;
        const Out X = array_for(x, {n_}), S = array_for(share, {n_});
        if (regular_) articulated_.solve(b.data(), x, share);
        return {X, S, regular_};
    }

  private:
    std::size_t n_;
    Jet<double> jet_;
    ArticulatedBodies articulated_;
    Elimination own_;
    bool regular_ = false;
};

}  // namespace

void register_elimination(nb::module_& m) {
    nb::enum_<Solver>(m, "Solver")
        .value("automatic", Solver::automatic)
        .value("dense", Solver::dense)
        .value("elimination", Solver::elimination);
    nb::class_<BoundElimination>(m, "Elimination")
        .def(nb::init<const Mechanism&, In<1>, In<1>>(), "mechanism"_a, "q"_a, "v"_a, nb::keep_alive<1, 2>())
        .def("step", &BoundElimination::step, "ahead"_a, "behind"_a, "diagonal"_a, "b"_a)
        .def("least_pivot_ratio", &BoundElimination::least_pivot_ratio, "coupling"_a, "curvature"_a, "diagonal"_a)
        .def("mass", &BoundElimination::mass, "b"_a);
}

}  // namespace varpin::border
