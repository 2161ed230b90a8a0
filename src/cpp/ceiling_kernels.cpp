// The machine's arithmetic and its reads at full register width. Compiled once per instruction set.
#include "ceilings.h"
#include "simd.h"

namespace cap4d::CAP4D_ISA {

extern const CeilingKernels kCeilingKernels;

namespace {

// Enough independent chains to hide the latency of a multiply-add, few enough for the 16 registers of the baseline.
constexpr int kChains = 12, kUnrolled = 8;

float multiply_add(std::size_t rounds) {
  FloatV x[kChains];
  for (int i = 0; i < kChains; ++i) x[i] = splat(0.1f * i);
  const FloatV a = splat(0.999f), b = splat(0.001f);  // tends to 1: never denormal, never infinite
  for (std::size_t r = 0; r < rounds; ++r)
#pragma GCC unroll 8
    for (int u = 0; u < kUnrolled; ++u)
#pragma GCC unroll 12
      for (int i = 0; i < kChains; ++i) x[i] = x[i] * a + b;
  FloatV sum{};
  for (int i = 0; i < kChains; ++i) sum += x[i];
  return sum[0];
}

float read(const float* values, std::size_t count) {
  constexpr int kSums = 8;
  FloatV sums[kSums] = {};
  for (std::size_t i = 0; i < count; i += kSums * kLanes)
#pragma GCC unroll 8
    for (int k = 0; k < kSums; ++k) sums[k] += load(values + i + k * kLanes);
  FloatV sum{};
  for (int k = 0; k < kSums; ++k) sum += sums[k];
  return sum[0];
}

}  // namespace

const CeilingKernels kCeilingKernels = {2ull * kChains * kUnrolled * kLanes, &multiply_add, &read};

}  // namespace cap4d::CAP4D_ISA
