// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Where rays first meet a triangle mesh. Triangles are listed in the cells of a grid, and a bit says whether a cell has
// any. Cells lie in blocks of 4 x 4 x 4. A dense array holds for each block its list, or how many blocks round it are
// empty: a ray leaves that cube at once.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/cell_blocks.hpp"
#include "util/large_array.hpp"

namespace radarsdf {

class SurfaceTracer {
 public:
  // vertices: (num_vertices, 3), finite, m; faces: (num_faces, 3) rows of them. cell_size_m: edge of a cell, best one
  // or two edges of a triangle; of a very large mesh cells become larger. Throws std::invalid_argument.
  SurfaceTracer(const double* vertices, std::int64_t num_vertices, const std::int32_t* faces, std::int64_t num_faces,
                double cell_size_m);

  // For each ray the distance to the first triangle, m, infinite without one, and the triangle's row, -1 without one.
  // origin: (3), that of all rays; directions: (count, 3) unit vectors. Both sides of a triangle stop a ray, or the
  // front alone: the side from which its corners are counter-clockwise. Throws std::invalid_argument.
  void first_hits(const double* origin, const float* directions, std::int64_t count, double max_range_m,
                  bool front_only, float* ranges_m, std::int32_t* faces, int num_threads) const;

  double cell_size_m() const { return cell_size_m_; }
  std::int64_t num_bytes() const;

 private:
  struct Triangle {
    float corner[3], edges[2][3];  // of the first corner from the block's lower one, and from it to the others
    std::int32_t face;
  };
  struct Block {
    std::int32_t row;  // of `occupied_`, or -1
    // Blocks to the nearest that has triangles, along the axis that is farthest: all round, and at the same height.
    // Rays over the ground are long and low, so flat boxes take them farther than cubes.
    std::uint16_t gap, flat_gap;
  };
  struct Ray;
  struct Hit;

  void make_grid(const double* vertices, const std::int32_t* faces, std::int64_t num_faces);
  void list_triangles(const double* vertices, const std::int32_t* faces, std::int64_t num_faces);
  void measure_gaps();
  void sweep(bool flat, int step);
  Hit first_hit(const Ray& ray, double max_range_m, bool front_only) const;
  bool hit_in_block(const Ray& ray, const std::int64_t* block, const Occupancy& cells, double begin_m, double end_m,
                    bool front_only, Hit& hit) const;

  double cell_size_m_;
  double lower_[3] = {};
  std::int64_t size_[3] = {};  // blocks along each axis
  LargeVector<Block> blocks_;
  std::vector<Occupancy> occupied_;  // cells of a block that have triangles
  std::vector<std::int64_t> first_;  // triangle of each such cell, and the end
  LargeVector<Triangle> triangles_;  // cell by cell, in the order of their faces
};

}  // namespace radarsdf
