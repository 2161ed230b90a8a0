// The deformation U-Net in float32. Compiled once per instruction set.
#include <cstring>

#include "simd.h"
#include "unet_layers.h"

namespace cap4d::CAP4D_ISA {

extern const UnetKernels<Float32> kFloat32Kernels;

namespace {

using Number = Float32;
typedef FloatV SumV;
typedef FloatV Weights;
typedef FloatV Inputs;

CAP4D_INLINE FloatV load_sum(const float* p) { return load(p); }
CAP4D_INLINE void store_sum(float* p, FloatV v) { store(p, v); }
CAP4D_INLINE FloatV load_weights(const float* p) { return load(p); }
CAP4D_INLINE FloatV spread(const float* p) { return splat(*p); }
CAP4D_INLINE FloatV spread_groups(const float* p) {
#if defined(CAP4D_AVX512)
  return _mm512_broadcast_f32x4(_mm_loadu_ps(p));
#elif defined(__AVX2__)
  return _mm256_broadcast_ps(reinterpret_cast<const __m128*>(p));
#else
  return load(p);
#endif
}
CAP4D_INLINE FloatV multiply_add(FloatV sum, FloatV a, FloatV w) { return sum + a * w; }
CAP4D_INLINE FloatV to_float(FloatV v) { return v; }

struct Steps {};
CAP4D_INLINE Steps steps(const Target<Float32>&, int) { return {}; }
CAP4D_INLINE void write(float* to, FloatV v, const Steps&) { store(to, v); }

}  // namespace
}  // namespace cap4d::CAP4D_ISA

#include "unet_layers_impl.h"

namespace cap4d::CAP4D_ISA {

const UnetKernels<Float32> kFloat32Kernels{CAP4D_TEXT(CAP4D_ISA), first, dot, norm, activate, last};

}  // namespace cap4d::CAP4D_ISA
