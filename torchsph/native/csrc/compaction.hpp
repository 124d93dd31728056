// Appending the numbers of those lanes that pass a test: the one operation that vector extensions cannot express.
#pragma once
#include <algorithm>

#include "lanes.hpp"

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace sph {

#if defined(__AVX2__)
// For each mask of 8 lanes the numbers of its set lanes, in order.
struct SetLanes {
  alignas(32) std::int32_t lane[256][8];
  constexpr SetLanes() : lane() {
    for (int mask = 0; mask < 256; ++mask) {
      int next = 0;
      for (int l = 0; l < 8; ++l)
        if (mask >> l & 1) lane[mask][next++] = l;
    }
  }
};
inline constexpr SetLanes set_lanes;

SPH_INLINE int append_set(std::int32_t* to, std::int32_t first, unsigned mask) {
  const __m256i lanes = _mm256_load_si256(reinterpret_cast<const __m256i*>(set_lanes.lane[mask]));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(to), _mm256_add_epi32(lanes, _mm256_set1_epi32(first)));
  return __builtin_popcount(mask);
}
#endif

// What `append_below` may write at `to`, whatever it returns: a whole register of int32, of which doubles fill half.
template <class Real> constexpr int append_width = std::max(Lanes<Real>::count, 8);

// Write first + l for each lane l < here with value < limit; returns how many, after `append_width` were written over.
template <class Real>
SPH_INLINE int append_below(std::int32_t* to, std::int32_t first, int here, typename Lanes<Real>::Vector value,
                            typename Lanes<Real>::Vector limit) {
  using L = Lanes<Real>;
  const unsigned valid = here >= L::count ? (1u << L::count) - 1 : (1u << here) - 1;
#if defined(__AVX512F__)
  if constexpr (sizeof(Real) == 4 && L::count == 16) {
    const unsigned mask = _mm512_cmp_ps_mask((__m512)value, (__m512)limit, _CMP_LT_OQ) & valid;
    const __m512i numbers = _mm512_add_epi32(_mm512_set1_epi32(first), _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15));
    _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(__mmask16(mask), numbers));
    return __builtin_popcount(mask);
  } else if constexpr (sizeof(Real) == 8 && L::count == 8) {
    return append_set(to, first, _mm512_cmp_pd_mask((__m512d)value, (__m512d)limit, _CMP_LT_OQ) & valid);
  }
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(Real) == 4 && L::count == 8)
    return append_set(to, first, unsigned(_mm256_movemask_ps(_mm256_cmp_ps((__m256)value, (__m256)limit, _CMP_LT_OQ))) & valid);
  else if constexpr (sizeof(Real) == 8 && L::count == 4)
    return append_set(to, first, unsigned(_mm256_movemask_pd(_mm256_cmp_pd((__m256d)value, (__m256d)limit, _CMP_LT_OQ))) & valid);
#endif
  const typename L::Mask close = value < limit;
  int n = 0;
  for (int l = 0; l < L::count && l < here; ++l) {
    to[n] = first + l;
    n -= int(close[l]);
  }
  return n;
}

}  // namespace sph
