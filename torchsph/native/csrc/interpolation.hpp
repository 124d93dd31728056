// Sums over the particles around query points: the moments of a first-order moving-least-squares fit.
//
// Queries are sorted into the particles' columns and worked through in clusters of 8, as particles are.
#pragma once
#include "guard.hpp"
#include "lists.hpp"
#include "passes.hpp"

namespace sph {

struct InterpolationKernel {
  KernelChoice kernel;
  const double* lengths;  // (members,)
};

template <class Real> struct Carried {
  const Real* fields;     // (particles, columns)
  std::int64_t columns;
  const Real* weights;    // (particles,), or null: all one
};

template <class Real> struct Moments {
  Real *count, *value, *first, *second, *field, *field_first;  // (queries,) twice, (.., D), (.., D, D), (.., C), (.., D, C)
};

// One sweep takes the plain moments (Plain) or those of D columns of the fields.
template <class Real, int D, bool Plain> struct Interpolation {
  using L = Lanes<Real>;
  using V = typename L::Vector;
  static constexpr int fields = D + 1 + D;  // position, weight (0: absent), columns of the field

  struct Sums {
    V count{}, value{}, first[D] = {}, second[D * D] = {}, field[D] = {}, field_first[D * D] = {};
  };

  static SPH_INLINE void add(const V* query, V inverse_length, const KernelChoice& k, const Partner<Real, fields>& b, Sums& s) {
    V gap[D], square{};
    for (int d = 0; d < D; ++d) {
      gap[d] = b.field(d) - query[d];
      square += gap[d] * gap[d];
    }
    const V w = smoothing<Real, V>(k.kind, square * inverse_length * inverse_length, Real(k.support)).value * b.field(D);
    if constexpr (Plain) {
      s.count += w > 0 ? V{} + 1 : V{};
      s.value += w;
      for (int d = 0; d < D; ++d) {
        const V part = w * gap[d];
        s.first[d] += part;
        for (int e = d; e < D; ++e) s.second[d * D + e] += part * gap[e];
      }
    } else {
      for (int c = 0; c < D; ++c) {
        const V part = w * b.field(D + 1 + c);
        s.field[c] += part;
        for (int d = 0; d < D; ++d) s.field_first[d * D + c] += part * gap[d];
      }
    }
  }

  static void write(Sums& s, const std::int32_t* slot, Real scale, std::int64_t column, std::int64_t columns, const Moments<Real>& o) {
    const auto put = [&](V sum, Real* out, std::int64_t stride, std::int64_t component, bool scaled = true) {
      sph::put<Real>(sum, scaled ? scale : Real(1), nullptr, slot, out + component, int(stride));
    };
    if constexpr (Plain) {
      put(s.count, o.count, 1, 0, false);
      put(s.value, o.value, 1, 0);
      for (int d = 0; d < D; ++d) {
        put(s.first[d], o.first, D, d);
        for (int e = 0; e < D; ++e) put(s.second[d <= e ? d * D + e : e * D + d], o.second, D * D, d * D + e);
      }
    } else {
      for (int c = 0; c < D && column + c < columns; ++c) {
        put(s.field[c], o.field, columns, column + c);
        for (int d = 0; d < D; ++d) put(s.field_first[d * D + c], o.field_first, D * columns, d * columns + column + c);
      }
    }
  }

  // Rows of the particles with `D` columns of the fields from `column` on; the null slot is absent and far away.
  static void pack(const Columns<Real>& c, const Carried<Real>& carried, std::int64_t column, int threads, std::vector<Real>& rows) {
    constexpr int stride = (fields + 7) / 8 * 8;
    rows.resize((c.slots() + 2) * stride);
#pragma omp parallel for num_threads(threads) schedule(static)
    for (std::int64_t s = 0; s <= c.slots(); ++s) {
      Real* row = rows.data() + s * stride;
      const bool present = s < c.slots() && c.slot[s] >= 0;
      for (int f = 0; f < stride; ++f) row[f] = 0;
      for (int d = 0; d < D; ++d) row[d] = present ? c.at[d][s] : Real(1e15);
      if (!present) continue;
      row[D] = carried.weights ? carried.weights[c.slot[s]] : Real(1);
      if (Plain) continue;
      const Real* values = carried.fields + std::int64_t(c.slot[s]) * carried.columns + column;
      for (int k = 0; k < D && column + k < carried.columns; ++k) row[D + 1 + k] = values[k];
    }
  }

  static void sweep(const Columns<Real>& c, const Columns<Real>& queries, const Shape& shape, const InterpolationKernel& kernel,
                    const Carried<Real>& carried, std::int64_t column, const Moments<Real>& out) {
    std::vector<Real> rows;
    pack(c, carried, column, shape.threads, rows);
    guard::Rescue rescue;
#pragma omp parallel num_threads(shape.threads)
    {
      std::vector<std::int32_t> list;  // grows below, where a lack of memory is caught
#pragma omp for schedule(dynamic, 16)
      for (std::int64_t g = 0; g < queries.clusters; ++g) {
        std::size_t size = 0;
        if (!rescue.run([&] { list_cluster<Real, D>(c, queries.owner[g], queries.at, g * cluster_size, shape, list, size); }))
          continue;
        const double h = kernel.lengths[queries.owner[g]];
        const Real scale = Real(kernel.kernel.sigma / std::pow(h, D));
        for (int group = 0; group < L::groups; ++group) {
          Sums sums;
          for (const std::int32_t* run = list.data(); run[0] >= 0; run += 2 + run[1]) {
            V query[D];
            for (int d = 0; d < D; ++d) {
              const int step = image_step(run[0], d);
              query[d] = L::load_own(queries.at[d].data() + g * cluster_size + group * L::own) +
                         (step ? Real(step * shape.period[d]) : Real(0));
            }
            for (std::int32_t n = 0; n < run[1]; n += L::partners)
              add(query, L::all(Real(1 / h)), kernel.kernel, Partner<Real, fields>(rows.data(), run + 2 + n, (fields + 7) / 8 * 8), sums);
          }
          write(sums, queries.slot.data() + g * cluster_size + group * L::own, scale, column, carried.columns, out);
        }
      }
    }
    rescue.rethrow();
  }
};

// Sort the queries into the boxes of the particles; a query of a member without particles finds none.
template <class Real, int D>
std::int64_t sort_queries(const Shape& shape, const Real* query, const Columns<Real>& particles, Columns<Real>& queries) {
  if (const std::int64_t bad = survey<Real, D>(shape, query, queries)) return bad;
  if (queries.members > particles.members) return shape.particles;
  queries.members = particles.members;
  queries.box = particles.box;
  queries.first_column = particles.first_column;
  queries.table = particles.table;
  queries.columns = particles.columns;
  sort_into_bins<Real, D>(shape, queries);
  cut_clusters<Real, D>(shape, queries);
  return 0;
}

}  // namespace sph
