/* Pinocchio's algorithms, timed in C++: seconds for one call, as the mean over `calls` samples in turn.

   Everything is compiled here from the headers of the wheel `pin`, for this processor; the model comes from its text archive. */

#include <pinocchio/fwd.hpp>

#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/serialization.hpp>

#include <chrono>

namespace se3 = pinocchio;
typedef Eigen::Map<const Eigen::VectorXd> Vector;

struct Robot {
    se3::Model model;
    se3::Data data;
};

template <class Call>
static double timed(Robot *robot, long calls, long samples, const double *q, const double *v, const double *tau, Call call) {
    long nq = robot->model.nq, nv = robot->model.nv;
    auto start = std::chrono::steady_clock::now();
    for (long k = 0; k < calls; k++) {
        long s = k % samples;
        call(Vector(q + s * nq, nq), Vector(v + s * nv, nv), Vector(tau + s * nv, nv));
    }
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count() / calls;
}

extern "C" {

void *load(const char *file) {
    Robot *robot = new Robot;
    se3::serialization::loadFromText(robot->model, file);
    robot->data = se3::Data(robot->model);
    return robot;
}

double aba(void *p, long calls, long samples, const double *q, const double *v, const double *tau, int world, double *a) {
    Robot *r = (Robot *)p;
    se3::Convention convention = world ? se3::Convention::WORLD : se3::Convention::LOCAL;
    double seconds = timed(r, calls, samples, q, v, tau, [&](const Vector &q, const Vector &v, const Vector &tau) {
        se3::aba(r->model, r->data, q, v, tau, convention);
    });
    Eigen::Map<Eigen::VectorXd>(a, r->model.nv) = r->data.ddq;
    return seconds;
}

double aba_derivatives(void *p, long calls, long samples, const double *q, const double *v, const double *tau, double *by_v) {
    Robot *r = (Robot *)p;
    double seconds = timed(r, calls, samples, q, v, tau, [&](const Vector &q, const Vector &v, const Vector &tau) {
        se3::computeABADerivatives(r->model, r->data, q, v, tau);
    });
    Eigen::Map<Eigen::Matrix<double, -1, -1, Eigen::RowMajor>>(by_v, r->model.nv, r->model.nv) = r->data.ddq_dv;
    return seconds;
}
}
