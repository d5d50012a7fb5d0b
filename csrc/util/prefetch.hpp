#pragma once

namespace radarsdf {

// Prefetches a cache line. Static: the kernels of each instruction set need a copy of their own.
static inline void prefetch(const void* address) {
#if defined(__GNUC__)
  __builtin_prefetch(address);
#else
  (void)address;
#endif
}

}  // namespace radarsdf
