#include "field/field_loss.hpp"

#include <algorithm>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>

#include "field/field_pass.hpp"
#include "kernels/fourier_kernels.hpp"
#include "util/large_array.hpp"

namespace radarsdf {
namespace {

// Factor that converts a sum over a batch to a mean.
double mean(std::int64_t count) { return 1 / static_cast<double>(std::max<std::int64_t>(count, 1)); }

void check_layers(const std::vector<Layer<float>>& layers, std::int64_t num_gradients, std::int64_t inputs,
                  const char* message) {
  if (static_cast<std::int64_t>(layers.size()) != num_gradients) {
    throw std::invalid_argument("there must be gradients of all layers");
  }
  for (const Layer<float>& layer : layers) {
    if (layer.inputs != inputs || layer.outputs < 1) throw std::invalid_argument(message);
    inputs = layer.outputs;
  }
}

void add(const std::vector<Layer<float>>& layers, const std::vector<LayerGradients<float>>& from,
         const std::vector<LayerGradients<float>>& to) {
  for (std::size_t i = 0; i < layers.size(); ++i) {
    for (std::int64_t k = 0; k < layers[i].outputs * layers[i].inputs; ++k) to[i].weights[k] += from[i].weights[k];
    for (std::int64_t k = 0; k < layers[i].outputs; ++k) to[i].biases[k] += from[i].biases[k];
  }
}

}  // namespace

FieldLoss::FieldLoss(const FieldParameters& parameters, const LossOptions& options, const NetworkGradients& gradients)
    : parameters_(parameters), options_(options), gradients_(gradients) {
  const Frequencies& f = parameters.frequencies;
  if (f.count < 0 || f.count > kMaxFrequencies)
    throw std::invalid_argument("there must be 0 to " + std::to_string(kMaxFrequencies) + " frequencies");
  if (!(f.half_width_m > 0)) throw std::invalid_argument("half_width_m must be positive");
  if (!(options.sigma_m > 0)) throw std::invalid_argument("sigma_m must be positive");
  if (parameters.sdf.empty()) throw std::invalid_argument("there must be an SDF network");
  check_layers(parameters.sdf, static_cast<std::int64_t>(gradients.sdf.size()), parameters.cells() + parameters.waves(),
               "the SDF network must see the encodings of cells and positions");
  if (parameters.intensity.empty() && gradients.intensity.empty()) return;
  check_layers(parameters.intensity, static_cast<std::int64_t>(gradients.intensity.size()),
               parameters.intensity_inputs(), "the intensity network must see what it is said to");
  if (parameters.intensity.back().outputs != 1) {
    throw std::invalid_argument("the intensity network must have one output");
  }
}

struct FieldLoss::Job {
  explicit Job(PassWeights prepared) : weights(std::move(prepared)) {}

  PassWeights weights;
  std::vector<PassInput> parts;
  std::vector<NetworkGradients> by_networks;  // by part
  std::vector<FieldLosses> sums;              // by part
  FieldLosses means;                          // factors that convert sums to means
  bool trains, sees;                          // losses of signed distances, of intensities
  std::unique_ptr<std::int32_t[]> located;    // if the caller does not request it
};

void FieldLoss::begin(const LossBatch& batch, const FeatureGradients& by_features, ThreadPool& pool) {
  const bool trains = by_features.interpolated != nullptr, sees = batch.rays != nullptr;
  if (sees && parameters_.intensity.empty()) throw std::invalid_argument("there is no intensity network");
  if (job_) throw std::logic_error("the batch before this one is not finished");
  const auto job = std::make_shared<Job>(PassWeights(parameters_, trains, sees));
  std::int64_t count = 0, num_seen = 0;
  for (const LossPart& part : batch.parts) {
    const std::int64_t seen = options_.intensity_in_free_space ? part.count : part.num_labelled;
    const float* rays = batch.rays ? batch.rays + count * batch.ray_stride : nullptr;
    job->by_networks.push_back(job->parts.empty() ? gradients_ : of_part(job->parts.size()));
    job->parts.push_back({batch.points + 3 * count,
                          batch.sdf_m + count,
                          part.count,
                          rays,
                          batch.ray_stride,
                          part.num_labelled,
                          seen,
                          count,
                          num_seen,
                          {batch.dropout[0], batch.dropout[1]}});
    count += part.count;
    num_seen += seen;
  }
  job->sums.resize(job->parts.size());
  job->means = {mean(count), mean(num_seen)};
  job->trains = trains;
  job->sees = sees;
  FeatureGradients to = by_features;
  if (!to.located) {
    job->located = large_array<std::int32_t>(count * parameters_.table->num_levels());
    to.located = job->located.get();
  }
  pool.begin(static_cast<std::int64_t>(job->parts.size()), [this, job, to](std::int64_t i) {
    const PassInput& part = job->parts[i];
    const PassRequest request{job->means,
                              job->trains ? &job->by_networks[i].sdf : nullptr,
                              job->sees ? &job->by_networks[i].intensity : nullptr,
                              {to.located + part.before * parameters_.table->num_levels(),
                               job->trains ? to.interpolated + part.before * parameters_.levels() : nullptr}};
    job->sums[i] = run_pass(parameters_, job->weights, options_, part, request);
  });
  job_ = job;
}

FieldLosses FieldLoss::finish(ThreadPool& pool) {
  if (!job_) throw std::logic_error("no batch was begun");
  const std::shared_ptr<Job> job = std::move(job_);
  pool.finish();
  FieldLosses losses{0, 0};
  for (const FieldLosses& sum : job->sums) {
    losses.sdf += sum.sdf * job->means.sdf;
    losses.intensity += sum.intensity * job->means.intensity;
  }
  for (std::size_t i = 1; i < job->parts.size(); ++i) {
    if (job->trains) add(parameters_.sdf, job->by_networks[i].sdf, gradients_.sdf);
    if (job->sees) add(parameters_.intensity, job->by_networks[i].intensity, gradients_.intensity);
  }
  return losses;
}

NetworkGradients FieldLoss::of_part(std::size_t part) {
  if (of_parts_.size() < part) of_parts_.resize(part);
  std::vector<float>& numbers = of_parts_[part - 1];
  std::int64_t size = 0;
  for (const auto* layers : {&parameters_.sdf, &parameters_.intensity}) {
    for (const Layer<float>& layer : *layers) size += layer.outputs * (layer.inputs + 1);
  }
  numbers.resize(size);
  NetworkGradients gradients;
  float* next = numbers.data();
  const auto share_out = [&](const std::vector<Layer<float>>& layers, std::vector<LayerGradients<float>>& of_layers) {
    for (const Layer<float>& layer : layers) {
      of_layers.push_back({next, next + layer.outputs * layer.inputs});
      next += layer.outputs * (layer.inputs + 1);
    }
  };
  share_out(parameters_.sdf, gradients.sdf);
  share_out(parameters_.intensity, gradients.intensity);
  return gradients;
}

}  // namespace radarsdf
