#include "sort.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <utility>
#include <vector>

#include "parallel.h"
#include "tiles.h"

namespace cap4d {
namespace {

constexpr int kDigitBits = 11;
constexpr std::uint32_t kBuckets = 1u << kDigitBits;
constexpr std::size_t kGrain = 8192;

// Unsigned order = numeric order: negative floats are flipped whole, others get the top bit.
std::uint32_t ordered_bits(float value) {
  const auto bits = std::bit_cast<std::uint32_t>(value);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

}  // namespace

void sort_pairs(std::uint32_t* keys, std::uint32_t* values, std::uint32_t* key_scratch, std::uint32_t* value_scratch, std::size_t count) {
  if (count < 2) return;
  const auto [low, high] = std::minmax_element(keys, keys + count);
  const std::uint32_t base = *low;
  const int passes = (std::bit_width(*high - base) + kDigitBits - 1) / kDigitBits;
  std::vector<std::uint32_t> places(kBuckets * std::max(passes, 1), 0);
  for (std::size_t i = 0; i < count; ++i)
    for (int pass = 0; pass < passes; ++pass) ++places[pass * kBuckets + ((keys[i] - base) >> (pass * kDigitBits)) % kBuckets];
  std::uint32_t *from_keys = keys, *from_values = values, *to_keys = key_scratch, *to_values = value_scratch;
  for (int pass = 0; pass < passes; ++pass) {
    std::uint32_t* place = places.data() + pass * kBuckets;
    std::uint32_t next = 0;
    for (std::uint32_t b = 0; b < kBuckets; ++b) next += std::exchange(place[b], next);
    for (std::size_t i = 0; i < count; ++i) {
      const std::uint32_t to = place[((from_keys[i] - base) >> (pass * kDigitBits)) % kBuckets]++;
      to_keys[to] = from_keys[i];
      to_values[to] = from_values[i];
    }
    std::swap(from_keys, to_keys);
    std::swap(from_values, to_values);
  }
  if (from_keys != keys) {
    std::memcpy(keys, from_keys, count * sizeof *keys);
    std::memcpy(values, from_values, count * sizeof *values);
  }
}

void sort_by_depth(const float* means, std::size_t count, const float* viewmat, std::uint32_t* order, int threads) {
  auto keys = make_buffer<std::uint32_t>(count), scratch = make_buffer<std::uint32_t>(2 * count);
  const double forward[3] = {viewmat[8], viewmat[9], viewmat[10]}, offset = viewmat[11];
  parallel_for(count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      // In double: far from the origin the sum cancels.
      const auto depth = static_cast<float>(forward[0] * means[3 * i] + forward[1] * means[3 * i + 1] + forward[2] * means[3 * i + 2] + offset);
      keys[i] = std::isfinite(depth) ? ordered_bits(depth) : 0xffffffffu;
      order[i] = static_cast<std::uint32_t>(i);
    }
  });
  sort_pairs(keys.get(), order, scratch.get(), scratch.get() + count, count);
}

}  // namespace cap4d
