// What Python hands over for the rows of a spline system; library.py holds the mirrors of both structures.
#pragma once
#include <cstdint>

constexpr int kMaxComponents = 3;
constexpr int kMaxAxes = 4;
constexpr int kMaxOrder = 6;  // degree + 1

extern "C" {

struct SplineGrid {
  int32_t axes, components, degree, padded;  // padded: local coefficients rounded up to the tile width
  int32_t axis_of_component[kMaxAxes];       // place of component k's own axis among the solve axes
  double spacing[kMaxAxes];                  // knot distance along the solve axes, m
  double pieces[kMaxOrder * kMaxOrder];      // (degree + 1, degree + 1): row k holds the factors of t^k of each function
  int64_t cells, nodes;                      // cells that hold rows, active coefficients
  const int32_t* position;                   // (cells, local) solve positions, rising within a cell
};

struct SplineRows {
  int32_t kind, shared;      // shared: all components have the same weight (kVector)
  int64_t count;             // rows' points; 0 for the cell kinds
  const int64_t* start;      // (cells + 1) points of each cell; for the cell kinds 0 or 1 blocks
  const double* t;           // (count, axes) local coordinates, slowest solve axis first
  const double* coefficient; // (count, components): weight, weight * direction, or weight in column 0
  const double* gram;        // (local, local), or (C, C, local, local) for kCellCoupled
};

}  // extern "C"
