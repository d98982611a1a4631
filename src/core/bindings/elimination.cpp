// Elimination from the leaves to the roots, for tests and examination.
#include "varpin/elimination.hpp"

#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>

#include "arrays.hpp"
#include "registrations.hpp"
#include "varpin/stage_elimination.hpp"

namespace varpin::border {

namespace {

using namespace nanobind::literals;

// Elimination at one (q, v).
class BoundElimination {
  public:
    BoundElimination(const Mechanism& mechanism, In<1> q, In<1> v)
        : n_(static_cast<std::size_t>(mechanism.dof())), jet_(mechanism.tree, false), articulated_(mechanism.tree) {
        require(q, "q", {n_});
        require(v, "v", {n_});
        if (mechanism.couplings.any()) throw std::invalid_argument("couplings act");
        regular_ = articulated_.at(mechanism, q.data(), jet_);
        first_order(mechanism, q.data(), v.data(), jet_);
        if (mechanism.tree.size() == mechanism.dof()) {
            free_.emplace(mechanism);
            free_->take(jet_);
        } else {
            tied_.emplace(mechanism, tableau_);
            tied_->take(0, jet_);
        }
    }

    // x with (M + ha A - hb A' - ha hb L_qq + diag(d)) x = b, (A' + ha L_qq) x, x' M x, and whether pivots are
    // positive.
    std::tuple<Out, Out, double, bool> step(double ahead, double behind, In<1> diagonal, In<1> b) {
        require(diagonal, "diagonal", {n_});
        require(b, "b", {n_});
        double *x = nullptr, *y = nullptr;
        const Out X = array_for(x, {n_}), Y = array_for(y, {n_});
        tableau_.a[0] = ahead;
        tableau_.gradient[0] = behind;
        if (free_ ? !free_->factor(ahead, behind, diagonal.data()) : !tied_->factor(1.0, diagonal.data()))
            return {X, Y, 0.0, false};
        return free_ ? solved(*free_, b.data(), x, y, X, Y) : solved(*tied_, b.data(), x, y, X, Y);
    }

    double least_pivot_ratio(double coupling, double curvature, In<1> diagonal) {
        require(diagonal, "diagonal", {n_});
        if (free_) return free_->least_pivot_ratio(coupling, curvature, diagonal.data());
        return tied_->least_pivot_ratio(coupling, curvature, diagonal.data());
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
    template <class Matrix>
    static std::tuple<Out, Out, double, bool> solved(Matrix& matrix, const double* b, double* x, double* y,
                                                     const Out& X, const Out& Y) {
        matrix.solve(b, x);
        matrix.change_of_slope(x, y);
        return {X, Y, matrix.kinetic_size(x), true};
    }

    std::size_t n_;
    Jet<double> jet_;
    ArticulatedBodies articulated_;
    Tableau tableau_{.stages = 1, .a = {0.0}, .gradient = {0.0}, .force = {1.0}, .b = {1.0}, .c = {0.5}, .ahead = {}};
    std::optional<Elimination> free_;
    std::optional<StageElimination> tied_;  // for coordinates that move several bodies
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
