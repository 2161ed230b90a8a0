// Memory for large arrays that come and go with every step of fitting. What is released is kept for the next of about its size:
// the system would clear each page again.
#pragma once
#include <cstddef>
#include <memory>

namespace cap4d {

// Begins with a cache line; not initialised. On huge pages where it is large and the system has them: what is reached in no order
// waits for the address of its page as long as for itself.
void* allocate_pages(std::size_t bytes);
void release_pages(void* pages);

struct ReleasePages {
  void operator()(void* pages) const { release_pages(pages); }
};

template <class T>
using Pages = std::unique_ptr<T[], ReleasePages>;

template <class T>
Pages<T> make_pages(std::size_t n) {
  return Pages<T>(static_cast<T*>(allocate_pages(n * sizeof(T))));
}

}  // namespace cap4d
