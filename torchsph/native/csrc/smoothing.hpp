// The smoothing kernels of pairs/smoothing_kernels.py in closed form: W = sigma / h^D w(q),  dW/dr / r = sigma / h^(D+2) s(q).
#pragma once
#include "lanes.hpp"
#include "terms.hpp"

namespace sph {

template <class V> struct Smoothing {
  V value;  // w(q)
  V slope;  // s(q) = w'(q) / q
};

// The kernel is the same in every turn of a pair loop, so that the branch costs a predicted jump per register;
// a template parameter in its place made no measurable difference and seven times the code.
template <class Real, class V>
SPH_INLINE Smoothing<V> smoothing(std::int32_t kernel, V square /* q^2 */, Real support) {
  const V zero{};
  if (__builtin_expect(kernel == wendland_c2, 1)) {
    const V t = positive_part(1 - Real(0.5) * square_root(square)), t3 = t * t * t;
    return {t3 * t * (5 - 4 * t), -5 * t3};  // 1 + 2 q = 5 - 4 t
  }
  if (kernel == gaussian) {
    const V e = square < support * support ? exponential(Real(-0.5) * square) : zero;
    return {e, -e};
  }
  const V q = smaller(square_root(square), zero + support);  // powers of a stray particle's distance would overflow
  switch (kernel) {
    case wendland_c4: {
      const V t = positive_part(1 - Real(0.5) * q), t2 = t * t, t5 = t2 * t2 * t;
      return {t5 * t * (1 + q * (3 + Real(35.0 / 12) * q)), -t5 * (Real(14.0 / 3) + Real(35.0 / 3) * q)};
    }
    case wendland_c6: {
      const V t = positive_part(1 - Real(0.5) * q), t2 = t * t, t4 = t2 * t2, t7 = t4 * t2 * t;
      return {t7 * t * (1 + q * (4 + q * (Real(6.25) + 4 * q))), -t7 * (Real(5.5) + q * (Real(19.25) + 22 * q))};
    }
    case cubic: {
      const V a = positive_part(2 - q), b = positive_part(1 - q);
      const V inner = Real(2.25) * q - 3, outer = Real(-0.75) * a * a / larger(q, zero + Real(0.5));
      return {Real(0.25) * a * a * a - b * b * b, q < 1 ? inner : outer};
    }
    case quintic: {
      const V a = positive_part(3 - q), b = positive_part(2 - q), c = positive_part(1 - q);
      const V a2 = a * a, b2 = b * b, c2 = c * c, a4 = a2 * a2, b4 = b2 * b2;
      const V inner = -120 + q * q * (120 - 50 * q), outer = -5 * (a4 - 6 * b4) / larger(q, zero + Real(0.5));
      return {a4 * a - 6 * b4 * b + 15 * c2 * c2 * c, q < 1 ? inner : outer};
    }
    case spiky: {  // the slope does not vanish at r = 0, where its direction is undefined anyway
      const V t = positive_part(1 - q), t2 = t * t;
      return {t2 * t, -3 * t2 / larger(q, zero + Real(1e-6))};
    }
    default: return {zero, zero};  // there is no other number
  }
}

}  // namespace sph
