#include <pybind11/numpy.h>

#include <algorithm>
#include <sstream>
#include <stdexcept>
#include <string>

#include "bindings.h"
#include "lit_surface.h"
#include "noise.h"

namespace py = pybind11;

namespace cap4d {
namespace {

using Floats = py::array_t<float, py::array::c_style>;
using Doubles = py::array_t<double, py::array::c_style>;
using Ints = py::array_t<std::int32_t, py::array::c_style>;

template <class T>
void expect(const char* name, const py::array_t<T, py::array::c_style>& array, std::initializer_list<py::ssize_t> shape) {
  if (array.ndim() == static_cast<py::ssize_t>(shape.size()) && std::equal(shape.begin(), shape.end(), array.shape())) return;
  std::ostringstream wanted;
  for (const py::ssize_t n : shape) wanted << ' ' << n;
  throw std::invalid_argument(std::string(name) + ": expected shape" + wanted.str());
}

void expect_indices(const char* name, const Ints& indices, py::ssize_t below) {
  for (py::ssize_t i = 0; i < indices.size(); ++i)
    if (indices.data()[i] < 0 || indices.data()[i] >= below) throw std::invalid_argument(std::string(name) + ": an index is out of range");
}

template <class T>
std::span<const T> span(const py::array_t<T, py::array::c_style>& array) {
  return {array.data(), static_cast<std::size_t>(array.size())};
}

void copy3(const char* name, const Floats& from, float* to) {
  expect(name, from, {3});
  std::copy_n(from.data(), 3, to);
}

py::ssize_t point_count(const Floats& points) {
  if (points.ndim() != 2 || points.shape(1) != 3) throw std::invalid_argument("points: expected float32[N, 3]");
  return points.shape(0);
}

Floats gradient(Floats points, std::uint32_t seed) {
  Floats values(point_count(points));
  py::gil_scoped_release release;
  gradient_noise({points.data(), static_cast<std::size_t>(points.size())}, seed, values.mutable_data());
  return values;
}

py::tuple cellular(Floats points, std::uint32_t seed) {
  Floats distances(point_count(points)), owns(point_count(points));
  {
    py::gil_scoped_release release;
    cellular_noise({points.data(), static_cast<std::size_t>(points.size())}, seed, distances.mutable_data(), owns.mutable_data());
  }
  return py::make_tuple(distances, owns);
}

py::tuple light(Ints face, Doubles bary, Ints faces, Ints uv_faces, Floats positions, Floats normals, Floats soft, Floats depths, Floats open,
                Floats visible, Floats uvs, Floats texture, Floats directions, Floats colors, Floats sky, Floats ground, Floats up, Floats eye) {
  if (face.ndim() != 2) throw std::invalid_argument("face: expected int32[H, W]");
  const py::ssize_t h = face.shape(0), w = face.shape(1), f = faces.shape(0), v = positions.shape(0), l = directions.shape(0), s = texture.shape(0);
  expect("bary", bary, {h, w, 3});
  expect("faces", faces, {f, 3});
  expect("uv_faces", uv_faces, {f, 3});
  for (const auto& [name, array] : {std::pair{"positions", &positions}, {"normals", &normals}, {"soft", &soft}}) expect(name, *array, {v, 3});
  expect("depths", depths, {v});
  expect("open", open, {v});
  expect("visible", visible, {v, l});
  expect("uvs", uvs, {uvs.shape(0), 2});
  if (s < 2 || s > 16384) throw std::invalid_argument("texture: expected 2 to 16384 texels a side");
  expect("texture", texture, {s, s, kTextureChannels});
  expect("directions", directions, {l, 3});
  expect("colors", colors, {l, 3});
  expect_indices("faces", faces, v);
  expect_indices("uv_faces", uv_faces, uvs.shape(0));
  for (py::ssize_t i = 0; i < face.size(); ++i)
    if (face.data()[i] >= f) throw std::invalid_argument("face: an index is out of range");
  for (py::ssize_t i = 0; i < uvs.size(); ++i)  // the texture is read where they say
    if (!(uvs.data()[i] >= -1e6f && uvs.data()[i] <= 1e6f)) throw std::invalid_argument("uvs: expected finite texels");
  Lighting lighting{.directions = span(directions), .colors = span(colors)};
  copy3("sky", sky, lighting.sky);
  copy3("ground", ground, lighting.ground);
  copy3("up", up, lighting.up);
  copy3("eye", eye, lighting.eye);
  const LitSurface surface{.faces = span(faces), .uv_faces = span(uv_faces), .positions = span(positions), .normals = span(normals),
                           .soft = span(soft), .depths = span(depths), .open = span(open), .visible = span(visible), .uvs = span(uvs)};
  Floats rgb({h, w, py::ssize_t{3}}), depth({h, w});
  {
    py::gil_scoped_release release;
    light_surface(surface, {span(texture), static_cast<int>(s)}, lighting, span(face), span(bary), rgb.mutable_data(), depth.mutable_data());
  }
  return py::make_tuple(rgb, depth);
}

}  // namespace

void register_lit_surface(py::module_& m) {
  m.def("gradient_noise", &gradient, py::arg("points").noconvert(), py::arg("seed"));
  m.def("cellular_noise", &cellular, py::arg("points").noconvert(), py::arg("seed"));
  m.def("light_surface", &light, py::arg("face").noconvert(), py::arg("bary").noconvert(), py::arg("faces").noconvert(),
        py::arg("uv_faces").noconvert(), py::arg("positions").noconvert(), py::arg("normals").noconvert(), py::arg("soft").noconvert(),
        py::arg("depths").noconvert(), py::arg("open").noconvert(), py::arg("visible").noconvert(), py::arg("uvs").noconvert(),
        py::arg("texture").noconvert(), py::arg("directions").noconvert(), py::arg("colors").noconvert(), py::arg("sky").noconvert(),
        py::arg("ground").noconvert(), py::arg("up").noconvert(), py::arg("eye").noconvert());
}

}  // namespace cap4d
