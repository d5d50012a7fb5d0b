// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "mlp.hpp"

#include <algorithm>
#include <cstddef>

#include "instruction_set.hpp"
#include "parallel.hpp"
#include "product_kernels.hpp"

namespace radarsdf {
namespace {

constexpr std::int64_t kTile = 64;         // rows that go through all layers together
constexpr std::int64_t kMinRows = 512;     // for which a thread is woken
constexpr std::int64_t kPieceRows = 2048;  // whose gradients are summed before they are added to those of others
constexpr std::int64_t kMaxPieces = 16;

template <typename T>
constexpr T kOne = 1;

constexpr std::int64_t padded(std::int64_t columns) {
  return (columns + kColumnBlock - 1) / kColumnBlock * kColumnBlock;
}

// Of all layers, with zeros as columns up to a multiple of the vectors'.
template <typename T>
struct Padded {
  std::vector<std::vector<T>> weights, biases;
};

template <typename T>
Padded<T> transposed(const std::vector<Layer<T>>& layers) {
  Padded<T> result;
  for (const Layer<T>& layer : layers) {
    const std::int64_t columns = padded(layer.outputs);
    std::vector<T> weights(static_cast<std::size_t>(layer.inputs * columns)), biases(static_cast<std::size_t>(columns));
    for (std::int64_t n = 0; n < layer.outputs; ++n) {
      for (std::int64_t k = 0; k < layer.inputs; ++k) weights[k * columns + n] = layer.weights[n * layer.inputs + k];
    }
    std::copy_n(layer.biases, layer.outputs, biases.begin());
    result.weights.push_back(std::move(weights));
    result.biases.push_back(std::move(biases));
  }
  return result;
}

// Where each hidden layer's columns begin.
template <typename T>
std::vector<std::int64_t> hidden_offsets(const std::vector<Layer<T>>& layers) {
  std::vector<std::int64_t> offsets = {0};
  for (std::size_t i = 0; i + 1 < layers.size(); ++i) offsets.push_back(offsets.back() + padded(layers[i].outputs));
  return offsets;
}

// Rows [first, first + rows) of the inputs, side by side and padded.
template <typename T>
void gather(const std::vector<Columns<const T>>& inputs, std::int64_t first, std::int64_t rows, std::int64_t columns,
            T* tile) {
  for (std::int64_t r = 0; r < rows; ++r) {
    T* row = tile + r * columns;
    for (const Columns<const T>& input : inputs) {
      row = std::copy_n(input.data + (first + r) * input.stride, input.width, row);
    }
    std::fill(row, tile + (r + 1) * columns, T(0));
  }
}

}  // namespace

template <typename T>
std::int64_t mlp_hidden_columns(const std::vector<Layer<T>>& layers) {
  return hidden_offsets(layers).back();
}

template <typename T>
void mlp(const std::vector<Layer<T>>& layers, const std::vector<Columns<const T>>& inputs, std::int64_t count,
         T* hidden, T* out, int num_threads) {
  const ProductKernel<T> kernel = RADARSDF_KERNEL(product_kernel<T>)();
  const Padded<T> weights = transposed(layers);
  const std::vector<std::int64_t> offsets = hidden_offsets(layers);
  const std::int64_t hidden_columns = offsets.back(), outputs = layers.back().outputs;
  parallel_blocks(count, kMinRows, num_threads, [&](std::int64_t begin, std::int64_t end) {
    std::vector<T> scratch(static_cast<std::size_t>(hidden ? 0 : kTile * hidden_columns));
    std::vector<T> results(static_cast<std::size_t>(kTile * padded(outputs)));
    for (std::int64_t first = begin; first < end; first += kTile) {
      const std::int64_t rows = std::min(kTile, end - first);
      T* tile = hidden ? hidden + first * hidden_columns : scratch.data();
      for (std::size_t i = 0; i < layers.size(); ++i) {
        const bool last = i + 1 == layers.size();
        Product<T> product{};
        product.b_row = product.columns = padded(layers[i].outputs);
        product.c = last ? results.data() : tile + offsets[i];
        product.c_row = last ? product.columns : hidden_columns;
        product.rows = rows;
        if (i > 0) {
          product.a = tile + offsets[i - 1];
          product.a_row = hidden_columns;
          product.a_depth = 1;
          product.b = weights.weights[i].data();
          product.depth = layers[i].inputs;
          product.biases = weights.biases[i].data();
          product.rectify = !last;
          kernel.multiply(product);
          continue;
        }
        const T* b = weights.weights[0].data();
        for (std::size_t part = 0; part < inputs.size(); ++part) {
          product.a = inputs[part].data + first * inputs[part].stride;
          product.a_row = inputs[part].stride;
          product.a_depth = 1;
          product.b = b;
          product.depth = inputs[part].width;
          product.add = part > 0;
          product.biases = weights.biases[0].data();
          product.rectify = !last && part + 1 == inputs.size();
          kernel.multiply(product);
          b += product.depth * product.columns;
        }
      }
      for (std::int64_t r = 0; r < rows; ++r) {
        std::copy_n(results.data() + r * padded(outputs), outputs, out + (first + r) * outputs);
      }
    }
  });
}

template <typename T>
void mlp_backward(const std::vector<Layer<T>>& layers, const std::vector<Columns<const T>>& inputs, std::int64_t count,
                  const T* hidden, Columns<const T> out_grad, const std::vector<LayerGradients<T>>& layer_grads,
                  const std::vector<Columns<T>>& input_grads, int num_threads) {
  const ProductKernel<T> kernel = RADARSDF_KERNEL(product_kernel<T>)();
  const std::vector<std::int64_t> offsets = hidden_offsets(layers);
  const std::int64_t hidden_columns = offsets.back(), input_columns = padded(layers[0].inputs);
  const bool by_layers = std::any_of(layer_grads.begin(), layer_grads.end(),
                                     [](const LayerGradients<T>& g) { return g.weights || g.biases; });
  // Rows of weights as they are, padded; of the first layer the columns of those inputs alone whose gradient is asked
  // for.
  std::vector<std::vector<T>> weights;
  std::vector<std::int64_t> back_columns;
  for (std::size_t i = 0; i < layers.size(); ++i) {
    std::vector<Columns<const T>> parts;
    std::int64_t columns = 0, offset = 0;
    if (i > 0) {
      parts.push_back({layers[i].weights, layers[i].inputs, layers[i].inputs});
      columns = layers[i].inputs;
    } else {
      for (std::size_t part = 0; part < inputs.size(); ++part) {
        if (input_grads[part].data) {
          parts.push_back({layers[0].weights + offset, layers[0].inputs, inputs[part].width});
          columns += inputs[part].width;
        }
        offset += inputs[part].width;
      }
    }
    back_columns.push_back(padded(columns));
    weights.emplace_back(static_cast<std::size_t>(layers[i].outputs * padded(columns)));
    gather(parts, 0, layers[i].outputs, padded(columns), weights.back().data());
  }

  // Sums of each piece: for each layer (outputs, padded inputs) of weights, then the biases.
  std::vector<std::int64_t> sums_at = {0};
  for (const Layer<T>& layer : layers)
    sums_at.push_back(sums_at.back() + layer.outputs * padded(layer.inputs) + padded(layer.outputs));
  const std::int64_t pieces = std::clamp<std::int64_t>((count + kPieceRows - 1) / kPieceRows, 1, kMaxPieces);
  std::vector<T> sums(static_cast<std::size_t>(by_layers ? pieces * sums_at.back() : 0));
  parallel_tasks(pieces, num_threads, [&](std::int64_t piece) {
    const std::int64_t begin = count * piece / pieces, end = count * (piece + 1) / pieces;
    std::int64_t widest = 0;
    for (const Layer<T>& layer : layers) widest = std::max({widest, padded(layer.outputs), padded(layer.inputs)});
    std::vector<T> tile(static_cast<std::size_t>(by_layers ? kTile * input_columns : 0));
    std::vector<T> grads[2] = {std::vector<T>(static_cast<std::size_t>(kTile * widest)),
                               std::vector<T>(static_cast<std::size_t>(kTile * widest))};
    for (std::int64_t first = begin; first < end; first += kTile) {
      const std::int64_t rows = std::min(kTile, end - first);
      if (by_layers) gather(inputs, first, rows, input_columns, tile.data());
      const T* grad = out_grad.data + first * out_grad.stride;  // by the outputs of layer i
      std::int64_t grad_row = out_grad.stride;
      for (std::size_t i = layers.size(); i-- > 0;) {
        const Layer<T>& layer = layers[i];
        const T* before = i > 0 ? hidden + first * hidden_columns + offsets[i - 1] : tile.data();
        const std::int64_t before_row = i > 0 ? hidden_columns : input_columns;
        if (by_layers) {
          Product<T> product{};
          product.a = grad;
          product.a_row = 1;
          product.a_depth = grad_row;
          product.b = before;
          product.b_row = before_row;
          product.c = sums.data() + piece * sums_at.back() + sums_at[i];
          product.c_row = product.columns = padded(layer.inputs);
          product.rows = layer.outputs;
          product.depth = rows;
          product.add = true;
          kernel.multiply(product);
          T* biases = product.c + layer.outputs * product.columns;
          if (i + 1 < layers.size()) {  // columns are padded: sums of columns are a product with ones
            product.a = &kOne<T>;
            product.a_row = product.a_depth = 0;
            product.b = grad;
            product.b_row = grad_row;
            product.c = biases;
            product.rows = 1;
            product.columns = padded(layer.outputs);
            kernel.multiply(product);
          } else {
            for (std::int64_t r = 0; r < rows; ++r) {
              for (std::int64_t n = 0; n < layer.outputs; ++n) biases[n] += grad[r * grad_row + n];
            }
          }
        }
        if (back_columns[i] == 0) continue;
        Product<T> product{};
        product.a = grad;
        product.a_row = grad_row;
        product.a_depth = 1;
        product.b = weights[i].data();
        product.b_row = product.columns = product.c_row = back_columns[i];
        product.c = grads[i % 2].data();
        product.rows = rows;
        product.depth = layer.outputs;
        if (i > 0) {
          product.positive = before;
          product.positive_row = before_row;
        }
        kernel.multiply(product);
        grad = product.c;
        grad_row = product.c_row;
      }
      std::int64_t column = 0;
      for (const Columns<T>& wanted : input_grads) {
        if (!wanted.data) continue;
        for (std::int64_t r = 0; r < rows; ++r) {
          std::copy_n(grad + r * grad_row + column, wanted.width, wanted.data + (first + r) * wanted.stride);
        }
        column += wanted.width;
      }
    }
  });
  for (std::size_t i = 0; by_layers && i < layers.size(); ++i) {
    const Layer<T>& layer = layers[i];
    const std::int64_t columns = padded(layer.inputs);
    const T* biases = sums.data() + sums_at[i] + layer.outputs * columns;
    for (std::int64_t piece = 1; piece < pieces; ++piece) {
      const T* more = sums.data() + piece * sums_at.back();
      for (std::int64_t j = sums_at[i]; j < sums_at[i + 1]; ++j) sums[j] += more[j];
    }
    for (std::int64_t n = 0; layer_grads[i].weights && n < layer.outputs; ++n) {
      std::copy_n(sums.data() + sums_at[i] + n * columns, layer.inputs, layer_grads[i].weights + n * layer.inputs);
    }
    if (layer_grads[i].biases) std::copy_n(biases, layer.outputs, layer_grads[i].biases);
  }
}

#define RADARSDF_INSTANTIATE(T)                                                                                     \
  template std::int64_t mlp_hidden_columns(const std::vector<Layer<T>>&);                                           \
  template void mlp(const std::vector<Layer<T>>&, const std::vector<Columns<const T>>&, std::int64_t, T*, T*, int); \
  template void mlp_backward(const std::vector<Layer<T>>&, const std::vector<Columns<const T>>&, std::int64_t,      \
                             const T*, Columns<const T>, const std::vector<LayerGradients<T>>&,                     \
                             const std::vector<Columns<T>>&, int);
RADARSDF_INSTANTIATE(float)
RADARSDF_INSTANTIATE(double)
#undef RADARSDF_INSTANTIATE

}  // namespace radarsdf
