// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "field/mlp.hpp"

#include <algorithm>
#include <cstddef>

#include "field/padding.hpp"
#include "kernels/product_kernels.hpp"
#include "util/instruction_set.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr std::int64_t kTile = 64;         // rows that go through all layers together
constexpr std::int64_t kMinRows = 512;     // that are worth waking a thread for
constexpr std::int64_t kChunkRows = 2048;  // that are summed together; then the sums of the chunks are added
constexpr std::int64_t kMaxChunks = 16;

template <typename T>
constexpr T kOne = 1;

template <typename T>
std::vector<T> zeros(std::int64_t size) {
  return std::vector<T>(static_cast<std::size_t>(size));
}

// Where each hidden layer's columns begin, and how many there are.
template <typename T>
std::vector<std::int64_t> hidden_offsets(const std::vector<Layer<T>>& layers) {
  std::vector<std::int64_t> offsets = {0};
  for (std::size_t i = 0; i + 1 < layers.size(); ++i) offsets.push_back(offsets.back() + padded(layers[i].outputs));
  return offsets;
}

// Rows [first, first + rows) of matrices side by side, with zeros up to `columns`.
template <typename T>
void gather(const std::vector<Columns<const T>>& matrices, std::int64_t first, std::int64_t rows, std::int64_t columns,
            T* tile) {
  for (std::int64_t r = 0; r < rows; ++r) {
    T* row = tile + r * columns;
    for (const Columns<const T>& matrix : matrices) {
      row = std::copy_n(matrix.data + (first + r) * matrix.stride, matrix.width, row);
    }
    std::fill(row, tile + (r + 1) * columns, T(0));
  }
}

template <typename T>
class Forward {
 public:
  Forward(const std::vector<Layer<T>>& layers, const std::vector<Columns<const T>>& inputs)
      : layers_(layers), inputs_(inputs), offsets_(hidden_offsets(layers)) {
    for (const Layer<T>& layer : layers) {
      const std::int64_t columns = padded(layer.outputs);
      weights_.push_back(zeros<T>(layer.inputs * columns));
      biases_.push_back(zeros<T>(columns));
      for (std::int64_t n = 0; n < layer.outputs; ++n) {
        for (std::int64_t k = 0; k < layer.inputs; ++k) {
          weights_.back()[k * columns + n] = layer.weights[n * layer.inputs + k];
        }
      }
      std::copy_n(layer.biases, layer.outputs, biases_.back().begin());
    }
  }

  // Rows [first, first + rows) into `hidden` (rows, hidden columns) and `results` (rows, padded outputs).
  void tile(std::int64_t first, std::int64_t rows, T* hidden, T* results) const {
    for (std::size_t i = 0; i < layers_.size(); ++i) {
      const bool last = i + 1 == layers_.size();
      Product<T> product{};
      product.a_depth = 1;
      product.b = weights_[i].data();
      product.b_row = product.columns = padded(layers_[i].outputs);
      product.c = last ? results : hidden + offsets_[i];
      product.c_row = last ? product.columns : offsets_.back();
      product.rows = rows;
      product.biases = biases_[i].data();
      if (i > 0) {
        product.a = hidden + offsets_[i - 1];
        product.a_row = offsets_.back();
        product.depth = layers_[i].inputs;
        product.rectify = !last;
        kernel_.multiply(product);
        continue;
      }
      for (std::size_t part = 0; part < inputs_.size(); ++part) {
        product.a = inputs_[part].data + first * inputs_[part].stride;
        product.a_row = inputs_[part].stride;
        product.depth = inputs_[part].width;
        product.add = part > 0;
        product.rectify = !last && part + 1 == inputs_.size();
        kernel_.multiply(product);
        product.b += product.depth * product.columns;
      }
    }
  }

 private:
  const std::vector<Layer<T>>& layers_;
  const std::vector<Columns<const T>>& inputs_;
  std::vector<std::int64_t> offsets_;
  std::vector<std::vector<T>> weights_, biases_;  // of each layer: transposed; both padded
  ProductKernel<T> kernel_ = RADARSDF_KERNEL(product_kernel<T>)();
};

template <typename T>
class Backward {
 public:
  Backward(const std::vector<Layer<T>>& layers, const std::vector<Columns<const T>>& inputs, const T* hidden,
           Columns<const T> out_grad, const std::vector<Columns<T>>& input_grads, bool by_layers)
      : layers_(layers),
        inputs_(inputs),
        hidden_(hidden),
        out_grad_(out_grad),
        input_grads_(input_grads),
        by_layers_(by_layers),
        offsets_(hidden_offsets(layers)) {
    for (std::size_t i = 0; i < layers.size(); ++i) {
      const Layer<T>& layer = layers[i];
      std::vector<Columns<const T>> wanted;  // columns of the weights, one for each input whose gradient is asked for
      std::int64_t columns = 0, offset = 0;
      for (std::size_t part = 0; part < (i == 0 ? inputs.size() : 1); ++part) {
        const std::int64_t width = i == 0 ? inputs[part].width : layer.inputs;
        if (i > 0 || input_grads[part].data) {
          wanted.push_back({layer.weights + offset, layer.inputs, width});
          columns += width;
        }
        offset += width;
      }
      columns_.push_back(padded(columns));
      weights_.push_back(zeros<T>(layer.outputs * columns_.back()));
      gather(wanted, 0, layer.outputs, columns_.back(), weights_.back().data());
      sums_at_.push_back(sums_at_.back() + layer.outputs * padded(layer.inputs) + padded(layer.outputs));
      widest_ = std::max({widest_, padded(layer.outputs), padded(layer.inputs)});
    }
  }

  // Numbers in the sums of all rows: of each layer the gradients by its weights (outputs, padded inputs), then by its
  // biases (padded outputs).
  std::int64_t num_sums() const { return sums_at_.back(); }
  std::int64_t sums_at(std::size_t layer) const { return sums_at_[layer]; }

  // Adds those of rows [begin, end) to `sums`, and writes the gradients by the inputs.
  void rows(std::int64_t begin, std::int64_t end, T* sums) const {
    std::vector<T> inputs = zeros<T>(by_layers_ ? kTile * padded(layers_[0].inputs) : 0);
    std::vector<T> grads[2] = {zeros<T>(kTile * widest_), zeros<T>(kTile * widest_)};
    for (std::int64_t first = begin; first < end; first += kTile) {
      tile(first, std::min(kTile, end - first), inputs.data(), grads, sums);
    }
  }

 private:
  void tile(std::int64_t first, std::int64_t rows, T* inputs, std::vector<T> (&grads)[2], T* sums) const {
    const std::int64_t input_columns = padded(layers_[0].inputs);
    if (by_layers_) gather(inputs_, first, rows, input_columns, inputs);
    const T* grad = out_grad_.data + first * out_grad_.stride;  // by the outputs of layer i
    std::int64_t grad_row = out_grad_.stride;
    for (std::size_t i = layers_.size(); i-- > 0;) {
      const T* before = i > 0 ? hidden_ + first * offsets_.back() + offsets_[i - 1] : inputs;
      const std::int64_t before_row = i > 0 ? offsets_.back() : input_columns;
      if (by_layers_) add_layer(i, rows, grad, grad_row, before, before_row, sums + sums_at_[i]);
      if (columns_[i] == 0) return;
      Product<T> product{};
      product.a = grad;
      product.a_row = grad_row;
      product.a_depth = 1;
      product.b = weights_[i].data();
      product.b_row = product.columns = product.c_row = columns_[i];
      product.c = grads[i % 2].data();
      product.rows = rows;
      product.depth = layers_[i].outputs;
      if (i > 0) {
        product.positive = before;
        product.positive_row = before_row;
      }
      kernel_.multiply(product);
      grad = product.c;
      grad_row = product.c_row;
    }
    std::int64_t column = 0;
    for (const Columns<T>& wanted : input_grads_) {
      if (!wanted.data) continue;
      for (std::int64_t r = 0; r < rows; ++r) {
        std::copy_n(grad + r * grad_row + column, wanted.width, wanted.data + (first + r) * wanted.stride);
      }
      column += wanted.width;
    }
  }

  void add_layer(std::size_t i, std::int64_t rows, const T* grad, std::int64_t grad_row, const T* before,
                 std::int64_t before_row, T* sums) const {
    const Layer<T>& layer = layers_[i];
    Product<T> product{};
    product.a = grad;
    product.a_row = 1;
    product.a_depth = grad_row;
    product.b = before;
    product.b_row = before_row;
    product.c = sums;
    product.c_row = product.columns = padded(layer.inputs);
    product.rows = layer.outputs;
    product.depth = rows;
    product.add = true;
    kernel_.multiply(product);
    T* biases = sums + layer.outputs * product.columns;
    if (i + 1 < layers_.size()) {  // columns are padded: their sums are a product with ones
      product.a = &kOne<T>;
      product.a_row = product.a_depth = 0;
      product.b = grad;
      product.b_row = grad_row;
      product.c = biases;
      product.rows = 1;
      product.columns = padded(layer.outputs);
      kernel_.multiply(product);
      return;
    }
    for (std::int64_t r = 0; r < rows; ++r) {
      for (std::int64_t n = 0; n < layer.outputs; ++n) biases[n] += grad[r * grad_row + n];
    }
  }

  const std::vector<Layer<T>>& layers_;
  const std::vector<Columns<const T>>& inputs_;
  const T* hidden_;
  Columns<const T> out_grad_;
  const std::vector<Columns<T>>& input_grads_;
  bool by_layers_;
  std::vector<std::int64_t> offsets_, columns_, sums_at_ = {0};
  std::vector<std::vector<T>> weights_;  // of each layer, the columns whose gradient is asked for, padded
  std::int64_t widest_ = 0;
  ProductKernel<T> kernel_ = RADARSDF_KERNEL(product_kernel<T>)();
};

}  // namespace

template <typename T>
std::int64_t mlp_hidden_columns(const std::vector<Layer<T>>& layers) {
  return hidden_offsets(layers).back();
}

template <typename T>
void mlp(const std::vector<Layer<T>>& layers, const std::vector<Columns<const T>>& inputs, std::int64_t count,
         T* hidden, T* out, int num_threads) {
  const Forward<T> forward(layers, inputs);
  const std::int64_t hidden_columns = mlp_hidden_columns(layers), outputs = layers.back().outputs;
  parallel_blocks(count, kMinRows, num_threads, [&](std::int64_t begin, std::int64_t end) {
    std::vector<T> scratch = zeros<T>(hidden ? 0 : kTile * hidden_columns);
    std::vector<T> results = zeros<T>(kTile * padded(outputs));
    for (std::int64_t first = begin; first < end; first += kTile) {
      const std::int64_t rows = std::min(kTile, end - first);
      forward.tile(first, rows, hidden ? hidden + first * hidden_columns : scratch.data(), results.data());
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
  const bool by_layers = !layer_grads.empty();
  const Backward<T> backward(layers, inputs, hidden, out_grad, input_grads, by_layers);
  const std::int64_t chunks = std::clamp<std::int64_t>((count + kChunkRows - 1) / kChunkRows, 1, kMaxChunks);
  std::vector<T> sums = zeros<T>(by_layers ? chunks * backward.num_sums() : 0);
  parallel_tasks(chunks, num_threads, [&](std::int64_t chunk) {
    T* own = by_layers ? sums.data() + chunk * backward.num_sums() : nullptr;
    backward.rows(count * chunk / chunks, count * (chunk + 1) / chunks, own);
  });
  if (!by_layers) return;
  for (std::int64_t i = backward.num_sums(); i < chunks * backward.num_sums(); ++i) {
    sums[i % backward.num_sums()] += sums[i];
  }
  for (std::size_t i = 0; i < layers.size(); ++i) {
    const Layer<T>& layer = layers[i];
    const T* sum = sums.data() + backward.sums_at(i);
    T* weights = layer_grads[i].weights;
    for (std::int64_t n = 0; n < layer.outputs; ++n, sum += padded(layer.inputs)) {
      weights = std::copy_n(sum, layer.inputs, weights);
    }
    std::copy_n(sum, layer.outputs, layer_grads[i].biases);
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
