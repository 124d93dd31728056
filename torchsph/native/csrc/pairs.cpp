// Plain C interface to the search and the pair sums; compiled once for each precision (SPH_REAL) and instruction set.
#include "interface.h"

#include <iterator>
#include <utility>

#include "guard.hpp"
#include "interpolation.hpp"
#include "lists.hpp"
#include "passes.hpp"
#include "poisson.hpp"

#ifndef SPH_REAL
#error "compile with -DSPH_REAL=float -DSPH_SUFFIX=_f32 or -DSPH_REAL=double -DSPH_SUFFIX=_f64"
#endif
#define SPH_JOIN(a, b) a##b
#define SPH_PASTE(a, b) SPH_JOIN(a, b)
#define SPH_NAME(name) SPH_PASTE(name, SPH_SUFFIX)

namespace {

using namespace sph;
using Real = SPH_REAL;

// Kept between calls of a thread, so that a step allocates nothing.
thread_local Columns<Real> columns, queries;
thread_local Rows<Real> rows;
thread_local PoissonRoom<Real> room;

Shape shape_of(const sph_search& s) {
  return {s.particles, s.member, s.radius, {s.period[0], s.period[1], s.period[2]}, s.threads};
}

constexpr bool special(std::uint32_t t) {
  for (const std::uint32_t pass : special_passes)
    if (pass == t) return true;
  return false;
}

// The combinations that are compiled: every subset of the rates, every subset of the accelerations, (float on wide
// registers) the two together, where a scheme evaluates them at one state, and the special passes.
constexpr bool compiled(std::uint32_t t) {
  const bool rates = t & rate_terms, accelerations = t & acceleration_terms;
  if (t & ~(rate_terms | acceleration_terms)) return special(t);
  if ((t & tensile) && !(t & pressure)) return false;
  if (!rates || !accelerations) return t != 0;
  return sizeof(Real) == 4 && register_bytes > 16 && (t & continuity) && (t & pressure) && !(t & (concentration | tensile));
}

using Run = void (*)(const Lists<Real>&, const Rows<Real>&, const KernelChoice&, const Coefficients*, const Outputs<Real>&);

template <int D, std::uint32_t T> constexpr Run run_of() {
  if constexpr (compiled(T)) return &Pass<Real, D, T>::run;
  else return nullptr;
}

template <int D, std::size_t... T> Run find_combination(std::uint32_t terms, std::index_sequence<T...>) {
  static constexpr Run table[] = {run_of<D, T>()...};
  return table[terms];
}

template <int D, std::size_t... I> Run find_special(std::uint32_t terms, std::index_sequence<I...>) {
  Run found = nullptr;
  ((void)(special_passes[I] == terms ? found = run_of<D, special_passes[I]>() : nullptr), ...);
  return found;
}

template <int D> Run find(std::uint32_t terms) {
  constexpr std::size_t combinations = (rate_terms | acceleration_terms) + 1;
  if (terms < combinations) return find_combination<D>(terms, std::make_index_sequence<combinations>());
  return find_special<D>(terms, std::make_index_sequence<std::size(special_passes)>());
}

const Real* reals(const void* a) { return static_cast<const Real*>(a); }

Lists<Real> lists_of(const sph_pass& p) {
  return {p.particles, p.clusters, p.slot, p.owner, p.entries, p.offset, reals(p.home),
          {p.period[0], p.period[1], p.period[2]}, p.home != nullptr, p.threads};
}

State<Real> state_of(const sph_pass& p) {
  return {reals(p.position), reals(p.velocity), reals(p.mass), reals(p.deviation), reals(p.pressure),
          reals(p.slope), reals(p.field), p.active, p.weight, p.form};
}

template <int D> int pass(const sph_pass& p) {
  const Run run = find<D>(p.terms);
  if (!run) return SPH_NOT_COMPILED;
  const Lists<Real> lists = lists_of(p);
  const KernelChoice kernel{p.kernel, p.support, p.sigma};
  pack<Real, D>(layout(D, p.terms), state_of(p), lists, rows);
  run(lists, rows, kernel, reinterpret_cast<const Coefficients*>(p.coefficients), Outputs<Real>(p.outputs));
  return SPH_DONE;
}

template <int D> int poisson(const sph_poisson& p) {
  const Lists<Real> lists = lists_of(p.pass);
  State<Real> state = state_of(p.pass);
  state.field = reals(p.source);  // any: the solver puts in its own
  pack<Real, D>(layout(D, laplacian), state, lists, rows);
  Poisson<Real, D>(p, lists, rows, room).run();
  return SPH_DONE;
}

template <int D> std::int64_t lists(const sph_search& s, std::int64_t capacity, sph_lists& out) {
  const std::int64_t needed = list_all<Real, D>(columns, shape_of(s), capacity, out.offset, out.entries);
  std::copy(columns.slot.begin(), columns.slot.end(), out.slot);
  std::copy(columns.owner.begin(), columns.owner.end(), out.owner);
  if (Real* home = static_cast<Real*>(out.home))
    for (std::int64_t i = 0; i < columns.slots(); ++i)
      for (int d = 0; d < D; ++d) home[i * D + d] = columns.at[d][i];
  return needed;
}

template <int D> std::int64_t interpolate(const sph_interpolation& p) {
  const Shape shape = shape_of(p.particles);
  const Shape asked{p.queries, p.query_member, shape.radius, {shape.period[0], shape.period[1], shape.period[2]}, shape.threads};
  if (const std::int64_t bad = sort_columns<Real, D>(shape, static_cast<const Real*>(p.particles.position), columns)) return bad;
  if (const std::int64_t bad = sort_queries<Real, D>(asked, static_cast<const Real*>(p.query), columns, queries)) return bad;
  const InterpolationKernel kernel{{p.kernel, p.support, p.sigma}, p.lengths};
  const auto out = [](void* a) { return static_cast<Real*>(a); };
  const Moments<Real> moments{out(p.count), out(p.value), out(p.first), out(p.second), out(p.field), out(p.field_first)};
  const Carried<Real> carried{static_cast<const Real*>(p.fields), p.columns, static_cast<const Real*>(p.weights)};
  Interpolation<Real, D, true>::sweep(columns, queries, shape, kernel, carried, 0, moments);
  for (std::int64_t c = 0; c < p.columns; c += D)
    Interpolation<Real, D, false>::sweep(columns, queries, shape, kernel, carried, c, moments);
  return 0;
}

}  // namespace

extern "C" {

int SPH_NAME(sph_sort)(const sph_search* s, sph_sizes* sizes) {
  return guard::call([&] {
    const Real* position = static_cast<const Real*>(s->position);
    const Shape shape = shape_of(*s);
    sizes->unusable = s->dimension == 3 ? sort_columns<Real, 3>(shape, position, columns)
                                        : sort_columns<Real, 2>(shape, position, columns);
    sizes->clusters = columns.clusters;
    sizes->members = columns.members;
    return int(SPH_DONE);
  });
}

int64_t SPH_NAME(sph_list)(const sph_search* s, int64_t capacity, sph_lists* out) {
  return guard::call([&] { return s->dimension == 3 ? lists<3>(*s, capacity, *out) : lists<2>(*s, capacity, *out); });
}

int64_t SPH_NAME(sph_interpolate)(const sph_interpolation* p) {
  return guard::call([&] { return p->particles.dimension == 3 ? interpolate<3>(*p) : interpolate<2>(*p); });
}

int SPH_NAME(sph_poisson)(const sph_poisson* p) {
  return guard::call([&] { return p->pass.dimension == 3 ? poisson<3>(*p) : poisson<2>(*p); });
}

int SPH_NAME(sph_pass)(const sph_pass* p) {
  return guard::call([&] { return p->dimension == 3 ? pass<3>(*p) : pass<2>(*p); });
}

}
