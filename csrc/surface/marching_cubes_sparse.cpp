// Marching cubes on a list of cells. An edge is indexed by its lower corner and its axis, so a plain array with three
// elements per corner replaces a map from edges to vertices. Passes run over blocks of fixed size; counts determine
// their offsets in the output, so results do not depend on the number of threads.
#include <atomic>
#include <vector>

#include "surface/marching_cubes.hpp"
#include "surface/marching_cubes_common.hpp"
#include "surface/marching_cubes_table.hpp"
#include "util/bits.hpp"
#include "util/integers.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr int64_t block_size = 1 << 14;
constexpr int32_t no_vertex = -1;

constexpr unsigned is_nan = 1 << 8;

// Signs of the corners, or 0 (a pattern without triangles) if a value is NaN. signs: 0, 1 or is_nan for each value.
std::uint8_t sign_pattern(const std::uint16_t* signs, const int32_t* cell) {
  unsigned pattern = 0, any = 0;
  for (int corner = 0; corner < 8; ++corner) {
    const unsigned sign = signs[cell[corner]];
    any |= sign;
    pattern |= sign << corner;
  }
  return (any & is_nan) != 0 ? std::uint8_t{0} : static_cast<std::uint8_t>(pattern);
}

void check_corner_numbers(const int32_t* cell, int64_t num_corners) {
  std::uint32_t highest = 0;  // a negative number is a high one
  for (int corner = 0; corner < 8; ++corner) highest = std::max(highest, static_cast<std::uint32_t>(cell[corner]));
  if (int64_t{highest} >= num_corners) throw std::invalid_argument("a cell refers to a corner that does not exist");
}

void check_corner_positions(const int32_t* corners, const int32_t* cell) {
  const int32_t* lowest = corners + 3 * int64_t{cell[0]};
  for (int corner = 1; corner < 8; ++corner) {
    const int32_t* position = corners + 3 * int64_t{cell[corner]};
    for (int axis = 0; axis < 3; ++axis) {
      const int step = corner & axis_bit(axis) ? 1 : 0;
      if (int64_t{position[axis]} != int64_t{lowest[axis]} + step) {
        throw std::invalid_argument("the corners of a cell are not in C order of a 2x2x2 block");
      }
    }
  }
}

}  // namespace

template <typename T>
Mesh marching_cubes_sparse(const int32_t* corners, const T* values, int64_t num_corners, const int32_t* cells,
                           int64_t num_cells, const Lattice& lattice, double level, int num_threads) {
  check_lattice(lattice, level);
  if (num_corners > std::numeric_limits<int32_t>::max()) {
    throw std::invalid_argument("there are more corners than int32 cells can refer to");
  }
  const auto& table = marching_cubes_table();

  // By cut edge: first its upper corner, then its vertex. Cells that share an edge write the same value, so the order
  // does not matter; relaxed atomics only avoid a data race, at no cost.
  const int64_t num_edges = 3 * num_corners;
  const auto edges = large_array<std::atomic<int32_t>>(num_edges);
  parallel_chunks(num_edges, block_size, num_threads, [&](int64_t, int64_t begin, int64_t end) {
    for (int64_t e = begin; e < end; ++e) edges[e].store(no_vertex, std::memory_order_relaxed);
  });
  const auto edge_of = [&](const int32_t* cell, int edge) -> std::atomic<int32_t>& {
    const auto [corner, axis] = cell_edge(edge);
    return edges[3 * int64_t{cell[corner]} + axis];
  };

  const auto signs = large_array<std::uint16_t>(num_corners);
  parallel_chunks(num_corners, block_size, num_threads, [&](int64_t, int64_t begin, int64_t end) {
    for (int64_t c = begin; c < end; ++c) {
      const auto value = static_cast<double>(values[c]);
      signs[c] = static_cast<std::uint16_t>(value > level ? 1 : value == value ? 0 : is_nan);
    }
  });
  const auto patterns = large_array<std::uint8_t>(num_cells);
  // Of vertices by block of corners, of faces by block of cells.
  std::vector<MeshCounts> offsets(num_chunks(std::max(num_corners, num_cells), block_size) + 1);
  parallel_chunks(num_cells, block_size, num_threads, [&](int64_t block, int64_t begin, int64_t end) {
    for (int64_t m = begin; m < end; ++m) {
      const int32_t* cell = cells + 8 * m;
      check_corner_numbers(cell, num_corners);
      const std::uint8_t pattern = patterns[m] = sign_pattern(signs.get(), cell);
      if (pattern == 0 || pattern == 255) continue;
      check_corner_positions(corners, cell);
      offsets[block + 1].faces += table[pattern].num_triangles;
      for (std::uint32_t bits = table[pattern].cut_edges; bits != 0; bits &= bits - 1) {
        const int edge = lowest_bit(bits);
        const auto [lower, axis] = cell_edge(edge);
        const int upper = lower | axis_bit(axis);
        edge_of(cell, edge).store(cell[upper], std::memory_order_relaxed);
      }
    }
  });
  parallel_chunks(num_corners, block_size, num_threads, [&](int64_t block, int64_t begin, int64_t end) {
    for (int64_t e = 3 * begin; e < 3 * end; ++e) {
      offsets[block + 1].vertices += edges[e].load(std::memory_order_relaxed) != no_vertex;
    }
  });
  Mesh mesh = sum_up(offsets, false);
  parallel_chunks(num_corners, block_size, num_threads, [&](int64_t block, int64_t begin, int64_t end) {
    auto vertex = static_cast<int32_t>(offsets[block].vertices);
    for (int64_t c = begin; c < end; ++c) {
      for (int axis = 0; axis < 3; ++axis) {
        auto& edge = edges[3 * c + axis];
        const int32_t upper = edge.load(std::memory_order_relaxed);
        if (upper == no_vertex) continue;
        write_vertex(lattice, vec3(corners, c), axis, static_cast<double>(values[c]),
                     static_cast<double>(values[upper]), level, mesh.vertices.get() + 3 * int64_t{vertex});
        edge.store(vertex++, std::memory_order_relaxed);
      }
    }
  });
  parallel_chunks(num_cells, block_size, num_threads, [&](int64_t block, int64_t begin, int64_t end) {
    int32_t* faces = mesh.faces.get() + 3 * offsets[block].faces;
    for (int64_t m = begin; m < end; ++m) {
      const auto vertex_of = [&](int edge) { return edge_of(cells + 8 * m, edge).load(std::memory_order_relaxed); };
      faces = write_triangles(table[patterns[m]], vertex_of, faces);
    }
  });
  return mesh;
}

template Mesh marching_cubes_sparse(const int32_t*, const float*, int64_t, const int32_t*, int64_t, const Lattice&,
                                    double, int);
template Mesh marching_cubes_sparse(const int32_t*, const double*, int64_t, const int32_t*, int64_t, const Lattice&,
                                    double, int);

}  // namespace radarsdf
