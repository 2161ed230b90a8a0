#include <algorithm>
#include <stdexcept>

#include "bind_arguments.h"
#include "bindings.h"
#include "parallel.h"
#include "render.h"

namespace py = pybind11;

namespace cap4d {
namespace {

constexpr std::size_t kGrain = 8192;  // Gaussians per piece of work

py::tuple render(FloatArray means, FloatArray quats, FloatArray scales, FloatArray opacities, FloatArray sh, DoubleArray viewmat, DoubleArray K,
                 int width, int height, Background background, int sh_degree, int threads) {
  const Inputs in = make_inputs(means, quats, scales, opacities, sh, sh_degree);
  const Camera camera = checked_camera(viewmat, K, width, height);
  OwnedImage image(height, width);
  const Image out = image.view();
  {
    py::gil_scoped_release release;
    Rendered rendered;
    render_fwd(camera, in.view, background ? background->data() : nullptr, Pass::kPlay, threads, out, rendered);
  }
  return py::make_tuple(image.rgb, image.alpha, image.depth);
}

py::tuple rasterize(FloatArray means, FloatArray quats, FloatArray scales, FloatArray opacities, FloatArray sh, DoubleArray viewmat, DoubleArray K,
                    int width, int height, Background background, int sh_degree, int threads) {
  const Inputs in = make_inputs(means, quats, scales, opacities, sh, sh_degree);
  const Camera camera = checked_camera(viewmat, K, width, height);
  OwnedImage image(height, width);
  const Image out = image.view();
  auto rendered = std::make_unique<Rendered>();
  const py::ssize_t n = means.shape(0);
  FloatArray means2d({n, py::ssize_t{2}});
  py::array_t<std::int32_t> radii(n);
  float* xy = means2d.mutable_data();
  std::int32_t* radius = radii.mutable_data();
  {
    py::gil_scoped_release release;
    render_fwd(camera, in.view, background ? background->data() : nullptr, Pass::kTrain, threads, out, *rendered);
    parallel_for(n, kGrain, threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t i = begin; i < end; ++i) {
        const bool drawn = rendered->radii[i] > 0;
        radius[i] = rendered->radii[i];
        xy[2 * i] = drawn ? rendered->splats[i].x : 0.0f, xy[2 * i + 1] = drawn ? rendered->splats[i].y : 0.0f;
      }
    });
  }
  return py::make_tuple(image.rgb, image.alpha, image.depth, means2d, radii, py::cast(std::move(rendered)));
}

py::tuple rasterize_vjp(const Rendered& rendered, FloatArray means, FloatArray quats, FloatArray scales, FloatArray opacities, FloatArray sh,
                        int sh_degree, FloatArray rgb, FloatArray alpha, FloatArray depth, FloatArray v_rgb, std::optional<FloatArray> v_alpha,
                        std::optional<FloatArray> v_depth, int threads) {
  const Inputs in = make_inputs(means, quats, scales, opacities, sh, sh_degree);
  const py::ssize_t n = means.shape(0), height = rendered.camera.height, width = rendered.camera.width;
  if (static_cast<std::size_t>(n) != rendered.count) throw std::invalid_argument("means: not the Gaussians of the forward pass");
  expect(rgb, "rgb", {height, width, 3});
  expect(alpha, "alpha", {height, width});
  expect(depth, "depth", {height, width});
  expect(v_rgb, "v_rgb", {height, width, 3});
  if (v_alpha) expect(*v_alpha, "v_alpha", {height, width});
  if (v_depth) expect(*v_depth, "v_depth", {height, width});
  FloatArray v_means({n, py::ssize_t{3}}), v_quats({n, py::ssize_t{4}}), v_scales({n, py::ssize_t{3}}), v_opacities(n);
  FloatArray v_sh = aligned_array({n, sh.shape(1), 3}), v_means2d({n, py::ssize_t{2}});
  const Image image{const_cast<float*>(rgb.data()), const_cast<float*>(alpha.data()), const_cast<float*>(depth.data())};
  const ImageGrad v_image{v_rgb.data(), v_alpha ? v_alpha->data() : nullptr, v_depth ? v_depth->data() : nullptr};
  const GaussianGrads grads{v_means.mutable_data(), v_quats.mutable_data(), v_scales.mutable_data(),
                            v_opacities.mutable_data(), v_sh.mutable_data(), v_means2d.mutable_data()};
  {
    py::gil_scoped_release release;
    render_bwd(rendered, in.view, image, v_image, threads, grads);
  }
  return py::make_tuple(v_means, v_quats, v_scales, v_opacities, v_sh, v_means2d);
}

}  // namespace

void register_render(py::module_& m) {
  py::class_<Rendered>(m, "Rendered", "What the forward pass leaves for the gradient.")
      .def_property_readonly("drawn", [](const Rendered& r) { return r.drawn; })
      .def_property_readonly("pairs", [](const Rendered& r) { return r.pairs; });
  const auto means = py::arg("means").noconvert();
  const auto quats = py::arg("quats").noconvert();
  const auto scales = py::arg("scales").noconvert();
  const auto opacities = py::arg("opacities").noconvert();
  const auto sh = py::arg("sh").noconvert();
  m.def("render", &render, means, quats, scales, opacities, sh, py::arg("viewmat"), py::arg("K"), py::arg("width"), py::arg("height"),
        py::arg("background") = py::none(), py::arg("sh_degree") = -1, py::arg("threads") = 0);
  m.def("rasterize", &rasterize, means, quats, scales, opacities, sh, py::arg("viewmat"), py::arg("K"), py::arg("width"), py::arg("height"),
        py::arg("background") = py::none(), py::arg("sh_degree") = -1, py::arg("threads") = 0);
  m.def("rasterize_vjp", &rasterize_vjp, py::arg("rendered"), means, quats, scales, opacities, sh, py::arg("sh_degree"), py::arg("rgb").noconvert(),
        py::arg("alpha").noconvert(), py::arg("depth").noconvert(), py::arg("v_rgb").noconvert(), py::arg("v_alpha").noconvert(),
        py::arg("v_depth").noconvert(), py::arg("threads") = 0);
  m.def("isa", [] { return kernels().isa; });
  m.def("default_threads", &default_threads);
}

}  // namespace cap4d
