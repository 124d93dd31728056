// Normalised cross-correlation of small kernels between the images of a packet, pooled over all pairs of images.
//
// The images of a node lie side by side. With samples as rows of alternating real and imaginary parts, the complex sum
// of conj(a) b is two real dot products, <a, b> and <i a, b>: no shuffles, and each register of the region searched is
// used for both. The planes of kernel and region that are worked on stay in the first cache, the sums of five lags in
// registers. Kernels on a millimetre's grid share next to nothing, and each is turned by its own shear, so that running
// sums of products over the image would save nothing here.
#include <omp.h>

#include <algorithm>
#include <cmath>
#include <complex>
#include <cstdint>
#include <limits>
#include <optional>
#include <vector>

#include "guard.hpp"
#include "interface.h"
#include "lanes.hpp"

namespace {

using std::int64_t;

constexpr int most_lags = 5;  // whose sums are kept in registers: two each, beside a, i a and b

struct Size {
  int64_t z, y, x;
  explicit Size(const int64_t* n) : z(n[0]), y(n[1]), x(n[2]) {}
  Size(int64_t z, int64_t y, int64_t x) : z(z), y(y), x(x) {}
  int64_t count() const { return z * y * x; }
};

// Reals that start where registers are loaded fastest.
template <class Real>
class Aligned {
  std::vector<Real> room;
  Real* first;

 public:
  explicit Aligned(int64_t count) : room(count + sph::register_bytes / sizeof(Real)) {
    const auto address = reinterpret_cast<std::uintptr_t>(room.data());
    first = room.data() + (-address & (sph::register_bytes - 1)) / sizeof(Real);
  }
  Real* data() { return first; }
};

template <class V>
auto total(V v) {
  auto sum = v[0];
  for (unsigned l = 1; l < sizeof(V) / sizeof(v[0]); ++l) sum += v[l];
  return sum;
}

// One thread's work on one point after the other.
template <class Real>
class Correlator {
  using L = sph::Lanes<Real>;
  using V = typename L::Vector;
  using M = typename L::Mask;

  const sph_correlation& a;
  const Size shape, half, search, size, lags, region;
  const int64_t used;    // reals of a node: two for each pair of images
  const int64_t stride;  // the same in whole registers
  const Real *volume, *end;
  Aligned<Real> kernel, turned, around, products, energies;  // turned: i times the kernel
  std::vector<std::complex<Real>> phasor;                    // of the ramp, along each axis; 1 without one
  std::vector<M> kept;                                       // of a node's registers, what belongs to it

 public:
  explicit Correlator(const sph_correlation& a)
      : a(a), shape(a.shape), half(a.half), search(a.search), size(2 * half.z + 1, 2 * half.y + 1, 2 * half.x + 1),
        lags(2 * search.z + 1, 2 * search.y + 1, 2 * search.x + 1),
        region(size.z + lags.z - 1, size.y + lags.y - 1, size.x + lags.x - 1), used(2 * (a.images - a.apart)),
        stride((used + L::count - 1) / L::count * L::count), volume(static_cast<const Real*>(a.volume)),
        end(volume + 2 * a.images * shape.count()), kernel(size.count() * stride), turned(size.count() * stride),
        around(region.count() * stride), products(2 * lags.count() * L::count),
        energies((region.x + region.z * region.y * lags.x + region.z * lags.y * lags.x) * L::count),
        phasor(size.z + size.y + size.x, 1), kept(stride / L::count) {
    for (int64_t i = 0; i < stride; ++i) kept[i / L::count][i % L::count] = i < used ? -1 : 0;
  }

  void run(int64_t point) {
    const Size corner(a.corner + 3 * point), offset(a.offset + 3 * point);
    const Real own = read_kernel(corner, a.ramp ? static_cast<const Real*>(a.ramp) + 3 * point : nullptr);
    read_region({corner.z + offset.z - search.z, corner.y + offset.y - search.y, corner.x + offset.x - search.x});
    const V* energy = sum_energies();
    std::fill(products.data(), products.data() + 2 * lags.count() * L::count, Real(0));
    for (int64_t plane = 0; plane < region.z; ++plane)
      for (int64_t z = std::max<int64_t>(0, plane - size.z + 1); z <= std::min(plane, lags.z - 1); ++z)
        multiply(plane - z, plane, products.data() + 2 * z * lags.y * lags.x * L::count);
    const Real tiny = std::sqrt(std::numeric_limits<Real>::min());
    Real* rho = static_cast<Real*>(a.rho) + 2 * point * lags.count();
    for (int64_t lag = 0; lag < lags.count(); ++lag) {
      const Real norm = std::sqrt(own) * std::sqrt(total(energy[lag]));
      for (int part = 0; part < 2; ++part)
        rho[2 * lag + part] =
            norm > tiny ? total(L::load(products.data() + (2 * lag + part) * L::count)) / norm : Real(0);
    }
  }

 private:
  const Real* node(int64_t z, int64_t y, int64_t x) const {
    return volume + 2 * a.images * ((z * shape.y + y) * shape.x + x);
  }

  // A node's samples from `from` on, zeros beyond them; `whole`: whether the registers end inside the volume.
  V samples(const Real* from, int64_t r, bool whole) const {
    if (whole) return (V)((M)L::load(from + r) & kept[r / L::count]);
    V v{};
    for (int64_t i = r; i < std::min(used, r + L::count); ++i) v[i - r] = from[i];
    return v;
  }

  // The kernel's first images, turned by exp(i ramp . node); returns their energy.
  Real read_kernel(const Size& corner, const Real* ramp) {
    if (ramp) set_phasors(ramp);
    V energy{};
    Real *to = kernel.data(), *across = turned.data();
    const std::complex<Real>*along_z = phasor.data(), *along_y = along_z + size.z, *along_x = along_y + size.y;
    for (int64_t z = 0; z < size.z; ++z)
      for (int64_t y = 0; y < size.y; ++y) {
        const Real* from = node(corner.z + z, corner.y + y, corner.x);
        const bool whole = end - from >= 2 * a.images * (size.x - 1) + stride;
        const auto row = along_z[z] * along_y[y];
        for (int64_t x = 0; x < size.x; ++x, from += 2 * a.images) {
          const auto turn = row * along_x[x];
          const V c = L::all(turn.real()), s = L::all(turn.imag());
          for (int64_t r = 0; r < stride; r += L::count, to += L::count, across += L::count) {
            const V v = samples(from, r, whole), w = times_i(v), k = c * v + s * w;
            L::store(to, k);
            L::store(across, c * w - s * v);
            energy += k * k;
          }
        }
      }
    return total(energy);
  }

  // exp(i ramp . node) is a product of one factor per axis.
  void set_phasors(const Real* ramp) {
    auto* next = phasor.data();
    const int64_t count[3] = {size.z, size.y, size.x};
    for (int axis = 0; axis < 3; ++axis)
      for (int64_t k = 0; k < count[axis]; ++k)
        *next++ = std::polar(Real(1), Real(a.apart) * ramp[axis] * Real(k - count[axis] / 2));
  }

  // (-im, re) of samples (re, im).
  static V times_i(V v) {
    V swapped;
#if defined(__clang__)
    for (int l = 0; l < L::count; ++l) swapped[l] = v[l ^ 1];
#else
    M order;
    for (int l = 0; l < L::count; ++l) order[l] = l ^ 1;
    swapped = __builtin_shuffle(v, order);
#endif
    V sign;
    for (int l = 0; l < L::count; ++l) sign[l] = l & 1 ? Real(1) : Real(-1);
    return swapped * sign;
  }

  // The second images of all nodes that any lag reaches, and the sums of their energies along x over a kernel.
  void read_region(const Size& start) {
    V* node_energy = reinterpret_cast<V*>(energies.data());
    V* row_energy = node_energy + region.x;
    Real* to = around.data();
    for (int64_t z = 0; z < region.z; ++z)
      for (int64_t y = 0; y < region.y; ++y) {
        const Real* from = node(start.z + z, start.y + y, start.x) + 2 * a.apart;
        const bool whole = end - from >= 2 * a.images * (region.x - 1) + stride;
        for (int64_t x = 0; x < region.x; ++x, from += 2 * a.images) {
          V energy{};
          for (int64_t r = 0; r < stride; r += L::count, to += L::count) {
            const V v = samples(from, r, whole);
            L::store(to, v);
            energy += v * v;
          }
          node_energy[x] = energy;
        }
        for (int64_t x = 0; x < lags.x; ++x) {
          V sum{};
          for (int64_t k = 0; k < size.x; ++k) sum += node_energy[x + k];
          *row_energy++ = sum;
        }
      }
  }

  // What the kernel lies against at each lag, summed further along y and z; the result overwrites the sums along x.
  const V* sum_energies() {
    V* rows = reinterpret_cast<V*>(energies.data()) + region.x;
    V* planes = rows + region.z * region.y * lags.x;
    for (int64_t z = 0; z < region.z; ++z)
      for (int64_t i = 0; i < lags.y * lags.x; ++i) {
        V sum{};
        for (int64_t k = 0; k < size.y; ++k) sum += rows[z * region.y * lags.x + i + k * lags.x];
        planes[z * lags.y * lags.x + i] = sum;
      }
    for (int64_t i = 0; i < lags.count(); ++i) {
      V sum{};
      for (int64_t k = 0; k < size.z; ++k) sum += planes[i + k * lags.y * lags.x];
      rows[i] = sum;
    }
    return rows;
  }

  // Adds the products of a plane of the kernel and one of the region at all lags of y and x.
  void multiply(int64_t kernel_plane, int64_t region_plane, Real* sums) {
    const int64_t count = lags.y * lags.x;
    const Real* of_kernel = kernel.data() + kernel_plane * size.y * size.x * stride;
    const Real* of_turned = turned.data() + kernel_plane * size.y * size.x * stride;
    const Real* of_region = around.data() + region_plane * region.y * region.x * stride;
    for (int64_t lag = 0; lag < count; lag += most_lags, sums += 2 * most_lags * L::count) {
      const Real* at[most_lags];
      const int wide = int(std::min<int64_t>(most_lags, count - lag));
      for (int w = 0; w < wide; ++w)
        at[w] = of_region + ((lag + w) / lags.x * region.x + (lag + w) % lags.x) * stride;
      switch (wide) {
        case 5: block<5>(of_kernel, of_turned, at, sums); break;
        case 4: block<4>(of_kernel, of_turned, at, sums); break;
        case 3: block<3>(of_kernel, of_turned, at, sums); break;
        case 2: block<2>(of_kernel, of_turned, at, sums); break;
        default: block<1>(of_kernel, of_turned, at, sums);
      }
    }
  }

  template <int wide>
  void block(const Real* of_kernel, const Real* of_turned, const Real* const* at, Real* sums) const {
    const int64_t row = size.x * stride, step = region.x * stride;
    V sum[2 * wide];
    for (int w = 0; w < 2 * wide; ++w) sum[w] = L::load(sums + w * L::count);
    for (int64_t y = 0; y < size.y; ++y)
      for (int64_t i = 0; i < row; i += L::count) {
        const V k = L::load(of_kernel + y * row + i), t = L::load(of_turned + y * row + i);
        for (int w = 0; w < wide; ++w) {
          const V b = L::load(at[w] + y * step + i);
          sum[2 * w] += k * b, sum[2 * w + 1] += t * b;
        }
      }
    for (int w = 0; w < 2 * wide; ++w) L::store(sums + w * L::count, sum[w]);
  }
};

template <class Real>
void correlate(const sph_correlation& a) {
  guard::Rescue rescue;
#pragma omp parallel num_threads(a.threads)
  {
    std::optional<Correlator<Real>> own;
    const bool ready = rescue.run([&] { own.emplace(a); });
#pragma omp for schedule(dynamic, 8)
    for (int64_t point = 0; point < a.points; ++point)
      if (ready) own->run(point);
  }
  rescue.rethrow();
}

}  // namespace

extern "C" void sph_correlate_f32(const sph_correlation* arguments) {
  guard::call([&] { correlate<float>(*arguments); });
}
extern "C" void sph_correlate_f64(const sph_correlation* arguments) {
  guard::call([&] { correlate<double>(*arguments); });
}
