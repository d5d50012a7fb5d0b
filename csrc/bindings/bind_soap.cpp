#include <pybind11/stl.h>

#include <optional>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/held_thread_pool.hpp"
#include "bindings/subjects.hpp"
#include "field/soap.hpp"

namespace radarsdf {

void bind_soap(py::module_& m) {
  using namespace py::literals;
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
