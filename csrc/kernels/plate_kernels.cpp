// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "kernels/plate_kernels.hpp"

#include "kernels/vector.hpp"

#if defined(__GNUC__)
#define RADARSDF_RESTRICT __restrict__
#elif defined(_MSC_VER)
#define RADARSDF_RESTRICT __restrict
#else
#define RADARSDF_RESTRICT
#endif

namespace radarsdf::RADARSDF_ISA {
namespace {

constexpr int kEdge = 4, kLayer = kEdge * kEdge;
constexpr float kFar_m = 3e38F;
constexpr int kRow = 8;  // along x: a row with two places of the block before and of the one after

inline void copy(float* to, const float* from, int count) {
  memcpy(to, from, static_cast<std::size_t>(count) * sizeof(float));
}

// Where they are bent, second differences of `values`, and of these once more: the slopes of the sum of their squares.
template <int kBends, int kStride>
inline void slopes_of(const float* values, const std::uint8_t* is_bent, float* slopes) {
  float bends[kBends + 2 * kStride];
  for (int i = 0; i < kBends; ++i)
    bends[i] = static_cast<float>(is_bent[i]) * (values[i] + values[i + 2 * kStride] - 2 * values[i + kStride]);
  for (int i = kBends; i < kBends + 2 * kStride; ++i) bends[i] = 0;
  constexpr int kSlopes = kStride == 1 ? kBends : kBends - 2 * kStride;
  for (int i = 0; i < kSlopes; ++i) slopes[i] = bends[i] + bends[i + 2 * kStride] - 2 * bends[i + kStride];
}

// A step of all vertices of a block. None of these arrays overlaps another.
inline void move(const float* RADARSDF_RESTRICT own_m, const float* RADARSDF_RESTRICT compliance,
                 const float* RADARSDF_RESTRICT slopes_m, const float* RADARSDF_RESTRICT more_slopes_m,
                 const float* RADARSDF_RESTRICT lower_m, const float* RADARSDF_RESTRICT upper_m, float keep, float gain,
                 float* RADARSDF_RESTRICT pulls_m, float* RADARSDF_RESTRICT steps_m, float* RADARSDF_RESTRICT after_m) {
  for (int i = 0; i < kPlateVertices; ++i) {
    const float slope_m = slopes_m[i] + more_slopes_m[i] + pulls_m[i];
    const float free_m = own_m[i] + keep * steps_m[i] - gain * (slope_m * compliance[i]);
    const float above_m = free_m < lower_m[i] ? lower_m[i] : free_m;
    const float moved_m = above_m > upper_m[i] ? upper_m[i] : above_m;
    steps_m[i] = moved_m - own_m[i];
    after_m[i] = moved_m;
    pulls_m[i] = 0;
  }
}

void sweep(const PlateSweep& plates, std::int64_t begin, std::int64_t end) {
  float along_x[kBendsAlongX + 2] = {}, along_y[kBendsAlongYZ + 2 * kLayer], along_z[kBendsAlongYZ + 2 * kLayer];
  float by_x[kBendsAlongX], by_y[kPlateVertices], by_z[kPlateVertices], slopes_m[kPlateVertices];
  float lower_m[kPlateVertices], upper_m[kPlateVertices];
  std::int8_t side[kPlateVertices];
  const float least_m = plates.least_m;
  for (std::int64_t block = begin; block < end; ++block) {
    const float* own = plates.before_m + kPlateVertices * block;
    const float* sides[6];
    for (int i = 0; i < 6; ++i)
      sides[i] = plates.before_m + kPlateVertices * std::int64_t{plates.neighbours[6 * block + i]};
    for (int row = 0; row < kLayer; ++row) {
      copy(along_x + kRow * row, sides[0] + kEdge * row + 2, 2);
      copy(along_x + kRow * row + 2, own + kEdge * row, kEdge);
      copy(along_x + kRow * row + 2 + kEdge, sides[1] + kEdge * row, 2);
    }
    for (int z = 0; z < kEdge; ++z) {
      for (int y = 0; y < 2; ++y) {
        copy(along_y + kLayer * y + kEdge * z, sides[2] + kLayer * z + kEdge * (y + 2), kEdge);
        copy(along_y + kLayer * (y + 6) + kEdge * z, sides[3] + kLayer * z + kEdge * y, kEdge);
      }
      for (int y = 0; y < kEdge; ++y) copy(along_y + kLayer * (y + 2) + kEdge * z, own + kLayer * z + kEdge * y, kEdge);
    }
    copy(along_z, sides[4] + 2 * kLayer, 2 * kLayer);
    copy(along_z + 2 * kLayer, own, kPlateVertices);
    copy(along_z + 2 * kLayer + kPlateVertices, sides[5], 2 * kLayer);

    const std::uint8_t* is_bent = plates.is_bent + kPlateBends * block;
    slopes_of<kBendsAlongX, 1>(along_x, is_bent, by_x);
    slopes_of<kBendsAlongYZ, kLayer>(along_y, is_bent + kBendsAlongX, by_y);
    slopes_of<kBendsAlongYZ, kLayer>(along_z, is_bent + kBendsAlongX + kBendsAlongYZ, by_z);
    for (int z = 0; z < kEdge; ++z) {
      for (int y = 0; y < kEdge; ++y) {
        const int row = kLayer * z + kEdge * y;
        for (int x = 0; x < kEdge; ++x)
          slopes_m[row + x] = by_x[kRow / kEdge * row + x] + by_y[kLayer * y + kEdge * z + x];
      }
    }
    float* pulls_m = plates.pulls_m + kPlateVertices * block;
    float* steps_m = plates.steps_m + kPlateVertices * block;
    memcpy(side, plates.sides + kPlateVertices * block, sizeof side);  // a char may be part of anything that is written
    for (int i = 0; i < kPlateVertices; ++i) {
      lower_m[i] = side[i] > 0 ? least_m : -kFar_m;
      upper_m[i] = side[i] < 0 ? -least_m : kFar_m;
    }
    move(own, plates.compliance + kPlateVertices * block, slopes_m, by_z, lower_m, upper_m, plates.keep, plates.gain,
         pulls_m, steps_m, plates.after_m + kPlateVertices * block);
  }
}

void pull(const PlatePlaces& places, const float* distances_m, float* pulls_m, std::int64_t begin, std::int64_t end) {
  using Corners = VectorOf<float, 8>::Type;
  for (std::int64_t cell = begin; cell < end; ++cell) {
    const std::int32_t* corners = places.corners + 8 * cell;
    float at_corners_m[8];
    for (int c = 0; c < 8; ++c) at_corners_m[c] = distances_m[corners[c]];
    const auto distances = load_vector<Corners>(at_corners_m);
    Corners pulls = {};
    for (std::int64_t k = places.first[cell]; k < places.first[cell + 1]; ++k) {
      const auto shares = load_vector<Corners>(places.shares + 8 * k);
      const Corners products = shares * distances;
      const float off_m = ((products[0] + products[4]) + (products[1] + products[5])) +
                          ((products[2] + products[6]) + (products[3] + products[7])) - places.targets_m[k];
      pulls += off_m * shares;
    }
    for (int c = 0; c < 8; ++c) pulls_m[corners[c]] += pulls[c];
  }
}

}  // namespace

PlateKernels plate_kernels() { return {sweep, pull}; }

}  // namespace radarsdf::RADARSDF_ISA
