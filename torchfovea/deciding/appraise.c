/* What each cell of patches is worth and whether a `Head` may fixate it: `torchfovea.deciding.worth.appraise`, which is
the definition, in C, several cells at once in the processor's wide registers. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <tgmath.h>

#include "../sensing/head.h"

typedef struct { /* torchfovea.memory.egosphere.Memory */
    int64_t sets; /* cells of each follow one another */
    int64_t cells; /* of a set */
    const double *vector; /* (3, all), as every array of vectors here */
    const double *matrix; /* (6, all) */
    const REAL *bearing;
    const REAL *looks;
    const REAL *lasting; /* (2, all) */
    const REAL *votes; /* (2, all) */
    const REAL *centres;
} Memory;

typedef struct {
    double far_m, tiny, height_m, ground_z_m, ground_sigmas, nearest_m; /* tiny: the least sum of votes */
    double unseen_mean, unseen_std, unseen_m; /* an unseen cell's reward, and how far out its point would be */
    int64_t range; /* whether the reward is minus the range, not the inverse range */
} Limits;

typedef struct { /* torchfovea.deciding.worth.Appraisal */
    REAL *mean;
    REAL *covariance;
    REAL *reward;
    REAL *std;
    REAL *open;
    REAL *target;
    uint8_t *eligible;
    REAL *incumbent; /* (sets,) */
} Appraisal;

static void appraise_set(const Memory *memory, const Limits *limits, const Head *head, const Appraisal *to, int64_t set) {
    const int64_t n = memory->cells, all = memory->sets * n, first = set * n, by_range = limits->range;
    const double *restrict v = memory->vector + first, *restrict m = memory->matrix + first;
    const REAL *restrict p = memory->centres + first, *restrict bearing = memory->bearing + first;
    const REAL *restrict looks = memory->looks + first, *restrict lasts = memory->lasting + first;
    const REAL *restrict votes = memory->votes + first;
    REAL *restrict mean = to->mean + first, *restrict cov = to->covariance + first, *restrict target = to->target + first;
    REAL *restrict reward = to->reward + first, *restrict std = to->std + first, *restrict open = to->open + first;
    uint8_t *restrict eligible = to->eligible + first;
    const REAL least = 1 / limits->far_m, nearest2 = limits->nearest_m * limits->nearest_m;
    const REAL then_mean = limits->unseen_mean, then_std = limits->unseen_std, unseen_m = limits->unseen_m;
    const REAL height = limits->height_m, floor_z = limits->ground_z_m, sigmas = limits->ground_sigmas;
    const REAL tiny = limits->tiny;
    const Head by = *head;
#pragma GCC ivdep
    for (int64_t i = 0; i < n; i++) {
        /* `torchfovea.memory.pooling.nearness` */
        const double xx = m[i], xy = m[all + i], xz = m[2 * all + i], yy = m[3 * all + i], yz = m[4 * all + i];
        const double scale = 1 / (xx * yy - xy * xy), a = scale * (xz * yy - yz * xy), b = scale * (yz * xx - xz * xy);
        const double own = 1 / (m[5 * all + i] - a * xz - b * yz);
        const REAL rho = own * (v[2 * all + i] - a * v[i] - b * v[all + i]), alone = own;
        const REAL once = lasts[i], twice = lasts[all + i], together = larger(once * once - twice, 0);
        const REAL variance = alone + alone * alone * together;
        /* `torchfovea.memory.egosphere.cartesian_from_patches` */
        const REAL r = 1 / larger(rho, least), square = r * r, across = square / bearing[i];
        const REAL along = square * square * variance - across, x = p[i], y = p[all + i], z = p[2 * all + i];
        const REAL px = r * x, py = r * y, pz = r * z, zz = across + along * z * z;
        mean[i] = px, mean[all + i] = py, mean[2 * all + i] = pz;
        cov[i] = across + along * x * x, cov[all + i] = along * x * y, cov[2 * all + i] = along * x * z;
        cov[3 * all + i] = across + along * y * y, cov[4 * all + i] = along * y * z, cov[5 * all + i] = zz;
        /* `torchfovea.deciding.worth.worth_of_cells` */
        const REAL sigma = sqrt(variance), known = by_range ? -r : rho, sure_std = by_range ? sigma * r * r : sigma;
        const REAL yes = votes[i], no = votes[all + i], sure = yes / larger(yes + no, tiny), doubt = 1 - sure;
        const REAL unseen = then_std / sqrt(1 + no), part = 2 * variance / (1 + sqrt(1 + 4 * together * variance));
        const REAL left = larger(1 - part * twice, 0) / (1 + part * together), reducible = left > 1 ? 1 : left;
        const int any = sure > 0;
        reward[i] = any ? sure * known + doubt * then_mean : then_mean;
        std[i] = any ? sure * sure_std + doubt * unseen : unseen;
        open[i] = any ? sure * (sure_std * sqrt(reducible)) + doubt * unseen : unseen;
        /* the eyes meet where the surface is, or where an unseen one would be while it is more likely not there */
        const int seen = looks[i] > 0, doubted = seen & (sure < (REAL)0.5);
        const REAL tx = doubted ? x * unseen_m : px, ty = doubted ? y * unseen_m : py, tz = doubted ? z * unseen_m : pz;
        target[i] = tx, target[all + i] = ty, target[2 * all + i] = tz;
        const int ground = seen & (pz - sigmas * sqrt(zz) + height < floor_z);
        eligible[i] = can_fixate(&by, tx, ty, tz) & (px * px + py * py + pz * pz > nearest2) & !ground;
    }
    REAL best = -INFINITY, seen_best = -INFINITY;
    for (int64_t i = 0; i < n; i++) {
        if (!eligible[i]) continue;
        best = larger(reward[i], best);
        if (looks[i] > 0) seen_best = larger(reward[i], seen_best);
    }
    to->incumbent[set] = isfinite(seen_best) ? seen_best : isfinite(best) ? best : 0;
}

int64_t appraise(const Memory *memory, const Limits *limits, const Head *head, const Appraisal *to) {
    for (int64_t set = 0; set < memory->sets; set++) appraise_set(memory, limits, head, to, set);
    return 0;
}
