// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// One iteration of returns/smooth_distances.cpp, compiled once for each instruction set (see
// interpolation_kernels.hpp). Vertices lie in blocks of 4 x 4 x 4, x fastest, so that neighbours along an axis are
// neighbours in memory. Places that no vertex takes up are 0 throughout, as is one more block, which stands for those
// that are missing.
#pragma once

#include <cstdint>

namespace radarsdf {

constexpr int kPlateVertices = 64;  // of a block
// Second differences along an axis that reach into a block. Along x: for each of 16 rows from its place -1 to 4, and
// two more that count nowhere. Along y and z: for each of six layers, from -1 to 4, 16 places, of which x is the
// fastest.
constexpr int kBendsAlongX = 128, kBendsAlongYZ = 96, kPlateBends = kBendsAlongX + 2 * kBendsAlongYZ;

struct PlateSweep {
  const std::int32_t* neighbours;  ///< (blocks, 6), before and after along x, y, z
  const std::uint8_t* is_bent;     ///< (blocks, kPlateBends), whether there is a vertex with neighbours on both sides
  const float* compliance;         ///< (blocks, 64), 1 / stiffness, 0 where nothing moves a vertex
  const std::int8_t* sides;        ///< (blocks, 64), of average_rays
  const float* before_m;           ///< (blocks + 1, 64), distances
  float* after_m;                  ///< (blocks + 1, 64)
  float* steps_m;                  ///< (blocks, 64), of the last iteration, and of this one
  float* pulls_m;                  ///< (blocks, 64), by the places of planes; 0 afterwards
  float keep, gain;                ///< of Chebyshev's iteration
  float least_m;                   ///< distance of a vertex whose side is known
};

// Places where the distance is known, in cells.
struct PlatePlaces {
  const std::int32_t* corners;  ///< (cells, 8), vertices
  const std::int64_t* first;    ///< (cells + 1), place of each cell
  const float* shares;          ///< (places, 8), of the corners, times the square root of the weight
  const float* targets_m;       ///< (places), times the square root of the weight
};

struct PlateKernels {
  void (*sweep)(const PlateSweep& plates, std::int64_t begin, std::int64_t end);  // blocks
  void (*pull)(const PlatePlaces& places, const float* distances_m, float* pulls_m, std::int64_t begin,
               std::int64_t end);  // cells
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
