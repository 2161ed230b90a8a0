#include "pages.h"

#include <cstdint>
#include <cstdlib>
#include <mutex>
#include <new>
#include <vector>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace cap4d {
namespace {

constexpr std::size_t kHugePage = std::size_t{2} << 20;
constexpr std::size_t kMaxKept = std::size_t{256} << 20;  // bytes that nobody uses: a step of fitting 300 000 Gaussians releases half as much

// What comes before the caller's part, and keeps that at the start of a cache line.
struct alignas(64) Header {
  std::size_t size;  // of all
};

Header* from_system(std::size_t size) {
  void* pages = std::aligned_alloc(size < kHugePage ? alignof(Header) : kHugePage, size);
  if (!pages) throw std::bad_alloc();
#ifdef __linux__
  if (size >= kHugePage) madvise(pages, size, MADV_HUGEPAGE);  // a wish: nothing is lost where it is not granted
#endif
  return new (pages) Header{size};
}

class Kept {
 public:
  // The smallest that holds `size` and wastes less than half of itself; or null.
  Header* take(std::size_t size) {
    std::lock_guard lock(mutex_);
    auto best = blocks_.end();
    for (auto block = blocks_.begin(); block != blocks_.end(); ++block)
      if ((*block)->size >= size && (*block)->size / 2 < size && (best == blocks_.end() || (*block)->size < (*best)->size)) best = block;
    if (best == blocks_.end()) return nullptr;
    Header* found = *best;
    blocks_.erase(best);
    bytes_ -= found->size;
    return found;
  }

  // Those kept longest make room for it.
  void put(Header* block) {
    std::lock_guard lock(mutex_);
    blocks_.push_back(block), bytes_ += block->size;
    while (bytes_ > kMaxKept) {
      bytes_ -= blocks_.front()->size;
      std::free(blocks_.front());
      blocks_.erase(blocks_.begin());
    }
  }

 private:
  std::mutex mutex_;
  std::vector<Header*> blocks_;
  std::size_t bytes_ = 0;
};

Kept& kept() {
  static Kept* instance = new Kept;  // never destroyed: arrays may outlive static destructors
  return *instance;
}

}  // namespace

void* allocate_pages(std::size_t bytes) {
  const std::size_t needed = sizeof(Header) + bytes, step = needed < kHugePage ? alignof(Header) : kHugePage;
  if (needed < bytes || needed > SIZE_MAX - step) throw std::bad_alloc();
  const std::size_t size = (needed + step - 1) / step * step;
  Header* block = size < kHugePage ? nullptr : kept().take(size);
  return (block ? block : from_system(size)) + 1;
}

void release_pages(void* pages) {
  if (!pages) return;
  Header* block = static_cast<Header*>(pages) - 1;
  if (block->size < kHugePage) std::free(block);
  else kept().put(block);
}

}  // namespace cap4d
