#include "similarity.h"

#include <string_view>
#include <vector>

#include "kernels.h"
#include "parallel.h"

namespace cap4d {

namespace base {
extern const SimilarityKernels kSimilarityKernels;
}
#ifdef CAP4D_HAS_X86_VARIANTS
namespace v3 {
extern const SimilarityKernels kSimilarityKernels;
}
namespace v4 {
extern const SimilarityKernels kSimilarityKernels;
}
#endif

namespace {

constexpr std::size_t kRows = 16;  // a piece of work
constexpr int kMostLines = 5;      // that a row needs

std::size_t scratch_size(const SimilarityView& view) { return kMostLines * (view.row + 2 * kReach * view.channels); }

const SimilarityKernels& choose() {
#ifdef CAP4D_HAS_X86_VARIANTS
  const std::string_view level = kernels().isa;
  if (level == "v4") return v4::kSimilarityKernels;
  if (level == "v3") return v3::kSimilarityKernels;
#endif
  return base::kSimilarityKernels;
}

}  // namespace

const SimilarityKernels& similarity_kernels() {
  static const SimilarityKernels& chosen = choose();
  return chosen;
}

SimilaritySums similarity(const SimilarityView& view, int threads) {
  std::vector<SimilaritySums> rows(view.height);
  parallel_for(view.height, kRows, threads, [&](std::size_t begin, std::size_t end) {
    std::vector<float> scratch(scratch_size(view));
    for (std::size_t y = begin; y < end; ++y) rows[y] = similarity_kernels().forward(view, y, scratch.data());
  });
  SimilaritySums sums{};
  for (const SimilaritySums& row : rows) sums.absolute += row.absolute, sums.structural += row.structural;
  const double values = static_cast<double>(view.height * view.row);
  return {sums.absolute / values, sums.structural / values};
}

void similarity_vjp(const SimilarityView& view, int threads, const SimilarityGradient& gradient) {
  const float share = 1.0f / static_cast<float>(view.height * view.row);
  const SimilarityGradient each{share * gradient.absolute, share * gradient.structural, gradient.v_image};
  parallel_for(view.height, kRows, threads, [&](std::size_t begin, std::size_t end) {
    std::vector<float> scratch(scratch_size(view));
    for (std::size_t y = begin; y < end; ++y) similarity_kernels().backward(view, y, each, scratch.data());
  });
}

}  // namespace cap4d
