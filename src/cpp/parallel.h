// Splits [0, n) over threads. What runs where never changes a result: bodies write disjoint outputs, and any
// reduction is done by the caller in a fixed order over chunks whose bounds do not depend on the thread count.
#pragma once
#include <cstddef>
#include <functional>

namespace cap4d {

// Threads used when a caller asks for 0: the hardware's, or CAP4D_THREADS when that is set.
int default_threads();

// Calls body(begin, end) for consecutive chunks of at most `grain` items; chunks are handed out dynamically.
void parallel_for(std::size_t n, std::size_t grain, int threads, const std::function<void(std::size_t, std::size_t)>& body);

}  // namespace cap4d
