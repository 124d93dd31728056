// The closest surface point of every node of a regular grid: exact within a limit given for each node, beyond it the
// closest point of a neighbouring node, which bounds the distance from above.
//
// Face by face rather than node by node: a face visits the nodes in a ball around it and is tried where it may be
// closer than what is known. Its centroid, a point of the surface, bounds the distance first, so that few tries remain.
#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "guard.hpp"
#include "interface.h"

namespace {

template <int D>
struct Vector {
  double x[D];
  double& operator[](int k) { return x[k]; }
  double operator[](int k) const { return x[k]; }
};

template <int D>
double dot(const Vector<D>& a, const Vector<D>& b) {
  double sum = 0;
  for (int k = 0; k < D; ++k) sum += a[k] * b[k];
  return sum;
}

template <int D>
Vector<D> minus(const Vector<D>& a, const Vector<D>& b) {
  Vector<D> out;
  for (int k = 0; k < D; ++k) out[k] = a[k] - b[k];
  return out;
}

double ratio(double above, double below) { return below > 0 ? std::min(std::max(above / below, 0.0), 1.0) : 0.0; }

// Weights of the corners at the closest point of a segment.
void weigh(const Vector<2>* corner, const Vector<2>& at, double* weight) {
  const Vector<2> along = minus<2>(corner[1], corner[0]);
  weight[1] = ratio(dot<2>(minus<2>(at, corner[0]), along), dot<2>(along, along));
  weight[0] = 1 - weight[1];
}

// Weights of the corners at the closest point of a triangle (Ericson 2005, Real-Time Collision Detection, 5.1.5).
void weigh(const Vector<3>* corner, const Vector<3>& at, double* weight) {
  const Vector<3> ab = minus<3>(corner[1], corner[0]), ac = minus<3>(corner[2], corner[0]);
  const Vector<3> ap = minus<3>(at, corner[0]), bp = minus<3>(at, corner[1]), cp = minus<3>(at, corner[2]);
  const double d1 = dot<3>(ab, ap), d2 = dot<3>(ac, ap), d3 = dot<3>(ab, bp), d4 = dot<3>(ac, bp);
  const double d5 = dot<3>(ab, cp), d6 = dot<3>(ac, cp);
  const double va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
  double v, w;
  if (d1 <= 0 && d2 <= 0) {
    v = w = 0;
  } else if (d3 >= 0 && d4 <= d3) {
    v = 1, w = 0;
  } else if (vc <= 0 && d1 >= 0 && d3 <= 0) {
    v = ratio(d1, d1 - d3), w = 0;
  } else if (d6 >= 0 && d5 <= d6) {
    v = 0, w = 1;
  } else if (vb <= 0 && d2 >= 0 && d6 <= 0) {
    v = 0, w = ratio(d2, d2 - d6);
  } else if (va <= 0 && d4 >= d3 && d5 >= d6) {
    w = ratio(d4 - d3, (d4 - d3) + (d5 - d6)), v = 1 - w;
  } else {
    v = ratio(vb, va + vb + vc), w = ratio(vc, va + vb + vc);
  }
  weight[0] = 1 - v - w, weight[1] = v, weight[2] = w;
}

template <int D>
class Closest {
 public:
  explicit Closest(const sph_closest& a) : a_(a), nodes_(1), reach_(0) {
    for (int k = 0; k < D; ++k) nodes_ *= a.counts[k];
    best_.assign(a.limit, a.limit + nodes_);
    for (double& limit : best_) reach_ = std::max(reach_, limit), limit *= limit;  // squares at first
    face_.assign(nodes_, -1);
    point_.resize(nodes_);
    for (int64_t f = 0; f < a.faces; ++f) describe(f);
  }

  void run() {
    const int64_t layers = a_.counts[D - 1], thick = 4, layer = nodes_ / layers;
#pragma omp parallel for schedule(dynamic) num_threads(a_.threads)
    for (int64_t slab = 0; slab < (layers + thick - 1) / thick; ++slab) {
      const int64_t from = slab * thick, to = std::min(layers, from + thick);
      for (int64_t f = 0; f < a_.faces; f += 4) bound(f, from, to);
      // a little more than the distance, so that the face of the nearest centroid is still found closer
      for (int64_t n = from * layer; n < to * layer; ++n) best_[n] = std::sqrt(best_[n]) * (1 + 1e-9);
      for (int64_t f = 0; f < a_.faces; ++f) visit(f, from, to);
    }
    carry();
    write();
  }

 private:
  void describe(int64_t f) {
    Vector<D> centre{};
    double radius = 0;
    for (int c = 0; c < D; ++c)
      for (int k = 0; k < D; ++k) centre[k] += vertex(f, c)[k] / D;
    for (int c = 0; c < D; ++c) {
      const Vector<D> arm = minus<D>(vertex(f, c), centre);
      radius = std::max(radius, dot<D>(arm, arm));
    }
    centre_.push_back(centre);
    radius_.push_back(std::sqrt(radius));
    Vector<D> normal = across(vertex(f, 0), vertex(f, 1), vertex(f, D - 1));
    const double length = std::sqrt(dot<D>(normal, normal));
    for (int k = 0; k < D; ++k) normal[k] = length > 0 ? normal[k] / length : 0.0;
    normal_.push_back(normal);
  }

  static Vector<2> across(const Vector<2>& a, const Vector<2>& b, const Vector<2>&) { return {{b[1] - a[1], a[0] - b[0]}}; }

  static Vector<3> across(const Vector<3>& a, const Vector<3>& b, const Vector<3>& c) {
    const Vector<3> u = minus<3>(b, a), v = minus<3>(c, a);
    return {{u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]}};
  }

  Vector<D> vertex(int64_t face, int corner) const {
    Vector<D> out;
    for (int k = 0; k < D; ++k) out[k] = a_.vertices[int64_t(a_.corners[face * D + corner]) * D + k];
    return out;
  }

  // Calls act(first node, number of nodes, the first one's place less the centre) for rows of the grid that hold the
  // nodes in a ball; all rows are of the same length, which is faster than to find each one's ends.
  template <class Act>
  void rows(const Vector<D>& centre, double radius, int64_t from, int64_t to, Act act) const {
    Vector<D> arm{};
    int64_t first, last;
    span(0, centre, radius, 0, a_.counts[0], first, last);
    arm[0] = a_.origin[0] + double(first) * a_.step - centre[0];
    if (last >= first) range(D - 1, centre, radius * radius, from, to, 0, first, last - first + 1, arm, act);
  }

  void span(int axis, const Vector<D>& centre, double half, int64_t from, int64_t to, int64_t& first, int64_t& last) const {
    const double middle = centre[axis] - a_.origin[axis];
    first = std::max(from, int64_t(std::ceil((middle - half) / a_.step)));
    last = std::min(to - 1, int64_t(std::floor((middle + half) / a_.step)));
  }

  template <class Act>
  void range(int axis, const Vector<D>& centre, double square, int64_t from, int64_t to, int64_t node, int64_t begin,
             int64_t count, Vector<D>& arm, Act act) const {
    if (axis == 0) return act(node + begin, count, arm);
    int64_t first, last;
    span(axis, centre, std::sqrt(std::max(square, 0.0)), from, to, first, last);
    for (int64_t i = first; i <= last; ++i) {
      arm[axis] = a_.origin[axis] + double(i) * a_.step - centre[axis];
      range(axis - 1, centre, square - arm[axis] * arm[axis], 0, a_.counts[axis - 1], (node + i) * a_.counts[axis - 1],
            begin, count, arm, act);
    }
  }

  void bound(int64_t f, int64_t from, int64_t to) {
    const double step = a_.step;
    rows(centre_[f], reach_, from, to, [&](int64_t node, int64_t count, const Vector<D>& arm) {
      double* best = best_.data() + node;
      const double begin = arm[0], off = dot<D>(arm, arm) - begin * begin;
      for (int64_t i = 0; i < count; ++i) {
        const double along = begin + double(i) * step;
        best[i] = std::min(best[i], along * along + off);
      }
    });
  }

  void visit(int64_t f, int64_t from, int64_t to) {
    const double radius = radius_[f], step = a_.step;
    Vector<D> corner[D];
    for (int c = 0; c < D; ++c) corner[c] = minus<D>(vertex(f, c), centre_[f]);
    rows(centre_[f], reach_ + radius, from, to, [&](int64_t node, int64_t count, Vector<D> arm) {
      const double begin = arm[0], off = dot<D>(arm, arm) - begin * begin;
      for (int64_t start = 0; start < count; start += CHUNK) {
        const int64_t size = std::min(CHUNK, count - start);
        const double* best = best_.data() + node + start;
        uint8_t wanted[CHUNK];
        for (int64_t i = 0; i < size; ++i) {
          const double along = begin + double(start + i) * step, far = best[i] + radius;
          wanted[i] = along * along + off <= far * far;
        }
        for (int64_t i = 0; i < size; ++i) {
          arm[0] = begin + double(start + i) * step;
          if (wanted[i] && may_be_closer(f, arm, best[i])) attempt(f, corner, arm, node + start + i);
        }
      }
    });
  }

  // The face lies in its plane within its radius of the centroid: it is no closer than that disc.
  bool may_be_closer(int64_t f, const Vector<D>& arm, double best) const {
    const double height = dot<D>(arm, normal_[f]);
    const double aside = std::sqrt(std::max(dot<D>(arm, arm) - height * height, 0.0)) - radius_[f];
    return aside <= 0 || height * height + aside * aside <= best * best * (1 + 1e-9);
  }

  void attempt(int64_t f, const Vector<D>* corner, const Vector<D>& at, int64_t node) {
    double weight[D];
    weigh(corner, at, weight);
    Vector<D> point{};
    for (int c = 0; c < D; ++c)
      for (int k = 0; k < D; ++k) point[k] += weight[c] * corner[c][k];
    const Vector<D> gap = minus<D>(at, point);
    const double distance = std::sqrt(dot<D>(gap, gap));
    if (distance > best_[node] || (distance == best_[node] && face_[node] >= 0)) return;
    best_[node] = distance, face_[node] = int32_t(f);
    for (int k = 0; k < D; ++k) point_[node][k] = point[k] + centre_[f][k];
  }

  Vector<D> place(int64_t node) const {
    Vector<D> out;
    for (int k = 0; k < D; ++k) {
      out[k] = a_.origin[k] + double(node % a_.counts[k]) * a_.step;
      node /= a_.counts[k];
    }
    return out;
  }

  // Two rounds of sweeps there and back: each node beyond the limit takes the best of its neighbours' closest points.
  void carry() {
    source_.resize(nodes_);
    for (int64_t n = 0; n < nodes_; ++n) source_[n] = face_[n] < 0 ? -1 : int32_t(n);
    for (int64_t n = 0; n < nodes_; ++n)
      if (face_[n] < 0) best_[n] = INFINITE;  // from here on squared distances of these nodes
    for (int round = 0; round < 2; ++round) sweep<1>(), sweep<-1>();
    for (int64_t n = 0; n < nodes_; ++n)
      if (face_[n] < 0) best_[n] = std::sqrt(best_[n]);
  }

  template <int way>
  void sweep() {
    const int64_t wide = a_.counts[0], high = a_.counts[1], deep = D == 3 ? a_.counts[D - 1] : 1;
    const int64_t stride[3] = {1, wide, wide * high};
    for (int64_t kk = 0; kk < deep; ++kk)
      for (int64_t jj = 0; jj < high; ++jj)
        for (int64_t ii = 0; ii < wide; ++ii) {
          const int64_t index[3] = {way > 0 ? ii : wide - 1 - ii, way > 0 ? jj : high - 1 - jj, way > 0 ? kk : deep - 1 - kk};
          const int64_t node = index[0] + wide * (index[1] + high * index[2]), passed[3] = {ii, jj, kk};
          if (face_[node] >= 0) continue;
          Vector<D> at;
          for (int k = 0; k < D; ++k) at[k] = a_.origin[k] + double(index[k]) * a_.step;
          for (int k = 0; k < D; ++k) {
            const int32_t source = passed[k] ? source_[node - way * stride[k]] : -1;
            if (source < 0 || source == source_[node]) continue;
            const Vector<D> gap = minus<D>(at, point_[source]);
            const double square = dot<D>(gap, gap);
            if (square < best_[node]) best_[node] = square, source_[node] = source;
          }
        }
  }

  void write() {
#pragma omp parallel for num_threads(a_.threads)
    for (int64_t n = 0; n < nodes_; ++n) {
      a_.distance[n] = best_[n];
      const int32_t source = source_[n];
      if (source < 0) continue;
      Vector<D> corner[D];
      for (int c = 0; c < D; ++c) corner[c] = vertex(face_[source], c);
      double weight[D];
      weigh(corner, place(source), weight);
      for (int k = 0; k < D; ++k) {
        double sum = 0;
        for (int c = 0; c < D; ++c) sum += weight[c] * a_.values[int64_t(a_.corners[face_[source] * D + c]) * D + k];
        a_.carried[n * D + k] = sum;
      }
    }
  }

  static constexpr int64_t CHUNK = 64;
  static constexpr double INFINITE = 1e300;  // the library is compiled for finite numbers
  const sph_closest& a_;
  int64_t nodes_;
  double reach_;
  std::vector<double> best_, radius_;
  std::vector<int32_t> face_, source_;
  std::vector<Vector<D>> point_, centre_, normal_;
};

}  // namespace

extern "C" void sph_grid_closest(const sph_closest* arguments) {
  guard::call([&] { arguments->dimension == 2 ? Closest<2>(*arguments).run() : Closest<3>(*arguments).run(); });
}
