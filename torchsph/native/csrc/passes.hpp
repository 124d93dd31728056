// The pair sums: one template, whose terms are chosen when it is compiled; what is not asked for is not in the loop.
#pragma once
#include "rows.hpp"
#include "smoothing.hpp"

namespace sph {

constexpr double singularity = 0.01;  // keeps 1 / r^2 finite, in squared smoothing lengths (epsilon of Grønli 2017, eq. 2.28)

template <class Real> struct Outputs {  // arrays in the caller's order; null where a sum was not asked for
#define SPH_POINTER(name, ...) Real* name = nullptr;
  SPH_OUTPUTS(SPH_POINTER)
#undef SPH_POINTER
  Outputs() = default;
  explicit Outputs(void* const* given) {
#define SPH_TAKE(name, ...) name = static_cast<Real*>(*given++);
    SPH_OUTPUTS(SPH_TAKE)
#undef SPH_TAKE
  }
};

struct Coefficients {  // of one member
  double length, artificial, laminar, tensile;  // tensile: R / w(r0 / h)^4
};

struct KernelChoice {
  std::int32_t kind;
  double support, sigma;
};

// Spread a register of sums over the particles of its slots. Not inlined: it runs once per cluster and sum, and copies of
// it in every pass would double the time to compile.
template <class Real>
__attribute__((noinline)) void put(typename Lanes<Real>::Vector sum, Real scale, const Real* factor, const std::int32_t* slot,
                                   Real* out, int stride) {
  Real lane[cluster_size];
  Lanes<Real>::store_own(lane, sum);
  for (int l = 0; l < Lanes<Real>::own; ++l)
    if (slot[l] >= 0) out[std::int64_t(slot[l]) * stride] = (factor ? factor[l] : Real(1)) * scale * lane[l];
}

template <class Real, int D, std::uint32_t T> struct Pass {
  using L = Lanes<Real>;
  using V = typename L::Vector;
  static constexpr Layout at = layout(D, T);
  static constexpr bool has(std::uint32_t t) { return (T & t) != 0; }
  static constexpr bool jumps = has(continuity | xsph | artificial | laminar);

  struct Constants {  // of one member, spread over a register
    V inverse_length, epsilon, artificial, laminar, tensile;
    Real support;
    std::int32_t kernel;
  };

  template <int rank, int count = components(rank, D)> struct Sum { using Type = V[count]; };
  template <int count> struct Sum<0, count> { using Type = V; };

  struct Sums {
#define SPH_SUM(name, terms, rank, ...) typename Sum<rank>::Type name = {};
    SPH_OUTPUTS(SPH_SUM)
#undef SPH_SUM
  };

  struct Own {  // the particles a
    V field[at.fields];
  };

  static Constants constants(const Coefficients& c, const KernelChoice& choice) {
    const double h = c.length;
    return {L::all(Real(1 / h)), L::all(Real(singularity * h * h)), L::all(Real(2 * c.artificial * h)),
            L::all(Real(c.laminar)), L::all(Real(c.tensile)), Real(choice.support), choice.kind};
  }

  // Sums of the particles a of one register of a cluster: each(a, b, entry, sums) takes in the partners b at an entry.
  template <class Each>
  static SPH_INLINE Sums swept(const Lists<Real>& lists, const Rows<Real>& rows, std::int64_t g, int group, Each each) {
    const Real* block = rows.block.data() + g * at.block();
    Own a;
    for (int f = 0; f < at.fields; ++f) a.field[f] = L::load_own(block + f * cluster_size + group * L::own);
    V home[D];
    for (int d = 0; d < D; ++d) home[d] = a.field[d];
    Sums sums;
    for (const std::int32_t* list = lists.entries + lists.offset[g]; list[0] >= 0;) {
      const std::int32_t image = list[0], count = list[1];
      move(a, home, image, lists);
      list += 2;
      for (std::int32_t n = 0; n < count; n += L::partners)
        each(a, Partner<Real, at.fields>(rows.row.data(), list + n, at.stride()), list + n, sums);
      list += count;
    }
    return sums;
  }

  // The particles a, whose place is `home`, where a periodic image sees them.
  static SPH_INLINE void move(Own& a, const V* home, std::int32_t image, const Lists<Real>& lists) {
    if (!lists.periodic) return;
    for (int d = 0; d < D; ++d) {
      const int step = image_step(image, d);
      a.field[d] = home[d] + (step ? Real(step * lists.period[d]) : Real(0));
    }
  }

  static SPH_INLINE void add(const Constants& k, const Own& a, const Partner<Real, at.fields>& b, Sums& s) {
    V gap[D], square{}, jump[D], approach{};
    for (int d = 0; d < D; ++d) {
      gap[d] = a.field[d] - b.field(d);
      square += gap[d] * gap[d];
    }
    const V q_square = square * k.inverse_length * k.inverse_length;
    const Smoothing<V> w = smoothing<Real, V>(k.kernel, q_square, k.support);
    if constexpr (jumps)
      for (int d = 0; d < D; ++d) jump[d] = a.field[at.velocity + d] - b.field(at.velocity + d);
    if constexpr (has(continuity | artificial))
      for (int d = 0; d < D; ++d) approach += jump[d] * gap[d];
    const V weight = b.field(at.weight), slope = weight * w.slope;

    if constexpr (has(continuity)) s.divergence -= slope * approach;
    if constexpr (has(diffusion)) s.diffusion += slope * (a.field[at.deviation] - b.field(at.deviation));
    if constexpr (has(corrected_diffusion)) {
      V drop = a.field[at.deviation] - b.field(at.deviation), linear{};
      for (int d = 0; d < D; ++d) linear += (a.field[at.slope + d] + b.field(at.slope + d)) * gap[d];
      s.diffusion += slope * (drop - Real(0.5) * linear);
    }
    if constexpr (has(gradient)) {
      const V rise = slope * (b.field(at.deviation) - a.field[at.deviation]);
      for (int d = 0; d < D; ++d) s.gradient[d] += rise * gap[d];
    }
    if constexpr (has(moments)) {
      const V volume = weight * w.value, mass = b.field(at.mass) * w.value;
      for (int d = 0; d < D; ++d) {
        const V part = volume * gap[d];
        s.moment_first[d] -= part;
        s.moment_mass[d] -= mass * gap[d];
        for (int e = 0; e < D; ++e) s.moment_second[d * D + e] += part * gap[e];
      }
    }
    if constexpr (has(concentration))
      for (int d = 0; d < D; ++d) s.concentration[d] += slope * gap[d];
    if constexpr (has(renormalisation))
      for (int d = 0; d < D; ++d) {
        const V part = slope * gap[d];
        for (int e = 0; e < D; ++e) s.renormalisation[d * D + e] -= part * gap[e];
      }
    if constexpr (has(shepard)) {
      s.shepard_volume += weight * w.value;
      s.shepard_mass += b.field(at.mass) * w.value;
    }

    // one division serves 1 / (k_a + k_b), 1 / (r^2 + eps h^2) and their product
    V per_inertia{}, per_square{}, per_both{};
    if constexpr (has(artificial)) {
      const V inertia = a.field[at.inertia] + b.field(at.inertia), distance = square + k.epsilon;
      per_both = 1 / (inertia * distance);
      if constexpr (has(xsph)) per_inertia = per_both * distance;
      if constexpr (has(laminar)) per_square = per_both * inertia;
    } else {
      if constexpr (has(xsph)) per_inertia = 1 / (a.field[at.inertia] + b.field(at.inertia));
      if constexpr (has(laminar | laplacian)) per_square = 1 / (square + k.epsilon);
    }
    if constexpr (has(xsph)) {
      const V pull = weight * w.value * per_inertia;
      for (int d = 0; d < D; ++d) s.xsph[d] -= pull * jump[d];
    }
    if constexpr (has(pressure | artificial)) {
      V push{};
      if constexpr (has(pressure)) push = a.field[at.stress] + b.field(at.stress);
      if constexpr (has(tensile)) {
        const V w2 = w.value * w.value;
        push += k.tensile * w2 * w2 * (magnitude(a.field[at.stress]) + magnitude(b.field(at.stress)));
      }
      if constexpr (has(artificial)) push -= k.artificial * negative_part(approach) * per_both;
      const V force = slope * push;
      for (int d = 0; d < D; ++d) s.acceleration[d] -= force * gap[d];
    }
    if constexpr (has(laminar)) {
      const V rate = k.laminar * slope * square * per_square * (a.field[at.inverse] + b.field(at.inverse));
      for (int d = 0; d < D; ++d) s.acceleration[d] += rate * jump[d];
    }
    if constexpr (has(laplacian)) {
      const V part = slope * square * per_square;
      s.diagonal -= part;
      s.laplacian -= part * (a.field[at.field] - b.field(at.field));
    }
  }

  template <int rank>
  static SPH_INLINE void put_all(const typename Sum<rank>::Type& sum, Real scale, const Real* factor,
                                 const std::int32_t* slot, Real* out) {
    if constexpr (rank == 0) put<Real>(sum, scale, factor, slot, out, 1);
    else
      for (int k = 0; k < components(rank, D); ++k) put<Real>(sum[k], scale, factor, slot, out + k, components(rank, D));
  }

  static SPH_INLINE void write(const Sums& s, const std::int32_t* slot, const Real* factor, Real per_value, Real per_slope,
                               const Outputs<Real>& o) {
#define SPH_WRITE(name, terms, rank, power, times, own) \
  if constexpr (has(terms))                             \
    if (o.name) put_all<rank>(s.name, times * (power ? per_slope : per_value), own ? factor : nullptr, slot, o.name);
    SPH_OUTPUTS(SPH_WRITE)
#undef SPH_WRITE
  }

  static void run(const Lists<Real>& lists, const Rows<Real>& rows, const KernelChoice& choice, const Coefficients* members,
                  const Outputs<Real>& outputs) {
#pragma omp parallel for num_threads(lists.threads) schedule(dynamic, 16)
    for (std::int64_t g = 0; g < lists.clusters; ++g) {
      const Coefficients& c = members[lists.owner[g]];
      const double h = c.length;
      const Constants k = constants(c, choice);
      const Real per_value = Real(choice.sigma / std::pow(h, D)), per_slope = Real(choice.sigma / std::pow(h, D + 2));
      const Real* block = rows.block.data() + g * at.block();
      for (int group = 0; group < L::groups; ++group) {
        const Sums sums = swept(lists, rows, g, group, [&](const Own& a, const auto& b, const std::int32_t*, Sums& into) {
          add(k, a, b, into);
        });
        write(sums, lists.slot + g * cluster_size + group * L::own, block + at.factor() * cluster_size + group * L::own,
              per_value, per_slope, outputs);
      }
    }
  }
};

}  // namespace sph
