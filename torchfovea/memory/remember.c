/* One look's votes and what it tells, cell by cell: `torchfovea.memory.voting.see` and `cast` and
`torchfovea.memory.pooling.pool_patches`, which are the definition, in C, observation by observation.

REAL is float or double; sums of information are kept in double, as there. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <tgmath.h>

#define TIE 1.001 /* as in torchfovea.memory.voting */

typedef struct {
    int64_t pairs;
    int64_t observations; /* of all sets */
    int64_t cells;
    const int64_t *observation;
    const int64_t *cell;
    const REAL *mean; /* (3, observations), as every array of vectors here */
    const REAL *covariance; /* (6, observations) */
    const REAL *direction;
    const REAL *inlier; /* NULL: all are certain */
    const REAL *patch; /* torchfovea.sensing.kinship.Kinship; NULL: none */
    const REAL *lasts;
    const REAL *centres; /* of the cells */
} Look;

typedef struct { /* torchfovea.memory.egosphere.Memory */
    double *vector; /* (3, cells) */
    double *matrix; /* (6, cells) */
    REAL *bearing;
    REAL *looks;
    REAL *lasting; /* (2, cells) */
    REAL *votes; /* (2, cells) */
} Memory;

typedef struct { /* where what the look tells is added up */
    double *vector;
    double *matrix;
    REAL *bearing;
    REAL *hits; /* NULL: nobody asks */
    REAL *kinship; /* (4, cells): precision, its root, that of what lasts, patches; NULL: nobody asks */
} Pooled;

typedef struct { /* of torchfovea.memory.egosphere.Prior and Fusion */
    double mean, std, bearing_std, slope_std, conflict, window, nearest_m;
} Settings;

typedef struct { /* torchfovea.memory.voting.Sight, of one observation, and how it votes */
    REAL rho, variance, x, y, z, across, inlier;
    uint8_t agrees, ahead;
} Sight;

typedef struct {
    REAL mean[3], covariance[6];
} Belief;

/* Moments of a cell by its factors L D Lt, see `torchfovea.gaussian.inverse3` and `torchfovea.memory.egosphere.belief`. */
static Belief believe(const Memory *memory, int64_t cells, int64_t c) {
    const double *v = memory->vector + c, *m = memory->matrix + c;
    const double a = v[0], b = v[cells], g = v[2 * cells];
    const double xx = m[0], xy = m[cells], xz = m[2 * cells], yy = m[3 * cells], yz = m[4 * cells], zz = m[5 * cells];
    const double one = 1 / xx, yx = xy * one, zx = xz * one, two = 1 / (yy - yx * xy), left = yz - yx * xz, zy = left * two;
    const double i_zz = 1 / (zz - zx * xz - zy * left), i_yz = -zy * i_zz, i_yy = two - zy * i_yz;
    const double i_xz = -zx * i_zz - yx * i_yz, i_xy = -yx * i_yy - zx * i_yz, i_xx = one - yx * i_xy - zx * i_xz;
    const REAL once = memory->lasting[c], twice = memory->lasting[cells + c], together = once * once - twice;
    const REAL variance = i_zz;
    return (Belief){{i_xx * a + i_xy * b + i_xz * g, i_xy * a + i_yy * b + i_yz * g, i_xz * a + i_yz * b + i_zz * g},
                    {i_xx, i_xy, i_xz, i_yy, i_yz, variance + variance * variance * (together > 0 ? together : 0)}};
}

/* An observation as a row of a cell's filter; its direction in the frame of `torchfovea.sensing.chart.basis`. */
static Sight see(const Look *look, int64_t i, int64_t c, REAL slope2) {
    const int64_t n = look->observations, cells = look->cells;
    const REAL u = look->direction[i], v = look->direction[n + i], w = look->direction[2 * n + i];
    const REAL x = look->centres[c], y = look->centres[cells + c], z = look->centres[2 * cells + c];
    const REAL sign = copysign((REAL)1, z), a = -1 / (sign + z), b = x * y * a;
    const REAL across = look->covariance[i] + look->covariance[3 * n + i];
    return (Sight){look->mean[2 * n + i],
                   look->covariance[5 * n + i] + slope2 * across,
                   u * (1 + sign * x * x * a) + v * (sign * b) - w * (sign * x),
                   u * b + v * (sign + y * y * a) - w * y,
                   u * x + v * y + w * z,
                   across,
                   look->inlier ? look->inlier[i] : 1,
                   0,
                   0};
}

/* Whether the surface that a cell believes in foretells an observation. */
static int foretold(const Sight *s, const Belief *known, REAL conflict2) {
    const REAL *c = known->covariance, x = s->x, y = s->y, z = s->z;
    const REAL off = s->rho - (known->mean[0] * x + known->mean[1] * y + known->mean[2] * z);
    const REAL form = c[0] * x * x + c[3] * y * y + c[5] * z * z + 2 * (c[1] * x * y + c[2] * x * z + c[4] * y * z);
    return off * off < conflict2 * (s->variance + form);
}

/* Of what does not agree, the nearest surface hides the rest: `torchfovea.memory.association.in_front`. */
static void hide(const Look *look, Sight *sights, REAL *surface, REAL conflict, REAL slope2) {
    for (int64_t c = 0; c < look->cells; c++) surface[c] = -INFINITY;
    for (int64_t p = 0; p < look->pairs; p++) {
        const Sight *s = sights + p;
        if (s->agrees || !(s->inlier > (REAL)0.5)) continue;
        const REAL edge = s->rho - conflict * sqrt(s->variance + slope2 * (s->x * s->x + s->y * s->y));
        if (edge > surface[look->cell[p]]) surface[look->cell[p]] = edge;
    }
    for (int64_t p = 0; p < look->pairs; p++) {
        Sight *s = sights + p;
        const REAL margin = conflict * sqrt(s->variance + slope2 * (s->x * s->x + s->y * s->y));
        s->ahead = !s->agrees && s->rho + margin >= surface[look->cell[p]];
    }
}

/* What a look leaves of the votes (5.2): the cells that take its surface for theirs, and the votes after it. */
static void count(const REAL sums[4], const Memory *before, Memory *after, int64_t cells, int64_t c, REAL window, uint8_t *anew) {
    const REAL agree = sums[0], hits = agree + sums[1], share = 1 / (hits > 1 ? hits : 1);
    const REAL pro = fmin(sums[2] * share, (REAL)1), contra = fmin(sums[3] * share, (REAL)1);
    const REAL yes = before->votes[c], no = before->votes[cells + c];
    const int reached = hits > 0, fresh = !(before->looks[c] > 0) && reached;
    REAL more_yes = yes + pro, more_no = no + (agree > 0 ? 1 - pro : contra) * reached;
    const int turned = !fresh && more_no > (REAL)TIE * more_yes && contra > pro;
    *anew = fresh || turned;
    if (*anew) more_yes = contra, more_no = (turned ? yes : 0) + 1 - contra;
    const REAL total = more_yes + more_no, scale = window / (total > window ? total : window);
    after->votes[c] = more_yes * scale, after->votes[cells + c] = more_no * scale;
    after->looks[c] = before->looks[c] + reached;
}

static void keep_sums(const double *restrict from, double *restrict to, int64_t cells, const uint8_t *restrict anew, double other) {
    for (int64_t c = 0; c < cells; c++) {
        const double kept = from[c];
        to[c] = anew[c] ? other : kept;
    }
}

static void keep(const REAL *restrict from, REAL *restrict to, int64_t cells, const uint8_t *restrict anew, REAL other) {
    for (int64_t c = 0; c < cells; c++) {
        const REAL kept = from[c];
        to[c] = anew[c] ? other : kept;
    }
}

/* What is left of a cell that takes another surface is the prior: `torchfovea.memory.egosphere.blend`. */
static void blend(const Memory *before, Memory *after, int64_t cells, const uint8_t *anew, const Settings *by) {
    const double weight = 1 / (by->std * by->std), slope = 1 / (by->slope_std * by->slope_std);
    const double prior[9] = {0, 0, by->mean * weight, slope, 0, 0, slope, 0, weight};
    const REAL bearing = 1 / (by->bearing_std * by->bearing_std);
    for (int k = 0; k < 3; k++) keep_sums(before->vector + k * cells, after->vector + k * cells, cells, anew, prior[k]);
    for (int k = 0; k < 6; k++) keep_sums(before->matrix + k * cells, after->matrix + k * cells, cells, anew, prior[3 + k]);
    keep(before->bearing, after->bearing, cells, anew, bearing);
    for (int k = 0; k < 2; k++) keep(before->lasting + k * cells, after->lasting + k * cells, cells, anew, 0);
}

/* Add up an observation's information, `torchfovea.memory.pooling.pool_patches`, and what kinship asks for. */
static void add(const Look *look, const Sight *s, REAL share, int64_t p, Pooled *to) {
    const int64_t cells = look->cells, c = look->cell[p], i = look->observation[p];
    const double x = s->x, y = s->y, z = s->z, rho = s->rho, weight = share / s->variance;
    const double wx = weight * x, wy = weight * y, wz = weight * z;
    const double vector[3] = {wx * rho, wy * rho, wz * rho}, matrix[6] = {wx * x, wx * y, wx * z, wy * y, wy * z, wz * z};
    for (int k = 0; k < 3; k++) to->vector[k * cells + c] += vector[k];
    for (int k = 0; k < 6; k++) to->matrix[k * cells + c] += matrix[k];
    to->bearing[c] += share * (2 / s->across);
    if (to->hits) to->hits[c] += share;
    if (!to->kinship) return;
    const REAL root = 1 / sqrt(s->variance);
    const REAL more[4] = {root * root, root, root * sqrt(look->lasts[i]), look->patch[i]};
    for (int k = 0; k < 4; k++) to->kinship[k * cells + c] += share * more[k];
}

/* A look's votes, counted; what was believed and still is, in `after`; what the look tells, added to `pooled`, which
may be the same arrays. -1 where memory runs out, else 0. */
int64_t remember(const Look *look, const Memory *before, Memory *after, Pooled *pooled, const Settings *by) {
    const int64_t cells = look->cells, voting = by->conflict < INFINITY;
    const REAL slope2 = by->slope_std * by->slope_std, conflict2 = by->conflict * by->conflict;
    const REAL mean = by->mean, std = by->std, usual = log(by->std * sqrt(2 * M_PI) * by->nearest_m);
    Sight *sights = malloc((look->pairs + 1) * sizeof *sights);
    Belief *beliefs = malloc((cells + 1) * sizeof *beliefs);
    REAL *sums = calloc(4 * cells + 1, sizeof *sums), *surface = malloc((cells + 1) * sizeof *surface);
    uint8_t *anew = malloc(cells + 1), *asked = calloc(cells + 1, 1);
    const int room = sights && beliefs && sums && surface && anew && asked;
    for (int64_t p = 0; p < look->pairs && room; p++) {
        const int64_t c = look->cell[p];
        sights[p] = see(look, look->observation[p], c, slope2);
        sights[p].agrees = before->looks[c] > 0;
        if (sights[p].agrees && voting) {
            if (!asked[c]) asked[c] = 1, beliefs[c] = believe(before, cells, c);
            sights[p].agrees = foretold(sights + p, beliefs + c, conflict2);
        }
        sights[p].ahead = !sights[p].agrees;
    }
    if (room && voting) hide(look, sights, surface, by->conflict, slope2);
    for (int64_t p = 0; p < look->pairs && room; p++) {
        const Sight *s = sights + p;
        REAL *sum = sums + 4 * look->cell[p];
        if (s->agrees) sum[0] += 1, sum[2] += s->inlier;
        if (!s->ahead) continue;
        /* how much more often true surfaces lie there than false matches, which are even in inverse range */
        const REAL off = (s->rho - mean) / std, rare = usual + off * off / 2, odds = rare > 0 ? exp(-rare) : 1;
        const REAL likely = s->inlier * odds, all = likely + 1 - s->inlier;
        sum[1] += 1, sum[3] += likely / (all > (REAL)1e-12 ? all : (REAL)1e-12);
    }
    for (int64_t c = 0; c < cells && room; c++) count(sums + 4 * c, before, after, cells, c, by->window, anew + c);
    if (room) blend(before, after, cells, anew, by);
    for (int64_t p = 0; p < look->pairs && room; p++) {
        const int counts = anew[look->cell[p]] ? sights[p].ahead : sights[p].agrees;
        if (counts) add(look, sights + p, sights[p].inlier, p, pooled);
    }
    free(sights), free(beliefs), free(sums), free(surface), free(anew), free(asked);
    return room ? 0 : -1;
}
