#include <algorithm>
#include <array>
#include <memory>
#include <optional>
#include <tuple>
#include <utility>
#include <variant>
#include <vector>

#include "bindings/held_thread_pool.hpp"
#include "bindings/layer_arrays.hpp"
#include "bindings/subjects.hpp"
#include "field/field_loss.hpp"
#include "field/ray_samples.hpp"

namespace radarsdf {
namespace {

template <typename T>
using Network = std::pair<Arrays<T>, Arrays<T>>;  // weights and biases

using Drop = std::pair<std::uint64_t, int>;                        // seed of a dropout, and its `keep`
using Parts = std::vector<std::pair<std::int64_t, std::int64_t>>;  // samples, and samples with a label

// A FieldLoss with references to its parameters and to the gradients of the networks.
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

  FieldLoss<T>& loss() { return *loss_; }

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

// FieldLoss in Python: of the dtype of the features.
class AnyFieldLoss {
 public:
  template <typename Kind, typename... Arguments>
  explicit AnyFieldLoss(std::in_place_type_t<Kind> kind, Arguments&&... arguments)
      : arrays_(kind, std::forward<Arguments>(arguments)...) {}

  AnyFieldLoss(const AnyFieldLoss&) = delete;
  AnyFieldLoss& operator=(const AnyFieldLoss&) = delete;

  template <typename T>
  LossArrays<T>& of() {
    auto* arrays = std::get_if<LossArrays<T>>(&arrays_);
    if (arrays == nullptr) throw py::type_error("the batch must have the dtype of the features");
    return *arrays;
  }

  std::pair<double, double> finish(HeldThreadPool& pool) {
    const FieldLosses losses = std::visit(
        [&](auto& arrays) {
          auto& loss = arrays.loss();
          return pool.finish([&](ThreadPool& own) { return loss.finish(own); });
        },
        arrays_);
    return {losses.sdf, losses.intensity};
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
LossBatch<T> points_of(const Array<T>& points, const Array<T>& sdf_m, const Parts& parts) {
  const std::int64_t count = check_points(points);
  if (sdf_m.ndim() != 1 || sdf_m.shape(0) != count) throw std::invalid_argument("sdf_m must have shape (N,)");
  LossBatch<T> batch{points.data(), sdf_m.data(), {}};
  std::int64_t left = count;
  for (const auto& [samples, labelled] : parts) {
    if (labelled < 0 || labelled > samples || samples > left) {
      throw std::invalid_argument("parts must be of the batch");
    }
    left -= samples;
    batch.parts.push_back({samples, labelled});
  }
  if (left != 0) throw std::invalid_argument("each sample must be in a part");
  return batch;
}

template <typename T>
LossBatch<T> rays_of(const Array<T>& points, const Array<T>& sdf_m, const Parts& parts, const Rows<T>& rays,
                     const std::vector<Drop>& dropout) {
  LossBatch<T> batch = points_of(points, sdf_m, parts);
  check_shape(rays, points.shape(0), kRayColumns, "rays");
  batch.rays = rays.data();
  batch.ray_stride = row_stride(rays, "rays");
  if (dropout.size() > 2) throw std::invalid_argument("only the two encodings can have a dropout");
  for (std::size_t i = 0; i < dropout.size(); ++i) {
    if (dropout[i].second < 1) throw std::invalid_argument("a dropout must keep something");
    batch.dropout[i] = {dropout[i].first, dropout[i].second};
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
      "`features` (num_rows, 8); `frequencies`: half width (m), first exponent and number; `sdf`, `intensity`: weights "
      "and biases of the layers, `intensity` may be None; `sees`: whether the intensity network has the inputs SDF, "
      "viewing direction and range. The arrays are kept by reference: each call reads their current values.");
  cls.def(
      "begin_sdf",
      [](AnyFieldLoss& self, const Array<T>& points, const Array<T>& sdf_m, const Parts& parts, double weight,
         Array<std::int32_t>& located, Array<T>& interpolated_grad, HeldThreadPool& pool) {
        FieldLoss<T>& loss = self.of<T>().loss();
        const LossBatch<T> batch = points_of(points, sdf_m, parts);
        const FeatureGradients<T> gradients = by_features(loss, points.shape(0), located, interpolated_grad);
        loss.begin_sdf(batch, weight, gradients, pool.pool());
        pool.hold(py::make_tuple(py::cast(&self), points, sdf_m, located, interpolated_grad));
      },
      "points"_a.noconvert(), "sdf_m"_a.noconvert(), "parts"_a, "weight"_a, "located"_a.noconvert(),
      "interpolated_grad"_a.noconvert(), "pool"_a,
      "Starts computing the mean loss of the signed distances `sdf_m` (N,) at `points` (N, 3), local frame, m, on the "
      "other threads of `pool`; `finish` waits for it. `parts` are consecutive samples for one thread: numbers of "
      "samples, and of samples with intensity labels. Gradients are summed in the order of the parts, independent of "
      "the number of threads. Gradients of `weight` times the loss are written to `sdf_gradients` and, by the "
      "interpolated features, to `interpolated_grad` (N, 8 L), the cells of the points to `located` (N, L) int32.");
  cls.def(
      "begin_joint",
      [](AnyFieldLoss& self, const Array<T>& points, const Array<T>& sdf_m, const Parts& parts, const Rows<T>& rays,
         const std::vector<Drop>& dropout, const std::pair<double, double>& weights, Array<std::int32_t>& located,
         Array<T>& interpolated_grad, HeldThreadPool& pool) {
        FieldLoss<T>& loss = self.of<T>().loss();
        const LossBatch<T> batch = rays_of(points, sdf_m, parts, rays, dropout);
        const FeatureGradients<T> gradients = by_features(loss, points.shape(0), located, interpolated_grad);
        loss.begin_joint(batch, {weights.first, weights.second}, gradients, pool.pool());
        pool.hold(py::make_tuple(py::cast(&self), points, sdf_m, rays, located, interpolated_grad));
      },
      "points"_a.noconvert(), "sdf_m"_a.noconvert(), "parts"_a, "rays"_a.noconvert(), "dropout"_a, "weights"_a,
      "located"_a.noconvert(), "interpolated_grad"_a.noconvert(), "pool"_a,
      "Like `begin_sdf`, for both losses: their means, and the gradients of their sum weighted by `weights`. `rays` "
      "(N, 8) are the rays of the samples. `dropout` has up to two pairs, for the encodings of cells and positions: "
      "seed of `random_bytes` (samples seen, columns), and the bound below which a byte keeps its element.");
  cls.def(
      "begin_intensity",
      [](AnyFieldLoss& self, const Array<T>& points, const Array<T>& sdf_m, const Parts& parts, const Rows<T>& rays,
         const std::vector<Drop>& dropout, double weight, HeldThreadPool& pool) {
        FieldLoss<T>& loss = self.of<T>().loss();
        const LossBatch<T> batch = rays_of(points, sdf_m, parts, rays, dropout);
        loss.begin_intensity(batch, weight, pool.pool());
        pool.hold(py::make_tuple(py::cast(&self), points, sdf_m, rays));
      },
      "points"_a.noconvert(), "sdf_m"_a.noconvert(), "parts"_a, "rays"_a.noconvert(), "dropout"_a, "weight"_a, "pool"_a,
      "Like `begin_joint`, for the intensities alone, with frozen SDF network and features: writes to "
      "`intensity_gradients` only.");
}

template <typename T>
void check_below(const Array<T>& numbers, std::int64_t end, const char* message) {
  const T* n = numbers.data();
  if (std::any_of(n, n + numbers.size(), [&](T number) { return number < 0 || number >= end; })) {
    throw std::invalid_argument(message);
  }
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
        if (check_column(number, "number") != count || check_column(kind, "kind") != count) {
          throw std::invalid_argument("ray, number and kind must have the same length");
        }
        check_shape(segments, segments.shape(0), 4, "segments");
        check_below(places, rays.shape(0), "places must be rows of rays");
        check_below(ray, check_column(places, "places"), "ray must lie in [0, len(places))");
        check_below(kind, segments.shape(0), "kind must be a row of segments");
        static_assert(sizeof(RaySegment) == 4 * sizeof(float));
        const SampleLayout layout{ray.data(), number.data(), kind.data(),
                                  reinterpret_cast<const RaySegment*>(segments.data()), count};
        const TakenRays taken{rays.data(), columns, places.data()};
        Array<float> points(std::vector<std::int64_t>{count, 3}), sdf_m(count);
        Array<float> of_ray(std::vector<std::int64_t>{count, columns});
        draw_samples(taken, layout, seed, points.mutable_data(), sdf_m.mutable_data(), of_ray.mutable_data());
        return std::make_tuple(points, sdf_m, of_ray);
      },
      "rays"_a.noconvert(), "places"_a.noconvert(), "ray"_a.noconvert(), "number"_a.noconvert(), "kind"_a.noconvert(),
      "segments"_a.noconvert(), "seed"_a,
      "Random samples on `rays` (N, 7 or 8) float32: points (B, 3), m, signed distances along the ray to the return "
      "(B,), m, and rows of `rays`. Sample i is on ray `places[ray[i]]`; its random number, from `seed` and "
      "`number[i]`, is uniform in row `kind[i]` of `segments` (K, 4): start and length in metres, each a constant and "
      "a factor on the range.");
}

}  // namespace

void bind_field_loss(py::module_& m) {
  bind_samples(m);
  py::class_<AnyFieldLoss> cls(
      m, "FieldLoss",
      "Losses of batches and their gradients, as defined by the package's neural field and losses. An object is not "
      "thread-safe.");
  bind_methods<float>(cls);
  bind_methods<double>(cls);
  cls.def(
      "finish", &AnyFieldLoss::finish, py::arg("pool"),
      "Joins the thread pool until the batch is complete. Returns both mean losses, 0 for one that was not requested.");
  cls.def_property_readonly("sdf_gradients", &AnyFieldLoss::sdf_gradients,
                            "Gradients by weights and biases of each layer of the SDF network in turn, written by the "
                            "last call that trained it.");
  cls.def_property_readonly("intensity_gradients", &AnyFieldLoss::intensity_gradients,
                            "Like `sdf_gradients`, of the intensity network.");
}

}  // namespace radarsdf
