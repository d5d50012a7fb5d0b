// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <algorithm>
#include <array>
#include <memory>
#include <optional>
#include <tuple>
#include <utility>
#include <variant>
#include <vector>

#include "bindings/layer_arrays.hpp"
#include "bindings/subjects.hpp"
#include "field/field_loss.hpp"

namespace radarsdf {
namespace {

template <typename T>
using Network = std::pair<Arrays<T>, Arrays<T>>;  // weights and biases

using Bytes = std::pair<Array<std::uint8_t>, int>;  // of a dropout, and what it keeps

// A FieldLoss with the arrays that it reads, and those that it writes the gradients of the networks to.
template <typename T>
class LossArrays {
 public:
  LossArrays(const VertexTable& table, Array<T> features, const Frequencies& frequencies, Network<T> sdf,
             std::optional<Network<T>> intensity, IntensityInputs sees, const LossOptions& options)
      : features_(std::move(features)), sdf_(std::move(sdf)), intensity_(std::move(intensity)) {
    check_shape(features_, table.num_rows(), kFeatureDim, "features");
    FieldParameters<T> parameters{&table, features_.data(), frequencies, layers_of(sdf_.first, sdf_.second), {}, sees};
    if (intensity_) parameters.intensity = layers_of(intensity_->first, intensity_->second);
    const NetworkGradients<T> gradients{gradients_of(parameters.sdf, sdf_gradients),
                                        gradients_of(parameters.intensity, intensity_gradients)};
    loss_.emplace(parameters, options, gradients);
  }

  const FieldLoss<T>& loss() const { return *loss_; }

  Arrays<T> sdf_gradients, intensity_gradients;  // weights and biases of each layer in turn

 private:
  static std::vector<LayerGradients<T>> gradients_of(const std::vector<Layer<T>>& layers, Arrays<T>& arrays) {
    std::vector<LayerGradients<T>> gradients;
    for (const Layer<T>& layer : layers) {
      Array<T> weights(std::vector<std::int64_t>{layer.outputs, layer.inputs});
      Array<T> biases(std::vector<std::int64_t>{layer.outputs});
      std::fill_n(weights.mutable_data(), weights.size(), T(0));
      std::fill_n(biases.mutable_data(), biases.size(), T(0));
      gradients.push_back({weights.mutable_data(), biases.mutable_data()});
      arrays.push_back(std::move(weights));
      arrays.push_back(std::move(biases));
    }
    return gradients;
  }

  Array<T> features_;
  Network<T> sdf_;
  std::optional<Network<T>> intensity_;
  std::optional<FieldLoss<T>> loss_;
};

// What Python knows as FieldLoss: its numbers have the type of the features.
class AnyFieldLoss {
 public:
  template <typename... Arguments>
  explicit AnyFieldLoss(Arguments&&... arguments) : arrays_(std::forward<Arguments>(arguments)...) {}

  AnyFieldLoss(const AnyFieldLoss&) = delete;
  AnyFieldLoss& operator=(const AnyFieldLoss&) = delete;

  template <typename T>
  const LossArrays<T>& of() const {
    const auto* arrays = std::get_if<LossArrays<T>>(&arrays_);
    if (arrays == nullptr) throw py::type_error("the batch must have the dtype of the features");
    return *arrays;
  }

  using Gradients = std::variant<Arrays<float>, Arrays<double>>;
  Gradients sdf_gradients() const {
    return std::visit([](const auto& arrays) { return Gradients(arrays.sdf_gradients); }, arrays_);
  }
  Gradients intensity_gradients() const {
    return std::visit([](const auto& arrays) { return Gradients(arrays.intensity_gradients); }, arrays_);
  }

 private:
  std::variant<LossArrays<float>, LossArrays<double>> arrays_;
};

template <typename T>
LossBatch<T> points_of(const Array<T>& points, const Array<T>& sdf_m) {
  const std::int64_t count = check_points(points);
  if (sdf_m.ndim() != 1 || sdf_m.shape(0) != count) throw std::invalid_argument("sdf_m must have shape (N,)");
  return {points.data(), sdf_m.data(), count};
}

template <typename T>
LossBatch<T> rays_of(const FieldLoss<T>& loss, const Array<T>& points, const Array<T>& sdf_m, const Rows<T>& rays,
                     std::int64_t num_labelled, const std::vector<Bytes>& dropout) {
  LossBatch<T> batch = points_of(points, sdf_m);
  check_shape(rays, batch.count, kRayColumns, "rays");
  batch.rays = rays.data();
  batch.ray_stride = row_stride(rays, "rays");
  if (num_labelled < 0 || num_labelled > batch.count) throw std::invalid_argument("num_labelled must be of the batch");
  batch.num_labelled = num_labelled;
  const std::int64_t columns[] = {loss.parameters().cells(), loss.parameters().waves()};
  if (dropout.size() > 2) throw std::invalid_argument("only the two encodings can have a dropout");
  for (std::size_t i = 0; i < dropout.size(); ++i) {
    check_shape(dropout[i].first, loss.num_seen(batch.count, num_labelled), columns[i], "dropout");
    if (dropout[i].second < 1) throw std::invalid_argument("a dropout must keep something");
    batch.dropout[i] = {dropout[i].first.data(), dropout[i].second};
  }
  return batch;
}

template <typename T>
FeatureGradients<T> by_features(const FieldLoss<T>& loss, std::int64_t count, Array<std::int32_t>& located,
                                Array<T>& interpolated_grad) {
  check_shape(located, count, loss.parameters().table->num_levels(), "located");
  check_shape(interpolated_grad, count, loss.parameters().levels(), "interpolated_grad");
  return {located.mutable_data(), interpolated_grad.mutable_data()};
}

template <typename T>
void bind_methods(py::class_<AnyFieldLoss>& cls) {
  using namespace py::literals;
  cls.def(
      py::init([](const VertexTable& table, const Array<T>& features, const std::tuple<double, int, int>& frequencies,
                  const Network<T>& sdf, const std::optional<Network<T>>& intensity, const std::array<bool, 3>& sees,
                  double sigma_m, bool intensity_in_free_space) {
        const auto [half_width_m, first, count] = frequencies;
        return std::make_unique<AnyFieldLoss>(
            std::in_place_type<LossArrays<T>>, table, features, Frequencies{half_width_m, first, count}, sdf, intensity,
            IntensityInputs{sees[0], sees[1], sees[2]}, LossOptions{sigma_m, intensity_in_free_space});
      }),
      py::keep_alive<1, 2>(), "table"_a, "features"_a.noconvert(), "frequencies"_a, "sdf"_a.noconvert(),
      "intensity"_a.noconvert(), "sees"_a, "sigma_m"_a, "intensity_in_free_space"_a,
      "`features` (num_rows, 8); `frequencies`: half width (m), the first exponent and how many; `sdf` and "
      "`intensity`: weights and biases of their layers, `intensity` may be None; `sees`: whether the intensity "
      "network sees SDF, viewing direction and range. The arrays are read anew by each call, where they are.");
  cls.def(
      "sdf",
      [](const AnyFieldLoss& self, const Array<T>& points, const Array<T>& sdf_m, double weight,
         Array<std::int32_t>& located, Array<T>& interpolated_grad) {
        const FieldLoss<T>& loss = self.of<T>().loss();
        const LossBatch<T> batch = points_of(points, sdf_m);
        const FeatureGradients<T> gradients = by_features(loss, batch.count, located, interpolated_grad);
        const py::gil_scoped_release release;
        return loss.sdf(batch, weight, gradients);
      },
      "points"_a.noconvert(), "sdf_m"_a.noconvert(), "weight"_a, "located"_a.noconvert(),
      "interpolated_grad"_a.noconvert(),
      "The mean loss of the signed distances `sdf_m` (N,) at `points` (N, 3), local frame, m. Writes the gradients of "
      "`weight` times it: to `sdf_gradients`, and by what is interpolated of the features to `interpolated_grad` (N, "
      "8 L), with the points' cells in `located` (N, L) int32.");
  cls.def(
      "joint",
      [](const AnyFieldLoss& self, const Array<T>& points, const Array<T>& sdf_m, const Rows<T>& rays,
         std::int64_t num_labelled, const std::vector<Bytes>& dropout, const std::pair<double, double>& weights,
         Array<std::int32_t>& located, Array<T>& interpolated_grad) {
        const FieldLoss<T>& loss = self.of<T>().loss();
        const LossBatch<T> batch = rays_of(loss, points, sdf_m, rays, num_labelled, dropout);
        const FeatureGradients<T> gradients = by_features(loss, batch.count, located, interpolated_grad);
        const py::gil_scoped_release release;
        const FieldLosses losses = loss.joint(batch, {weights.first, weights.second}, gradients);
        return std::pair(losses.sdf, losses.intensity);
      },
      "points"_a.noconvert(), "sdf_m"_a.noconvert(), "rays"_a.noconvert(), "num_labelled"_a, "dropout"_a, "weights"_a,
      "located"_a.noconvert(), "interpolated_grad"_a.noconvert(),
      "Like `sdf`, of both losses at once: their means, and the gradients of their sum weighted by `weights`. "
      "`rays` (N, 8) are the samples' rays; the intensities of the first `num_labelled` are labels. `dropout` has up "
      "to two pairs of bytes (samples seen, columns) and the number below which a byte keeps its column, of the "
      "encodings of cells and positions.");
  cls.def(
      "intensity",
      [](const AnyFieldLoss& self, const Array<T>& points, const Array<T>& sdf_m, const Rows<T>& rays,
         std::int64_t num_labelled, const std::vector<Bytes>& dropout, double weight) {
        const FieldLoss<T>& loss = self.of<T>().loss();
        const LossBatch<T> batch = rays_of(loss, points, sdf_m, rays, num_labelled, dropout);
        const py::gil_scoped_release release;
        return loss.intensity(batch, weight);
      },
      "points"_a.noconvert(), "sdf_m"_a.noconvert(), "rays"_a.noconvert(), "num_labelled"_a, "dropout"_a, "weight"_a,
      "Like `joint`, of the intensities alone while the SDF network and the features are frozen: writes to "
      "`intensity_gradients` only.");
}

}  // namespace

void bind_field_loss(py::module_& m) {
  py::class_<AnyFieldLoss> cls(
      m, "FieldLoss",
      "The losses of batches and their gradients, as the package's Field and its losses define "
      "them. One thread at a time may use an object.");
  bind_methods<float>(cls);
  bind_methods<double>(cls);
  cls.def_property_readonly("sdf_gradients", &AnyFieldLoss::sdf_gradients,
                            "By weights and biases of each layer of the SDF network in turn, as the last call that "
                            "trained it wrote them.");
  cls.def_property_readonly("intensity_gradients", &AnyFieldLoss::intensity_gradients,
                            "The same of the intensity network.");
}

}  // namespace radarsdf
