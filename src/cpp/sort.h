// Stable radix sorts.
#pragma once
#include <cstddef>
#include <cstdint>

namespace cap4d {

// Sorts `values` by `keys`, ascending, equal keys in their given order. Both are overwritten; scratch is of the same size.
// Only as many passes as the range of the keys needs.
void sort_pairs(std::uint32_t* keys, std::uint32_t* values, std::uint32_t* key_scratch, std::uint32_t* value_scratch, std::size_t count);

// order [N]: indices of means [N, 3] near to far along the camera's axis (third row of viewmat [4, 4]); equal depths keep
// their order. Depths that are not finite come last.
void sort_by_depth(const float* means, std::size_t count, const float* viewmat, std::uint32_t* order, int threads);

}  // namespace cap4d
