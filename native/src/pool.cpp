#include "pool.h"

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <thread>
#include <vector>

#if !defined(_WIN32)
#include <unistd.h>
#endif

namespace tgb {
namespace {

constexpr int kSpins = 500;  // a few tens of microseconds: stages of one frame follow each other closely

inline void cpu_pause() {
#if defined(__x86_64__) || defined(__i386__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

struct Job {
  TaskFunction function = nullptr;
  const void* context = nullptr;
  int tasks = 0;
  int helpers = 0;  // workers 0..helpers-1 take part
};

thread_local bool inside_task = false;

class Pool {
 public:
  void run(int threads, const Job& request) {
    std::lock_guard<std::mutex> one_job_at_a_time(busy_);
    grow(threads - 1);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      job_ = request;
      job_.helpers = threads - 1;
      next_ = 0;
      working_ = job_.helpers;
      generation_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    drain(request);
    while (working_.load(std::memory_order_acquire) > 0) std::this_thread::yield();
  }

 private:
  void grow(int helpers) {
    while (static_cast<int>(workers_.size()) < helpers) {
      const int id = static_cast<int>(workers_.size());
      workers_.emplace_back([this, id] { work(id); });
    }
  }

  void drain(const Job& job) {
    inside_task = true;
    for (int task; (task = next_.fetch_add(1, std::memory_order_relaxed)) < job.tasks;) job.function(job.context, task);
    inside_task = false;
  }

  void work(int id) {
    uint64_t seen = 0;
    for (;;) {
      for (int i = 0; i < kSpins && generation_.load(std::memory_order_acquire) == seen; i++) cpu_pause();
      Job job;
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return generation_.load(std::memory_order_relaxed) != seen; });
        seen = generation_.load(std::memory_order_relaxed);
        job = job_;
      }
      if (id >= job.helpers) continue;
      drain(job);
      working_.fetch_sub(1, std::memory_order_release);
    }
  }

  std::mutex busy_, mutex_;
  std::condition_variable wake_;
  std::vector<std::thread> workers_;
  std::atomic<uint64_t> generation_{0};
  std::atomic<int> next_{0}, working_{0};
  Job job_;
};

// The pool is never destroyed (joining threads at interpreter exit can hang) and is made anew after a fork,
// because threads do not survive one.
Pool& pool() {
  static std::mutex mutex;
  static Pool* instance = nullptr;
  std::lock_guard<std::mutex> lock(mutex);
#if !defined(_WIN32)
  static pid_t owner = 0;
  if (owner != getpid()) {
    owner = getpid();
    instance = nullptr;
  }
#endif
  if (instance == nullptr) instance = new Pool;
  return *instance;
}

}  // namespace

void run_tasks(int threads, int tasks, TaskFunction function, const void* context) {
  if (threads > tasks) threads = tasks;
  if (threads <= 1 || inside_task) {
    for (int task = 0; task < tasks; task++) function(context, task);
    return;
  }
  pool().run(threads, Job{function, context, tasks, 0});
}

}  // namespace tgb
