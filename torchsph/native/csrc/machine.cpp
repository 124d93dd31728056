// What this processor can do: its instruction sets, and the rate at which it multiplies and adds; what this library takes.
#include <omp.h>

#include <iterator>

#include "guard.hpp"
#include "interface.h"
#include "lanes.hpp"
#include "layouts.hpp"
#include "processor.hpp"

extern "C" int sph_runs(const char* instruction_set) { return processor_runs(instruction_set); }

extern "C" int sph_fault(char* text, int64_t room) { return guard::read(text, room); }

extern "C" const sph_layout* sph_layouts(int64_t* count) {
  *count = std::size(layouts);
  return layouts;
}

// Chains of x <- x a + b in registers; the caller takes the time. Returns the additions and multiplications done.
extern "C" double sph_fma(int threads, int64_t turns, float factor) {
  using L = sph::Lanes<float>;
  constexpr int chains = 12;  // independent, so that the latency is hidden
  double sink = 0;
#pragma omp parallel num_threads(threads) reduction(+ : sink)
  {
    const L::Vector a = L::all(factor), b = L::all(0.001f);
    L::Vector x[chains];
    for (int c = 0; c < chains; ++c) x[c] = L::all(0.1f * float(c));
    for (int64_t t = 0; t < turns; ++t)
      for (int c = 0; c < chains; ++c) x[c] = x[c] * a + b;
    for (int c = 0; c < chains; ++c) sink += double(x[c][0]);
  }
  return sink == 12345.0 ? 0.0 : 2.0 * double(turns) * chains * L::count * threads;  // sink keeps the loop alive
}
