#include "surface/mesh_components.hpp"

#include <algorithm>
#include <limits>
#include <numeric>
#include <stdexcept>

#include "util/integers.hpp"
#include "util/parallel.hpp"
#include "util/vec3.hpp"

namespace radarsdf {
namespace {

constexpr int64_t faces_between_checks = 1 << 16;

// Union-find with path halving.
int32_t find_root(int32_t* parents, int32_t vertex) {
  while (parents[vertex] != vertex) vertex = parents[vertex] = parents[parents[vertex]];
  return vertex;
}

}  // namespace

void check_faces(const int32_t* faces, int64_t num_faces, int64_t num_vertices) {
  for (int64_t i = 0; i < 3 * num_faces; ++i) {
    if (faces[i] < 0 || faces[i] >= num_vertices) {
      throw std::invalid_argument("a face refers to a vertex that does not exist");
    }
  }
}

MeshComponents mesh_components(const int32_t* faces, int64_t num_faces, int64_t num_vertices) {
  if (num_vertices < 0 || num_vertices > std::numeric_limits<int32_t>::max()) {
    throw std::invalid_argument("the number of vertices must be in the range of int32");
  }
  check_faces(faces, num_faces, num_vertices);
  std::vector<int32_t> parents(num_vertices);
  std::iota(parents.begin(), parents.end(), 0);
  for (int64_t f = 0; f < num_faces; ++f) {
    if (f % faces_between_checks == 0) check_interrupt();
    int32_t root = find_root(parents.data(), faces[3 * f]);
    for (int64_t i = 1; i < 3; ++i) {
      const int32_t other = find_root(parents.data(), faces[3 * f + i]);
      parents[std::max(root, other)] = std::min(root, other);
      root = std::min(root, other);
    }
  }
  MeshComponents components;
  components.labels.reset(new int32_t[num_faces]);
  std::vector<int32_t> label_of_root(parents.size(), -1);
  for (int64_t f = 0; f < num_faces; ++f) {
    if (f % faces_between_checks == 0) check_interrupt();
    int32_t& label = label_of_root[find_root(parents.data(), faces[3 * f])];
    if (label < 0) {
      label = static_cast<int32_t>(components.sizes.size());
      components.sizes.push_back(0);
    }
    components.labels[f] = label;
    ++components.sizes[label];
  }
  return components;
}

void vertex_areas(const double* vertices, int64_t num_vertices, const int32_t* faces, int64_t num_faces,
                  double* areas) {
  check_faces(faces, num_faces, num_vertices);
  std::fill_n(areas, num_vertices, 0.0);
  for (int64_t f = 0; f < num_faces; ++f) {
    if (f % (1 << 18) == 0) check_interrupt();
    const int32_t* face = faces + 3 * f;
    const Vec3 first = vec3(vertices, face[0]);
    const double sixth = norm(cross(vec3(vertices, face[1]) - first, vec3(vertices, face[2]) - first)) / 6;
    for (int c = 0; c < 3; ++c) areas[face[c]] += sixth;
  }
}

}  // namespace radarsdf
