// The pressure Poisson equation by conjugate gradients: positions and weights are packed once, only the field changes.
#pragma once
#include <limits>
#include <vector>

#include "coarse.hpp"

namespace sph {

constexpr double alone = 1e-12;  // below this a diagonal entry belongs to a particle without neighbours
constexpr double least = std::numeric_limits<double>::min();

// Sums over each member's particles, in double precision and in an order that does not depend on the threads.
struct Totals {
  static constexpr std::int64_t stretch = 4096;
  std::int64_t particles, members;
  const std::int64_t* member;
  int threads;
  std::vector<double> partial;

  // body(i, sums): changes particle i and adds to its member's `kinds` sums; the result is (members, kinds).
  template <class Body> void over(int kinds, std::vector<double>& result, Body body) {
    const std::int64_t stretches = (particles + stretch - 1) / stretch, width = members * kinds;
    partial.assign(stretches * width, 0.0);
#pragma omp parallel for num_threads(threads) schedule(static)
    for (std::int64_t s = 0; s < stretches; ++s) {
      double* mine = partial.data() + s * width;
      const std::int64_t stop = std::min(particles, (s + 1) * stretch);
      for (std::int64_t i = s * stretch; i < stop; ++i) body(i, mine + member[i] * kinds);
    }
    result.assign(width, 0.0);
    for (std::int64_t s = 0; s < stretches; ++s)
      for (std::int64_t k = 0; k < width; ++k) result[k] += partial[s * width + k];
  }
};

// Vectors of the solver in the caller's order, kept between the calls of a thread.
template <class Real> struct PoissonRoom {
  std::vector<Real> residual, direction, image, diagonal;
  std::vector<double> mean, scale, left, begun, fresh, old, curvature, along, beta, sums;
  std::vector<std::uint8_t> active;
  CoarseRoom<Real> coarse;
};

template <class Real, int D> class Poisson {
  static constexpr Layout at = layout(D, laplacian);
  using Laplacian = Pass<Real, D, laplacian>;

  const sph_poisson& p;
  const Lists<Real>& lists;
  Rows<Real>& rows;
  PoissonRoom<Real>& room;
  CoarseLevel<Real, D> coarse;
  bool two_levels = false;
  Totals totals;
  const Real *mass, *source;
  Real* values;

 public:
  Poisson(const sph_poisson& given, const Lists<Real>& found, Rows<Real>& packed, PoissonRoom<Real>& kept)
      : p(given), lists(found), rows(packed), room(kept),
        coarse(found, kept.coarse, static_cast<const Real*>(given.pass.mass), given.free, given.member, given.members),
        totals{given.pass.particles, given.members, given.member, given.pass.threads, {}},
        mass(static_cast<const Real*>(given.pass.mass)), source(static_cast<const Real*>(given.source)),
        values(static_cast<Real*>(given.values)) {}

  void run() {
    begin();
    auto& r = room;
    r.begun = r.left;
    const double wanted = p.tolerance * p.tolerance;
    const auto going = [&](std::int64_t b) { return finite(r.left[b]) && r.left[b] > wanted * r.scale[b]; };
    for (std::int64_t b = 0; b < p.members; ++b) r.active[b] = going(b), p.count[b] = 0;
    if (two_levels) coarse.solve(r.residual, r.active, p.singular, r.fresh);
    for (std::int64_t turn = 0; turn < p.iterations && any(r.active); ++turn) {
      for (std::int64_t b = 0; b < p.members; ++b)
        r.beta[b] = p.count[b] > 0 ? r.fresh[b] / std::max(r.old[b], least) : 0.0;
      r.old = r.fresh;
      advance();
      for (std::int64_t b = 0; b < p.members; ++b) {
        r.active[b] = r.active[b] && r.curvature[b] > 0;
        r.along[b] = r.active[b] ? r.fresh[b] / r.curvature[b] : 0.0;
        p.count[b] += r.active[b];
      }
      descend();
      for (std::int64_t b = 0; b < p.members; ++b) r.active[b] = r.active[b] && going(b);
      if (two_levels) coarse.solve(r.residual, r.active, p.singular, r.fresh);
    }
    keep_better();
    for (std::int64_t b = 0; b < p.members; ++b) {
      const bool known = finite(r.left[b]);
      p.residual[b] = known ? std::sqrt(r.left[b] / std::max(r.scale[b], least)) : std::numeric_limits<double>::quiet_NaN();
      p.converged[b] = known && r.left[b] <= wanted * r.scale[b];
      p.mismatch[b] = r.mean[b];
    }
  }

 private:
  static bool any(const std::vector<std::uint8_t>& flags) {
    for (const std::uint8_t flag : flags)
      if (flag) return true;
    return false;
  }

  // Where the residual has grown, as it may on a system without a solution, the start is the better answer.
  void keep_better() {
    auto& r = room;
    bool worse = false;
    for (std::int64_t b = 0; b < p.members; ++b) {
      r.active[b] = finite(r.begun[b]) && !(finite(r.left[b]) && r.left[b] <= r.begun[b]);
      if (r.active[b]) r.left[b] = r.begun[b], worse = true;
    }
    const Real* start = static_cast<const Real*>(p.start);
    for (std::int64_t i = 0; worse && i < p.pass.particles; ++i)
      if (r.active[p.member[i]]) values[i] = start && p.free[i] ? start[i] : Real(0);
  }

  // Sources without their mean where only differences of pressure count, the start's residual, the diagonal.
  void begin() {
    auto& r = room;
    const std::int64_t n = p.pass.particles;
    for (auto* one : {&r.residual, &r.direction, &r.image, &r.diagonal}) one->resize(n);
    for (auto* one : {&r.curvature, &r.along, &r.beta, &r.mean}) one->assign(p.members, 0.0);
    r.active.assign(p.members, 0);
    totals.over(2, r.sums, [&](std::int64_t i, double* sum) {
      if (!p.free[i]) return;
      sum[0] += double(mass[i]) * source[i], sum[1] += mass[i];
    });
    for (std::int64_t b = 0; b < p.members; ++b)
      if (p.singular[b]) r.mean[b] = r.sums[2 * b] / std::max(r.sums[2 * b + 1], least);
    const Real* start = static_cast<const Real*>(p.start);
    totals.over(1, r.scale, [&](std::int64_t i, double* sum) {
      values[i] = start && p.free[i] ? start[i] : Real(0);
      r.direction[i] = values[i];
      r.residual[i] = p.free[i] ? source[i] - Real(r.mean[p.member[i]]) : Real(0);
      if (p.free[i]) sum[0] += double(mass[i]) * r.residual[i] * r.residual[i];
    });
    two_levels = coarse.build(rows);
    apply(r.diagonal.data());
    totals.over(2, r.sums, [&](std::int64_t i, double* sum) {
      // from now on the inverse, the preconditioner
      r.diagonal[i] = r.diagonal[i] > Real(alone) ? 1 / r.diagonal[i] : Real(0);
      r.direction[i] = 0;
      if (!p.free[i]) return;
      r.residual[i] -= r.image[i];
      note(i, sum);
    });
    split();
  }

  void note(std::int64_t i, double* sum) const {
    const double weighted = double(mass[i]) * room.residual[i];
    sum[0] += weighted * room.residual[i];
    sum[1] += weighted * room.diagonal[i] * room.residual[i];
  }

  void split() {
    room.left.resize(p.members), room.fresh.resize(p.members);
    for (std::int64_t b = 0; b < p.members; ++b) room.left[b] = room.sums[2 * b], room.fresh[b] = room.sums[2 * b + 1];
  }

  void advance() {
    auto& r = room;
#pragma omp parallel for num_threads(p.pass.threads) schedule(static)
    for (std::int64_t i = 0; i < p.pass.particles; ++i)
      r.direction[i] = r.diagonal[i] * r.residual[i] + (two_levels ? coarse.answer(i) : Real(0)) +
                       Real(r.beta[p.member[i]]) * r.direction[i];
    apply(nullptr);
    totals.over(1, r.curvature, [&](std::int64_t i, double* sum) {
      if (p.free[i]) sum[0] += double(mass[i]) * r.direction[i] * r.image[i];
    });
  }

  void descend() {
    auto& r = room;
    totals.over(2, r.sums, [&](std::int64_t i, double* sum) {
      if (!p.free[i]) return;
      const Real along = Real(r.along[p.member[i]]);
      values[i] += along * r.direction[i];
      r.residual[i] -= along * r.image[i];
      note(i, sum);
    });
    split();
  }

  // image = A direction; where it is wanted, once, the diagonal of A and the coarse level too
  void apply(Real* diagonal) {
    const Real* field = room.direction.data();
#pragma omp parallel for num_threads(lists.threads) schedule(static)
    for (std::int64_t g = 0; g < lists.clusters; ++g)
      for (int lane = 0; lane < cluster_size; ++lane) {
        const std::int64_t slot = g * cluster_size + lane, i = lists.slot[slot];
        const Real value = field[i < 0 ? ~i : i];
        rows.row[slot * at.stride() + at.field] = value;
        rows.block[g * at.block() + at.field * cluster_size + lane] = value;
      }
    Outputs<Real> out{};
    out.laplacian = room.image.data();
    out.diagonal = diagonal;
    const KernelChoice kernel{p.pass.kernel, p.pass.support, p.pass.sigma};
    const auto* members = reinterpret_cast<const Coefficients*>(p.pass.coefficients);
    if (diagonal && two_levels) coarse.assemble(rows, kernel, members, out);
    else Laplacian::run(lists, rows, kernel, members, out);
  }
};

}  // namespace sph
