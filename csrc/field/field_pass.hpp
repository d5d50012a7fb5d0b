// Losses and gradients of one part of a batch, computed by one thread for `FieldLoss`.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "field/field_loss.hpp"

namespace radarsdf {

// Samples of a part of a batch.
struct PassInput {
  const float* points;
  const float* sdf_m;
  std::int64_t count;
  const float* rays;
  std::int64_t ray_stride;
  std::int64_t num_labelled;
  std::int64_t num_seen;             // number of leading samples that the intensity network sees
  std::int64_t before, seen_before;  // numbers of samples in previous parts
  Dropout dropout[2];
};

// Requested gradients of a part.
struct PassRequest {
  FieldLosses shares;                                   // of one sample in the means over the batch
  const std::vector<LayerGradients<float>>* sdf;        // null: features and SDF network are frozen, without a loss
  const std::vector<LayerGradients<float>>* intensity;  // null: no loss of intensities
  FeatureGradients by_features;                         // `interpolated` is null if they are frozen
};

// Weights of the networks, prepared once for all parts of a batch.
struct PassWeights {
  // `trains`, `sees`: whether there are losses of signed distances, and of intensities.
  PassWeights(const FieldParameters& field, bool trains, bool sees);

  ForwardWeights<float> sdf;
  std::optional<ForwardWeights<float>> intensity;
  std::optional<BackwardWeights<float>> sdf_backward, intensity_backward;
};

// Returns the losses summed over the samples of a part.
FieldLosses run_pass(const FieldParameters& field, const PassWeights& weights, const LossOptions& options,
                     const PassInput& part, const PassRequest& request);

}  // namespace radarsdf
