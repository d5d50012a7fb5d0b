// Losses and gradients of one part of a batch, computed by one thread for `FieldLoss`.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "field/field_loss.hpp"

namespace radarsdf {

// Samples of a part of a batch.
template <typename T>
struct PassInput {
  const T* points;
  const T* sdf_m;
  std::int64_t count;
  const T* rays;
  std::int64_t ray_stride;
  std::int64_t num_labelled;
  std::int64_t num_seen;             // number of leading samples that the intensity network sees
  std::int64_t before, seen_before;  // numbers of samples in previous parts
  Dropout dropout[2];
};

// Requested gradients of a part.
template <typename T>
struct PassRequest {
  FieldLosses shares;                               // weight of one sample in the means over the batch
  const std::vector<LayerGradients<T>>* sdf;        // null: features and SDF network are frozen, without a loss
  const std::vector<LayerGradients<T>>* intensity;  // null: no loss of intensities
  FeatureGradients<T> by_features;                  // `interpolated` is null if they are frozen
};

// Weights of the networks, prepared once for all parts of a batch.
template <typename T>
struct PassWeights {
  // `trains`, `sees`: see FieldLoss.
  PassWeights(const FieldParameters<T>& field, bool trains, bool sees);

  ForwardWeights<T> sdf;
  std::optional<ForwardWeights<T>> intensity;
  std::optional<BackwardWeights<T>> sdf_backward, intensity_backward;
};

// Returns the losses summed over the samples of a part.
template <typename T>
FieldLosses run_pass(const FieldParameters<T>& field, const PassWeights<T>& weights, const LossOptions& options,
                     const PassInput<T>& part, const PassRequest<T>& request);

}  // namespace radarsdf
