// A stable radix sort of records by their `key`, and the order of depths made with it.
#pragma once
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "parallel.h"
#include "scratch.h"

namespace cap4d {

template <class Record>
struct SortSpace {
  Scratch<Record> records;
  Scratch<std::uint32_t> places;
};

// Sorts by `key` (std::uint32_t), ascending, equal keys in their given order; as many passes as the range of the keys needs. Returns
// where the result lies: `records`, or the space's. The same result for any number of threads.
template <class Record>
Record* sort_by_key(Record* records, std::size_t count, SortSpace<Record>& space, int threads) {
  constexpr int kDigitBits = 12;          // 4096 destinations of a pass: what the second-level cache holds
  constexpr std::size_t kChunks = 8;      // each has its own counters, so that chunks are placed side by side
  constexpr std::size_t kSerial = 8192;   // records that are not worth waking threads for
  if (count < 2) return records;
  std::uint32_t low = records[0].key, high = low;
  for (std::size_t i = 1; i < count; ++i) low = std::min(low, records[i].key), high = std::max(high, records[i].key);
  const int bits = std::bit_width(high - low), passes = (bits + kDigitBits - 1) / kDigitBits;
  if (passes == 0) return records;
  const int digit = (bits + passes - 1) / passes;
  const std::uint32_t buckets = 1u << digit;
  const std::size_t size = (count + kChunks - 1) / kChunks;
  std::uint32_t* places = space.places.reserve(kChunks * buckets);
  Record *from = records, *to = space.records.reserve(count);
  const auto each_chunk = [&](auto&& body) {  // (its counters, first, last)
    parallel_for(kChunks, 1, count < kSerial ? 1 : threads, [&](std::size_t begin, std::size_t end) {
      for (std::size_t k = begin; k < end; ++k) body(places + k * buckets, std::min(count, k * size), std::min(count, (k + 1) * size));
    });
  };
  for (int shift = 0; shift < passes * digit; shift += digit) {
    const auto bucket = [&](std::uint32_t key) { return (key - low) >> shift & (buckets - 1); };
    each_chunk([&](std::uint32_t* place, std::size_t first, std::size_t last) {
      std::fill_n(place, buckets, 0);
      for (std::size_t i = first; i < last; ++i) ++place[bucket(from[i].key)];
    });
    std::uint32_t next = 0;
    for (std::uint32_t b = 0; b < buckets; ++b)
      for (std::size_t k = 0; k < kChunks; ++k) next += std::exchange(places[k * buckets + b], next);
    each_chunk([&](std::uint32_t* place, std::size_t first, std::size_t last) {
      for (std::size_t i = first; i < last; ++i) to[place[bucket(from[i].key)]++] = from[i];
    });
    std::swap(from, to);
  }
  return from;
}

// order [count]: indices near to far by `depth_of(index)`; equal depths keep their order, those that are not finite come last.
template <class DepthOf>
void sort_depths(std::size_t count, std::uint32_t* order, int threads, const DepthOf& depth_of) {
  constexpr std::size_t kGrain = 8192;
  struct Depth {
    std::uint32_t key, id;
  };
  auto depths = make_buffer<Depth>(count);
  SortSpace<Depth> space;
  parallel_for(count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      const float depth = depth_of(i);
      const auto bits = std::bit_cast<std::uint32_t>(depth);
      // Unsigned order = numeric order: negative floats are flipped whole, others get the top bit.
      depths[i] = {!std::isfinite(depth) ? 0xffffffffu : bits & 0x80000000u ? ~bits : bits | 0x80000000u, static_cast<std::uint32_t>(i)};
    }
  });
  const Depth* sorted = sort_by_key(depths.get(), count, space, threads);
  parallel_for(count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) order[i] = sorted[i].id;
  });
}

// The same of means [N, 3] along the camera's axis, the third row of viewmat [4, 4].
void sort_by_depth(const float* means, std::size_t count, const float* viewmat, std::uint32_t* order, int threads);

}  // namespace cap4d
