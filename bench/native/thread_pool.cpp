#include "thread_pool.h"

#include <chrono>
#include <system_error>

#include <unistd.h>

namespace headbench {
namespace {

// How long a thread spins before it sleeps: about as long as the gaps between the kernels of a training iteration, as to
// sleep and to be woken takes longer than most of them.
constexpr std::chrono::microseconds kSpinTime{200};

void pause() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

template <typename Condition>
void spin_until(const Condition& condition) {
  const auto until = std::chrono::steady_clock::now() + kSpinTime;
  do {
    for (int turn = 0; turn < 16; ++turn) {
      if (condition()) return;
      pause();
    }
  } while (std::chrono::steady_clock::now() < until);
}

}  // namespace

ThreadPool& ThreadPool::instance() {
  // Never destroyed: at exit its threads sleep on a condition that must outlive them.
  static std::atomic<ThreadPool*> current{nullptr};
  const long process = getpid();
  ThreadPool* pool = current.load();
  while (!pool || pool->process_ != process) {
    ThreadPool* fresh = new ThreadPool(process);
    if (current.compare_exchange_strong(pool, fresh)) return *fresh;
    delete fresh;
  }
  return *pool;
}

void ThreadPool::run(std::int64_t tasks, int threads, const std::function<void(std::int64_t, int)>& body) {
  const int wanted = static_cast<int>(tasks < threads ? tasks : threads);
  std::unique_lock<std::mutex> alone(caller_, std::defer_lock);
  if (wanted <= 1 || !alone.try_lock()) {
    for (std::int64_t task = 0; task < tasks; ++task) body(task, 0);
    return;
  }
  {
    std::lock_guard<std::mutex> lock(mutex_);
    try {
      while (started_ < wanted - 1) {
        std::thread(&ThreadPool::work, this, started_ + 1).detach();
        ++started_;
      }
    } catch (const std::system_error&) {
      // The system gives no more threads; those that started do the work.
    }
    joining_ = started_ < wanted - 1 ? started_ : wanted - 1;
    body_ = &body;
    tasks_ = tasks;
    next_ = 0;
    open_ = true;
    ++job_;
  }
  wake_.notify_all();
  for (std::int64_t task; (task = next_.fetch_add(1)) < tasks;) body(task, 0);
  spin_until([this] { return busy_ == 0; });
  std::unique_lock<std::mutex> lock(mutex_);
  open_ = false;
  done_.wait(lock, [this] { return busy_ == 0; });
}

void ThreadPool::work(int worker) {
  std::uint64_t seen = 0;
  std::unique_lock<std::mutex> lock(mutex_);
  for (;;) {
    wake_.wait(lock, [&] { return open_ && job_ != seen; });
    seen = job_;
    if (worker > joining_) continue;
    ++busy_;
    const auto* body = body_;
    const std::int64_t tasks = tasks_;
    lock.unlock();
    for (std::int64_t task; (task = next_.fetch_add(1)) < tasks;) (*body)(task, worker);
    lock.lock();
    if (--busy_ == 0) done_.notify_one();
    lock.unlock();
    spin_until([&] { return job_ != seen; });
    lock.lock();
  }
}

}  // namespace headbench
