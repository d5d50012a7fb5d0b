// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Steps of an optimiser on the rows of the feature matrix that a batch of points touches.
#pragma once

#include <atomic>
#include <cstdint>
#include <vector>

#include "field/point_batch.hpp"
#include "kernels/adam_kernels.hpp"
#include "lattice/vertex_table.hpp"

namespace radarsdf {

// Hands out the numbers 0, 1, 2 and so on, each once. With it, threads of the caller share the tasks of one step.
class TaskQueue {
 public:
  int take() { return next_.fetch_add(1, std::memory_order_relaxed); }

 private:
  std::atomic<int> next_{0};
};

// One step of Adam with the gradients that `scatter` would sum over the batches, on the rows that they touch: on those
// (level, group) pairs that no other call with the same queue has begun.
template <typename T>
void adam_step(const VertexTable& table, const std::vector<PointBatch<T>>& batches, const std::vector<const T*>& grads,
               const std::vector<std::int64_t>& strides, const AdamStep<T>& adam, TaskQueue& queue);

}  // namespace radarsdf
