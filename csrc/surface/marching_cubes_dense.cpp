// Dense marching cubes in three passes, as in flying edges: signs, counts, output. The first reads the volume once and
// keeps one bit per sample; later passes process 32 cells at a time, and read the volume again only at cut edges. Each
// pass runs over planes of constant x; counts determine their offsets in the output.
#include <algorithm>
#include <vector>

#include "surface/marching_cubes.hpp"
#include "surface/marching_cubes_common.hpp"
#include "surface/marching_cubes_table.hpp"
#include "surface/volume_signs.hpp"
#include "util/bits.hpp"
#include "util/integers.hpp"
#include "util/parallel.hpp"
#include "util/prefetch.hpp"

namespace radarsdf {
namespace {

// Signs at 32 samples of row (i, j), cut edges that start there, and cells that have their lower corner there.
struct CutWindow {
  int64_t first;                  ///< k of the first sample
  std::array<uint64_t, 4> signs;  ///< of rows (i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1)
  std::array<uint32_t, 3> edges;  ///< cut edges of used cells along each axis
  uint32_t cells;                 ///< used cells

  // Two bits of each row, in the order of the corners.
  size_t pattern(int bit) const {
    return static_cast<size_t>((signs[0] >> bit & 3) | (signs[1] >> bit & 3) << 2 | (signs[2] >> bit & 3) << 4 |
                               (signs[3] >> bit & 3) << 6);
  }
};

// Drops unused cells, and edges without a used cell.
void keep_used(const VolumeSigns& signs, int64_t i, int64_t j, int64_t m, CutWindow& cut) {
  const auto cells = [&](int64_t ci, int64_t cj) { return ci < 0 || cj < 0 ? 0 : signs.cells.row(ci, cj)[m]; };
  // An edge across the row touches cells k - 1 and k.
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

// Calls visit(cut) for each CutWindow of row (i, j) with both signs.
template <typename Visit>
void for_each_cut_window(const VolumeSigns& signs, int64_t i, int64_t j, const Visit& visit) {
  const auto [nx, ny, nz] = signs.shape;
  // Clamping the next row to the volume cuts no edge; there are no cells beyond it.
  const int64_t next_i = std::min(i + 1, nx - 1);
  const int64_t next_j = std::min(j + 1, ny - 1);
  const bool has_cells = i < next_i && j < next_j;
  const uint32_t* rows[4] = {signs.positive.row(i, j), signs.positive.row(i, next_j), signs.positive.row(next_i, j),
                             signs.positive.row(next_i, next_j)};
  constexpr uint64_t concerned = (uint64_t{1} << (word_bits + 1)) - 1;
  for (int64_t m = 0; m < signs.positive.windows(); ++m) {
    CutWindow cut{
        m * word_bits, {window(rows[0], m), window(rows[1], m), window(rows[2], m), window(rows[3], m)}, {}, 0};
    const uint64_t any = cut.signs[0] | cut.signs[1] | cut.signs[2] | cut.signs[3];
    const uint64_t all = cut.signs[0] & cut.signs[1] & cut.signs[2] & cut.signs[3];
    if ((any & concerned) == 0 || (all & concerned) == concerned) continue;
    const int64_t followed = std::min(nz - 1 - cut.first, word_bits);  // samples with a successor
    const auto in_row = static_cast<uint32_t>((uint64_t{1} << followed) - 1);
    cut.edges = {static_cast<uint32_t>(cut.signs[0] ^ cut.signs[2]), static_cast<uint32_t>(cut.signs[0] ^ cut.signs[1]),
                 static_cast<uint32_t>(cut.signs[0] ^ cut.signs[0] >> 1) & in_row};
    cut.cells = has_cells ? static_cast<uint32_t>((any | any >> 1) & ~(all & all >> 1)) & in_row : 0;
    if (signs.cells) keep_used(signs, i, j, m, cut);
    visit(cut);
  }
}

// Counts of a plane of samples and the slab of cells above it.
MeshCounts count_plane(const VolumeSigns& signs, int64_t i) {
  const auto& table = marching_cubes_table();
  MeshCounts count;
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

// Writes the output of consecutive slabs. A slab of cells needs only the vertices of the planes below and above it.
// Edge 3 * k + axis of a row starts at sample k; edge 3 * (j * nz + k) + axis of a plane at sample (j, k).
template <typename T>
class SlabWriter {
 public:
  SlabWriter(const T* volume, const VolumeSigns& signs, const std::vector<MeshCounts>& offsets, const Lattice& lattice,
             double level, Mesh& mesh)
      : volume_(volume),
        signs_(signs),
        offsets_(offsets),
        lattice_(lattice),
        level_(level),
        mesh_(mesh),
        strides_{signs.shape[1] * signs.shape[2], signs.shape[2], 1},
        lower_(new int32_t[3 * strides_[0]]),
        upper_(new int32_t[3 * strides_[0]]),
        edges_(new int32_t[3 * strides_[0]]),
        first_edge_(static_cast<size_t>(signs.shape[1]) + 1) {}

  // Writes the triangles of slabs [begin, end) and the vertices of the planes below them. The last plane of the volume
  // has no slab above it.
  void write(int64_t begin, int64_t end) {
    number_vertices(begin, lower_.get());
    write_plane(begin);
    for (int64_t i = begin; i < end; ++i) {
      number_vertices(i + 1, upper_.get());
      write_slab(i);
      if (i + 1 < end || i + 2 == signs_.shape[0]) write_plane(i + 1);
      std::swap(lower_, upper_);
    }
  }

 private:
  // Lists the cut edges of a plane by row, and stores the vertex of each. Other elements of `vertices` stay unset.
  void number_vertices(int64_t i, int32_t* vertices) {
    auto vertex = static_cast<int32_t>(offsets_[i].vertices);
    int32_t* next_edge = edges_.get();
    for (int64_t j = 0; j < signs_.shape[1]; ++j) {
      const T* row = volume_ + i * strides_[0] + j * strides_[1];
      int32_t* row_vertices = vertices + 3 * j * strides_[1];
      first_edge_[j] = next_edge - edges_.get();
      for_each_cut_window(signs_, i, j, [&](const CutWindow& cut) {
        for (size_t axis = 0; axis < 3; ++axis) {
          for (uint32_t bits = cut.edges[axis]; bits != 0; bits &= bits - 1) {
            const int64_t k = cut.first + lowest_bit(bits);
            const int64_t edge = 3 * k + static_cast<int64_t>(axis);
            row_vertices[edge] = vertex++;
            *next_edge++ = static_cast<int32_t>(edge);
            // The volume is no longer cached; without prefetching, write_vertices took a fifth of the time.
            prefetch(row + k);
            prefetch(row + k + strides_[axis]);
          }
        }
      });
    }
    first_edge_.back() = next_edge - edges_.get();
  }

  // Writes the plane numbered last.
  void write_plane(int64_t i) {
    write_vertices(i);
    if (mesh_.edges) write_edges(i);
  }

  void write_edges(int64_t i) {
    int64_t* out = mesh_.edges.get() + offsets_[i].vertices;
    for (int64_t j = 0; j < signs_.shape[1]; ++j) {
      const int64_t row = 3 * (i * strides_[0] + j * strides_[1]);
      const int64_t end = first_edge_[j + 1];
      for (int64_t e = first_edge_[j]; e < end; ++e) *out++ = row + edges_[e];
    }
  }

  void write_vertices(int64_t i) {
    double* vertex = mesh_.vertices.get() + 3 * offsets_[i].vertices;
    for (int64_t j = 0; j < signs_.shape[1]; ++j) {
      const T* row = volume_ + i * strides_[0] + j * strides_[1];
      const int32_t* const end = edges_.get() + first_edge_[j + 1];
      for (const int32_t* edge = edges_.get() + first_edge_[j]; edge != end; ++edge, vertex += 3) {
        const int axis = *edge % 3;
        const int64_t k = *edge / 3;
        write_vertex(lattice_, {static_cast<double>(i), static_cast<double>(j), static_cast<double>(k)}, axis,
                     static_cast<double>(row[k]), static_cast<double>(row[k + strides_[axis]]), level_, vertex);
      }
    }
  }

  void write_slab(int64_t i) {
    const auto& table = marching_cubes_table();
    int32_t* faces = mesh_.faces.get() + 3 * offsets_[i].faces;
    for (int64_t j = 0; j + 1 < signs_.shape[1]; ++j) {
      std::array<const int32_t*, 12> vertices{};  // vertices on the edges of the row's first cell
      for (int edge = 0; edge < 12; ++edge) {
        const auto [corner, axis] = cell_edge(edge);
        const int64_t sample = (j + ((corner >> 1) & 1)) * strides_[1] + (corner & 1);
        vertices[edge] = (corner & axis_bit(0) ? upper_ : lower_).get() + 3 * sample + axis;
      }
      for_each_cut_window(signs_, i, j, [&](const CutWindow& cut) {
        for (uint32_t cells = cut.cells; cells != 0; cells &= cells - 1) {
          const int bit = lowest_bit(cells);
          const int64_t offset = 3 * (cut.first + bit);
          const auto vertex_of = [&](int edge) { return vertices[edge][offset]; };
          faces = write_triangles(table[cut.pattern(bit)], vertex_of, faces);
        }
      });
    }
  }

  const T* volume_;
  const VolumeSigns& signs_;
  const std::vector<MeshCounts>& offsets_;
  const Lattice& lattice_;
  double level_;
  Mesh& mesh_;
  std::array<int64_t, 3> strides_;    ///< in samples, along each axis
  std::unique_ptr<int32_t[]> lower_;  ///< vertex of each cut edge of a plane; other elements are unset
  std::unique_ptr<int32_t[]> upper_;
  std::unique_ptr<int32_t[]> edges_;  ///< cut edges of the plane numbered last, numbered by row
  std::vector<int64_t> first_edge_;   ///< index in edges_ of each row's first edge, and the end
};

}  // namespace

template <typename T>
Mesh marching_cubes_dense(const T* volume, const std::array<int64_t, 3>& shape, const bool* mask,
                          const Lattice& lattice, double level, int num_threads, bool with_edges) {
  check_lattice(lattice, level);
  const auto [nx, ny, nz] = shape;
  std::vector<MeshCounts> offsets(nx + 1);
  if (nx < 2 || ny < 2 || nz < 2) return sum_up(offsets, with_edges);  // no cells
  if (nz > std::numeric_limits<int32_t>::max() / 3) throw std::invalid_argument("the volume's rows are too long");
  const VolumeSigns signs = read_signs(volume, shape, mask, level, num_threads);
  parallel_tasks(nx, num_threads, [&](int64_t i) { offsets[i + 1] = count_plane(signs, i); });
  Mesh mesh = sum_up(offsets, with_edges);

  // More parts than threads balance the load; each numbers the first plane of the next again, so not many more.
  const int64_t num_slabs = nx - 1;
  const int64_t threads = resolve_num_threads(num_threads);
  const int64_t num_runs = threads == 1 ? 1 : std::min(num_slabs, 8 * threads);
  parallel_tasks(num_runs, num_threads, [&](int64_t run) {
    SlabWriter<T>(volume, signs, offsets, lattice, level, mesh)
        .write(num_slabs * run / num_runs, num_slabs * (run + 1) / num_runs);
  });
  return mesh;
}

template Mesh marching_cubes_dense(const float*, const std::array<int64_t, 3>&, const bool*, const Lattice&, double,
                                   int, bool);
template Mesh marching_cubes_dense(const double*, const std::array<int64_t, 3>&, const bool*, const Lattice&, double,
                                   int, bool);

}  // namespace radarsdf
