// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Dense marching cubes in three passes, as in flying edges: signs, counts, output. The first reads the volume once and
// keeps one bit per sample; from then on 32 cells are dealt with at a time, and the volume itself is read again only at
// the cut edges. Each pass runs over planes of constant x, whose places in the output are known from the counts.
#include <limits>
#include <vector>

#include "bits.hpp"
#include "marching_cubes.hpp"
#include "marching_cubes_common.hpp"
#include "marching_cubes_table.hpp"
#include "parallel.hpp"

namespace radarsdf {
namespace {

using std::int64_t;
using std::size_t;
using std::uint32_t;
using std::uint64_t;

constexpr int64_t word_bits = 32;

// One bit for each sample of a volume, or for the cell of which it is the lower corner. A row ends with a word of
// zeros, so that a window may begin in any word before it.
class BitVolume {
 public:
  BitVolume() = default;
  explicit BitVolume(const std::array<int64_t, 3>& shape)
      : rows_per_plane_(shape[1]),
        words_((shape[2] + word_bits - 1) / word_bits + 1),
        bits_(new uint32_t[static_cast<size_t>(shape[0] * shape[1] * words_)]) {}

  uint32_t* row(int64_t i, int64_t j) { return bits_.get() + (i * rows_per_plane_ + j) * words_; }
  const uint32_t* row(int64_t i, int64_t j) const { return bits_.get() + (i * rows_per_plane_ + j) * words_; }
  int64_t windows() const { return words_ - 1; }
  explicit operator bool() const { return bits_ != nullptr; }

 private:
  int64_t rows_per_plane_ = 0;
  int64_t words_ = 0;
  std::unique_ptr<uint32_t[]> bits_;
};

// 64 bits from word m on: those of 32 samples and of the samples after them.
inline uint64_t window(const uint32_t* row, int64_t m) { return row[m] | static_cast<uint64_t>(row[m + 1]) << word_bits; }

inline uint64_t merged_with_next(uint64_t bits) { return bits | bits >> 1; }

// flags: word_bits bytes that are 0 or 1. The product gathers the lowest bits of eight bytes in its top byte.
inline uint32_t pack_flags(const std::uint8_t* flags) {
  uint32_t word = 0;
  for (int group = 0; group < word_bits; group += 8) {
    uint64_t bytes = 0;
    for (int b = 0; b < 8; ++b) bytes |= static_cast<uint64_t>(flags[group + b]) << (8 * b);
    word |= static_cast<uint32_t>((bytes * 0x0102040810204080u) >> 56) << group;
  }
  return word;
}

// Writes test(k) for k in [0, size) as bits, and the word of zeros. Bytes come first since compilers vectorise that.
template <typename Test>
void write_bits(int64_t size, uint32_t* words, const Test& test) {
  std::uint8_t flags[word_bits];
  int64_t k = 0;
  for (; k + word_bits <= size; k += word_bits) {
    for (int64_t b = 0; b < word_bits; ++b) flags[b] = test(k + b);
    *words++ = pack_flags(flags);
  }
  if (k < size) {
    std::fill(flags, flags + word_bits, std::uint8_t{0});
    for (int64_t b = 0; k + b < size; ++b) flags[b] = test(k + b);
    *words++ = pack_flags(flags);
  }
  *words = 0;
}

// The largest T that is <= level, so that the samples > level are those > it: float samples need no conversion.
template <typename T>
T round_down(double level) {
  constexpr T infinity = std::numeric_limits<T>::infinity();
  if (level > static_cast<double>(std::numeric_limits<T>::max())) return std::numeric_limits<T>::max();
  if (level < -static_cast<double>(std::numeric_limits<T>::max())) return -infinity;
  const T rounded = static_cast<T>(level);
  return static_cast<double>(rounded) <= level ? rounded : std::nextafter(rounded, -infinity);
}

// The samples that are > level, then the cells in use; `cells` is empty where all are.
struct Signs {
  std::array<int64_t, 3> shape;
  BitVolume positive;
  BitVolume cells;
};

template <typename T>
Signs read_signs(const T* volume, const std::array<int64_t, 3>& shape, const bool* mask, double level,
                 int num_threads) {
  const auto [nx, ny, nz] = shape;
  Signs signs{shape, BitVolume(shape), {}};
  const T threshold = round_down<T>(level);
  std::vector<std::uint8_t> plane_has_nan(static_cast<size_t>(nx));
  parallel_tasks(nx, num_threads, [&](int64_t i) {
    bool has_nan = false;
    for (int64_t j = 0; j < ny; ++j) {
      const T* row = volume + (i * ny + j) * nz;
      write_bits(nz, signs.positive.row(i, j), [&](int64_t k) { return row[k] > threshold; });
      int row_has_nan = 0;
      for (int64_t k = 0; k < nz; ++k) row_has_nan |= row[k] != row[k];
      has_nan |= row_has_nan != 0;
    }
    plane_has_nan[static_cast<size_t>(i)] = has_nan;
  });
  if (!mask && std::find(plane_has_nan.begin(), plane_has_nan.end(), 1) == plane_has_nan.end()) return signs;

  BitVolume usable(shape);
  parallel_tasks(nx, num_threads, [&](int64_t i) {
    for (int64_t j = 0; j < ny; ++j) {
      const T* row = volume + (i * ny + j) * nz;
      const bool* flags = mask ? mask + (i * ny + j) * nz : nullptr;
      write_bits(nz, usable.row(i, j), [&](int64_t k) { return row[k] == row[k] && (!flags || flags[k]); });
    }
  });
  signs.cells = BitVolume(shape);
  parallel_tasks(nx, num_threads, [&](int64_t i) {
    for (int64_t j = 0; j < ny; ++j) {
      const bool has_cells = i + 1 < nx && j + 1 < ny;
      uint32_t* cells = signs.cells.row(i, j);
      for (int64_t m = 0; m < usable.windows(); ++m) {
        if (!has_cells) {
          cells[m] = 0;
          continue;
        }
        const uint64_t all = window(usable.row(i, j), m) & window(usable.row(i, j + 1), m) &
                             window(usable.row(i + 1, j), m) & window(usable.row(i + 1, j + 1), m);
        cells[m] = static_cast<uint32_t>(all & all >> 1);
      }
      cells[usable.windows()] = 0;
    }
  });
  return signs;
}

// What is cut among 32 samples of row (i, j): the edges that start there, and the cells whose lower corner they are.
struct CutWindow {
  int64_t first;                  ///< the first sample's k
  std::array<uint64_t, 4> signs;  ///< of rows (i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1)
  std::array<uint32_t, 3> edges;  ///< along each axis, those of cells in use
  uint32_t cells;                 ///< in use

  // Two bits from each row, in the order of the corners.
  size_t pattern(int bit) const {
    return static_cast<size_t>((signs[0] >> bit & 3) | (signs[1] >> bit & 3) << 2 | (signs[2] >> bit & 3) << 4 |
                               (signs[3] >> bit & 3) << 6);
  }
};

// Drops the edges that belong to no cell in use, and the cells that are not.
void keep_used(const Signs& signs, int64_t i, int64_t j, int64_t m, CutWindow& cut) {
  const auto cells = [&](int64_t ci, int64_t cj) { return ci < 0 || cj < 0 ? 0 : signs.cells.row(ci, cj)[m]; };
  // An edge across the row touches cell k and also cell k - 1.
  const auto cells_around = [&](int64_t ci, int64_t cj) {
    if (ci < 0 || cj < 0) return uint32_t{0};
    const uint32_t* row = signs.cells.row(ci, cj);
    return row[m] | row[m] << 1 | (m > 0 ? row[m - 1] >> (word_bits - 1) : 0);
  };
  cut.edges[0] &= cells_around(i, j) | cells_around(i, j - 1);
  cut.edges[1] &= cells_around(i, j) | cells_around(i - 1, j);
  cut.edges[2] &= cells(i, j) | cells(i - 1, j) | cells(i, j - 1) | cells(i - 1, j - 1);
  cut.cells &= cells(i, j);
}

// Calls visit(cut) for each CutWindow of row (i, j) in which signs differ.
template <typename Visit>
void for_each_cut_window(const Signs& signs, int64_t i, int64_t j, const Visit& visit) {
  const auto [nx, ny, nz] = signs.shape;
  // A row beyond the volume is taken to be the last one, which cuts no edge; there are no cells.
  const int64_t next_i = std::min(i + 1, nx - 1);
  const int64_t next_j = std::min(j + 1, ny - 1);
  const bool has_cells = i < next_i && j < next_j;
  const uint32_t* rows[4] = {signs.positive.row(i, j), signs.positive.row(i, next_j), signs.positive.row(next_i, j),
                             signs.positive.row(next_i, next_j)};
  constexpr uint64_t concerned = (uint64_t{1} << (word_bits + 1)) - 1;
  for (int64_t m = 0; m < signs.positive.windows(); ++m) {
    CutWindow cut{m * word_bits, {window(rows[0], m), window(rows[1], m), window(rows[2], m), window(rows[3], m)}, {}, 0};
    const uint64_t any = cut.signs[0] | cut.signs[1] | cut.signs[2] | cut.signs[3];
    const uint64_t all = cut.signs[0] & cut.signs[1] & cut.signs[2] & cut.signs[3];
    if ((any & concerned) == 0 || (all & concerned) == concerned) continue;
    const int64_t followed = std::min(nz - 1 - cut.first, word_bits);  // samples that have another after them
    const auto in_row = static_cast<uint32_t>((uint64_t{1} << followed) - 1);
    cut.edges = {static_cast<uint32_t>(cut.signs[0] ^ cut.signs[2]), static_cast<uint32_t>(cut.signs[0] ^ cut.signs[1]),
                 static_cast<uint32_t>(cut.signs[0] ^ cut.signs[0] >> 1) & in_row};
    cut.cells = has_cells ? static_cast<uint32_t>((any | any >> 1) & ~(all & all >> 1)) & in_row : 0;
    if (signs.cells) keep_used(signs, i, j, m, cut);
    visit(cut);
  }
}

// Of a plane of samples and of the slab of cells above it: counts, then (as running sums) places in the output.
struct PlaneOffsets {
  int64_t vertices = 0;
  int64_t faces = 0;
};

PlaneOffsets count_plane(const Signs& signs, int64_t i) {
  const auto& table = marching_cubes_table();
  PlaneOffsets count;
  for (int64_t j = 0; j < signs.shape[1]; ++j) {
    for_each_cut_window(signs, i, j, [&](const CutWindow& cut) {
      count.vertices += count_bits(cut.edges[0] | static_cast<uint64_t>(cut.edges[1]) << word_bits);
      count.vertices += count_bits(cut.edges[2]);
      for (uint32_t cells = cut.cells; cells != 0; cells &= cells - 1) {
        count.faces += table[cut.pattern(lowest_bit(cells))].num_triangles;
      }
    });
  }
  return count;
}

// A plane's edges are numbered 3 * (j * nz + k) + axis. Lists those of row j that are cut, at most 3 * nz.
int64_t list_cut_edges(const Signs& signs, int64_t i, int64_t j, std::int32_t* edges) {
  const std::int32_t* const begin = edges;
  for_each_cut_window(signs, i, j, [&](const CutWindow& cut) {
    for (size_t axis = 0; axis < 3; ++axis) {
      for (uint32_t bits = cut.edges[axis]; bits != 0; bits &= bits - 1) {
        *edges++ = static_cast<std::int32_t>(3 * (cut.first + lowest_bit(bits)) + static_cast<int64_t>(axis));
      }
    }
  });
  return edges - begin;
}

// The triangles between two planes, given the vertex on each of their cut edges.
void write_slab(const Signs& signs, int64_t i, const std::int32_t* lower, const std::int32_t* upper,
                std::int32_t* faces) {
  const auto& table = marching_cubes_table();
  const int64_t nz = signs.shape[2];
  for (int64_t j = 0; j + 1 < signs.shape[1]; ++j) {
    std::array<const std::int32_t*, 12> vertices{};  // on each edge of the row's first cell
    for (int edge = 0; edge < 12; ++edge) {
      const auto [corner, axis] = cell_edge(edge);
      const int64_t sample = (j + ((corner >> 1) & 1)) * nz + (corner & 1);
      vertices[static_cast<size_t>(edge)] = (corner & axis_bit(0) ? upper : lower) + 3 * sample + axis;
    }
    for_each_cut_window(signs, i, j, [&](const CutWindow& cut) {
      for (uint32_t cells = cut.cells; cells != 0; cells &= cells - 1) {
        const int bit = lowest_bit(cells);
        const CellTriangles& cell = table[cut.pattern(bit)];
        const int64_t offset = 3 * (cut.first + bit);
        for (size_t n = 0; n < 3u * cell.num_triangles; ++n) *faces++ = vertices[cell.edges[n]][offset];
      }
    });
  }
}

}  // namespace

template <typename T>
Mesh marching_cubes_dense(const T* volume, const std::array<int64_t, 3>& shape, const bool* mask,
                          const Lattice& lattice, double level, int num_threads) {
  check_lattice(lattice, level);
  const auto [nx, ny, nz] = shape;
  if (nx < 2 || ny < 2 || nz < 2) return allocate_mesh(0, 0);  // samples without a cell
  const Signs signs = read_signs(volume, shape, mask, level, num_threads);

  std::vector<PlaneOffsets> offsets(static_cast<size_t>(nx) + 1);
  parallel_tasks(nx, num_threads, [&](int64_t i) { offsets[static_cast<size_t>(i) + 1] = count_plane(signs, i); });
  for (size_t i = 1; i < offsets.size(); ++i) {
    offsets[i].vertices += offsets[i - 1].vertices;
    offsets[i].faces += offsets[i - 1].faces;
  }
  Mesh mesh = allocate_mesh(offsets.back().vertices, offsets.back().faces);

  const int64_t strides[3] = {ny * nz, nz, 1};
  // More chunks than threads even out the load; each numbers one plane of its successor again, so not many more.
  const int64_t num_slabs = nx - 1;
  const int64_t threads = resolve_num_threads(num_threads);
  const int64_t num_chunks = threads == 1 ? 1 : std::min(num_slabs, 8 * threads);
  parallel_tasks(num_chunks, num_threads, [&](int64_t chunk) {
    const int64_t begin = num_slabs * chunk / num_chunks;
    const int64_t end = num_slabs * (chunk + 1) / num_chunks;
    std::vector<std::int32_t> edges(static_cast<size_t>(3 * nz));
    const auto number = [&](int64_t i, std::int32_t* plane_vertices) {
      auto vertex = static_cast<std::int32_t>(offsets[static_cast<size_t>(i)].vertices);
      const bool is_ours = i < end || end == num_slabs;  // the plane after a chunk belongs to the next one
      for (int64_t j = 0; j < ny; ++j) {
        const int64_t num_edges = list_cut_edges(signs, i, j, edges.data());
        for (int64_t n = 0; n < num_edges; ++n) plane_vertices[3 * j * nz + edges[static_cast<size_t>(n)]] = vertex + static_cast<std::int32_t>(n);
        if (is_ours) {
          const T* row = volume + (i * ny + j) * nz;
          double* out = mesh.vertices.get() + 3 * int64_t{vertex};
          for (int64_t n = 0; n < num_edges; ++n, out += 3) {
            const auto edge = static_cast<std::uint32_t>(edges[static_cast<size_t>(n)]);
            const size_t axis = edge % 3;
            const int64_t k = edge / 3;
            const double fraction = edge_fraction(row[k], row[k + strides[axis]], level);
            write_vertex(lattice, {static_cast<double>(i), static_cast<double>(j), static_cast<double>(k)}, axis,
                         fraction, out);
          }
        }
        vertex += static_cast<std::int32_t>(num_edges);
      }
    };
    std::unique_ptr<std::int32_t[]> lower(new std::int32_t[static_cast<size_t>(3 * ny * nz)]);
    std::unique_ptr<std::int32_t[]> upper(new std::int32_t[static_cast<size_t>(3 * ny * nz)]);
    number(begin, lower.get());
    for (int64_t i = begin; i < end; ++i) {
      number(i + 1, upper.get());
      write_slab(signs, i, lower.get(), upper.get(), mesh.faces.get() + 3 * offsets[static_cast<size_t>(i)].faces);
      std::swap(lower, upper);
    }
  });
  return mesh;
}

template Mesh marching_cubes_dense(const float*, const std::array<int64_t, 3>&, const bool*, const Lattice&, double,
                                   int);
template Mesh marching_cubes_dense(const double*, const std::array<int64_t, 3>&, const bool*, const Lattice&, double,
                                   int);

}  // namespace radarsdf
