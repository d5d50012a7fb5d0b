#include "returns/scan_rays.hpp"

#include <algorithm>
#include <cstring>

#include "lattice/morton.hpp"
#include "util/bits.hpp"
#include "util/parallel.hpp"
#include "util/vec3.hpp"

namespace radarsdf {
namespace {

constexpr double kLeast_m = 1e-6;  // lower bound of ranges, which are divisors

}  // namespace

std::int64_t scan_rays(const PlacedScans& scans, double min_range_m, bool* kept, float* points, float* directions,
                       float* ranges_m, int num_threads) {
  parallel_for(scans.count, 1 << 13, num_threads, [&](std::int64_t i) {
    const std::int64_t scan = scans.scans[i];
    const Vec3 in_sensor = vec3(scans.points, i);
    const double from_sensor_m = norm(in_sensor);
    kept[i] = from_sensor_m > 0 && from_sensor_m >= min_range_m && from_sensor_m <= scans.max_ranges_m[scan];
    if (!kept[i]) return;
    const auto row = [&](int axis) { return dot(vec3(scans.rotations, 3 * scan + axis), in_sensor); };
    const Vec3 point = Vec3{row(0), row(1), row(2)} + vec3(scans.positions, scan);
    const Vec3 ray = point - vec3(scans.seen_from, scan);
    const double range_m = std::max(norm(ray), kLeast_m);
    store(point, points + 3 * i);
    store(ray / range_m, directions + 3 * i);
    ranges_m[i] = static_cast<float>(range_m);
  });
  std::int64_t rows = 0;
  for (std::int64_t i = 0; i < scans.count; ++i) {
    if (!kept[i]) continue;
    std::copy_n(points + 3 * i, 3, points + 3 * rows);
    std::copy_n(directions + 3 * i, 3, directions + 3 * rows);
    ranges_m[rows++] = ranges_m[i];
  }
  return rows;
}

void hash_rays(const float* directions, const float* ranges_m, const float* intensities, std::int64_t count,
               std::uint64_t* keys, int num_threads) {
  // Directions and ranges of a tile differ in their last bits, which only decide among rays that are equal otherwise.
  constexpr float kPerMetre = 64;
  constexpr std::uint64_t kLastBits = 0xffffff;
  parallel_for(count, 1 << 13, num_threads, [&](std::int64_t i) {
    const float *d = directions + 3 * i, intensity = intensities != nullptr ? intensities[i] : 0.0F;
    const float numbers[5] = {d[0], d[1], d[2], ranges_m[i], intensity};
    std::uint32_t bits[5];
    std::memcpy(bits, numbers, sizeof bits);
    std::uint64_t coarse = 0, fine = 0;
    for (int k = 0; k < (intensities != nullptr ? 5 : 4); ++k) {
      const auto place = [&] { return floor_to_int<std::int64_t>(kPerMetre * numbers[k]); };
      coarse = mixed(coarse, k < 4 ? static_cast<std::uint32_t>(place()) : bits[k]);
      fine = mixed(fine, bits[k]);
    }
    keys[i] = (coarse & ~kLastBits) | (fine & kLastBits);
  });
}

}  // namespace radarsdf
