// Large arrays in huge pages, as in NumPy. With small pages, page faults took a quarter of the time of a large mesh,
// and address translation a quarter of that of a look-up in a large map.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <new>
#include <utility>
#include <vector>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace radarsdf {

// Call before the memory is first written.
inline void ask_for_huge_pages([[maybe_unused]] void* memory, [[maybe_unused]] std::size_t num_bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  constexpr std::uintptr_t page = 4096;
  constexpr std::uintptr_t huge_page = std::uintptr_t{1} << 21;
  const auto begin = (reinterpret_cast<std::uintptr_t>(memory) + page - 1) / page * page;
  const auto end = reinterpret_cast<std::uintptr_t>(memory) + num_bytes;
  // Only a hint: it may fail on kernels without huge pages.
  if (begin + 2 * huge_page <= end) madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
#endif
}

// For results and scratch. Uninitialised on purpose: the caller writes every entry that is read, and clearing would
// cost a pass over memory.
template <typename T>
std::unique_ptr<T[]> large_array(std::int64_t size) {
  std::unique_ptr<T[]> array(new T[size]);
  ask_for_huge_pages(array.get(), sizeof(T) * size);
  return array;
}

template <typename T>
struct LargeAllocator : std::allocator<T> {
  template <typename U>
  struct rebind {
    using other = LargeAllocator<U>;
  };

  LargeAllocator() = default;
  template <typename U>
  LargeAllocator(const LargeAllocator<U>&) {}

  T* allocate(std::size_t size) {
    T* memory = std::allocator<T>::allocate(size);
    ask_for_huge_pages(memory, sizeof(T) * size);
    return memory;
  }
};

template <typename T>
using LargeVector = std::vector<T, LargeAllocator<T>>;

// Value-initialised elements of a vector stay uninitialised, so that threads can write them first: each then gets local
// pages from the system.
template <typename T>
struct UninitialisedAllocator : LargeAllocator<T> {
  template <typename U>
  struct rebind {
    using other = UninitialisedAllocator<U>;
  };

  UninitialisedAllocator() = default;
  template <typename U>
  UninitialisedAllocator(const UninitialisedAllocator<U>&) {}

  template <typename U>
  void construct(U*) noexcept {}
  template <typename U, typename... Arguments>
  void construct(U* at, Arguments&&... arguments) {
    ::new (static_cast<void*>(at)) U(std::forward<Arguments>(arguments)...);
  }
};

template <typename T>
using UninitialisedVector = std::vector<T, UninitialisedAllocator<T>>;

}  // namespace radarsdf
