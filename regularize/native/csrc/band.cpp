// Cholesky factorisation and triangular solves of band matrices inside their envelope.
//
// Plain C interface, called through ctypes (see native.py); cholesky.py is the reference that the tests compare with,
// and explains the storage: column j of the matrix lies in row j of the band, from the diagonal downwards. Strips of
// columns are factored at once; what they subtract from the rest is summed in register tiles of kRows x kCols.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "guard.hpp"

#ifdef _OPENMP
#include <omp.h>
#endif

namespace {

#if defined(__AVX512F__)
constexpr int kBytes = 64, kCols = 8;
#elif defined(__AVX__)
constexpr int kBytes = 32, kCols = 4;
#else
constexpr int kBytes = 16, kCols = 4;
#endif

constexpr int kStrip = 128;  // columns factored at once
constexpr int kGroup = 4;    // columns of a solve taken together: each entry of x is then fetched and stored once for four
constexpr int kSweep = 512;  // columns of a solve between two meetings of the threads
constexpr int64_t kWorthThreads = 1 << 22;  // entries of the band; with fewer the threads' meetings cost more
constexpr int kPiece = 256;  // rows or columns of the rest that one thread updates at once: they fit its cache

template <typename T>
struct Lanes;
template <>
struct Lanes<double> {
  typedef double Vector __attribute__((vector_size(kBytes), aligned(8), may_alias));
};
template <>
struct Lanes<float> {
  typedef float Vector __attribute__((vector_size(kBytes), aligned(4), may_alias));
};

template <typename T>
struct Tile {
  static constexpr int kRows = 2 * kBytes / int(sizeof(T));
  using Vector = typename Lanes<T>::Vector;
  Vector sum[kCols][2];

  // sum[c] -= left[k] * right[k][c] over k; left (depth, kRows), right (depth, stride) with kCols values in use
  void subtract(const T* left, const T* right, int64_t stride, int depth) {
    for (int k = 0; k < depth; ++k) {
      const Vector* row = reinterpret_cast<const Vector*>(left + k * kRows);
      const Vector a = row[0], b = row[1];
      for (int c = 0; c < kCols; ++c) {
        const T factor = right[k * stride + c];
        sum[c][0] -= a * factor;
        sum[c][1] -= b * factor;
      }
    }
  }
  T* column(int c) { return reinterpret_cast<T*>(sum[c]); }
};

template <typename T>
struct Band {
  T* data;
  int64_t count, width;
  const int64_t* reach;

  T* column(int64_t j) const { return data + j * width - j; }  // its entry i at [i]
  int64_t end(int64_t j) const { return std::min(reach[j] + 1, j + width); }  // rows of column j
};

// The diagonal block of a strip in place; its transpose and inverse diagonal for the rows below. False: not positive.
template <typename T>
bool factor_diagonal(const Band<T>& band, int64_t start, int depth, T* transposed, T* inverse) {
  for (int k = 0; k < depth; ++k) {
    T* own = band.column(start + k) + start;
    if (!(own[k] > 0)) return false;
    const T root = std::sqrt(own[k]);
    own[k] = root;
    inverse[k] = 1 / root;
    const int end = int(std::min<int64_t>(depth, band.end(start + k) - start));
    for (int i = k + 1; i < end; ++i) own[i] *= inverse[k];
    for (int j = k + 1; j < end; ++j) {
      T* other = band.column(start + j) + start;
      const T factor = own[j];
#pragma omp simd
      for (int i = j; i < end; ++i) other[i] -= own[i] * factor;
    }
    for (int i = 0; i < kStrip; ++i) transposed[k * kStrip + i] = i >= k && i < end ? own[i] : T(0);
  }
  return true;
}

// Rows (first, first + kRows) of a strip: divided by the diagonal block, stored in the band and in panel (depth, kRows).
template <typename T>
void solve_rows(const Band<T>& band, int64_t start, int depth, int64_t first, int64_t end, const T* transposed,
                const T* inverse, T* panel) {
  constexpr int rows = Tile<T>::kRows;
  for (int k0 = 0; k0 < depth; k0 += kCols) {
    const int columns = std::min(kCols, depth - k0);
    Tile<T> tile = {};
    for (int c = 0; c < columns; ++c) {
      const T* from = band.column(start + k0 + c);
      const int64_t last = std::min(end, band.end(start + k0 + c));
      T* to = tile.column(c);
      for (int r = 0; r < rows; ++r) to[r] = first + r < last ? from[first + r] : T(0);
    }
    tile.subtract(panel, transposed + k0, kStrip, k0);
    for (int c = 0; c < columns; ++c) {
      for (int p = 0; p < c; ++p) {
        const T factor = transposed[(k0 + p) * kStrip + k0 + c];
        tile.sum[c][0] -= tile.sum[p][0] * factor;
        tile.sum[c][1] -= tile.sum[p][1] * factor;
      }
      tile.sum[c][0] *= inverse[k0 + c];
      tile.sum[c][1] *= inverse[k0 + c];
      const T* from = tile.column(c);
      T* to = band.column(start + k0 + c);
      const int64_t last = std::min(end, band.end(start + k0 + c));
      std::copy(from, from + rows, panel + (k0 + c) * rows);
      for (int64_t i = first; i < std::min(first + rows, last); ++i) to[i] = from[i - first];
    }
  }
}

// Subtract panel panel' from the entries (rows of one piece, columns of another) of the lower triangle.
template <typename T>
void update_piece(const Band<T>& band, int64_t stop, int64_t end, int depth, const T* panel, int64_t row, int64_t column) {
  constexpr int rows = Tile<T>::kRows;
  const int64_t row_end = std::min(end, row + kPiece), column_end = std::min(end, column + kPiece);
  for (int64_t j = column; j < column_end; j += kCols) {
    const T* right = panel + (j - stop) / rows * rows * depth + (j - stop) % rows;
    const int columns = int(std::min<int64_t>(kCols, column_end - j));
    for (int64_t i = std::max(row, stop + (j - stop) / rows * rows); i < row_end; i += rows) {
      Tile<T> tile = {};
      tile.subtract(panel + (i - stop) * depth, right, rows, depth);
      for (int c = 0; c < columns; ++c) {
        T* to = band.column(j + c);
        const T* from = tile.column(c);
        const int64_t first = std::max(i, j + c), last = std::min(i + rows, row_end);
        if (last - first == rows) {
          using Vector = typename Tile<T>::Vector;
          Vector* whole = reinterpret_cast<Vector*>(to + i);
          whole[0] += tile.sum[c][0];
          whole[1] += tile.sum[c][1];
        } else {
          for (int64_t k = first; k < last; ++k) to[k] += from[k - i];
        }
      }
    }
  }
}

template <typename T>
int32_t factorise(const Band<T>& band) {
  constexpr int rows = Tile<T>::kRows;
  // a strip wider than the band would not do: its panel would not touch every column
  const int step = int(std::max<int64_t>(1, std::min<int64_t>(kStrip, band.width - 1)));
  std::vector<T> transposed(kStrip * kStrip), inverse(kStrip), panel(size_t(step) * (band.width + 2 * rows));
  bool good = true;
#pragma omp parallel if (band.count * band.width > kWorthThreads)
  for (int64_t start = 0; start < band.count; start += step) {
    const int64_t stop = std::min(start + step, band.count), end = band.reach[stop - 1] + 1;
    const int depth = int(stop - start);
#pragma omp single
    good = factor_diagonal(band, start, depth, transposed.data(), inverse.data());
    if (!good) break;
#pragma omp for schedule(static)
    for (int64_t i = stop; i < end; i += rows)
      solve_rows(band, start, depth, i, end, transposed.data(), inverse.data(), panel.data() + (i - stop) * depth);
    const int64_t pieces = (end - stop + kPiece - 1) / kPiece;
#pragma omp for schedule(dynamic, 1)
    for (int64_t pair = 0; pair < pieces * pieces; ++pair) {
      const int64_t row = pair / pieces, column = pair % pieces;
      if (column <= row)
        update_piece(band, stop, end, depth, panel.data(), stop + row * kPiece, stop + column * kPiece);
    }
  }
  return good;
}

// x[i] -= L(i, j) x[j] for the columns (start, stop) and rows (first, last), kGroup columns in one pass over the rows
template <typename T>
void push(const Band<T>& band, int64_t start, int64_t stop, int64_t first, int64_t last, T* x) {
  int64_t j = start;
  for (; j + kGroup <= stop; j += kGroup) {
    const T *a = band.column(j), *b = band.column(j + 1), *c = band.column(j + 2), *d = band.column(j + 3);
    const T p = x[j], q = x[j + 1], r = x[j + 2], s = x[j + 3];
    const int64_t end = std::max(first, std::min(last, band.end(j)));  // column j is the first to end
#pragma omp simd
    for (int64_t i = first; i < end; ++i) x[i] -= a[i] * p + b[i] * q + c[i] * r + d[i] * s;
    for (int k = 1; k < kGroup; ++k)
      for (int64_t i = end; i < std::min(last, band.end(j + k)); ++i) x[i] -= band.column(j + k)[i] * x[j + k];
  }
  for (; j < stop; ++j)
    for (int64_t i = first; i < std::min(last, band.end(j)); ++i) x[i] -= band.column(j)[i] * x[j];
}

// x[j] -= sum of L(i, j) x[i] over the rows (first, last), for kGroup columns from j
template <typename T>
void pull(const Band<T>& band, int64_t j, int64_t first, int64_t last, T* x) {
  const T *a = band.column(j), *b = band.column(j + 1), *c = band.column(j + 2), *d = band.column(j + 3);
  const int64_t end = std::max(first, std::min(last, band.end(j)));
  T p = 0, q = 0, r = 0, s = 0;
#pragma omp simd reduction(+ : p, q, r, s)
  for (int64_t i = first; i < end; ++i) {
    p += a[i] * x[i];
    q += b[i] * x[i];
    r += c[i] * x[i];
    s += d[i] * x[i];
  }
  const T sum[kGroup] = {p, q, r, s};
  for (int k = 0; k < kGroup; ++k) {
    T rest = sum[k];
    for (int64_t i = end; i < std::min(last, band.end(j + k)); ++i) rest += band.column(j + k)[i] * x[i];
    x[j + k] -= rest;
  }
}

// Columns (start, stop), at most kGroup, against their own triangle
template <typename T>
void solve_triangle(const Band<T>& band, int64_t start, int64_t stop, bool lower, T* x) {
  if (lower) {
    for (int64_t j = start; j < stop; ++j) {
      x[j] /= band.column(j)[j];
      for (int64_t i = j + 1; i < std::min(stop, band.end(j)); ++i) x[i] -= band.column(j)[i] * x[j];
    }
    return;
  }
  for (int64_t j = stop - 1; j >= start; --j) {
    for (int64_t i = j + 1; i < std::min(stop, band.end(j)); ++i) x[j] -= band.column(j)[i] * x[i];
    x[j] /= band.column(j)[j];
  }
}

// x (sides, count) in place: L x = right
template <typename T>
void solve_lower(const Band<T>& band, int64_t sides, T* x) {
#pragma omp parallel if (band.count * band.width * sides > kWorthThreads)
  for (int64_t start = 0; start < band.count; start += kSweep) {
    const int64_t stop = std::min<int64_t>(start + kSweep, band.count), end = band.reach[stop - 1] + 1;
#pragma omp for schedule(static)
    for (int64_t side = 0; side < sides; ++side) {
      T* own = x + side * band.count;
      for (int64_t j = start; j < stop; j += kGroup) {
        const int64_t next = std::min(j + kGroup, stop);
        solve_triangle(band, j, next, true, own);
        push(band, j, next, next, stop, own);
      }
    }
#pragma omp for schedule(static) collapse(2)
    for (int64_t first = stop; first < end; first += kPiece)
      for (int64_t side = 0; side < sides; ++side)
        push(band, start, stop, first, std::min(end, first + kPiece), x + side * band.count);
  }
}

// x (sides, count) in place: L' x = right
template <typename T>
void solve_upper(const Band<T>& band, int64_t sides, T* x) {
#pragma omp parallel if (band.count * band.width * sides > kWorthThreads)
  for (int64_t start = (band.count - 1) / kSweep * kSweep; start >= 0; start -= kSweep) {
    const int64_t stop = std::min<int64_t>(start + kSweep, band.count);
    const int64_t groups = (stop - start) / kGroup, tail = start + groups * kGroup;  // a tail ends the matrix
#pragma omp for schedule(static) collapse(2)
    for (int64_t group = 0; group < groups; ++group)
      for (int64_t side = 0; side < sides; ++side)
        pull(band, start + group * kGroup, stop, band.count, x + side * band.count);
#pragma omp for schedule(static)
    for (int64_t side = 0; side < sides; ++side) {
      T* own = x + side * band.count;
      if (tail < stop) solve_triangle(band, tail, stop, false, own);
      for (int64_t j = tail - kGroup; j >= start; j -= kGroup) {
        pull(band, j, j + kGroup, stop, own);
        solve_triangle(band, j, j + kGroup, false, own);
      }
    }
  }
}

template <typename T>
void solve(const Band<T>& band, int32_t parts, int64_t sides, T* x) {
  if (parts & 1) solve_lower(band, sides, x);
  if (parts & 2) solve_upper(band, sides, x);
}

}  // namespace

extern "C" {

// Overwrite a band (count, width) by its factor; reach[j], rising: last row of column j. 0: not positive definite.
int32_t spline_factor_f64(double* band, int64_t count, int64_t width, const int64_t* reach) {
  return guard::call([&] { return factorise(Band<double>{band, count, width, reach}); });
}

int32_t spline_factor_f32(float* band, int64_t count, int64_t width, const int64_t* reach) {
  return guard::call([&] { return factorise(Band<float>{band, count, width, reach}); });
}

// x (sides, count) in place; parts 1: L x = right, 2: L' x = right, 3: both
void spline_solve_f64(double* band, int64_t count, int64_t width, const int64_t* reach, int32_t parts, int64_t sides,
                      double* x) {
  guard::call([&] { solve(Band<double>{band, count, width, reach}, parts, sides, x); });
}

void spline_solve_f32(float* band, int64_t count, int64_t width, const int64_t* reach, int32_t parts, int64_t sides,
                      float* x) {
  guard::call([&] { solve(Band<float>{band, count, width, reach}, parts, sides, x); });
}

}  // extern "C"
