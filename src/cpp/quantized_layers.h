// The inner loops of the quantised U-Net, compiled once per instruction set (see CMakeLists.txt) and chosen at run time.
//
// Images are uint8 [side + 2, side + 2, channels], a border of one pixel around them, channels innermost and padded to a multiple of
// kChannelBlock. Two images that are concatenated lie one behind the other. The same bits on every instruction set: products are
// summed in int32 without saturation, and float arithmetic is not contracted and has one order.
#pragma once
#include <cstddef>
#include <cstdint>

namespace cap4d {

inline constexpr int kChannelBlock = 16;
inline constexpr int kMaxPanel = 32;
inline constexpr int kMaxUnetSize = 512;  // px a side
inline constexpr int kFirstTaps = 4 * 4 * 3;
inline constexpr int kFirstBand = 4;  // rows that are computed at once
inline constexpr float kLeak = 0.2f;  // of LeakyReLU (fact 22)

// A run of bytes that enters the dot product of a pixel, relative to the pixel's first byte.
struct Segment {
  std::uint32_t offset, bytes;  // bytes: a multiple of kChannelBlock
};

// Dot products of `count` pixels with the weights of `panel` output channels.
struct DotJob {
  const std::uint8_t* input;
  const std::uint32_t* pixels;  // [count] the first byte of each
  std::size_t count;            // a multiple of 4
  const Segment* segments;
  int segment_count;
  const std::int8_t* weights;  // [sum of bytes / 4][panel][4]
  const std::int32_t* init;    // [panel]
  int panel;                   // 16 or 32
  std::int32_t* acc;           // [count][panel]
};

struct NormJob {
  const std::int32_t* acc;  // [count][panel]
  std::size_t count;
  int panel;
  const float* epsilon;  // [panel] added to the variance, in units of acc^2
  float *mean, *gain;    // out [panel]: gain = 1 / sqrt(variance + epsilon)
};

// How values become uint8: round(value * inverse_scale + zero), clamped.
struct Requantizer {
  std::uint8_t* image;         // its first byte for the first of these channels; null: not wanted
  const float* inverse_scale;  // [channels]
  const float* zero;           // [channels]
};

// (acc - mean) * gain, through LeakyReLU into one image and ReLU into another.
struct RequantizeJob {
  const std::int32_t* acc;      // [count][panel]
  const std::uint32_t* pixels;  // [count] where each goes
  std::size_t count;
  int panel;
  const float *mean, *gain;  // [panel]
  Requantizer leaky, relu;
};

// The first layer, in float: rows [row, row + kFirstBand) of its output. Offsets are masked; what constant inputs and biases add is in
// two tables that hold the first, an inner and the last column (of `rows`) or row (of `columns`).
struct FirstJob {
  const float* offsets;         // [3, size, size]
  const std::uint8_t* mask;     // [size, size]
  int size, channels, row;      // channels: padded
  const float* weights;         // [kFirstTaps][channels], taps row, axis, column
  const float *rows, *columns;  // [3][size / 2][channels]
  Requantizer leaky, relu;
};

// The last layer: rows 2 row and 2 row + 1 of the answer, from the two images of `input`.
struct LastJob {
  const std::uint8_t* input;
  std::size_t plane;           // bytes from one image to the other
  int size, channels, row;     // channels: padded
  const std::int8_t* weights;  // [2 images][3 x 3 input pixels][channels / 16][parities that read the pixel][4 outputs][16]
  const float *scale, *bias;   // [3]
  float* out;                  // [3, size, size]
};

struct UnetKernels {
  const char* isa;
  void (*first)(const FirstJob&);
  void (*dot)(const DotJob&);
  void (*norm)(const NormJob&);
  void (*requantize)(const RequantizeJob&);
  void (*last)(const LastJob&);
};

// The widest variant this processor runs: that of kernels(), or that with VNNI (CAP4D_ISA=v3 or v4 asks for none).
const UnetKernels& unet_kernels();

}  // namespace cap4d
