#include "ceilings.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <functional>
#include <string_view>
#include <thread>
#include <vector>

#include "kernels.h"

namespace cap4d {

namespace base {
extern const CeilingKernels kCeilingKernels;
}
#ifdef CAP4D_HAS_X86_VARIANTS
namespace v3 {
extern const CeilingKernels kCeilingKernels;
}
namespace v4 {
extern const CeilingKernels kCeilingKernels;
}
#endif

namespace {

using Clock = std::chrono::steady_clock;

double seconds_between(Clock::time_point a, Clock::time_point b) { return std::chrono::duration<double>(b - a).count(); }

const CeilingKernels& ceiling_kernels() {
#ifdef CAP4D_HAS_X86_VARIANTS
  const std::string_view isa = kernels().isa;
  if (isa == "v4") return v4::kCeilingKernels;
  if (isa == "v3") return v3::kCeilingKernels;
#endif
  return base::kCeilingKernels;
}

// Where loops leave what they found, so that none of them can be optimised away.
std::atomic<float> sink;

// Runs work(thread) once on every thread, all starting together, and returns the wall-clock seconds of the slowest.
double one_go(int threads, const std::function<void(int)>& work) {
  std::atomic<int> ready{0};
  std::vector<Clock::time_point> starts(threads), ends(threads);
  const auto run = [&](int thread) {
    ready.fetch_add(1);
    while (ready.load() < threads) std::this_thread::yield();
    starts[thread] = Clock::now();
    work(thread);
    ends[thread] = Clock::now();
  };
  std::vector<std::thread> others;
  for (int thread = 1; thread < threads; ++thread) others.emplace_back(run, thread);
  run(0);
  for (auto& other : others) other.join();
  return seconds_between(*std::min_element(starts.begin(), starts.end()), *std::max_element(ends.begin(), ends.end()));
}

// `work(thread, rounds)` does `amount` a round and thread. The number of rounds grows until even the quickest of a few goes takes some
// milliseconds, long beside the start of a thread; then the best of many goes counts.
double best_rate(double amount, int threads, double seconds, const std::function<void(int, std::size_t)>& work) {
  constexpr double kGo = 4e-3;
  constexpr int kTries = 3;  // on a busy machine a single go can take long for other reasons
  std::size_t rounds = 1;
  const auto go = [&] { return one_go(threads, [&](int thread) { work(thread, rounds); }); };
  const auto quickest = [&] {
    double least = go();
    for (int i = 1; i < kTries; ++i) least = std::min(least, go());
    return least;
  };
  const Clock::time_point start = Clock::now();
  double least = quickest();
  for (; least < kGo; least = quickest()) rounds *= 2;
  while (seconds_between(start, Clock::now()) < seconds) least = std::min(least, go());
  return amount * threads * rounds / least;
}

constexpr std::size_t kPiece = 4096;  // bytes: buffers are a multiple of it

}  // namespace

double multiply_add_rate(int threads, double seconds) {
  const CeilingKernels& k = ceiling_kernels();
  return best_rate(static_cast<double>(k.flops_per_round), threads, seconds, [&](int, std::size_t rounds) { sink = k.multiply_add(rounds); });
}

double copy_rate(std::size_t bytes, int threads, double seconds) {
  const std::size_t half = std::max(kPiece, bytes / threads / 2 / kPiece * kPiece);
  std::vector<std::vector<char>> from(threads, std::vector<char>(half, 1)), to(threads, std::vector<char>(half));
  return best_rate(2.0 * half, threads, seconds, [&](int thread, std::size_t rounds) {
    for (std::size_t r = 0; r < rounds; ++r) {
      std::memcpy(to[thread].data(), from[thread].data(), half);
      sink = static_cast<float>(to[thread][r % half]);
    }
  });
}

double read_rate(std::size_t bytes, int threads, double seconds) {
  const std::size_t part = std::max(kPiece, bytes / threads / kPiece * kPiece), count = part / sizeof(float);
  std::vector<std::vector<float>> values(threads, std::vector<float>(count, 1.0f));
  const CeilingKernels& k = ceiling_kernels();
  return best_rate(static_cast<double>(part), threads, seconds, [&](int thread, std::size_t rounds) {
    for (std::size_t r = 0; r < rounds; ++r) sink = k.read(values[thread].data(), count);
  });
}

double sort_pass_rate(std::size_t count, int threads, double seconds) {
  struct Lists {
    std::vector<std::uint64_t> from, to;  // key in the low half, value in the high half
  };
  std::vector<Lists> lists(threads);
  for (Lists& l : lists) {
    l.from.resize(count), l.to.resize(count);
    std::uint64_t state = 1;
    for (std::uint64_t& item : l.from) item = state = state * 6364136223846793005ull + 1442695040888963407ull;
  }
  return best_rate(static_cast<double>(count), threads, seconds, [&](int thread, std::size_t rounds) {
    Lists& l = lists[thread];
    for (std::size_t r = 0; r < rounds; ++r) {
      const int shift = 32 + 8 * (r % 4);  // the generator's low bits are poor
      std::uint32_t places[256] = {}, next = 0;
      for (const std::uint64_t item : l.from) ++places[(item >> shift) & 255];
      for (std::uint32_t& place : places) {
        const std::uint32_t here = place;
        place = next, next += here;
      }
      for (const std::uint64_t item : l.from) l.to[places[(item >> shift) & 255]++] = item;
      l.from.swap(l.to);
    }
  });
}

}  // namespace cap4d
