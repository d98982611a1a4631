// Steps of arms with up to seven joints, whose number is known at compile time.
#include "small_arms.hpp"

#include "varpin/velocity_slopes.hpp"

namespace varpin::border {

namespace {

// The result of `make(Size)` for the number of joints of a mechanism whose bodies each have their own in a single
// block, else a default one.
template <class Make>
auto of_arm(const Mechanism& mechanism, const Make& make) -> decltype(make(Known<3>(3))) {
    const Tree& tree = mechanism.tree;
    const int n = mechanism.dof();
    if (tree.size() != n || tree.blocks.size() != 1) return {};
    switch (n) {
        case 3:
            return make(Known<3>(n));
#ifndef VARPIN_FEW_SIZES
        case 2:
            return make(Known<2>(n));
        case 4:
            return make(Known<4>(n));
        case 6:
            return make(Known<6>(n));
        case 7:
            return make(Known<7>(n));
#endif
        default:
            return {};
    }
}

// The same if its steps are solved with one matrix.
template <class Made, class Make>
std::unique_ptr<Made> of_size(const Mechanism& mechanism, const Tableau& tableau, Solver solver, const Make& make) {
    if (tableau.stages != 1 || eliminates(mechanism, solver) || eliminates(mechanism.tree, solver)) return nullptr;
    return of_arm(mechanism, make);
}

}  // namespace

std::unique_ptr<Stepper> small_stepper(const Mechanism& mechanism, const Tableau& tableau, double tolerance,
                                       const Guards& guards, double left, Solver solver) {
    return of_size<Stepper>(mechanism, tableau, solver, [&]<class Size>(Size) -> std::unique_ptr<Stepper> {
        return std::make_unique<VariationalStepper<Size, Known<1>>>(mechanism, tableau, tolerance, guards, left,
                                                                    solver);
    });
}

std::unique_ptr<StepDerivatives> small_derivatives(const Mechanism& mechanism, const Tableau& tableau, double tolerance,
                                                   const Guards& guards, Solver solver) {
    return of_size<StepDerivatives>(mechanism, tableau, solver,
                                    [&]<class Size>(Size) -> std::unique_ptr<StepDerivatives> {
                                        return std::make_unique<VariationalLinearization<Size, Known<1>>>(
                                            mechanism, tableau, tolerance, guards, solver);
                                    });
}

std::unique_ptr<AnyConstrainedStepper> small_constrained_stepper(const Mechanism& mechanism, const Tableau& tableau,
                                                                 const std::vector<double>& places, double tolerance,
                                                                 const Guards& guards) {
    return of_size<AnyConstrainedStepper>(
        mechanism, tableau, Solver::dense, [&]<class Size>(Size) -> std::unique_ptr<AnyConstrainedStepper> {
            return std::make_unique<ConstrainedStepper<Size, Known<1>>>(mechanism, tableau, places, tolerance, guards);
        });
}

bool small_velocity_slopes(const Mechanism& mechanism, std::size_t rows, const double* q, const double* v,
                           double* slopes) {
    return of_arm(mechanism, [&]<class Size>(Size) {
        velocity_slopes<Size>(mechanism, rows, q, v, slopes);
        return true;
    });
}

}  // namespace varpin::border
