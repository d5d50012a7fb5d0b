// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "kernels/plate_kernels.hpp"

#include "kernels/vector.hpp"

#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define RADARSDF_SHUFFLE(a, b, lane) \
  __builtin_shufflevector(a, b, lane(0), lane(1), lane(2), lane(3), lane(4), lane(5), lane(6), lane(7))
#endif
#endif

namespace radarsdf::RADARSDF_ISA {
namespace {

using Floats = VectorOf<float, kPlateVertices>::Type;

// Lane i of the result is lane kLane(i) of `first` and `second` concatenated.
template <int (*kLane)(int)>
inline Floats shuffled(const Floats& first, const Floats& second) {
#ifdef RADARSDF_SHUFFLE
  return RADARSDF_SHUFFLE(first, second, kLane);
#else
  float lanes[kPlateVertices];
  for (int i = 0; i < kPlateVertices; ++i)
    lanes[i] = kLane(i) < kPlateVertices ? first[kLane(i)] : second[kLane(i) - kPlateVertices];
  return load_vector<Floats>(lanes);
#endif
}

// Neighbours of vertex i along an axis: the other vertex of its block; the adjacent one in the previous or next block;
// the second one there.
template <int kBit>
constexpr int across(int i) {
  return i ^ kBit;
}
template <int kBit>
constexpr int next_to(int i) {
  return (i ^ kBit) + ((i & kBit) != 0 ? kPlateVertices : 0);
}
template <int kBit>
constexpr int beyond(int i) {
  return i + ((i & kBit) != 0 ? kPlateVertices : 0);
}

// Derivative of the sum of squared second differences along an axis, where distances are bent: second differences of
// second differences.
template <int kBit>
inline Floats slopes(const Floats& own, const Floats& before, const Floats& after, const Floats& is_bent,
                     const Floats& next_is_bent) {
  const Floats next = shuffled<next_to<kBit>>(before, after);
  const Floats bends = is_bent * (next + shuffled<across<kBit>>(own, own) - 2.0F * own);
  const Floats next_bends = next_is_bent * (shuffled<beyond<kBit>>(before, after) + own - 2.0F * next);
  return next_bends + shuffled<across<kBit>>(bends, bends) - 2.0F * bends;
}

// Vectors with 1 in the lanes of set bits.
struct BitVectors {
  float lanes[256][kPlateVertices] = {};

  constexpr BitVectors() {
    for (int bits = 0; bits < 256; ++bits)
      for (int i = 0; i < kPlateVertices; ++i) lanes[bits][i] = static_cast<float>(bits >> i & 1);
  }
};
constexpr BitVectors kBitVectors;

void sweep(const PlateSweep& plates, std::int64_t begin, std::int64_t end) {
  const float least_m = plates.least_m;
  for (std::int64_t block = begin; block < end; ++block) {
    const std::int32_t* neighbours = plates.neighbours + 6 * block;
    const auto next = [&](int i) {
      return load_vector<Floats>(plates.before_m + kPlateVertices * std::int64_t{neighbours[i]});
    };
    const std::uint8_t* is_bent = plates.is_bent + 6 * block;
    const auto bent = [&](int i) { return load_vector<Floats>(kBitVectors.lanes[is_bent[i]]); };
    float* pulls_m = plates.pulls_m + kPlateVertices * block;
    float* after_m = plates.after_m + kPlateVertices * block;
    const auto own = load_vector<Floats>(plates.before_m + kPlateVertices * block);
    Floats slope = slopes<1>(own, next(0), next(1), bent(0), bent(3));
    slope += slopes<2>(own, next(2), next(3), bent(1), bent(4));
    slope += slopes<4>(own, next(4), next(5), bent(2), bent(5));
    slope += load_vector<Floats>(pulls_m);
    const auto compliance = load_vector<Floats>(plates.compliance + kPlateVertices * block);
    const Floats step = own - load_vector<Floats>(after_m);
    store_vector(after_m, own + plates.keep * step - plates.gain * (slope * compliance));
    store_vector(pulls_m, Floats{});
    std::int8_t sides[kPlateVertices];
    memcpy(sides, plates.sides + kPlateVertices * block, sizeof sides);
    std::uint64_t any = 0;
    memcpy(&any, sides, sizeof any);
    if (any == 0) continue;
    for (int i = 0; i < kPlateVertices; ++i) {
      if (sides[i] > 0 && after_m[i] < least_m) after_m[i] = least_m;
      if (sides[i] < 0 && after_m[i] > -least_m) after_m[i] = -least_m;
    }
  }
}

void pull(const PlatePlaces& places, const float* distances_m, float* pulls_m, std::int64_t begin, std::int64_t end) {
  for (std::int64_t cell = begin; cell < end; ++cell) {
    const std::int32_t* corners = places.corners + 8 * cell;
    // Through memory, the vector load would wait for eight stores.
    const Floats distances = {distances_m[corners[0]], distances_m[corners[1]], distances_m[corners[2]],
                              distances_m[corners[3]], distances_m[corners[4]], distances_m[corners[5]],
                              distances_m[corners[6]], distances_m[corners[7]]};
    Floats pulls = {};
    for (std::int32_t k = places.first[cell]; k < places.first[cell + 1]; ++k) {
      const auto shares = load_vector<Floats>(places.shares + 8 * std::int64_t{k});
      const Floats products = shares * distances;
      const Floats pairs = products + shuffled<across<4>>(products, products);
      const Floats fours = pairs + shuffled<across<1>>(pairs, pairs);
      const float target_m = places.targets_m[k];
      pulls += (fours + shuffled<across<2>>(fours, fours) - target_m) * shares;  // every lane holds the full sum
    }
    float of_corners[kPlateVertices];
    store_vector(of_corners, pulls);
    for (int c = 0; c < kPlateVertices; ++c) pulls_m[corners[c]] += of_corners[c];
  }
}

}  // namespace

PlateKernels plate_kernels() { return {sweep, pull}; }

}  // namespace radarsdf::RADARSDF_ISA
