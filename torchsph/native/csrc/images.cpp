// The images of a packet node by node, in one pass over memory, and sums of fields over boxes around points.
#include <omp.h>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "guard.hpp"
#include "interface.h"

namespace {

using std::int64_t;

// Asks for large pages for an array that nobody has written yet: its first pass is else mostly page faults.
void use_large_pages(void* array, int64_t bytes) {
#if defined(__linux__)
  constexpr std::uintptr_t page = 1 << 21;
  const auto first = (reinterpret_cast<std::uintptr_t>(array) + page - 1) / page * page;
  const auto last = (reinterpret_cast<std::uintptr_t>(array) + std::uintptr_t(bytes)) / page * page;
  if (array && first < last) madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
#else
  (void)array, (void)bytes;
#endif
}

constexpr int64_t nodes_at_once = 64;  // of a row, whose samples stay in the first cache

// Images one after the other to images side by side at each node of a padded volume, with what is summed over them.
template <class Real>
class Arranger {
  const sph_images& a;
  const int64_t ny, nx, image, height, width;
  const Real* samples;
  Real *volume, *power, *turn;

 public:
  explicit Arranger(const sph_images& a)
      : a(a), ny(a.shape[1]), nx(a.shape[2]), image(2 * a.shape[0] * ny * nx), height(ny + 2 * a.margin[1]),
        width(nx + 2 * a.margin[2]), samples(static_cast<const Real*>(a.samples)), volume(static_cast<Real*>(a.volume)),
        power(static_cast<Real*>(a.power)), turn(static_cast<Real*>(a.turn)) {}

  void run() const {
    const int64_t depth = a.shape[0] + 2 * a.margin[0];
    use_large_pages(volume, 2 * a.images * depth * height * width * int64_t(sizeof(Real)));
#pragma omp parallel for schedule(static) num_threads(a.threads)
    for (int64_t row = 0; row < depth * height; ++row) {
      const int64_t z = row / height - a.margin[0], y = row % height - a.margin[1], node = row * width;
      if (z < 0 || z >= a.shape[0] || y < 0 || y >= ny) {
        clear(node, width);
        continue;
      }
      clear(node, a.margin[2]);
      for (int64_t x = 0; x < nx; x += nodes_at_once)
        fill(samples + 2 * ((z * ny + y) * nx + x), node + a.margin[2] + x, std::min(nodes_at_once, nx - x));
      clear(node + width - a.margin[2], a.margin[2]);
    }
  }

 private:
  void clear(int64_t node, int64_t count) const {
    std::fill_n(power + node, count, Real(0));
    if (turn) std::fill_n(turn + 2 * node, 2 * count, Real(0));
    if (volume) std::fill_n(volume + 2 * a.images * node, 2 * a.images * count, Real(0));
  }

  void fill(const Real* from, int64_t node, int64_t count) const {
    Real square[nodes_at_once] = {}, real[nodes_at_once] = {}, imaginary[nodes_at_once] = {};
    for (int64_t t = 0; t < a.images; ++t) {
      const Real *now = from + t * image, *next = now + image;
      for (int64_t i = 0; i < count; ++i) square[i] += now[2 * i] * now[2 * i] + now[2 * i + 1] * now[2 * i + 1];
      if (!turn || t + 1 == a.images) continue;
      for (int64_t i = 0; i < count; ++i) {
        real[i] += now[2 * i] * next[2 * i] + now[2 * i + 1] * next[2 * i + 1];
        imaginary[i] += now[2 * i] * next[2 * i + 1] - now[2 * i + 1] * next[2 * i];
      }
    }
    for (int64_t i = 0; i < count; ++i) power[node + i] = square[i] / Real(a.images);
    if (turn)
      for (int64_t i = 0; i < count; ++i) {
        const Real root = std::sqrt(std::max(power[node + i], std::numeric_limits<Real>::min()));
        turn[2 * (node + i)] = real[i] / root, turn[2 * (node + i) + 1] = imaginary[i] / root;
      }
    if (!volume) return;
    for (int64_t i = 0; i < count; ++i) {
      Real* to = volume + 2 * a.images * (node + i);
      for (int64_t t = 0; t < a.images; ++t) std::memcpy(to + 2 * t, from + t * image + 2 * i, 2 * sizeof(Real));
    }
  }
};

// The part of a box around a node that lies inside the volume.
struct Box {
  int64_t low[3], high[3];  // first and last node
  Box(const sph_boxes& a, const int64_t* middle) {
    for (int k = 0; k < 3; ++k) {
      low[k] = std::max<int64_t>(0, middle[k] - a.reach[k]);
      high[k] = std::min(a.shape[k] - 1, middle[k] + a.reach[k]);
    }
  }
};

template <class Real>
void box_sums(const sph_boxes& a) {
  const auto* field = static_cast<const Real*>(a.field);
  auto* out = static_cast<Real*>(a.out);
  guard::Rescue rescue;
#pragma omp parallel num_threads(a.threads)
  {
    std::vector<Real> sum;
    const bool ready = rescue.run([&] { sum.resize(a.parts * (2 * a.reach[2] + 1)); });
#pragma omp for schedule(static)
    for (int64_t p = 0; p < a.points; ++p) {
      if (!ready) continue;
      const Box box(a, a.middle + 3 * p);
      const int64_t count = a.parts * (box.high[2] - box.low[2] + 1);
      std::fill(sum.begin(), sum.end(), Real(0));
      for (int64_t z = box.low[0]; z <= box.high[0]; ++z)
        for (int64_t y = box.low[1]; y <= box.high[1]; ++y) {
          const Real* row = field + a.parts * ((z * a.shape[1] + y) * a.shape[2] + box.low[2]);
          for (int64_t i = 0; i < count; ++i) sum[i] += row[i];
        }
      for (int64_t part = 0; part < a.parts; ++part) {
        Real total = 0;
        for (int64_t i = part; i < count; i += a.parts) total += sum[i];
        out[a.parts * p + part] = total;
      }
    }
  }
  rescue.rethrow();
}

}  // namespace

extern "C" void sph_arrange_f32(const sph_images* arguments) {
  guard::call([&] { Arranger<float>(*arguments).run(); });
}
extern "C" void sph_arrange_f64(const sph_images* arguments) {
  guard::call([&] { Arranger<double>(*arguments).run(); });
}
extern "C" void sph_box_sums_f32(const sph_boxes* arguments) {
  guard::call([&] { box_sums<float>(*arguments); });
}
extern "C" void sph_box_sums_f64(const sph_boxes* arguments) {
  guard::call([&] { box_sums<double>(*arguments); });
}
