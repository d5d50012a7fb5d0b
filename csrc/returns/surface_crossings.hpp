// Surface crossings of rays before their ends: the signature of a ghost, a return reflected by a mirror, which the
// sensor places behind it.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/cell_blocks.hpp"

namespace radarsdf {

// Plane of the returns in a cell.
struct Surfel {
  float centre[3];  ///< local frame, m
  float normal[3];  ///< unit, towards the sensors
  float thickness;  ///< standard deviation of the returns across the plane, m
  float reach;      ///< largest distance of a crossing from the centre, within the cell, m
};

// Standard deviations of a return's position.
struct BeamNoise {
  float range_m;    ///< along the beam
  float angle_rad;  ///< across it
};

class SurfelMap {
 public:
  // keys: unique ascending Morton keys of the surfels' cells; surfels in the same order.
  SurfelMap(const std::uint64_t* keys, const Surfel* surfels, std::int64_t count, double cell_size_m);

  // For each ray the first surfel that it crosses from the front and behind which it ends by more than margin_m +
  // sigmas standard deviations, or -1. points, directions: (count, 3), local frame, m.
  void first_crossings(const float* points, const float* directions, const float* ranges_m, std::int64_t count,
                       BeamNoise noise, float margin_m, float sigmas, std::int32_t* crossed, int num_threads) const;

 private:
  double cell_size_m_;
  CellBlocks cells_;
  std::vector<Surfel> surfels_;
};

}  // namespace radarsdf
