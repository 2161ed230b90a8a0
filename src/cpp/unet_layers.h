// The inner loops of the deformation U-Net, compiled once per instruction set (see CMakeLists.txt) and chosen at run time.
//
// Images are [side + 2, side + 2, channels] numbers, a border of one pixel around them, channels innermost and padded to a multiple of
// kChannelBlock. Two images that are concatenated lie one behind the other. In integers: the same bits on every instruction set;
// products are summed in int32 without saturation, and float arithmetic is not contracted and has one order. In floats the sets differ
// by rounding.
#pragma once
#include <cstddef>
#include <cstdint>

namespace cap4d {

// What a network is computed in. Sums hold products of values and weights; a step of a dot product takes kGroup values a lane.
struct Int8 {
  using Value = std::uint8_t;
  using Weight = std::int8_t;
  using Sum = std::int32_t;
  static constexpr int kGroup = 4;
};
struct Float32 {
  using Value = float;
  using Weight = float;
  using Sum = float;
  static constexpr int kGroup = 1;
};

inline constexpr int kChannelBlock = 16;
inline constexpr int kMaxPanel = 32;
inline constexpr int kMaxUnetSize = 512;  // px a side
inline constexpr int kFirstTaps = 4 * 4 * 3;
inline constexpr int kFirstBand = 4;  // rows that are computed at once
inline constexpr float kLeak = 0.2f;  // of LeakyReLU (fact 22)

// A run of values that enters the dot product of a pixel, relative to the pixel's first.
struct Segment {
  std::uint32_t offset, count;  // count: a multiple of kChannelBlock
};

// Dot products of `count` pixels with the weights of `panel` output channels.
template <class N>
struct DotJob {
  const typename N::Value* input;
  const std::uint32_t* pixels;  // [count] the first value of each
  std::size_t count;            // a multiple of 4
  const Segment* segments;
  int segment_count;
  const typename N::Weight* weights;  // [sum of counts / kGroup][panel][kGroup]
  const typename N::Sum* init;        // [panel]
  int panel;                          // 16 or 32
  typename N::Sum* acc;               // [count][panel]
};

template <class N>
struct NormJob {
  const typename N::Sum* acc;  // [count][panel]
  std::size_t count;
  int panel;
  const float* epsilon;  // [panel] added to the variance, in units of acc^2
  float *mean, *gain;    // out [panel]: gain = 1 / sqrt(variance + epsilon)
};

// Where activations go. Those of Int8 become round(value * inverse_scale + zero), clamped; those of Float32 have neither.
template <class N>
struct Target {
  typename N::Value* image;    // its first value for the first of these channels; null: not wanted
  const float* inverse_scale;  // [channels]
  const float* zero;           // [channels]
};

// (acc - mean) * gain, through LeakyReLU into one image and ReLU into another.
template <class N>
struct ActivateJob {
  const typename N::Sum* acc;   // [count][panel]
  const std::uint32_t* pixels;  // [count] where each goes
  std::size_t count;
  int panel;
  const float *mean, *gain;  // [panel]
  Target<N> leaky, relu;
};

// The first layer, in float: rows [row, row + kFirstBand) of its output. Offsets are masked; what constant inputs and biases add is in
// two tables that hold the first, an inner and the last column (of `rows`) or row (of `columns`).
template <class N>
struct FirstJob {
  const float* offsets;         // [3, size, size]
  const std::uint8_t* mask;     // [size, size]
  int size, channels, row;      // channels: padded
  const float* weights;         // [kFirstTaps][channels], taps row, axis, column
  const float *rows, *columns;  // [3][size / 2][channels]
  Target<N> leaky, relu;
};

// The last layer: rows 2 row and 2 row + 1 of the answer, from the two images of `input`.
template <class N>
struct LastJob {
  const typename N::Value* input;
  std::size_t plane;       // values from one image to the other
  int size, channels, row;  // channels: padded
  // [2 images][3 x 3 input pixels][channels / (4 kGroup)][parities that read the pixel][4 outputs][4 kGroup]
  const typename N::Weight* weights;
  const float *scale, *bias;  // [3]
  float* out;                 // [3, size, size]
};

template <class N>
struct UnetKernels {
  const char* isa;
  void (*first)(const FirstJob<N>&);
  void (*dot)(const DotJob<N>&);
  void (*norm)(const NormJob<N>&);
  void (*activate)(const ActivateJob<N>&);
  void (*last)(const LastJob<N>&);
};

// The widest variant this processor runs: that of kernels(), and of Int8 that with VNNI (CAP4D_ISA=v3 or v4 asks for none).
template <class N>
const UnetKernels<N>& unet_kernels();

}  // namespace cap4d
