#include <doctest/doctest.h>

#include <algorithm>
#include <atomic>
#include <bitset>
#include <chrono>
#include <random>
#include <stdexcept>
#include <thread>
#include <vector>

#include "helpers.hpp"
#include "util/bits.hpp"
#include "util/large_array.hpp"
#include "util/parallel.hpp"
#include "util/random_bytes.hpp"
#include "util/sorting.hpp"
#include "util/thread_pool.hpp"

TEST_CASE("bit counts and positions equal those of std::bitset") {
  std::mt19937_64 generator(1);
  for (int i = 0; i < 10000; ++i) {
    const std::uint64_t bits = (generator() & generator() & generator()) << (i % 64);
    REQUIRE(radarsdf::count_bits(bits) == static_cast<int>(std::bitset<64>(bits).count()));
    if (bits == 0) continue;
    const int lowest = radarsdf::lowest_bit(bits);
    REQUIRE((bits >> lowest & 1) == 1);
    REQUIRE(bits % (std::uint64_t{1} << lowest) == 0);
  }
  CHECK(radarsdf::count_bits(~std::uint64_t{0}) == 64);
  CHECK(radarsdf::lowest_bit(std::uint64_t{1} << 63) == 63);
  CHECK(radarsdf::lowest_bit(std::uint32_t{1} << 31) == 31);
}

TEST_CASE("each task runs once") {
  for (const int threads : test::kThreads) {
    std::vector<std::atomic<int>> runs(1000);
    radarsdf::parallel_tasks(1000, threads, [&](std::int64_t i) { ++runs[i]; });
    CHECK(std::all_of(runs.begin(), runs.end(), [](const std::atomic<int>& n) { return n == 1; }));
    radarsdf::parallel_tasks(0, threads, [](std::int64_t) { FAIL("there is no task"); });
  }
}

TEST_CASE("a thread pool runs each task once, in consecutive jobs") {
  for (const int threads : {0, 1, 2, 5}) {
    radarsdf::ThreadPool pool(threads);
    std::vector<std::atomic<int>> runs(50);
    for (int job = 1; job <= 300; ++job) {
      const std::int64_t tasks = job % 51;
      pool.begin(tasks, [&](std::int64_t i) { ++runs[i]; });
      // In some jobs, the other threads are asleep.
      if (job % 100 == 0) std::this_thread::sleep_for(std::chrono::milliseconds(20));
      pool.finish();
      REQUIRE(std::all_of(runs.begin(), runs.begin() + tasks, [](const std::atomic<int>& n) { return n == 1; }));
      REQUIRE(std::all_of(runs.begin() + tasks, runs.end(), [](const std::atomic<int>& n) { return n == 0; }));
      for (std::atomic<int>& n : runs) n = 0;
    }
  }
}

TEST_CASE("a thread pool works while its caller is busy") {
  radarsdf::ThreadPool pool(2);
  std::atomic<bool> done{false};
  pool.begin(1, [&](std::int64_t) { done = true; });
  const auto until = std::chrono::steady_clock::now() + std::chrono::seconds(60);
  while (!done && std::chrono::steady_clock::now() < until) std::this_thread::yield();
  CHECK(done);
  CHECK_THROWS_AS(pool.begin(1, [](std::int64_t) {}), std::logic_error);
  pool.finish();
  pool.finish();  // no tasks
}

TEST_CASE("a thread pool rethrows the exception of a task, and stays usable") {
  for (const int threads : {1, 3}) {
    radarsdf::ThreadPool pool(threads);
    for (int job = 0; job < 20; ++job) {
      std::atomic<int> runs{0};
      CHECK_THROWS_AS(pool.run(1000,
                               [&](std::int64_t i) {
                                 ++runs;
                                 if (i == 3) throw std::runtime_error("no");
                                 std::this_thread::sleep_for(std::chrono::microseconds(50));
                               }),
                      std::runtime_error);
      CHECK(runs < 1000);
      std::atomic<int> after{0};
      pool.run(10, [&](std::int64_t) { ++after; });
      CHECK(after == 10);
    }
  }
}

TEST_CASE("a thread pool may be destroyed before its tasks are complete") {
  std::atomic<int> runs{0};
  {
    radarsdf::ThreadPool pool(3);
    pool.begin(1000, [&](std::int64_t) {
      ++runs;
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    });
  }
  const int at_end = runs;
  CHECK(at_end < 1000);
  std::this_thread::sleep_for(std::chrono::milliseconds(20));
  CHECK(runs == at_end);
}

TEST_CASE("random words equal SplitMix64, with a sequence for each row") {
  // The first numbers for the seed 1234567 in the authors' implementation.
  CHECK(radarsdf::random_word(1234567, 0) == 6457827717110365317u);
  CHECK(radarsdf::random_word(1234567, 1) == 3203168211198807973u);
  CHECK(radarsdf::random_word(1234567, 4) == 16408922859458223821u);
  radarsdf::RandomRows random(9, 11);
  const std::vector<std::uint8_t> third(random.row(2), random.row(2) + 11);
  const std::vector<std::uint8_t> first(random.row(0), random.row(0) + 11);
  CHECK(first != third);
  CHECK(third == std::vector<std::uint8_t>(random.row(2), random.row(2) + 11));
}

TEST_CASE("blocks partition a range and have bounded size") {
  for (const int threads : test::kThreads) {
    for (const std::int64_t size : {0, 1, 511, 512, 100000, 1 << 20}) {
      std::vector<std::atomic<int>> visits(size);
      std::atomic<std::int64_t> longest{0};
      radarsdf::parallel_blocks(size, 512, threads, [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t i = begin; i < end; ++i) ++visits[i];
        std::int64_t known = longest;
        while (known < end - begin && !longest.compare_exchange_weak(known, end - begin)) {
        }
      });
      CHECK(std::all_of(visits.begin(), visits.end(), [](const std::atomic<int>& n) { return n == 1; }));
      CHECK(longest <= 1 << 18);
    }
  }
}

TEST_CASE("chunks partition a range independent of the number of threads") {
  for (const int threads : test::kThreads) {
    for (const std::int64_t size : {0, 1, 9, 10, 11}) {
      std::vector<int> chunk_of(size, -1);
      radarsdf::parallel_chunks(size, 5, threads, [&](std::int64_t chunk, std::int64_t begin, std::int64_t end) {
        for (std::int64_t i = begin; i < end; ++i) chunk_of[i] = static_cast<int>(chunk);
      });
      for (std::int64_t i = 0; i < size; ++i) CHECK(chunk_of[i] == i / 5);
      CHECK(radarsdf::num_chunks(size, 5) == (size == 0 ? 0 : 1 + (size - 1) / 5));
    }
  }
}

TEST_CASE("radix_sort sorts by the upper bits and keeps the order of equal ones") {
  radarsdf::UninitialisedVector<std::uint64_t> keys;
  for (std::uint64_t i = 0; i < 20'000; ++i) keys.push_back(radarsdf::random_word(1, i % 9'000) >> 32 << 20 | i);
  auto expected = keys;  // the lower bits are the input order, so sorting all bits is stable
  std::sort(expected.begin(), expected.end());
  radarsdf::radix_sort(keys, 20, 52);
  CHECK(std::equal(keys.begin(), keys.end(), expected.begin(), expected.end()));
}

TEST_CASE("the exception of a task reaches the caller and cancels the other tasks") {
  for (const int threads : test::kThreads) {
    std::atomic<int> begun{0};
    const auto run = [&] {
      radarsdf::parallel_tasks(100000, threads, [&](std::int64_t) {
        ++begun;
        throw std::runtime_error("of a task");
      });
    };
    CHECK_THROWS_WITH_AS(run(), "of a task", std::runtime_error);
    CHECK(begun < 1000);
  }
}

TEST_CASE("an interrupt check can cancel a call, on the calling thread") {
  static std::atomic<int> asked;
  for (const int threads : test::kThreads) {
    asked = 0;
    radarsdf::set_interrupt_check([] {
      ++asked;
      throw std::runtime_error("interrupted");
    });
    const auto run = [&] {
      // Half a second on one thread: at most ten checks per second.
      radarsdf::parallel_tasks(500 * threads, threads, [](std::int64_t) {
        std::this_thread::sleep_for(std::chrono::milliseconds(1));
        radarsdf::check_interrupt();
      });
    };
    CHECK_THROWS_WITH_AS(run(), "interrupted", std::runtime_error);
    radarsdf::set_interrupt_check(nullptr);
    CHECK(asked == 1);
  }
}

TEST_CASE("parallel_sort sorts with any number of threads") {
  std::mt19937_64 generator(2);
  for (const std::size_t size : {std::size_t{0}, std::size_t{1}, std::size_t{1000}, std::size_t{300001}}) {
    std::vector<std::uint64_t> numbers(size);
    for (std::uint64_t& number : numbers) number = generator() >> 40;  // with duplicates
    std::vector<std::uint64_t> expected = numbers;
    std::sort(expected.begin(), expected.end());
    for (const int threads : test::kThreads) {
      std::vector<std::uint64_t> sorted = numbers;
      radarsdf::parallel_sort(sorted, threads);
      CHECK(sorted == expected);
    }
  }
}
