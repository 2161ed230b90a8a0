// The deformation U-Net in 8-bit integers. Compiled once per instruction set.
#include <cstring>

#include "simd.h"
#include "unet_layers.h"

#if defined(__SSE2__) && !defined(__AVX2__)
#include <emmintrin.h>
#endif

namespace cap4d::CAP4D_ISA {

extern const UnetKernels<Int8> kInt8Kernels;

namespace {

using Number = Int8;
typedef IntV SumV;

// ---- Four products of uint8 x int8 per lane, added to int32 -----------------------------------------------------------------------
//
// Without VNNI bytes are widened to 16 bits: the even ones and the odd ones of each lane separately, so that neither needs a shuffle.
// pmaddubsw would be shorter, but saturates.

#if (defined(CAP4D_AVX512) && defined(__AVX512VNNI__)) || (!defined(CAP4D_AVX512) && defined(__AVXVNNI__))
#define CAP4D_VNNI 1
#endif

#ifdef CAP4D_VNNI
typedef IntV Weights;
typedef IntV Inputs;
CAP4D_INLINE Weights unpack(IntV w) { return w; }
CAP4D_INLINE Inputs split(IntV all) { return all; }
CAP4D_INLINE Inputs spread_four(std::int32_t four) { return four - IntV{}; }
CAP4D_INLINE IntV multiply_add(IntV sum, Inputs a, const Weights& w) {
#ifdef CAP4D_AVX512
  return reinterpret_cast<IntV>(_mm512_dpbusd_epi32(reinterpret_cast<__m512i>(sum), reinterpret_cast<__m512i>(a), reinterpret_cast<__m512i>(w)));
#else
  return reinterpret_cast<IntV>(_mm256_dpbusd_avx_epi32(reinterpret_cast<__m256i>(sum), reinterpret_cast<__m256i>(a), reinterpret_cast<__m256i>(w)));
#endif
}
#else
struct Weights {
  IntV even, odd;
};
struct Inputs {
  IntV even, odd;
};
typedef std::int16_t ShortV __attribute__((vector_size(4 * kLanes)));
typedef std::uint16_t UShortV __attribute__((vector_size(4 * kLanes)));

CAP4D_INLINE Weights unpack(IntV w) {
  const ShortV pairs = reinterpret_cast<ShortV>(w);
  return {reinterpret_cast<IntV>((pairs << 8) >> 8), reinterpret_cast<IntV>(pairs >> 8)};
}
CAP4D_INLINE Inputs split(IntV all) { return {all & 0x00ff00ff, reinterpret_cast<IntV>(reinterpret_cast<UShortV>(all) >> 8)}; }
CAP4D_INLINE Inputs spread_four(std::int32_t four) {
  IntV all = four - IntV{};
#ifdef __SSE2__
  asm("" : "+x"(all));  // GCC would mask the number before it is spread, and so take both halves through general registers
#endif
  return split(all);
}
CAP4D_INLINE IntV madd(IntV a, IntV b) {
#if defined(CAP4D_AVX512)
  return reinterpret_cast<IntV>(_mm512_madd_epi16(reinterpret_cast<__m512i>(a), reinterpret_cast<__m512i>(b)));
#elif defined(__AVX2__)
  return reinterpret_cast<IntV>(_mm256_madd_epi16(reinterpret_cast<__m256i>(a), reinterpret_cast<__m256i>(b)));
#elif defined(__SSE2__)
  return reinterpret_cast<IntV>(_mm_madd_epi16(reinterpret_cast<__m128i>(a), reinterpret_cast<__m128i>(b)));
#else
  return (a & 0xffff) * ((b << 16) >> 16) + (a >> 16) * (b >> 16);  // a holds no negative numbers
#endif
}
CAP4D_INLINE IntV multiply_add(IntV sum, const Inputs& a, const Weights& w) { return sum + (madd(a.even, w.even) + madd(a.odd, w.odd)); }
#endif

CAP4D_INLINE IntV load_sum(const void* p) {
  IntV v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
CAP4D_INLINE void store_sum(void* p, IntV v) { std::memcpy(p, &v, sizeof v); }
CAP4D_INLINE Weights load_weights(const std::int8_t* p) { return unpack(load_sum(p)); }
CAP4D_INLINE Inputs spread(const std::uint8_t* p) {
  std::int32_t four;
  std::memcpy(&four, p, sizeof four);
  return spread_four(four);
}
CAP4D_INLINE Inputs spread_groups(const std::uint8_t* p) {
#if defined(CAP4D_AVX512)
  const IntV all = reinterpret_cast<IntV>(_mm512_broadcast_i32x4(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))));
#elif defined(__AVX2__)
  const IntV all = reinterpret_cast<IntV>(_mm256_broadcastsi128_si256(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))));
#else
  const IntV all = load_sum(p);
#endif
  return split(all);
}

CAP4D_INLINE FloatV to_float(IntV v) { return __builtin_convertvector(v, FloatV); }

struct Steps {
  FloatV inverse_scale, zero;
};
CAP4D_INLINE Steps steps(const Target<Int8>& to, int channel) {
  return to.image ? Steps{load(to.inverse_scale + channel), load(to.zero + channel)} : Steps{};
}

// Rounds to nearest, ties to even; a value that is not a number becomes 0.
CAP4D_INLINE void write(std::uint8_t* to, FloatV v, const Steps& steps) {
  typedef std::uint8_t ByteV __attribute__((vector_size(kLanes)));
  v = v * steps.inverse_scale + steps.zero;
  v = min(max(v, FloatV{}), splat(255.0f));
  const ByteV bytes = __builtin_convertvector(as_int(v + 12582912.0f) & 0xff, ByteV);  // 1.5 * 2^23
  std::memcpy(to, &bytes, sizeof bytes);
}

}  // namespace
}  // namespace cap4d::CAP4D_ISA

#include "unet_layers_impl.h"

namespace cap4d::CAP4D_ISA {

const UnetKernels<Int8> kInt8Kernels{CAP4D_TEXT(CAP4D_ISA), first, dot, norm, activate, last};

}  // namespace cap4d::CAP4D_ISA
