#include "util/kept_memory.hpp"

#include <mutex>

#ifdef __linux__
#include <malloc.h>
#endif

namespace radarsdf {
namespace {

std::mutex mutex;
int instances = 0;

#ifdef __GLIBC__
void keep() {
  mallopt(M_MMAP_MAX, 0);         // a mapping of its own, which large arrays usually have, ends with the array
  mallopt(M_TRIM_THRESHOLD, -1);  // unlimited
}

// The thresholds are those that glibc arrives at after the first large arrays. Once set, it no longer adjusts them.
void release() {
  constexpr int kLargestMmapThreshold = 32 << 20, kKept = 2 * kLargestMmapThreshold;
  mallopt(M_MMAP_MAX, 65536);  // the default
  mallopt(M_MMAP_THRESHOLD, kLargestMmapThreshold);
  mallopt(M_TRIM_THRESHOLD, kKept);
  if (mallinfo2().fordblks > kKept) malloc_trim(kKept);
}
#else
void keep() {}
void release() {}
#endif

}  // namespace

KeptMemory::KeptMemory() {
  const std::lock_guard<std::mutex> lock(mutex);
  if (instances++ == 0) keep();
}

KeptMemory::~KeptMemory() {
  const std::lock_guard<std::mutex> lock(mutex);
  if (--instances == 0) release();
}

}  // namespace radarsdf
