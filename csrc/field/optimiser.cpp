#include "field/optimiser.hpp"

#include <algorithm>
#include <vector>

#include "kernels/interpolation_kernels.hpp"
#include "util/instruction_set.hpp"

namespace radarsdf {

void adam_task(const VertexTable& table, const PointBatch<float>& batch, const float* out_grad, std::int64_t stride,
               const AdamStep& adam, LevelTask task) {
  const InterpolationKernels<float>& kernels = RADARSDF_KERNEL(interpolation_kernels<float>)(table.encoding());
  // Reused between calls: page faults of a new allocation would cost as much as the sums.
  thread_local std::vector<std::int32_t> rows;
  thread_local std::vector<float> sums;  // zero between calls
  const std::size_t most = std::min(batch.count * corners_per_group(table.encoding()), table.num_rows()) + 1;
  if (rows.size() < most) rows.resize(most);
  if (sums.size() < most * kFeatureDim) sums.resize(most * kFeatureDim);
  RowSums<float> touched{adam.states, rows.data(), sums.data(), 0};
  kernels.scatter_rows(interpolation(table, batch), out_grad, stride, touched, task.level, task.group, 0, batch.count);
  RADARSDF_KERNEL(adam_kernel)().move(adam, touched.rows, touched.sums, touched.count);
}

}  // namespace radarsdf
