#include "bind_arguments.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

#include "constants.h"
#include "pages.h"

namespace py = pybind11;

namespace cap4d {
namespace {

std::string shape_text(const py::ssize_t* sizes, std::size_t count) {
  std::string text = "[";
  for (std::size_t i = 0; i < count; ++i) text.append(i ? ", " : "").append(std::to_string(sizes[i]));
  return text + "]";
}

std::string describe(const py::array& a) { return shape_text(a.shape(), a.ndim()); }

}  // namespace

void expect(const py::array& a, const char* name, std::initializer_list<py::ssize_t> shape) {
  if (a.ndim() != static_cast<py::ssize_t>(shape.size()) || !std::equal(shape.begin(), shape.end(), a.shape()))
    throw std::invalid_argument(std::string(name) + ": expected " + shape_text(shape.begin(), shape.size()) + ", got " + describe(a));
}

void expect_below(const IntArray& indices, const char* name, py::ssize_t limit) {
  for (py::ssize_t i = 0; i < indices.size(); ++i)
    if (indices.data()[i] < 0 || indices.data()[i] >= limit)
      throw std::invalid_argument(std::string(name) + ": index " + std::to_string(indices.data()[i]) + " is out of range");
}

Inputs make_inputs(FloatArray means, FloatArray quats, FloatArray scales, FloatArray opacities, FloatArray sh, int sh_degree) {
  const py::ssize_t n = means.ndim() ? means.shape(0) : 0;
  if (n >= (py::ssize_t{1} << 31)) throw std::invalid_argument("means: more than 2^31 Gaussians");
  expect(means, "means", {n, 3});
  expect(quats, "quats", {n, 4});
  expect(scales, "scales", {n, 3});
  expect(opacities, "opacities", {n});
  const int stored = sh.ndim() == 3 ? static_cast<int>(sh.shape(1)) : 0;
  if (stored != 1 && stored != 4 && stored != 9 && stored != 16) throw std::invalid_argument("sh: expected [N, 1|4|9|16, 3], got " + describe(sh));
  expect(sh, "sh", {n, stored, 3});
  const int degree = stored == 1 ? 0 : stored == 4 ? 1 : stored == 9 ? 2 : 3;
  if (sh_degree > degree) throw std::invalid_argument("sh_degree: expected at most " + std::to_string(degree) + ", got " + std::to_string(sh_degree));
  const GaussiansView view{static_cast<std::size_t>(n), stored, sh_degree < 0 ? degree : sh_degree,
                           means.data(), quats.data(), scales.data(), opacities.data(), sh.data()};
  return {means, quats, scales, opacities, sh, view};
}

FloatArray aligned_array(std::vector<py::ssize_t> shape) {
  std::size_t size = sizeof(float);
  for (const py::ssize_t n : shape) size *= static_cast<std::size_t>(n);
  auto* data = static_cast<float*>(allocate_pages(size));
  const py::capsule owner(data, &release_pages);
  return FloatArray(std::move(shape), data, owner);
}

Camera checked_camera(const DoubleArray& viewmat, const DoubleArray& K, int width, int height) {
  expect(viewmat, "viewmat", {4, 4});
  expect(K, "K", {3, 3});
  if (width < 1 || height < 1 || width > kMaxSide || height > kMaxSide)
    throw std::invalid_argument("size: expected 1 to " + std::to_string(kMaxSide) + " px a side, got " + std::to_string(width) + "x" + std::to_string(height));
  for (int i = 0; i < 16; ++i)
    if (!std::isfinite(viewmat.data()[i])) throw std::invalid_argument("viewmat: expected finite numbers");
  for (int i = 0; i < 9; ++i)
    if (!std::isfinite(K.data()[i])) throw std::invalid_argument("K: expected finite numbers");
  if (!(K.data()[0] > 0) || !(K.data()[4] > 0)) throw std::invalid_argument("K: expected positive focal lengths");
  return make_camera(viewmat.data(), K.data(), width, height);
}

}  // namespace cap4d
