#include "field/field_pass.hpp"

#include <algorithm>
#include <cmath>
#include <memory>
#include <utility>

#include "field/padding.hpp"
#include "kernels/fourier_kernels.hpp"
#include "util/large_array.hpp"
#include "util/random_bytes.hpp"

namespace radarsdf {
namespace {

using Matrix = std::unique_ptr<float[]>;

Matrix matrix(std::int64_t rows, std::int64_t columns) { return large_array<float>(rows * columns); }

class Pass {
 public:
  Pass(const FieldParameters& field, const PassWeights& weights, const LossOptions& options, const PassInput& part,
       const PassRequest& request)
      : field_(field),
        weights_(weights),
        options_(options),
        part_(part),
        request_(request),
        levels_(field.levels()),
        cells_(field.cells()),
        waves_(field.waves()),
        feature_(field.feature()) {}

  // Returns the losses summed over the samples.
  FieldLosses run() {
    encode();
    const bool trains = request_.sdf != nullptr;
    const std::int64_t outputs = 1 + feature_;
    out_ = matrix(part_.count, outputs);
    const Matrix hidden = trains ? matrix(part_.count, mlp_hidden_columns(field_.sdf)) : nullptr;
    std::vector<Columns<const float>> inputs = {{encoding_.get(), row(), cells_}};
    if (waves_ > 0) inputs.push_back({encoding_.get() + cells_, row(), waves_});
    mlp(weights_.sdf, inputs, part_.count, hidden.get(), out_.get(), 1);

    FieldLosses losses{0, 0};
    if (request_.intensity != nullptr) losses.intensity = intensity_loss(trains);
    if (!trains) return losses;
    out_grad_ = matrix(part_.count, outputs);
    std::fill_n(out_grad_.get(), part_.count * outputs, 0.0F);
    losses.sdf = sdf_loss();
    add_links();
    const Matrix own = sums_levels() ? matrix(part_.count, cells_) : nullptr;
    float* cells_grad = own ? own.get() : request_.by_features.interpolated;
    std::vector<Columns<float>> input_grads = {{cells_grad, cells_, cells_}};
    if (waves_ > 0) input_grads.push_back({nullptr, 0, waves_});
    mlp_backward(*weights_.sdf_backward, inputs, part_.count, hidden.get(), {out_grad_.get(), outputs, outputs},
                 *request_.sdf, input_grads, 1);
    add_cells(cells_grad);
    if (own) spread(own.get());
    return losses;
  }

 private:
  bool sums_levels() const { return field_.table->encoding() == Encoding::kOctree; }
  std::int64_t dim() const { return cells_ + waves_; }
  std::int64_t row() const { return padded(dim()); }  // padded row length of the encoding

  void encode() {
    encoding_ = matrix(part_.count, row());
    for (std::int64_t i = 0; i < part_.count; ++i) {
      std::fill_n(encoding_.get() + i * row() + dim(), row() - dim(), 0.0F);
    }
    const Matrix own = sums_levels() ? matrix(part_.count, levels_) : nullptr;
    radarsdf::encode(*field_.table, field_.features, part_.points, part_.count, request_.by_features.located,
                     own ? own.get() : encoding_.get(), own ? levels_ : row(), 1);
    for (std::int64_t i = 0; own && i < part_.count; ++i) {
      for (std::int64_t d = 0; d < cells_; ++d) {
        float sum = 0;
        for (std::int64_t at = d; at < levels_; at += cells_) sum += own[i * levels_ + at];
        encoding_[i * row() + d] = sum;
      }
    }
    if (waves_ > 0) {
      fourier(part_.points, part_.count, field_.frequencies.half_width_m, 0, field_.frequencies.count,
              encoding_.get() + cells_, row(), 1);
    }
  }

  // Binary cross-entropy of sigmoid(logit) and sigmoid(sdf / sigma), as in `sdf_loss` of the Python package.
  double sdf_loss() {
    const std::int64_t outputs = 1 + feature_;
    const float inverse_sigma = static_cast<float>(1 / options_.sigma_m);
    const float share = static_cast<float>(request_.shares.sdf);
    double sum = 0;
    for (std::int64_t i = 0; i < part_.count; ++i) {
      const float logit = out_[i * outputs], label = 1 / (1 + std::exp(-part_.sdf_m[i] * inverse_sigma));
      const float tail = std::exp(-std::abs(logit));
      sum += static_cast<double>(std::max(logit, 0.0F) - logit * label + std::log1p(tail));
      out_grad_[i * outputs] = share * ((logit < 0 ? tail : 1.0F) / (1 + tail) - label);
    }
    return sum;
  }

  // Applies a dropout to the rows of an encoding, or of its gradient, of the samples seen. `to` may equal `from`.
  void drop(const Dropout& dropout, std::int64_t columns, const float* from, std::int64_t from_row, float* to,
            std::int64_t to_row) const {
    if (dropout.keep >= 256 && to == from) return;
    RandomRows random(dropout.seed, columns);
    const float scale = 256.0F / static_cast<float>(dropout.keep);
    for (std::int64_t i = 0; i < part_.num_seen; ++i, from += from_row, to += to_row) {
      if (dropout.keep >= 256) {
        std::copy_n(from, columns, to);
        continue;
      }
      const std::uint8_t* bytes = random.row(part_.seen_before + i);
      for (std::int64_t d = 0; d < columns; ++d) to[d] = from[d] * (bytes[d] < dropout.keep ? scale : 0.0F);
    }
  }

  // Mean absolute error, and gradients by the layers and, if `trains`, by the outputs of the SDF network.
  double intensity_loss(bool trains) {
    const std::int64_t count = part_.num_seen, width = field_.intensity[0].inputs;
    const std::int64_t links = feature_ + 1;  // columns from the SDF network
    const std::int64_t rest = dim() + links;  // columns from here on are data and need no gradient
    const std::int64_t row_of_x = padded(width);
    const Matrix x = matrix(count, row_of_x);
    drop(part_.dropout[0], cells_, encoding_.get(), row(), x.get(), row_of_x);
    drop(part_.dropout[1], waves_, encoding_.get() + cells_, row(), x.get() + cells_, row_of_x);
    for (std::int64_t i = 0; i < count; ++i) {
      fill(i, x.get() + i * row_of_x + dim());
      std::fill_n(x.get() + i * row_of_x + width, row_of_x - width, 0.0F);
    }
    if (field_.sees.view_direction) {
      const Matrix directions = matrix(count, 3);
      for (std::int64_t i = 0; i < count; ++i) {
        std::copy_n(part_.rays + i * part_.ray_stride + kRayDirection, 3, directions.get() + 3 * i);
      }
      spherical_harmonics(directions.get(), count, x.get() + rest, row_of_x, 1);
    }

    std::vector<Columns<const float>> inputs;
    std::vector<Columns<float>> input_grads;
    if (trains) {
      cells_grad_ = matrix(count, cells_);
      links_grad_ = matrix(count, links);
    }
    std::int64_t first = 0;
    const auto add = [&](std::int64_t columns, float* gradient) {
      if (columns == 0) return;
      inputs.push_back({x.get() + first, row_of_x, columns});
      input_grads.push_back({gradient, columns, columns});
      first += columns;
    };
    add(cells_, cells_grad_.get());
    add(waves_, nullptr);
    add(links, links_grad_.get());
    add(width - rest, nullptr);

    const Matrix predicted = matrix(count, 1);
    const Matrix hidden = matrix(count, mlp_hidden_columns(field_.intensity));
    mlp(*weights_.intensity, inputs, count, hidden.get(), predicted.get(), 1);
    const float share = static_cast<float>(request_.shares.intensity);
    double sum = 0;
    for (std::int64_t i = 0; i < count; ++i) {
      // The label in free space is 0 (3QFPI).
      const float label = i < part_.num_labelled ? part_.rays[i * part_.ray_stride + kRayIntensity] : 0.0F;
      const float error = std::isnan(label) ? 0.0F : predicted[i] - label;
      sum += static_cast<double>(std::abs(error));
      predicted[i] = error > 0 ? share : error < 0 ? -share : 0.0F;
    }
    mlp_backward(*weights_.intensity_backward, inputs, count, hidden.get(), {predicted.get(), 1, 1},
                 *request_.intensity, input_grads, 1);
    return sum;
  }

  // Inputs of the intensity network after the encodings, except the harmonics.
  void fill(std::int64_t i, float* x) const {
    const float* out = out_.get() + i * (1 + feature_);
    x = std::copy_n(out + 1, feature_, x);
    *x++ = out[0];
    if (field_.sees.view_direction) x += kHarmonics;
    if (field_.sees.log_range) {
      const float range_m = part_.rays[i * part_.ray_stride + kRayRange] - part_.sdf_m[i];
      *x = std::log10(std::max(range_m, 1e-3F) / 10);
    }
  }

  // Adds the gradients of the intensity loss by the outputs of the SDF network.
  void add_links() {
    if (!links_grad_) return;
    for (std::int64_t i = 0; i < part_.num_seen; ++i) {
      const float* from = links_grad_.get() + i * (1 + feature_);
      float* to = out_grad_.get() + i * (1 + feature_);
      for (std::int64_t g = 0; g < feature_; ++g) to[1 + g] += from[g];
      to[0] += from[feature_];
    }
  }

  // Adds the gradients of the intensity loss by the cells' encoding.
  void add_cells(float* cells_grad) {
    if (!cells_grad_) return;
    float* own = cells_grad_.get();
    drop(part_.dropout[0], cells_, own, cells_, own, cells_);
    for (std::int64_t i = 0; i < part_.num_seen * cells_; ++i) cells_grad[i] += own[i];
  }

  // The encoding is the sum over levels, so every level has the gradient of the sum.
  void spread(const float* cells_grad) const {
    for (std::int64_t i = 0; i < part_.count; ++i) {
      for (std::int64_t first = 0; first < levels_; first += cells_) {
        std::copy_n(cells_grad + i * cells_, cells_, request_.by_features.interpolated + i * levels_ + first);
      }
    }
  }

  const FieldParameters& field_;
  const PassWeights& weights_;
  const LossOptions& options_;
  const PassInput& part_;
  const PassRequest& request_;
  std::int64_t levels_, cells_, waves_, feature_;  // numbers of columns
  Matrix encoding_, out_, out_grad_;
  Matrix cells_grad_, links_grad_;  // of the intensity loss alone
};

}  // namespace

PassWeights::PassWeights(const FieldParameters& field, bool trains, bool sees) : sdf(field.sdf) {
  if (trains) sdf_backward.emplace(field.sdf, std::vector<MlpInput>{{field.cells(), true}, {field.waves(), false}});
  if (!sees) return;
  const std::int64_t links = field.feature() + 1;
  const std::int64_t rest = field.intensity_inputs() - field.cells() - field.waves() - links;
  intensity.emplace(field.intensity);
  intensity_backward.emplace(
      field.intensity,
      std::vector<MlpInput>{{field.cells(), trains}, {field.waves(), false}, {links, trains}, {rest, false}});
}

FieldLosses run_pass(const FieldParameters& field, const PassWeights& weights, const LossOptions& options,
                     const PassInput& part, const PassRequest& request) {
  return Pass(field, weights, options, part, request).run();
}

}  // namespace radarsdf
