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
        const std::int64_t count = check_points(points);
        if (!(half_width_m > 0)) throw std::invalid_argument("half_width_m must be positive");
        if (first_frequency < 0 || num_frequencies < 0 || first_frequency > kMaxFrequencies ||
            num_frequencies > kMaxFrequencies - first_frequency) {
          throw std::invalid_argument("frequencies must lie in [0, " + std::to_string(kMaxFrequencies) + ")");
        }
        const std::int64_t stride = row_stride(out, count, 6 * num_frequencies, "out");
        const py::gil_scoped_release release;
        fourier(points.data(), count, half_width_m, first_frequency, num_frequencies, out.mutable_data(), stride,
                num_threads);
      },
      "points"_array, "half_width_m"_a, "first_frequency"_a, "num_frequencies"_a, "out"_array, "num_threads"_a = 0,
      "Writes sin and cos of 2^k pi x / half_width_m to `out` (N, 6 num_frequencies).");
  m.def(
      "spherical_harmonics",
      [](const Array<T>& directions, Rows<T>& out, int num_threads) {
        const std::int64_t count = check_points(directions, "directions");
        const std::int64_t stride = row_stride(out, count, kHarmonics, "out");
        const py::gil_scoped_release release;
        spherical_harmonics(directions.data(), count, out.mutable_data(), stride, num_threads);
      },
      "directions"_array, "out"_array, "num_threads"_a = 0,
      "Writes the real spherical harmonics of degrees 0 to 3 of unit vectors (N, 3) to `out` (N, 16).");
}

}  // namespace

void bind_encodings(py::module_& m) {
  bind_fixed_encodings<float>(m);
  bind_fixed_encodings<double>(m);
}

}  // namespace radarsdf
