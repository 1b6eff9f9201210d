/* Episodes of the hard policy, `torchfovea.tuning.simulator.simulate` with all that it calls, and what a glance tells,
`torchfovea.tuning.worlds.glance`. They are the definition; this is the same in C, several cells at once in the
processor's wide registers. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <tgmath.h>

#include "../sensing/head.h"

typedef struct {
    REAL axes[9]; /* of the rig, its x, y and z in E */
    REAL middle[3]; /* of the baseline, along these axes */
    REAL half; /* the baseline */
    REAL turned[18]; /* of the left eye, then of the right one: its x, y and z along the rig's axes */
} Rig;

typedef struct { /* the retina, the error budget and the camera */
    double focal_px, radius_px;
    double slope2, least2; /* the squared width is the larger of slope2 times the squared eccentricity, and least2 */
    double share2, source2; /* what of it is variance, and what comes on top [px²] */
} Sensor;

/* Which cells both eyes see, and the variance of their inverse range. */
static void see(const Rig *rig, const Sensor *sensor, int64_t n, const REAL *restrict dx, const REAL *restrict dy,
                const REAL *restrict dz, const REAL *restrict range, uint8_t *restrict visible, REAL *restrict variance) {
    const Rig r = *rig;
    const REAL focal = sensor->focal_px, rim2 = sensor->radius_px * sensor->radius_px, slope2 = sensor->slope2;
    const REAL least2 = sensor->least2, share2 = sensor->share2, source2 = sensor->source2, ahead = (REAL)1e-3;
#pragma GCC ivdep
    for (int64_t i = 0; i < n; i++) {
        const REAL far = range[i];
        const REAL ux = r.axes[0] * dx[i] + r.axes[1] * dy[i] + r.axes[2] * dz[i];
        const REAL uy = r.axes[3] * dx[i] + r.axes[4] * dy[i] + r.axes[5] * dz[i];
        const REAL uz = r.axes[6] * dx[i] + r.axes[7] * dy[i] + r.axes[8] * dz[i];
        const REAL x = far * ux - r.middle[0], y = far * uy - r.middle[1], z = far * uz - r.middle[2];
        int seen = z > ahead;
        const REAL depth = seen ? z : 1, v = y / depth, reach = ux * x + uy * y + uz * depth, by_v = depth * uy / 2;
        REAL spread = 0;
        for (int eye = 0; eye < 2; eye++) {
            const REAL *a = r.turned + 9 * eye, side = eye ? -r.half : r.half;
            const REAL px = a[0] * (x + side) + a[1] * y + a[2] * z, py = a[3] * (x + side) + a[4] * y + a[5] * z;
            const REAL pz = a[6] * (x + side) + a[7] * y + a[8] * z;
            const int forward = pz > ahead;
            const REAL distance = forward ? pz : 1, shrink = focal / distance;
            const REAL away2 = px * shrink * (px * shrink) + py * shrink * (py * shrink);
            seen &= forward & (away2 <= rim2);
            const REAL sigma2 = share2 * larger(slope2 * away2, least2) + source2, scale = distance / depth;
            const REAL u = (x + side) / depth, by_u = depth * (ux / 2 - reach / (2 * side)), both = by_u * u + by_v * v;
            const REAL across = a[0] * by_u + a[1] * by_v - a[2] * both, upright = a[3] * by_u + a[4] * by_v - a[5] * both;
            spread += sigma2 * scale * scale * (across * across + upright * upright);
        }
        const REAL over = focal * far * far;
        visible[i] = seen;
        variance[i] = larger(spread / (over * over), (REAL)1e-12);
    }
}

typedef struct {
    int64_t rows, cells;
    const REAL *direction; /* (3, rows, cells) */
    const REAL *range; /* (rows, cells), as what follows */
    uint8_t *visible;
    REAL *variance;
} Glance;

int64_t glance(const Rig *rig, const Sensor *sensor, const Glance *of) {
    const int64_t n = of->cells, all = of->rows * n;
    for (int64_t i = 0; i < all; i += n) {
        const REAL *d = of->direction + i;
        see(rig++, sensor, n, d, d + all, d + 2 * all, of->range + i, of->visible + i, of->variance + i);
    }
    return 0;
}

typedef struct { /* torchfovea.tuning.worlds.Worlds */
    int64_t rows, cells, saccades;
    const REAL *direction; /* (3, rows, cells) */
    const REAL *range; /* (rows, cells) */
    const REAL *noise; /* (saccades, rows, cells) */
    const uint8_t *allowed; /* (rows, cells) */
} World;

typedef struct { /* where episodes begin */
    const REAL *precision; /* (rows, cells), as what follows */
    const REAL *vector;
    const uint8_t *seen;
    const int64_t *made; /* decisions, (rows,); none: at the initial gaze, before the first look */
    const REAL *weights; /* (4, rows): alpha, by_time, by_unseen, cost_per_deg of torchfovea.deciding.weighted */
} Start;

typedef struct { /* torchfovea.sensing.head.Head, and which cells may be fixated */
    double baseline_m, height_m, pan_limit, up_limit, down_limit, vergence_limit; /* angles [rad] */
    double far_m, nearest_m, ground_z_m, ground_sigmas;
    int64_t range; /* whether the reward is minus the range, not the inverse range */
    int64_t by_unseen, by_cost; /* whether any row has these weights */
} Body;

typedef struct { /* torchfovea.tuning.simulator.Run */
    int64_t *cell; /* (rows, saccades) */
    REAL *score; /* (rows, saccades) */
    REAL *angles; /* (3, rows, saccades) */
    REAL *precision; /* (saccades − 1, rows, cells), before each decision, as what follows; or none are kept */
    REAL *vector;
    uint8_t *seen;
} Run;

/* `torchfovea.sensing.head.eyes`, as seen from the rig, which is the cyclopean frame. */
static Rig pose(const Head *head, const Body *body, REAL pan, REAL tilt, REAL vergence) {
    const REAL cp = cos(pan), sp = sin(pan), ct = cos(tilt), st = sin(tilt);
    const REAL c = cos(vergence / 2), s = sin(vergence / 2);
    return (Rig){{sp, -cp, 0, -cp * st, -sp * st, -ct, cp * ct, sp * ct, -st},
                 {0, -(REAL)head->up_m, head->forward_m},
                 (REAL)body->baseline_m / 2,
                 {c, 0, -s, 0, 1, 0, s, 0, c, c, 0, s, 0, 1, 0, -s, 0, c}};
}

/* `torchfovea.tuning.simulator.score` and `best_cell`: the best score, and its cell or −1. */
static REAL decide(const World *world, const Head *given, const Body *body, int64_t row, const REAL *weights, REAL left,
                   const Rig *rig, const REAL *restrict precision, const REAL *restrict vector, const uint8_t *restrict seen,
                   uint8_t *restrict eligible, REAL *restrict value, int64_t *cell) {
    const int64_t n = world->cells, all = world->rows * n, rows = world->rows, by_range = body->range;
    const REAL *restrict dx = world->direction + row * n, *restrict dy = dx + all, *restrict dz = dy + all;
    const uint8_t *restrict allowed = world->allowed + row * n;
    const REAL least = 1 / body->far_m, height = body->height_m, floor_z = body->ground_z_m;
    const REAL sigmas = body->ground_sigmas, nearest = body->nearest_m;
    const Head head = *given;
    int64_t open = 0, unseen = 0;
#pragma GCC ivdep
    for (int64_t i = 0; i < n; i++) {
        const REAL mean = vector[i] / precision[i], std = 1 / sqrt(precision[i]), range = 1 / larger(mean, least);
        const REAL x = dx[i] * range, y = dy[i] * range, z = dz[i] * range;
        const int ground = seen[i] & (z + height - sigmas * std * range * fabs(z) < floor_z);
        eligible[i] = allowed[i] & can_fixate(&head, x, y, z) & (range > nearest) & !ground;
    }
    if (body->by_unseen)
        for (int64_t i = 0; i < n; i++) open += eligible[i], unseen += eligible[i] & !seen[i];
    const REAL time = weights[rows] * (left - (REAL)0.5);
    const REAL novelty = body->by_unseen ? weights[2 * rows] * ((REAL)unseen / (open > 1 ? open : 1) - (REAL)0.5) : 0;
    const REAL power = time + novelty, alpha = weights[0] * exp(power > 20 ? 20 : power < -20 ? -20 : power);
    const int alone = isinf(alpha);
    const REAL slope = alone ? 1 : alpha, flat = alone ? 0 : 1;
#pragma GCC ivdep
    for (int64_t i = 0; i < n; i++) {
        const REAL mean = vector[i] / precision[i], std = 1 / sqrt(precision[i]), range = 1 / larger(mean, least);
        value[i] = by_range ? slope * (std * range * range) - flat * range : slope * std + flat * mean;
    }
    if (body->by_cost) {
        const REAL *f = rig->axes + 6, degree = (REAL)57.295779513082320877, cost = weights[3 * rows];
        for (int64_t i = 0; i < n; i++) {
            const REAL cx = f[1] * dz[i] - f[2] * dy[i], cy = f[2] * dx[i] - f[0] * dz[i], cz = f[0] * dy[i] - f[1] * dx[i];
            const REAL cosine = f[0] * dx[i] + f[1] * dy[i] + f[2] * dz[i];
            value[i] -= cost * (degree * atan2(sqrt(cx * cx + cy * cy + cz * cz), cosine));
        }
    }
    REAL best = -INFINITY;
    *cell = -1;
    for (int64_t i = 0; i < n; i++)
        if (eligible[i] && value[i] > best) best = value[i], *cell = i;
    if (!isfinite(best)) *cell = -1;
    return best;
}

/* `torchfovea.sensing.head.fixate` of a point that can be fixated. */
static void aim(const Head *head, const Body *body, REAL x, REAL y, REAL z, REAL to[3]) {
    const REAL up = head->up_m, forward = head->forward_m, pan_limit = body->pan_limit, high = body->up_limit;
    const REAL low = body->down_limit, widest = body->vergence_limit, side2 = x * x + y * y;
    const REAL side = sqrt(side2), reach = sqrt(side2 + z * z - up * up), distance = larger(reach - forward, (REAL)1e-6);
    const REAL pan = atan2(y, x), tilt = atan2(up, reach) - atan2(z, side);
    const REAL vergence = 2 * atan2((REAL)body->baseline_m / 2, distance);
    to[0] = pan < -pan_limit ? -pan_limit : pan > pan_limit ? pan_limit : pan;
    to[1] = tilt < high ? high : tilt > low ? low : tilt;
    to[2] = vergence > widest ? widest : vergence;
}

int64_t episodes(const World *world, const Start *start, const Head *head, const Body *body, const Sensor *sensor,
                 const Run *run) {
    const int64_t n = world->cells, rows = world->rows, all = rows * n, steps = world->saccades;
    REAL *precision = malloc(4 * n * sizeof *precision), *vector = precision + n, *variance = vector + n;
    REAL *value = variance + n;
    uint8_t *seen = malloc(3 * n), *visible = seen + n, *eligible = visible + n;
    if (!precision || !seen) return free(precision), free(seen), -1;
    for (int64_t row = 0; row < rows; row++) {
        const REAL *dx = world->direction + row * n, *dy = dx + all, *dz = dy + all, *range = world->range + row * n;
        REAL *pan = run->angles + row * steps, *tilt = pan + rows * steps, *vergence = tilt + rows * steps;
        for (int64_t i = 0; i < n; i++) {
            precision[i] = start->precision[row * n + i], vector[i] = start->vector[row * n + i];
            seen[i] = start->seen[row * n + i];
        }
        for (int64_t t = start->made ? start->made[row] : -1; t < steps - 1; t++) {
            const int64_t now = t < 0 ? 0 : t;
            Rig rig = pose(head, body, pan[now], tilt[now], vergence[now]);
            if (t >= 0) {
                if (run->precision)
                    for (int64_t i = 0, to = t * all + row * n; i < n; i++) {
                        run->precision[to + i] = precision[i], run->vector[to + i] = vector[i];
                        run->seen[to + i] = seen[i];
                    }
                const int64_t between = steps > 3 ? steps - 2 : 1;
                const REAL left = larger(1 - (REAL)t / between, 0);
                REAL aimed[3] = {0, 0, 0};
                int64_t cell;
                run->score[row * steps + t + 1] = decide(world, head, body, row, start->weights + row, left, &rig, precision,
                                                         vector, seen, eligible, value, &cell);
                if (cell >= 0) {
                    const REAL far = 1 / larger(vector[cell] / precision[cell], 1 / (REAL)body->far_m);
                    aim(head, body, far * dx[cell], far * dy[cell], far * dz[cell], aimed);
                }
                run->cell[row * steps + t + 1] = cell;
                pan[t + 1] = aimed[0], tilt[t + 1] = aimed[1], vergence[t + 1] = aimed[2];
                rig = pose(head, body, aimed[0], aimed[1], aimed[2]);
            }
            if (t + 2 >= steps) continue;
            see(&rig, sensor, n, dx, dy, dz, range, visible, variance);
            const REAL *restrict noise = world->noise + (t + 1) * all + row * n;
#pragma GCC ivdep
            for (int64_t i = 0; i < n; i++) {
                const REAL weight = visible[i] / variance[i];
                precision[i] += weight, vector[i] += weight * (1 / range[i] + sqrt(variance[i]) * noise[i]);
                seen[i] |= visible[i];
            }
        }
    }
    return free(precision), free(seen), 0;
}
