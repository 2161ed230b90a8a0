#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "bind_arguments.h"
#include "bindings.h"
#include "unet_training.h"

namespace py = pybind11;

namespace cap4d {
namespace {

using Layers = std::vector<std::pair<FloatArray, FloatArray>>;  // weight, bias

std::unique_ptr<UnetPass> make_pass(int width, int batch, FloatArray encoding) {
  if (encoding.ndim() != 3 || encoding.shape(1) != encoding.shape(2) || encoding.shape(0) > 256)
    throw std::invalid_argument("encoding: expected [C, S, S]");
  return std::make_unique<UnetPass>(static_cast<int>(encoding.shape(1)), width, batch, encoding.data(), static_cast<int>(encoding.shape(0)));
}

std::vector<py::ssize_t> weight_shape(const UnetPass& pass, int layer, bool up) {
  const auto shape = pass.filter_shape(layer, up);
  return {static_cast<py::ssize_t>(shape[0]), static_cast<py::ssize_t>(shape[1]), 4, 4};
}

// A way's tensors, checked.
std::vector<LayerTensors> tensors_of(const UnetPass& pass, const Layers& layers, bool up) {
  const std::string way = up ? "up " : "down ";
  if (layers.size() != static_cast<std::size_t>(pass.depth())) throw std::invalid_argument(way + "layers: expected " + std::to_string(pass.depth()));
  std::vector<LayerTensors> out;
  for (int l = 0; l < pass.depth(); ++l) {
    const auto& [weight, bias] = layers[l];
    const auto shape = weight_shape(pass, l, up);
    const std::string name = way + std::to_string(l);
    expect(weight, (name + ".weight").c_str(), {shape[0], shape[1], 4, 4});
    expect(bias, (name + ".bias").c_str(), {up ? shape[1] : shape[0]});
    out.push_back({weight.data(), bias.data()});
  }
  return out;
}

FloatArray forward(UnetPass& pass, FloatArray offsets, const Layers& down, const Layers& up, int threads) {
  const py::ssize_t size = pass.size(), batch = pass.batch();
  expect(offsets, "offsets", {batch, 3, size, size});
  const auto downs = tensors_of(pass, down, false), ups = tensors_of(pass, up, true);
  FloatArray out({batch, py::ssize_t{3}, size, size});
  float* to = out.mutable_data();
  py::gil_scoped_release release;
  pass.forward(offsets.data(), downs.data(), ups.data(), threads, to);
  return out;
}

std::pair<Layers, std::vector<LayerGradients>> make_gradients(const UnetPass& pass, bool up) {
  Layers layers;
  std::vector<LayerGradients> to;
  for (int l = 0; l < pass.depth(); ++l) {
    const auto shape = weight_shape(pass, l, up);
    auto& [weight, bias] = layers.emplace_back(FloatArray(shape), FloatArray(up ? shape[1] : shape[0]));
    to.push_back({weight.mutable_data(), bias.mutable_data()});
  }
  return {std::move(layers), std::move(to)};
}

py::tuple backward(UnetPass& pass, FloatArray v_out, int threads) {
  const py::ssize_t size = pass.size(), batch = pass.batch();
  expect(v_out, "v_out", {batch, 3, size, size});
  auto [down, v_down] = make_gradients(pass, false);
  auto [up, v_up] = make_gradients(pass, true);
  {
    py::gil_scoped_release release;
    pass.backward(v_out.data(), threads, v_down.data(), v_up.data());
  }
  return py::make_tuple(down, up);
}

}  // namespace

void register_unet_training(py::module_& m) {
  py::class_<UnetPass>(m, "UnetPass", "The deformation network's way there and back, for fitting.")
      .def(py::init(&make_pass), py::arg("width"), py::arg("batch"), py::arg("encoding").noconvert())
      .def_property_readonly("size", &UnetPass::size)
      .def_property_readonly("batch", &UnetPass::batch)
      .def_property_readonly("depth", &UnetPass::depth)
      .def("forward", &forward, py::arg("offsets").noconvert(), py::arg("down"), py::arg("up"), py::arg("threads") = 0)
      .def("backward", &backward, py::arg("v_out").noconvert(), py::arg("threads") = 0);
}

}  // namespace cap4d
