// As many floats as one register of the target holds, and the few operations on them. Arithmetic is the compiler's own
// (GCC/Clang vector extensions). For sources that are compiled once per instruction set (CAP4D_ISA names the variant):
// everything here lives in that variant's namespace, so that no wide code can leak into the baseline through the linker.
// The scalar overloads let the maths be written once for float, double and FloatV.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>

#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

#ifndef CAP4D_ISA
#define CAP4D_ISA base
#endif

namespace cap4d::CAP4D_ISA {

#define CAP4D_INLINE inline __attribute__((always_inline))

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__) && defined(__AVX512BW__)
#define CAP4D_AVX512 1
inline constexpr int kLanes = 16;
#elif defined(__AVX2__)
inline constexpr int kLanes = 8;
#else
inline constexpr int kLanes = 4;
#endif

typedef float FloatV __attribute__((vector_size(4 * kLanes)));
typedef std::int32_t IntV __attribute__((vector_size(4 * kLanes)));
typedef float Float4 __attribute__((vector_size(16)));

CAP4D_INLINE FloatV load(const float* p) {
  FloatV v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
CAP4D_INLINE void store(float* p, FloatV v) { std::memcpy(p, &v, sizeof v); }
CAP4D_INLINE Float4 load4(const float* p) {
  Float4 v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
CAP4D_INLINE void store4(float* p, Float4 v) { std::memcpy(p, &v, sizeof v); }
CAP4D_INLINE FloatV splat(float x) { return x - FloatV{}; }
CAP4D_INLINE IntV as_int(FloatV v) { return reinterpret_cast<IntV>(v); }
CAP4D_INLINE FloatV as_float(IntV v) { return reinterpret_cast<FloatV>(v); }

#ifdef CAP4D_AVX512
typedef __mmask16 MaskV;
CAP4D_INLINE MaskV less(FloatV a, FloatV b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
CAP4D_INLINE MaskV less_equal(FloatV a, FloatV b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
CAP4D_INLINE FloatV select(MaskV m, FloatV yes, FloatV no) { return _mm512_mask_blend_ps(m, no, yes); }
CAP4D_INLINE FloatV keep(MaskV m, FloatV v) { return _mm512_maskz_mov_ps(m, v); }
CAP4D_INLINE IntV keep_int(MaskV m, int v) { return reinterpret_cast<IntV>(_mm512_maskz_set1_epi32(m, v)); }
CAP4D_INLINE std::uint32_t bits(MaskV m) { return m; }
CAP4D_INLINE MaskV both(MaskV a, MaskV b) { return static_cast<MaskV>(a & b); }
CAP4D_INLINE MaskV less_equal_in(MaskV where, FloatV a, FloatV b) { return _mm512_mask_cmp_ps_mask(where, a, b, _CMP_LE_OQ); }
CAP4D_INLINE MaskV first_only(MaskV a, MaskV b) { return static_cast<MaskV>(a & ~b); }
CAP4D_INLINE FloatV sqrt(FloatV v) { return _mm512_sqrt_ps(v); }
CAP4D_INLINE FloatV min(FloatV a, FloatV b) { return _mm512_min_ps(a, b); }
CAP4D_INLINE FloatV max(FloatV a, FloatV b) { return _mm512_max_ps(a, b); }
#else
typedef IntV MaskV;
CAP4D_INLINE MaskV less(FloatV a, FloatV b) { return a < b; }
CAP4D_INLINE MaskV less_equal(FloatV a, FloatV b) { return a <= b; }
CAP4D_INLINE FloatV select(MaskV m, FloatV yes, FloatV no) { return m ? yes : no; }
CAP4D_INLINE FloatV keep(MaskV m, FloatV v) { return as_float(m & as_int(v)); }
CAP4D_INLINE IntV keep_int(MaskV m, int v) { return m & v; }
CAP4D_INLINE MaskV both(MaskV a, MaskV b) { return a & b; }
CAP4D_INLINE MaskV first_only(MaskV a, MaskV b) { return a & ~b; }
CAP4D_INLINE MaskV less_equal_in(MaskV where, FloatV a, FloatV b) { return where & (a <= b); }
#ifdef __AVX2__
CAP4D_INLINE std::uint32_t bits(MaskV m) { return static_cast<std::uint32_t>(_mm256_movemask_ps(as_float(m))); }
CAP4D_INLINE FloatV sqrt(FloatV v) { return _mm256_sqrt_ps(v); }
CAP4D_INLINE FloatV min(FloatV a, FloatV b) { return _mm256_min_ps(a, b); }
CAP4D_INLINE FloatV max(FloatV a, FloatV b) { return _mm256_max_ps(a, b); }
#else
CAP4D_INLINE std::uint32_t bits(MaskV m) {
  std::uint32_t r = 0;
  for (int i = 0; i < kLanes; ++i) r |= (m[i] ? 1u : 0u) << i;
  return r;
}
CAP4D_INLINE FloatV sqrt(FloatV v) {
  for (int i = 0; i < kLanes; ++i) v[i] = std::sqrt(v[i]);
  return v;
}
CAP4D_INLINE FloatV min(FloatV a, FloatV b) { return a < b ? a : b; }
CAP4D_INLINE FloatV max(FloatV a, FloatV b) { return a > b ? a : b; }
#endif
#endif

CAP4D_INLINE bool any(MaskV m) { return bits(m) != 0; }

// 2^x for x in [-125, 126], relative error below 2e-7: a degree 5 minimax polynomial (relative, by linear programming) on one
// octave, the integer added to the exponent. Beyond, and for NaN, rubbish.
CAP4D_INLINE FloatV exp2_in_range(FloatV x) {
#ifdef CAP4D_AVX512
  constexpr int kFloor = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
  const FloatV f = _mm512_reduce_ps(x, kFloor);  // x - floor(x)
  FloatV p = f * 1.881429651e-3f + 8.980025032e-3f;
  p = p * f + 5.583399171e-2f;
  p = p * f + 2.401512769e-1f;
  p = p * f + 6.931532616e-1f;
  p = p * f + 9.999999346e-1f;
  return _mm512_scalef_ps(p, x);
#else
  const FloatV shifted = x + 12582912.0f;  // 1.5 * 2^23: the low mantissa bits now hold round(x)
  const FloatV f = x - (shifted - 12582912.0f);
  FloatV p = f * 1.327692934e-3f + 9.675559861e-3f;
  p = p * f + 5.550711605e-2f;
  p = p * f + 2.402211987e-1f;
  p = p * f + 6.93146969e-1f;
  p = p * f + 1.000000071f;
  return as_float(as_int(p) + (as_int(shifted) << 23));
#endif
}

// log2(x) for normal x > 0, absolute error below 2e-7 near 1 (Cephes logf).
CAP4D_INLINE FloatV log2_positive(FloatV x) {
  const IntV raw = as_int(x) - 0x3f3504f3;  // sqrt(1/2)
  const IntV exponent = raw >> 23;
  const FloatV f = as_float((raw & 0x007fffff) + 0x3f3504f3) - 1.0f;
  const FloatV z = f * f;
  FloatV p = f * 7.0376836292e-2f - 1.1514610310e-1f;
  p = p * f + 1.1676998740e-1f;
  p = p * f - 1.2420140846e-1f;
  p = p * f + 1.4249322787e-1f;
  p = p * f - 1.6668057665e-1f;
  p = p * f + 2.0000714765e-1f;
  p = p * f - 2.4999993993e-1f;
  p = p * f + 3.3333331174e-1f;
  p = p * f * z - 0.5f * z;
  return (f + p) * 1.44269504088896341f + __builtin_convertvector(exponent, FloatV);
}

// kLanes IEEE 754 half floats, none infinite or NaN.
CAP4D_INLINE FloatV load_half(const std::uint16_t* p) {
#ifdef CAP4D_AVX512
  return _mm512_cvtph_ps(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p)));
#elif defined(__F16C__)
  return _mm256_cvtph_ps(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p)));
#else
  IntV half;
  for (int i = 0; i < kLanes; ++i) half[i] = p[i];
  // Exponent and mantissa in place are the number over 2^112, denormals too.
  const FloatV magnitude = as_float((half & 0x7fff) << 13) * 0x1p112f;
  return as_float(as_int(magnitude) | (half & 0x8000) << 16);
#endif
}

CAP4D_INLINE MaskV mask_of(std::uint32_t bits) {
#ifdef CAP4D_AVX512
  return static_cast<MaskV>(bits);
#else
  IntV lane;
  for (int i = 0; i < kLanes; ++i) lane[i] = static_cast<std::int32_t>(1u << i);
  return (lane & static_cast<std::int32_t>(bits)) != 0;
#endif
}

#ifdef __AVX2__
#ifdef CAP4D_AVX512
#define CAP4D_MM(name) _mm512_##name
#else
#define CAP4D_MM(name) _mm256_##name
#endif
CAP4D_INLINE void transpose4(const FloatV* in, FloatV* out) {  // 4 x 4 within the 128-bit lanes
  const FloatV lo0 = CAP4D_MM(unpacklo_ps)(in[0], in[1]), hi0 = CAP4D_MM(unpackhi_ps)(in[0], in[1]);
  const FloatV lo1 = CAP4D_MM(unpacklo_ps)(in[2], in[3]), hi1 = CAP4D_MM(unpackhi_ps)(in[2], in[3]);
  out[0] = CAP4D_MM(shuffle_ps)(lo0, lo1, 0x44), out[1] = CAP4D_MM(shuffle_ps)(lo0, lo1, 0xee);
  out[2] = CAP4D_MM(shuffle_ps)(hi0, hi1, 0x44), out[3] = CAP4D_MM(shuffle_ps)(hi0, hi1, 0xee);
}
#undef CAP4D_MM
#endif

// Past the caches, whose lines it would fetch only to overwrite them; p is aligned to the register. After the last one, end_stream.
CAP4D_INLINE void stream(float* p, FloatV v) {
#ifdef CAP4D_AVX512
  _mm512_stream_ps(p, v);
#elif defined(__AVX2__)
  _mm256_stream_ps(p, v);
#else
  store(p, v);
#endif
}
CAP4D_INLINE void end_stream() {
#ifdef __AVX2__
  _mm_sfence();
#endif
}

// Turns 16 registers into rows of 16 floats, a row per lane, `stride` floats apart. Only rows whose bit is set are written. `put` is
// store or stream.
template <void (*put)(float*, FloatV) = store>
CAP4D_INLINE void store_rows16(const FloatV* columns, float* rows, std::size_t stride, std::uint32_t which) {
#ifdef CAP4D_AVX512
  FloatV a[16], b[16];
  for (int i = 0; i < 16; i += 4) transpose4(columns + i, a + i);
  for (int j = 0; j < 4; ++j) {  // a[4 i + j] holds columns 4 i.. of rows j, 4 + j, 8 + j, 12 + j
    b[j] = _mm512_shuffle_f32x4(a[j], a[4 + j], 0x44), b[4 + j] = _mm512_shuffle_f32x4(a[j], a[4 + j], 0xee);
    b[8 + j] = _mm512_shuffle_f32x4(a[8 + j], a[12 + j], 0x44), b[12 + j] = _mm512_shuffle_f32x4(a[8 + j], a[12 + j], 0xee);
  }
  for (int j = 0; j < 4; ++j) {
    const FloatV row[4] = {_mm512_shuffle_f32x4(b[j], b[8 + j], 0x88), _mm512_shuffle_f32x4(b[j], b[8 + j], 0xdd),
                           _mm512_shuffle_f32x4(b[4 + j], b[12 + j], 0x88), _mm512_shuffle_f32x4(b[4 + j], b[12 + j], 0xdd)};
    for (int k = 0; k < 4; ++k)
      if (which >> (4 * k + j) & 1) put(rows + stride * (4 * k + j), row[k]);
  }
#elif defined(__AVX2__)
  for (int half = 0; half < 16; half += 8) {
    FloatV a[8];
    transpose4(columns + half, a), transpose4(columns + half + 4, a + 4);
    for (int j = 0; j < 4; ++j) {  // a[j] holds columns 0-3 of rows j, 4 + j; a[4 + j] columns 4-7
      if (which >> j & 1) put(rows + stride * j + half, _mm256_permute2f128_ps(a[j], a[4 + j], 0x20));
      if (which >> (4 + j) & 1) put(rows + stride * (4 + j) + half, _mm256_permute2f128_ps(a[j], a[4 + j], 0x31));
    }
  }
#else
  float lanes[16][kLanes];
  for (int c = 0; c < 16; ++c) store(lanes[c], columns[c]);
  for (; which; which &= which - 1) {
    const int l = __builtin_ctz(which);
    for (int c = 0; c < 16; ++c) rows[stride * l + c] = lanes[c][l];
  }
#endif
}

// The first 8 floats of kLanes rows as 8 registers.
CAP4D_INLINE void load_rows8(const float* const* rows, FloatV* columns) {
#ifdef CAP4D_AVX512
  FloatV z[8], t[8];
  for (int i = 0; i < 8; ++i) {  // rows i and i + 4 of each half of the rows
    const int row = i < 4 ? i : i + 4;
    z[i] = _mm512_insertf32x8(_mm512_castps256_ps512(_mm256_loadu_ps(rows[row])), _mm256_loadu_ps(rows[row + 4]), 1);
  }
  transpose4(z, t), transpose4(z + 4, t + 4);
  for (int c = 0; c < 4; ++c) {
    columns[c] = _mm512_shuffle_f32x4(t[c], t[4 + c], 0x88);
    columns[4 + c] = _mm512_shuffle_f32x4(t[c], t[4 + c], 0xdd);
  }
#elif defined(__AVX2__)
  FloatV z[8], t[8];
  for (int l = 0; l < 8; ++l) z[l] = load(rows[l]);
  transpose4(z, t), transpose4(z + 4, t + 4);
  for (int c = 0; c < 4; ++c) {
    columns[c] = _mm256_permute2f128_ps(t[c], t[4 + c], 0x20);
    columns[4 + c] = _mm256_permute2f128_ps(t[c], t[4 + c], 0x31);
  }
#else
  float lanes[8][kLanes];
  for (int l = 0; l < kLanes; ++l)
    for (int c = 0; c < 8; ++c) lanes[c][l] = rows[l][c];
  for (int c = 0; c < 8; ++c) columns[c] = load(lanes[c]);
#endif
}

#ifdef CAP4D_AVX512
template <int kComponents>
struct Interleaving {  // at[c][n]: where the lanes of row c come from when source n joins what was taken from those before it
  std::int32_t columns[kComponents][kComponents][kLanes], items[kComponents][kComponents][kLanes];
};
template <int kComponents>
constexpr Interleaving<kComponents> kInterleaving = [] {
  Interleaving<kComponents> at{};
  for (int c = 0; c < kComponents; ++c)
    for (int n = 1; n < kComponents; ++n)
      for (int l = 0; l < kLanes; ++l) {
        const int item = kComponents * l + c, flat = kLanes * c + l;  // where lane l of column c lies; what lane l of row c is
        const auto from = [&](int source, int lane) { return source == n ? kLanes + lane : n == 1 ? lane : l; };
        at.columns[c][n][l] = from(item / kLanes, item % kLanes);
        at.items[c][n][l] = from(flat % kComponents, flat / kComponents);
      }
  return at;
}();
template <int kComponents>
CAP4D_INLINE FloatV merge(const FloatV* sources, const std::int32_t (*at)[kLanes]) {
  FloatV merged = sources[0];
  for (int n = 1; n < kComponents; ++n) merged = _mm512_permutex2var_ps(merged, _mm512_loadu_si512(at[n]), sources[n]);
  return merged;
}
#endif

// Component c of each of kLanes items that lie one after the other: an array of structures as registers.
template <int kComponents>
CAP4D_INLINE void deinterleave(const float* items, FloatV* columns) {
#ifdef CAP4D_AVX512
  FloatV rows[kComponents];
  for (int n = 0; n < kComponents; ++n) rows[n] = load(items + kLanes * n);
  for (int c = 0; c < kComponents; ++c) columns[c] = merge<kComponents>(rows, kInterleaving<kComponents>.columns[c]);
#else
  float lanes[kComponents][kLanes];
  for (int l = 0; l < kLanes; ++l)
    for (int c = 0; c < kComponents; ++c) lanes[c][l] = items[kComponents * l + c];
  for (int c = 0; c < kComponents; ++c) columns[c] = load(lanes[c]);
#endif
}

// The way back.
template <int kComponents>
CAP4D_INLINE void interleave(const FloatV* columns, float* items) {
#ifdef CAP4D_AVX512
  for (int n = 0; n < kComponents; ++n) store(items + kLanes * n, merge<kComponents>(columns, kInterleaving<kComponents>.items[n]));
#else
  float lanes[kComponents][kLanes];
  for (int c = 0; c < kComponents; ++c) store(lanes[c], columns[c]);
  for (int l = 0; l < kLanes; ++l)
    for (int c = 0; c < kComponents; ++c) items[kComponents * l + c] = lanes[c][l];
#endif
}

// About 1 / x for normal x, relative error below 3e-7.
CAP4D_INLINE FloatV reciprocal(FloatV x) {
#ifdef CAP4D_AVX512
  const FloatV r = _mm512_rcp14_ps(x);
  return r * (2.0f - x * r);
#else
  return 1.0f / x;
#endif
}

// `v` where `sign` is above 0; else 0.
CAP4D_INLINE Float4 positive_only(Float4 sign, Float4 v) {
  typedef std::int32_t Int4 __attribute__((vector_size(16)));
  return reinterpret_cast<Float4>((sign > 0.0f) & reinterpret_cast<Int4>(v));
}

// Sum of the lanes, in a fixed order.
CAP4D_INLINE Float4 fold4(FloatV v) {
#ifdef CAP4D_AVX512
  const __m256 half = _mm256_add_ps(_mm512_castps512_ps256(v), _mm512_extractf32x8_ps(v, 1));
  return _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1));
#elif defined(__AVX2__)
  return _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
#else
  return v;
#endif
}

// Four sums at once: [sum a, sum b, sum c, sum d].
CAP4D_INLINE Float4 sums4(Float4 a, Float4 b, Float4 c, Float4 d) {
#ifdef __clang__
#define CAP4D_SHUFFLE(x, y, i, j, k, l) __builtin_shufflevector(x, y, i, j, k, l)
#else
  typedef std::int32_t Int4 __attribute__((vector_size(16)));
#define CAP4D_SHUFFLE(x, y, i, j, k, l) __builtin_shuffle(x, y, Int4{i, j, k, l})
#endif
  const Float4 ab = CAP4D_SHUFFLE(a, b, 0, 4, 1, 5) + CAP4D_SHUFFLE(a, b, 2, 6, 3, 7);
  const Float4 cd = CAP4D_SHUFFLE(c, d, 0, 4, 1, 5) + CAP4D_SHUFFLE(c, d, 2, 6, 3, 7);
  return CAP4D_SHUFFLE(ab, cd, 0, 1, 4, 5) + CAP4D_SHUFFLE(ab, cd, 2, 3, 6, 7);
#undef CAP4D_SHUFFLE
}

// The same operations on one number.
template <class T>
concept Scalar = std::is_floating_point_v<T>;
template <Scalar T> CAP4D_INLINE bool less(T a, T b) { return a < b; }
template <Scalar T> CAP4D_INLINE T select(bool m, T yes, T no) { return m ? yes : no; }
template <Scalar T> CAP4D_INLINE T keep(bool m, T v) { return m ? v : T(0); }
template <Scalar T> CAP4D_INLINE T sqrt(T v) { return std::sqrt(v); }
template <Scalar T> CAP4D_INLINE T min(T a, T b) { return a < b ? a : b; }
template <Scalar T> CAP4D_INLINE T max(T a, T b) { return a > b ? a : b; }

}  // namespace cap4d::CAP4D_ISA
