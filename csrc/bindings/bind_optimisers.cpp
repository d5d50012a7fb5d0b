#include <pybind11/stl.h>

#include <optional>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/held_thread_pool.hpp"
#include "bindings/subjects.hpp"
#include "bindings/table_arrays.hpp"
#include "field/optimiser.hpp"
#include "field/soap.hpp"

namespace radarsdf {

void bind_optimisers(py::module_& m, VertexTableClass& table_class) {
  using Floats = Array<float>;
  using Integers = Array<std::int32_t>;
  using namespace py::literals;
  table_class.def(
      "begin_adam_step",
      [](const VertexTable& table, const Floats& points, const Integers& located, const Rows<float>& out_grad,
         Floats& features, Integers& states, const Floats& decays, std::int32_t step, double learning_rate,
         double epsilon, HeldThreadPool& pool) {
        check_shape(features, {table.num_rows(), kFeatureDim}, "features");
        check_shape(states, {table.num_rows(), sizeof(RowState) / sizeof(std::int32_t)}, "states");
        if (step < 1) throw std::invalid_argument("step must be at least 1");
        if (decays.ndim() != 2 || decays.shape(0) <= step || decays.shape(1) != 2)
          throw std::invalid_argument("decays must have shape (more than step, 2)");
        const PointBatch<float> batch = point_batch(table, points, located, std::optional<Floats>());
        const std::int64_t stride = row_stride(out_grad, batch.count, table.num_levels() * kFeatureDim, "out_grad");
        const float* grad = out_grad.data();
        const float* powers = decays.data();
        const AdamStep adam{features.mutable_data(),
                            reinterpret_cast<RowState*>(states.mutable_data()),
                            powers,
                            step,
                            static_cast<float>(learning_rate / (1 - static_cast<double>(powers[2 * step]))),
                            static_cast<float>(1 / (1 - static_cast<double>(powers[2 * step + 1]))),
                            static_cast<float>(epsilon)};
        pool.pool().begin(num_level_tasks(table), [&table, batch, grad, stride, adam](std::int64_t task) {
          adam_task(table, batch, grad, stride, adam, level_task(table, task));
        });
        pool.hold(py::make_tuple(py::cast(&table), points, located, out_grad, features, states, decays));
      },
      "points"_array, "located"_array, "out_grad"_array, "features"_array, "states"_array, "decays"_array, "step"_a,
      "learning_rate"_a, "epsilon"_a, "pool"_a,
      "Starts a step of Adam for the features touched by `points`, with gradients summed "
      "like `scatter`, on the other threads of `pool`; its `finish` waits for it. `states` (num_rows, 8) int32 "
      "are mean gradients in bfloat16 (4 numbers), their mean square as float32, the last step that updated the "
      "row, and zeros. `decays` (more than step, 2) are the powers of both betas.");
  m.def("soap_memory_size", &soap_memory_size, "rows"_a, "columns"_a,
        "Number of elements of SOAP's state of a matrix of weights.");
  m.def(
      "soap_step",
      [](std::vector<Array<float>>& weights, const std::vector<Array<float>>& gradients,
         std::vector<Array<float>>& memories, std::int64_t step, double learning_rate,
         std::optional<HeldThreadPool*> pool) {
        if (step < 1) throw std::invalid_argument("step must be at least 1");
        if (gradients.size() != weights.size() || memories.size() != weights.size()) {
          throw std::invalid_argument("there must be a gradient and a memory for each matrix of weights");
        }
        std::vector<SoapMatrix> matrices;
        for (std::size_t i = 0; i < weights.size(); ++i) {
          if (weights[i].ndim() != 2) throw std::invalid_argument("weights must be matrices");
          const std::int64_t rows = weights[i].shape(0), columns = weights[i].shape(1);
          check_shape(gradients[i], {rows, columns}, "gradients");
          check_shape(memories[i], {soap_memory_size(rows, columns)}, "memories");
          matrices.push_back(
              {weights[i].mutable_data(), gradients[i].data(), memories[i].mutable_data(), rows, columns});
        }
        const py::gil_scoped_release release;
        const auto move = [&](std::int64_t i) { soap_step(matrices[i], step, learning_rate); };
        const auto count = static_cast<std::int64_t>(matrices.size());
        if (pool) {
          (*pool)->pool().run(count, move);
        } else {
          for (std::int64_t i = 0; i < count; ++i) move(i);
        }
      },
      "weights"_array, "gradients"_array, "memories"_array, "step"_a, "learning_rate"_a, "pool"_a = py::none(),
      "Updates matrices of weights by step `step` >= 1 of SOAP. `memories`, the states of `soap_memory_size` elements "
      "each, are zero before the first step. The matrices are distributed to the threads of a `pool`.");
}

}  // namespace radarsdf
