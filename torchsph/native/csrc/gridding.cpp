// Points spread over a periodic lattice with a compact kernel, and its adjoint; see ultrasound/gridding.py.
#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "finite.hpp"
#include "guard.hpp"
#include "interface.h"
#include "lanes.hpp"

namespace {

using std::int64_t;

constexpr int most_nodes = 12;  // per axis

// The nodes that a point touches and their weights, axis by axis, x first; a plane has one node of weight 1 along z.
template <class Real, int fixed>
struct Stencil {
  using L = sph::Lanes<Real>;
  const sph_gridding& a;
  const int width;
  int64_t first[3] = {}, counts[3] = {1, 1, 1};
  int nodes[3] = {1, 1, 1};
  alignas(64) Real weight[3 * 16];  // read and written by whole registers

  explicit Stencil(const sph_gridding& a) : a(a), width(fixed ? fixed : a.width) {
    for (int k = 0; k < a.dimension; ++k) counts[k] = a.counts[k], nodes[k] = width;
  }

  Real along(const Real* point, int k) const { return (point[k] - Real(a.origin[k])) / Real(a.spacing[k]); }
  int64_t begin(Real place) const { return int64_t(std::ceil(place - Real(0.5) * Real(width))); }

  // False for a point that is nowhere.
  bool find(const Real* point) {
    for (int k = 0; k < a.dimension; ++k) {
      const Real place = along(point, k);
      if (!sph::finite(place)) return false;
      first[k] = begin(place);
      for (int i = 0; i < width; ++i)
        weight[k * width + i] = (Real(first[k] + i) - place) / (Real(0.5) * Real(width));
      first[k] = wrapped(first[k], k);
    }
    for (int i = a.dimension * width; i % L::count; ++i) weight[i] = 1;
    for (int i = 0; i < a.dimension * width; i += L::count) {
      const typename L::Vector d = L::load(weight + i), rest = sph::positive_part(1 - d * d);
      const auto w = sph::exponential(Real(a.shape_parameter) * (sph::square_root(rest) - 1));
      L::store(weight + i, d * d <= 1 ? w : typename L::Vector{});
    }
    if (a.dimension == 2) weight[2 * width] = 1;
    return true;
  }

  int64_t wrapped(int64_t node, int k) const {
    if (node >= 0 && node < counts[k]) return node;  // divisions are slow
    const int64_t rest = node % counts[k];
    return rest < 0 ? rest + counts[k] : rest;
  }
  int64_t node(int k, int i) const {
    const int64_t n = first[k] + i;
    return n < counts[k] ? n : n - counts[k];
  }

  // Calls f(start of the row, its weight) for the rows of samples that the point touches in planes `low` to `high`.
  template <class Field, class F>
  void rows(Field* field, int64_t low, int64_t high, F f) const {
    for (int z = 0; z < nodes[2]; ++z)
      for (int y = 0; y < nodes[1]; ++y) {
        const int64_t row = node(1, y), plane = node(2, z), slowest = a.dimension == 3 ? plane : row;
        if (slowest >= low && slowest < high)
          f(field + 2 * (plane * counts[1] + row) * counts[0], weight[2 * width + z] * weight[width + y]);
      }
  }
  bool together() const { return first[0] + width <= counts[0]; }  // along x
};

// Each thread adds to planes of its own, so that a node's sum is in the order of the points.
template <class Real, int fixed>
void spread(const sph_gridding& a) {
  const auto *position = static_cast<const Real*>(a.position), *values = static_cast<const Real*>(a.values);
  Real* field = static_cast<Real*>(a.field);
  const int slowest = a.dimension - 1;
  const int64_t planes = a.counts[slowest];
#pragma omp parallel num_threads(a.threads)
  {
    const int64_t threads = omp_get_num_threads(), low = omp_get_thread_num() * planes / threads,
                  high = (omp_get_thread_num() + 1) * planes / threads;
    Stencil<Real, fixed> s(a);
    const int wide = s.width;
    Real part[2 * most_nodes];
    for (int64_t p = 0; p < a.points; ++p) {
      const Real *point = position + p * a.dimension, place = s.along(point, slowest);
      if (!sph::finite(place)) continue;
      const int64_t first = s.wrapped(s.begin(place), slowest);
      if (!(first < high && first + wide > low) && first + wide - planes <= low) continue;
      if (!s.find(point)) continue;
      for (int i = 0; i < wide; ++i)
        part[2 * i] = s.weight[i] * values[2 * p], part[2 * i + 1] = s.weight[i] * values[2 * p + 1];
      s.rows(field, low, high, [&](Real* row, Real weight) {
        if (s.together()) {
          Real* to = row + 2 * s.first[0];
          for (int i = 0; i < 2 * wide; ++i) to[i] += weight * part[i];
        } else {
          for (int i = 0; i < wide; ++i)
            for (int c = 0; c < 2; ++c) row[2 * s.node(0, i) + c] += weight * part[2 * i + c];
        }
      });
    }
  }
}

template <class Real, int fixed>
void gather(const sph_gridding& a) {
  const auto *position = static_cast<const Real*>(a.position), *field = static_cast<const Real*>(a.field);
  Real* values = static_cast<Real*>(a.values);
#pragma omp parallel num_threads(a.threads)
  {
    Stencil<Real, fixed> s(a);
    const int wide = s.width;
#pragma omp for schedule(static)
    for (int64_t p = 0; p < a.points; ++p) {
      values[2 * p] = values[2 * p + 1] = 0;
      if (!s.find(position + p * a.dimension)) continue;
      Real sum[2 * most_nodes] = {};
      s.rows(field, 0, a.counts[a.dimension - 1], [&](const Real* row, Real weight) {
        if (s.together()) {
          const Real* from = row + 2 * s.first[0];
          for (int i = 0; i < 2 * wide; ++i) sum[i] += weight * from[i];
        } else {
          for (int i = 0; i < wide; ++i)
            for (int c = 0; c < 2; ++c) sum[2 * i + c] += weight * row[2 * s.node(0, i) + c];
        }
      });
      for (int i = 0; i < wide; ++i)
        for (int c = 0; c < 2; ++c) values[2 * p + c] += s.weight[i] * sum[2 * i + c];
    }
  }
}

}  // namespace

#define SPH_GRIDDING(name, Real, suffix)                                     \
  extern "C" void sph_##name##suffix(const sph_gridding* arguments) {        \
    guard::call([&] {                                                        \
      const sph_gridding& a = *arguments;                                    \
      a.width == 4 ? name<Real, 4>(a) : name<Real, 0>(a); /* the default */  \
    });                                                                      \
  }
SPH_GRIDDING(spread, float, _f32)
SPH_GRIDDING(spread, double, _f64)
SPH_GRIDDING(gather, float, _f32)
SPH_GRIDDING(gather, double, _f64)
