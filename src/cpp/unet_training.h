// The deformation U-Net (facts 20-24) with its gradient, in float32: for fitting. The inner loops of its convolutions are those that it is
// played with (unet_layers.h).
//
// A convolution that halves and a transposed one that doubles are each other's adjoint: both have a filter [small, big, 4, 4] between a
// small image and one of twice its side, and everything is one of three products of these: halve, double, and their filter's gradient.
// The same bits for any number of threads.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

namespace cap4d {

// ---- Inner loops that only fitting needs; compiled once per instruction set ----

// out [big][small] = sum over places of big x small. Channels are multiples of 4 and 16.
struct FilterJob {
  const float *big, *small;
  const std::uint32_t *big_pixels, *small_pixels;  // [count]
  std::size_t count;
  int big_channels, small_channels;
  float* out;
};

// values [count][panel]: (value - mean) * gain, in place, and through LeakyReLU and ReLU into images; null: not wanted.
struct PassJob {
  float* values;
  const std::uint32_t *leaky_pixels, *relu_pixels;  // [count]
  std::size_t count;
  int panel;
  const float *mean, *gain;  // [panel]
  float *leaky, *relu;
};

// The way back of a PassJob, from the gradients of both images. Row i of `values` has row relu_rows[i] of `relu`, and so on; null rows: i.
struct BackJob {
  const float* values;  // after the pass
  const float *leaky, *relu;  // [count][panel] gradients; leaky may be null
  const std::uint32_t *leaky_rows, *relu_rows;
  std::size_t count;
  int panel;
  const float* gain;  // [panel] of the norm; null: there was none
  const std::uint32_t* pixels;
  float* scratch;  // [count][panel]
  float* image;    // the gradient of the sums goes to its pixels
  float* bias;     // [panel] its sum
};

struct TrainingKernels {
  void (*filter)(const FilterJob&);
  void (*pass)(const PassJob&);
  void (*back)(const BackJob&);
};
const TrainingKernels& training_kernels();

// ---- The network ----

struct LayerTensors {  // as torch has them
  const float *weight, *bias;
};
struct LayerGradients {
  float *weight, *bias;
};

// One batch on its way through the network and back; what the way back needs stays here. Not for several threads at once.
class UnetPass {
 public:
  // encoding [channels, size, size]: what the first layer sees behind the three offsets. Throws std::invalid_argument on a wrong size.
  UnetPass(int size, int width, int batch, const float* encoding, int encoding_channels);
  ~UnetPass();
  int size() const;
  int batch() const;
  int depth() const;
  std::vector<std::size_t> filter_shape(int layer, bool up) const;  // [small, big]
  // offsets, out: [batch, 3, size, size]; down, up: `depth` layers, the outermost first.
  void forward(const float* offsets, const LayerTensors* down, const LayerTensors* up, int threads, float* out);
  // v_out: [batch, 3, size, size]. After `forward`.
  void backward(const float* v_out, int threads, const LayerGradients* down, const LayerGradients* up);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace cap4d
