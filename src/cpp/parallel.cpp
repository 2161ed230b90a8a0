// A small persistent pool behind parallel_for. Callers at the same time share its threads: the oldest job that wants more is helped first.
// Nested calls work alone.
#include "parallel.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdlib>
#include <deque>
#include <exception>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#ifdef __linux__
#include <pthread.h>
#include <sched.h>
#endif

namespace cap4d {
namespace {

constexpr int kMaxThreads = 256;  // of one job, whoever asks: the pool's threads are never given back

thread_local bool inside_job = false;

struct Job {
  std::size_t n, grain;
  const std::function<void(std::size_t, std::size_t)>* body;
  std::atomic<std::size_t> next{0};
  int wanted = 0;              // helpers that have not come yet; of the pool's mutex
  std::atomic<int> active{0};  // helpers at work; changed only under the pool's mutex
  std::exception_ptr error;
  std::mutex error_mutex;

  void run() {
    inside_job = true;
    for (;;) {
      const std::size_t begin = next.fetch_add(grain);
      if (begin >= n) break;
      try {
        (*body)(begin, std::min(n, begin + grain));
      } catch (...) {
        std::lock_guard lock(error_mutex);
        if (!error) error = std::current_exception();
      }
    }
    inside_job = false;
  }
};

// A thread of the pool, and where it may run. Linux in a virtual machine takes a halted core for one that its host has taken away, and
// wakes a thread on its waker's core, where it waits for the waker: an int8 pass of the network after 2 ms of rest took 0.70 ms, as on one
// thread, and 0.42 ms with the worker sent elsewhere. So it is kept off the waker's core until it runs.
class Worker {
 public:
  bool asleep = false;  // of the pool's mutex

  template <class Body>
  explicit Worker(const Body& body) : thread_([this, body] { body(*this); }) {}
  void join() { thread_.join(); }

#ifdef __linux__
  // By the waker, under the pool's mutex, of a sleeping worker.
  void send_elsewhere() {
    if (!sent_ && pthread_getaffinity_np(thread_.native_handle(), sizeof allowed_, &allowed_) != 0) return;
    cpu_set_t elsewhere = allowed_;
    const int here = sched_getcpu();
    if (here < 0 || here >= CPU_SETSIZE) return;
    CPU_CLR(here, &elsewhere);
    if (CPU_COUNT(&elsewhere) > 0) sent_ |= pthread_setaffinity_np(thread_.native_handle(), sizeof elsewhere, &elsewhere) == 0;
  }
  // By the worker itself, under the pool's mutex.
  void settle() {
    if (sent_) pthread_setaffinity_np(pthread_self(), sizeof allowed_, &allowed_);
    sent_ = false;
  }

 private:
  cpu_set_t allowed_;  // where sent_
  bool sent_ = false;
#else
  void send_elsewhere() {}
  void settle() {}

 private:
#endif
  std::thread thread_;  // the last: it starts when the rest is there
};

class Pool {
 public:
  void run(Job& job, int helpers) {
    {
      std::lock_guard lock(mutex_);
      while (static_cast<int>(workers_.size()) < helpers) workers_.emplace_back([this](Worker& worker) { work(worker); });
      for (Worker& worker : workers_)
        if (worker.asleep) worker.send_elsewhere();
      job.wanted = helpers;
      jobs_.push_back(&job);
      wanted_ += helpers;
    }
    wake_.notify_all();
    job.run();
    {
      std::lock_guard lock(mutex_);
      jobs_.erase(std::find(jobs_.begin(), jobs_.end(), &job));
      wanted_ -= job.wanted;  // a worker that has not started yet need not
    }
    spin_while([&job] { return job.active.load(std::memory_order_acquire) > 0; });
    std::unique_lock lock(mutex_);
    done_.wait(lock, [&job] { return job.active == 0; });
  }

  ~Pool() {
    {
      std::lock_guard lock(mutex_);
      stop_ = true;
    }
    wake_.notify_all();
    for (auto& worker : workers_) worker.join();
  }

 private:
  void work(Worker& worker) {
    std::unique_lock lock(mutex_);
    for (;;) {
      worker.asleep = wanted_ == 0;
      wake_.wait(lock, [this] { return stop_ || wanted_ > 0; });
      worker.asleep = false;
      worker.settle();
      if (stop_) return;
      Job& job = **std::find_if(jobs_.begin(), jobs_.end(), [](const Job* j) { return j->wanted > 0; });
      --wanted_, --job.wanted;
      ++job.active;
      lock.unlock();
      job.run();
      lock.lock();
      if (--job.active == 0) done_.notify_all();
      lock.unlock();
      spin_while([this] { return wanted_.load(std::memory_order_acquire) == 0; });
      lock.lock();
    }
  }

  // A frame is a dozen jobs one after the other, and a sleeping thread takes as long to wake as some of them last: it stays awake for
  // the next, but so briefly that nobody misses the core.
  template <class Condition>
  static void spin_while(const Condition& holds) {
    constexpr int kSpins = 2000;  // some 20 to 50 us
    for (int i = 0; i < kSpins && holds(); ++i) pause();
  }
  static void pause() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ volatile("yield");
#endif
  }

  std::mutex mutex_;
  std::condition_variable wake_, done_;
  std::deque<Worker> workers_;
  std::vector<Job*> jobs_;      // running, the oldest first
  std::atomic<int> wanted_{0};  // by all of them; changed only under the mutex
  bool stop_ = false;
};

Pool& pool() {
  static Pool* instance = new Pool;  // never destroyed: worker threads may outlive static destructors
  return *instance;
}

}  // namespace

int default_threads() {
  if (const char* text = std::getenv("CAP4D_THREADS")) {
    const int value = std::atoi(text);
    if (value > 0) return std::min(value, kMaxThreads);
  }
  return std::clamp(static_cast<int>(std::thread::hardware_concurrency()), 1, kMaxThreads);
}

void parallel_for(std::size_t n, std::size_t grain, int threads, const std::function<void(std::size_t, std::size_t)>& body) {
  if (n == 0) return;
  grain = std::max<std::size_t>(1, grain);
  threads = threads <= 0 ? default_threads() : std::min(threads, kMaxThreads);
  const std::size_t chunks = (n + grain - 1) / grain;
  const int helpers = static_cast<int>(std::min<std::size_t>(threads, chunks)) - 1;
  if (helpers <= 0 || inside_job) {
    for (std::size_t begin = 0; begin < n; begin += grain) body(begin, std::min(n, begin + grain));
    return;
  }
  Job job;
  job.n = n, job.grain = grain, job.body = &body;
  pool().run(job, helpers);
  if (job.error) std::rethrow_exception(job.error);
}

}  // namespace cap4d
