// What the bindings of the renderer take, checked: arrays of Gaussians, cameras, and images to write.
#pragma once
#include <pybind11/numpy.h>
#include <pybind11/stl.h>

#include <array>
#include <optional>
#include <vector>

#include "camera.h"
#include "gaussians.h"
#include "kernels.h"

namespace cap4d {

using FloatArray = pybind11::array_t<float, pybind11::array::c_style>;
using IntArray = pybind11::array_t<std::int32_t, pybind11::array::c_style>;
using DoubleArray = pybind11::array_t<double, pybind11::array::c_style>;
using Background = std::optional<std::array<float, 3>>;

// Each of these throws std::invalid_argument, which names the argument, what was expected and what was found.
void expect(const pybind11::array& a, const char* name, std::initializer_list<pybind11::ssize_t> shape);
void expect_below(const IntArray& indices, const char* name, pybind11::ssize_t limit);
Camera checked_camera(const DoubleArray& viewmat, const DoubleArray& K, int width, int height);

struct Inputs {  // the view's arrays are these
  FloatArray means, quats, scales, opacities, sh;
  GaussiansView view;
};
Inputs make_inputs(FloatArray means, FloatArray quats, FloatArray scales, FloatArray opacities, FloatArray sh, int sh_degree);

// An array that begins with a cache line; not initialised.
FloatArray aligned_array(std::vector<pybind11::ssize_t> shape);

struct OwnedImage {
  FloatArray rgb, alpha, depth;
  OwnedImage(int height, int width) : rgb({height, width, 3}), alpha({height, width}), depth({height, width}) {}
  Image view() { return {rgb.mutable_data(), alpha.mutable_data(), depth.mutable_data()}; }
};

}  // namespace cap4d
