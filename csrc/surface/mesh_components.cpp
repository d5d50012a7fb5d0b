#include "surface/mesh_components.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>

#include "util/integers.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr int64_t faces_between_checks = 1 << 16;

// Union-find with path halving.
int32_t find_root(int32_t* parents, int32_t vertex) {
  while (parents[vertex] != vertex) vertex = parents[vertex] = parents[parents[vertex]];
  return vertex;
}

}  // namespace

MeshComponents mesh_components(const int32_t* faces, int64_t num_faces, int64_t num_vertices) {
  if (num_vertices < 0 || num_vertices > std::numeric_limits<int32_t>::max()) {
    throw std::invalid_argument("the number of vertices must be in the range of int32");
  }
  for (int64_t i = 0; i < 3 * num_faces; ++i) {
    if (faces[i] < 0 || faces[i] >= num_vertices) {
      throw std::invalid_argument("a face refers to a vertex that does not exist");
    }
  }
  std::vector<int32_t> parents(static_cast<std::size_t>(num_vertices));
  std::iota(parents.begin(), parents.end(), 0);
  for (int64_t f = 0; f < num_faces; ++f) {
    if (f % faces_between_checks == 0) check_interrupt();
    int32_t root = find_root(parents.data(), faces[3 * f]);
    for (int64_t i = 1; i < 3; ++i) {
      const int32_t other = find_root(parents.data(), faces[3 * f + i]);
      parents[static_cast<std::size_t>(std::max(root, other))] = std::min(root, other);
      root = std::min(root, other);
    }
  }
  MeshComponents components;
  components.labels.reset(new int32_t[static_cast<std::size_t>(num_faces)]);
  std::vector<int32_t> label_of_root(parents.size(), -1);
  for (int64_t f = 0; f < num_faces; ++f) {
    if (f % faces_between_checks == 0) check_interrupt();
    int32_t& label = label_of_root[static_cast<std::size_t>(find_root(parents.data(), faces[3 * f]))];
    if (label < 0) {
      label = static_cast<int32_t>(components.sizes.size());
      components.sizes.push_back(0);
    }
    components.labels[static_cast<std::size_t>(f)] = label;
    ++components.sizes[static_cast<std::size_t>(label)];
  }
  return components;
}

void vertex_areas(const double* vertices, int64_t num_vertices, const int32_t* faces, int64_t num_faces,
                  double* areas) {
  for (int64_t v = 0; v < num_vertices; ++v) areas[v] = 0;
  for (int64_t f = 0; f < num_faces; ++f) {
    if (f % (1 << 18) == 0) check_interrupt();
    const double* corners[3];
    for (int c = 0; c < 3; ++c) {
      const int32_t v = faces[3 * f + c];
      if (v < 0 || v >= num_vertices) throw std::invalid_argument("a face refers to a vertex that does not exist");
      corners[c] = vertices + 3 * int64_t{v};
    }
    double a[3], b[3];
    for (int axis = 0; axis < 3; ++axis) {
      a[axis] = corners[1][axis] - corners[0][axis];
      b[axis] = corners[2][axis] - corners[0][axis];
    }
    const double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
    const double sixth = std::sqrt(x * x + y * y + z * z) / 6;
    for (int c = 0; c < 3; ++c) areas[faces[3 * f + c]] += sixth;
  }
}

}  // namespace radarsdf
