#include "field/optimiser.hpp"

#include <algorithm>

#include "kernels/interpolation_kernels.hpp"
#include "util/instruction_set.hpp"

namespace radarsdf {

void adam_task(const VertexTable& table, const std::vector<PointBatch<float>>& batches,
               const std::vector<const float*>& grads, const std::vector<std::int64_t>& strides, const AdamStep& adam,
               LevelTask task) {
  const InterpolationKernels<float>& kernels = RADARSDF_KERNEL(interpolation_kernels<float>)(table.encoding());
  std::int64_t points = 0;
  for (const PointBatch<float>& batch : batches) points += batch.count;
  // Reused between calls: page faults of a new allocation would cost as much as the sums.
  thread_local std::vector<std::int32_t> rows;
  thread_local std::vector<float> sums;  // zero between calls
  const auto most =
      static_cast<std::size_t>(std::min(points * corners_per_group(table.encoding()), table.num_rows())) + 1;
  if (rows.size() < most) rows.resize(most);
  if (sums.size() < most * kFeatureDim) sums.resize(most * kFeatureDim);
  RowSums<float> touched{adam.states, rows.data(), sums.data(), 0};
  for (std::size_t b = 0; b < batches.size(); ++b) {
    kernels.scatter_rows(interpolation(table, batches[b]), grads[b], strides[b], touched, task.level, task.group, 0,
                         batches[b].count);
  }
  RADARSDF_KERNEL(adam_kernel)().move(adam, touched.rows, touched.sums, touched.count);
}

}  // namespace radarsdf
