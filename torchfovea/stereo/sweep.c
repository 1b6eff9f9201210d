/* The best hypothesis of inverse depth for each cell of a sheet: what `torchfovea.stereo.surfaces.win` does with costs,
which is the definition, in C. Hypotheses of a cell lie side by side in memory, so that all loops over them run in the
processor's wide registers. REAL is float or double. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <tgmath.h>

#define LANES 16 /* hypotheses whose costs are found at once */
#define ENDLESS ((REAL)INFINITY)

typedef struct { /* cells are (pairs, rows, columns) */
    int64_t pairs, rows, columns, closed, most;
    const REAL *rho; /* (pairs, most) */
    const int64_t *number; /* (pairs,), of each pair's hypotheses */
    const REAL *ray; /* (3, cells) */
    const REAL *own; /* what the cells see, about 0 */
    const REAL *mean;
    const REAL *variance;
    const REAL *low; /* bounds of inverse depth, or none */
    const REAL *high;
    const REAL *slack; /* of the bounds, (pairs, most) */
    const REAL *given; /* costs (pairs, most, rows, columns), found already, or none */
} Cells;

typedef struct { /* the other eye */
    int64_t levels, height, width;
    const REAL *images; /* (pairs, levels, height, width) */
    const REAL *level; /* (rows, columns), at which of them cells are read */
    const REAL *shift; /* (pairs, 3) */
    double focal_px, cx_px, cy_px, radius_px, scale, middle_x_px, middle_y_px;
} Other;

typedef struct {
    int64_t window, segment, run_in;
    double noise, small, large, contrast, uniqueness;
} Weights;

typedef struct {
    REAL *rho;
    REAL *step;
    uint8_t *clear;
} Winners;

static inline REAL smaller(REAL a, REAL b) { return a < b ? a : b; }
static inline REAL larger(REAL a, REAL b) { return a > b ? a : b; }
static int64_t kept(int64_t k, int64_t size) { return k < 0 ? 0 : k < size ? k : size - 1; }

static void read_level(const Other *to, const REAL *restrict image, const REAL *restrict x, const REAL *restrict y,
                       REAL part, REAL *restrict value) {
    const int32_t line = (int32_t)to->width;
    const REAL right = to->width - 1, low = to->height - 1;
    for (int k = 0; k < LANES; k++) {
        const int32_t i = (int32_t)x[k], j = (int32_t)y[k], at = j * line + i;
        const int32_t beside = x[k] < right, below = y[k] < low ? line : 0;
        const REAL s = x[k] - i, t = y[k] - j;
        const REAL a = image[at], b = image[at + beside], c = image[at + below], d = image[at + below + beside];
        const REAL upper = a + s * (b - a), lower = c + s * (d - c);
        value[k] += part * (upper + t * (lower - upper));
    }
}

/* What the other eye sees of a cell at LANES hypotheses, and whether it does; see `torchfovea.stereo.costs.project`. */
static void look(const Cells *cells, const Other *to, int64_t pair, int64_t place, const REAL *restrict rho,
                 REAL *restrict value, uint8_t *restrict seen) {
    const int64_t area = cells->rows * cells->columns, all = cells->pairs * area, cell = pair * area + place;
    const REAL *shift = to->shift + 3 * pair, *images = to->images + pair * to->levels * to->height * to->width;
    const REAL rx = cells->ray[cell], ry = cells->ray[all + cell], rz = cells->ray[2 * all + cell];
    const REAL tx = shift[0], ty = shift[1], tz = shift[2], focal = to->focal_px, cx = to->cx_px, cy = to->cy_px;
    const REAL reach = to->radius_px * to->radius_px, scale = to->scale, mx = to->middle_x_px, my = to->middle_y_px;
    const REAL right = to->width - 1, low = to->height - 1;
    REAL x[LANES], y[LANES], inside[LANES];
    for (int k = 0; k < LANES; k++) {
        const REAL px = rx + rho[k] * tx, py = ry + rho[k] * ty, pz = rz + rho[k] * tz;
        const REAL inverse = focal / larger(pz, (REAL)1e-3), u = px * inverse + cx, v = py * inverse + cy;
        const REAL column = u * scale + mx, row = v * scale + my;
        inside[k] = (pz > (REAL)1e-3) & (u * u + v * v <= reach) ? 1 : 0; /* of the same width as the rest */
        x[k] = smaller(larger(column, 0), right), y[k] = smaller(larger(row, 0), low), value[k] = 0;
    }
    for (int k = 0; k < LANES; k++) seen[k] = inside[k] > 0;
    const REAL level = to->level[place];
    const int64_t first = (int64_t)level, size = to->height * to->width;
    const REAL coarse = level - first;
    read_level(to, images + first * size, x, y, 1 - coarse, value);
    if (coarse > 0) read_level(to, images + (first + 1) * size, x, y, coarse, value);
}

/* Sums over windows of cells with LANES numbers each, in place; see `torchfovea.stereo.sheets.average`. `line` has room
for two rows. */
static void sum_windows(const Cells *cells, int64_t radius, REAL *values, REAL *line) {
    const int64_t rows = cells->rows, columns = cells->columns, wide = columns * LANES;
    REAL *restrict before = line, *restrict here = line + wide;
    for (int64_t turn = 0; turn < radius; turn++) {
        for (int64_t k = 0; k < wide; k++) before[k] = values[k];
        for (int64_t r = 0; r < rows; r++) {
            REAL *restrict row = values + r * wide;
            const REAL *after = r + 1 < rows ? row + wide : row;
#pragma GCC ivdep
            for (int64_t k = 0; k < wide; k++) {
                const REAL own = row[k];
                row[k] = before[k] + own + after[k];
                before[k] = own;
            }
        }
        for (int64_t r = 0; r < rows; r++) {
            REAL *restrict row = values + r * wide;
            for (int64_t k = 0; k < wide; k++) here[k] = row[k];
            for (int64_t c = 0; c < columns; c++) {
                const int64_t last = cells->closed ? (c + columns - 1) % columns : kept(c - 1, columns);
                const int64_t next = cells->closed ? (c + 1) % columns : kept(c + 1, columns);
                for (int k = 0; k < LANES; k++)
                    row[c * LANES + k] = here[last * LANES + k] + here[c * LANES + k] + here[next * LANES + k];
            }
        }
    }
}

/* Costs (rows, columns, depth) of a pair's hypotheses; `room` is for 3 (rows + 2) · columns · LANES numbers. */
static void find_costs(const Cells *cells, const Other *to, const Weights *by, int64_t pair, int64_t depth,
                       REAL *restrict cost, REAL *room, uint8_t *seen) {
    const int64_t area = cells->rows * cells->columns, from = pair * area, number = cells->number[pair];
    const int64_t size = area * LANES;
    REAL *value = room, *square = room + size, *cross = room + 2 * size, *line = room + 3 * size;
    const REAL share = pow(9, -(double)by->window), noise2 = by->noise * by->noise;
    for (int64_t start = 0; start < depth; start += LANES) {
        REAL rho[LANES], slack[LANES];
        for (int k = 0; k < LANES; k++) {
            const int64_t d = kept(start + k, number), place = pair * cells->most + d;
            rho[k] = cells->rho[place], slack[k] = cells->low ? cells->slack[place] : 0;
        }
        for (int64_t p = 0; p < area; p++) {
            const REAL own = cells->own[from + p];
            REAL *restrict v = value + p * LANES, *restrict s = square + p * LANES, *restrict c = cross + p * LANES;
            look(cells, to, pair, p, rho, v, seen + p * LANES);
            for (int k = 0; k < LANES; k++) s[k] = v[k] * v[k], c[k] = own * v[k];
        }
        for (int which = 0; which < 3; which++) sum_windows(cells, by->window, room + which * size, line);
        for (int64_t p = 0; p < area; p++) {
            const REAL own_mean = cells->mean[from + p], own_variance = cells->variance[from + p];
            const REAL low = cells->low ? cells->low[from + p] : -ENDLESS, high = cells->low ? cells->high[from + p] : ENDLESS;
            const REAL *restrict v = value + p * LANES, *restrict s = square + p * LANES, *restrict c = cross + p * LANES;
            const uint8_t *restrict known = seen + p * LANES;
            REAL *restrict out = cost + p * depth + start;
            for (int k = 0; k < LANES; k++) {
                const REAL mean = v[k] * share, variance = larger(s[k] * share - mean * mean, 0) + noise2;
                const REAL z = (c[k] * share - own_mean * mean) / sqrt(own_variance * variance);
                const int within = known[k] & (rho[k] >= low - slack[k]) & (rho[k] <= high + slack[k]);
                const REAL own = within ? smaller(1 - z, 1) : 1;
                out[k] = start + k < number ? own : ENDLESS;
            }
        }
    }
}

/* The least of LANES numbers: halved four times, which the compiler keeps in registers where it is written out. */
static inline REAL least_lane(const REAL *restrict x) {
    REAL a[8], b[4];
    for (int k = 0; k < 8; k++) a[k] = smaller(x[k], x[k + 8]);
    for (int k = 0; k < 4; k++) b[k] = smaller(a[k], a[k + 4]);
    return smaller(smaller(b[0], b[2]), smaller(b[1], b[3]));
}

static inline REAL least(const REAL *restrict x, int64_t depth) {
    REAL lanes[LANES];
    for (int k = 0; k < LANES; k++) lanes[k] = x[k];
    for (int64_t d = LANES; d < depth; d += LANES)
        for (int k = 0; k < LANES; k++) lanes[k] = smaller(x[d + k], lanes[k]);
    return least_lane(lanes);
}

/* One step of a path, from costs along it, of which `best` is the least, to the next cell's; the least of these. There
is a place without end on either side of both. */
static inline REAL pass_on(const REAL *restrict before, REAL best, const REAL *restrict cost, REAL *restrict path,
                           int64_t depth, REAL small, REAL large) {
    REAL lanes[LANES];
    for (int k = 0; k < LANES; k++) lanes[k] = ENDLESS;
    for (int64_t d = 0; d < depth; d += LANES)
        for (int k = 0; k < LANES; k++) {
            const REAL aside = smaller(before[d + k - 1] - best, before[d + k + 1] - best) + small;
            const REAL own = cost[d + k] + smaller(smaller(aside, before[d + k] - best), large);
            path[d + k] = own, lanes[k] = smaller(own, lanes[k]);
        }
    return least_lane(lanes);
}

typedef struct {
    int64_t size, step; /* of a line: cells, and from one to the next */
    int64_t first; /* its first cell */
    int64_t closed;
} Line;

static int64_t cell_of(const Line *line, int64_t k) {
    k = line->closed ? ((k % line->size) + line->size) % line->size : kept(k, line->size);
    return line->first + k * line->step;
}

/* Paths along a line both ways, in segments, each after a run-in; the sum of the two is added to `total`, or is it. */
static void follow(const Line *line, const Weights *by, const REAL *cost, const REAL *shade, REAL *total, int64_t depth,
                   int add, REAL *ways, REAL *paths) {
    const int64_t size = line->size;
    int64_t parts = lrint((double)size / by->segment);
    parts = parts < 1 ? 1 : parts;
    const int64_t length = (size + parts - 1) / parts + (line->closed || parts > 1 ? by->run_in : 0);
    const REAL small = by->small, large = by->large, contrast = by->contrast;
    REAL *both[2] = {paths + 1, paths + depth + 3};
    for (int64_t part = 0; part < parts; part++) {
        const int64_t start = part * size / parts, end = (part + 1) * size / parts;
        for (int backward = 0; backward < 2; backward++) {
            const int64_t way = backward ? -1 : 1, from = backward ? start - 1 + length : end - length;
            int64_t cell = cell_of(line, from);
            for (int64_t d = 0; d < depth; d++) both[0][d] = cost[cell * depth + d];
            REAL best = least(both[0], depth);
            for (int64_t t = 0; t < length; t++) {
                const REAL *restrict path = both[t % 2];
                const int64_t k = from + way * t, own = k - start;
                if (own >= 0 && k < end) {
                    REAL *restrict kept_way = ways + own * depth, *restrict sum = total + cell_of(line, k) * depth;
                    if (!backward)
                        for (int64_t d = 0; d < depth; d++) kept_way[d] = path[d];
                    else if (!add)
                        for (int64_t d = 0; d < depth; d++) sum[d] = path[d] + kept_way[d];
                    else
                        for (int64_t d = 0; d < depth; d++) sum[d] = (sum[d] + (path[d] + kept_way[d])) * (REAL)0.25;
                }
                if (t + 1 == length) break;
                const int64_t next = cell_of(line, k + way);
                const REAL bound = larger(large / (1 + fabs(shade[next] - shade[cell]) / contrast), small);
                best = pass_on(path, best, cost + next * depth, both[(t + 1) % 2], depth, small, bound);
                cell = next;
            }
        }
    }
}

static void choose(const Cells *cells, const Weights *by, int64_t pair, int64_t place, const REAL *restrict total,
                   int64_t depth, const Winners *to) {
    const int64_t number = cells->number[pair], cell = pair * cells->rows * cells->columns + place;
    const REAL *rho = cells->rho + pair * cells->most, best = least(total, depth);
    int64_t win = 0;
    while (win < number - 1 && total[win] != best) win++;
    REAL other = ENDLESS;
    for (int64_t d = 0; d < win - 2; d++) other = smaller(total[d], other);
    for (int64_t d = win + 3; d < number; d++) other = smaller(total[d], other);
    const int64_t k = win < 1 ? 1 : win > number - 2 ? number - 2 : win;
    const REAL before = total[k - 1], here = total[k], after = total[k + 1], bend = before - 2 * here + after;
    REAL part = bend > 0 ? (before - after) / (2 * larger(bend, (REAL)1e-9)) : 0;
    part = rint(4 * larger(smaller(part, (REAL)0.5), (REAL)-0.5)) / 4;
    const REAL step = part < 0 ? rho[k] - rho[k - 1] : rho[k + 1] - rho[k];
    to->rho[cell] = rho[k] + part * step, to->step[cell] = step;
    to->clear[cell] = other - best >= (REAL)by->uniqueness * best;
}

/* Winners (pairs, rows, columns); -1 where memory runs out, else 0. */
int64_t sweep(const Cells *cells, const Other *to, const Weights *by, const Winners *winners) {
    const int64_t rows = cells->rows, columns = cells->columns, area = rows * columns;
    const int64_t deepest = (cells->most + LANES - 1) / LANES * LANES, longest = rows > columns ? rows : columns;
    REAL *cost = malloc(area * deepest * sizeof *cost), *total = malloc(area * deepest * sizeof *total);
    REAL *ways = malloc(longest * deepest * sizeof *ways), *paths = malloc(2 * (deepest + 2) * sizeof *paths);
    REAL *room = malloc((3 * area + 2 * columns) * LANES * sizeof *room);
    uint8_t *seen = malloc(area * LANES);
    const int built = cost && total && ways && paths && room && seen;
    for (int64_t pair = 0; built && pair < cells->pairs; pair++) {
        const int64_t depth = (cells->number[pair] + LANES - 1) / LANES * LANES;
        const REAL *shade = cells->own + pair * area;
        if (!cells->given)
            find_costs(cells, to, by, pair, depth, cost, room, seen);
        else
            for (int64_t d = 0; d < depth; d++)
                for (int64_t p = 0; p < area; p++)
                    cost[p * depth + d] = d < cells->number[pair] ? cells->given[(pair * cells->most + d) * area + p] : ENDLESS;
        paths[0] = paths[depth + 1] = paths[depth + 2] = paths[2 * depth + 3] = ENDLESS;
        for (int64_t c = 0; c < columns; c++) {
            const Line line = {rows, columns, c, 0};
            follow(&line, by, cost, shade, total, depth, 0, ways, paths);
        }
        for (int64_t r = 0; r < rows; r++) {
            const Line line = {columns, 1, r * columns, cells->closed};
            follow(&line, by, cost, shade, total, depth, 1, ways, paths);
            for (int64_t c = 0; c < columns; c++)
                choose(cells, by, pair, r * columns + c, total + (r * columns + c) * depth, depth, winners);
        }
    }
    free(cost), free(total), free(ways), free(paths), free(room), free(seen);
    return built ? 0 : -1;
}
