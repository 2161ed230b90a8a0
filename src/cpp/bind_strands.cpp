#include <stdexcept>

#include "bind_arguments.h"
#include "bindings.h"
#include "sort.h"
#include "strands.h"

namespace py = pybind11;

namespace cap4d {
namespace {

std::span<const float> span_of(const FloatArray& a) { return {a.data(), static_cast<std::size_t>(a.size())}; }

// First points of the segments of K strands of P points, near to far by the middle's depth.
std::vector<std::uint32_t> sorted_segments(std::span<const float> xyz, std::size_t strands, std::size_t points) {
  const std::size_t segments = points - 1;
  std::vector<std::uint32_t> order(strands * segments);
  const auto first = [&](std::size_t s) { return s / segments * points + s % segments; };
  sort_depths(order.size(), order.data(), 1, [&](std::size_t s) { return xyz[3 * first(s) + 2] + xyz[3 * first(s) + 5]; });
  for (std::uint32_t& s : order) s = static_cast<std::uint32_t>(first(s));
  return order;
}

py::tuple draw(FloatArray xyz, FloatArray rgba, FloatArray widths, FloatArray depth, float softness) {
  if (xyz.ndim() != 3 || xyz.shape(1) < 2) throw std::invalid_argument("xyz: expected float32[K, P, 3], P at least 2");
  const py::ssize_t k = xyz.shape(0), p = xyz.shape(1);
  if (k * p >= (py::ssize_t{1} << 31)) throw std::invalid_argument("xyz: more than 2^31 points");
  expect(xyz, "xyz", {k, p, 3});
  expect(rgba, "rgba", {k, p, 4});
  expect(widths, "widths", {k, p});
  if (depth.ndim() != 2 || depth.shape(0) > 16384 || depth.shape(1) > 16384) throw std::invalid_argument("depth: expected float32[H, W], at most 16384 px a side");
  if (!(softness > 0)) throw std::invalid_argument("softness: expected above 0");
  const int height = static_cast<int>(depth.shape(0)), width = static_cast<int>(depth.shape(1));
  FloatArray rgb({height, width, 3}), transmittance({height, width});
  std::fill_n(rgb.mutable_data(), rgb.size(), 0.0f);
  std::fill_n(transmittance.mutable_data(), transmittance.size(), 1.0f);
  const StrandPoints points{span_of(xyz), span_of(rgba), span_of(widths)};
  const StrandImage image{height, width, depth.data(), softness, rgb.mutable_data(), transmittance.mutable_data()};
  {
    py::gil_scoped_release release;
    draw_strands(points, sorted_segments(points.xyz, k, p), image);
  }
  return py::make_tuple(rgb, transmittance);
}

}  // namespace

void register_strands(py::module_& m) {
  m.def("draw_strands", &draw, py::arg("xyz").noconvert(), py::arg("rgba").noconvert(), py::arg("widths").noconvert(),
        py::arg("depth").noconvert(), py::arg("softness"));
}

}  // namespace cap4d
