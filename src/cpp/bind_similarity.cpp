#include <cmath>
#include <stdexcept>

#include "bind_arguments.h"
#include "bindings.h"
#include "similarity.h"

namespace py = pybind11;

namespace cap4d {
namespace {

// Sigma 1.5 (Wang et al. 2004, sec. III-B).
void fill_window(float* window) {
  double weights[kWindow], sum = 0;
  for (int k = 0; k < kWindow; ++k) sum += weights[k] = std::exp(-(k - kReach) * (k - kReach) / (2 * 1.5 * 1.5));
  for (int k = 0; k < kWindow; ++k) window[k] = static_cast<float>(weights[k] / sum);
}

SimilarityView view_of(const FloatArray& image, const FloatArray& target, float* partials) {
  if (image.ndim() != 3 || image.size() == 0) throw std::invalid_argument("image: expected [H, W, C]");
  const auto height = image.shape(0), width = image.shape(1), channels = image.shape(2);
  if (channels > 64) throw std::invalid_argument("image: expected at most 64 channels");
  expect(target, "target", {height, width, channels});
  SimilarityView view{image.data(), target.data(), static_cast<std::size_t>(height), static_cast<std::size_t>(width * channels),
                      static_cast<int>(channels), {}, partials};
  fill_window(view.window);
  return view;
}

py::tuple compare(FloatArray image, FloatArray target, int threads) {
  SimilarityView view = view_of(image, target, nullptr);
  FloatArray partials = aligned_array({3, image.shape(0), image.shape(1), image.shape(2)});
  view.partials = partials.mutable_data();
  SimilaritySums sums;
  {
    py::gil_scoped_release release;
    sums = similarity(view, threads);
  }
  return py::make_tuple(sums.absolute, sums.structural, partials);
}

FloatArray compare_vjp(FloatArray image, FloatArray target, FloatArray partials, float v_absolute, float v_structural, int threads) {
  expect(partials, "partials", {3, image.ndim() > 0 ? image.shape(0) : 0, image.ndim() > 1 ? image.shape(1) : 0, image.ndim() > 2 ? image.shape(2) : 0});
  const SimilarityView view = view_of(image, target, const_cast<float*>(partials.data()));
  FloatArray v_image = aligned_array({image.shape(0), image.shape(1), image.shape(2)});
  const SimilarityGradient gradient{v_absolute, v_structural, v_image.mutable_data()};
  py::gil_scoped_release release;
  similarity_vjp(view, threads, gradient);
  return v_image;
}

}  // namespace

void register_similarity(py::module_& m) {
  const auto image = py::arg("image").noconvert(), target = py::arg("target").noconvert();
  m.def("similarity", &compare, image, target, py::arg("threads") = 0);
  m.def("similarity_vjp", &compare_vjp, image, target, py::arg("partials").noconvert(), py::arg("v_absolute"), py::arg("v_structural"),
        py::arg("threads") = 0);
}

}  // namespace cap4d
