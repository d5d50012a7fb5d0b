// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// A network of linear layers with ReLU between them, forward and backward. A few rows at a time go through all layers,
// so that the numbers between two layers stay in the cache.
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

// Some columns of the input, or of its gradient: rows `stride` apart.
template <typename T>
struct Columns {
  T* data;  // null, of a gradient: not asked for
  std::int64_t stride, width;
};

// Columns of what `mlp` keeps for `mlp_backward`: the hidden layers side by side, each padded.
template <typename T>
std::int64_t mlp_hidden_columns(const std::vector<Layer<T>>& layers);

// Weights as the products of a pass take them: prepared once, and read by all parts of a batch. The layers must stay.
template <typename T>
struct ForwardWeights {
  explicit ForwardWeights(const std::vector<Layer<T>>& layers);

  const std::vector<Layer<T>>& layers;
  std::vector<std::int64_t> offsets;               // of each hidden layer's columns, then their number
  std::vector<std::vector<T>> transposed, biases;  // of each layer, padded
};

// Columns of the input, side by side, and whether their gradient is asked for.
struct MlpInput {
  std::int64_t width;
  bool wanted;
};

template <typename T>
struct BackwardWeights {
  BackwardWeights(const std::vector<Layer<T>>& layers, const std::vector<MlpInput>& inputs);

  const std::vector<Layer<T>>& layers;
  std::vector<std::int64_t> offsets;    // see ForwardWeights
  std::vector<std::vector<T>> weights;  // of each layer, the columns whose gradient is asked for, padded
  std::vector<std::int64_t> columns;    // of these
  // Of each layer in the sums of all rows: gradients by its weights (outputs, padded inputs), then by its biases
  // (padded outputs); then the number of sums.
  std::vector<std::int64_t> sums_at = {0};
  std::int64_t widest = 0;  // columns of a layer
};

// `inputs` side by side are the input (count, layers[0].inputs), `out` is (count, layers.back().outputs). `hidden`
// (count, mlp_hidden_columns) is null if there will be no gradient.
template <typename T>
void mlp(const ForwardWeights<T>& weights, const std::vector<Columns<const T>>& inputs, std::int64_t count, T* hidden,
         T* out, int num_threads);

// Gradients of (out . out_grad), all of them overwritten: by the weights and biases of each layer unless these are
// null, and by the inputs. Sums over rows are made in chunks that do not depend on the number of threads. Inputs that
// lie side by side in rows of a padded length are not copied.
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
