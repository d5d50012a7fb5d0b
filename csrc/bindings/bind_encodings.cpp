#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "field/encodings.hpp"
#include "kernels/fourier_kernels.hpp"

namespace radarsdf {
namespace {

template <typename T>
void bind_fixed_encodings(py::module_& m) {
  using namespace py::literals;
  m.def(
      "fourier",
      [](const Array<T>& points, double half_width_m, int first_frequency, int num_frequencies, Rows<T>& out,
         int num_threads) {
        if (points.ndim() != 2) throw std::invalid_argument("points must have shape (N, 3)");
        check_shape(points, points.shape(0), 3, "points");
        if (!(half_width_m > 0)) throw std::invalid_argument("half_width_m must be positive");
        if (first_frequency < 0 || num_frequencies < 0 || first_frequency > kMaxFrequencies ||
            num_frequencies > kMaxFrequencies - first_frequency) {
          throw std::invalid_argument("frequencies must lie in [0, " + std::to_string(kMaxFrequencies) + ")");
        }
        check_shape(out, points.shape(0), 6 * num_frequencies, "out");
        const std::int64_t stride = row_stride(out, "out"), count = points.shape(0);
        const T* p = points.data();
        T* result = out.mutable_data();
        const py::gil_scoped_release release;
        fourier(p, count, half_width_m, first_frequency, num_frequencies, result, stride, num_threads);
      },
      "points"_a.noconvert(), "half_width_m"_a, "first_frequency"_a, "num_frequencies"_a, "out"_a.noconvert(),
      "num_threads"_a = 0, "Writes sin and cos of 2^k pi x / half_width_m to `out` (N, 6 num_frequencies).");
  m.def(
      "spherical_harmonics",
      [](const Array<T>& directions, Rows<T>& out, int num_threads) {
        if (directions.ndim() != 2) throw std::invalid_argument("directions must have shape (N, 3)");
        check_shape(directions, directions.shape(0), 3, "directions");
        check_shape(out, directions.shape(0), 16, "out");
        const std::int64_t stride = row_stride(out, "out"), count = directions.shape(0);
        const T* d = directions.data();
        T* result = out.mutable_data();
        const py::gil_scoped_release release;
        spherical_harmonics(d, count, result, stride, num_threads);
      },
      "directions"_a.noconvert(), "out"_a.noconvert(), "num_threads"_a = 0,
      "Writes the real spherical harmonics of degrees 0 to 3 of unit vectors (N, 3) to `out` (N, 16).");
}

}  // namespace

void bind_encodings(py::module_& m) {
  bind_fixed_encodings<float>(m);
  bind_fixed_encodings<double>(m);
}

}  // namespace radarsdf
