// Whether a number is finite, by its bits: the library is compiled for finite numbers.
#pragma once
#include <cstdint>
#include <cstring>

namespace sph {

template <class Real> inline bool finite(Real value) {
  if constexpr (sizeof(Real) == 4) {
    std::uint32_t bits;
    std::memcpy(&bits, &value, 4);
    return (bits & 0x7f800000u) != 0x7f800000u;
  } else {
    std::uint64_t bits;
    std::memcpy(&bits, &value, 8);
    return (bits & 0x7ff0000000000000ull) != 0x7ff0000000000000ull;
  }
}

}  // namespace sph
