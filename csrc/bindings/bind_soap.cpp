#include <pybind11/stl.h>

#include <optional>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/held_thread_pool.hpp"
#include "bindings/subjects.hpp"
#include "field/soap.hpp"

namespace radarsdf {
namespace {

template <typename T>
void bind_step(py::module_& m) {
  using namespace py::literals;
  m.def(
      "soap_step",
      [](std::vector<Array<T>>& weights, const std::vector<Array<T>>& gradients, std::vector<Array<T>>& memories,
         std::int64_t step, double learning_rate, std::optional<HeldThreadPool*> pool) {
        if (step < 1) throw std::invalid_argument("step must be at least 1");
        if (gradients.size() != weights.size() || memories.size() != weights.size()) {
          throw std::invalid_argument("there must be a gradient and a memory for each matrix of weights");
        }
        std::vector<SoapMatrix<T>> matrices;
        for (std::size_t i = 0; i < weights.size(); ++i) {
          if (weights[i].ndim() != 2) throw std::invalid_argument("weights must be matrices");
          const std::int64_t rows = weights[i].shape(0), columns = weights[i].shape(1);
          check_shape(gradients[i], rows, columns, "gradients");
          if (check_column(memories[i], "memories") != soap_memory_size(rows, columns)) {
            throw std::invalid_argument("memories must have soap_memory_size numbers");
          }
          matrices.push_back(
              {weights[i].mutable_data(), gradients[i].data(), memories[i].mutable_data(), rows, columns});
        }
        const py::gil_scoped_release release;
        const auto move = [&](std::int64_t i) {
          soap_step(matrices[static_cast<std::size_t>(i)], step, learning_rate);
        };
        const auto count = static_cast<std::int64_t>(matrices.size());
        if (pool) {
          (*pool)->pool().run(count, move);
        } else {
          for (std::int64_t i = 0; i < count; ++i) move(i);
        }
      },
      "weights"_a.noconvert(), "gradients"_a.noconvert(), "memories"_a.noconvert(), "step"_a, "learning_rate"_a,
      "pool"_a = py::none(),
      "Updates matrices of weights by step `step` >= 1 of SOAP. `memories`, the states of `soap_memory_size` elements "
      "each, are zero before the first step. The matrices are distributed to the threads of a `pool`.");
}

}  // namespace

void bind_soap(py::module_& m) {
  m.def("soap_memory_size", &soap_memory_size, py::arg("rows"), py::arg("columns"),
        "Number of elements of SOAP's state of a matrix of weights.");
  bind_step<float>(m);
  bind_step<double>(m);
}

}  // namespace radarsdf
