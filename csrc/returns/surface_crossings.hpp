// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Which rays passed through a surface before they ended: the mark of a ghost, a return over a mirror that the sensor
// places straight on, behind it.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/cell_blocks.hpp"

namespace radarsdf {

// A piece of plane in a cell, with what its returns tell about it.
struct Surfel {
  float centre[3];  ///< local frame, m
  float normal[3];  ///< unit, towards the sensors
  float thickness;  ///< standard deviation of the returns across the plane, m
  float reach;      ///< how far from the centre a ray crosses it in its cell, m
};

// Standard deviations of a return's position.
struct BeamNoise {
  float range_m;    ///< along the beam
  float angle_rad;  ///< across it
};

class SurfelMap {
 public:
  // keys: Morton keys of the surfels' cells, ascending, each once; surfels in the same order.
  SurfelMap(const std::uint64_t* keys, const Surfel* surfels, std::int64_t count, double cell_size_m);

  // For each ray the first surfel that it crosses from the front and ends behind of by more than
  // margin_m + sigmas standard deviations, -1 where there is none. points, directions: (count, 3), local frame, m.
  void first_crossings(const float* points, const float* directions, const float* ranges_m, std::int64_t count,
                       BeamNoise noise, float margin_m, float sigmas, std::int32_t* crossed, int num_threads) const;

 private:
  double cell_size_m_;
  CellBlocks cells_, blocks_;  // and the blocks that hold them
  std::vector<Surfel> surfels_;
};

}  // namespace radarsdf
