/* A minimal speckle tracker for the test of the ctypes adapter: whole-node search of the normalised correlation. */
#include <math.h>
#include <stdint.h>

typedef struct {
    int32_t dimension, images, nz, ny, nx;
    double spacing[3], interval, frequency, sound_speed;
    double kernel, search;
    double beam[3];
} speckle_parameters;

static double correlation_at(const speckle_parameters *p, const float *iq, const int64_t at[3], const int64_t by[3],
                             const int64_t half[3]) {
    double re = 0, im = 0, a2 = 0, b2 = 0;
    for (int64_t t = 0; t + 1 < p->images; ++t)
        for (int64_t k = -half[2]; k <= half[2]; ++k)
            for (int64_t j = -half[1]; j <= half[1]; ++j)
                for (int64_t i = -half[0]; i <= half[0]; ++i) {
                    const int64_t x = at[0] + i, y = at[1] + j, z = at[2] + k;
                    const int64_t u = x + by[0], v = y + by[1], w = z + by[2];
                    if (x < 0 || y < 0 || z < 0 || x >= p->nx || y >= p->ny || z >= p->nz) continue;
                    if (u < 0 || v < 0 || w < 0 || u >= p->nx || v >= p->ny || w >= p->nz) continue;
                    const float *a = iq + 2 * (((t * p->nz + z) * p->ny + y) * p->nx + x);
                    const float *b = iq + 2 * ((((t + 1) * p->nz + w) * p->ny + v) * p->nx + u);
                    re += a[0] * b[0] + a[1] * b[1];
                    im += a[0] * b[1] - a[1] * b[0];
                    a2 += a[0] * a[0] + a[1] * a[1];
                    b2 += b[0] * b[0] + b[1] * b[1];
                }
    return a2 > 0 && b2 > 0 ? sqrt((re * re + im * im) / (a2 * b2)) : 0;
}

int speckle_track(const speckle_parameters *p, const float *iq, int64_t points, const double *position,
                  float *velocity, float *correlation) {
    if (p->images < 2) return 7;
    int64_t half[3], reach[3];
    for (int c = 0; c < 3; ++c) {
        const int active = c < p->dimension;
        half[c] = active ? llround(p->kernel / (2 * p->spacing[c])) : 0;
        reach[c] = active ? (int64_t)ceil(p->search * p->interval / p->spacing[c]) : 0;
    }
    for (int64_t n = 0; n < points; ++n) {
        int64_t at[3], by[3];
        for (int c = 0; c < 3; ++c) at[c] = llround(position[3 * n + c] / p->spacing[c]);
        correlation[n] = -1;
        for (by[2] = -reach[2]; by[2] <= reach[2]; ++by[2])
            for (by[1] = -reach[1]; by[1] <= reach[1]; ++by[1])
                for (by[0] = -reach[0]; by[0] <= reach[0]; ++by[0]) {
                    const double found = correlation_at(p, iq, at, by, half);
                    if (found <= correlation[n]) continue;
                    correlation[n] = (float)found;
                    for (int c = 0; c < 3; ++c)
                        velocity[3 * n + c] = (float)(by[c] * p->spacing[c] / p->interval);
                }
    }
    return 0;
}
