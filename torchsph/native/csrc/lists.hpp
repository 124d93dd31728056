// Cluster lists: for every cluster of 8 particles a the slots of all particles b within reach of any of the 8.
//
// The list of a cluster is a run of int32: for each periodic image with neighbours the image, the number of entries and
// the entries (filled up with the null slot to a multiple of the partners per register); then the end mark -1.
#pragma once
#include <atomic>

#include "columns.hpp"
#include "guard.hpp"
#include "compaction.hpp"

namespace sph {

constexpr std::int32_t list_end = -1;

// The particles a of one cluster in one periodic image, relative to their middle.
template <class Real, int D> struct Reach {
  Real middle[D], twice[D][cluster_size], square[cluster_size];  // 2 a and |a|^2
  double least[D], most[D];

  Reach(const std::vector<Real>* at, std::int64_t first, int image, const double* period) {
    Real lane[D][cluster_size];
    for (int d = 0; d < D; ++d) {
      const int step = image_step(image, d);
      const Real move = step ? Real(step * period[d]) : Real(0);
      for (int l = 0; l < cluster_size; ++l) lane[d][l] = at[d][first + l] + move;
      Real low = lane[d][0], high = lane[d][0];
      for (int l = 1; l < cluster_size; ++l) {
        low = std::min(low, lane[d][l]);
        high = std::max(high, lane[d][l]);
      }
      least[d] = low;
      most[d] = high;
      middle[d] = Real(0.5) * (low + high);
    }
    for (int l = 0; l < cluster_size; ++l) {
      square[l] = 0;
      for (int d = 0; d < D; ++d) {
        const Real a = lane[d][l] - middle[d];
        twice[d][l] = 2 * a;
        square[l] += a * a;
      }
    }
  }

  // Rounding of |a|^2 - 2 a.b + |b|^2 must not lose a neighbour: squares that the radius is raised by.
  Real allowance(Real radius) const {
    Real wide = radius;
    for (int d = 0; d < D; ++d) wide += Real(most[d] - least[d]);
    return 16 * std::numeric_limits<Real>::epsilon() * wide * wide;
  }
};

// Append the slots of [first, last) closer than the root of `reach2` to any of the 8 particles a.
template <class Real, int D>
SPH_INLINE void sift(const Columns<Real>& c, const Reach<Real, D>& a, std::int64_t first, std::int64_t last, Real reach2,
                     std::vector<std::int32_t>& out, std::size_t& size) {
  using L = Lanes<Real>;
  using V = typename L::Vector;
  const std::size_t room = size + std::size_t(last - first) + append_width<Real>;
  if (out.size() < room) out.resize(2 * room);
  std::int32_t* to = out.data() + size;
  for (std::int64_t j = first; j < last; j += L::count) {
    V b[D], square{}, least;  // least over a of |a|^2 - 2 a.b = r^2 - |b|^2
    for (int d = 0; d < D; ++d) {
      b[d] = L::load(c.at[d].data() + j) - a.middle[d];
      square += b[d] * b[d];
    }
    for (int l = 0; l < cluster_size; ++l) {
      V part = L::all(a.square[l]);
      for (int d = 0; d < D; ++d) part -= a.twice[d][l] * b[d];
      least = l ? smaller(least, part) : part;
    }
    to += append_below<Real>(to, std::int32_t(j), int(std::min<std::int64_t>(L::count, last - j)), least, reach2 - square);
  }
  size = std::size_t(to - out.data());
}

// All slots of the member's columns within reach of the cluster.
template <class Real, int D>
void gather(const Columns<Real>& c, std::int64_t member, const Reach<Real, D>& a, double radius,
            std::vector<std::int32_t>& out, std::size_t& size) {
  const Box& box = c.box[member];
  const double reach = radius * (1 + 1e-5);  // a rounded cell edge must not hide a neighbour
  for (int d = 0; d < D; ++d)
    if (a.most[d] + reach < box.least[d] || a.least[d] - reach > box.most[d]) return;
  const auto apart = [&](int axis, std::int64_t k) {
    return std::max(0.0, std::max(box.left(axis, k) - a.most[axis], a.least[axis] - box.right(axis, k)));
  };
  const Real reach2 = Real(radius * radius) + a.allowance(Real(radius));
  const std::int64_t z0 = D == 3 ? box.cell(2, a.least[2] - reach) : 0, z1 = D == 3 ? box.cell(2, a.most[2] + reach) : 0;
  const std::int64_t y0 = box.cell(1, a.least[1] - reach), y1 = box.cell(1, a.most[1] + reach);
  for (std::int64_t z = z0; z <= z1; ++z) {
    const double gz = D == 3 ? apart(2, z) : 0;
    for (std::int64_t y = y0; y <= y1; ++y) {
      const double gy = apart(1, y), left = reach * reach - gz * gz - gy * gy;
      if (left <= 0) continue;
      const double along = std::sqrt(left);
      const std::int64_t column = z * box.cells[1] + y, bin = box.first_bin + column * box.cells[0];
      const std::int64_t shift = c.shift[c.first_column[member] + column];
      const std::int64_t first = c.start[bin + box.cell(0, a.least[0] - along)] + shift;
      const std::int64_t last = c.start[bin + box.cell(0, a.most[0] + along) + 1] + shift;
      sift<Real, D>(c, a, first, last, reach2, out, size);
    }
  }
}

// The complete list of the particles a at slots [first, first + 8) of `at` against the particles in `c`, with end mark.
template <class Real, int D>
void list_cluster(const Columns<Real>& c, std::int64_t member, const std::vector<Real>* at, std::int64_t first,
                  const Shape& shape, std::vector<std::int32_t>& out, std::size_t& size) {
  const std::int32_t null_slot = std::int32_t(c.slots());
  for (int image = 0; image < images; ++image) {
    bool exists = true;
    for (int d = 0; d < 3; ++d) exists = exists && (image_step(image, d) == 0 || (d < D && shape.period[d] < 1e300));
    if (!exists) continue;
    const std::size_t header = size;
    if (out.size() < size + 64) out.resize(2 * size + 64);
    size += 2;
    gather<Real, D>(c, member, Reach<Real, D>(at, first, image, shape.period), shape.radius, out, size);
    if (size == header + 2) {
      size = header;
      continue;
    }
    if (out.size() < size + 8) out.resize(2 * size + 8);
    while ((size - header) % Lanes<Real>::partners) out[size++] = null_slot;
    out[header] = image;
    out[header + 1] = std::int32_t(size - header - 2);
  }
  if (out.size() < size + 8) out.resize(2 * size + 8);
  out[size++] = list_end;
}

// Lists of all clusters into `entries`, where they fit. Returns the entries needed; offset[cluster] says where each begins.
template <class Real, int D>
std::int64_t list_all(const Columns<Real>& c, const Shape& shape, std::int64_t capacity, std::int64_t* offset,
                      std::int32_t* entries) {
  constexpr std::int64_t chunk = 16;
  const std::int64_t chunks = (c.clusters + chunk - 1) / chunk;
  std::atomic<std::int64_t> used{0};
  guard::Rescue rescue;
#pragma omp parallel num_threads(shape.threads)
  {
    std::vector<std::int32_t> buffer;  // grows below, where a lack of memory is caught
    std::int64_t begin[chunk];
#pragma omp for schedule(dynamic, 2)
    for (std::int64_t k = 0; k < chunks; ++k) {
      const std::int64_t first = k * chunk, last = std::min(first + chunk, c.clusters);
      std::size_t size = 0;
      const bool listed = rescue.run([&] {
        for (std::int64_t g = first; g < last; ++g) {
          begin[g - first] = std::int64_t(size);
          list_cluster<Real, D>(c, c.owner[g], c.at, g * cluster_size, shape, buffer, size);
        }
      });
      if (!listed) continue;
      const std::int64_t at = used.fetch_add(std::int64_t(size));
      for (std::int64_t g = first; g < last; ++g) offset[g] = at + begin[g - first];
      if (at + std::int64_t(size) <= capacity) std::memcpy(entries + at, buffer.data(), size * sizeof(std::int32_t));
    }
  }
  rescue.rethrow();
  return used.load();
}

}  // namespace sph
