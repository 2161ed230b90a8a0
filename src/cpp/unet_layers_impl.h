// Layers of the deformation U-Net, whatever their numbers. Included once by each source that says what those are:
// Reads: Number; SumV, Weights, Inputs: a register of sums, and of what a product takes; load_sum, store_sum, load_weights; spread: a
//   group of values to all lanes; spread_groups: four groups to every four lanes; multiply_add; to_float; Steps, steps, write: how an
//   activation becomes a value of an image.
// Defines: first, dot, norm, activate, last, as of UnetKernels.
#pragma once
#include <algorithm>
#include <cstring>

#include "simd.h"
#include "unet_layers.h"

namespace cap4d::CAP4D_ISA {
namespace {

// A tile of accumulators stays in registers.
#if defined(CAP4D_AVX512)
constexpr int kTilePixels = 12, kTileVectors = 2;
#else
constexpr int kTilePixels = 4, kTileVectors = 2;
#endif
static_assert(kTilePixels % 4 == 0);  // what is left over is a multiple of 4

template <int kPixels, int kVectors>
CAP4D_INLINE void dot_tile(const DotJob<Number>& job, std::size_t first, int column) {
  SumV sum[kPixels][kVectors];
  for (int v = 0; v < kVectors; ++v) {
    const SumV init = load_sum(job.init + column + v * kLanes);
    for (int p = 0; p < kPixels; ++p) sum[p][v] = init;
  }
  const Number::Weight* weights = job.weights + Number::kGroup * column;
  const Number::Value* base[kPixels];
  for (int p = 0; p < kPixels; ++p) base[p] = job.input + job.pixels[first + p];
  const std::size_t stride = Number::kGroup * job.panel;
  for (int s = 0; s < job.segment_count; ++s) {
    const std::uint32_t begin = job.segments[s].offset, end = begin + job.segments[s].count;
    for (std::uint32_t k = begin; k < end; k += Number::kGroup, weights += stride) {
      Weights w[kVectors];
      for (int v = 0; v < kVectors; ++v) w[v] = load_weights(weights + Number::kGroup * v * kLanes);
      for (int p = 0; p < kPixels; ++p) {
        const Inputs a = spread(base[p] + k);
        for (int v = 0; v < kVectors; ++v) sum[p][v] = multiply_add(sum[p][v], a, w[v]);
      }
    }
  }
  for (int p = 0; p < kPixels; ++p)
    for (int v = 0; v < kVectors; ++v) store_sum(job.acc + (first + p) * job.panel + column + v * kLanes, sum[p][v]);
}

template <int kVectors>
void dot_columns(const DotJob<Number>& job, int column) {
  std::size_t first = 0;
  for (; first + kTilePixels <= job.count; first += kTilePixels) dot_tile<kTilePixels, kVectors>(job, first, column);
  if constexpr (kTilePixels > 8)
    for (; first + 8 <= job.count; first += 8) dot_tile<8, kVectors>(job, first, column);
  for (; first < job.count; first += 4) dot_tile<4, kVectors>(job, first, column);
}

void dot(const DotJob<Number>& job) {
  int column = 0;
  for (; column + kTileVectors * kLanes <= job.panel; column += kTileVectors * kLanes) dot_columns<kTileVectors>(job, column);
  for (; column < job.panel; column += kLanes) dot_columns<1>(job, column);
}

// ---- InstanceNorm -------------------------------------------------------------------------------------------------------------------

// Two passes: the variance of what the mean has been taken from does not cancel.
void norm(const NormJob<Number>& job) {
  const float share = 1.0f / static_cast<float>(job.count);
  for (int c = 0; c < job.panel; c += kLanes) {
    FloatV sum{}, squares{};
    const Number::Sum* acc = job.acc + c;
    for (std::size_t i = 0; i < job.count; ++i) sum = sum + to_float(load_sum(acc + i * job.panel));
    const FloatV mean = sum * share;
    for (std::size_t i = 0; i < job.count; ++i) {
      const FloatV x = to_float(load_sum(acc + i * job.panel)) - mean;
      squares = squares + x * x;
    }
    store(job.mean + c, mean);
    store(job.gain + c, 1.0f / sqrt(squares * share + load(job.epsilon + c)));
  }
}

// ---- Activations --------------------------------------------------------------------------------------------------------------------

CAP4D_INLINE void put(FloatV x, const Target<Number>& leaky, const Steps& leaky_steps, const Target<Number>& relu, const Steps& relu_steps,
                      std::size_t at) {
  if (leaky.image) write(leaky.image + at, max(x, x * kLeak), leaky_steps);
  if (relu.image) write(relu.image + at, max(x, FloatV{}), relu_steps);
}

void activate(const ActivateJob<Number>& job) {
  for (int c = 0; c < job.panel; c += kLanes) {
    const FloatV mean = load(job.mean + c), gain = load(job.gain + c);
    const Steps leaky = steps(job.leaky, c), relu = steps(job.relu, c);
    for (std::size_t i = 0; i < job.count; ++i) {
      const FloatV x = (to_float(load_sum(job.acc + i * job.panel + c)) - mean) * gain;
      put(x, job.leaky, leaky, job.relu, relu, job.pixels[i] + c);
    }
  }
}

// ---- The first layer ----------------------------------------------------------------------------------------------------------------

constexpr int kFirstLines = 2 * kFirstBand + 2, kFirstStride = kMaxUnetSize + 2;
#if defined(CAP4D_AVX512)
constexpr int kFirstPixels = 8;  // at once
#else
constexpr int kFirstPixels = 4;
#endif

// What a band of output rows reads: [line][axis][x], masked, with a zero on every side.
struct FirstLines {
  float value[kFirstLines][3][kFirstStride];
};

void fill_lines(const FirstJob<Number>& job, FirstLines& lines) {
  const int size = job.size;
  const std::size_t plane = static_cast<std::size_t>(size) * size;
  for (int r = 0; r < kFirstLines; ++r) {
    const int y = 2 * job.row - 1 + r;
    for (int axis = 0; axis < 3; ++axis) {
      float* line = lines.value[r][axis];
      line[0] = line[size + 1] = 0.0f;
      if (y < 0 || y >= size) {
        std::fill_n(line + 1, size, 0.0f);
        continue;
      }
      const std::uint8_t* mask = job.mask + static_cast<std::size_t>(y) * size;
      const float* offsets = job.offsets + axis * plane + static_cast<std::size_t>(y) * size;
      for (int x = 0; x < size; ++x) line[1 + x] = mask[x] ? offsets[x] : 0.0f;
    }
  }
}

template <int kPixels, int kVectors>
CAP4D_INLINE void first_tile(const FirstJob<Number>& job, const FirstLines& lines, int row, int x, int c) {
  const int half = job.size / 2, y = job.row + row;
  const std::size_t channels = job.channels;
  const auto edge = [half](int at) { return at == 0 ? 0 : at == half - 1 ? 2 : 1; };
  const auto table = [=](const float* values, int border, int at) { return values + (static_cast<std::size_t>(border) * half + at) * channels + c; };
  FloatV sum[kPixels][kVectors];
  for (int p = 0; p < kPixels; ++p)
    for (int v = 0; v < kVectors; ++v)
      sum[p][v] = load(table(job.rows, edge(x + p), y) + v * kLanes) + load(table(job.columns, edge(y), x + p) + v * kLanes);
  const float* weights = job.weights + c;
  for (int tap = 0; tap < kFirstTaps; ++tap, weights += channels) {
    const float* input = lines.value[2 * row][0] + tap / 4 * kFirstStride + 2 * x + tap % 4;
    FloatV w[kVectors];
    for (int v = 0; v < kVectors; ++v) w[v] = load(weights + v * kLanes);
    for (int p = 0; p < kPixels; ++p)
      for (int v = 0; v < kVectors; ++v) sum[p][v] = sum[p][v] + w[v] * input[2 * p];
  }
  for (int v = 0; v < kVectors; ++v) {
    const int at = c + v * kLanes;
    const Steps leaky = steps(job.leaky, at), relu = steps(job.relu, at);
    for (int p = 0; p < kPixels; ++p) {
      const std::size_t pixel = static_cast<std::size_t>(y + 1) * (half + 2) + x + p + 1;
      put(sum[p][v], job.leaky, leaky, job.relu, relu, pixel * channels + at);
    }
  }
}

template <int kPixels>
void first_band(const FirstJob<Number>& job, const FirstLines& lines) {
  for (int row = 0; row < kFirstBand; ++row)
    for (int x = 0; x < job.size / 2; x += kPixels) {
      int c = 0;
      for (; c + 2 * kLanes <= job.channels; c += 2 * kLanes) first_tile<kPixels, 2>(job, lines, row, x, c);
      for (; c < job.channels; c += kLanes) first_tile<kPixels, 1>(job, lines, row, x, c);
    }
}

void first(const FirstJob<Number>& job) {
  FirstLines lines;
  fill_lines(job, lines);
  if (job.size / 2 % kFirstPixels == 0)
    first_band<kFirstPixels>(job, lines);
  else
    first_band<4>(job, lines);
}

// ---- The last layer -----------------------------------------------------------------------------------------------------------------
//
// Three outputs are too few to be lanes. The register's fours of lanes are outputs (one of them idle), the lanes of a four take every
// fourth group of channels, and one loading of inputs serves all parities that read them.

constexpr int kParities = 4, kOutputs = 4, kGroups = 4;
constexpr int kLastStep = kOutputs * kGroups * Number::kGroup;  // weights of one parity for the channels that are read at once
#if defined(CAP4D_AVX512)
constexpr int kLastPixels = 4;  // at once
#else
constexpr int kLastPixels = 2;
#endif

// What the input pixel kRow rows and kColumn columns from the upper left one adds to the outputs of each parity that it reaches.
template <int kRow, int kColumn>
CAP4D_INLINE const Number::Weight* last_neighbour(const LastJob<Number>& job, const Number::Value* pixel, const Number::Weight* weights,
                                               SumV sum[kLastPixels][kParities]) {
  const Number::Value* input = pixel + (static_cast<std::size_t>(kRow) * (job.size / 2 + 2) + kColumn) * job.channels;
  for (int k = 0; k < job.channels; k += kGroups * Number::kGroup) {
    Inputs a[kLastPixels];
    for (int p = 0; p < kLastPixels; ++p) a[p] = spread_groups(input + p * job.channels + k);
    for (int parity = 0; parity < kParities; ++parity) {
      const int row = kRow - parity / 2, column = kColumn - parity % 2;
      if (row < 0 || row > 1 || column < 0 || column > 1) continue;
      const Weights w = load_weights(weights);
      weights += kLastStep;
      for (int p = 0; p < kLastPixels; ++p) sum[p][parity] = multiply_add(sum[p][parity], a[p], w);
    }
  }
  return weights;
}

void last_tile(const LastJob<Number>& job, int x) {
  Number::Sum sums[kLastPixels][kParities][kOutputs * kGroups];
  for (int lane = 0; lane < 3 * kGroups; lane += kLanes) {
    SumV sum[kLastPixels][kParities] = {};
    const Number::Weight* weights = job.weights + Number::kGroup * lane;
    for (int source = 0; source < 2; ++source) {
      const Number::Value* pixel = job.input + source * job.plane + (static_cast<std::size_t>(job.row) * (job.size / 2 + 2) + x) * job.channels;
      weights = last_neighbour<0, 0>(job, pixel, weights, sum);
      weights = last_neighbour<0, 1>(job, pixel, weights, sum);
      weights = last_neighbour<0, 2>(job, pixel, weights, sum);
      weights = last_neighbour<1, 0>(job, pixel, weights, sum);
      weights = last_neighbour<1, 1>(job, pixel, weights, sum);
      weights = last_neighbour<1, 2>(job, pixel, weights, sum);
      weights = last_neighbour<2, 0>(job, pixel, weights, sum);
      weights = last_neighbour<2, 1>(job, pixel, weights, sum);
      weights = last_neighbour<2, 2>(job, pixel, weights, sum);
    }
    for (int p = 0; p < kLastPixels; ++p)
      for (int parity = 0; parity < kParities; ++parity) store_sum(sums[p][parity] + lane, sum[p][parity]);
  }
  const std::size_t size = job.size;
  for (int axis = 0; axis < 3; ++axis) {
    const float scale = job.scale[axis], bias = job.bias[axis];
    float* out = job.out + (axis * size + 2 * job.row) * size + 2 * x;
    for (int p = 0; p < kLastPixels; ++p)
      for (int parity = 0; parity < kParities; ++parity) {
        const Number::Sum* four = sums[p][parity] + axis * kGroups;
        const Number::Sum sum = (four[0] + four[1]) + (four[2] + four[3]);
        out[parity / 2 * size + 2 * p + parity % 2] = static_cast<float>(sum) * scale + bias;
      }
  }
}

void last(const LastJob<Number>& job) {
  for (int x = 0; x < job.size / 2; x += kLastPixels) last_tile(job, x);
}

#define CAP4D_TEXT(name) CAP4D_TEXT_(name)
#define CAP4D_TEXT_(name) #name

}  // namespace
}  // namespace cap4d::CAP4D_ISA
