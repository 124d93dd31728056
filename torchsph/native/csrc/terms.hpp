// Pair terms and smoothing kernels. Written by native/headers.py from torchsph/pairs/terms.py and
// smoothing_kernels.py: change those, then build.
#pragma once
#include <cstdint>

namespace sph {

enum Term : std::uint32_t {
  continuity = 1,
  diffusion = 2,
  concentration = 4,
  xsph = 8,
  pressure = 16,
  artificial = 32,
  laminar = 64,
  tensile = 128,
  shepard = 256,
  renormalisation = 512,
  laplacian = 1024,
  gradient = 2048,
  corrected_diffusion = 4096,
  moments = 8192,
};

enum Weight : std::int32_t {
  by_volume = 0,
  by_mass = 1,
};

enum PressureForm : std::int32_t {
  symmetric = 0,
  sum = 1,
  switched = 2,
  difference = 3,
};

enum Kernel : std::int32_t {
  gaussian = 0,
  cubic = 1,
  quintic = 2,
  wendland_c2 = 3,
  wendland_c4 = 4,
  wendland_c6 = 5,
  spiky = 6,
};

// Terms of which all combinations are compiled, and further passes.
constexpr std::uint32_t rate_terms = 15;
constexpr std::uint32_t acceleration_terms = 240;
constexpr std::uint32_t special_passes[] = {256, 512, 1024, 2048, 4096, 8192, 2560, 257, 261, 325};

// FIELD(name, rank, terms that read it)
#define SPH_FIELDS(FIELD) \
  FIELD(velocity, 1, continuity | xsph | artificial | laminar) \
  FIELD(slope, 1, corrected_diffusion) \
  FIELD(stress, 0, pressure | tensile) \
  FIELD(inertia, 0, xsph | artificial) \
  FIELD(inverse, 0, laminar) \
  FIELD(deviation, 0, diffusion | gradient | corrected_diffusion) \
  FIELD(mass, 0, shepard | moments) \
  FIELD(field, 0, laplacian)

// OUTPUT(name, terms that fill it, rank, power of 1 / h beyond the dimension, times, by the own factor)
#define SPH_OUTPUTS(OUTPUT) \
  OUTPUT(divergence, continuity, 0, 2, 1, false) \
  OUTPUT(diffusion, diffusion | corrected_diffusion, 0, 2, 2, false) \
  OUTPUT(concentration, concentration, 1, 2, 1, false) \
  OUTPUT(xsph, xsph, 1, 0, 2, true) \
  OUTPUT(acceleration, pressure | artificial | laminar, 1, 2, 1, true) \
  OUTPUT(shepard_volume, shepard, 0, 0, 1, false) \
  OUTPUT(shepard_mass, shepard, 0, 0, 1, false) \
  OUTPUT(renormalisation, renormalisation, 2, 2, 1, false) \
  OUTPUT(laplacian, laplacian, 0, 2, 2, true) \
  OUTPUT(diagonal, laplacian, 0, 2, 2, true) \
  OUTPUT(gradient, gradient, 1, 2, 1, false) \
  OUTPUT(moment_first, moments, 1, 0, 1, false) \
  OUTPUT(moment_second, moments, 2, 0, 1, false) \
  OUTPUT(moment_mass, moments, 1, 0, 1, false)

}  // namespace sph
