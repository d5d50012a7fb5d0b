#include "field/mlp.hpp"

#include <algorithm>
#include <cstddef>

#include "field/padding.hpp"
#include "kernels/product_kernels.hpp"
#include "util/instruction_set.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr std::int64_t kTile = 64;         // rows per tile, which passes all layers
constexpr std::int64_t kMinRows = 512;     // least rows worth waking a thread
constexpr std::int64_t kChunkRows = 2048;  // rows per partial sum
constexpr std::int64_t kMaxChunks = 16;

template <typename T>
constexpr T kOne = 1;

template <typename T>
std::vector<T> zeros(std::int64_t size) {
  return std::vector<T>(size);
}

// First column of each hidden layer, and the number of columns.
template <typename T>
std::vector<std::int64_t> hidden_offsets(const std::vector<Layer<T>>& layers) {
  std::vector<std::int64_t> offsets = {0};
  for (std::size_t i = 0; i + 1 < layers.size(); ++i) offsets.push_back(offsets.back() + padded(layers[i].outputs));
  return offsets;
}

// Concatenates rows [first, first + rows) of matrices, padded with zeros to `columns`.
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

// Whether the inputs are adjacent columns of one matrix with padded rows.
template <typename T>
bool side_by_side(const std::vector<Columns<const T>>& inputs) {
  const T* next = inputs[0].data;
  for (const Columns<const T>& input : inputs) {
    if (input.data != next || input.stride != inputs[0].stride) return false;
    next += input.width;
  }
  return padded(next - inputs[0].data) <= inputs[0].stride;
}

// Forward pass of rows [first, first + rows) to `hidden` (rows, hidden columns) and `results` (rows, padded outputs).
template <typename T>
void forward_tile(const ForwardWeights<T>& weights, const std::vector<Columns<const T>>& inputs, std::int64_t first,
                  std::int64_t rows, T* hidden, T* results) {
  const ProductKernel<T> kernel = RADARSDF_KERNEL(product_kernel<T>)();
  const std::int64_t hidden_columns = weights.offsets.back();
  for (std::size_t i = 0; i < weights.layers.size(); ++i) {
    const bool last = i + 1 == weights.layers.size();
    Product<T> product{};
    product.a_depth = 1;
    product.b = weights.transposed[i].data();
    product.b_row = product.columns = padded(weights.layers[i].outputs);
    product.c = last ? results : hidden + weights.offsets[i];
    product.c_row = last ? product.columns : hidden_columns;
    product.rows = rows;
    product.biases = weights.biases[i].data();
    if (i > 0) {
      product.a = hidden + weights.offsets[i - 1];
      product.a_row = hidden_columns;
      product.depth = weights.layers[i].inputs;
      product.rectify = !last;
      kernel.multiply(product);
      continue;
    }
    for (std::size_t part = 0; part < inputs.size(); ++part) {
      product.a = inputs[part].data + first * inputs[part].stride;
      product.a_row = inputs[part].stride;
      product.depth = inputs[part].width;
      product.add = part > 0;
      product.rectify = !last && part + 1 == inputs.size();
      kernel.multiply(product);
      product.b += product.depth * product.columns;
    }
  }
}

template <typename T>
class Backward {
 public:
  Backward(const BackwardWeights<T>& weights, const std::vector<Columns<const T>>& inputs, const T* hidden,
           Columns<const T> out_grad, const std::vector<Columns<T>>& input_grads, bool by_layers)
      : weights_(weights),
        layers_(weights.layers),
        inputs_(inputs),
        hidden_(hidden),
        out_grad_(out_grad),
        input_grads_(input_grads),
        by_layers_(by_layers),
        gathers_(by_layers && !side_by_side(inputs)) {}

  // Adds the gradients by the layers of rows [begin, end) to `sums`, and writes the gradients by the inputs.
  void rows(std::int64_t begin, std::int64_t end, T* sums) const {
    std::vector<T> inputs = zeros<T>(gathers_ ? kTile * padded(layers_[0].inputs) : 0);
    std::vector<T> grads[2] = {zeros<T>(kTile * weights_.widest), zeros<T>(kTile * weights_.widest)};
    for (std::int64_t first = begin; first < end; first += kTile) {
      tile(first, std::min(kTile, end - first), inputs.data(), grads, sums);
    }
  }

 private:
  void tile(std::int64_t first, std::int64_t rows, T* inputs, std::vector<T> (&grads)[2], T* sums) const {
    const std::vector<std::int64_t>&offsets = weights_.offsets, &columns = weights_.columns;
    const T* input = gathers_ ? inputs : inputs_[0].data + first * inputs_[0].stride;
    const std::int64_t input_row = gathers_ ? padded(layers_[0].inputs) : inputs_[0].stride;
    if (gathers_) gather(inputs_, first, rows, input_row, inputs);
    const T* grad = out_grad_.data + first * out_grad_.stride;  // gradient by the outputs of layer i
    std::int64_t grad_row = out_grad_.stride;
    for (std::size_t i = layers_.size(); i-- > 0;) {
      const T* before = i > 0 ? hidden_ + first * offsets.back() + offsets[i - 1] : input;
      const std::int64_t before_row = i > 0 ? offsets.back() : input_row;
      if (by_layers_) add_layer(i, rows, grad, grad_row, before, before_row, sums + weights_.sums_at[i]);
      if (columns[i] == 0) return;
      Product<T> product{};
      product.a = grad;
      product.a_row = grad_row;
      product.a_depth = 1;
      product.b = weights_.weights[i].data();
      product.b_row = product.columns = product.c_row = columns[i];
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
    if (i + 1 < layers_.size()) {  // padded columns: column sums are a product with ones
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

  const BackwardWeights<T>& weights_;
  const std::vector<Layer<T>>& layers_;
  const std::vector<Columns<const T>>& inputs_;
  const T* hidden_;
  Columns<const T> out_grad_;
  const std::vector<Columns<T>>& input_grads_;
  bool by_layers_, gathers_;
  ProductKernel<T> kernel_ = RADARSDF_KERNEL(product_kernel<T>)();
};

}  // namespace

template <typename T>
ForwardWeights<T>::ForwardWeights(const std::vector<Layer<T>>& own_layers)
    : layers(own_layers), offsets(hidden_offsets(own_layers)) {
  for (const Layer<T>& layer : layers) {
    const std::int64_t columns = padded(layer.outputs);
    transposed.push_back(zeros<T>(layer.inputs * columns));
    biases.push_back(zeros<T>(columns));
    for (std::int64_t n = 0; n < layer.outputs; ++n) {
      for (std::int64_t k = 0; k < layer.inputs; ++k) {
        transposed.back()[k * columns + n] = layer.weights[n * layer.inputs + k];
      }
    }
    std::copy_n(layer.biases, layer.outputs, biases.back().begin());
  }
}

template <typename T>
BackwardWeights<T>::BackwardWeights(const std::vector<Layer<T>>& own_layers, const std::vector<MlpInput>& inputs)
    : layers(own_layers), offsets(hidden_offsets(own_layers)) {
  for (std::size_t i = 0; i < layers.size(); ++i) {
    const Layer<T>& layer = layers[i];
    std::vector<Columns<const T>> wanted;
    std::int64_t sum = 0, offset = 0;
    for (const MlpInput& input : i == 0 ? inputs : std::vector<MlpInput>{{layer.inputs, true}}) {
      if (input.wanted) {
        wanted.push_back({layer.weights + offset, layer.inputs, input.width});
        sum += input.width;
      }
      offset += input.width;
    }
    columns.push_back(padded(sum));
    weights.push_back(zeros<T>(layer.outputs * columns.back()));
    gather(wanted, 0, layer.outputs, columns.back(), weights.back().data());
    sums_at.push_back(sums_at.back() + layer.outputs * padded(layer.inputs) + padded(layer.outputs));
    widest = std::max({widest, padded(layer.outputs), padded(layer.inputs)});
  }
}

template <typename T>
std::int64_t mlp_hidden_columns(const std::vector<Layer<T>>& layers) {
  return hidden_offsets(layers).back();
}

template <typename T>
void mlp(const ForwardWeights<T>& weights, const std::vector<Columns<const T>>& inputs, std::int64_t count, T* hidden,
         T* out, int num_threads) {
  const std::int64_t hidden_columns = weights.offsets.back(), outputs = weights.layers.back().outputs;
  parallel_blocks(count, kMinRows, num_threads, [&](std::int64_t begin, std::int64_t end) {
    std::vector<T> scratch = zeros<T>(hidden ? 0 : kTile * hidden_columns);
    std::vector<T> results = zeros<T>(kTile * padded(outputs));
    for (std::int64_t first = begin; first < end; first += kTile) {
      const std::int64_t rows = std::min(kTile, end - first);
      T* kept = hidden ? hidden + first * hidden_columns : scratch.data();
      forward_tile(weights, inputs, first, rows, kept, results.data());
      for (std::int64_t r = 0; r < rows; ++r) {
        std::copy_n(results.data() + r * padded(outputs), outputs, out + (first + r) * outputs);
      }
    }
  });
}

template <typename T>
void mlp_backward(const BackwardWeights<T>& weights, const std::vector<Columns<const T>>& inputs, std::int64_t count,
                  const T* hidden, Columns<const T> out_grad, const std::vector<LayerGradients<T>>& layer_grads,
                  const std::vector<Columns<T>>& input_grads, int num_threads) {
  const bool by_layers = !layer_grads.empty();
  const std::vector<Layer<T>>& layers = weights.layers;
  const std::int64_t num_sums = weights.sums_at.back();
  const Backward<T> backward(weights, inputs, hidden, out_grad, input_grads, by_layers);
  const std::int64_t chunks = std::clamp<std::int64_t>((count + kChunkRows - 1) / kChunkRows, 1, kMaxChunks);
  std::vector<T> sums = zeros<T>(by_layers ? chunks * num_sums : 0);
  parallel_tasks(chunks, num_threads, [&](std::int64_t chunk) {
    T* own = by_layers ? sums.data() + chunk * num_sums : nullptr;
    backward.rows(count * chunk / chunks, count * (chunk + 1) / chunks, own);
  });
  if (!by_layers) return;
  for (std::int64_t i = num_sums; i < chunks * num_sums; ++i) {
    sums[i % num_sums] += sums[i];
  }
  for (std::size_t i = 0; i < layers.size(); ++i) {
    const Layer<T>& layer = layers[i];
    const T* sum = sums.data() + weights.sums_at[i];
    T* to = layer_grads[i].weights;
    for (std::int64_t n = 0; n < layer.outputs; ++n, sum += padded(layer.inputs)) {
      to = std::copy_n(sum, layer.inputs, to);
    }
    std::copy_n(sum, layer.outputs, layer_grads[i].biases);
  }
}

#define RADARSDF_INSTANTIATE(T)                                                                                       \
  template std::int64_t mlp_hidden_columns(const std::vector<Layer<T>>&);                                             \
  template struct ForwardWeights<T>;                                                                                  \
  template struct BackwardWeights<T>;                                                                                 \
  template void mlp(const ForwardWeights<T>&, const std::vector<Columns<const T>>&, std::int64_t, T*, T*, int);       \
  template void mlp_backward(const BackwardWeights<T>&, const std::vector<Columns<const T>>&, std::int64_t, const T*, \
                             Columns<const T>, const std::vector<LayerGradients<T>>&, const std::vector<Columns<T>>&, \
                             int);
RADARSDF_INSTANTIATE(float)
RADARSDF_INSTANTIATE(double)
#undef RADARSDF_INSTANTIATE

}  // namespace radarsdf
