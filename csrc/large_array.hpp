// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Memory for results and scratch of many megabytes. It is uninitialised on purpose: the caller writes every entry that
// is read, and clearing first would cost a pass over memory. It asks for huge pages, as NumPy's arrays do: a quarter of
// the time of a large mesh went into faults of small ones.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace radarsdf {

template <typename T>
std::unique_ptr<T[]> large_array(std::int64_t size) {
  std::unique_ptr<T[]> array(new T[static_cast<std::size_t>(size)]);
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  constexpr std::uintptr_t page = 4096;
  constexpr std::uintptr_t huge_page = std::uintptr_t{1} << 21;
  const auto begin = (reinterpret_cast<std::uintptr_t>(array.get()) + page - 1) / page * page;
  const auto end = reinterpret_cast<std::uintptr_t>(array.get() + size);
  // Only a hint: it may fail where the kernel knows no huge pages.
  if (begin + 2 * huge_page <= end) madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
#endif
  return array;
}

}  // namespace radarsdf
