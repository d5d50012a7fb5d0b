// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The two losses of a batch and the gradients of all parameters, in one call. Written as dozens of PyTorch's
// operations, it let two threads of a fit wait for the interpreter's lock during half of each iteration.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "field/encodings.hpp"
#include "field/mlp.hpp"
#include "lattice/vertex_table.hpp"
#include "util/thread_pool.hpp"

namespace radarsdf {

// A ray is a row: return (3), direction (3), range and, where intensities are learnt, the label of its intensity. These
// are the first columns of the parts, and the number of columns.
constexpr std::int64_t kRayPoint = 0, kRayDirection = 3, kRayRange = 6, kRayIntensity = 7, kRayColumns = 8;

// Of the Fourier encoding: 2^first to 2^(first + count - 1), in units of pi / half_width_m.
struct Frequencies {
  double half_width_m;
  int first, count;
};

// What the intensity network sees after the encodings and the geometry feature, in this order.
struct IntensityInputs {
  bool sdf, view_direction, log_range;
};

// What is learnt, as the Field of the Python package puts it together. The numbers stay the caller's: they may change
// between two calls, but not move.
template <typename T>
struct FieldParameters {
  const VertexTable* table;
  const T* features;  // (num_rows, 8)
  Frequencies frequencies;
  std::vector<Layer<T>> sdf;        // gives the logit of the signed distance, then the geometry feature
  std::vector<Layer<T>> intensity;  // empty: no intensities are learnt
  IntensityInputs sees;

  // Numbers of columns: of the interpolated features of all levels, of the cells' encoding made of them, of the Fourier
  // encoding, of the geometry feature.
  std::int64_t levels() const { return kFeatureDim * table->num_levels(); }
  std::int64_t cells() const { return table->encoding() == Encoding::kOctree ? kFeatureDim : levels(); }
  std::int64_t waves() const { return 6 * std::int64_t{frequencies.count}; }
  std::int64_t feature() const { return sdf.back().outputs - 1; }
  std::int64_t intensity_inputs() const {
    return cells() + waves() + feature() + sees.sdf + kHarmonics * sees.view_direction + sees.log_range;
  }
};

struct LossOptions {
  double sigma_m;                // width of the sigmoid that turns a signed distance into a label
  bool intensity_in_free_space;  // or only near the returns
};

// By weights and biases, of as many layers as the networks have.
template <typename T>
struct NetworkGradients {
  std::vector<LayerGradients<T>> sdf, intensity;
};

// Each number has a random byte (see RandomRows). If it is below `keep`, the number stays, times 256 / keep; the others
// become 0.
struct Dropout {
  std::uint64_t seed = 0;
  int keep = 256;  // all stays
};

// A run of a batch's samples, which one thread works on.
struct LossPart {
  std::int64_t count;
  std::int64_t num_labelled;  // the first have the intensity of their return as a label
};

// Samples on rays, part by part. The loss of the signed distances needs points and labels only.
template <typename T>
struct LossBatch {
  const T* points;  // (count, 3) local frame, m
  const T* sdf_m;   // (count) labels, positive in front of the return
  std::vector<LossPart> parts;
  const T* rays = nullptr;  // (count, kRayColumns), rows ray_stride apart
  std::int64_t ray_stride = 0;
  Dropout dropout[2] = {};  // of the cells' encoding and of the Fourier encoding: (num_seen, columns)
};

// By the features, which only few points touch: what `scatter` and `adam_task` take.
template <typename T>
struct FeatureGradients {
  std::int32_t* located;  // (count, num_levels), see VertexTable::locate
  T* interpolated;        // (count, 8 num_levels), by what is interpolated of the features
};

// Means over the batch, or what these are multiplied by in the gradients.
struct FieldLosses {
  double sdf, intensity;
};

// A batch is begun, and the caller may do something else until it calls `finish`; then all gradients are overwritten.
// They are made part by part and added in the order of the parts, so they do not depend on the number of threads. One
// batch at a time; what it points to must stay until its end.
template <typename T>
class FieldLoss {
 public:
  // Throws std::invalid_argument where the parts do not fit together.
  FieldLoss(const FieldParameters<T>& parameters, const LossOptions& options, const NetworkGradients<T>& gradients);

  const FieldParameters<T>& parameters() const { return parameters_; }

  // The loss of the signed distances alone.
  void begin_sdf(const LossBatch<T>& batch, double weight, const FeatureGradients<T>& by_features, ThreadPool& pool);
  // Both losses.
  void begin_joint(const LossBatch<T>& batch, FieldLosses weights, const FeatureGradients<T>& by_features,
                   ThreadPool& pool);
  // The loss of the intensities, by the intensity network alone: features and SDF network are frozen.
  void begin_intensity(const LossBatch<T>& batch, double weight, ThreadPool& pool);
  // Helps the thread pool. A loss that was not asked for is 0.
  FieldLosses finish(ThreadPool& pool);

 private:
  struct Job;

  // `trains`: features and SDF network, by the first loss. `sees`: there is a loss of intensities.
  void begin(const LossBatch<T>& batch, FieldLosses weights, const FeatureGradients<T>& by_features, bool trains,
             bool sees, ThreadPool& pool);
  NetworkGradients<T> of_part(std::size_t part);  // from 1 on

  FieldParameters<T> parameters_;
  LossOptions options_;
  NetworkGradients<T> gradients_;
  std::vector<std::vector<T>> of_parts_;  // gradients of the networks by all parts but the first
  std::shared_ptr<Job> job_;              // the batch that was begun
};

}  // namespace radarsdf
