#include <stdexcept>
#include <string>

#include "bind.h"
#include "bind_arguments.h"
#include "bindings.h"

namespace py = pybind11;

namespace cap4d {
namespace {

void expect_rows(const py::array& a, const char* name, py::ssize_t rows, py::ssize_t columns) {
  if (a.ndim() != 2 || a.shape(1) != columns || (rows >= 0 && a.shape(0) != rows))
    throw std::invalid_argument(std::string(name) + ": expected [" + (rows < 0 ? "any" : std::to_string(rows)) + ", " + std::to_string(columns) + "]");
}

// The arguments that `bind` and its VJP share, checked.
BoundGaussians checked(const FloatArray& vertices, const IntArray& faces, const FloatArray& means, const FloatArray& quats,
                       const FloatArray& log_scales, const IntArray& binding) {
  const py::ssize_t n = binding.ndim() == 1 ? binding.shape(0) : -1;
  if (n < 0) throw std::invalid_argument("binding: expected int32[N]");
  expect_rows(vertices, "vertices", -1, 3);
  expect_rows(faces, "faces", -1, 3);
  expect_rows(means, "means", n, 3);
  expect_rows(quats, "quats", n, 4);
  expect_rows(log_scales, "log_scales", n, 3);
  expect_below(faces, "faces", vertices.shape(0));
  expect_below(binding, "binding", faces.shape(0));
  return {static_cast<std::size_t>(n), static_cast<std::size_t>(faces.shape(0)), faces.data(), binding.data(), means.data(), quats.data(),
          log_scales.data()};
}

FloatArray empty_rows(py::ssize_t rows, py::ssize_t columns) { return FloatArray({rows, columns}); }

py::tuple bind_gaussians(FloatArray vertices, IntArray faces, FloatArray means, FloatArray quats, FloatArray log_scales, IntArray binding,
                         int threads) {
  const BoundGaussians bound = checked(vertices, faces, means, quats, log_scales, binding);
  const auto n = static_cast<py::ssize_t>(bound.count);
  FloatArray out_means = empty_rows(n, 3), out_quats = empty_rows(n, 4), out_scales = empty_rows(n, 3);
  float *m = out_means.mutable_data(), *q = out_quats.mutable_data(), *s = out_scales.mutable_data();
  {
    py::gil_scoped_release release;
    bind(vertices.data(), bound, threads, m, q, s);
  }
  return py::make_tuple(out_means, out_quats, out_scales);
}

py::tuple bind_gaussians_vjp(FloatArray vertices, IntArray faces, FloatArray means, FloatArray quats, FloatArray log_scales,
                             IntArray binding, FloatArray v_means, FloatArray v_quats, FloatArray v_scales, int threads) {
  const BoundGaussians bound = checked(vertices, faces, means, quats, log_scales, binding);
  const auto n = static_cast<py::ssize_t>(bound.count);
  expect_rows(v_means, "v_means", n, 3);
  expect_rows(v_quats, "v_quats", n, 4);
  expect_rows(v_scales, "v_scales", n, 3);
  const auto count = static_cast<std::size_t>(vertices.shape(0));
  FloatArray v_vertices = empty_rows(vertices.shape(0), 3);
  FloatArray v_local_means = empty_rows(n, 3), v_local_quats = empty_rows(n, 4), v_log_scales = empty_rows(n, 3);
  const BindGradients g{v_means.data(),           v_quats.data(),           v_scales.data(),         v_vertices.mutable_data(),
                        v_local_means.mutable_data(), v_local_quats.mutable_data(), v_log_scales.mutable_data()};
  {
    py::gil_scoped_release release;
    bind_vjp(vertices.data(), count, bound, threads, g);
  }
  return py::make_tuple(v_vertices, v_local_means, v_local_quats, v_log_scales);
}

}  // namespace

void register_bind(py::module_& m) {
  m.def("bind", &bind_gaussians, py::arg("vertices").noconvert(), py::arg("faces").noconvert(), py::arg("means").noconvert(),
        py::arg("quats").noconvert(), py::arg("log_scales").noconvert(), py::arg("binding").noconvert(), py::arg("threads") = 0);
  m.def("bind_vjp", &bind_gaussians_vjp, py::arg("vertices").noconvert(), py::arg("faces").noconvert(), py::arg("means").noconvert(),
        py::arg("quats").noconvert(), py::arg("log_scales").noconvert(), py::arg("binding").noconvert(), py::arg("v_means").noconvert(),
        py::arg("v_quats").noconvert(), py::arg("v_scales").noconvert(), py::arg("threads") = 0);
}

}  // namespace cap4d
