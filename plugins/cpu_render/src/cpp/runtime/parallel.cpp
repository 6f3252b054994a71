#include "runtime/parallel.hpp"

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <cstdlib>
#include <exception>
#include <mutex>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>
#include <vector>

#if defined(__linux__)
#include <sched.h>
#endif
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace gsstream_cpu {
namespace {

constexpr int kMaxThreads = 1024;
constexpr auto kSpin = std::chrono::microseconds(20);

thread_local bool inside = false;  // this thread is running a chunk, as caller or as worker

void relax() {
#if defined(__x86_64__)
  _mm_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

// True as soon as ready() holds, false after kSpin.
template <class Ready>
bool spin(Ready ready) {
  const auto end = std::chrono::steady_clock::now() + kSpin;
  do {
    for (int i = 0; i < 16; ++i) {
      if (ready()) return true;
      relax();
    }
  } while (std::chrono::steady_clock::now() < end);
  return false;
}

int available_processors() {
#if defined(__linux__)
  cpu_set_t set;
  CPU_ZERO(&set);
  if (sched_getaffinity(0, sizeof set, &set) == 0) return std::clamp(CPU_COUNT(&set), 1, kMaxThreads);
#endif
  return std::clamp(static_cast<int>(std::thread::hardware_concurrency()), 1, kMaxThreads);
}

int default_threads() {
  const char* text = std::getenv("GSSTREAM_THREADS");
  if (text == nullptr || *text == '\0') return available_processors();
  char* end = nullptr;
  errno = 0;
  const long value = std::strtol(text, &end, 10);
  if (errno != 0 || end == text || *end != '\0' || value < 1 || value > kMaxThreads) {
    throw std::invalid_argument("environment variable GSSTREAM_THREADS: expected an integer from 1 to " +
                                std::to_string(kMaxThreads) + ", got '" + text + "'; correct or unset it");
  }
  return static_cast<int>(value);
}

struct Job {
  detail::RangeFunction function;
  void* context;
  std::size_t count;
  std::size_t grain;
  std::size_t chunks;
  std::atomic<std::size_t> next{0};
  std::mutex error_mutex;
  std::exception_ptr error;

  void work() {
    inside = true;
    for (;;) {
      const std::size_t chunk = next.fetch_add(1, std::memory_order_relaxed);
      if (chunk >= chunks) break;
      const std::size_t begin = chunk * grain;
      try {
        function(context, begin, begin + std::min(grain, count - begin));
      } catch (...) {
        const std::lock_guard lock(error_mutex);
        if (!error) error = std::current_exception();
        next.store(chunks, std::memory_order_relaxed);
      }
    }
    inside = false;
  }
};

class Pool {
 public:
  explicit Pool(int threads) : threads_(threads) {}

  int threads() const { return threads_.load(std::memory_order_relaxed); }

  void resize(int threads) {
    const std::lock_guard owner(owner_);
    if (threads == threads_) return;
    join_workers();
    threads_ = threads;
  }

  // False when another thread owns the pool: the caller then works alone, which can never deadlock.
  bool run(Job& job) {
    const std::unique_lock owner(owner_, std::try_to_lock);
    if (!owner.owns_lock() || closed_) return false;
    start_workers();
    const std::size_t helpers = std::min(workers_.size(), job.chunks - 1);
    {
      const std::lock_guard lock(mutex_);
      job_ = &job;
      epoch_.fetch_add(1, std::memory_order_release);
    }
    if (helpers == workers_.size()) {
      wake_.notify_all();
    } else {
      for (std::size_t i = 0; i < helpers; ++i) wake_.notify_one();
    }
    job.work();
    {
      const std::lock_guard lock(mutex_);
      job_ = nullptr;  // nobody joins from here on
    }
    const auto finished = [this] { return active_.load(std::memory_order_acquire) == 0; };
    if (!spin(finished)) {
      std::unique_lock lock(mutex_);
      done_.wait(lock, finished);
    }
    return true;
  }

  // At exit: join if idle. A thread that is still inside a job at exit is left alone; the pool's memory is never freed.
  void close() {
    const std::unique_lock owner(owner_, std::try_to_lock);
    if (!owner.owns_lock()) return;
    closed_ = true;
    join_workers();
  }

 private:
  void start_workers() {
    const auto wanted = static_cast<std::size_t>(threads_.load() - 1);
    while (workers_.size() < wanted) {
      try {
        workers_.emplace_back([this] { worker(); });
      } catch (const std::system_error&) {
        break;  // the system gives no more threads: the ones there are (at least the caller) do all the work
      }
    }
  }

  void join_workers() {
    {
      const std::lock_guard lock(mutex_);
      stop_ = true;
      epoch_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    for (auto& thread : workers_) thread.join();
    workers_.clear();
    stop_ = false;
  }

  void worker() {
    std::uint64_t seen = 0;
    for (;;) {
      spin([&] { return epoch_.load(std::memory_order_acquire) != seen; });
      Job* job = nullptr;
      {
        std::unique_lock lock(mutex_);
        wake_.wait(lock, [&] { return stop_ || (job_ != nullptr && epoch_.load(std::memory_order_relaxed) != seen); });
        if (stop_) return;
        seen = epoch_.load(std::memory_order_relaxed);
        job = job_;
        active_.fetch_add(1, std::memory_order_relaxed);
      }
      job->work();
      // The job may die as soon as active_ is 0: touch only the pool afterwards.
      if (active_.fetch_sub(1, std::memory_order_acq_rel) == 1) {
        { const std::lock_guard lock(mutex_); }  // the caller is either before its test or already asleep
        done_.notify_one();
      }
    }
  }

  std::mutex owner_;  // held by the thread whose job runs
  std::atomic<int> threads_;
  bool closed_ = false;
  std::vector<std::thread> workers_;

  std::mutex mutex_;  // guards job_, stop_ and joining a job
  std::condition_variable wake_;
  std::condition_variable done_;
  Job* job_ = nullptr;
  bool stop_ = false;
  std::atomic<std::uint64_t> epoch_{0};
  std::atomic<int> active_{0};
};

// Leaked on purpose: sleeping workers of a dying process, and threads lost by fork(), must never see freed memory.
std::atomic<Pool*> current{nullptr};
std::mutex& create_mutex = *new std::mutex;

void before_fork() { create_mutex.lock(); }
void after_fork_parent() { create_mutex.unlock(); }
void after_fork_child() {
  // Worker threads do not exist in the child and the pool's locks may be held for ever: forget that pool.
  if (const Pool* lost = current.load()) current.store(new Pool(lost->threads()));
  inside = false;
  create_mutex.unlock();
}

struct CloseAtExit {
  ~CloseAtExit() {
#if !defined(_WIN32)  // joining while a DLL unloads would deadlock on the loader lock
    if (Pool* pool = current.load()) pool->close();
#endif
  }
};

Pool& pool() {
  if (Pool* existing = current.load(std::memory_order_acquire)) return *existing;
  const std::lock_guard lock(create_mutex);
  if (Pool* existing = current.load(std::memory_order_acquire)) return *existing;
  auto* fresh = new Pool(default_threads());
  static CloseAtExit close_at_exit;
#if defined(__unix__) || defined(__APPLE__)
  pthread_atfork(before_fork, after_fork_parent, after_fork_child);
#endif
  current.store(fresh, std::memory_order_release);
  return *fresh;
}

}  // namespace

namespace detail {

void parallel_run(std::size_t count, std::size_t grain, RangeFunction function, void* context) {
  if (count == 0) return;
  grain = std::max<std::size_t>(grain, 1);
  if (count <= grain || inside) return function(context, 0, count);
  Pool& shared = pool();
  if (shared.threads() == 1) return function(context, 0, count);
  Job job{function, context, count, grain, (count - 1) / grain + 1, {}, {}, {}};
  if (!shared.run(job)) return function(context, 0, count);
  if (job.error) std::rethrow_exception(job.error);
}

}  // namespace detail

int num_threads() { return pool().threads(); }

void set_num_threads(int n) {
  if (n < 1 || n > kMaxThreads) {
    throw std::invalid_argument("set_num_threads: expected 1 to " + std::to_string(kMaxThreads) + " threads, got " +
                                std::to_string(n));
  }
  if (inside) throw std::logic_error("set_num_threads: called from inside a parallel_for; call it before or after");
  pool().resize(n);
}

}  // namespace gsstream_cpu
