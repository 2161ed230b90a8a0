#include <mutex>
#include <stdexcept>

#include "bind_arguments.h"
#include "bindings.h"
#include "render.h"

namespace py = pybind11;

namespace cap4d {
namespace {

using ByteArray = py::array_t<std::uint8_t, py::array::c_style>;

// A splatter as Python holds it: one frame at a time, whoever calls.
class PySplatter {
 public:
  PySplatter(FloatArray means, FloatArray quats, FloatArray scales, FloatArray opacities, FloatArray sh, std::optional<IntArray> binding,
             std::optional<IntArray> faces)
      : splatter_(packed(make_inputs(means, quats, scales, opacities, sh, -1), binding, faces)) {
    if (faces)
      for (py::ssize_t i = 0; i < faces->size(); ++i) vertices_needed_ = std::max<py::ssize_t>(vertices_needed_, faces->data()[i] + 1);
  }

  py::tuple render(DoubleArray viewmat, DoubleArray K, int width, int height, Background background, std::optional<FloatArray> vertices, int threads) {
    const View view = checked_view(viewmat, K, width, height, background, vertices);
    OwnedImage image(height, width);
    const Image out = image.view();
    draw_alone(view, threads, out);
    return py::make_tuple(image.rgb, image.alpha, image.depth);
  }

  void draw(ByteArray out, DoubleArray viewmat, DoubleArray K, Background background, std::optional<FloatArray> vertices, int threads,
            bool premultiplied) {
    if (out.ndim() != 3 || out.shape(2) != 4) throw std::invalid_argument("out: expected uint8[H, W, 4]");
    const View view =
        checked_view(viewmat, K, static_cast<int>(std::min<py::ssize_t>(out.shape(1), INT32_MAX)),
                     static_cast<int>(std::min<py::ssize_t>(out.shape(0), INT32_MAX)), background, vertices);
    if (background && premultiplied) throw std::invalid_argument("premultiplied: expected no background, got one");
    const Alpha alpha = background ? Alpha::kOpaque : premultiplied ? Alpha::kPremultiplied : Alpha::kStraight;
    draw_alone(view, threads, Image8{out.mutable_data(), alpha});
  }

  // The picture's size is asked for and counted into in one go: another thread may draw one of another size.
  void count_pixels(py::array_t<std::uint16_t, py::array::c_style> out, int threads) {
    if (out.ndim() != 2) throw std::invalid_argument("out: expected uint16[H, W]");
    std::uint16_t* to = out.mutable_data();
    const py::ssize_t height = out.shape(0), width = out.shape(1);
    Camera last;
    bool drawn;
    {
      py::gil_scoped_release release;
      std::lock_guard lock(busy_);
      last = splatter_.last().camera, drawn = splatter_.last().lists.offsets.get() != nullptr;
      if (drawn && height == last.height && width == last.width) return splatter_.count(threads, to);
    }
    if (!drawn) throw std::invalid_argument("count: expected a picture that was drawn, got none");
    expect(out, "out", {last.height, last.width});
  }

  py::array_t<std::uint32_t> order(DoubleArray viewmat, std::optional<FloatArray> vertices, int threads) {
    expect(viewmat, "viewmat", {4, 4});
    check_vertices(vertices);
    py::array_t<std::uint32_t> out(static_cast<py::ssize_t>(count()));
    std::uint32_t* to = out.mutable_data();
    {
      py::gil_scoped_release release;
      std::lock_guard lock(busy_);
      splatter_.order(viewmat.data(), vertices ? vertices->data() : nullptr, threads, to);
    }
    return out;
  }

  std::size_t count() const { return splatter_.packed().count; }
  std::size_t drawn() const { return splatter_.last().drawn; }
  std::size_t pairs() const { return splatter_.last().pairs; }
  std::size_t bytes() const { return splatter_.packed().bytes() + splatter_.last().bytes(); }
  py::dict seconds() const {
    const StageTimes& t = splatter_.last().seconds;
    py::dict out;
    out["bind"] = t.frames, out["project"] = t.project, out["sort"] = t.sort, out["tiles"] = t.tiles, out["rasterize"] = t.rasterize;
    return out;
  }

 private:
  static Packed packed(const Inputs& in, const std::optional<IntArray>& binding, const std::optional<IntArray>& faces) {
    if (binding.has_value() != faces.has_value()) throw std::invalid_argument("binding, faces: expected both or neither");
    if (!binding) return pack(in.view, nullptr, nullptr, 0);
    expect(*binding, "binding", {static_cast<py::ssize_t>(in.view.count)});
    expect(*faces, "faces", {faces->ndim() ? faces->shape(0) : 0, 3});
    expect_below(*binding, "binding", faces->shape(0));
    expect_below(*faces, "faces", INT32_MAX);
    return pack(in.view, binding->data(), faces->data(), static_cast<std::size_t>(faces->shape(0)));
  }

  View checked_view(const DoubleArray& viewmat, const DoubleArray& K, int width, int height, const Background& background,
                    const std::optional<FloatArray>& vertices) const {
    const View view{checked_camera(viewmat, K, width, height), background ? background->data() : nullptr, vertices ? vertices->data() : nullptr};
    check_vertices(vertices);
    return view;
  }

  void check_vertices(const std::optional<FloatArray>& vertices) const {
    if (vertices.has_value() != splatter_.packed().bound()) throw std::invalid_argument("vertices: expected where, and only where, there is a binding");
    if (vertices) {
      expect(*vertices, "vertices", {vertices->ndim() ? vertices->shape(0) : 0, 3});
      if (vertices->shape(0) < vertices_needed_) throw std::invalid_argument("vertices: expected all that faces name");
    }
  }

  template <class Out>
  void draw_alone(const View& view, int threads, const Out& out) {
    py::gil_scoped_release release;
    std::lock_guard lock(busy_);
    splatter_.draw(view, threads, out);
  }

  Splatter splatter_;
  py::ssize_t vertices_needed_ = 0;
  std::mutex busy_;
};

}  // namespace

void register_splatter(py::module_& m) {
  const auto background = py::arg("background").none(true), vertices = py::arg("vertices").noconvert().none(true);
  py::class_<PySplatter>(m, "Splatter")
      .def(py::init<FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, std::optional<IntArray>, std::optional<IntArray>>(),
           py::arg("means").noconvert(), py::arg("quats").noconvert(), py::arg("scales").noconvert(), py::arg("opacities").noconvert(),
           py::arg("sh").noconvert(), py::arg("binding").noconvert() = py::none(), py::arg("faces").noconvert() = py::none())
      .def("render", &PySplatter::render, py::arg("viewmat"), py::arg("K"), py::arg("width"), py::arg("height"), background = py::none(),
           vertices = py::none(), py::arg("threads") = 0)
      .def("draw", &PySplatter::draw, py::arg("out").noconvert(), py::arg("viewmat"), py::arg("K"), background = py::none(), vertices = py::none(),
           py::arg("threads") = 0, py::arg("premultiplied") = false)
      .def("count", &PySplatter::count_pixels, py::arg("out").noconvert(), py::arg("threads") = 0)
      .def("order", &PySplatter::order, py::arg("viewmat"), vertices = py::none(), py::arg("threads") = 0)
      .def("__len__", &PySplatter::count)
      .def_property_readonly("drawn", &PySplatter::drawn)
      .def_property_readonly("pairs", &PySplatter::pairs)
      .def_property_readonly("bytes", &PySplatter::bytes)
      .def_property_readonly("seconds", &PySplatter::seconds);
}

}  // namespace cap4d
