// The thread pool under ThreadSanitizer (`make sanitize`): jobs from many threads at once, nested, throwing, of any number of threads.
#include <atomic>
#include <chrono>
#include <cstdio>
#include <stdexcept>
#include <thread>
#include <vector>

#include "parallel.h"

#ifdef __linux__
#include <sched.h>
#endif

namespace {

// Each item written by one thread and read by the caller: a race if the pool does not order them.
bool sums_up(std::size_t n, int threads) {
  std::vector<int> items(n);
  cap4d::parallel_for(n, 7, threads, [&](std::size_t begin, std::size_t end) {
    cap4d::parallel_for(end - begin, 2, threads, [&](std::size_t first, std::size_t last) {
      for (std::size_t i = first; i < last; ++i) items[begin + i] += 1;
    });
  });
  std::size_t sum = 0;
  for (const int item : items) sum += item;
  return sum == n;
}

bool rethrows(int threads) {
  try {
    cap4d::parallel_for(100, 1, threads, [](std::size_t begin, std::size_t) {
      if (begin % 10 == 3) throw std::runtime_error("on purpose");
    });
  } catch (const std::runtime_error&) {
    return true;
  }
  return false;
}

// Two items that wait for each other: callers at the same time, each of which needs a helper, get one in turn.
void meet() {
  std::atomic<int> arrived{0};
  cap4d::parallel_for(2, 1, 2, [&](std::size_t, std::size_t) {
    ++arrived;
    while (arrived < 2) std::this_thread::yield();
  });
}

// Workers that were asleep run wherever the caller may, whatever was done to wake them.
bool run_anywhere() {
#ifdef __linux__
  const auto cores = [] {
    cpu_set_t allowed;
    return sched_getaffinity(0, sizeof allowed, &allowed) == 0 ? CPU_COUNT(&allowed) : 0;
  };
  std::atomic<int> arrived{0}, same{0};
  const int expected = cores();
  std::this_thread::sleep_for(std::chrono::milliseconds(2));
  cap4d::parallel_for(2, 1, 2, [&](std::size_t, std::size_t) {
    ++arrived;
    while (arrived < 2) std::this_thread::yield();
    same += cores() == expected;
  });
  return same == 2;
#else
  return true;
#endif
}

}  // namespace

int main() {
  std::atomic<int> failures{0};
  for (int round = 0; round < 20; ++round)
    if (!run_anywhere()) ++failures;
  std::vector<std::thread> callers;
  for (int caller = 0; caller < 4; ++caller)
    callers.emplace_back([&, caller] {
      for (int round = 0; round < 300; ++round) {
        const int threads = 1 + (caller + round) % 5;
        if (!sums_up(static_cast<std::size_t>(round), threads)) ++failures;
        meet();
        if (round % 10 == 0 && !rethrows(threads)) ++failures;
      }
    });
  for (std::thread& caller : callers) caller.join();
  std::printf("thread pool: %d failures\n", failures.load());
  return failures != 0;
}
