#include <pybind11/numpy.h>

#include <stdexcept>

#include "bindings.h"
#include "sort.h"

namespace py = pybind11;

namespace cap4d {
namespace {

using FloatArray = py::array_t<float, py::array::c_style>;

py::array_t<std::uint32_t> sort_means(FloatArray means, FloatArray viewmat, int threads) {
  if (means.ndim() != 2 || means.shape(1) != 3) throw std::invalid_argument("means: expected float32[N, 3]");
  if (viewmat.ndim() != 2 || viewmat.shape(0) != 4 || viewmat.shape(1) != 4) throw std::invalid_argument("viewmat: expected float32[4, 4]");
  if (means.shape(0) >= (py::ssize_t{1} << 31)) throw std::invalid_argument("means: more than 2^31 Gaussians");
  py::array_t<std::uint32_t> order(means.shape(0));
  std::uint32_t* out = order.mutable_data();
  {
    py::gil_scoped_release release;
    sort_by_depth(means.data(), static_cast<std::size_t>(means.shape(0)), viewmat.data(), out, threads);
  }
  return order;
}

}  // namespace

void register_sort(py::module_& m) {
  m.def("sort_by_depth", &sort_means, py::arg("means").noconvert(), py::arg("viewmat").noconvert(), py::arg("threads") = 0);
}

}  // namespace cap4d
