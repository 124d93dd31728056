// What complete-kernel walls add to the sums of the particles, each pass over the particles in one piece.
#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "guard.hpp"
#include "interface.h"
#include "terms.hpp"

namespace {

// One particle's row: distance, normal, velocity of the wall, share of the kernel, its gradient, perhaps what is swept.
template <class Real, int D>
struct Wall {
  const Real* row;
  Real distance() const { return row[0]; }
  const Real* velocity() const { return row + 1 + D; }
  Real share() const { return row[1 + 2 * D]; }
  const Real* gradient() const { return row + 2 + 2 * D; }
  Real swept() const { return row[2 + 3 * D]; }
};

template <class Real, int D>
Real dot(const Real* a, const Real* b) {
  Real total = 0;
  for (int d = 0; d < D; ++d) total += a[d] * b[d];
  return total;
}

template <class Real, int D>
void rates(const sph_walls& a) {
  const auto* rows = static_cast<const Real*>(a.rows);
  const auto *velocity = static_cast<const Real*>(a.velocity), *divergence = static_cast<const Real*>(a.divergence),
             *concentration_gradient = static_cast<const Real*>(a.concentration_gradient);
  auto *whole = static_cast<Real*>(a.whole_divergence), *even = static_cast<Real*>(a.whole_concentration_gradient);
  const bool sliding = a.channels > 2 + 3 * D;
  const Real least = Real(a.smallest_share);
#pragma omp parallel for schedule(static) num_threads(a.threads)
  for (int64_t i = 0; i < a.count; ++i) {
    const Wall<Real, D> wall{rows + i * a.channels};
    const Real* v = velocity + i * D;
    const Real *g = wall.gradient(), coming = sliding ? wall.swept() : dot<Real, D>(wall.velocity(), g);
    whole[i] = (divergence[i] - (coming - dot<Real, D>(v, g))) / std::max(wall.share(), least);
    if (concentration_gradient)
      for (int d = 0; d < D; ++d) even[i * D + d] = concentration_gradient[i * D + d] - g[d];
  }
}

template <class Real>
Real opposite(Real pressure, int form) {  // what the wall carries against a particle's own pressure
  return form == sph::switched ? std::fabs(pressure) : form == sph::difference ? -pressure : pressure;
}

template <class Real, int D>
void forces(const sph_walls& a) {
  const auto* rows = static_cast<const Real*>(a.rows);
  const auto *velocity = static_cast<const Real*>(a.velocity), *pressure = static_cast<const Real*>(a.pressure),
             *deviation = static_cast<const Real*>(a.deviation), *acceleration = static_cast<const Real*>(a.acceleration);
  auto* out = static_cast<Real*>(a.whole_acceleration);
  const Real least = Real(a.smallest_share), gap = Real(a.smallest_gap);
#pragma omp parallel for schedule(static) num_threads(a.threads)
  for (int64_t i = 0; i < a.count; ++i) {
    const Wall<Real, D> wall{rows + i * a.channels};
    const Real* g = wall.gradient();
    Real push = 0, rate = 0;
    if (pressure) push = (pressure[i] + opposite(pressure[i], a.form)) / (1 + deviation[i]);
    if (a.viscosities) {
      const Real nu = Real(a.viscosity[a.viscosities == 1 ? 0 : a.member[i]]);
      rate = 2 * nu * std::sqrt(dot<Real, D>(g, g)) / std::max(wall.distance(), gap);
    }
    const Real part = std::max(wall.share(), least);
    for (int d = 0; d < D; ++d) {
      const Real drag = rate * (wall.velocity()[d] - velocity[i * D + d]);
      out[i * D + d] = (acceleration[i * D + d] + push * g[d] + drag) / part;
    }
  }
}

// Particles that end nearer to the wall than the gap, with their distance carried on from where the wall was seen.
template <class Real, int D>
int64_t near(const sph_walls& a) {
  const auto *rows = static_cast<const Real*>(a.rows), *seen = static_cast<const Real*>(a.distance),
             *before = static_cast<const Real*>(a.before), *after = static_cast<const Real*>(a.after);
  auto* distance = static_cast<Real*>(a.near_distance);
  int64_t found = 0;
  for (int64_t i = 0; i < a.count; ++i) {
    const Wall<Real, D> wall{rows + i * a.channels};
    const Real step = Real(a.step[a.member[i]]);
    Real moved = 0;
    for (int d = 0; d < D; ++d)
      moved += (after[i * D + d] - before[i * D + d] - step * wall.velocity()[d]) * wall.row[1 + d];
    const Real ends = seen[i * a.distance_stride] + moved;
    if (ends < Real(a.gap) && a.held[i]) distance[found] = ends, a.near[found++] = i;
  }
  return found;
}

template <class Real>
void run(const sph_walls& a, bool first) {
  if (first) a.dimension == 2 ? rates<Real, 2>(a) : rates<Real, 3>(a);
  else a.dimension == 2 ? forces<Real, 2>(a) : forces<Real, 3>(a);
}

}  // namespace

extern "C" void sph_wall_rates_f32(const sph_walls* arguments) {
  guard::call([&] { run<float>(*arguments, true); });
}
extern "C" void sph_wall_rates_f64(const sph_walls* arguments) {
  guard::call([&] { run<double>(*arguments, true); });
}
extern "C" void sph_wall_forces_f32(const sph_walls* arguments) {
  guard::call([&] { run<float>(*arguments, false); });
}
extern "C" void sph_wall_forces_f64(const sph_walls* arguments) {
  guard::call([&] { run<double>(*arguments, false); });
}
extern "C" int64_t sph_wall_near_f32(const sph_walls* a) {
  return guard::call([&] { return a->dimension == 2 ? near<float, 2>(*a) : near<float, 3>(*a); });
}
extern "C" int64_t sph_wall_near_f64(const sph_walls* a) {
  return guard::call([&] { return a->dimension == 2 ? near<double, 2>(*a) : near<double, 3>(*a); });
}
