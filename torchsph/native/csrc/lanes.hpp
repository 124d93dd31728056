// Vector registers of reals in the compilers' own vector extensions (GCC, Clang): no intrinsics, any instruction set.
//
// A cluster has 8 particles a.  Where a register holds 16 reals (AVX-512, float) it carries the 8 particles against two
// partners b at once; where it holds fewer than 8, a cluster is worked through in groups of `own` particles.
#pragma once
#include <cstdint>
#include <cstring>
#include <initializer_list>

namespace sph {

constexpr int cluster_size = 8;

#if defined(__AVX512F__) && defined(__AVX512DQ__) && (defined(__clang__) || __GNUC__ >= 12)
constexpr int register_bytes = 64;
#elif defined(__AVX2__)
constexpr int register_bytes = 32;
#else
constexpr int register_bytes = 16;
#endif

#define SPH_INLINE inline __attribute__((always_inline))

template <class Real> struct VectorOf;
template <> struct VectorOf<float> {
  typedef float Vector __attribute__((vector_size(register_bytes)));
  typedef std::int32_t Mask __attribute__((vector_size(register_bytes)));
};
template <> struct VectorOf<double> {
  typedef double Vector __attribute__((vector_size(register_bytes)));
  typedef std::int64_t Mask __attribute__((vector_size(register_bytes)));
};

template <class Real> struct Lanes {
  using Vector = typename VectorOf<Real>::Vector;
  using Mask = typename VectorOf<Real>::Mask;
  static constexpr int count = register_bytes / int(sizeof(Real));
  static constexpr int own = count < cluster_size ? count : cluster_size;  // particles a in a register
  static constexpr int partners = count / own;                             // partners b in a register: 1 or 2
  static constexpr int groups = cluster_size / own;                        // registers for one cluster

  static SPH_INLINE Vector load(const Real* from) {
    Vector v;
    std::memcpy(&v, from, sizeof v);
    return v;
  }
  static SPH_INLINE void store(Real* to, Vector v) { std::memcpy(to, &v, sizeof v); }
  static SPH_INLINE Vector all(Real value) { return Vector{} + value; }

  // the `own` particles at `from`, repeated for every partner
  static SPH_INLINE Vector load_own(const Real* from) {
    if constexpr (partners == 1) {
      return load(from);
    } else {
      typedef Real Half __attribute__((vector_size(register_bytes / 2)));
      Half h;
      std::memcpy(&h, from, sizeof h);
      return __builtin_shufflevector(h, h, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    }
  }

  // the sums of the `own` particles over all partners of the register
  static SPH_INLINE void store_own(Real* to, Vector v) {
    Real lane[count];
    store(lane, v);
    for (int l = 0; l < own; ++l) {
      Real sum = lane[l];
      for (int p = 1; p < partners; ++p) sum += lane[l + p * own];
      to[l] = sum;
    }
  }
};

template <class V> SPH_INLINE V positive_part(V x) { return x > 0 ? x : V{}; }
template <class V> SPH_INLINE V negative_part(V x) { return x < 0 ? x : V{}; }
template <class V> SPH_INLINE V smaller(V a, V b) { return a < b ? a : b; }
template <class V> SPH_INLINE V larger(V a, V b) { return a > b ? a : b; }
template <class V> SPH_INLINE V magnitude(V x) { return larger(x, -x); }

template <class V> SPH_INLINE V square_root(V x) {
#if defined(__has_builtin) && defined(__clang__)
  return __builtin_elementwise_sqrt(x);
#else
  V r;
  for (unsigned l = 0; l < sizeof(V) / sizeof(x[0]); ++l) {
    if constexpr (sizeof(x[0]) == 4) r[l] = __builtin_sqrtf(x[l]);
    else r[l] = __builtin_sqrt(x[l]);
  }
  return r;
#endif
}

// e^x for x <= 0: x = n ln 2 + f, |f| <= ln 2 / 2, Taylor series in f, n put into the exponent bits.
SPH_INLINE Lanes<float>::Vector exponential(Lanes<float>::Vector x) {
  using L = Lanes<float>;
  x = larger(x, L::all(-80.0f));  // far below the support's edge; keeps n inside the exponent's range
  const L::Mask n = __builtin_convertvector(x * 1.44269504f - 0.5f, L::Mask);
  const L::Vector whole = __builtin_convertvector(n, L::Vector);
  const L::Vector f = (x - whole * 0.693359375f) + whole * 2.12194440e-4f;
  L::Vector p = L::all(1.0f / 5040);
  for (float c : {1.0f / 720, 1.0f / 120, 1.0f / 24, 1.0f / 6, 0.5f, 1.0f, 1.0f}) p = p * f + c;
  return (L::Vector)((L::Mask)p + (n << 23));
}

SPH_INLINE Lanes<double>::Vector exponential(Lanes<double>::Vector x) {
  using L = Lanes<double>;
  x = larger(x, L::all(-600.0));
  const L::Mask n = __builtin_convertvector(x * 1.4426950408889634 - 0.5, L::Mask);
  const L::Vector whole = __builtin_convertvector(n, L::Vector);
  const L::Vector f = (x - whole * 6.93147180369123816490e-01) - whole * 1.90821492927058770002e-10;
  L::Vector p = L::all(1.0 / 6227020800.0);
  for (double c : {1.0 / 479001600, 1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320, 1.0 / 5040, 1.0 / 720,
                   1.0 / 120, 1.0 / 24, 1.0 / 6, 0.5, 1.0, 1.0})
    p = p * f + c;
  return (L::Vector)((L::Mask)p + (n << 52));
}

// The fields of the partners b of one step of a pair loop; every field comes spread over its partner's lanes.
template <class Real, int Fields, int Partners = Lanes<Real>::partners> struct Partner {
  const Real* row;
  SPH_INLINE Partner(const Real* rows, const std::int32_t* entry, int stride) : row(rows + std::int64_t(entry[0]) * stride) {}
  SPH_INLINE typename Lanes<Real>::Vector field(int f) const { return Lanes<Real>::all(row[f]); }
};

#if defined(__AVX512F__) && defined(__AVX512DQ__) && (defined(__clang__) || __GNUC__ >= 12)
// Two rows side by side in a register: one load each per 8 fields, then a permutation per field instead of two
// broadcasts from memory.
template <int Fields> struct Partner<float, Fields, 2> {
  using V = Lanes<float>::Vector;
  using M = Lanes<float>::Mask;
  static constexpr int parts = (Fields + 7) / 8;
  V part[parts];
  SPH_INLINE Partner(const float* rows, const std::int32_t* entry, int stride) {
    typedef float Half __attribute__((vector_size(32)));
    const float* row[2] = {rows + std::int64_t(entry[0]) * stride, rows + std::int64_t(entry[1]) * stride};
    for (int p = 0; p < parts; ++p) {
      Half h[2];
      std::memcpy(&h[0], row[0] + 8 * p, sizeof(Half));
      std::memcpy(&h[1], row[1] + 8 * p, sizeof(Half));
      part[p] = __builtin_shufflevector(h[0], h[1], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    }
  }
  SPH_INLINE V field(int f) const {
    const int g = f & 7, k = g + 8;
    return __builtin_shuffle(part[f >> 3], M{g, g, g, g, g, g, g, g, k, k, k, k, k, k, k, k});
  }
};
#endif

}  // namespace sph
