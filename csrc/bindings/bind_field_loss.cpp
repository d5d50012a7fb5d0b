#include <algorithm>
#include <array>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "bindings/held_thread_pool.hpp"
#include "bindings/layer_arrays.hpp"
#include "bindings/subjects.hpp"
#include "field/field_loss.hpp"
#include "field/ray_samples.hpp"

namespace radarsdf {
namespace {

using Network = std::pair<Arrays<float>, Arrays<float>>;  // weights and biases

using Drop = std::pair<std::uint64_t, int>;                        // seed of a dropout, and its `keep`
using Parts = std::vector<std::pair<std::int64_t, std::int64_t>>;  // samples, and samples with a label

// A FieldLoss with references to its parameters and to the gradients of the networks.
class LossArrays {
 public:
  LossArrays(const VertexTable& table, Array<float> features, const Frequencies& frequencies, Network sdf,
             std::optional<Network> intensity, IntensityInputs sees, const LossOptions& options)
      : features_(std::move(features)), sdf_(std::move(sdf)), intensity_(std::move(intensity)) {
    check_shape(features_, {table.num_rows(), kFeatureDim}, "features");
    FieldParameters parameters{&table, features_.data(), frequencies, layers_of(sdf_.first, sdf_.second), {}, sees};
    if (intensity_) parameters.intensity = layers_of(intensity_->first, intensity_->second);
    const NetworkGradients gradients{gradients_of(parameters.sdf, sdf_gradients),
                                     gradients_of(parameters.intensity, intensity_gradients)};
    loss_.emplace(parameters, options, gradients);
  }

  LossArrays(const LossArrays&) = delete;
  LossArrays& operator=(const LossArrays&) = delete;

  FieldLoss& loss() { return *loss_; }

  Arrays<float> sdf_gradients, intensity_gradients;  // weights and biases of each layer in turn

 private:
  static std::vector<LayerGradients<float>> gradients_of(const std::vector<Layer<float>>& layers,
                                                         Arrays<float>& arrays) {
    std::vector<LayerGradients<float>> gradients;
    for (const Layer<float>& layer : layers) {
      Array<float> weights = new_array<float>(layer.outputs, layer.inputs), biases = new_array<float>(layer.outputs);
      std::fill_n(weights.mutable_data(), weights.size(), 0.0F);
      std::fill_n(biases.mutable_data(), biases.size(), 0.0F);
      gradients.push_back({weights.mutable_data(), biases.mutable_data()});
      arrays.push_back(std::move(weights));
      arrays.push_back(std::move(biases));
    }
    return gradients;
  }

  Array<float> features_;
  Network sdf_;
  std::optional<Network> intensity_;
  std::optional<FieldLoss> loss_;
};

LossBatch batch_of(const Array<float>& points, const Array<float>& sdf_m, const Parts& parts,
                   const std::optional<Rows<float>>& rays, const std::vector<Drop>& dropout) {
  const std::int64_t count = check_points(points);
  check_shape(sdf_m, {count}, "sdf_m");
  LossBatch batch{points.data(), sdf_m.data(), {}};
  std::int64_t left = count;
  for (const auto& [samples, labelled] : parts) {
    if (labelled < 0 || labelled > samples || samples > left) {
      throw std::invalid_argument("parts must be of the batch");
    }
    left -= samples;
    batch.parts.push_back({samples, labelled});
  }
  if (left != 0) throw std::invalid_argument("each sample must be in a part");
  if (rays) {
    batch.rays = rays->data();
    batch.ray_stride = row_stride(*rays, count, kRayColumns, "rays");
  }
  if (dropout.size() > 2) throw std::invalid_argument("only the two encodings can have a dropout");
  for (std::size_t i = 0; i < dropout.size(); ++i) {
    if (dropout[i].second < 1) throw std::invalid_argument("a dropout must keep something");
    batch.dropout[i] = {dropout[i].first, dropout[i].second};
  }
  return batch;
}

void bind_losses(py::module_& m) {
  using namespace py::literals;
  py::class_<LossArrays> cls(
      m, "FieldLoss",
      "Losses of batches and their gradients, as defined by the package's neural field and losses. An object is not "
      "thread-safe.");
  cls.def(
      py::init([](const VertexTable& table, const Array<float>& features, const std::pair<double, int>& frequencies,
                  const Network& sdf, const std::optional<Network>& intensity, const std::array<bool, 2>& sees,
                  double sigma_m, bool intensity_in_free_space) {
        return std::make_unique<LossArrays>(table, features, Frequencies{frequencies.first, frequencies.second}, sdf,
                                            intensity, IntensityInputs{sees[0], sees[1]},
                                            LossOptions{sigma_m, intensity_in_free_space});
      }),
      py::keep_alive<1, 2>(), "table"_a, "features"_array, "frequencies"_a, "sdf"_array, "intensity"_array, "sees"_a,
      "sigma_m"_a, "intensity_in_free_space"_a,
      "`features` (num_rows, 8); `frequencies`: half width (m) and number; `sdf`, `intensity`: weights "
      "and biases of the layers, `intensity` may be None; `sees`: whether the intensity network has the inputs viewing "
      "direction and range. The arrays are kept by reference: each call reads their current values.");
  cls.def(
      "begin",
      [](LossArrays& self, const Array<float>& points, const Array<float>& sdf_m, const Parts& parts,
         const std::optional<Rows<float>>& rays, const std::vector<Drop>& dropout,
         std::optional<Array<std::int32_t>> located, std::optional<Array<float>> interpolated_grad,
         HeldThreadPool& pool) {
        FieldLoss& loss = self.loss();
        const LossBatch batch = batch_of(points, sdf_m, parts, rays, dropout);
        FeatureGradients gradients{nullptr, nullptr};
        if (located && interpolated_grad) {
          check_shape(*located, {points.shape(0), loss.parameters().table->num_levels()}, "located");
          check_shape(*interpolated_grad, {points.shape(0), loss.parameters().levels()}, "interpolated_grad");
          gradients = {located->mutable_data(), interpolated_grad->mutable_data()};
        }
        loss.begin(batch, gradients, pool.pool());
        pool.hold(py::make_tuple(py::cast(&self), points, sdf_m, rays, located, interpolated_grad));
      },
      "points"_array, "sdf_m"_array, "parts"_a, "rays"_array.none(true), "dropout"_a, "located"_array.none(true),
      "interpolated_grad"_array.none(true), "pool"_a,
      "Starts computing the mean losses of a batch and the gradients of their sum on the other threads of `pool`; "
      "`finish` waits for it. With `located` (N, L) int32 and `interpolated_grad` (N, 8 L), the loss of the signed "
      "distances `sdf_m` (N,) at `points` (N, 3), local frame, m: writes the cells of the points and the gradients by "
      "the interpolated features to these, else features and SDF network are frozen. With the `rays` (N, 8) of the "
      "samples, that of the intensities. `parts` are consecutive samples for one thread: numbers of samples, and of "
      "samples with intensity labels. Gradients are summed in the order of the parts, independent of the number of "
      "threads. `dropout` has up to two pairs, for the encodings of cells and positions: seed of `random_bytes` "
      "(samples seen, columns), and the bound below which a byte keeps its element.");
  cls.def(
      "finish",
      [](LossArrays& self, HeldThreadPool& pool) {
        const FieldLosses losses = pool.finish([&](ThreadPool& own) { return self.loss().finish(own); });
        return std::pair(losses.sdf, losses.intensity);
      },
      "pool"_a,
      "Joins the thread pool until the batch is complete. Returns both mean losses, 0 for one that was not requested.");
  cls.def_readonly("sdf_gradients", &LossArrays::sdf_gradients,
                   "Gradients by weights and biases of each layer of the SDF network in turn, written by the last call "
                   "that trained it.");
  cls.def_readonly("intensity_gradients", &LossArrays::intensity_gradients,
                   "Like `sdf_gradients`, of the intensity network.");
}

void bind_samples(py::module_& m) {
  using namespace py::literals;
  m.def(
      "draw_samples",
      [](const Array<float>& rays, const Array<std::int64_t>& places, const Array<std::int32_t>& ray,
         const Array<std::int32_t>& number, const Array<std::uint8_t>& kind, const Array<float>& segments,
         std::uint64_t seed) {
        if (rays.ndim() != 2 || rays.shape(1) < kRayIntensity || rays.shape(1) > kRayColumns) {
          throw std::invalid_argument("rays must have shape (N, 7) or (N, 8)");
        }
        const std::int64_t count = check_column(ray, "ray"), columns = rays.shape(1);
        const std::int64_t num_segments = check_rows(segments, 4, "segments");
        check_shape(number, {count}, "number");
        check_shape(kind, {count}, "kind");
        check_numbers(places, 0, rays.shape(0), "places");
        check_numbers(ray, 0, check_column(places, "places"), "ray");
        check_numbers(kind, 0, num_segments, "kind");
        static_assert(sizeof(RaySegment) == 4 * sizeof(float));
        const SampleLayout layout{ray.data(), number.data(), kind.data(),
                                  reinterpret_cast<const RaySegment*>(segments.data()), count};
        const TakenRays taken{rays.data(), columns, places.data()};
        Array<float> points = new_array<float>(count, 3), sdf_m = new_array<float>(count),
                     of_ray = new_array<float>(count, columns);
        draw_samples(taken, layout, seed, points.mutable_data(), sdf_m.mutable_data(), of_ray.mutable_data());
        return std::make_tuple(points, sdf_m, of_ray);
      },
      "rays"_array, "places"_array, "ray"_array, "number"_array, "kind"_array, "segments"_array, "seed"_a,
      "Random samples on `rays` (N, 7 or 8) float32: points (B, 3), m, signed distances along the ray to the return "
      "(B,), m, and rows of `rays`. Sample i is on ray `places[ray[i]]`; its random number, from `seed` and "
      "`number[i]`, is uniform in row `kind[i]` of `segments` (K, 4): start and length in metres, each a constant and "
      "a factor on the range.");
}

}  // namespace

void bind_field_loss(py::module_& m) {
  bind_samples(m);
  bind_losses(m);
}

}  // namespace radarsdf
