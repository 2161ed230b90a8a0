#include <pybind11/numpy.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

#include "bindings.h"
#include "quantized_layers.h"
#include "quantized_unet.h"

namespace py = pybind11;

namespace cap4d {
namespace {

using FloatArray = py::array_t<float, py::array::c_style>;

// Tensors by name, each taken with the dtype and the shape that it must have.
class Tensors {
 public:
  explicit Tensors(const py::dict& dict) : dict_(dict) {}

  template <class T>
  std::span<const T> take(const std::string& name, std::initializer_list<py::ssize_t> shape) const {
    if (!dict_.contains(name)) throw std::invalid_argument(name + ": expected a tensor, got nothing");
    const py::object value = dict_[name.c_str()];
    if (!py::isinstance<py::array_t<T, py::array::c_style>>(value))
      throw std::invalid_argument(name + ": expected a contiguous array of " + py::str(py::dtype::of<T>()).cast<std::string>());
    const auto array = py::reinterpret_borrow<py::array_t<T, py::array::c_style>>(value);
    if (array.ndim() != static_cast<py::ssize_t>(shape.size()) || !std::equal(shape.begin(), shape.end(), array.shape()))
      throw std::invalid_argument(name + ": wrong shape");
    return {array.data(), static_cast<std::size_t>(array.size())};
  }

  // Outputs of the first layer.
  int width() const {
    const py::object value = dict_.contains("down0.weight") ? py::object(dict_["down0.weight"]) : py::none();
    if (!py::isinstance<py::array>(value)) throw std::invalid_argument("down0.weight: expected a tensor");
    const auto array = py::reinterpret_borrow<py::array>(value);
    const py::ssize_t width = array.ndim() == 4 ? array.shape(0) : 0;
    if (width < 1 || width > kMaxUnetWidth) throw std::invalid_argument("down0.weight: expected [1 to 256, 3, 4, 4]");
    return static_cast<int>(width);
  }

 private:
  const py::dict& dict_;
};

ActivationTensors take_activation(const Tensors& tensors, const std::string& name, int channels, bool innermost) {
  ActivationTensors out;
  if (!innermost) {
    out.leaky_scale = tensors.take<float>(name + ".leaky_scale", {channels});
    out.leaky_zero = tensors.take<std::uint8_t>(name + ".leaky_zero", {channels});
  }
  out.relu_scale = tensors.take<float>(name + ".relu_scale", {channels});
  return out;
}

UnetTensors take_all(const Tensors& tensors, int size) {
  check_unet_size(size);
  const int depth = unet_depth(size), half = size / 2, width = tensors.width();
  UnetTensors t{};
  t.size = size, t.width = width;
  t.mask = tensors.take<std::uint8_t>("mask", {size, size});
  t.weight = tensors.take<float>("down0.weight", {width, 3, 4, 4});
  t.rows = tensors.take<float>("down0.rows", {3, half, width});
  t.columns = tensors.take<float>("down0.columns", {3, half, width});
  t.out = take_activation(tensors, "down0", width, false);
  for (int i = 1; i < depth; ++i) {
    const std::string name = "down" + std::to_string(i);
    const int outputs = unet_channels(width, i);
    DownTensors& down = t.down.emplace_back();
    down.weight = tensors.take<std::int8_t>(name + ".weight", {outputs, unet_channels(width, i - 1), 4, 4});
    down.scale = tensors.take<float>(name + ".scale", {outputs});
    if (i == depth - 1) down.bias = tensors.take<float>(name + ".bias", {outputs});
    down.out = take_activation(tensors, name, outputs, i == depth - 1);
  }
  for (int i = 0; i < depth; ++i) {
    const std::string name = "up" + std::to_string(i);
    const int inputs = unet_channels(width, i) * (i == depth - 1 ? 1 : 2), outputs = i ? unet_channels(width, i - 1) : 3;
    UpTensors& up = t.up.emplace_back();
    up.weight = tensors.take<std::int8_t>(name + ".weight", {inputs, outputs, 4, 4});
    up.scale = tensors.take<float>(name + ".scale", {outputs});
    if (i)
      up.relu_scale = tensors.take<float>(name + ".relu_scale", {outputs});
    else
      up.bias = tensors.take<float>(name + ".bias", {outputs});
  }
  return t;
}

std::unique_ptr<QuantizedUnet> make(const py::dict& dict, int size) { return std::make_unique<QuantizedUnet>(take_all(Tensors(dict), size)); }

FloatArray run(QuantizedUnet& net, FloatArray offsets, int threads) {
  const py::ssize_t size = net.size();
  if (offsets.ndim() != 3 || offsets.shape(0) != 3 || offsets.shape(1) != size || offsets.shape(2) != size)
    throw std::invalid_argument("offsets: expected float32[3, " + std::to_string(size) + ", " + std::to_string(size) + "]");
  if (!std::all_of(offsets.data(), offsets.data() + offsets.size(), [](float x) { return std::isfinite(x); }))
    throw std::invalid_argument("offsets: expected finite numbers, got one that is not");
  FloatArray out({py::ssize_t{3}, size, size});
  float* to = out.mutable_data();
  {
    py::gil_scoped_release release;
    net.run(offsets.data(), threads, to);
  }
  return out;
}

}  // namespace

void register_quantized_unet(py::module_& m) {
  py::class_<QuantizedUnet>(m, "QuantizedUnet", "The deformation U-Net in 8-bit integers.")
      .def(py::init(&make), py::arg("tensors"), py::arg("size"))
      .def_property_readonly("size", &QuantizedUnet::size)
      .def_property_readonly_static("isa", [](const py::object&) { return unet_kernels().isa; })
      .def("run", &run, py::arg("offsets").noconvert(), py::arg("threads") = 0);
}

}  // namespace cap4d
