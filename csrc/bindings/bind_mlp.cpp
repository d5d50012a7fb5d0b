#include <optional>

#include "bindings/layer_arrays.hpp"
#include "bindings/subjects.hpp"

namespace radarsdf {
namespace {

template <typename T>
std::vector<Columns<const T>> inputs_of(const std::vector<Rows<T>>& blocks, std::int64_t count,
                                        const std::vector<Layer<T>>& layers) {
  std::vector<Columns<const T>> inputs;
  std::int64_t width = 0;
  for (const Rows<T>& block : blocks) {
    if (block.ndim() != 2) throw std::invalid_argument("inputs must be matrices");
    inputs.push_back({block.data(), row_stride(block, count, block.shape(1), "inputs"), block.shape(1)});
    width += block.shape(1);
  }
  if (width != layers[0].inputs) throw std::invalid_argument("inputs must have as many columns as the first weights");
  return inputs;
}

template <typename T>
void bind_networks(py::module_& m) {
  using namespace py::literals;
  m.def(
      "mlp",
      [](const std::vector<Rows<T>>& blocks, const Arrays<T>& weights, const Arrays<T>& biases, Array<T>& out,
         bool keep_hidden, int num_threads) -> py::object {
        const std::vector<Layer<T>> layers = layers_of(weights, biases);
        const std::int64_t count = out.ndim() == 2 ? out.shape(0) : 0;
        check_shape(out, {count, layers.back().outputs}, "out");
        const auto inputs = inputs_of(blocks, count, layers);
        std::optional<Array<T>> hidden;
        if (keep_hidden) hidden.emplace(std::vector<std::int64_t>{count, mlp_hidden_columns(layers)});
        T* kept = hidden ? hidden->mutable_data() : nullptr;
        without_gil([&] { mlp(ForwardWeights<T>(layers), inputs, count, kept, out.mutable_data(), num_threads); });
        return hidden ? py::object(*hidden) : py::none();
      },
      "inputs"_array, "weights"_array, "biases"_array, "out"_array, "keep_hidden"_a, "num_threads"_a = 0,
      "Writes to `out` (N, outputs) the output of linear layers with ReLU activations for concatenated blocks of "
      "columns. Returns the hidden activations for `mlp_backward` if `keep_hidden`.");
  m.def(
      "mlp_backward",
      [](const std::vector<Rows<T>>& blocks, const Arrays<T>& weights, const Arrays<T>& biases, const Array<T>& hidden,
         const Rows<T>& out_grad, std::optional<Arrays<T>>& weight_grads, std::optional<Arrays<T>>& bias_grads,
         std::vector<std::optional<Rows<T>>>& input_grads, int num_threads) {
        const std::vector<Layer<T>> layers = layers_of(weights, biases);
        const std::int64_t count = hidden.ndim() == 2 ? hidden.shape(0) : 0;
        check_shape(hidden, {count, mlp_hidden_columns(layers)}, "hidden");
        const auto inputs = inputs_of(blocks, count, layers);
        if (weight_grads.has_value() != bias_grads.has_value()) {
          throw std::invalid_argument("gradients of weights and biases must be of all layers or of none");
        }
        std::vector<LayerGradients<T>> by_layers;
        if (weight_grads) by_layers = layer_gradients_of(*weight_grads, *bias_grads, layers);
        if (input_grads.size() != inputs.size()) {
          throw std::invalid_argument("there must be one of input_grads, or None, for each of the inputs");
        }
        std::vector<Columns<T>> by_inputs;
        std::vector<MlpInput> wanted;
        for (std::size_t i = 0; i < inputs.size(); ++i) {
          by_inputs.push_back({nullptr, 0, inputs[i].width});
          wanted.push_back({inputs[i].width, input_grads[i].has_value()});
          if (!input_grads[i]) continue;
          by_inputs[i].stride = row_stride(*input_grads[i], count, inputs[i].width, "input_grads");
          by_inputs[i].data = input_grads[i]->mutable_data();
        }
        const Columns<const T> grad{out_grad.data(), row_stride(out_grad, count, layers.back().outputs, "out_grad"),
                                    layers.back().outputs};
        const py::gil_scoped_release release;
        mlp_backward(BackwardWeights<T>(layers, wanted), inputs, count, hidden.data(), grad, by_layers, by_inputs,
                     num_threads);
      },
      "inputs"_array, "weights"_array, "biases"_array, "hidden"_array, "out_grad"_array, "weight_grads"_array,
      "bias_grads"_array, "input_grads"_array, "num_threads"_a = 0,
      "Writes the gradients of (mlp . out_grad) by weights and biases, unless these are None, and by the inputs that "
      "have a matrix in `input_grads`. `hidden` was returned by `mlp`.");
}

}  // namespace

void bind_mlp(py::module_& m) {
  bind_networks<float>(m);
  bind_networks<double>(m);
}

}  // namespace radarsdf
