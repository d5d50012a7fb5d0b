#pragma once

namespace radarsdf {

// While an instance lives, memory that is freed stays with the process for the next allocation. Otherwise the C library
// returns each large array to the system, which clears its pages anew for the next one: a third of the time of a quick
// fit of three million returns. The last instance returns what is free. No effect without glibc.
class KeptMemory {
 public:
  KeptMemory();
  ~KeptMemory();
  KeptMemory(const KeptMemory&) = delete;
  KeptMemory& operator=(const KeptMemory&) = delete;
};

}  // namespace radarsdf
