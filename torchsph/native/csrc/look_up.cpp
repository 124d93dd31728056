// Multilinear look-up of many fields at once, between two moments: the rows of a point's corners are read whole.
#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "finite.hpp"
#include "guard.hpp"
#include "interface.h"

namespace {

// Where a point lies: the lower corner of its cell, the share of each axis, and whether it lies anywhere.
template <class Real, int D>
struct Place {
  int64_t node = 0;
  Real share[D];
  bool usable = true;

  void find(const sph_look_up& a, const Real* point) {
    int64_t stride = 1;
    node = 0, usable = true;
    for (int k = 0; k < D; ++k) {
      const Real place = (point[k] - Real(a.origin[k])) / Real(a.step[k]);
      usable = usable && sph::finite(place);
      const Real low = usable ? std::min(std::max(std::floor(place), Real(0)), Real(a.counts[k] - 2)) : Real(0);
      share[k] = std::min(std::max(place - low, Real(0)), Real(1));
      node += int64_t(low) * stride, stride *= a.counts[k];
    }
  }
};

// The weighted rows of a cell's corners; `wide` channels are summed, so that the loops have a length known beforehand.
template <class Real, int D, int wide>
void gather(const Place<Real, D>& place, const int64_t* offset, int64_t channels, const Real* early, const Real* late,
            Real after, Real* out) {
  Real sum[wide] = {};
  for (int c = 0; c < 1 << D; ++c) {
    Real weight = 1;
    for (int k = 0; k < D; ++k) weight *= c >> k & 1 ? place.share[k] : 1 - place.share[k];
    const Real* row = early + (place.node + offset[c]) * channels;
    const Real before = weight * (1 - after);
    for (int i = 0; i < wide; ++i) sum[i] += before * row[i];
    if (!late) continue;
    row = late + (place.node + offset[c]) * channels;
    for (int i = 0; i < wide; ++i) sum[i] += weight * after * row[i];
  }
  std::copy(sum, sum + std::min<int64_t>(wide, channels), out);
}

template <class Real, int D>
void gather(const Place<Real, D>& place, const int64_t* offset, int64_t channels, int64_t room, const Real* early,
            const Real* late, Real after, Real* out) {
  // sums over more channels than there are read into the next row, which the last rows do not have
  if (channels > 8 && channels <= 12 && room >= 12)
    return gather<Real, D, 12>(place, offset, channels, early, late, after, out);
  if (channels > 4 && channels <= 8 && room >= 8)
    return gather<Real, D, 8>(place, offset, channels, early, late, after, out);
  for (int64_t i = 0; i < channels; ++i)
    gather<Real, D, 1>(place, offset, channels, early + i, late ? late + i : nullptr, after, out + i);
}

// Channels 1 to D made a direction, as torch.nn.functional.normalize does.
template <class Real, int D>
void direct(Real* out) {
  Real square = 0;
  for (int d = 1; d <= D; ++d) square += out[d] * out[d];
  const Real length = std::max(std::sqrt(square), Real(1e-12));
  for (int d = 1; d <= D; ++d) out[d] /= length;
}

template <class Real, int D>
void look_up(const sph_look_up& a) {
  constexpr int64_t corners = 1 << D, block = 16;
  const int64_t channels = a.channels;
  const auto *early = static_cast<const Real*>(a.early), *late = static_cast<const Real*>(a.late);
  const auto *points = static_cast<const Real*>(a.points), *fractions = static_cast<const Real*>(a.fraction);
  Real* out = static_cast<Real*>(a.out);
  int64_t nodes = 1;
  for (int k = 0; k < D; ++k) nodes *= a.counts[k];
  int64_t offset[corners];  // of the corners of a cell, in nodes
  for (int64_t c = 0; c < corners; ++c) {
    int64_t stride = 1;
    offset[c] = 0;
    for (int k = 0; k < D; stride *= a.counts[k], ++k) offset[c] += (c >> k & 1) * stride;
  }
#pragma omp parallel for schedule(static) num_threads(a.threads)
  for (int64_t start = 0; start < a.count; start += block) {
    const int64_t stop = std::min(a.count, start + block);
    Place<Real, D> places[block];
    // the tables are far larger than the caches: ask for all rows of a block before the first is used
    for (int64_t n = start; n < stop; ++n) {
      Place<Real, D>& place = places[n - start];
      place.find(a, points + n * D);
      if (a.plain && a.plain[place.node]) {
        __builtin_prefetch(early + place.node * channels);
        continue;
      }
      for (int64_t c = 0; c < corners; c += 2)  // the two corners along x lie side by side
        for (const Real* table : {early, late})
          if (table) {
            const char* row = reinterpret_cast<const char*>(table + (place.node + offset[c]) * channels);
            for (int64_t byte = 0; byte < 2 * channels * int64_t(sizeof(Real)); byte += 64) __builtin_prefetch(row + byte);
          }
    }
    for (int64_t n = start; n < stop; ++n) {
      const Place<Real, D>& place = places[n - start];
      Real* sum = out + n * channels;
      if (!place.usable) {
        std::fill(sum, sum + channels, std::numeric_limits<Real>::quiet_NaN());
        continue;
      }
      if (a.plain && a.plain[place.node]) {
        std::copy(early + place.node * channels, early + (place.node + 1) * channels, sum);
        if (a.unit) direct<Real, D>(sum);
        continue;
      }
      const Real after = late ? fractions[a.fractions == 1 ? 0 : n] : Real(0);
      const int64_t room = (nodes - place.node - offset[corners - 1]) * channels;
      gather<Real, D>(place, offset, channels, room, early, late, after, sum);
      if (a.unit) direct<Real, D>(sum);
    }
  }
}

template <class Real>
void run(const sph_look_up& a) {
  a.dimension == 2 ? look_up<Real, 2>(a) : look_up<Real, 3>(a);
}

}  // namespace

extern "C" void sph_look_up_f32(const sph_look_up* arguments) {
  guard::call([&] { run<float>(*arguments); });
}
extern "C" void sph_look_up_f64(const sph_look_up* arguments) {
  guard::call([&] { run<double>(*arguments); });
}
