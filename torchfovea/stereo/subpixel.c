/* Offsets of surfaces by what both eyes see of them: `torchfovea.stereo.subpixel.subpixel` once it has read the images,
which is the definition, in C. REAL is float or double. */

#include <stdint.h>
#include <stdlib.h>
#include <tgmath.h>

typedef struct { /* a batch of sheets of cells */
    int64_t batch, rows, columns, closed; /* closed: the last column neighbours the first */
    const REAL *other; /* (batch, 3, rows, columns), what the other eye sees before, at and after the surface */
    const REAL *own; /* what the eye sees behind, at and ahead of its cells */
    const uint8_t *trusted; /* (batch, rows, columns) */
    int64_t radius, wide; /* of a neighbourhood; how far apart its surroundings are */
    double step, noise, smooth; /* of the derivatives; of the images; of a surface */
    double near_samples, far_samples; /* independent ones of a neighbourhood and of its surroundings */
} Sheets;

enum { LL, RR, LR, LXL, LXR, RXL, RXR, XY, XX, YY, PRODUCTS, WEIGHT = 4 + PRODUCTS, PLANES };
static const int PAIRS[PRODUCTS][2] = {{0, 0}, {1, 1}, {0, 1}, {0, 2}, {1, 2}, {0, 3}, {1, 3}, {2, 3}, {2, 2}, {3, 3}};

static inline REAL least(REAL value, REAL floor_) { return value > floor_ ? value : floor_; }

/* Sums over 3 x 3 cells that are `apart` cells from each other, times a factor, repeated beyond an open border. */
static void box(const Sheets *sheets, REAL *restrict plane, int64_t apart, REAL factor, REAL *restrict aside) {
    const int64_t rows = sheets->rows, columns = sheets->columns;
    for (int64_t i = 0; i < rows; i++) {
        const REAL *above = plane + (i > apart ? i - apart : 0) * columns, *here = plane + i * columns;
        const REAL *below = plane + (i + apart < rows ? i + apart : rows - 1) * columns;
        for (int64_t j = 0; j < columns; j++) aside[i * columns + j] = above[j] + here[j] + below[j];
    }
    for (int64_t i = 0; i < rows; i++) {
        const REAL *restrict from = aside + i * columns;
        REAL *restrict to = plane + i * columns;
        for (int64_t j = apart; j < columns - apart; j++) to[j] = factor * (from[j - apart] + from[j] + from[j + apart]);
        for (int64_t j = 0; j < columns; j += j + 1 == apart && columns > 2 * apart ? columns - 2 * apart + 1 : 1) {
            const int64_t left = j - apart, right = j + apart, last = columns - 1;
            const REAL before = from[left >= 0 ? left : sheets->closed ? left + columns : 0];
            to[j] = factor * (before + from[j] + from[right <= last ? right : sheets->closed ? right - columns : last]);
        }
    }
}

/* The offset and the inverse of its variance: `torchfovea.stereo.subpixel._solve`. */
static inline REAL solve(REAL pull, REAL shared, REAL energy, REAL error, REAL samples, REAL floor_, REAL *value) {
    const REAL differ = energy / 2 - shared, positive = least(shared, 0);
    const REAL clear = least(positive * positive - differ * differ / least(samples, (REAL)1e-3), 0);
    *value = clear > 0 ? pull / (2 * shared) : 0;
    const REAL rest = least(error - *value * pull + *value * *value * energy / 4, floor_);
    return 4 * samples * clear / (rest * least(energy, (REAL)1e-3 * floor_));
}

/* Value, variance, correlation, misfit and rest of every cell, (5, batch, rows, columns). -1 where memory runs out. */
int64_t refine(const Sheets *sheets, REAL *restrict told) {
    const int64_t cells = sheets->rows * sheets->columns, all = sheets->batch * cells;
    const REAL ninth = (REAL)1 / 9, floor_ = sheets->noise * sheets->noise, half = 1 / (2 * sheets->step);
    REAL *planes = malloc((PLANES + 6) * cells * sizeof *planes);
    if (!planes) return -1;
    REAL *wide = planes + PLANES * cells, *aside = wide + 5 * cells, *weight = planes + WEIGHT * cells;
    for (int64_t b = 0; b < sheets->batch; b++) {
        const REAL *other = sheets->other + 3 * b * cells, *own = sheets->own + 3 * b * cells;
        REAL *value = told + b * cells, *variance = value + all, *correlation = variance + all;
        REAL *misfit = correlation + all, *remains = misfit + all;
        for (int64_t i = 0; i < cells; i++) {
            const REAL trust = sheets->trusted[b * cells + i];
            const REAL signal[] = {own[cells + i], other[cells + i], half * (own[2 * cells + i] - own[i]),
                                   half * (other[2 * cells + i] - other[i])};
            for (int k = 0; k < 4; k++) planes[k * cells + i] = trust * signal[k];
            for (int k = 0; k < PRODUCTS; k++) planes[(4 + k) * cells + i] = trust * signal[PAIRS[k][0]] * signal[PAIRS[k][1]];
            weight[i] = trust;
        }
        for (int k = 0; k < PLANES; k++)
            for (int64_t r = 0; r < sheets->radius; r++) box(sheets, planes + k * cells, 1, ninth, aside);
        for (int64_t i = 0; i < cells; i++) {
            const REAL share = 1 / least(weight[i], (REAL)1e-3);
            REAL mean[4], moment[PRODUCTS];
            for (int k = 0; k < 4; k++) mean[k] = planes[k * cells + i] * share;
            for (int k = 0; k < PRODUCTS; k++)
                moment[k] = planes[(4 + k) * cells + i] * share - mean[PAIRS[k][0]] * mean[PAIRS[k][1]];
            const REAL ll = least(moment[LL], 0) + floor_, rr = least(moment[RR], 0) + floor_, gain = sqrt(ll / rr);
            const REAL pull = moment[LXL] - gain * (moment[LXR] - moment[RXL]) - gain * gain * moment[RXR];
            const REAL shared = gain * moment[XY], error = 2 * least(ll - gain * moment[LR], floor_);
            const REAL energy = least(moment[XX] + gain * (2 * moment[XY] + gain * moment[YY]), 0);
            const REAL differs = own[cells + i] - mean[0] - gain * (other[cells + i] - mean[1]);
            wide[i] = weight[i] * pull, wide[cells + i] = weight[i] * shared, wide[2 * cells + i] = weight[i] * energy;
            wide[3 * cells + i] = weight[i] * error, wide[4 * cells + i] = weight[i];
            misfit[i] = differs * differs;
            planes[i] = pull, planes[cells + i] = shared, planes[2 * cells + i] = energy, planes[3 * cells + i] = error;
            planes[4 * cells + i] = ll;
        }
        for (int k = 0; k < 5; k++) box(sheets, wide + k * cells, sheets->wide, ninth, aside);
        box(sheets, misfit, 1, ninth, aside);
        for (int64_t i = 0; i < cells; i++) {
            const REAL pull = planes[i], energy = planes[2 * cells + i], error = planes[3 * cells + i];
            const REAL around = wide[4 * cells + i], share = 1 / least(around, (REAL)1e-3), smooth = sheets->smooth;
            REAL near_, far_;
            const REAL sure = solve(pull, planes[cells + i], energy, error, sheets->near_samples * weight[i], 2 * floor_, &near_);
            const REAL known = solve(wide[i] * share, wide[cells + i] * share, wide[2 * cells + i] * share,
                                     wide[3 * cells + i] * share, sheets->far_samples * around, 2 * floor_, &far_);
            /* the matcher's word is good to a width; then the surroundings'; then the neighbourhood's own */
            const REAL doubt = 1 / (1 + known) + smooth * smooth, precision = sure + 1 / doubt;
            const REAL offset = (near_ * sure + far_ * known / (1 + known) / doubt) / precision;
            value[i] = offset, variance[i] = 1 / precision;
            remains[i] = least(error - offset * pull + offset * offset * energy / 4, 0);
            correlation[i] = weight[i] * (1 - remains[i] / (2 * planes[4 * cells + i]));
        }
    }
    return free(planes), 0;
}
