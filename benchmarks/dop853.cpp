// Dormand and Prince's method of order 8 with error control (Hairer, Norsett, Wanner, Solving ODEs I, II.5 and II.10)
// on Pinocchio's articulated-body algorithm: what a user who compiles his own simulation would write.
//
// peers.py compiles it and hands it the coefficients that SciPy has.
#include <algorithm>
#include <cmath>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/multibody.hpp>

using Vector = Eigen::VectorXd;
using Map = Eigen::Map<const Vector>;
constexpr int stages = 12;

struct Problem {
    pinocchio::Model model;
    pinocchio::Data data;
    Vector force, damping, stiffness, rest, swing, friction, torque;
    double omega, width;

    // x = (q, v); rate = (v, a).
    void rate(double t, const Vector& x, Eigen::Ref<Vector> out) {
        const auto n = model.nv;
        torque = force - damping.cwiseProduct(x.tail(n)) - stiffness.cwiseProduct(x.head(n) - rest);
        if (swing.any()) torque += std::sin(omega * t) * swing;
        if (friction.any()) torque.array() -= friction.array() * (x.tail(n) / width).array().tanh();
        out.head(n) = x.tail(n);
        out.tail(n) = pinocchio::aba(model, data, x.head(n), x.tail(n), torque);
    }
};

extern "C" {

// n revolute joints: parents (n), 0 being the base; placements (n, 12) as rotation by rows and translation; axes (n,
// 3); inertias (n, 10) as Pinocchio's dynamic parameters; gravity (3); force, damping, stiffness, rest, swing, friction
// (6, n); the torque is force + swing sin(omega t) - friction tanh(v / width).
Problem* varpin_problem(int n, const int* parents, const double* placements, const double* axes, const double* inertias,
                        const double* gravity, const double* forces, double omega, double width) {
    pinocchio::Model model;
    for (int k = 0; k < n; ++k) {
        const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> rotation(placements + 12 * k);
        const pinocchio::SE3 placement(rotation, Eigen::Map<const Eigen::Vector3d>(placements + 12 * k + 9));
        const Eigen::Map<const Eigen::Vector3d> axis(axes + 3 * k);
        const auto name = std::to_string(k);
        const auto parent = static_cast<pinocchio::JointIndex>(parents[k]);
        pinocchio::JointIndex joint;
        if (axis == Eigen::Vector3d::UnitX())
            joint = model.addJoint(parent, pinocchio::JointModelRX(), placement, name);
        else if (axis == Eigen::Vector3d::UnitY())
            joint = model.addJoint(parent, pinocchio::JointModelRY(), placement, name);
        else if (axis == Eigen::Vector3d::UnitZ())
            joint = model.addJoint(parent, pinocchio::JointModelRZ(), placement, name);
        else
            joint = model.addJoint(parent, pinocchio::JointModelRevoluteUnaligned(axis), placement, name);
        model.appendBodyToJoint(joint, pinocchio::Inertia::FromDynamicParameters(Map(inertias + 10 * k, 10)));
    }
    model.gravity.linear() = Eigen::Map<const Eigen::Vector3d>(gravity);
    const auto row = [&](int i) { return Vector(Map(forces + i * n, n)); };
    return new Problem{model, pinocchio::Data(model), row(0), row(1), row(2), row(3), row(4), row(5), Vector(n), omega,
                       width};
}

// From x (2n) at t to the end under a force (n); A (12, 12), B (12), E3 and E5 (13). The number of calls of aba, or -1
// if the step vanishes.
long varpin_integrate(Problem* problem, double* x, const double* force, double t, double end, double tolerance,
                      const double* A, const double* B, const double* E3, const double* E5) {
    problem->force = Map(force, problem->model.nv);
    const auto size = 2 * problem->model.nv;
    Eigen::MatrixXd K(size, stages + 1);
    Vector y = Eigen::Map<Vector>(x, size), point(size), next(size), scale(size);
    // SciPy's coefficients of the stages add up to their times.
    const auto time = [&](int s) { return Map(A + stages * s, s).sum(); };
    problem->rate(t, y, K.col(0));
    long calls = 1;
    double h = std::min(end - t, 0.01 * std::pow(tolerance, 1.0 / 8.0));
    bool rejected = false;
    while (t < end) {
        const bool last = end - t <= h;
        h = std::min(h, end - t);
        if (t + h == t) return -1;
        for (int s = 1; s < stages; ++s) {
            point.noalias() = y + h * (K.leftCols(s) * Map(A + stages * s, s));
            problem->rate(t + h * time(s), point, K.col(s));
        }
        next.noalias() = y + h * (K.leftCols(stages) * Map(B, stages));
        problem->rate(t + h, next, K.col(stages));
        calls += stages;
        scale = tolerance * (1.0 + y.cwiseAbs().cwiseMax(next.cwiseAbs()).array());
        const double five = (K * Map(E5, stages + 1)).cwiseQuotient(scale).squaredNorm();
        const double three = (K * Map(E3, stages + 1)).cwiseQuotient(scale).squaredNorm();
        const double error = five + three > 0.0 ? h * five / std::sqrt((five + 0.01 * three) * size) : 0.0;
        const double factor = error > 0.0 ? 0.9 * std::pow(error, -1.0 / 8.0) : 10.0;
        if (error < 1.0) {
            t = last ? end : t + h;
            h *= std::clamp(factor, 0.2, rejected ? 1.0 : 10.0);
            y = next;
            K.col(0) = K.col(stages);
            rejected = false;
        } else {
            h *= std::isfinite(factor) ? std::clamp(factor, 0.2, 1.0) : 0.2;
            rejected = true;
        }
    }
    Eigen::Map<Vector>(x, size) = y;
    return calls;
}
}
