// Particle fields in the order of the pair loop: rows for the partners b, blocks of 8 lanes for the particles a.
//
// Weights are chosen so that one formula serves every form (w: weight, k: inertia):
//   volumes  w = m / rho, k = 1 / rho:  the pressure sum is divided by rho_a afterwards, factor = 1 / rho_a
//   masses   w = m,       k = rho:      factor = 1
// In both, w_b factor_a / (k_a + k_b) = m_b / (rho_a + rho_b), and w_b factor_a (1/k_a + 1/k_b) is Morris's weight.
#pragma once
#include "columns.hpp"
#include "terms.hpp"

namespace sph {

// How many numbers a scalar, vector or matrix has.
constexpr int components(int rank, int dimension) { return rank == 0 ? 1 : dimension * components(rank - 1, dimension); }

// Where each field stands in a row, after the place and the weight; -1: not there.
struct Layout {
  int dimension = 0, weight = -1, fields = 0;
#define SPH_PLACE(name, rank, readers) int name = -1;
  SPH_FIELDS(SPH_PLACE)
#undef SPH_PLACE
  constexpr int stride() const { return (fields + 7) / 8 * 8; }
  constexpr int factor() const { return fields; }  // only the particles a have it
  constexpr int block() const { return (fields + 1) * cluster_size; }
};

constexpr Layout layout(int dimension, std::uint32_t terms) {
  Layout l;
  l.dimension = dimension;
  l.weight = dimension;
  l.fields = dimension + 1;
#define SPH_PLACE(name, rank, readers)         \
  if (terms & (readers)) {                     \
    l.name = l.fields;                         \
    l.fields += components(rank, dimension);   \
  }
  SPH_FIELDS(SPH_PLACE)
#undef SPH_PLACE
  return l;
}

template <class Real> struct State {
  const Real *position, *velocity, *mass, *deviation, *pressure, *slope, *field;
  const std::uint8_t* active;  // laplacian: null, or whether a particle takes part
  std::int32_t weight, form;
};

template <class Real> struct Lists {
  std::int64_t particles, clusters;
  const std::int32_t *slot, *owner, *entries;
  const std::int64_t* offset;
  const Real* home;   // (slots, D) positions of the search; read where an axis is periodic
  double period[3];
  bool periodic;
  int threads;
};

template <class Real> struct Rows {
  std::vector<Real> row, block;  // both grow and are kept for the next pass
};

// One particle's fields, those of a partner first and the factor of a particle a last.
template <class Real, int D>
SPH_INLINE void particle_fields(const Layout& l, const State<Real>& s, const Lists<Real>& lists, std::int64_t slot,
                                std::int64_t i, Real* out) {
  for (int d = 0; d < D; ++d) {
    Real x = s.position[i * D + d];
    if (lists.periodic && lists.period[d] < 1e300) {  // the image that the search saw
      const Real length = Real(lists.period[d]);
      x -= length * std::nearbyint((x - lists.home[slot * D + d]) / length);
    }
    out[d] = x;
  }
  if (l.velocity >= 0)
    for (int d = 0; d < D; ++d) out[l.velocity + d] = s.velocity[i * D + d];
  const Real density = 1 + s.deviation[i], volume = s.mass[i] / density;
  Real weight = s.weight == by_volume ? volume : s.mass[i];
  if (s.active && !s.active[i]) weight = 0;
  out[l.weight] = weight;
  if (l.stress >= 0) out[l.stress] = s.form == symmetric ? s.pressure[i] / (density * density) : s.pressure[i];
  if (l.inertia >= 0) out[l.inertia] = s.weight == by_volume ? 1 / density : density;
  if (l.inverse >= 0) out[l.inverse] = s.weight == by_volume ? density : 1 / density;
  if (l.deviation >= 0) out[l.deviation] = s.deviation[i];
  if (l.mass >= 0) out[l.mass] = s.mass[i];
  if (l.field >= 0) out[l.field] = s.field[i];
  if (l.slope >= 0)
    for (int d = 0; d < D; ++d) out[l.slope + d] = s.slope[i * D + d];
  if (l.field >= 0) out[l.factor()] = weight == 0 ? Real(0) : Real(1);  // an inactive particle takes no sum either
  else out[l.factor()] = s.weight == by_volume ? 1 / density : Real(1);
}

constexpr int ahead = 24;  // slots; the caller's order may be far from that of the clusters

template <class Real, int D> SPH_INLINE void prefetch(const Layout& l, const State<Real>& s, std::int64_t slot) {
  const std::int64_t i = slot < 0 ? ~slot : slot;
  __builtin_prefetch(s.position + i * D);
  if (l.velocity >= 0) __builtin_prefetch(s.velocity + i * D);
  __builtin_prefetch(s.mass + i);
  __builtin_prefetch(s.deviation + i);
  if (l.stress >= 0) __builtin_prefetch(s.pressure + i);
}

template <class Real, int D> void pack(const Layout& l, const State<Real>& s, const Lists<Real>& lists, Rows<Real>& rows) {
  const int stride = l.stride();
  const std::int64_t slots = lists.clusters * cluster_size;
  if (rows.row.size() < std::size_t((slots + 2) * stride)) rows.row.resize((slots + 2) * stride);
  if (rows.block.size() < std::size_t(lists.clusters * l.block() + slack)) rows.block.resize(lists.clusters * l.block() + slack);
#pragma omp parallel for num_threads(lists.threads) schedule(static)
  for (std::int64_t g = 0; g < lists.clusters; ++g) {
    Real* block = rows.block.data() + g * l.block();
    for (int lane = 0; lane < cluster_size; ++lane) {
      const std::int64_t at = g * cluster_size + lane, i = lists.slot[at];
      if (at + ahead < slots) prefetch<Real, D>(l, s, lists.slot[at + ahead]);
      Real field[24] = {};
      particle_fields<Real, D>(l, s, lists, at, i < 0 ? ~i : i, field);
      std::memcpy(rows.row.data() + at * stride, field, stride * sizeof(Real));
      if (l.stress >= 0 && s.form == switched) field[l.stress] = std::fabs(field[l.stress]);
      if (l.stress >= 0 && s.form == difference) field[l.stress] = -field[l.stress];
      for (int f = 0; f <= l.fields; ++f) block[f * cluster_size + lane] = field[f];
    }
  }
  Real* none = rows.row.data() + slots * stride;  // the null slot: far away and without weight
  for (int f = 0; f < stride; ++f) none[f] = f < D ? Real(1e15) : Real(0);
  for (int f : {l.inertia, l.inverse})
    if (f >= 0) none[f] = 1;
}

}  // namespace sph
