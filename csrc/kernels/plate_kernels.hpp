// One iteration of returns/smooth_distances.cpp, compiled once for each instruction set (see
// interpolation_kernels.hpp). Vertices are stored in blocks of 2 x 2 x 2, x fastest: a block is one vector, and the two
// vertices before and after it along an axis are those of the adjacent block. Missing vertices are 0 throughout, as is
// an extra block that stands for missing blocks.
#pragma once

#include <cstdint>

namespace radarsdf {

constexpr int kPlateVertices = 8;  // per block

struct PlateSweep {
  const std::int32_t* neighbours;  ///< (blocks, 6), blocks before and after along x, y, z
  // (blocks, 6), bit i: whether vertex i has neighbours on both sides along x, y, z; then whether its neighbour in the
  // adjacent block has.
  const std::uint8_t* is_bent;
  const float* compliance;   ///< (blocks, 8), 1 / stiffness, 0 for vertices without any
  const std::int8_t* sides;  ///< (blocks, 8), see average_rays
  const float* before_m;     ///< (blocks + 1, 8), current distances
  float* after_m;            ///< (blocks + 1, 8), in: previous distances, out: next ones
  float* pulls_m;            ///< (blocks, 8), data gradient of the planes; reset to 0
  float keep, gain;          ///< coefficients of the Chebyshev iteration
  float least_m;             ///< minimum distance of a vertex with a known side
};

// Points with known distance, at most one in each of the 2 x 2 x 2 cells of a block; for the layout see
// returns/smooth_distances.cpp.
struct ConstraintLayer {
  float weights[8];  ///< 0 without a constraint
  // Two 16-bit fields each: the interpolation weights of the upper corners along x and y; the weight along z and the
  // distance, 0 to 2 leaf cells from one behind the plane.
  std::uint32_t x_and_y[8], z_and_leaf[8];
};
constexpr int kPlateQuanta = 65535;  // steps of an interpolation weight

// Blocks of cells with constraints.
struct PlateConstraints {
  const std::int32_t* corners;  ///< (blocks, 8), blocks of vertices; the first one where missing
  const std::int32_t* first;    ///< (blocks + 1), first layer of each block
  const ConstraintLayer* layers;
  float leaf_m;
};

struct PlateKernels {
  void (*sweep)(const PlateSweep& plates, std::int64_t begin, std::int64_t end);  // blocks
  void (*pull)(const PlateConstraints& constraints, const float* distances_m, float* pulls_m, std::int64_t begin,
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
