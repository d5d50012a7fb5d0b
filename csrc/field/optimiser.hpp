// Sparse optimiser steps on the rows of the feature matrix that a batch of points touches.
#pragma once

#include <cstdint>
#include <vector>

#include "field/level_tasks.hpp"
#include "field/point_batch.hpp"
#include "kernels/adam_kernels.hpp"
#include "lattice/vertex_table.hpp"

namespace radarsdf {

// One task (see level_tasks.hpp) of a step of Adam on the rows that batches touch, with the gradients that `scatter`
// would sum over the batches.
void adam_task(const VertexTable& table, const std::vector<PointBatch<float>>& batches,
               const std::vector<const float*>& grads, const std::vector<std::int64_t>& strides, const AdamStep& adam,
               LevelTask task);

}  // namespace radarsdf
