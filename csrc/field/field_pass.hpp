// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Losses and gradients of a part of a batch: what one thread computes for `FieldLoss`.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "field/field_loss.hpp"

namespace radarsdf {

// The samples of a part of a batch.
template <typename T>
struct PassInput {
  const T* points;
  const T* sdf_m;
  std::int64_t count;
  const T* rays;
  std::int64_t ray_stride;
  std::int64_t num_labelled;
  std::int64_t num_seen;             // the intensity network sees the first so many
  std::int64_t before, seen_before;  // samples of the batch
  Dropout dropout[2];
};

// What is asked for of a part.
template <typename T>
struct PassRequest {
  FieldLosses shares;                               // of one sample in the weighted means over the batch
  const std::vector<LayerGradients<T>>* sdf;        // null: features and SDF network are frozen, without a loss
  const std::vector<LayerGradients<T>>* intensity;  // null: there is no loss of intensities
  FeatureGradients<T> by_features;                  // `interpolated` is null where they are frozen
};

// Weights of the networks, prepared once for all parts of a batch.
template <typename T>
struct PassWeights {
  // `trains`: features and SDF network; `sees`: there is a loss of intensities.
  PassWeights(const FieldParameters<T>& field, bool trains, bool sees);

  ForwardWeights<T> sdf;
  std::optional<ForwardWeights<T>> intensity;
  std::optional<BackwardWeights<T>> sdf_backward, intensity_backward;
};

// Sums over the samples of a part.
template <typename T>
FieldLosses run_pass(const FieldParameters<T>& field, const PassWeights<T>& weights, const LossOptions& options,
                     const PassInput<T>& part, const PassRequest<T>& request);

}  // namespace radarsdf
