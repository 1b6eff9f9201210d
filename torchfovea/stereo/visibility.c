/* Which claims on places of the right eye others outdo: `torchfovea.stereo.visibility.outdone`, which is the definition,
in C. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <tgmath.h>

#define NEAR 3 /* torchfovea.stereo.visibility.NEAR: how far beside each other rivals may lie */
#define SPAN 8 /* places about a cell that are looked at together, 2 NEAR + 1 of them */

typedef struct {
    int64_t batch, count; /* of the claims: (batch, count) */
    int64_t rows, columns; /* cells of the right eye */
    const int64_t *cell; /* (2, batch, count), column and row */
    const REAL *disparity; /* in cells */
    const REAL *misfit;
    const uint8_t *valid;
    double apart, clear;
} Claims;

/* Fill `lost`, and how far the farthest rival's disparity differs, (batch, count) each. -1 where memory runs out, else 0. */
int64_t outdone(const Claims *claims, uint8_t *restrict lost, REAL *restrict rivals) {
    const int64_t width = claims->columns + 2 * NEAR, size = claims->rows * width + SPAN, all = claims->batch * claims->count;
    const REAL apart = claims->apart, clear = claims->clear;
    int32_t *place = malloc(claims->count * sizeof *place); /* where each looks for rivals; -1 where it does not count */
    REAL *least = malloc(2 * size * sizeof *least), *told = least + size, limit[SPAN];
    if (!least || !place) return free(least), free(place), -1;
    for (int k = 0; k < SPAN; k++) limit[k] = k <= 2 * NEAR ? apart + abs(k - NEAR) : (REAL)INFINITY;
    for (int64_t start = 0; start < all; start += claims->count) {
        const int64_t *column = claims->cell + start, *row = column + all;
        const REAL *misfit = claims->misfit + start, *disparity = claims->disparity + start;
        for (int64_t n = 0; n < claims->count; n++) {
            const int inside = (column[n] >= 0) & (column[n] < claims->columns) & (row[n] >= 0) & (row[n] < claims->rows);
            place[n] = inside & claims->valid[start + n] ? row[n] * width + column[n] : -1;
        }
        for (int64_t i = 0; i < size; i++) least[i] = INFINITY, told[i] = NAN;
        for (int64_t n = 0; n < claims->count; n++) {
            REAL *best = least + place[n] + NEAR;
            if (place[n] >= 0) *best = misfit[n] < *best ? misfit[n] : *best;
        }
        for (int64_t n = 0; n < claims->count; n++)
            if (place[n] >= 0 && misfit[n] == least[place[n] + NEAR]) told[place[n] + NEAR] = disparity[n];
        for (int64_t n = 0; n < claims->count; n++) {
            const REAL *around = told + place[n];
            int any = 0, out = 0;
            REAL dispute = 0;
            for (int k = 0; place[n] >= 0 && k < SPAN; k++) any |= fabs(around[k] - disparity[n]) > limit[k];
            for (int k = 0; any && k < SPAN; k++) {
                const REAL differs = fabs(around[k] - disparity[n]);
                if (!(differs > limit[k])) continue;
                out |= least[place[n] + k] * clear < misfit[n];
                dispute = differs > dispute ? differs : dispute;
            }
            lost[start + n] = out, rivals[start + n] = dispute;
        }
    }
    return free(least), free(place), 0;
}
