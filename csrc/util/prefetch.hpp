// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#pragma once

namespace radarsdf {

// Asks for a cache line that will be needed soon. Static: the kernels of each instruction set have a copy of their own.
static inline void prefetch(const void* address) {
#if defined(__GNUC__)
  __builtin_prefetch(address);
#else
  (void)address;
#endif
}

}  // namespace radarsdf
