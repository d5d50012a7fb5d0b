// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// One iteration of returns/smooth_distances.cpp, compiled once for each instruction set (see
// interpolation_kernels.hpp). Vertices lie in blocks of 2 x 2 x 2, x fastest: a block is one vector, and the two
// vertices before and after it along an axis are those of the next block. Places that no vertex takes up are 0
// throughout, as is one more block, which stands for those that are missing.
#pragma once

#include <cstdint>

namespace radarsdf {

constexpr int kPlateVertices = 8;  // of a block

struct PlateSweep {
  const std::int32_t* neighbours;  ///< (blocks, 6), before and after along x, y, z
  // (blocks, 6), bit i: whether vertex i has neighbours on both sides along x, y, z; then whether the vertex next to
  // it has that belongs to the block before or after.
  const std::uint8_t* is_bent;
  const float* compliance;   ///< (blocks, 8), 1 / stiffness, 0 where nothing moves a vertex
  const std::int8_t* sides;  ///< (blocks, 8), of average_rays
  const float* before_m;     ///< (blocks + 1, 8), distances
  float* after_m;            ///< (blocks + 1, 8), of the iteration before, and of this one
  float* pulls_m;            ///< (blocks, 8), by the places of planes; 0 afterwards
  float keep, gain;          ///< of Chebyshev's iteration
  float least_m;             ///< distance of a vertex whose side is known
};

// At most one place in each of the 2 x 2 x 2 cells of a block, where the distance is known.
struct PlateLayer {
  float weights[8];  ///< 0 without a place
  // Two numbers of 16 bits each: the shares of the cell's upper corners along x and y; that along z and the distance,
  // of 0 to 2 leaf cells from one behind the plane on.
  std::uint32_t x_and_y[8], z_and_leaf[8];
};
constexpr int kPlateQuanta = 65535;  // of a share

// Blocks of cells with places. Their cells have the places of the blocks of vertices.
struct PlatePlaces {
  const std::int32_t* corners;  ///< (blocks, 8), blocks of vertices; where there is none, the first one
  const std::int32_t* first;    ///< (blocks + 1), layer of each block
  const PlateLayer* layers;
  float leaf_m;
};

struct PlateKernels {
  void (*sweep)(const PlateSweep& plates, std::int64_t begin, std::int64_t end);  // blocks
  void (*pull)(const PlatePlaces& places, const float* distances_m, float* pulls_m, std::int64_t begin,
               std::int64_t end);  // blocks of cells
};

#define RADARSDF_DECLARE_KERNEL(isa) \
  namespace isa {                    \
  PlateKernels plate_kernels();      \
  }
RADARSDF_DECLARE_KERNEL(baseline)
RADARSDF_DECLARE_KERNEL(avx2)
RADARSDF_DECLARE_KERNEL(avx512)
#undef RADARSDF_DECLARE_KERNEL

}  // namespace radarsdf
