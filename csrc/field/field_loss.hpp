// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The two losses of a batch and their gradients, from points to the gradients of what is learnt, in one call: as dozens
// of PyTorch's operations, two threads of a fit waited for the interpreter's lock during half of each iteration.
#pragma once

#include <cstdint>
#include <vector>

#include "field/encodings.hpp"
#include "field/mlp.hpp"
#include "lattice/vertex_table.hpp"

namespace radarsdf {

// A ray is a row: return (3), direction (3), range and, where intensities are learnt, the label of its intensity. These
// are the first columns of the parts, and the number of columns.
constexpr std::int64_t kRayPoint = 0, kRayDirection = 3, kRayRange = 6, kRayIntensity = 7, kRayColumns = 8;

// What is learnt, as python/radarsdf/field.py puts it together.
template <typename T>
struct FieldLayers {
  const VertexTable* table;
  const T* features;
  double half_width_m;  // of the Fourier encoding, as are
  int first_frequency, num_frequencies;
  std::vector<Layer<T>> sdf;  // gives the logit and then the geometry feature
  std::vector<Layer<T>>
      intensity;  // sees encoding, geometry feature and, where asked for, the next three; may be empty
  bool sdf_input, view_direction, log_range;

  // Numbers of columns: of the cells' encoding, of what it is interpolated from, of the Fourier encoding, of the
  // feature.
  std::int64_t cells() const { return table->encoding() == Encoding::kOctree ? kFeatureDim : levels(); }
  std::int64_t levels() const { return kFeatureDim * table->num_levels(); }
  std::int64_t waves() const { return 6 * num_frequencies; }
  std::int64_t feature() const { return sdf.back().outputs - 1; }
  std::int64_t intensity_inputs() const {
    return cells() + waves() + feature() + sdf_input + kHarmonics * view_direction + log_range;
  }
};

// The bytes of a dropout: what is below `keep` stays, times 256 / keep.
struct Dropout {
  const std::uint8_t* bytes = nullptr;  // null: all stays
  int keep = 256;
};

template <typename T>
struct LossBatch {
  const T* points;  // (count, 3) local frame, m
  const T* sdf_m;   // (count) labels, positive in front of the return
  const T* rays;    // (count, ray_columns): return (3), direction (3), range and, for the intensity, its label
  std::int64_t ray_columns;
  std::int64_t count;
  std::int64_t num_near;         // the first are near a surface: behind them, no return is expected
  std::int64_t intensity_count;  // the intensity network sees the first so many
  Dropout dropout[2];            // of the cells' (intensity_count, dim) and of the Fourier encoding
};

struct LossWeights {
  double sigma_m;
  double sdf, intensity;  // what the mean losses are multiplied by in the gradients
};

// All overwritten. An empty `sdf` stands for frozen geometry: it has no loss.
template <typename T>
struct FieldGradients {
  std::vector<LayerGradients<T>> sdf, intensity;
  std::int32_t* located;  // (count, num_levels), see VertexTable::locate
  T* interpolated;        // (count, 8 num_levels), by what is interpolated of the features; null where `sdf` is empty
};

// Means over the batch.
struct FieldLosses {
  double sdf, intensity;
};

template <typename T>
FieldLosses field_loss(const FieldLayers<T>& field, const LossBatch<T>& batch, const LossWeights& weights,
                       const FieldGradients<T>& gradients);

}  // namespace radarsdf
