#include "sort.h"

namespace cap4d {

void sort_by_depth(const float* means, std::size_t count, const float* viewmat, std::uint32_t* order, int threads) {
  const double forward[3] = {viewmat[8], viewmat[9], viewmat[10]}, offset = viewmat[11];
  sort_depths(count, order, threads, [&](std::size_t i) {
    // In double: far from the origin the sum cancels.
    return static_cast<float>(forward[0] * means[3 * i] + forward[1] * means[3 * i + 1] + forward[2] * means[3 * i + 2] + offset);
  });
}

}  // namespace cap4d
