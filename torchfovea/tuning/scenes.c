/* First surfaces on rays, `torchfovea.tuning.scenes.first_surfaces`, which is the definition, in C, several rays at once
in the processor's wide registers. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <tgmath.h>

#define BLOCK 256 /* rays that are tried together, can after can */

typedef struct { /* torchfovea.tuning.scenes.Scenes */
    int64_t sets, cans;
    const REAL *x; /* (sets, cans), as what follows */
    const REAL *y;
    const REAL *low;
    const REAL *high;
    const REAL *radius;
    double front, back, side, floor, ceiling;
} Scenes;

typedef struct {
    int64_t rays; /* of a set */
    const REAL *direction; /* (3, sets, rays) */
    int64_t origins; /* of a set: one for all its rays, or as many */
    const REAL *origin; /* (3, sets, origins) */
} Rays;

typedef struct { /* torchfovea.tuning.scenes.Hits, each (sets, rays) */
    REAL *range;
    uint8_t *floor;
    int64_t *can;
} Hits;

static inline REAL off(REAL a) { return fabs(a) < (REAL)1e-12 ? (REAL)1e-12 : a; }

int64_t first_surfaces(const Scenes *scenes, const Rays *rays, const Hits *to) {
    const int64_t n = rays->rays, all = scenes->sets * n, apart = rays->origins > 1 ? n : 1, origins = scenes->sets * apart;
    const REAL front = scenes->front, back = -scenes->back, side = scenes->side, bottom = scenes->floor;
    const REAL ceiling = scenes->ceiling;
    REAL best[BLOCK], ox[BLOCK], oy[BLOCK], oz[BLOCK];
    int32_t which[BLOCK], down[BLOCK];
    for (int64_t start = 0, count; start < all; start += count) {
        const int64_t set = start / n, end = (set + 1) * n;
        count = end - start < BLOCK ? end - start : BLOCK;
        const REAL *restrict dx = rays->direction + start, *restrict dy = dx + all, *restrict dz = dy + all;
        for (int64_t i = 0; i < count; i++) {
            const REAL *o = rays->origin + (apart > 1 ? start + i : set);
            ox[i] = o[0], oy[i] = o[origins], oz[i] = o[2 * origins];
        }
        for (int64_t i = 0; i < count; i++) {
            const REAL sx = off(dx[i]), sy = off(dy[i]), sz = off(dz[i]);
            const REAL along = ((sx > 0 ? front : back) - ox[i]) / sx, across = ((sy > 0 ? side : -side) - oy[i]) / sy;
            const REAL level = ((sz > 0 ? ceiling : bottom) - oz[i]) / sz, wall = along < across ? along : across;
            best[i] = wall < level ? wall : level;
            down[i] = (level < wall) & (sz < 0);
            which[i] = -1;
        }
        for (int64_t j = set * scenes->cans; j < (set + 1) * scenes->cans; j++) {
            const REAL cx = scenes->x[j], cy = scenes->y[j], low = scenes->low[j], high = scenes->high[j];
            const REAL radius = scenes->radius[j];
            const int32_t number = (int32_t)(j - set * scenes->cans);
            for (int64_t i = 0; i < count; i++) {
                const REAL px = ox[i] - cx, py = oy[i] - cy, x = dx[i], y = dy[i], z = dz[i], sz = off(z);
                const REAL square = x * x + y * y, flat = square > (REAL)1e-12 ? square : (REAL)1e-12, b = px * x + py * y;
                const REAL root = b * b - flat * (px * px + py * py - radius * radius), half = sqrt(root > 0 ? root : 1);
                const REAL entry = (-b - half) / flat, leave = (-b + half) / flat, at = oz[i] + entry * z;
                const REAL cap = ((sz > 0 ? low : high) - oz[i]) / sz;
                const int beside = (root > 0) & (entry > 0) & (at >= low) & (at <= high);
                const int above = (root > 0) & (cap > 0) & (cap >= entry) & (cap <= leave);
                const REAL by_side = beside ? entry : (REAL)INFINITY, by_cap = above ? cap : (REAL)INFINITY;
                const REAL met = by_side < by_cap ? by_side : by_cap;
                which[i] = met < best[i] ? number : which[i];
                best[i] = met < best[i] ? met : best[i];
            }
        }
        for (int64_t i = 0; i < count; i++) {
            to->range[start + i] = best[i], to->can[start + i] = which[i];
            to->floor[start + i] = down[i] & (which[i] < 0);
        }
    }
    return 0;
}
