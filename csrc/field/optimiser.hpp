// Sparse optimiser steps on the rows of the feature matrix that a batch of points touches.
#pragma once

#include <cstdint>

#include "field/level_tasks.hpp"
#include "field/point_batch.hpp"
#include "kernels/adam_kernels.hpp"
#include "lattice/vertex_table.hpp"

namespace radarsdf {

// One task (see level_tasks.hpp) of a step of Adam on the rows that a batch touches, with the gradients that `scatter`
// would sum.
void adam_task(const VertexTable& table, const PointBatch<float>& batch, const float* out_grad, std::int64_t stride,
               const AdamStep& adam, LevelTask task);

}  // namespace radarsdf
