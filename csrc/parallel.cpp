// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "parallel.hpp"

#ifdef _OPENMP
#include <omp.h>
#endif

namespace radarsdf {

int resolve_num_threads(int num_threads) {
#ifdef _OPENMP
  // Where the system refuses a thread, OpenMP ends the whole program.
  constexpr int kMaxThreads = 1024;
  return num_threads > 0 ? std::min(num_threads, kMaxThreads) : omp_get_max_threads();
#else
  (void)num_threads;
  return 1;
#endif
}

}  // namespace radarsdf
