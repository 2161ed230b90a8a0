#include <algorithm>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "bind_arguments.h"
#include "bindings.h"
#include "constants.h"
#include "grid_surface.h"

namespace py = pybind11;

namespace cap4d {
namespace {

using FlagArray = py::array_t<bool, py::array::c_style>;

template <class T, class From>
Buffer<T> copy_of(const From& array) {
  auto out = make_buffer<T>(static_cast<std::size_t>(array.size()));
  std::copy_n(array.data(), array.size(), out.get());
  return out;
}

GridSurface make_surface(FloatArray neutral, FloatArray basis, FloatArray skin_weights, IntArray pixels, int size, FlagArray deformable,
                         FloatArray deform_neutral) {
  const py::ssize_t points = neutral.ndim() ? neutral.shape(0) : 0, rows = basis.ndim() ? basis.shape(0) : 0;
  const py::ssize_t joints = skin_weights.ndim() ? skin_weights.shape(0) : 0;
  if (size < 1 || size > kMaxMapSide) throw std::invalid_argument("size: expected 1 to " + std::to_string(kMaxMapSide));
  expect(neutral, "neutral", {points, 3});
  expect(basis, "basis", {rows, points, 3});
  expect(skin_weights, "skin_weights", {joints, points});
  expect(pixels, "pixels", {points});
  expect_below(pixels, "pixels", py::ssize_t{size} * size);
  expect(deformable, "deformable", {points});
  expect(deform_neutral, "deform_neutral", {points, 3});
  GridSurface surface{static_cast<std::size_t>(points), static_cast<std::size_t>(rows), static_cast<std::size_t>(joints), size,
                      copy_of<float>(neutral), copy_of<float>(basis), {}, copy_of<float>(skin_weights), copy_of<std::int32_t>(pixels),
                      copy_of<std::uint8_t>(deformable), copy_of<float>(deform_neutral)};
  find_moving(surface);
  return surface;
}

// turns: (joint, late, turn [3, 3], pivot [3]) each.
std::vector<JointTurn> joint_turns(const GridSurface& surface, const std::vector<std::tuple<int, bool, FloatArray, FloatArray>>& turns) {
  std::vector<JointTurn> out;
  for (const auto& [joint, late, turn, pivot] : turns) {
    if (joint < 0 || joint >= static_cast<py::ssize_t>(surface.joints)) throw std::invalid_argument("turns: no such joint");
    expect(turn, "turn", {3, 3});
    expect(pivot, "pivot", {3});
    JointTurn t{joint, late, {}, {}};
    std::copy_n(turn.data(), 9, t.turn);
    std::copy_n(pivot.data(), 3, t.pivot);
    out.push_back(t);
  }
  return out;
}

void pose(const GridSurface& surface, FloatArray vertices, std::optional<FloatArray> offsets, FloatArray coefficients, FloatArray late,
          const std::vector<std::tuple<int, bool, FloatArray, FloatArray>>& turns, std::optional<FloatArray> rest, int threads) {
  const auto points = static_cast<py::ssize_t>(surface.points), rows = static_cast<py::ssize_t>(surface.rows);
  expect(vertices, "vertices", {points, 3});
  expect(coefficients, "coefficients", {rows});
  expect(late, "late", {rows});
  if (offsets.has_value() != rest.has_value()) throw std::invalid_argument("offsets, rest: expected both or neither");
  if (offsets) {
    expect(*offsets, "offsets", {3, surface.size, surface.size});
    expect(*rest, "rest", {points, 3});
  }
  const std::vector<JointTurn> joints = joint_turns(surface, turns);
  const SurfaceMotion motion{coefficients.data(), late.data(), &joints};
  float *out = vertices.mutable_data(), *map = offsets ? offsets->mutable_data() : nullptr;
  const float* from = rest ? rest->data() : nullptr;
  py::gil_scoped_release release;
  pose_surface(surface, motion, from, threads, out, map);
}

void deform(const GridSurface& surface, FloatArray vertices, std::optional<FloatArray> answer, int threads) {
  expect(vertices, "vertices", {static_cast<py::ssize_t>(surface.points), 3});
  if (answer) expect(*answer, "answer", {3, surface.size, surface.size});
  float* out = vertices.mutable_data();
  const float* map = answer ? answer->data() : nullptr;
  py::gil_scoped_release release;
  add_deformation(surface, map, threads, out);
}

}  // namespace

void register_grid_surface(py::module_& m) {
  const auto none = [](const char* name) { return py::arg(name).noconvert().none(true); };
  py::class_<GridSurface>(m, "GridSurface")
      .def(py::init(&make_surface), py::arg("neutral").noconvert(), py::arg("basis").noconvert(), py::arg("skin_weights").noconvert(),
           py::arg("pixels").noconvert(), py::arg("size"), py::arg("deformable").noconvert(), py::arg("deform_neutral").noconvert())
      .def("pose", &pose, py::arg("vertices").noconvert(), none("offsets"), py::arg("coefficients").noconvert(), py::arg("late").noconvert(),
           py::arg("turns"), none("rest"), py::arg("threads") = 0)
      .def("deform", &deform, py::arg("vertices").noconvert(), none("answer"), py::arg("threads") = 0);
}

}  // namespace cap4d
