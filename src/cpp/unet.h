// The deformation U-Net (facts 20-24), in float32 or in 8-bit integers: offsets on the UV grid in, a correction of the grid's vertices
// out.
//
// Layers are numbered from the outside: down 0 halves `size` pixels, up 0 doubles to them. In integers down 0 runs in float, and
// everything else multiplies uint8 activations with int8 weights. What the numbers mean is in cap4d/bundle/quantized_unet.py and
// cap4d/bundle/float_unet.py.
#pragma once
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "unet_layers.h"

namespace cap4d {

// uint8 = round(activation / scale) + zero, per channel. All empty in Float32.
struct ActivationTensors {
  std::span<const float> leaky_scale;        // [C] of LeakyReLU's output; empty for the innermost layer
  std::span<const std::uint8_t> leaky_zero;  // [C]
  std::span<const float> relu_scale;         // [C] of ReLU's output
};

template <class N>
struct DownTensors {
  std::span<const typename N::Weight> weight;  // [C, inputs, 4, 4]
  std::span<const float> scale;                // [C] of the sum; empty in Float32
  std::span<const float> bias;                 // [C]; the innermost layer only
  ActivationTensors out;
};

template <class N>
struct UpTensors {
  std::span<const typename N::Weight> weight;  // [inputs, C, 4, 4]
  std::span<const float> scale;                // [C]; in Float32 of up 0 only
  std::span<const float> relu_scale;           // [C]; not of up 0; empty in Float32
  std::span<const float> bias;                 // [3] m; up 0 only
};

template <class N>
struct UnetTensors {
  int size, width;
  std::span<const std::uint8_t> mask;    // [size, size]
  std::span<const float> weight;         // [width, 3, 4, 4] of down 0, 1/m
  std::span<const float> rows, columns;  // [3, size / 2, width]
  ActivationTensors out;                 // of down 0
  std::vector<DownTensors<N>> down;      // 1, 2, ..
  std::vector<UpTensors<N>> up;          // 0, 1, ..
};

inline constexpr int kMaxUnetWidth = 256;  // a sum has at most 16 x 8 x width products of 255 x 127: below 2^31

void check_unet_size(int size);           // throws std::invalid_argument unless it is a power of two from 8 to 512
int unet_depth(int size);                 // how often a grid is halved: to 2 px, at most 6 times
int unet_channels(int width, int layer);  // outputs of down `layer`

// N: Int8 or Float32.
template <class N>
class Unet {
 public:
  // Spans need not outlive the call. Throws std::invalid_argument when a size is wrong.
  explicit Unet(const UnetTensors<N>& tensors);
  ~Unet();
  int size() const;
  // offsets, out: [3, size, size] m. The same bits for any number of threads. Calls from several threads wait for each other.
  void run(const float* offsets, int threads, float* out);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace cap4d
