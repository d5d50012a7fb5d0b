#pragma once

#include <cstdint>
#include <memory>
#include <vector>

namespace radarsdf {

struct MeshComponents {
  std::unique_ptr<std::int32_t[]> labels;  ///< one per face; components are numbered in the order of their first faces
  std::vector<std::int64_t> sizes;         ///< faces per component
};

// Throws std::invalid_argument for a face with a vertex out of range.
void check_faces(const std::int32_t* faces, std::int64_t num_faces, std::int64_t num_vertices);

// faces: (num_faces, 3) vertices in [0, num_vertices). Faces are connected if they share a vertex. Serial union-find in
// nearly linear time.
MeshComponents mesh_components(const std::int32_t* faces, std::int64_t num_faces, std::int64_t num_vertices);

// areas: (num_vertices), a third of the area of the incident triangles (num_faces, 3) of each vertex (num_vertices, 3).
// Throws std::invalid_argument for a face with a vertex out of range.
void vertex_areas(const double* vertices, std::int64_t num_vertices, const std::int32_t* faces, std::int64_t num_faces,
                  double* areas);

}  // namespace radarsdf
