// The images of a packet node by node, in one pass over memory, and sums of fields over boxes around points.
#include <omp.h>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

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
      for (int64_t i = 0; i < count; ++i) turn[2 * (node + i)] = real[i], turn[2 * (node + i) + 1] = imaginary[i];
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
#pragma omp parallel num_threads(a.threads)
  {
    std::vector<Real> sum(2 * a.reach[2] + 1);
#pragma omp for schedule(static)
    for (int64_t p = 0; p < a.points; ++p) {
      const Box box(a, a.middle + 3 * p);
      const int64_t count = box.high[2] - box.low[2] + 1;
      std::fill(sum.begin(), sum.end(), Real(0));
      for (int64_t z = box.low[0]; z <= box.high[0]; ++z)
        for (int64_t y = box.low[1]; y <= box.high[1]; ++y) {
          const Real* row = field + (z * a.shape[1] + y) * a.shape[2] + box.low[2];
          for (int64_t i = 0; i < count; ++i) sum[i] += row[i];
        }
      Real total = 0;
      for (int64_t i = 0; i < count; ++i) total += sum[i];
      out[p] = total;
    }
  }
}

// Sums over a box of conj(f(k - 1)) f(k) + conj(f(k)) f(k + 1) along each axis, of a complex field f, 0 outside.
template <class Real>
void neighbour_sums(const sph_boxes& a) {
  const auto* field = static_cast<const Real*>(a.field);
  const int64_t step[3] = {2 * a.shape[1] * a.shape[2], 2 * a.shape[2], 2};
#pragma omp parallel num_threads(a.threads)
  {
    std::vector<Real> sums(2 * (2 * a.reach[2] + 2));
#pragma omp for schedule(static)
    for (int64_t p = 0; p < a.points; ++p) {
      const Box box(a, a.middle + 3 * p);
      for (int axis = 0; axis < 3; ++axis) {
        Real* out = static_cast<Real*>(a.out) + 2 * (3 * p + axis);
        out[0] = out[1] = 0;
        if (a.reach[axis] == 0) continue;
        // pairs of a node and the next along the axis, by their first node
        int64_t low[3], high[3];
        for (int k = 0; k < 3; ++k) low[k] = box.low[k], high[k] = box.high[k];
        low[axis] = std::max<int64_t>(0, low[axis] - 1), high[axis] = std::min(a.shape[axis] - 2, high[axis]);
        const int64_t count = high[2] - low[2] + 1;
        // those with both nodes in the box count twice
        const auto times = [&](int64_t k) { return Real((k >= box.low[axis]) + (k < box.high[axis])); };
        std::fill(sums.begin(), sums.end(), Real(0));
        Real *real = sums.data(), *imaginary = real + std::max<int64_t>(count, 0);
        for (int64_t z = low[0]; z <= high[0]; ++z)
          for (int64_t y = low[1]; y <= high[1]; ++y) {
            const Real* one = field + z * step[0] + y * step[1] + low[2] * step[2];
            const Real *other = one + step[axis], weight = axis == 2 ? Real(1) : times(axis == 0 ? z : y);
            for (int64_t i = 0; i < count; ++i) {
              real[i] += weight * (one[2 * i] * other[2 * i] + one[2 * i + 1] * other[2 * i + 1]);
              imaginary[i] += weight * (one[2 * i] * other[2 * i + 1] - one[2 * i + 1] * other[2 * i]);
            }
          }
        for (int64_t i = 0; i < count; ++i) {
          const Real weight = axis == 2 ? times(low[2] + i) : Real(1);
          out[0] += weight * real[i], out[1] += weight * imaginary[i];
        }
      }
    }
  }
}

}  // namespace

extern "C" void sph_arrange_f32(const sph_images* arguments) { Arranger<float>(*arguments).run(); }
extern "C" void sph_arrange_f64(const sph_images* arguments) { Arranger<double>(*arguments).run(); }
extern "C" void sph_box_sums_f32(const sph_boxes* arguments) { box_sums<float>(*arguments); }
extern "C" void sph_box_sums_f64(const sph_boxes* arguments) { box_sums<double>(*arguments); }
extern "C" void sph_neighbour_sums_f32(const sph_boxes* arguments) { neighbour_sums<float>(*arguments); }
extern "C" void sph_neighbour_sums_f64(const sph_boxes* arguments) { neighbour_sums<double>(*arguments); }
