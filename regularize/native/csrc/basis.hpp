// Values of the basis functions at one point.
#pragma once

#include "spline.hpp"

// Inlined into a caller that knows the sizes at compile time, these small loops become straight vector code.
#define SPLINE_INLINE inline __attribute__((always_inline))

namespace {

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

}  // namespace
