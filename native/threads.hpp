// Running numbered tasks on a few threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <thread>
#include <type_traits>
#include <vector>

namespace holo {

// Calls `work(task)` for task = 0 … tasks - 1 on up to `threads` threads, the caller's among them; or
// `work(task, thread)` if it takes the number of the thread, 0 … threads - 1, for memory that its tasks use in turn.
// Which thread does which task is left to chance: a task must write only what no other task writes.
// Threads sleep when they are done; a busy wait would steal time from whoever shares the cores.
// An exception in any task ends the others soon and is thrown again here.
template <class Work>
void parallel(int64_t tasks, int64_t threads, const Work& work) {
  std::atomic<int64_t> next{0};
  std::atomic<bool> failed{false};
  std::exception_ptr failure;
  const auto loop = [&](int64_t thread) {
    try {
      for (int64_t task = next++; task < tasks; task = next++) {
        if constexpr (std::is_invocable_v<Work, int64_t, int64_t>) {
          work(task, thread);
        } else {
          work(task);
        }
      }
    } catch (...) {
      next = tasks;
      if (!failed.exchange(true)) failure = std::current_exception();
    }
  };
  std::vector<std::thread> helpers;
  helpers.reserve(static_cast<size_t>(std::max<int64_t>(0, threads)));
  try {
    for (int64_t k = 1; k < std::min(tasks, threads); ++k) helpers.emplace_back(loop, k);
  } catch (const std::exception&) {
    // No more threads to be had, or no memory for one: those that started do it all.
  }
  loop(0);
  for (auto& helper : helpers) helper.join();
  if (failure) std::rethrow_exception(failure);
}

// As `parallel`, over the numbers 0 … count - 1 in runs [first, last) of `length`, but for the last.
template <class Work>
void parallel_equal_runs(int64_t count, int64_t length, int64_t threads, const Work& work) {
  parallel((count + length - 1) / length, threads, [&](int64_t run) {
    work(run * length, std::min(count, (run + 1) * length));
  });
}

// The same, in runs of at most `longest`: short enough to keep all threads busy to the end, long enough to share what
// a run's numbers have in common.
template <class Work>
void parallel_runs(int64_t count, int64_t longest, int64_t threads, const Work& work) {
  parallel_equal_runs(count, std::clamp<int64_t>(count / (8 * threads), 1, longest), threads, work);
}

// Runs `work` for a C caller, to whom no exception may pass: 0, or 1 if it failed (only memory can run out).
template <class Work>
int64_t guarded(const Work& work) {
  try {
    work();
    return 0;
  } catch (...) {
    return 1;
  }
}

}  // namespace holo
