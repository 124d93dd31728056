/* What Python calls through ctypes.  Plain C; every array belongs to the caller; lengths in the caller's unit. */
#ifndef TORCHSPH_INTERFACE_H
#define TORCHSPH_INTERFACE_H
#include <stdint.h>

enum { SPH_DONE = 0, SPH_NOT_COMPILED = 1 };

typedef struct { /* particles to be searched */
  int64_t particles;
  const void* position;  /* (particles, dimension) */
  const int64_t* member; /* (particles,) */
  double radius;
  double period[3];      /* infinity: not periodic */
  int32_t dimension, threads;
} sph_search;

typedef struct {
  int64_t clusters, members, unusable; /* unusable: particles not finite or of a negative member; nothing was sorted */
} sph_sizes;

typedef struct { /* cluster lists; see lists.hpp */
  int32_t* slot;    /* (8 clusters,) particle of each slot, ~particle for padding */
  int32_t* owner;   /* (clusters,) member */
  int64_t* offset;  /* (clusters,) */
  int32_t* entries; /* (capacity,) */
  void* home;       /* (8 clusters, dimension) sorted positions, or null */
} sph_lists;

typedef struct {
  int32_t dimension, threads;
  uint32_t terms;             /* sum of sph::Term, of terms.hpp as the other enums */
  int32_t weight, form, kernel;
  double support, sigma;
  int64_t particles, clusters;
  const int32_t *slot, *owner, *entries;
  const int64_t* offset;
  const void* home;           /* null: no periodic axis */
  double period[3];
  const double* coefficients; /* (members, 4): smoothing length, artificial, laminar, tensile */
  const void *position, *velocity, *mass, *deviation, *pressure, *slope, *field;
  const uint8_t* active;
  void* const* outputs;       /* one for each of SPH_OUTPUTS; null: not asked for */
} sph_pass;

typedef struct { /* the pressure Poisson equation; see poisson.hpp */
  sph_pass pass;              /* terms: the Laplacian; its sums are not written */
  const void *source, *start; /* (particles,); start null: from 0 */
  const uint8_t *free, *singular; /* (particles,) unknowns, (members,) where the constant is in the null space */
  const int64_t* member;      /* (particles,) */
  int64_t members, iterations;
  double tolerance;
  void* values;               /* (particles,) */
  int64_t* count;             /* (members,) iterations, and so on */
  double *residual, *mismatch;
  uint8_t* converged;
} sph_poisson;

typedef struct { /* moments of a first-order moving-least-squares fetch; see interpolation.hpp */
  sph_search particles;
  const void* fields;         /* (particles, columns) */
  int64_t columns, queries;
  const void* query;          /* (queries, dimension) */
  const int64_t* query_member;
  int32_t kernel;
  double support, sigma;
  const double* lengths;      /* (members,) */
  void *count, *value, *first, *second, *field, *field_first;
  const void* weights;        /* (particles,) that the kernel is multiplied by, or null */
} sph_interpolation;

typedef struct { /* closest surface points of the nodes of a regular grid, x fastest; see closest.cpp */
  int32_t dimension, threads;
  int64_t faces;
  const double* vertices;  /* (vertices, dimension) */
  const double* values;    /* (vertices, dimension), linear on each face */
  const int32_t* corners;  /* (faces, dimension) */
  double origin[3], step;
  int64_t counts[3];       /* nodes along x, y, z */
  const double* limit;     /* (nodes,) distance up to which the closest point is wanted exactly */
  double *distance, *carried; /* (nodes,) and (nodes, dimension): the values at the closest point */
} sph_closest;

typedef struct { /* fields on a regular grid, looked up at points; see look_up.cpp */
  int32_t dimension, threads;
  int64_t channels, count, fractions; /* fractions: 1 for all points, or count */
  const void *early, *late;           /* (nodes, channels), x fastest; late null: nothing changes */
  const uint8_t* plain;               /* (nodes,) cells, by their lowest corner, that take its early values; or null */
  const void *points, *fraction;      /* (count, dimension), (fractions,) of the way from early to late */
  double origin[3], step[3];
  int64_t counts[3];                  /* nodes along x, y, z, at least 2 each */
  int32_t unit;                       /* whether channels 1 to dimension are a direction, to be of length 1 */
  void* out;                          /* (count, channels) */
} sph_look_up;

typedef struct { /* complete-kernel walls' part of the sums; see walls.cpp */
  int32_t dimension, threads, form;   /* form: sph::PressureForm */
  int64_t count, channels;
  const void* rows;                   /* (count, channels): distance, normal, wall velocity, share, gradient, swept */
  const void* velocity;               /* (count, dimension) */
  const void *divergence, *concentration_gradient;  /* rates: (count,), (count, dimension) or null */
  void *whole_divergence, *whole_concentration_gradient;
  const void *pressure, *deviation;   /* forces: (count,) each, or null without pressure */
  const double* viscosity;            /* (viscosities,): 0 without friction, 1 for all, or one per member */
  int64_t viscosities;
  const int64_t* member;              /* (count,) */
  const void* acceleration;           /* (count, dimension) */
  void* whole_acceleration;
  double smallest_share, smallest_gap;
  const void *before, *after, *distance; /* near: (count, dimension) each; distance where the walls were seen, */
  int64_t distance_stride;               /* which may be a column */
  const double* step;                    /* (members,) */
  const uint8_t* held;                   /* (count,) whether walls hold a particle */
  double gap;
  int64_t* near;                         /* (count,) indices, of which as many are filled as are returned */
  void* near_distance;                   /* (count,) likewise */
} sph_walls;

typedef struct { /* normalised correlation of kernels with what surrounds them; see correlation.cpp */
  int32_t threads;
  int64_t points, images, apart;
  int64_t shape[3], half[3], search[3]; /* along z, y, x, in nodes */
  const void* volume;                   /* (z, y, x, images) complex; every kernel and lag lies inside */
  const int64_t *corner, *offset;       /* (points, 3) first nodes of the kernels, and the lags amid those searched */
  const void* ramp;                     /* (points, 3) rad per node and image, or null */
  void* rho;                            /* (points, lags z, y, x) complex */
} sph_correlation;

typedef struct { /* a packet's images put side by side at each node; see images.cpp */
  int32_t threads;
  int64_t images;
  int64_t shape[3], margin[3]; /* along z, y, x: nodes of an image, and of the rim of the arrays below */
  const void* samples;         /* (images, z, y, x) complex */
  void* volume;                /* (.., images) complex, or null; their rims are filled with 0 */
  void* power;                 /* (..) mean square */
  void* turn;                  /* (..) complex sum of conj(sample) times that of the next image, over the
                                  root of the power, or null */
} sph_images;

typedef struct { /* sums of a field over boxes around points; see images.cpp */
  int32_t threads;
  int64_t points, parts;      /* parts: 1 for a real field, 2 for a complex one */
  int64_t shape[3], reach[3]; /* along z, y, x: of the field, and of a box to either side, in nodes */
  const void* field;
  const int64_t* middle;      /* (points, 3) nodes */
  void* out;                  /* (points,), of the field's type */
} sph_boxes;

typedef struct { /* points and a periodic lattice; see gridding.cpp */
  int32_t threads, dimension, width;
  double shape_parameter;
  double origin[3], spacing[3]; /* along x, y, z */
  int64_t counts[3];            /* nodes, at least `width` */
  int64_t points;
  const void* position;         /* (points, dimension) */
  void* values;                 /* (points,) complex */
  void* field;                  /* (.., y, x) complex; spread: added to */
} sph_gridding;

typedef struct { /* where a field lies in a structure, in bytes; without a name: the structure itself */
  const char *structure, *field;
  int64_t offset, size;
} sph_layout;

#ifdef __cplusplus
extern "C" {
#endif
#pragma GCC visibility push(default)
int sph_sort_f32(const sph_search*, sph_sizes*);
int sph_sort_f64(const sph_search*, sph_sizes*);
int64_t sph_list_f32(const sph_search*, int64_t capacity, sph_lists*); /* entries needed; call again if above capacity */
int64_t sph_list_f64(const sph_search*, int64_t capacity, sph_lists*);
int sph_pass_f32(const sph_pass*);
int sph_pass_f64(const sph_pass*);
int sph_poisson_f32(const sph_poisson*);
int sph_poisson_f64(const sph_poisson*);
int64_t sph_interpolate_f32(const sph_interpolation*); /* number of unusable particles and queries; 0: done */
int64_t sph_interpolate_f64(const sph_interpolation*);
void sph_look_up_f32(const sph_look_up*);
void sph_look_up_f64(const sph_look_up*);
void sph_wall_rates_f32(const sph_walls*);
void sph_wall_rates_f64(const sph_walls*);
void sph_wall_forces_f32(const sph_walls*);
void sph_wall_forces_f64(const sph_walls*);
int64_t sph_wall_near_f32(const sph_walls*);
int64_t sph_wall_near_f64(const sph_walls*);
void sph_correlate_f32(const sph_correlation*);
void sph_correlate_f64(const sph_correlation*);
void sph_arrange_f32(const sph_images*);
void sph_arrange_f64(const sph_images*);
void sph_box_sums_f32(const sph_boxes*);
void sph_box_sums_f64(const sph_boxes*);
void sph_spread_f32(const sph_gridding*);
void sph_spread_f64(const sph_gridding*);
void sph_gather_f32(const sph_gridding*);
void sph_gather_f64(const sph_gridding*);
void sph_grid_closest(const sph_closest*);
int sph_runs(const char* instruction_set);             /* whether this processor has it */
int sph_fault(char* text, int64_t room); /* kind of the calling thread's last fault, see guard.hpp; 0: none */
const sph_layout* sph_layouts(int64_t* count);
double sph_fma(int threads, int64_t turns, float factor); /* float32 multiply-adds; the flop done */
#pragma GCC visibility pop
#ifdef __cplusplus
}
#endif
#endif
