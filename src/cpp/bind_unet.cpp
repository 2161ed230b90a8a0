#include <pybind11/numpy.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <bit>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>

#include "bindings.h"
#include "unet.h"

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

template <class N>
UnetTensors<N> take_all(const Tensors& tensors, int size) {
  constexpr bool kScaled = std::is_same_v<N, Int8>;
  check_unet_size(size);
  const int depth = unet_depth(size), half = size / 2, width = tensors.width();
  UnetTensors<N> t{};
  t.size = size, t.width = width;
  t.mask = tensors.take<std::uint8_t>("mask", {size, size});
  t.weight = tensors.take<float>("down0.weight", {width, 3, 4, 4});
  t.rows = tensors.take<float>("down0.rows", {3, half, width});
  t.columns = tensors.take<float>("down0.columns", {3, half, width});
  if (kScaled) t.out = take_activation(tensors, "down0", width, false);
  for (int i = 1; i < depth; ++i) {
    const std::string name = "down" + std::to_string(i);
    const int outputs = unet_channels(width, i);
    DownTensors<N>& down = t.down.emplace_back();
    down.weight = tensors.take<typename N::Weight>(name + ".weight", {outputs, unet_channels(width, i - 1), 4, 4});
    if (kScaled) down.scale = tensors.take<float>(name + ".scale", {outputs});
    if (i == depth - 1) down.bias = tensors.take<float>(name + ".bias", {outputs});
    if (kScaled) down.out = take_activation(tensors, name, outputs, i == depth - 1);
  }
  for (int i = 0; i < depth; ++i) {
    const std::string name = "up" + std::to_string(i);
    const int inputs = unet_channels(width, i) * (i == depth - 1 ? 1 : 2), outputs = i ? unet_channels(width, i - 1) : 3;
    UpTensors<N>& up = t.up.emplace_back();
    up.weight = tensors.take<typename N::Weight>(name + ".weight", {inputs, outputs, 4, 4});
    if (kScaled || i == 0) up.scale = tensors.take<float>(name + ".scale", {outputs});
    if (kScaled && i) up.relu_scale = tensors.take<float>(name + ".relu_scale", {outputs});
    if (i == 0) up.bias = tensors.take<float>(name + ".bias", {outputs});
  }
  return t;
}

template <class N>
std::unique_ptr<Unet<N>> make(const py::dict& dict, int size) {
  return std::make_unique<Unet<N>>(take_all<N>(Tensors(dict), size));
}

// Looks at every exponent and never stops early: this way it is vectorised.
bool all_finite(const float* values, std::size_t count) {
  constexpr std::uint32_t kExponent = 0x7f800000;
  std::uint32_t found = 0;
  for (std::size_t i = 0; i < count; ++i) found |= (std::bit_cast<std::uint32_t>(values[i]) & kExponent) == kExponent;
  return found == 0;
}

void expect_map(const FloatArray& map, const char* name, py::ssize_t size) {
  if (map.ndim() != 3 || map.shape(0) != 3 || map.shape(1) != size || map.shape(2) != size)
    throw std::invalid_argument(std::string(name) + ": expected float32[3, " + std::to_string(size) + ", " + std::to_string(size) + "]");
}

template <class N>
FloatArray run(Unet<N>& net, FloatArray offsets, int threads, std::optional<FloatArray> out) {
  const py::ssize_t size = net.size();
  expect_map(offsets, "offsets", size);
  if (out) expect_map(*out, "out", size);
  if (!all_finite(offsets.data(), offsets.size())) throw std::invalid_argument("offsets: expected finite numbers, got one that is not");
  FloatArray answer = out ? *out : FloatArray({py::ssize_t{3}, size, size});
  float* to = answer.mutable_data();
  {
    py::gil_scoped_release release;
    net.run(offsets.data(), threads, to);
  }
  return answer;
}

template <class N>
void register_unet_of(py::module_& m, const char* name, const char* doc) {
  py::class_<Unet<N>>(m, name, doc)
      .def(py::init(&make<N>), py::arg("tensors"), py::arg("size"))
      .def_property_readonly("size", &Unet<N>::size)
      .def_property_readonly_static("isa", [](const py::object&) { return unet_kernels<N>().isa; })
      .def("run", &run<N>, py::arg("offsets").noconvert(), py::arg("threads") = 0, py::arg("out").noconvert() = py::none());
}

}  // namespace

void register_unet(py::module_& m) {
  register_unet_of<Int8>(m, "QuantizedUnet", "The deformation U-Net in 8-bit integers.");
  register_unet_of<Float32>(m, "FloatUnet", "The deformation U-Net in float32.");
}

}  // namespace cap4d
