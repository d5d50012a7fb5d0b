// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <optional>
#include <tuple>
#include <vector>

#include "bindings/held_thread_pool.hpp"
#include "bindings/subjects.hpp"
#include "bindings/table_arrays.hpp"
#include "field/optimiser.hpp"

namespace radarsdf {
namespace {

template <typename T>
void bind_adam(VertexTableClass& cls) {
  using Located = Array<std::int32_t>;
  using namespace py::literals;
  cls.def(
      "begin_adam_step",
      [](const VertexTable& table, const std::vector<std::tuple<Array<T>, Located, Rows<T>>>& batches,
         Array<T>& features, Array<T>& moments, Located& marks, const Array<T>& decays, std::int32_t step,
         double learning_rate, double epsilon, HeldThreadPool& pool) {
        const std::int64_t rows = table.num_rows();
        check_features(table, features);
        check_shape(moments, rows, 2 * kFeatureDim, "moments");
        check_shape(marks, rows, 2, "marks");
        if (step < 1) throw std::invalid_argument("step must be at least 1");
        if (decays.ndim() != 2 || decays.shape(0) <= step || decays.shape(1) != 2)
          throw std::invalid_argument("decays must have shape (more than step, 2)");
        std::vector<PointBatch<T>> points;
        std::vector<const T*> grads;
        std::vector<std::int64_t> strides;
        for (const auto& [batch_points, located, out_grad] : batches) {
          points.push_back(point_batch(table, batch_points, located, std::optional<Array<T>>()));
          check_shape(out_grad, points.back().count, table.num_levels() * kFeatureDim, "out_grad");
          grads.push_back(out_grad.data());
          strides.push_back(row_stride(out_grad, "out_grad"));
        }
        const T* powers = decays.data();
        const AdamStep<T> adam{features.mutable_data(),
                               moments.mutable_data(),
                               reinterpret_cast<RowMark*>(marks.mutable_data()),
                               powers,
                               step,
                               static_cast<T>(learning_rate / (1 - static_cast<double>(powers[2 * step]))),
                               static_cast<T>(1 / (1 - static_cast<double>(powers[2 * step + 1]))),
                               static_cast<T>(epsilon)};
        pool.pool().begin(num_level_tasks(table), [&table, points, grads, strides, adam](std::int64_t task) {
          adam_task(table, points, grads, strides, adam, level_task(table, task));
        });
        pool.hold(py::make_tuple(py::cast(&table), batches, features, moments, marks, decays));
      },
      "batches"_a, "features"_a.noconvert(), "moments"_a.noconvert(), "marks"_a.noconvert(), "decays"_a.noconvert(),
      "step"_a, "learning_rate"_a, "epsilon"_a, "pool"_a,
      "Starts a step of Adam for the features touched by batches of (points, located, out_grad), with gradients summed "
      "like `scatter`, on the other threads of `pool`; its `finish` waits for it. The state is `moments` (num_rows, "
      "16) and `marks` (num_rows, 2) int32: the last step that updated a row, and a zero. `decays` (more than step, 2) "
      "are the powers of both betas.");
}

}  // namespace

void bind_optimiser(VertexTableClass& table) {
  bind_adam<float>(table);
  bind_adam<double>(table);
}

}  // namespace radarsdf
