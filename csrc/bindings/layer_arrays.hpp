// Validated layers of networks from lists of arrays.
#pragma once

#include <pybind11/stl.h>

#include <vector>

#include "bindings/arrays.hpp"
#include "field/mlp.hpp"

namespace radarsdf {

template <typename T>
using Arrays = std::vector<Array<T>>;

template <typename T>
std::vector<Layer<T>> layers_of(const Arrays<T>& weights, const Arrays<T>& biases) {
  if (weights.empty() || weights.size() != biases.size()) {
    throw std::invalid_argument("there must be as many weights as biases, and at least one");
  }
  std::vector<Layer<T>> layers;
  for (std::size_t i = 0; i < weights.size(); ++i) {
    const auto inputs = i == 0 && weights[0].ndim() == 2 ? weights[0].shape(1) : i > 0 ? layers.back().outputs : 0;
    const auto outputs = weights[i].ndim() == 2 ? weights[i].shape(0) : 0;
    if (outputs == 0) throw std::invalid_argument("a layer must have outputs");
    check_shape(weights[i], {outputs, inputs}, "weights");
    check_shape(biases[i], {outputs}, "biases");
    layers.push_back({weights[i].data(), biases[i].data(), inputs, outputs});
  }
  return layers;
}

template <typename T>
std::vector<LayerGradients<T>> layer_gradients_of(Arrays<T>& weight_grads, Arrays<T>& bias_grads,
                                                  const std::vector<Layer<T>>& layers) {
  if (weight_grads.size() != layers.size() || bias_grads.size() != layers.size()) {
    throw std::invalid_argument("gradients of weights and biases must be of all layers or of none");
  }
  std::vector<LayerGradients<T>> gradients;
  for (std::size_t i = 0; i < layers.size(); ++i) {
    check_shape(weight_grads[i], {layers[i].outputs, layers[i].inputs}, "weight_grads");
    check_shape(bias_grads[i], {layers[i].outputs}, "bias_grads");
    gradients.push_back({weight_grads[i].mutable_data(), bias_grads[i].mutable_data()});
  }
  return gradients;
}

}  // namespace radarsdf
