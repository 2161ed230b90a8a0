// Inner loops of the U-Net's gradient. Compiled once per instruction set.
#include "simd.h"
#include "unet_training.h"

namespace cap4d::CAP4D_ISA {

extern const TrainingKernels kTrainingKernels;

namespace {

constexpr float kLeaky = 0.2f;  // fact 22

template <int kBig, int kVectors>
CAP4D_INLINE void filter_tile(const FilterJob& job, int b, int s) {
  FloatV sum[kBig][kVectors] = {};
  for (std::size_t i = 0; i < job.count; ++i) {
    const float *big = job.big + job.big_pixels[i] + b, *small = job.small + job.small_pixels[i] + s;
    FloatV x[kVectors];
    for (int v = 0; v < kVectors; ++v) x[v] = load(small + v * kLanes);
    for (int k = 0; k < kBig; ++k)
      for (int v = 0; v < kVectors; ++v) sum[k][v] = sum[k][v] + x[v] * big[k];
  }
  for (int k = 0; k < kBig; ++k)
    for (int v = 0; v < kVectors; ++v) store(job.out + static_cast<std::size_t>(b + k) * job.small_channels + s + v * kLanes, sum[k][v]);
}

template <int kBig>
CAP4D_INLINE void filter_rows(const FilterJob& job, int b) {
  int s = 0;
  for (; s + 2 * kLanes <= job.small_channels; s += 2 * kLanes) filter_tile<kBig, 2>(job, b, s);
  for (; s < job.small_channels; s += kLanes) filter_tile<kBig, 1>(job, b, s);
}

void filter(const FilterJob& job) {
  int b = 0;
#if defined(CAP4D_AVX512)
  for (; b + 8 <= job.big_channels; b += 8) filter_rows<8>(job, b);
#endif
  for (; b < job.big_channels; b += 4) filter_rows<4>(job, b);
}

void pass(const PassJob& job) {
  for (int c = 0; c < job.panel; c += kLanes) {
    const FloatV mean = load(job.mean + c), gain = load(job.gain + c);
    for (std::size_t i = 0; i < job.count; ++i) {
      float* value = job.values + i * job.panel + c;
      const FloatV x = (load(value) - mean) * gain;
      store(value, x);
      if (job.leaky) store(job.leaky + job.leaky_pixels[i] + c, max(x, x * kLeaky));
      if (job.relu) store(job.relu + job.relu_pixels[i] + c, max(x, FloatV{}));
    }
  }
}

void back(const BackJob& job) {
  const float share = 1.0f / static_cast<float>(job.count);
  for (int c = 0; c < job.panel; c += kLanes) {
    FloatV sum{}, along{};
    for (std::size_t i = 0; i < job.count; ++i) {
      const FloatV x = load(job.values + i * job.panel + c), zero{};
      FloatV g = load(job.relu + (job.relu_rows ? job.relu_rows[i] : i) * job.panel + c);
      g = keep(less(zero, x), g);
      if (job.leaky) {
        const FloatV l = load(job.leaky + (job.leaky_rows ? job.leaky_rows[i] : i) * job.panel + c);
        g = g + select(less(zero, x), l, l * kLeaky);
      }
      sum = sum + g, along = along + g * x;
      store(job.scratch + i * job.panel + c, g);
    }
    if (job.bias) store(job.bias + c, sum);
    const FloatV gain = job.gain ? load(job.gain + c) : splat(1.0f);
    const FloatV mean = job.gain ? sum * share : FloatV{}, slope = job.gain ? along * share : FloatV{};
    for (std::size_t i = 0; i < job.count; ++i) {
      const FloatV x = load(job.values + i * job.panel + c), g = load(job.scratch + i * job.panel + c);
      store(job.image + job.pixels[i] + c, gain * (g - mean - x * slope));
    }
  }
}

}  // namespace

const TrainingKernels kTrainingKernels{&filter, &pass, &back};

}  // namespace cap4d::CAP4D_ISA
