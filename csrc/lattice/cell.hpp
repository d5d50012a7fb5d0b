// Constants of occupied cells. Kernels include them once for each instruction set.
#pragma once

namespace radarsdf {

constexpr int kFeatureDim = 8;  // floats per vertex: one AVX register, as in the paper
constexpr int kMaxLevels = 12;
constexpr int kMaxCorners = 12;

enum class Encoding { kTriQuadtree, kOctree };

}  // namespace radarsdf
