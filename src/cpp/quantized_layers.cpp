// Layers of the quantised U-Net. Compiled once per instruction set.
#include "quantized_layers.h"

#include <algorithm>
#include <cstring>

#include "simd.h"

#if defined(__SSE2__) && !defined(__AVX2__)
#include <emmintrin.h>
#endif

namespace cap4d::CAP4D_ISA {

extern const UnetKernels kUnetKernels;

namespace {

// ---- Four products of uint8 x int8 per lane, added to int32 -----------------------------------------------------------------------
//
// Without VNNI bytes are widened to 16 bits: the even ones and the odd ones of each lane separately, so that neither needs a shuffle.
// pmaddubsw would be shorter, but saturates.

#if defined(CAP4D_AVX512) && defined(__AVX512VNNI__)
typedef IntV Weights;
typedef IntV Inputs;
CAP4D_INLINE Weights unpack(IntV w) { return w; }
CAP4D_INLINE Inputs spread(std::int32_t four) { return reinterpret_cast<IntV>(_mm512_set1_epi32(four)); }
CAP4D_INLINE IntV dot4(IntV sum, Inputs a, const Weights& w) {
  return reinterpret_cast<IntV>(_mm512_dpbusd_epi32(reinterpret_cast<__m512i>(sum), reinterpret_cast<__m512i>(a), reinterpret_cast<__m512i>(w)));
}
#else
struct Weights {
  IntV even, odd;
};
struct Inputs {
  IntV even, odd;
};
typedef std::int16_t ShortV __attribute__((vector_size(4 * kLanes)));

CAP4D_INLINE Weights unpack(IntV w) {
  const ShortV pairs = reinterpret_cast<ShortV>(w);
  return {reinterpret_cast<IntV>((pairs << 8) >> 8), reinterpret_cast<IntV>(pairs >> 8)};
}
CAP4D_INLINE Inputs spread(std::int32_t four) {
  const IntV all = four - IntV{};
  return {all & 0x00ff00ff, (all >> 8) & 0x00ff00ff};
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
CAP4D_INLINE IntV dot4(IntV sum, const Inputs& a, const Weights& w) { return sum + madd(a.even, w.even) + madd(a.odd, w.odd); }
#endif

CAP4D_INLINE IntV load_int(const void* p) {
  IntV v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
CAP4D_INLINE void store_int(void* p, IntV v) { std::memcpy(p, &v, sizeof v); }
CAP4D_INLINE std::int32_t load_four(const std::uint8_t* p) {
  std::int32_t four;
  std::memcpy(&four, p, sizeof four);
  return four;
}

// A tile of accumulators stays in registers.
#if defined(CAP4D_AVX512)
constexpr int kTilePixels = 12, kTileVectors = 2;
#else
constexpr int kTilePixels = 4, kTileVectors = 2;
#endif

template <int kPixels, int kVectors>
CAP4D_INLINE void dot_tile(const DotJob& job, std::size_t first, int column) {
  IntV sum[kPixels][kVectors];
  for (int v = 0; v < kVectors; ++v) {
    const IntV init = load_int(job.init + column + v * kLanes);
    for (int p = 0; p < kPixels; ++p) sum[p][v] = init;
  }
  const std::int8_t* weights = job.weights + 4 * column;
  const std::uint8_t* base[kPixels];
  for (int p = 0; p < kPixels; ++p) base[p] = job.input + job.pixels[first + p];
  const std::size_t stride = 4 * job.panel;
  for (int s = 0; s < job.segment_count; ++s) {
    const std::uint32_t begin = job.segments[s].offset, end = begin + job.segments[s].bytes;
    for (std::uint32_t k = begin; k < end; k += 4, weights += stride) {
      Weights w[kVectors];
      for (int v = 0; v < kVectors; ++v) w[v] = unpack(load_int(weights + 4 * v * kLanes));
      for (int p = 0; p < kPixels; ++p) {
        const Inputs a = spread(load_four(base[p] + k));
        for (int v = 0; v < kVectors; ++v) sum[p][v] = dot4(sum[p][v], a, w[v]);
      }
    }
  }
  for (int p = 0; p < kPixels; ++p)
    for (int v = 0; v < kVectors; ++v) store_int(job.acc + (first + p) * job.panel + column + v * kLanes, sum[p][v]);
}

template <int kVectors>
void dot_columns(const DotJob& job, int column) {
  std::size_t first = 0;
  for (; first + kTilePixels <= job.count; first += kTilePixels) dot_tile<kTilePixels, kVectors>(job, first, column);
  if constexpr (kTilePixels > 8)
    for (; first + 8 <= job.count; first += 8) dot_tile<8, kVectors>(job, first, column);
  for (; first < job.count; first += 4) dot_tile<4, kVectors>(job, first, column);
}

void dot(const DotJob& job) {
  int column = 0;
  for (; column + kTileVectors * kLanes <= job.panel; column += kTileVectors * kLanes) dot_columns<kTileVectors>(job, column);
  for (; column < job.panel; column += kLanes) dot_columns<1>(job, column);
}

// ---- InstanceNorm -------------------------------------------------------------------------------------------------------------------

CAP4D_INLINE FloatV to_float(IntV v) { return __builtin_convertvector(v, FloatV); }

// Two passes: the variance of what the mean has been taken from does not cancel.
void norm(const NormJob& job) {
  const float share = 1.0f / static_cast<float>(job.count);
  for (int c = 0; c < job.panel; c += kLanes) {
    FloatV sum{}, squares{};
    const std::int32_t* acc = job.acc + c;
    for (std::size_t i = 0; i < job.count; ++i) sum = sum + to_float(load_int(acc + i * job.panel));
    const FloatV mean = sum * share;
    for (std::size_t i = 0; i < job.count; ++i) {
      const FloatV x = to_float(load_int(acc + i * job.panel)) - mean;
      squares = squares + x * x;
    }
    store(job.mean + c, mean);
    store(job.gain + c, 1.0f / sqrt(squares * share + load(job.epsilon + c)));
  }
}

// ---- To uint8 -----------------------------------------------------------------------------------------------------------------------

// Rounds to nearest, ties to even; a value that is not a number becomes 0.
CAP4D_INLINE void store_bytes(std::uint8_t* to, FloatV v) {
  typedef std::uint8_t ByteV __attribute__((vector_size(kLanes)));
  v = min(max(v, FloatV{}), splat(255.0f));
  const ByteV bytes = __builtin_convertvector(as_int(v + 12582912.0f) & 0xff, ByteV);  // 1.5 * 2^23
  std::memcpy(to, &bytes, sizeof bytes);
}

struct Quantum {
  FloatV inverse_scale, zero;
};
CAP4D_INLINE Quantum quantum(const Requantizer& to, int channel) {
  return to.image ? Quantum{load(to.inverse_scale + channel), load(to.zero + channel)} : Quantum{};
}

CAP4D_INLINE void activate(FloatV x, const Requantizer& leaky, const Quantum& leaky_q, const Requantizer& relu, const Quantum& relu_q, std::size_t at) {
  if (leaky.image) store_bytes(leaky.image + at, max(x, x * kLeak) * leaky_q.inverse_scale + leaky_q.zero);
  if (relu.image) store_bytes(relu.image + at, max(x, FloatV{}) * relu_q.inverse_scale + relu_q.zero);
}

void requantize(const RequantizeJob& job) {
  for (int c = 0; c < job.panel; c += kLanes) {
    const FloatV mean = load(job.mean + c), gain = load(job.gain + c);
    const Quantum leaky = quantum(job.leaky, c), relu = quantum(job.relu, c);
    for (std::size_t i = 0; i < job.count; ++i) {
      const FloatV x = (to_float(load_int(job.acc + i * job.panel + c)) - mean) * gain;
      activate(x, job.leaky, leaky, job.relu, relu, job.pixels[i] + c);
    }
  }
}

// ---- The first layer ----------------------------------------------------------------------------------------------------------------

constexpr int kFirstPixels = 4;  // at once

template <int kVectors>
CAP4D_INLINE void first_tile(const FirstJob& job, const float* const* lines, const float* rows, const float* columns, int x, int c) {
  const int half = job.size / 2;
  FloatV sum[kFirstPixels][kVectors];
  for (int p = 0; p < kFirstPixels; ++p) {
    const int edge = x + p == 0 ? 0 : x + p == half - 1 ? 2 : 1;
    for (int v = 0; v < kVectors; ++v) {
      const int at = c + v * kLanes;
      sum[p][v] = load(rows + static_cast<std::size_t>(edge) * half * job.channels + at) + load(columns + static_cast<std::size_t>(x + p) * job.channels + at);
    }
  }
  const float* weights = job.weights + c;
  for (int line = 0; line < 4; ++line)
    for (int tap = 0; tap < 12; ++tap, weights += job.channels)
      for (int v = 0; v < kVectors; ++v) {
        const FloatV w = load(weights + v * kLanes);
        for (int p = 0; p < kFirstPixels; ++p) sum[p][v] = sum[p][v] + w * lines[line][6 * (x + p) + tap];
      }
  for (int v = 0; v < kVectors; ++v) {
    const int at = c + v * kLanes;
    const Quantum leaky = quantum(job.leaky, at), relu = quantum(job.relu, at);
    for (int p = 0; p < kFirstPixels; ++p) {
      const std::size_t pixel = static_cast<std::size_t>(job.row + 1) * (half + 2) + x + p + 1;
      activate(sum[p][v], job.leaky, leaky, job.relu, relu, pixel * job.channels + at);
    }
  }
}

void first(const FirstJob& job) {
  const int size = job.size, half = size / 2;
  const std::size_t plane = static_cast<std::size_t>(size) * size;
  float line[4][3 * (kMaxUnetSize + 2)];  // masked, axes innermost, a zero on either side
  const float* lines[4];
  for (int r = 0; r < 4; ++r) {
    lines[r] = line[r];
    const int y = 2 * job.row - 1 + r;
    std::fill_n(line[r], 3 * (size + 2), 0.0f);
    if (y < 0 || y >= size) continue;
    for (int x = 0; x < size; ++x) {
      const std::size_t at = static_cast<std::size_t>(y) * size + x;
      if (job.mask[at])
        for (int axis = 0; axis < 3; ++axis) line[r][3 * (x + 1) + axis] = job.offsets[axis * plane + at];
    }
  }
  const int edge = job.row == 0 ? 0 : job.row == half - 1 ? 2 : 1;
  const float* rows = job.rows + static_cast<std::size_t>(job.row) * job.channels;
  const float* columns = job.columns + static_cast<std::size_t>(edge) * half * job.channels;
  for (int x = 0; x < half; x += kFirstPixels) {
    int c = 0;
    for (; c + 2 * kLanes <= job.channels; c += 2 * kLanes) first_tile<2>(job, lines, rows, columns, x, c);
    for (; c < job.channels; c += kLanes) first_tile<1>(job, lines, rows, columns, x, c);
  }
}

// ---- The last layer -----------------------------------------------------------------------------------------------------------------

void last(const LastJob& job) {
  std::int32_t acc[kMaxUnetSize / 2 * kChannelBlock];
  DotJob dots = job.dot;
  dots.acc = acc;
  dot(dots);
  const std::size_t plane = static_cast<std::size_t>(job.size) * job.size;
  for (int axis = 0; axis < 3; ++axis)
    for (int down = 0; down < 2; ++down) {
      float* out = job.out + axis * plane + static_cast<std::size_t>(2 * job.row + down) * job.size;
      const std::int32_t* from = acc + 6 * down + axis;
      for (std::size_t x = 0; x < dots.count; ++x)
        for (int right = 0; right < 2; ++right)
          out[2 * x + right] = static_cast<float>(from[x * kChannelBlock + 3 * right]) * job.scale[axis] + job.bias[axis];
    }
}

#define CAP4D_TEXT(name) CAP4D_TEXT_(name)
#define CAP4D_TEXT_(name) #name

}  // namespace

const UnetKernels kUnetKernels{CAP4D_TEXT(CAP4D_ISA), first, dot, norm, requantize, last};

}  // namespace cap4d::CAP4D_ISA
