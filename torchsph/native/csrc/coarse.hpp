// A coarse level for the pressure's conjugate gradients: one unknown for each aggregate of neighbouring clusters.
//
// Added to the diagonal as preconditioner (two-level additive Schwarz with piecewise constants: Nicolaides 1987, SIAM J.
// Numer. Anal. 24, 355-365; Galerkin products) it takes the long waves out of the iteration, of which a cavity many
// smoothing lengths wide has many. The aggregates' matrix is dense and small, and factored afresh for every solve.
#pragma once
#include "passes.hpp"

namespace sph {

constexpr int largest_coarse = 256;      // unknowns of a member: the factor costs their cube
constexpr double coarse_shift = 1e-5;    // of the mean diagonal: where only differences count the matrix is singular
constexpr double in_aggregate[4] = {0, 0, 12, 36};  // particles: cells 3.5 spacings wide, by dimension

template <class Real> struct CoarseRoom {
  std::vector<std::int32_t> of_cluster, of_particle, order;  // aggregate, in its member; clusters by aggregate
  std::vector<std::int64_t> begin, first, matrix_at;         // (aggregates + 1) in order; (members + 1) twice
  std::vector<double> matrix, given, right, weight;          // upper factors row by row; right sides; answers; masses
  std::vector<Real> answer;
  std::vector<std::int32_t> owner;                           // (aggregates) member
  std::vector<std::uint8_t> usable;                          // (members)
  std::vector<std::pair<std::uint64_t, std::int32_t>> keys;
};

template <class Real, int D> class CoarseLevel {
  static constexpr Layout at = layout(D, laplacian);
  static_assert(at.fields < at.stride(), "the flag of a free partner needs a place in the row");
  using L = Lanes<Real>;
  using V = typename L::Vector;
  using Sums = Pass<Real, D, laplacian>;

  const Lists<Real>& lists;
  CoarseRoom<Real>& r;
  const Real* mass;
  const std::uint8_t* free;
  const std::int64_t* group;
  const std::int64_t members;

 public:
  CoarseLevel(const Lists<Real>& found, CoarseRoom<Real>& kept, const Real* masses, const std::uint8_t* freed,
              const std::int64_t* groups, std::int64_t count)
      : lists(found), r(kept), mass(masses), free(freed), group(groups), members(count) {}

  // Aggregates of clusters; false where a cluster holds particles of several groups, which must not be mixed.
  bool build(const Rows<Real>& rows) {
    r.first.assign(1, 0), r.matrix_at.assign(1, 0), r.begin.assign(1, 0), r.owner.clear();
    r.of_cluster.resize(lists.clusters + 1), r.order.resize(lists.clusters), r.of_particle.assign(lists.particles, -1);
    r.of_cluster[lists.clusters] = 0;  // of the null slot, which weighs nothing
    std::int64_t g = 0;
    for (std::int64_t b = 0; b < members; ++b) {
      const std::int64_t begin = g;
      while (g < lists.clusters && lists.owner[g] == b) ++g;
      aggregate(rows, b, begin, g);
      const std::int64_t size = std::int64_t(r.begin.size()) - 1 - r.first.back();
      r.first.push_back(r.first.back() + size);
      r.matrix_at.push_back(r.matrix_at.back() + size * size);
    }
    if (g != lists.clusters) return false;
    for (g = 0; g < lists.clusters; ++g)
      for (int lane = 0; lane < cluster_size; ++lane) {
        const std::int32_t i = lists.slot[g * cluster_size + lane];
        if (i < 0) continue;
        if (group[i] != lists.owner[g]) return false;
        if (free[i]) r.of_particle[i] = std::int32_t(r.first[group[i]]) + r.of_cluster[g];
      }
    r.weight.assign(r.owner.size(), 0.0);
    for (std::int64_t i = 0; i < lists.particles; ++i)
      if (r.of_particle[i] >= 0) r.weight[r.of_particle[i]] += mass[i];
    r.given.resize(r.owner.size()), r.right.resize(r.owner.size()), r.answer.assign(r.owner.size(), Real(0));
    return true;
  }

  // One pass as `Laplacian::run` makes it, which leaves behind the factors of the aggregates' matrices.
  void assemble(Rows<Real>& rows, const KernelChoice& choice, const Coefficients* coefficients, const Outputs<Real>& out) {
    r.matrix.assign(r.matrix_at[members], 0.0);
    for (std::int64_t slot = 0; slot < lists.clusters * cluster_size; ++slot) {
      const std::int32_t i = lists.slot[slot];
      rows.row[slot * at.stride() + at.fields] = i >= 0 && free[i] ? Real(1) : Real(0);
    }
    const std::int64_t aggregates = std::int64_t(r.owner.size());
#pragma omp parallel for num_threads(lists.threads) schedule(dynamic, 4)
    for (std::int64_t a = 0; a < aggregates; ++a) {
      const std::int64_t b = r.owner[a], size = r.first[b + 1] - r.first[b], own = a - r.first[b];
      double* row = r.matrix.data() + r.matrix_at[b] + own * size;
      for (std::int64_t k = r.begin[a]; k < r.begin[a + 1]; ++k)
        cluster(r.order[k], own, row, rows, choice, coefficients[b], out);
    }
    r.usable.assign(members, 0);
#pragma omp parallel for num_threads(lists.threads) schedule(dynamic, 1)
    for (std::int64_t b = 0; b < members; ++b)
      r.usable[b] = factor(r.matrix.data() + r.matrix_at[b], r.first[b + 1] - r.first[b]);
  }

  // Answers to `residual` (N,) of the active members, and what they add to its product with the preconditioned one.
  // Where only differences count neither has a mean: of the rounding in that of the residual nothing must be made.
  void solve(const std::vector<Real>& residual, const std::vector<std::uint8_t>& active, const std::uint8_t* singular,
             std::vector<double>& energy) {
#pragma omp parallel for num_threads(lists.threads) schedule(dynamic, 1)
    for (std::int64_t b = 0; b < members; ++b) {
      if (!active[b] || !r.usable[b]) continue;
      const std::int64_t first = r.first[b], size = r.first[b + 1] - first;
      double total = 0, mean = 0, product = 0, weight = 0;
      for (std::int64_t a = first; a < first + size; ++a) {
        r.given[a] = r.right[a] = collected(a, residual);
        total += r.given[a], weight += r.weight[a];
      }
      for (std::int64_t a = first; singular[b] && a < first + size; ++a) r.right[a] -= total / weight * r.weight[a];
      substitute(r.matrix.data() + r.matrix_at[b], size, r.right.data() + first);
      for (std::int64_t a = first; singular[b] && a < first + size; ++a) mean += r.weight[a] * r.right[a] / weight;
      for (std::int64_t a = first; a < first + size; ++a) {
        r.answer[a] = Real(r.right[a] - mean);
        product += r.given[a] * (r.right[a] - mean);
      }
      energy[b] += product;
    }
  }

  SPH_INLINE Real answer(std::int64_t i) const {
    const std::int32_t a = r.of_particle[i];
    return a < 0 ? Real(0) : r.answer[a];
  }

 private:
  // Cut the member's clusters [begin, end) into cells, wide enough for few enough of them.
  void aggregate(const Rows<Real>& rows, std::int64_t b, std::int64_t begin, std::int64_t end) {
    if (begin == end) return;
    double volume = 0;
    std::int64_t particles = 0;
    for (std::int64_t slot = begin * cluster_size; slot < end * cluster_size; ++slot)
      if (const std::int32_t i = lists.slot[slot]; i >= 0) volume += mass[i], ++particles;
    const double wanted = std::max(in_aggregate[D], 1.3 * double(particles) / largest_coarse);
    for (double width = std::pow(wanted * volume / double(particles), 1.0 / D);; width *= 1.2) {
      r.keys.clear();
      for (std::int64_t g = begin; g < end; ++g) r.keys.emplace_back(key(rows, g, width), std::int32_t(g));
      std::sort(r.keys.begin(), r.keys.end());
      std::int64_t cells = 1;
      for (std::size_t k = 1; k < r.keys.size(); ++k) cells += r.keys[k].first != r.keys[k - 1].first;
      if (cells <= largest_coarse) break;
    }
    std::int32_t cell = 0;
    for (std::size_t k = 0; k < r.keys.size(); ++k) {
      const std::int32_t g = r.keys[k].second;
      if (k && r.keys[k].first != r.keys[k - 1].first) r.begin.push_back(begin + std::int64_t(k)), ++cell;
      if (!k || r.keys[k].first != r.keys[k - 1].first) r.owner.push_back(std::int32_t(b));
      r.of_cluster[g] = cell;
      r.order[begin + std::int64_t(k)] = g;
    }
    r.begin.push_back(end);
  }

  static std::uint64_t key(const Rows<Real>& rows, std::int64_t g, double width) {
    const Real* block = rows.block.data() + g * at.block();
    std::uint64_t key = 0;
    for (int d = 0; d < D; ++d) {
      double middle = 0;
      for (int lane = 0; lane < cluster_size; ++lane) middle += block[d * cluster_size + lane];
      const double cell = std::floor(middle / (cluster_size * width));
      key = key << 21 | std::uint64_t(std::int64_t(std::clamp(cell, -1e6, 1e6)) + 1048576);
    }
    return key;
  }

  // Sums of one cluster as in `Pass::run`; the row of its aggregate takes what its free particles have of free partners.
  void cluster(std::int64_t g, std::int64_t own, double* row, const Rows<Real>& rows, const KernelChoice& choice,
               const Coefficients& c, const Outputs<Real>& out) const {
    const double h = c.length;
    const auto k = Sums::constants(c, choice);
    const Real per_value = Real(choice.sigma / std::pow(h, D)), per_slope = Real(choice.sigma / std::pow(h, D + 2));
    const Real* block = rows.block.data() + g * at.block();
    for (int part = 0; part < L::groups; ++part) {
      const std::int32_t* slot = lists.slot + g * cluster_size + part * L::own;
      Real weight[cluster_size];
      for (int l = 0; l < L::own; ++l)
        weight[l] = slot[l] >= 0 && free[slot[l]] ? mass[slot[l]] * 2 * per_slope : Real(0);
      const V mine = L::load_own(weight);
      V run{};
      std::int32_t to = -1;
      // What they have of one aggregate stands together in the list and is taken at once; inlined, for its registers.
      const auto each = [&](const typename Sums::Own& a, const auto& b, const std::int32_t* entry, auto& into) __attribute__((always_inline)) {
        const V before = into.diagonal;
        into.diagonal = V{};
        Sums::add(k, a, b, into);
        const V pull = mine * into.diagonal * b.field(at.fields);
        into.diagonal += before;
        const std::int32_t next = r.of_cluster[entry[0] / cluster_size];
        const std::int32_t last = r.of_cluster[entry[L::partners - 1] / cluster_size];
        if (last != next) {
          take(pull, next, last, row);
          return;
        }
        if (next != to) {
          if (to >= 0) take(run, to, to, row);
          run = V{}, to = next;
        }
        run += pull;
      };
      const auto sums = Sums::swept(lists, rows, g, part, each);
      if (to >= 0) take(run, to, to, row);
      Real lane[cluster_size];
      L::store_own(lane, sums.diagonal);
      for (int l = 0; l < L::own; ++l) row[own] += double(weight[l]) * lane[l];
      Sums::write(sums, slot, block + at.factor() * cluster_size + part * L::own, per_value, per_slope, out);
    }
  }

  // Take the pull on the first and on the second half of a register's partners from two entries of a row.
  static SPH_INLINE void take(V pull, std::int32_t first, std::int32_t second, double* row) {
    Real lane[L::count];
    L::store(lane, pull);
    for (int l = 0; l < L::count; ++l) row[l < L::own ? first : second] -= double(lane[l]);
  }

  double collected(std::int64_t a, const std::vector<Real>& residual) const {
    double sum = 0;
    for (std::int64_t k = r.begin[a]; k < r.begin[a + 1]; ++k)
      for (int lane = 0; lane < cluster_size; ++lane) {
        const std::int32_t i = lists.slot[std::int64_t(r.order[k]) * cluster_size + lane];
        if (i >= 0 && free[i]) sum += double(mass[i]) * residual[i];
      }
    return sum;
  }

  // Cholesky's factor in the upper triangle, row by row; false where the matrix is not positive.
  static bool factor(double* a, std::int64_t n) {
    double trace = 0;
    for (std::int64_t k = 0; k < n; ++k) trace += a[k * n + k];
    if (!(trace > 0) || !finite(trace)) return false;
    for (std::int64_t k = 0; k < n; ++k) {
      double* pivot = a + k * n;
      // an aggregate without free particles stands alone
      pivot[k] += pivot[k] > 0 ? coarse_shift * trace / double(n) : trace / double(n);
    }
    for (std::int64_t k = 0; k < n; ++k) {
      double* pivot = a + k * n;
      if (!(pivot[k] > 0)) return false;
      const double root = std::sqrt(pivot[k]);
      pivot[k] = root;
      for (std::int64_t j = k + 1; j < n; ++j) pivot[j] /= root;
      for (std::int64_t i = k + 1; i < n; ++i) {
        const double share = pivot[i];
        if (share == 0) continue;
        double* row = a + i * n;
#pragma omp simd
        for (std::int64_t j = i; j < n; ++j) row[j] -= share * pivot[j];
      }
    }
    return true;
  }

  static void substitute(const double* a, std::int64_t n, double* x) {
    for (std::int64_t k = 0; k < n; ++k) {
      const double* row = a + k * n;
      const double value = x[k] /= row[k];
#pragma omp simd
      for (std::int64_t j = k + 1; j < n; ++j) x[j] -= value * row[j];
    }
    for (std::int64_t k = n - 1; k >= 0; --k) {
      const double* row = a + k * n;
      double sum = x[k];
#pragma omp simd reduction(- : sum)
      for (std::int64_t j = k + 1; j < n; ++j) sum -= row[j] * x[j];
      x[k] = sum / row[k];
    }
  }
};

}  // namespace sph
