// Multi-layer perceptron with ReLU, forward and backward. A few rows at a time go through all layers, so that
// activations stay in the cache.
#pragma once

#include <cstdint>
#include <vector>

namespace radarsdf {

template <typename T>
struct Layer {
  const T* weights;  // (outputs, inputs)
  const T* biases;   // (outputs)
  std::int64_t inputs, outputs;
};

// Columns of the input, or of its gradient: rows `stride` apart.
template <typename T>
struct Columns {
  T* data;  // null: gradient not requested
  std::int64_t stride, width;
};

// Number of columns of the activations that `mlp` stores for `mlp_backward`: all hidden layers, each padded.
template <typename T>
std::int64_t mlp_hidden_columns(const std::vector<Layer<T>>& layers);

// Weights in the layout of the product kernels: prepared once, and read by all parts of a batch. Refers to `layers`.
template <typename T>
struct ForwardWeights {
  explicit ForwardWeights(const std::vector<Layer<T>>& layers);

  const std::vector<Layer<T>>& layers;
  std::vector<std::int64_t> offsets;               // first column of each hidden layer, and the end
  std::vector<std::vector<T>> transposed, biases;  // by layer, padded
};

// A block of input columns, and whether its gradient is requested.
struct MlpInput {
  std::int64_t width;
  bool wanted;
};

template <typename T>
struct BackwardWeights {
  BackwardWeights(const std::vector<Layer<T>>& layers, const std::vector<MlpInput>& inputs);

  const std::vector<Layer<T>>& layers;
  std::vector<std::int64_t> offsets;    // see ForwardWeights
  std::vector<std::vector<T>> weights;  // by layer, columns with a requested gradient, padded
  std::vector<std::int64_t> columns;    // number of these columns
  // Offset of each layer in the sums over rows: gradients by its weights (outputs, padded inputs), then by its biases
  // (padded outputs); and the end.
  std::vector<std::int64_t> sums_at = {0};
  std::int64_t widest = 0;  // largest number of columns of a layer
};

// Evaluates the network on the concatenated `inputs` (count, layers[0].inputs); `out` is (count,
// layers.back().outputs). `hidden` (count, mlp_hidden_columns) is null without a backward pass.
template <typename T>
void mlp(const ForwardWeights<T>& weights, const std::vector<Columns<const T>>& inputs, std::int64_t count, T* hidden,
         T* out, int num_threads);

// Overwrites the gradients of (out . out_grad) by the weights and biases of each layer, unless these are null, and by
// the inputs. Rows are summed in chunks independent of the number of threads. Inputs that are adjacent columns of one
// matrix with padded rows are not copied.
template <typename T>
struct LayerGradients {
  T* weights;
  T* biases;
};
template <typename T>
void mlp_backward(const BackwardWeights<T>& weights, const std::vector<Columns<const T>>& inputs, std::int64_t count,
                  const T* hidden, Columns<const T> out_grad, const std::vector<LayerGradients<T>>& layer_grads,
                  const std::vector<Columns<T>>& input_grads, int num_threads);

}  // namespace radarsdf
