// Rows of a tensor-product B-spline system, applied, transposed and summed into the normal matrix.
//
// Plain C interface, called through ctypes (see native.py); the torch code in operators.py and assembly.py
// is the reference that the tests compare with. Local coefficients are in solve order throughout: the caller
// hands 1-D values with the slowest solve axis first, so that a cell's coefficients have rising positions.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <optional>
#include <vector>

#include "guard.hpp"
#include "processor.hpp"
#include "spline.hpp"

#ifdef _OPENMP
#include <omp.h>
#endif

namespace {

#if defined(__AVX512F__)
constexpr int kWidth = 8;
#elif defined(__AVX__)
constexpr int kWidth = 4;
#else
constexpr int kWidth = 2;
#endif
using Vector = double __attribute__((vector_size(kWidth * 8), aligned(8), may_alias));

constexpr int kRows = 4;              // tile rows held in registers
constexpr int kCols = 2 * kWidth;     // tile columns: two vectors
constexpr int kWorthThreads = 4096;   // rows: with fewer the threads' meetings cost more
constexpr int kDepth = 32;            // points whose stencils are buffered before they are summed
constexpr int kAhead = 16;             // rows whose targets are fetched before they are needed

// Inlined into a caller that knows the sizes at compile time, these small loops become straight vector code.
#define SPLINE_INLINE inline __attribute__((always_inline))

enum Kind : int32_t { kVector = 0, kDirection = 1, kDivergence = 2, kCellScalar = 3, kCellCoupled = 4 };

constexpr int power(int base, int exponent) { return exponent == 0 ? 1 : base * power(base, exponent - 1); }

int local_size(const SplineGrid& g) { return power(g.degree + 1, g.axes); }

// Sizes known at compile time (all 0: read from the grid).
template <int kAxes, int kDegree, int kComponents>
struct Sizes {
  static SPLINE_INLINE SplineGrid of(const SplineGrid& given) {
    SplineGrid g = given;
    if (kAxes) g.axes = kAxes, g.degree = kDegree, g.components = kComponents;
    return g;
  }
  static SPLINE_INLINE int local(const SplineGrid& g) { return kAxes ? power(kDegree + 1, kAxes) : local_size(g); }
};

// 1-D basis values of one point, and their derivatives per metre.
struct Basis {
  double value[kMaxAxes][kMaxOrder], slope[kMaxAxes][kMaxOrder];

  SPLINE_INLINE Basis(const SplineGrid& g, const double* t, bool slopes) {
    const int order = g.degree + 1;
    for (int a = 0; a < g.axes; ++a) {
      double* v = value[a];
      double* s = slope[a];
      for (int i = 0; i < order; ++i) v[i] = g.pieces[(order - 1) * order + i], s[i] = 0;
      for (int k = order - 2; k >= 0; --k) {  // Horner for the polynomials and their derivatives together
        const double* power = g.pieces + k * order;
#pragma omp simd
        for (int i = 0; i < order; ++i) {
          s[i] = s[i] * t[a] + v[i];
          v[i] = v[i] * t[a] + power[i];
        }
      }
      if (slopes)
        for (int i = 0; i < order; ++i) s[i] /= g.spacing[a];
    }
  }
};

// Products of 1-D values; the 1-D derivative on one axis (or -1 for none), times scale.
SPLINE_INLINE void stencil(const SplineGrid& g, const Basis& basis, int derived, double scale, double* out) {
  const int order = g.degree + 1;
  out[0] = scale;
  int size = 1;
  for (int a = 0; a < g.axes; ++a) {
    const double* one = a == derived ? basis.slope[a] : basis.value[a];
    for (int i = size - 1; i >= 0; --i) {  // downwards: the products are expanded in place
      const double left = out[i];
      for (int k = 0; k < order; ++k) out[i * order + k] = left * one[k];
    }
    size *= order;
  }
}

// The row of component k at point n, without the weight of kVector rows.
SPLINE_INLINE void row_of(const SplineGrid& g, const SplineRows& rows, const Basis& basis, int64_t n, int k,
                          double* out) {
  const double* c = rows.coefficient + n * g.components;
  if (rows.kind == kVector) stencil(g, basis, -1, 1.0, out);
  else if (rows.kind == kDirection) stencil(g, basis, -1, c[k], out);
  else stencil(g, basis, g.axis_of_component[k], c[0], out);
}

// out[m][l] += sum_k p[k][m] q[k][l] over tiles with l >= m, p and q (depth, padded).
void add_products(const double* p, const double* q, int depth, int padded, double* out) {
  for (int m0 = 0; m0 < padded; m0 += kRows) {
    for (int l0 = m0 / kCols * kCols; l0 < padded; l0 += kCols) {
      Vector sum[kRows][2] = {};
      for (int k = 0; k < depth; ++k) {
        const Vector* right = reinterpret_cast<const Vector*>(q + k * padded + l0);
        const Vector a = right[0], b = right[1];
        for (int r = 0; r < kRows; ++r) {
          const double left = p[k * padded + m0 + r];
          sum[r][0] += left * a;
          sum[r][1] += left * b;
        }
      }
      for (int r = 0; r < kRows; ++r) {
        Vector* to = reinterpret_cast<Vector*>(out + (m0 + r) * padded + l0);
        to[0] += sum[r][0];
        to[1] += sum[r][1];
      }
    }
  }
}

// Gram blocks of one cell. coupled (wide, wide): of unknowns l C + c; own (C, padded, padded): of one component alone;
// shared (padded, padded): of every component.
struct CellGram {
  int components, padded, wide;
  std::vector<double> coupled, own, shared, panel, mixed;  // the panels' padding stays 0
  std::vector<int> run;                                    // end of the run of neighbouring positions from each one on
  bool has_coupled, has_shared, has_own[kMaxComponents];

  CellGram(int components_, int padded_, int local)
      : components(components_), padded(padded_), wide((components_ * local + kCols - 1) / kCols * kCols),
        coupled(size_t(wide) * wide), own(size_t(components_) * padded_ * padded_), shared(size_t(padded_) * padded_),
        panel(size_t(components_) * kDepth * padded_), mixed(size_t(kDepth) * wide), run(local) {}

  void clear() {
    std::memset(has_own, 0, sizeof has_own);
    has_coupled = has_shared = false;
  }
  static double* touched(bool& has, double* block, int size) {
    if (!has) std::fill_n(block, size_t(size) * size, 0.0);
    has = true;
    return block;
  }
  double* touched_coupled() { return touched(has_coupled, coupled.data(), wide); }
  double* touched_shared() { return touched(has_shared, shared.data(), padded); }
  double* touched_own(int c) { return touched(has_own[c], own.data() + size_t(c) * padded * padded, padded); }
};

void add_vector_rows(const SplineGrid& g, const SplineRows& rows, int64_t first, int depth, CellGram& cell) {
  const size_t panel = size_t(kDepth) * cell.padded;
  const int panels = rows.shared ? 1 : g.components;
  for (int k = 0; k < depth; ++k) {
    const int64_t n = first + k;
    const Basis basis(g, rows.t + n * g.axes, false);
    for (int c = 0; c < panels; ++c) {
      double* row = cell.panel.data() + c * panel + size_t(k) * cell.padded;
      stencil(g, basis, -1, rows.coefficient[n * g.components + c], row);
    }
  }
  for (int c = 0; c < panels; ++c) {
    const double* p = cell.panel.data() + c * panel;
    add_products(p, p, depth, cell.padded, rows.shared ? cell.touched_shared() : cell.touched_own(c));
  }
}

void add_coupled_rows(const SplineGrid& g, const SplineRows& rows, int64_t first, int depth, int local,
                      CellGram& cell) {
  for (int k = 0; k < depth; ++k) {
    const int64_t n = first + k;
    const Basis basis(g, rows.t + n * g.axes, rows.kind == kDivergence);
    double* row = cell.mixed.data() + size_t(k) * cell.wide;
    for (int c = 0; c < g.components; ++c) {
      row_of(g, rows, basis, n, c, cell.panel.data());
      for (int l = 0; l < local; ++l) row[l * g.components + c] = cell.panel[l];
    }
  }
  add_products(cell.mixed.data(), cell.mixed.data(), depth, cell.wide, cell.touched_coupled());
}

void add_point_rows(const SplineGrid& g, const SplineRows& rows, int64_t begin, int64_t end, int local,
                    CellGram& cell) {
  for (int64_t first = begin; first < end; first += kDepth) {
    const int depth = int(std::min<int64_t>(kDepth, end - first));
    if (rows.kind == kVector) add_vector_rows(g, rows, first, depth, cell);
    else add_coupled_rows(g, rows, first, depth, local, cell);
  }
}

void add_constant(const SplineGrid& g, const SplineRows& rows, int local, CellGram& cell) {
  const int c_count = g.components;
  if (rows.kind == kCellScalar) {
    double* to = cell.touched_shared();
    for (int m = 0; m < local; ++m)
      for (int l = 0; l < local; ++l) to[m * cell.padded + l] += rows.gram[m * local + l];
    return;
  }
  double* to = cell.touched_coupled();
  for (int d = 0; d < c_count; ++d)
    for (int c = 0; c < c_count; ++c) {
      const double* from = rows.gram + size_t(d * c_count + c) * local * local;
      for (int m = 0; m < local; ++m) {
        double* row = to + size_t(m * c_count + d) * cell.wide + c;
        for (int l = 0; l < local; ++l) row[l * c_count] += from[m * local + l];
      }
    }
}

// Add a cell's blocks to band[(column) * width + (row - column)], row >= column.
void scatter(const SplineGrid& g, int64_t cell_number, int local, CellGram& cell, double* band, int64_t width) {
  const int32_t* position = g.position + cell_number * local;
  const int c_count = g.components, padded = cell.padded;
  for (int l = local - 1; l >= 0; --l)
    cell.run[l] = l + 1 < local && position[l + 1] == position[l] + 1 ? cell.run[l + 1] : l + 1;
  for (int m = 0; m < local; ++m) {
    for (int d = 0; d < c_count; ++d) {
      const int64_t column = int64_t(position[m]) * c_count + d;
      double* out = band + column * width - column;
      if (cell.has_coupled) {
        const double* row = cell.coupled.data() + size_t(m * c_count + d) * cell.wide;
        double* diagonal = out + int64_t(position[m]) * c_count;
        for (int c = d; c < c_count; ++c) diagonal[c] += row[m * c_count + c];
        for (int l = m + 1; l < local; l = cell.run[l]) {
          double* to = out + int64_t(position[l]) * c_count;
          const double* from = row + l * c_count;
          const int count = (cell.run[l] - l) * c_count;
#pragma omp simd
          for (int k = 0; k < count; ++k) to[k] += from[k];
        }
      }
      const double* own = cell.has_own[d] ? cell.own.data() + (size_t(d) * padded + m) * padded : nullptr;
      const double* shared = cell.has_shared ? cell.shared.data() + size_t(m) * padded : nullptr;
      if (!own && !shared) continue;
      for (int l = m; l < local; ++l)
        out[int64_t(position[l]) * c_count + d] += (own ? own[l] : 0.0) + (shared ? shared[l] : 0.0);
    }
  }
}

SPLINE_INLINE double dot(const double* a, const double* b, int count) {
  double sum = 0;
#pragma omp simd reduction(+ : sum)
  for (int l = 0; l < count; ++l) sum += a[l] * b[l];
  return sum;
}

SPLINE_INLINE void add_scaled(const double* row, double scale, int count, double* out) {
#pragma omp simd
  for (int l = 0; l < count; ++l) out[l] += scale * row[l];
}

// A cell's coefficients (components, local) out of x (nodes, components), and back by addition.
void gather(const SplineGrid& g, const int32_t* position, int local, const double* x, double* near) {
  for (int k = 0; k < g.components; ++k)
    for (int l = 0; l < local; ++l) near[k * local + l] = x[int64_t(position[l]) * g.components + k];
}

void scatter_add(const SplineGrid& g, const int32_t* position, int local, const double* near, double* x) {
  for (int k = 0; k < g.components; ++k)
    for (int l = 0; l < local; ++l) x[int64_t(position[l]) * g.components + k] += near[k * local + l];
}

// What one cell's rows subtract from and add to its coefficients: pulled (components, local) += rows' (target - rows near).
template <typename Size>
void pull_cell(const SplineGrid& given, const SplineRows& rows, int64_t cell, const double* target, const int64_t* number,
               const double* near, double* row, double* pulled) {
  const SplineGrid g = Size::of(given);
  const int local = Size::local(g), c = g.components;
  const int width = rows.kind == kVector ? c : 1;  // targets of a row
  for (int64_t n = rows.start[cell]; n < rows.start[cell + 1]; ++n) {
    // the caller's order is any: its targets would be waited for
    if (target && n + kAhead < rows.count) __builtin_prefetch(target + number[n + kAhead] * width);
    const Basis basis(g, rows.t + n * g.axes, rows.kind == kDivergence);
    if (rows.kind == kVector) {
      stencil(g, basis, -1, 1.0, row);
      for (int k = 0; k < c; ++k) {
        const double weight = rows.coefficient[n * c + k];
        const double fitted = near ? weight * dot(row, near + k * local, local) : 0.0;
        const double goal = target ? target[number[n] * c + k] : 0.0;
        add_scaled(row, weight * (goal - fitted), local, pulled + k * local);
      }
    } else {
      for (int k = 0; k < c; ++k) row_of(g, rows, basis, n, k, row + k * local);
      const double fitted = near ? dot(row, near, c * local) : 0.0;
      add_scaled(row, (target ? target[number[n]] : 0.0) - fitted, c * local, pulled);
    }
  }
}

using PullCell = void (*)(const SplineGrid&, const SplineRows&, int64_t, const double*, const int64_t*, const double*,
                          double*, double*);

// The sizes in daily use, and any other.
PullCell pull_cell_for(const SplineGrid& g) {
  if (g.degree == 3 && g.axes == 3 && g.components == 3) return pull_cell<Sizes<3, 3, 3>>;
  if (g.degree == 3 && g.axes == 2 && g.components == 2) return pull_cell<Sizes<2, 3, 2>>;
  if (g.degree == 3 && g.axes == 4 && g.components == 3) return pull_cell<Sizes<4, 3, 3>>;
  return pull_cell<Sizes<0, 0, 0>>;
}

// Sum all blocks' rows into the lower band (nodes * components, width). Cells come in slabs (slab_start, slabs
// + 1) along the slowest axis; slabs two apart share no coefficient, so even and odd ones take turns.
void gram(const SplineGrid* grid, const SplineRows* blocks, int32_t block_count, const int64_t* slab_start,
          int64_t slabs, double* band, int64_t width) {
  const SplineGrid& g = *grid;
  const int local = local_size(g);
  guard::Rescue rescue;
  for (int parity = 0; parity < 2; ++parity) {
#pragma omp parallel if (g.cells > kWorthThreads / 16)
    {
      std::optional<CellGram> room;
      const bool ready = rescue.run([&] { room.emplace(g.components, g.padded, local); });
#pragma omp for schedule(dynamic, 1)
      for (int64_t slab = parity; slab < slabs; slab += 2) {
        for (int64_t number = slab_start[slab]; ready && number < slab_start[slab + 1]; ++number) {
          CellGram& cell = *room;
          cell.clear();
          for (int32_t b = 0; b < block_count; ++b) {
            const SplineRows& rows = blocks[b];
            if (rows.kind >= kCellScalar) {
              if (rows.start[number + 1] > rows.start[number]) add_constant(g, rows, local, cell);
            } else {
              add_point_rows(g, rows, rows.start[number], rows.start[number + 1], local, cell);
            }
          }
          scatter(g, number, local, cell, band, width);
        }
      }
    }
  }
  rescue.rethrow();
}

// out (nodes, C) += rows' (target - rows x), the rows of one block. target in the caller's order, of which number[n] is
// row n's place; null: zero. x (nodes, C); null: zero. Slabs as in gram: they take turns, so that every
// coefficient's sum has one order, whatever the number of threads and whichever comes first.
void gradient(const SplineGrid* grid, const SplineRows* rows, const int64_t* slab_start, int64_t slabs,
              const double* target, const int64_t* number, const double* x, double* out) {
  const SplineGrid& g = *grid;
  const int local = local_size(g);
  const size_t size = size_t(local) * g.components;
  const PullCell pull = pull_cell_for(g);
  guard::Rescue rescue;
  for (int parity = 0; parity < 2; ++parity) {
#pragma omp parallel if (rows->count > kWorthThreads)
    {
      std::vector<double> row, near, pulled;
      const bool ready = rescue.run([&] { row.resize(size), near.resize(size), pulled.resize(size); });
#pragma omp for schedule(dynamic, 1)
      for (int64_t slab = parity; slab < slabs; slab += 2) {
        for (int64_t cell = slab_start[slab]; ready && cell < slab_start[slab + 1]; ++cell) {
          if (rows->start[cell] == rows->start[cell + 1]) continue;
          const int32_t* position = g.position + cell * local;
          if (x) gather(g, position, local, x, near.data());
          std::fill(pulled.begin(), pulled.end(), 0.0);
          pull(g, *rows, cell, target, number, x ? near.data() : nullptr, row.data(), pulled.data());
          scatter_add(g, position, local, pulled.data(), out);
        }
      }
    }
  }
  rescue.rethrow();
}

// Counting sort: number[place] is the row at each place when rows are sorted by their slot, equal ones in their order;
// start (slots + 1) the first place of each slot.
void sort(const int64_t* slot, int64_t count, int64_t slots, int64_t* number, int64_t* start) {
  std::fill_n(start, slots + 1, 0);
  for (int64_t n = 0; n < count; ++n) ++start[slot[n] + 1];
  for (int64_t s = 0; s < slots; ++s) start[s + 1] += start[s];
  std::vector<int64_t> next(start, start + slots);
  for (int64_t n = 0; n < count; ++n) number[next[slot[n]]++] = n;
}

}  // namespace

extern "C" {

int32_t spline_runs(const char* instruction_set) { return processor_runs(instruction_set); }

int32_t spline_tile_width() { return kCols; }

void spline_set_threads(int32_t threads) {
#ifdef _OPENMP
  omp_set_num_threads(threads);
#else
  (void)threads;
#endif
}

int32_t spline_fault(char* text, int64_t room) { return guard::read(text, room); }

void spline_gram(const SplineGrid* grid, const SplineRows* blocks, int32_t block_count, const int64_t* slab_start,
                 int64_t slabs, double* band, int64_t width) {
  guard::call([&] { gram(grid, blocks, block_count, slab_start, slabs, band, width); });
}

void spline_gradient(const SplineGrid* grid, const SplineRows* rows, const int64_t* slab_start, int64_t slabs,
                     const double* target, const int64_t* number, const double* x, double* out) {
  guard::call([&] { gradient(grid, rows, slab_start, slabs, target, number, x, out); });
}

void spline_sort(const int64_t* slot, int64_t count, int64_t slots, int64_t* number, int64_t* start) {
  guard::call([&] { sort(slot, count, slots, number, start); });
}

}  // extern "C"
