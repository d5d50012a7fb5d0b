#include "kernels/interpolation_kernels.hpp"

#include "kernels/feature_vector.hpp"
#include "util/prefetch.hpp"

namespace radarsdf::RADARSDF_ISA {
namespace {  // internal linkage for everything: see the header

// A group of corners interpolates along NumAxes axes: a plane of the tri-quadtree along two, a cell of space along
// three.
template <int NumGroupsV, int NumAxesV>
struct Corners {
  static constexpr int kGroups = NumGroupsV, kAxes = NumAxesV, kPerGroup = 1 << NumAxesV;
};
using Planes = Corners<3, 2>;
using Space = Corners<1, 3>;

// The i-th axis of a group: planes xy, xz, yz; or x, y, z.
template <typename C>
constexpr int axis_of(int group, int i) {
  if (C::kAxes == 3) return i;
  return i == 0 ? (group == 2 ? 1 : 0) : (group == 0 ? 1 : 2);
}

// Position of a point in its cell.
template <typename T>
struct Local {
  T fraction[3];
  T inverse_size;  // 1/m
};

template <typename T>
inline Local<T> local_coordinates(const Interpolation<T>& in, std::int64_t n, int level) {
  Local<T> local;
  const T scale = T(1) / static_cast<T>(1 << level);  // a power of two: cells of a point are exactly nested
  local.inverse_size = in.inverse_leaf_size * scale;
  for (int axis = 0; axis < 3; ++axis) {
    const T u = in.points[3 * n + axis] * in.inverse_leaf_size * scale;
    const auto truncated = static_cast<T>(static_cast<std::int32_t>(u));
    local.fraction[axis] = u - (u < truncated ? truncated - 1 : truncated);
  }
  return local;
}

// Product over the group's axes of the linear basis function of corner c, or, along the axes in the bit mask
// `derivatives`, of its derivative (1/m). Second derivatives along one axis are zero and never requested.
template <typename C, typename T>
inline T basis(const Local<T>& local, int group, int c, int derivatives) {
  T product = 1;
  for (int i = 0; i < C::kAxes; ++i) {
    const bool upper = c >> i & 1;
    const T f = local.fraction[axis_of<C>(group, i)];
    if (derivatives >> i & 1) {
      product *= upper ? local.inverse_size : -local.inverse_size;
    } else {
      product *= upper ? f : 1 - f;
    }
  }
  return product;
}

// W_k of the header for the corners of one group.
template <typename C, bool kDirectional, typename T>
inline void corner_weights(const Local<T>& local, const T* direction, int group, T* weights) {
  for (int c = 0; c < C::kPerGroup; ++c) {
    if (!kDirectional) {
      weights[c] = basis<C>(local, group, c, 0);
    } else {
      weights[c] = 0;
      for (int i = 0; i < C::kAxes; ++i)
        weights[c] += direction[axis_of<C>(group, i)] * basis<C>(local, group, c, 1 << i);
    }
  }
}

// dW_k/dx along the i-th axis of the group.
template <typename C, bool kDirectional, typename T>
inline T corner_weight_gradient(const Local<T>& local, const T* direction, int group, int c, int i) {
  if (!kDirectional) return basis<C>(local, group, c, 1 << i);
  T sum = 0;
  for (int j = 0; j < C::kAxes; ++j) {
    if (j != i) sum += direction[axis_of<C>(group, j)] * basis<C>(local, group, c, 1 << i | 1 << j);
  }
  return sum;
}

// Rows of the corners of a group of a cell.
template <typename C, typename T>
inline const std::int32_t* rows_of(const Interpolation<T>& in, std::int32_t cell, int group) {
  const std::int32_t face = C::kGroups == 1 ? cell : in.faces[std::int64_t{cell} * C::kGroups + group];
  return in.rows + std::int64_t{face} * C::kPerGroup;
}

template <typename T>
inline const T* direction_of(const Interpolation<T>& in, std::int64_t n) {
  return in.directions ? in.directions + 3 * n : nullptr;
}

template <typename C, bool kDirectional, typename T>
void interpolate(const Interpolation<T>& in, const T* __restrict features, T* __restrict out, std::int64_t stride,
                 std::int64_t begin, std::int64_t end) {
  constexpr std::int64_t kAhead = 3;  // points
  for (std::int64_t n = begin; n < end; ++n) {
    for (int level = 0; level < in.num_levels && n + 2 * kAhead < end; ++level) {
      const std::int32_t later = in.located[(n + 2 * kAhead) * in.num_levels + level];
      const std::int32_t soon = in.located[(n + kAhead) * in.num_levels + level];
      for (int group = 0; group < C::kGroups; ++group) {
        if (later >= 0) prefetch(rows_of<C>(in, later, group));
        if (soon < 0) continue;
        const std::int32_t* rows = rows_of<C>(in, soon, group);
        for (int c = 0; c < C::kPerGroup; ++c) prefetch(features + std::int64_t{rows[c]} * kFeatureDim);
      }
    }
    for (int level = 0; level < in.num_levels; ++level) {
      Features<T> sum = {};
      const std::int32_t cell = in.located[n * in.num_levels + level];
      if (cell >= 0) {
        const Local<T> local = local_coordinates(in, n, level);
        T weights[kMaxCorners];
        for (int group = 0; group < C::kGroups; ++group) {
          corner_weights<C, kDirectional>(local, direction_of(in, n), group, weights + group * C::kPerGroup);
        }
        for (int group = 0; group < C::kGroups; ++group) {
          const std::int32_t* rows = rows_of<C>(in, cell, group);
          for (int c = 0; c < C::kPerGroup; ++c)
            sum += weights[group * C::kPerGroup + c] * load(features + std::int64_t{rows[c]} * kFeatureDim);
        }
      }
      store(out + n * stride + level * kFeatureDim, sum);
    }
  }
}

// Accumulators of row gradients, with or without a list of touched rows.
template <typename T>
struct AllRows {
  T* gradients;
  void prefetch_row(std::int32_t) const {}
  void add(std::int32_t row, Features<T> gradient) {
    T* sum = gradients + static_cast<std::int64_t>(row) * kFeatureDim;
    store(sum, load(sum) + gradient);
  }
};

template <typename T>
struct TouchedRows {
  RowSums<T> touched;
  void prefetch_row(std::int32_t row) const { prefetch(touched.states + row); }
  void add(std::int32_t row, Features<T> gradient) {
    // Branch-free: whether a row is new is unpredictable, and a misprediction costs more than the sum.
    const std::int32_t known = touched.states[row].place;
    touched.rows[touched.count] = row;
    touched.count += known == 0;
    const std::int32_t place = known == 0 ? static_cast<std::int32_t>(touched.count) : known;
    touched.states[row].place = place;
    T* sum = touched.sums + static_cast<std::int64_t>(place - 1) * kFeatureDim;
    store(sum, load(sum) + gradient);
  }
};

// The group is a template constant, so that code of other groups is eliminated. Arguments are passed by value: with
// references, the compiler would have to assume that every store to the sums aliases them.
template <typename C, bool kDirectional, int kGroup, typename T, typename Sums>
Sums scatter(Interpolation<T> in, const T* __restrict out_grad, std::int64_t stride, Sums sums, int level,
             std::int64_t begin, std::int64_t end) {
  constexpr std::int64_t kAhead = 12;  // points
  for (std::int64_t n = begin; n < end; ++n) {
    if (n + kAhead < end) {
      const std::int32_t later = in.located[(n + kAhead) * in.num_levels + level];
      if (later >= 0) prefetch(rows_of<C>(in, later, kGroup));
      const std::int32_t soon = in.located[(n + kAhead / 2) * in.num_levels + level];
      if (soon >= 0) {
        for (int c = 0; c < C::kPerGroup; ++c) sums.prefetch_row(rows_of<C>(in, soon, kGroup)[c]);
      }
    }
    const std::int32_t cell = in.located[n * in.num_levels + level];
    if (cell < 0) continue;
    T weights[C::kPerGroup];
    corner_weights<C, kDirectional>(local_coordinates(in, n, level), direction_of(in, n), kGroup, weights);
    const Features<T> grad = load(out_grad + n * stride + level * kFeatureDim);
    const std::int32_t* rows = rows_of<C>(in, cell, kGroup);
    for (int c = 0; c < C::kPerGroup; ++c) sums.add(rows[c], weights[c] * grad);
  }
  return sums;
}

template <typename C, typename T, typename Sums>
Sums scatter_group(const Interpolation<T>& in, const T* out_grad, std::int64_t stride, Sums sums, int level, int group,
                   std::int64_t begin, std::int64_t end) {
  constexpr int kSecond = C::kGroups > 1 ? 1 : 0, kThird = C::kGroups > 1 ? 2 : 0;
  if (in.directions) {
    return (group == 0   ? scatter<C, true, 0, T, Sums>
            : group == 1 ? scatter<C, true, kSecond, T, Sums>
                         : scatter<C, true, kThird, T, Sums>)(in, out_grad, stride, sums, level, begin, end);
  }
  return (group == 0   ? scatter<C, false, 0, T, Sums>
          : group == 1 ? scatter<C, false, kSecond, T, Sums>
                       : scatter<C, false, kThird, T, Sums>)(in, out_grad, stride, sums, level, begin, end);
}

template <typename C, bool kDirectional, typename T>
void coordinate_gradient(const Interpolation<T>& in, const T* __restrict features, const T* __restrict out_grad,
                         std::int64_t stride, T* __restrict points_grad, std::int64_t begin, std::int64_t end) {
  for (std::int64_t n = begin; n < end; ++n) {
    Features<T> sum[3] = {};  // one lane per feature, reduced once per point
    for (int level = 0; level < in.num_levels; ++level) {
      const std::int32_t cell = in.located[n * in.num_levels + level];
      if (cell < 0) continue;
      const Local<T> local = local_coordinates(in, n, level);
      const Features<T> grad = load(out_grad + n * stride + level * kFeatureDim);
      for (int group = 0; group < C::kGroups; ++group) {
        const std::int32_t* rows = rows_of<C>(in, cell, group);
        for (int c = 0; c < C::kPerGroup; ++c) {
          const Features<T> product = load(features + std::int64_t{rows[c]} * kFeatureDim) * grad;
          for (int i = 0; i < C::kAxes; ++i) {
            const T weight = corner_weight_gradient<C, kDirectional>(local, direction_of(in, n), group, c, i);
            sum[axis_of<C>(group, i)] += weight * product;
          }
        }
      }
    }
    for (int axis = 0; axis < 3; ++axis) {
      T total = 0;
      for (int d = 0; d < kFeatureDim; ++d) total += sum[axis][d];
      points_grad[3 * n + axis] = total;
    }
  }
}

// The version with or without directions is selected once per call, not once per point.
template <typename C, typename T>
constexpr InterpolationKernels<T> kKernels = {
    [](const Interpolation<T>& in, const T* features, T* out, std::int64_t stride, std::int64_t begin,
       std::int64_t end) {
      (in.directions ? interpolate<C, true, T> : interpolate<C, false, T>)(in, features, out, stride, begin, end);
    },
    [](const Interpolation<T>& in, const T* out_grad, std::int64_t stride, T* features_grad, int level, int group,
       std::int64_t begin, std::int64_t end) {
      scatter_group<C>(in, out_grad, stride, AllRows<T>{features_grad}, level, group, begin, end);
    },
    [](const Interpolation<T>& in, const T* out_grad, std::int64_t stride, RowSums<T>& touched, int level, int group,
       std::int64_t begin, std::int64_t end) {
      touched = scatter_group<C>(in, out_grad, stride, TouchedRows<T>{touched}, level, group, begin, end).touched;
    },
    [](const Interpolation<T>& in, const T* features, const T* out_grad, std::int64_t stride, T* points_grad,
       std::int64_t begin, std::int64_t end) {
      (in.directions ? coordinate_gradient<C, true, T>
                     : coordinate_gradient<C, false, T>)(in, features, out_grad, stride, points_grad, begin, end);
    }};

}  // namespace

template <typename T>
const InterpolationKernels<T>& interpolation_kernels(Encoding encoding) {
  return encoding == Encoding::kTriQuadtree ? kKernels<Planes, T> : kKernels<Space, T>;
}

template const InterpolationKernels<float>& interpolation_kernels(Encoding);
template const InterpolationKernels<double>& interpolation_kernels(Encoding);

}  // namespace radarsdf::RADARSDF_ISA
