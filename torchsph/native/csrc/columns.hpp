// Counting sort of particles into columns: cells of width ~0.8 radii across, fine bins along the first axis.
//
// Every member has its own box and its own part of the table, so that a batch sorts as its members would alone.
// Coordinates are clamped to the table: the map from coordinate to cell is monotone, hence a range of coordinates always
// covers the particles in it, and particles far away from all others cost no table.
#pragma once
#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <vector>

#include "finite.hpp"
#include "lanes.hpp"

namespace sph {

constexpr double column_width = 1.0;            // in search radii, across the columns
constexpr double bin_width = 0.15;              // in search radii, along them
constexpr std::int64_t bins_per_particle = 32;  // a larger table is made coarser
constexpr int slack = 16;                    // reals that vector loads may read past the end

constexpr int images = 27;

// Periodic image i moves the particles a by image_step(i, axis) periods; image 13 is the particle itself.
SPH_INLINE int image_step(int image, int axis) {
  const int power[3] = {1, 3, 9};
  return image / power[axis] % 3 - 1;
}

struct Box {
  double least[3], most[3];      // bounds of the member's particles
  double lower[3], inverse[3];   // where the table begins and cells per length
  std::int64_t cells[3] = {1, 1, 1};
  std::int64_t first_bin = 0;

  template <class Real> SPH_INLINE std::int64_t cell(int axis, Real x) const {
    const double at = (double(x) - lower[axis]) * inverse[axis];
    const double last = double(cells[axis] - 1);
    return std::int64_t(at < 0 ? 0 : at > last ? last : at);
  }
  std::int64_t bins() const { return cells[0] * cells[1] * cells[2]; }
  std::int64_t columns() const { return cells[1] * cells[2]; }
  template <int D, class Real> SPH_INLINE std::int64_t bin(const Real* x) const {
    std::int64_t column = cell(1, x[1]);
    if constexpr (D == 3) column += cells[1] * cell(2, x[2]);
    return first_bin + column * cells[0] + cell(0, x[0]);
  }
  // a column's outermost cells reach to infinity, because coordinates are clamped into them
  double left(int axis, std::int64_t c) const { return c == 0 ? -1e300 : lower[axis] + double(c) / inverse[axis]; }
  double right(int axis, std::int64_t c) const {
    return c == cells[axis] - 1 ? 1e300 : lower[axis] + double(c + 1) / inverse[axis];
  }
};

// Particles of one axis of a member inside which a table pays: all of them, or the bulk where strays stretch the box.
template <class Real, int D>
void lay_table(Box& box, const Real* wrapped, const std::int64_t* member, std::int64_t id, std::int64_t particles,
               std::int64_t of_member, double radius) {
  const auto cut = [&](const double* lower, const double* upper, double coarser) {
    for (int d = 0; d < D; ++d) {
      const double width = radius * (d == 0 ? bin_width : column_width) * coarser;
      box.lower[d] = lower[d];
      box.inverse[d] = 1 / width;
      box.cells[d] = std::int64_t(std::min(std::max((upper[d] - lower[d]) / width, 0.0), 1e6)) + 1;
    }
  };
  const std::int64_t budget = 64 + bins_per_particle * of_member;
  const auto bins = [&] { return double(box.cells[0]) * double(box.cells[1]) * double(box.cells[2]); };
  cut(box.least, box.most, 1);
  if (bins() <= double(budget)) return;
  double lower[3], upper[3];
  for (int d = 0; d < D; ++d) {
    std::vector<double> sample;
    const std::int64_t step = std::max<std::int64_t>(1, of_member / 2048);
    std::int64_t seen = 0;
    for (std::int64_t i = 0; i < particles; ++i)
      if (member[i] == id && seen++ % step == 0) sample.push_back(double(wrapped[i * D + d]));
    const auto at = [&](double part) {
      const auto nth = sample.begin() + std::int64_t(part * double(sample.size() - 1));
      std::nth_element(sample.begin(), nth, sample.end());
      return *nth;
    };
    const double low = at(0.02), high = at(0.98), rim = 0.1 * (high - low) + 2 * radius;
    lower[d] = std::max(box.least[d], low - rim);
    upper[d] = std::min(box.most[d], high + rim);
  }
  for (double coarser = 1; cut(lower, upper, coarser), bins() > double(budget); coarser *= 1.5) {
  }
}

struct Shape {  // what the caller gives the search
  std::int64_t particles;
  const std::int64_t* member;
  double radius;
  double period[3];  // infinity: not periodic
  int threads;
};

template <class Real> struct Columns {
  std::int64_t members = 0, clusters = 0, table = 0, columns = 0;
  std::vector<Box> box;
  std::vector<std::int64_t> count;                // particles of each member
  std::vector<std::int32_t> start;                // (bins + 1) first sorted particle of each bin
  std::vector<std::int32_t> order, bin_of;        // sorted -> particle; particle -> bin
  std::vector<std::int32_t> shift;                // (columns) slot minus sorted index
  std::vector<std::int64_t> first_column;         // (members + 1)
  std::vector<std::int32_t> slot, owner;          // (slots) particle, ~particle for padding; (clusters) member
  std::vector<Real> wrapped;                      // (particles, D) inside the period
  std::vector<Real> at[3];                        // (slots) coordinates
  std::vector<std::int32_t> histogram;
  std::int64_t slots() const { return clusters * cluster_size; }
};

template <int D, class Real> SPH_INLINE void wrap(const Real* x, const double* period, Real* out) {
  for (int d = 0; d < D; ++d)
    out[d] = period[d] < 1e300 ? Real(x[d] - period[d] * std::floor(x[d] / period[d])) : x[d];
}

// Bounds and counts of every member; the number of particles that are not finite or have a negative member.
template <class Real, int D>
std::int64_t survey(const Shape& shape, const Real* position, Columns<Real>& c) {
  const std::int64_t n = shape.particles;
  std::int64_t members = 0, bad = 0;
#pragma omp parallel for num_threads(shape.threads) reduction(max : members) reduction(+ : bad) schedule(static)
  for (std::int64_t i = 0; i < n; ++i) {
    members = std::max(members, shape.member[i] + 1);
    bool good = shape.member[i] >= 0;
    for (int d = 0; d < D; ++d) good = good && finite(position[i * D + d]);
    bad += !good;
  }
  if (bad) return bad;
  c.members = members;
  c.wrapped.resize(n * D + slack);
  c.count.assign(members, 0);
  Box empty;
  for (int d = 0; d < 3; ++d) {
    empty.least[d] = std::numeric_limits<double>::max();
    empty.most[d] = std::numeric_limits<double>::lowest();
  }
  c.box.assign(members, empty);
  // made before the region, which no lack of memory may leave
  std::vector<std::vector<Box>> boxes(shape.threads, std::vector<Box>(members, empty));
  std::vector<std::vector<std::int64_t>> counts(shape.threads, std::vector<std::int64_t>(members, 0));
#pragma omp parallel num_threads(shape.threads)
  {
    std::vector<Box>& box = boxes[omp_get_thread_num()];
    std::vector<std::int64_t>& count = counts[omp_get_thread_num()];
#pragma omp for schedule(static) nowait
    for (std::int64_t i = 0; i < n; ++i) {
      const std::int64_t m = shape.member[i];
      wrap<D>(position + i * D, shape.period, c.wrapped.data() + i * D);
      ++count[m];
      for (int d = 0; d < D; ++d) {
        const double x = c.wrapped[i * D + d];
        box[m].least[d] = std::min(box[m].least[d], x);
        box[m].most[d] = std::max(box[m].most[d], x);
      }
    }
#pragma omp critical(sph_survey)
    for (std::int64_t m = 0; m < members; ++m) {
      c.count[m] += count[m];
      for (int d = 0; d < D; ++d) {
        c.box[m].least[d] = std::min(c.box[m].least[d], box[m].least[d]);
        c.box[m].most[d] = std::max(c.box[m].most[d], box[m].most[d]);
      }
    }
  }
  return 0;
}

// Sort the particles whose wrapped positions are in `c` into the boxes of `c`, stably, with a histogram per thread.
template <class Real, int D> void sort_into_bins(const Shape& shape, Columns<Real>& c) {
  const std::int64_t n = shape.particles, bins = c.table;
  const int threads = int(std::min<std::int64_t>(shape.threads, std::max<std::int64_t>(1, n / 4096)));
  if (bins > std::numeric_limits<std::int32_t>::max())
    throw std::overflow_error("the search's table has more cells than an int32 can number");
  c.bin_of.resize(n);
  c.order.resize(n);
  c.start.resize(bins + 1);
  c.histogram.resize(bins * threads);
#pragma omp parallel num_threads(threads)
  {
    const int t = omp_get_thread_num(), team = omp_get_num_threads();
    std::int32_t* own = c.histogram.data() + t * bins;
    std::fill(own, own + bins, 0);
    const std::int64_t first = n * t / team, last = n * (t + 1) / team;
    for (std::int64_t i = first; i < last; ++i) {
      const std::int64_t b = c.box[shape.member[i]].template bin<D>(c.wrapped.data() + i * D);
      c.bin_of[i] = std::int32_t(b);
      ++own[b];
    }
#pragma omp barrier
#pragma omp single
    {
      std::int32_t total = 0;
      for (std::int64_t b = 0; b < bins; ++b) {
        c.start[b] = total;
        for (int q = 0; q < team; ++q) {
          const std::int32_t here = c.histogram[q * bins + b];
          c.histogram[q * bins + b] = total;
          total += here;
        }
      }
      c.start[bins] = total;
    }
    for (std::int64_t i = first; i < last; ++i) c.order[own[c.bin_of[i]]++] = std::int32_t(i);
  }
}

// Cut every column into clusters of 8 consecutive particles; the last of a column is filled up with its last particle.
template <class Real, int D> void cut_clusters(const Shape& shape, Columns<Real>& c) {
  c.shift.resize(c.columns);
  std::vector<std::int64_t> first_cluster(c.columns + 1, 0);
  std::int64_t column = 0, clusters = 0;
  for (const Box& box : c.box)
    for (std::int64_t k = 0; k < box.columns(); ++k, ++column) {
      const std::int64_t first = c.start[box.first_bin + k * box.cells[0]];
      const std::int64_t last = c.start[box.first_bin + (k + 1) * box.cells[0]];
      first_cluster[column] = clusters;
      c.shift[column] = std::int32_t(clusters * cluster_size - first);
      clusters += (last - first + cluster_size - 1) / cluster_size;
    }
  first_cluster[column] = clusters;
  c.clusters = clusters;
  if (c.slots() + slack > std::numeric_limits<std::int32_t>::max())
    throw std::overflow_error("the search has more slots than an int32 can number");
  c.slot.resize(c.slots());
  c.owner.resize(clusters);
  for (int d = 0; d < D; ++d) c.at[d].resize(c.slots() + slack);
#pragma omp parallel for num_threads(shape.threads) schedule(dynamic, 1)
  for (std::int64_t m = 0; m < c.members; ++m) {
    const Box& box = c.box[m];
    for (std::int64_t k = 0; k < box.columns(); ++k) {
      const std::int64_t own = c.first_column[m] + k;
      const std::int64_t last = c.start[box.first_bin + (k + 1) * box.cells[0]];
      for (std::int64_t g = first_cluster[own]; g < first_cluster[own + 1]; ++g) {
        c.owner[g] = std::int32_t(m);
        for (std::int64_t s = g * cluster_size; s < (g + 1) * cluster_size; ++s) {
          const std::int64_t rank = s - c.shift[own];
          const std::int32_t particle = c.order[std::min(rank, last - 1)];
          c.slot[s] = rank < last ? particle : ~particle;
          for (int d = 0; d < D; ++d) c.at[d][s] = c.wrapped[std::int64_t(particle) * D + d];
        }
      }
    }
  }
}

// Positions -> columns and clusters. Returns the number of unusable particles (0: done).
template <class Real, int D> std::int64_t sort_columns(const Shape& shape, const Real* position, Columns<Real>& c) {
  if (const std::int64_t bad = survey<Real, D>(shape, position, c)) return bad;
  c.first_column.assign(c.members + 1, 0);
  c.table = 0;
  for (std::int64_t m = 0; m < c.members; ++m) {
    Box& box = c.box[m];
    if (c.count[m] == 0)
      for (int d = 0; d < 3; ++d) box.least[d] = box.most[d] = 0;
    lay_table<Real, D>(box, c.wrapped.data(), shape.member, m, shape.particles, c.count[m], shape.radius);
    box.first_bin = c.table;
    c.table += box.bins();
    c.first_column[m + 1] = c.first_column[m] + box.columns();
  }
  c.columns = c.first_column[c.members];
  sort_into_bins<Real, D>(shape, c);
  cut_clusters<Real, D>(shape, c);
  return 0;
}

}  // namespace sph
