#include "sort.h"

namespace cap4d {

void sort_by_depth(const float* means, std::size_t count, const float* viewmat, std::uint32_t* order, int threads) {
  const float *forward = viewmat + 8, offset = viewmat[11];
  sort_depths(count, order, threads, [&](std::size_t i) {
    return forward[0] * means[3 * i] + forward[1] * means[3 * i + 1] + forward[2] * means[3 * i + 2] + offset;
  });
}

}  // namespace cap4d
