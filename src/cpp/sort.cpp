#include "sort.h"

#include <cmath>

namespace cap4d {
namespace {

constexpr std::size_t kGrain = 8192;

// Unsigned order = numeric order: negative floats are flipped whole, others get the top bit.
std::uint32_t ordered_bits(float value) {
  const auto bits = std::bit_cast<std::uint32_t>(value);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

struct Depth {
  std::uint32_t key, id;
};

}  // namespace

void sort_by_depth(const float* means, std::size_t count, const float* viewmat, std::uint32_t* order, int threads) {
  auto depths = make_buffer<Depth>(count);
  SortSpace<Depth> space;
  const float *forward = viewmat + 8, offset = viewmat[11];
  parallel_for(count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      const float depth = forward[0] * means[3 * i] + forward[1] * means[3 * i + 1] + forward[2] * means[3 * i + 2] + offset;
      depths[i] = {std::isfinite(depth) ? ordered_bits(depth) : 0xffffffffu, static_cast<std::uint32_t>(i)};
    }
  });
  const Depth* sorted = sort_by_key(depths.get(), count, space, threads);
  parallel_for(count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) order[i] = sorted[i].id;
  });
}

}  // namespace cap4d
