// A small pool of threads that spin for up to 0.2 ms between jobs and sleep after that.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <thread>

namespace headbench {

class ThreadPool {
 public:
  // The process's pool. A forked child gets a fresh one: threads do not survive a fork, and the locks of the
  // parent's pool may be held by nobody for ever, so that pool is left behind untouched.
  static ThreadPool& instance();

  // Call body(task, worker) for every task below `tasks`, worker below `threads`, and wait. Tasks are handed out
  // in order to whoever is free. Runs on the caller alone while another thread of the process uses the pool.
  // `body` must not throw.
  void run(std::int64_t tasks, int threads, const std::function<void(std::int64_t, int)>& body);

 private:
  explicit ThreadPool(long process) : process_(process) {}
  void work(int worker);

  const long process_;
  std::mutex caller_;  // held while a job runs
  std::mutex mutex_;   // guards what follows
  std::condition_variable wake_, done_;
  const std::function<void(std::int64_t, int)>* body_ = nullptr;
  std::atomic<std::uint64_t> job_{0};
  int started_ = 0;  // workers in existence, numbered from 1
  int joining_ = 0;  // workers with a number up to this one take part
  std::atomic<int> busy_{0};  // workers at the job; those that wake up after its last task was taken are not waited for
  bool open_ = false;  // whether workers may still begin with the job
  std::int64_t tasks_ = 0;
  std::atomic<std::int64_t> next_{0};
};

}  // namespace headbench
