// Both losses of a batch and the gradients of all parameters, in one call. As dozens of PyTorch operations, two threads
// of a fit waited for the GIL during half of each iteration.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "field/encodings.hpp"
#include "field/mlp.hpp"
#include "lattice/vertex_table.hpp"
#include "util/thread_pool.hpp"

namespace radarsdf {

// A ray is a row: return (3), direction (3), range and, with intensities, the label of its intensity. These are the
// first columns of the parts, and the number of columns.
constexpr std::int64_t kRayPoint = 0, kRayDirection = 3, kRayRange = 6, kRayIntensity = 7, kRayColumns = 8;

// Frequencies of the Fourier encoding: 1 to 2^(count - 1), in units of pi / half_width_m.
struct Frequencies {
  double half_width_m;
  int count;
};

// Inputs of the intensity network after the encodings, the geometry feature and the logit, in this order.
struct IntensityInputs {
  bool view_direction, log_range;
};

// Trainable parameters, as in the NeuralField of the Python package. The caller owns the arrays: values may change
// between calls, addresses may not.
struct FieldParameters {
  const VertexTable* table;
  const float* features;  // (num_rows, 8)
  Frequencies frequencies;
  std::vector<Layer<float>> sdf;        // outputs the logit of the signed distance, then the geometry feature
  std::vector<Layer<float>> intensity;  // empty without intensities
  IntensityInputs sees;

  // Numbers of columns of the interpolated features of all levels, of the cells' encoding, of the Fourier encoding, and
  // of the geometry feature.
  std::int64_t levels() const { return kFeatureDim * table->num_levels(); }
  std::int64_t cells() const { return table->encoding() == Encoding::kOctree ? kFeatureDim : levels(); }
  std::int64_t waves() const { return 6 * std::int64_t{frequencies.count}; }
  std::int64_t feature() const { return sdf.back().outputs - 1; }
  std::int64_t intensity_inputs() const {
    return cells() + waves() + sdf.back().outputs + kHarmonics * sees.view_direction + sees.log_range;
  }
};

struct LossOptions {
  double sigma_m;                // width of the sigmoid that converts a signed distance to a label
  bool intensity_in_free_space;  // else only near the returns
};

// Gradients by weights and biases of the layers of both networks.
struct NetworkGradients {
  std::vector<LayerGradients<float>> sdf, intensity;
};

// Each element has a random byte (see RandomRows). Elements with a byte below `keep` are multiplied by 256 / keep, the
// others by 0.
struct Dropout {
  std::uint64_t seed = 0;
  int keep = 256;  // keeps all
};

// Consecutive samples of a batch, processed by one thread.
struct LossPart {
  std::int64_t count;
  std::int64_t num_labelled;  // number of leading samples with intensity labels
};

// Samples on rays, by part. The loss of the signed distances needs only points and labels.
struct LossBatch {
  const float* points;  // (count, 3) local frame, m
  const float* sdf_m;   // (count) labels, positive in front of the return
  std::vector<LossPart> parts;
  const float* rays = nullptr;  // (count, kRayColumns), rows ray_stride apart
  std::int64_t ray_stride = 0;
  Dropout dropout[2] = {};  // for the cells' encoding and the Fourier encoding: (num_seen, columns)
};

// Sparse gradients by the features: the input of `scatter` and `adam_task`.
struct FeatureGradients {
  std::int32_t* located;  // (count, num_levels), see VertexTable::locate
  float* interpolated;    // (count, 8 num_levels), by the interpolated features
};

// Means over the batch.
struct FieldLosses {
  double sdf, intensity;
};

// Asynchronous: `begin` starts a batch, and `finish` waits for it; then all gradients are overwritten. Gradients
// are computed by part and summed in the order of the parts, independent of the number of threads. One batch at a time;
// its arrays must remain valid until `finish`.
class FieldLoss {
 public:
  // Throws std::invalid_argument if the arguments are inconsistent.
  FieldLoss(const FieldParameters& parameters, const LossOptions& options, const NetworkGradients& gradients);

  const FieldParameters& parameters() const { return parameters_; }

  // Trains the intensities if the batch has rays, and the signed distances if `by_features` has an array; else features
  // and SDF network are frozen.
  void begin(const LossBatch& batch, const FeatureGradients& by_features, ThreadPool& pool);
  // Joins the thread pool. Losses that were not requested are 0.
  FieldLosses finish(ThreadPool& pool);

 private:
  struct Job;

  NetworkGradients of_part(std::size_t part);  // part >= 1

  FieldParameters parameters_;
  LossOptions options_;
  NetworkGradients gradients_;
  std::vector<std::vector<float>> of_parts_;  // gradients of the networks by all parts except the first
  std::shared_ptr<Job> job_;                  // current batch
};

}  // namespace radarsdf
