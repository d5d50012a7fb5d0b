// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <array>
#include <optional>
#include <tuple>
#include <utility>
#include <vector>

#include "bindings/layer_arrays.hpp"
#include "bindings/subjects.hpp"
#include "field/field_loss.hpp"
#include "kernels/fourier_kernels.hpp"

namespace radarsdf {
namespace {

template <typename T>
using Network = std::pair<Arrays<T>, Arrays<T>>;  // weights and biases, or their gradients

using Bytes = std::pair<Array<std::uint8_t>, int>;  // of a dropout, and what it keeps

template <typename T>
std::int64_t check_batch(const VertexTable& table, const Array<T>& features, const Array<T>& points,
                         const Array<T>& sdf_m, const Rows<T>& rays, std::int64_t num_near,
                         std::int64_t intensity_count, bool with_intensity) {
  check_shape(features, table.num_rows(), kFeatureDim, "features");
  const std::int64_t count = points.ndim() == 2 ? points.shape(0) : 0;
  check_shape(points, count, 3, "points");
  if (sdf_m.ndim() != 1 || sdf_m.shape(0) != count) throw std::invalid_argument("sdf_m must have shape (N,)");
  check_shape(rays, count, with_intensity ? kRayColumns : rays.ndim() == 2 ? rays.shape(1) : 0, "rays");
  if (num_near < 0 || num_near > count || intensity_count < 0 || intensity_count > count)
    throw std::invalid_argument("num_near and intensity_count must be of the batch");
  return count;
}

Dropout dropout_of(const Bytes& bytes, std::int64_t rows, std::int64_t columns) {
  check_shape(bytes.first, rows, columns, "dropout");
  if (bytes.second < 1) throw std::invalid_argument("a dropout must keep something");
  return {bytes.first.data(), bytes.second};
}

template <typename T>
void bind_loss(py::module_& m) {
  using namespace py::literals;
  m.def(
      "field_loss",
      [](const VertexTable& table, const Array<T>& features, const std::tuple<double, int, int>& frequencies,
         const Network<T>& sdf, const std::optional<Network<T>>& intensity, const std::array<bool, 3>& sees,
         const Array<T>& points, const Array<T>& sdf_m, const Rows<T>& rays, std::int64_t num_near,
         std::int64_t intensity_count, const std::vector<Bytes>& dropout, double sigma_m, double sdf_weight,
         double intensity_weight, std::optional<Network<T>>& sdf_grads, std::optional<Network<T>>& intensity_grads,
         Array<std::int32_t>& located, std::optional<Array<T>>& interpolated_grad) {
        const std::int64_t count =
            check_batch(table, features, points, sdf_m, rays, num_near, intensity_count, intensity.has_value());
        const auto [half_width_m, first, num_frequencies] = frequencies;
        FieldLayers<T> field{
            &table, features.data(), half_width_m, first,  num_frequencies, layers_of(sdf.first, sdf.second),
            {},     sees[0],         sees[1],      sees[2]};
        if (first < 0 || num_frequencies < 0 || first > kMaxFrequencies || num_frequencies > kMaxFrequencies - first)
          throw std::invalid_argument("there are no such frequencies");
        if (field.sdf[0].inputs != field.cells() + field.waves())
          throw std::invalid_argument("the SDF network must see the encodings of cells and positions");
        if (intensity) {
          field.intensity = layers_of(intensity->first, intensity->second);
          if (field.intensity[0].inputs != field.intensity_inputs() || field.intensity.back().outputs != 1) {
            throw std::invalid_argument("the intensity network must have one output, and see what it is said to");
          }
        }
        if (sdf_grads.has_value() != interpolated_grad.has_value() ||
            intensity.has_value() != intensity_grads.has_value())
          throw std::invalid_argument("there must be gradients of what is trained");
        check_shape(located, count, table.num_levels(), "located");
        FieldGradients<T> gradients{{}, {}, located.mutable_data(), nullptr};
        if (sdf_grads) {
          gradients.sdf = layer_gradients_of(sdf_grads->first, sdf_grads->second, field.sdf);
          check_shape(*interpolated_grad, count, field.levels(), "interpolated_grad");
          gradients.interpolated = interpolated_grad->mutable_data();
        }
        if (intensity_grads)
          gradients.intensity = layer_gradients_of(intensity_grads->first, intensity_grads->second, field.intensity);
        LossBatch<T> batch{points.data(), sdf_m.data(), rays.data(),     row_stride(rays, "rays"),
                           count,         num_near,     intensity_count, {}};
        const std::int64_t columns[] = {field.cells(), field.waves()};
        if (dropout.size() > 2) throw std::invalid_argument("only the two encodings can have a dropout");
        for (std::size_t i = 0; i < dropout.size(); ++i) {
          batch.dropout[i] = dropout_of(dropout[i], intensity_count, columns[i]);
        }
        const py::gil_scoped_release release;
        const FieldLosses losses = field_loss(field, batch, {sigma_m, sdf_weight, intensity_weight}, gradients);
        return std::pair(losses.sdf, losses.intensity);
      },
      "table"_a, "features"_a.noconvert(), "frequencies"_a, "sdf"_a.noconvert(), "intensity"_a.noconvert(), "sees"_a,
      "points"_a.noconvert(), "sdf_m"_a.noconvert(), "rays"_a.noconvert(), "num_near"_a, "intensity_count"_a,
      "dropout"_a, "sigma_m"_a, "sdf_weight"_a, "intensity_weight"_a, "sdf_grads"_a.noconvert(),
      "intensity_grads"_a.noconvert(), "located"_a.noconvert(), "interpolated_grad"_a.noconvert(),
      "Gives the mean losses of SDF and intensity and writes their weighted gradients: see radarsdf.shards.");
}

}  // namespace

void bind_field_loss(py::module_& m) {
  bind_loss<float>(m);
  bind_loss<double>(m);
}

}  // namespace radarsdf
