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

#if (defined(CAP4D_AVX512) && defined(__AVX512VNNI__)) || (!defined(CAP4D_AVX512) && defined(__AVXVNNI__))
#define CAP4D_VNNI 1
#endif

#ifdef CAP4D_VNNI
typedef IntV Weights;
typedef IntV Inputs;
CAP4D_INLINE Weights unpack(IntV w) { return w; }
CAP4D_INLINE Inputs split(IntV all) { return all; }
CAP4D_INLINE Inputs spread(std::int32_t four) { return four - IntV{}; }
CAP4D_INLINE IntV dot4(IntV sum, Inputs a, const Weights& w) {
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
CAP4D_INLINE Inputs spread(std::int32_t four) {
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
CAP4D_INLINE IntV dot4(IntV sum, const Inputs& a, const Weights& w) { return sum + (madd(a.even, w.even) + madd(a.odd, w.odd)); }
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
static_assert(kTilePixels % 4 == 0);  // what is left over is a multiple of 4

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

CAP4D_INLINE void activate(FloatV x, const Requantizer& leaky, const Quantum& leaky_q, const Requantizer& relu, const Quantum& relu_q,
                           std::size_t at) {
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

void fill_lines(const FirstJob& job, FirstLines& lines) {
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
CAP4D_INLINE void first_tile(const FirstJob& job, const FirstLines& lines, int row, int x, int c) {
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
    const Quantum leaky = quantum(job.leaky, at), relu = quantum(job.relu, at);
    for (int p = 0; p < kPixels; ++p) {
      const std::size_t pixel = static_cast<std::size_t>(y + 1) * (half + 2) + x + p + 1;
      activate(sum[p][v], job.leaky, leaky, job.relu, relu, pixel * channels + at);
    }
  }
}

template <int kPixels>
void first_band(const FirstJob& job, const FirstLines& lines) {
  for (int row = 0; row < kFirstBand; ++row)
    for (int x = 0; x < job.size / 2; x += kPixels) {
      int c = 0;
      for (; c + 2 * kLanes <= job.channels; c += 2 * kLanes) first_tile<kPixels, 2>(job, lines, row, x, c);
      for (; c < job.channels; c += kLanes) first_tile<kPixels, 1>(job, lines, row, x, c);
    }
}

void first(const FirstJob& job) {
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
// fourth four of channels, and one loading of input bytes serves all parities that read them.

constexpr int kParities = 4, kOutputs = 4, kGroups = 4;
constexpr int kLastStep = kOutputs * kGroups * 4;  // bytes of weights for 16 channels of one parity
#if defined(CAP4D_AVX512)
constexpr int kLastPixels = 4;  // at once
#else
constexpr int kLastPixels = 2;
#endif

// Sixteen bytes to every four lanes.
CAP4D_INLINE Inputs spread16(const std::uint8_t* p) {
#if defined(CAP4D_AVX512)
  const IntV all = reinterpret_cast<IntV>(_mm512_broadcast_i32x4(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))));
#elif defined(__AVX2__)
  const IntV all = reinterpret_cast<IntV>(_mm256_broadcastsi128_si256(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))));
#else
  const IntV all = load_int(p);
#endif
  return split(all);
}

// What the input pixel kRow rows and kColumn columns from the upper left one adds to the outputs of each parity that it reaches.
template <int kRow, int kColumn>
CAP4D_INLINE const std::int8_t* last_neighbour(const LastJob& job, const std::uint8_t* pixel, const std::int8_t* weights,
                                               IntV sum[kLastPixels][kParities]) {
  const std::uint8_t* input = pixel + (static_cast<std::size_t>(kRow) * (job.size / 2 + 2) + kColumn) * job.channels;
  for (int k = 0; k < job.channels; k += 4 * kGroups) {
    Inputs a[kLastPixels];
    for (int p = 0; p < kLastPixels; ++p) a[p] = spread16(input + p * job.channels + k);
    for (int parity = 0; parity < kParities; ++parity) {
      const int row = kRow - parity / 2, column = kColumn - parity % 2;
      if (row < 0 || row > 1 || column < 0 || column > 1) continue;
      const Weights w = unpack(load_int(weights));
      weights += kLastStep;
      for (int p = 0; p < kLastPixels; ++p) sum[p][parity] = dot4(sum[p][parity], a[p], w);
    }
  }
  return weights;
}

void last_tile(const LastJob& job, int x) {
  std::int32_t sums[kLastPixels][kParities][kOutputs * kGroups];
  for (int lane = 0; lane < 3 * kGroups; lane += kLanes) {
    IntV sum[kLastPixels][kParities] = {};
    const std::int8_t* weights = job.weights + 4 * lane;
    for (int source = 0; source < 2; ++source) {
      const std::uint8_t* pixel = job.input + source * job.plane + (static_cast<std::size_t>(job.row) * (job.size / 2 + 2) + x) * job.channels;
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
      for (int parity = 0; parity < kParities; ++parity) store_int(sums[p][parity] + lane, sum[p][parity]);
  }
  const std::size_t size = job.size;
  for (int axis = 0; axis < 3; ++axis) {
    const float scale = job.scale[axis], bias = job.bias[axis];
    float* out = job.out + (axis * size + 2 * job.row) * size + 2 * x;
    for (int p = 0; p < kLastPixels; ++p)
      for (int parity = 0; parity < kParities; ++parity) {
        const std::int32_t* four = sums[p][parity] + axis * kGroups;
        const std::int32_t sum = (four[0] + four[1]) + (four[2] + four[3]);
        out[parity / 2 * size + 2 * p + parity % 2] = static_cast<float>(sum) * scale + bias;
      }
  }
}

void last(const LastJob& job) {
  for (int x = 0; x < job.size / 2; x += kLastPixels) last_tile(job, x);
}

#define CAP4D_TEXT(name) CAP4D_TEXT_(name)
#define CAP4D_TEXT_(name) #name

}  // namespace

const UnetKernels kUnetKernels{CAP4D_TEXT(CAP4D_ISA), first, dot, norm, requantize, last};

}  // namespace cap4d::CAP4D_ISA
