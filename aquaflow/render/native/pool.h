// A small persistent pool of threads with a static schedule.
//
// run(n, job) calls job(0) ... job(n - 1) once each. What a part computes depends on its number
// only, never on the thread that ran it, so results repeat bit for bit at a given n. Part k is
// offered to thread k, whose cache may still hold what it worked on before; the caller takes what
// no thread has begun when its own part is done, so that a machine busy with other programs costs
// no wait. When the pool is busy (another Python thread renders) the caller runs all parts itself,
// with the same result. A job whose parts draw their work from a counter must itself see to it that
// the result does not depend on who drew.
#pragma once

#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <mutex>
#include <new>
#include <thread>
#include <vector>

#include "simd.h"

namespace aq {

constexpr int kMaxThreads = 64;
constexpr int kSpinsBeforeSleep = 4000;  // about 50 us: longer than the gap between two stages

AQ_INLINE void spin_pause() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

class Pool {
 public:
  template <class Job>
  static void run(int parts, const Job& job) {
    if (parts > 1) {
      if (Pool* pool = instance()) {
        std::unique_lock<std::mutex> turn(pool->turn_, std::try_to_lock);
        if (turn.owns_lock() && pool->start(parts - 1, &call<Job>, &job)) {
          pool->attempt(0);
          for (int part = 1; part < parts; part++) pool->take(part, pool->round_);
          pool->finish();
          if (pool->failed_.exchange(false)) throw std::bad_alloc();
          return;
        }
      }
    }
    for (int part = 0; part < parts; part++) job(part);
  }

 private:
  using Call = void (*)(const void* job, int part);

  template <class Job>
  static void call(const void* job, int part) {
    (*static_cast<const Job*>(job))(part);
  }

  // Threads do not survive fork(): a child process gets a pool of its own, the parent's is left
  // alone. Null where there is no memory for it.
  static Pool* instance() {
    static std::mutex guard;
    static Pool* pool = nullptr;
    static pid_t owner = 0;
    std::lock_guard<std::mutex> lock(guard);
    if (owner != getpid()) {
      pool = new (std::nothrow) Pool();  // never freed: its threads may outlive static destruction
      if (pool) owner = getpid();
    }
    return pool;
  }

  bool start(int helpers, Call call, const void* job) {
    try {
      while ((int)threads_.size() < helpers) {
        const int number = (int)threads_.size() + 1;
        threads_.emplace_back([this, number, seen = round_.load()] { work(number, seen); });
        threads_.back().detach();
      }
    } catch (const std::exception&) {
      return false;  // no more threads or no memory for them: the caller runs all parts
    }
    call_ = call;
    job_ = job;
    unfinished_.store(helpers, std::memory_order_relaxed);
    const uint64_t round = round_ + 1;
    for (int part = 1; part <= helpers; part++)
      offered_[part].store(round, std::memory_order_release);
    {
      std::lock_guard<std::mutex> lock(sleep_);
      round_.store(round, std::memory_order_release);
    }
    wake_.notify_all();
    return true;
  }

  // Runs the part if it is still on offer in this round. A thread that wakes too late finds
  // nothing: the round does not end, and its job does not go away, before every part has been
  // taken.
  void take(int part, uint64_t round) {
    if (!offered_[part].compare_exchange_strong(round, 0, std::memory_order_acq_rel)) return;
    attempt(part);
    unfinished_.fetch_sub(1, std::memory_order_release);
  }

  // An exception must leave neither a thread (it would end the process) nor run() while others work
  // on the job. Kernels throw only when memory runs out.
  void attempt(int part) {
    try {
      call_(job_, part);
    } catch (const std::exception&) {
      failed_.store(true, std::memory_order_relaxed);
    }
  }

  void finish() {
    for (int spins = 0; unfinished_.load(std::memory_order_acquire) != 0; spins++) {
      if (spins < kSpinsBeforeSleep)
        spin_pause();
      else
        std::this_thread::yield();
    }
  }

  void work(int number, uint64_t seen) {
    for (;;) {
      for (int spins = 0; round_.load(std::memory_order_acquire) == seen; spins++) {
        if (spins < kSpinsBeforeSleep) {
          spin_pause();
          continue;
        }
        std::unique_lock<std::mutex> lock(sleep_);
        wake_.wait(lock, [&] { return round_.load(std::memory_order_acquire) != seen; });
      }
      seen = round_.load(std::memory_order_acquire);
      take(number, seen);
    }
  }

  std::mutex turn_, sleep_;
  std::condition_variable wake_;
  std::atomic<uint64_t> round_{0};
  std::atomic<uint64_t> offered_[kMaxThreads] = {};  // by part: the round it waits in, 0 once taken
  std::atomic<int> unfinished_{0};
  std::atomic<bool> failed_{false};
  std::vector<std::thread> threads_;
  Call call_ = nullptr;
  const void* job_ = nullptr;
};

// [begin, end) of part number `part` when `count` items are cut into `parts` runs of whole
// `grain`s.
AQ_INLINE int part_begin(int count, int grain, int parts, int part) {
  const int64_t grains = (count + grain - 1) / grain;
  const int64_t begin = grains * part / parts * grain;
  return begin < count ? (int)begin : count;
}

}  // namespace aq
