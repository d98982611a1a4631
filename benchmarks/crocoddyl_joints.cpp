// Joint torques of crocoddyl's models: B u - D v, dampers and joints without a motor, which its own lack.

#include <boost/python.hpp>
#include <crocoddyl/core/actuation-base.hpp>

namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using State = crocoddyl::StateAbstractTpl<double>;
using Base = crocoddyl::ActuationModelAbstractTpl<double>;
using Data = crocoddyl::ActuationDataAbstractTpl<double>;
using Vector = Eigen::Ref<const VectorXd>;

class Joints : public Base {
  public:
    // B is (n, m), the damping D (n,) [N m s/rad].
    Joints(std::shared_ptr<State> state, const MatrixXd& B, const VectorXd& D)
        : Base(state, B.cols()), motors_(B), damping_(D) {}

    void calc(const std::shared_ptr<Data>& data, const Vector& x, const Vector& u) override {
        data->tau.noalias() = motors_ * u;
        data->tau -= damping_.cwiseProduct(x.tail(damping_.size()));
    }
    void calcDiff(const std::shared_ptr<Data>&, const Vector&, const Vector&) override {}
    void commands(const std::shared_ptr<Data>& data, const Vector& x, const Vector& tau) override {
        data->u = motors_.transpose() * (tau + damping_.cwiseProduct(x.tail(damping_.size())));
    }
    std::shared_ptr<Data> createData() override {
        auto data = Base::createData();
        data->dtau_du = motors_;
        data->dtau_dx.rightCols(damping_.size()).diagonal() = -damping_;
        return data;
    }
    std::shared_ptr<crocoddyl::ActuationModelBase> cloneAsDouble() const override {
        return std::make_shared<Joints>(*this);
    }
    std::shared_ptr<crocoddyl::ActuationModelBase> cloneAsFloat() const override { return nullptr; }

  private:
    MatrixXd motors_;
    VectorXd damping_;
};

}  // namespace

BOOST_PYTHON_MODULE(crocoddyl_joints) {
    namespace bp = boost::python;
    bp::import("crocoddyl");
    bp::class_<Joints, bp::bases<Base>, std::shared_ptr<Joints>>(
        "Joints", bp::init<std::shared_ptr<State>, MatrixXd, VectorXd>());
}
