#include "kernels/plate_kernels.hpp"

#include "kernels/vector.hpp"
#include "util/prefetch.hpp"

#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define RADARSDF_SHUFFLE(a, b, lane) \
  __builtin_shufflevector(a, b, lane(0), lane(1), lane(2), lane(3), lane(4), lane(5), lane(6), lane(7))
#endif
#endif

namespace radarsdf::RADARSDF_ISA {
namespace {

using Floats = VectorOf<float, kPlateVertices>::Type;
constexpr std::int64_t kAhead = 8;  // blocks: prefetch distance, scattered vertices are cache misses

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

// The lower and the upper 16 bits of each number.
inline void unpack(const std::uint32_t* numbers, Floats& lower, Floats& upper) {
#ifdef RADARSDF_SHUFFLE
  using Integers = VectorOf<int, kPlateVertices>::Type;
  using Bits = VectorOf<std::uint32_t, kPlateVertices>::Type;
  const auto bits = load_vector<Bits>(numbers);
  lower = __builtin_convertvector((Integers)(bits & 0xffffU), Floats);
  upper = __builtin_convertvector((Integers)(bits >> 16), Floats);
#else
  float lanes[2][kPlateVertices];
  for (int i = 0; i < kPlateVertices; ++i) {
    lanes[0][i] = static_cast<float>(numbers[i] & 0xffffU);
    lanes[1][i] = static_cast<float>(numbers[i] >> 16);
  }
  lower = load_vector<Floats>(lanes[0]);
  upper = load_vector<Floats>(lanes[1]);
#endif
}

// Lanes of the first operand where the bit of the lane index is set, else of the second.
template <int kBit>
constexpr int set_or_second(int i) {
  return i + ((i & kBit) != 0 ? 0 : kPlateVertices);
}

// Values at corner c of the eight cells of a block, from the adjacent blocks, in two shuffles.
template <int kBit>
inline void to_corners(Floats* corners) {
  for (int c = 0; c < kPlateVertices; ++c) {
    if ((c & kBit) == 0) continue;
    const Floats ahead = shuffled<set_or_second<kBit>>(corners[c ^ kBit], corners[c]);
    corners[c] = shuffled<across<kBit>>(ahead, ahead);
  }
}

// Adjoint of `to_corners`: accumulates the values at corners in the adjacent blocks.
template <int kBit>
inline void from_corners(Floats* corners) {
  for (int c = 0; c < kPlateVertices; ++c) {
    if ((c & kBit) == 0) continue;
    const Floats back = shuffled<across<kBit>>(corners[c], corners[c]), zero = {};
    corners[c ^ kBit] += shuffled<set_or_second<kBit>>(back, zero);
    corners[c] = shuffled<set_or_second<kBit>>(zero, back);
  }
}

void pull(const PlateConstraints& constraints, const float* distances_m, float* pulls_m, std::int64_t begin,
          std::int64_t end) {
  for (std::int64_t block = begin; block < end; ++block) {
    const std::int32_t* blocks = constraints.corners + 8 * block;
    const Floats one = {1, 1, 1, 1, 1, 1, 1, 1};
    Floats corners[8], pulls[8] = {};
    const std::int64_t ahead = block + kAhead < end ? kAhead : 0;
    prefetch(blocks + 16 * ahead);
    prefetch(constraints.layers + constraints.first[block + ahead]);
    for (int c = 0; c < 8; ++c) {
      const std::int64_t later = kPlateVertices * std::int64_t{blocks[8 * ahead + c]};
      prefetch(distances_m + later);
      prefetch(pulls_m + later);
      corners[c] = load_vector<Floats>(distances_m + kPlateVertices * std::int64_t{blocks[c]});
    }
    to_corners<1>(corners);
    to_corners<2>(corners);
    to_corners<4>(corners);
    for (std::int32_t k = constraints.first[block]; k < constraints.first[block + 1]; ++k) {
      const ConstraintLayer& layer = constraints.layers[k];
      Floats upper[3], leaves, values[8];
      unpack(layer.x_and_y, upper[0], upper[1]);
      unpack(layer.z_and_leaf, upper[2], leaves);
      for (int axis = 0; axis < 3; ++axis) upper[axis] = (1.0F / kPlateQuanta) * upper[axis];
      for (int c = 0; c < 8; ++c) values[c] = corners[c];
      for (int axis = 3; axis-- > 0;)
        for (int c = 0; c < 1 << axis; ++c) values[c] += upper[axis] * (values[c + (1 << axis)] - values[c]);
      const auto weights = load_vector<Floats>(layer.weights);
      values[0] = weights * (values[0] - constraints.leaf_m * (leaves - one));
      for (int axis = 0; axis < 3; ++axis) {
        for (int c = 0; c < 1 << axis; ++c) {
          values[c + (1 << axis)] = upper[axis] * values[c];
          values[c] = values[c] - values[c + (1 << axis)];
        }
      }
      for (int c = 0; c < 8; ++c) pulls[c] += values[c];
    }
    from_corners<4>(pulls);
    from_corners<2>(pulls);
    from_corners<1>(pulls);
    for (int c = 0; c < 8; ++c) {
      float* to = pulls_m + kPlateVertices * std::int64_t{blocks[c]};
      store_vector(to, load_vector<Floats>(to) + pulls[c]);
    }
  }
}

}  // namespace

PlateKernels plate_kernels() { return {sweep, pull}; }

}  // namespace radarsdf::RADARSDF_ISA
