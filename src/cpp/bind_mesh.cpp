#include <pybind11/numpy.h>

#include <stdexcept>

#include "bindings.h"
#include "mesh.h"

namespace py = pybind11;

namespace cap4d {
namespace {

Cull cull_from_name(const std::string& name) {
  if (name == "none") return Cull::kNone;
  if (name == "clockwise") return Cull::kClockwise;
  if (name == "counter_clockwise") return Cull::kCounterClockwise;
  throw std::invalid_argument("cull: expected none, clockwise or counter_clockwise, got " + name);
}

py::tuple rasterize(py::array_t<double, py::array::c_style> xyz, py::array_t<std::int32_t, py::array::c_style> faces, int height,
                    int width, const std::string& cull) {
  if (xyz.ndim() != 2 || xyz.shape(1) != 3) throw std::invalid_argument("xyz: expected float64[V, 3]");
  if (faces.ndim() != 2 || faces.shape(1) != 3) throw std::invalid_argument("faces: expected int32[F, 3]");
  if (height < 1 || width < 1 || height > 16384 || width > 16384) throw std::invalid_argument("size: expected 1 to 16384 px a side");
  const std::span<const std::int32_t> indices(faces.data(), faces.size());
  for (const std::int32_t v : indices)
    if (v < 0 || v >= xyz.shape(0)) throw std::invalid_argument("faces: index " + std::to_string(v) + " is out of range");
  const Cull side = cull_from_name(cull);
  py::array_t<std::int32_t> face({height, width});
  py::array_t<double> bary({height, width, 3});
  {
    py::gil_scoped_release release;
    rasterize_mesh({xyz.data(), static_cast<std::size_t>(xyz.size())}, indices, height, width, side, face.mutable_data(), bary.mutable_data());
  }
  return py::make_tuple(face, bary);
}

}  // namespace

void register_mesh(py::module_& m) {
  m.def("rasterize_mesh", &rasterize, py::arg("xyz").noconvert(), py::arg("faces").noconvert(), py::arg("height"), py::arg("width"),
        py::arg("cull") = "none");
}

}  // namespace cap4d
