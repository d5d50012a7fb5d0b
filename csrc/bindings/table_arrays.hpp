// Validated arrays of a vertex table.
#pragma once

#include <pybind11/stl.h>

#include <optional>

#include "bindings/arrays.hpp"
#include "field/encodings.hpp"

namespace radarsdf {

// Validated arguments of kernels on located points.
template <typename T>
PointBatch<T> point_batch(const VertexTable& table, const Array<T>& points, const Array<std::int32_t>& located,
                          const std::optional<Array<T>>& directions) {
  const std::int64_t count = check_points(points);
  check_shape(located, {count, table.num_levels()}, "located");
  if (directions) check_shape(*directions, {count, 3}, "directions");
  return {points.data(), directions ? directions->data() : nullptr, located.data(), count};
}

}  // namespace radarsdf
