/* Four numbers of a periodic volume at places between its voxels: `torchfovea.sim.volume.PeriodicVolume.at`, which is
the definition, in C. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <tgmath.h>

typedef struct {
    int64_t size; /* voxels of a period along each axis; one more closes it */
    const REAL *values; /* (size + 1, size + 1, size + 1, 4), x fastest */
} Volume;

/* The first `wanted` of the numbers, (wanted, count), at places (3, count) in periods. */
int64_t read_volume(const Volume *volume, const REAL *restrict places, int64_t count, int64_t wanted, REAL *restrict to) {
    const int64_t size = volume->size, row = 4 * (size + 1), floor_ = row * (size + 1);
    for (int64_t p = 0; p < count; p++) {
        int64_t at = 0;
        REAL part[3];
        for (int axis = 0; axis < 3; axis++) {
            const REAL period = places[axis * count + p], place = (period - floor(period)) * size;
            const int64_t voxel = place < size - 1 ? (int64_t)place : size - 1; /* no number: the last */
            part[axis] = place - voxel;
            at += voxel * (axis == 0 ? 4 : axis == 1 ? row : floor_);
        }
        const REAL *restrict a = volume->values + at, *restrict b = a + row, *restrict c = a + floor_, *restrict d = c + row;
        REAL sum[4];
        for (int k = 0; k < 4; k++) {
            const REAL near_ = a[k] + part[0] * (a[k + 4] - a[k]), far_ = b[k] + part[0] * (b[k + 4] - b[k]);
            const REAL above = c[k] + part[0] * (c[k + 4] - c[k]), beyond = d[k] + part[0] * (d[k + 4] - d[k]);
            const REAL low = near_ + part[1] * (far_ - near_), high = above + part[1] * (beyond - above);
            sum[k] = low + part[2] * (high - low);
        }
        for (int64_t k = 0; k < wanted; k++) to[k * count + p] = sum[k];
    }
    return 0;
}
