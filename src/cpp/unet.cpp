// What is done once, when a network is loaded, and the order of the work of a frame.
//
// One job of the thread pool is a whole frame: its threads go through the layers together, each taking panels of output channels as
// long as there are any. A panel is owned by one thread from the dot products to the activations, so the sums stay in its caches; but
// for a layer of one panel, which is shared out.
// Which thread takes what changes nothing. A thread that comes late, or never, only leaves more to the others.
#include "unet.h"

#include <algorithm>
#include <atomic>
#include <cstring>
#include <deque>
#include <functional>
#include <mutex>
#include <new>
#include <stdexcept>
#include <string>
#include <thread>
#include <type_traits>

#include "parallel.h"

namespace cap4d {
namespace {

constexpr float kNormEpsilon = 1e-5f;  // of InstanceNorm (fact 22)
constexpr int kMinSize = 8, kMaxDepth = 6;
constexpr int kSpins = 2000;  // looks at a counter before a waiting thread offers its core to others

// Zeroed memory that starts at a cache line.
template <class T>
class Aligned {
 public:
  Aligned() = default;
  explicit Aligned(std::size_t count) : data_(static_cast<T*>(::operator new(count * sizeof(T), kLine))) {
    std::memset(data_.get(), 0, count * sizeof(T));
  }
  T* data() const { return data_.get(); }
  T& operator[](std::size_t i) const { return data_.get()[i]; }

 private:
  static constexpr std::align_val_t kLine{64};
  struct Free {
    void operator()(T* p) const { ::operator delete(p, kLine); }
  };
  std::unique_ptr<T[], Free> data_;
};

int padded(int channels) { return (channels + kChannelBlock - 1) / kChannelBlock * kChannelBlock; }
int panel_width(int channels) { return channels % kMaxPanel == 0 && channels > kMaxPanel ? kMaxPanel : kChannelBlock; }

// One or two images of one size, one behind the other, each with its border.
template <class N>
struct Image {
  using Value = typename N::Value;
  int side = 0, channels = 0;  // channels: padded
  Aligned<Value> values;

  Image() = default;
  Image(int side, int channels, int count) : side(side), channels(channels), values(count * plane()) {}
  std::size_t line() const { return static_cast<std::size_t>(side + 2) * channels; }
  std::size_t plane() const { return (side + 2) * line(); }
  std::uint32_t inner(int y, int x) const { return static_cast<std::uint32_t>((y + 1) * line() + static_cast<std::size_t>(x + 1) * channels); }
  std::uint32_t outer(int y, int x) const { return static_cast<std::uint32_t>(y * line() + static_cast<std::size_t>(x) * channels); }
};

Segment segment(std::size_t offset, int count) { return {static_cast<std::uint32_t>(offset), static_cast<std::uint32_t>(count)}; }

// How a layer's activations become values of one image.
template <class N>
struct Destination {
  typename N::Value* image = nullptr;
  Aligned<float> inverse_scale, zero;

  Target<N> from(int channel) const {
    return image ? Target<N>{image + channel, inverse_scale.data() + channel, zero.data() + channel} : Target<N>{};
  }
};

template <class N>
Destination<N> destination(typename N::Value* image, std::span<const float> scale, std::span<const std::uint8_t> zero, int channels) {
  Destination<N> to{image, Aligned<float>(channels), Aligned<float>(channels)};
  for (std::size_t c = 0; c < scale.size(); ++c) to.inverse_scale[c] = 1.0f / scale[c];
  for (std::size_t c = 0; c < zero.size(); ++c) to.zero[c] = zero[c];
  return to;
}

// A layer but the first and the last. Its weights lie panel by panel, in each parity by parity, in the order in which `dot` reads them.
template <class N>
struct Layer {
  const typename N::Value* input = nullptr;
  int inputs = 0, outputs = 0, panel = 0;      // channels, padded
  std::vector<std::uint32_t> from, to;         // [pixels] first input value; [parities x pixels] output value
  std::vector<std::vector<Segment>> segments;  // of each parity
  std::size_t taps = 0;                        // values of one pixel's input
  Aligned<typename N::Weight> weights;
  Aligned<typename N::Sum> init;  // [panels][parities][panel]
  bool normalised = true;
  Aligned<float> epsilon;        // [outputs], where normalised
  Aligned<float> mean, gain;     // [outputs], computed, or fixed where not normalised
  Aligned<typename N::Sum> acc;  // [parities x pixels][panel] where parities are shared out; see `shared`
  Destination<N> leaky, relu;

  int parities() const { return static_cast<int>(segments.size()); }
  int panels() const { return outputs / panel; }
  // A single panel would leave all threads but one idle: they take a parity each.
  bool shared() const { return panels() == 1 && parities() > 1; }
};

// The weight of a layer's output for its input channel at a value of a segment, 0 where there is none.
template <class N>
using WeightAt = std::function<typename N::Weight(int parity, int output, int segment, int column, int channel)>;

template <class N>
void pack(Layer<N>& layer, const WeightAt<N>& weight, const std::vector<typename N::Value>& zero) {
  const int panel = layer.panel, parities = layer.parities();
  layer.weights = Aligned<typename N::Weight>(static_cast<std::size_t>(layer.outputs) * parities * layer.taps);
  layer.init = Aligned<typename N::Sum>(static_cast<std::size_t>(layer.outputs) * parities);
  typename N::Weight* to = layer.weights.data();
  for (int first = 0; first < layer.outputs; first += panel)
    for (int parity = 0; parity < parities; ++parity) {
      typename N::Sum* init = layer.init.data() + static_cast<std::size_t>(first) * parities + parity * panel;
      int segment = 0;
      for (const Segment& s : layer.segments[parity]) {
        for (std::uint32_t k = 0; k < s.count; k += N::kGroup)
          for (int lane = 0; lane < panel; ++lane)
            for (std::uint32_t b = k; b < k + N::kGroup; ++b) {
              const int channel = static_cast<int>(b % layer.inputs);
              const typename N::Weight w = weight(parity, first + lane, segment, static_cast<int>(b / layer.inputs), channel);
              init[lane] -= w * zero[channel];
              *to++ = w;
            }
        ++segment;
      }
    }
}

// A zero border in terms of the image's own numbers.
template <class N>
void fill_border(const Image<N>& image, const std::vector<typename N::Value>& zero) {
  for (int y = 0; y < image.side + 2; ++y)
    for (int x = 0; x < image.side + 2; ++x)
      if (y == 0 || x == 0 || y == image.side + 1 || x == image.side + 1)
        std::copy(zero.begin(), zero.end(), image.values.data() + image.outer(y, x));
}

template <class N>
std::vector<typename N::Value> padded_zero(std::span<const std::uint8_t> zero, int channels) {
  std::vector<typename N::Value> out(channels);
  std::copy(zero.begin(), zero.end(), out.begin());
  return out;
}

template <class T>
void expect_size(std::span<const T> values, std::size_t count, const std::string& name) {
  if (values.size() != count)
    throw std::invalid_argument(name + ": expected " + std::to_string(count) + " numbers, got " + std::to_string(values.size()));
}

template <class N>
void check(const UnetTensors<N>& t) {
  constexpr bool kScaled = std::is_same_v<N, Int8>;
  check_unet_size(t.size);
  if (t.width < 1 || t.width > kMaxUnetWidth) throw std::invalid_argument("width: expected 1 to 256, got " + std::to_string(t.width));
  const std::size_t depth = unet_depth(t.size), half = t.size / 2, width = t.width, plane = static_cast<std::size_t>(t.size) * t.size;
  if (t.down.size() != depth - 1 || t.up.size() != depth) throw std::invalid_argument("layers: expected " + std::to_string(depth) + " each way");
  expect_size(t.mask, plane, "mask");
  expect_size(t.weight, width * kFirstTaps, "weight");
  expect_size(t.rows, 3 * half * width, "rows");
  expect_size(t.columns, 3 * half * width, "columns");
  const auto check_out = [](const ActivationTensors& out, std::size_t channels, bool innermost, const std::string& name) {
    if (!kScaled) channels = 0;
    expect_size(out.leaky_scale, innermost ? 0 : channels, name + ".leaky_scale");
    expect_size(out.leaky_zero, innermost ? 0 : channels, name + ".leaky_zero");
    expect_size(out.relu_scale, channels, name + ".relu_scale");
  };
  check_out(t.out, width, false, "down0");
  for (std::size_t i = 1; i < depth; ++i) {
    const DownTensors<N>& down = t.down[i - 1];
    const std::string name = "down" + std::to_string(i);
    const std::size_t inputs = unet_channels(t.width, static_cast<int>(i) - 1), outputs = unet_channels(t.width, static_cast<int>(i));
    const bool innermost = i == depth - 1;
    expect_size(down.weight, outputs * inputs * 16, name + ".weight");
    expect_size(down.scale, kScaled ? outputs : 0, name + ".scale");
    expect_size(down.bias, innermost ? outputs : 0, name + ".bias");
    check_out(down.out, outputs, innermost, name);
  }
  for (std::size_t i = 0; i < depth; ++i) {
    const UpTensors<N>& up = t.up[i];
    const std::string name = "up" + std::to_string(i);
    const std::size_t inputs = unet_channels(t.width, static_cast<int>(i)) * (i == depth - 1 ? 1 : 2);
    const std::size_t outputs = i ? unet_channels(t.width, static_cast<int>(i) - 1) : 3;
    expect_size(up.weight, inputs * outputs * 16, name + ".weight");
    expect_size(up.scale, kScaled || i == 0 ? outputs : 0, name + ".scale");
    expect_size(up.relu_scale, kScaled && i ? outputs : 0, name + ".relu_scale");
    expect_size(up.bias, i ? 0 : outputs, name + ".bias");
  }
}

// A share of a frame's work, on cache lines of its own: items are handed out one by one, and the next phase starts when all are done.
enum class Step { kFirst, kPanel, kParity, kNorm, kActivate, kLast };
struct alignas(64) Phase {
  Step step;
  std::size_t layer;
  int items;
  std::atomic<int> next{0}, done{0};

  Phase(Step step, std::size_t layer, int items) : step(step), layer(layer), items(items) {}
};

}  // namespace

void check_unet_size(int size) {
  if (size < kMinSize || size > kMaxUnetSize || (size & (size - 1)))
    throw std::invalid_argument("size: expected a power of two in [8, 512], got " + std::to_string(size));
}

int unet_depth(int size) {
  int depth = -1;
  for (; size > 1; size /= 2) ++depth;
  return std::min(depth, kMaxDepth);
}

int unet_channels(int width, int layer) { return width << std::min(layer, 3); }

template <class N>
struct Unet<N>::Impl {
  using Weight = typename N::Weight;
  using Sum = typename N::Sum;
  int size, width, depth;
  const UnetKernels<N>& kernels = unet_kernels<N>();
  std::vector<std::uint8_t> mask;
  Aligned<float> first_weights, rows, columns;
  Destination<N> first_leaky, first_relu;
  std::vector<Image<N>> leaky;    // [depth - 1] outputs of the way down, for the next layer
  std::vector<Image<N>> decoder;  // [depth] input of up i: the way down's output, then that of up i + 1
  std::vector<Layer<N>> layers;   // down 1, .., up depth - 1, .., up 1
  Aligned<Weight> last_weights;
  float last_scale[3], last_bias[3];

  std::mutex busy;
  std::deque<Phase> phases;
  std::vector<Aligned<Sum>> sums;  // of each thread
  std::size_t most_sums = 0;
  const float* offsets = nullptr;
  float* out = nullptr;

  explicit Impl(const UnetTensors<N>& t) : size(t.size), width(t.width), depth(unet_depth(t.size)), mask(t.mask.begin(), t.mask.end()) {
    for (int i = 0; i < depth; ++i) {
      const int side = size >> (i + 1), channels = padded(unet_channels(width, i));
      if (i < depth - 1) leaky.emplace_back(side, channels, 1);
      decoder.emplace_back(side, channels, i < depth - 1 ? 2 : 1);
    }
    load_first(t);
    for (int i = 1; i < depth; ++i) load_down(t, i);
    for (int i = depth - 1; i > 0; --i) load_up(t, i);
    load_last(t);
    plan();
  }

  void plan() {
    phases.emplace_back(Step::kFirst, 0, size / 2 / kFirstBand);
    for (std::size_t i = 0; i < layers.size(); ++i) {
      Layer<N>& layer = layers[i];
      const std::size_t count = layer.to.size() * layer.panel;
      if (layer.shared()) {
        layer.acc = Aligned<Sum>(count);
        phases.emplace_back(Step::kParity, i, layer.parities());
        phases.emplace_back(Step::kNorm, i, 1);
        phases.emplace_back(Step::kActivate, i, layer.parities());
      } else {
        phases.emplace_back(Step::kPanel, i, layer.panels());
        most_sums = std::max(most_sums, count);
      }
    }
    phases.emplace_back(Step::kLast, 0, size / 2);
  }

  void load_first(const UnetTensors<N>& t) {
    const int half = size / 2, channels = padded(width);
    first_weights = Aligned<float>(static_cast<std::size_t>(kFirstTaps) * channels);
    for (int c = 0; c < width; ++c)
      for (int axis = 0; axis < 3; ++axis)
        for (int tap = 0; tap < 16; ++tap)
          first_weights[static_cast<std::size_t>(12 * (tap / 4) + 4 * axis + tap % 4) * channels + c] = t.weight[(c * 3 + axis) * 16 + tap];
    const auto table = [&](std::span<const float> values) {
      Aligned<float> out(static_cast<std::size_t>(3) * half * channels);
      for (std::size_t i = 0; i < static_cast<std::size_t>(3) * half; ++i)
        std::copy_n(values.data() + i * width, width, out.data() + i * channels);
      return out;
    };
    rows = table(t.rows), columns = table(t.columns);
    first_leaky = destination<N>(leaky[0].values.data(), t.out.leaky_scale, t.out.leaky_zero, channels);
    first_relu = destination<N>(decoder[0].values.data(), t.out.relu_scale, {}, channels);
    fill_border(leaky[0], padded_zero<N>(t.out.leaky_zero, channels));
  }

  void load_down(const UnetTensors<N>& t, int i) {
    const DownTensors<N>& down = t.down[i - 1];
    const Image<N> &image = leaky[i - 1], &relu = decoder[i];
    const int side = size >> (i + 1), channels = unet_channels(width, i - 1), outputs = unet_channels(width, i);
    Layer<N>& layer = add_layer(image, outputs, down.scale, down.bias);
    for (int y = 0; y < side; ++y)
      for (int x = 0; x < side; ++x) layer.from.push_back(image.outer(2 * y, 2 * x)), layer.to.push_back(relu.inner(y, x));
    layer.segments.resize(1);
    for (int line = 0; line < 4; ++line) layer.segments[0].push_back(segment(line * image.line(), 4 * image.channels));
    layer.taps = 16 * image.channels;
    const std::span<const std::uint8_t> zero = i == 1 ? t.out.leaky_zero : t.down[i - 2].out.leaky_zero;
    pack<N>(layer, [&](int, int output, int line, int column, int channel) -> Weight {
      if (output >= outputs || channel >= channels) return 0;
      return down.weight[(static_cast<std::size_t>(output) * channels + channel) * 16 + 4 * line + column];
    }, padded_zero<N>(zero, image.channels));
    layer.relu = destination<N>(decoder[i].values.data(), down.out.relu_scale, {}, layer.outputs);
    if (i == depth - 1) return;
    layer.leaky = destination<N>(leaky[i].values.data(), down.out.leaky_scale, down.out.leaky_zero, layer.outputs);
    fill_border(leaky[i], padded_zero<N>(down.out.leaky_zero, layer.outputs));
  }

  // A 4 x 4 transposed convolution of stride 2 is four 2 x 2 convolutions, one for each parity of the output's row and column.
  // Input pixel y + below - 1 + line reaches output 2 y + below by row 3 - below - 2 line of the kernel; columns alike.
  void load_up(const UnetTensors<N>& t, int i) {
    const UpTensors<N>& up = t.up[i];
    const Image<N> &image = decoder[i], &next = decoder[i - 1];
    const int side = image.side, channels = unet_channels(width, i), outputs = unet_channels(width, i - 1);
    const int sources = i == depth - 1 ? 1 : 2;
    Layer<N>& layer = add_layer(image, outputs, up.scale, {});
    for (int y = 0; y < side; ++y)
      for (int x = 0; x < side; ++x) layer.from.push_back(image.outer(y, x));
    layer.segments.resize(4);
    for (int parity = 0; parity < 4; ++parity) {
      const int below = parity / 2, right = parity % 2;
      for (int source = 0; source < sources; ++source)
        for (int line = 0; line < 2; ++line)
          layer.segments[parity].push_back(segment(source * image.plane() + image.outer(below + line, right), 2 * image.channels));
      for (int y = 0; y < side; ++y)
        for (int x = 0; x < side; ++x) layer.to.push_back(next.inner(2 * y + below, 2 * x + right));
    }
    layer.taps = static_cast<std::size_t>(sources) * 4 * image.channels;
    pack<N>(layer, [&](int parity, int output, int segment, int column, int channel) -> Weight {
      if (output >= outputs || channel >= channels) return 0;
      const int ky = 3 - parity / 2 - 2 * (segment % 2), kx = 3 - parity % 2 - 2 * column;
      return up.weight[(static_cast<std::size_t>(segment / 2 * channels + channel) * outputs + output) * 16 + 4 * ky + kx];
    }, std::vector<typename N::Value>(image.channels));
    layer.relu = destination<N>(next.values.data() + next.plane(), up.relu_scale, {}, layer.outputs);
  }

  void load_last(const UnetTensors<N>& t) {
    const UpTensors<N>& up = t.up[0];
    const int channels = decoder[0].channels;
    last_weights = Aligned<Weight>(static_cast<std::size_t>(2) * 16 * channels * 4);
    Weight* to = last_weights.data();
    for (int source = 0; source < 2; ++source)
      for (int pixel = 0; pixel < 9; ++pixel)
        for (int first = 0; first < channels; first += 4 * N::kGroup)
          for (int parity = 0; parity < 4; ++parity) {
            const int line = pixel / 3 - parity / 2, column = pixel % 3 - parity % 2;
            if (line < 0 || line > 1 || column < 0 || column > 1) continue;
            const int tap = 4 * (3 - parity / 2 - 2 * line) + 3 - parity % 2 - 2 * column;
            for (int output = 0; output < 4; ++output)
              for (int c = first; c < first + 4 * N::kGroup; ++c)
                *to++ = output < 3 && c < width ? up.weight[(static_cast<std::size_t>(source * width + c) * 3 + output) * 16 + tap] : 0;
          }
    std::copy_n(up.scale.data(), 3, last_scale), std::copy_n(up.bias.data(), 3, last_bias);
  }

  // A bias makes a layer one that is not normalised.
  Layer<N>& add_layer(const Image<N>& image, int outputs, std::span<const float> scale, std::span<const float> bias) {
    Layer<N>& layer = layers.emplace_back();
    layer.input = image.values.data(), layer.inputs = image.channels;
    layer.outputs = padded(outputs), layer.panel = panel_width(layer.outputs);
    for (Aligned<float>* values : {&layer.epsilon, &layer.mean, &layer.gain}) *values = Aligned<float>(layer.outputs);
    std::fill_n(layer.epsilon.data(), layer.outputs, kNormEpsilon);
    layer.normalised = bias.empty();
    for (int c = 0; c < outputs; ++c) {
      const float unit = scale.empty() ? 1.0f : scale[c];
      layer.epsilon[c] = kNormEpsilon / (unit * unit);
      if (!layer.normalised) layer.gain[c] = unit, layer.mean[c] = -bias[c] / unit;
    }
    return layer;
  }

  void sum_up(const Layer<N>& layer, int index, int parity, Sum* acc) const {
    const int panel = layer.panel;
    const std::size_t pixels = layer.from.size(), part = static_cast<std::size_t>(index) * layer.parities() + parity;
    const auto& segments = layer.segments[parity];
    kernels.dot({layer.input, layer.from.data(), pixels, segments.data(), static_cast<int>(segments.size()),
                 layer.weights.data() + part * panel * layer.taps, layer.init.data() + part * panel, panel, acc + parity * pixels * panel});
  }

  void normalise(const Layer<N>& layer, int index, const Sum* acc) const {
    const int channel = index * layer.panel;
    if (!layer.normalised) return;
    kernels.norm({acc, layer.to.size(), layer.panel, layer.epsilon.data() + channel, layer.mean.data() + channel, layer.gain.data() + channel});
  }

  void activate(const Layer<N>& layer, int index, const Sum* acc, std::size_t begin, std::size_t count) const {
    const int channel = index * layer.panel;
    kernels.activate({acc + begin * layer.panel, layer.to.data() + begin, count, layer.panel, layer.mean.data() + channel,
                      layer.gain.data() + channel, layer.leaky.from(channel), layer.relu.from(channel)});
  }

  void run_panel(const Layer<N>& layer, int index, Sum* acc) const {
    for (int parity = 0; parity < layer.parities(); ++parity) sum_up(layer, index, parity, acc);
    normalise(layer, index, acc);
    // Two neighbouring panels may share cache lines: they start at different ends, so that two threads do not fight for each line.
    const std::size_t half = layer.to.size() / 2;
    for (const std::size_t begin : {index % 2 ? half : 0, index % 2 ? 0 : half}) activate(layer, index, acc, begin, half);
  }

  void run_first(int item) const {
    kernels.first({offsets, mask.data(), size, padded(width), item * kFirstBand, first_weights.data(), rows.data(), columns.data(),
                   first_leaky.from(0), first_relu.from(0)});
  }

  void run_last(int item) const {
    const Image<N>& image = decoder[0];
    kernels.last({image.values.data(), image.plane(), size, padded(width), item, last_weights.data(), last_scale, last_bias, out});
  }

  void run_item(const Phase& phase, int item, Sum* acc) const {
    if (phase.step == Step::kFirst) return run_first(item);
    if (phase.step == Step::kLast) return run_last(item);
    const Layer<N>& layer = layers[phase.layer];
    const std::size_t pixels = layer.from.size();
    if (phase.step == Step::kPanel) return run_panel(layer, item, acc);
    if (phase.step == Step::kParity) return sum_up(layer, 0, item, layer.acc.data());
    if (phase.step == Step::kNorm) return normalise(layer, 0, layer.acc.data());
    activate(layer, 0, layer.acc.data(), item * pixels, pixels);
  }

  void take_part(Sum* acc) {
    for (Phase& phase : phases) {
      for (int item; (item = phase.next.fetch_add(1, std::memory_order_relaxed)) < phase.items;) {
        run_item(phase, item, acc);
        phase.done.fetch_add(1, std::memory_order_release);
      }
      for (int spins = 0; phase.done.load(std::memory_order_acquire) < phase.items;)
        if (spins < kSpins)
          ++spins;
        else
          std::this_thread::yield();
    }
  }
};

template <class N>
Unet<N>::Unet(const UnetTensors<N>& tensors) {
  check(tensors);
  impl_ = std::make_unique<Impl>(tensors);
}

template <class N>
Unet<N>::~Unet() = default;

template <class N>
int Unet<N>::size() const {
  return impl_->size;
}

template <class N>
void Unet<N>::run(const float* offsets, int threads, float* out) {
  Impl& net = *impl_;
  std::lock_guard lock(net.busy);
  threads = std::clamp(threads <= 0 ? default_threads() : threads, 1, net.size / 2);
  while (net.sums.size() < static_cast<std::size_t>(threads)) net.sums.emplace_back(net.most_sums);
  for (Phase& phase : net.phases) phase.next = 0, phase.done = 0;
  net.offsets = offsets, net.out = out;
  parallel_for(threads, 1, threads, [&net](std::size_t begin, std::size_t) { net.take_part(net.sums[begin].data()); });
}

template class Unet<Int8>;
template class Unet<Float32>;

}  // namespace cap4d
