// Rows of the structural similarity and of its gradient. Compiled once per instruction set.
#include "simd.h"
#include "similarity.h"

namespace cap4d::CAP4D_ISA {

extern const SimilarityKernels kSimilarityKernels;

namespace {

constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;  // K1, K2 of Wang et al. at a dynamic range of 1
constexpr int kMoments = 5, kPartials = 3;

template <class T> CAP4D_INLINE T get(const float* p) { T v; std::memcpy(&v, p, sizeof v); return v; }
template <class T> CAP4D_INLINE void put(float* p, T v) { std::memcpy(p, &v, sizeof v); }

// A row between margins of zeros as wide as the window reaches.
struct Rows {
  float* first;
  std::size_t stride, margin;
  float* operator[](int i) const { return first + i * stride + margin; }
};
Rows cleared(const SimilarityView& v, float* scratch, int count) {
  const std::size_t margin = static_cast<std::size_t>(kReach) * v.channels, stride = v.row + 2 * margin;
  for (int i = 0; i < count; ++i)
    for (std::size_t k = 0; k < margin; ++k) scratch[i * stride + k] = scratch[i * stride + margin + v.row + k] = 0.0f;
  return {scratch, stride, margin};
}

struct Taps {
  std::size_t first, last;  // rows of the image, inclusive
  const float* weights;     // of the first
};
Taps taps_at(const SimilarityView& v, std::size_t y) {
  const std::size_t first = y < kReach ? 0 : y - kReach, last = y + kReach < v.height ? y + kReach : v.height - 1;
  return {first, last, v.window + (first + kReach - y)};
}

template <class T>
CAP4D_INLINE T across(const SimilarityView& v, const float* middle) {
  T sum{};
  for (int k = 0; k < kWindow; ++k) sum = sum + v.window[k] * get<T>(middle + (k - kReach) * v.channels);
  return sum;
}

template <class T>
CAP4D_INLINE void moments_down(const SimilarityView& v, const Taps& taps, const Rows& rows, std::size_t i) {
  T sums[kMoments] = {};
  for (std::size_t y = taps.first; y <= taps.last; ++y) {
    const float w = taps.weights[y - taps.first];
    const T a = get<T>(v.image + y * v.row + i), b = get<T>(v.target + y * v.row + i), wa = w * a, wb = w * b;
    sums[0] = sums[0] + wa, sums[1] = sums[1] + wb;
    sums[2] = sums[2] + wa * a, sums[3] = sums[3] + wb * b, sums[4] = sums[4] + wa * b;
  }
  for (int m = 0; m < kMoments; ++m) put<T>(rows[m] + i, sums[m]);
}

template <class T>
CAP4D_INLINE T score(const SimilarityView& v, const Rows& rows, std::size_t y, std::size_t i) {
  const T mx = across<T>(v, rows[0] + i), my = across<T>(v, rows[1] + i);
  const T xx = across<T>(v, rows[2] + i), yy = across<T>(v, rows[3] + i), xy = across<T>(v, rows[4] + i);
  const T a1 = 2.0f * mx * my + kC1, b1 = mx * mx + my * my + kC1;
  const T a2 = 2.0f * (xy - mx * my) + kC2, b2 = (xx - mx * mx) + (yy - my * my) + kC2;
  const T inverse1 = 1.0f / b1, inverse2 = 1.0f / b2, similar = a1 * a2 * inverse1 * inverse2;
  const T by_xx = -similar * inverse2, by_xy = 2.0f * a1 * inverse1 * inverse2;
  const T direct = 2.0f * (my * a2 * inverse1 * inverse2 - mx * similar * inverse1);
  const std::size_t at = y * v.row + i, plane = v.height * v.row;
  put<T>(v.partials + at, direct - 2.0f * mx * by_xx - my * by_xy);
  put<T>(v.partials + plane + at, by_xx);
  put<T>(v.partials + 2 * plane + at, by_xy);
  return similar;
}

template <class T> CAP4D_INLINE T magnitude(T x) { return max(x, -x); }
CAP4D_INLINE double total(float x) { return x; }
CAP4D_INLINE double total(FloatV x) {
  double sum = 0;
  for (int l = 0; l < kLanes; ++l) sum += x[l];
  return sum;
}

SimilaritySums forward(const SimilarityView& v, std::size_t y, float* scratch) {
  const Rows rows = cleared(v, scratch, kMoments);
  const Taps taps = taps_at(v, y);
  const std::size_t whole = v.row / kLanes * kLanes;
  for (std::size_t i = 0; i < whole; i += kLanes) moments_down<FloatV>(v, taps, rows, i);
  for (std::size_t i = whole; i < v.row; ++i) moments_down<float>(v, taps, rows, i);
  const float *image = v.image + y * v.row, *target = v.target + y * v.row;
  FloatV absolute{}, structural{};
  for (std::size_t i = 0; i < whole; i += kLanes) {
    structural = structural + score<FloatV>(v, rows, y, i);
    absolute = absolute + magnitude(load(image + i) - load(target + i));
  }
  SimilaritySums sums{total(absolute), total(structural)};
  for (std::size_t i = whole; i < v.row; ++i) {
    sums.structural += score<float>(v, rows, y, i);
    sums.absolute += magnitude(image[i] - target[i]);
  }
  return sums;
}

template <class T>
CAP4D_INLINE void partials_down(const SimilarityView& v, const Taps& taps, const Rows& rows, std::size_t i) {
  const std::size_t plane = v.height * v.row;
  T sums[kPartials] = {};
  for (std::size_t y = taps.first; y <= taps.last; ++y)
    for (int m = 0; m < kPartials; ++m) sums[m] = sums[m] + taps.weights[y - taps.first] * get<T>(v.partials + m * plane + y * v.row + i);
  for (int m = 0; m < kPartials; ++m) put<T>(rows[m] + i, sums[m]);
}

template <class T>
CAP4D_INLINE void gradient(const SimilarityView& v, const Rows& rows, std::size_t y, std::size_t i, const SimilarityGradient& g) {
  const std::size_t at = y * v.row + i;
  const T a = get<T>(v.image + at), b = get<T>(v.target + at), zero{}, one = zero + g.absolute;
  const T sign = keep(less(b, a), one) - keep(less(a, b), one);
  const T structural = across<T>(v, rows[0] + i) + 2.0f * a * across<T>(v, rows[1] + i) + b * across<T>(v, rows[2] + i);
  put<T>(g.v_image + at, sign + g.structural * structural);
}

void backward(const SimilarityView& v, std::size_t y, const SimilarityGradient& g, float* scratch) {
  const Rows rows = cleared(v, scratch, kPartials);
  const Taps taps = taps_at(v, y);
  const std::size_t whole = v.row / kLanes * kLanes;
  for (std::size_t i = 0; i < whole; i += kLanes) partials_down<FloatV>(v, taps, rows, i);
  for (std::size_t i = whole; i < v.row; ++i) partials_down<float>(v, taps, rows, i);
  for (std::size_t i = 0; i < whole; i += kLanes) gradient<FloatV>(v, rows, y, i, g);
  for (std::size_t i = whole; i < v.row; ++i) gradient<float>(v, rows, y, i, g);
}

}  // namespace

const SimilarityKernels kSimilarityKernels{&forward, &backward};

}  // namespace cap4d::CAP4D_ISA
